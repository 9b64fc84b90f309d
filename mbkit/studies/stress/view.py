"""Words and tables for where engines and methods break: a line a case on a terminal, coloured maps on a page."""

from __future__ import annotations

import itertools
import math
import statistics
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, get_args

from mbkit._check import by_key
from mbkit.simulate.plotting.style import engine_index
from mbkit.studies.formatting import error_text, time_text
from mbkit.studies.measurement import Measurement, Outcome
from mbkit.studies.results import counted
from mbkit.studies.stress.case import Family
from mbkit.studies.stress.figure import MAX_ROOMY_COLUMNS, cell_text, error_short, number_text, shade, stable_steps
from mbkit.studies.stress.measurements import CaseResult, Line, Overview, Row, engines_of, fractional_index, name_of

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
_FAMILIES: Final = {x: x.capitalize() for x in get_args(Family)} | {
    "large": "Large and small",
    "long": "Long runs",
    "step": "Step size",
}
_MEASURES: Final = {
    "motion": "the largest difference of q along the run, over the size of the motion",
    "energy": "the largest relative error of the energy along the run",
    "terms": "that of each term at the case's states, relative to the term",
}
#: The words before a truth's floor.
_KNOWN: Final = "; known to "
#: Names in one sentence; the tables have all.
_MAX_NAMES: Final = 3
#: A terminal names so many cases in which a method was wrong in silence.
_MAX_PLACES: Final = 2


def _left_out(o: Overview) -> list[tuple[str, str]]:
    """Return names and reasons of the rows that never ran, those of one reason together."""
    reasons = []
    for line in (x for x in o.lines if x.left_out):
        reason = remarks(line.row.cells[0]) if line.row.cells else ""
        reasons.append((reason or HOW[line.outcomes[0] if line.outcomes else "not run"], name_of(line.row)))
    return [(", ".join(alike), reason) for reason, alike in by_key(reasons).items()]


def families(cases: Iterable[Overview]) -> list[tuple[str, list[Overview]]]:
    """Return the cases by family: its title, and its cases."""
    groups = by_key((each.case.family, each) for each in cases)
    order = [*_FAMILIES, *groups]
    return [(name, groups[name]) for name in sorted(groups, key=order.index)]


# Words.


def value_text(x: float | None, case: CaseResult, unit: bool = True) -> str:
    """Return a value of the swept number, with its unit if wished; a dash for none."""
    if x is None:
        return "–"
    return number_text(x) + (f" {case.unit}" if unit and case.unit and math.isfinite(x) else "")


def held_text(line: Line) -> str:
    """Return how far a row held, in words."""
    return f"held {'' if line.whole or line.broken.held is None else 'to '}{reached_text(line)}"


def reached_text(line: Line) -> str:
    """Return the value up to which a row held."""
    if line.whole:
        return "all"
    return "nothing" if line.broken.held is None else value_text(line.broken.held, line.case)


def remarks(cell: Measurement | None) -> str:
    """Return what was said of a cell beside its numbers."""
    return "" if cell is None else "; ".join(dict.fromkeys(x for x in (cell.note, *cell.warnings) if x))


def leaders(cases: Iterable[Overview]) -> str:
    """Return what held furthest in most cases."""
    ran = [o for o in cases if o.case.rows]
    ranked = [o for o in ran if o.ranks] or ran
    counts = Counter(name for o in ranked for name in o.unbeaten)
    if not counts:
        return f"nothing held in {counted(len(ranked), 'case')}"
    most = max(counts.values())
    names = [name for name, count in counts.items() if count == most]
    if len(names) > _MAX_NAMES:
        names = [", ".join(names[:_MAX_NAMES]), f"{len(names) - _MAX_NAMES} more"]
    elif len(names) > 1:
        names = [", ".join(names[:-1]), names[-1]]
    return f"{' and '.join(names)} held furthest, or as far as any, in {most} of {counted(len(ranked), 'case')}"


# Methods by kind of scene: how often none held further, and at what price.


@dataclass(frozen=True)
class MethodLine:
    """One engine and method over the families of cases."""

    row: Row
    families: dict[str, tuple[int, int]]  # cases where it held furthest, and where it ran
    ahead: int  # the same of all families
    cases: int
    held: float  # the mean part of a sweep
    silent: int  # cases where it was wrong in silence
    factor: float  # median run time over the least of those that held as far; NaN: never ahead


