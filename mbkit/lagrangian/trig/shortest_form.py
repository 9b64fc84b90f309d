"""The shortest of several equal forms of an exact sum of cosines and sines.

A form has powers of the cosines and sines of single angles in place of multiples of angles: sin² θ for ½ - ½ cos 2θ.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import combinations
from math import comb, gcd, lcm, prod
from random import Random
from typing import Any, Final

import sympy as sp

from mbkit.lagrangian.trig.polynomial import Key, TrigPolynomial, TrigRing

#: Terms up to which products of cosines and sines are looked for.
_SMALL: Final = 60
#: Forms of fewest terms whose operations are counted.
_TRIED: Final = 4
#: Terms up to which a sum is tried to be a product of sums.
_FACTORED: Final = 10


def complexity(x: sp.Expr) -> int:
    """Return the operations of an expression, more for a sum that begins with a minus or is nested deep."""
    sums = x.atoms(sp.Add)
    minus = sum(bool(e.could_extract_minus_sign()) for e in sums)
    return int(x.count_ops()) + minus + 2 * max(_depth(x) - 2, 0)


def _depth(x: sp.Expr) -> int:
    """Return how many sums stand in one another, outside of cosines and the like."""
    if not (x.is_Add or x.is_Mul or x.is_Pow):
        return 0
    return int(max(map(_depth, x.args))) + bool(x.is_Add)


def number(x: Fraction) -> sp.Expr:
    """Return a fraction such as 1/2 or 1/12, a decimal for 9.81 and longer numbers."""
    # A decimal that ends after few digits reads better as one, unless it is a half, a quarter or an eighth.
    ends = _without(_without(x.denominator, 2), 5) == 1
    if x.denominator in (1, 2, 4, 8) or (x.denominator <= 1000 and not ends):
        return sp.Rational(x.numerator, x.denominator)
    return sp.Float(float(x))


def _without(n: int, p: int) -> int:
    while n % p == 0:
        n //= p
    return n


def shortest_form(x: TrigPolynomial, *, whole: bool = True, decimals: bool = True) -> sp.Expr:
    """Return a sum of cosines and sines as a SymPy expression that is short to read.

    With `whole`, factors that all terms share are factored out; without `decimals`, 9.81 is a fraction.
    """
    if not x:
        return sp.Integer(0)
    forms = [(x.space, power_form(x, (), 0))]
    if len(x.terms) <= _SMALL:
        forms = [(x.space, form) for form in _forms(x)]
        last = len(x.space.angles)
        forms += [(y.space, power_form(y, (last,), kept)) for y in combine_angles(x) for kept in (0, 1)]
    forms.sort(key=lambda pair: len(pair[1]))
    near = [pair for pair in forms[:_TRIED] if len(pair[1]) <= len(forms[0][1]) + 2]
    writer = _Writer(whole, decimals)
    return min((writer.expression(space, form) for space, form in near), key=complexity)


def _forms(x: TrigPolynomial) -> list[Form]:
    """Return a sum with the angles of each subset split off as powers of their own cosine and sine."""
    present = [i for i in range(len(x.space.angles)) if any(key[1][i] for key in x.terms)]
    sizes = range(len(present) + 1 if len(present) <= 4 else 1)
    subsets = [subset for n in sizes for subset in combinations(present, n)]

    def split(x: TrigPolynomial) -> list[Form]:
        # The square that stays, of cosines (0) or sines (1); neither is shorter always.
        return [power_form(x, subset, kept) for subset in subsets for kept in ((0, 1) if subset else (0,))]

    by_monomial: dict[tuple[int, ...], dict[Key, Fraction]] = {}
    for key, value in x.terms.items():
        by_monomial.setdefault(key[2], {})[key] = value
    mixed: Form = {}
    for terms in by_monomial.values():
        shortest: Form = min(split(TrigPolynomial(x.space, terms)), key=len)
        mixed |= shortest
    forms: list[Form] = []
    for form in (*split(x), mixed):
        if form not in forms:
            forms.append(form)
    return forms


class _Writer:
    def __init__(self, whole: bool, decimals: bool) -> None:
        self._whole, self._decimals = whole, decimals
        self._sums: dict[frozenset[Any], sp.Expr] = {}

    def expression(self, space: TrigRing, form: Form) -> sp.Expr:
        poly = paired(dict(_term(space, key, value) for key, value in form.items()))
        by_angle = self._by_angle(poly)
        if not self._whole or len(by_angle) == len(poly):
            candidates = [sp.Add(*map(self._written, by_angle))]
        else:
            shared, scale, left = content(poly)
            inside = sp.Add(*map(self._written, self._by_angle(left)))
            candidates = [sp.Mul(self._number(scale), *(a**e for a, e in shared), inside)]
        if self._whole:
            candidates.append(self._written(poly))
        return min(candidates, key=complexity)

    def _by_angle(self, poly: Poly) -> list[Poly]:
        """Return the terms of each cosine and sine."""
        groups: dict[tuple[tuple[sp.Expr, int], ...], Poly] = {}
        for atoms, value in poly.items():
            turned = tuple(a for a in atoms if isinstance(a[0], (sp.sin, sp.cos)))
            groups.setdefault(turned, {})[atoms] = value
        return list(groups.values())

    def _number(self, x: Fraction) -> sp.Expr:
        return number(x) if self._decimals else sp.Rational(x.numerator, x.denominator)

    def _written(self, poly: Poly) -> sp.Expr:
        """Return a polynomial with the shared factors of its terms in front, most shared first."""
        if len(poly) == 1:
            ((atoms, value),) = poly.items()
            return sp.Mul(self._number(value), *(a**e for a, e in atoms))
        shared, scale, left = content(poly)
        outside = sp.Mul(self._number(scale), *(a**e for a, e in shared))
        inside = self._sum(left)
        if outside.is_Number and isinstance(inside, sp.Add):
            # SymPy multiplies a number into a sum; the terms then hold it.
            return self._sum({atoms: scale * value for atoms, value in left.items()}) if outside != 1 else inside
        return sp.Mul(outside, inside)

    def _sum(self, poly: Poly) -> sp.Expr:
        """Return a sum by the atom that most of its terms have, and what has it not likewise."""
        # The same parts come up in many forms.
        key = frozenset(poly.items())
        if key not in self._sums:
            self._sums[key] = self._summed(poly)
        return self._sums[key]

    def _summed(self, poly: Poly) -> sp.Expr:
        counts: dict[sp.Expr, int] = {}
        for atoms in poly:
            for a, e in atoms:
                counts[a] = counts.get(a, 0) + (e > 0)
        most = max(counts.values(), default=0)
        if len(poly) > _FACTORED:
            return self._by_atom(poly, next(a for a in counts if counts[a] == most)) if most > 1 else self._plain(poly)
        tried = [self._plain(poly)]
        if len(poly) > 2:
            tried += [self._by_atom(poly, a) for a in counts if counts[a] == most > 1]
            tried += product(poly, tried[0])
        # Of equal forms the one that was combined most.
        return min(reversed(tried), key=complexity)

    def _plain(self, poly: Poly) -> sp.Expr:
        return sp.Add(*(self._written({atoms: value}) for atoms, value in poly.items()))

    def _by_atom(self, poly: Poly, atom: sp.Expr) -> sp.Expr:
        with_it = {atoms: value for atoms, value in poly.items() if dict(atoms).get(atom, 0) > 0}
        without = {atoms: value for atoms, value in poly.items() if atoms not in with_it}
        if not without:
            return self._plain(poly)
        return sp.Add(self._written(with_it), self._written(without) if len(without) == 1 else self._sum(without))


def _term(space: TrigRing, key: FormKey, value: Fraction) -> tuple[tuple[tuple[sp.Expr, int], ...], Fraction]:
    done, kind, rest, powers = key
    out = [(g, e) for g, e in zip(space.generators, powers, strict=True) if e]
    for i, c, s in done:
        out += [(f(space.angles[i]), e) for f, e in ((sp.sin, s), (sp.cos, c)) if e]
    if any(rest):
        angle = sp.Add(*(k * a for k, a in zip(rest, space.angles, strict=True) if k))
        turned = sp.sin(angle) if kind else sp.cos(angle)
        if turned.is_Mul:
            # SymPy writes sin(b - a) as -sin(a - b).
            turned, value = -turned, -value
        out.append((turned, 1))
    return tuple(out), value


# Powers of the cosines and sines of single angles

#: Most sums of angles that count as one angle.
_COMBINED: Final = 2

#: Powers (angle, of cos, of sin) of single angles.
_Powers = tuple[tuple[int, int, int], ...]
#: Those, the kind and multiples of the rest, exponents of the generators.
FormKey = tuple[_Powers, int, tuple[int, ...], tuple[int, ...]]
Form = dict[FormKey, Fraction]


def power_form(x: TrigPolynomial, subset: tuple[int, ...], kept: int) -> Form:
    """Return a form: Re or Im of Π (cos a + i sin a)^k (cos rest + i sin rest), power by power."""
    out: Form = {}
    for (kind, multiples, powers), value in x.terms.items():
        rest = tuple(0 if i in subset else k for i, k in enumerate(multiples))
        first = next((k for k in rest if k), 0)
        sign = -1 if first < 0 else 1
        rest = tuple(sign * k for k in rest)
        parts: list[tuple[_Powers, int, int]] = [((), 0, 1)]
        for i in subset:
            if multiples[i]:
                parts = [
                    ((*done, (i, c, s)), turns + (s if multiples[i] > 0 else -s), factor * times)
                    for done, turns, factor in parts
                    for c, s, times in _powers(abs(multiples[i]))
                ]
        for done, turns, factor in parts:
            for part in (0, 1) if first else (0,):
                # A power of i: real for a cosine, imaginary for a sine.
                total = (turns + part) % 4
                if total % 2 == kind:
                    amount = value * factor * (-1 if total >= 2 else 1) * (sign if part else 1)
                    for reduced, weight in _reduced(done, kept):
                        _gather(out, (reduced, part, rest, powers), amount * weight)
    return out


def _powers(k: int) -> list[tuple[int, int, int]]:
    """Return (power of cos, of sin, coefficient) of (cos + i sin)^k, without the powers of i."""
    return [(k - s, s, comb(k, s)) for s in range(k + 1)]


def _reduced(done: _Powers, kept: int) -> Iterator[tuple[_Powers, int]]:
    """Yield a product of powers with the square that is not kept replaced by 1 less the other's."""
    if not done:
        yield (), 1
        return
    (i, c, s), *others = done
    gone, stays = (s, c) if kept == 0 else (c, s)
    for rest, weight in _reduced(tuple(others), kept):
        half = gone // 2
        for n in range(half + 1):
            a, b = stays + 2 * n, gone % 2
            power = (i, a, b) if kept == 0 else (i, b, a)
            yield ((power, *rest) if a or b else rest), weight * comb(half, n) * (-1) ** n


