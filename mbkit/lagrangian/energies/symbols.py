"""The symbols of mechanics on paper: coordinates, their velocities and accelerations, by name.

Inside, a coordinate is a plain symbol and so is its velocity, so that ∂T/∂v is a plain
derivative. `sympy.physics.mechanics.dynamicsymbols` and their derivatives are replaced
by such symbols when they come in.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import sympy as sp
from sympy.core.function import AppliedUndef

from mbkit._check import real
from mbkit.errors import InputError

if TYPE_CHECKING:
    from mbkit.lagrangian.system import Lagrangian

__all__ = [
    "Declaration",
    "Plain",
    "acceleration_of",
    "by_name",
    "declared",
    "expression",
    "fits",
    "free_name",
    "in_symbols_of",
    "listed",
    "name_of",
    "plain",
    "velocity_of",
]


def velocity_of(coordinate: sp.Symbol) -> sp.Symbol:
    """Return the symbol of a coordinate's velocity: theta1 -> thetadot1, which prints as θ̇₁."""
    return _dotted(coordinate, "dot")


def acceleration_of(coordinate: sp.Symbol) -> sp.Symbol:
    """Return the symbol of a coordinate's acceleration: theta1 -> thetaddot1."""
    return _dotted(coordinate, "ddot")


def _dotted(symbol: sp.Symbol, dots: str) -> sp.Symbol:
    # SymPy's printers read the modifier from the name, before its digits and indices.
    stem, rest = re.fullmatch(r"(.*?)(_.*|\d*)", symbol.name, flags=re.S).groups()  # type: ignore[union-attr]
    # What is positive changes with a velocity of any sign.
    return sp.Symbol(f"{stem}{dots}{rest}", **({"real": True} if symbol.is_real else {}))


def free_name(name: str, taken: Collection[str]) -> str:
    """Return a name, with a capital or a mark behind it where it is taken: p_x, P_x, P_x_."""
    while name in taken:
        name = name[0].upper() + name[1:] if name[0].islower() else f"{name}_"
    return name