def methods(cases: Iterable[Overview]) -> list[MethodLine]:
    """Return every engine and method that ran, the one that was most often unbeaten first."""
    # Family, line, whether it held furthest, its time over the least of those that did.
    scores: list[tuple[tuple[str, str], tuple[str, Line, bool, float]]] = []
    for o in (o for o in cases if o.ranks):
        most, family = o.furthest, o.case.family
        least = min((x.seconds for x in o.lines if x.reach == most and x.seconds > 0), default=math.nan)
        scores += [((x.row.engine, x.row.method), (family, x, x.reach == most > 0, x.seconds / least)) for x in o.lines]
    out = []
    for group in by_key(scores).values():
        _, lines, ahead, factors = zip(*group, strict=True)
        if all(line.left_out for line in lines):
            continue
        places = by_key((family, first) for family, _, first, _ in group)
        known = [x for x, first in zip(factors, ahead, strict=True) if first and math.isfinite(x)]
        line = MethodLine(
            lines[0].row,
            {family: (sum(firsts), len(firsts)) for family, firsts in places.items()},
            ahead=sum(ahead),
            cases=len(group),
            held=statistics.fmean(line.reach / max(line.size, 1) for line in lines),
            silent=sum("silent" in line.outcomes for line in lines),
            factor=statistics.median(known) if known else math.nan,
        )
        out.append(line)
    return sorted(out, key=lambda m: (-m.ahead, -m.held, m.silent, math.isnan(m.factor), m.factor))


# Silent failures: row by row, and the methods to avoid.


class SilentLine(NamedTuple):
    """One row that was wrong in silence, with the cells where it was."""

    overview: Overview
    row: Row
    cells: list[Measurement]
    worst: Measurement


class Avoid(NamedTuple):
    """A method, and where it was wrong in silence: the case, from which value on, on which engines if not on all."""

    method: str
    places: list[tuple[Overview, str, list[str]]]


def silences(cases: Iterable[Overview]) -> list[SilentLine]:
    """Return every row that was wrong in silence."""
    out = []
    for o in cases:
        for row in o.case.rows:
            if cells := [cell for cell in row.cells if cell.outcome(o.case.bar) == "silent"]:
                worst = max(cells, key=lambda c: math.inf if math.isnan(c.seen) else c.seen)
                out.append(SilentLine(o, row, cells, worst))
    return out


def avoid(cases: Iterable[Overview]) -> list[Avoid]:
    """Return the methods that were wrong in silence, and where; the most often so first."""
    lines: dict[str, dict[str, list[SilentLine]]] = {}
    for line in silences(cases):
        name = name_of(line.row) if line.overview.case.measure == "terms" else line.row.method
        lines.setdefault(name, {}).setdefault(line.overview.anchor, []).append(line)
    out = [Avoid(name, list(map(_mildest, where.values()))) for name, where in lines.items()]
    return sorted(out, key=lambda a: -len(a.places))


def _mildest(group: list[SilentLine]) -> tuple[Overview, str, list[str]]:
    o = group[0].overview
    values = o.case.values
    first = min((s.cells[0].value for s in group), key=lambda v: values.index(v) if v in values else 0)
    # A method of one engine, or wrong on all of them, needs no engine named.
    everywhere = len(group) == [row.method for row in o.case.rows].count(group[0].row.method)
    return o, value_text(first, o.case), [] if everywhere else [s.row.engine for s in group]


# The largest stable step of each method, against linear theory, and the rule that follows for a step.

#: A step is to be short against facts whose names begin so: "fastest frequency", "fastest rate".
_FASTEST: Final = "fastest"
#: Ends that say nothing about stability.
_OTHER: Final = ("slow", "refused", "died")


class Bound(NamedTuple):
    """Steps times the fastest frequency or rate ω, over all cases that have one."""

    held: float  # up to here it held in every case; 0: nowhere
    failed: float  # NaN: all held
    theory: float  # the least limit; infinite: no limit, NaN: unknown

    @property
    def words(self) -> str:
        """The rule for a step."""
        if math.isnan(self.failed):
            return f"no limit up to {_two(self.held)} / ω"
        return f"dt ≤ {_two(self.held)} / ω" if self.held else f"none tried held, the least {_two(self.failed)} / ω"


