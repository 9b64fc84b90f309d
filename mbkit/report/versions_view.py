"""Versions of an engine against the oracle, as a document."""

from __future__ import annotations

import math
from collections.abc import Callable

from mbkit._check import by_key
from mbkit.report.document import Bullet, Column, Document, Items, Paragraph, Section, Span, Table
from mbkit.studies.versions.result import AWAY, REFUSED, Change, VersionRow, VersionsResult, digits_text

_LEGEND = (
    "Right digits in the worst state, by the oracle. A star marks a number that moved by more than the tolerance since "
    "the version before; rows that begin with “file” are of the version's own parser, and a dash is no value."
)


def versions_view(result: VersionsResult) -> Document:
    """Return the document of a study: changes, digits by version, times and what is missing."""
    columns, rows = result.table()
    cells = [Column("robot", lambda row: row[0], group=True), Column("terms", lambda row: row[1])]
    cells += [Column(c.head, _cell(k + 2), right=True) for k, c in enumerate(columns[2:])]
    reasons = dict.fromkeys((r.robot, r.reason, r.version) for r in result.rows if r.reason)
    grouped = by_key(((robot, reason), version) for robot, reason, version in reasons)
    notes = [Bullet(f"{robot}, {', '.join(of)}", reason) for (robot, reason), of in grouped.items()]
    return Document(
        name=result.engine,
        title=f"{result.engine}: {len(result.measured)} versions",
        verdict=result.verdict.removeprefix(f"{result.engine} "),
        good=result.same,
        sections=[
            Section("Changes", [Items([_change(c) for c in result.changes])]),
            Section("Digits", [Table(cells, rows), Paragraph(_LEGEND, on="page", note=True)] if rows else []),
            Section("Time of a forward dynamics, over the last version's", _times(result)),
            Section("Versions without a number", [Items([Bullet(v, why, "✗", "bad") for v, why in result.missing])]),
            Section("Notes", [Items(notes, most=12)]),
        ],
        result=result,
        basis={
            "states": f"{result.settings['samples']} random ones of each robot, seed {result.settings['seed']}, and "
            "neutral, at-limit and near-singular ones",
            "versions": f"{len(result.measured)} of {result.settings['known']}",
        },
    )


def _change(change: Change) -> Bullet:
    worse = change.direction in (AWAY, REFUSED)
    return Bullet(change.version, str(change), "✗" if worse else "!", "bad" if worse else "allowed")


def _cell(k: int) -> Callable[[tuple[str, ...]], Span]:
    def cell(row: tuple[str, ...]) -> Span:
        return Span(row[k], "bold" if row[k].endswith("*") else "muted")

    return cell


def _times(result: VersionsResult) -> list[Table]:
    """Return a table of ratios, robot by version; nothing without any."""
    ratios: dict[str, dict[str, VersionRow]] = {}
    for r in result.rows:
        if not math.isnan(r.time_ratio):
            ratios.setdefault(r.robot, {})[r.version] = r
    columns = [Column("robot", lambda robot: robot)]
    columns += [Column(v, _ratio(ratios, v), right=True) for v in result.measured]
    return [Table(columns, list(ratios))] if ratios else []


def _ratio(ratios: dict[str, dict[str, VersionRow]], version: str) -> Callable[[str], str]:
    return lambda robot: digits_text(ratios[robot][version].time_ratio, 2) if version in ratios[robot] else "–"