def _gather(out: Form, key: FormKey, value: Fraction) -> None:
    total = out.get(key, Fraction(0)) + value
    if total:
        out[key] = total
    else:
        out.pop(key, None)


def combine_angles(x: TrigPolynomial) -> Iterator[TrigPolynomial]:
    """Yield a sum with one more angle, such as θ₁ - θ₂, where it holds twice that angle."""
    space = x.space
    directions = dict.fromkeys(_direction(key[1]) for key in x.terms if gcd(*key[1]) > 1 and sum(map(bool, key[1])) > 1)
    for direction in list(directions)[:_COMBINED]:
        angle = sp.Add(*(k * a for k, a in zip(direction, space.angles, strict=True)))
        # SymPy writes sin(b - a) as -sin(a - b).
        sign = -1 if sp.sin(angle).is_Mul else 1
        wider = TrigRing(space.name, [*space.angles, sign * angle], space.generators, space.most, space.instead)
        terms = {}
        for (kind, turns, powers), value in x.terms.items():
            along = any(turns) and _direction(turns) == direction
            more = ((0,) * len(turns), gcd(*turns)) if along else (turns, 0)
            # Of a sine the sign of the angle comes before it.
            terms[kind, (*more[0], more[1]), powers] = value * (sign if along and kind else 1)
        yield TrigPolynomial(wider, terms)


def _direction(turns: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(k // gcd(*turns) for k in turns) if any(turns) else turns


# Sums of products of atoms: what their terms share, and whether they are products of sums.

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
    factored = sp.factor(named)
    return [] if factored.is_Add else [factored.xreplace({symbol: a for a, symbol in symbols.items()})]


def _irreducible(poly: Poly) -> bool:
    """Return whether a sum surely has no factors: those of Q a + R are shared by Q and R, tested at random numbers."""
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
    """Return the powers and the number that all terms share, and the rest."""
    first, *others = (dict(atoms) for atoms in poly)
    powers = {a: [e, *(o.get(a, 0) for o in others)] for a, e in first.items()}
    # k/r² - p/r³ stays as it is.
    shared = {a: min(es) for a, es in powers.items() if min(es) > 0 or min(es) == max(es)}
    values = list(poly.values())
    scale = min(map(abs, values))
    if any(v.denominator > 1 or abs(v) > 100 for v in (x / scale for x in values)):
        scale = Fraction(gcd(*(v.numerator for v in values)), lcm(*(v.denominator for v in values)))
        # Decimals share many numbers by accident; a common factor is useful where it is small.
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
