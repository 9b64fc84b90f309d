"""A comparison of importers: frozen data, and ways to read it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePath
from typing import ClassVar, Final

from mbkit.studies.document import Bullet, Column, Document, Items, Paragraph, Section, Span, Table
from mbkit.studies.explain.result import Explanation, cause_blocks, meanings
from mbkit.studies.explain.terms import TERMS
from mbkit.studies.formatting import error_text
from mbkit.studies.results import ResultTable, columns

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
        same = [p.engine for p in self.importers if p.agrees]
        differ = [p.engine for p in self.importers if p.stages and not p.agrees]
        missing = [p.engine for p in self.importers if p.refused and p.version == MISSING]
        refuse = [p.engine for p in self.importers if p.refused and p.engine not in missing]
        alone = [p.engine for p in self.importers if not p.stages and not p.refused]
        other = {s.name for p in self.importers if p.agrees for s in p.stages if not s.same}
        other |= {c.kind for p in self.importers if p.agrees and p.explanation for c in p.explanation.causes}
        apart = [what for name, what in _APART.items() if name in other]
        parts = [f"{_listed(same)} agree{_s(same)} with the file as written"] if same else []
        parts = [f"{x}, {_listed(apart)} apart" if apart else x for x in parts]
        parts += [f"{_listed(differ)} differ{_s(differ)}"] if differ else []
        parts += [f"{_listed(refuse)} refuse{_s(refuse)}"] if refuse else []
        parts += [f"{_listed(missing)} {'is' if len(missing) == 1 else 'are'} not installed"] if missing else []
        if alone:
            parts.insert(0, f"not compared: mbkit does not read the file; {_listed(alone)} read{_s(alone)} it")
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
        alone = [p for p in self.importers if not p.stages and not p.refused]
        outcome = "agree" if self.agree else "differ" if read else "are not compared" if alone else "refuse"
        rows = [p.stages for p in read]
        columns = [
            Column("stage", lambda k: Span(rows[0][k].name, "bold")),
            Column("", lambda k: Span(meanings()["stages"].get(rows[0][k].name, ""), "muted"), on="page"),
            *(_importer(p) for p in read),
        ]
        plural = "s" * (self.samples != 1)
        refused = [Bullet(p.label, p.refused, "✗", "bad") for p in self.importers if p.refused]
        notes = [Bullet("the file", note) for note in (*([self.faults] if self.faults else []), *self.notes)]
        notes += [Bullet(p.engine, note) for p in (*read, *alone) for note in p.notes]
        fused = (
            "What an importer fuses is fused on the other side too; mimic joints are left free in M, g, nle and "
            f"passive, whose differences are relative to the forces at play and count above {self.tolerance:g}."
        )
        return Document(
            name=name,
            title=f"{name}: importers {outcome}",
            verdict=self.verdict,
            sentence=_importers_sentence(self, read),
            good=self.agree,
            opening=[Paragraph(_setting(self, read, alone), on="page")],
            sections=[
                Section(
                    "Terms of each engine" + (f", against the {self.against}" if self.against else ""),
                    [
                        Table(columns, range(len(rows[0])), style="stages"),
                        Paragraph(_LEGEND, on="page", note=True),
                        Paragraph(fused, on="page", note=True),
                    ]
                    if read
                    else [],
                ),
                *_differences(read),
                Section("Refused", [Items(refused)]),
                Section("Notes", [Items(notes)]),
            ],
            result=self,
            basis={
                "file": Span(self.source, "mono"),
                "states": f"{self.samples} random one{plural}, seed {self.seed}; M, g, nle and passive are each "
                "engine's own, on its own model",
            },
        )


def _importers_sentence(result: ParserComparison, read: list[Parsed]) -> str:
    """Return the verdict with the digits on which terms agree, and at how many states."""
    terms = [s for p in read if p.agrees for s in p.stages if s.name in TERMS and s.same]
    worst = max((s.worst for s in terms if math.isfinite(s.worst)), default=0.0)
    if not worst:
        return result.verdict
    names = ", ".join(dict.fromkeys(s.name for s in terms))
    states = f"{result.samples} state{'s' * (result.samples != 1)}"
    return f"{result.verdict}; where they agree, {names} to {-math.log10(worst):.1f} digits or more at {states}"


def _importer(p: Parsed) -> Column:
    return Column(p.label, lambda k: _stage(p.stages[k]))


def _setting(result: ParserComparison, read: list[Parsed], alone: list[Parsed]) -> str:
    """Return what was done with the file, in words."""
    head = f"The same {'URDF' if result.format == 'urdf' else 'MJCF'} was read by each engine's own importer"
    if not read:
        why = "" if result.reference else ", because mbkit itself does not read the file"
        return f"{head}. Nothing is compared{why}." if alone else f"{head}, and none reads it."
    still = "stands still" if result.format == "urdf" else "is as the file has it"
    base = "floats" if result.floating_base else still
    return f"{head}. What came out is compared with the {result.against}; the base {base}."


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


def _stage(stage: Stage) -> Span:
    """Return a stage as mark, word and what differs."""
    if stage.same is None:
        return Span("– not comparable" + (f": {stage.says}" if stage.says else ""), "muted", "none")
    number = error_text(stage.worst) if stage.name in TERMS and math.isfinite(stage.worst) else ""
    if stage.same:
        return Span(f"✓ same to {number}" if number else "✓ same", "good", "same")
    joint = f", most at {stage.where}" if stage.where else ""
    says = f" by {number}{joint}" if number else f": {stage.says}"
    return Span(f"✗ differs{says}", "bad", "differs") if stage.name in DECIDING else Span(f"! differs{says}", "allowed")


def _s(names: list[str]) -> str:
    return "s" if len(names) == 1 else ""


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
