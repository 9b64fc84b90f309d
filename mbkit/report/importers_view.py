"""What the page on several importers of one file is made of."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import groupby
from pathlib import PurePath
from typing import Final, Literal

from mbkit.report.formatting import error_text
from mbkit.report.terminal import meaning
from mbkit.studies.explain.result import grouped
from mbkit.studies.importers.result import DECIDING, TERMS, Parsed, ParserComparison, Stage

__all__ = ["Cell", "Line", "Reason", "cell", "lines", "reasons", "title"]

State = Literal["same", "differs", "told", "none"]
_MARK: Final[dict[State, str]] = {"same": "✓", "differs": "✗", "told": "!", "none": "–"}
_WORD: Final[dict[State, str]] = {"same": "same", "differs": "differs", "told": "differs", "none": "not comparable"}
_GLOSS: Final = {
    "joints": "every moving joint has its counterpart",
    "kinds": "they move in the same way",
    "parents": "they hang on the same bodies",
    "places": "they stand at the same places",
    "axes": "about or along the same directions",
    "mimic": "what follows another joint does so",
    "total mass": "with all that stands still",
    "masses": "of each moving body, with what is fixed to it",
    "centres of mass": "of the same bodies",
    "inertias": "about their centres of mass",
    "armature": "motors' inertias at the joints",
    "damping": "viscous, at the joints",
    "friction": "dry, at the joints",
    "limits": "of position, speed and effort",
    "M": "mass matrix, by the engine itself",
    "g": "forces of gravity, by the engine itself",
    "nle": "C v + g, by the engine itself",
    "passive": "springs, dampers and all else that acts without a command, by the engine itself",
}


@dataclass(frozen=True)
class Cell:
    """One stage of one importer: mark, word, and what differs."""

    state: State
    mark: str
    word: str
    says: str


@dataclass(frozen=True)
class Line:
    """One stage of all importers that read the file."""

    name: str
    gloss: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Reason:
    """Causes of one kind.

    Attributes
    ----------
    kind, meaning : str
    says : tuple of (str, str)
        What was done, and what that does.
    acts : bool
        Whether it changes the motion.
    """

    kind: str
    meaning: str
    says: tuple[tuple[str, str], ...]
    acts: bool


def title(result: ParserComparison) -> str:
    """Return the file's name without its folder."""
    return PurePath(result.source).name


def lines(result: ParserComparison) -> list[Line]:
    """Return the table, stage by stage."""
    read = [p for p in result.importers if p.stages]
    if not read:
        return []
    return [
        Line(stage.name, _GLOSS.get(stage.name, ""), tuple(cell(p.stages[k]) for p in read))
        for k, stage in enumerate(read[0].stages)
    ]


def cell(stage: Stage) -> Cell:
    """Return a stage as mark, word and what differs."""
    state: State = "same" if stage.same else "none" if stage.same is None else "told"
    if state == "told" and stage.name in DECIDING:
        state = "differs"
    says = "" if stage.same else stage.says
    if stage.name in TERMS and math.isfinite(stage.worst):
        joint = f", most at {stage.where}" if stage.same is False and stage.where else ""
        says = f"to {error_text(stage.worst)}" if stage.same else f"by {error_text(stage.worst)}{joint}"
    return Cell(state, _MARK[state], _WORD[state], says)


def reasons(p: Parsed) -> list[Reason]:
    """Return why an importer's reading differs, what moves something first."""
    if p.explanation is None:
        return []
    out = []
    for acts in (True, False):
        told = grouped(c for c in p.explanation.causes if c.acts == acts)
        for kind, some in groupby(told, key=lambda x: x[0]):
            says = tuple((s, what if acts else "") for _, s, what in some)
            out.append(Reason(kind, meaning(kind), says, acts))
    return out
