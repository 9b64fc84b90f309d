"""The work-precision study on a terminal: the fastest for each error, then curve by curve."""

from __future__ import annotations

import math

from rich.console import Group, RenderableType
from rich.text import Text

from mbkit.report.layout import bullet, columns, right, titled
from mbkit.report.numbers import error_text, inline, time_text
from mbkit.report.precision import Lead, curve_lines, headline, leads, setting_text
from mbkit.report.reading import notices
from mbkit.studies.precision_result import WorkPrecision

__all__ = ["bench", "study"]


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
        Text.assemble((f"{inline(name, 80)}: ", "bold"), inline(headline(result))),
        Text("  " + " · ".join(told), style="dim"),
        *study(result),
        *_curves(result),
    ]
    lines = [
        bullet(inline(n.engine + (f" ({', '.join(n.terms)})" if n.terms else "")) + ": ", inline(n.reason, 300))
        for n in notices(result.refusals)
    ]
    return Group(*parts, *(titled("Notes", *lines) if lines else []), Text())


def study(result: WorkPrecision) -> list[RenderableType]:
    """Return the fastest run for each error, and how the errors were known."""
    table = columns(*right("error ≤"), "engine", "method", *right("setting", "run time", "first run"), "next engine")
    for lead in leads(result):
        table.add_row(
            lead.errors,
            Text(inline(lead.curve.engine)),
            Text(inline(lead.curve.method)),
            setting_text(lead.point),
            time_text(lead.point.seconds),
            time_text(lead.curve.compile + lead.point.seconds) or "–",
            Text(_next(lead), style="dim"),
        )
    known = f"known to {error_text(result.floor)}" if math.isfinite(result.floor) else "known to an unknown error"
    below = bullet("", f"{inline(result.reference, 300)}; {known}", "i")
    missing = [Text(f"  ! {inline('; '.join(result.shortened), 400)}", style="bold yellow")] if result.shortened else []
    title = f"Error against run time, {result.duration:g} s of motion: the fastest with an error of q (rad or m)"
    return titled(title, *missing, table if table.rows else Text("  no run reached 1e-02", style="dim"), below)


def _next(lead: Lead) -> str:
    return ", ".join(f"{inline(engine)} × {factor}" if factor else engine for engine, _, factor in lead.nexts)


def _curves(result: WorkPrecision) -> list[RenderableType]:
    table = columns("", "engine", "method", *right("order", "of", "least error", "run time", "compile"))
    for line in curve_lines(result):
        curve, best = line.curve, line.best
        order = "" if math.isnan(curve.order) else f"{curve.order:.2f}"
        table.add_row(
            Text("●" if line.on_front else "", style="green"),
            Text(inline(curve.engine)),
            Text(inline(curve.method)),
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
