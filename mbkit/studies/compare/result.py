"""What a comparison returns: frozen rows, their judgement, and the document that shows them.

Tables of a comparison: its terms, rollouts and omissions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal

from mbkit._check import DOUBLE_BITS, MAX_LINES, by_key
from mbkit.engines.base import MAX_NAMES
from mbkit.engines.constrained import off_by
from mbkit.model.elements.kinds import EFFECTS
from mbkit.simulate.plotting.style import drawing
from mbkit.studies import document as doc
from mbkit.studies.compare import figure
from mbkit.studies.compare.errors import named_precision
from mbkit.studies.compare.terms import OWN_LAW, STIFF, Finding, Omission, RolloutRow, Row, by_term
from mbkit.studies.formatting import count_text, error_text, judged, missing_text, model_facts, refusals, time_text
from mbkit.studies.results import Refusal, ResultTable, columns_of
from mbkit.studies.work_precision.result import WorkPrecision, curve_sections, failed_curves

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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


_MORE: Final = "All terms, rollouts, run times and notes: with --full, and on the page."


@dataclass(frozen=True, repr=False)
class Comparison(ResultTable):
    """Several engines on one description: do they agree, to how many digits, at what cost.

    `facts` has nq, nv, mass, digest, needs and notes of the model. `reference` is what the terms of all `engines` were
    measured by: the oracle. Accelerations of an engine with soft constraints are measured by its own written law
    instead, and `softness` has the digits that it keeps of the exact ones, at the median state. `findings` are what the
    description has that no engine uses, its forces that jump and its stiff joints. `precision` is the error against run
    time of a few methods on a short horizon. `setup` has the seconds to build each engine; the derivation works when
    first called.
    `seconds` is the time of the whole study.
    """

    model: str
    facts: dict[str, Any]
    engines: tuple[str, ...]
    reference: str
    samples: int
    seed: int
    tolerance: float
    rows: tuple[Row, ...]
    rollouts: tuple[RolloutRow, ...] = ()
    precision: WorkPrecision | None = None
    omissions: tuple[Omission, ...] = ()
    refusals: tuple[Refusal, ...] = ()
    findings: tuple[Finding, ...] = ()
    setup: dict[str, float] = field(default_factory=dict)
    softness: dict[str, float] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    processor: str = ""
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether at least two engines were compared, in terms that are not all zero, and nothing differed.

        What the description has and no engine uses, among `findings`, is no difference between engines.
        """
        agreed = bool(self.rows) and not self.nothing and all(r.passed for r in self.rows)
        return agreed and not self._beyond

    @property
    def worst(self) -> Row | None:
        """The row with the largest relative error; a failed one first."""
        return max(self.rows, key=lambda r: (not r.passed, r.relative), default=None)

    @property
    def verdict(self) -> str:
        """Whether they agree, and to how many digits, or which engine differs in what, and by which known defect."""
        if self.nothing:
            return f"nothing compared: {self.nothing}"
        missing = "".join(f"; {x}" for x in self.shortened)
        if self.passed:
            return f"{self.agreement()}{missing}"
        known = by_key(((r.engine, r.defect), r.term) for r in self.rows if r.defect)
        parts = [f"{engine} differs in {', '.join(terms)}: {defect}" for (engine, defect), terms in known.items()]
        if self.only_known_defects:
            return f"{'; '.join(parts)}; all else agrees to {self.digits:.1f} digits{missing}"
        failed = [r for r in self.rows if not r.passed and not r.defect]
        parts += [f"{r.engine} differs in {r.term}" + (f" at {r.joint}" if r.joint else "") for r in failed]
        beyond = [
            f"rollout {x.against if x.off else x.method} on {x.off or x.engine} differs"
            if isinstance(x, RolloutRow)
            else f"leaving out {x.need} changes the accelerations"
            for x in self._beyond
        ]
        return "; ".join([*parts, *dict.fromkeys(beyond)]) + missing

    @property
    def nothing(self) -> str:
        """Why the comparison says nothing although no row differs; empty where it does say something."""
        if not self.rows:
            # Engines that refuse a model for the same reason say so once.
            return "; ".join(dict.fromkeys(r.reason for r in self.refusals)) or "no engines"
        if any(not r.passed for r in self.rows):
            return ""
        if any(r.zero for r in self.rows if r.term == "M"):
            return "the mass matrix is zero at every state, as no joint moves any mass"
        return "every term is zero at every state" if all(r.zero for r in self.rows) else ""

    @property
    def only_known_defects(self) -> bool:
        """Whether something differs, and all of it by known defects of engines."""
        failed = [r for r in self.rows if not r.passed]
        return bool(failed) and all(r.defect for r in failed) and not self._beyond

    @property
    def _beyond(self) -> list[RolloutRow | Omission]:
        """The failures beyond the terms."""
        return [*(r for r in self.rollouts if r.passed is False), *(o for o in self.omissions if o.fault)]

    @property
    def shortened(self) -> tuple[str, ...]:
        """Terms, engines, studies and curves that the comparison left out, and horizons that were cut."""
        out = [f"not compared: {', '.join(self.not_compared)}"] if self.not_compared else []
        absent = dict.fromkeys(r.engine for r in self.refusals if not r.term and r.engine not in self.engines)
        out += [f"{', '.join(absent)} left out"] if absent else []
        out += [f"no {r.term}" for r in self.refusals if not r.engine]
        loops = self.facts["needs"]["loops"] if self.softness else False
        what, them, exact = ("loops", "them", "rigid") if loops else (EFFECTS["jump"], "it", "exact")
        out += [
            f"{name} holds {what} softly, and agrees with its own law of {them}; its accelerations are "
            f"{off_by(10.0**-x, f'the {exact} ones')} at the median state"
            for name, x in self.softness.items()
        ]
        rows = [r for r in self.rollouts if not r.informs]
        rubbing = [x.size for x in self.findings if x.kind == EFFECTS["jump"]]
        if rows and rubbing:
            size = f"{rubbing[0]:.2g} times the other forces"
            out += [f"rollouts and error against run time are without {EFFECTS['jump']} ({size})"]
        if rows and self.facts["needs"].get("stops"):
            out += [f"rollouts and error against run time are without {EFFECTS['stop']}"]
        judged = [r for r in rows if r.judged]
        if rows and not judged:
            out.append(f"none of {len(rows)} rollouts judged" if len(rows) > 1 else "the rollout not judged")
        elif len(judged) < len(rows):
            out.append(f"{len(rows) - len(judged)} of {len(rows)} rollouts not judged")
        if cut := [r for r in judged if r.cut]:
            least = min(r.duration for r in cut)
            out.append(f"{len(cut)} of {len(rows)} rollouts cut, to {least:.3g} s at the least")
        if self.precision is not None:
            # A comparison's runs are short by its own choice.
            out += [f"error against run time: {x}" for x in self.precision.shortened if x != self.precision.bounded]
        return tuple(out)

    @property
    def not_compared(self) -> tuple[str, ...]:
        """Terms that no engine could give, as where M is singular; `refusals` has the reasons."""
        known = {r.term for r in self.rows}
        return tuple(dict.fromkeys(r.term for r in self.refusals if r.engine and r.term and r.term not in known))

    def agreement(self, reference: str = "") -> str:
        """Return to how many digits engines agree: those in double precision together, each other one by itself."""
        lower = {r.engine: r for r in sorted(self.rows, key=lambda r: r.relative) if r.bits < DOUBLE_BITS}
        doubles = [name for name in self.engines if name not in lower and not (reference and name == self.reference)]
        agree = "agree" if len(doubles) > 1 else "agrees" if reference else f"agrees with the {self.reference}"
        parts = [f"{', '.join(doubles)} {agree} to {self.digits:.1f} digits{reference}"] if doubles else []
        parts += [f"{name} agrees to {named_precision(r.bits)} ({r.digits})" for name, r in lower.items()]
        return "; ".join(parts)

    @property
    def digits(self) -> float:
        """Decimal digits on which all terms agree, known defects apart, at most 16; zeros are no evidence.

        Of engines in double precision, where there are some.
        """
        evidence = [r for r in self.rows if not r.zero and not r.defect]
        errors = [r.relative for r in evidence if r.bits >= DOUBLE_BITS] or [r.relative for r in evidence]
        if not errors or any(math.isnan(e) for e in errors):
            return math.nan
        return -math.log10(max(*errors, 1e-16))

    def by_term(self) -> dict[str, dict[str, Row]]:
        """Return the rows by term and engine, terms in their order."""
        return by_term(self.rows)

    @property
    def headline(self) -> str:
        """The verdict in one sentence that stays short however much differs."""
        if self.nothing or self.passed or self.only_known_defects:
            return self.verdict
        # Rows are measured by the oracle: the engine that differs fails. Rollouts are measured by MuJoCo's own.
        rows = [r for r in self.rows if not r.passed]
        runs = [r for r in self.rollouts if r.passed is False]
        omissions = [o for o in self.omissions if o.fault]
        counts = (
            (rows, self.rows, "comparisons of terms"),
            (runs, [r for r in self.rollouts if r.judged], "rollouts"),
            (omissions, self.omissions, "omissions"),
        )
        parts = [f"{len(failed)} of {len(every)} {what}" for failed, every, what in counts if failed]
        engines = dict.fromkeys([*(r.engine for r in rows), *(r.off or r.engine for r in runs)])
        known = [r.engine for r in rows if r.defect]
        by_defect = f" ({len(known)} by a known defect of {', '.join(dict.fromkeys(known))})" if known else ""
        subject = f"{', '.join(engines)} differ{'s' * (len(engines) == 1)}: " if engines else ""
        return f"{subject}{', '.join(parts)}{by_defect}{missing_text(self.shortened)}"

    def _sentence(self) -> str:
        """Return the headline, with what was compared with what on how many states."""
        if self.nothing:
            return self.headline
        instead = self.reference in self.engines
        what = "which stands in for the oracle" if instead else "the own derivation evaluated with 34 digits"
        reference = f"{'' if instead else 'the '}{self.reference}, {what}"
        terms = len({r.term for r in self.rows})
        measured = f"{terms} term{'s' * (terms != 1)} at {self.rows[0].samples} states"
        if not self.passed:
            return f"{self.headline}; measured against {reference}, in {measured}"
        return f"{self.agreement(f' with {reference}')}, in {measured}{missing_text(self.shortened)}"

    def document(self, target: str = "", *, full: bool = True) -> doc.Document:
        """Return the document of the comparison; `target` is the name by which a person called the model.

        Without `full` a terminal shows what the page begins with: verdict, what the file has that no engine used,
        faults, and each engine's worst row.
        """
        target = target if target != self.model else ""
        facts = self.facts
        mass = facts.get("mass")
        samples = self.rows[0].samples if self.rows else self.samples
        size = f"nq {facts.get('nq', '?')}, nv {facts.get('nv', '?')}" + (
            f", {mass:.4g} kg" if mass is not None else ""
        )
        outcome = "agree" if self.passed else "not compared" if self.nothing else "differ"
        precision = self.precision
        steps = " or ".join(dict.fromkeys(time_text(r.dt) for r in self.rollouts if not r.informs))
        on: doc.On = "both" if full else "page"
        terms = dict.fromkeys(r.term for r in self.rows)
        return doc.Document(
            name=f"{self.model} ({target})" if target else self.model,
            heading=self.model,
            title=f"{self.model}: {outcome}",
            verdict=self.headline,
            sentence=self._sentence(),
            good=self.passed,
            summary=f"{size} · {samples} states (seed {self.seed}) · tolerance {self.tolerance:.0e}"
            f" · {self.seconds:.1f} s",
            opening=self._first_screen(full=full),
            sections=[
                doc.Section("The model", [doc.Facts(list(model_facts(facts, target, self.setup)))], on="page"),
                doc.Section("Terms: worst relative error, time per call", self._terms() if self.rows else [], on),
                doc.Section(_ROLLOUTS.format(steps), rollout_blocks(self.rollouts), on),
                *(curve_sections(precision, whole=False, on=on) if precision is not None else []),
                doc.Section(
                    "What a call leaves out, and the time that this saves; change is that of the accelerations",
                    omission_blocks(self.omissions),
                    on,
                ),
                doc.Section("Notes", self._notes(), on),
                doc.Section(
                    "What the terms are", [doc.Facts([(t, x) for t in terms if (x := MEANINGS.get(t))])], "page"
                ),
                doc.Section(
                    "How errors are measured",
                    [doc.Paragraph(_MEASURED[0]), doc.Items([doc.Bullet("", text) for text in _MEASURED[1]])],
                    on="page",
                ),
            ],
            result=self,
            basis=states_text(self.samples, self.seed),
        )

    def _first_screen(self, *, full: bool) -> list[doc.Block]:
        """Return what a reader needs to know before any table."""
        stiff = [x for x in self.findings if x.kind == STIFF]
        # Few stiff joints have a line of their own on the first screen.
        less = [] if full else stiff[MAX_NAMES:]
        beside = [doc.Bullet(x.kind, x.says, "!", "allowed") for x in self.findings if x not in less]
        if less:
            rest = ", ".join(name for x in less for name in x.joints)
            beside.append(doc.Bullet("stiff joints", f"{len(less)} more, less stiff: {rest}", "!", "allowed"))
        beside += [
            doc.Bullet(r.engine or f"no {r.term}", r.reason, "!", "allowed")
            for r in self.refusals
            if not r.engine or (not r.term and r.engine not in self.engines)
        ]
        notes = dict.fromkeys(r.note for r in self.rollouts if r.passed is None and not r.informs)
        beside += [doc.Bullet("rollouts", note, "!", "allowed") for note in notes]
        if self.precision is not None:
            failed = self.precision.failed
            beside += [doc.Bullet(f"no curve of {b.head}", b.text, "!", "allowed") for b in failed_curves(failed)]
        return [
            doc.Items(failures(self.rows, self.rollouts, self.omissions), most=MAX_LINES),
            doc.Items(beside, most=MAX_LINES),
            doc.Table(WORST, self._worst_rows()),
            *([] if full else [doc.Paragraph(doc.Span(_MORE, "muted"), on="terminal")]),
        ]

    def _worst_rows(self) -> list[Row]:
        """Return each engine's worst row; one that failed comes first."""
        rows = [[r for r in self.rows if r.engine == engine and r.reference != engine] for engine in self.engines]
        return [max(some, key=lambda r: (not r.passed, r.relative)) for some in rows if some]

    def _terms(self) -> list[doc.Block]:
        terms = self.by_term()
        short = [doc.Column("term", lambda rows: next(iter(rows.values())).term)]
        short += [engine_column(engine, self.reference) for engine in self.engines]
        entries = [(term, engine, rows.get(engine)) for term, rows in terms.items() for engine in self.engines]
        allowed = [r for r in self.rows if r.passed and r.reason]
        but = ", but where an engine's own formula cannot do better (marked !)" if allowed else ""
        return [
            doc.Table(short, [*terms.values()], on="terminal"),
            *self._soft(),
            doc.Paragraph(
                f"Every engine against the {self.reference}, the own derivation evaluated with 34 digits, at "
                f"{self.rows[0].samples} states; an error above {self.tolerance:g} fails{but}.",
                on="page",
            ),
            doc.Figure(
                lambda: figure.digits(self.rows, self.engines, self.reference, self.tolerance),
                "A marker is the worst state, crossed out where it fails; the thin bar's other end is the median. "
                "Double precision ends near 16 digits; “same” is the same number in every state.",
            ),
            doc.Figure(
                lambda: figure.term_costs(self.rows, self.engines, self.tolerance),
                "The same worst errors over the time of one call through mbkit: lower left is better. Errors below "
                "what double precision can tell stand at the bottom.",
                wide=True,
            ),
            doc.Table(TERM_COLUMNS, entries, on="page"),
            doc.Items([doc.Bullet(f"{r.term}, {r.engine}", r.reason, "!", "allowed") for r in allowed]),
            doc.Paragraph(
                "Times are medians of single calls through mbkit, interleaved between engines; ± is half the "
                "interquartile range. The joint named has the largest error on its own scale.",
                on="page",
                note=True,
            ),
        ]

    def _soft(self) -> list[doc.Block]:
        """Return a sentence on each engine with soft constraints."""
        out: list[doc.Block] = []
        for engine in self.softness:
            terms = [r.term for r in self.rows if r.engine == engine and r.reference == OWN_LAW]
            out.append(
                doc.Paragraph(
                    f"{', '.join(terms)} of {engine} are measured by its own law of soft constraints instead of the "
                    f"{self.reference}."
                )
            )
        return out

    def _notes(self) -> list[doc.Block]:
        notes = [doc.Bullet("", note) for note in self.facts.get("notes", ())]
        bodies = "; ".join(self.facts.get("nonphysical", ()))
        inconsistent = [doc.Bullet("bodies with inconsistent inertia", bodies)] if bodies else []
        return [doc.Items([*refusals(self.refusals), *notes, *inconsistent])]

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the digits of each engine and term with Matplotlib: the worst state, and the median behind it.

        What failed is crossed out. `ax` is where to draw; by default in a figure of its own.
        """
        with drawing():
            return figure.figure(self.rows, self.engines, self.reference, self.tolerance, ax=ax)

    _derived = ("passed", "verdict", "digits", "shortened")
    _csv_columns = columns_of(Row)


def states_text(samples: int, seed: int) -> Mapping[str, doc.Text]:
    """Return the states of a comparison, for the foot of a page."""
    return {"states": f"{samples} random ones, seed {seed}; beside them neutral, at-limit and near-singular ones"}
