"""What a comparison of importers is: frozen data, and ways to read it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from mbkit._escape import html, markdown, one_line
from mbkit.studies.explain.result import Explanation, grouped, saved

__all__ = ["DECIDING", "MISSING", "TERMS", "Parsed", "ParserComparison", "Stage"]

#: The terms that each engine computes by itself, on its own model.
TERMS: Final = ("M", "g", "nle", "passive")
#: The version of an importer that is not there; it has refused nothing.
MISSING: Final = "not installed"
#: The stages that say whether two readings move alike.
DECIDING: Final = ("joints", "kinds", *TERMS)
_MARK: Final = {True: "same", False: "differs", None: "not comparable"}


@dataclass(frozen=True)
class Stage:
    """One kind of number of one importer against the reference.

    Attributes
    ----------
    name : str
    same : bool or None
        None where it cannot be compared.
    worst : float
        The largest difference: relative for masses, inertias and terms, m for places and
        centres of mass, in the numbers' own units for the rest; NaN where there is no number.
    where : str
        The joint or body where it is largest.
    says : str
        What differs, in words; empty where nothing does.
    """

    name: str
    same: bool | None
    worst: float
    where: str
    says: str


@dataclass(frozen=True)
class Parsed:
    """One importer's reading.

    Attributes
    ----------
    engine, version : str
    refused : str
        Why it does not read the file; empty where it does.
    stages : tuple of Stage
        Empty for the reference itself, and where there is no reference.
    explanation : Explanation or None
        Why it differs from the reference.
    notes : tuple of str
        What it said, and what it holds beside bodies and joints.
    """

    engine: str
    version: str
    refused: str = ""
    stages: tuple[Stage, ...] = ()
    explanation: Explanation | None = None
    notes: tuple[str, ...] = ()

    @property
    def agrees(self) -> bool:
        """Whether it moves as the reference does, mimic joints left free."""
        return bool(self.stages) and all(s.same for s in self.stages if s.name in DECIDING)


@dataclass(frozen=True)
class ParserComparison:
    """A file through several importers.

    Attributes
    ----------
    source : str
        The file.
    format : str
        ``"urdf"`` or ``"mjcf"``.
    floating_base : bool
    reference : str
        What the importers are compared with: ``"file"``, the file as written, link by link. Where mbkit
        does not read it: ``"mujoco"`` for an MJCF that MuJoCo reads, else empty, and nothing is compared.
    faults : str
        Why mbkit does not read it; empty where it does.
    importers : tuple of Parsed
    notes : tuple of str
        What was taken out of the file before.
    samples, seed : int
    tolerance : float
    versions : dict
        Package -> version, of everything that took part.
    processor : str
    seconds : float
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
        """One sentence: who agrees, who differs, who refuses; and what was not compared."""
        same = [p.engine for p in self.importers if p.agrees]
        differ = [p.engine for p in self.importers if p.stages and not p.agrees]
        missing = [p.engine for p in self.importers if p.refused and p.version == MISSING]
        refuse = [p.engine for p in self.importers if p.refused and p.engine not in missing]
        against = "" if self.reference == "file" else f" from the {self.against}"
        alone = [p.engine for p in self.importers if not p.stages and not p.refused]
        parts = [f"{_listed(same)} agree{_s(same)} with the {self.against.split(',')[0]}"] if same else []
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

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain data."""
        told = asdict(self)
        for data, p in zip(told["importers"], self.importers, strict=True):
            data["agrees"] = p.agrees
            data["explanation"] = p.explanation.to_dict() if p.explanation else None
        return told | {"agree": self.agree, "verdict": self.verdict}

    def to_json(self, path: str | Path | None = None) -> str:
        """Return the result as JSON, and write it to `path` if given. Infinity and NaN become null."""
        return saved(self.to_dict(), path)

    def to_markdown(self) -> str:
        """Return the stages as a table, and the causes, in Markdown."""
        read = [p for p in self.importers if p.stages]
        lines = [f"**{markdown(self.source)}**: {markdown(self.verdict)}", ""]
        if read:
            lines += [f"| stage | {' | '.join(p.engine for p in read)} |", "|---" * (len(read) + 1) + "|"]
            for k, stage in enumerate(read[0].stages):
                lines.append(f"| {stage.name} | {' | '.join(markdown(cell(p.stages[k])) for p in read)} |")
            lines.append("")
        for p in self.importers:
            if p.refused:
                lines.append(f"- {p.engine}: {markdown(p.refused)}")
            if not p.refused and not p.stages:
                lines.append(f"- {p.engine} reads it{', and is the reference' if p.engine == self.reference else ''}")
            for kind, says, what in grouped(p.explanation.causes) if p.explanation else ():
                lines.append(f"- {markdown(f'{kind}: {says} ({what})')}")
            lines += [f"- {p.engine}: {markdown(note)}" for note in p.notes]
        lines += [f"- {markdown(note)}" for note in (*self.notes, *([self.faults] if self.faults else []))]
        return "\n".join(lines).rstrip() + "\n"

    def _repr_html_(self) -> str:
        read = [p for p in self.importers if p.stages]
        head = "".join(f"<th>{h}</th>" for h in ("stage", *(p.engine for p in read)))
        rows = "".join(
            f"<tr><td>{stage.name}</td>{''.join(f'<td>{html(cell(p.stages[k]))}</td>' for p in read)}</tr>"
            for k, stage in enumerate(read[0].stages if read else ())
        )
        told = [f"{p.engine}: {p.refused}" for p in self.importers if p.refused]
        told += [
            f"{kind}: {says} ({what})"
            for p in read
            if p.explanation
            for kind, says, what in grouped(p.explanation.causes)
        ]
        items = "".join(f"<li>{html(x)}</li>" for x in told)
        return f"<p><b>{html(self.source)}</b>: {html(self.verdict)}</p><table><tr>{head}</tr>{rows}</table>" + (
            f"<ul>{items}</ul>" if items else ""
        )

    def __repr__(self) -> str:
        return f"<ParserComparison of {self.source!r}: {one_line(self.verdict)}>"


def cell(stage: Stage) -> str:
    """Return a stage as a cell of a table."""
    return stage.says if stage.same is False and stage.says else _MARK[stage.same]


def _s(names: list[str]) -> str:
    return "s" if len(names) == 1 else ""


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
