"""Which method for which kind of scene: how often none held further, and at what price."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass

from mbkit.report.stress import ranks
from mbkit.studies.drawing import engine_index
from mbkit.studies.stress.reading import Line, lines, name_of
from mbkit.studies.stress.result import StressResult

__all__ = ["MethodLine", "methods"]


@dataclass(frozen=True)
class MethodLine:
    """One engine and method over the families.

    Attributes
    ----------
    name : str
        Engine and method.
    series : int
        Of the engine's colour.
    families : dict of str to (int, int)
        Cases where none held further, and cases where it was asked.
    ahead, cases : int
        The same of all families.
    held : float
        Part of a sweep that held, the mean over the cases.
    silent : int
        Cases where it was wrong in silence.
    factor : float
        Run time over the least of those that held as far, the median over the cases where none held further;
        NaN where there is none.
    """

    name: str
    series: int
    families: dict[str, tuple[int, int]]
    ahead: int
    cases: int
    held: float
    silent: int
    factor: float


@dataclass(frozen=True)
class _Score:
    """A row on one case."""

    family: str
    line: Line
    ahead: bool
    factor: float


def methods(result: StressResult) -> list[MethodLine]:
    """Return every engine and method that ran, the one that was most often unbeaten first.

    Terms have no methods, and a sweep of the step asks for stability alone: neither counts.
    """
    found: dict[tuple[str, str], list[_Score]] = {}
    for case in result.cases:
        if not ranks(case):
            continue
        ranked = lines(case)
        most = max((line.reach for line in ranked), default=0)
        least = min((line.seconds for line in ranked if line.reach == most and line.seconds > 0), default=math.nan)
        for line in ranked:
            ahead = line.reach == most > 0
            score = _Score(case.family, line, ahead, line.seconds / least if ahead else math.nan)
            found.setdefault((line.row.engine, line.row.method), []).append(score)
    out = [_summed(scores) for scores in found.values() if not all(s.line.left_out for s in scores)]
    return sorted(out, key=lambda m: (-m.ahead, -m.held, m.silent, math.isnan(m.factor), m.factor))


def _summed(scores: list[_Score]) -> MethodLine:
    families: dict[str, tuple[int, int]] = {}
    for s in scores:
        ahead, asked = families.get(s.family, (0, 0))
        families[s.family] = ahead + s.ahead, asked + 1
    factors = [s.factor for s in scores if math.isfinite(s.factor)]
    row = scores[0].line.row
    return MethodLine(
        name_of(row),
        engine_index(row.engine) + 1,
        families,
        sum(s.ahead for s in scores),
        len(scores),
        statistics.fmean(s.line.reach / max(s.line.size, 1) for s in scores),
        sum("silent" in s.line.outcomes for s in scores),
        statistics.median(factors) if factors else math.nan,
    )
