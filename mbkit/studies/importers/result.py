"""A comparison of importers: frozen data, and ways to read it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import PurePath
from typing import ClassVar, Final

from mbkit._check import by_key
from mbkit.studies.document import Bullet, Column, Document, Items, Paragraph, Section, Span, Table
from mbkit.studies.explain.result import Explanation, cause_blocks, meanings
from mbkit.studies.explain.terms import TERMS
from mbkit.studies.formatting import error_text
from mbkit.studies.results import ResultTable, columns, counted

#: The name of the reference: the file as written.
FILE: Final = "file"
#: The version of an importer that is not there; it has refused nothing.
MISSING: Final = "not installed"
#: The stages that say whether two readings move alike.
DECIDING: Final = ("joints", *TERMS)
#: Stages that no term shows: an agreement leaves them out.
_APART: Final = {"mimic": "mimic joints", "limits": "limits", "loops": "loops", "couplers": "couplers"}
_LEGEND: Final = (
    "✓ the same. ✗ another motion, which decides whether an importer agrees. ! in no term, so it decides nothing. "
    "– cannot be compared."
)


@dataclass(frozen=True)
class Stage:
    """A term of one importer, or what holds its joints, against the reference.

    `same` is None where it cannot be compared. `worst` is the largest difference, relative for terms, else in m or its
    unit, and NaN without one; `where` is the joint where it is largest; `says` tells the difference in words.
    """

    name: str
    same: bool | None
    worst: float
    where: str
    says: str


@dataclass(frozen=True)
class Parsed:
    """One importer's reading.

    `refused` says why it does not read the file, and is empty where it does. `stages` is empty where there is no
    reference; `explanation` says why it differs from the reference; `notes` are what it
    said, and what it holds beside bodies and joints.
    """

    engine: str
    version: str
    refused: str = ""
    stages: tuple[Stage, ...] = ()
    explanation: Explanation | None = None
    notes: tuple[str, ...] = ()

    _derived: ClassVar = ("agrees",)

    @property
    def label(self) -> str:
        """The importer and its version."""
        return self.engine if "==" in self.engine else f"{self.engine} {self.version}"

    @property
    def outcome(self) -> str:
        """``"agree"``, ``"differ"``, ``"refuse"``, ``"missing"``, or ``"read"`` where there is no reference."""
        if self.refused:
            return "missing" if self.version == MISSING else "refuse"
        return "read" if not self.stages else "agree" if self.agrees else "differ"

    @property
    def agrees(self) -> bool:
        """Whether it moves as the reference does, mimic joints left free and loops open, and no cause acts."""
        causes = self.explanation.acting if self.explanation else ()
        same = bool(self.stages) and all(s.same for s in self.stages if s.name in DECIDING)
        return same and all(c.kind in _APART for c in causes)


@dataclass(frozen=True, repr=False)
class ParserComparison(ResultTable):
    """A file through several importers.

    `source` is the file, and `format` is ``"urdf"`` or ``"mjcf"``. `reference` is what the importers are compared with:
    ``"file"``, the file as written, link by link. Where mbkit does not read it, for the reason in `faults`, it is
    empty, and nothing is compared. `notes` say what was removed from the file before. `versions` are those of every
    package that took part, and `seconds` is the time of the whole.
    """

    source: str
    format: str
    floating_base: bool
    reference: str
    faults: str
    importers: tuple[Parsed, ...]
    notes: tuple[str, ...]
    samples: int
    seed: int
    tolerance: float
    versions: dict[str, str]
    processor: str
    seconds: float

    @property
    def agree(self) -> bool:
        """Whether every importer reads the file, and all of them move alike."""
        return len(self.importers) > 1 and all(p.agrees for p in self.importers)

    @property
    def verdict(self) -> str:
        """One sentence: which importers agree, differ, refuse or were not compared."""
        names = by_key((p.outcome, p.engine) for p in self.importers)
        alike = [p for p in self.importers if p.agrees]
        other = {s.name for p in alike for s in p.stages if not s.same}
        other |= {c.kind for p in alike if p.explanation for c in p.explanation.causes}
        apart = [what for name, what in _APART.items() if name in other]
        said = {
            "read": "not compared: mbkit does not read the file; {names} read{s} it",
            "agree": "{names} agree{s} with the file as written" + (f", {_listed(apart)} apart" if apart else ""),
            "differ": "{names} differ{s}",
            "refuse": "{names} refuse{s}",
            "missing": "{names} {are} not installed",
        }
        parts = (
            text.format(names=_listed(some), s="s" * (len(some) == 1), are="is" if len(some) == 1 else "are")
            for outcome, text in said.items()
            if (some := names.get(outcome))
        )
        return "; ".join(parts) or "no importer was asked"

    @property
    def against(self) -> str:
        """What the importers are compared with, in words; empty where there is no reference."""
        how = "link by link" if self.format == "urdf" else "body by body"
        return f"file as written, {how}" if self.reference else ""

    _derived = ("agree", "verdict")
    _called = "source"
    _csv_columns: ClassVar = {
        **columns(0, "engine", "version"),
        "stage": lambda row: row[1].name,
        **columns(1, "same", "worst", "where", "says"),
    }

    def _csv_rows(self) -> list[tuple[Parsed, Stage]]:
        return [(p, stage) for p in self.importers for stage in p.stages]

    def document(self) -> Document:
        """Return the document of several importers of one file: their own terms, and why they differ."""
        name = PurePath(self.source).name
        read = [p for p in self.importers if p.stages]
        alone = [p for p in self.importers if p.outcome == "read"]
        outcome = "agree" if self.agree else "differ" if read else "are not compared" if alone else "refuse"
        columns = [
            Column("stage", lambda rows: Span(rows[0].name, "bold")),
            Column("", lambda rows: Span(meanings()["stages"].get(rows[0].name, ""), "muted"), on="page"),
            *(Column(p.label, partial(_stage, k)) for k, p in enumerate(read)),
        ]
        refused = [Bullet(p.label, p.refused, "✗", "bad") for p in self.importers if p.refused]
        notes = [Bullet("the file", note) for note in (*([self.faults] if self.faults else []), *self.notes)]
        notes += [Bullet(p.engine, note) for p in (*read, *alone) for note in p.notes]
        about = (
            "What an importer fuses is fused on the other side too; mimic joints are left free in M, g, nle and "
            f"passive, whose differences are relative to the forces at play and count above {self.tolerance:g}."
        )
        stages = Table(columns, [*zip(*(p.stages for p in read), strict=True)], style="stages")
        legends = (Paragraph(text, on="page", note=True) for text in (_LEGEND, about))
        against = f", against the {self.against}" if self.against else ""
        states = counted(self.samples, "random one")
        return Document(
            name=name,
            title=f"{name}: importers {outcome}",
            verdict=self.verdict,
            sentence=self._sentence(),
            good=self.agree,
            opening=[Paragraph(self._setting(bool(read), bool(alone)), on="page")],
            sections=[
                Section(f"Terms of each engine{against}", [stages, *legends] if read else []),
                *_differences(read),
                Section("Refused", [Items(refused)]),
                Section("Notes", [Items(notes)]),
            ],
            result=self,
            basis={
                "file": Span(self.source, "mono"),
                "states": f"{states}, seed {self.seed}; M, g, nle and passive are each engine's own, on its own model",
            },
        )

    def _sentence(self) -> str:
        """Return the verdict with the digits on which terms agree, and at how many states."""
        terms = [s for p in self.importers if p.agrees for s in p.stages if s.name in TERMS and s.same]
        worst = max((s.worst for s in terms if math.isfinite(s.worst)), default=0.0)
        if not worst:
            return self.verdict
        digits = f"{', '.join(dict.fromkeys(s.name for s in terms))} to {-math.log10(worst):.1f} digits or more"
        return f"{self.verdict}; where they agree, {digits} at {counted(self.samples, 'state')}"

    def _setting(self, read: bool, alone: bool) -> str:
        """Return what was done with the file, in words."""
        head = f"The same {self.format.upper()} was read by each engine's own importer"
        if not read:
            why = "" if self.reference else ", because mbkit itself does not read the file"
            return f"{head}. Nothing is compared{why}." if alone else f"{head}, and none reads it."
        base = "floats" if self.floating_base else "stands still" if self.format == "urdf" else "is as the file has it"
        return f"{head}. What came out is compared with the {self.against}; the base {base}."


def _differences(read: list[Parsed]) -> Iterator[Section]:
    about = Paragraph(
        "Each cause was applied to the other side, to see whether the difference vanishes. ✗ moves something, by so "
        "much; ! moves nothing.",
        on="page",
    )
    for p in read:
        why = p.explanation
        if why is None or not why.causes:
            continue
        title = p.engine
        if not why.explained:
            where = f"; the smallest part that still differs: {', '.join(why.subtree)}" if why.subtree else ""
            title += f": not all is explained{where}"
        elif not why.acting:
            title += " moves the same; what differs is data"
        yield Section(f"Why they differ: {title}", [about, *cause_blocks(why.causes, ("mimic",))])


def _stage(k: int, stages: Sequence[Stage]) -> Span:
    """Return the stage of an importer as mark, word and what differs."""
    stage = stages[k]
    if stage.same is None:
        return Span("– not comparable" + (f": {stage.says}" if stage.says else ""), "muted", "none")
    number = error_text(stage.worst) if stage.name in TERMS and math.isfinite(stage.worst) else ""
    if stage.same:
        return Span(f"✓ same to {number}" if number else "✓ same", "good", "same")
    joint = f", most at {stage.where}" if stage.where else ""
    says = f" by {number}{joint}" if number else f": {stage.says}"
    return Span(f"✗ differs{says}", "bad", "differs") if stage.name in DECIDING else Span(f"! differs{says}", "allowed")


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