class Plain:
    """What stands for what: dynamic symbols and their derivatives, and plain symbols.

    Attributes
    ----------
    coordinates, velocities : tuple of sympy.Symbol
    time : sympy.Symbol or None

    Parameters
    ----------
    coordinates, velocities, time
        As `Lagrangian` takes them.
    among : iterable of sympy.Symbol
        Where velocities that are not given may stand already, by their names.
    named : iterable of sympy.Symbol
        Others that are known by their names.

    Notes
    -----
    A name stands for one thing, whatever is assumed of it: ``Symbol("m", positive=True)`` in an expression is the
    parameter ``Symbol("m")``, as engines know parameters by their names.
    """

    def __init__(
        self,
        coordinates: Any,
        velocities: Any,
        time: Any,
        among: Iterable[sp.Symbol] = (),
        named: Iterable[sp.Symbol] = (),
    ) -> None:
        given = listed("coordinates", coordinates)
        functions = [c for c in given if isinstance(c, AppliedUndef)]
        times = {c.args for c in functions}
        if len(times) > 1 or any(len(c.args) != 1 for c in functions):
            raise InputError(f"coordinates: expected functions of one time, got {functions}")
        own = next(iter(times))[0] if times else None
        if time is not None and not isinstance(time, sp.Symbol):
            raise InputError(f"time: expected a SymPy symbol, got {time!r}")
        if time is not None and own is not None and own.name != time.name:
            raise InputError(f"time: {time} is given, but the coordinates are functions of {own}")
        self.time = time if own is None else own
        self._map: dict[Any, sp.Symbol] = {}
        made = []
        for c in given:
            if isinstance(c, AppliedUndef):
                self._map[c] = sp.Symbol(c.func.__name__)
                made.append(self._map[c])
            elif isinstance(c, sp.Symbol):
                made.append(c)
            else:
                raise InputError(f"coordinates: expected SymPy symbols or dynamicsymbols, got {c!r}")
        self.coordinates = tuple(made)
        self.velocities = self._velocities(given, velocities, among)
        own_time = [self.time] if self.time else []
        _differ((*self.coordinates, *self.velocities, *own_time))
        for what, symbols in (("coordinates", self.coordinates), ("velocities", self.velocities), ("time", own_time)):
            for s in symbols:
                fits(what, s)
        self._named = {s.name: s for s in (*named, *own_time, *self.velocities, *self.coordinates)}

    def _velocities(self, given: Sequence[Any], velocities: Any, among: Iterable[sp.Symbol]) -> tuple[sp.Symbol, ...]:
        if velocities is None:
            # One of that name that stands there already may have assumptions of its own.
            named = {s.name: s for s in among}
            own = [named.get(velocity_of(c).name, velocity_of(c)) for c in self.coordinates]
        else:
            told = listed("velocities", velocities)
            if len(told) != len(given):
                what = f"{len(told)} velocities for {len(given)} coordinates"
                raise InputError(f"velocities: {what}; give each coordinate one, in the same order")
            own = []
            for c, w in zip(given, told, strict=True):
                if isinstance(w, sp.Symbol):
                    own.append(w)
                elif isinstance(w, AppliedUndef):
                    own.append(sp.Symbol(w.func.__name__))
                    self._map[w] = own[-1]
                elif isinstance(w, sp.Derivative) and w == sp.Derivative(c, self.time):
                    own.append(velocity_of(self._map[c]))
                else:
                    raise InputError(f"velocities: expected a symbol, or the derivative of {c}, got {w!r}")
        for c, symbol in zip(given, own, strict=True):
            if isinstance(c, AppliedUndef):
                self._map[sp.Derivative(c, self.time)] = symbol
        return tuple(own)

    def __call__(self, what: str, given: Any) -> sp.Expr:
        """Return an expression in plain symbols."""
        out = expression(what, given, self._named)
        # A derivative before the function in it.
        order = sorted(self._map, key=lambda x: not isinstance(x, sp.Derivative))
        out = by_name(out.subs([(x, self._map[x]) for x in order]), self._named)
        left = [*out.atoms(sp.Derivative), *out.atoms(AppliedUndef)]
        if left:
            raise InputError(
                f"{what}: {left[0]} is no coordinate or velocity here; the coordinates are "
                f"{', '.join(map(str, self.coordinates))}"
            )
        return out


def plain(names: Iterable[sp.Symbol]) -> str:
    """Return names as a list to read."""
    return ", ".join(sorted(s.name for s in names))


def name_of(given: Any) -> str:
    """Return the name of a coordinate given as a symbol, a dynamicsymbol or a name."""
    return (
        given if isinstance(given, str) else str(getattr(given, "func", given) if getattr(given, "args", ()) else given)
    )


def by_name(x: Any, named: Mapping[str, sp.Symbol]) -> Any:
    """Return an expression or a matrix with the symbols that are known by these names."""
    put = {}
    for s in x.free_symbols:
        known = named.get(s.name) if isinstance(s, sp.Symbol) and not isinstance(s, sp.Dummy) else None
        if known is not None and known != s:
            put[s] = known
    return x.xreplace(put) if put else x


def in_symbols_of(
    system: Lagrangian, what: str, given: Any, also: Iterable[sp.Symbol] = (), *, others: bool = False
) -> sp.Expr:
    """Return an expression in a system's own symbols, whatever variants of them or dynamicsymbols it is written in.

    Raises
    ------
    InputError
        It holds others, unless there may be; they are named.
    """
    own = [*system.parameters, *system.inputs.values(), *([system.time] if system.time is not None else [])]
    own += [*system.velocities, *system.coordinates, *also]
    known = {s.name: s for s in own}
    rates = {q.name: v for q, v in zip(system.coordinates, system.velocities, strict=True)}
    out = expression(what, given, known)
    for d in out.atoms(sp.Derivative):
        name = name_of(d.expr)
        if name in rates and d.derivative_count == 1:
            out = out.subs(d, rates[name])
    out = out.subs({f: known[name_of(f)] for f in out.atoms(AppliedUndef) if name_of(f) in rates})
    out = by_name(out, known)
    unknown = [str(x) for x in (*out.atoms(sp.Derivative), *out.atoms(AppliedUndef), *(out.free_symbols - set(own)))]
    if unknown and not others:
        raise InputError(f"{what}: {', '.join(sorted(unknown))} is no symbol of {system.name}: {', '.join(known)}")
    return out


