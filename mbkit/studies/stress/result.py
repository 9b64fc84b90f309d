"""The result of `stress`: for each engine and method, how far it held and how it failed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

from mbkit._check import real
from mbkit.errors import require_known
from mbkit.studies.document import Bullet, Column, Document, Items, Paragraph, Section, Span, Table
from mbkit.studies.formatting import setting_words, time_text
from mbkit.studies.measurement import Measurement, Outcome
from mbkit.studies.results import NO_LIMIT, ResultTable, columns, counted
from mbkit.studies.stress.figure import figure
from mbkit.studies.stress.measurements import Breaking, CaseResult, Row, name_of, overviews
from mbkit.studies.stress.view import (
    avoid,
    content,
    first_failure,
    held_text,
    leader_text,
    leaders,
    places_text,
    reached_text,
)
from mbkit.studies.study_runs import OUT_OF_TIME

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: A terminal names so many methods that were wrong in silence.
_MAX_SILENT_METHODS: Final = 6


@dataclass(frozen=True)
class SilentFailure:
    """A grossly wrong answer without a warning; `cell` has the value and the error."""

    case: str
    engine: str
    method: str
    cell: Measurement


class _Item(NamedTuple):
    """A line of the CSV file."""

    case: CaseResult
    row: Row
    cell: Measurement

    @property
    def outcome(self) -> Outcome:
        return self.cell.outcome(self.case.bar)


@dataclass(frozen=True)
class StressResult(ResultTable):
    """How far each engine and method held in every case.

    `complete` is False for a study that was interrupted, `seconds` is the time of the whole study, and `settings` are
    steps, tolerances, bounds of time and memory.
    """

    cases: tuple[CaseResult, ...]
    complete: bool
    versions: dict[str, str]
    processor: str
    seconds: float
    settings: dict[str, Any] = field(default_factory=dict)

    _csv_columns: ClassVar = {
        "case": attrgetter("case.name"),
        **columns(0, "parameter", "unit"),
        **columns(2, "value"),
        **columns(1, "engine", "method", "setting"),
        "outcome": attrgetter("outcome"),
        **columns(2, "end", "error", "floor", "energy", "seconds", "steps"),
        "warnings": lambda item: "; ".join(item.cell.warnings),
        **columns(2, "note"),
    }

    @property
    def left_out(self) -> str:
        """One sentence about the cells that were not computed; empty where none was left out."""
        notes = [item.cell.note for item in self._csv_rows()]
        late = notes.count(OUT_OF_TIME)
        if not self.complete:
            return f"interrupted: {late} of {len(notes)} cells were not reached"
        return f"the time allowed was used up: {late} of {len(notes)} cells were not run" if late else ""

    def case(self, name: str) -> CaseResult:
        """Return the case of this name; `UnknownNameError` where there is none."""
        known = {case.name: case for case in self.cases}
        require_known("case", known, name)
        return known[name]

    def rows(self) -> Iterator[tuple[CaseResult, Row]]:
        """Yield every row with its case."""
        for case in self.cases:
            for row in case.rows:
                yield case, row

    def breaking(self, bar: float | None = None) -> tuple[Breaking, ...]:
        """Return where each engine and method breaks in each case, by its own bar or another one."""
        return tuple(row.breaking(_bar(case, bar), case.name) for case, row in self.rows())

    def silent(self, bar: float | None = None) -> tuple[SilentFailure, ...]:
        """Return all answers that were grossly wrong without a word, by each case's bar or another one."""
        return tuple(
            SilentFailure(item.case.name, item.row.engine, item.row.method, item.cell)
            for item in self._csv_rows()
            if item.cell.outcome(_bar(item.case, bar)) == "silent"
        )

    def best(self, case: str, bar: float | None = None) -> tuple[Row, ...]:
        """Return the rows that hold furthest in a case; none where none holds at all."""
        data = self.case(case)
        reach = {id(row): row.reach(_bar(data, bar)) for row in data.rows}
        most = max(reach.values(), default=0)
        return tuple(row for row in data.rows if reach[id(row)] == most > 0)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain data, with the outcome of each cell and the breaking point of each row."""
        out = super().to_dict()
        for case_data, case in zip(out["cases"], self.cases, strict=True):
            for data, row in zip(case_data["rows"], case.rows, strict=True):
                broken = row.breaking(case.bar)
                data.update(held=broken.held, failed=broken.failed, how=broken.how)
                if row.theory == math.inf:
                    data["theory"] = NO_LIMIT
                for entry, cell in zip(data["cells"], row.cells, strict=True):
                    entry["outcome"] = cell.outcome(case.bar)
        return out

    def _csv_rows(self) -> Iterator[_Item]:
        return (_Item(case, row, cell) for case, row in self.rows() for cell in row.cells)

    @property
    def headline(self) -> str:
        """What held furthest and how much was wrong in silence, in one sentence."""
        stopped = "interrupted; what was finished: "
        if self.complete:
            stopped = f"{self.left_out}; " if self.left_out else ""
        if all(cell.end == "not run" for _, row in self.rows() for cell in row.cells):
            return f"{stopped}nothing was run"
        counts = [[c.outcome(case.bar) for row in case.rows for c in row.cells].count("silent") for case in self.cases]
        silent = f"{sum(counts)} silent failure{'s' * (sum(counts) != 1)} in {counted(sum(map(bool, counts)), 'case')}"
        return f"{stopped}{leaders(overviews(self.cases))}; {silent if sum(counts) else 'no silent failures'}"

    def document(self, *, full: bool = True) -> Document:
        """Return the document of the study; `full` has how far each engine and method held in every case."""
        cases = overviews(self.cases)
        runs = sum(cell.end != "not run" for _, row in self.rows() for cell in row.cells)
        behind_or_not = {True: Span("behind", "allowed"), False: Span("✓", "good")}
        auto = [Column("auto", lambda o: behind_or_not[o.behind] if o.choice else Span("", "good"), fill=True)]
        columns = (
            Column("case", lambda o: o.case.name, most=22, fill=True),
            Column("furthest", leader_text, most=24, fill=True),
            Column("held to", lambda o: reached_text(o.leader) if o.leader else "", fill=True),
            *(auto if any(o.choice for o in cases) else []),
            Column("✗", lambda o: Span(str(sum(x.outcomes.count("silent") for x in o.lines) or ""), "bad"), right=True),
            Column("first to break", lambda o: Span(first_failure(o), "muted"), fill=True),
        )
        behind = [
            Bullet(
                o.case.name,
                f"auto {held_text(o.choice)}, {name_of(o.lines[0].row)} {held_text(o.lines[0])}",
                "!",
                "allowed",
            )
            for o in cases
            if o.behind and o.choice is not None
        ]
        silent = [Bullet(a.method, places_text(a), "✗", "bad") for a in avoid(cases)]
        return Document(
            name="stress",
            heading="Stiff and extreme: where each engine and method breaks",
            title="Stiff and extreme",
            verdict=self.headline,
            sentence=f"{self.headline}; {runs} runs of {counted(len(cases), 'case')}, each against a known truth",
            good=bool(self.complete and self.cases and not silent),
            marked=False,
            summary=f"{len(cases)} cases · {runs} runs · {time_text(self.seconds)}",
            sections=[
                Section("Who holds furthest, and what breaks first", [Table(columns, cases)]),
                Section("Where another held further than auto", [Items(behind)]),
                Section("Wrong in silence, and the mildest value where", [Items(silent, most=_MAX_SILENT_METHODS)]),
                *(map(_rows_of, self.cases) if full else ()),
            ],
            result=self,
            basis={
                name: f"{value / 2**30:g} GiB" if name == "memory" and value else setting_words(value)
                for name, value in self.settings.items()
            },
            template="stress.html",
            content=lambda: content(cases),
        )

    def plot(self, case: str | None = None, ax: Axes | None = None) -> Figure:
        """Draw the map of one case, or how far each engine held in all of them, with Matplotlib.

        `ax` is where to draw; by default in a figure of its own.
        """
        return figure(self.cases, case, ax=ax)

    def __repr__(self) -> str:
        counts = Counter(item.outcome for item in self._csv_rows())
        outcomes = ", ".join(f"{n} {how}" for how, n in counts.most_common())
        return f"<StressResult of {counted(len(self.cases), 'case')}: {outcomes or 'nothing run'}>"


def _bar(case: CaseResult, other: float | None) -> float:
    return case.bar if other is None else real("bar", other, positive=True)


def _rows_of(case: CaseResult) -> Section:
    """Return how far each engine and method held in a case, the furthest first."""
    ranked = sorted(case.rows, key=lambda row: -row.reach(case.bar))
    columns = (
        *(Column(name, attrgetter(name)) for name in ("engine", "method", "setting")),
        Column(f"held to {case.unit}".rstrip(), lambda b: "none" if b.held is None else f"{b.held:g}", right=True),
        Column("then", lambda b: "" if b.failed is None else f"{b.failed:g}", right=True),
        Column("how", attrgetter("how")),
    )
    about = Paragraph(f"{case.about} Held: error ≤ {case.bar:g}.")
    return Section(case.name, [about, Table(columns, [row.breaking(case.bar, case.name) for row in ranked])])