class Rule(NamedTuple):
    """A method's bounds, by what ω is."""

    method: str
    bounds: dict[str, Bound]

    @property
    def words(self) -> str:
        """The rule for a step, once where it is the same for every ω."""
        by_words = by_key((bound.words, kind) for kind, bound in self.bounds.items())
        if len(by_words) == 1:
            return next(iter(by_words))
        return "; ".join(f"{words} ({', '.join(which)})" for words, which in by_words.items())


def _two(x: float) -> str:
    return number_text(float(f"{x:.2g}"))


def steps(cases: Iterable[Overview]) -> list[Overview]:
    """Return the cases whose step is swept, and of which a row ran."""
    return [o for o in cases if o.case.family == "step" and o.ran]


def rules(cases: Iterable[Overview]) -> list[Rule]:
    """Return each method's rule over all engines and cases that tell a frequency or rate, the largest step first."""
    bounds: dict[str, dict[str, list[Bound]]] = {}
    for o in cases:
        for line in o.ran:
            for kind, bound in _bounds(line):
                bounds.setdefault(line.row.method, {}).setdefault(kind, []).append(bound)
    out = [Rule(method, {kind: _least(group) for kind, group in of.items()}) for method, of in bounds.items()]
    return sorted(out, key=lambda rule: (-min(b.held for b in rule.bounds.values()), rule.method))


def _bounds(line: Line) -> Iterator[tuple[str, Bound]]:
    held, failed, case = line.broken.held, line.broken.failed, line.case
    if line.rest is not None and (failed is None or line.rest in _OTHER):
        # The reason why it stopped there has nothing to do with the step.
        return
    bound = (0.0 if held is None else held, math.nan if failed is None else failed, _limit(line))
    for kind, rate in case.facts[0].items() if case.facts else ():
        if kind.startswith(_FASTEST) and rate > 0:
            yield kind.partition(",")[0], Bound(*(x * rate for x in bound))


def _limit(line: Line) -> float:
    return math.nan if line.row.theory is None else line.row.theory


def _least(group: list[Bound]) -> Bound:
    """Return the settings that are safe in all the cases measured."""
    failed, theory = (
        min((x for x in numbers if not math.isnan(x)), default=math.nan)
        for numbers in ([b.failed for b in group], [b.theory for b in group])
    )
    # Steps are tried on a grid, another one in each case: what held in one may be beyond what did not in another.
    return Bound(min(b.held for b in group if math.isnan(failed) or not math.isnan(b.failed)), failed, theory)


def against_theory(line: Line) -> str:
    """Return how the measured breaking point compares with linear theory; empty where one is unknown."""
    limit, failed, values = _limit(line), line.broken.failed, line.case.values
    at = fractional_index(values, limit)
    if math.isnan(at):
        return ""
    if line.reach and at < line.reach - 1:
        return f"holds {_times(values[line.reach - 1], limit)}further"
    if line.rest is not None and (failed is None or line.rest in _OTHER):
        return ""
    if failed is not None and at > line.reach:
        return f"breaks {_times(failed, limit)}earlier" if math.isfinite(limit) else "breaks, theory has no limit"
    return "as theory says"


def _times(x: float, y: float) -> str:
    return f"{_two(max(abs(x / y), abs(y / x)))} × " if x and y else ""


# The map of a case on the page: a table of cells, as sharp as the page, that can be searched and copied.


class MapCell(NamedTuple):
    """A cell: its classes in the style sheet, its text, and its tooltip."""

    style: str
    text: str
    title: str


def map_cells(line: Line) -> list[MapCell]:
    """Return a row of a case's map."""
    case = line.case
    at = fractional_index(case.values, _limit(line))
    beyond = -1 if math.isnan(at) else math.floor(at) + 1
    out = []
    for k, (cell, how) in enumerate(zip(line.row.cells, line.outcomes, strict=True)):
        style = [shade(cell, how)]
        style += ["sil"] if how == "silent" else []
        style += ["brk"] if k == line.reach and line.broken.failed is not None else []
        style += ["lim"] if k == beyond else []
        text = cell_text(cell, how, short=len(case.values) > MAX_ROOMY_COLUMNS)
        out.append(MapCell(" ".join(style), text, _title(case, line.row, cell, how)))
    # An interrupted study has fewer cells than values.
    return out + [MapCell("none", "", "")] * (len(case.values) - len(out))


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
    known = [(v, *how.partition(_KNOWN)) for v, how in zip(case.values, case.truths, strict=False) if how]
    out = []
    for how, group in itertools.groupby(known, key=lambda entry: entry[1]):
        values, _, _, floors = zip(*group, strict=True)
        where = _ends([value_text(v, case, unit=False) for v in values])
        floor = _ends(floors)
        out.append(("" if len(values) == len(case.values) else where, how + (_KNOWN + floor if floor else "")))
    return out


