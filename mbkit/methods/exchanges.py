"""Forces of friction at rest, found by rounds of exchanges on any arithmetic: arrays of problems, or symbols of one.

Forces λ of joints at rest make accelerations a = b + A λ. Those within their bounds keep a joint at rest, those at a
bound push against its motion: λ minimizes ½ λᵀ A λ + bᵀ λ in a box. The set of forces at their bounds is exchanged as a
whole as long as fewer conditions fail, then one by one, the last first, which ends (Murty 1974, Linear Algebra and its
Applications 9; Júdice and Pires 1994, Computers and Operations Research 21). Of a semidefinite A, λ is the limit of
proximal points, whose A is definite (Rockafellar 1976, SIAM Journal on Control and Optimization 14).

First all hold up to their bounds. Of those that would move, the one whose friction takes the most power lets go: on
that side it has the friction of motion from then on, and the problem is solved again with what the others feel of it.
It may come to hold after all. Each time a bound is lowered, so that there are 2 n at most, and the last is consistent:
a joint holds within its bound, or moves against the friction of motion. A joint at its stop has a bound on one side.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit._check import EPS, TYPED, Array
from mbkit.model.parts import ROUNDING

#: Rounds of exchanges in one call of machine code: as many as proximal points take.
ROUNDS: Final = 2
#: Rounds of exchanges that may leave as many conditions failing; then conditions are exchanged one by one.
PATIENCE: Final = 3
#: Part of the forces that their sums lose to rounding.
FORCE_ROUNDING: Final = 64 * EPS
#: Addition to the diagonal of a singular A: far from its own rounding and from what is not rounding.
PROXIMAL_SHIFT: Final = 2.0**-32


class Operations(NamedTuple):
    """Operations on the entries of a problem: matrix times column, its solution in some entries, sums and choices."""

    times: Callable[[Any, Any], Any]
    #: (A, right, on) -> the x with A x = right in the entries that are on, where x is zero in the others.
    solved: Callable[[Any, Any, Any], Any]
    total: Callable[[Any], Any]
    largest: Callable[[Any], Any]
    #: Sums from each entry to the last.
    behind: Callable[[Any], Any]
    choose: Callable[[Any, Any, Any], Any]
    size: Callable[[Any], Any]
    sign: Callable[[Any], Any]


def restricted(A: Array, right: Array, on: Any, *, definite: bool = True) -> Array:
    """Return the x with A x = right in the entries that are on, and zero in the others, (N, n)."""
    # The others have an equation of their own, of the size of A.
    on = np.asarray(on, dtype=np.bool_)
    size = np.abs(np.einsum("nii->ni", A)).max(axis=1, initial=1e-300)[:, None, None]
    own = np.where(on[:, :, None] & on[:, None, :], A, size * np.eye(A.shape[-1]) * ~on[:, :, None])
    right = np.where(on, right, 0.0)[..., None]
    x = np.linalg.solve(own, right) if definite else np.linalg.pinv(own, rcond=PROXIMAL_SHIFT, hermitian=True) @ right
    return np.asarray(x[..., 0])


ARRAYS: Final = Operations(
    times=lambda A, x: (A @ x[..., None])[..., 0],
    solved=restricted,
    total=lambda x: x.sum(axis=-1, keepdims=True),
    largest=lambda x: x.max(axis=-1, keepdims=True, initial=0.0),
    behind=lambda x: np.cumsum(x[..., ::-1], axis=-1)[..., ::-1],
    choose=np.where,
    size=np.abs,
    sign=np.sign,
)


class Problem(NamedTuple):
    """Responses A, accelerations b, bounds at rest, and `less` of motion; of joints that are `on`, others have none.

    `known` are the forces of joints that are about to move, zero of the others; `noise` is the rounding of a. `shift`
    is None where A is definite, else the addition to the diagonal, which `own` has.
    """

    A: Any
    own: Any
    b: Any
    bound: Any
    less: Any
    on: Any
    known: Any
    noise: Any
    shift: Any
    #: 1 for joints at their lower stops, -1 at their upper ones, and the rounding of forces there; None without stops.
    stop: Any = None
    slack: Any = None


class Signs(NamedTuple):
    """Bounds now, which known forces still count, signs of the forces at bounds, and how the search goes on."""

    low: Any
    high: Any
    free: Any
    side: Any
    #: The least number of failures so far, and how many rounds may fail to have fewer.
    best: Any
    left: Any
    #: The last proximal point.
    before: Any


def noise(A: Array, b: Array, bound: Array, stop: Array | None = None) -> Array:
    """Return the rounding of accelerations under forces up to their bounds, or those that `stop` a joint, (N, n)."""
    if stop is not None:
        bound = bound + np.abs(stop * b) / np.abs(np.einsum("nii->ni", A))
    return np.asarray(FORCE_ROUNDING * (np.abs(b) + (np.abs(A) @ bound[..., None])[..., 0]))


def exchange(o: Operations, p: Problem, s: Signs, n: int) -> tuple[Signs, Any, Any, Any]:
    """Return the signs after a round; with them the forces, which of them hold, and whether to go on."""
    held, half, middle = p.on * (1 - s.free), 0.5 * (s.high - s.low), 0.5 * (s.low + s.high)
    if p.stop is not None:
        half = o.choose(p.stop != 0, 0.0, half)
        middle = o.choose(p.stop > 0, s.low, o.choose(p.stop < 0, s.high, middle))
    middle = o.choose(held, middle, o.choose(p.on, p.known, 0.0))
    fixed, inner = s.side * half, held * (s.side == 0)
    pushed = p.b + o.times(p.A, middle) - (0.0 if p.shift is None else p.shift * s.before)
    x = o.choose(inner, o.solved(p.own, -pushed - o.times(p.own, fixed), inner), fixed)
    beyond: Any = o.size(x) > half * (1 + ROUNDING)
    if p.stop is not None:
        beyond = o.choose(p.stop != 0, p.stop * x < -p.slack, beyond)
    wrong = o.choose(inner, beyond, s.side * (pushed + o.times(p.own, x)) > p.noise)
    count = o.total(wrong)
    fewer, settled = count < s.best, count == 0
    change = o.choose((1 - fewer) * (s.left <= 0), wrong * (o.behind(wrong) == 1), wrong)
    side = o.choose(change, o.choose(inner, o.sign(x), 0.0), s.side)
    near: Any = 0.0
    if p.shift is not None:
        near = o.largest(p.shift * o.size(x - s.before) > p.noise)
    forces = o.choose(s.side < 0, s.low, o.choose(s.side > 0, s.high, middle + x))
    rate = p.b + o.times(p.A, forces)
    # Forces of loops are not unique: what is at its bound may be held by the others, to the rounding of A.
    least = PROXIMAL_SHIFT / FORCE_ROUNDING * p.noise
    moves = s.side != 0 if p.shift is None else s.side * rate < -least
    if p.stop is not None:
        # What its stop neither pushes nor lets go rests.
        moves = moves * o.choose(p.stop != 0, p.stop * rate > p.noise, 1.0)
    falls = moves * (o.size(forces) > p.less) * settled * (1 - near)
    power = o.choose(falls, o.size(rate) * p.bound, 0.0)
    # Joints whose power differs by less let go together, as rounding does not break a symmetry.
    first = falls * (power >= (1 - TYPED) * o.largest(power))
    # A joint that is known to leave may be held by what the others do then.
    again = o.largest(first)
    signs = Signs(
        o.choose(first * (s.side < 0), -p.less, s.low),
        o.choose(first * (s.side > 0), p.less, s.high),
        s.free * (1 - again),
        side,
        o.choose(settled, n + 1.0, o.choose(fewer, count, s.best)),
        o.choose(settled + fewer > 0, PATIENCE, s.left - (s.left > 0)),
        s.before if p.shift is None else o.choose(settled, x * (1 - again), s.before),
    )
    return signs, forces, held * (1 - moves), 1 - settled * (1 - near) * (1 - again)
