"""The document of where engines and methods break.

A case has a map on the page: a table of coloured cells, as sharp as the page, that can be searched and copied.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from mbkit.report import stress_view
from mbkit.report.document import Bullet, Column, Document, Items, Section, Span, Table
from mbkit.report.formatting import choice, error_text, time_text
from mbkit.report.stress_steps import against_theory, kinds, rules, stable_steps, steps
from mbkit.report.stress_view import HOW, Overview, held_text, remarks, value_text
from mbkit.studies._figure_style import engine_index
from mbkit.studies.stress.figure import ROOMY, cell_text, error_short, number_text, shade
from mbkit.studies.stress.measurements import CaseResult, Line, Measurement, Outcome, Row, engines_of, name_of, place
from mbkit.studies.stress.result import StressResult

_MEASURES: Final = {
    "motion": "the largest difference of q along the run, over the size of the motion",
    "energy": "the largest relative error of the energy along the run",
    "terms": "that of each term at given states, relative to the term",
}
#: What a truth's floor stands behind.
_KNOWN: Final = "; known to "


@dataclass(frozen=True)
class MapCell:
    """A cell: its classes in the style sheet, its text, and its tooltip."""

    style: str
    text: str
    title: str


@dataclass(frozen=True)
class MapRow:
    """A row of a map: `series` is its engine's colour, `theory` how its breaking point stands to linear theory's."""

    line: Line
    series: int
    cells: tuple[MapCell, ...]
    theory: str


@dataclass(frozen=True)
class CaseMap:
    """A case with all that the page tells of it: rows that ran, the furthest first, and what was left out and why."""

    case: CaseResult
    anchor: str
    heads: list[str]
    rows: list[MapRow]
    left_out: list[tuple[str, str]]
    facts: list[tuple[str, list[float]]]
    truths: list[tuple[str, str]]
    measured: str

    @property
    def settings(self) -> bool:
        """Whether anything was set."""
        return any(row.line.row.setting for row in self.rows)

    @property
    def theories(self) -> bool:
        """Whether linear theory says anything."""
        return any(row.line.row.theory is not None for row in self.rows)

    @property
    def energies(self) -> bool:
        """Whether any energy was measured."""
        return any(not math.isnan(cell.energy) for row in self.rows for cell in row.line.row.cells)


def case_map(overview: Overview) -> CaseMap:
    """Return what the page tells of a case."""
    case = overview.case
    rows = [
        MapRow(line, engine_index(line.row.engine) + 1, tuple(_cells(line, case)), against_theory(line, case))
        for line in overview.lines
        if not line.left_out
    ]
    heads = [value_text(v, case, unit=False) for v in case.values]
    measured = _MEASURES.get(case.measure, case.measure)
    return CaseMap(case, overview.anchor, heads, rows, overview.left_out, _facts(case), _truths(case), measured)


def _cells(line: Line, case: CaseResult) -> list[MapCell]:
    short = len(case.values) > ROOMY
    limit = _first_beyond(line, case)
    out = []
    for k, (cell, how) in enumerate(zip(line.row.cells, line.outcomes, strict=True)):
        style = [shade(cell, how)]
        style += ["sil"] if how == "silent" else []
        style += ["brk"] if k == line.reach and line.broken.failed is not None else []
        style += ["lim"] if k == limit else []
        out.append(MapCell(" ".join(style), cell_text(cell, how, short), _title(case, line.row, cell, how)))
    # An interrupted study has fewer cells than values.
    return out + [MapCell("none", "", "")] * (len(case.values) - len(out))


def _first_beyond(line: Line, case: CaseResult) -> int:
    """Return the first value beyond linear theory's limit; -1 where there is no limit."""
    limit = line.row.theory
    at = math.nan if limit is None else place(case.values, limit)
    return -1 if math.isnan(at) else math.floor(at) + 1


def _title(case: CaseResult, row: Row, cell: Measurement, outcome: Outcome) -> str:
    """Return the tooltip of a cell: all its numbers."""
    parts = [f"{name_of(row)}, {case.parameter} = {value_text(cell.value, case)}: {HOW[outcome]}"]
    for name, x in (("error", cell.error), ("energy", cell.energy)):
        parts += [] if math.isnan(x) else [f"{name} {error_text(x)}"]
    parts += [f"the truth is known to {error_text(cell.floor)}"] if cell.floor else []
    parts += [] if math.isnan(cell.seconds) else [time_text(cell.seconds)]
    parts += [f"{cell.steps} steps"] if cell.steps else []
    return "; ".join(parts + ([remarks(cell)] if remarks(cell) else []))


def _truths(case: CaseResult) -> list[tuple[str, str]]:
    """Return how the truth is known, neighbours of one kind together: for which values, and how."""
    split = [(value, *how.partition(_KNOWN)) for value, how in zip(case.values, case.truths, strict=False) if how]
    out = []
    for how, group in itertools.groupby(split, key=lambda known: known[1]):
        alike = list(group)
        where = _ends([value_text(value, case, unit=False) for value, *_ in alike])
        floors = _ends([floor for *_, floor in alike])
        out.append(("" if len(alike) == len(case.values) else where, how + (_KNOWN + floors if floors else "")))
    return out


def _ends(texts: Sequence[str]) -> str:
    """Return the first and the last, or one where they are the same."""
    return " … ".join(dict.fromkeys((texts[0], texts[-1])))


