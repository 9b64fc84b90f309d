"""An inertia as a sum of squares of rates, in rational numbers.

What the description's doubles say is rounded once, however thin the body: LᵀDL in doubles, or principal axes, would
lose an inertia about the long axis of a rod as it loses what is left of a mass matrix.
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Final, NamedTuple

__all__ = ["InertiaSquare", "inertia_squares"]

_PAIRS: Final = tuple(combinations_with_replacement(range(3), 2))


class InertiaSquare(NamedTuple):
    """One of the rates u · ω with Σ weight u uᵀ = I.

    Attributes
    ----------
    weight : float
        kg m². Below zero by rounding, where the doubles' matrix is so.
    direction : tuple of 3 floats
        u.
    turning : tuple of ((int, int), float)
        A form in ω: the rows' forms c have Σ weight u c = ω × I ω.
    """

    weight: float
    direction: tuple[float, ...]
    turning: tuple[tuple[tuple[int, int], float], ...]


_Form = dict[tuple[int, int], Fraction]


@lru_cache(maxsize=1024)
def inertia_squares(inertia: tuple[float, ...]) -> tuple[InertiaSquare, ...] | None:
    """Return the squares of an inertia given row by row; None where there are none, as of no matter."""
    exact = [Fraction(x) for x in inertia]
    I = [exact[3 * i : 3 * i + 3] for i in range(3)]
    torque = _torque(I)
    left, out = [0, 1, 2], []
    while any(I[i][j] for i in left for j in left):
        pivot = max(left, key=lambda i: abs(I[i][i]))
        weight, form = I[pivot][pivot], torque[pivot]
        if not weight:
            return None
        u = [I[pivot][j] / weight if j in left else Fraction(0) for j in range(3)]
        left.remove(pivot)
        for i in left:
            torque[i] = {pair: torque[i][pair] - u[i] * form[pair] for pair in _PAIRS}
        I = [[I[i][j] - weight * u[i] * u[j] for j in range(3)] for i in range(3)]
        try:
            turning = tuple((pair, float(x / weight)) for pair, x in form.items() if x)
            out.append(InertiaSquare(float(weight), tuple(float(x) for x in u), turning))
        except OverflowError:
            return None
    # A torque that no motion of the body resists.
    if any(x for i in left for x in torque[i].values()):
        return None
    return tuple(out)


def _torque(I: list[list[Fraction]]) -> list[_Form]:
    """Return ω × I ω as three forms in ω."""
    out: list[_Form] = []
    for i in range(3):
        form = dict.fromkeys(_PAIRS, Fraction(0))
        for a, b, sign in (((i + 1) % 3, (i + 2) % 3, 1), ((i + 2) % 3, (i + 1) % 3, -1)):
            for j in range(3):
                form[min(a, j), max(a, j)] += sign * I[b][j]
        out.append(form)
    return out
