"""The result of `work_precision`: curves of error against run time, and the document and figure that show them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

from mbkit._check import by_key
from mbkit.studies import document as doc
from mbkit.studies.formatting import count_text, error_text, missing_text, model_facts, setting_words, time_text
from mbkit.studies.measurement import Measurement
from mbkit.studies.results import Refusal, ResultTable, columns, counted
from mbkit.studies.study_runs import OUT_OF_TIME
from mbkit.studies.svg import PAGE, image, page_style, svg
from mbkit.studies.work_precision.curve import Curve, pareto_front
from mbkit.studies.work_precision.figure import MAX_USEFUL_ERROR, figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


#: An observed order farther than this from the method's own is flagged.
MAX_ORDER_ERROR: Final = 0.2
_ERROR_EXPONENTS: Final = range(-2, -15, -2)


class Lead(NamedTuple):
    """A run, the errors for which it is the fastest, and for each the fastest of another engine that reaches it."""

    curve: Curve
    point: Measurement
    errors: list[float]
    nexts: list[tuple[Curve, Measurement] | None]


def _range(errors: Sequence[float]) -> str:
    """Return the largest and the least of some errors."""
    return " to ".join(dict.fromkeys(f"{x:.0e}" for x in (errors[0], errors[-1])))


def next_engines(lead: Lead) -> str:
    """Return the engines that are next, which may change with the error, and how many times as long they take."""
    texts = []
    for engine, alike in by_key((x[0].engine if x else "", x) for x in lead.nexts).items():
        factors = [x[1].seconds / lead.point.seconds for x in alike if x]
        ends = dict.fromkeys(count_text(x) for x in (min(factors), max(factors))) if factors else ()
        texts.append(f"{engine} × {' to '.join(ends)}" if factors else "none")
    return ", ".join(texts)


class CurveLine(NamedTuple):
    """One engine and method in one line."""

    curve: Curve
    best: Measurement | None  # the fastest of those with the least error that the reference can resolve
    off: bool  # the observed order is not the method's own
    on_front: bool


@dataclass(frozen=True)
class WorkPrecision(ResultTable):
    """Error against run time for every engine and method of a study.

    `facts` has nq, nv, mass, digest, needs and notes of the model. `duration` is the horizon on which errors are
    measured, and `asked` the one of the arguments, s. `reference` says how the reference was computed, and why the
    horizon was cut if it was; `floor` is how well it is known, rad or m. The motion starts at `q0` and `v0`.
    `refusals` are engines and methods that failed, with the reason. `complete` is False after an interruption, and
    `seconds` is the time of the whole study.

    `settings` has `changed`, what the model was measured without or otherwise; seed, repeats, steps, tolerances,
    torque, the saved times, the executor, and how run times were measured: those of worker processes, which share the
    cores, cannot be compared with those of another study.
    """

    model: str
    facts: dict[str, Any]
    duration: float
    asked: float
    reference: str
    floor: float
    q0: tuple[float, ...]
    v0: tuple[float, ...]
    curves: tuple[Curve, ...]
    refusals: tuple[Refusal, ...]
    complete: bool
    versions: dict[str, str]
    processor: str
    seconds: float
    settings: dict[str, Any] = field(default_factory=dict)

    _csv_columns: ClassVar = {
        **columns(0, "engine", "method"),
        **columns(1, "setting", "value", "error", "energy", "seconds", "spread"),
        "first_run": lambda row: row[0].compile + row[1].seconds,
        **columns(1, "steps", "evaluations"),
        **columns(0, "order"),
        "expected_order": lambda row: row[0].expected,
        "front": itemgetter(2),
        **columns(1, "note"),
    }

    def rows(self) -> Iterator[tuple[Curve, Measurement]]:
        """Yield every point with its curve."""
        for curve in self.curves:
            for point in curve.points:
                yield curve, point

    @property
    def failed(self) -> tuple[Refusal, ...]:
        """Engines and methods that gave no error at all, with the reason."""
        empty = [c for c in self.curves if not any(math.isfinite(p.error) for p in c.points)]
        why = [next((p.note for p in c.points if p.note), c.ended or "no run came to an end") for c in empty]
        mute = [Refusal(c.engine, c.method, reason) for c, reason in zip(empty, why, strict=True)]
        return (
            *self.refusals,
            *(r for r in mute if (r.engine, r.term) not in {(x.engine, x.term) for x in self.refusals}),
        )

    @property
    def untimed(self) -> tuple[str, ...]:
        """Engines without a measured run because the time was used up, beside which no engine is the fastest."""
        lost = {r.engine for r in self.refusals if r.reason == OUT_OF_TIME}
        return tuple(sorted(lost - {c.engine for c, p in self.rows() if math.isfinite(p.error)}))

    @property
    def turns(self) -> tuple[str, ...]:
        """Of each curve that rounding bends back, the best step, below which errors grow again."""
        return tuple(
            f"{c.name}: best at dt = {p.value:.2g} s, with an error of {p.error:.1e}; smaller steps are worse"
            for c in self.curves
            if (p := c.turn)
        )

    @property
    def bounded(self) -> str:
        """The limit of work of each run, where it is less than a study's own; else empty."""
        work, whole = self.settings.get("work", math.inf), self.settings.get("whole_work", 0)
        return f"runs of up to {work:,.0f} evaluations alone" if work < whole else ""

    @property
    def shortened(self) -> tuple[str, ...]:
        """What was taken out of the model, curves that failed or ran out of time, and a horizon that was cut."""
        out = [*self.settings.get("changed", ()), *([] if self.complete else ["interrupted"])]
        if failed := self.failed:
            names = list(dict.fromkeys(r.name for r in failed))
            out.append(f"{counted(len(names), 'curve')} left out: {', '.join(names)}")
        out += [self.bounded] if self.bounded else []
        ended = [f"{c.engine} {c.method}" for c in self.curves if c.ended]
        if ended:
            out.append(f"{counted(len(ended), 'curve')} ended by time: {', '.join(ended)}")
        none = {(r.engine, r.term) for r in self.failed}
        lost = sum(math.isnan(p.seconds) for c, p in self.rows() if (c.engine, c.method) not in none)
        if lost:
            out.append(f"{counted(lost, 'setting')} not run")
        if self.duration < self.asked * (1 - 1e-9):
            out.append(f"horizon cut from {self.asked:g} s to {self.duration:g} s")
        return tuple(out)

    @property
    def front(self) -> tuple[tuple[Curve, Measurement], ...]:
        """The Pareto front, points that none beats in both error and run time, fastest first."""
        known = [(c, p) for c, p in self.rows() if math.isfinite(p.error) and math.isfinite(p.seconds)]
        return tuple(pareto_front(known, lambda item: (item[1].seconds, item[1].error), self.floor))

    def fastest(self, error: float) -> tuple[Curve, Measurement] | None:
        """Return the curve and point that reach this error in the least time, None if no point does."""
        reached = [(c, p) for c, p in self.rows() if p.error <= error]
        return min(reached, key=lambda item: item[1].seconds, default=None)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain data, with the front and the first-run times."""
        failed = [{"engine": r.engine, "method": r.term, "reason": r.reason} for r in self.failed]
        out = super().to_dict() | {"shortened": list(self.shortened), "failed": failed}
        for data, curve in zip(out["curves"], self.curves, strict=True):
            for p, point in zip(data["points"], curve.points, strict=True):
                p["first_run"] = curve.compile + point.seconds
        out["front"] = [
            {"engine": c.engine, "method": c.method, p.setting: p.value, "error": p.error, "seconds": p.seconds}
            for c, p in self.front
        ]
        return out

    def _csv_rows(self) -> Iterator[tuple[Curve, Measurement, bool]]:
        front = {(id(c), id(p)) for c, p in self.front}
        return ((c, p, (id(c), id(p)) in front) for c, p in self.rows())

    @property
    def headline(self) -> str:
        """The fastest curve for each error, in one sentence."""
        return self._fastest() + "".join(f"; {x}" for x in self.shortened if x != "interrupted")

    def _sentence(self) -> str:
        """Return the headline with what the errors are measured against; long lists stand below it."""
        known = f"known to {error_text(self.floor)} rad or m" if math.isfinite(self.floor) else "of unknown error"
        measured = f"errors of q over {self.duration:g} s, against a reference {known}"
        return f"{self._fastest()}; {measured}{missing_text(x for x in self.shortened if x != 'interrupted')}"

    def _fastest(self) -> str:
        stopped = "" if self.complete else "interrupted; what was finished: "
        groups = itertools.groupby(leads(self), key=lambda lead: lead.curve.name)
        parts = [f"{name} for an error of {_range([e for lead in some for e in lead.errors])}" for name, some in groups]
        if not parts:
            return f"{stopped}no run has an error of at most {10.0 ** _ERROR_EXPONENTS[0]:g} rad or m"
        count = f"{len(self.curves)} curve{'s' * (len(self.curves) != 1)}"
        if self.untimed:
            stopped += f"no time was left for {' and '.join(self.untimed)}, so none is the fastest; "
            return f"{stopped}of {count}, least time: {', '.join(parts)}"
        return f"{stopped}fastest of {count}: {', '.join(parts)}"

    def document(self, target: str = "") -> doc.Document:
        """Return the document of the study; `target` is the name by which a person called the model."""
        target = target if target != self.model else ""
        facts = self.facts
        count = sum(len(c.points) for c in self.curves)
        notes = [doc.Bullet("", note) for note in facts.get("notes", ())]
        return doc.Document(
            name=f"{self.model} ({target})" if target else self.model,
            heading=f"{self.model}: error against run time",
            verdict=self.headline,
            sentence=self._sentence(),
            good=bool(self.complete and self.front),
            marked=False,
            summary=f"nq {facts.get('nq', '?')}, nv {facts.get('nv', '?')} · {count} settings · {self.seconds:.1f} s",
            sections=[
                *curve_sections(self, whole=True),
                doc.Section(
                    "The model", [doc.Facts(list(model_facts(facts, target, {}))), doc.Items(notes)], on="page"
                ),
            ],
            result=self,
            basis={name: setting_words(value) for name, value in self.settings.items()},
        )

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw error and energy drift against run time with Matplotlib, and a panel for each method.

        With `ax` the error alone is drawn there.
        """
        return figure(self.curves, self.duration, self.floor, only=ax)

    def __repr__(self) -> str:
        count = sum(len(c.points) for c in self.curves)
        missing = "".join(f"; {x}" for x in self.shortened)
        curves = counted(len(self.curves), "curve")
        return f"<WorkPrecision of {self.model!r}: {curves}, {count} points, {self.duration:g} s{missing}>"


