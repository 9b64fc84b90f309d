"""A system as its energies in generalized coordinates: the data that everything else in `mbkit.lagrangian` reads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, Final, Self

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef, UndefinedFunction

from mbkit._check import Array, real
from mbkit.errors import InputError, MbkitWarning, require_known, warn
from mbkit.lagrangian.energies.kinetic_energy import KineticSplit, require_inertia, split, warn_of_negative
from mbkit.lagrangian.energies.symbols import (
    PlainSymbols,
    accelerations_of,
    by_name,
    expression,
    free_name,
    listed,
    name_of,
    plain,
    undefined,
)
from mbkit.lagrangian.trig.simplify import gradient, is_zero, settled, tidy, tidy_matrix

#: Arguments that are several expressions each.
ROWS: Final = ("constraints", "velocity_constraints", "stops", "restitution")


@dataclass(frozen=True, eq=False)
class QuasiVelocities:
    """q̇ = D w + e in symbols, with W = D⁻¹; `input_forces` are Dᵀ u of the coordinates' inputs u.

    `drift` is e, and `time` the symbol of the time where D or e holds it.
    """

    D: sp.ImmutableMatrix
    W: sp.ImmutableMatrix
    coordinates: tuple[sp.Symbol, ...]
    rates: tuple[sp.Symbol, ...]
    input_forces: sp.ImmutableMatrix
    drift: sp.ImmutableMatrix
    time: sp.Symbol | None = None

    @property
    def moves(self) -> bool:
        """Whether time transports the frame: D or e depends on it, or e is not zero."""
        return self.time is not None or any(self.drift)

    def transported(self, x: Any) -> Any:
        """Return ∂x/∂t + Σ ∂x/∂q_r e_r: the rate of an expression or a matrix where w is zero."""
        out = sum((sp.diff(x, q) * e for q, e in zip(self.coordinates, self.drift, strict=True) if e != 0), 0 * x)
        return out if self.time is None else out + sp.diff(x, self.time)

    @cached_property
    def transport_coefficients(self) -> sp.ImmutableMatrix:
        """γ⁰, (n, n), of `mbkit.lagrangian.reduction.quasi_equations`; ``transport_coefficients[k, i]`` = γ^k_i0."""
        slope = sp.Matrix(self.drift).jacobian(self.coordinates)
        return tidy_matrix(self.W * (slope * self.D - self.transported(self.D)))

    @cached_property
    def hamel_coefficients(self) -> sp.ImmutableDenseNDimArray:
        """γ, (n, n, n), of `mbkit.lagrangian.reduction.quasi_equations`; ``hamel_coefficients[k, i, j]`` = γ^k_ij."""
        q, D, n = sp.Matrix(self.coordinates), self.D, len(self.coordinates)
        slopes = [D[:, j].jacobian(q) for j in range(n)]
        out = sp.MutableDenseNDimArray.zeros(n, n, n)
        for i in range(n):
            for j in range(i):
                # [D_i, D_j] in the frame that D's columns are.
                bracket = self.W * (slopes[j] * D[:, i] - slopes[i] * D[:, j])
                for k, x in enumerate(bracket):
                    out[k, i, j] = settled(x)
                    out[k, j, i] = -out[k, i, j]
        return sp.ImmutableDenseNDimArray(out)


class EnergyForm:
    """T, V, forces and constraints in plain symbols, checked; arguments and attributes are those of `Lagrangian`."""

    quasi: QuasiVelocities | None = None

    def __init__(
        self,
        T: Any,
        V: Any = 0,
        coordinates: Sequence[Any] = (),
        velocities: Sequence[Any] | None = None,
        *,
        time: sp.Symbol | None = None,
        forces: Mapping[Any, Any] | None = None,
        dissipation: Any = 0,
        parameters: Mapping[sp.Symbol, float | None] | Iterable[sp.Symbol] | None = None,
        constraints: Sequence[Any] = (),
        velocity_constraints: Sequence[Any] = (),
        stops: Any = (),
        restitution: Any = 0,
        name: str = "system on paper",
    ) -> None:
        self.parameters = _parameters(parameters)
        into = PlainSymbols(coordinates, velocities, time, among=getattr(T, "free_symbols", ()), named=self.parameters)
        self.T, self.V = _without_rates(into("T", T), into("V", V), into.velocities)
        self.dissipation = into("dissipation", dissipation)
        acting = _forces(into, forces or {})
        self.constraints = _rows(into, "constraints", constraints)
        self.velocity_constraints = _rows(into, "velocity_constraints", velocity_constraints)
        values = {s: x for s, x in self.parameters.items() if x is not None}
        self.stops, self.restitution = _stops(into, stops, restitution, values)
        self.coordinates, self.velocities, self.clock = into.coordinates, into.velocities, into.time
        others = (self.T, self.V, self.dissipation, *self.constraints, *self.velocity_constraints, *self.stops)
        # The time of dynamicsymbols need not enter by itself.
        self.time = into.time if any(into.time in x.free_symbols for x in (*others, *acting.values())) else None
        moving = {*self.coordinates, *self.velocities, *([self.time] if self.time else [])}
        self.inputs = _inputs(acting, moving | set(self.parameters), others)
        self.forces = sp.ImmutableMatrix([x if q not in self.inputs else 0 for q, x in acting.items()])
        self.accelerations = accelerations_of(self.coordinates, self.velocities)
        used = {s.name for s in (*moving, *self.parameters, *self.inputs.values(), *self.accelerations)}
        m = len(self.constraints) + len(self.velocity_constraints)
        symbols = tuple(sp.Symbol(free_name(f"lambda{k + 1}", used)) for k in range(m + len(self.stops)))
        self.multiplier_symbols, self.stop_multipliers = symbols[:m], symbols[m:]
        _check_names(self)
        _check_declared(self)
        _check_velocities(self)
        if not isinstance(name, str) or not name.strip():
            raise InputError(f"name: expected a text, got {name!r}")
        self.name = name
        require_inertia(self.kinetic.M, self.velocities, self.constraint_matrix)
        warn_of_negative(self.kinetic.M, self.velocities, self.parameters)
        _warn_of_mass_in_time(self)

    # Parts

    @cached_property
    def kinetic(self) -> KineticSplit:
        """T = T2 + T1 + T0, with M and b."""
        return split(self.T, self.velocities)

    @cached_property
    def momenta(self) -> sp.ImmutableMatrix:
        """p = ∂T/∂v, (n, 1)."""
        return tidy_matrix(self.kinetic.M * sp.Matrix(self.velocities) + self.kinetic.b)

    @property
    def L(self) -> sp.Expr:
        """T - V."""
        return self.T - self.V

    # Constraints

    @cached_property
    def velocity_rows(self) -> tuple[sp.ImmutableMatrix, sp.ImmutableMatrix]:
        """A (k, n) and a (k, 1) of the velocity constraints A v + a = 0."""
        rows = sp.Matrix(len(self.velocity_constraints), 1, self.velocity_constraints)
        if not rows:
            return sp.ImmutableMatrix(0, len(self.velocities), []), sp.ImmutableMatrix(0, 1, [])
        A, at_rest = rows.jacobian(self.velocities), rows.subs(dict.fromkeys(self.velocities, 0))
        return tidy_matrix(A), tidy_matrix(at_rest)

    @cached_property
    def constraint_matrix(self) -> sp.ImmutableMatrix:
        """J (m, n) of the holonomic constraints, with A of the velocity constraints below it."""
        f = sp.Matrix(len(self.constraints), 1, self.constraints)
        J = f.jacobian(self.coordinates) if f else sp.zeros(0, len(self.coordinates))
        return sp.ImmutableMatrix(J.col_join(self.velocity_rows[0]))

    @cached_property
    def constraint_drift(self) -> sp.ImmutableMatrix:
        """c (m, 1) of the rates J v + c, ∂f/∂t and a; zero where no constraint moves."""
        by_time = [0 if self.time is None else sp.diff(f, self.time) for f in self.constraints]
        return sp.ImmutableMatrix(len(self.multiplier_symbols), 1, [*by_time, *self.velocity_rows[1]])

    # Cyclic coordinates

    @cached_property
    def _ignorable(self) -> dict[sp.Symbol, sp.Expr]:
        """Each coordinate that L does not hold -> the force along it beside V's, constraints with their λ included."""
        reactions = self.constraint_matrix.T * sp.Matrix(len(self.multiplier_symbols), 1, self.multiplier_symbols)
        acting = zip(self.coordinates, acting_forces(self), reactions, strict=True)
        forces = {q: tidy(x + reaction) for q, x, reaction in acting}
        # Term by term in the velocities, so that each is short.
        parts = (*self.kinetic.M, *self.kinetic.b, self.kinetic.T0, self.V)
        return {q: forces[q] for q in self.coordinates if vanish(sp.diff(x, q) for x in parts)}

    def cyclic_coordinates(self) -> tuple[sp.Symbol, ...]:
        """Return the coordinates that L does not hold and along which nothing acts: their momenta are constant."""
        return tuple(q for q, force in self._ignorable.items() if force == 0)

    def forced_cyclic_coordinates(self) -> dict[sp.Symbol, sp.Expr]:
        """Return the other coordinates that L does not hold, each with the force that acts along it."""
        return {q: force for q, force in self._ignorable.items() if force != 0}

    @cached_property
    def jumps(self) -> tuple[str, ...]:
        """Forces that jump where a velocity changes its sign, by name."""
        out = []
        for name, x in _parts(self).items():
            kind, at_zero = (sp.Abs, 0) if name == "dissipation" else (sp.sign, 1)
            for a in sorted(x.atoms(kind), key=str) if name.startswith(("forces", "dissipation")) else ():
                own_velocities = sorted(a.free_symbols & {*self.velocities}, key=str)
                slopes = [(w, sp.diff(a.args[0], w)) for w in own_velocities]
                solved = [(w, w - a.args[0] / slope) for w, slope in slopes if slope != 0 and not slope.has(w)]
                size = sp.Dummy()
                # Its factor at the velocity where it jumps: v² sign(v) does not jump.
                factor = sp.diff(x.xreplace({a: size}), size).subs(size, at_zero).subs(solved[:1])
                if own_velocities and not is_zero(factor):
                    out.append(f"{name} by {a}")
        return tuple(out)

    # Variants

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), **self._arguments()), ()

    def _arguments(self) -> dict[str, Any]:
        energies = ("T", "V", "coordinates", "velocities", "dissipation", "name")
        names = (*energies, *ROWS)
        forces = {q: self.inputs.get(q, x) for q, x in zip(self.coordinates, self.forces, strict=True)}
        others = {"time": self.clock, "forces": forces, "parameters": dict(self.parameters)}
        return {n: getattr(self, n) for n in names} | others

    def substituted(self, values: Mapping[sp.Symbol, Any]) -> Self:
        """Return the same system with numbers for some parameters, and expressions for functions such as J(theta)."""
        own = {s.name: s for s in self.parameters}
        functions = sorted({f for x in _parts(self).values() for f in x.atoms(AppliedUndef)}, key=str)
        numbers, known = {}, {s.name: s for s in symbols_of(self)}
        definitions: dict[Any, sp.Lambda] = {}
        for key, x in values.items():
            name, value = name_of(key), by_name(expression(f"values[{key}]", x, known), known)
            forms = [f for f in functions if f.func.__name__ == name]
            if name in own and not isinstance(key, (AppliedUndef, UndefinedFunction)):
                numbers[own[name]] = value
            elif forms:
                definitions[forms[0].func] = _as_function(key, forms, value, known)
            else:
                parameters = plain(self.parameters) or "none"
                raise InputError(f"values: {key} is no parameter or function; the parameters are {parameters}")

        def replaced(x: Any) -> Any:
            # The derivatives of a function that is now known are known too.
            x = x.subs([*definitions.items()]).subs(numbers).doit()
            return by_name(x, {s.name: s for s in (*self.coordinates, *self.parameters)})

        out = self._arguments()
        out |= {name: replaced(out[name]) for name in ("T", "V", "dissipation")}
        out["forces"] = {q: x if q in self.inputs else replaced(x) for q, x in out["forces"].items()}
        out |= {name: [replaced(c) for c in out[name]] for name in ROWS}
        out["parameters"] = {s: x for s, x in self.parameters.items() if s not in numbers}
        return self._like(out)

    def _like(self, arguments: dict[str, Any]) -> Self:
        return type(self)(**arguments)

    def conservative(self) -> Self:
        """Return the same system without dissipation and forces; inputs stay."""
        return self._like({**self._arguments(), "dissipation": 0, "forces": dict(self.inputs)})


