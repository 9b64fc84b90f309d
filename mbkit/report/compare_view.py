"""A comparison of engines, and one of many robots, as documents."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, Literal

from mbkit.report import document as doc
from mbkit.report import figures, work_precision_view
from mbkit.report.formatting import brief, count_text, error_text, mark, model_facts, refusals, time_text
from mbkit.studies.compare.all_robots import RobotOutcome, Sweep
from mbkit.studies.compare.result import OWN_LAW, STIFF, Comparison, Omission, RolloutRow, Row

# Rounding stays far below this, and anything that acts is far above.
_VISIBLE: Final = 1e-6
_MAX_FAILURES: Final = 12
#: Stiff joints that have a line of their own on the first screen.
_MAX_STIFF: Final = 3
#: What stands behind the name of a term.
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
_ROLLOUTS: Final = "Rollouts against MuJoCo's own, step {}: largest difference of q (rad or m)"
_MEASURED: Final = (
    "At each state a vector x of the reference and its error e give ‖e‖ / max(‖x‖, ‖M‖‖v‖²): a term that happens to be "
    "small is measured by the forces at play. “Worst” is the largest over all states.",
    (
        "M: the largest |eᵢⱼ| / √(Mᵢᵢ Mⱼⱼ), which no choice of units changes.",
        "Forward dynamics: accelerations weighted by √Mⱼⱼ, and divided by cond(M) of M scaled to a unit diagonal, "
        "which any arithmetic loses.",
        "Energies: |e| / max(|x|, ‖M‖‖v‖²).",
        "Per joint: |eⱼ| by that joint's own scale, which shows a small joint beside a large one.",
        "Power balance: dE/dt against (τ + damping)·v, each engine by itself.",
    ),
)


def view(result: Comparison, target: str = "", *, full: bool = False) -> doc.Document:
    """Return the document of a comparison; `target` is the name by which a person called the model.

    A terminal shows what the page begins with: verdict, what the file has that no engine used, faults, and each
    engine's worst row. With `full` it shows the tables too.
    """
    target = target if target != result.model else ""
    facts = result.facts
    mass = facts.get("mass")
    samples = result.rows[0].samples if result.rows else result.samples
    size = f"nq {facts.get('nq', '?')}, nv {facts.get('nv', '?')}" + (f", {mass:.4g} kg" if mass is not None else "")
    outcome = "agree" if result.passed else "not compared" if result.nothing else "differ"
    precision = result.precision
    steps = " or ".join(dict.fromkeys(time_text(r.dt) for r in _compared(result)))
    on: doc.On = "both" if full else "page"
    terms = dict.fromkeys(r.term for r in result.rows)
    return doc.Document(
        name=f"{result.model} ({target})" if target else result.model,
        heading=result.model,
        title=f"{result.model}: {outcome}",
        verdict=headline(result),
        sentence=_sentence(result),
        good=result.passed,
        summary=f"{size} · {samples} states (seed {result.seed}) · tolerance {result.tolerance:.0e}"
        f" · {result.seconds:.1f} s",
        opening=_first_screen(result, full=full),
        sections=[
            doc.Section("The model", [doc.Facts(list(model_facts(facts, target, result.setup)))], on="page"),
            doc.Section("Terms: worst relative error, time per call", _terms(result) if result.rows else [], on),
            doc.Section(_ROLLOUTS.format(steps), _rollouts(result), on),
            *(work_precision_view.sections(precision, whole=False, on=on) if precision is not None else []),
            doc.Section(
                "What a call leaves out, and the time that this saves; change is that of the accelerations",
                _omissions(result),
                on,
            ),
            doc.Section("Notes", _notes(result), on),
            doc.Section("What the terms are", [doc.Facts([(t, x) for t in terms if (x := MEANINGS.get(t))])], "page"),
            doc.Section(
                "How errors are measured",
                [doc.Paragraph(_MEASURED[0]), doc.Items([doc.Bullet("", text) for text in _MEASURED[1]])],
                on="page",
            ),
        ],
        result=result,
        basis=_basis(result),
    )


def _first_screen(result: Comparison, *, full: bool) -> list[doc.Block]:
    """Return what a reader needs to know before any table."""
    stiff = [x for x in result.findings if x.kind == STIFF]
    beside = [doc.Bullet(x.kind, x.says, "!", "allowed") for x in result.findings if x not in stiff[_MAX_STIFF:]]
    if len(stiff) > _MAX_STIFF:
        rest = ", ".join(name for x in stiff[_MAX_STIFF:] for name in x.joints)
        beside.append(doc.Bullet("stiff joints", f"{len(stiff) - _MAX_STIFF} more, less stiff: {rest}", "!", "allowed"))
    beside += [
        doc.Bullet(r.engine or f"no {r.term}", r.reason, "!", "allowed")
        for r in result.refusals
        if not r.engine or (not r.term and r.engine not in result.engines)
    ]
    notes = dict.fromkeys(r.note for r in result.rollouts if r.passed is None and not r.informs)
    beside += [doc.Bullet("rollouts", note, "!", "allowed") for note in notes]
    if result.precision is not None:
        failed = result.precision.failed
        beside += [
            doc.Bullet(f"no curve of {b.head}", b.text, "!", "allowed") for b in work_precision_view.named(failed)
        ]
    return [
        doc.Items(failures(result), most=_MAX_FAILURES),
        doc.Items(beside, most=_MAX_FAILURES),
        doc.Table(_WORST, _worst_rows(result)),
        *([] if full else [doc.Paragraph(doc.Span(_MORE, "muted"), on="terminal")]),
    ]


_MORE: Final = "All terms, rollouts, run times and notes: with --full, and on the page."
_WORST: Final = (
    doc.Column("worst row of", lambda r: r.engine),
    doc.Column("term", lambda r: r.term),
    doc.Column("error", lambda r: _error(r), right=True),
    doc.Column("allowed", lambda r: error_text(r.allowed), right=True),
    doc.Column("in a state", lambda r: r.worst_kind),
    doc.Column("most at joint", lambda r: doc.Span(r.joint, "mono")),
)


def _worst_rows(result: Comparison) -> list[Row]:
    """Return each engine's worst row; one that failed comes first."""
    rows = [[r for r in result.rows if r.engine == engine and r.reference != engine] for engine in result.engines]
    return [max(some, key=lambda r: (not r.passed, r.relative)) for some in rows if some]


