"""What `lint` found in a description: frozen data, and ways to read it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar, Final

from mbkit.studies.results import Block, Items, ResultTable, Table, Title, columns_of, counted

#: How sure a finding is. Only the first two make `LintResult.passed` False.
SURE: Final = "sure"
LIKELY: Final = "likely"
LOOK: Final = "look"
SURENESS: Final = (SURE, LIKELY, LOOK)
#: What is never judged, since nothing in the file contradicts it.
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

    def _blocks(self) -> Iterator[Block]:
        yield Title(self.model, f": {self.verdict}")
        if self.rows:
            yield Table([c for c in columns_of(LintFinding) if c.head != "value"], self.rows)
        yield Items((*self.skipped, UNSEEN))
