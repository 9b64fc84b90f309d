"""Tables for a terminal, read in ten seconds: the verdict first, then where it comes from."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import PurePath
from typing import Any, Final

from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from mbkit._escape import one_line
from mbkit.report import terminal
from mbkit.report.compare_view import (
    allowances,
    by_term,
    failures,
    headline,
    judged,
    notices,
    omission_state,
    saving_text,
    told,
)
from mbkit.report.formatting import count_text, error_text, time_text
from mbkit.report.work_precision_view import Lead, curve_lines, leads, setting_text
from mbkit.report.work_precision_view import headline as headline_of_precision
from mbkit.studies.baseline import BaselineResult
from mbkit.studies.compare.all_robots import Sweep
from mbkit.studies.compare.result import Comparison, Row
from mbkit.studies.explain.result import Cause, Explanation, grouped
from mbkit.studies.importers.result import TERMS, Parsed, ParserComparison, Stage
from mbkit.studies.work_precision.result import WorkPrecision

__all__ = [
    "bench",
    "bullet",
    "columns",
    "comparison",
    "explanation",
    "importers",
    "meaning",
    "result",
    "right",
    "robots",
    "study",
    "sweep",
    "titled",
    "verdict",
]


# The pieces that tables on a terminal are made of.


def bullet(head: str, text: str, mark: str = "·", style: str = "dim") -> RenderableType:
    """Return a line with a mark before it, folded under its own beginning."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=3, justify="right")
    grid.add_column(overflow="fold")
    grid.add_row(Text(mark, style=style), Text.assemble((head, "bold"), text))
    return grid


