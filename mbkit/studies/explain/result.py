"""The result of `explain`: causes with their measured effects, and a verdict."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from mbkit._check import by_key
from mbkit._escape import one_line
from mbkit.engines.base import MAX_NAMES
from mbkit.model.validation import listing
from mbkit.studies.document import Block, Bullet, Column, Document, Items, Section, Span, Style, Table
from mbkit.studies.explain.hypotheses import Hypothesis
from mbkit.studies.explain.joint_matching import Match
from mbkit.studies.explain.motion_result import MotionComparison, RecordComparison
from mbkit.studies.explain.terms import WHOLE, Gap
from mbkit.studies.explain.worlds import Changed, changed
from mbkit.studies.formatting import error_text
from mbkit.studies.results import NOT_PLAIN, ResultTable, columns_of


@dataclass(frozen=True)
class Cause:
    """A difference between two sides.

    Its `kind` names the usual mistake, such as ``"gravity"`` or ``"inertia about the wrong point"``; `subject` is the
    body or joint, empty for the whole; `says` is a sentence about the second side; `a` and `b` are the numbers of the
    two sides, where they are numbers. `effects` has for each term the relative difference of this cause alone: the
    larger of two, where it is added to the first side, and where it is removed from the second. It is infinite where
    the coordinates then differ, and empty where no term can show it: other names, matter that stands still. A
    constraint acts on the accelerations of the whole system, or on its configurations. `acts` says whether an effect is
    above the tolerance.
    """

    kind: str
    subject: str
    says: str
    a: Any
    b: Any
    effects: dict[str, float]
    acts: bool
    change: Hypothesis | None = field(default=None, repr=False, compare=False, metadata=NOT_PLAIN)

    def __str__(self) -> str:
        return self.says

    def apply(self, side: Changed) -> Changed:
        """Return the first description with this change alone, its links that are fixed together merged.

        Parameters
        ----------
        side : Model or Settings
            The first description; settings where the cause is one of the simulator (`MotionComparison.effects`).

        Raises
        ------
        UnsupportedError
            A cause that no part of the description holds: other names, joints that one side alone has.
        """
        return changed(self.change, self.says, side)

    def revert(self, side: Changed) -> Changed:
        """Return the second description without this change, in the names and frames of the first."""
        return changed(self.change, self.says, side, back=True)


@dataclass(frozen=True)
class Explanation(ResultTable):
    """Why two descriptions or engines differ, or that they do not.

    `a` and `b` are the names of the two sides. `agree` says whether all terms agree by joint name, and all joints and
    constraints are there. `gaps` has the difference of each term, joints matched by name where they have the same
    names; `comparable` says whether both have the same coordinates, so that terms can be compared. `matches` are the
    matched joints, `only_a` and `only_b` those without a counterpart. `notes` are differences without effect, such as
    frames drawn elsewhere. `explained` says whether the difference vanishes with all `causes` applied to one side, and
    `left` has the remaining difference of each term, empty where the coordinates differ; then `subtree` has the joints
    of the smallest part that still differs. Two sides differ where a term differs by more than `tolerance`. `massless`
    says whether M is zero on both sides at every state, so that equal terms are no agreement. `compared` says whether
    accelerations of the whole systems were: there are none without a state that keeps the constraints, nor where the
    mass matrix is singular. `beside` has what differs, or was not compared, of two files beside their terms: options of
    simulation, servos, contacts. `motion` has what each cause does to a motion, `records` what turns one
    recorded motion into another, where that was asked.
    """

    a: str
    b: str
    agree: bool
    gaps: tuple[Gap, ...]
    comparable: bool
    matches: tuple[Match, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    causes: tuple[Cause, ...]
    notes: tuple[str, ...]
    explained: bool
    left: tuple[Gap, ...]
    subtree: tuple[str, ...]
    samples: int
    seed: int
    tolerance: float
    massless: bool = False
    compared: bool = True
    beside: tuple[str, ...] = ()
    motion: MotionComparison | None = None
    records: RecordComparison | None = None

    @property
    def acting(self) -> tuple[Cause, ...]:
        """The causes that change the motion."""
        return tuple(c for c in self.causes if c.acts)

    @property
    def worst(self) -> float:
        """The largest relative difference of a term; infinite where the coordinates differ."""
        return max((g.relative for g in self.gaps), default=0.0) if self.comparable else math.inf

    @property
    def remainder(self) -> float:
        """The largest relative difference with all causes applied to one side; infinite without any term."""
        return max((g.relative for g in self.left), default=math.inf)

    @property
    def verdict(self) -> str:
        """One sentence: the same, or why not."""
        moved = "".join(f"; {x.verdict}" for x in (self.motion, self.records) if x is not None)
        return self._of_terms + (f"; {listing(self.beside, MAX_NAMES)}" if self.beside else "") + moved

    @property
    def _of_terms(self) -> str:
        count, silent = len(self.acting), len(self.causes) - len(self.acting)
        beside = f"; {_counted(silent, 'difference')} that change{'s' * (silent == 1)} no term" if silent else ""
        alike = self.comparable and not (self.massless or self.acting) and self.worst <= self.tolerance
        if self.agree or ((self.beside or self.motion is not None) and alike):
            cancel = f"; {_counted(count, 'difference')} that cancel" if count else ""
            if not self.compared:
                none = "no motion was compared: no state keeps the constraints, or the mass matrix is singular"
                return f"{self.b} is described as {self.a} is (to {self.worst:.1e}); {none}{cancel}{beside}"
            moves = f"moves as {self.a} does" if self.agree else f"has the terms of {self.a}"
            return f"{self.b} {moves} (to {self.worst:.1e}){cancel}{beside}"
        apart = "in its coordinates"
        if self.comparable:
            apart = f"by {self.worst:.1e}" if self.tolerance < self.worst < math.inf else "in its constraints"
        head = f"{self.b} differs from {self.a} {apart}"
        if self.massless:
            return f"{self.b} and {self.a} are not compared: the mass matrix is zero on both sides{beside}"
        if not self.matches:
            return f"{head}; they have no joint in common, so no term was compared"
        if not self.explained:
            where = f"; the smallest part that still differs: {', '.join(self.subtree)}" if self.subtree else ""
            rest = f": {self.remainder:.1e} remains" if self.left else ""
            some = f"{_counted(count, 'cause')} do not explain all of it" if count else "no usual cause does it"
            return f"{head}, and {some}{rest}{where}"
        left = f"; with {'it' if count == 1 else 'all of them'} applied the terms agree to {self.remainder:.1e}"
        return f"{head}, for {_counted(count, 'reason')}{left}{beside}"

    _derived = ("verdict",)
    _listed = "causes"
    _csv_columns: ClassVar = {**columns_of(Cause), "effect": lambda cause: effect(cause)}

    def document(self) -> Document:
        """Return the document of the explanation: verdict, terms, causes and notes."""
        gaps = (
            Column("term", lambda g: g.term),
            Column("relative difference", self._difference, right=True),
            Column("joint", lambda g: g.joint),
        )
        joints = [f"{m.a} is {m.b}" for m in self.matches if m.how == "structure"]
        for names, side in ((self.only_a, self.a), (self.only_b, self.b)):
            joints += [f"{name} is only in {side}" for name in names]
        by_name = sum(m.how == "name" for m in self.matches)
        return Document(
            name=f"{self.a} and {self.b}",
            verdict=self.verdict,
            good=self.agree,
            sections=[
                Section("Terms, by joint name", [Table(gaps, self.gaps)]),
                Section("Causes", cause_blocks(self.causes)),
                *(section for x in (self.motion, self.records) if x is not None for section in x.sections()),
                Section(f"Joints: {by_name} matched by name, and", [Items([Bullet("", text) for text in joints])]),
                Section("Notes", [Items([Bullet("", note) for note in self.notes])]),
            ],
            result=self,
        )

    def _difference(self, gap: Gap) -> Span:
        return Span(error_text(gap.relative), "good" if gap.relative <= self.tolerance else "bad")

    def __repr__(self) -> str:
        reasons = [f"{c.says} ({effect(c)})" for c in self.acting]
        return f"<Explanation: {one_line('; '.join(filter(None, (self.verdict, listing(reasons, MAX_NAMES)))))}>"


def _counted(n: int, what: str) -> str:
    return f"{'one' if n == 1 else n} {what}{'s' * (n != 1)}"


def effect(cause: Cause) -> str:
    """Return the effect of a cause, in a few words."""
    if not cause.acts:
        return "changes no term"
    term, largest = max(cause.effects.items(), key=lambda x: x[1])
    if math.isinf(largest):
        return "other configurations" if term == WHOLE else "other coordinates"
    return f"{term} by {largest:.1e}"


def grouped(causes: Iterable[Cause]) -> list[tuple[str, str, str]]:
    """Return kind, sentence and effect of each cause; more than three of one kind are one line."""
    out = []
    for (kind, _), some in by_key(((c.kind, c.acts), c) for c in causes).items():
        if len(some) <= MAX_NAMES:
            out += [(kind, c.says, effect(c)) for c in some]
            continue
        largest = max(some, key=lambda c: max(c.effects.values(), default=0.0))
        names = ", ".join(c.subject.split("'")[1] if "'" in c.subject else c.subject for c in some)
        most = f"up to {effect(largest)}" if largest.acts and largest.effects else effect(largest)
        out.append((kind, f"{len(some)} times, first {some[0].says}; in all: {names}", most))
    return out


def cause_blocks(causes: Iterable[Cause], apart: tuple[str, ...] = ()) -> list[Block]:
    """Return the causes, those that move something first; kinds that stand `apart` decide nothing."""
    bullets: list[Bullet] = []
    known = list(causes)
    for acts in (True, False):
        for kind, says, what in grouped(c for c in known if c.acts == acts):
            # The meaning of a kind is said once.
            again = any(b.head == kind for b in bullets)
            decides = acts and kind not in apart
            look: tuple[str, Style] = ("✗", "bad") if decides else ("!", "allowed")
            bullets.append(Bullet(kind, f"{says} ({what})", *look, "" if again else meaning(kind)))
    return [Items(bullets)]


@cache
def meanings() -> dict[str, dict[str, str]]:
    """Return sentences on kinds of causes and on stages of importers."""
    return tomllib.loads((Path(__file__).parent / "meanings.toml").read_text(encoding="utf-8"))


def meaning(kind: str) -> str:
    """Return a sentence on a kind of cause; empty where its name says it all."""
    return meanings()["causes"].get(kind, "")
