"""Tables for a terminal, read in ten seconds: the verdict first, then where it comes from."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.text import Text

from mbkit.report import precision_tables
from mbkit.report.layout import bullet, columns, right, titled
from mbkit.report.numbers import count_text, error_text, inline, time_text
from mbkit.report.reading import (
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
from mbkit.studies.all_robots import Sweep
from mbkit.studies.result import Comparison, Row

__all__ = ["comparison", "robots", "sweep", "verdict"]

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
        parts += precision_tables.study(result.precision)
    if result.omissions:
        parts += _omissions(result)
    parts += _notes(result)
    return Group(*parts)


def verdict(name: str, text: str, passed: bool) -> Text:
    """Return the headline: a mark, the name if there is one, one sentence."""
    mark, _ = _MARK[passed]
    style = AGREE if passed else DIFFER
    head = (f"{inline(name, 80)}: ", "bold") if name else ""
    return Text.assemble((f"{mark} ", style), head, (inline(text), style))


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
        bullet(f"{inline(f.what)}: ", inline(f.reason, 400), "✗", DIFFER) for f in found[:_MOST_FAILURES]
    ]
    if len(found) > _MOST_FAILURES:
        lines.append(bullet("", f"and {len(found) - _MOST_FAILURES} more, in the page and the JSON", " ", DIFFER))
    return lines


def _terms(result: Comparison) -> list[RenderableType]:
    heads = [f"{e}\nvs {result.reference}" for e in result.engines]
    table = columns("term", *right(*heads))
    for term, rows in by_term(result).items():
        table.add_row(Text(inline(term)), *(_term_cell(rows.get(engine)) for engine in result.engines))
    below = [bullet(f"{inline(a.what)}: ", inline(a.reason, 400), *_ALLOWED) for a in allowances(result)]
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
            Text(inline(r.method)),
            Text(r.engine),
            time_text(r.duration),
            count_text(r.condition),
            Text(f"{mark} {error_text(r.error):>7}", style=style),
            time_text(r.seconds),
            time_text(r.seconds_against),
            Text(f"[{notes.setdefault(r.note, len(notes) + 1)}]" if r.note else "", style="dim"),
        )
    steps = " or ".join(dict.fromkeys(time_text(r.dt) for r in judged(result)))
    below = [bullet("", inline(note), f"[{k}]") for note, k in notes.items()]
    below += [
        bullet(f"{inline(r.method)} vs {inline(r.against)}: ", f"{error_text(r.error)} in q; {inline(r.note)}", "i")
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
            Text(inline(o.need), no_wrap=True),
            "yes" if o.present else "no",
            Text(saving_text(o) or "–", style="" if o.measurable else "dim"),
            Text(time_text(o.saved_setup) or "–"),
            Text("–" if state == "on" else f"{mark} {error_text(o.change):>7}", style=style),
            Text(inline(o.what), style="dim"),
        )
        if state == "chosen":
            below.append(bullet(f"{inline(o.need)}: ", inline(o.note), "i"))
    return titled("Left out because the scene does not need it: change is that of the accelerations", table, *below)


def _notes(result: Comparison) -> list[RenderableType]:
    lines = [
        bullet(inline(n.engine + (f" ({', '.join(n.terms)})" if n.terms else "")) + ": ", inline(n.reason, 400))
        for n in notices(result.refusals)
    ]
    lines += [bullet("", inline(note, 300)) for note in result.facts.get("notes", ())]
    bodies = list(result.facts.get("nonphysical", ()))
    if bodies:
        lines.append(bullet("bodies that no matter is like: ", inline("; ".join(bodies), 300)))
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
            Text(inline(o.robot)),
            str(c.facts.get("nv", "")) if c else "",
            str(len(c.engines)) if c else "",
            f"{c.digits:.1f}" if c and worst else "",
            error_text(worst.relative) if worst else "",
        )
        if o.reason:
            reasons.append(bullet(f"{inline(o.robot)}: ", inline(o.reason, 300), mark, style))
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
            table.add_row(Text(r.name), names, "–", "–", "–", Text(inline(r.reason), style="yellow"))
        else:
            table.add_row(Text(r.name), names, str(r.nq), str(r.nv), f"{r.mass:.4g}", "")
    foot = f"{count} robots of example-robot-data; mimic joints reduced. Catalog systems: {', '.join(systems)}"
    return Group(table, Padding(Text(foot, style="dim"), (0, 0, 1, 0)))
