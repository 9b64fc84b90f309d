"""Zero tests of expressions by values at random places: with more digits only the value of a zero gets smaller."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

import mpmath
import sympy as sp
from mpmath.libmp import NoConvergence
from numpy.random import default_rng

#: Digits of values, and of the second evaluation of a zero test.
DIGITS: Final = 30
_MORE: Final = 60
#: Remainder of zero at the second evaluation, relative to the first.
_LESS: Final = 1e-15
#: Negligible beside terms of the order of 1.
_NOTHING: Final = 1e-50
#: Places that must agree; more of them where signs decide.
_PLACES: Final = 2
_SIGNED: Final = 8


class RandomEvaluation:
    """Expressions as numbers at random places, of their symbols and of further ones."""

    def __init__(self, expressions: Sequence[sp.Expr], symbols: Iterable[sp.Symbol] = ()) -> None:
        held: set[Any] = set(symbols).union(*(x.free_symbols for x in expressions))
        self.symbols = sorted(held, key=lambda s: (s.name, str(s)))
        dummies = {s: sp.Dummy() for s in self.symbols}
        named = [x.xreplace(dummies) for x in expressions]
        self._call = sp.lambdify([list(dummies.values())], named, modules="mpmath", cse=True)

    def place(self, seed: int) -> dict[sp.Symbol, Any]:
        """Return a random value for each symbol, of size ½ to 3/2; positive ones only where the seed is even."""
        rng = default_rng(seed)
        out = {}
        for s in self.symbols:
            size, sign = rng.uniform(0.5, 1.5), rng.choice([-1.0, 1.0])
            out[s] = mpmath.mpf(size if seed % 2 == 0 or s.is_nonnegative else sign * size)
        return out

    def __call__(self, place: dict[sp.Symbol, Any], digits: int = DIGITS) -> list[Any] | None:
        """Return the values at a place, complex where a root is negative; None where one is not defined."""
        with mpmath.workdps(digits):
            try:
                out = [mpmath.mpmathify(x) for x in self._call([place[s] for s in self.symbols])]
            except (ArithmeticError, ValueError, TypeError, NameError, NoConvergence):
                return None
        return out if all(mpmath.isfinite(x) for x in out) else None


def is_zero(x: sp.Expr) -> bool:
    """Return whether an expression is zero everywhere; a piecewise one only where SymPy knows it."""
    if not x.free_symbols or x.is_zero is not None or x.has(sp.Piecewise, sp.Max, sp.Min):
        return bool(x == 0 or x.is_zero)
    broken = x.has(sp.Abs, sp.sign) or any(not p.exp.is_Integer for p in x.atoms(sp.Pow))
    probe, needed = RandomEvaluation([x]), _SIGNED if broken else _PLACES
    for seed in range(2 * needed):
        place = probe.place(seed)
        rough, fine = (probe(place, digits) for digits in (DIGITS, _MORE))
        if rough is None or fine is None:
            continue
        if abs(fine[0]) > max(_LESS * abs(rough[0]), _NOTHING):
            return False
        needed -= 1
        if not needed:
            return True
    return False