def _as_function(key: Any, forms: list[Any], value: sp.Expr, known: Mapping[str, sp.Symbol]) -> sp.Lambda:
    """Return the function whose value at the key's arguments, or at its only ones, is given."""
    if not isinstance(key, AppliedUndef) and len(forms) > 1:
        raise InputError(f"values: {key} stands as {', '.join(map(str, forms))}; give one of them with its value")
    arguments = key.args if isinstance(key, AppliedUndef) else forms[0].args
    own = {x: sp.Symbol(name_of(x)) for x in arguments if isinstance(x, AppliedUndef)}
    names = [by_name(own.get(x, x), known) for x in arguments]
    if not all(isinstance(x, sp.Symbol) for x in names) or len({*names}) < len(names) or isinstance(value, sp.Lambda):
        raise InputError(
            f"values: expected {forms[0].func.__name__} of a symbol with an expression in it, such as "
            f"{forms[0].func.__name__}(x): x**2, got {key}: {value}"
        )
    if any(len(f.args) != len(names) for f in forms):
        raise InputError(f"values: {key} has {len(names)} arguments, but {', '.join(map(str, forms))} stands here")
    return sp.Lambda(tuple(names), value.subs(own))


def vanish(parts: Iterable[sp.Expr]) -> bool:
    """Return whether all expressions are zero; decimals that cancel do so in their own digits only."""
    return all(is_zero(x) or (x.has(sp.Float) and tidy(x) == 0) for x in parts)


