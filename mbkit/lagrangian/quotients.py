"""Quotients of cosines and sines, cancelled exactly.

Inverses of matrices of Euler angles put sin θ below the line, where 1 / sin² θ - 1 / tan² θ is
only 1 once it stands over one denominator and its numerator is divided by sin² θ modulo
sin² θ + cos² θ = 1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import sympy as sp

from mbkit.lagrangian.tidy import tidy

__all__ = ["reduced", "reduced_matrix"]

# Operations beyond which an expression is left as it is.
_MOST: Final = 1500

_OTHERS: Final[dict[Any, Callable[[sp.Expr], sp.Expr]]] = {
    sp.tan: lambda a: sp.sin(a) / sp.cos(a),
    sp.cot: lambda a: sp.cos(a) / sp.sin(a),
    sp.sec: lambda a: 1 / sp.cos(a),
    sp.csc: lambda a: 1 / sp.sin(a),
}


def reduced(x: sp.Expr) -> sp.Expr:
    """Return the shorter of an expression tidied as it stands, and over one denominator that is cancelled."""
    if not x.free_symbols or x.count_ops() > _MOST:
        return x
    above, below = sp.fraction(sp.together(_plain(x)))
    if not below.free_symbols and not x.has(*_OTHERS):
        return tidy(x)
    above, below = tidy(above), tidy(below)
    for angle in sorted({f.args[0] for f in below.atoms(sp.sin, sp.cos)}, key=sp.default_sort_key):
        for f, other in ((sp.sin(angle), sp.cos(angle)), (sp.cos(angle), sp.sin(angle))):
            above, below = _divided(above, below, f, other)
    forms = [tidy(above) / below, tidy(x)]
    return min(forms, key=lambda form: (int(form.count_ops()), forms.index(form)))


def reduced_matrix(x: Any) -> sp.ImmutableMatrix:
    """Return a matrix with each entry reduced."""
    return sp.ImmutableMatrix(x).applyfunc(reduced)


def _plain(x: sp.Expr) -> sp.Expr:
    """Return an expression in cosines and sines alone."""
    for f, quotient in _OTHERS.items():
        x = x.replace(f, quotient)
    return x


def _divided(above: sp.Expr, below: sp.Expr, f: sp.Expr, other: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """Divide both by the highest power of f that they share, where f² + other² = 1."""
    powers = dict(factor.as_base_exp() for factor in sp.Mul.make_args(below))
    power = powers.get(f, sp.Integer(0))
    if not (power.is_Integer and power > 0):
        return above, below
    a, b = sp.Dummy(), sp.Dummy()
    put = {f: a, other: b}
    try:
        parts = sp.Poly(sp.expand(above.subs(put)), b).rem(sp.Poly(a**2 + b**2 - 1, b)).all_coeffs()
        polynomials = [sp.Poly(part, a) for part in parts if part != 0]
    except sp.PolynomialError:
        return above, below
    if not polynomials:
        return sp.Integer(0), sp.Integer(1)
    shared = min([int(power), *(min(k for (k,) in p.monoms()) for p in polynomials)])
    if not shared:
        return above, below
    back = {a: f, b: other}
    left = sum((part * b**i for i, part in enumerate(reversed(parts))), sp.Integer(0))
    return sp.expand(left / a**shared).subs(back), below / f**shared