def leads(result: WorkPrecision) -> list[Lead]:
    """Return the fastest run for each error that anyone reaches, as far as the reference can tell, each run once."""
    out: dict[int, Lead] = {}
    for error in (10.0**exponent for exponent in _ERROR_EXPONENTS):
        first = result.fastest(error)
        if first is None or error < result.floor:
            break
        beside = [(c, p) for c, p in result.rows() if p.error <= error and c.engine != first[0].engine]
        lead = out.setdefault(id(first[1]), Lead(*first, [], []))
        lead.errors.append(error)
        lead.nexts.append(min(beside, key=lambda item: item[1].seconds, default=None))
    return list(out.values())


def curve_lines(result: WorkPrecision) -> list[CurveLine]:
    """Return every curve in one line, in the order of the curves."""
    front = {id(c) for c, p in result.front if p.error <= MAX_USEFUL_ERROR}
    floor = result.floor if math.isfinite(result.floor) else 0.0
    out = []
    for curve in result.curves:
        known = [p for p in curve.points if math.isfinite(p.error)]
        best = min(known, key=lambda p: (max(p.error, floor), p.seconds), default=None)
        out.append(CurveLine(curve, best, abs(curve.order - curve.expected) > MAX_ORDER_ERROR, id(curve) in front))
    return out


