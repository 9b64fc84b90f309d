"""The result of `work_precision`: curves of error against run time, as tables, text and a figure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, Final

from mbkit.studies.measurement import Measurement
from mbkit.studies.results import Block, Column, Items, Refusal, ResultTable, Table, Title, block_html, columns, counted
from mbkit.studies.study_runs import OUT_OF_TIME
from mbkit.studies.work_precision.curve import Curve, pareto_front
from mbkit.studies.work_precision.figure import figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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

    _csv_columns: ClassVar = (
        *columns(0, "engine", "method"),
        *columns(1, "setting", "value", "error", "energy", "seconds", "spread"),
        Column("first_run", lambda row: row[0].compile + row[1].seconds),
        *columns(1, "steps", "evaluations"),
        *columns(0, "order"),
        Column("expected_order", lambda row: row[0].expected),
        Column("front", itemgetter(2)),
        *columns(1, "note"),
    )

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
            names = list(dict.fromkeys(f"{r.engine} {r.term}".strip() for r in failed))
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

    def _title(self) -> Title:
        missing = f" ({'; '.join(self.shortened)})" if self.shortened else ""
        return Title(self.model, f", {self.duration:g} s{missing}: {self.reference}")

    def _blocks(self) -> Iterator[Block]:
        yield self._title()
        fastest = {exponent: self.fastest(10.0**exponent) for exponent in range(-2, -14, -2)}
        # One row for each run, with the least error that it is fastest for.
        last = {id(x[1]): (f"1e{exponent}", *x) for exponent, x in fastest.items() if x}
        yield Table((Column("error ≤", itemgetter(0), right=True), *_run_columns("fastest", 1)), last.values())
        yield Table(_CURVE_COLUMNS, self.curves)
        notes = [f"{r.engine} {r.term}: {r.reason}" for r in self.failed] + [*self.turns]
        yield Items([*notes, *([] if self.complete else ["Interrupted: this is what was finished."])])

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

    def _repr_html_(self) -> str:
        error = Column("error", lambda row: row[1].error, ".1e", right=True)
        name, setting, *times = _run_columns("on the front", 0)
        return block_html(self._title()) + block_html(Table((name, setting, error, *times), self.front))


def _run_columns(head: str, at: int) -> tuple[Column, ...]:
    """Return columns of rows that hold a curve and its point from some place on."""
    return (
        Column(head, lambda row: row[at].name),
        Column("setting", lambda row: f"{row[at + 1].setting} {row[at + 1].value:g}"),
        Column("run time", lambda row: f"{row[at + 1].seconds:.3g} s", right=True),
        Column("first run", lambda row: f"{row[at].compile + row[at + 1].seconds:.3g} s", right=True),
    )


def _least(curve: Curve, text: Callable[[Measurement], str], otherwise: str) -> str:
    """Return a text about the point with the least error."""
    best = min((p for p in curve.points if math.isfinite(p.error)), key=lambda p: p.error, default=None)
    return text(best) if best else otherwise


def _order(x: float) -> str:
    return "" if math.isnan(x) else f"{x:.2f}"


_CURVE_COLUMNS: Final = (
    Column("engine and method", attrgetter("name")),
    Column("order", lambda c: _order(c.order), right=True),
    Column("expected", lambda c: _order(c.expected), right=True),
    Column("least error", lambda c: _least(c, lambda p: f"{p.error:.1e}", "none"), right=True),
    Column("its run time", lambda c: _least(c, lambda p: f"{p.seconds:.3g} s", ""), right=True),
    Column("compile", lambda c: f"{c.compile:.3g} s", right=True),
)
