"""Constraints eliminated: equations of motion in independent quasi-velocities, without multipliers.

The rates of n coordinates satisfy A(q, t) q̇ + a(q, t) = 0, m rows, those of holonomic constraints first. With r = n
- m quasi-velocities w = B(q, t) q̇ beside them, D = (B; A)⁻¹ = (N E) gives every velocity that the rows allow::

    q̇ = N w - E a        A N = 0        A E = 1

The reactions Aᵀ λ do no work on N, and three ways lead to the same r equations (Neimark and Fufaev 1972, Dynamics of
Nonholonomic Systems, ch. III; Greenwood 2003, Advanced Dynamics, ch. 4)::

    Maggi               Nᵀ (M q̈ + C q̇ + d + ∂V/∂q - Q) = 0          q̈ = N ẇ + d/dt(N) w - d/dt(E a)
    Boltzmann, Hamel    the first r of Hamel's equations in the n quasi-velocities (w, A q̇ + a), with the last m zero
                        afterwards
    Gibbs, Appell       ∂S/∂ẇ = Nᵀ (Q - ∂V/∂q)                      S = ½ q̈ᵀ M q̈ + q̈ᵀ (C q̇ + d)

T holds all velocities while it is differentiated. If the rows are put into T before, the reactions' part of Σ γ p is
lost, and the equations are wrong unless the rows are integrable.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, islice
from typing import Any, Final

import mpmath
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from mbkit._check import PROBES, Array, real, rows
from mbkit._escape import terminal
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.lagrangian.energies.energy_form import (
    EnergyForm,
    parameter_values,
    read_expression,
    symbols_of,
    timed_parameters,
    vanish,
)
from mbkit.lagrangian.energies.equations_of_motion import EquationsOfMotion, equations_of_motion
from mbkit.lagrangian.energies.kinetic_energy import inverse
from mbkit.lagrangian.energies.symbols import fits, free_name, listed, name_of, velocity_of
from mbkit.lagrangian.energies.sympy_to_casadi import Numeric
from mbkit.lagrangian.printer import ExpressionPrinter, Printable, aligned
from mbkit.lagrangian.reduction.hamilton import ConservedQuantity, numbers_at
from mbkit.lagrangian.reduction.quasi_equations import in_quasi_velocities, quasi_equations
from mbkit.lagrangian.trig.simplify import (
    PROBE_DIGITS,
    ZERO_PROBE_RATIO,
    RandomEvaluation,
    is_zero,
    settled,
    settled_matrix,
    tidy,
    tidy_matrix,
)

#: Choices of dependent velocities that are looked at.
_MAX_CHOICES: Final = 200


@dataclass(frozen=True, repr=False)
class NonholonomicEquations(EquationsOfMotion):
    """M ẇ + C w + d + Nᵀ ∂V/∂q = Nᵀ Q with q̇ = N w - E a, the result of `Lagrangian.maggi` and its like.

    `velocities` are w and `accelerations` ẇ; matrices and vectors have r rows, in coordinates, w, time and parameters.

    Attributes
    ----------
    form : str
        How they were derived: Maggi's, Boltzmann and Hamel's, or Gibbs and Appell's equations.
    rates : tuple of sympy.Symbol
        q̇.
    N : (n, r) sympy.Matrix
    E : (n, m) sympy.Matrix
    drift_velocity : (n, 1) sympy.Matrix
        -E a.
    definitions : (r, 1) sympy.Matrix
        w in the coordinates' rates, B q̇.
    determinant : sympy.Expr
        Of (B; A): where it is zero, w says nothing of some velocity, and the equations have no value.
    reactions : (m, 1) sympy.Matrix
        λ of the constraints, in coordinates, w and ẇ.
    S : sympy.Expr or None
        Gibbs's function, up to terms without ẇ, where the equations came from it.
    """

    system: EnergyForm = field(default=None, compare=False)  # type: ignore[assignment]
    form: str = "Maggi"
    rates: tuple[sp.Symbol, ...] = ()
    N: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 0, []))
    E: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 0, []))
    drift_velocity: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 1, []))
    definitions: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 1, []))
    determinant: sp.Expr = sp.S.One
    reactions: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 1, []))
    S: sp.Expr | None = None

    def kinematics(self) -> tuple[sp.Eq, ...]:
        """Return q̇ = N w - E a, one equation per coordinate."""
        right = self.N * sp.Matrix(self.velocities) + self.drift_velocity
        return tuple(sp.Eq(a, b, evaluate=False) for a, b in zip(self.rates, right, strict=True))

    # Numbers

    def _numeric(self, A: Any, *moving: Sequence[sp.Symbol]) -> Numeric:
        return Numeric(A, self.coordinates, *moving, timed_parameters(self.system))

    @cached_property
    def _maps(self) -> tuple[Numeric, Numeric]:
        right = self.N * sp.Matrix(self.velocities) + self.drift_velocity
        return self._numeric(right, self.velocities), self._numeric(self.definitions, self.rates)

    @cached_property
    def _motion(self) -> Numeric:
        no_inputs = dict.fromkeys(self.system.inputs.values(), sp.Integer(0))
        both = sp.Matrix.hstack(self.mass_matrix, self.applied.subs(no_inputs), self.N.T)
        return self._numeric(both, self.velocities)

    def _mapped(self, which: int, q: ArrayLike, x: ArrayLike, t: float, values: Mapping[str, float]) -> Array:
        name, size = (("w", len(self.velocities)), ("v", len(self.rates)))[which]
        q = rows("q", q, len(self.coordinates), self.system.name, "nq")
        x = rows(name, x, size, self.system.name, f"n{name}")
        out = self._maps[which](q, x, numbers_at(self.system, t, values, name))[..., 0]
        return require_value(out, self.system.name, q, self.determinant)

    def to_velocity(self, q: ArrayLike, w: ArrayLike, *, t: float = 0.0, **values: float) -> Array:
        """Return q̇ = N w - E a in numbers, (n,) or (N, n); t in s, and values of parameters by name."""
        return self._mapped(0, q, w, t, values)

    def to_quasi_velocity(self, q: ArrayLike, v: ArrayLike, *, t: float = 0.0, **values: float) -> Array:
        """Return w = B q̇ in numbers, (r,) or (N, r); of a v that the constraints allow it says everything."""
        return self._mapped(1, q, v, t, values)

    def field(self, tau: ArrayLike | None = None, **values: float) -> Callable[[float, ArrayLike], Array]:
        """Return f(t, y) = (q̇, ẇ) with y = (q, w), (n + r,), as SciPy's integrators take it.

        `tau` (n,) are forces on the coordinates, zero by default; `values` are those of parameters, by name.
        `mbkit.simulate` runs the same system with multipliers, compiled.
        """
        s, n, r = self.system, len(self.coordinates), len(self.velocities)
        force = np.zeros(n) if tau is None else rows("tau", tau, n, s.name, "nv")
        numbers, timed = parameter_values(s, values, "field"), s.time is not None

        def f(t: float, y: ArrayLike) -> Array:
            y = rows("y", y, n + r, s.name, "nq + nw")
            q, w = y[..., :n], y[..., n:]
            behind = np.concatenate([[real("t", t)] if timed else [], numbers])
            both = require_value(self._motion(q, w, behind), s.name, q, self.determinant)
            M, right = both[..., :r], both[..., r] + both[..., r + 1 :] @ force
            try:
                wdot = np.linalg.solve(M, right[..., None])[..., 0]
            except np.linalg.LinAlgError:
                raise NumericalError(f"{s.name}: the mass matrix of w is singular at q = {q.tolist()}") from None
            qdot = require_value(self._maps[0](q, w, behind)[..., 0], s.name, q, self.determinant)
            return np.concatenate([qdot, wdot], axis=-1)

        return f


def require_value(x: Array, name: str, q: Array, determinant: Any) -> Array:
    """Return x; refuse numbers that are not finite, as where quasi-velocities say nothing of some velocity."""
    if not np.isfinite(x).all():
        raise NumericalError(
            f"{name}: not finite at q = {q.tolist()}; where {determinant} is zero, the quasi-velocities say nothing of "
            "some velocity; take others, or a pose beside it"
        )
    return x


def nonholonomic_equations(system: EnergyForm, quasi_velocities: Any, form: str) -> NonholonomicEquations:
    """Return the equations in independent quasi-velocities; `form` is one of Maggi, Hamel and Appell."""
    if not system.multiplier_symbols:
        raise UnsupportedError(f"{system.name}: has no constraints; give them as velocity_constraints=[...]")
    frame = _Frame.of(system, quasi_velocities)
    derive, motion = {"Maggi": _maggi, "Hamel": _hamel, "Appell": _appell}[form], _Motion.of(system, frame)
    return _made(system, frame, motion, derive(system, frame, motion))


@dataclass(frozen=True)
class _Frame:
    """w and their definitions, and q̇ = N w - E a."""

    velocities: tuple[sp.Symbol, ...]
    definitions: sp.ImmutableMatrix
    N: sp.ImmutableMatrix
    E: sp.ImmutableMatrix
    drift: sp.ImmutableMatrix
    determinant: sp.Expr

    @classmethod
    def of(cls, system: EnergyForm, choice: Any) -> _Frame:
        """Return the frame of what a user chose: names of coordinates, or definitions; the simplest one of None."""
        n, A, a = len(system.coordinates), system.constraint_matrix, system.constraint_drift
        r = n - A.rows
        if r < 1:
            raise InputError(f"{system.name}: {A.rows} constraints leave none of {n} velocities free")
        if isinstance(choice, Mapping):
            w, defined = _defined(system, choice)
        else:
            independent = _simplest(system, A) if choice is None else _chosen(system, choice)
            w = tuple(system.velocities[i] for i in independent)
            defined = sp.Matrix(w)
        if len(w) != r:
            raise InputError(f"quasi_velocities: expected {r}, one for each degree of freedom, got {len(w)}")
        whole = defined.jacobian(system.velocities).col_join(A)
        D = inverse(whole, f"quasi_velocities: {', '.join(map(str, w))} and the constraints, whose matrix")
        E = D[:, r:]
        return cls(
            w, sp.ImmutableMatrix(defined), D[:, :r], E, tidy_matrix(-E * a), settled(whole.det(method="berkowitz"))
        )


def _defined(system: EnergyForm, choice: Mapping[Any, Any]) -> tuple[tuple[sp.Symbol, ...], sp.Matrix]:
    used = {s.name for s in (*symbols_of(system), *system.accelerations)}
    out = []
    for key, source in choice.items():
        if not isinstance(key, (str, sp.Symbol)) or not str(key):
            raise InputError(f"quasi_velocities: expected names or symbols, got {key!r}")
        symbol = sp.Symbol(key) if isinstance(key, str) else key
        fits("velocities", symbol)
        if {symbol.name, velocity_of(symbol).name} & used:
            raise InputError(f"quasi_velocities: {symbol.name!r} or its derivative stands for something else already")
        used |= {symbol.name, velocity_of(symbol).name}
        w = read_expression(system, f"quasi_velocities[{key}]", source)
        slopes = [sp.diff(w, v) for v in system.velocities]
        at_rest = w.subs(dict.fromkeys(system.velocities, 0))
        if not vanish([at_rest, *(sp.diff(x, v) for x in slopes for v in system.velocities)]):
            raise InputError(
                f"quasi_velocities[{key}]: expected a sum of velocities times functions of coordinates, got {w}"
            )
        out.append((symbol, w))
    return tuple(symbol for symbol, _ in out), sp.Matrix([w for _, w in out])


def _chosen(system: EnergyForm, choice: Any) -> list[int]:
    names = [q.name for q in system.coordinates]
    out = []
    for x in listed("quasi_velocities", choice):
        if name_of(x) not in names:
            raise InputError(f"quasi_velocities: {x} is no coordinate; the coordinates are {', '.join(names)}")
        out.append(names.index(name_of(x)))
    return sorted(set(out))


def _simplest(system: EnergyForm, A: sp.ImmutableMatrix) -> list[int]:
    """Return the velocities to keep: those whose others the rows give by the simplest determinant."""
    n, moving = A.cols, {*system.coordinates, system.time}

    def price(dependent: tuple[int, ...]) -> tuple[Any, ...]:
        det = tidy(A[:, list(dependent)].det(method="berkowitz"))
        return is_zero(det), bool(det.free_symbols & moving), det.count_ops(), dependent

    best = min((_dependent(system, A), *islice(combinations(range(n), A.rows), _MAX_CHOICES)), key=price)
    return [i for i in range(n) if i not in best]


def _places(A: sp.ImmutableMatrix) -> tuple[int, ...]:
    """Return columns that are independent of each other, as many as there are, from the last on."""
    places: list[int] = []
    for i in reversed(range(A.cols)):
        if len(places) < A.rows and _rank([sp.Matrix(A[:, [i, *places]])]) > len(places):
            places.insert(0, i)
    return tuple(places)


def _dependent(system: EnergyForm, A: sp.ImmutableMatrix) -> tuple[int, ...]:
    """Return velocities that the rows give by the others; refuse rows that depend on each other."""
    places = _places(A)
    if len(places) < A.rows:
        raise InputError(f"{system.name}: its constraints follow from each other or contradict each other")
    return places


def _along(x: Any, system: EnergyForm, qdot: sp.Matrix) -> Any:
    """Return d/dt of an expression or a matrix of coordinates and time, with the coordinates' rates given."""
    out = sum((sp.diff(x, q) * rate for q, rate in zip(system.coordinates, qdot, strict=True)), 0 * x)
    return out if system.time is None else out + sp.diff(x, system.time)


