"""What is read from a stress result by people: how far each row held, and who held furthest."""

from __future__ import annotations

import math
import statistics
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from mbkit.studies.drawing import engine_index
from mbkit.studies.stress.result import Break, CaseResult, Cell, Outcome, Row

__all__ = [
    "RECOMMENDED",
    "Line",
    "best",
    "engines_of",
    "furthest",
    "lines",
    "name_of",
    "place",
    "recommended",
]

#: What mbkit advises who does not want to choose.
RECOMMENDED: Final = "auto"
_OWN: Final = ("pinocchio", "lagrangian")
#: Up to here an answer is of use, if not to the bar.
_USABLE: Final = ("held", "inaccurate")


@dataclass(frozen=True)
class Line:
    """One row of a case, read from mild to extreme.

    Attributes
    ----------
    row : Row
    size : int
        Number of the case's values.
    outcomes : tuple of Outcome
        Of the row's cells.
    broken : Break
    reach, usable : int
        How many values held before the first that did not; and stayed at least usable.
    """

    row: Row
    size: int
    outcomes: tuple[Outcome, ...]
    broken: Break
    reach: int
    usable: int

    @property
    def whole(self) -> bool:
        """Whether all values held."""
        return self.reach == self.size > 0

    @property
    def seconds(self) -> float:
        """Median run time where it held, or where it finished at all; NaN where it did not."""
        times = _finite(c.seconds for c in self.row.cells[: self.reach])
        times = times or _finite(c.seconds for c in self.row.cells if c.end == "finished")
        return statistics.median(times) if times else math.nan

    @property
    def left_out(self) -> bool:
        """Whether it never ran: refused, or not reached, at every value."""
        return all(how in ("refused", "not run") for how in self.outcomes)

    @property
    def ended(self) -> tuple[Cell, Outcome] | None:
        """The first cell that was not even usable, if there is one."""
        at = self.usable
        found = at < len(self.row.cells) and self.outcomes[at] not in ("unjudged", "not run")
        return (self.row.cells[at], self.outcomes[at]) if found else None

    @property
    def rest(self) -> Outcome | None:
        """What follows what held: the first failure, what hides it (unjudged, not run), or nothing."""
        if self.broken.how:
            return self.broken.how
        return None if self.whole else self.outcomes[self.reach] if self.reach < len(self.outcomes) else "not run"


def lines(case: CaseResult) -> list[Line]:
    """Return the rows of a case, the furthest first: by what held, by what was usable, by run time."""
    return sorted((_line(row, case) for row in case.rows), key=_rank)


def _line(row: Row, case: CaseResult) -> Line:
    outcomes = tuple(cell.outcome(case.bar) for cell in row.cells)
    usable = next((k for k, how in enumerate(outcomes) if how not in _USABLE), len(outcomes))
    return Line(row, len(case.values), outcomes, row.breaking(case.bar), row.reach(case.bar), usable)


def _rank(line: Line) -> tuple[float, ...]:
    seconds = line.seconds
    silent_ones = line.outcomes.count("silent")
    return -line.reach, -line.usable, silent_ones, math.inf if math.isnan(seconds) else seconds


def _finite(numbers: Iterable[float]) -> list[float]:
    return [x for x in numbers if math.isfinite(x)]


def name_of(row: Row) -> str:
    """Return engine and method; MuJoCo's own integrators have the engine in their names."""
    return row.method if row.method.startswith(f"{row.engine}_") else f"{row.engine} {row.method}"


def engines_of(cases: Iterable[CaseResult]) -> list[str]:
    """Return the engines that are in any row, in the order of every figure."""
    found = dict.fromkeys(row.engine for case in cases for row in case.rows)
    return sorted(found, key=engine_index)


def best(case: CaseResult) -> dict[str, Line]:
    """Return what speaks for each engine: its furthest method, or of the terms that it has the first to break."""
    out: dict[str, Line] = {}
    ranked = lines(case)
    if case.measure == "terms":
        ranked = sorted(ranked, key=lambda line: (line.left_out, line.reach, line.usable))
    for line in ranked:
        out.setdefault(line.row.engine, line)
    return out


def recommended(case: CaseResult) -> Line | None:
    """Return mbkit's own choice of method, on the engine where it held furthest, if it was run."""
    own = (x for x in lines(case) if x.row.method == RECOMMENDED and x.row.engine in _OWN)
    return next((x for x in own if not x.left_out), None)


def furthest(case: CaseResult) -> int:
    """Return how many values the best held; of terms, the best engine in all of them."""
    return max((line.reach for line in best(case).values()), default=0)


def place(values: Sequence[float], x: float) -> float:
    """Return where a number stands among the values of a sweep, as a fractional index.

    Decades are even where all are positive. -1 and the number of values stand for what is beyond the ends; NaN for
    no number, and where the values are in no order.
    """
    if math.isnan(x) or not values or not all(map(math.isfinite, values)):
        return math.nan
    decades = min(values) > 0
    sign = -1.0 if values[-1] < values[0] else 1.0

    def mark(v: float) -> float:
        if not decades or math.isinf(v):
            return sign * v
        return sign * (math.log(v) if v > 0 else -math.inf)

    marks, at = [mark(v) for v in values], mark(x)
    if any(b <= a for a, b in pairwise(marks)):
        return math.nan
    if at < marks[0] or at > marks[-1]:
        return -1.0 if at < marks[0] else float(len(marks))
    k = min(bisect_right(marks, at), len(marks) - 1)
    return k - 1 + (at - marks[k - 1]) / (marks[k] - marks[k - 1]) if k else 0.0
