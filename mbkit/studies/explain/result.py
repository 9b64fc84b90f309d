"""What an explanation is: frozen data, and ways to read it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from mbkit._escape import html, markdown, one_line
from mbkit.errors import OutputError
from mbkit.studies.explain.joint_matching import Match
from mbkit.studies.explain.terms import Gap

__all__ = ["Cause", "Explanation", "effect", "grouped", "plain", "saved"]

#: More causes of one kind than this are told in one line.
_FEW: Final = 3


@dataclass(frozen=True)
class Cause:
    """One thing that makes the second side differ from the first.

    Attributes
    ----------
    kind : str
        The usual mistake's name, such as ``"armature"`` or ``"inertia about the wrong point"``.
    subject : str
        The body, the joint or the whole.
    says : str
        What the second side did, as a sentence.
    a, b : float, list or None
        The numbers of the two sides, where they are numbers.
    effects : dict
        Term -> relative difference that this cause alone makes: the larger of two, where it is put into the
        first side, and where it is taken out of the second. Infinite where the coordinates are then others.
        Empty where no term can show it: other names, matter that stands still, a constraint.
    acts : bool
        Whether any of that is above the tolerance, or it is a constraint.
    """

    kind: str
    subject: str
    says: str
    a: Any
    b: Any
    effects: dict[str, float]
    acts: bool

    def __str__(self) -> str:
        return self.says


@dataclass(frozen=True)
class Explanation:
    """Why two descriptions or engines differ, or that they do not.

    Attributes
    ----------
    a, b : str
        What the two sides are called.
    agree : bool
        Whether all terms agree by joint name, and all joints and constraints are there.
    gaps : tuple of Gap
        How far each term is apart, joints matched by name where they have the same names.
    comparable : bool
        Whether both have the same coordinates, so that terms can be compared.
    matches : tuple of Match
        Who is who, and whether by name or by structure.
    only_a, only_b : tuple of str
        Joints without a counterpart.
    causes : tuple of Cause
    notes : tuple of str
        Differences that are none, such as frames drawn elsewhere.
    explained : bool
        Whether the difference vanishes once all causes are applied to one side.
    left : tuple of Gap
        What remains of each term then; empty where the coordinates are not the same.
    subtree : tuple of str
        Where something remains: the joints of the smallest part that still differs.
    samples, seed : int
    tolerance : float
        Relative difference of a term above which two sides differ.
    massless : bool
        Whether M is zero on both sides at every state, so that equal terms are no agreement.
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

    @property
    def acting(self) -> tuple[Cause, ...]:
        """The causes that change the motion."""
        return tuple(c for c in self.causes if c.acts)

    @property
    def worst(self) -> float:
        """The largest relative difference of a term; infinite where the coordinates are not the same."""
        return max((g.relative for g in self.gaps), default=0.0) if self.comparable else math.inf

    @property
    def remainder(self) -> float:
        """The largest relative difference with all causes applied to one side; infinite without any term."""
        return max((g.relative for g in self.left), default=math.inf)

    @property
    def verdict(self) -> str:
        """One sentence: the same, or why not."""
        count, silent = len(self.acting), len(self.causes) - len(self.acting)
        beside = f"; {_counted(silent, 'difference')} that change{'s' * (silent == 1)} no term" if silent else ""
        if self.agree:
            cancel = f"; {_counted(count, 'difference')} that cancel" if count else ""
            return f"{self.b} moves as {self.a} does (to {self.worst:.1e}){cancel}{beside}"
        apart = "in its coordinates"
        if self.comparable:
            apart = f"by {self.worst:.1e}" if self.worst > self.tolerance else "in its constraints"
        head = f"{self.b} differs from {self.a} {apart}"
        if self.massless:
            return f"{self.b} and {self.a} are not compared: the mass matrix is zero on both sides{beside}"
        if not self.matches:
            return f"{head}; they have no joint in common, so no term was compared"
        if not self.explained:
            where = f"; the smallest part that still differs: {', '.join(self.subtree)}" if self.subtree else ""
            rest = f": {self.remainder:.1e} remains" if self.left else ""
            some = f"{_counted(count, 'cause')} found do not explain it all" if count else "no usual cause does it"
            return f"{head}, and {some}{rest}{where}"
        left = f"; with {'it' if count == 1 else 'all of them'} applied the terms agree to {self.remainder:.1e}"
        return f"{head}, for {_counted(count, 'reason')}{left}{beside}"

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return asdict(self) | {"verdict": self.verdict}

    def to_json(self, path: str | Path | None = None) -> str:
        """Return the result as JSON, and write it to `path` if given. Infinity and NaN become null."""
        return saved(self.to_dict(), path)

    def to_markdown(self) -> str:
        """Return verdict, causes and notes in Markdown."""
        lines = [f"**{markdown(self.a)} and {markdown(self.b)}**: {markdown(self.verdict)}", ""]
        if self.causes:
            lines += ["| cause | what | effect |", "|---|---|---|"]
            lines += [f"| {' | '.join(map(markdown, line))} |" for line in grouped(self.causes)]
            lines.append("")
        lines += [f"- {markdown(note)}" for note in self.notes]
        return "\n".join(lines).rstrip() + "\n"

    def _repr_html_(self) -> str:
        cells = "".join(
            f"<tr><td>{html(kind)}</td><td>{html(says)}</td><td>{html(what)}</td></tr>"
            for kind, says, what in grouped(self.causes)
        )
        head = "".join(f"<th>{h}</th>" for h in ("cause", "what", "effect"))
        notes = "".join(f"<li>{html(n)}</li>" for n in self.notes)
        return (
            f"<p><b>{html(self.a)} and {html(self.b)}</b>: {html(self.verdict)}</p>"
            + (f"<table><tr>{head}</tr>{cells}</table>" if cells else "")
            + (f"<ul>{notes}</ul>" if notes else "")
        )

    def __repr__(self) -> str:
        return f"<Explanation: {one_line(self.verdict)}>"


