"""The result of `stress`, and the document that shows how far each engine and method held and how it failed."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

from mbkit._check import MAX_LINES, real
from mbkit.engines.base import MAX_NAMES
from mbkit.errors import require_known
from mbkit.model.validation import listing
from mbkit.studies import document as doc
from mbkit.studies.document import Bullet, Column, Document, Items, Paragraph, Section, Span, Table
from mbkit.studies.formatting import setting_words, time_text
from mbkit.studies.measurement import Measurement, Outcome
from mbkit.studies.results import NO_LIMIT, ResultTable, columns, counted
from mbkit.studies.stress.figure import WORDS, cell_text, figure, number_text, shade
from mbkit.studies.stress.measurements import UNKNOWN, Breaking, CaseResult, Line, Row
from mbkit.studies.study_runs import OUT_OF_TIME
from mbkit.studies.svg import PAGE, page_style, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: The words before a truth's floor.
_KNOWN: Final = "; known to "
_MEASURES: Final = {
    "motion": "the largest difference of q along the run, over the size of the motion",
    "energy": "the largest relative error of the energy along the run",
    "terms": "that of each term at the case's states, relative to the term",
}
_KEY: Final = (
    "A row is one engine and method, a column one value; the furthest row stands first. A number is the error: blue "
    "where it held, orange where it is inaccurate, the darker the fewer digits, by steps of 12, 9, 6 and 3. Red is "
    "wrong by more than a hundredth of the motion or term: ! with a warning, ✗ in silence. Grey ended otherwise, dark "
    "grey without a word; ? finished, and the truth is not known well enough; empty was not run. The first value that "
    "did not hold begins at a thick line. Run time is the median where it held."
)


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
        if all(item.cell.end == "not run" for item in self._csv_rows()):
            return f"{stopped}nothing was run"
        counts = [n for n in map(_silent_count, self.cases) if n]
        silent = f"{counted(sum(counts), 'silent failure')} in {counted(len(counts), 'case')}"
        return f"{stopped}{_leaders(self.cases)}; {silent if counts else 'no silent failures'}"

    def document(self, *, full: bool = True) -> Document:
        """Return the document of the study; `full` has the rows of every case beyond the page, too."""
        runs = sum(item.cell.end != "not run" for item in self._csv_rows())
        silent, study = _silent_bullets(self.cases), f"{runs} runs of {counted(len(self.cases), 'case')}"
        chosen = any(case._choice for case in self.cases)
        shown = [c for c in _CASES if chosen or c.head != "auto"]
        drawn = doc.Figure(
            lambda: _drawn(self.cases), "How much of each sweep the furthest method of each engine held."
        )
        key = doc.Details("how to read the tables", [Paragraph(_KEY)])
        return Document(
            name="stress",
            heading="Stiff and extreme: where each engine and method breaks",
            title="Stiff and extreme",
            verdict=self.headline,
            sentence=f"{self.headline}; {study}, each against a known truth",
            good=bool(self.cases and not self.left_out and not silent),
            marked=False,
            summary=f"{len(self.cases)} cases · {runs} runs · {time_text(self.seconds)}",
            sections=[
                Section("Who holds furthest, and what breaks first", [Table(shown, self.cases), drawn, key]),
                Section("Where another held further than auto", [Items(list(_behind_bullets(self.cases)))]),
                Section("Wrong in silence, and the mildest value where", [Items(silent, most=MAX_LINES)]),
                *(_case_section(case, "both" if full else "page") for case in self.cases),
            ],
            result=self,
            basis={
                name: f"{value / 2**30:g} GiB" if name == "memory" and value else setting_words(value)
                for name, value in self.settings.items()
            },
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


def _drawn(cases: Sequence[CaseResult]) -> str:
    with page_style("stress"):
        return svg(figure(cases, palette=PAGE), "How much of each sweep every engine's furthest method held")


# Sentences


def _value_text(x: float, case: CaseResult) -> str:
    return number_text(x) + (f" {case.unit}" if case.unit and math.isfinite(x) else "")


def _reached(line: Line, case: CaseResult) -> str:
    if line.reach == len(case.values) > 0:
        return "all"
    return _value_text(line.row.cells[line.reach - 1].value, case) if line.reach else "nothing"


def _leaders(cases: Iterable[CaseResult]) -> str:
    """Return what held furthest in most cases; terms and steps, which ask for stability alone, rank no method."""
    ran = [case for case in cases if case.rows]
    ranked = [case for case in ran if case.measure != "terms" and case.family != "step"] or ran
    counts = Counter(name for case in ranked for name in case._unbeaten)
    if not counts:
        return f"nothing held in {counted(len(ranked), 'case')}"
    most = max(counts.values())
    names = [name for name, count in counts.items() if count == most]
    if len(names) > MAX_NAMES:
        names = [*names[:MAX_NAMES], f"{len(names) - MAX_NAMES} more"]
    listed = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
    return f"{listed} held furthest, or as far as any, in {most} of {counted(len(ranked), 'case')}"


def _behind(case: CaseResult) -> bool:
    """Return whether another line held further than mbkit's own choice."""
    return case._choice is not None and case._choice.reach < max(line.reach for line in case._best.values())


def _behind_bullets(cases: Iterable[CaseResult]) -> Iterator[Bullet]:
    for case in filter(_behind, cases):
        assert case._choice is not None
        held = [_reached(line, case) for line in (case._choice, case._lines[0])]
        held = [f"held {'' if text in ('all', 'nothing') else 'to '}{text}" for text in held]
        yield Bullet(case.name, f"auto {held[0]}, {case._lines[0].row._name} {held[1]}", "!", "allowed")


