"""A comparison of engines, and one of many robots, as documents."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

from mbkit.report import figures, work_precision_view
from mbkit.report.document import (
    Block,
    Bullet,
    Column,
    Document,
    Facts,
    Figure,
    Items,
    Paragraph,
    Section,
    Span,
    Table,
    Text,
)
from mbkit.report.formatting import count_text, error_text, mark, model_facts, refusals, time_text
from mbkit.studies.compare.all_robots import RobotOutcome, Sweep
from mbkit.studies.compare.result import Comparison, Omission, RolloutRow, Row

# Rounding stays far below this, and anything that acts is far above.
_VISIBLE: Final = 1e-6
_MAX_FAILURES: Final = 12
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


@dataclass(frozen=True)
class Failure:
    """One thing that differs; `row` is there for terms."""

    what: str
    reason: str
    row: Row | None = None


def view(result: Comparison, target: str = "") -> Document:
    """Return the document of a comparison; `target` is the name by which a person called the model."""
    target = target if target != result.model else ""
    facts = result.facts
    mass = facts.get("mass")
    samples = result.rows[0].samples if result.rows else result.samples
    size = f"nq {facts.get('nq', '?')}, nv {facts.get('nv', '?')}" + (f", {mass:.4g} kg" if mass is not None else "")
    outcome = "agree" if result.passed else "not compared" if result.nothing else "differ"
    precision = result.precision
    steps = " or ".join(dict.fromkeys(time_text(r.dt) for r in _judged(result)))
    return Document(
        name=f"{result.model} ({target})" if target else result.model,
        heading=result.model,
        title=f"{result.model}: {outcome}",
        verdict=headline(result),
        good=result.passed,
        summary=f"{size} · {samples} states (seed {result.seed}) · tolerance {result.tolerance:.0e}"
        f" · {result.seconds:.1f} s",
        opening=[Items([_failure(f) for f in failures(result)], most=_MAX_FAILURES)],
        sections=[
            Section("The model", [Facts(list(model_facts(facts, target, result.setup)))], on="page"),
            Section("Terms: worst relative error, time per call", _terms(result) if result.rows else []),
            Section(_ROLLOUTS.format(steps), _rollouts(result)),
            *(work_precision_view.sections(precision, whole=False) if precision is not None else []),
            Section(
                "Left out because the scene does not need it: change is that of the accelerations", _omissions(result)
            ),
            Section("Notes", _notes(result)),
            Section(
                "How errors are measured",
                [Paragraph(_MEASURED[0]), Items([Bullet("", text) for text in _MEASURED[1]])],
                on="page",
            ),
        ],
        result=result,
        basis=_basis(result),
    )


def _basis(result: Comparison | Sweep) -> dict[str, Text]:
    states = f"{result.samples} random ones, seed {result.seed}; beside them neutral, at-limit and near-singular ones"
    return {"states": states}


def headline(result: Comparison) -> str:
    """Return the verdict in one sentence that stays short however much differs."""
    if result.nothing or result.passed or result.only_known_defects:
        return result.verdict
    parts = []
    for some, all_, what in (
        (sum(not r.passed for r in result.rows), len(result.rows), "comparisons of terms"),
        (sum(not r.passed for r in result.rollouts), len(_judged(result)), "rollouts"),
        (sum(not o.unchanged for o in result.omissions), len(result.omissions), "omissions"),
    ):
        parts += [f"{some} of {all_} {what}"] if some else []
    # Rows are measured by the oracle: the engine that differs fails. Rollouts are measured by MuJoCo's own.
    rows = [r for r in result.rows if not r.passed]
    engines = dict.fromkeys([*(r.engine for r in rows), *(r.engine for r in result.rollouts if not r.passed)])
    known = [r.engine for r in rows if r.defect]
    by_defect = f" ({len(known)} by a known defect of {', '.join(dict.fromkeys(known))})" if known else ""
    missing = "".join(f"; {x}" for x in result.shortened)
    subject = f"{', '.join(engines)} differ{'s' * (len(engines) == 1)}: " if engines else ""
    return f"{subject}{', '.join(parts)}{by_defect}{missing}"


def failures(result: Comparison) -> list[Failure]:
    """Return everything that differs, with its reason."""
    out = [Failure(f"{r.term}, {r.engine}", r.reason or "differs", r) for r in result.rows if not r.passed]
    for r in result.rollouts:
        if not r.passed:
            reason = f"differs from {r.against} by {r.error:.1e} in q, {r.tolerance:.0e} expected"
            out.append(Failure(f"rollout {r.method}, {r.engine}", reason + (f"; {r.note}" if r.note else "")))
    changed = [o for o in result.omissions if not o.unchanged]
    return out + [Failure(f"leaving out {o.need}", f"changes the accelerations by {o.change:.1e}") for o in changed]


def _failure(f: Failure) -> Bullet:
    folded = None
    if f.row is not None:
        q, v = (", ".join(map(str, x)) for x in (f.row.worst_q, f.row.worst_v))
        folded = f"the state of the worst error ({f.row.worst_kind})", f"q = [{q}]\nv = [{v}]"
    return Bullet(f.what, f.reason, "✗", "bad", folded=folded)


# Terms.


def _terms(result: Comparison) -> list[Block]:
    by_term = figures.by_term(result)
    short = [Column("term", lambda rows: next(iter(rows.values())).term)]
    short += [_of_engine(engine, result.reference) for engine in result.engines]
    entries = [(term, engine, rows.get(engine)) for term, rows in by_term.items() for engine in result.engines]
    allowed = [r for r in result.rows if r.passed and r.reason]
    but = ", but where an engine's own formula cannot do better (marked !)" if allowed else ""
    return [
        Table(short, [*by_term.values()], on="terminal"),
        Paragraph(
            f"Every engine against the {result.reference}, the own derivation evaluated with 34 digits, at "
            f"{result.rows[0].samples} states; an error above {result.tolerance:g} fails{but}.",
            on="page",
        ),
        Figure(
            lambda: figures.digits(result),
            "A marker is the worst state, crossed out where it fails; the thin bar's other end is the median. Double "
            "precision ends near 16 digits; “same” is the same number in every state.",
        ),
        Figure(
            lambda: figures.term_costs(result),
            "The same worst errors over the time of one call through mbkit: lower left is better. Errors below what "
            "double precision can tell stand at the bottom.",
            wide=True,
        ),
        Table(_COLUMNS, entries, on="page"),
        Items([Bullet(f"{r.term}, {r.engine}", r.reason, "!", "allowed") for r in allowed]),
        Paragraph(
            "Times are medians of single calls through mbkit, interleaved between engines; ± is half the interquartile "
            "range. The joint named has the largest error on its own scale.",
            on="page",
            note=True,
        ),
    ]


def _error(row: Row) -> Span:
    if row.zero and row.passed:
        return Span(f"– {'zero':>7}", "muted")
    if row.passed and row.reason:
        return Span(f"! {error_text(row.relative):>7}", "allowed")
    return mark(row.passed, error_text(row.relative))


def _of_engine(engine: str, reference: str) -> Column:
    return Column(f"{engine}\nvs {reference}", lambda rows: _short(rows.get(engine)), right=True)


def _short(row: Row | None) -> Text:
    """Return the error and the time of a term in one cell."""
    if row is None:
        return Span("refused", "muted")
    spent = f" {time_text(row.ns * 1e-9):>8}"
    # Where the oracle has no value, an engine stands in for it.
    return spent if row.engine == row.reference else (_error(row), spent)


def _of_row(text: Callable[[Row], Text], own: Text = "", refused: Text = "") -> Callable[[Any], Text]:
    """Return a cell of the long table; `own` of the engine that stands in for the oracle, `refused` without a row."""

    def cell(entry: tuple[str, str, Row | None]) -> Text:
        row = entry[2]
        return refused if row is None else own if row.engine == row.reference else text(row)

    return cell


def _time(ns: Callable[[Row], float]) -> Callable[[Any], Text]:
    return lambda row: "" if row[2] is None else time_text(ns(row[2]) * 1e-9)


_COLUMNS: Final = (
    Column("term", lambda row: row[0], group=True),
    Column("engine", lambda row: row[1]),
    Column(
        "worst",
        _of_row(_error, Span("stands in for the oracle", "muted"), Span("refused, see the notes", "muted")),
        right=True,
    ),
    Column("median", _of_row(lambda r: error_text(r.median)), right=True),
    Column("per joint", _of_row(lambda r: error_text(r.per_joint) if r.joint else ""), right=True),
    Column("at joint", _of_row(lambda r: Span(r.joint, "mono"))),
    Column("in a state", _of_row(lambda r: r.worst_kind if r.relative else "")),
    Column("largest\ndifference, SI", _of_row(lambda r: error_text(r.max_abs)), right=True),
    Column("time\nper call", _time(lambda r: r.ns), right=True),
    Column("±", _time(lambda r: r.ns_spread), right=True),
)


# Rollouts.


def _judged(result: Comparison) -> list[RolloutRow]:
    """Return the rollouts that can fail; the others, with an infinite tolerance, are there for information."""
    return [r for r in result.rollouts if math.isfinite(r.tolerance)]


def _rollouts(result: Comparison) -> list[Block]:
    judged = _judged(result)
    notes = {note: k for k, note in enumerate(dict.fromkeys(r.note for r in judged if r.note), 1)}
    columns = (
        Column("integrator", lambda r: r.method),
        Column("engine", lambda r: r.engine),
        Column("against", lambda r: r.against, on="page"),
        Column("step", lambda r: time_text(r.dt), right=True, on="page"),
        Column("horizon", lambda r: time_text(r.duration), right=True),
        Column("condition", lambda r: count_text(r.condition), right=True),
        Column("difference", lambda r: mark(r.passed if r.judged else None, error_text(r.error)), right=True),
        Column("tolerance", lambda r: f"{r.tolerance:.2g}", right=True, on="page"),
        Column("run time", lambda r: time_text(r.seconds), right=True),
        Column("MuJoCo's", lambda r: time_text(r.seconds_against), right=True),
        Column("", lambda r: Span(f"[{notes[r.note]}]" if r.note else "", "muted")),
    )
    out: list[Block] = []
    if judged:
        out.append(Paragraph("The same integrator with the same step, step for step.", on="page"))
        out.append(Table(columns, judged, dense=True))
        about = (
            "Condition is how far q moves when the forces are disturbed anew in every step, per relative disturbance: "
            "rounding disturbs them so, in any engine, by some eps."
        )
        out.append(Paragraph(about, on="page", note=True))
    below = [Bullet("", note, f"[{k}]") for note, k in notes.items()]
    below += [
        Bullet(
            f"{r.method} vs {r.against}",
            f"{error_text(r.error)} in q after {time_text(r.duration)} at {time_text(r.dt)}; {r.note}",
            "i",
        )
        for r in result.rollouts
        if not math.isfinite(r.tolerance)
    ]
    return [*out, Items(below)]


# What was left out of the computation, and what no engine could do.


def omission_state(omission: Omission) -> Literal["on", "same", "chosen", "changed"]:
    """Return whether the thing was on, off without effect, off by choice, or off to an effect."""
    if math.isnan(omission.change):
        return "on"
    if not omission.unchanged:
        return "changed"
    return "chosen" if omission.present and omission.change > _VISIBLE else "same"


def _saving(omission: Omission) -> Span:
    """Return the time that leaving a thing out saves at each call, with its spread, where it can be measured."""
    if math.isnan(omission.saved_ns):
        return Span("–", "muted")
    if not omission.measurable:
        return Span("not measurable", "muted")
    return Span(f"{time_text(omission.saved_ns * 1e-9)} ± {time_text(omission.saved_spread * 1e-9)}")


def _change(omission: Omission) -> Text:
    state = omission_state(omission)
    if state == "on":
        return "–"
    return error_text(omission.change) if state == "chosen" else mark(state == "same", error_text(omission.change))


def _omissions(result: Comparison) -> list[Block]:
    columns = (
        Column("need", lambda o: o.need, width=1),
        Column("in model", lambda o: "yes" if o.present else "no"),
        Column("saves/call", _saving, right=True),
        Column("set-up", lambda o: time_text(o.saved_setup) or "–", right=True),
        Column("change", _change, right=True),
        Column("what was off", lambda o: Span(o.what, "muted"), fill=True),
        Column("note", lambda o: Span(o.note, "muted"), on="page"),
    )
    chosen = [Bullet(o.need, o.note, "i") for o in result.omissions if omission_state(o) == "chosen"]
    return [Table(columns, result.omissions), Items(chosen, on="terminal")]


def _notes(result: Comparison) -> list[Block]:
    bullets = refusals(result.refusals)
    bullets += [Bullet("", note) for note in result.facts.get("notes", ())]
    bodies = "; ".join(result.facts.get("nonphysical", ()))
    bullets += [Bullet("bodies with inconsistent inertia", bodies)] if bodies else []
    return [Items(bullets)]


# Many robots.

_STATUS: Final = {
    "agree": Span("✓ agree", "good"),
    "refused": Span("– refused", "allowed"),
    "differ": Span("✗ differ", "bad"),
    "failed": Span("✗ failed", "bad"),
}


def robots_view(result: Sweep) -> Document:
    """Return the document of many robots."""
    reasons = [
        Bullet(o.robot, o.reason, _STATUS[o.status].text[0], _STATUS[o.status].style)
        for o in result.outcomes
        if o.reason
    ]
    compared = any(o.comparison and o.comparison.rows for o in result.outcomes)
    about = "Worst relative error of any term and state, one marker per robot; the dotted line is the tolerance."
    columns = (
        Column("result", lambda o: _STATUS[o.status], width=9),
        Column("robot", lambda o: o.robot, width=20),
        Column("nv", _of(lambda c: str(c.facts["nv"])), right=True, width=3),
        Column("engines", _of(lambda c: str(len(c.engines))), right=True, width=7, on="terminal"),
        Column("engines", _of(lambda c: ", ".join(c.engines)), on="page"),
        Column("digits", _of(lambda c: f"{c.digits:.1f}" if c.worst else ""), right=True, width=6),
        Column("worst", _of(lambda c: error_text(c.worst.relative) if c.worst else ""), right=True, width=7),
        Column("where", _of(lambda c: f"{c.worst.term}, {c.worst.engine}" if c.worst else ""), on="page"),
    )
    return Document(
        name="",
        heading="All robots of example-robot-data",
        title=f"all robots: {'agree' if result.passed else 'differ'}",
        verdict=result.verdict,
        good=result.passed,
        opening=[Figure(lambda: figures.robots(result), about)] if compared else [],
        sections=[
            Section("Robot by robot", [Table(columns, result.outcomes, dense=True)]),
            Section("Reasons", [Items(reasons)]),
        ],
        result=result,
        basis=_basis(result),
        last=True,
    )


def _of(text: Callable[[Any], str]) -> Callable[[RobotOutcome], str]:
    return lambda o: text(o.comparison) if o.comparison else ""
