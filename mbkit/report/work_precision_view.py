"""Error against run time as a document: the fastest for each error, then curve by curve."""

from __future__ import annotations

import io
import itertools
import math
from dataclasses import dataclass
from typing import Final

from mbkit.report.document import (
    Block,
    Bullet,
    Column,
    Details,
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
from mbkit.report.figures import PAGE, page_style, svg
from mbkit.report.formatting import choice, count_text, error_text, model_facts, refusals, time_text
from mbkit.studies.work_precision.curve import Curve, PrecisionPoint
from mbkit.studies.work_precision.figure import USEFUL, figure
from mbkit.studies.work_precision.result import WorkPrecision

#: An observed order farther than this from the method's own is flagged.
ORDER_TOLERANCE: Final = 0.2
_EXPONENTS: Final = range(-2, -15, -2)
_DOTS_PER_INCH: Final = 160


@dataclass(frozen=True)
class Level:
    """The fastest run that reaches an error, and the fastest of another engine that does (`next`)."""

    error: float
    curve: Curve
    point: PrecisionPoint
    next: tuple[Curve, PrecisionPoint] | None

    @property
    def factor(self) -> float:
        """How many times as long the next engine takes; NaN where none reaches the error."""
        return self.next[1].seconds / self.point.seconds if self.next else math.nan

    @property
    def next_engine(self) -> str:
        """The engine of `next`; empty where there is none."""
        return self.next[0].engine if self.next else ""


@dataclass(frozen=True)
class Lead:
    """One run, and all the errors for which it is the fastest: from the largest to the least."""

    levels: tuple[Level, ...]

    @property
    def curve(self) -> Curve:
        """Engine and method."""
        return self.levels[0].curve

    @property
    def point(self) -> PrecisionPoint:
        """The run."""
        return self.levels[0].point

    @property
    def errors(self) -> str:
        """The errors, as a range where there are several."""
        first, last = f"{self.levels[0].error:.0e}", f"{self.levels[-1].error:.0e}"
        return first if len(self.levels) == 1 else f"{first} to {last}"

    @property
    def nexts(self) -> list[tuple[str, str, str]]:
        """Engine, methods and times as long of the fastest of other engines, which may change with the error."""
        out = []
        for engine, group in itertools.groupby(self.levels, key=lambda x: x.next_engine):
            some = list(group)
            methods = ", ".join(dict.fromkeys(x.next[0].method for x in some if x.next))
            factors = dict.fromkeys(count_text(x.factor) for x in (some[0], some[-1]))
            out.append((engine or "none", methods, " to ".join(factors)))
        return out


@dataclass(frozen=True)
class CurveLine:
    """One engine and method in one line."""

    curve: Curve
    best: PrecisionPoint | None  # the fastest of those with the least error that the reference can resolve
    off: bool  # the observed order is not the method's own
    on_front: bool


def levels(result: WorkPrecision) -> list[Level]:
    """Return the fastest for each error that anyone reaches, as far as the reference can tell."""
    out = []
    for exponent in _EXPONENTS:
        error = 10.0**exponent
        first = result.fastest(error)
        if first is None or error < result.floor:
            break
        out.append(Level(error, *first, _fastest_beside(first[0].engine, result, error)))
    return out


def leads(result: WorkPrecision) -> list[Lead]:
    """Return the fastest runs, each once, with the errors for which it is the fastest."""
    return [Lead(tuple(group)) for _, group in itertools.groupby(levels(result), key=lambda level: id(level.point))]


def _fastest_beside(engine: str, result: WorkPrecision, error: float) -> tuple[Curve, PrecisionPoint] | None:
    reached = [(c, p) for c, p in result.rows() if p.error <= error and c.engine != engine]
    return min(reached, key=lambda item: item[1].seconds, default=None)


def curve_lines(result: WorkPrecision) -> list[CurveLine]:
    """Return every curve in one line, in the order of the curves."""
    front = {id(c) for c, p in result.front if p.error <= USEFUL}
    floor = result.floor if math.isfinite(result.floor) else 0.0
    out = []
    for curve in result.curves:
        ended = [p for p in curve.points if math.isfinite(p.error)]
        best = min(ended, key=lambda p: (max(p.error, floor), p.seconds), default=None)
        off = abs(curve.order - curve.expected) > ORDER_TOLERANCE
        out.append(CurveLine(curve, best, off, id(curve) in front))
    return out


def _name(curve: Curve) -> str:
    """Return engine and method; MuJoCo's own integrators have the engine in their names."""
    return curve.method if curve.method.startswith(f"{curve.engine}_") else f"{curve.engine} {curve.method}"


def front_names(result: WorkPrecision) -> list[str]:
    """Return the names of the curves on the front, the fastest first; no answers are left out."""
    return list(dict.fromkeys(_name(c) for c, p in result.front if p.error <= USEFUL))


def headline(result: WorkPrecision) -> str:
    """Return the fastest curve for each error, in one sentence."""
    stopped = "" if result.complete else "interrupted; what was finished: "
    missing = "".join(f"; {x}" for x in result.shortened if x != "interrupted")
    found = levels(result)
    if not found:
        return f"{stopped}no run has an error of at most {10.0 ** _EXPONENTS[0]:g} rad or m{missing}"
    parts = []
    for name, group in itertools.groupby(found, key=lambda level: _name(level.curve)):
        first, *rest = [f"{level.error:.0e}" for level in group]
        parts.append(f"{name} for an error of {first}" + (f" to {rest[-1]}" if rest else ""))
    count = f"{len(result.curves)} curve{'s' * (len(result.curves) != 1)}"
    return f"{stopped}fastest of {count}: {', '.join(parts)}{missing}"


def error_against_time(result: WorkPrecision) -> str:
    """Draw the figure of error against run time, for the page."""
    with page_style("precision"):
        return svg(
            figure(result.curves, result.duration, result.floor, PAGE), "Error against run time, by engine and method"
        )


def picture(result: WorkPrecision) -> bytes:
    """Return the same figure as PNG on white."""
    stream = io.BytesIO()
    fig = figure(result.curves, result.duration, result.floor)
    fig.savefig(stream, format="png", dpi=_DOTS_PER_INCH, facecolor="white", metadata={"Software": "mbkit"})
    return stream.getvalue()


# The document.


def view(result: WorkPrecision, target: str = "") -> Document:
    """Return the document of a study; `target` is the name by which a person called the model."""
    target = target if target != result.model else ""
    facts = result.facts
    count = sum(len(c.points) for c in result.curves)
    notes = [Bullet("", note) for note in facts.get("notes", ())]
    return Document(
        name=f"{result.model} ({target})" if target else result.model,
        heading=f"{result.model}: error against run time",
        title=f"{result.model}: error against run time",
        verdict=headline(result),
        good=bool(result.complete and result.front),
        marked=False,
        summary=f"nq {facts.get('nq', '?')}, nv {facts.get('nv', '?')} · {count} settings · {result.seconds:.1f} s",
        sections=[
            *sections(result, whole=True),
            Section(
                "The model",
                [Facts(list(model_facts(facts, target, {}))), Items(notes)],
                on="page",
            ),
        ],
        result=result,
        basis={name: choice(value) for name, value in result.settings.items()},
    )


def sections(result: WorkPrecision, whole: bool) -> list[Section]:
    """Return the sections of a study; unless `whole`, a terminal shows the fastest only."""
    missing = [Paragraph(Span(f"! {'; '.join(result.shortened)}", "allowed"))] if result.shortened else []
    cut = f", cut from {result.asked:g} s where the reference stops holding" if result.duration < result.asked else ""
    known = f"known to {error_text(result.floor)}" if math.isfinite(result.floor) else "known to an unknown error"
    front = "Lower left is better. On the front, fastest first: {}. Names beside the grey band are the methods that "
    front += (
        "join it there, in their engine’s colour. Run times are without deriving and compiling, first runs with both."
    )
    drawn = Figure(lambda: error_against_time(result), front.format(", ".join(front_names(result))), wide=True)
    fastest = leads(result)
    about = f"Error against run time, {result.duration:g} s of motion: errors of q in rad or m"
    unable = refusals(result.refusals)
    return [
        Section(
            about,
            [
                *missing,
                Paragraph(f"Errors are the largest difference of q on the manifold over the saved times{cut}.", "page"),
                Paragraph(f"Reference: {result.reference}; {known}."),
                *([drawn] if result.front else []),
            ],
        ),
        Section(
            "Who reaches an error first",
            [Table(_LEADS, fastest) if fastest else Paragraph(Span("no run reached 1e-02", "muted"))],
            level=3,
        ),
        Section(
            "Engine by engine, method by method; the run time is that of the least error",
            _curves(result),
            on="both" if whole else "page",
            level=3,
        ),
        Section(
            "What could not be measured",
            [Items(unable)],
            on="both" if whole else "page",
            level=3,
        ),
        Section(
            "",
            [Details("the motion", [Facts([(n, f"{n} = [{choice(getattr(result, n))}]") for n in ("q0", "v0")])])],
            on="page",
            level=3,
        ),
    ]


def setting_text(point: PrecisionPoint) -> str:
    """Return the step with its unit, or the tolerance."""
    return f"dt {time_text(point.value)}" if point.setting == "dt" else f"rtol {point.value:.0e}"


def _known(x: float) -> str:
    return "" if math.isnan(x) else error_text(x)


_LEADS: Final = (
    Column("error ≤", lambda x: x.errors, right=True),
    Column("engine", lambda x: x.curve.engine),
    Column("method", lambda x: x.curve.method),
    Column("setting", lambda x: setting_text(x.point), right=True),
    Column("run time", lambda x: time_text(x.point.seconds), right=True),
    Column("±", lambda x: Span(time_text(x.point.spread), "muted"), right=True, on="page"),
    Column("first run", lambda x: time_text(x.curve.compile + x.point.seconds) or "–", right=True),
    Column("next engine", lambda x: Span(_next(x), "muted")),
    Column("its method", lambda x: ", ".join(methods for _, methods, _ in x.nexts), on="page"),
)


def _next(lead: Lead) -> str:
    return ", ".join(f"{engine} × {factor}" if factor else engine for engine, _, factor in lead.nexts)


def _order(line: CurveLine) -> Text:
    order = "" if math.isnan(line.curve.order) else f"{line.curve.order:.2f}"
    return Span(f"! {order}", "allowed") if line.off else order


_CURVES: Final = (
    Column("", lambda x: Span("●" if x.on_front else "", "good")),
    Column("engine", lambda x: x.curve.engine),
    Column("method", lambda x: x.curve.method),
    Column("order", _order, right=True),
    Column("of", lambda x: "" if math.isnan(x.curve.expected) else f"{x.curve.expected:g}", right=True),
    Column("from\npoints", lambda x: Span(str(x.curve.order_points or ""), "muted"), right=True, on="page"),
    Column("least error", lambda x: error_text(x.best.error) if x.best else "none", right=True),
    Column("at", lambda x: setting_text(x.best) if x.best else "", right=True, on="page"),
    Column("run time", lambda x: time_text(x.best.seconds) if x.best else "", right=True),
    Column("±", lambda x: Span(time_text(x.best.spread) if x.best else "", "muted"), right=True, on="page"),
    Column("energy\ndrift", lambda x: _known(x.best.energy) if x.best else "", right=True, on="page"),
    Column("compile", lambda x: time_text(x.curve.compile) or "–", right=True),
    Column(
        "first run",
        lambda x: (time_text(x.curve.compile + x.best.seconds) or "–") if x.best else "",
        right=True,
        on="page",
    ),
    Column("note", lambda x: Span(_why_none(x), "muted"), on="page"),
)


def _why_none(line: CurveLine) -> str:
    """Return why a curve has no error at all."""
    if line.best:
        return ""
    return next((p.note for p in line.curve.points if p.note), "no run came to an end")


_POINTS: Final = (
    Column("engine", lambda x: x[0].engine),
    Column("method", lambda x: x[0].method),
    Column("setting", lambda x: setting_text(x[1]), right=True),
    Column("error of q,\nrad or m", lambda x: _known(x[1].error) or "–", right=True),
    Column("energy\ndrift", lambda x: _known(x[1].energy), right=True),
    Column("run time", lambda x: time_text(x[1].seconds), right=True),
    Column("±", lambda x: Span(time_text(x[1].spread), "muted"), right=True),
    Column("first run", lambda x: time_text(x[0].compile + x[1].seconds), right=True),
    Column("steps", lambda x: str(x[1].steps or ""), right=True),
    Column("evaluations", lambda x: str(x[1].evaluations or ""), right=True),
    Column("note", lambda x: Span(x[1].note, "muted")),
)


def _curves(result: WorkPrecision) -> list[Block]:
    lines = curve_lines(result)
    if not lines:
        return []
    work, timing = result.settings.get("work"), result.settings.get("timing")
    most = f" ({work:.0f} evaluations of the dynamics; one that is called from Python counts eight)" if work else ""
    legend = [Bullet("", "on the front: nothing beats it in both error and run time", "●", "good")]
    if any(line.off for line in lines):
        off = f"the observed order is not the method's own: it is more than {ORDER_TOLERANCE} off"
        legend.append(Bullet("", off, "!", "allowed"))
    return [
        Table(_CURVES, lines),
        Items(legend),
        Paragraph(
            "The order is the slope of log error over log step, where neither coarse steps nor rounding hide it. A "
            f"curve ends where finer settings bring nothing, or a run would take too much work{most}. Run times are "
            f"medians of repeated runs{f', {timing}' if timing else ''}; ± is half the interquartile range. Compiling "
            "is timed from nothing, whatever the caches hold.",
            on="page",
            note=True,
        ),
        Details("every setting", [Table(_POINTS, list(result.rows()))]),
    ]
