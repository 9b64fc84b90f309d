"""Statics by virtual work: where a system rests, what holds it there, and whether it stays.

No virtual displacement does work at rest::

    nle(q, 0) - τ_passive(q, 0) = τ + Σ J_Fᵀ F + Jᵀ λ,      f(q) = 0

with the forces F at frames, and λ where constraints act.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit.engines.base import Dynamics
from mbkit.engines.clock import at_time
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, NumericalError, UnknownNameError
from mbkit.lagrangian.small_motion import SmallMotion, small_motion
from mbkit.lagrangian.system import Lagrangian

__all__ = ["Equilibrium", "equilibrium"]

_MOST: Final = 200
_STARTS: Final = 30
#: Of the forces that balance: what rounding leaves of them.
_BALANCED: Final = 1e-11
# rad or m: a neighbourhood, in which stiffness that vanishes at a threshold does not.
_ASIDE: Final = 0.1
_EPS: Final = float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A configuration at rest.

    Attributes
    ----------
    q : (nq,) array
    tau : (nv,) array
        The generalized force that acts there, or that holds it.
    residual : float
        The largest force that is left over, in the units of tau.
    multipliers : (m,) array
        λ of the constraints; empty without.
    stable : bool or None
        Of small motions: True where they stay small, False where some grow, None where
        the linear equation does not decide.
    frequencies : (k,) array
        Angular frequencies of those that oscillate, rad/s, increasing.
    eigenvalues : (2 f,) complex array
        Of the linearized equation with f degrees of freedom, 1/s.
    name : str
    coordinates, velocities : tuple of str
        What the entries of q and of tau belong to.
    """

    q: Array
    tau: Array
    residual: float
    multipliers: Array
    stable: bool | None
    frequencies: Array
    eigenvalues: Any
    name: str
    coordinates: tuple[str, ...] = field(repr=False)
    velocities: tuple[str, ...] = field(repr=False)

    def __post_init__(self) -> None:
        for name in ("q", "tau", "multipliers", "frequencies", "eigenvalues"):
            array = np.array(getattr(self, name))
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def _told(self) -> str:
        return {True: "stable", False: "unstable", None: "stability not decided by small motions"}[self.stable]

    def __str__(self) -> str:
        lines = [f"{self.name}: equilibrium, {self._told}; residual {self.residual:.2g}"]
        lines += [f"  {n} = {x:.9g}" for n, x in zip(self.coordinates, self.q, strict=True)]
        lines += [f"  tau of {n} = {x:.9g}" for n, x in zip(self.velocities, self.tau, strict=True) if x]
        lines += [f"  lambda{k + 1} = {x:.9g}" for k, x in enumerate(self.multipliers)]
        if len(self.frequencies):
            lines.append("  oscillates at " + ", ".join(f"{w:.6g}" for w in self.frequencies) + " rad/s")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        from html import escape

        head = f"<p><b>{escape(self.name)}</b>: equilibrium, {self._told}; residual {self.residual:.2g}</p>"
        rows = [(n, f"{x:.9g}") for n, x in zip(self.coordinates, self.q, strict=True)]
        rows += [(f"τ of {n}", f"{x:.9g}") for n, x in zip(self.velocities, self.tau, strict=True) if x]
        rows += [(f"λ{k + 1}", f"{x:.9g}") for k, x in enumerate(self.multipliers)]
        if len(self.frequencies):
            rows.append(("ω, rad/s", ", ".join(f"{w:.6g}" for w in self.frequencies)))
        cells = "".join(f"<tr><td>{escape(n)}</td><td>{x}</td></tr>" for n, x in rows)
        return f"{head}<table>{cells}</table>"


