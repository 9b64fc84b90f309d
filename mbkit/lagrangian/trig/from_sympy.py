"""SymPy's expressions as exact sums of cosines and sines, and back in short forms.

Roots and denominators are generators of the sum, so that common factors cancel modulo sin² + cos² = 1.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Final

import sympy as sp

from mbkit.errors import UnsupportedError
from mbkit.lagrangian.trig.polynomial import Key, TrigPolynomial, TrigRing, quotient
from mbkit.lagrangian.trig.shortest_form import shortest_form

#: Products of terms that one expression may cost: about half a second.
_MOST: Final = 40_000
_HIGHEST: Final = 12
#: Terms of a readable sum, and up to which quotients are put over one denominator.
_LONG: Final = 300
_SHORT: Final = 60

#: Functions that are quotients of cosines and sines.
_QUOTIENTS: Final[dict[Any, Callable[[sp.Expr], sp.Expr]]] = {
    sp.tan: lambda a: sp.sin(a) / sp.cos(a),
    sp.cot: lambda a: sp.cos(a) / sp.sin(a),
    sp.sec: lambda a: 1 / sp.cos(a),
    sp.csc: lambda a: 1 / sp.sin(a),
}


def shortened(x: sp.Expr) -> sp.Expr | None:
    """Return a short form of a sum, with roots and denominators as they stand; None of a long one."""
    try:
        return _Reading(x).as_it_stands()
    except UnsupportedError:
        return None


def forms(x: sp.Expr) -> list[sp.Expr]:
    """Return short forms of an expression: as it stands, and over one denominator; none of a long one."""
    out: list[sp.Expr] = []
    with suppress(UnsupportedError):
        reading = _Reading(x)
        out.append(reading.as_it_stands())
        if x.has(*_QUOTIENTS):
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
        self._space = TrigRing("expression", list(self._angles), generators, _MOST)
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
        elif x.is_Pow and x.exp.is_Integer and 0 < x.exp <= _HIGHEST:
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
        if x.is_Pow and x.exp.is_Integer and 0 < x.exp <= _HIGHEST:
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
        # One over what is under a root is a power of the root.
        written = root if root in self._powers else 1 / x.base
        generator = self._powers[written]
        if generator not in self._known:
            power = _Power(x.base, written == root, self._read(x.base))
            # The same may be written in several ways.
            twins = (g for g, p in self._known.items() if p.root == power.root and p.sum.terms == power.sum.terms)
            generator = self._powers[written] = next(twins, generator)
            self._known.setdefault(generator, power)
        return self._space.power(generator, int(2 * x.exp) if written == root else -int(x.exp))

    # Writing

    def _written(self, x: TrigPolynomial) -> sp.Expr:
        if len(x.terms) > _LONG:
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
        if not self._known or len(self.sum.terms) > _SHORT:
            return []
        # What was read last may stand on what was read before.
        total = self._over_one(self.sum, list(reversed(self._known)))
        return [total, sp.factor_terms(total)]

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
    if not (x.is_Pow and x.exp.is_Rational and abs(x.exp) <= _HIGHEST):
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
