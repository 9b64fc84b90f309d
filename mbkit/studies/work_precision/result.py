"""What `work_precision` returns: frozen curves of error against run time, and ways to read them."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mbkit._escape import csv_text, html, markdown
from mbkit.errors import InputError
from mbkit.studies.results import Refusal, remade, write
from mbkit.studies.results import csv_number as cell
from mbkit.studies.results import to_plain as plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Curve", "InterruptedSweepError", "PrecisionPoint", "WorkPrecision"]


@dataclass(frozen=True)
class PrecisionPoint:
    """One engine, method and step or tolerance.

    Attributes
    ----------
    setting : {"dt", "rtol"}
    value : float
        Of the setting, s or 1.
    error : float
        Largest difference of q to the reference over the saved times, rad or m; NaN
        where the run did not reach the end.
    energy : float
        Largest |E(t) - E(0)| at the saved times, relative to the larger of the largest
        kinetic energy and the change of potential energy; NaN with dampers or applied
        forces, whose work is not known well enough.
    seconds, spread : float
        Run time, median of the repetitions and half their interquartile range (NaN of
        one alone); without what is derived and compiled once.
    steps, evaluations : int
        Of one run; 0 where the engine does not tell.
    repeats : int
        Timings taken.
    note : str
        Why there is no error, or no energy.
    """

    setting: Literal["dt", "rtol"]
    value: float
    error: float
    energy: float
    seconds: float
    spread: float
    steps: int
    evaluations: int
    repeats: int
    note: str = ""


@dataclass(frozen=True)
class Curve:
    """All settings of one engine and method.

    Attributes
    ----------
    engine, method : str
    points : tuple of PrecisionPoint
        In the order of the sweep, coarse to fine.
    order : float
        Observed, the slope of log error over log dt by regression over the points that
        are neither coarse nor at rounding; NaN where fewer than three are.
    order_points : int
        How many points that used.
    expected : float
        The method's own order; NaN for adaptive methods.
    compile : float
        Seconds from nothing (no cache) to the first step: deriving, compiling, building;
        NaN where that failed. Of a method that is compiled for each tolerance, for one.
    ended : str
        Why there are no finer settings, where time ran out.
    """

    engine: str
    method: str
    points: tuple[PrecisionPoint, ...]
    order: float
    order_points: int
    expected: float
    compile: float
    ended: str = ""

    @property
    def name(self) -> str:
        """Return engine and method; an engine's own method as such."""
        own = f"{self.engine}_"
        if self.method.startswith(own):
            return f"{self.engine}'s own {self.method.removeprefix(own)}"
        return f"{self.engine} {self.method}"

    def reach(self, error: float) -> PrecisionPoint | None:
        """Return the fastest point with at most this error, if there is one."""
        return min((p for p in self.points if p.error <= error), key=lambda p: p.seconds, default=None)


