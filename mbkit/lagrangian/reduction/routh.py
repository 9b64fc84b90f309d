"""Routh's reduction: cyclic coordinates leave the equations, their momenta stay as constants.

With the cyclic coordinates' velocities u, those of the others v, and M, b of T split alike, p = Mᵤᵤ u + Mᵤᵥ v + bᵤ is
constant where nothing acts, and R = L - pᵀ u with u eliminated is the Lagrangian of the others (Goldstein, Poole, Safko
2002, ch. 8.3, where it has the other sign; Lanczos 1970, ch. V.4)::

    R = ½ vᵀ (Mᵥᵥ - Mᵥᵤ Mᵤᵤ⁻¹ Mᵤᵥ) v  +  vᵀ (bᵥ + Mᵥᵤ Mᵤᵤ⁻¹ (p - bᵤ))  -  Vₑ
    Vₑ = V + ½ (p - bᵤ)ᵀ Mᵤᵤ⁻¹ (p - bᵤ) - T0

The term linear in v makes gyroscopic forces, and Vₑ is the effective potential. T0, of axes that turn at a given rate,
is part of it; the reduced Lagrangian keeps it in its T.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from mbkit._check import TYPED, Array, finite_array, require_finite, rows
from mbkit._escape import terminal
from mbkit.engines.base import at_times
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.lagrangian.energies.energy_form import EnergyForm, parameter_values, timed_parameters
from mbkit.lagrangian.energies.kinetic_energy import completed_squares
from mbkit.lagrangian.energies.symbols import listed, name_of, plain
from mbkit.lagrangian.energies.sympy_to_casadi import Numeric
from mbkit.lagrangian.energy_model import EnergyModel
from mbkit.lagrangian.printer import ExpressionPrinter, Printable, aligned
from mbkit.lagrangian.reduction.hamilton import momentum_symbols, numbers_at
from mbkit.lagrangian.trig.simplify import tidy

FormT = TypeVar("FormT", bound=EnergyForm)


class ReducedState(NamedTuple):
    """A state (r,) or (N, r) of the reduced system, and its constant momenta by name as keywords of `dynamics`."""

    q: Array
    v: Array
    values: dict[str, Any]


class Motion(NamedTuple):
    """States in time: t (K,) in s, q and v (K, n)."""

    t: Array
    q: Array
    v: Array


@dataclass(frozen=True, eq=False, repr=False)
class Routhian(Printable, Generic[FormT]):
    """A system less its cyclic coordinates, the result of `Lagrangian.routhian`.

    Attributes
    ----------
    system : Lagrangian
        The whole one.
    lagrangian : Lagrangian
        The reduced one, whose parameters hold the constant momenta: to read, and to run.
    cyclic : tuple of sympy.Symbol
        The ignored coordinates.
    momenta : mapping of sympy.Symbol to sympy.Expr
        Symbol of each constant momentum -> its expression in the whole system's velocities.
    rates : mapping of sympy.Symbol to sympy.Expr
        Ignored coordinate -> its velocity, in what remains.
    """

    system: FormT = field(repr=False)
    lagrangian: FormT
    cyclic: tuple[sp.Symbol, ...]
    momenta: Mapping[sp.Symbol, sp.Expr]
    rates: Mapping[sp.Symbol, sp.Expr]

    def __reduce__(self) -> tuple[Any, ...]:
        return routhian, (self.system, self.cyclic)

    @property
    def R(self) -> sp.Expr:
        """The Routhian L - Σ p q̇ of the ignored coordinates, a Lagrangian of the others."""
        return self.lagrangian.L

    @property
    def effective_potential(self) -> sp.Expr:
        """Vₑ = V + ½ (p - bᵤ)ᵀ Mᵤᵤ⁻¹ (p - bᵤ) - T0, whose stationary points are the steady motions."""
        V, T0 = self.lagrangian.V, self.lagrangian.kinetic.T0
        return V if T0 == 0 else tidy(V - T0)

    @cached_property
    def _places(self) -> tuple[list[int], list[int]]:
        """Indices of the remaining and the ignored coordinates in the whole system."""
        whole = self.system.coordinates
        return [whole.index(q) for q in self.lagrangian.coordinates], [whole.index(q) for q in self.cyclic]

    @cached_property
    def _momenta(self) -> Numeric:
        s = self.system
        return Numeric(sp.Matrix(list(self.momenta.values())), s.coordinates, s.velocities, timed_parameters(s))

    @cached_property
    def _model(self) -> EnergyModel:
        return EnergyModel(self.lagrangian)

    def reduce(self, q: ArrayLike, v: ArrayLike, *, t: float = 0.0, **values: float) -> ReducedState:
        """Return the reduced system's state and constant momenta.

        Of the whole system's q and v, (n,) or (N, n), time t in s, and values of its parameters by name.
        """
        s, n = self.system, len(self.system.coordinates)
        q, v = rows("q", q, n, s.name, "nq"), rows("v", v, n, s.name, "nv")
        p = self._momenta(q, v, numbers_at(s, t, values, "reduce"))[..., 0]
        remaining, _ = self._places
        momenta = {x.name: p[..., k] if p.ndim > 1 else float(p[k]) for k, x in enumerate(self.momenta)}
        return ReducedState(q[..., remaining].copy(), v[..., remaining].copy(), momenta)

    def reconstruct(self, run: Any, q0: ArrayLike, **values: float) -> Motion:
        """Return the motion t, q, v of the whole system, (K,), (K, n), (K, n); the ignored coordinates by quadrature.

        Each interval between saved states is integrated again from its start, to 1e-13, with the ignored rates: the
        result is as accurate as the run, however far apart its states are.

        Parameters
        ----------
        run : Trajectory or (t, q, v)
            Of the reduced system: one run, (K,), (K, r), (K, r); not a batch, and without a torque (UnsupportedError).
        q0 : (n,) or (m,) array_like
            The whole configuration at the first time, or its ignored coordinates alone.
        **values
            Of the reduced system's parameters and momenta, by name; a Trajectory brings its own.
        """
        t, q, v, numbers = _read(self, run, values)
        remaining, ignored = self._places
        start = _start(self, q0, q)
        steps = _increments(self, t, q, v, numbers)
        whole, speeds = (np.empty((len(t), len(self.system.coordinates))) for _ in range(2))
        whole[:, remaining], speeds[:, remaining] = q, v
        whole[:, ignored] = start + np.concatenate([np.zeros((1, len(ignored))), np.cumsum(steps, axis=0)])
        speeds[:, ignored] = self._rates(t, q, v, numbers)
        return Motion(t, whole, speeds)

    @cached_property
    def _rate_numbers(self) -> Numeric:
        s = self.lagrangian
        return Numeric(sp.Matrix(list(self.rates.values())), s.coordinates, s.velocities, timed_parameters(s))

    def _rates(self, t: Array, q: Array, v: Array, numbers: Mapping[str, float]) -> Array:
        """Return the ignored velocities at states, (K, m)."""
        behind = [np.full(len(t), x) for x in numbers.values()]
        behind[:0] = [] if self.lagrangian.time is None else [t]
        return self._rate_numbers(q, v, np.array(behind).reshape(-1, len(t)).T)[..., 0]

    def _pairs(self) -> list[tuple[sp.Expr, sp.Expr]]:
        named = dict(zip(self.system.coordinates, self.system.velocities, strict=True))
        return [(sp.Symbol("R"), self.R), *self.momenta.items(), *((named[q], x) for q, x in self.rates.items())]

    def latex(self) -> str:
        """Return R, the momenta and the ignored rates as an aligned LaTeX block."""
        whole = self.system
        board = ExpressionPrinter(whole.coordinates, whole.velocities, tuple(self.momenta), time=whole.time)
        return aligned((board.latex(left), board.latex(right)) for left, right in self._pairs())

    def __str__(self) -> str:
        return terminal("\n".join(f"{left} = {right}" for left, right in self._pairs()))


def routhian(system: FormT, cyclic: Any = None) -> Routhian[FormT]:
    """Return the reduction of a system by the `cyclic` coordinates, or by all that are cyclic and unforced."""
    ignored = _chosen(system, cyclic)
    remaining = [q for q in system.coordinates if q not in ignored]
    r, c = ([system.coordinates.index(q) for q in part] for part in (remaining, ignored))
    k = system.kinetic
    symbols = momentum_symbols(system, ignored)
    excess = [symbol - k.b[i] for symbol, i in zip(symbols, c, strict=True)]
    squares = completed_squares(k.M.extract(c, c), "T: the ignored coordinates' mass matrix")
    columns = [list(k.M.extract(c, [j])) for j in r]
    v = [system.velocities[j] for j in r]
    M = sp.Matrix(len(r), len(r), lambda i, j: tidy(k.M[r[i], r[j]] - squares.form(columns[i], columns[j])))
    b = [tidy(k.b[j] + squares.form(column, excess)) for j, column in zip(r, columns, strict=True)]
    others = [x - sum(y * w for y, w in zip(k.M[i, r], v, strict=True)) for x, i in zip(excess, c, strict=True)]
    rates = squares.solve(others)
    eliminated = {system.velocities[i]: x for i, x in zip(c, rates, strict=True)}
    squared = [M[i, j] * v[i] * v[j] for i in range(len(v)) for j in range(len(v))]
    reduced = type(system)(
        T=sp.Add(*squared) / 2 + sum(x * w for x, w in zip(b, v, strict=True)) + k.T0,
        V=system.V + squares.form(excess, excess) / 2,
        coordinates=remaining,
        velocities=v,
        time=system.time,
        forces=_forces(system, remaining, ignored, eliminated),
        dissipation=tidy(system.dissipation),
        parameters={**system.parameters, **dict.fromkeys(symbols)},
        constraints=system.constraints,
        velocity_constraints=system.velocity_constraints,
        name=f"{system.name} less {', '.join(q.name for q in ignored)}",
    )
    definitions = dict(zip(symbols, (system.momenta[i] for i in c), strict=True))
    return Routhian(system, reduced, tuple(ignored), definitions, dict(zip(ignored, rates, strict=True)))


def _chosen(system: EnergyForm, cyclic: Any) -> list[sp.Symbol]:
    free = system.cyclic_coordinates()
    ignorable = system.forced_cyclic_coordinates() | dict.fromkeys(free, sp.Integer(0))
    by_name = {q.name: q for q in system.coordinates}
    out: list[sp.Symbol] = []
    for choice in free if cyclic is None else listed("cyclic", cyclic):
        q = by_name.get(name_of(choice))
        if q is None:
            raise InputError(f"cyclic: {choice} is no coordinate; the coordinates are {', '.join(by_name)}")
        if q not in ignorable:
            raise InputError(f"cyclic: L holds {q}; cyclic are {plain(free) or 'none'}")
        if q not in free:
            raise InputError(
                f"cyclic: L does not hold {q}, but the force {ignorable[q]} acts along it, so p_{q} changes"
            )
        if q not in out:
            out.append(q)
    if not out:
        forced = "; ".join(f"{q} is in no energy, but {x} acts along it" for q, x in ignorable.items() if x != 0)
        raise InputError(f"cyclic: no coordinate of {system.name} can be ignored" + (f": {forced}" if forced else ""))
    if len(out) == len(system.coordinates):
        raise InputError(
            f"cyclic: all coordinates of {system.name} are cyclic and none would remain; choose which to ignore, "
            f"such as routhian([{out[0]}])"
        )
    return [q for q in system.coordinates if q in out]


def _forces(
    system: EnergyForm, remaining: list[sp.Symbol], ignored: list[sp.Symbol], eliminated: Mapping[sp.Symbol, sp.Expr]
) -> dict[sp.Symbol, sp.Expr]:
    """Return the forces along the remaining coordinates, without the ignored velocities."""
    forces = {q: system.inputs.get(q, x) for q, x in zip(system.coordinates, system.forces, strict=True)}
    out = {q: tidy(forces[q].subs(eliminated)) for q in remaining if forces[q] != 0}
    for q, x in out.items():
        _need_not(ignored, x, f"the force {forces[q]} along {q}")
    for row in system.velocity_constraints:
        _need_not(ignored, row, f"the velocity constraint {row}")
    # Nothing acts along the ignored coordinates: R holds their velocities in form only.
    _need_not([*ignored, *eliminated], tidy(system.dissipation), f"the dissipation {system.dissipation}")
    return out


def _need_not(ignored: list[sp.Symbol], x: sp.Expr, what: str) -> None:
    cyclic = x.free_symbols & set(ignored)
    if cyclic:
        raise InputError(f"cyclic: {what} holds {plain(cyclic)}, which can therefore not be ignored")


# The ignored coordinates of a reduced motion, by quadrature along it. The intervals between saved states do not depend
# on each other: all of them are integrated side by side, as one system on the unit interval, with the rates of the
# ignored coordinates as further states. What each adds is then summed.

# SciPy's limit is 100 eps; the norm is a mean over all intervals.
_QUADRATURE_TOLERANCE: Final = 1e-13


def _read(
    routhian: Routhian[Any], run: Any, values: Mapping[str, float]
) -> tuple[Array, Array, Array, dict[str, float]]:
    """Return t, q, v and the numbers of the reduced model's parameters without the time."""
    model, parameters = routhian._model, {}
    if hasattr(run, "tau") and hasattr(run, "model"):
        if np.any(run.tau):
            raise UnsupportedError(
                "run: a torque acted on it, which is not known between its states; write it as one of the "
                "Lagrangian's forces"
            )
        parameters = dict(run.model.parameters)
        t, q, v = run.t, run.q, run.v
    else:
        try:
            t, q, v = run
        except (TypeError, ValueError):
            raise InputError(f"run: expected a Trajectory or (t, q, v), got {type(run).__name__}") from None
    t = np.asarray(t, dtype=np.float64)
    if t.ndim != 1 or not len(t) or np.any(np.diff(t) < 0):
        raise InputError(f"run: expected times (K,) that ascend, got shape {t.shape}")
    if np.ndim(q) == 3:
        raise InputError("run: expected one trajectory, got a batch; reconstruct them one by one")
    require_finite("run: t", t)
    q, v = (finite_array(f"run: {name}", x, (len(t), model.nq)) for name, x in (("q", q), ("v", v)))
    names = [p.name for p in routhian.lagrangian.parameters]
    values = {**{n: x for n, x in parameters.items() if n in names and x is not None}, **values}
    numbers = parameter_values(routhian.lagrangian, values, "reconstruct")
    return t, q, v, dict(zip(names, numbers.tolist(), strict=True))


