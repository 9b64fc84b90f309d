"""Plain symbols of coordinates, velocities and accelerations; they replace dynamicsymbols and their derivatives."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef, UndefinedFunction

from mbkit.errors import InputError
from mbkit.lagrangian.printer import apart


def velocity_of(coordinate: sp.Symbol) -> sp.Symbol:
    """Return the symbol of a coordinate's velocity: theta1 -> thetadot1, which prints as θ̇₁."""
    return _dotted(coordinate, "dot")


def acceleration_of(coordinate: sp.Symbol) -> sp.Symbol:
    """Return the symbol of a coordinate's acceleration: theta1 -> thetaddot1."""
    return _dotted(coordinate, "ddot")


def _dotted(symbol: sp.Symbol, dots: str) -> sp.Symbol:
    # SymPy's printers read the modifier from the name, before its digits and indices.
    part, name, number = apart(symbol.name)
    stem, rest = re.fullmatch(r"(.*?)(_.*|\d*)", name, flags=re.S).groups()  # type: ignore[union-attr]
    # A positive coordinate has velocities of any sign.
    return sp.Symbol(f"{part}{stem}{dots}{rest}{number}", **({"real": True} if symbol.is_real else {}))


def free_name(name: str, used: Collection[str]) -> str:
    """Return a name, with a capital or a mark behind it where it is in use: p_x, P_x, P_x_."""
    while name in used:
        name = name[0].upper() + name[1:] if name[0].islower() else f"{name}_"
    return name


def accelerations_of(coordinates: Sequence[sp.Symbol], velocities: Sequence[sp.Symbol]) -> tuple[sp.Symbol, ...]:
    """Return a symbol for each acceleration; a velocity of a name of its own, such as omega, has its derivative."""
    pairs = zip(coordinates, velocities, strict=True)
    return tuple(acceleration_of(q) if w.name == velocity_of(q).name else velocity_of(w) for q, w in pairs)


class PlainSymbols:
    """The plain symbols of coordinates, velocities and time, and their dynamicsymbols.

    Velocities by default may be in `among` already. A name stands for one thing: `Symbol("m", positive=True)`
    is the parameter `Symbol("m")` of `named`, as engines know parameters by their names.
    """

    def __init__(
        self,
        coordinates: Any,
        velocities: Any,
        time: Any,
        among: Iterable[sp.Symbol] = (),
        named: Iterable[sp.Symbol] = (),
    ) -> None:
        originals = listed("coordinates", coordinates)
        functions = [c for c in originals if isinstance(c, AppliedUndef)]
        times = {c.args for c in functions}
        if len(times) > 1 or any(len(c.args) != 1 for c in functions):
            raise InputError(f"coordinates: expected functions of one time, got {functions}")
        own = next(iter(times))[0] if times else None
        if time is not None and not isinstance(time, sp.Symbol):
            raise InputError(f"time: expected a SymPy symbol, got {time!r}")
        if time is not None and own is not None and own.name != time.name:
            raise InputError(f"time: expected {own}, of which the coordinates are functions, got {time}")
        self.time = time if own is None else own
        for c in originals:
            if not isinstance(c, (AppliedUndef, sp.Symbol)):
                raise InputError(f"coordinates: expected SymPy symbols or dynamicsymbols, got {c!r}")
        self._map: dict[Any, sp.Symbol] = {c: sp.Symbol(c.func.__name__) for c in functions}
        self.coordinates = tuple(self._map.get(c, c) for c in originals)
        self.velocities = self._velocities(originals, velocities, among)
        own_time = [self.time] if self.time else []
        _differ((*self.coordinates, *self.velocities, *own_time))
        for what, symbols in (("coordinates", self.coordinates), ("velocities", self.velocities), ("time", own_time)):
            for s in symbols:
                fits(what, s)
        self._named = {s.name: s for s in (*named, *own_time, *self.velocities, *self.coordinates)}

    def _velocities(
        self, originals: Sequence[Any], velocities: Any, among: Iterable[sp.Symbol]
    ) -> tuple[sp.Symbol, ...]:
        if velocities is None:
            # A symbol of that name in T may have assumptions of its own.
            named = {s.name: s for s in among}
            own = [named.get(velocity_of(c).name, velocity_of(c)) for c in self.coordinates]
        else:
            rates = listed("velocities", velocities)
            if len(rates) != len(originals):
                what = f"{len(rates)} velocities for {len(originals)} coordinates"
                raise InputError(f"velocities: {what}; give each coordinate one, in the same order")
            own = []
            for c, w in zip(originals, rates, strict=True):
                if isinstance(w, sp.Symbol):
                    own.append(w)
                elif isinstance(w, AppliedUndef):
                    own.append(sp.Symbol(w.func.__name__))
                    self._map[w] = own[-1]
                elif isinstance(w, sp.Derivative) and w == sp.Derivative(c, self.time):
                    own.append(velocity_of(self._map[c]))
                else:
                    raise InputError(f"velocities: expected a symbol, or the derivative of {c}, got {w!r}")
        for c, symbol in zip(originals, own, strict=True):
            if isinstance(c, AppliedUndef):
                self._map[sp.Derivative(c, self.time)] = symbol
        return tuple(own)

    def __call__(self, what: str, value: Any) -> sp.Expr:
        """Return an expression in plain symbols."""
        out = expression(what, value, self._named)
        # A derivative before the function in it.
        order = sorted(self._map, key=lambda x: not isinstance(x, sp.Derivative))
        out = by_name(out.subs([(x, self._map[x]) for x in order]), self._named)
        left = undefined(out, [*self._named.values()])
        if left:
            raise InputError(
                f"{what}: {left[0]} is no coordinate or velocity here; the coordinates are "
                f"{', '.join(map(str, self.coordinates))}"
            )
        return out