def acting_forces(form: EnergyForm) -> list[sp.Expr]:
    """Return the generalized forces beside V's: forces, inputs, dissipation and stops with their λ, one a velocity."""
    pairs = zip(form.stops, form.stop_multipliers, strict=True)
    pushed = sp.Matrix(gradient(sum((g * x for g, x in pairs), sp.Integer(0)), form.coordinates))
    pushed = pushed if form.quasi is None else form.quasi.D.T * pushed
    # Not from the equations of motion, whose Christoffel symbols are long.
    named = zip(form.coordinates, gradient(form.dissipation, form.velocities), form.forces + pushed, strict=True)
    return [tidy(x + form.inputs.get(q, sp.Integer(0)) - loss) for q, loss, x in named]


def timed_parameters(form: EnergyForm) -> tuple[sp.Symbol, ...]:
    """Return the time, where it enters, and the parameters."""
    return (*(() if form.time is None else (form.time,)), *form.parameters)


def parameter_values(form: EnergyForm, values: Mapping[str, float], what: str) -> Array:
    """Return the numbers of the parameters in their order, with some replaced; refuse one without a value."""
    numbers = {s.name: x for s, x in form.parameters.items()}
    require_known("parameter", numbers, *values)
    numbers |= {n: real(f"parameter {n!r}", x) for n, x in values.items()}
    require_values(numbers, what)
    return np.array(list(numbers.values()), dtype=np.float64)