def _start(routhian: Routhian[Any], q0: ArrayLike, q: Array) -> Array:
    remaining, ignored = routhian._places
    whole = len(remaining) + len(ignored)
    start = np.asarray(q0, dtype=np.float64)
    if start.shape not in ((len(ignored),), (whole,)):
        raise InputError(
            f"q0: expected the whole configuration ({whole},) or its ignored coordinates ({len(ignored)},), "
            f"got shape {start.shape}"
        )
    require_finite("q0", start)
    if len(start) < whole:
        return start
    off = float(np.abs(start[remaining] - q[0]).max())
    if off > TYPED * (1 + float(np.abs(q[0]).max())):
        names = ", ".join(x.name for x in routhian.lagrangian.coordinates)
        raise InputError(f"q0: its {names} differ from the run's first state by {off:.3g}")
    return start[ignored]


def _increments(routhian: Routhian[Any], t: Array, q: Array, v: Array, numbers: Mapping[str, float]) -> Array:
    """Return what each interval adds to the ignored coordinates, (K - 1, m)."""
    spans, n, m = np.diff(t), q.shape[1], len(routhian.cyclic)
    if not len(spans):
        return np.empty((0, m))
    dyn = LagrangianDynamics(routhian._model, compile=False)
    own = dyn.at(**numbers) if numbers else dyn

    def field(s: float, y: Array) -> Array:
        state, now = y.reshape(len(spans), 2 * n + m), t[:-1] + s * spans
        position, speed = np.ascontiguousarray(state[:, :n]), np.ascontiguousarray(state[:, n : 2 * n])
        a = at_times(own, now).forward_dynamics(position, speed, np.zeros_like(speed))
        rates = routhian._rates(now, position, speed, numbers)
        return np.asarray(spans[:, None] * np.concatenate([speed, a, rates], axis=1)).ravel()

    start = np.concatenate([q[:-1], v[:-1], np.zeros((len(spans), m))], axis=1).ravel()
    # A mean over N numbers hides one that is √N times as wrong.
    tight = max(_QUADRATURE_TOLERANCE / np.sqrt(len(spans)), 3e-14)
    solution = solve_ivp(field, (0.0, 1.0), start, "DOP853", t_eval=[1.0], rtol=tight, atol=tight)
    if not solution.success or not np.isfinite(solution.y).all():
        name = routhian.lagrangian.name
        raise NumericalError(f"{name}: the motion between the saved states cannot be followed: {solution.message}")
    return np.asarray(solution.y[:, -1].reshape(len(spans), 2 * n + m)[:, 2 * n :])
