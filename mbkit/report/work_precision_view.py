"""The work-precision study as a figure, and what is read from it for tables."""

from __future__ import annotations

import io
import itertools
import math
from dataclasses import dataclass
from typing import Final

from mbkit.report.figures import PAGE, page_style, svg
from mbkit.report.formatting import count_text, time_text
from mbkit.studies.work_precision.curve import Curve, PrecisionPoint
from mbkit.studies.work_precision.figure import USEFUL, figure
from mbkit.studies.work_precision.result import WorkPrecision

__all__ = [
    "CurveLine",
    "Lead",
    "Level",
    "curve_lines",
    "curve_name",
    "error_against_time",
    "front_names",
    "headline",
    "leads",
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
    """Who reaches an error in the least time, and who is first among the other engines.

    Attributes
    ----------
    error : float
    curve, point : Curve, PrecisionPoint
    next : (Curve, PrecisionPoint) or None
        The fastest of another engine that reaches this error.
    """

    error: float
    curve: Curve
    point: PrecisionPoint
    next: tuple[Curve, PrecisionPoint] | None

    @property
    def factor(self) -> float:
        """How many times as long the next engine takes; NaN where none reaches the error."""
        return self.next[1].seconds / self.point.seconds if self.next else math.nan

    @property
    def next_engine(self) -> str:
        """The engine of `next`; empty where there is none."""
        return self.next[0].engine if self.next else ""


@dataclass(frozen=True)
class Lead:
    """One run, and all the errors for which it is the fastest: from the largest to the least."""

    levels: tuple[Level, ...]

    @property
    def curve(self) -> Curve:
        """Engine and method."""
        return self.levels[0].curve

    @property
    def point(self) -> PrecisionPoint:
        """The run."""
        return self.levels[0].point

    @property
    def errors(self) -> str:
        """The errors, as a range where there are several."""
        first, last = f"{self.levels[0].error:.0e}", f"{self.levels[-1].error:.0e}"
        return first if len(self.levels) == 1 else f"{first} to {last}"

    @property
    def nexts(self) -> list[tuple[str, str, str]]:
        """Engine, methods and times as long of the fastest of other engines, which may change with the error."""
        out = []
        for engine, group in itertools.groupby(self.levels, key=lambda x: x.next_engine):
            some = list(group)
            methods = ", ".join(dict.fromkeys(x.next[0].method for x in some if x.next))
            factors = dict.fromkeys(count_text(x.factor) for x in (some[0], some[-1]))
            out.append((engine or "none", methods, " to ".join(factors)))
        return out


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


def leads(result: WorkPrecision) -> list[Lead]:
    """Return the fastest runs, each once, with the errors for which it is the fastest."""
    return [Lead(tuple(group)) for _, group in itertools.groupby(levels(result), key=lambda level: id(level.point))]


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
    missing = "".join(f"; {x}" for x in result.shortened if x != "interrupted")
    found = levels(result)
    if not found:
        return f"{stopped}no run has an error of at most {10.0 ** _EXPONENTS[0]:g} rad or m{missing}"
    parts = []
    for name, group in itertools.groupby(found, key=lambda level: curve_name(level.curve)):
        first, *rest = [f"{level.error:.0e}" for level in group]
        parts.append(f"{name} for an error of {first}" + (f" to {rest[-1]}" if rest else ""))
    count = f"{len(result.curves)} curve{'s' * (len(result.curves) != 1)}"
    return f"{stopped}fastest of {count}: {', '.join(parts)}{missing}"


def error_against_time(result: WorkPrecision) -> str:
    """Draw the figure of error against run time, for the page."""
    with page_style("precision"):
        return svg(
            figure(result.curves, result.duration, result.floor, PAGE), "Error against run time, by engine and method"
        )


def picture(result: WorkPrecision) -> bytes:
    """Return the same figure as PNG on white."""
    stream = io.BytesIO()
    fig = figure(result.curves, result.duration, result.floor)
    fig.savefig(stream, format="png", dpi=_DOTS_PER_INCH, facecolor="white", metadata={"Software": "mbkit"})
    return stream.getvalue()