@dataclass(frozen=True)
class _Motion:
    """q̇, q̈ less N ẇ, and M q̈ + C q̇ + d less M N ẇ, of a system on a frame, and its equations without reactions."""

    equations: EquationsOfMotion
    rate: sp.Matrix
    bias: sp.Matrix
    force: sp.Matrix
    accelerations: tuple[sp.Symbol, ...]  # ẇ

    @classmethod
    def of(cls, system: EnergyForm, frame: _Frame) -> _Motion:
        free = equations_of_motion(system)
        named = dict(zip(system.velocities, system.accelerations, strict=True))
        accelerations = tuple(named.get(w, velocity_of(w)) for w in frame.velocities)
        w = sp.Matrix(frame.velocities)
        rate = frame.N * w + frame.drift
        put = dict(zip(system.velocities, rate, strict=True))
        bias = _along(frame.N, system, rate) * w + _along(frame.drift, system, rate)
        inertial = (free.coriolis_matrix * sp.Matrix(system.velocities) + free.drift).subs(put, simultaneous=True)
        return cls(free, rate, bias, free.mass_matrix * bias + inertial, accelerations)


def _made(system: EnergyForm, frame: _Frame, motion: _Motion, fields: dict[str, Any]) -> NonholonomicEquations:
    """Return the equations from M, C and d in w and their form, with forces, reactions and kinematics."""
    free, N, accelerations = motion.equations, frame.N, motion.accelerations
    Q = free.forces.subs(dict(zip(system.velocities, motion.rate, strict=True)), simultaneous=True)
    whole = free.mass_matrix * (N * sp.Matrix(accelerations)) + motion.force + free.potential_gradient
    reactions = settled_matrix(frame.E.T * whole, (*frame.velocities, *accelerations))
    return NonholonomicEquations(
        coordinates=system.coordinates,
        velocities=frame.velocities,
        accelerations=accelerations,
        potential_gradient=settled_matrix(N.T * free.potential_gradient),
        forces=tidy_matrix(N.T * Q),
        system=system,
        rates=system.velocities,
        N=N,
        E=frame.E,
        drift_velocity=frame.drift,
        definitions=frame.definitions,
        determinant=frame.determinant,
        reactions=tidy_matrix(reactions - frame.E.T * Q),
        **fields,
    )