def _facts(case: CaseResult) -> list[tuple[str, list[float]]]:
    """Return each fact over the values, NaN where it is unknown."""
    names = dict.fromkeys(name for facts in case.facts for name in facts)
    padded = [*case.facts, *({} for _ in range(len(case.values) - len(case.facts)))]
    return [(name, [facts.get(name, math.nan) for facts in padded]) for name in names]


def content(result: StressResult) -> dict[str, Any]:
    """Return what the template of the page is filled with."""
    overview = stress_view.overview(result)
    step_cases = steps(overview)
    step_rules = rules(step_cases)
    engines = engines_of(result.cases)
    return {
        "avoid": stress_view.avoid(result),
        "silences": stress_view.silences(result),
        "asked": [o for o in overview if o.choice is not None],
        "behind": [o for o in overview if o.behind],
        "methods": stress_view.methods(result),
        "run_families": stress_view.families([o for o in overview if stress_view.ranks(o.case)]),
        "families": stress_view.families(overview),
        "sections": {o.anchor: case_map(o) for o in overview},
        "engines": engines,
        "series": {e: engine_index(e) + 1 for e in engines},
        "steps": step_cases,
        "rules": step_rules,
        "kinds": kinds(step_rules),
        "step_figure": stable_steps(step_cases) if step_cases else None,
        "bars": stress_view.bars(result),
    }


def _three_digits(x: float) -> str:
    return "" if math.isnan(x) else number_text(float(f"{x:.3g}"))


def _limit(x: float | None, unit: str = "") -> str:
    """Return where theory lets something break."""
    if x is None or math.isnan(x):
        return "–"
    return "no limit" if math.isinf(x) else f"{_three_digits(x)} {unit}".rstrip()


#: What the template writes numbers and rows with.
FILTERS: Final = {
    "short": error_short,
    "number": number_text,
    "fact": _three_digits,
    "limit": _limit,
    "value": value_text,
    "held": held_text,
    "how": lambda outcome: HOW.get(outcome, ""),
    "remarks": remarks,
    "rowname": name_of,
}


# The document: a line a case on a terminal; on a page all of `content`.

#: Of methods that were wrong in silence, and of the cases of each.
_METHODS: Final = 6
_PLACES: Final = 2


def view(result: StressResult) -> Document:
    """Return the document of a stress study."""
    cases = stress_view.overview(result)
    runs = sum(cell.end != "not run" for _, row in result.rows() for cell in row.cells)
    auto = [Column("auto", lambda o: _choice(o), fill=True)] if any(o.choice for o in cases) else []
    columns = (
        Column("case", lambda o: o.case.name, most=22, fill=True),
        Column("furthest", lambda o: o.leader_name if o.leader else "none ran", most=24, fill=True),
        Column("held to", lambda o: _held(o.leader, o) if o.leader else "", fill=True),
        *auto,
        Column("✗", lambda o: Span(_silent_count(o), "bad"), right=True),
        Column("first to break", lambda o: Span(_first(o), "muted"), fill=True),
    )
    behind = [
        Bullet(
            o.case.name,
            f"auto {held_text(o.choice, o.case)}, {name_of(o.lines[0].row)} {held_text(o.lines[0], o.case)}",
            "!",
            "allowed",
        )
        for o in cases
        if o.behind and o.choice is not None
    ]
    silent = [Bullet(a.method, _places(a), "✗", "bad") for a in stress_view.avoid(result)]
    return Document(
        name="stress",
        heading="Stiff and extreme: where each engine and method breaks",
        title="Stiff and extreme",
        verdict=stress_view.headline(result),
        good=bool(result.complete and result.cases and not silent),
        marked=False,
        summary=f"{len(cases)} cases · {runs} runs · {time_text(result.seconds)}",
        sections=[
            Section("Who holds furthest, and what breaks first", [Table(columns, cases)]),
            Section("Where another held further than auto", [Items(behind)]),
            Section("Wrong in silence, and the mildest value where", [Items(silent, most=_METHODS)]),
        ],
        result=result,
        basis={name: choice(value) for name, value in result.settings.items()},
        template="stress.html",
        content=lambda: content(result),
    )


def _choice(o: Overview) -> Span:
    text = "" if o.choice is None else "behind" if o.behind else "✓"
    return Span(text, "allowed" if o.behind else "good")


def _held(line: Line, o: Overview) -> str:
    if line.whole:
        return "all"
    return "nothing" if line.broken.held is None else value_text(line.broken.held, o.case)


def _silent_count(o: Overview) -> str:
    return str(sum(line.outcomes.count("silent") for line in o.lines) or "")


def _first(o: Overview) -> str:
    """Return which row is the first that is of no use, and how."""
    ended = [(line.usable, line, *line.ended) for line in o.lines if line.ended and not line.left_out]
    if not ended:
        return ""
    _, line, cell, how = min(ended, key=lambda item: item[0])
    return f"{value_text(cell.value, o.case, unit=False)} {how}: {name_of(line.row)}"


def _places(a: stress_view.Avoid) -> str:
    places = [f"{p.case.name} at {p.case.parameter} = {p.text}" for p in a.places[:_PLACES]]
    return ", ".join(places + ([f"{len(a.places) - _PLACES} more"] if len(a.places) > _PLACES else []))
