"""Where engines and methods break, on a terminal: a line a case, and what was wrong in silence."""

from __future__ import annotations

from typing import Final

from rich.console import Group, RenderableType
from rich.text import Text

from mbkit._escape import one_line
from mbkit.report.formatting import time_text
from mbkit.report.stress_view import Avoid, Overview, avoid, headline, held_text, overview, value_text
from mbkit.report.terminal import bullet, columns, right, titled
from mbkit.studies.stress.result import Line, StressResult, name_of

__all__ = ["summary"]

_BAD: Final = "bold red"
#: Of methods that were wrong in silence, and of the cases of each.
_METHODS: Final = 6
_PLACES: Final = 2


def summary(result: StressResult) -> RenderableType:
    """Return each case in a line: who held furthest and how far, mbkit's own choice, what breaks first."""
    told = overview(result)
    runs = sum(cell.end != "not run" for _, row in result.rows() for cell in row.cells)
    parts: list[RenderableType] = [
        Text.assemble(("stress: ", "bold"), one_line(headline(result))),
        Text(f"  {len(told)} cases · {runs} runs · {time_text(result.seconds)}", style="dim"),
        *(titled("Who holds furthest, and what breaks first", _cases(told)) if told else []),
        *_behind(told),
        *_avoided(avoid(result)),
    ]
    return Group(*parts, Text())


def _cases(told: list[Overview]) -> RenderableType:
    asked = any(o.choice for o in told)
    table = columns("case", "furthest", "held to", *(["auto"] if asked else []), *right("✗"), "first to break")
    # One line a case: what is cut stands in the page.
    table.expand = True
    table.columns[-1].ratio = 1
    for column in table.columns:
        column.no_wrap, column.overflow = True, "ellipsis"
    for o in told:
        silent = sum(line.outcomes.count("silent") for line in o.lines)
        choice = "" if o.choice is None else "behind" if o.behind else "✓"
        table.add_row(
            Text(one_line(o.case.name, 22)),
            Text(one_line(o.leader_name, 24) if o.leader else "none ran"),
            Text(_held(o.leader, o) if o.leader else ""),
            *([Text(choice, style="yellow" if o.behind else "green")] if asked else []),
            Text(str(silent) if silent else "", style=_BAD),
            Text(_first(o), style="dim"),
        )
    return table


def _held(line: Line, o: Overview) -> str:
    if line.whole:
        return "all"
    return "nothing" if line.broken.held is None else one_line(value_text(line.broken.held, o.case))


def _first(o: Overview) -> str:
    """Return which row is the first that is of no use, and how."""
    found = [(line.usable, line, *line.ended) for line in o.lines if line.ended and not line.left_out]
    if not found:
        return ""
    _, line, cell, how = min(found, key=lambda item: item[0])
    return one_line(f"{value_text(cell.value, o.case, unit=False)} {how}: {name_of(line.row)}")


def _behind(told: list[Overview]) -> list[RenderableType]:
    lines = [
        bullet(
            f"{one_line(o.case.name)}: ",
            one_line(
                f"auto {held_text(o.choice, o.case)}, {name_of(o.lines[0].row)} {held_text(o.lines[0], o.case)}", 200
            ),
            "!",
            "bold yellow",
        )
        for o in told
        if o.behind and o.choice is not None
    ]
    return titled("Where another held further than auto", *lines) if lines else []


def _avoided(found: list[Avoid]) -> list[RenderableType]:
    lines = []
    for a in found[:_METHODS]:
        places = [f"{p.case.name} at {p.case.parameter} = {p.text}" for p in a.places[:_PLACES]]
        places += [f"{len(a.places) - _PLACES} more"] if len(a.places) > _PLACES else []
        lines.append(bullet(f"{one_line(a.method)}: ", one_line(", ".join(places), 300), "✗", _BAD))
    if len(found) > _METHODS:
        lines.append(bullet("", f"and {len(found) - _METHODS} more methods, in the page and the JSON", " ", _BAD))
    return titled("Wrong in silence, and the mildest value where", *lines) if lines else []