def require_values(numbers: Mapping[str, float | None], what: str) -> None:
    """Refuse parameters without a value, by name."""
    missing = [n for n, x in numbers.items() if x is None]
    if missing:
        example = ", ".join(f"{n}=..." for n in missing)
        raise InputError(f"{what}: no value for parameter {', '.join(map(repr, missing))}; give it as {example}")


def symbols_of(form: EnergyForm) -> list[sp.Symbol]:
    """Return parameters, inputs, time, velocities and coordinates."""
    time = [] if form.time is None else [form.time]
    return [*form.parameters, *form.inputs.values(), *time, *form.velocities, *form.coordinates]


def read_expression(
    form: EnergyForm, what: str, source: Any, also: Iterable[sp.Symbol] = (), *, others: bool = False
) -> sp.Expr:
    """Return an expression in a system's own symbols, from symbols of the same names or dynamicsymbols.

    Symbols that are neither the system's nor in `also` are refused, unless `others` are allowed.
    """
    own = [*symbols_of(form), *also]
    known = {s.name: s for s in own}
    rates = {q.name: v for q, v in zip(form.coordinates, form.velocities, strict=True)}
    out = expression(what, source, known)
    for d in out.atoms(sp.Derivative):
        name = name_of(d.expr)
        if name in rates and d.derivative_count == 1:
            out = out.subs(d, rates[name])
    out = out.subs({f: known[name_of(f)] for f in out.atoms(AppliedUndef) if name_of(f) in rates})
    out = by_name(out, known)
    unknown = [str(x) for x in (*undefined(out, own), *(out.free_symbols - set(own)))]
    if unknown and not others:
        raise InputError(f"{what}: {', '.join(sorted(unknown))} is no symbol of {form.name}: {', '.join(known)}")
    return out


