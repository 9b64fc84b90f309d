"""Where engines and methods break: the words, and the rows of tables, of a page and a terminal."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from mbkit.studies._figure_style import engine_index
from mbkit.studies.stress.figure import number_text
from mbkit.studies.stress.measurements import (
    CaseResult,
    Line,
    Measurement,
    Outcome,
    Row,
    best,
    furthest,
    lines,
    name_of,
    recommended,
)
from mbkit.studies.stress.result import StressResult

#: Outcomes in words that follow "then".
HOW: Final[dict[Outcome, str]] = {
    "held": "held",
    "inaccurate": "inaccurate",
    "warned": "wrong, with a warning",
    "silent": "wrong in silence",
    "diverged": "diverged",
    "nan": "NaN in silence",
    "refused": "refused",
    "slow": "too slow",
    "died": "the process died",
    "unjudged": "not judged: the truth is not known well enough",
    "not run": "not run",
}
_FAMILIES: Final = {
    "stiffness": "Stiffness",
    "mass ratio": "Mass ratio",
    "length": "Length",
    "spin": "Spin",
    "near-singular": "Near-singular",
    "large": "Large and small",
    "long": "Long runs",
    "step": "Step size",
}
#: Names in one sentence; the tables have all.
_NAMED: Final = 3


@dataclass(frozen=True)
class Overview:
    """A case in one line."""

    case: CaseResult
    anchor: str  # the case's place on the page
    lines: tuple[Line, ...]  # the furthest first
    best: dict[str, Line]  # by engine
    choice: Line | None  # of method auto
    furthest: int  # how many values the best held

    @property
    def behind(self) -> bool:
        """Whether another held further than mbkit's own choice."""
        return self.choice is not None and self.choice.reach < self.furthest

    @property
    def leader(self) -> Line | None:
        """What held furthest; of terms, the first to break of the engine that is best in all of them."""
        ran = [line for line in self.best.values() if not line.left_out]
        return max(ran, key=lambda line: line.reach, default=None)

    @property
    def leader_name(self) -> str:
        """Whose that is."""
        line = self.leader
        if line is None:
            return ""
        return f"{line.row.engine} (terms)" if self.case.measure == "terms" else name_of(line.row)

    @property
    def left_out(self) -> list[tuple[str, str]]:
        """Names and reasons of the rows that never ran, those of one reason together."""
        found: dict[str, list[str]] = {}
        for line in self.lines:
            if line.left_out:
                reason = remarks(line.row.cells[0]) if line.row.cells else ""
                found.setdefault(reason or HOW[line.outcomes[0] if line.outcomes else "not run"], []).append(
                    name_of(line.row)
                )
        return [(", ".join(names), reason) for reason, names in found.items()]


def value_text(x: float | None, case: CaseResult, unit: bool = True) -> str:
    """Return a value of the swept number, with its unit if wished; a dash for none."""
    if x is None:
        return "–"
    return number_text(x) + (f" {case.unit}" if unit and case.unit and math.isfinite(x) else "")


def held_text(line: Line, case: CaseResult) -> str:
    """Return how far a row held, in words."""
    if line.whole:
        return "held all"
    return "held nothing" if line.broken.held is None else f"held to {value_text(line.broken.held, case)}"


def headline(result: StressResult) -> str:
    """Return what held furthest and how much was wrong in silence, in one sentence."""
    stopped = "interrupted; what was finished: "
    if result.complete:
        stopped = f"{result.left_out}; " if result.left_out else ""
    if all(cell.end == "not run" for _, row in result.rows() for cell in row.cells):
        return f"{stopped}nothing was run"
    return f"{stopped}{_leaders(result)}; {_silent(result)}"


def _leaders(result: StressResult) -> str:
    ran = [c for c in result.cases if c.rows]
    ranked = [c for c in ran if ranks(c)] or ran
    counts = Counter(name for case in ranked for name in _ahead(case))
    if not counts:
        return f"nothing held in {_of(len(ranked))}"
    most = max(counts.values())
    names = _listed([name for name, count in counts.items() if count == most])
    return f"{names} held furthest, or as far as any, in {most} of {_of(len(ranked))}"


def ranks(case: CaseResult) -> bool:
    """Return whether a case ranks methods: terms have none, and a sweep of the step asks for stability alone."""
    return case.measure != "terms" and case.family != "step"


def _ahead(case: CaseResult) -> list[str]:
    """Return what held as far as any: engine and method, or of terms the engine in all of them."""
    most = furthest(case)
    if not most:
        return []
    if case.measure == "terms":
        return [engine for engine, line in best(case).items() if line.reach == most]
    return [name_of(line.row) for line in lines(case) if line.reach == most]