def _maggi(system: EnergyForm, frame: _Frame, motion: _Motion) -> dict[str, Any]:
    N, w = frame.N, frame.velocities
    M = motion.equations.mass_matrix
    slow = dict(zip(system.velocities, N * sp.Matrix(w), strict=True))
    # The part of N w alone; the rest, of drifts and of the time, is d.
    turning = sum((sp.diff(N, q) * slow[v] for q, v in zip(system.coordinates, system.velocities, strict=True)), 0 * N)
    C = settled_matrix(N.T * (M * turning + motion.equations.coriolis_matrix.subs(slow, simultaneous=True) * N), w)
    rest = sp.zeros(len(w), 1)
    if any(frame.drift) or system.time is not None or any(motion.equations.drift):
        rest = N.T * motion.force - C * sp.Matrix(w)
    d = settled_matrix(rest, w)
    return {"form": "Maggi", "mass_matrix": settled_matrix(N.T * M * N), "coriolis_matrix": C, "drift": d}


def _appell(system: EnergyForm, frame: _Frame, motion: _Motion) -> dict[str, Any]:
    C, w, wdot = _maggi(system, frame, motion)["coriolis_matrix"], frame.velocities, sp.Matrix(motion.accelerations)
    a, M = frame.N * wdot, motion.equations.mass_matrix
    S = (a.T * M * a)[0] / 2 + (a.T * motion.force)[0]
    slopes = sp.Matrix([S]).jacobian(motion.accelerations).T
    M = settled_matrix(slopes.jacobian(motion.accelerations))
    at_rest = settled_matrix(slopes.subs(dict.fromkeys(motion.accelerations, 0)), w)
    d = settled_matrix(at_rest - C * sp.Matrix(w), w)
    # Built from the shortest parts.
    S = tidy((wdot.T * M * wdot)[0] / 2) + tidy((wdot.T * at_rest)[0])
    return {"form": "Gibbs and Appell", "mass_matrix": M, "coriolis_matrix": C, "drift": d, "S": S}


