"""Making expressions readable, in a time that is bounded."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import sympy as sp
from sympy.functions.elementary.trigonometric import TrigonometricFunction

from mbkit.lagrangian.compact import cost
from mbkit.lagrangian.reading import forms

__all__ = ["LARGE", "tidy", "tidy_matrix"]

#: Operations up to which an expression is simplified unasked.
LARGE: Final = 2000
# Roots of cosines: what multiplies them is often better left as it was.
_WORTH: Final = 0.7


@lru_cache(1024)
def tidy(x: sp.Expr) -> sp.Expr:
    """Return a shorter form of an expression; a large one as it is.

    The shortest of several forms, so that no rewriting makes it worse. Cosines and sines are
    combined exactly (`mbkit.lagrangian.reading`): `sympy.simplify` and `trigsimp` search, with no bound on their time.
    """
    if not x.free_symbols or x.count_ops() > LARGE:
        return x
    rooted = any(p.has(TrigonometricFunction) for p in x.atoms(sp.Pow) if not p.exp.is_Integer)
    # Of equal forms one that was combined.
    tried = [(cost(form), form) for form in forms(x)] + [(cost(x) * (_WORTH if rooted else 1.0), x)]
    return min(tried, key=lambda pair: pair[0])[1]


def tidy_matrix(x: Any) -> sp.ImmutableMatrix:
    """Return a matrix with each entry tidied."""
    return sp.ImmutableMatrix(x).applyfunc(tidy)