def _basis(result: Comparison | Sweep) -> dict[str, doc.Text]:
    states = f"{result.samples} random ones, seed {result.seed}; beside them neutral, at-limit and near-singular ones"
    return {"states": states}


def headline(result: Comparison) -> str:
    """Return the verdict in one sentence that stays short however much differs."""
    if result.nothing or result.passed or result.only_known_defects:
        return result.verdict
    # Rows are measured by the oracle: the engine that differs fails. Rollouts are measured by MuJoCo's own.
    rows = [r for r in result.rows if not r.passed]
    runs = [r for r in result.rollouts if r.passed is False]
    omissions = [o for o in result.omissions if o.fault]
    counts = (
        (rows, result.rows, "comparisons of terms"),
        (runs, [r for r in result.rollouts if r.judged], "rollouts"),
        (omissions, result.omissions, "omissions"),
    )
    parts = [f"{len(failed)} of {len(every)} {what}" for failed, every, what in counts if failed]
    engines = dict.fromkeys([*(r.engine for r in rows), *(r.off or r.engine for r in runs)])
    known = [r.engine for r in rows if r.defect]
    by_defect = f" ({len(known)} by a known defect of {', '.join(dict.fromkeys(known))})" if known else ""
    subject = f"{', '.join(engines)} differ{'s' * (len(engines) == 1)}: " if engines else ""
    return f"{subject}{', '.join(parts)}{by_defect}{brief(result.shortened)}"


def _sentence(result: Comparison) -> str:
    """Return the headline, with what was compared with what on how many states."""
    if result.nothing:
        return headline(result)
    instead = result.reference in result.engines
    what = "which stands in for the oracle" if instead else "the own derivation evaluated with 34 digits"
    reference = f"{'' if instead else 'the '}{result.reference}, {what}"
    terms = len({r.term for r in result.rows})
    measured = f"{terms} term{'s' * (terms != 1)} at {result.rows[0].samples} states"
    if not result.passed:
        return f"{headline(result)}; measured against {reference}, in {measured}"
    return f"{result.agreement(f' with {reference}')}, in {measured}{brief(result.shortened)}"


