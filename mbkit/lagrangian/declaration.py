"""What a `Lagrangian` is written with: read, and refused where it cannot be meant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import sympy as sp

from mbkit._check import real
from mbkit.errors import InputError
from mbkit.lagrangian.symbols import Plain, acceleration_of, free_name, listed, plain, velocity_of

__all__ = ["Declaration", "declared"]


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
