"""Statics by virtual work: configurations at rest, the forces that hold them, and their stability.

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
from mbkit._escape import html, terminal
from mbkit.engines.base import Dynamics
from mbkit.errors import InputError, NumericalError
from mbkit.lagrangian.statics.force_balance import BALANCED, Balance, SmallMotion
from mbkit.lagrangian.system import Lagrangian

# The search for a configuration at rest: Newton's iteration, damped after Levenberg and Marquardt far from the end.

_MOST: Final = 200


def find_equilibrium(balance: Balance, starts: list[Array], tau: Array) -> tuple[Array, Array]:
    """Return the first configuration at rest that is found, and λ there; NumericalError names the least force left."""
    least: tuple[float, Array, Array] | None = None
    for start in starts:
        q, multipliers, left = _solved(balance, start, tau)
        if left <= 1.0:
            return q, multipliers
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


def _solved(balance: Balance, q: Array, tau: Array) -> tuple[Array, Array, float]:
    """Return q, λ and the residual, relative to its rounding."""
    multipliers = balance.multipliers(q, tau)
    r = balance.residual(q, multipliers, tau)
    damping, size = 0.0, float(np.linalg.norm(r))
    for _ in range(_MOST):
        if _left(balance, r, q, tau) <= 1e-3 or size == 0.0:
            break
        K = balance.matrix(q, multipliers)
        step = _damped(K, r, damping)
        moved = balance.model.integrate(q, step[: balance.model.nv])
        tried = multipliers + step[balance.model.nv :]
        new = balance.residual(moved, tried, tau)
        new_size = float(np.linalg.norm(new))
        if new_size < size and np.abs(step[: balance.model.nv]).max() < 3.0:
            q, multipliers, r, size = moved, tried, new, new_size
            damping = 0.0 if damping < 1e-9 else damping / 10
        elif _left(balance, r, q, tau) <= 1.0:
            break
        else:
            damping = max(10 * damping, 1e-6)
            if damping > 1e9:
                break
    return q, multipliers, _left(balance, r, q, tau)


def _left(balance: Balance, r: Array, q: Array, tau: Array) -> float:
    return float(np.abs(r).max(initial=0.0)) / (BALANCED * balance.scale(q, tau))


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


_STARTS: Final = 30


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
    def _verdict(self) -> str:
        return {True: "stable", False: "unstable", None: "stability not decided by small motions"}[self.stable]

    def __str__(self) -> str:
        lines = [f"{self.name}: equilibrium, {self._verdict}; residual {self.residual:.2g}"]
        lines += [f"  {n} = {x:.9g}" for n, x in zip(self.coordinates, self.q, strict=True)]
        lines += [f"  tau of {n} = {x:.9g}" for n, x in zip(self.velocities, self.tau, strict=True) if x]
        lines += [f"  lambda{k + 1} = {x:.9g}" for k, x in enumerate(self.multipliers)]
        if len(self.frequencies):
            lines.append("  oscillates at " + ", ".join(f"{w:.6g}" for w in self.frequencies) + " rad/s")
        return terminal("\n".join(lines))

    def _repr_html_(self) -> str:
        head = f"<p><b>{html(self.name)}</b>: equilibrium, {self._verdict}; residual {self.residual:.2g}</p>"
        rows = [(n, f"{x:.9g}") for n, x in zip(self.coordinates, self.q, strict=True)]
        rows += [(f"τ of {n}", f"{x:.9g}") for n, x in zip(self.velocities, self.tau, strict=True) if x]
        rows += [(f"λ{k + 1}", f"{x:.9g}") for k, x in enumerate(self.multipliers)]
        if len(self.frequencies):
            rows.append(("ω, rad/s", ", ".join(f"{w:.6g}" for w in self.frequencies)))
        cells = "".join(f"<tr><td>{html(n)}</td><td>{x}</td></tr>" for n, x in rows)
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
    """Return where a system rests under given forces, or the forces that hold it in a configuration.

    Parameters
    ----------
    dynamics : Dynamics or Lagrangian
        Of any engine. The own derivation differentiates the forces exactly, others by differences.
    q0 : (nq,) array_like, optional
        Start of the search; by default the neutral configuration, then random ones.
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
        Both `tau` or `q0` and `holding`; a wrong shape; forces that depend on the time;
        a configuration that constraints do not allow.
    NumericalError
        No equilibrium found, with the least force that is left over and where.

    Notes
    -----
    Newton's iteration with the exact stiffness, and Levenberg and Marquardt's damping far from the end, finds one
    equilibrium, not all. Stability is that of M δq̈ + D δq̇ + K δq = 0 on what constraints leave free. Where K is
    symmetric and D feeds no energy in, K's sign decides (Lagrange and Dirichlet, Kelvin and Tait); else the
    eigenvalues do.

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
    balance = Balance(dyn, {name: _wrench(name, x) for name, x in (forces or {}).items()})
    if holding is not None:
        q = dyn.model.check_q(finite_array("holding", holding, (dyn.model.nq,)), "holding")
        balance.check_constraints(q)
        return _equilibrium_at(balance, q, *balance.held(q))
    tau = np.zeros(dyn.model.nv) if tau is None else finite_array("tau", tau, (dyn.model.nv,))
    if q0 is not None:
        starts = [balance.allowed(dyn.model.check_q(finite_array("q0", q0, (dyn.model.nq,)), "q0"))]
    else:
        rng = np.random.default_rng(seed)
        starts = [dyn.model.random_state(rng)[0] for _ in range(_STARTS)]
        # From the neutral configuration there need be no way to the constraints.
        starts[:0] = [] if dyn.model.constrained else [dyn.model.neutral()]
    q, multipliers = find_equilibrium(balance, starts, tau)
    return _equilibrium_at(balance, q, tau, multipliers)


def _equilibrium_at(balance: Balance, q: Array, tau: Array, multipliers: Array) -> Equilibrium:
    """Return the equilibrium with the small motions about it."""
    balance.require_independent(q)
    if balance.changes(q, tau, multipliers):
        # Mathieu's equation and its kind: no instant says whether the whole motion stays small.
        motion = SmallMotion(None, np.empty(0), np.empty(0, dtype=complex))
    else:
        motion = balance.small_motion(q, multipliers)
    return Equilibrium(
        q=q,
        tau=tau,
        residual=balance.size(q, multipliers, tau),
        multipliers=multipliers,
        stable=motion.stable,
        frequencies=motion.frequencies,
        eigenvalues=motion.eigenvalues,
        name=balance.model.name,
        coordinates=balance.model.coordinate_names,
        velocities=balance.model.velocity_names,
    )


def _wrench(name: str, value: ArrayLike) -> Array:
    try:
        shape = np.shape(value)
    except ValueError:
        shape = ()
    if shape not in ((3,), (6,)):
        raise InputError(f"forces[{name!r}]: expected shape (3,) or (6,), got {shape}")
    wrench = finite_array(f"forces[{name!r}]", value, shape)
    return wrench if len(wrench) == 6 else np.concatenate([wrench, np.zeros(3)])
