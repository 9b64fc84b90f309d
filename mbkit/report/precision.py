"""The work-precision study as a figure, and what is read from it for tables."""

from __future__ import annotations

import io
import itertools
import math
from dataclasses import dataclass
from typing import Final

from mbkit.report.drawing import PAGE, page_style, svg
from mbkit.report.numbers import time_text
from mbkit.studies.precision_figure import USEFUL, figure
from mbkit.studies.precision_result import Curve, PrecisionPoint, WorkPrecision

__all__ = [
    "CurveLine",
    "Level",
    "curve_lines",
    "curve_name",
    "error_against_time",
    "front_names",
    "headline",
    "levels",
    "picture",
    "setting_text",
]

#: An observed order farther than this from the method's own is flagged.
ORDER_TOLERANCE: Final = 0.2
_EXPONENTS: Final = range(-2, -15, -2)
_DOTS_PER_INCH: Final = 160


@dataclass(frozen=True)
class Level:
    """Who reaches an error in the least time, and who is first among the other engines."""

    error: float
    curve: Curve
    point: PrecisionPoint
    next: tuple[Curve, PrecisionPoint] | None

    @property
    def factor(self) -> float:
        """How many times as long the next engine takes; NaN where none reaches the error."""
        return self.next[1].seconds / self.point.seconds if self.next else math.nan


@dataclass(frozen=True)
class CurveLine:
    """One engine and method in one line.

    Attributes
    ----------
    curve : Curve
    best : PrecisionPoint or None
        With the least error, the fastest of several that are as good as the reference
        can tell.
    off : bool
        Whether the observed order is not the method's own.
    on_front : bool
    """

    curve: Curve
    best: PrecisionPoint | None
    off: bool
    on_front: bool


def levels(result: WorkPrecision) -> list[Level]:
    """Return the fastest for each error that anyone reaches, as far as the reference can tell."""
    out = []
    for exponent in _EXPONENTS:
        error = 10.0**exponent
        first = result.fastest(error)
        if first is None or error < result.floor:
            break
        out.append(Level(error, *first, _fastest_beside(first[0].engine, result, error)))
    return out


def _fastest_beside(engine: str, result: WorkPrecision, error: float) -> tuple[Curve, PrecisionPoint] | None:
    reached = [(c, p) for c, p in result.rows() if p.error <= error and c.engine != engine]
    return min(reached, key=lambda item: item[1].seconds, default=None)


def curve_lines(result: WorkPrecision) -> list[CurveLine]:
    """Return every curve in one line, in the order of the curves."""
    front = {id(c) for c, p in result.front if p.error <= USEFUL}
    floor = result.floor if math.isfinite(result.floor) else 0.0
    out = []
    for curve in result.curves:
        ended = [p for p in curve.points if math.isfinite(p.error)]
        best = min(ended, key=lambda p: (max(p.error, floor), p.seconds), default=None)
        off = abs(curve.order - curve.expected) > ORDER_TOLERANCE
        out.append(CurveLine(curve, best, off, id(curve) in front))
    return out


def curve_name(curve: Curve) -> str:
    """Return engine and method; MuJoCo's own integrators have the engine in their names."""
    return curve.method if curve.method.startswith(f"{curve.engine}_") else f"{curve.engine} {curve.method}"


def front_names(result: WorkPrecision) -> list[str]:
    """Return the names of the curves on the front, the fastest first; no answers are left out."""
    return list(dict.fromkeys(curve_name(c) for c, p in result.front if p.error <= USEFUL))


def setting_text(point: PrecisionPoint) -> str:
    """Return the step with its unit, or the tolerance."""
    return f"dt {time_text(point.value)}" if point.setting == "dt" else f"rtol {point.value:.0e}"


def headline(result: WorkPrecision) -> str:
    """Return who is fastest at which error, in one sentence."""
    stopped = "" if result.complete else "interrupted; what was finished: "
    found = levels(result)
    if not found:
        return f"{stopped}no run has an error of at most {10.0 ** _EXPONENTS[0]:g} rad or m"
    parts = []
    for name, group in itertools.groupby(found, key=lambda level: curve_name(level.curve)):
        first, *rest = [f"{level.error:.0e}" for level in group]
        parts.append(f"{name} for an error of {first}" + (f" to {rest[-1]}" if rest else ""))
    count = f"{len(result.curves)} curve{'s' * (len(result.curves) != 1)}"
    return f"{stopped}fastest of {count}: {', '.join(parts)}"


def error_against_time(result: WorkPrecision) -> str:
    """Draw the figure of error against run time, for the page."""
    with page_style("precision"):
        return svg(figure(result, PAGE), "Error against run time, by engine and method")


def picture(result: WorkPrecision) -> bytes:
    """Return the same figure as PNG on white."""
    stream = io.BytesIO()
    figure(result).savefig(stream, format="png", dpi=_DOTS_PER_INCH, facecolor="white", metadata={"Software": "mbkit"})
    return stream.getvalue()