def expression(what: str, given: Any, named: Mapping[str, sp.Symbol] = MappingProxyType({})) -> sp.Expr:
    """Return a scalar SymPy expression, or say what came instead; text is read with the symbols of these names."""
    try:
        out = sp.sympify(given, locals=dict(named))
    except (sp.SympifyError, TypeError, AttributeError) as error:
        raise InputError(f"{what}: expected a SymPy expression, got {given!r}") from error
    if not isinstance(out, sp.Expr) or out.is_Matrix:
        raise InputError(f"{what}: expected a scalar SymPy expression, got {type(given).__name__}")
    if out.has(sp.nan, sp.zoo, sp.oo, -sp.oo):
        raise InputError(f"{what}: {out} is not finite")
    if out.has(sp.I):
        raise InputError(f"{what}: {out} holds the imaginary unit; a symbol of that name is sympy.Symbol('I')")
    other = [s for s in out.free_symbols if not isinstance(s, sp.Symbol)]
    if other:
        raise InputError(f"{what}: {min(map(str, other))} is no plain symbol; take sympy.Symbol instead")
    return out


def listed(what: str, given: Any) -> list[Any]:
    """Return one or several symbols as a list."""
    if isinstance(given, (sp.Basic, str)) and not isinstance(given, sp.Tuple):
        given = [given]
    try:
        out = list(given)
    except TypeError:
        raise InputError(f"{what}: expected a list of symbols, got {given!r}") from None
    if not out:
        raise InputError(f"{what}: expected at least one symbol, got none")
    if isinstance(given, (set, frozenset)) and len(out) > 1:
        raise InputError(f"{what}: expected a list of symbols, got a set, which has no order")
    return out


def _differ(symbols: Sequence[sp.Symbol]) -> None:
    seen: dict[str, sp.Symbol] = {}
    for s in symbols:
        if s.name in seen:
            raise InputError(f"coordinates: {s.name!r} stands twice among coordinates, velocities and time")
        seen[s.name] = s


def fits(what: str, s: sp.Symbol) -> None:
    """Refuse what is assumed of a symbol that moves, where that cannot be."""
    if not s.name.strip():
        raise InputError(f"{what}: expected symbols with names, got {s!r}")
    wrong = ["commutative"] if not s.is_commutative else []
    wrong += [told for told in ("integer", "imaginary", "zero") if getattr(s, f"is_{told}")]
    if what == "velocities":
        wrong += [told for told in ("nonnegative", "nonpositive") if getattr(s, f"is_{told}")]
    if wrong:
        told = "not commutative" if wrong[0] == "commutative" else wrong[0]
        raise InputError(f"{what}: {s} is assumed to be {told}; what moves takes every real value on its way")


# What a `Lagrangian` is written with: read, and refused where it cannot be meant.


@dataclass(frozen=True)
class Declaration:
    """The arguments of `Lagrangian` in plain symbols, with its attributes' meaning.

    Attributes
    ----------
    given : mapping of sympy.Symbol to sympy.Expr
        The force along each coordinate, inputs among them.
    multipliers : tuple of sympy.Symbol
        One for each constraint.
    """

    T: sp.Expr
    V: sp.Expr
    dissipation: sp.Expr
    given: Mapping[sp.Symbol, sp.Expr]
    constraints: tuple[sp.Expr, ...]
    coordinates: tuple[sp.Symbol, ...]
    velocities: tuple[sp.Symbol, ...]
    accelerations: tuple[sp.Symbol, ...]
    multipliers: tuple[sp.Symbol, ...]
    parameters: Mapping[sp.Symbol, float | None]
    time: sp.Symbol | None
    inputs: Mapping[sp.Symbol, sp.Symbol]


