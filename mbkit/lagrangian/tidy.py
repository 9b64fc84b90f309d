"""Making expressions readable, in a time that is bounded."""

from __future__ import annotations

from typing import Any, Final

import sympy as sp
from sympy.functions.elementary.trigonometric import TrigonometricFunction

from mbkit.lagrangian.compact import cost
from mbkit.lagrangian.reading import shortened

__all__ = ["LARGE", "SMALL", "tidy", "tidy_matrix"]

#: Operations up to which an expression is simplified unasked: any, and one of symbols, cosines and sines only.
SMALL: Final = 120
LARGE: Final = 2000


def tidy(x: sp.Expr, *, small: int = SMALL) -> sp.Expr:
    """Return a shorter form of a small expression; a large one as it is.

    The shortest of several forms, so that no rewriting makes it worse. Cosines and sines are
    combined exactly (`reading.shortened`): `sympy.simplify` and `trigsimp` search, with no bound on their time.
    """
    if not x.free_symbols or x.count_ops() > LARGE:
        return x
    short = shortened(x)
    # Roots of cosines are not taken apart, so what multiplies them is often better left as it was.
    rooted = any(p.has(TrigonometricFunction) for p in x.atoms(sp.Pow) if not p.exp.is_Integer)
    if short is not None and (rooted or x.count_ops() > small or not _has_quotients(x)):
        return short if cost(short) <= (0.7 if rooted else 1.0) * cost(x) else x
    if x.count_ops() > small:
        return x
    expanded = sp.expand(x)
    forms = [x, short or x, expanded, sp.factor_terms(expanded)]
    if x.has(TrigonometricFunction):
        turned = sp.trigsimp(expanded)
        forms += [turned, sp.factor_terms(turned), sp.factor_terms(sp.fu(expanded))]
    if expanded.is_rational_function(*expanded.free_symbols) or len(forms) == 4:
        forms.append(sp.factor_terms(sp.cancel(sp.together(expanded))))
    return min(forms, key=lambda form: (cost(form), forms.index(form)))


def _has_quotients(x: sp.Expr) -> bool:
    """Return whether a sum or a cosine stands below a line, where more may cancel than in polynomials."""
    below = (p for p in x.atoms(sp.Pow) if p.exp.is_Integer and p.exp.is_negative)
    return x.has(sp.tan, sp.cot, sp.sec, sp.csc) or any(not p.base.is_Symbol for p in below)


def tidy_matrix(x: Any, *, small: int = SMALL) -> sp.ImmutableMatrix:
    """Return a matrix with each entry tidied."""
    return sp.ImmutableMatrix(x).applyfunc(lambda e: tidy(e, small=small))
