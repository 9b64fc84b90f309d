"""Making expressions readable, in a time that is bounded."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import sympy as sp
from sympy.functions.elementary.trigonometric import TrigonometricFunction

from mbkit.lagrangian.trig.from_sympy import forms
from mbkit.lagrangian.trig.shortest_form import complexity

#: Operations up to which an expression is simplified.
LARGE: Final = 2000
# Roots of cosines: their factors often read better as they were.
_WORTH: Final = 0.7


@lru_cache(1024)
def tidy(x: sp.Expr) -> sp.Expr:
    """Return the shortest of several forms of an expression; a large one as it is.

    `sympy.simplify` and `trigsimp` search with no bound on their time.
    """
    if not x.free_symbols or x.count_ops() > LARGE:
        return x
    rooted = any(p.has(TrigonometricFunction) for p in x.atoms(sp.Pow) if not p.exp.is_Integer)
    # Of equal forms one that was combined.
    tried = [(complexity(form), form) for form in forms(x)] + [(complexity(x) * (_WORTH if rooted else 1.0), x)]
    return min(tried, key=lambda pair: pair[0])[1]


def tidy_matrix(x: Any) -> sp.ImmutableMatrix:
    """Return a matrix with each entry tidied."""
    return sp.ImmutableMatrix(x).applyfunc(tidy)


# Derivatives that stay products

#: Operations up to which the derivative is multiplied out too.
_SMALL: Final = 60
#: Operations up to which the contents of brackets are tidied.
_LONG: Final = 150


def slope(x: sp.Expr, q: sp.Symbol) -> sp.Expr:
    """Return ∂x/∂q, tidied; factors that all terms share stay in front.

    A slider-crank's inertia m r² λ² sin² θ has the slope 2 m r² λ (λ cos θ + λ′ sin θ) sin θ, which is lost
    when it is multiplied out.
    """
    broken = [f for f in x.atoms(sp.Pow) if f.base.has(q) and (not f.exp.is_Integer or f.exp.is_negative)]
    if all(f.base.is_Symbol for f in broken):
        return tidy(sp.diff(x, q))
    product = _product(x, q)
    # Multiplied out, what has roots gets shorter in rare cases only.
    if x.count_ops() > _SMALL or not all(f.exp.is_Integer for f in broken):
        return product
    plain = tidy(sp.diff(x, q))
    # A sum that was written as products stays one, unless it gets much shorter.
    return plain if complexity(plain) < (_WORTH if x.is_Add else 1.0) * complexity(product) else product


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
    number, rest = (tidy(inside) if inside.count_ops() <= _LONG else inside).primitive()
    return shared * number * rest
