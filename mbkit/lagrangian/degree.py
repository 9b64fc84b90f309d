"""T as a polynomial of the velocities: its degree is checked, and its parts are told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import mpmath
import sympy as sp

from mbkit.errors import InputError
from mbkit.lagrangian.probe import DIGITS, Probe
from mbkit.lagrangian.tidy import LARGE, tidy

__all__ = ["KineticSplit", "split"]

#: Lines through the velocities, and places on each.
_LINES: Final = 4
_STEPS: Final = (3, 1, -1, -3)
#: Of 30 digits, what a third difference that is zero has left.
_ROUNDED: Final = 1e-20


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
    p = [sp.diff(T, w) for w in velocities]
    seconds = {(i, j): sp.diff(p[i], velocities[j]) for i in range(n) for j in range(i, n)}
    if any(_moves(x, velocities) for x in seconds.values()):
        _check(T, velocities)
    entries = {place: tidy(_at_rest(x, velocities, sp.Integer(0))) for place, x in seconds.items()}
    M = sp.ImmutableMatrix(n, n, lambda i, j: entries[min(i, j), max(i, j)])
    v = sp.Matrix(velocities)
    b = sp.ImmutableMatrix(n, 1, [tidy(_at_rest(x, velocities, (M[i, :] * v)[0])) for i, x in enumerate(p)])
    T2, T1 = (v.T * M * v)[0] / 2, (b.T * v)[0]
    return KineticSplit(T2=T2, T1=T1, T0=tidy(_at_rest(T, velocities, T2 + T1)), M=M, b=b)


def _moves(x: sp.Expr, velocities: Sequence[sp.Symbol]) -> bool:
    return bool(x.free_symbols & set(velocities))


def _at_rest(x: sp.Expr, velocities: Sequence[sp.Symbol], gained: sp.Expr) -> sp.Expr:
    """Return an expression at rest; where it has no value there, at other velocities and less what it gains by them."""
    n = len(velocities)
    for speeds in ((0,) * n, range(1, n + 1), range(2, 2 * n + 1, 2)):
        put = dict(zip(velocities, map(sp.Integer, speeds), strict=True))
        out = x.subs(put)
        if not out.has(sp.nan, sp.zoo, sp.oo, -sp.oo):
            return out - gained.subs(put)
    return x


def _check(T: sp.Expr, velocities: Sequence[sp.Symbol]) -> None:
    """Refuse T where it is no polynomial of second degree, with the first term that is none either."""
    if _quadratic(T, velocities):
        return
    terms = sp.Add.make_args(sp.expand_mul(T) if T.count_ops() <= LARGE else T)
    told = next((x for x in terms if not _quadratic(x, velocities)), T)
    raise InputError(
        f"T: expected at most the second degree in the velocities {', '.join(map(str, velocities))}, "
        f"but its term {told} is not"
    )


def _quadratic(x: sp.Expr, velocities: Sequence[sp.Symbol]) -> bool:
    """Return whether an expression is of second degree at most: along random lines its third differences are zero."""
    probe = Probe([x], velocities)
    with mpmath.workdps(DIGITS):
        for seed in range(_LINES):
            start, way = probe.place(2 * seed), probe.place(2 * seed + 1)
            # Through velocities of both signs, where what has a kink shows it.
            places = ({c: y / 3 + s * way[c] if c in velocities else y for c, y in start.items()} for s in _STEPS)
            values = [point[0] for point in map(probe, places) if point is not None]
            if len(values) < len(_STEPS):
                continue
            third = sum(k * value for k, value in zip((1, -3, 3, -1), values, strict=True))
            if abs(third) > _ROUNDED * max(abs(value) for value in values):
                return False
    return True