def _hamel(system: EnergyForm, frame: _Frame, _: _Motion) -> dict[str, Any]:
    r, used = len(frame.velocities), {s.name for s in (*symbols_of(system), *frame.velocities)}
    names = [free_name(f"{x}_", used) for x in (*frame.velocities, *(f"rate{k + 1}" for k in range(frame.E.cols)))]
    # In the first r equations no reaction stands.
    free = EnergyForm(**{**system._arguments(), "constraints": (), "velocity_constraints": ()})
    arguments, kinetic, quasi = in_quasi_velocities(free, sp.Matrix.hstack(frame.N, frame.E), names, frame.drift)
    form = EnergyForm.__new__(EnergyForm)
    form.quasi, form.__dict__["kinetic"] = quasi, kinetic
    EnergyForm.__init__(form, **arguments)
    whole = quasi_equations(form, quasi)
    w, held_rates = form.velocities[:r], form.velocities[r:]
    back = {**dict.fromkeys(held_rates, sp.Integer(0)), **dict(zip(w, frame.velocities, strict=True))}
    # Only now: the momenta of A q̇ stand in Hamel's terms.
    C, d = (
        settled_matrix(x.subs(back, simultaneous=True), frame.velocities)
        for x in (whole.coriolis_matrix[:r, :r], whole.drift[:r, :])
    )
    M = settled_matrix(whole.mass_matrix[:r, :r])
    return {"form": "Boltzmann and Hamel", "mass_matrix": M, "coriolis_matrix": C, "drift": d}


