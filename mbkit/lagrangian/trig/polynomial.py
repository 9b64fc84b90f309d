"""Exact sums of cosines and sines of angles, with polynomials for coefficients.

Products become sums at once (cos a cos b = ½ cos(a - b) + ½ cos(a + b)), so this is a normal form: equal sums have
equal terms, and a planar chain of n links has at most n² terms.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from typing import Any, Final

import sympy as sp

from mbkit.errors import UnsupportedError

#: Products of terms that one system may cost. A robot with six joints costs 10,000, a planar chain of 19 twice that.
MAX_TERM_PRODUCTS: Final = 200_000

#: 0 for a cosine and 1 for a sine, whole multiples of the angles, exponents of the generators.
Key = tuple[int, tuple[int, ...], tuple[int, ...]]


class TrigRing:
    """The angles and generators (parameters, coordinates, other expressions) of a system's terms.

    More than `most` products of terms are refused; `instead` is the advice of that message.
    """

    def __init__(
        self,
        name: str,
        angles: Sequence[sp.Expr],
        generators: Sequence[sp.Expr],
        most: int = MAX_TERM_PRODUCTS,
        instead: str = "shorten it",
    ) -> None:
        self.name, self.angles, self.generators = name, tuple(angles), tuple(generators)
        self.most, self.instead = most, instead
        self._angle = {x: i for i, x in enumerate(self.angles)}
        self._generator = {x: i for i, x in enumerate(self.generators)}
        self.still = (0,) * len(self.angles)
        self.plain = (0,) * len(self.generators)
        self.one: Key = (0, self.still, self.plain)
        self.cost = 0

    def number(self, value: Any) -> TrigPolynomial:
        """Return a constant."""
        x = Fraction(value)
        return TrigPolynomial(self, {self.one: x} if x else {})

    def of(self, expression: Any) -> TrigPolynomial:
        """Return a polynomial of the generators."""
        terms: dict[Key, Fraction] = {}
        for term in sp.Add.make_args(sp.expand(expression)):
            number, rest = term.as_coeff_Mul()
            exponents = list(self.plain)
            if rest in self._generator:
                exponents[self._generator[rest]] = 1
            elif rest != 1:
                for factor in sp.Mul.make_args(rest):
                    base, exponent = (factor, 1) if factor in self._generator else factor.as_base_exp()
                    exponents[self._generator[base]] += int(exponent)
            if number:
                gather(terms, (0, self.still, tuple(exponents)), Fraction(int(number.p), int(number.q)))
        return TrigPolynomial(self, terms)

    def power(self, generator: sp.Expr, exponent: int) -> TrigPolynomial:
        """Return a power of a generator, of either sign."""
        exponents = list(self.plain)
        exponents[self._generator[generator]] = exponent
        return TrigPolynomial(self, {(0, self.still, tuple(exponents)): Fraction(1)})

    def cos(self, angle: Any) -> TrigPolynomial:
        """Return the cosine of a sum of angles."""
        return self._turned(0, angle)

    def sin(self, angle: Any) -> TrigPolynomial:
        """Return the sine of a sum of angles."""
        return self._turned(1, angle)

    def _turned(self, kind: int, angle: Any) -> TrigPolynomial:
        x = angle.expression
        value, rest = (1, x) if x in self._angle else x.as_coeff_Mul()
        return self.turned(kind, {rest: int(value)})

    def turned(self, kind: int, multiples: Mapping[sp.Expr, int]) -> TrigPolynomial:
        """Return the cosine (0) or sine (1) of whole multiples of angles."""
        out: dict[Key, Fraction] = {}
        _put(out, kind, tuple(multiples.get(a, 0) for a in self.angles), self.plain, Fraction(1))
        return TrigPolynomial(self, out)

    def spend(self, products: int) -> None:
        """Count products of terms, and refuse too many of them."""
        self.cost += products
        if self.cost > self.most:
            raise UnsupportedError(f"{self.name}: its energies have too many terms to be written out; {self.instead}")


class TrigPolynomial:
    """A sum of cosines and sines with polynomial coefficients; it adds and multiplies, also with numbers."""

    __slots__ = ("space", "terms")

    def __init__(self, space: TrigRing, terms: dict[Key, Fraction]) -> None:
        self.space, self.terms = space, terms

    def _other(self, x: Any) -> TrigPolynomial:
        if isinstance(x, TrigPolynomial):
            return x
        return self.space.number(x)

    def __bool__(self) -> bool:
        return bool(self.terms)

    def __add__(self, x: Any) -> TrigPolynomial:
        other = self._other(x)
        out = dict(self.terms)
        for key, value in other.terms.items():
            gather(out, key, value)
        return TrigPolynomial(self.space, out)

    __radd__ = __add__

    def __neg__(self) -> TrigPolynomial:
        return TrigPolynomial(self.space, {k: -x for k, x in self.terms.items()})

    def __sub__(self, x: Any) -> TrigPolynomial:
        return self + (-self._other(x))

    def __rsub__(self, x: Any) -> TrigPolynomial:
        return self._other(x) + (-self)

    def __mul__(self, x: Any) -> TrigPolynomial:
        other = self._other(x)
        a, b = (self.terms, other.terms) if len(self.terms) < len(other.terms) else (other.terms, self.terms)
        square, still = other is self, self.space.still
        self.space.spend(len(a) * (len(b) + 1) // 2 if square else len(a) * len(b))
        row, doubled = list(b.items()), [(key, 2 * x) for key, x in b.items()] if square else []
        out: dict[Key, Fraction] = {}
        for place, ((s, k, m), x1) in enumerate(a.items()):
            for (t, l, n), x2 in [row[place], *doubled[place + 1 :]] if square else row:
                value = x1 * x2
                powers = tuple(i + j for i, j in zip(m, n, strict=True))
                if k == still:
                    gather(out, (t, l, powers), value)
                elif l == still:
                    gather(out, (s, k, powers), value)
                else:
                    half = value / 2
                    total = tuple(i + j for i, j in zip(k, l, strict=True))
                    gap = tuple(i - j for i, j in zip(k, l, strict=True))
                    _put(out, s ^ t, total, powers, -half if s and t else half)
                    _put(out, s ^ t, gap, powers, -half if t and not s else half)
        return TrigPolynomial(self.space, out)

    __rmul__ = __mul__

    def coefficient(self, i: int) -> TrigPolynomial:
        """Return what stands with the first power of a generator, by its place."""
        parts = ((kind, turns, powers, value) for (kind, turns, powers), value in self.terms.items() if powers[i] == 1)
        terms = {(kind, turns, (*p[:i], 0, *p[i + 1 :])): value for kind, turns, p, value in parts}
        return TrigPolynomial(self.space, terms)

    @property
    def expression(self) -> sp.Expr:
        """The sum of a polynomial that has neither cosine nor sine."""
        terms = self.terms.items()
        return sp.Add(*(sp.Rational(x.numerator, x.denominator) * self.monomial(m) for (_, _, m), x in terms))

    def monomial(self, exponents: Iterable[int]) -> sp.Expr:
        """Return a product of powers of the generators."""
        return sp.Mul(*(g**e for g, e in zip(self.space.generators, exponents, strict=True) if e))


def gather(out: dict[Any, Fraction], key: Any, value: Fraction) -> None:
    """Add a term."""
    total = out.get(key)
    if total is None:
        out[key] = value
    elif total + value:
        out[key] = total + value
    else:
        del out[key]


def _put(
    out: dict[Key, Fraction], kind: int, multiples: tuple[int, ...], powers: tuple[int, ...], value: Fraction
) -> None:
    """Add a term, of an angle and its negative only the one whose first multiple is positive."""
    first = next((k for k in multiples if k), 0)
    if not first:
        if kind == 0:
            gather(out, (0, multiples, powers), value)
        return
    if first < 0:
        multiples = tuple(-k for k in multiples)
        value = -value if kind else value
    gather(out, (kind, multiples, powers), value)


# Exact division of sums of cosines and sines.
#
# With z = exp(i θ) a cosine is (z + 1/z)/2 and a sine (z - 1/z)/(2 i), so a sum is a polynomial in the z's and the
# generators with exponents of either sign. Such polynomials factor in one way only: whether one divides another is
# computed term by term, modulo sin² + cos² = 1 and without a search.

#: Terms of a sum or a quotient that can still be read.
MAX_READABLE_TERMS: Final = 400

#: Exponents of the z's and the generators -> a complex number of fractions.
_Exponential = dict[tuple[int, ...], Any]


def quotient(above: TrigPolynomial, below: TrigPolynomial) -> TrigPolynomial | None:
    """Return above / below where that is such a sum again; None where it is not."""
    if not above.terms or not below.terms:
        return None
    a, b = _exponential(above), _exponential(below)
    # The least and the largest exponents of each variable add in a product.
    spans = list(zip(zip(*a, strict=True), zip(*b, strict=True), strict=True))
    low, high = [min(x) - min(y) for x, y in spans], [max(x) - max(y) for x, y in spans]
    lead = max(b)
    out: _Exponential = {}
    while a:
        first = max(a)
        step = tuple(p - q for p, q in zip(first, lead, strict=True))
        if any(not i <= e <= j for i, e, j in zip(low, step, high, strict=True)) or len(out) == MAX_READABLE_TERMS:
            return None
        out[step] = factor = a[first] / b[lead]
        for exponents, value in b.items():
            place = tuple(p + q for p, q in zip(exponents, step, strict=True))
            left = a.pop(place, sp.QQ_I.zero) - factor * value
            if left:
                a[place] = left
    return _sum(above, out)


def _exponential(x: TrigPolynomial) -> _Exponential:
    out: _Exponential = {}
    for (kind, turns, powers), value in x.terms.items():
        number = sp.QQ_I(sp.QQ(value.numerator, value.denominator), 0)
        if any(turns):
            half = number / sp.QQ_I(0, 2) if kind else number / sp.QQ_I(2, 0)
            back = tuple(-k for k in turns)
            for exponents, part in (((*turns, *powers), half), ((*back, *powers), -half if kind else half)):
                out[exponents] = out.get(exponents, sp.QQ_I.zero) + part
        else:
            out[(*turns, *powers)] = number
    return out


def _sum(like: TrigPolynomial, x: _Exponential) -> TrigPolynomial:
    n, terms = len(like.space.angles), {}
    for exponents, value in x.items():
        turns, powers = exponents[:n], exponents[n:]
        real, imaginary = (Fraction(int(y.numerator), int(y.denominator)) for y in (value.x, value.y))
        first = next((k for k in turns if k), 0)
        if not first:
            terms[0, turns, powers] = real
        elif first > 0:
            terms |= {(kind, turns, powers): part for kind, part in ((0, 2 * real), (1, -2 * imaginary)) if part}
    return TrigPolynomial(like.space, terms)
