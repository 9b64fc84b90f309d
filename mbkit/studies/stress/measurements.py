"""Data of a stress study: its rows and cases, and how far each row held."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Literal

import numpy as np

from mbkit.engines.registry import DERIVED, PINOCCHIO
from mbkit.methods.registry import AUTOMATIC_METHOD
from mbkit.simulate.plotting.style import engine_index
from mbkit.studies.measurement import Measurement, Outcome, run_name


@dataclass(frozen=True)
class Breaking:
    """Where one engine and method breaks in one case.

    `held` is the last value up to which all milder ones held, too, and None where the mildest did not. `failed`, `how`
    and `cell` are the first value that did not hold, its outcome and measurement; None and empty where all held.
    """

    case: str
    engine: str
    method: str
    setting: str
    held: float | None
    failed: float | None
    how: Outcome | Literal[""]
    cell: Measurement | None = field(compare=False, repr=False)

    @property
    def note(self) -> str:
        """Error, warnings and note of the first value that did not hold."""
        if self.cell is None:
            return ""
        error = f"error {self.cell.seen:.1e}" if math.isfinite(self.cell.seen) else ""
        return "; ".join(x for x in (error, *self.cell.warnings, self.cell.note) if x)


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

    def breaking(self, bar: float, case: str = "") -> Breaking:
        """Return the last value that held and the first that did not."""
        at = self.reach(bar)
        held = self.cells[at - 1].value if at else None
        cell = self.cells[at] if at < len(self.cells) else None
        how = "not run" if cell is None else cell.outcome(bar)
        if cell is None or how in ("not run", "unjudged"):
            return Breaking(case, self.engine, self.method, self.setting, held, None, "", None)
        return Breaking(case, self.engine, self.method, self.setting, held, cell.value, how, cell)

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

#: The engines on which mbkit recommends its automatic method.
_OURS: Final = (PINOCCHIO, DERIVED)


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
    def broken(self) -> Breaking:
        """Where it breaks."""
        return self.row.breaking(self.case.bar, self.case.name)

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


def name_of(row: Row) -> str:
    """Return engine and method; MuJoCo's own integrators have the engine in their names."""
    return run_name(row.engine, row.method)


@dataclass(frozen=True, eq=False)
class Overview:
    """A case, and how far each of its rows held; `anchor` is its place on a page, whatever its name holds."""

    case: CaseResult
    anchor: str = ""

    @cached_property
    def lines(self) -> list[Line]:
        """The rows, the furthest first: by what held, by what was usable, by run time."""

        def rank(line: Line) -> tuple[float, ...]:
            seconds = math.inf if math.isnan(line.seconds) else line.seconds
            return -line.reach, -line.usable, line.outcomes.count("silent"), seconds

        return sorted((Line(row, self.case) for row in self.case.rows), key=rank)

    @property
    def ran(self) -> list[Line]:
        """The rows that ran at all."""
        return [line for line in self.lines if not line.left_out]

    @cached_property
    def best(self) -> dict[str, Line]:
        """What speaks for each engine: its furthest method, or of the terms that it has the first to break."""
        ranked = self.lines
        if self.case.measure == "terms":
            ranked = sorted(ranked, key=lambda line: (line.left_out, line.reach, line.usable))
        return {line.row.engine: line for line in reversed(ranked)}

    @property
    def leader(self) -> Line | None:
        """What held furthest; of terms, the first to break of the engine that is best in all of them."""
        return max((x for x in self.best.values() if not x.left_out), key=lambda line: line.reach, default=None)

    @property
    def furthest(self) -> int:
        """How many values the best held; of terms, the best engine in all of them."""
        return max((line.reach for line in self.best.values()), default=0)

    @property
    def choice(self) -> Line | None:
        """mbkit's own choice of method, on the engine where it held furthest, if it was run."""
        return next((x for x in self.ran if x.row.method == AUTOMATIC_METHOD and x.row.engine in _OURS), None)

    @property
    def behind(self) -> bool:
        """Whether another held further than mbkit's own choice."""
        return self.choice is not None and self.choice.reach < self.furthest

    @property
    def ranks(self) -> bool:
        """Whether it ranks methods: terms have none, and a sweep of the step asks for stability alone."""
        return self.case.measure != "terms" and self.case.family != "step"

    @property
    def unbeaten(self) -> list[str]:
        """What held as far as any: engine and method, or of terms the engine in all of them."""
        most = self.furthest
        if self.case.measure == "terms":
            return [engine for engine, line in self.best.items() if line.reach == most > 0]
        return [name_of(line.row) for line in self.lines if line.reach == most > 0]


def overviews(cases: Iterable[CaseResult]) -> list[Overview]:
    """Return every case with its rows, each with a place on a page."""
    return [Overview(case, f"case-{k}") for k, case in enumerate(cases, 1)]


def engines_of(cases: Iterable[CaseResult]) -> list[str]:
    """Return the engines that are in any row, in the order of every figure."""
    return sorted(dict.fromkeys(row.engine for case in cases for row in case.rows), key=engine_index)


def fractional_index(values: Sequence[float], x: float) -> float:
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