def _silent(result: StressResult) -> str:
    found = [[c.outcome(case.bar) for row in case.rows for c in row.cells].count("silent") for case in result.cases]
    count = sum(found)
    if not count:
        return "no silent failures"
    return f"{count} silent failure{'s' * (count != 1)} in {_of(sum(map(bool, found)))}"


def _of(count: int) -> str:
    return f"{count} case{'s' * (count != 1)}"


def _listed(names: Sequence[str]) -> str:
    if len(names) > _NAMED:
        return f"{', '.join(names[:_NAMED])} and {len(names) - _NAMED} more"
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else "".join(names)


def overview(result: StressResult) -> list[Overview]:
    """Return every case in one line."""
    return [
        Overview(case, anchor(k), tuple(lines(case)), best(case), recommended(case), furthest(case))
        for k, case in enumerate(result.cases)
    ]


def anchor(k: int) -> str:
    """Return where on the page the k-th case stands, whatever its name holds."""
    return f"case-{k + 1}"


def families(cases: Sequence[Overview]) -> list[tuple[str, str, list[Overview]]]:
    """Return the cases by family: its name, its title, and its cases."""
    found: dict[str, list[Overview]] = {}
    for each in cases:
        found.setdefault(each.case.family, []).append(each)
    order = [*_FAMILIES, *found]
    return [(name, _FAMILIES.get(name, name), found[name]) for name in sorted(found, key=order.index)]


def remarks(cell: Measurement | None) -> str:
    """Return what was said of a cell beside its numbers."""
    return "" if cell is None else "; ".join(dict.fromkeys(x for x in (cell.note, *cell.warnings) if x))


def bars(result: StressResult) -> list[tuple[float, str, list[str]]]:
    """Return each bar with its reason and the cases that it is for."""
    found: dict[tuple[float, str], list[str]] = {}
    for case in result.cases:
        found.setdefault((case.bar, case.why), []).append(case.name)
    return [(bar, why, names) for (bar, why), names in found.items()]


# Which method for which kind of scene: how often none held further, and at what price.


@dataclass(frozen=True)
class MethodLine:
    """One engine and method over the families of cases."""

    name: str
    series: int
    families: dict[str, tuple[int, int]]  # cases where it held furthest, and where it ran
    ahead: int  # the same of all families
    cases: int
    held: float  # the mean part of a sweep
    silent: int  # cases where it was wrong in silence
    factor: float  # median run time over the least of those that held as far; NaN: never ahead


@dataclass(frozen=True)
class _Score:
    """A row on one case."""

    family: str
    line: Line
    ahead: bool
    factor: float


def methods(result: StressResult) -> list[MethodLine]:
    """Return every engine and method that ran, the one that was most often unbeaten first."""
    found: dict[tuple[str, str], list[_Score]] = {}
    for case in result.cases:
        if not ranks(case):
            continue
        ranked = lines(case)
        most = max((line.reach for line in ranked), default=0)
        least = min((line.seconds for line in ranked if line.reach == most and line.seconds > 0), default=math.nan)
        for line in ranked:
            ahead = line.reach == most > 0
            score = _Score(case.family, line, ahead, line.seconds / least if ahead else math.nan)
            found.setdefault((line.row.engine, line.row.method), []).append(score)
    out = [_summed(scores) for scores in found.values() if not all(s.line.left_out for s in scores)]
    return sorted(out, key=lambda m: (-m.ahead, -m.held, m.silent, math.isnan(m.factor), m.factor))


def _summed(scores: list[_Score]) -> MethodLine:
    families: dict[str, tuple[int, int]] = {}
    for s in scores:
        ahead, cases = families.get(s.family, (0, 0))
        families[s.family] = ahead + s.ahead, cases + 1
    factors = [s.factor for s in scores if math.isfinite(s.factor)]
    row = scores[0].line.row
    return MethodLine(
        name_of(row),
        engine_index(row.engine) + 1,
        families,
        sum(s.ahead for s in scores),
        len(scores),
        statistics.fmean(s.line.reach / max(s.line.size, 1) for s in scores),
        sum("silent" in s.line.outcomes for s in scores),
        statistics.median(factors) if factors else math.nan,
    )


# What was wrong in silence: row by row, and the methods to avoid.


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
    cells: tuple[Measurement, ...]

    @property
    def worst(self) -> Measurement:
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
    of_method = [row.engine for row in case.rows if row.method == group[0].row.method]
    engines = tuple(s.row.engine for s in group)
    # A method of one engine, or wrong on all of them, needs no engine named.
    return AvoidAt(case, group[0].anchor, value_text(first, case), () if len(engines) == len(of_method) else engines)