def _silent_count(case: CaseResult) -> int:
    return sum(line.outcomes.count("silent") for line in case._lines)


def _silent_bullets(cases: Iterable[CaseResult]) -> list[Bullet]:
    """Return the methods that were wrong in silence, with the mildest value of each case; the most often so first."""
    where: dict[str, dict[int, tuple[CaseResult, int]]] = {}
    for k, case in enumerate(cases):
        for line in (x for x in case._lines if "silent" in x.outcomes):
            places = where.setdefault(line.row._name if case.measure == "terms" else line.row.method, {})
            first = line.outcomes.index("silent")
            places[k] = case, min(first, places.get(k, (case, first))[1])
    out = []
    for method, found in sorted(where.items(), key=lambda item: -len(item[1])):
        texts = [f"{c.name} at {c.parameter} = {_value_text(c.values[at], c)}" for c, at in found.values()]
        out.append(Bullet(method, listing(texts, MAX_NAMES), "✗", "bad"))
    return out


# Columns


def _leader(case: CaseResult) -> str:
    if case._leader is None:
        return "none ran"
    row = case._leader.row
    return f"{row.engine} (terms)" if case.measure == "terms" else row._name


def _auto(case: CaseResult) -> doc.Text:
    if case._choice is None:
        return ""
    return Span("behind", "allowed") if _behind(case) else Span("✓", "good")


def _first_failure(case: CaseResult) -> str:
    """Return which row is the first that is of no use, and how."""
    ended = [x for x in case._lines if not x.left_out and (*x.outcomes, "not run")[x.usable] not in UNKNOWN]
    if not ended:
        return ""
    line = min(ended, key=lambda x: x.usable)
    how = line.outcomes[line.usable]
    return f"{number_text(line.row.cells[line.usable].value)} {WORDS.get(how, how)}: {line.row._name}"


_CASES: Final = (
    Column("case", attrgetter("name"), most=22, fill=True),
    Column("furthest", _leader, most=24, fill=True),
    Column("held to", lambda case: _reached(case._leader, case) if case._leader else "", fill=True),
    Column("auto", _auto, fill=True),
    Column("✗", lambda case: Span(str(_silent_count(case) or ""), "bad"), right=True),
    Column("first to break", lambda case: Span(_first_failure(case), "muted"), fill=True),
)


def _case_section(case: CaseResult, on: doc.On) -> Section:
    """Return how far each engine and method held in a case, on a page with every cell."""
    columns = [
        *(Column(name, attrgetter(f"row.{name}")) for name in ("engine", "method", "setting")),
        Column(f"held to {case.unit}".rstrip(), lambda x: _plain(x.broken.held, "none"), right=True),
        Column("then", lambda x: _plain(x.broken.failed), right=True),
        Column("how", lambda x: WORDS.get(x.broken.how, x.broken.how)),
        *(Column(number_text(value), partial(_cell, k=k), on="page") for k, value in enumerate(case.values)),
        Column("linear\ntheory", lambda x: _number(x.row.theory), right=True, on="page"),
        Column("run time", lambda x: Span(time_text(x.seconds), "muted"), right=True, on="page"),
        Column("what happened", lambda x: Span(x.broken.note, "muted"), on="page"),
    ]
    if all(row.theory is None for row in case.rows):
        del columns[-3]
    facts = dict.fromkeys(name for facts in case.facts for name in facts)
    known = [(name, ", ".join(_number(of.get(name)) for of in case.facts)) for name in facts]
    why = f"; {case.why}" if case.why else ""
    swept = ", ".join(filter(None, (case.parameter, case.unit)))
    error = f"Columns are {swept}. Error: {_MEASURES.get(case.measure, '')}{why}."
    blocks: list[doc.Block] = [
        Paragraph(f"{case.about} Held: error ≤ {case.bar:g}."),
        Table(columns, case._lines, style="map"),
        Paragraph(error, on="page", note=True),
        doc.Facts([*_truths(case), *known]),
    ]
    return Section(case.name, blocks, on)


def _cell(line: Line, k: int) -> Span:
    if k >= len(line.outcomes):
        # An interrupted study has fewer cells than values.
        return Span("", cell="none")
    cell, how = line.row.cells[k], line.outcomes[k]
    styles = [shade(cell, how), *(["sil"] if how == "silent" else [])]
    styles += ["brk"] if k == line.reach and how not in UNKNOWN else []
    return Span(cell_text(cell, how), cell=" ".join(styles))


def _plain(x: float | None, none: str = "") -> str:
    return none if x is None else number_text(x)


def _number(x: float | None) -> str:
    return "–" if x is None or math.isnan(x) else "no limit" if math.isinf(x) else number_text(float(f"{x:.3g}"))


def _truths(case: CaseResult) -> Iterator[tuple[str, str]]:
    """Yield how the truth is known, neighbours of one kind together: for which values, and how."""
    known = [(number_text(v), *how.partition(_KNOWN)[::2]) for v, how in zip(case.values, case.truths, strict=False)]
    for how, group in itertools.groupby((x for x in known if x[1]), key=itemgetter(1)):
        values, _, floors = ([*dict.fromkeys((x[0], x[-1]))] for x in zip(*group, strict=True))
        yield f"truth at {' … '.join(values)}", how + (_KNOWN + " … ".join(floors) if floors[0] else "")
