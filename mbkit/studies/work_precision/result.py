"""The result of `work_precision`: curves of error against run time, and the document and figure that show them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

from mbkit._check import by_key
from mbkit.studies import document as doc
from mbkit.studies.formatting import count_text, error_text, missing_text, model_facts, setting_words, time_text
from mbkit.studies.measurement import Measurement
from mbkit.studies.results import Refusal, ResultTable, columns, counted
from mbkit.studies.study_runs import OUT_OF_TIME
from mbkit.studies.svg import PAGE, image, page_style, svg
from mbkit.studies.work_precision.figure import MAX_USEFUL_ERROR, figure
from mbkit.studies.work_precision.sweep import Curve, pareto_front

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

    @property
    def next_engines(self) -> str:
        """The engines that are next, which may change with the error, and how many times as long they take."""
        texts = []
        for engine, alike in by_key((x[0].engine if x else "", x) for x in self.nexts).items():
            factors = [x[1].seconds / self.point.seconds for x in alike if x]
            ends = dict.fromkeys(count_text(x) for x in (min(factors), max(factors))) if factors else ()
            texts.append(f"{engine} × {' to '.join(ends)}" if factors else "none")
        return ", ".join(texts)


class CurveLine(NamedTuple):
    """One curve: the fastest point of the least error that the reference can resolve, and marks."""

    curve: Curve
    point: Measurement | None
    off: bool  # the observed order is not the method's own
    on_front: bool


def _range(errors: Sequence[float]) -> str:
    """Return the largest and the least of some errors."""
    return " to ".join(dict.fromkeys(f"{x:.0e}" for x in (errors[0], errors[-1])))


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
        refused = {(r.engine, r.term) for r in self.refusals}
        mute = [line.curve for line in curve_lines(self) if line.point is None]
        rest = (Refusal(c.engine, c.method, _why_none(c)) for c in mute if (c.engine, c.method) not in refused)
        return (*self.refusals, *rest)

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
        failed = {(r.engine, r.term): r.name for r in self.failed}
        ended = [f"{c.engine} {c.method}" for c in self.curves if c.ended]
        lost = sum(math.isnan(p.seconds) for c, p in self.rows() if (c.engine, c.method) not in failed)
        cut = self.duration < self.asked * (1 - 1e-9)
        names = list(dict.fromkeys(failed.values()))
        out = [
            *self.settings.get("changed", ()),
            "" if self.complete else "interrupted",
            f"{counted(len(names), 'curve')} left out: {', '.join(names)}" if names else "",
            self.bounded,
            f"{counted(len(ended), 'curve')} ended by time: {', '.join(ended)}" if ended else "",
            f"{counted(lost, 'setting')} not run" if lost else "",
            f"horizon cut from {self.asked:g} s to {self.duration:g} s" if cut else "",
        ]
        return tuple(filter(None, out))

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
        what, count = "fastest of {}", counted(len(self.curves), "curve")
        if self.untimed:
            stopped += f"no time was left for {' and '.join(self.untimed)}, so none is the fastest; "
            what = "of {}, least time"
        return f"{stopped}{what.format(count)}: {', '.join(parts)}"

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


def _why_none(curve: Curve) -> str:
    return next((p.note for p in curve.points if p.note), curve.ended or "no run came to an end")


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
    known = "its own error is unknown"
    if math.isfinite(result.floor):
        floor = error_text(result.floor)
        known = f"its own error is at most {floor} rad or m (a smaller error of a run cannot be told)"
    front = (
        f"Lower left is better. On the front, fastest first: {', '.join(front_names(result))}. Names at the lower left "
        "are the methods of the front, in their engine’s colour. Run times are without deriving and compiling, first "
        "runs with both."
    )
    fastest, lines = leads(result), curve_lines(result)
    start = [(n, f"{n} = [{setting_words(getattr(result, n))}]") for n in ("q0", "v0")]
    about: list[doc.Block] = [
        *([doc.Paragraph(doc.Span(f"! {missing}", "allowed"))] if missing else []),
        doc.Paragraph(f"Errors are the largest difference of q on the manifold over the saved times{cut}.", "page"),
        doc.Paragraph(f"Reference: {result.reference}; {known}."),
        *([doc.Figure(lambda: error_against_time(result), front, wide=True)] if result.front else []),
    ]
    none = doc.Paragraph(doc.Span("no run reached 1e-02", "muted"))
    sections: list[tuple[str, list[doc.Block], doc.On]] = [
        ("Who reaches an error first", [doc.Table(_LEADS, fastest) if fastest else none], on),
        (
            "Engine by engine, method by method; the run time is that of the least error",
            _curve_blocks(result, lines) if lines else [],
            on if whole else "page",
        ),
        ("What could not be measured", [doc.Items(failed_curves(result.failed))], on),
        ("Where rounding grows", [doc.Items([doc.Bullet("", x) for x in result.turns])], on),
        ("", [doc.Details("the motion", [doc.Facts(start)])], "page"),
    ]
    title = f"Error against run time, {result.duration:g} s of motion: errors of q in rad or m"
    return [doc.Section(title, about, on), *(doc.Section(*section, level=3) for section in sections)]


def _curve_blocks(result: WorkPrecision, lines: Sequence[CurveLine]) -> list[doc.Block]:
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
        doc.Details("every setting", [doc.Table(_POINTS, [CurveLine(c, p, False, False) for c, p in result.rows()])]),
    ]


# Columns of rows that have a curve and a point, which may be None.


def setting_text(point: Measurement) -> str:
    """Return the step with its unit, or the tolerance."""
    return f"dt {time_text(point.value)}" if point.setting == "dt" else f"rtol {point.value:.0e}"


def _column(head: str, text: Callable[[Measurement], str], *, muted: bool = False, **more: Any) -> doc.Column:
    """Return a column of points, empty where there is none."""

    def cell(row: Any) -> doc.Text:
        shown = "" if row.point is None else text(row.point)
        return doc.Span(shown, "muted") if muted else shown

    return doc.Column(head, cell, right=True, **more)


def _number(x: float) -> str:
    return "" if math.isnan(x) else error_text(x)


def _first_run(row: Any) -> str:
    return "" if row.point is None else time_text(row.curve.compile + row.point.seconds) or "–"


def _order(line: CurveLine) -> doc.Text:
    order = "" if math.isnan(line.curve.order) else f"{line.curve.order:.2f}"
    return doc.Span(f"! {order}", "allowed") if line.off else order


_NAME: Final = (doc.Column("engine", lambda x: x.curve.engine), doc.Column("method", lambda x: x.curve.method))
_SETTING: Final = _column("setting", setting_text)
_TIMES: Final = (
    _column("run time", lambda p: time_text(p.seconds)),
    _column("±", lambda p: time_text(p.spread), muted=True, on="page"),
)
_ENERGY: Final = _column("energy\ndrift", lambda p: _number(p.energy), on="page")
_FIRST_RUN: Final = doc.Column("first run", _first_run, right=True)
_LEADS: Final = (
    doc.Column("error ≤", lambda x: _range(x.errors), right=True),
    *(*_NAME, _SETTING, *_TIMES, _FIRST_RUN),
    doc.Column("next engine", lambda x: doc.Span(x.next_engines, "muted")),
    doc.Column("its method", lambda x: ", ".join(dict.fromkeys(n[0].method for n in x.nexts if n)), on="page"),
)
_CURVES: Final = (
    doc.Column("", lambda x: doc.Span("●" if x.on_front else "", "good")),
    *_NAME,
    doc.Column("order", _order, right=True),
    doc.Column("of", lambda x: "" if math.isnan(x.curve.expected) else f"{x.curve.expected:g}", right=True),
    doc.Column("from\npoints", lambda x: doc.Span(str(x.curve.order_points or ""), "muted"), right=True, on="page"),
    doc.Column("least error", lambda x: error_text(x.point.error) if x.point else "none", right=True),
    *(replace(_SETTING, head="at", on="page"), *_TIMES, _ENERGY),
    doc.Column("compile", lambda x: time_text(x.curve.compile) or "–", right=True),
    replace(_FIRST_RUN, on="page"),
    doc.Column("note", lambda x: doc.Span("" if x.point else _why_none(x.curve), "muted"), on="page"),
)
_POINTS: Final = (
    *(*_NAME, _SETTING),
    _column("error of q,\nrad or m", lambda p: _number(p.error) or "–"),
    *(_ENERGY, *_TIMES, _FIRST_RUN),
    _column("steps", lambda p: str(p.steps or "")),
    _column("evaluations", lambda p: str(p.evaluations or "")),
    doc.Column("note", lambda x: doc.Span(x.point.note, "muted")),
)
