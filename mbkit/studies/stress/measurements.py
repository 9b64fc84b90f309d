"""Data of a stress study: the measurement of each cell, rows and cases, and how far each row held."""

from __future__ import annotations

import math
import statistics
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal

from mbkit.engines.registry import DERIVED, PINOCCHIO
from mbkit.methods.registry import AUTOMATIC_METHOD
from mbkit.studies._figure_style import engine_index

#: How a run or an evaluation ended, before its error is judged.
End = Literal["finished", "diverged", "nan", "refused", "slow", "died", "not run"]
#: With its error: held; above the bar, yet within `GROSS`; grossly wrong with a warning or without one; finished, with
#: no truth to judge it by this bar; or how it ended.
Outcome = Literal[
    "held", "inaccurate", "warned", "silent", "unjudged", "diverged", "nan", "refused", "slow", "died", "not run"
]

#: The default bar: a relative error that plots cannot hide and papers accept.
BAR: Final = 1e-6
#: Where an answer is no longer inaccurate but wrong: a hundredth of the motion, or of the term. A method of low order
#: misses the bar with every affordable step, and misleads nobody by that.
GROSS: Final = 1e-2


@dataclass(frozen=True)
class Measurement:
    """One engine and method at one value.

    Attributes
    ----------
    value : float
        Of the case's parameter.
    end : str
        ``"finished"``; ``"diverged"`` where the run said so itself; ``"nan"`` where numbers are not finite and nothing
        was said; ``"refused"``, an error of its own; ``"slow"``, stopped at the time allowed; ``"died"``, the process
        ended or took too much memory; ``"not run"``.
    error : float
        Relative to the problem's scale (motion, terms), or of the energy where that is the measure; NaN where there is
        none, or no truth to measure it by.
    energy : float
        Largest relative energy error, NaN where forces do work or nothing was integrated.
    seconds : float
        Processor time of the run, or of one evaluation of a term, without compilation.
    steps : int
    warnings : tuple of str
    note : str
        Why it ended, what was chosen.
    floor : float
        Error of the truth, on the same scale.
    """

    value: float
    end: End
    error: float = math.nan
    energy: float = math.nan
    seconds: float = math.nan
    steps: int = 0
    warnings: tuple[str, ...] = ()
    note: str = ""
    floor: float = 0.0

    @property
    def seen(self) -> float:
        """The error that counts: its own, or that of the energy where there is no truth.

        A wrong energy speaks against a run, but a right one does not speak for it.
        """
        return self.energy if math.isnan(self.error) else self.error

    def outcome(self, bar: float) -> Outcome:
        """Return the outcome by this bar on the error."""
        if self.end != "finished":
            return self.end
        seen = self.seen
        if math.isnan(seen) or abs(seen - bar) <= self.floor or (math.isnan(self.error) and seen <= bar):
            return "unjudged"
        if seen <= bar:
            return "held"
        if seen <= max(bar, GROSS):
            return "inaccurate"
        return "warned" if self.warnings else "silent"


@dataclass(frozen=True)
class BreakingPoint:
    """Where an engine and method breaks.

    Attributes
    ----------
    held : float or None
        The last value up to which all milder ones held, too; None where the mildest did not.
    failed : float or None
        The first that did not; None where all held.
    how : str
        The outcome there; empty where all held.
    cell : Measurement or None
        The measurement there.
    """

    held: float | None
    failed: float | None
    how: Outcome | Literal[""]
    cell: Measurement | None


@dataclass(frozen=True)
class Row:
    """One engine and method over all values of a case.

    Attributes
    ----------
    engine, method : str
        For terms, the method is the term.
    cells : tuple of Measurement
        In the order of the case's values.
    setting : str
        The step or tolerance.
    theory : float or None
        Where linear theory lets it break; infinite where it does not, ``"no limit"`` in JSON.
    """

    engine: str
    method: str
    cells: tuple[Measurement, ...]
    setting: str = ""
    theory: float | None = None

    def breaking(self, bar: float) -> BreakingPoint:
        """Return the last value that held and the first that did not."""
        held: float | None = None
        for cell in self.cells:
            how = cell.outcome(bar)
            if how in ("not run", "unjudged"):
                break
            if how != "held":
                return BreakingPoint(held, cell.value, how, cell)
            held = cell.value
        return BreakingPoint(held, None, "", None)

    def reach(self, bar: float) -> int:
        """Return how many values held before the first that did not."""
        return next((k for k, cell in enumerate(self.cells) if cell.outcome(bar) != "held"), len(self.cells))


@dataclass(frozen=True)
class CaseResult:
    """All engines and methods on one case.

    Attributes
    ----------
    name, about, family, parameter, unit, measure, why : str
        As of the `Case`.
    bar : float
        The one that counts here.
    values : tuple of float
    truths : tuple of str
        How each value's truth is known, and to which floor.
    facts : tuple of dict
        Further numbers of each value.
    rows : tuple of Row
    """

    name: str
    about: str
    family: str
    parameter: str
    unit: str
    measure: str
    bar: float
    why: str
    values: tuple[float, ...]
    truths: tuple[str, ...]
    facts: tuple[dict[str, float], ...]
    rows: tuple[Row, ...]


# How far each row held

#: The method that mbkit recommends, and the engines that it is recommended on.
RECOMMENDED: Final = AUTOMATIC_METHOD
#: Outcomes of use, if not to the bar.
_USABLE: Final = ("held", "inaccurate")


@dataclass(frozen=True)
class Line:
    """One row of a case, read from mild to extreme."""

    row: Row
    #: Number of the case's values.
    size: int
    outcomes: tuple[Outcome, ...]
    broken: BreakingPoint
    #: How many values held before the first that did not, and how many stayed at least usable.
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
    def ended(self) -> tuple[Measurement, Outcome] | None:
        """The first cell that was not even usable, if there is one."""
        at = self.usable
        failed = at < len(self.row.cells) and self.outcomes[at] not in ("unjudged", "not run")
        return (self.row.cells[at], self.outcomes[at]) if failed else None

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
    return sorted(dict.fromkeys(row.engine for case in cases for row in case.rows), key=engine_index)


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
    own = (x for x in lines(case) if x.row.method == RECOMMENDED and x.row.engine in (PINOCCHIO, DERIVED))
    return next((x for x in own if not x.left_out), None)


def furthest(case: CaseResult) -> int:
    """Return how many values the best held; of terms, the best engine in all of them."""
    return max((line.reach for line in best(case).values()), default=0)


def place(values: Sequence[float], x: float) -> float:
    """Return where a number stands among a sweep's values, as a fractional index; decades are even if all are positive.

    -1 and the number of values stand for what is beyond the ends; NaN for no number, and for values in no order.
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
