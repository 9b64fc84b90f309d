"""What a page and a terminal tell of where engines and methods break: the words, and the lines of tables."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from mbkit.studies.stress.figure import number_text
from mbkit.studies.stress.reading import Line, best, furthest, lines, name_of, recommended
from mbkit.studies.stress.result import CaseResult, Cell, Outcome, StressResult

__all__ = [
    "HOW",
    "Overview",
    "anchor",
    "bars",
    "families",
    "headline",
    "held_text",
    "overview",
    "ranks",
    "told",
    "value_text",
]

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
    """A case in one line.

    Attributes
    ----------
    case : CaseResult
    anchor : str
        Where on the page it stands.
    lines : tuple of Line
        Its rows, the furthest first.
    best : dict of str to Line
        What speaks for each engine.
    choice : Line or None
        Of mbkit's own choice of method.
    furthest : int
        How many values the best held.
    """

    case: CaseResult
    anchor: str
    lines: tuple[Line, ...]
    best: dict[str, Line]
    choice: Line | None
    furthest: int

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
                reason = told(line.row.cells[0]) if line.row.cells else ""
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
    """Return who held furthest and how much was wrong in silence, in one sentence."""
    stopped = "" if result.complete else "interrupted; what was finished: "
    if all(cell.end == "not run" for _, row in result.rows() for cell in row.cells):
        return f"{stopped}nothing was run"
    return f"{stopped}{_leaders(result)}; {_silent(result)}"


def _leaders(result: StressResult) -> str:
    ran = [c for c in result.cases if c.rows]
    asked = [c for c in ran if ranks(c)] or ran
    counts = Counter(name for case in asked for name in _ahead(case))
    if not counts:
        return f"nothing held in {_of(len(asked))}"
    most = max(counts.values())
    names = _listed([name for name, count in counts.items() if count == most])
    return f"{names} held furthest, or as far as any, in {most} of {_of(len(asked))}"


def ranks(case: CaseResult) -> bool:
    """Return whether a case ranks methods: terms have none, and a sweep of the step asks for stability alone."""
    return case.measure != "terms" and case.family != "step"


def _ahead(case: CaseResult) -> list[str]:
    """Return who held as far as any: engine and method, or of terms the engine in all of them."""
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


def told(cell: Cell | None) -> str:
    """Return what was said of a cell beside its numbers."""
    return "" if cell is None else "; ".join(dict.fromkeys(x for x in (cell.note, *cell.warnings) if x))


def bars(result: StressResult) -> list[tuple[float, str, list[str]]]:
    """Return each bar with its reason and the cases that it is for."""
    found: dict[tuple[float, str], list[str]] = {}
    for case in result.cases:
        found.setdefault((case.bar, case.why), []).append(case.name)
    return [(bar, why, names) for (bar, why), names in found.items()]
