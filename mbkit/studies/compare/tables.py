"""Tables of a comparison: its terms, rollouts and omissions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final, Literal

from mbkit.studies import document as doc
from mbkit.studies.compare.rows import Omission, RolloutRow, Row
from mbkit.studies.formatting import count_text, error_text, judged, time_text

#: The least relative change of accelerations that is an effect: rounding stays far below it.
_MIN_VISIBLE_CHANGE: Final = 1e-6
#: Name of a term -> its meaning.
MEANINGS: Final = {
    "M": "mass matrix",
    "g": "gravity force",
    "nle": "gravity and velocity forces together: M a + nle = τ without passive forces",
    "C v": "velocity (Coriolis and centrifugal) forces",
    "passive": "forces of springs, dampers and other elements",
    "inverse dynamics": "the force τ that an acceleration needs",
    "forward dynamics": "the acceleration that a force τ causes",
    "kinetic energy": "½ vᵀ M v",
    "potential energy": "of gravity and springs",
    "pose": "position and orientation of the frame at the end of the longest chain",
    "Jacobian": "J, by which v gives that frame's velocity",
    "velocity": "of that frame",
    "acceleration": "of that frame",
    "J̇ v": "the part of that frame's acceleration that v alone causes",
    "centre of mass": "of all bodies together",
    "A_G": "centroidal momentum matrix: A_G v is the momentum of all bodies about their common centre of mass",
    "Ȧ_G v": "the part of that momentum's rate that v alone causes",
    "locked inertia": "inertia of all bodies about their common centre of mass, as if every joint were locked",
    "M⁻¹": "inverse of the mass matrix",
    "joint loads": "force and moment that each joint carries",
    "Jᵀ wrench": "the joint forces that stand for a force and moment on that frame",
    "forward dynamics, wrench": "the acceleration with a force and moment on that frame",
    "regressor": "Y, in which τ = Y p is linear in the masses and inertias p",
    "∂ID/∂(q, v, a)": "derivatives of inverse dynamics",
    "f": "constraint equations, zero where loops are closed",
    "J": "Jacobian of the constraint equations",
    "J̇ v rows": "the part of the constraints' acceleration that v alone causes",
    "Jᵀ λ": "joint forces of the constraints",
    "power balance": "rate of the energy against the power of the forces",
}


def failures(rows: Sequence[Row], rollouts: Sequence[RolloutRow], omissions: Sequence[Omission]) -> list[doc.Bullet]:
    """Return everything that differs, with its reason."""
    out = []
    for r in rows:
        if not r.passed:
            q, v = (", ".join(map(str, x)) for x in (r.worst_q, r.worst_v))
            state = f"the state of the worst error ({r.worst_kind})", f"q = [{q}]\nv = [{v}]"
            out.append(doc.Bullet(f"{r.term}, {r.engine}", r.reason or "differs", "✗", "bad", folded=state))
    for run in rollouts:
        if run.passed is False:
            other = f"{run.method} on {run.engine}" if run.off else run.against
            reason = f"differs from {other} by {error_text(run.error)} in q, {run.tolerance:.0e} expected"
            reason += f"; {run.note}" if run.note else ""
            name = f"{run.against}, {run.off}" if run.off else f"{run.method}, {run.engine}"
            out.append(doc.Bullet(f"rollout {name}", reason, "✗", "bad"))
    changed = [o for o in omissions if o.fault]
    what = "changes the accelerations by {}"
    return out + [doc.Bullet(f"leaving out {o.need}", what.format(error_text(o.change)), "✗", "bad") for o in changed]


# Terms.


def _error(row: Row) -> doc.Span:
    if row.zero and row.passed:
        return doc.Span(f"– {'zero':>7}", "muted")
    if row.passed and row.reason:
        return doc.Span(f"! {error_text(row.relative):>7}", "allowed")
    return judged(row.passed, error_text(row.relative))


WORST: Final = (
    doc.Column("worst row of", lambda r: r.engine),
    doc.Column("term", lambda r: r.term),
    doc.Column("error", lambda r: _error(r), right=True),
    doc.Column("allowed", lambda r: error_text(r.allowed), right=True),
    doc.Column("in a state", lambda r: r.worst_kind),
    doc.Column("most at joint", lambda r: doc.Span(r.joint, "mono")),
)


def engine_column(engine: str, reference: str) -> doc.Column:
    """Return the column of an engine's errors and times, term by term."""
    return doc.Column(f"{engine}\nvs {reference}", lambda rows: _short(rows.get(engine)), right=True)


def _short(row: Row | None) -> doc.Text:
    """Return the error and the time of a term in one cell."""
    if row is None:
        return doc.Span("refused", "muted")
    spent = f" {time_text(row.ns * 1e-9):>8}"
    # Where the oracle has no value, an engine stands in for it.
    return spent if row.engine == row.reference else (_error(row), spent)


def _of_row(text: Callable[[Row], doc.Text], own: doc.Text = "", refused: doc.Text = "") -> Callable[[Any], doc.Text]:
    """Return a cell of the long table; `own` of the engine that stands in for the oracle, `refused` without a row."""

    def cell(entry: tuple[str, str, Row | None]) -> doc.Text:
        row = entry[2]
        return refused if row is None else own if row.engine == row.reference else text(row)

    return cell


