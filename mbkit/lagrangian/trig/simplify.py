"""SymPy's expressions in short forms, in a time that is bounded, and whether they are zero.

An expression is read as an exact sum of cosines and sines, of which roots and denominators are generators: so common
factors cancel modulo sin² + cos² = 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any, Final

import mpmath
import sympy as sp
from mpmath.libmp import NoConvergence
from numpy.random import default_rng
from sympy.core.function import AppliedUndef

from mbkit.errors import UnsupportedError
from mbkit.lagrangian.trig.shortest_form import (
    MAX_COMBINED_TERMS,
    MAX_READABLE_TERMS,
    Key,
    TrigPolynomial,
    TrigRing,
    complexity,
    quotient,
    shortest_form,
)

#: Operations up to which an expression is simplified.
MAX_SIMPLIFIED_OPERATIONS: Final = 2000
#: Operations up to which an intermediate result is tidied.
_MAX_TIDIED_OPERATIONS: Final = 150


@lru_cache(1024)
def tidy(x: sp.Expr) -> sp.Expr:
    """Return the shortest of several forms of an expression; a large one as it is.

    `sympy.simplify` and `trigsimp` search with no bound on their time.
    """
    if not x.free_symbols or x.count_ops() > MAX_SIMPLIFIED_OPERATIONS:
        return x
    # Among equally complex forms a combined one wins.
    return min((*forms(x), x), key=complexity)


def tidy_short(x: sp.Expr) -> sp.Expr:
    """Return an expression tidied; a long one as it is."""
    return tidy(x) if x.count_ops() <= _MAX_TIDIED_OPERATIONS else x


#: Values of an angle on which an expression does not depend.
_ANY: Final = (sp.Integer(0), sp.pi / 2, sp.pi / 6, sp.Integer(1))


@lru_cache(1024)
def settled(x: sp.Expr) -> sp.Expr:
    """Return an expression, tidied, without the angles that cancel in it: those along which its slope is zero."""
    for q in sorted(set().union(*(a.free_symbols for a in x.atoms(sp.sin, sp.cos))), key=str):
        # A sign, as that of √(cos² q), has the slope zero too.
        signs = [p for p in x.atoms(sp.Pow) if not p.exp.is_Integer]
        signs += x.atoms(sp.Abs, sp.sign, sp.Piecewise, AppliedUndef)
        if x.has(q) and not any(part.has(q) for part in signs) and is_zero(sp.diff(x, q)):
            values = (x.subs(q, value) for value in _ANY)
            x = next((y for y in values if not y.has(sp.nan, sp.zoo, sp.oo)), x)
    return tidy(x)


def settled_matrix(A: Any, velocities: Sequence[sp.Symbol] = ()) -> sp.ImmutableMatrix:
    """Return a matrix whose entries, of second degree in velocities at most, have `settled` coefficients."""
    at_rest = dict.fromkeys(velocities, sp.Integer(0))

    def entry(x: sp.Expr) -> sp.Expr:
        total = settled(x.subs(at_rest))
        for i, v in enumerate(velocities):
            by_v = sp.diff(x, v)
            total += settled(by_v.subs(at_rest)) * v
            for w in velocities[i:]:
                total += settled(sp.diff(by_v, w) / (2 if v == w else 1)) * v * w
        return tidy(total) if velocities else total

    return sp.ImmutableMatrix(A).applyfunc(entry)


def tidy_matrix(x: Any) -> sp.ImmutableMatrix:
    """Return a matrix with each entry tidied."""
    return sp.ImmutableMatrix(x).applyfunc(tidy)


def slope(x: sp.Expr, q: sp.Symbol) -> sp.Expr:
    """Return ∂x/∂q, tidied; factors that all terms share stay in front.

    A slider-crank's inertia m r² λ² sin² θ has the slope 2 m r² λ (λ cos θ + λ′ sin θ) sin θ, which is lost
    when it is multiplied out.
    """
    if any(not s.is_real for a in x.atoms(sp.Abs) for s in a.free_symbols):
        # SymPy takes |x| for the modulus of a complex number.
        known = {s: sp.Dummy(s.name, real=True) for s in sorted(x.free_symbols | {q}, key=str)}
        return slope(x.xreplace(known), known[q]).xreplace({real: s for s, real in known.items()})
    broken = [f for f in x.atoms(sp.Pow) if f.base.has(q) and (not f.exp.is_Integer or f.exp.is_negative)]
    if all(f.base.is_Symbol for f in broken):
        return tidy(sp.diff(x, q))
    return _product(x, q)


def gradient(x: sp.Expr, coordinates: Any) -> list[sp.Expr]:
    """Return ∂x/∂q of each coordinate."""
    return [slope(x, q) for q in coordinates]


def _product(x: sp.Expr, q: sp.Symbol) -> sp.Expr:
    if not x.has(q):
        return sp.Integer(0)
    if x.is_Add:
        return sp.Add(*(_product(term, q) for term in x.args))
    powers = [f.as_base_exp() for f in sp.Mul.make_args(x)]
    still = sp.Mul(*(b**e for b, e in powers if not b.has(q)))
    moving = [(b, e) for b, e in powers if b.has(q)]
    if any(e.has(q) for _, e in powers):
        return sp.diff(x, q)
    shared = sp.Mul(still, *(b ** (e - 1) for b, e in moving))
    inside = sp.Integer(0)
    for k, (b, e) in enumerate(moving):
        rate = _product(b, q) if b.is_Add else sp.diff(b, q)
        inside += e * rate * sp.Mul(*(other for i, (other, _) in enumerate(moving) if i != k))
    # A number would be multiplied into the sum.
    number, rest = tidy_short(inside).primitive()
    return shared * number * rest


# Expressions as exact sums, and back

#: Products of terms that one expression may cost: about half a second.
_MAX_TERM_PRODUCTS: Final = 40_000
_MAX_EXPONENT: Final = 12

#: Functions that are quotients of cosines and sines.
_QUOTIENTS: Final[dict[Any, Callable[[sp.Expr], sp.Expr]]] = {
    sp.tan: lambda a: sp.sin(a) / sp.cos(a),
    sp.cot: lambda a: sp.cos(a) / sp.sin(a),
    sp.sec: lambda a: 1 / sp.cos(a),
    sp.csc: lambda a: 1 / sp.sin(a),
}


def forms(x: sp.Expr) -> list[sp.Expr]:
    """Return short forms of an expression: as it stands, and over one denominator; none of a long one."""
    out: list[sp.Expr] = []
    with suppress(UnsupportedError):
        for f, put in _QUOTIENTS.items():
            x = x.replace(f, put)
        reading = _Reading(x)
        out.append(reading.as_it_stands())
        out += reading.over_one_denominator()
    return out


@dataclass
class _Power:
    """The meaning of a generator: the root of a base or one over it, with the base as an exact sum."""

    base: sp.Expr
    root: bool
    sum: TrigPolynomial

    @property
    def written(self) -> sp.Expr:
        return sp.sqrt(self.base) if self.root else 1 / self.base

    def times(self, x: TrigPolynomial, exponent: int) -> TrigPolynomial:
        """Return x · base^exponent."""
        for _ in range(exponent):
            x = x * self.sum
        return x


class _Reading:
    """An expression as a sum, with the meaning of its generators."""

    def __init__(self, x: sp.Expr) -> None:
        self._angles: dict[sp.Expr, None] = {}
        self._symbols: dict[sp.Expr, None] = {}
        self._powers: dict[sp.Expr, sp.Dummy] = {}
        self._gather(x)
        generators = [*self._symbols, *self._powers.values()]
        self._space = TrigRing("expression", list(self._angles), generators, _MAX_TERM_PRODUCTS)
        self._known: dict[sp.Dummy, _Power] = {}
        self._decimals = x.has(sp.Float)
        self.sum = self._read(x)

    # Reading

    def _gather(self, x: sp.Expr) -> None:
        """Note the angles and the generators."""
        if x.is_Rational or x.is_Float:
            return
        if isinstance(x, (sp.sin, sp.cos)):
            self._angles.update(dict.fromkeys(_turns(x.args[0])))
        elif x.is_Add or x.is_Mul:
            for e in x.args:
                self._gather(e)
        elif x.is_Pow and x.exp.is_Integer and 0 < x.exp <= _MAX_EXPONENT:
            self._gather(x.base)
        elif not _is_power(x):
            self._symbols[x] = None
        elif x.base.is_Symbol and x.exp.is_Integer:
            self._symbols[x.base] = None
        else:
            self._gather(x.base)
            self._powers.setdefault(_power(x), sp.Dummy())

    def _read(self, x: Any) -> TrigPolynomial:
        space = self._space
        if x.is_Float:
            return space.number(Fraction(repr(float(x))))
        if x.is_Rational:
            return space.number(Fraction(int(x.p), int(x.q)))
        if isinstance(x, (sp.sin, sp.cos)):
            return space.turned(int(isinstance(x, sp.sin)), _turns(x.args[0]))
        if x.is_Add or x.is_Mul:
            parts = [self._read(e) for e in x.args]
            out = parts[0]
            for part in parts[1:]:
                out = out + part if x.is_Add else out * part
            return out
        if x.is_Pow and x.exp.is_Integer and 0 < x.exp <= _MAX_EXPONENT:
            out = base = self._read(x.base)
            for _ in range(int(x.exp) - 1):
                out = out * base
            return out
        if not _is_power(x):
            return space.power(x, 1)
        if x.base.is_Symbol and x.exp.is_Integer:
            return space.power(x.base, int(x.exp))
        return self._read_power(x)

    def _read_power(self, x: Any) -> TrigPolynomial:
        root = sp.sqrt(x.base)
        # 1 / (the argument of a root) is a power of the root.
        written = root if root in self._powers else 1 / x.base
        generator = self._powers[written]
        if generator not in self._known:
            self._known[generator] = _Power(x.base, written == root, self._read(x.base))
        return self._space.power(generator, int(2 * x.exp) if written == root else -int(x.exp))

    # Writing

    def _written(self, x: TrigPolynomial) -> sp.Expr:
        if len(x.terms) > MAX_READABLE_TERMS:
            raise UnsupportedError(f"expression: {len(x.terms)} terms are more than anybody reads")
        return self._back(shortest_form(x, decimals=self._decimals))

    def _back(self, x: sp.Expr) -> sp.Expr:
        # One may stand in the base of another.
        put = {generator: power.written for generator, power in self._known.items()}
        while x.free_symbols & put.keys():
            x = x.xreplace(put)
        return x

    def as_it_stands(self) -> sp.Expr:
        """Return the sum with roots and denominators as they were."""
        return self._written(self.sum)

    def over_one_denominator(self) -> list[sp.Expr]:
        """Return the sum with terms of the same roots over one denominator each; none if it is long or has neither."""
        if not self._known or len(self.sum.terms) > MAX_COMBINED_TERMS:
            return []
        # A symbol read later may depend on earlier ones.
        return [self._over_one(self.sum, list(reversed(self._known)))]

    def _over_one(self, x: TrigPolynomial, left: list[sp.Dummy]) -> sp.Expr:
        """Return a sum as a numerator and powers of what the generators stand for, for each set of roots one."""
        if not left:
            return self._written(x)
        generator, *rest = left
        power, i = self._known[generator], self._space.generators.index(generator)
        out = sp.Integer(0)
        for part in _by_parity(x, i) if power.root else [x]:
            least, step = _least({key[2][i] for key in part.terms}, power.root), 2 if power.root else -1
            part = _shared(part, i, least, power, step)
            while part.terms and least * step < 0:
                less = quotient(part, power.sum)
                if less is None:
                    break
                part, least = less, least + step
            out += power.written**least * self._over_one(part, rest)
        return self._back(out)


def _by_parity(x: TrigPolynomial, i: int) -> list[TrigPolynomial]:
    """Return the terms with even and those with odd powers of a generator."""
    parts = [{key: value for key, value in x.terms.items() if key[2][i] % 2 == odd} for odd in (0, 1)]
    return [TrigPolynomial(x.space, terms) for terms in parts if terms]


def _least(exponents: set[int], root: bool) -> int:
    """Return the power of a generator over which terms with these powers are written."""
    if not root:
        return max(exponents, default=0)
    least = min(exponents, default=0)
    return min(least, least % 2)


def _shared(x: TrigPolynomial, i: int, least: int, power: _Power, step: int) -> TrigPolynomial:
    """Return a sum over a power of a generator, whose other powers are written out."""
    parts: dict[int, dict[Key, Fraction]] = {}
    for (kind, turns, powers), value in x.terms.items():
        bare = (*powers[:i], 0, *powers[i + 1 :])
        parts.setdefault((powers[i] - least) // step, {})[kind, turns, bare] = value
    out = TrigPolynomial(x.space, {})
    for exponent, terms in parts.items():
        out = out + power.times(TrigPolynomial(x.space, terms), exponent)
    return out


def _is_power(x: sp.Expr) -> bool:
    """Return whether an expression is a square root, or one over something; other roots are generators themselves."""
    if not (x.is_Pow and x.exp.is_Rational and abs(x.exp) <= _MAX_EXPONENT):
        return False
    return bool(x.exp.q == 2 or (x.exp.is_Integer and x.exp.is_negative))


def _power(x: sp.Expr) -> sp.Expr:
    return sp.sqrt(x.base) if x.exp.q == 2 else 1 / x.base


def _turns(angle: sp.Expr) -> dict[sp.Expr, int]:
    """Return an angle as whole multiples of others."""
    out = {}
    for term in sp.Add.make_args(sp.expand(angle)):
        value, rest = term.as_coeff_Mul()
        if value.is_Integer and rest != 1:
            out[rest] = int(value)
        else:
            out[term] = 1
    return out


# Zero tests by values at random places: with more digits only the value of a zero gets smaller.

#: Digits of values; a zero test evaluates again with twice as many.
PROBE_DIGITS: Final = 30
#: A number computed with `PROBE_DIGITS` is zero below this part of those that it is computed from.
ZERO_PROBE_RATIO: Final = 1e-20
#: Negligible beside terms of the order of 1.
_ZERO_VALUE: Final = 1e-50


class RandomEvaluation:
    """Expressions as numbers at random places, of their symbols and of further ones."""

    def __init__(self, expressions: Sequence[sp.Expr], symbols: Iterable[sp.Symbol] = ()) -> None:
        # A function that is not given, and each of its derivatives, may have any value.
        unknown = {f for x in expressions for f in (*x.atoms(sp.Derivative), *x.atoms(AppliedUndef))}
        values = {f: sp.Dummy(str(f)) for f in sorted(unknown, key=lambda f: (not f.is_Derivative, str(f)))}
        for f, value in values.items():
            expressions = [x.xreplace({f: value}) for x in expressions]
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

    def __call__(self, place: dict[sp.Symbol, Any], digits: int = PROBE_DIGITS) -> list[Any] | None:
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
    # Places that must agree are more where signs decide.
    probe, needed = RandomEvaluation([x]), 8 if broken else 2
    for seed in range(2 * needed):
        place = probe.place(seed)
        rough, fine = (probe(place, digits) for digits in (PROBE_DIGITS, 2 * PROBE_DIGITS))
        if rough is None or fine is None:
            continue
        if abs(fine[0]) > max(ZERO_PROBE_RATIO * abs(rough[0]), _ZERO_VALUE):
            return False
        needed -= 1
        if not needed:
            return True
    return False
