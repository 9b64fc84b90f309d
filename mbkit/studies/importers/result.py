"""What a comparison of importers is: frozen data, and ways to read it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import ClassVar, Final

from mbkit.studies.explain.result import Explanation, grouped
from mbkit.studies.results import Block, Column, Items, ResultTable, Table, Title, columns

#: The terms that each engine computes by itself, on its own model.
TERMS: Final = ("M", "g", "nle", "passive")
#: The version of an importer that is not there; it has refused nothing.
MISSING: Final = "not installed"
#: The stages that say whether two readings move alike.
DECIDING: Final = ("joints", *TERMS)
#: Stages that no term shows: an agreement leaves them out.
_APART: Final = {"mimic": "mimic joints", "limits": "limits", "loops": "loops", "couplers": "couplers"}
_MARK: Final = {True: "same", False: "differs", None: "not comparable"}


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

    `refused` says why it does not read the file, and is empty where it does. `stages` is empty for the reference
    itself, and where there is no reference; `explanation` says why it differs from the reference; `notes` are what it
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
    ``"mujoco"`` for an MJCF that MuJoCo reads, else empty, and nothing is compared. `notes` say what was removed from
    the file before. `versions` are those of every package that took part, and `seconds` is the time of the whole.
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
        return len(self.importers) > 1 and all(p.agrees for p in self.importers if p.engine != self.reference)

    @property
    def verdict(self) -> str:
        """One sentence: which importers agree, differ, refuse or were not compared."""
        same = [p.engine for p in self.importers if p.agrees]
        differ = [p.engine for p in self.importers if p.stages and not p.agrees]
        missing = [p.engine for p in self.importers if p.refused and p.version == MISSING]
        refuse = [p.engine for p in self.importers if p.refused and p.engine not in missing]
        against = "" if self.reference == "file" else f" from the {self.against}"
        alone = [p.engine for p in self.importers if not p.stages and not p.refused]
        other = {s.name for p in self.importers if p.agrees for s in p.stages if not s.same}
        other |= {c.kind for p in self.importers if p.agrees and p.explanation for c in p.explanation.causes}
        apart = [what for name, what in _APART.items() if name in other]
        parts = [f"{_listed(same)} agree{_s(same)} with the {self.against.split(',')[0]}"] if same else []
        parts = [f"{x}, {_listed(apart)} apart" if apart else x for x in parts]
        parts += [f"{_listed(differ)} differ{_s(differ)}{against}"] if differ else []
        parts += [f"{_listed(refuse)} refuse{_s(refuse)}"] if refuse else []
        parts += [f"{_listed(missing)} {'is' if len(missing) == 1 else 'are'} not installed"] if missing else []
        if not self.reference and alone:
            parts.insert(0, f"not compared: mbkit does not read the file; {_listed(alone)} read{_s(alone)} it")
        elif alone and not same and not differ:
            parts.insert(0, f"not compared: {_listed(alone)} alone reads it")
        return "; ".join(parts) or "no importer was asked"

    @property
    def against(self) -> str:
        """What the importers are compared with, in words; empty where there is no reference."""
        if self.reference == "file":
            return f"file as written, {'link by link' if self.format == 'urdf' else 'body by body'}"
        return f"reading of {self.reference}" if self.reference else ""

    _derived = ("agree", "verdict")
    _called = "source"
    _csv_columns = (
        *columns(0, "engine", "version"),
        Column("stage", lambda row: row[1].name),
        *columns(1, "same", "worst", "where", "says"),
    )

    def _csv_rows(self) -> list[tuple[Parsed, Stage]]:
        return [(p, stage) for p in self.importers for stage in p.stages]

    def _blocks(self) -> Iterator[Block]:
        yield Title(self.source, f": {self.verdict}")
        read = [p for p in self.importers if p.stages]
        if read:
            rows = [(stages[0].name, *map(_cell, stages)) for stages in zip(*(p.stages for p in read), strict=True)]
            heads = ("stage", *(p.engine for p in read))
            yield Table([Column(head, itemgetter(k)) for k, head in enumerate(heads)], rows)
        yield Items(self._notes())

    def _notes(self) -> Iterator[str]:
        for p in self.importers:
            if p.refused:
                yield f"{p.engine}: {p.refused}"
            elif not p.stages:
                yield f"{p.engine} reads it{', and is the reference' if p.engine == self.reference else ''}"
            for kind, says, what in grouped(p.explanation.causes) if p.explanation else ():
                yield f"{kind}: {says} ({what})"
            yield from (f"{p.engine}: {note}" for note in p.notes)
        yield from (*self.notes, *([self.faults] if self.faults else []))


def _cell(stage: Stage) -> str:
    """Return a stage as a cell of a table."""
    return stage.says if stage.same is False and stage.says else _MARK[stage.same]


def _s(names: list[str]) -> str:
    return "s" if len(names) == 1 else ""


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