def _ends(texts: Sequence[str]) -> str:
    """Return the first and the last, or one where they are the same."""
    return " … ".join(dict.fromkeys((texts[0], texts[-1])))


def _facts(case: CaseResult) -> list[tuple[str, list[float]]]:
    """Return each fact over the values, NaN where it is unknown."""
    names = dict.fromkeys(name for facts in case.facts for name in facts)
    padded = [*case.facts, *({} for _ in range(len(case.values) - len(case.facts)))]
    return [(name, [facts.get(name, math.nan) for facts in padded]) for name in names]


def content(cases: Sequence[Overview]) -> dict[str, Any]:
    """Return what the template of the page is filled with."""
    swept = steps(cases)
    step_rules = rules(swept)
    return {
        "avoid": avoid(cases),
        "silences": silences(cases),
        "asked": [o for o in cases if o.choice is not None],
        "behind": [o for o in cases if o.behind],
        "methods": methods(cases),
        "run_families": families(o for o in cases if o.ranks),
        "families": families(cases),
        "engines": engines_of(o.case for o in cases),
        "steps": swept,
        "rules": step_rules,
        "kinds": list(dict.fromkeys(kind for rule in step_rules for kind in rule.bounds)),
        "step_figure": stable_steps([(o.case, o.ran) for o in swept]) if swept else None,
        "bars": by_key(((case.bar, case.why), case.name) for case in (o.case for o in cases)),
    }


def _three_digits(x: float) -> str:
    return "" if math.isnan(x) else number_text(float(f"{x:.3g}"))


def _limit_text(x: float | None, unit: str = "") -> str:
    """Return where theory lets something break."""
    if x is None or math.isnan(x):
        return "–"
    return "no limit" if math.isinf(x) else f"{_three_digits(x)} {unit}".rstrip()


#: Filters by which the template writes numbers and rows.
FILTERS: Final[Mapping[str, Any]] = {
    "short": error_short,
    "number": number_text,
    "fact": _three_digits,
    "limit": _limit_text,
    "value": value_text,
    "held": held_text,
    "left_out": _left_out,
    "how": lambda outcome: HOW.get(outcome, ""),
    "remarks": remarks,
    "rowname": name_of,
    "series": lambda engine: engine_index(engine) + 1,
    "family": lambda name: _FAMILIES.get(name, name),
    "against_theory": against_theory,
    "map_cells": map_cells,
    "facts": _facts,
    "truths": _truths,
    "measured": lambda case: _MEASURES.get(case.measure, case.measure),
    "any_energy": lambda lines: any(not math.isnan(cell.energy) for line in lines for cell in line.row.cells),
}


def leader_text(o: Overview) -> str:
    """Return what held furthest in a case."""
    if o.leader is None:
        return "none ran"
    return f"{o.leader.row.engine} (terms)" if o.case.measure == "terms" else name_of(o.leader.row)


def first_failure(o: Overview) -> str:
    """Return which row is the first that is of no use, and how."""
    line = min((x for x in o.ran if x.ended), key=lambda x: x.usable, default=None)
    if line is None or line.ended is None:
        return ""
    cell, how = line.ended
    return f"{value_text(cell.value, o.case, unit=False)} {how}: {name_of(line.row)}"


def places_text(a: Avoid) -> str:
    """Return where a method was wrong in silence, the first few places."""
    places = [f"{o.case.name} at {o.case.parameter} = {text}" for o, text, _ in a.places[:_MAX_PLACES]]
    return ", ".join(places + ([f"{len(a.places) - _MAX_PLACES} more"] if len(a.places) > _MAX_PLACES else []))