def columns(*heads: str | tuple[str, str]) -> Table:
    """Return an empty table; a column is its head, or its head and how it is justified."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    for column in heads:
        head, justify = (column, "left") if isinstance(column, str) else column
        # A long name goes on in the next line; an ellipsis would make it another name.
        table.add_column(Text(head), justify=justify, no_wrap=justify == "right", overflow="fold")  # type: ignore[arg-type]
    return table


def right(*heads: str) -> list[tuple[str, str]]:
    """Return columns of numbers."""
    return [(head, "right") for head in heads]


def titled(title: str, *parts: RenderableType) -> list[RenderableType]:
    """Return parts under a title."""
    return [Text(), Text(title, style="bold"), *parts]


AGREE: Final = "bold green"
DIFFER: Final = "bold red"
_MARK: Final = {True: ("✓", "green"), False: ("✗", DIFFER)}
_ALLOWED: Final = ("!", "bold yellow")
_STATUS: Final = {"agree": ("✓", "green"), "refused": ("–", "yellow"), "differ": ("✗", DIFFER), "failed": ("✗", DIFFER)}
_MOST_FAILURES: Final = 12


def comparison(result: Comparison, asked: str = "") -> RenderableType:
    """Return everything a person wants to see of one comparison; `asked` is what they called the model."""
    name = f"{result.model} ({asked})" if asked not in ("", result.model) else result.model
    parts: list[RenderableType] = [verdict(name, headline(result), result.passed), _facts(result)]
    parts += _failed(result)
    if result.rows:
        parts += _terms(result)
    if result.rollouts:
        parts += _rollouts(result)
    if result.precision is not None:
        parts += terminal.study(result.precision)
    if result.omissions:
        parts += _omissions(result)
    parts += _notes(result)
    return Group(*parts)


def verdict(name: str, text: str, passed: bool) -> Text:
    """Return the headline: a mark, the name if there is one, one sentence."""
    mark, _ = _MARK[passed]
    style = AGREE if passed else DIFFER
    head = (f"{one_line(name, 80)}: ", "bold") if name else ""
    return Text.assemble((f"{mark} ", style), head, (one_line(text), style))


def _facts(result: Comparison) -> Text:
    facts = result.facts
    mass = facts.get("mass")
    told = [
        f"nq {facts.get('nq', '?')}, nv {facts.get('nv', '?')}" + (f", {mass:.4g} kg" if mass is not None else ""),
        f"{result.rows[0].samples if result.rows else result.samples} states (seed {result.seed})",
        f"tolerance {result.tolerance:.0e}",
        f"{result.seconds:.1f} s",
    ]
    return Text("  " + " · ".join(told), style="dim")


def _failed(result: Comparison) -> list[RenderableType]:
    found = failures(result)
    lines: list[RenderableType] = [
        bullet(f"{one_line(f.what)}: ", one_line(f.reason, 400), "✗", DIFFER) for f in found[:_MOST_FAILURES]
    ]
    if len(found) > _MOST_FAILURES:
        lines.append(bullet("", f"and {len(found) - _MOST_FAILURES} more, in the page and the JSON", " ", DIFFER))
    return lines


def _terms(result: Comparison) -> list[RenderableType]:
    heads = [f"{e}\nvs {result.reference}" for e in result.engines]
    table = columns("term", *right(*heads))
    for term, rows in by_term(result).items():
        table.add_row(Text(one_line(term)), *(_term_cell(rows.get(engine)) for engine in result.engines))
    below = [bullet(f"{one_line(a.what)}: ", one_line(a.reason, 400), *_ALLOWED) for a in allowances(result)]
    return titled("Terms: worst relative error, time per call", table, *below)


def _term_cell(row: Row | None) -> Text:
    if row is None:
        return Text("refused", style="dim")
    # Where the oracle has no value, an engine stands in for it.
    own = row.engine == row.reference
    if row.zero and row.passed and not own:
        return Text.assemble(("–    zero", "dim"), f" {time_text(row.ns * 1e-9):>8}")
    mark, style = ("", "") if own else _MARK[row.passed] if not (row.passed and row.reason) else _ALLOWED
    error = "" if own else error_text(row.relative)
    spent = time_text(row.ns * 1e-9)
    return Text.assemble((f"{mark:>1} {error:>7}", style), f" {spent:>8}")


def _rollouts(result: Comparison) -> list[RenderableType]:
    table = columns("integrator", "engine", *right("horizon", "condition", "difference", "run time", "MuJoCo's"), "")
    # Eighty columns are enough without it.
    table.padding = 0
    notes: dict[str, int] = {}
    for r in judged(result):
        mark, style = _MARK[r.passed] if r.judged else ("–", "dim")
        table.add_row(
            Text(one_line(r.method)),
            Text(r.engine),
            time_text(r.duration),
            count_text(r.condition),
            Text(f"{mark} {error_text(r.error):>7}", style=style),
            time_text(r.seconds),
            time_text(r.seconds_against),
            Text(f"[{notes.setdefault(r.note, len(notes) + 1)}]" if r.note else "", style="dim"),
        )
    steps = " or ".join(dict.fromkeys(time_text(r.dt) for r in judged(result)))
    below = [bullet("", one_line(note), f"[{k}]") for note, k in notes.items()]
    below += [
        bullet(one_line(f"{r.method} vs {r.against}") + ": ", f"{error_text(r.error)} in q; {one_line(r.note)}", "i")
        for r in told(result)
    ]
    title = f"Rollouts against MuJoCo's own, step {steps}: largest difference of q (rad or m)"
    return titled(title, table, *below)


def _omissions(result: Comparison) -> list[RenderableType]:
    table = columns("need", "in model", *right("saves/call", "set-up", "change"), "what was off")
    # The page has these in full; here a line each is worth more.
    table.expand = True
    table.columns[-1].ratio = 1
    table.columns[-1].no_wrap = True
    table.columns[-1].overflow = "ellipsis"
    below = []
    for o in result.omissions:
        state = omission_state(o)
        mark, style = {"same": _MARK[True], "changed": _MARK[False], "chosen": ("i", "")}.get(state, ("", "dim"))
        table.add_row(
            Text(one_line(o.need), no_wrap=True),
            "yes" if o.present else "no",
            Text(saving_text(o) or "–", style="" if o.measurable else "dim"),
            Text(time_text(o.saved_setup) or "–"),
            Text("–" if state == "on" else f"{mark} {error_text(o.change):>7}", style=style),
            Text(one_line(o.what), style="dim"),
        )
        if state == "chosen":
            below.append(bullet(f"{one_line(o.need)}: ", one_line(o.note), "i"))
    return titled("Left out because the scene does not need it: change is that of the accelerations", table, *below)


def _notes(result: Comparison) -> list[RenderableType]:
    lines = [
        bullet(one_line(n.engine + (f" ({', '.join(n.terms)})" if n.terms else "")) + ": ", one_line(n.reason, 400))
        for n in notices(result.refusals)
    ]
    lines += [bullet("", one_line(note, 300)) for note in result.facts.get("notes", ())]
    bodies = list(result.facts.get("nonphysical", ()))
    if bodies:
        lines.append(bullet("bodies that no matter is like: ", one_line("; ".join(bodies), 300)))
    return [*(titled("Notes", *lines) if lines else []), Text()]


def sweep(result: Sweep) -> RenderableType:
    """Return the table of many robots, the reasons, and the verdict last, where the eye is at the end."""
    table = columns("result", "robot", *right("nv", "engines", "digits", "worst"))
    table.padding = 0
    table.columns[0].no_wrap = table.columns[1].no_wrap = True
    for column, width in zip(table.columns, (9, 20, 3, 7, 6, 7), strict=True):
        column.min_width = width
    reasons: list[RenderableType] = []
    for o in result.outcomes:
        mark, style = _STATUS[o.status]
        c = o.comparison
        worst = c.worst if c else None
        table.add_row(
            Text(f"{mark} {o.status}", style=style),
            Text(one_line(o.robot)),
            str(c.facts.get("nv", "")) if c else "",
            str(len(c.engines)) if c else "",
            f"{c.digits:.1f}" if c and worst else "",
            error_text(worst.relative) if worst else "",
        )
        if o.reason:
            reasons.append(bullet(f"{one_line(o.robot)}: ", one_line(o.reason, 300), mark, style))
    parts = [table, *(titled("Reasons", *reasons) if reasons else [])]
    return Group(*parts, Text(), verdict("", result.verdict, result.passed), Text())


def robots(records: Iterable[Any], systems: Iterable[str]) -> RenderableType:
    """Return the table of robots that there are, and the names of catalog systems."""
    table = columns("robot", "short names", *right("nq", "nv", "mass, kg"), "")
    count = 0
    for r in records:
        count += 1
        names = Text(", ".join(r.aliases), style="bold")
        if r.reason:
            table.add_row(Text(r.name), names, "–", "–", "–", Text(one_line(r.reason), style="yellow"))
        else:
            table.add_row(Text(r.name), names, str(r.nq), str(r.nv), f"{r.mass:.4g}", "")
    foot = f"{count} robots of example-robot-data; mimic joints reduced. Catalog systems: {', '.join(systems)}"
    return Group(table, Padding(Text(foot, style="dim"), (0, 0, 1, 0)))


# A model held against its baseline, on a terminal.

_MARKS = {"note": ("·", "dim"), "version": ("·", "dim"), "processor": ("·", "dim"), "effect": ("→", "bold")}


def result(found: BaselineResult, again: str = "") -> RenderableType:
    """Return the verdict and what led to it; `again` is the command that records anew."""
    name = found.path if found.question == "check" else f"{found.path} → {found.against}"
    parts: list[RenderableType] = [verdict(f"{found.model} ({name})", one_line(found.verdict), found.passed)]
    skipped = {r.engine for r in found.skipped}
    for what, line in found.lines():
        mark = ("–", "yellow") if what in skipped else _MARKS.get(what, ("✗", "bold red"))
        parts.append(bullet(f"{one_line(what)}: ", one_line(line), *mark))
    if again and found.question == "check" and found.status in ("description", "numbers", "versions"):
        head = "if this is meant: " if found.status != "versions" else "to record anew: "
        parts.append(bullet(head, one_line(again)))
    return Group(*parts)


# The work-precision study on a terminal: the fastest for each error, then curve by curve.


def bench(result: WorkPrecision, asked: str = "") -> RenderableType:
    """Return everything a person wants to see of one study; `asked` is what they called the model."""
    name = f"{result.model} ({asked})" if asked not in ("", result.model) else result.model
    facts = result.facts
    told = [
        f"nq {facts.get('nq', '?')}, nv {facts.get('nv', '?')}",
        f"{sum(len(c.points) for c in result.curves)} settings",
        f"{result.seconds:.1f} s",
    ]
    parts: list[RenderableType] = [
        Text.assemble((f"{one_line(name, 80)}: ", "bold"), one_line(headline_of_precision(result))),
        Text("  " + " · ".join(told), style="dim"),
        *study(result),
        *_curves(result),
    ]
    lines = [
        bullet(one_line(n.engine + (f" ({', '.join(n.terms)})" if n.terms else "")) + ": ", one_line(n.reason, 300))
        for n in notices(result.refusals)
    ]
    return Group(*parts, *(titled("Notes", *lines) if lines else []), Text())


def study(result: WorkPrecision) -> list[RenderableType]:
    """Return the fastest run for each error, and how the errors were known."""
    table = columns(*right("error ≤"), "engine", "method", *right("setting", "run time", "first run"), "next engine")
    for lead in leads(result):
        table.add_row(
            lead.errors,
            Text(one_line(lead.curve.engine)),
            Text(one_line(lead.curve.method)),
            setting_text(lead.point),
            time_text(lead.point.seconds),
            time_text(lead.curve.compile + lead.point.seconds) or "–",
            Text(_next(lead), style="dim"),
        )
    known = f"known to {error_text(result.floor)}" if math.isfinite(result.floor) else "known to an unknown error"
    below = bullet("", f"{one_line(result.reference, 300)}; {known}", "i")
    missing = (
        [Text(f"  ! {one_line('; '.join(result.shortened), 400)}", style="bold yellow")] if result.shortened else []
    )
    title = f"Error against run time, {result.duration:g} s of motion: the fastest with an error of q (rad or m)"
    return titled(title, *missing, table if table.rows else Text("  no run reached 1e-02", style="dim"), below)


def _next(lead: Lead) -> str:
    return ", ".join(f"{one_line(engine)} × {factor}" if factor else engine for engine, _, factor in lead.nexts)


def _curves(result: WorkPrecision) -> list[RenderableType]:
    table = columns("", "engine", "method", *right("order", "of", "least error", "run time", "compile"))
    for line in curve_lines(result):
        curve, best = line.curve, line.best
        order = "" if math.isnan(curve.order) else f"{curve.order:.2f}"
        table.add_row(
            Text("●" if line.on_front else "", style="green"),
            Text(one_line(curve.engine)),
            Text(one_line(curve.method)),
            Text(f"! {order}" if line.off else order, style="bold yellow" if line.off else ""),
            "" if math.isnan(curve.expected) else f"{curve.expected:g}",
            error_text(best.error) if best else "none",
            time_text(best.seconds) if best else "",
            time_text(curve.compile) or "–",
        )
    lines = curve_lines(result)
    below = [bullet("", "on the front: nothing beats it in both error and run time", "●", "green")]
    if any(line.off for line in lines):
        below.append(bullet("", "the observed order is not the method's own", "!", "bold yellow"))
    return titled("Engines and methods; the run time is that of the least error", table, *below)


# Tables of why two descriptions, importers or engines differ.

_MARK_CAUSE_TABLES = {True: ("✓", "green"), False: ("✗", DIFFER), None: ("–", "dim")}


def explanation(result: Explanation) -> RenderableType:
    """Return verdict, terms, causes and notes of an explanation."""
    parts: list[RenderableType] = [verdict(f"{result.a} and {result.b}", result.verdict, result.agree)]
    if result.gaps:
        table = columns("term", *right("relative difference"), "joint")
        for g in result.gaps:
            style = "green" if g.relative <= result.tolerance else DIFFER
            table.add_row(one_line(g.term), Text(error_text(g.relative), style=style), one_line(g.joint))
        parts += titled("Terms, by joint name", table)
    parts += _causes("Causes", result.causes)
    if any(m.how == "structure" for m in result.matches) or result.only_a or result.only_b:
        lines = [bullet(f"{one_line(m.a)} ", f"is {one_line(m.b)}") for m in result.matches if m.how == "structure"]
        for names, side in ((result.only_a, result.a), (result.only_b, result.b)):
            lines += [bullet(f"{one_line(n)} ", f"is only in {one_line(side)}") for n in names]
        parts += titled(f"Joints: {sum(m.how == 'name' for m in result.matches)} matched by name, and", *lines)
    if result.notes:
        parts += titled("Notes", *(bullet("", one_line(n, 400)) for n in result.notes))
    return Group(*parts, Text())


def _causes(title: str, causes: tuple[Cause, ...]) -> list[RenderableType]:
    if not causes:
        return []
    acting = [(*line, True) for line in grouped(c for c in causes if c.acts)]
    silent = [(*line, False) for line in grouped(c for c in causes if not c.acts)]
    lines = [
        bullet(f"{one_line(kind)}: ", f"{one_line(says, 400)} ({what})", *(("✗", DIFFER) if acts else ("i", "dim")))
        for kind, says, what, acts in (*acting, *silent)
    ]
    return titled(title, *lines)


def importers(result: ParserComparison) -> RenderableType:
    """Return the stages of every importer side by side, and why they differ."""
    parts: list[RenderableType] = [verdict(PurePath(result.source).name, result.verdict, result.agree)]
    read = [p for p in result.importers if p.stages]
    if read:
        table = columns("stage", *(f"{p.engine} {p.version}" for p in read))
        for k, stage in enumerate(read[0].stages):
            table.add_row(stage.name, *(_cell(p.stages[k]) for p in read))
        base = "; the base floats" if result.floating_base else ""
        parts += titled(f"Stages, against the {result.against}{base}; mimic joints free in the terms", table)
    for p in result.importers:
        parts += _importer(p)
    notes = [*result.notes, *([result.faults] if result.faults else [])]
    if notes:
        parts += titled("Notes", *(bullet("", one_line(n, 500)) for n in notes))
    return Group(*parts, Text())


def _importer(p: Parsed) -> list[RenderableType]:
    if p.refused:
        return titled(f"{p.engine} {p.version}", bullet("refuses: ", one_line(p.refused, 500), "✗", DIFFER))
    out = _causes(f"{p.engine}: causes", p.explanation.causes if p.explanation else ())
    lines = [bullet("", one_line(n, 300)) for n in p.notes]
    return [*out, *(lines if out else titled(p.engine, *lines) if lines else [])]


def _cell(stage: Stage) -> Text:
    mark, style = _MARK_CAUSE_TABLES[stage.same]
    number = ""
    if stage.name in TERMS and math.isfinite(stage.worst):
        number = f" {error_text(stage.worst)}"
    says = f" {one_line(stage.says, 44)}" if not number and stage.same is not True else number
    return Text(f"{mark}{says}", style=style)


# What each kind of cause means, for who meets it the first time.

_MEANINGS: Final = {
    "actuator": "A motor or servo: its armature adds to M, and at zero control its gain and damping still act.",
    "added body": "It has matter where the other side has none.",
    "added joint": "It has a joint that the other side has not.",
    "armature": "A motor's inertia, seen through its gear: it adds to the diagonal of M.",
    "axis": "The joint turns or slides about another direction.",
    "axis sign": "Positive q goes the other way.",
    "base mass": "Matter that never moves, fused into the world: no term holds it while the base stands.",
    "centre of mass": "The matter is as heavy, and elsewhere.",
    "damping": "Viscous friction in the joint. It is in no term of M and nle.",
    "fluid": "The drag and lift of the medium in which the bodies move.",
    "friction": "Dry friction in the joint. It is in no term of M and nle.",
    "fused at the wrong place": "Links that are fixed to each other were made one body, and one was put elsewhere.",
    "fused with a rotated frame": "Links that are fixed to each other were made one body, and one was turned wrongly.",
    "gravity": "Another acceleration of gravity.",
    "gravity compensation": "A force that holds some of a body's weight.",
    "inertia": "The matter is as heavy, and resists turning otherwise.",
    "inertia about the wrong point": "The moments are about another point than the centre of mass.",
    "inertia axes": "The same principal moments, about other axes.",
    "inverse placement": "A frame's place in another was taken for the other's place in it.",
    "joint held still": "What moves on one side is fixed on the other, so q and v are not the same there.",
    "joint kind": "The joint moves in another way.",
    "joint order": "q and v name the same joints in another order; read them by name.",
    "joint origin": "The joint stands elsewhere in its parent.",
    "joint rotation": "The joint stands turned in its parent.",
    "limits": "Bounds of position, speed or effort. They are in no term of M and nle.",
    "lost body": "Matter is gone: with no joint of its own and little mass, an importer may take a link for empty.",
    "lost joint": "A joint is gone, with all that it carries, so q and v are not the same there.",
    "mass": "Another mass.",
    "mimic": "A joint that follows another has a coordinate of its own, or follows otherwise.",
    "names exchanged": "Joints are called by each other's names.",
    "own terms": "The engine computes other terms than the bodies and joints that were read out of it have.",
    "parent": "The joint hangs on another body.",
    "passive forces": "Springs and dampers were put where they do not belong, or left out.",
    "pitch": "How far a screw goes in a turn.",
    "products of inertia": "The off-diagonal moments have another sign, or are gone.",
    "quaternion order": "w, x, y, z was read for x, y, z, w, or the other way round.",
    "renamed": "The same joints are called otherwise.",
    "replaced inertia": "An inertia that no body can have was taken out, and a ball of water put in its place.",
    "rounding": "The numbers were written with few digits on the way.",
    "spring": "A spring in the joint. It is in no term of M and nle.",
    "tendon": "It couples joints: its armature adds to M, its spring and damper pull at them.",
    "unit of inertia": "The numbers are of another unit of inertia.",
    "unit of length": "The numbers are of another unit of length.",
    "unit of mass": "The numbers are of another unit of mass.",
    "unit of pitch": "Metres a radian, or a turn.",
    "velocity frame": "Velocities of a free body are in other axes.",
    "zero position": "q counts from another pose.",
}


def meaning(kind: str) -> str:
    """Return a sentence on a kind of cause; empty where its name says it all."""
    return _MEANINGS.get(kind, "")