def _time(ns: Callable[[Row], float]) -> Callable[[Any], doc.Text]:
    return lambda row: "" if row[2] is None else time_text(ns(row[2]) * 1e-9)


TERM_COLUMNS: Final = (
    doc.Column("term", lambda row: row[0], group=True),
    doc.Column("engine", lambda row: row[1]),
    doc.Column(
        "worst",
        _of_row(_error, doc.Span("stands in for the oracle", "muted"), doc.Span("refused, see the notes", "muted")),
        right=True,
    ),
    doc.Column("median", _of_row(lambda r: error_text(r.median)), right=True),
    doc.Column("per joint", _of_row(lambda r: error_text(r.per_joint) if r.joint else ""), right=True),
    doc.Column("at joint", _of_row(lambda r: doc.Span(r.joint, "mono"))),
    doc.Column("in a state", _of_row(lambda r: r.worst_kind if r.relative else "")),
    doc.Column("largest\ndifference, SI", _of_row(lambda r: error_text(r.max_abs)), right=True),
    doc.Column("time\nper call", _time(lambda r: r.ns), right=True),
    doc.Column("±", _time(lambda r: r.ns_spread), right=True),
)


# Rollouts.


def rollout_blocks(rollouts: Sequence[RolloutRow]) -> list[doc.Block]:
    """Return the rollouts of one formula as a table, those for information as a list."""
    shown = [r for r in rollouts if not r.informs]
    notes = {note: k for k, note in enumerate(dict.fromkeys(r.note for r in shown if r.note), 1)}
    columns = (
        doc.Column("integrator", lambda r: r.method),
        doc.Column("engine", lambda r: r.engine),
        doc.Column("against", lambda r: r.against, on="page"),
        doc.Column("step", lambda r: time_text(r.dt), right=True, on="page"),
        doc.Column("horizon", lambda r: time_text(r.duration), right=True),
        doc.Column("condition", lambda r: count_text(r.condition), right=True),
        doc.Column("difference", lambda r: judged(r.passed, error_text(r.error)), right=True),
        doc.Column("tolerance", lambda r: f"{r.tolerance:.2g}", right=True, on="page"),
        doc.Column("run time", lambda r: time_text(r.seconds), right=True),
        doc.Column("MuJoCo's", lambda r: time_text(r.seconds_against), right=True),
        doc.Column("", lambda r: doc.Span(f"[{notes[r.note]}]" if r.note else "", "muted")),
    )
    out: list[doc.Block] = []
    if shown:
        out.append(doc.Paragraph("The same integrator with the same step, step for step.", on="page"))
        out.append(doc.Table(columns, shown, dense=True))
        about = (
            "Condition is how far q moves when the forces are disturbed in every step, per relative disturbance: "
            "rounding disturbs them so, in any engine, by some eps."
        )
        out.append(doc.Paragraph(about, on="page", note=True))
    below = [doc.Bullet("", note, f"[{k}]") for note, k in notes.items()]
    below += [
        doc.Bullet(
            f"{r.method} vs {r.against}",
            f"{error_text(r.error)} in q after {time_text(r.duration)} at {time_text(r.dt)}; {r.note}",
            "i",
        )
        for r in rollouts
        if r.informs
    ]
    return [*out, doc.Items(below)]


# Omissions: parts of the scene that were left out of the computation.


def omission_state(omission: Omission) -> Literal["on", "same", "chosen", "changed"]:
    """Return whether the thing was on, off without effect, off by choice, or off to an effect."""
    if math.isnan(omission.change):
        return "on"
    if omission.fault:
        return "changed"
    return "chosen" if omission.present and omission.change > _MIN_VISIBLE_CHANGE else "same"


def _saving(omission: Omission) -> doc.Span:
    """Return the time that leaving a thing out saves at each call, with its spread, where it can be measured."""
    if math.isnan(omission.saved_ns):
        return doc.Span("–", "muted")
    if not omission.measurable:
        return doc.Span("not measurable", "muted")
    return doc.Span(f"{time_text(omission.saved_ns * 1e-9)} ± {time_text(omission.saved_spread * 1e-9)}")


def _change(omission: Omission) -> doc.Text:
    state, text = omission_state(omission), error_text(omission.change)
    return "–" if state == "on" else text if state == "chosen" else judged(state == "same", text)


def omission_blocks(omissions: Sequence[Omission]) -> list[doc.Block]:
    """Return what was left out as a table, and what that chose."""
    columns = (
        doc.Column("need", lambda o: o.need, width=1),
        doc.Column("in model", lambda o: "yes" if o.present else "no"),
        doc.Column("saves/call", _saving, right=True),
        doc.Column("set-up", lambda o: time_text(o.saved_setup) or "–", right=True),
        doc.Column("change", _change, right=True),
        doc.Column("what was off", lambda o: doc.Span(o.what, "muted"), fill=True),
        doc.Column("note", lambda o: doc.Span(o.note, "muted"), on="page"),
    )
    chosen = [doc.Bullet(o.need, o.note, "i") for o in omissions if omission_state(o) == "chosen"]
    return [doc.Table(columns, omissions), doc.Items(chosen, on="terminal")]