# Arguments


def _parameters(source: Any) -> Mapping[sp.Symbol, float | None]:
    if isinstance(source, Mapping):
        pairs: Iterable[tuple[Any, Any]] = source.items()
    else:
        none = source is None or (not isinstance(source, sp.Basic) and not source)
        pairs = [] if none else ((s, None) for s in listed("parameters", source))
    out: dict[sp.Symbol, float | None] = {}
    for symbol, value in pairs:
        if not isinstance(symbol, sp.Symbol):
            raise InputError(f"parameters: expected SymPy symbols, got {symbol!r}")
        if any(s.name == symbol.name for s in out):
            raise InputError(f"parameters: {symbol.name!r} stands twice; a name stands for one number")
        out[symbol] = None if value is None else real(f"parameter {symbol}", value)
    return MappingProxyType(out)


def _forces(into: PlainSymbols, source: Any) -> dict[sp.Symbol, sp.Expr]:
    if not isinstance(source, Mapping):
        raise InputError(f"forces: expected {{coordinate: force}}, got {source!r}")
    out: dict[sp.Symbol, sp.Expr] = dict.fromkeys(into.coordinates, sp.Integer(0))
    named = set()
    for key, value in source.items():
        coordinate = into("forces", key)
        if coordinate not in out:
            names = ", ".join(map(str, into.coordinates))
            raise InputError(f"forces: {key} is no coordinate; the coordinates are {names}")
        if coordinate in named:
            raise InputError(f"forces: {coordinate} stands twice; add the forces along it")
        named.add(coordinate)
        out[coordinate] = into(f"forces[{key}]", value)
    return out


def _without_rates(T: sp.Expr, V: sp.Expr, velocities: Sequence[sp.Symbol]) -> tuple[sp.Expr, sp.Expr]:
    """Return T and V with terms of V that are linear in the velocities as terms of T: L = T - V stays."""
    slopes = [sp.diff(V, w) for w in velocities]
    if not any(slopes):
        return T, V
    if not vanish(sp.diff(a, w) for a in slopes for w in velocities):
        raise InputError(
            f"V: expected at most the first degree in the velocities, as of a magnetic field, got {V}; other forces "
            "belong in forces or dissipation"
        )
    linear = sp.Add(*(a * w for a, w in zip(slopes, velocities, strict=True)))
    return T - linear, V.subs(dict.fromkeys(velocities, 0))