def failures(result: Comparison) -> list[doc.Bullet]:
    """Return everything that differs, with its reason."""
    out = []
    for r in result.rows:
        if not r.passed:
            q, v = (", ".join(map(str, x)) for x in (r.worst_q, r.worst_v))
            state = f"the state of the worst error ({r.worst_kind})", f"q = [{q}]\nv = [{v}]"
            out.append(doc.Bullet(f"{r.term}, {r.engine}", r.reason or "differs", "✗", "bad", folded=state))
    for run in result.rollouts:
        if run.passed is False:
            other = f"{run.method} on {run.engine}" if run.off else run.against
            reason = f"differs from {other} by {error_text(run.error)} in q, {run.tolerance:.0e} expected"
            reason += f"; {run.note}" if run.note else ""
            name = f"{run.against}, {run.off}" if run.off else f"{run.method}, {run.engine}"
            out.append(doc.Bullet(f"rollout {name}", reason, "✗", "bad"))
    changed = [o for o in result.omissions if o.fault]
    what = "changes the accelerations by {}"
    return out + [doc.Bullet(f"leaving out {o.need}", what.format(error_text(o.change)), "✗", "bad") for o in changed]


# Terms.


def _terms(result: Comparison) -> list[doc.Block]:
    by_term = result.by_term()
    short = [doc.Column("term", lambda rows: next(iter(rows.values())).term)]
    short += [_of_engine(engine, result.reference) for engine in result.engines]
    entries = [(term, engine, rows.get(engine)) for term, rows in by_term.items() for engine in result.engines]
    allowed = [r for r in result.rows if r.passed and r.reason]
    but = ", but where an engine's own formula cannot do better (marked !)" if allowed else ""
    return [
        doc.Table(short, [*by_term.values()], on="terminal"),
        *_soft(result),
        doc.Paragraph(
            f"Every engine against the {result.reference}, the own derivation evaluated with 34 digits, at "
            f"{result.rows[0].samples} states; an error above {result.tolerance:g} fails{but}.",
            on="page",
        ),
        doc.Figure(
            lambda: figures.digits(result),
            "A marker is the worst state, crossed out where it fails; the thin bar's other end is the median. Double "
            "precision ends near 16 digits; “same” is the same number in every state.",
        ),
        doc.Figure(
            lambda: figures.term_costs(result),
            "The same worst errors over the time of one call through mbkit: lower left is better. Errors below what "
            "double precision can tell stand at the bottom.",
            wide=True,
        ),
        doc.Table(_COLUMNS, entries, on="page"),
        doc.Items([doc.Bullet(f"{r.term}, {r.engine}", r.reason, "!", "allowed") for r in allowed]),
        doc.Paragraph(
            "Times are medians of single calls through mbkit, interleaved between engines; ± is half the interquartile "
            "range. The joint named has the largest error on its own scale.",
            on="page",
            note=True,
        ),
    ]


def _soft(result: Comparison) -> list[doc.Block]:
    """Return a sentence on each engine with soft constraints."""
    out: list[doc.Block] = []
    for engine in result.softness:
        terms = [r.term for r in result.rows if r.engine == engine and r.reference == OWN_LAW]
        out.append(
            doc.Paragraph(
                f"{', '.join(terms)} of {engine} are measured by its own law of soft constraints instead of the "
                f"{result.reference}."
            )
        )
    return out


def _error(row: Row) -> doc.Span:
    if row.zero and row.passed:
        return doc.Span(f"– {'zero':>7}", "muted")
    if row.passed and row.reason:
        return doc.Span(f"! {error_text(row.relative):>7}", "allowed")
    return mark(row.passed, error_text(row.relative))


def _of_engine(engine: str, reference: str) -> doc.Column:
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


