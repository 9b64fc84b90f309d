"""The shortest of several equal forms of an exact sum of cosines and sines.

A form has powers of the cosines and sines of single angles in place of multiples of angles: sin² θ for ½ - ½ cos 2θ.

Exact sums of cosines and sines of angles, with polynomials for coefficients.

Products become sums at once (cos a cos b = ½ cos(a - b) + ½ cos(a + b)), so this is a normal form: equal sums have
equal terms, and a planar chain of n links has at most n² terms.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from itertools import combinations
from math import comb, gcd, lcm, prod
from random import Random
from typing import Any, Final

import sympy as sp

from mbkit._check import PROBES
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


#: Terms of a sum that is combined, and angles whose products of cosines and sines are looked for.
MAX_COMBINED_TERMS: Final = 60
_MAX_PRODUCT_ANGLES: Final = 4
#: Terms up to which a sum is tried to be a product of sums.
_MAX_FACTORED_TERMS: Final = 10


def complexity(x: sp.Expr) -> int:
    """Return the operations of an expression, more for a sum that is nested deep."""
    return int(x.count_ops()) + 2 * max(_depth(x) - 2, 0)


def _depth(x: sp.Expr) -> int:
    """Return how many sums stand in one another, outside of cosines and the like."""
    if not (x.is_Add or x.is_Mul or x.is_Pow):
        return 0
    return int(max(map(_depth, x.args))) + bool(x.is_Add)


def number(x: Fraction) -> sp.Expr:
    """Return a fraction such as 1/2 or 1/12, a decimal for 9.81 and longer numbers."""
    # A decimal that ends after few digits reads better as one, unless it is a half, a quarter or an eighth.
    ends = 10**9 % x.denominator == 0
    if x.denominator in (1, 2, 4, 8) or (x.denominator <= 1000 and not ends):
        return sp.Rational(x.numerator, x.denominator)
    return sp.Float(float(x))


def shortest_form(x: TrigPolynomial, *, whole: bool = True, decimals: bool = True) -> sp.Expr:
    """Return a sum of cosines and sines as a SymPy expression that is short to read.

    Without `whole`, the terms of each cosine and sine stand by themselves; without `decimals`, 9.81 is a fraction.
    """
    if not x:
        return sp.Integer(0)
    by_monomial: dict[tuple[int, ...], dict[Key, Fraction]] = {}
    for key, value in x.terms.items():
        by_monomial.setdefault(key[2], {})[key] = value
    parts = [TrigPolynomial(x.space, terms) for terms in by_monomial.values()]
    forms = [_joined(map(_fewest_terms, parts))]
    if whole and len(parts) > 1 and (angles := _split_off(x)):
        # A factor such as sin θ shows in all parts only where sin 2θ is written by it.
        forms += [_joined(power_form(part, tuple(angles), square) for part in parts) for square in (0, 1)]
    write = _Writer(x.space, whole, decimals).expression
    return min((write(form) for form in forms), key=complexity)


def _joined(forms: Iterable[Form]) -> Form:
    return {key: value for form in forms for key, value in form.items()}


def _split_off(x: TrigPolynomial) -> list[int]:
    """Return the angles that powers are tried of; none of a large sum."""
    angles = [i for i in range(len(x.space.angles)) if any(key[1][i] for key in x.terms)]
    return angles if len(angles) <= _MAX_PRODUCT_ANGLES and len(x.terms) <= MAX_COMBINED_TERMS else []


def _fewest_terms(x: TrigPolynomial) -> Form:
    """Return the shortest form with the angles of one subset split off as powers of their own cosines and sines."""
    angles = _split_off(x)
    subsets = (subset for n in range(len(angles) + 1) for subset in combinations(angles, n))
    # The square that stays, of cosines (0) or sines (1); neither is shorter always.
    return min((power_form(x, subset, square) for subset in subsets for square in (0, 1)), key=len)


class _Writer:
    def __init__(self, space: TrigRing, whole: bool, decimals: bool) -> None:
        self._space, self._whole, self._decimals = space, whole, decimals
        #: The same parts come up in many forms.
        self._sums: dict[frozenset[Any], sp.Expr] = {}

    def expression(self, form: Form) -> sp.Expr:
        poly: Poly = {}
        for key, value in form.items():
            # Angles that are numbers are not independent: 2 · ½ and 1 are one sum.
            gather(poly, *_term(self._space, key, value))
        if not poly:
            return sp.Integer(0)
        by_angle: dict[tuple[tuple[sp.Expr, int], ...], Poly] = {}
        for atoms, value in poly.items():
            turned = tuple(a for a in atoms if isinstance(a[0], (sp.sin, sp.cos)))
            by_angle.setdefault(turned, {})[atoms] = value
        # Among equally complex forms the one whose cosines and sines stand by themselves wins.
        tried = [sp.Add(*map(self._written, by_angle.values())), *([self._written(poly)] if self._whole else [])]
        return min(tried, key=complexity)

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
        key = frozenset(poly.items())
        if key not in self._sums:
            self._sums[key] = self._summed(poly)
        return self._sums[key]

    def _summed(self, poly: Poly) -> sp.Expr:
        """Return a sum by an atom that most of its terms have, and what has it not likewise."""
        counts = Counter(a for atoms in poly for a, e in atoms if e > 0)
        most = max(counts.values(), default=0)
        shared = [a for a, n in counts.items() if n == most > 1]
        if len(poly) > _MAX_FACTORED_TERMS:
            shared = shared[:1]
        tried = [self._by_atom(poly, a) for a in shared] or [self._plain(poly)]
        if 2 < len(poly) <= _MAX_FACTORED_TERMS:
            tried += product(poly, tried[0])
        # Among equally complex forms the most combined one wins.
        return min(reversed(tried), key=complexity)

    def _plain(self, poly: Poly) -> sp.Expr:
        return sp.Add(*(self._written({atoms: value}) for atoms, value in poly.items()))

    def _by_atom(self, poly: Poly, atom: sp.Expr) -> sp.Expr:
        with_it = {atoms: value for atoms, value in poly.items() if dict(atoms).get(atom, 0) > 0}
        without = {atoms: value for atoms, value in poly.items() if atoms not in with_it}
        return sp.Add(self._written(with_it), self._written(without)) if without else self._plain(poly)


def _term(space: TrigRing, key: FormKey, value: Fraction) -> tuple[tuple[tuple[sp.Expr, int], ...], Fraction]:
    done, kind, rest, powers = key
    out = Counter({g: e for g, e in zip(space.generators, powers, strict=True) if e})
    for i, c, s in done:
        for f, e in ((sp.sin, s), (sp.cos, c)):
            if e:
                turned, sign = _turned(f(space.angles[i]))
                out[turned] += e
                value *= sign**e
    if any(rest):
        angle = sp.Add(*(k * a for k, a in zip(rest, space.angles, strict=True) if k))
        turned, sign = _turned(sp.sin(angle) if kind else sp.cos(angle))
        # It may be one of those already there: 2 · ½ is 1.
        out[turned] += 1
        value *= sign
    return tuple(out.items()), value


def _turned(x: sp.Expr) -> tuple[sp.Expr, int]:
    """Return a sine or cosine and its sign: SymPy writes sin(b - a) as -sin(a - b)."""
    return (-x, -1) if x.is_Mul else (x, 1)


# Powers of the cosines and sines of single angles

#: The powers (angle, of cos, of sin) of single angles, the kind and multiples of the rest, exponents of the generators.
FormKey = tuple[tuple[tuple[int, int, int], ...], int, tuple[int, ...], tuple[int, ...]]
Form = dict[FormKey, Fraction]


def power_form(x: TrigPolynomial, subset: tuple[int, ...], square: int) -> Form:
    """Return a form: Re or Im of Π (cos a + i sin a)^k (cos rest + i sin rest), power by power."""
    out: Form = {}
    for (kind, multiples, powers), value in x.terms.items():
        rest = tuple(0 if i in subset else k for i, k in enumerate(multiples))
        sign = -1 if next((k for k in rest if k), 0) < 0 else 1
        parts: list[tuple[tuple[tuple[int, int, int], ...], int, Fraction]] = [((), 0, value)]
        for i in subset:
            k = multiples[i]
            parts = [
                ((*done, (i, c, s)) if c or s else done, turns + (s if k > 0 else -s), factor * times)
                for done, turns, factor in parts
                for (c, s), times in _power(abs(k), square).items()
            ]
        for done, turns, factor in parts:
            for part in (0, 1) if any(rest) else (0,):
                # A power of i: real for a cosine, imaginary for a sine.
                total = (turns + part) % 4
                if total % 2 == kind:
                    amount = factor * (-1 if total >= 2 else 1) * (sign if part else 1)
                    gather(out, (done, part, tuple(sign * k for k in rest), powers), amount)
    return out


def _power(k: int, kept: int) -> dict[tuple[int, int], int]:
    """Return (cos + i sin)^k as powers of cos and i sin, with the square of the one that is not `kept` replaced."""
    out: Counter[tuple[int, int]] = Counter()
    for s in range(k + 1):
        half, odd = divmod(k - s if kept else s, 2)
        # (i sin)² = cos² - 1
        for n in range(half + 1):
            place = (odd, s + 2 * n) if kept else (k - s + 2 * n, odd)
            out[place] += comb(k, s) * comb(half, n) * (1 if kept else (-1) ** (half - n))
    return out


# Sums of products of atoms: what their terms share, and whether they are products of sums.

#: Possible terms up to which a product of sums is looked for.
_MAX_DENSE_TERMS: Final = 50_000

#: A product of powers of atoms -> its coefficient.
Poly = dict[tuple[tuple[sp.Expr, int], ...], Fraction]


def product(poly: Poly, x: sp.Expr) -> list[sp.Expr]:
    """Return a sum as a product of sums, if it is one; its atoms are as good as symbols."""
    highest: dict[sp.Expr, int] = {}
    for a, e in (pair for atoms in poly for pair in atoms):
        highest[a] = max(highest.get(a, 0), e)
    # SymPy's polynomials are as large as all powers together.
    large = prod(e + 1 for e in highest.values()) > _MAX_DENSE_TERMS
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
    # Factors that all terms share are not looked for.
    least = [min(es) for es in zip(*rows, strict=True)]
    rows = [tuple(e - f for e, f in zip(row, least, strict=True)) for row in rows]
    scale = lcm(*(v.denominator for v in poly.values()))
    numbers = [int(v * scale) for v in poly.values()]
    shared, rng = gcd(*numbers), Random(0)
    for i, highest in enumerate(max(es) for es in zip(*rows, strict=True)):
        for _ in range(PROBES if highest == 1 else 0):
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
    # Decimals share many numbers by accident; a common factor is useful where it leaves small whole numbers.
    if any((x / scale).denominator > 1 or abs(x / scale) > 100 for x in values):
        scale = Fraction(1)
    if sum(v > 0 for v in values) == 0:
        scale = -scale
    left = {
        tuple((a, e - shared.get(a, 0)) for a, e in atoms if e != shared.get(a, 0)): v / scale
        for atoms, v in poly.items()
    }
    return list(shared.items()), scale, left