# Integrable rows


@dataclass(frozen=True, repr=False)
class Integrability(Printable):
    """The velocity constraints that follow from functions of the coordinates, by Frobenius' theorem.

    Attributes
    ----------
    constraints : tuple of sympy.Expr
        The rows A v + a.
    integrable : tuple of bool
        Of each row whether it follows from functions that stay constant: whether the last velocities of `growth`
        keep it too. That dω ∧ ω1 ∧ ... ∧ ωm = 0 is needed for it, and is not enough.
    growth : tuple of int
        Dimensions of the velocities that the rows allow, then with their Lie brackets, then with the brackets of these,
        until they grow no more (the growth vector); time counts as a coordinate where it enters.
    integrals : int
        Independent functions of the coordinates that stay constant on every motion: n less the last of `growth`.
    """

    constraints: tuple[sp.Expr, ...]
    integrable: tuple[bool, ...]
    growth: tuple[int, ...]
    integrals: int
    moving: tuple[tuple[sp.Symbol, ...], ...] = field(default=(), compare=False)

    @property
    def holonomic(self) -> bool:
        """Whether all rows are integrable; as functions they then belong in `constraints`."""
        return self.integrals == len(self.constraints)

    def __str__(self) -> str:
        lines = [
            f"{x} = 0: {'' if good else 'not '}integrable"
            for x, good in zip(self.constraints, self.integrable, strict=True)
        ]
        n = self.integrals
        whole = f"{n} function{'s' if n != 1 else ''} of the coordinates {'are' if n != 1 else 'is'} constant"
        return terminal("\n".join([*lines, f"{whole}; growth {', '.join(map(str, self.growth))}"]))

    def latex(self) -> str:
        """Return each row with what it is, as an aligned LaTeX block."""
        board = ExpressionPrinter(*self.moving)
        return aligned(
            (board.latex(x), rf"0 \quad\text{{{'' if good else 'not '}integrable}}")
            for x, good in zip(self.constraints, self.integrable, strict=True)
        )


