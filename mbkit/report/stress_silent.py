"""What was wrong in silence: row by row, and the methods to avoid."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mbkit.report.stress import anchor, value_text
from mbkit.studies.stress.reading import name_of
from mbkit.studies.stress.result import CaseResult, Cell, Row, StressResult

__all__ = ["Avoid", "AvoidAt", "SilentLine", "avoid", "silences"]


@dataclass(frozen=True)
class AvoidAt:
    """A case in which a method was wrong in silence, from which value on, on which engines if not on all."""

    case: CaseResult
    anchor: str
    text: str
    engines: tuple[str, ...]


@dataclass(frozen=True)
class Avoid:
    """A method and where it was wrong in silence."""

    method: str
    places: tuple[AvoidAt, ...]


@dataclass(frozen=True)
class SilentLine:
    """One row that was wrong in silence, with the cells where it was."""

    case: CaseResult
    anchor: str
    row: Row
    cells: tuple[Cell, ...]

    @property
    def worst(self) -> Cell:
        """The cell of the largest error."""
        return max(self.cells, key=lambda c: math.inf if math.isnan(c.seen) else c.seen)


def silences(result: StressResult) -> list[SilentLine]:
    """Return every row that was wrong in silence."""
    out = []
    for k, case in enumerate(result.cases):
        for row in case.rows:
            cells = tuple(cell for cell in row.cells if cell.outcome(case.bar) == "silent")
            out += [SilentLine(case, anchor(k), row, cells)] if cells else []
    return out


def avoid(result: StressResult) -> list[Avoid]:
    """Return the methods that were wrong in silence, and where; the most often so first."""
    found: dict[str, dict[str, list[SilentLine]]] = {}
    for line in silences(result):
        name = name_of(line.row) if line.case.measure == "terms" else line.row.method
        found.setdefault(name, {}).setdefault(line.anchor, []).append(line)
    out = [Avoid(name, tuple(_avoid_at(group) for group in where.values())) for name, where in found.items()]
    return sorted(out, key=lambda a: -len(a.places))


def _avoid_at(group: list[SilentLine]) -> AvoidAt:
    case = group[0].case
    first = min((s.cells[0].value for s in group), key=lambda v: case.values.index(v) if v in case.values else 0)
    asked = [row.engine for row in case.rows if row.method == group[0].row.method]
    engines = tuple(s.row.engine for s in group)
    # A method of one engine, or wrong on all of them, needs no engine named.
    return AvoidAt(case, group[0].anchor, value_text(first, case), () if len(engines) == len(asked) else engines)
