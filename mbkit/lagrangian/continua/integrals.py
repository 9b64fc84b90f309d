"""Integrals of products of mode shapes over a continuum: exact of polynomials, else to some 30 digits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any, Final

import mpmath
import sympy as sp
from mpmath.calculus.quadrature import GaussLegendre

from mbkit.errors import InputError, NumericalError
from mbkit.lagrangian.energies.symbols import expression, plain
from mbkit.lagrangian.printer import MAX_DENOMINATOR

#: The place on a continuum, from 0 at one end to 1 at the other; all shapes depend on it.
XI: Final = sp.Symbol("xi", real=True)
INTEGRAL_DIGITS: Final = 50
#: Modes that the digits of beams and of Ritz's matrices are enough for: sines added to cosh λ are lost in 40 digits.
MAX_MODES: Final = 20
#: Orders of two rules of Gauss and Legendre, of 48 and 96 nodes, whose results are compared.
_ORDERS: Final = (5, 6)
#: Two rules agree, and an integral is zero, up to this part of the integral of the absolute value.
_INTEGRAL_ERROR_RATIO: Final = 1e-22


@lru_cache(8)
def _rule(order: int, digits: int) -> list[tuple[Any, Any]]:
    with mpmath.workdps(digits):
        nodes: list[tuple[Any, Any]] = GaussLegendre(mpmath.mp).get_nodes(0, 1, order, mpmath.mp.prec)
        return nodes


class Shape:
    """A function of ξ, with its derivatives as polynomials or as values at the nodes of a rule."""

    def __init__(self, x: sp.Expr) -> None:
        self.expression = x
        self._nodes: dict[tuple[int, int], list[Any]] = {}
        self._slopes: dict[int, Shape] = {0: self}

    @cached_property
    def polynomial(self) -> sp.Poly | None:
        """The function with exact coefficients, where it has such."""
        exact = self.expression.is_polynomial(XI) and not self.expression.atoms(sp.Float)
        return sp.Poly(self.expression, XI, domain="QQ") if exact else None

    def slope(self, times: int) -> Shape:
        """Return a derivative."""
        if times not in self._slopes:
            self._slopes[times] = Shape(self.slope(times - 1).expression.diff(XI))
        return self._slopes[times]

    @cached_property
    def _function(self) -> Any:
        x = self.expression
        return sp.lambdify(XI, sp.horner(x, XI) if x.is_polynomial(XI) else x, "mpmath")

    def __call__(self, xi: Any, digits: int = INTEGRAL_DIGITS) -> Any:
        """Return the value at a place; InputError where there is none."""
        with mpmath.workdps(digits):
            try:
                return mpmath.mpf(self._function(mpmath.mpf(xi)))
            except (ArithmeticError, TypeError, ValueError, NameError) as error:
                at = mpmath.nstr(xi, 6)
                raise InputError(f"shapes: {self.expression} has no real value at {XI} = {at}, of 0 to 1") from error

    def at_nodes(self, order: int, digits: int = INTEGRAL_DIGITS) -> list[Any]:
        """Return the values at the nodes of a rule."""
        key = order, digits
        if key not in self._nodes:
            self._nodes[key] = [self(x, digits) for x, _ in _rule(order, digits)]
        return self._nodes[key]


class Integrals:
    """∫₀¹ f(ξ) φ_a φ_b ... dξ, each once."""

    def __init__(self, shapes: Sequence[Shape]) -> None:
        self._shapes = shapes
        self._weights: dict[sp.Expr, Shape] = {}
        self._done: dict[Any, sp.Expr] = {}

    def __call__(self, weight: sp.Expr, factors: tuple[tuple[int, int], ...]) -> sp.Expr:
        """Return the integral; each factor is a shape's number and its derivative.

        Raises
        ------
        NumericalError
            A function that is not smooth enough for 22 digits.
        """
        key = weight, tuple(sorted(factors))
        if key not in self._done:
            parts = [self._weight(weight), *(self._shapes[i].slope(k) for i, k in key[1])]
            exact = [p.polynomial for p in parts if p.polynomial is not None]
            self._done[key] = _of_polynomials(exact) if len(exact) == len(parts) else _by_quadrature(parts)
        return self._done[key]

    def _weight(self, weight: sp.Expr) -> Shape:
        return self._weights.setdefault(weight, Shape(weight))

    def of_power(self, weight: sp.Expr, power: int) -> Any:
        """Return ∫₀¹ f ξ^n dξ in the digits of mpmath, of which half have to be right."""
        digits = mpmath.mp.dps
        if weight.is_polynomial(XI):
            return mpmath.fsum(
                mpmath.mpf(sp.Float(c, digits)) / (k + power + 1) for (k,), c in sp.Poly(weight, XI).terms()
            )
        f = self._weight(weight)
        rules = [_rule(order, digits) for order in _ORDERS]
        values = [f.at_nodes(order, digits) for order in _ORDERS]
        totals = [
            mpmath.fsum(y * w * x**power for y, (x, w) in zip(*pair, strict=True))
            for pair in zip(values, rules, strict=True)
        ]
        _settled([f], totals, mpmath.mpf(10) ** (-digits / 2), max(map(abs, values[0])))
        return totals[1]


def _of_polynomials(parts: Sequence[sp.Poly]) -> sp.Expr:
    return number(sum((c / (k[0] + 1) for k, c in math.prod(parts[1:], start=parts[0]).terms()), sp.Integer(0)))


def _by_quadrature(parts: Sequence[Shape]) -> sp.Expr:
    totals = []
    with mpmath.workdps(INTEGRAL_DIGITS):
        for order in _ORDERS:
            products = [mpmath.fprod(x) for x in zip(*(p.at_nodes(order) for p in parts), strict=True)]
            weights = [w for _, w in _rule(order, INTEGRAL_DIGITS)]
            total = mpmath.fdot(weights, products)
            size = mpmath.fdot(weights, map(abs, products))
            totals.append(total)
        _settled(parts, totals, _INTEGRAL_ERROR_RATIO, size)
        if abs(totals[1]) < _INTEGRAL_ERROR_RATIO * size:
            return sp.Integer(0)
        return number(sp.Float(totals[1], 40))


def _settled(parts: Sequence[Shape], totals: Sequence[Any], same: Any, size: Any) -> None:
    """Refuse an integral of which two rules give different numbers."""
    if abs(totals[0] - totals[1]) > same * size:
        shown = " * ".join(f"({p.expression})" for p in parts)
        raise NumericalError(
            f"shapes: the integral of {shown} from 0 to 1 does not settle; give functions that are smooth between the "
            "ends and vary less, or polynomials"
        )


def number(x: sp.Expr) -> sp.Expr:
    """Return a number as a short quotient where it is one, else with 20 digits."""
    x = sp.sympify(x)
    if x.is_Rational and x.q <= MAX_DENOMINATOR:
        return x
    near = sp.Rational(str(x.n(30))).limit_denominator(24)
    if near != 0 and abs(x - near) < _INTEGRAL_ERROR_RATIO * abs(near):
        return near
    return sp.Float(x, 20)


def read_shape(what: str, source: Any, x: sp.Symbol, ends: tuple[Any, ...]) -> Shape:
    """Return a shape φ(x) as a function of ξ with x = lower + (upper - lower) ξ.

    Raises
    ------
    InputError
        Other symbols than x and those of the ends.
    """
    lower, upper = ends
    out = expression(what, source).subs(x, lower + (upper - lower) * XI)
    if out.is_polynomial(XI):
        out = sp.expand(out)
    else:
        out = out.replace(lambda e: bool(e.is_Function and not isinstance(e, sp.Piecewise)), _inside)
    left = out.free_symbols - {XI}
    if left:
        out = sp.simplify(out)
        left = out.free_symbols - {XI}
    if left:
        raise InputError(
            f"{what}: {source} holds {plain(left)} beside {x}/length; a shape is a function of the place between the "
            "ends alone: put numbers in first"
        )
    return Shape(out)


def _inside(e: sp.Expr) -> sp.Expr:
    return e.func(*(sp.cancel(a) for a in e.args))


def weights_of(c: sp.Expr, x: sp.Symbol, ends: tuple[Any, ...], what: str) -> Mapping[sp.Expr, sp.Expr]:
    """Return a coefficient as functions of ξ, each with its factor.

    Raises
    ------
    InputError
        A function of x with parameters in it that do not go out with the length.
    """
    lower, upper = ends
    out: dict[sp.Expr, sp.Expr] = {}
    for term in sp.Add.make_args(sp.expand(sp.expand(c).subs(x, lower + (upper - lower) * XI))):
        factor, f = term.as_independent(XI, as_Add=False)
        f = sp.simplify(f) if f.free_symbols - {XI} else f
        again, f = f.as_independent(XI, as_Add=False)
        if f.free_symbols - {XI} or f.atoms(sp.core.function.AppliedUndef):
            raise InputError(
                f"{what}: {term} depends on the place in a way that holds {plain(f.free_symbols - {XI}) or f}; "
                "put numbers in first, or write it with x/length"
            )
        out[f] = out.get(f, sp.Integer(0)) + factor * again
    return out