def _rows(into: PlainSymbols, what: str, source: Any) -> tuple[sp.Expr, ...]:
    if isinstance(source, (sp.Basic, str)) and not isinstance(source, sp.Tuple):
        source = [source]
    if isinstance(source, (Mapping, set, frozenset)) or not isinstance(source, Iterable):
        raise InputError(f"{what}: expected a list of expressions, got {source!r}")
    # An equation stands for its left side less its right side, an inequality for the greater one less the other.
    kind, *ends = ((sp.Ge, sp.Le), "gts", "lts") if what == "stops" else (sp.Equality, "lhs", "rhs")
    sides = [[getattr(c, x) for x in ends] if isinstance(c, kind) else (c, 0) for c in source]
    return tuple(into(f"{what}[{k}]", a) - into(f"{what}[{k}]", b) for k, (a, b) in enumerate(sides))


def _stops(into: PlainSymbols, source: Any, restitution: Any, values: Any) -> tuple[tuple[sp.Expr, ...], ...]:
    """Return g and e of each stop; `values` are those of parameters."""
    gaps = list[Any]()
    for key, bounds in source.items() if isinstance(source, Mapping) else ():
        q, pair = into("stops", key), [*bounds] if isinstance(bounds, (tuple, list, sp.Tuple)) else []
        if q not in into.coordinates:
            names = ", ".join(map(str, into.coordinates))
            raise InputError(f"stops: {key} is no coordinate; the coordinates are {names}, and stops=[g] takes g >= 0")
        if len(pair) != 2 or pair.count(None) == 2:
            raise InputError(f"stops[{key}]: expected (lower, upper), one of which may be None, got {bounds!r}")
        both = [sign * (q - into(f"stops[{key}]", x)) for sign, x in zip((1, -1), pair, strict=True) if x is not None]
        if len(both) == 2 and (both[0] + both[1]).subs(values).is_nonpositive:
            raise InputError(f"stops[{key}]: expected lower < upper, got {bounds!r}; exchange them")
        gaps += both
    gaps = [*_rows(into, "stops", gaps if isinstance(source, Mapping) else source)]
    several = isinstance(restitution, (tuple, list, sp.Tuple))
    given = [*restitution] if several else [restitution] * (len(gaps) or restitution != 0)
    if len(given) != len(gaps):
        raise InputError(f"restitution: expected one e, or one for each of {len(gaps)} stops, got {restitution!r}")
    for e in (out := tuple(into("restitution", x) for x in given)):
        if (at := e.subs(values)).is_number and not 0 <= at <= 1:
            raise InputError(f"restitution: expected a number from 0 to 1, got {at}; 1 loses no energy")
    return tuple(gaps), out


def _inputs(
    acting: Mapping[sp.Symbol, sp.Expr], known: set[sp.Symbol], others: Iterable[sp.Expr]
) -> Mapping[sp.Symbol, sp.Symbol]:
    """Return the symbols that stand alone as a force, and nowhere else."""
    counts = Counter(s for x in (*acting.values(), *others) for s in x.free_symbols)
    alone = {q: x for q, x in acting.items() if isinstance(x, sp.Symbol) and x not in known and counts[x] == 1}
    return MappingProxyType(alone)


def _parts(d: EnergyForm) -> dict[str, sp.Expr]:
    """Return every expression by its name in messages."""
    out = {"T": d.T, "V": d.V, "dissipation": d.dissipation}
    out |= {f"forces[{q}]": x for q, x in zip(d.coordinates, d.forces, strict=True)}
    return out | {f"{name}[{k}]": x for name in ROWS for k, x in enumerate(getattr(d, name))}


def _check_names(d: EnergyForm) -> None:
    own = {s.name for s in (*d.coordinates, *d.velocities, *([d.time] if d.time else []))}
    clash = [s for s in d.parameters if s.name in own]
    if clash:
        raise InputError(f"parameters: {plain(clash)} is a coordinate, a velocity or the time already")
    rates = {a.name: v for a, v in zip(d.accelerations, d.velocities, strict=True)}
    for what, symbols in (("parameters", d.parameters), ("forces", d.inputs.values()), ("coordinates", d.coordinates)):
        for s in symbols:
            if s.name in rates:
                raise InputError(f"{what}: {s.name} is what the derivative of {rates[s.name]} is called; rename it")


