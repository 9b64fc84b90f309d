"""Statics by virtual work: configurations at rest, the forces that hold them, and their stability.

No virtual displacement does work at rest::

    nle(q, 0) - τ_passive(q, 0) = τ + Σ J_Fᵀ F + Jᵀ λ,      f(q) = 0

with the forces F at frames, and λ where constraints act.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import EPS, ITERATED, TYPED, Array, finite_array, generator
from mbkit._escape import html, terminal
from mbkit._reproducible import DEPENDENT
from mbkit.engines.base import Dynamics, at_time
from mbkit.engines.constraint_manifold import manifold_of, require_independent
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, NumericalError, UnknownNameError
from mbkit.lagrangian.system import Lagrangian
from mbkit.methods.small_motions import SmallMotion, small_motion
from mbkit.model import Model
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.elements.paths import ALL, Path
from mbkit.model.parts import read_only

#: Forces of a row count as at least this part of the largest row's, whose rounding reaches it.
_CANCELLED_FORCE_RATIO: Final = 1e-3
# Random starts, and steps from each.
_RANDOM_STARTS: Final = 30
_MAX_NEWTON_ITERATIONS: Final = 200
#: Halvings of a start from which the search finds nothing.
_START_HALVINGS: Final = 12
# rad or m: a neighbourhood, in which stiffness that vanishes at a threshold does not.
_NEIGHBOUR_DISTANCE: Final = 0.1
#: Step of differences of fourth order, whose error is far below half of the digits.
_DIFFERENCE_STEP: Final = EPS**0.2
#: s: when a system that depends on the time is looked at again.
_LATER: Final = (0.7310585786300049, 2.0178)
#: Rounding of an exact derivative, and of differences, relative to their terms.
_EXACT_ERROR_RATIO: Final = 8 * EPS
_DIFFERENCE_ERROR_RATIO: Final = 8 * EPS**0.8


def _driven(model: Model) -> Iterator[str]:
    # Forces of the time may still leave a system at rest, which the search finds out.
    if model.constraints_do_work and model.time_parameter is None:
        yield "its constraints prescribe a speed, at which nothing rests"


EQUILIBRIUM: Final = Path(
    "equilibrium",
    "equilibrium: not known of",
    ALL - {"stop"},
    notes={"jump": f"{EFFECTS['jump']}, which holds a range of configurations, is left out"},
    also=_driven,
)


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
        λ of the constraints.
    stable : bool or None
        Whether small motions stay small; None where the linear equation does not decide or changes with the time.
    frequencies : (k,) array
        Angular frequencies of small motions that oscillate, rad/s, increasing.
    eigenvalues : (2 f,) complex array
        Of the linearized equation with f degrees of freedom, 1/s.
    name : str
    coordinates, velocities : tuple of str
        What the entries of q and of tau belong to.
    notes : tuple of str
        What of the model is left out.
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
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("q", "tau", "multipliers", "frequencies", "eigenvalues"):
            object.__setattr__(self, name, read_only(np.array(getattr(self, name))))

    @property
    def _verdict(self) -> str:
        stability = {True: "stable", False: "unstable", None: "stability not decided by small motions"}[self.stable]
        return "; ".join((f": equilibrium, {stability}", f"residual {self.residual:.2g}", *self.notes))

    def _rows(self, tau: str, multiplier: str) -> list[tuple[str, str]]:
        rows = [*zip(self.coordinates, self.q, strict=True)]
        rows += [(f"{tau} of {n}", x) for n, x in zip(self.velocities, self.tau, strict=True) if x]
        rows += [(f"{multiplier}{k + 1}", x) for k, x in enumerate(self.multipliers)]
        return [(n, f"{x:.9g}") for n, x in rows]

    def _shown_frequencies(self) -> str:
        return ", ".join(f"{w:.6g}" for w in self.frequencies)

    def __str__(self) -> str:
        lines = [self.name + self._verdict, *(f"  {n} = {x}" for n, x in self._rows("tau", "lambda"))]
        if len(self.frequencies):
            lines.append(f"  oscillates at {self._shown_frequencies()} rad/s")
        return terminal("\n".join(lines))

    def _repr_html_(self) -> str:
        rows = self._rows("τ", "λ") + ([("ω, rad/s", self._shown_frequencies())] if len(self.frequencies) else [])
        cells = "".join(f"<tr><td>{html(n)}</td><td>{x}</td></tr>" for n, x in rows)
        return f"<p><b>{html(self.name)}</b>{self._verdict}</p><table>{cells}</table>"


def equilibrium(
    dynamics: Dynamics | Lagrangian,
    q0: ArrayLike | None = None,
    *,
    tau: ArrayLike | None = None,
    holding: ArrayLike | None = None,
    forces: Mapping[str, ArrayLike] | None = None,
    seed: int = 0,
) -> Equilibrium:
    """Return where a system rests under forces, or the forces that hold it in a configuration.

    Parameters
    ----------
    dynamics : Dynamics or Lagrangian
        Of any engine. The own derivation differentiates the forces exactly, others by differences.
    q0 : (nq,) array_like, optional
        Start of the search, and then, for a system on paper, places nearer zero; by default the neutral configuration,
        then random ones.
    tau : (nv,) array_like, optional
        Generalized force that acts; zero by default.
    holding : (nq,) array_like, optional
        A configuration to hold: the result is the tau that holds it, the least one with constraints.
    forces : mapping of str to (3,) or (6,) array_like, optional
        On frames or bodies of a robot: force at the frame's origin, N, and moment, N m, constant in world axes. A
        payload of mass m in the hand is ``{"hand": [0, 0, -9.81 * m]}``.
    seed : int
        Of the random starts.

    Raises
    ------
    InputError
        `tau` or `q0` beside `holding`, a wrong shape, forces that depend on the time, or a `holding` that constraints
        do not allow.
    UnsupportedError
        Constraints prescribe a speed.
    NumericalError
        No equilibrium; names the least remaining force and where it is.

    Notes
    -----
    Newton's iteration with the exact stiffness, and Levenberg and Marquardt's damping far from the end, finds one
    equilibrium, not all. Stability is that of M δq̈ + D δq̇ + K δq = 0 on what constraints leave free. Where K is
    symmetric and D feeds no energy in, K's sign decides (Lagrange and Dirichlet, Kelvin and Tait); else the
    eigenvalues do. Each has a bound of its error from the rounding of M, D and K, entry by entry, whatever their units;
    what the bound does not decide is None. `Equilibrium.notes` tell what is left out, such as forces that jump.

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
    if dyn._samples is not None:
        raise InputError("dynamics: its parameters have a value per sample; expected one value of each")
    if holding is not None and not (tau is None and q0 is None):
        raise InputError("holding: expected without q0 and tau, which are for finding a configuration")
    notes = EQUILIBRIUM.admit(dyn.model)
    model, balance = dyn.model, _Balance(dyn, {name: _wrench(name, x) for name, x in (forces or {}).items()})
    if holding is not None:
        q = model.check_q(finite_array("holding", holding, (model.nq,)), "holding")
        acting, multipliers = balance.held(q)
    else:
        acting = np.zeros(model.nv) if tau is None else finite_array("tau", tau, (model.nv,))
        if q0 is not None:
            starts = [balance.allowed(model.check_q(finite_array("q0", q0, (model.nq,)), "q0"))]
            # Far out a force fades, and the search runs away from where it balances.
            starts += (
                [] if model.has_bodies or model.constrained else [starts[0] / 2**k for k in range(1, _START_HALVINGS)]
            )
        else:
            rng = generator("seed", seed)
            starts = [model.random_state(rng)[0] for _ in range(_RANDOM_STARTS)]
            # Newton's iteration may not reach the constraints from the neutral configuration.
            starts[:0] = [] if model.constrained else [model.neutral()]
        q, multipliers = balance.at_rest(starts, acting)
    motion = balance.small_motion(q, acting, multipliers)
    size = balance.size(balance.residual(q, multipliers, acting))
    names = model.name, model.coordinate_names, model.velocity_names
    return Equilibrium(q, acting, size, multipliers, *motion, *names, notes)


