"""The symbols of mechanics on paper: coordinates, their velocities and accelerations, by name.

Inside, a coordinate is a plain symbol and so is its velocity, so that ∂T/∂v is a plain
derivative. `sympy.physics.mechanics.dynamicsymbols` and their derivatives are replaced
by such symbols when they come in.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from mbkit.errors import InputError

__all__ = ["Plain", "acceleration_of", "expression", "plain", "velocity_of"]


def velocity_of(coordinate: sp.Symbol) -> sp.Symbol:
    """Return the symbol of a coordinate's velocity: theta1 -> thetadot1, which prints as θ̇₁."""
    return _dotted(coordinate, "dot")


def acceleration_of(coordinate: sp.Symbol) -> sp.Symbol:
    """Return the symbol of a coordinate's acceleration: theta1 -> thetaddot1."""
    return _dotted(coordinate, "ddot")


def _dotted(symbol: sp.Symbol, dots: str) -> sp.Symbol:
    # SymPy's printers read the modifier from the name, before its digits and indices.
    stem, rest = re.fullmatch(r"(.*?)(_.*|\d*)", symbol.name, flags=re.S).groups()  # type: ignore[union-attr]
    return sp.Symbol(f"{stem}{dots}{rest}", **symbol.assumptions0) if stem else sp.Symbol(f"{dots}{rest}")


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
    """

    def __init__(self, coordinates: Any, velocities: Any, time: Any, among: Iterable[sp.Symbol] = ()) -> None:
        given = _several("coordinates", coordinates)
        functions = [c for c in given if isinstance(c, AppliedUndef)]
        times = {c.args for c in functions}
        if len(times) > 1 or any(len(c.args) != 1 for c in functions):
            raise InputError(f"coordinates: expected functions of one time, got {functions}")
        own = next(iter(times))[0] if times else None
        if time is not None and not isinstance(time, sp.Symbol):
            raise InputError(f"time: expected a SymPy symbol, got {time!r}")
        if time is not None and own is not None and own != time:
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
        _differ((*self.coordinates, *self.velocities, *([self.time] if self.time else [])))

    def _velocities(self, given: Sequence[Any], velocities: Any, among: Iterable[sp.Symbol]) -> tuple[sp.Symbol, ...]:
        if velocities is None:
            # One of that name that stands there already may have assumptions of its own.
            named = {s.name: s for s in among}
            own = [named.get(velocity_of(c).name, velocity_of(c)) for c in self.coordinates]
        else:
            told = _several("velocities", velocities)
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
        out = expression(what, given)
        # A derivative before the function in it.
        order = sorted(self._map, key=lambda x: not isinstance(x, sp.Derivative))
        out = out.subs([(x, self._map[x]) for x in order])
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


def expression(what: str, given: Any) -> sp.Expr:
    """Return a scalar SymPy expression, or say what came instead."""
    try:
        out = sp.sympify(given)
    except (sp.SympifyError, TypeError) as error:
        raise InputError(f"{what}: expected a SymPy expression, got {given!r}") from error
    if not isinstance(out, sp.Expr) or out.is_Matrix:
        raise InputError(f"{what}: expected a scalar SymPy expression, got {type(given).__name__}")
    if out.has(sp.nan, sp.zoo, sp.oo, -sp.oo):
        raise InputError(f"{what}: {out} is not finite")
    return out


def _several(what: str, given: Any) -> list[Any]:
    if isinstance(given, (sp.Basic, str)) and not isinstance(given, sp.Tuple):
        given = [given]
    try:
        out = list(given)
    except TypeError:
        raise InputError(f"{what}: expected a list of symbols, got {given!r}") from None
    if not out:
        raise InputError(f"{what}: expected at least one symbol, got none")
    return out


def _differ(symbols: Sequence[sp.Symbol]) -> None:
    seen: dict[str, sp.Symbol] = {}
    for s in symbols:
        if s.name in seen:
            raise InputError(f"coordinates: {s.name!r} stands twice among coordinates, velocities and time")
        seen[s.name] = s