def integrability(system: EnergyForm) -> Integrability:
    """Return which of a system's velocity constraints are integrable."""
    if not system.velocity_constraints:
        raise UnsupportedError(f"{system.name}: has no velocity constraints; give them as velocity_constraints=[...]")
    A, a = system.velocity_rows
    _dependent(system, A)
    place = list(system.coordinates)
    if system.time is not None and (any(a) or system.time in A.free_symbols):
        # Velocities (q̇, ṫ) of a row A q̇ + a ṫ = 0.
        place, A = [*place, system.time], A.row_join(a)
    elif any(a):
        place, A = [*place, sp.Dummy("t")], A.row_join(a)
    frame = _kernel(A)
    spread, growth = [*frame], [len(frame)]
    new = frame
    while new and len(spread) < len(place):
        # Lie brackets [x, y].
        pairs = (y.jacobian(place) * x - x.jacobian(place) * y for x in frame for y in new)
        brackets = [x for x in (pair.applyfunc(tidy) for pair in pairs) if any(e != 0 for e in x)]
        new = _independent(spread, brackets)
        spread += new
        if not new:
            break
        growth.append(len(spread))
    good = tuple(all(is_zero((A[k, :] * x)[0]) for x in spread) for k in range(A.rows))
    integrals = len(place) - growth[-1]
    moving = (system.coordinates, system.velocities)
    return Integrability(system.velocity_constraints, good, tuple(growth), integrals, moving)


