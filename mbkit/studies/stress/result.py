"""What `stress` returns: for each engine and method, how far it held and how it failed."""

from __future__ import annotations

import csv
import io
import json
import math
import statistics
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from mbkit._check import real
from mbkit._escape import csv_text, html, markdown
from mbkit.engines.registry import DERIVED, PINOCCHIO
from mbkit.errors import InputError, UnknownNameError
from mbkit.studies._figure_style import engine_index
from mbkit.studies.results import csv_number as number
from mbkit.studies.results import remade, write
from mbkit.studies.results import to_plain as plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "RECOMMENDED",
    "Break",
    "Breaking",
    "CaseResult",
    "Cell",
    "End",
    "Line",
    "Outcome",
    "Row",
    "Silent",
    "StressResult",
    "best",
    "engines_of",
    "furthest",
    "lines",
    "name_of",
    "place",
    "recommended",
]


#: How a run or an evaluation ended, before anybody looks at its error.
End = Literal["finished", "diverged", "nan", "refused", "slow", "died", "not run"]
#: With its error: held; above the bar, yet within `GROSS`; grossly wrong with a word of warning or
#: without one; finished, with no truth to judge it by this bar; or how it ended.
Outcome = Literal[
    "held", "inaccurate", "warned", "silent", "unjudged", "diverged", "nan", "refused", "slow", "died", "not run"
]

#: The default bar: a relative error that plots cannot hide and papers accept.
BAR: Final = 1e-6
#: Where an answer is no longer inaccurate but wrong: a hundredth of the motion, or of the term. A method of
#: low order misses the bar with every step that is affordable, and nobody is misled by that.
GROSS: Final = 1e-2
#: What JSON has for a limit that is infinite: it has no infinity, and null is a limit that nobody knows.
_NO_LIMIT: Final = "no limit"


