"""The content of the stress page; a case has a map, a table of coloured cells, and what stands under it.

The map is a table and no picture: as sharp as the page on any screen, to be searched and copied, with the rest
of a cell shown to whoever points at it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from mbkit.report import stress_view
from mbkit.report.formatting import error_text, time_text
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
    """A cell: its classes in the style sheet, its text, and what is said of it to whoever points at it."""

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
class Section:
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


def section(overview: Overview) -> Section:
    """Return what the page tells of a case."""
    case = overview.case
    rows = [
        MapRow(line, engine_index(line.row.engine) + 1, tuple(_cells(line, case)), against_theory(line, case))
        for line in overview.lines
        if not line.left_out
    ]
    heads = [value_text(v, case, unit=False) for v in case.values]
    measured = _MEASURES.get(case.measure, case.measure)
    return Section(case, overview.anchor, heads, rows, overview.left_out, _facts(case), _truths(case), measured)


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
    """Return all of a cell, for whoever points at it."""
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
        "headline": stress_view.headline(result),
        "avoid": stress_view.avoid(result),
        "silences": stress_view.silences(result),
        "asked": [o for o in overview if o.choice is not None],
        "behind": [o for o in overview if o.behind],
        "methods": stress_view.methods(result),
        "run_families": stress_view.families([o for o in overview if stress_view.ranks(o.case)]),
        "families": stress_view.families(overview),
        "sections": {o.anchor: section(o) for o in overview},
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