def equilibrium(
    dynamics: Dynamics | Lagrangian,
    q0: ArrayLike | None = None,
    *,
    tau: ArrayLike | None = None,
    holding: ArrayLike | None = None,
    forces: Mapping[str, ArrayLike] | None = None,
    seed: int = 0,
) -> Equilibrium:
    """Return where a system rests under given forces, or what holds it where it is.

    Parameters
    ----------
    dynamics : Dynamics or Lagrangian
        Of any engine. The own derivation differentiates the forces exactly; of others
        differences are taken.
    q0 : (nq,) array_like, optional
        Where to look from; the neutral configuration and then random ones when not given.
    tau : (nv,) array_like, optional
        Generalized force that acts; zero when not given.
    holding : (nq,) array_like, optional
        A configuration: what is returned is the tau that holds it. With constraints,
        which take a part of the load, it is the least such tau.
    forces : mapping of str to (3,) or (6,) array_like, optional
        What acts on frames or bodies of a robot: force at the frame's origin, N, and
        moment, N m, in world axes. A payload of mass m in the hand is
        ``{"hand": [0, 0, -9.81 * m]}``; it stays as it is when the robot moves.
    seed : int
        Of the random starts.

    Returns
    -------
    Equilibrium

    Raises
    ------
    InputError
        Both `tau` or `q0` and `holding`; a wrong shape; forces that depend on the time;
        a configuration that constraints do not allow.
    NumericalError
        No equilibrium found, with the least force that is left over and where.

    Notes
    -----
    Newton's iteration with the exact stiffness, and Levenberg and Marquardt's damping far
    from the end. It finds one equilibrium, not all; of an upright and a hanging pendulum
    the one that is nearer in its own way.

    Stability is that of M δq̈ + D δq̇ + K δq = 0 on what constraints leave free. Where K is
    symmetric, and D has no part that feeds energy in, K's sign decides (Lagrange and
    Dirichlet, Kelvin and Tait); else the eigenvalues do.

    Examples
    --------
    >>> import mbkit as mb
    >>> dyn = mb.dynamics(mb.catalog.pendulum(), "lagrangian")
    >>> rest = mb.equilibrium(dyn, [0.3])
    >>> rest.stable, round(float(rest.frequencies[0]), 6)
    (True, 3.132092)
    """
    dyn = dynamics.dynamics() if isinstance(dynamics, Lagrangian) else dynamics
    if not isinstance(dyn, Dynamics):
        raise InputError(
            f"dynamics: expected a Dynamics or a Lagrangian, got {type(dyn).__name__}; mbkit.dynamics makes one"
        )
    if dyn.samples is not None:
        raise InputError("dynamics: its parameters have a value per sample; expected one value of each")
    if holding is not None and not (tau is None and q0 is None):
        raise InputError("holding: expected without q0 and tau, which are for finding a configuration")
    balance = _Balance(dyn, forces or {})
    if holding is not None:
        q = dyn.model.check_q(finite_array("holding", holding, (dyn.model.nq,)), "holding")
        balance.check_constraints(q)
        balance.check_time(q)
        tau, multipliers = balance.held(q)
        return balance.result(q, tau, multipliers)
    tau = np.zeros(dyn.model.nv) if tau is None else finite_array("tau", tau, (dyn.model.nv,))
    if q0 is not None:
        starts = [balance.allowed(dyn.model.check_q(finite_array("q0", q0, (dyn.model.nq,)), "q0"))]
    else:
        rng = np.random.default_rng(seed)
        starts = [dyn.model.random_state(rng)[0] for _ in range(_STARTS)]
        # From the neutral configuration there need be no way to the constraints.
        starts[:0] = [] if dyn.model.constrained else [dyn.model.neutral()]
    balance.check_time(starts[0])
    return _sought(balance, starts, tau)


def _sought(balance: _Balance, starts: list[Array], tau: Array) -> Equilibrium:
    least: tuple[float, Array, Array] | None = None
    for start in starts:
        q, multipliers, left = balance.solved(start, tau)
        if left <= 1.0:
            return balance.result(q, tau, multipliers)
        size = balance.size(q, multipliers, tau)
        if least is None or size < least[0]:
            least = size, q, balance.residual(q, multipliers, tau)
    assert least is not None
    size, q, residual = least
    names = balance.model.velocity_names
    worst = int(np.abs(residual[: len(names)]).argmax())
    raise NumericalError(
        f"{balance.model.name}: no equilibrium found from {len(starts)} start{'s' * (len(starts) > 1)}; the least "
        f"force left over is {size:.3g}, most of it along {names[worst]}, at q = {np.array2string(q, precision=4)}; "
        "give tau= that balances it, or another q0"
    )


