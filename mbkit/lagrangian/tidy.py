"""Making expressions readable, in a time that is bounded."""

from __future__ import annotations

from typing import Any, Final

import sympy as sp

__all__ = ["SMALL", "tidy", "tidy_matrix"]

#: Operations up to which an expression is simplified unasked.
SMALL: Final = 120


def tidy(x: sp.Expr, *, small: int = SMALL) -> sp.Expr:
    """Return a shorter form of a small expression; a large one as it is.

    Of several forms that SymPy finds, the one with the fewest operations, so that no
    rewriting makes it worse. `sympy.simplify` itself has no bound on its time.
    """
    if not x.free_symbols or x.count_ops() > small:
        return x
    expanded = sp.expand(x)
    forms = [x, expanded, sp.factor_terms(expanded)]
    if x.has(sp.sin, sp.cos):
        turned = sp.trigsimp(expanded)
        forms += [turned, sp.factor_terms(turned), sp.factor_terms(sp.fu(expanded))]
    if expanded.is_rational_function(*expanded.free_symbols) or len(forms) == 3:
        forms.append(sp.factor_terms(sp.cancel(sp.together(expanded))))
    return min(forms, key=lambda form: (form.count_ops(), forms.index(form)))


def tidy_matrix(x: Any, *, small: int = SMALL) -> sp.ImmutableMatrix:
    """Return a matrix with each entry tidied."""
    return sp.ImmutableMatrix(x).applyfunc(lambda e: tidy(e, small=small))
