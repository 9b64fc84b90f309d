"""What `lint` found in a description: frozen data, and ways to read it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import ClassVar, Final

from mbkit._check import by_key
from mbkit.engines.base import MAX_NAMES
from mbkit.model.validation import listing
from mbkit.studies.document import Bullet, Column, Document, Items, Section, Span, Style, Table
from mbkit.studies.results import ResultTable, columns_of, counted

#: How sure a finding is. Only the first two make `LintResult.passed` False.
SURE: Final = "sure"
LIKELY: Final = "likely"
LOOK: Final = "look"
SURENESS: Final = (SURE, LIKELY, LOOK)
_STYLES: Final[dict[str, Style]] = {SURE: "bad", LIKELY: "allowed", LOOK: "muted"}
#: Facts that are never judged, since nothing in the file contradicts them.
UNSEEN: Final = "what one file cannot show: the sign of an axis, the mass of the whole, where a joint's zero is"


@dataclass(frozen=True)
class LintFinding:
    """One number that a description should not have.

    `part` is a link or a joint, and `others` are those that share the finding. `value` is the number, `expected` says
    in words what it should be, and `confidence` is "sure", "likely" or "look".
    """

    part: str
    check: str
    value: float
    expected: str
    confidence: str
    message: str
    others: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.part}: {self.message} ({self.check}, {self.confidence})"


@dataclass(frozen=True)
class LintResult(ResultTable):
    """A description judged by what it knows of itself; no engine says whether a file is plausible.

    `rows` begin with the surest. `links` and `joints` count what was judged, `shaped` the links with shapes. `skipped`
    says what was not judged, and why. `control_period` is in s, and `seconds` is the time of the whole.
    """

    model: str
    rows: tuple[LintFinding, ...]
    links: int
    joints: int
    shaped: int
    skipped: tuple[str, ...] = ()
    control_period: float = 0.0
    versions: dict[str, str] = field(default_factory=dict)
    processor: str = ""
    seconds: float = 0.0

    _csv_columns: ClassVar = columns_of(LintFinding)
    _derived: ClassVar = ("passed", "verdict")

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong for sure or likely; what to look at does not count."""
        return all(row.confidence == LOOK for row in self.rows)

    @property
    def verdict(self) -> str:
        """How many findings there are, by how sure they are."""
        judged = f"{counted(self.links, 'link')} ({self.shaped} with shapes) and {counted(self.joints, 'joint')}"
        many = Counter(row.confidence for row in self.rows)
        how = ", ".join(f"{many[name]} {name}" for name in SURENESS if many[name])
        return f"{counted(len(self.rows), 'finding') if self.rows else 'nothing found'} on {judged}" + (
            f": {how}" if how else ""
        )

    def document(self, *, full: bool = True) -> Document:
        """Return the document of the findings; parts with the same finding share a line, which names a few or all."""
        most = len(self.rows) if full else MAX_NAMES
        groups = by_key(((row.check, row.confidence, row.message, row.expected), row) for row in self.rows)
        columns = (
            Column("link or joint", lambda rows: Span(listing([row.part for row in rows], most), "mono")),
            Column("check", lambda rows: rows[0].check),
            Column("", lambda rows: Span(rows[0].confidence, _STYLES[rows[0].confidence])),
            Column("found", lambda rows: rows[0].message, fill=True),
            Column("expected", lambda rows: rows[0].expected),
        )
        return Document(
            name=self.model,
            verdict=self.verdict,
            good=self.passed,
            sections=[
                Section("", [Table(columns, [*groups.values()])]),
                Section("Not judged", [Items([Bullet("", text) for text in (*self.skipped, UNSEEN)])]),
            ],
            result=self,
        )
