"""What `lint` found, as a document."""

from __future__ import annotations

from mbkit._check import by_key
from mbkit.model.validation import listing
from mbkit.report.document import Bullet, Column, Document, Items, Section, Span, Style, Table
from mbkit.studies.lint.result import LIKELY, LOOK, SURE, UNSEEN, LintResult

_STYLES: dict[str, Style] = {SURE: "bad", LIKELY: "allowed", LOOK: "muted"}
#: Parts of one finding that are named.
_NAMED = 3


def lint_view(result: LintResult) -> Document:
    """Return the document of a result; parts with the same finding share a line."""
    groups = by_key(((row.check, row.confidence, row.message, row.expected), row) for row in result.rows)
    columns = [
        Column("link or joint", lambda rows: Span(listing([row.part for row in rows], _NAMED), "mono")),
        Column("check", lambda rows: rows[0].check),
        Column("", lambda rows: Span(rows[0].confidence, _STYLES[rows[0].confidence])),
        Column("found", lambda rows: rows[0].message, fill=True),
        Column("expected", lambda rows: rows[0].expected),
    ]
    return Document(
        name=result.model,
        verdict=result.verdict,
        good=result.passed,
        sections=[
            Section("", [Table(columns, [*groups.values()])]),
            Section("Not judged", [Items([Bullet("", text) for text in (*result.skipped, UNSEEN)])]),
        ],
        result=result,
    )
