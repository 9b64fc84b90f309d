"""The derivatives of fields w(x, t) as plain symbols: w_xxt stands for ∂³w/∂x²∂t."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from mbkit.errors import InputError
from mbkit.lagrangian.energies.symbols import PlainSymbols, acceleration_of, expression, listed, plain, velocity_of

#: Derivatives along x and by t.
Order = tuple[int, int]


class Jets:
    """Symbols of the fields' derivatives, and total derivatives of expressions of them.

    A boundary's motion may enter too: `coordinates` with their rates, as of `Lagrangian`.
    """

    def __init__(self, fields: Any, coordinates: Sequence[Any] = (), velocities: Sequence[Any] | None = None) -> None:
        self.fields = tuple(listed("fields", fields))
        places = {f.args for f in self.fields if isinstance(f, AppliedUndef)}
        if len(places) != 1 or not all(isinstance(f, AppliedUndef) and len(f.args) == 2 for f in self.fields):
            raise InputError(
                f"fields: expected functions of one place and the time, such as w(x, t), got {self.fields}"
            )
        if len({f.func.__name__ for f in self.fields}) < len(self.fields):
            raise InputError(f"fields: expected different functions, got {self.fields}")
        self.x, self.t = next(iter(places))
        if not (isinstance(self.x, sp.Symbol) and isinstance(self.t, sp.Symbol)):
            raise InputError(f"fields: expected functions of two symbols, got {self.fields[0]}")
        self._into = PlainSymbols(coordinates, velocities, self.t) if len(coordinates) else None
        self.coordinates = self._into.coordinates if self._into else ()
        self.velocities = self._into.velocities if self._into else ()
        self.accelerations = tuple(
            acceleration_of(q) if w.name == velocity_of(q).name else velocity_of(w)
            for q, w in zip(self.coordinates, self.velocities, strict=True)
        )
        self._known: dict[sp.Symbol, tuple[int, Order]] = {}

    def symbol(self, field: int, order: Order) -> sp.Symbol:
        """Return the symbol of a derivative of a field."""
        name, (along, by_time) = self.fields[field].func.__name__, order
        s = sp.Symbol(f"{name}_{self.x.name * along}{self.t.name * by_time}" if along + by_time else name, real=True)
        self._known[s] = field, order
        return s

    def order(self, s: sp.Symbol) -> tuple[int, Order]:
        """Return the field and the derivatives of a symbol."""
        return self._known[s]

    def among(self, x: Any) -> list[sp.Symbol]:
        """Return the symbols of derivatives in an expression, in order."""
        return sorted(x.free_symbols & self._known.keys(), key=lambda s: (self._known[s], s.name))

    def __call__(self, what: str, source: Any) -> sp.Expr:
        """Return an expression with derivatives as symbols.

        Raises
        ------
        InputError
            No expression, or functions of x and t that are no fields.
        """
        out = expression(what, source).doit()
        put = {}
        for d in out.atoms(sp.Derivative):
            if d.expr in self.fields:
                counts = dict(d.variable_count)
                put[d] = self.symbol(self.fields.index(d.expr), (counts.pop(self.x, 0), counts.pop(self.t, 0)))
        # A derivative before the function in it.
        out = out.xreplace(put).xreplace({f: self.symbol(k, (0, 0)) for k, f in enumerate(self.fields)})
        if self._into is not None:
            out = self._into(what, out)
        left = [f for f in out.atoms(AppliedUndef) if self.t in f.free_symbols]
        if left:
            names = ", ".join(map(str, self.fields))
            raise InputError(f"{what}: {min(map(str, left))} is no field here; the fields are {names}")
        return out

    def _slope(self, x: sp.Expr, by: sp.Symbol, step: Order) -> sp.Expr:
        out = sp.diff(x, by)
        for s in self.among(x):
            field, order = self._known[s]
            out += sp.diff(x, s) * self.symbol(field, (order[0] + step[0], order[1] + step[1]))
        return out

    def along(self, x: sp.Expr, times: int = 1) -> sp.Expr:
        """Return dx/dx of an expression along the continuum, so many times."""
        for _ in range(times):
            x = self._slope(x, self.x, (1, 0))
        return x

    def rate(self, x: sp.Expr, times: int = 1) -> sp.Expr:
        """Return the total derivative by the time, so many times."""
        for _ in range(times):
            moved = self._slope(x, self.t, (0, 1))
            for q, v, a in zip(self.coordinates, self.velocities, self.accelerations, strict=True):
                moved += sp.diff(x, q) * v + sp.diff(x, v) * a
            x = moved
        return x

    def groups(self, shown: Iterable[sp.Expr]) -> list[list[sp.Symbol]]:
        """Return moving symbols by their derivatives by the time, as printers order them."""
        symbols = {s for x in shown for s in self.among(x)}
        own: Mapping[int, tuple[sp.Symbol, ...]] = {0: self.coordinates, 1: self.velocities, 2: self.accelerations}
        most = max([2, *(self._known[s][1][1] for s in symbols)])
        return [
            [*own.get(k, ()), *sorted((s for s in symbols if self._known[s][1][1] == k), key=lambda s: self._known[s])]
            for k in range(most + 1)
        ]

    def check_parameters(self, parts: Mapping[str, sp.Expr]) -> None:
        """Refuse parameters whose names derivatives have."""
        names = {s.name for s in self._known}
        for what, x in parts.items():
            clash = [s for s in x.free_symbols - self._known.keys() if s.name in names]
            if clash:
                raise InputError(f"{what}: {plain(clash)} is how a derivative of a field is written here; rename it")