@dataclass(frozen=True)
class WorkPrecision:
    """Error against run time, for every engine and method that was asked.

    Attributes
    ----------
    model : str
    facts : dict
        nq, nv, mass, digest, needs and notes of the model.
    duration, asked : float
        Horizon that errors are measured on, and the one asked for, s.
    reference : str
        How the reference was made, and why the horizon was cut if it was.
    floor : float
        How well the reference is known, rad or m.
    q0, v0 : tuple of float
        Start.
    curves : tuple of Curve
    refusals : tuple of Refusal
        What an engine or method could not do, with the reason.
    complete : bool
        False for a sweep that was interrupted.
    versions : dict
    processor : str
    seconds : float
        Time of the whole study.
    settings : dict
        seed, repeats, steps, tolerances, torque, the saved times, the executor, and in
        words how run times were taken: those of worker processes, which share the
        cores, are not to be set beside those of another run.
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

    def rows(self) -> Iterator[tuple[Curve, PrecisionPoint]]:
        """Yield every point with its curve."""
        for curve in self.curves:
            for point in curve.points:
                yield curve, point

    @property
    def shortened(self) -> tuple[str, ...]:
        """What is missing: the curves left out, those that time ended, a horizon that was cut."""
        out = [] if self.complete else ["interrupted"]
        if self.refusals:
            names = list(dict.fromkeys(f"{r.engine} {r.term}".strip() for r in self.refusals))
            out.append(f"{_counted(len(names), 'curve')} left out: {', '.join(names)}")
        ended = [f"{c.engine} {c.method}" for c in self.curves if c.ended]
        if ended:
            out.append(f"{_counted(len(ended), 'curve')} ended by time: {', '.join(ended)}")
        # Each setting that was asked for is there, and some were not run.
        lost = sum(math.isnan(p.seconds) for _, p in self.rows())
        if lost:
            out.append(f"{_counted(lost, 'setting')} not run")
        if self.duration < self.asked * (1 - 1e-9):
            out.append(f"horizon cut from {self.asked:g} s to {self.duration:g} s")
        return tuple(out)

    @property
    def front(self) -> tuple[tuple[Curve, PrecisionPoint], ...]:
        """The Pareto front: points that none beats in both error and run time, fastest first."""
        out: list[tuple[Curve, PrecisionPoint]] = []
        known = [(c, p) for c, p in self.rows() if math.isfinite(p.error) and math.isfinite(p.seconds)]
        for curve, point in sorted(known, key=lambda item: (item[1].seconds, item[1].error)):
            # What is below the reference's own floor is no better than the floor.
            if not out or max(point.error, self.floor) < max(out[-1][1].error, self.floor):
                out.append((curve, point))
        return tuple(out)

    def fastest(self, error: float) -> tuple[Curve, PrecisionPoint] | None:
        """Return the curve and point that reach this error in the least time, if any does."""
        reached = [(c, p) for c, p in self.rows() if p.error <= error]
        return min(reached, key=lambda item: item[1].seconds, default=None)

    def to_dict(self) -> dict[str, Any]:
        """Return all of it as plain data, with the front by name and first-run times."""
        out = asdict(self) | {"shortened": list(self.shortened)}
        for told, curve in zip(out["curves"], self.curves, strict=True):
            for p, point in zip(told["points"], curve.points, strict=True):
                p["first_run"] = curve.compile + point.seconds
        out["front"] = [
            {"engine": c.engine, "method": c.method, p.setting: p.value, "error": p.error, "seconds": p.seconds}
            for c, p in self.front
        ]
        return out

    def to_json(self, path: str | Path | None = None) -> str:
        """Return the result as JSON with null for NaN, and write it if a path is given."""
        text = json.dumps(plain(self.to_dict()), indent=1, allow_nan=False)
        if path is not None:
            write(path, text + "\n")
        return text

    @classmethod
    def from_json(cls, text: str) -> WorkPrecision:
        """Return the result that `to_json` told.

        Raises
        ------
        InputError
            The text is no such result.
        """
        try:
            return cls._from_plain(json.loads(text))
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
            raise InputError(
                f"text: expected the JSON of a WorkPrecision, such as Path(...).read_text() of a file "
                f"that to_json wrote; it has no such content ({type(error).__name__}: {error})"
            ) from None

    @classmethod
    def _from_plain(cls, data: dict[str, Any]) -> WorkPrecision:
        curves = []
        for told in data["curves"]:
            points = tuple(remade(PrecisionPoint, point) for point in told["points"])
            curves.append(remade(Curve, told | {"points": points}))
        told = {
            "curves": tuple(curves),
            "refusals": tuple(Refusal(**r) for r in data["refusals"]),
            "q0": tuple(data["q0"]),
            "v0": tuple(data["v0"]),
        }
        made: WorkPrecision = remade(cls, data | told)
        return made

    def to_csv(self, path: str | Path | None = None) -> str:
        """Return one line per point, and write it if a path is given."""
        front = {(id(c), id(p)) for c, p in self.front}
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        head = ("engine", "method", "setting", "value", "error", "energy", "seconds", "spread", "first_run")
        writer.writerow([*head, "steps", "evaluations", "order", "expected_order", "front", "note"])
        for c, p in self.rows():
            numbers = (p.value, p.error, p.energy, p.seconds, p.spread, c.compile + p.seconds)
            on = (id(c), id(p)) in front
            order = (c.order, c.expected)
            about = (csv_text(c.engine), csv_text(c.method), p.setting, *map(cell, numbers), p.steps, p.evaluations)
            writer.writerow((*about, *map(cell, order), int(on), csv_text(p.note)))
        if path is not None:
            write(path, stream.getvalue())
        return stream.getvalue()

    def to_markdown(self) -> str:
        """Return the front and the curves as tables."""
        missing = f" ({markdown('; '.join(self.shortened))})" if self.shortened else ""
        lines = [f"**{markdown(self.model)}**, {self.duration:g} s{missing}: {markdown(self.reference)}", ""]
        lines += ["| error ≤ | fastest | setting | run time | first run |", "|---:|---|---|---:|---:|"]
        found = {exponent: self.fastest(10.0**exponent) for exponent in range(-2, -14, -2)}
        # One row for each run, with the least error that it is fastest for.
        last = {id(x[1]): exponent for exponent, x in found.items() if x}
        for exponent, x in found.items():
            if x and last[id(x[1])] == exponent:
                c, p = x
                first = f"{c.compile + p.seconds:.3g} s"
                about = f"{markdown(c.name)} | {p.setting} {p.value:g}"
                lines.append(f"| 1e{exponent} | {about} | {p.seconds:.3g} s | {first} |")
        lines += ["", "| engine and method | order | expected | least error | its run time | compile |"]
        lines.append("|---|---:|---:|---:|---:|---:|")
        for c in self.curves:
            best = min((p for p in c.points if math.isfinite(p.error)), key=lambda p: p.error, default=None)
            least = (f"{best.error:.1e}", f"{best.seconds:.3g} s") if best else ("none", "")
            orders = ["" if math.isnan(x) else f"{x:.2f}" for x in (c.order, c.expected)]
            lines.append(f"| {' | '.join((markdown(c.name), *orders, *least))} | {c.compile:.3g} s |")
        told = [f"- {markdown(f'{r.engine} {r.term}')}: {markdown(r.reason)}" for r in self.refusals]
        lines += ["", *told] if told else []
        lines += [] if self.complete else ["", "Interrupted: this is what was finished."]
        return "\n".join(lines) + "\n"

    def plot(self) -> Figure:
        """Return the log-log figure of error against run time."""
        from mbkit.studies.work_precision.figure import figure

        return figure(self)

    def __repr__(self) -> str:
        count = sum(len(c.points) for c in self.curves)
        missing = "".join(f"; {x}" for x in self.shortened)
        curves = _counted(len(self.curves), "curve")
        return f"<WorkPrecision of {self.model!r}: {curves}, {count} points, {self.duration:g} s{missing}>"

    def _repr_html_(self) -> str:
        rows = []
        for c, p in self.front:
            numbers = f"<td>{p.error:.1e}</td><td>{p.seconds:.3g} s</td><td>{c.compile + p.seconds:.3g} s</td>"
            rows.append(f"<tr><td>{html(c.name)}</td><td>{p.setting} {p.value:g}</td>{numbers}</tr>")
        head = "<tr><th>on the front</th><th>setting</th><th>error</th><th>run time</th><th>first run</th></tr>"
        missing = f" <b>{html('; '.join(self.shortened))}.</b>" if self.shortened else ""
        told = f"<p><b>{html(self.model)}</b>, {self.duration:g} s.{missing} {html(self.reference)}</p>"
        return f"{told}<table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"


def _counted(n: int, what: str) -> str:
    return f"{n} {what}{'s' * (n != 1)}"


class InterruptedSweepError(KeyboardInterrupt):
    """Ctrl-C came; `result` holds what was finished.

    A `KeyboardInterrupt`, so that whoever does not ask for the result ends as ever.

    Attributes
    ----------
    result : WorkPrecision or StressResult
        With ``complete=False``.
    """

    def __init__(self, result: Any) -> None:
        super().__init__("interrupted; what was finished is in .result")
        self.result = result

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.result,)
