"""A model held against its baseline, on a terminal."""

from __future__ import annotations

from rich.console import Group, RenderableType

from mbkit._escape import one_line
from mbkit.report.layout import bullet
from mbkit.report.tables import verdict
from mbkit.studies.baseline import BaselineResult

__all__ = ["result"]

_MARKS = {"note": ("·", "dim"), "version": ("·", "dim"), "processor": ("·", "dim"), "effect": ("→", "bold")}


def result(found: BaselineResult, again: str = "") -> RenderableType:
    """Return the verdict and what led to it; `again` is the command that records anew."""
    name = found.path if found.question == "check" else f"{found.path} → {found.against}"
    parts: list[RenderableType] = [verdict(f"{found.model} ({name})", one_line(found.verdict), found.passed)]
    skipped = {r.engine for r in found.skipped}
    for what, told in found.lines():
        mark = ("–", "yellow") if what in skipped else _MARKS.get(what, ("✗", "bold red"))
        parts.append(bullet(f"{one_line(what)}: ", one_line(told), *mark))
    if again and found.question == "check" and found.status in ("description", "numbers", "versions"):
        head = "if this is meant: " if found.status != "versions" else "to record anew: "
        parts.append(bullet(head, one_line(again)))
    return Group(*parts)
