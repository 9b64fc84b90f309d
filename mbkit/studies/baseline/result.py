"""What `check` and `diff` return: a status, what led to it, and ways to read them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from mbkit._check import MAX_LINES
from mbkit.studies.baseline.description import Change
from mbkit.studies.document import Bullet, Document, Items, Style, to_text
from mbkit.studies.results import Refusal, ResultTable, columns_of, counted

Status = Literal["same", "versions", "numbers", "description", "skipped"]
# A person acts on the first few; the rest is in the data.
_MAX_CHANGES_SHOWN: Final = 20
_MARKS: Final[dict[str, tuple[str, Style]]] = {
    "note": ("·", "muted"),
    "version": ("·", "muted"),
    "processor": ("·", "muted"),
    "effect": ("→", "bold"),
}
_FAULT: Final[tuple[str, Style]] = ("✗", "bad")
_SKIPPED: Final[tuple[str, Style]] = ("–", "allowed")


@dataclass(frozen=True)
class ChangedNumber:
    """A term that is not what was recorded, at its worst state and joint.

    `joint` is the name of the velocity, or of the two of an entry of M, and empty for energies; `state` is one of the
    recorded states; `recorded` and `now` are the entry that differs most for that joint; `error` and `allowed` are as
    `mbkit.studies.compare.errors` has them; `cause` names the version that moved, and `reason` what else there is to
    say, alone where the engine gave no number.
    """

    term: str
    engine: str
    joint: str
    state: str
    recorded: float
    now: float
    error: float
    allowed: float
    cause: str = ""
    reason: str = ""

    def __str__(self) -> str:
        if np.isnan(self.now):
            return f"{self.term}: {self.reason}"
        at = f" at {self.joint}" if self.joint else ""
        where = f" ({self.state})" if self.state else ""
        change = f"{self.term}{at}{where}: {self.recorded:.12g} → {self.now:.12g}"
        more = f"; {self.reason}" if self.reason else ""
        return f"{change}, off by {self.error:.1e} where {self.allowed:.1e} is rounding{more}"


@dataclass(frozen=True)
class VersionChange:
    """A package whose version differs."""

    package: str
    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.package} {self.old} → {self.new}"


@dataclass(frozen=True, repr=False)
class BaselineResult(ResultTable):
    """A model held against a baseline, or one baseline against another.

    `question` is "check" or "diff", and `against` the second file of a `diff`. `status` is the gravest difference, and
    "skipped" where no engine was there. `engines` are those that were checked. `changes` are parameters of the
    description, causes before effects; `moved` are numbers that are not as recorded, by more than rounding;
    `processors` are those of then and now. `skipped` are engines that are not there, with the reason, which fails if
    `strict`. `effect` says what a changed description does to the terms, and `worst` is the largest error of numbers
    as recorded.
    """

    question: Literal["check", "diff"]
    model: str
    path: str
    status: Status
    engines: tuple[str, ...] = ()
    against: str = ""
    changes: tuple[Change, ...] = ()
    moved: tuple[ChangedNumber, ...] = ()
    versions: tuple[VersionChange, ...] = ()
    processors: tuple[str, str] = ("", "")
    skipped: tuple[Refusal, ...] = ()
    strict: bool = False
    notes: tuple[str, ...] = ()
    effect: str = ""
    worst: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether the robot and all engines that were checked are as recorded."""
        return self.status in ("same", "versions") and not (self.strict and self.skipped)

    @property
    def verdict(self) -> str:
        """One sentence."""
        how = "missing, which fails (strict)" if self.strict else "skipped"
        missing = f"; {', '.join(r.engine for r in self.skipped)} {how}" if self.skipped else ""
        if self.question == "diff":
            parameters = f"{counted(len(self.changes), 'parameter')} of the description"
            sentences = {
                "same": "the same robot, with the same numbers",
                "versions": f"the same numbers, of other versions: {self._version_text()}",
                "numbers": "the same description, with other numbers",
                "description": f"{parameters} differ{'s' * (len(self.changes) == 1)}",
            }
            return sentences[self.status]
        if self.status == "skipped":
            return f"nothing was checked: {', '.join(f'{r.engine} ({r.reason})' for r in self.skipped)}"
        if self.status == "description":
            return f"the description changed in {counted(len(self.changes), 'parameter')}"
        if self.status == "numbers":
            names = ", ".join(dict.fromkeys(r.engine for r in self.moved))
            return f"{counted(len(self.moved), 'number')} moved: {names}{missing}"
        agreement = f"{', '.join(self.engines)}; largest error {self.worst:.1e}"
        if self.status == "versions":
            return f"as recorded ({agreement}), by other versions: {self._version_text()}; rebaseline?{missing}"
        return f"as recorded ({agreement}){missing}"

    def _version_text(self) -> str:
        return ", ".join(map(str, self.versions))

    def lines(self, everything: bool = False) -> Iterator[tuple[str, str]]:
        """Iterate over the findings, gravest first: (subject, message).

        Unless `everything` is set, the first 20 parameters and of each engine the 8 numbers that are off most.
        """
        most = len(self.moved) if everything else MAX_LINES
        shown = self.changes if everything else self.changes[:_MAX_CHANGES_SHOWN]
        for change in shown:
            yield "description", change.text
        if len(shown) < len(self.changes):
            yield "description", f"and {len(self.changes) - len(shown)} more"
        if self.effect:
            yield "effect", self.effect
        for engine in dict.fromkeys(r.engine for r in self.moved):
            rows = sorted((r for r in self.moved if r.engine == engine), key=lambda r: -r.error)
            cause = f" ({rows[0].cause})" if rows[0].cause else ""
            for row in rows[:most]:
                yield f"{engine}{cause}", str(row)
            if len(rows) > most:
                rest = ", ".join(dict.fromkeys(r.term for r in rows[most:]))
                yield f"{engine}{cause}", f"and {len(rows) - most} more: {rest}"
        if self.moved or self.changes:
            for version in self.versions:
                yield "version", str(version)
            if self.processors[0] != self.processors[1]:
                yield "processor", " → ".join(self.processors)
        for refusal in self.skipped:
            yield refusal.engine, refusal.reason if self.strict else f"skipped: {refusal.reason}"
        for note in self.notes:
            yield "note", note

    def text(self, remedy: str = "") -> str:
        """Return everything for a terminal without colours; `remedy` is the command that records again."""
        return to_text(self.document(remedy, full=False))

    _derived = ("passed", "verdict")
    _listed = "moved"
    _csv_columns = columns_of(ChangedNumber)

    def document(self, again: str = "", *, full: bool = True) -> Document:
        """Return the document of a check or a diff; `again` is the command that records again, `full` as in `lines`."""
        skipped = {r.engine for r in self.skipped}
        bullets = []
        for what, line in self.lines(everything=full):
            mark, style = _SKIPPED if what in skipped else _MARKS.get(what, _FAULT)
            bullets.append(Bullet(what, line, mark, style))
        if again and self.question == "check" and self.status in ("description", "numbers", "versions"):
            bullets.append(Bullet("if this is meant" if self.status != "versions" else "to record again", again))
        path = self.path if self.question == "check" else f"{self.path} → {self.against}"
        return Document(
            name=f"{self.model} ({path})",
            verdict=self.verdict,
            good=self.passed,
            opening=[Items(bullets)],
            sections=[],
            result=self,
        )