def undefined(x: sp.Expr, known: Iterable[sp.Symbol]) -> list[sp.Expr]:
    """Return derivatives and undefined functions in an expression but those of known symbols, such as J(theta)."""
    # J′(2 θ) is a derivative by a symbol of its own, taken at 2 θ.
    symbols = {*known, *(v for substitution in x.atoms(sp.Subs) for v in substitution.variables)}
    functions = [*x.atoms(sp.Derivative), *x.atoms(AppliedUndef)]
    of_symbols = [d for d in functions if isinstance(d, sp.Derivative) and not d.expr.has(AppliedUndef)]
    return [f for f in functions if f in of_symbols or not (f.free_symbols and f.free_symbols <= symbols)]


def plain(names: Iterable[sp.Symbol]) -> str:
    """Return names as a list to read."""
    return ", ".join(sorted(s.name for s in names))


def name_of(value: Any) -> str:
    """Return the name of a coordinate or function: of a symbol, a dynamicsymbol, or the name itself."""
    if isinstance(value, UndefinedFunction):
        return str(value.__name__)
    return (
        value if isinstance(value, str) else str(getattr(value, "func", value) if getattr(value, "args", ()) else value)
    )


def by_name(x: Any, named: Mapping[str, sp.Symbol]) -> Any:
    """Return an expression or a matrix with the symbols that are known by these names."""
    put = {}
    for s in x.free_symbols:
        known = named.get(s.name) if isinstance(s, sp.Symbol) and not isinstance(s, sp.Dummy) else None
        if known is not None and known != s:
            put[s] = known
    return x.xreplace(put) if put else x


def expression(what: str, value: Any, named: Mapping[str, sp.Symbol] = MappingProxyType({})) -> sp.Expr:
    """Return a scalar SymPy expression; text is read with the symbols of these names."""
    try:
        out = sp.sympify(value, locals=dict(named))
    except (sp.SympifyError, TypeError, AttributeError) as error:
        raise InputError(f"{what}: expected a SymPy expression, got {value!r}") from error
    if not isinstance(out, sp.Expr) or out.is_Matrix:
        raise InputError(f"{what}: expected a scalar SymPy expression, got {type(value).__name__}")
    if out.has(sp.nan, sp.zoo, sp.oo, -sp.oo):
        raise InputError(f"{what}: {out} is not finite")
    if out.has(sp.I):
        raise InputError(f"{what}: {out} holds the imaginary unit; a symbol of that name is sympy.Symbol('I')")
    other = [s for s in out.free_symbols if not isinstance(s, sp.Symbol)]
    if other:
        raise InputError(f"{what}: {min(map(str, other))} is no plain symbol; take sympy.Symbol instead")
    return out


def listed(what: str, value: Any) -> list[Any]:
    """Return one or several symbols as a list."""
    if isinstance(value, (sp.Basic, str)) and not isinstance(value, sp.Tuple):
        value = [value]
    try:
        out = list(value)
    except TypeError:
        raise InputError(f"{what}: expected a list of symbols, got {value!r}") from None
    if not out:
        raise InputError(f"{what}: expected at least one symbol, got none")
    if isinstance(value, (set, frozenset)) and len(out) > 1:
        raise InputError(f"{what}: expected a list of symbols, got a set, which has no order")
    return out


def _differ(symbols: Sequence[sp.Symbol]) -> None:
    for name, times in Counter(s.name for s in symbols).items():
        if times > 1:
            raise InputError(f"coordinates: {name!r} stands twice among coordinates, velocities and time")


def fits(what: str, s: sp.Symbol) -> None:
    """Refuse assumptions that a symbol of motion cannot have."""
    if not s.name.strip():
        raise InputError(f"{what}: expected symbols with names, got {s!r}")
    wrong = ["commutative"] if not s.is_commutative else []
    wrong += [word for word in ("integer", "imaginary", "zero") if getattr(s, f"is_{word}")]
    if what == "velocities":
        wrong += [word for word in ("nonnegative", "nonpositive") if getattr(s, f"is_{word}")]
    if wrong:
        assumption = "not commutative" if wrong[0] == "commutative" else wrong[0]
        raise InputError(f"{what}: {s} is assumed to be {assumption}; what moves takes every real value on its way")
