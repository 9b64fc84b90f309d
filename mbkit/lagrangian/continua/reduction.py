"""Energies of a continuum with mode shapes put in: integrals along it, and values at its ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mpmath
import sympy as sp

from mbkit.errors import UnsupportedError
from mbkit.lagrangian.continua.densities import Densities
from mbkit.lagrangian.continua.integrals import INTEGRAL_DIGITS, Integrals, Shape, number, weights_of
from mbkit.lagrangian.energies.symbols import velocity_of

#: Shapes by their number, each with its derivative.
Factors = tuple[tuple[int, int], ...]


class Reduction:
    """Energies per length and of ends, with the modes put in."""

    def __init__(self, system: Densities, modes: Sequence[tuple[Shape, ...]], q: Sequence[sp.Symbol]) -> None:
        self._system, self._q = system, q
        self._shapes = [shape for mode in modes for shape in mode]
        self._integrals = Integrals(self._shapes)
        self._length = system.ends[1] - system.ends[0]

    def _sum(self, what: str, x: sp.Expr, also: Factors, measured: Callable[[sp.Expr, Factors], sp.Expr]) -> sp.Expr:
        """Return a sum over the modes of each product of derivatives in x."""
        jets, n, out = self._system.jets, len(self._system.jets.fields), []
        for product, c in terms(self._system, what, x):
            sums: dict[Factors, sp.Expr] = {also: sp.Integer(1)}
            for s in product:
                field, (along, by_time) = jets.order(s)
                grown: dict[Factors, sp.Expr] = {}
                for factors, amplitude in sums.items():
                    for i, a in enumerate(self._q):
                        if self._shapes[i * n + field].expression != 0:
                            key = tuple(sorted((*factors, (i * n + field, along))))
                            rate = (velocity_of(a) if by_time else a) / self._length**along
                            grown[key] = grown.get(key, sp.Integer(0)) + amplitude * rate
                sums = grown
            out += [measured(c, factors) * amplitude for factors, amplitude in sums.items()]
        return sp.Add(*out)

    def along(self, what: str, x: sp.Expr, also: Factors = ()) -> sp.Expr:
        """Return ∫ x dx, with the shapes `also` as factors."""

        def measured(c: sp.Expr, factors: Factors) -> sp.Expr:
            weights = weights_of(c, self._system.jets.x, self._system.ends, what)
            return self._length * sp.Add(*(k * self._integrals(f, factors) for f, k in weights.items()))

        return self._sum(what, x, also, measured)

    def at_end(self, what: str, end: sp.Expr, x: sp.Expr) -> sp.Expr:
        """Return an energy at an end."""
        place = self._system.ends.index(end)

        def measured(c: sp.Expr, factors: Factors) -> sp.Expr:
            with mpmath.workdps(INTEGRAL_DIGITS):
                value = mpmath.fprod(self._shapes[k].slope(along)(place) for k, along in factors)
            return c.subs(self._system.jets.x, end) * number(value)

        return self._sum(what, x, (), measured)


def terms(system: Densities, what: str, x: sp.Expr) -> list[tuple[tuple[sp.Symbol, ...], sp.Expr]]:
    """Return an expression as products of derivatives, with the coefficient of each.

    Raises
    ------
    UnsupportedError
        Other functions of them.
    """
    moving = system.jets.among(x)
    if not moving:
        return [((), x)] if x != 0 else []
    if not x.is_polynomial(*moving):
        raise UnsupportedError(
            f"{what}: {x} is no polynomial of the fields and their derivatives, and modes cannot be put in; expand it "
            "to the powers that matter"
        )
    monomials = sp.Poly(x, *moving).terms()
    return [(tuple(s for s, k in zip(moving, powers, strict=True) for _ in range(k)), c) for powers, c in monomials]