def front_names(result: WorkPrecision) -> list[str]:
    """Return the names of the curves on the front, the fastest first; no answers are left out."""
    return list(dict.fromkeys(c.name for c, p in result.front if p.error <= MAX_USEFUL_ERROR))


def error_against_time(result: WorkPrecision) -> str:
    """Draw the figure of error against run time, for the page."""
    with page_style("precision"):
        return svg(
            figure(result.curves, result.duration, result.floor, PAGE), "Error against run time, by engine and method"
        )


def picture(result: WorkPrecision) -> bytes:
    """Return the same figure as PNG on white."""
    return image(figure(result.curves, result.duration, result.floor))


def failed_curves(failed: Sequence[Refusal]) -> list[doc.Bullet]:
    """Return the methods that gave no curve, those of one reason together."""
    of = by_key((r.reason, r.name) for r in failed)
    return [doc.Bullet(", ".join(dict.fromkeys(names)), reason) for reason, names in of.items()]


def curve_sections(result: WorkPrecision, whole: bool, on: doc.On = "both") -> list[doc.Section]:
    """Return the sections of a study, shown on `on`; unless `whole`, a terminal shows the fastest only."""
    missing = missing_text(result.shortened).removeprefix("; ") if not whole else ""
    cut = f", cut from {result.asked:g} s where the reference stops holding" if result.duration < result.asked else ""
    of = "rad or m (a smaller error of a run cannot be told)"
    known = (
        f"its own error is at most {error_text(result.floor)} {of}"
        if math.isfinite(result.floor)
        else "its own error is unknown"
    )
    front = "Lower left is better. On the front, fastest first: {}. Names beside the grey band are the methods that "
    front += (
        "join it there, in their engine’s colour. Run times are without deriving and compiling, first runs with both."
    )
    drawn = doc.Figure(lambda: error_against_time(result), front.format(", ".join(front_names(result))), wide=True)
    fastest = leads(result)
    about = f"Error against run time, {result.duration:g} s of motion: errors of q in rad or m"
    start = [(n, f"{n} = [{setting_words(getattr(result, n))}]") for n in ("q0", "v0")]
    lists: doc.On = on if whole else "page"
    return [
        doc.Section(
            about,
            [
                *([doc.Paragraph(doc.Span(f"! {missing}", "allowed"))] if missing else []),
                doc.Paragraph(
                    f"Errors are the largest difference of q on the manifold over the saved times{cut}.", "page"
                ),
                doc.Paragraph(f"Reference: {result.reference}; {known}."),
                *([drawn] if result.front else []),
            ],
            on,
        ),
        doc.Section(
            "Who reaches an error first",
            [doc.Table(_LEADS, fastest) if fastest else doc.Paragraph(doc.Span("no run reached 1e-02", "muted"))],
            on,
            level=3,
        ),
        doc.Section(
            "Engine by engine, method by method; the run time is that of the least error",
            _curve_blocks(result),
            lists,
            level=3,
        ),
        doc.Section("What could not be measured", [doc.Items(failed_curves(result.failed))], on, level=3),
        doc.Section("Where rounding grows", [doc.Items([doc.Bullet("", x) for x in result.turns])], on, level=3),
        doc.Section("", [doc.Details("the motion", [doc.Facts(start)])], on="page", level=3),
    ]