def _wrench(name: str, value: ArrayLike) -> Array:
    try:
        shape = np.shape(value)
    except ValueError:
        shape = ()
    if shape not in ((3,), (6,)):
        raise InputError(f"forces[{name!r}]: expected shape (3,) or (6,), got {shape}")
    return np.append(finite_array(f"forces[{name!r}]", value, shape), np.zeros(6 - shape[0]))


class _Balance:
    """The forces that balance at rest at time t, s, with a wrench (6,) on each frame by name."""

    def __init__(self, dyn: Dynamics, wrenches: Mapping[str, Array], t: float = 0.0) -> None:
        self._whole, self._wrenches = dyn, wrenches
        self.dyn, self.model = at_time(dyn, t), dyn.model
        for name in wrenches:
            self.model.frame(name)
            if not self.model.has_bodies:
                raise UnknownNameError("frame", name, (), hint="a system on paper takes tau=")
        self._manifold: Any = manifold_of(dyn).at(t) if self.model.constrained else None
        self._zero, self._unit = np.zeros(self.model.nv), np.eye(self.model.nv)

    # Balance

    def load(self, q: Array) -> Array:
        """Return nle - τ_passive - Σ J_Fᵀ F at rest: the force to be held, (nv,)."""
        out = self.dyn.inverse_dynamics(q, self._zero, self._zero)
        for name, wrench in self._wrenches.items():
            out = out - self.dyn.jacobian(q, name).T @ wrench
        return np.asarray(out)

    def scale(self, q: Array, tau: Array) -> Array:
        """Return the size of each row of the residual, which scales its rounding; rows may differ in unit."""
        # The stiffness gives a scale where all forces are zero.
        parts = np.abs(np.column_stack([tau, self.load(q), self._stiffness(q)])).max(axis=1)
        if self._manifold is not None:
            parts = np.append(parts, np.abs(self._manifold.jacobian(q)).max(axis=1))
        return np.asarray(np.maximum(parts, np.finfo(float).tiny ** 0.5))

    def residual(self, q: Array, multipliers: Array, tau: Array) -> Array:
        """Return the residual, (nv,) of forces and (m,) of constraints."""
        left = self.load(q) - tau
        if self._manifold is None:
            return np.asarray(left)
        return np.concatenate([left - self._manifold.jacobian(q).T @ multipliers, self._manifold.value(q)])

    def size(self, residual: Array) -> float:
        """Return the largest force left over."""
        return float(np.abs(residual[: self.model.nv]).max(initial=0.0))

    def multipliers(self, q: Array, tau: Array) -> Array:
        """Return the λ that balance best, (m,)."""
        if self._manifold is None:
            return np.empty(0)
        return np.asarray(np.linalg.lstsq(self._manifold.jacobian(q).T, self.load(q) - tau, rcond=None)[0])

    def allowed(self, q: Array) -> Array:
        """Return a configuration on the constraints."""
        if self._manifold is None:
            return q
        return np.asarray(self._manifold.restored(q))

    def held(self, q: Array) -> tuple[Array, Array]:
        """Return the least τ that holds a configuration, which constraints must allow, and the multipliers with it."""
        load = self.load(q)
        if self._manifold is None:
            return load, np.empty(0)
        self._manifold.check(q, self._zero)
        multipliers = self.multipliers(q, self._zero)
        return load - self._manifold.jacobian(q).T @ multipliers, multipliers

    # Stiffness and damping

    def _slopes(self, function: Callable[[Array], Array], h: float) -> Array:
        """Return the derivative of a function of a step (nv,) at zero, by differences of fourth order."""
        columns = []
        for e in h * self._unit:
            ahead, behind, far, back = (function(s * e) for s in (1.0, -1.0, 2.0, -2.0))
            columns.append((8 * (ahead - behind) - (far - back)) / (12 * h))
        return np.array(columns).T.reshape(self.model.nv, self.model.nv)

    def _stiffness(self, q: Array) -> Array:
        """Return ∂load/∂q along the manifold, (nv, nv)."""
        if not isinstance(self.dyn, LagrangianDynamics):
            return self._slopes(lambda u: self.load(self.model.integrate(q, u)), _DIFFERENCE_STEP)
        K = np.asarray(self.dyn.inverse_dynamics_derivatives(q, self._zero, self._zero).q)
        if self._wrenches:

            def loads(u: Array) -> Array:
                there = self.model.integrate(q, u)
                return np.asarray(-sum(self.dyn.jacobian(there, n).T @ w for n, w in self._wrenches.items()))

            K = K + self._slopes(loads, _DIFFERENCE_STEP)
        return K

    def _damping(self, q: Array) -> Array:
        """Return ∂(inverse dynamics)/∂v at rest."""
        if isinstance(self.dyn, LagrangianDynamics):
            return np.asarray(self.dyn.inverse_dynamics_derivatives(q, self._zero, self._zero).v)
        # Differences of a quadratic are exact, and those of two speeds leave jumps out.
        change = (
            np.array([self.dyn.inverse_dynamics(q, s * e, self._zero) for s in (2, -2, 1, -1)]) for e in self._unit
        )
        return np.array([[0.5, -0.5, -0.5, 0.5] @ rows for rows in change]).T.reshape(self._unit.shape)

    def _whole_stiffness(self, q: Array, multipliers: Array) -> Array:
        """Return ∂(load - Jᵀ λ)/∂q at these multipliers."""
        K = self._stiffness(q)
        if self._manifold is None:
            return K
        padded = np.append(multipliers, np.zeros(self.model.nv - len(multipliers)))
        return np.asarray(K - self._manifold.call("curvature", q, padded)[0])

    # The search: Newton's iteration, damped after Levenberg and Marquardt far from the end

    def at_rest(self, starts: list[Array], tau: Array) -> tuple[Array, Array]:
        """Return the first configuration at rest, and λ there; NumericalError names the least force."""
        ends: list[tuple[float, Array, Array]] = []
        for k, start in enumerate(starts):
            try:
                q, multipliers, residual, left = self._solved(start, tau)
            except NumericalError:
                # Coordinates may be singular at the neutral configuration, as those of an orbit.
                if k + 1 == len(starts) and not ends:
                    raise
                continue
            if left <= 1.0:
                return q, multipliers
            ends.append((self.size(residual), q, residual))
        size, q, residual = min(ends, key=lambda end: end[0])
        names = self.model.velocity_names
        worst = int(np.abs(residual[: len(names)]).argmax())
        raise NumericalError(
            f"{self.model.name}: no equilibrium found from {len(starts)} start{'s' * (len(starts) > 1)}; the least "
            f"force left over is {size:.3g}, most of it along {names[worst]}, at q = "
            f"{np.array2string(q, precision=4)}; give tau= that balances it, or another q0"
        )

    def _solved(self, q: Array, tau: Array) -> tuple[Array, Array, Array, float]:
        """Return q, λ, the residual, and its size relative to its rounding."""
        nv, multipliers = self.model.nv, self.multipliers(q, tau)
        r = self.residual(q, multipliers, tau)
        damping, size = 0.0, float(np.linalg.norm(r))
        for _ in range(_MAX_NEWTON_ITERATIONS):
            own, left = self._left(r, q, tau)
            if own <= 1e-3 or size == 0.0:
                break
            # A remainder that is small beside a stiff direction may be large in a soft one: on, while it gets less.
            K = self._whole_stiffness(q, multipliers)
            if self._manifold is not None:
                J = self._manifold.jacobian(q)
                # Rows of velocities hold no configuration.
                position_rows = J[: len(r) - nv]
                K = np.block([[K, -J.T], [position_rows, np.zeros((len(position_rows), len(J)))]])
            step = _damped(K, r, damping)
            ahead = self.model.integrate(q, step[:nv]), multipliers + step[nv:]
            new = self.residual(*ahead, tau)
            new_size = float(np.linalg.norm(new))
            if new_size < size and np.abs(step[:nv]).max() < 3.0:
                (q, multipliers), r, size = ahead, new, new_size
                damping = 0.0 if damping < 1e-9 else damping / 10
            elif left <= 1.0:
                break
            else:
                damping = max(10 * damping, 1e-6)
                if damping > 1e9:
                    break
        return q, multipliers, r, self._left(r, q, tau)[1]

    def _left(self, r: Array, q: Array, tau: Array) -> tuple[float, float]:
        """Return the residual relative to its rounding: of the forces of each row, and beside those of all rows."""
        rows = self.scale(q, tau)[: len(r)]
        sizes = np.maximum(rows, _CANCELLED_FORCE_RATIO * rows.max(initial=0.0))
        own, left = (float((np.abs(r) / (ITERATED * x)).max(initial=0.0)) for x in (rows, sizes))
        return own, left

    # Small motions

    def small_motion(self, q: Array, tau: Array, multipliers: Array) -> SmallMotion:
        """Return the small motions about a configuration, on what the constraints leave free."""
        if self._manifold is not None:
            require_independent(self._manifold.dyn, q)
        if self._changes(q, tau, multipliers):
            # Mathieu's equation and its kind: no instant says whether the whole motion stays small.
            return SmallMotion(None, np.empty(0), np.empty(0, dtype=complex))
        matrices, N = self._matrices(q, multipliers), self._free(q)
        # Products with N add rounding of their own.
        errors = [np.abs(N).T @ E @ np.abs(N) for E in self._errors(q, multipliers, *matrices)]
        M, D, K = (N.T @ A @ N for A in matrices)
        return small_motion(M, D, K, errors)

    def _matrices(self, q: Array, multipliers: Array) -> tuple[Array, Array, Array]:
        """Return M, D and K of all coordinates."""
        return self.dyn.mass_matrix(q), self._damping(q), self._whole_stiffness(q, multipliers)

    def _errors(self, q: Array, multipliers: Array, M: Array, D: Array, K: Array) -> tuple[Array, Array, Array]:
        """Return bounds of the errors of M, D and K, entry by entry."""
        places = [
            self.model.integrate(q, s * np.ones(self.model.nv)) for s in (-_NEIGHBOUR_DISTANCE, _NEIGHBOUR_DISTANCE)
        ]
        # Terms that cancel here do not beside it: their size is the curvature of their sum.
        terms = np.abs(
            [K, *((self._whole_stiffness(p, multipliers) - K) / _NEIGHBOUR_DISTANCE**2 for p in places)]
        ).sum(axis=0)
        M, D = np.abs(M), np.abs(D)
        if self.model.has_bodies:
            # Sums over bodies round by what they add in other rows and columns too.
            terms += np.where(self._unit, 0.0, np.maximum(terms.max(axis=0), terms.max(axis=1)[:, None]))
        if isinstance(self.dyn, LagrangianDynamics):
            return _EXACT_ERROR_RATIO * M, _EXACT_ERROR_RATIO * D, _EXACT_ERROR_RATIO * terms
        loads = np.max([np.abs(self.load(p)) for p in (q, *places)], axis=0)[:, None] / _NEIGHBOUR_DISTANCE
        return (
            _EXACT_ERROR_RATIO * M,
            _EXACT_ERROR_RATIO * (D + loads + M.max(axis=1, keepdims=True)),
            _DIFFERENCE_ERROR_RATIO * (terms + loads),
        )

    def _linear(self, q: Array, multipliers: Array) -> list[Array]:
        """Return M, D and K of what the constraints leave free."""
        N = self._free(q)
        return [np.asarray(N.T @ A @ N) for A in self._matrices(q, multipliers)]

    def _free(self, q: Array) -> Array:
        """Return columns of the velocities that the constraints leave free."""
        if self._manifold is None:
            return self._unit
        _, sizes, V = np.linalg.svd(self._manifold.jacobian(q))
        return np.asarray(V[int(np.count_nonzero(sizes > DEPENDENT * sizes[0])) :].T)

    def _changes(self, q: Array, tau: Array, multipliers: Array) -> bool:
        """Return whether the small motions change with the time; refuse forces or constraints that do (InputError)."""
        if self.model.time_parameter is None:
            return False
        now, differs = self._linear(q, multipliers), False
        for t in _LATER:
            later = _Balance(self._whole, self._wrenches, t)
            theirs = later.multipliers(q, tau)
            left = np.abs(later.residual(q, theirs, tau))
            if (left > TYPED * (1 + later.scale(q, tau)[: len(left)])).any():
                raise InputError(
                    f"dynamics: {self.model.name} depends on the time {self.model.time_parameter}, which moves it; "
                    "there is no equilibrium of such a system"
                )
            pairs = zip(now, later._linear(q, theirs), strict=True)
            differs = differs or any(np.abs(a - b).max(initial=0.0) > TYPED * (1 + np.abs(a).max()) for a, b in pairs)
        return differs


def _damped(K: Array, r: Array, damping: float) -> Array:
    """Return Levenberg's and Marquardt's step; Newton's without damping."""
    if damping:
        square = K.T @ K
        scale = max(float(np.trace(square)) / len(square), np.finfo(float).tiny)
        return np.asarray(np.linalg.solve(square + damping * scale * np.eye(len(square)), -K.T @ r))
    try:
        step = np.linalg.solve(K, -r)
    except np.linalg.LinAlgError:
        step = np.full(len(K), np.nan)
    return np.asarray(step if np.isfinite(step).all() else np.linalg.lstsq(K, -r, rcond=1e-10)[0])