class _Balance:
    """The forces at rest of one system and how they change with the configuration."""

    def __init__(self, dyn: Dynamics, forces: Mapping[str, ArrayLike]) -> None:
        self.dyn, self.model = dyn, dyn.model
        self._wrenches = {name: _wrench(name, x) for name, x in forces.items()}
        for name in self._wrenches:
            self.model.frame(name)
            if self.model.written is not None:
                raise UnknownNameError("frame", name, (), hint="a system on paper takes tau=")
        self._manifold: Any = None
        self._m = 0
        if self.model.constrained:
            from mbkit.lagrangian.constraints import manifold_of
            from mbkit.lagrangian.redundancy import require_independent

            require_independent(dyn)
            self._manifold = manifold_of(dyn).at(0.0)
            self._m = len(self._manifold.value(self.model.neutral()))
        self._zero = np.zeros(self.model.nv)

    # What balances

    def load(self, q: Array) -> Array:
        """Return nle - τ_passive - Σ J_Fᵀ F at rest: the force to be held, (nv,)."""
        out = self.dyn.inverse_dynamics(q, self._zero, self._zero)
        for name, wrench in self._wrenches.items():
            out = out - self.dyn.jacobian(q, name).T @ wrench
        return np.asarray(out)

    def scale(self, q: Array, tau: Array) -> float:
        """Return how large the forces are that balance, so that rounding can be told from a residual."""
        sizes = [np.abs(tau).max(initial=0.0), np.abs(self.load(q)).max(initial=0.0)]
        # Where all is balanced, how the forces change over a unit of the coordinates.
        sizes.append(np.abs(self.stiffness(q)).max(initial=0.0))
        return float(max(*sizes, np.finfo(float).tiny))

    def residual(self, q: Array, multipliers: Array, tau: Array) -> Array:
        """Return what is left over, (nv,) of forces and (m,) of constraints."""
        left = self.load(q) - tau
        if not self._m:
            return np.asarray(left)
        return np.concatenate([left - self._manifold.jacobian(q).T @ multipliers, self._manifold.value(q)])

    def size(self, q: Array, multipliers: Array, tau: Array) -> float:
        """Return the largest force left over."""
        return float(np.abs(self.residual(q, multipliers, tau)[: self.model.nv]).max(initial=0.0))

    def stiffness(self, q: Array) -> Array:
        """Return ∂load/∂q along the manifold, (nv, nv)."""
        if isinstance(self.dyn, LagrangianDynamics):
            K = self.dyn.inverse_dynamics_derivatives(q, self._zero, self._zero).q
            return np.asarray(K + self._differences(q, self._loads_of_frames) if self._wrenches else K)
        return self._differences(q, self.load)

    def _loads_of_frames(self, q: Array) -> Array:
        return np.asarray(-sum(self.dyn.jacobian(q, n).T @ w for n, w in self._wrenches.items()))

    def _differences(self, q: Array, function: Any) -> Array:
        # Of fourth order: the error is far below half of the digits.
        h = _EPS**0.2
        columns = []
        for e in np.eye(self.model.nv):
            ahead, behind, far, back = (function(self.model.integrate(q, s * h * e)) for s in (1.0, -1.0, 2.0, -2.0))
            columns.append((8 * (ahead - behind) - (far - back)) / (12 * h))
        return np.array(columns).T.reshape(self.model.nv, self.model.nv)

    def whole_stiffness(self, q: Array, multipliers: Array) -> Array:
        """Return ∂(load - Jᵀ λ)/∂q at these multipliers."""
        K = self.stiffness(q)
        if not self._m:
            return K
        padded = np.zeros(self.model.nv)
        padded[: self._m] = multipliers
        return np.asarray(K - self._manifold.call("curvature", q, padded)[0])

    def allowed(self, q: Array) -> Array:
        """Return a configuration on the constraints."""
        return np.asarray(self._manifold.restored(q, self._zero)) if self._m else q

    # Solving

    def solved(self, q: Array, tau: Array) -> tuple[Array, Array, float]:
        """Return q, λ and what is left over, relative to what rounding would leave."""
        multipliers = self._best_multipliers(q, tau)
        r = self.residual(q, multipliers, tau)
        damping, size = 0.0, float(np.linalg.norm(r))
        for _ in range(_MOST):
            if self._left(r, q, tau) <= 1e-3 or size == 0.0:
                break
            K = self._matrix(q, multipliers)
            step = _damped(K, r, damping)
            moved = self.model.integrate(q, step[: self.model.nv])
            tried = multipliers + step[self.model.nv :]
            new = self.residual(moved, tried, tau)
            new_size = float(np.linalg.norm(new))
            if new_size < size and np.abs(step[: self.model.nv]).max() < 3.0:
                q, multipliers, r, size = moved, tried, new, new_size
                damping = 0.0 if damping < 1e-9 else damping / 10
            elif self._left(r, q, tau) <= 1.0:
                break
            else:
                damping = max(10 * damping, 1e-6)
                if damping > 1e9:
                    break
        return q, multipliers, self._left(r, q, tau)

    def _left(self, r: Array, q: Array, tau: Array) -> float:
        return float(np.abs(r).max(initial=0.0)) / (_BALANCED * self.scale(q, tau))

    def _matrix(self, q: Array, multipliers: Array) -> Array:
        K = self.whole_stiffness(q, multipliers)
        if not self._m:
            return K
        J = self._manifold.jacobian(q)
        return np.block([[K, -J.T], [J, np.zeros((self._m, self._m))]])

    def _best_multipliers(self, q: Array, tau: Array) -> Array:
        if not self._m:
            return np.empty(0)
        return np.asarray(np.linalg.lstsq(self._manifold.jacobian(q).T, self.load(q) - tau, rcond=None)[0])

    def held(self, q: Array) -> tuple[Array, Array]:
        """Return the least τ that holds a configuration, and the multipliers with it."""
        load = self.load(q)
        if not self._m:
            return load, np.empty(0)
        multipliers = self._best_multipliers(q, np.zeros(self.model.nv))
        return load - self._manifold.jacobian(q).T @ multipliers, multipliers

    # Judging

    def check_constraints(self, q: Array) -> None:
        """Refuse a configuration that the constraints do not allow."""
        if self._m:
            self._manifold.check(q, self._zero)

    def check_time(self, q: Array) -> None:
        """Refuse forces that change with the time: there is no rest."""
        clock = self.model.clock
        if clock is None:
            return
        v = 0.1 * np.ones(self.model.nv)
        there = [at_time(self.dyn, t).inverse_dynamics(q, v, v) for t in (0.0, 0.7310585786300049)]
        if np.abs(there[1] - there[0]).max() > 1e-9 * (1 + np.abs(there[0]).max()):
            raise InputError(
                f"dynamics: {self.model.name} depends on the time {clock}, which moves it; "
                "there is no equilibrium of such a system"
            )

    def result(self, q: Array, tau: Array, multipliers: Array) -> Equilibrium:
        """Return what was found, with the small motions about it."""
        N = self._free(q)
        K = N.T @ self.whole_stiffness(q, multipliers) @ N
        M = N.T @ self.dyn.mass_matrix(q) @ N
        D = N.T @ self._damping(q) @ N
        motion: SmallMotion = small_motion(M, D, K, self._round_about(q, multipliers))
        return Equilibrium(
            q=q,
            tau=tau,
            residual=self.size(q, multipliers, tau),
            multipliers=multipliers,
            stable=motion.stable,
            frequencies=motion.frequencies,
            eigenvalues=motion.eigenvalues,
            name=self.model.name,
            coordinates=self.model.coordinate_names,
            velocities=self.model.velocity_names,
        )

    def _round_about(self, q: Array, multipliers: Array) -> float:
        """Return how large the stiffness is in the neighbourhood."""
        there = (self.model.integrate(q, s * np.ones(self.model.nv)) for s in (-_ASIDE, _ASIDE))
        return max(float(np.abs(self.whole_stiffness(p, multipliers)).max(initial=0.0)) for p in there)

    def _free(self, q: Array) -> Array:
        """Return a basis of what the constraints leave free, (nv, f)."""
        if not self._m:
            return np.eye(self.model.nv)
        _, sizes, V = np.linalg.svd(self._manifold.jacobian(q))
        return np.asarray(V[int(np.count_nonzero(sizes > 1e-10 * sizes[0])) :].T)

    def _damping(self, q: Array) -> Array:
        """Return ∂(inverse dynamics)/∂v at rest."""
        if isinstance(self.dyn, LagrangianDynamics):
            return np.asarray(self.dyn.inverse_dynamics_derivatives(q, self._zero, self._zero).v)
        zero, h = self._zero, 1.0
        # Quadratic in v but for what is looked for, which central differences then give exactly.
        columns = [
            (self.dyn.inverse_dynamics(q, h * e, zero) - self.dyn.inverse_dynamics(q, -h * e, zero)) / (2 * h)
            for e in np.eye(self.model.nv)
        ]
        return np.array(columns).T.reshape(self.model.nv, self.model.nv)


def _damped(K: Array, r: Array, damping: float) -> Array:
    """Return Levenberg's and Marquardt's step; Newton's without damping."""
    if not damping:
        try:
            step = np.linalg.solve(K, -r)
            if np.isfinite(step).all():
                return np.asarray(step)
        except np.linalg.LinAlgError:
            pass
        return np.asarray(np.linalg.lstsq(K, -r, rcond=1e-10)[0])
    square = K.T @ K
    scale = max(float(np.trace(square)) / len(K), np.finfo(float).tiny)
    return np.asarray(np.linalg.solve(square + damping * scale * np.eye(len(K)), -K.T @ r))


def _wrench(name: str, given: ArrayLike) -> Array:
    try:
        shape = np.shape(given)
    except ValueError:
        shape = ()
    if shape not in ((3,), (6,)):
        raise InputError(f"forces[{name!r}]: expected shape (3,) or (6,), got {shape}")
    wrench = finite_array(f"forces[{name!r}]", given, shape)
    return wrench if len(wrench) == 6 else np.concatenate([wrench, np.zeros(3)])