def declared(
    T: Any,
    V: Any,
    coordinates: Any,
    velocities: Any,
    time: Any,
    forces: Any,
    dissipation: Any,
    parameters: Any,
    constraints: Any,
) -> Declaration:
    """Return what was given in plain symbols.

    Raises
    ------
    InputError
        See `Lagrangian`.
    """
    known = _parameters(parameters)
    into = Plain(coordinates, velocities, time, among=getattr(T, "free_symbols", ()), named=known)
    T, V, dissipation = into("T", T), into("V", V), into("dissipation", dissipation)
    given = _forces(into, forces or {})
    rows = tuple(_row(into, f"constraints[{k}]", c) for k, c in enumerate(_rows(constraints)))
    # Dynamicsymbols bring a time that need not enter by itself.
    clock = into.time if any(into.time in x.free_symbols for x in (T, V, dissipation, *given.values(), *rows)) else None
    moving = {*into.coordinates, *into.velocities, *([clock] if clock else [])}
    inputs = _inputs(given, moving | set(known), (T, V, dissipation, *rows))
    # A velocity of a name of its own, such as omega, has its derivative named after it.
    accelerations = tuple(
        acceleration_of(q) if w.name == velocity_of(q).name else velocity_of(w)
        for q, w in zip(into.coordinates, into.velocities, strict=True)
    )
    taken = {s.name for s in (*moving, *known, *inputs.values(), *accelerations)}
    out = Declaration(
        T=T,
        V=V,
        dissipation=dissipation,
        given=given,
        constraints=rows,
        coordinates=into.coordinates,
        velocities=into.velocities,
        accelerations=accelerations,
        multipliers=tuple(sp.Symbol(free_name(f"lambda{k + 1}", taken)) for k in range(len(rows))),
        parameters=known,
        time=clock,
        inputs=inputs,
    )
    _check_names(out, into.time)
    _check_declared(out)
    _check_velocities(out)
    return out


def _parameters(given: Any) -> Mapping[sp.Symbol, float | None]:
    if isinstance(given, Mapping):
        pairs: Iterable[tuple[Any, Any]] = given.items()
    else:
        none = given is None or (not isinstance(given, sp.Basic) and not given)
        pairs = [] if none else ((s, None) for s in listed("parameters", given))
    out: dict[sp.Symbol, float | None] = {}
    for symbol, value in pairs:
        if not isinstance(symbol, sp.Symbol):
            raise InputError(f"parameters: expected SymPy symbols, got {symbol!r}")
        if any(s.name == symbol.name for s in out):
            raise InputError(f"parameters: {symbol.name!r} stands twice; a name stands for one number")
        out[symbol] = None if value is None else real(f"parameter {symbol}", value)
    return MappingProxyType(out)


def _forces(into: Plain, given: Any) -> dict[sp.Symbol, sp.Expr]:
    if not isinstance(given, Mapping):
        raise InputError(f"forces: expected {{coordinate: force}}, got {given!r}")
    out: dict[sp.Symbol, sp.Expr] = dict.fromkeys(into.coordinates, sp.Integer(0))
    told = set()
    for key, value in given.items():
        coordinate = into("forces", key)
        if coordinate not in out:
            names = ", ".join(map(str, into.coordinates))
            raise InputError(f"forces: {key} is no coordinate; the coordinates are {names}")
        if coordinate in told:
            raise InputError(f"forces: {coordinate} stands twice; add the forces along it")
        told.add(coordinate)
        out[coordinate] = into(f"forces[{key}]", value)
    return out