_COLUMNS: Final = (
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


def _compared(result: Comparison) -> list[RolloutRow]:
    """Return the rollouts of one formula; the others are there for information."""
    return [r for r in result.rollouts if not r.informs]


def _rollouts(result: Comparison) -> list[doc.Block]:
    shown = _compared(result)
    notes = {note: k for k, note in enumerate(dict.fromkeys(r.note for r in shown if r.note), 1)}
    columns = (
        doc.Column("integrator", lambda r: r.method),
        doc.Column("engine", lambda r: r.engine),
        doc.Column("against", lambda r: r.against, on="page"),
        doc.Column("step", lambda r: time_text(r.dt), right=True, on="page"),
        doc.Column("horizon", lambda r: time_text(r.duration), right=True),
        doc.Column("condition", lambda r: count_text(r.condition), right=True),
        doc.Column("difference", lambda r: mark(r.passed, error_text(r.error)), right=True),
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
        for r in result.rollouts
        if r.informs
    ]
    return [*out, doc.Items(below)]


# What was left out of the computation, and what no engine could do.


def omission_state(omission: Omission) -> Literal["on", "same", "chosen", "changed"]:
    """Return whether the thing was on, off without effect, off by choice, or off to an effect."""
    if math.isnan(omission.change):
        return "on"
    if omission.fault:
        return "changed"
    return "chosen" if omission.present and omission.change > _VISIBLE else "same"


def _saving(omission: Omission) -> doc.Span:
    """Return the time that leaving a thing out saves at each call, with its spread, where it can be measured."""
    if math.isnan(omission.saved_ns):
        return doc.Span("–", "muted")
    if not omission.measurable:
        return doc.Span("not measurable", "muted")
    return doc.Span(f"{time_text(omission.saved_ns * 1e-9)} ± {time_text(omission.saved_spread * 1e-9)}")


def _change(omission: Omission) -> doc.Text:
    state, text = omission_state(omission), error_text(omission.change)
    return "–" if state == "on" else text if state == "chosen" else mark(state == "same", text)


def _omissions(result: Comparison) -> list[doc.Block]:
    columns = (
        doc.Column("need", lambda o: o.need, width=1),
        doc.Column("in model", lambda o: "yes" if o.present else "no"),
        doc.Column("saves/call", _saving, right=True),
        doc.Column("set-up", lambda o: time_text(o.saved_setup) or "–", right=True),
        doc.Column("change", _change, right=True),
        doc.Column("what was off", lambda o: doc.Span(o.what, "muted"), fill=True),
        doc.Column("note", lambda o: doc.Span(o.note, "muted"), on="page"),
    )
    chosen = [doc.Bullet(o.need, o.note, "i") for o in result.omissions if omission_state(o) == "chosen"]
    return [doc.Table(columns, result.omissions), doc.Items(chosen, on="terminal")]


def _notes(result: Comparison) -> list[doc.Block]:
    notes = [doc.Bullet("", note) for note in result.facts.get("notes", ())]
    bodies = "; ".join(result.facts.get("nonphysical", ()))
    inconsistent = [doc.Bullet("bodies with inconsistent inertia", bodies)] if bodies else []
    return [doc.Items([*refusals(result.refusals), *notes, *inconsistent])]


# Many robots.

_STATUS: Final = {
    "agree": doc.Span("✓ agree", "good"),
    "refused": doc.Span("– refused", "allowed"),
    "differ": doc.Span("✗ differ", "bad"),
    "failed": doc.Span("✗ failed", "bad"),
}


def robots_view(result: Sweep) -> doc.Document:
    """Return the document of many robots."""
    reasons = [
        doc.Bullet(o.robot, o.reason, _STATUS[o.status].text[0], _STATUS[o.status].style)
        for o in result.outcomes
        if o.reason
    ]
    compared = any(o.comparison and o.comparison.rows for o in result.outcomes)
    about = "Worst relative error of any term and state, one marker per robot; the dotted line is the tolerance."
    columns = (
        doc.Column("result", lambda o: _STATUS[o.status], width=9),
        doc.Column("robot", lambda o: o.robot, width=20),
        doc.Column("nv", _of(lambda c: str(c.facts["nv"])), right=True, width=3),
        doc.Column("engines", _of(lambda c: str(len(c.engines))), right=True, width=7, on="terminal"),
        doc.Column("engines", _of(lambda c: ", ".join(c.engines)), on="page"),
        doc.Column("digits", _of(lambda c: f"{c.digits:.1f}" if c.worst else ""), right=True, width=6),
        doc.Column("worst", _of(lambda c: error_text(c.worst.relative) if c.worst else ""), right=True, width=7),
        doc.Column("where", _of(lambda c: f"{c.worst.term}, {c.worst.engine}" if c.worst else ""), on="page"),
    )
    return doc.Document(
        name="",
        heading="All robots of example-robot-data",
        title=f"all robots: {'agree' if result.passed else 'differ'}",
        verdict=result.verdict,
        sentence=_robots_sentence(result),
        good=result.passed,
        opening=[doc.Figure(lambda: figures.robots(result), about)] if compared else [],
        sections=[
            doc.Section("Robot by robot", [doc.Table(columns, result.outcomes, dense=True)]),
            doc.Section("Reasons", [doc.Items(reasons)]),
        ],
        result=result,
        basis=_basis(result),
        last=True,
    )


def _robots_sentence(result: Sweep) -> str:
    states = [c.rows[0].samples for o in result.outcomes if (c := o.comparison) and c.rows]
    if not states:
        return result.verdict
    least, most = min(states), max(states)
    span = f"{least} to {most}" if least != most else f"{least}"
    return f"{result.verdict}; each against its own derivation evaluated with 34 digits, at {span} states"


def _of(text: Callable[[Any], str]) -> Callable[[RobotOutcome], str]:
    return lambda o: text(o.comparison) if o.comparison else ""