def _check_declared(d: EnergyForm) -> None:
    known = {*d.coordinates, *d.velocities, *d.parameters, *([d.time] if d.time else [])}
    parts = _parts(d)
    unknown = {s for x in parts.values() for s in x.free_symbols} - known
    if not unknown:
        return
    where = [name for name, x in parts.items() if x.free_symbols & unknown]
    first = min(unknown, key=lambda s: s.name)
    message = f"parameters: {plain(unknown)} stands in {', '.join(where)} and is not declared; "
    message += f"add {first}=... to it as parameters={{{first}: 1.0}}, or with None for no value yet"
    if all(name.startswith("forces") for name in where):
        message += " (an input is a symbol that is all of one force, and stands nowhere else)"
    elif "t" in {s.name for s in unknown} and d.time is None:
        message += " (pass the time as time=t)"
    else:
        message += f" (the velocities are {', '.join(map(str, d.velocities))})"
    raise InputError(message)


def _warn_of_mass_in_time(d: EnergyForm) -> None:
    """Warn of T = ½ m(t) v²: the rocket's equation is another one. A length that is driven leaves terms of ṫ in T."""
    k, t = d.kinetic, d.time
    # Quasi-velocities may move while masses do not.
    if t is None or d.quasi is not None or any(k.b) or k.T0 != 0:
        return
    affected = [w.name for i, w in enumerate(d.velocities) if t in k.M[i, i].free_symbols and d.forces[i] == 0]
    if not affected:
        return
    warn(
        f"T: the mass matrix of {', '.join(affected)} depends on the time {t}, which adds dM/dt v to the equation. "
        "That is right where something drives a length. Where mass leaves or joins with the relative velocity u, the "
        "force dm/dt (v + u) is missing; add it to forces (Meshchersky's equation)",
        MbkitWarning,
    )


def _check_velocities(d: EnergyForm) -> None:
    """Refuse velocities in constraints, and expressions that hold no coordinate or velocity."""
    moving = set(d.velocities)
    unknown = [f for f in d.T.atoms(AppliedUndef) if f.free_symbols & moving]
    if unknown:
        raise InputError(f"T: {unknown[0]} is a function of a velocity; T is of second degree in the velocities")
    for name, x in _parts(d).items():
        rates = x.free_symbols & moving
        if rates and name.startswith(("constraints", "stops")):
            raise InputError(f"{name}: expected coordinates, time and parameters only, got the velocity {plain(rates)}")
        if name.startswith(("constraints", "stops")) and not x.free_symbols & set(d.coordinates):
            raise InputError(f"{name}: {x} holds no coordinate, so that it binds none")
        if name.startswith("restitution") and not x.free_symbols <= {*d.parameters}:
            raise InputError(f"{name}: expected a number or parameters only, got {x}")
    if d.dissipation != 0 and not d.dissipation.free_symbols & moving:
        raise InputError(
            f"dissipation: {d.dissipation} holds none of the velocities {', '.join(map(str, d.velocities))}, and its "
            "force is what it gains by them; a potential energy belongs in V"
        )
    for k, x in enumerate(d.velocity_constraints):
        slopes = [sp.diff(x, w) for w in d.velocities]
        if not any(slopes):
            raise InputError(
                f"velocity_constraints[{k}]: {x} holds none of the velocities {', '.join(map(str, d.velocities))}; "
                "f(q, t) = 0 belongs in constraints"
            )
        if not vanish(sp.diff(slope, w) for slope in slopes for w in d.velocities):
            raise InputError(
                f"velocity_constraints[{k}]: expected a row A(q, t) v + a(q, t) that is linear in the velocities, "
                f"got {x}; mechanics has no reaction force for others that all agree on"
            )