def setting_text(point: Measurement) -> str:
    """Return the step with its unit, or the tolerance."""
    return f"dt {time_text(point.value)}" if point.setting == "dt" else f"rtol {point.value:.0e}"


def _known(x: float) -> str:
    return "" if math.isnan(x) else error_text(x)


_LEADS: Final = (
    doc.Column("error ≤", lambda x: _range(x.errors), right=True),
    doc.Column("engine", lambda x: x.curve.engine),
    doc.Column("method", lambda x: x.curve.method),
    doc.Column("setting", lambda x: setting_text(x.point), right=True),
    doc.Column("run time", lambda x: time_text(x.point.seconds), right=True),
    doc.Column("±", lambda x: doc.Span(time_text(x.point.spread), "muted"), right=True, on="page"),
    doc.Column("first run", lambda x: time_text(x.curve.compile + x.point.seconds) or "–", right=True),
    doc.Column("next engine", lambda x: doc.Span(next_engines(x), "muted")),
    doc.Column("its method", lambda x: ", ".join(dict.fromkeys(n[0].method for n in x.nexts if n)), on="page"),
)


def _order(line: CurveLine) -> doc.Text:
    order = "" if math.isnan(line.curve.order) else f"{line.curve.order:.2f}"
    return doc.Span(f"! {order}", "allowed") if line.off else order


