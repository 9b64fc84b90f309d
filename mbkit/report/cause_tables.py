"""Tables of why two descriptions, importers or engines differ."""

from __future__ import annotations

import math
from pathlib import PurePath

from rich.console import Group, RenderableType
from rich.text import Text

from mbkit._escape import one_line
from mbkit.report.layout import bullet, columns, right, titled
from mbkit.report.numbers import error_text
from mbkit.report.tables import DIFFER, verdict
from mbkit.studies.causes.result import Cause, Explanation, grouped
from mbkit.studies.parsers.result import TERMS, Parsed, ParserComparison, Stage

__all__ = ["explanation", "importers"]

_MARK = {True: ("✓", "green"), False: ("✗", DIFFER), None: ("–", "dim")}


def explanation(result: Explanation) -> RenderableType:
    """Return verdict, terms, causes and notes of an explanation."""
    parts: list[RenderableType] = [verdict(f"{result.a} and {result.b}", result.verdict, result.agree)]
    if result.gaps:
        table = columns("term", *right("relative difference"), "joint")
        for g in result.gaps:
            style = "green" if g.relative <= result.tolerance else DIFFER
            table.add_row(one_line(g.term), Text(error_text(g.relative), style=style), one_line(g.joint))
        parts += titled("Terms, by joint name", table)
    parts += _causes("Causes", result.causes)
    if any(m.how == "structure" for m in result.matches) or result.only_a or result.only_b:
        lines = [bullet(f"{one_line(m.a)} ", f"is {one_line(m.b)}") for m in result.matches if m.how == "structure"]
        for names, side in ((result.only_a, result.a), (result.only_b, result.b)):
            lines += [bullet(f"{one_line(n)} ", f"is only in {one_line(side)}") for n in names]
        parts += titled(f"Joints: {sum(m.how == 'name' for m in result.matches)} matched by name, and", *lines)
    if result.notes:
        parts += titled("Notes", *(bullet("", one_line(n, 400)) for n in result.notes))
    return Group(*parts, Text())


def _causes(title: str, causes: tuple[Cause, ...]) -> list[RenderableType]:
    if not causes:
        return []
    acting = [(*line, True) for line in grouped(c for c in causes if c.acts)]
    silent = [(*line, False) for line in grouped(c for c in causes if not c.acts)]
    lines = [
        bullet(f"{one_line(kind)}: ", f"{one_line(says, 400)} ({what})", *(("✗", DIFFER) if acts else ("i", "dim")))
        for kind, says, what, acts in (*acting, *silent)
    ]
    return titled(title, *lines)


def importers(result: ParserComparison) -> RenderableType:
    """Return the stages of every importer side by side, and why they differ."""
    parts: list[RenderableType] = [verdict(PurePath(result.source).name, result.verdict, result.agree)]
    read = [p for p in result.importers if p.stages]
    if read:
        table = columns("stage", *(f"{p.engine} {p.version}" for p in read))
        for k, stage in enumerate(read[0].stages):
            table.add_row(stage.name, *(_cell(p.stages[k]) for p in read))
        base = "; the base floats" if result.floating_base else ""
        parts += titled(f"Stages, against the {result.against}{base}; mimic joints free in the terms", table)
    for p in result.importers:
        parts += _importer(p)
    notes = [*result.notes, *([result.faults] if result.faults else [])]
    if notes:
        parts += titled("Notes", *(bullet("", one_line(n, 500)) for n in notes))
    return Group(*parts, Text())


def _importer(p: Parsed) -> list[RenderableType]:
    if p.refused:
        return titled(f"{p.engine} {p.version}", bullet("refuses: ", one_line(p.refused, 500), "✗", DIFFER))
    out = _causes(f"{p.engine}: causes", p.explanation.causes if p.explanation else ())
    lines = [bullet("", one_line(n, 300)) for n in p.notes]
    return [*out, *(lines if out else titled(p.engine, *lines) if lines else [])]


def _cell(stage: Stage) -> Text:
    mark, style = _MARK[stage.same]
    number = ""
    if stage.name in TERMS and math.isfinite(stage.worst):
        number = f" {error_text(stage.worst)}"
    says = f" {one_line(stage.says, 44)}" if not number and stage.same is not True else number
    return Text(f"{mark}{says}", style=style)
