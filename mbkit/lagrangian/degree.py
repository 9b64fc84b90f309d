"""T as a polynomial of the velocities: its degree is checked, and its parts are told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy as sp

from mbkit.errors import InputError
from mbkit.lagrangian.tidy import tidy

__all__ = ["KineticSplit", "split"]


@dataclass(frozen=True)
class KineticSplit:
    """T = T2 + T1 + T0, of second, first and zeroth degree in the velocities.

    Attributes
    ----------
    T2, T1, T0 : sympy.Expr
        T2 = ½ vᵀ M v, T1 = bᵀ v.
    M : (n, n) sympy.Matrix
        ∂²T/∂v².
    b : (n, 1) sympy.Matrix
        ∂T/∂v at v = 0; not zero only where time or a drift carries the system along.

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, eq. (1.73); Lanczos 1970, ch. V.
    """

    T2: sp.Expr
    T1: sp.Expr
    T0: sp.Expr
    M: sp.ImmutableMatrix
    b: sp.ImmutableMatrix


def split(T: sp.Expr, velocities: Sequence[sp.Symbol]) -> KineticSplit:
    """Return the parts of T.

    Raises
    ------
    InputError
        T is not of second degree in the velocities; the offending term is named.
    """
    n = len(velocities)
    at_rest = dict.fromkeys(velocities, sp.Integer(0))
    p = [sp.diff(T, w) for w in velocities]
    entries = {}
    for i in range(n):
        for j in range(i, n):
            second = sp.diff(p[i], velocities[j])
            if second.free_symbols & set(velocities):
                second = _constant(T, second, velocities, at_rest)
            entries[i, j] = tidy(second)
    M = sp.ImmutableMatrix(n, n, lambda i, j: entries[min(i, j), max(i, j)])
    b = sp.ImmutableMatrix(n, 1, lambda i, _: tidy(p[i].subs(at_rest)))
    v = sp.Matrix(velocities)
    T1 = (b.T * v)[0]
    return KineticSplit(T2=(v.T * M * v)[0] / 2, T1=T1, T0=tidy(T.subs(at_rest)), M=M, b=b)


def _constant(
    T: sp.Expr, second: sp.Expr, velocities: Sequence[sp.Symbol], at_rest: dict[sp.Symbol, sp.Expr]
) -> sp.Expr:
    """Return a second derivative without velocities, or say which term of T has too many."""
    for form in (sp.expand, sp.cancel, sp.simplify):
        second = form(second)
        if not second.free_symbols & set(velocities):
            return second
    terms = sp.Add.make_args(sp.expand(T))
    # All velocities scaled by s: what is no polynomial of second degree in s is to blame.
    s = sp.Dummy("s")
    scaled = {w: s * w for w in velocities}
    blamed = [x for x in terms if sp.simplify(sp.diff(x.subs(scaled, simultaneous=True), s, 3)) != 0]
    told = blamed[0] if blamed else second.subs(at_rest)
    raise InputError(
        f"T: expected at most the second degree in the velocities {', '.join(map(str, velocities))}, "
        f"but its term {told} is not"
    )