_CURVES: Final = (
    doc.Column("", lambda x: doc.Span("●" if x.on_front else "", "good")),
    doc.Column("engine", lambda x: x.curve.engine),
    doc.Column("method", lambda x: x.curve.method),
    doc.Column("order", _order, right=True),
    doc.Column("of", lambda x: "" if math.isnan(x.curve.expected) else f"{x.curve.expected:g}", right=True),
    doc.Column("from\npoints", lambda x: doc.Span(str(x.curve.order_points or ""), "muted"), right=True, on="page"),
    doc.Column("least error", lambda x: error_text(x.best.error) if x.best else "none", right=True),
    doc.Column("at", lambda x: setting_text(x.best) if x.best else "", right=True, on="page"),
    doc.Column("run time", lambda x: time_text(x.best.seconds) if x.best else "", right=True),
    doc.Column("±", lambda x: doc.Span(time_text(x.best.spread) if x.best else "", "muted"), right=True, on="page"),
    doc.Column("energy\ndrift", lambda x: _known(x.best.energy) if x.best else "", right=True, on="page"),
    doc.Column("compile", lambda x: time_text(x.curve.compile) or "–", right=True),
    doc.Column(
        "first run",
        lambda x: (time_text(x.curve.compile + x.best.seconds) or "–") if x.best else "",
        right=True,
        on="page",
    ),
    doc.Column("note", lambda x: doc.Span(_why_none(x), "muted"), on="page"),
)


def _why_none(line: CurveLine) -> str:
    """Return why a curve has no error at all."""
    return "" if line.best else next((p.note for p in line.curve.points if p.note), "no run came to an end")


_POINTS: Final = (
    doc.Column("engine", lambda x: x[0].engine),
    doc.Column("method", lambda x: x[0].method),
    doc.Column("setting", lambda x: setting_text(x[1]), right=True),
    doc.Column("error of q,\nrad or m", lambda x: _known(x[1].error) or "–", right=True),
    doc.Column("energy\ndrift", lambda x: _known(x[1].energy), right=True),
    doc.Column("run time", lambda x: time_text(x[1].seconds), right=True),
    doc.Column("±", lambda x: doc.Span(time_text(x[1].spread), "muted"), right=True),
    doc.Column("first run", lambda x: time_text(x[0].compile + x[1].seconds), right=True),
    doc.Column("steps", lambda x: str(x[1].steps or ""), right=True),
    doc.Column("evaluations", lambda x: str(x[1].evaluations or ""), right=True),
    doc.Column("note", lambda x: doc.Span(x[1].note, "muted")),
)


def _curve_blocks(result: WorkPrecision) -> list[doc.Block]:
    lines = curve_lines(result)
    if not lines:
        return []
    counts = [p.repeats for _, p in result.rows() if p.repeats]
    repeats = " to ".join(dict.fromkeys(str(x) for x in (min(counts, default=0), max(counts, default=0))))
    work, timing = result.settings.get("work"), result.settings.get("timing")
    most = f" ({work:.0f} evaluations of the dynamics; one that is called from Python counts eight)" if work else ""
    legend = [doc.Bullet("", "on the front: nothing beats it in both error and run time", "●", "good")]
    if any(line.off for line in lines):
        off = f"the observed order is not the method's own: it is more than {MAX_ORDER_ERROR} off"
        legend.append(doc.Bullet("", off, "!", "allowed"))
    return [
        doc.Table(_CURVES, lines),
        doc.Items(legend),
        doc.Paragraph(
            "The order is the slope of log error over log step, where neither coarse steps nor rounding hide it. A "
            f"curve ends where finer settings bring nothing, or a run would take too much work{most}. Run times are "
            f"medians of {repeats} timings{f', {timing}' if timing else ''}, the longest runs timed least; ± is half "
            "the interquartile range. Compiling is timed from nothing, whatever the caches hold.",
            on="page",
            note=True,
        ),
        doc.Details("every setting", [doc.Table(_POINTS, list(result.rows()))]),
    ]
