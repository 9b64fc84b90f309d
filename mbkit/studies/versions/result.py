"""What a study of an engine's versions found: frozen data, and ways to read it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, ClassVar, Final

from mbkit.studies.results import Block, Column, Items, ResultTable, Table, Title, columns_of, counted

#: Where a number went.
TOWARDS: Final = "towards the truth"
AWAY: Final = "away from the truth"
ASIDE: Final = "as far from the truth as before"
REFUSED: Final = "refused since"
GIVEN: Final = "given since"


@dataclass(frozen=True)
class VersionRow:
    """One term of one robot in one version.

    A `term` that begins with ``file`` is of the model that the version's own parser read. `digits` are those that are
    right, by the oracle, in the worst state; NaN without a value. `moved` is how far the value is from that of the
    version before, relative as errors are, NaN without one; `changed` says whether it moved by more than the tolerance,
    or began or ceased to be there, and `direction` where it went. `time_ratio` is the time of one forward dynamics over
    that of the last version, measured alternately; NaN for files. `reason` says why there is no value.
    """

    robot: str
    version: str
    term: str
    digits: float
    moved: float = math.nan
    changed: bool = False
    direction: str = ""
    time_ratio: float = math.nan
    reason: str = ""


@dataclass(frozen=True)
class Change:
    """A number that moved between two versions.

    `next_to_it` says whether none of the versions of the study lies between them; then `version` is its first with the
    new number.
    """

    robot: str
    term: str
    before: str
    version: str
    digits_before: float
    digits: float
    direction: str
    next_to_it: bool = True

    def __str__(self) -> str:
        between = "" if self.next_to_it else " (there are versions between them)"
        old, new = (digits_text(x) for x in (self.digits_before, self.digits))
        return (
            f"{self.term} of {self.robot}: {self.direction}, {old} digits in {self.before}, {new} in "
            f"{self.version}{between}"
        )


def digits_text(digits: float, places: int = 1) -> str:
    """Return a number of digits, a dash for none."""
    return "–" if math.isnan(digits) else f"{digits:.{places}f}"


@dataclass(frozen=True)
class VersionsResult(ResultTable):
    """Terms of an engine's versions against the oracle.

    `measured` are its versions, oldest first. `rows` are by robot, term and version, and `changes`, what moved, in the
    same order. `missing` are versions without an environment or a process, each with the reason. `versions` are those
    of what else took part, such as the oracle, and `seconds` is the time of the whole.
    """

    engine: str
    measured: tuple[str, ...]
    rows: tuple[VersionRow, ...]
    changes: tuple[Change, ...]
    missing: tuple[tuple[str, str], ...]
    settings: dict[str, Any]
    versions: dict[str, str]
    processor: str
    seconds: float

    _derived: ClassVar = ("same", "verdict")
    _csv_columns = columns_of(VersionRow)

    @property
    def same(self) -> bool:
        """Whether no number moved, and every version could be measured."""
        return not self.changes and not self.missing

    @property
    def verdict(self) -> str:
        """The outcome in a sentence."""
        if not self.measured:
            return f"none of {len(self.missing)} versions of {self.engine} could be measured"
        span = self.measured[0] if len(self.measured) == 1 else f"{self.measured[0]} to {self.measured[-1]}"
        head = f"{self.engine} {span}: "
        if not self.changes:
            said = f"no number moved by more than {self.settings['tolerance']:g}"
        else:
            away = sum(c.direction in (AWAY, REFUSED) for c in self.changes)
            said = f"{counted(len(self.changes), 'change')}, {away} of them away from the truth or to no value"
        lost = f"; {counted(len(self.missing), 'version')} could not be measured" if self.missing else ""
        return head + said + lost

    def row(self, robot: str, version: str, term: str) -> VersionRow:
        """Return one row; `LookupError` without it."""
        for r in self.rows:
            if (r.robot, r.version, r.term) == (robot, version, term):
                return r
        raise LookupError(f"no row of {robot}, {version}, {term}")

    def table(self) -> tuple[list[Column], list[tuple[str, ...]]]:
        """Return columns and rows of digits: robot and term by version, alike rows of a robot together."""
        cells: dict[tuple[str, tuple[str, ...]], list[str]] = {}
        by = {(r.robot, r.term, r.version): r for r in self.rows}
        for robot, term in dict.fromkeys((r.robot, r.term) for r in self.rows):
            of = [by.get((robot, term, v)) for v in self.measured]
            texts = tuple("" if r is None else digits_text(r.digits, 0) + " *" * r.changed for r in of)
            cells.setdefault((robot, texts), []).append(term)
        rows = [(robot, ", ".join(terms), *texts) for (robot, texts), terms in cells.items()]
        heads = ("robot", "terms", *self.measured)
        return [Column(head, itemgetter(k), right=k > 1) for k, head in enumerate(heads)], rows

    def _blocks(self) -> Iterator[Block]:
        yield Title(self.engine, f": {self.verdict}")
        if self.changes:
            yield Items([str(c) for c in self.changes])
        yield Table(*self.table())
        yield Items([f"{version}: {reason}" for version, reason in self.missing])
        reasons = dict.fromkeys((r.robot, r.term, r.reason) for r in self.rows if r.reason)
        yield Items([f"{robot}, {term}: {reason}" for robot, term, reason in reasons])

    def __repr__(self) -> str:
        return f"<VersionsResult: {self.verdict}>"
