"""Data of a stress study: its rows and cases, and how far each row held."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Literal, NamedTuple

from mbkit.engines.registry import DERIVED, PINOCCHIO
from mbkit.methods.registry import AUTOMATIC_METHOD
from mbkit.simulate.plotting.style import engine_index
from mbkit.studies.measurement import Measurement, Outcome, run_name

#: The engines on which mbkit recommends its automatic method.
_OURS: Final = (PINOCCHIO, DERIVED)
#: Outcomes that say nothing about a row.
UNKNOWN: Final = ("not run", "unjudged")


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

    @property
    def _name(self) -> str:
        """Engine and method; MuJoCo's own integrators have the engine in their names."""
        return run_name(self.engine, self.method)

    def breaking(self, bar: float, case: str = "") -> Breaking:
        """Return the last value that held and the first that did not."""
        at = self.reach(bar)
        held = self.cells[at - 1].value if at else None
        cell = self.cells[at] if at < len(self.cells) else None
        how = "not run" if cell is None else cell.outcome(bar)
        if cell is None or how in UNKNOWN:
            return Breaking(case, self.engine, self.method, self.setting, held, None, "", None)
        return Breaking(case, self.engine, self.method, self.setting, held, cell.value, how, cell)

    def reach(self, bar: float) -> int:
        """Return how many values held before the first that did not."""
        return _count([cell.outcome(bar) for cell in self.cells], ("held",))


def _count(outcomes: Sequence[Outcome], wanted: Sequence[Outcome]) -> int:
    """Return how many outcomes are wanted ones before the first that is not."""
    return next((k for k, how in enumerate(outcomes) if how not in wanted), len(outcomes))


class Line(NamedTuple):
    """A row read from mild to extreme: how many values held, or were only inaccurate, before the first that did not.

    `seconds` is the median run time where it held, or where it finished at all; NaN where it did not.
    """

    row: Row
    broken: Breaking
    outcomes: tuple[Outcome, ...]
    reach: int
    usable: int
    seconds: float

    @classmethod
    def of(cls, row: Row, bar: float, case: str) -> Line:
        """Return a row of a case by a bar on its errors."""
        outcomes = tuple(cell.outcome(bar) for cell in row.cells)
        reach = _count(outcomes, ("held",))
        times = [c.seconds for c in row.cells if c.end == "finished" and math.isfinite(c.seconds)]
        held = [c.seconds for c in row.cells[:reach] if math.isfinite(c.seconds)]
        seconds = statistics.median(held or times or [math.nan])
        return cls(row, row.breaking(bar, case), outcomes, reach, _count(outcomes, ("held", "inaccurate")), seconds)

    @property
    def left_out(self) -> bool:
        """Whether it never ran: refused, or not reached, at every value."""
        return all(how in ("refused", "not run") for how in self.outcomes)


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

    @cached_property
    def _lines(self) -> list[Line]:
        """The rows in the order of what held, then of what was usable, then of run time."""

        def rank(line: Line) -> tuple[float, ...]:
            seconds = math.inf if math.isnan(line.seconds) else line.seconds
            return -line.reach, -line.usable, line.outcomes.count("silent"), seconds

        return sorted((Line.of(row, self.bar, self.name) for row in self.rows), key=rank)

    @cached_property
    def _best(self) -> dict[str, Line]:
        """The furthest method of each engine; of terms that it has, the first to break."""
        ranked = self._lines
        if self.measure == "terms":
            ranked = sorted(ranked, key=lambda line: (line.left_out, line.reach, line.usable))
        return {line.row.engine: line for line in reversed(ranked)}

    @property
    def _leader(self) -> Line | None:
        """The furthest line; of terms, the first to break of the engine that is best in all of them."""
        return max((x for x in self._best.values() if not x.left_out), key=lambda line: line.reach, default=None)

    @property
    def _choice(self) -> Line | None:
        """mbkit's own choice of method, on the engine where it held furthest, if it was run."""
        ours = (x for x in self._lines if x.row.method == AUTOMATIC_METHOD and x.row.engine in _OURS)
        return next((x for x in ours if not x.left_out), None)

    @property
    def _unbeaten(self) -> list[str]:
        """Engine and method of all that held furthest, or of terms the engines in all of them."""
        most = max((line.reach for line in self._best.values()), default=0)
        if self.measure == "terms":
            return [engine for engine, line in self._best.items() if line.reach == most > 0]
        return [line.row._name for line in self._lines if line.reach == most > 0]


def engines_of(cases: Iterable[CaseResult]) -> list[str]:
    """Return the engines that are in any row, in the order of every figure."""
    return sorted(dict.fromkeys(row.engine for case in cases for row in case.rows), key=engine_index)
