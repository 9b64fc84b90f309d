"""One engine and method as a work-precision curve: its points and its observed order."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeVar

import numpy as np

from mbkit._check import Array
from mbkit.studies.measurement import Measurement, run_name

T = TypeVar("T")
#: Errors below so many times the reference's floor, or the rounding level, are not in the regression.
_MIN_ERROR_PER_FLOOR: Final = 100.0
#: Errors above this part of the motion are pre-asymptotic.
_MAX_ERROR_PER_MOTION: Final = 0.03
#: Largest spread of the slopes between neighbouring points in the regression.
_MAX_SLOPE_SPREAD: Final = 0.3
_MIN_POINTS: Final = 3
#: An error that is so many times as large has turned.
_MIN_TURNED_ERROR_RATIO: Final = 1.5
#: A sweep over the study's own grid ends after so many settings in a row that bring no smaller error.
_MAX_SETTINGS_WITHOUT_GAIN: Final = 2
#: A setting is finer if it takes at least so many times the steps: a decade of a tolerance is 1.33 at order 8.
_MIN_STEPS_RATIO: Final = 1.2
#: Larger errors may still fall again, as those of steps that are too large do.
_MAX_CONVERGED_ERROR: Final = 1e-6
#: Errors that differ by less than this part are one: that of an engine's own law, such as soft loops, at any step.
_MAX_SETTLED_SPREAD: Final = 0.01


@dataclass(frozen=True)
class Curve:
    """All settings of one engine and method: its points in the order of the sweep, coarse to fine.

    `order` is the `observed_order`, NaN where fewer than three points show it, and `order_points` is the number of
    points in its regression; `expected` is the method's own order, NaN for adaptive methods. `compile` are the seconds
    of derivation, compilation and construction with empty caches, up to the first step; NaN where that failed. For a
    method that is compiled for each tolerance, they are of one tolerance. `ended` says why there are no finer settings,
    where time ran out.
    """

    engine: str
    method: str
    points: tuple[Measurement, ...]
    order: float
    order_points: int
    expected: float
    compile: float
    ended: str = ""

    @property
    def name(self) -> str:
        """Engine and method; an engine's own integrators have it in their names."""
        return run_name(self.engine, self.method)

    @property
    def turn(self) -> Measurement | None:
        """The point of least error of a fixed step, where each finer step is worse by a half and rounding grows.

        So it is of an engine in single precision, whose error in the sum of steps is some eps / dt.
        """
        fixed = [p for p in self.points if p.setting == "dt" and math.isfinite(p.error)]
        if not fixed:
            return None
        best = min(fixed, key=lambda p: p.error)
        finer = [p.error for p in fixed if p.value < best.value]
        return best if finer and min(finer) > _MIN_TURNED_ERROR_RATIO * best.error else None

    def reach(self, error: float) -> Measurement | None:
        """Return the fastest point with at most this error, if there is one."""
        return min((p for p in self.points if p.error <= error), key=lambda p: p.seconds, default=None)


def pareto_front(items: Iterable[T], place: Callable[[T], tuple[float, float]], floor: float) -> list[T]:
    """Return what none beats in both run time and error, fastest first; below the floor all errors are equal."""
    front: list[T] = []
    for item in sorted(items, key=place):
        if not front or max(place(item)[1], floor) < max(place(front[-1])[1], floor):
            front.append(item)
    return front


class ObservedOrder(NamedTuple):
    """The order, NaN where it is not observed, and the number of points in the regression."""

    order: float
    points: int


def observed_order(steps: Sequence[float], errors: Sequence[float], *, floor: float, motion: float) -> ObservedOrder:
    """Return the slope of log error over log step in the asymptotic range.

    Left out are failed runs (NaN), errors above 3 % of the motion (pre-asymptotic), errors below 100 times the
    reference's floor, and, where errors no longer fall, those below 100 times the least of them (rounding). Of the
    rest, the regression takes the longest run of neighbours whose slopes from point to point lie within 0.3 of each
    other; of two as long, the finer. The expected order plays no part in the choice.

    Examples
    --------
    >>> result = observed_order([0.1, 0.05, 0.025], [1e-4, 0.625e-5, 0.390625e-6], floor=1e-14, motion=1.0)
    >>> round(result.order, 6), result.points
    (4.0, 3)
    """
    h, e = np.asarray(steps, dtype=float), np.asarray(errors, dtype=float)
    good = np.isfinite(e) & (e > 0) & (e < _MAX_ERROR_PER_MOTION * motion)
    h, e = h[good], e[good]
    by_step = np.argsort(-h)
    h, e = h[by_step], e[by_step]
    above = e > _MIN_ERROR_PER_FLOOR * max(floor, _rounding_level(h, e))
    x, y = np.log(h[above]), np.log(e[above])
    part = _longest_steady(x, y)
    if part is None:
        return ObservedOrder(float("nan"), 0)
    return ObservedOrder(float(np.polyfit(x[part], y[part], 1)[0]), len(x[part]))


def _rounding_level(h: Array, e: Array) -> float:
    """Return the error that finer steps no longer reduce, 0 where that level is not reached."""
    if len(e) < 2:
        return 0.0
    least = int(np.argmin(e))
    flat = least < len(e) - 1 or np.log(e[-2] / e[-1]) < 0.5 * np.log(h[-2] / h[-1])
    return float(e[least]) if flat else 0.0


def _longest_steady(x: Array, y: Array) -> slice | None:
    slopes = np.diff(y) / np.diff(x)
    best: slice | None = None
    for start in range(len(slopes)):
        for stop in range(start + _MIN_POINTS - 1, len(slopes) + 1):
            if np.ptp(slopes[start:stop]) > _MAX_SLOPE_SPREAD:
                break
            if best is None or stop + 1 - start >= best.stop - best.start:
                best = slice(start, stop + 1)
    return best


def gains_nothing(cells: Sequence[Measurement], floor: float) -> bool:
    """Return whether the last settings, coarse to fine, brought no smaller error: at the floor, or at rounding."""
    # Steps that end on the saved times can be shorter than a coarse tolerance needs: of settings that hardly add a
    # step, only the first shows whether finer ones help.
    counted = [*cells[:1]]
    for cell in cells[1:]:
        if not cell.error > floor or cell.steps >= _MIN_STEPS_RATIO * counted[-1].steps:
            counted.append(cell)
    errors = [cell.error for cell in counted]
    least = min(filter(math.isfinite, errors[:-_MAX_SETTINGS_WITHOUT_GAIN]), default=math.inf)
    last = errors[-_MAX_SETTINGS_WITHOUT_GAIN - 1 :]
    if least > _MAX_CONVERGED_ERROR:
        return len(last) > _MAX_SETTINGS_WITHOUT_GAIN and max(last) - min(last) < _MAX_SETTLED_SPREAD * min(last)
    return all(not e < max(0.5 * least, floor) or e <= floor for e in errors[-_MAX_SETTINGS_WITHOUT_GAIN:])
