"""Why descriptions, importers or engines differ, and a model against its baseline, as documents."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path, PurePath
from typing import Final

from mbkit.report.document import Block, Bullet, Column, Document, Items, Paragraph, Section, Span, Style, Table
from mbkit.report.formatting import error_text
from mbkit.studies.baseline import BaselineResult
from mbkit.studies.explain.result import Cause, Explanation, grouped
from mbkit.studies.importers.result import DECIDING, TERMS, Parsed, ParserComparison, Stage


def explanation_view(result: Explanation) -> Document:
    """Return the document of an explanation: verdict, terms, causes and notes."""
    gaps = (
        Column("term", lambda g: g.term),
        Column(
            "relative difference",
            lambda g: Span(error_text(g.relative), "good" if g.relative <= result.tolerance else "bad"),
            right=True,
        ),
        Column("joint", lambda g: g.joint),
    )
    joints = [Bullet("", f"{m.a} is {m.b}") for m in result.matches if m.how == "structure"]
    for names, side in ((result.only_a, result.a), (result.only_b, result.b)):
        joints += [Bullet("", f"{name} is only in {side}") for name in names]
    by_name = sum(m.how == "name" for m in result.matches)
    return Document(
        name=f"{result.a} and {result.b}",
        verdict=result.verdict,
        good=result.agree,
        sections=[
            Section("Terms, by joint name", [Table(gaps, result.gaps)]),
            Section("Causes", _causes(result.causes)),
            Section(f"Joints: {by_name} matched by name, and", [Items(joints)]),
            Section("Notes", [Items([Bullet("", note) for note in result.notes])]),
        ],
        result=result,
    )


def _causes(causes: Iterable[Cause], apart: tuple[str, ...] = ()) -> list[Block]:
    """Return the causes, those that move something first; kinds that stand `apart` decide nothing."""
    bullets: list[Bullet] = []
    known = list(causes)
    for acts, mark, style in ((True, "✗", "bad"), (False, "!", "allowed")):
        for kind, says, what in grouped(c for c in known if c.acts == acts):
            # What a kind means is said once.
            again = any(b.head == kind for b in bullets)
            look = ("!", "allowed") if kind in apart else (mark, style)
            bullets.append(Bullet(kind, f"{says} ({what})", *look, "" if again else meaning(kind)))  # type: ignore[arg-type]
    return [Items(bullets)]


# One file through several importers.

_LEGEND: Final = (
    "✓ the same. ✗ another motion, which decides whether an importer agrees. ! in no term, so it decides nothing. "
    "– cannot be compared."
)


def importers_view(result: ParserComparison) -> Document:
    """Return the document of several importers of one file: their own terms, and why they differ."""
    name = PurePath(result.source).name
    read = [p for p in result.importers if p.stages]
    alone = [p for p in result.importers if not p.stages and not p.refused]
    outcome = "agree" if result.agree else "differ" if read else "are not compared" if alone else "refuse"
    rows = [p.stages for p in read]
    columns = [
        Column("stage", lambda k: Span(rows[0][k].name, "bold")),
        Column("", lambda k: Span(_meanings()["stages"].get(rows[0][k].name, ""), "muted"), on="page"),
        *(_importer(p) for p in read),
    ]
    plural = "s" * (result.samples != 1)
    refused = [Bullet(p.label, p.refused, "✗", "bad") for p in result.importers if p.refused]
    notes = [Bullet("the file", note) for note in (*([result.faults] if result.faults else []), *result.notes)]
    notes += [Bullet(p.engine, note) for p in (*read, *alone) for note in p.notes]
    fused = (
        "What an importer fuses is fused on the other side too; mimic joints are left free in M, g, nle and passive, "
        f"whose differences are relative to the forces at play and count above {result.tolerance:g}."
    )
    return Document(
        name=name,
        title=f"{name}: importers {outcome}",
        verdict=result.verdict,
        sentence=_importers_sentence(result, read),
        good=result.agree,
        opening=[Paragraph(_setting(result, read, alone), on="page")],
        sections=[
            Section(
                "Terms of each engine" + (f", against the {result.against}" if result.against else ""),
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
        result=result,
        basis={
            "file": Span(result.source, "mono"),
            "states": f"{result.samples} random one{plural}, seed {result.seed}; M, g, nle and passive are each "
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
    because = ", because mbkit itself does not read the file"
    if not read:
        why = because if not result.reference else ""
        return f"{head}. Nothing is compared{why}." if alone else f"{head}, and none reads it."
    still = "stands still" if result.format == "urdf" else "is as the file has it"
    why = because if result.reference != "file" else ""
    base = "floats" if result.floating_base else still
    return f"{head}. What came out is compared with the {result.against}{why}; the base {base}."


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
        yield Section(f"Why they differ: {title}", [about, *_causes(why.causes, ("mimic",))])


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


# A model against its baseline.

_MARKS: Final[dict[str, tuple[str, Style]]] = {
    "note": ("·", "muted"),
    "version": ("·", "muted"),
    "processor": ("·", "muted"),
    "effect": ("→", "bold"),
}


def baseline_view(result: BaselineResult, again: str = "") -> Document:
    """Return the document of a check or a diff; `again` is the command that records again."""
    name = result.path if result.question == "check" else f"{result.path} → {result.against}"
    skipped = {r.engine for r in result.skipped}
    bullets = []
    for what, line in result.lines():
        mark, style = ("–", "allowed") if what in skipped else _MARKS.get(what, ("✗", "bad"))
        bullets.append(Bullet(what, line, mark, style))  # type: ignore[arg-type]
    if again and result.question == "check" and result.status in ("description", "numbers", "versions"):
        bullets.append(Bullet("if this is meant" if result.status != "versions" else "to record again", again))
    return Document(
        name=f"{result.model} ({name})",
        verdict=result.verdict,
        good=result.passed,
        opening=[Items(bullets)],
        sections=[],
        result=result,
    )


@cache
def _meanings() -> dict[str, dict[str, str]]:
    return tomllib.loads((Path(__file__).parent / "templates" / "meanings.toml").read_text(encoding="utf-8"))


def meaning(kind: str) -> str:
    """Return a sentence on a kind of cause; empty where its name says it all."""
    return _meanings()["causes"].get(kind, "")
