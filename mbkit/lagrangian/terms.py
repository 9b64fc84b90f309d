"""Sums of products of atoms: what their terms share, and whether they are products of sums."""

from __future__ import annotations

from fractions import Fraction
from math import gcd, lcm, prod
from random import Random
from typing import Final

import sympy as sp

__all__ = ["Poly", "content", "paired", "product"]

#: Possible terms up to which a product of sums is looked for, and places at which it is ruled out first.
_DENSE: Final = 50_000
_PROBES: Final = 4

#: A product of powers of atoms -> its coefficient.
Poly = dict[tuple[tuple[sp.Expr, int], ...], Fraction]


def product(poly: Poly, x: sp.Expr) -> list[sp.Expr]:
    """Return a sum as a product of sums, if it is one; its atoms are as good as symbols."""
    highest: dict[sp.Expr, int] = {}
    for a, e in (pair for atoms in poly for pair in atoms):
        highest[a] = max(highest.get(a, 0), e)
    # SymPy's polynomials are as large as all powers together.
    large = prod(e + 1 for e in highest.values()) > _DENSE
    # The factors of a sum with decimals would have others.
    if large or x.has(sp.Float) or any(e < 0 for atoms in poly for _, e in atoms) or _irreducible(poly):
        return []
    symbols = {a: sp.Dummy(f"x{i}") for i, a in enumerate(dict.fromkeys(a for atoms in poly for a, _ in atoms))}
    named = sp.Add(
        *(
            sp.Rational(v.numerator, v.denominator) * sp.Mul(*(symbols[a] ** e for a, e in atoms))
            for atoms, v in poly.items()
        )
    )
    found = sp.factor(named)
    return [] if found.is_Add else [found.xreplace({symbol: a for a, symbol in symbols.items()})]


def _irreducible(poly: Poly) -> bool:
    """Return whether a sum is surely no product: what is Q a + R has no factor but those that Q and R share.

    At random whole numbers for the other atoms Q and R share no factor either, most of the time.
    """
    atoms = list(dict.fromkeys(a for powers in poly for a, _ in powers))
    rows = [tuple(dict(powers).get(a, 0) for a in atoms) for powers in poly]
    # Without what all terms share, which is no factor that is looked for.
    least = [min(es) for es in zip(*rows, strict=True)]
    rows = [tuple(e - f for e, f in zip(row, least, strict=True)) for row in rows]
    scale = lcm(*(v.denominator for v in poly.values()))
    numbers = [int(v * scale) for v in poly.values()]
    shared, rng = gcd(*numbers), Random(0)
    for i, highest in enumerate(max(es) for es in zip(*rows, strict=True)):
        for _ in range(_PROBES if highest == 1 else 0):
            at = [rng.randrange(1_000, 1_000_000) for _ in atoms]
            parts = [0, 0]
            for row, x in zip(rows, numbers, strict=True):
                others = (at[j] ** e for j, e in enumerate(row) if j != i)
                parts[row[i]] += x // shared * prod(others)
            if gcd(*parts) == 1:
                return True
    return False


def content(poly: Poly) -> tuple[list[tuple[sp.Expr, int]], Fraction, Poly]:
    """Return the powers and the number that all terms share, and what is left."""
    first, *others = (dict(atoms) for atoms in poly)
    powers = {a: [e, *(o.get(a, 0) for o in others)] for a, e in first.items()}
    # k/r² - p/r³ stays as it is.
    shared = {a: min(es) for a, es in powers.items() if min(es) > 0 or min(es) == max(es)}
    values = list(poly.values())
    scale = min(map(abs, values))
    if any(v.denominator > 1 or abs(v) > 100 for v in (x / scale for x in values)):
        scale = Fraction(gcd(*(v.numerator for v in values)), lcm(*(v.denominator for v in values)))
        # Decimals share many numbers by accident; a common factor of a sum is read where it is a small one.
        if scale.numerator > 100 or scale.denominator > 100:
            scale = Fraction(1)
    # ½ (2 a + b) reads worse than a + ½ b.
    if _numbers(values) <= _numbers([scale, *(x / scale for x in values)]):
        scale = Fraction(1)
    if sum(v > 0 for v in values) == 0:
        scale = -scale
    left = {
        tuple((a, e - shared.get(a, 0)) for a, e in atoms if e != shared.get(a, 0)): v / scale
        for atoms, v in poly.items()
    }
    return list(shared.items()), scale, left


def _numbers(values: list[Fraction]) -> int:
    """Return how many numbers are written, of which fractions count twice."""
    return sum((abs(x) != 1) + (x.denominator != 1) for x in values)


def paired(poly: Poly) -> Poly:
    """Write c - c cos² a as c sin² a, and c - c sin² a as c cos² a."""
    out = dict(poly)
    for atoms, value in poly.items():
        for a, e in atoms:
            if e != 2 or not isinstance(a, (sp.sin, sp.cos)) or atoms not in out:
                continue
            alone = tuple(x for x in atoms if x[0] != a)
            if out.get(alone) == -value:
                other = (sp.cos if isinstance(a, sp.sin) else sp.sin)(*a.args)
                del out[alone], out[atoms]
                powers = dict(alone)
                powers[other] = powers.get(other, 0) + 2
                # There may be such a term already, with its atoms in another order.
                place = next((k for k in out if dict(k) == powers), tuple(powers.items()))
                total = out.pop(place, Fraction(0)) - value
                if total:
                    out[place] = total
    return out
