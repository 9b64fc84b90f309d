"""Data of a stress study: the measurement of each cell, rows and cases, and how far each row held."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np

from mbkit.engines.registry import DERIVED, PINOCCHIO
from mbkit.methods.registry import AUTOMATIC_METHOD
from mbkit.simulate.plotting.style import engine_index

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
    """One engine and method at one value of the case's parameter.

    `end` is ``"finished"``; ``"diverged"`` where the run said so itself; ``"nan"`` where numbers are not finite and
    nothing was said; ``"refused"``, an error of its own; ``"slow"``, stopped at the time allowed; ``"died"``, the
    process ended or took too much memory; ``"not run"``. `error` is relative to the problem's scale (motion, terms), or
    of the energy where that is the measure, and NaN where there is none, or no truth to measure it by; `floor` is the
    error of that truth. `energy` is the largest relative energy error, NaN where forces do work or nothing was
    integrated. `seconds` are processor time of the run, or of one evaluation of a term, without compilation. `note`
    says why it ended, and what was chosen.
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
        """The error that counts, its own, or that of the energy where there is no truth.

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

    `held` is the last value up to which all milder ones held, too, and None where the mildest did not. `failed`, `how`
    and `cell` are the first value that did not hold, its outcome and measurement; None and empty where all held.
    """

    held: float | None
    failed: float | None
    how: Outcome | Literal[""]
    cell: Measurement | None


@dataclass(frozen=True)
class Row:
    """One engine and method over all values of a case; for terms, the method is the term.

    `cells` are in the order of the case's values, and `setting` is the step or tolerance. `theory` is where linear
    theory lets it break; infinite where it does not, ``"no limit"`` in JSON.
    """

    engine: str
    method: str
    cells: tuple[Measurement, ...]
    setting: str = ""
    theory: float | None = None

    def breaking(self, bar: float) -> BreakingPoint:
        """Return the last value that held and the first that did not."""
        at = self.reach(bar)
        held = self.cells[at - 1].value if at else None
        how = self.cells[at].outcome(bar) if at < len(self.cells) else "not run"
        if how in ("not run", "unjudged"):
            return BreakingPoint(held, None, "", None)
        return BreakingPoint(held, self.cells[at].value, how, self.cells[at])

    def reach(self, bar: float) -> int:
        """Return how many values held before the first that did not."""
        return _count([cell.outcome(bar) for cell in self.cells], ("held",))


@dataclass(frozen=True)
class CaseResult:
    """All engines and methods on one case.

    What a `Case` has is as there, but `bar` is the one that counts here. `truths` say how the truth of each of the
    `values` is known and to which floor, and `facts` are further numbers of each.
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


@dataclass(frozen=True)
class Line:
    """One row of a case, read from mild to extreme."""

    row: Row
    case: CaseResult

    @cached_property
    def outcomes(self) -> tuple[Outcome, ...]:
        """The outcome at each value."""
        return tuple(cell.outcome(self.case.bar) for cell in self.row.cells)

    @cached_property
    def broken(self) -> BreakingPoint:
        """Where it breaks."""
        return self.row.breaking(self.case.bar)

    @property
    def size(self) -> int:
        """Number of the case's values."""
        return len(self.case.values)

    @property
    def reach(self) -> int:
        """How many values held before the first that did not."""
        return _count(self.outcomes, ("held",))

    @property
    def usable(self) -> int:
        """How many values held or were only inaccurate before the first that was neither."""
        return _count(self.outcomes, ("held", "inaccurate"))

    @property
    def whole(self) -> bool:
        """Whether all values held."""
        return self.reach == self.size > 0

    @property
    def seconds(self) -> float:
        """Median run time where it held, or where it finished at all; NaN where it did not."""
        finished = (c for c in self.row.cells if c.end == "finished")
        for cells in (self.row.cells[: self.reach], finished):
            if times := [c.seconds for c in cells if math.isfinite(c.seconds)]:
                return statistics.median(times)
        return math.nan

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


def _count(outcomes: Sequence[Outcome], wanted: Sequence[Outcome]) -> int:
    """Return how many outcomes are wanted ones before the first that is not."""
    return next((k for k, how in enumerate(outcomes) if how not in wanted), len(outcomes))


def lines(case: CaseResult) -> list[Line]:
    """Return the rows of a case, the furthest first: by what held, by what was usable, by run time."""

    def rank(line: Line) -> tuple[float, ...]:
        seconds = math.inf if math.isnan(line.seconds) else line.seconds
        return -line.reach, -line.usable, line.outcomes.count("silent"), seconds

    return sorted((Line(row, case) for row in case.rows), key=rank)


def name_of(row: Row) -> str:
    """Return engine and method; MuJoCo's own integrators have the engine in their names."""
    return row.method if row.method.startswith(f"{row.engine}_") else f"{row.engine} {row.method}"


def engines_of(cases: Iterable[CaseResult]) -> list[str]:
    """Return the engines that are in any row, in the order of every figure."""
    return sorted(dict.fromkeys(row.engine for case in cases for row in case.rows), key=engine_index)


def best(case: CaseResult) -> dict[str, Line]:
    """Return what speaks for each engine: its furthest method, or of the terms that it has the first to break."""
    ranked = lines(case)
    if case.measure == "terms":
        ranked.sort(key=lambda line: (line.left_out, line.reach, line.usable))
    return {line.row.engine: line for line in reversed(ranked)}


def recommended(case: CaseResult) -> Line | None:
    """Return mbkit's own choice of method, on the engine where it held furthest, if it was run."""
    own = (x for x in lines(case) if x.row.method == RECOMMENDED and x.row.engine in (PINOCCHIO, DERIVED))
    return next((x for x in own if not x.left_out), None)


def furthest(case: CaseResult) -> int:
    """Return how many values the best held; of terms, the best engine in all of them."""
    return max((line.reach for line in best(case).values()), default=0)


def place(values: Sequence[float], x: float) -> float:
    """Return where a number stands among a sweep's values, as a fractional index; decades are even if all are positive.

    -1 and the number of values stand for places beyond the ends; NaN for NaN, and for unordered values.
    """
    if math.isnan(x) or not values or not np.isfinite(values).all():
        return math.nan
    marks = np.array([*values, x])
    if min(values) > 0:
        with np.errstate(divide="ignore"):
            marks = np.log(np.maximum(marks, 0.0))
    marks = -marks if values[-1] < values[0] else marks
    if (np.diff(marks[:-1]) <= 0).any():
        return math.nan
    return float(np.interp(marks[-1], marks[:-1], np.arange(len(values)), left=-1.0, right=len(values)))