@dataclass(frozen=True)
class Cell:
    """One engine and method at one value.

    Attributes
    ----------
    value : float
        Of the case's parameter.
    end : str
        ``"finished"``; ``"diverged"`` where the run said so itself; ``"nan"`` where numbers are
        not finite and nothing was said; ``"refused"``, an error of its own; ``"slow"``, stopped at the time
        allowed; ``"died"``, the process ended or took too much memory; ``"not run"``.
    error : float
        Relative to the problem's scale (motion, terms), or of the energy where that is the measure; NaN
        where there is none, or no truth to measure it by.
    energy : float
        Largest relative energy error, NaN where forces do work or nothing was integrated.
    seconds : float
        The processor's time of the run, or of one evaluation of a term, without what is compiled once.
    steps : int
    warnings : tuple of str
        What the library said about it.
    note : str
        Why it ended, what was chosen.
    floor : float
        How well the error itself is known: that of the truth, on the same scale.
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
        """Return how it went, by this bar on the error."""
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
class Break:
    """Where an engine and method breaks.

    Attributes
    ----------
    held : float or None
        The last value up to which all milder ones held, too; None where the mildest did not.
    failed : float or None
        The first that did not; None where all held.
    how : str
        The outcome there; empty where all held.
    cell : Cell or None
        What was seen there.
    """

    held: float | None
    failed: float | None
    how: Outcome | Literal[""]
    cell: Cell | None


@dataclass(frozen=True)
class Row:
    """One engine and method over all values of a case.

    Attributes
    ----------
    engine, method : str
        For terms, the method is the term.
    cells : tuple of Cell
        In the order of the case's values.
    setting : str
        The step or tolerance.
    theory : float or None
        Where linear theory lets it break; infinite where it does not, ``"no limit"`` in JSON.
    """

    engine: str
    method: str
    cells: tuple[Cell, ...]
    setting: str = ""
    theory: float | None = None

    def breaking(self, bar: float) -> Break:
        """Return the last value that held and the first that did not."""
        held: float | None = None
        for cell in self.cells:
            how = cell.outcome(bar)
            if how in ("not run", "unjudged"):
                break
            if how != "held":
                return Break(held, cell.value, how, cell)
            held = cell.value
        return Break(held, None, "", None)

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
        Numbers worth telling of each value.
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


@dataclass(frozen=True)
class Breaking:
    """Where one engine and method breaks in one case, a line of a table.

    Attributes
    ----------
    case, engine, method, setting : str
    held, failed, how
        As of `Break`.
    note : str
        What was said or seen where it failed.
    """

    case: str
    engine: str
    method: str
    setting: str
    held: float | None
    failed: float | None
    how: Outcome | Literal[""]
    note: str


@dataclass(frozen=True)
class Silent:
    """A wrong answer that nothing warned of.

    Attributes
    ----------
    case, engine, method : str
    cell : Cell
        With the value and the error.
    """

    case: str
    engine: str
    method: str
    cell: Cell


@dataclass(frozen=True)
class StressResult:
    """What held to where, of every case.

    Attributes
    ----------
    cases : tuple of CaseResult
    complete : bool
        False for a study that was interrupted.
    versions : dict
    processor : str
    seconds : float
        Of the whole study.
    settings : dict
        Steps, tolerances, bounds of time and memory.
    """

    cases: tuple[CaseResult, ...]
    complete: bool
    versions: dict[str, str]
    processor: str
    seconds: float
    settings: dict[str, Any] = field(default_factory=dict)

    def case(self, name: str) -> CaseResult:
        """Return the case of this name.

        Raises
        ------
        UnknownNameError
            There is none in this result.
        """
        known = {case.name: case for case in self.cases}
        if name not in known:
            raise UnknownNameError("case", name, known)
        return known[name]

    def rows(self) -> Iterator[tuple[CaseResult, Row]]:
        """Yield every row with its case."""
        for case in self.cases:
            for row in case.rows:
                yield case, row

    def breaking(self, bar: float | None = None) -> tuple[Breaking, ...]:
        """Return where each engine and method breaks in each case.

        Parameters
        ----------
        bar : float, optional
            Another one than each case's own.
        """
        out = []
        for case, row in self.rows():
            broken = row.breaking(_bar(case, bar))
            note = "" if broken.cell is None else _note(broken.cell)
            about = (case.name, row.engine, row.method, row.setting)
            out.append(Breaking(*about, broken.held, broken.failed, broken.how, note))
        return tuple(out)

    def silent(self, bar: float | None = None) -> tuple[Silent, ...]:
        """Return all answers that were grossly wrong without a word, by each case's bar or another one."""
        return tuple(
            Silent(case.name, row.engine, row.method, cell)
            for case, row in self.rows()
            for cell in row.cells
            if cell.outcome(_bar(case, bar)) == "silent"
        )

    def best(self, case: str, bar: float | None = None) -> tuple[Row, ...]:
        """Return the rows that hold furthest in a case; none where none holds at all."""
        found = self.case(case)
        reach = {id(row): row.reach(_bar(found, bar)) for row in found.rows}
        most = max(reach.values(), default=0)
        return tuple(row for row in found.rows if reach[id(row)] == most > 0)

    def to_dict(self) -> dict[str, Any]:
        """Return all of it as plain data, with the outcome of each cell and the breaking point of each row."""
        out = asdict(self)
        for told, case in zip(out["cases"], self.cases, strict=True):
            for line, row in zip(told["rows"], case.rows, strict=True):
                broken = row.breaking(case.bar)
                line.update(held=broken.held, failed=broken.failed, how=broken.how)
                if row.theory == math.inf:
                    line["theory"] = _NO_LIMIT
                for entry, cell in zip(line["cells"], row.cells, strict=True):
                    entry["outcome"] = cell.outcome(case.bar)
        return out

    def to_json(self, path: str | Path | None = None) -> str:
        """Return the result as JSON with null for NaN, and write it if a path is given."""
        text = json.dumps(plain(self.to_dict()), indent=1, allow_nan=False)
        if path is not None:
            write(path, text + "\n")
        return text

    @classmethod
    def from_json(cls, text: str) -> StressResult:
        """Return the result that `to_json` told.

        Raises
        ------
        InputError
            The text is no such result.
        """
        try:
            data = json.loads(text)
            made: StressResult = remade(cls, data | {"cases": tuple(_case(told) for told in data["cases"])})
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
            raise InputError(
                f"text: expected the JSON of a StressResult, such as Path(...).read_text() of a file "
                f"that to_json wrote; it has no such content ({type(error).__name__}: {error})"
            ) from None
        return made

    def to_csv(self, path: str | Path | None = None) -> str:
        """Return one line per engine, method and value, and write it if a path is given."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        head = ("case", "parameter", "unit", "value", "engine", "method", "setting", "outcome", "end")
        writer.writerow((*head, "error", "floor", "energy", "seconds", "steps", "warnings", "note"))
        for case, row in self.rows():
            for c in row.cells:
                about = (*map(csv_text, (case.name, case.parameter, case.unit)), number(c.value))
                about += (*map(csv_text, (row.engine, row.method, row.setting)),)
                numbers = (c.error, c.floor, c.energy, c.seconds)
                told = (c.steps, csv_text("; ".join(c.warnings)), csv_text(c.note))
                writer.writerow((*about, c.outcome(case.bar), c.end, *map(number, numbers), *told))
        if path is not None:
            write(path, stream.getvalue())
        return stream.getvalue()

    def to_markdown(self) -> str:
        """Return a table per case of how far each engine and method held, the furthest first."""
        lines: list[str] = []
        for case in self.cases:
            unit = f" {markdown(case.unit)}" if case.unit else ""
            lines += [f"**{markdown(case.name)}**: {markdown(case.about)} Held: error ≤ {case.bar:g}.", ""]
            lines += [f"| engine | method | setting | held to{unit} | then | how |", "|---|---|---|---:|---:|---|"]
            for row in sorted(case.rows, key=lambda row: -row.reach(case.bar)):
                broken = row.breaking(case.bar)
                told = ["none" if broken.held is None else f"{broken.held:g}"]
                told += ["" if broken.failed is None else f"{broken.failed:g}", markdown(broken.how)]
                about = " | ".join(map(markdown, (row.engine, row.method, row.setting)))
                lines.append(f"| {about} | {' | '.join(told)} |")
            lines.append("")
        lines += [] if self.complete else ["Interrupted: this is what was finished.", ""]
        return "\n".join(lines)

    def plot(self, case: str | None = None) -> Figure:
        """Return the map of one case, or how far each engine held in all of them."""
        from mbkit.studies.stress.figure import figure

        return figure(self, case)

    def __repr__(self) -> str:
        cells = [(cell, case.bar) for case, row in self.rows() for cell in row.cells]
        counts = Counter(cell.outcome(bar) for cell, bar in cells)
        told = ", ".join(f"{n} {how}" for how, n in counts.most_common())
        plural = "s" * (len(self.cases) != 1)
        return f"<StressResult of {len(self.cases)} case{plural}: {told or 'nothing run'}>"

    def _repr_html_(self) -> str:
        rows = []
        for b in self.breaking():
            held, failed = ("" if x is None else f"{x:g}" for x in (b.held, b.failed))
            told = (b.case, b.engine, b.method, b.setting, held or "none", failed, b.how)
            rows.append("<tr>" + "".join(f"<td>{html(x)}</td>" for x in told) + "</tr>")
        head = "".join(f"<th>{x}</th>" for x in ("case", "engine", "method", "setting", "held to", "then", "how"))
        return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def _bar(case: CaseResult, other: float | None) -> float:
    return case.bar if other is None else real("bar", other, positive=True)


def _note(cell: Cell) -> str:
    error = f"error {cell.seen:.1e}" if math.isfinite(cell.seen) else ""
    return "; ".join(x for x in (error, *cell.warnings, cell.note) if x)


def _case(told: dict[str, Any]) -> CaseResult:
    rows = []
    for row in told["rows"]:
        cells = tuple(remade(Cell, c | {"warnings": tuple(c["warnings"])}) for c in row["cells"])
        theory = math.inf if row["theory"] == _NO_LIMIT else row["theory"]
        rows.append(Row(row["engine"], row["method"], cells, row["setting"], theory))
    facts = tuple({k: math.nan if x is None else x for k, x in f.items()} for f in told["facts"])
    parts = {"values": tuple(told["values"]), "truths": tuple(told["truths"]), "facts": facts, "rows": tuple(rows)}
    made: CaseResult = remade(CaseResult, told | parts)
    return made


# What is read from a stress result by people: how far each row held, and who held furthest.

#: What mbkit advises who does not want to choose.
RECOMMENDED: Final = "auto"
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
    own = (x for x in lines(case) if x.row.method == RECOMMENDED and x.row.engine in (PINOCCHIO, DERIVED))
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