def _counted(n: int, what: str) -> str:
    return f"{'one' if n == 1 else n} {what}{'s' * (n != 1)}"


def effect(cause: Cause) -> str:
    """Return what a cause does, in a few words."""
    if not cause.acts:
        return "changes no term"
    if not cause.effects:
        return "a constraint, which no term holds"
    term, largest = max(cause.effects.items(), key=lambda x: x[1])
    return "other coordinates" if math.isinf(largest) else f"{term} by {largest:.1e}"


def grouped(causes: Iterable[Cause]) -> list[tuple[str, str, str]]:
    """Return kind, sentence and effect of each cause, many of one kind and effect taken together."""
    by_kind: dict[tuple[str, bool], list[Cause]] = {}
    for c in causes:
        by_kind.setdefault((c.kind, c.acts), []).append(c)
    out = []
    for (kind, _), some in by_kind.items():
        if len(some) <= _FEW:
            out += [(kind, c.says, effect(c)) for c in some]
            continue
        largest = max(some, key=lambda c: max(c.effects.values(), default=0.0))
        names = ", ".join(c.subject.split("'")[1] if "'" in c.subject else c.subject for c in some)
        most = f"up to {effect(largest)}" if largest.acts and largest.effects else effect(largest)
        out.append((kind, f"{len(some)} times, first {some[0].says}; in all: {names}", most))
    return out


def plain(value: Any) -> Any:
    """Return numbers of a description as JSON takes them."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (np.floating, np.integer)):
        return value.item()
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def saved(data: dict[str, Any], path: str | Path | None) -> str:
    """Return data as JSON, and write it if a path is given."""
    text = json.dumps(plain(data), indent=1, allow_nan=False)
    if path is not None:
        try:
            Path(path).write_text(text, encoding="utf-8")
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}; the result itself is kept") from error
    return text