def _rows(given: Any) -> Sequence[Any]:
    if isinstance(given, (sp.Basic, str)) and not isinstance(given, sp.Tuple):
        given = [given]
    try:
        return list(given)
    except TypeError:
        raise InputError(f"constraints: expected a list of expressions, got {given!r}") from None


def _row(into: Plain, what: str, given: Any) -> sp.Expr:
    """Return what is zero; of an equation its left side less its right side."""
    if isinstance(given, sp.Equality):
        return into(what, given.lhs) - into(what, given.rhs)
    return into(what, given)


def _inputs(
    given: Mapping[sp.Symbol, sp.Expr], known: set[sp.Symbol], others: Iterable[sp.Expr]
) -> Mapping[sp.Symbol, sp.Symbol]:
    """Return the symbols that stand alone as a force, and nowhere else."""
    counts: dict[Any, int] = {}
    for x in (*given.values(), *others):
        for s in x.free_symbols:
            counts[s] = counts.get(s, 0) + 1
    alone = {q: x for q, x in given.items() if isinstance(x, sp.Symbol) and x not in known and counts[x] == 1}
    return MappingProxyType(alone)


def _parts(d: Declaration) -> dict[str, sp.Expr]:
    """Return every expression by what it is called in a message."""
    out = {"T": d.T, "V": d.V, "dissipation": d.dissipation}
    out |= {f"forces[{q}]": x for q, x in d.given.items() if q not in d.inputs}
    return out | {f"constraints[{k}]": x for k, x in enumerate(d.constraints)}


def _check_names(d: Declaration, time: sp.Symbol | None) -> None:
    own = {s.name for s in (*d.coordinates, *d.velocities, *([time] if d.time else []))}
    clash = [s for s in d.parameters if s.name in own]
    if clash:
        raise InputError(f"parameters: {plain(clash)} is a coordinate, a velocity or the time already")
    rates = {a.name: v for a, v in zip(d.accelerations, d.velocities, strict=True)}
    for what, symbols in (("parameters", d.parameters), ("forces", d.inputs.values()), ("coordinates", d.coordinates)):
        for s in symbols:
            if s.name in rates:
                raise InputError(f"{what}: {s.name} is what the derivative of {rates[s.name]} is called; rename it")


def _check_declared(d: Declaration) -> None:
    known = {*d.coordinates, *d.velocities, *d.parameters, *([d.time] if d.time else [])}
    parts = _parts(d)
    unknown = {s for x in parts.values() for s in x.free_symbols} - known
    if not unknown:
        return
    where = [name for name, x in parts.items() if x.free_symbols & unknown]
    first = min(unknown, key=lambda s: s.name)
    told = f"parameters: {plain(unknown)} stands in {', '.join(where)} and is not declared; "
    told += f"add {first}=... to it as parameters={{{first}: 1.0}}, or with None for no value yet"
    if all(name.startswith("forces") for name in where):
        told += " (an input is a symbol that is all of one force, and stands nowhere else)"
    elif "t" in {s.name for s in unknown} and d.time is None:
        told += " (the time is given as time=t)"
    else:
        told += f" (the velocities are {', '.join(map(str, d.velocities))})"
    raise InputError(told)


def _check_velocities(d: Declaration) -> None:
    """Refuse velocities where there can be none, and what says nothing without one."""
    moving = set(d.velocities)
    for name, x in _parts(d).items():
        held = x.free_symbols & moving
        if held and (name == "V" or name.startswith("constraints")):
            raise InputError(f"{name}: expected coordinates, time and parameters only, got the velocity {plain(held)}")
    if d.dissipation != 0 and not d.dissipation.free_symbols & moving:
        raise InputError(
            f"dissipation: {d.dissipation} holds none of the velocities {', '.join(map(str, d.velocities))}, and its "
            "force is what it gains by them; a potential energy belongs in V"
        )
    for k, x in enumerate(d.constraints):
        if not x.free_symbols & set(d.coordinates):
            raise InputError(f"constraints[{k}]: {x} holds no coordinate, so that it binds none")