def _kernel(A: sp.ImmutableMatrix) -> list[sp.Matrix]:
    n = A.cols
    choices = dict.fromkeys((_places(A), *islice(combinations(range(n), A.rows), _MAX_CHOICES)))
    priced = ((tidy(A[:, list(c)].det(method="berkowitz")), c) for c in choices)
    det, dependent = min(((d, c) for d, c in priced if not is_zero(d)), key=lambda x: (x[0].count_ops(), x[1]))
    block, out = A[:, list(dependent)], []
    # Cramer's rule: times the determinant, so that no quotient grows in the brackets.
    adjugate = block.adjugate(method="berkowitz")
    for free in (i for i in range(n) if i not in dependent):
        x = sp.zeros(n, 1)
        x[free] = det
        for i, value in zip(dependent, -adjugate * A[:, free], strict=True):
            x[i] = value
        out.append(x.applyfunc(tidy))
    return out


def _independent(known: Sequence[sp.Matrix], more: Iterable[sp.Matrix]) -> list[sp.Matrix]:
    """Return those of more vector fields that are no sums of the ones before, at a general place."""
    out: list[sp.Matrix] = []
    rank = _rank([*known])
    for x in more:
        larger_rank = _rank([*known, *out, x])
        if larger_rank > rank:
            out.append(x)
            rank = larger_rank
    return out


def _rank(columns: Sequence[sp.Matrix]) -> int:
    """Return the rank of columns at a random place, with 30 digits."""
    if not columns:
        return 0
    whole = sp.Matrix.hstack(*columns)
    probe = RandomEvaluation([*whole])
    best = 0
    for seed in range(PROBES):
        values = probe(probe.place(seed))
        if values is None:
            continue
        with mpmath.workdps(PROBE_DIGITS):
            B = mpmath.matrix(whole.rows, whole.cols)
            for i in range(whole.rows):
                for j in range(whole.cols):
                    B[i, j] = values[i * whole.cols + j]
            sizes = [abs(x) for x in mpmath.svd_c(B, compute_uv=False)]
            best = max(best, sum(x > ZERO_PROBE_RATIO * max(sizes) for x in sizes))
    return best


# Momenta along symmetries that the constraints allow

#: Values of a coordinate at which the rows are looked at.
_LOOKS: Final = (sp.Integer(0), sp.pi / 2, sp.Rational(1, 3), sp.Integer(1))


def symmetry_momenta(system: EnergyForm) -> tuple[ConservedQuantity, ...]:
    """Return the momenta Σ ξ p along constant directions ξ of the configuration along which nothing acts.

    Of coordinates that L does not hold and on which reactions alone act: A ξ = 0 everywhere (the momentum equation for
    a symmetry that the constraints allow; Bloch 2003, Nonholonomic Mechanics and Control, ch. 5.5).
    """
    forced = system.forced_cyclic_coordinates().items()
    at_rest = dict.fromkeys(system.multiplier_symbols, 0)
    pure = [q for q, x in forced if is_zero(x.subs(at_rest))]
    if not pure:
        return ()
    places = [system.coordinates.index(q) for q in pure]
    A = system.constraint_matrix[:, places]
    # Constant ξ: the rows and their slopes at several places.
    moving = [s for s in (*system.coordinates, system.time) if s is not None and s in A.free_symbols]
    looks = [A.subs(dict.fromkeys(moving, x)) for x in _LOOKS] if moving else [A]
    looks += [A.subs({s: _LOOKS[(k + i) % len(_LOOKS)] for i, s in enumerate(moving)}) for k in range(len(_LOOKS))]
    stacked = sp.Matrix.vstack(*(x for x in looks if not x.has(sp.nan, sp.zoo, sp.oo)))
    out: list[ConservedQuantity] = []
    for direction in stacked.nullspace():
        if not vanish(A * direction):
            continue
        momentum = sum((e * system.momenta[i] for e, i in zip(direction, places, strict=True)), sp.Integer(0))
        along = " + ".join(f"{e} p_{q}" if e != 1 else f"p_{q}" for q, e in zip(pure, direction, strict=True) if e)
        meaning = f"momentum {along}, along a symmetry that the constraints allow"
        symbols = (system.coordinates, system.velocities)
        out.append(ConservedQuantity(f"J{len(out) + 1}", tidy(momentum), meaning, symbols))
    return tuple(out)
