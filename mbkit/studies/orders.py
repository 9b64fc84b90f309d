"""The observed order of a fixed-step method: the slope of log error over log step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from mbkit._check import Array

__all__ = ["ObservedOrder", "observed_order"]

#: An error this many times what the reference is known to, or the rounding seen, is the method's own to a hundredth.
_ABOVE: Final = 100.0
#: An error beyond this part of the motion itself tells of no series in the step.
_COARSE: Final = 0.03
#: Within the range of the regression, slopes from point to point differ by less than this.
_STEADY: Final = 0.3
_FEWEST: Final = 3


class ObservedOrder(NamedTuple):
    """The order, NaN where it is not seen, and how many points it is taken from."""

    order: float
    points: int


def observed_order(steps: Sequence[float], errors: Sequence[float], *, floor: float, motion: float) -> ObservedOrder:
    """Return the slope of log error over log step where the method shows its order.

    Points count that are neither pre-asymptotic nor at rounding. At rounding are
    errors below 100 times the reference's floor, and, where the errors have stopped
    falling, below 100 times the least of them. Pre-asymptotic are errors above 3 % of the
    motion. Of what is left the longest run of neighbours is taken whose slopes from
    point to point all lie within 0.3 of each other; of two as long, the finer. The
    expected order plays no part in the choice.

    Parameters
    ----------
    steps, errors : sequences of float
        s; rad or m, NaN where a run failed.
    floor : float
        How well the reference is known.
    motion : float
        Size of the motion in the units of the errors.

    Examples
    --------
    >>> found = observed_order([0.1, 0.05, 0.025], [1e-4, 0.625e-5, 0.390625e-6], floor=1e-14, motion=1.0)
    >>> round(found.order, 6), found.points
    (4.0, 3)
    """
    h, e = np.asarray(steps, dtype=float), np.asarray(errors, dtype=float)
    good = np.isfinite(e) & (e > 0) & (e < _COARSE * motion)
    h, e = h[good], e[good]
    by_step = np.argsort(-h)
    h, e = h[by_step], e[by_step]
    above = e > _ABOVE * max(floor, _rounding(h, e))
    first = _longest(np.log(h[above]), np.log(e[above]))
    if first is None:
        return ObservedOrder(float("nan"), 0)
    x, y = np.log(h[above])[first], np.log(e[above])[first]
    return ObservedOrder(float(np.polyfit(x, y, 1)[0]), len(x))


def _rounding(h: Array, e: Array) -> float:
    """Return the level at which finer steps bring nothing, 0 where that is not reached."""
    if len(e) < 2:
        return 0.0
    least = int(np.argmin(e))
    flat = least < len(e) - 1 or np.log(e[-2] / e[-1]) < 0.5 * np.log(h[-2] / h[-1])
    return float(e[least]) if flat else 0.0


def _longest(x: Array, y: Array) -> slice | None:
    """Return the longest run of neighbouring points with steady slopes, the finer of two as long."""
    slopes = np.diff(y) / np.diff(x)
    best: slice | None = None
    for start in range(len(slopes)):
        for stop in range(start + _FEWEST - 1, len(slopes) + 1):
            part = slopes[start:stop]
            if np.ptp(part) > _STEADY:
                break
            if best is None or stop + 1 - start >= best.stop - best.start:
                best = slice(start, stop + 1)
    return best
