"""Exact sums of cosines and sines as a teacher would write them: the shortest of several equal forms."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations
from typing import Any, Final

import sympy as sp

from mbkit.lagrangian.trig.polynomial import Key, TrigPolynomial
from mbkit.lagrangian.trig.power_forms import Form, FormKey, Poly, combine_angles, content, paired, power_form, product

__all__ = ["complexity", "number", "shortest_form"]

#: Terms up to which products of cosines and sines are looked for.
_SMALL: Final = 60
#: Forms of fewest terms that are made into SymPy's expressions, to count their operations.
_TRIED: Final = 4
#: Terms up to which a sum is tried to be a product of sums.
_FACTORED: Final = 10


def complexity(x: sp.Expr) -> int:
    """Return how long an expression reads: its operations, more for a sum that begins with a minus or stands deep."""
    sums = x.atoms(sp.Add)
    minus = sum(bool(e.could_extract_minus_sign()) for e in sums)
    return int(x.count_ops()) + minus + 2 * max(_depth(x) - 2, 0)


def _depth(x: sp.Expr) -> int:
    """Return how many sums stand in one another, outside of cosines and the like."""
    if not (x.is_Add or x.is_Mul or x.is_Pow):
        return 0
    return int(max(map(_depth, x.args))) + bool(x.is_Add)


def number(x: Fraction) -> sp.Expr:
    """Return a fraction where people write one: 1/2, 1/12; a decimal for 9.81 and what is longer."""
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

    Parameters
    ----------
    x : TrigPolynomial
    whole : bool
        Whether what all terms share is taken out of the sum.
    decimals : bool
        Whether numbers such as 9.81 are decimals; else all are fractions.
    """
    if not x:
        return sp.Integer(0)
    writer = _Writer(x, whole, decimals)
    if len(x.terms) > _SMALL:
        return writer.expression(writer.as_it_is())
    forms = [(writer, form) for form in writer.forms()]
    forms += [(other, form) for other in map(writer.like, combine_angles(x)) for form in other.squares()]
    forms.sort(key=lambda pair: len(pair[1]))
    near = [(w, form) for w, form in forms[:_TRIED] if len(form) <= len(forms[0][1]) + 2]
    candidates = [w.expression(form) for w, form in near]
    return min(candidates, key=lambda e: (complexity(e), candidates.index(e)))


class _Writer:
    def __init__(self, x: TrigPolynomial, whole: bool, decimals: bool) -> None:
        self._x, self._whole, self._decimals = x, whole, decimals
        self._sums: dict[frozenset[Any], sp.Expr] = {}

    def like(self, x: TrigPolynomial) -> _Writer:
        """Return a writer of another sum."""
        return _Writer(x, self._whole, self._decimals)

    def squares(self) -> list[Form]:
        """Return the sum with its last angle split off."""
        last = len(self._x.space.angles) - 1
        return [power_form(self._x, (last,), kept) for kept in (0, 1)]

    def as_it_is(self) -> Form:
        return {((), kind, multiples, powers): value for (kind, multiples, powers), value in self._x.terms.items()}

    def forms(self) -> list[Form]:
        """Return the sum with the angles of each subset split off as powers of their own cosine and sine."""
        x = self._x
        present = [i for i in range(len(x.space.angles)) if any(key[1][i] for key in x.terms)]
        subsets: list[tuple[int, ...]] = [()]
        if len(present) <= 4:
            subsets = [s for n in range(len(present) + 1) for s in combinations(present, n)]
        forms: list[Form] = []
        for subset in subsets:
            # The square that stays, of cosines (0) or sines (1); neither is shorter always.
            for kept in (0, 1) if subset else (0,):
                form = power_form(x, subset, kept)
                if form not in forms:
                    forms.append(form)
        mixed = self._by_monomial(subsets)
        return forms if mixed in forms else [*forms, mixed]

    def _by_monomial(self, subsets: list[tuple[int, ...]]) -> Form:
        """Return the sum with the shortest form of what multiplies each product of generators."""
        groups: dict[tuple[int, ...], dict[Key, Fraction]] = {}
        for key, value in self._x.terms.items():
            groups.setdefault(key[2], {})[key] = value
        out: Form = {}
        for terms in groups.values():
            part = TrigPolynomial(self._x.space, terms)
            tried = [power_form(part, subset, kept) for subset in subsets for kept in ((0, 1) if subset else (0,))]
            best: Form = min(tried, key=len)
            out |= best
        return out

    def expression(self, form: Form) -> sp.Expr:
        poly = paired(dict(self._term(key, value) for key, value in form.items()))
        by_angle = self._by_angle(poly)
        if not self._whole or len(by_angle) == len(poly):
            candidates = [sp.Add(*map(self._written, by_angle))]
        else:
            shared, scale, left = content(poly)
            inside = sp.Add(*map(self._written, self._by_angle(left)))
            candidates = [sp.Mul(self._number(scale), *(a**e for a, e in shared), inside)]
        if self._whole:
            candidates.append(self._written(poly))
        return min(candidates, key=lambda e: (complexity(e), candidates.index(e)))

    def _by_angle(self, poly: Poly) -> list[Poly]:
        """Return the terms of each cosine and sine."""
        groups: dict[tuple[tuple[sp.Expr, int], ...], Poly] = {}
        for atoms, value in poly.items():
            turned = tuple(a for a in atoms if isinstance(a[0], (sp.sin, sp.cos)))
            groups.setdefault(turned, {})[atoms] = value
        return list(groups.values())

    def _term(self, key: FormKey, value: Fraction) -> tuple[tuple[tuple[sp.Expr, int], ...], Fraction]:
        done, kind, rest, powers = key
        space = self._x.space
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

    def _number(self, x: Fraction) -> sp.Expr:
        return number(x) if self._decimals else sp.Rational(x.numerator, x.denominator)

    def _written(self, poly: Poly) -> sp.Expr:
        """Return a polynomial with what its terms share taken out, most shared first."""
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
            return self._taken(poly, next(a for a in counts if counts[a] == most)) if most > 1 else self._plain(poly)
        tried = [self._plain(poly)]
        if len(poly) > 2:
            tried += [self._taken(poly, a) for a in counts if counts[a] == most > 1]
            tried += product(poly, tried[0])
        return min(tried, key=lambda e: (complexity(e), -tried.index(e)))

    def _plain(self, poly: Poly) -> sp.Expr:
        return sp.Add(*(self._written({atoms: value}) for atoms, value in poly.items()))

    def _taken(self, poly: Poly, atom: sp.Expr) -> sp.Expr:
        with_it = {atoms: value for atoms, value in poly.items() if dict(atoms).get(atom, 0) > 0}
        without = {atoms: value for atoms, value in poly.items() if atoms not in with_it}
        if not without:
            return self._plain(poly)
        return sp.Add(self._written(with_it), self._written(without) if len(without) == 1 else self._sum(without))
