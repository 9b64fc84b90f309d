"""Runs on independent coordinates, from chart to chart.

With a tolerance, a change of the chart and the way into a singular pose are events of the run. With a fixed step the
run goes in blocks of steps; a block ends where its chart is worn. At a singular pose the constraints depend on each
other and no chart serves: the run goes through it on all coordinates, with multipliers.
"""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit._warn import warn
from mbkit.engines import Dynamics
from mbkit.errors import FunctionError, InputError, MbkitWarning, NumericalError, UnsupportedError
from mbkit.lagrangian.independent_coordinates import SINGULAR, Chart, Embedded, EmbeddedDynamics
from mbkit.methods.registry import METHODS, Method, method_of
from mbkit.simulate.constraint_projection import SingularPoses, from_consistent
from mbkit.simulate.events import Event, Hit, as_events
from mbkit.simulate.integrate import integrate, times_of
from mbkit.simulate.progress import Progress, ProgressFunction
from mbkit.simulate.result import Stats
from mbkit.simulate.run_data import RunData
from mbkit.simulate.time_grid import Grid, save_times
from mbkit.simulate.torque import Force, Torque, TorqueFunction

_WORN: Final = "the dependent coordinates are badly chosen"
_NEAR: Final = "near a singular pose"
# Steps of a fixed-step method between two looks at the chart.
_BLOCK: Final = 100
# How far behind a singular pose charts serve again, in terms of how near they end.
_FAR: Final = 20
# Least measure, whose logarithm is taken.
_LEAST: Final = 1e-16
_MOST: Final = 10_000


@dataclass
class _Run:
    """A run so far, on all coordinates."""

    poses: SingularPoses
    t: list[float] = field(default_factory=list)
    q: list[Array] = field(default_factory=list)
    v: list[Array] = field(default_factory=list)
    hits: list[Hit] = field(default_factory=list)
    near: list[tuple[float, float]] = field(default_factory=list)
    steps: int = 0
    evaluations: int = 0
    rejected: int = 0
    ended: Any = "finished"
    message: str = ""
    error: FunctionError | None = None

    def keep(self, t: float, q: Array, v: Array) -> None:
        self.t.append(t)
        self.q.append(q)
        self.v.append(v)

    def count(self, part: RunData) -> None:
        self.steps += part.stats.steps
        self.evaluations += part.stats.evaluations
        self.rejected += part.stats.rejected


def _on_charts(method: Method) -> bool:
    """Return whether a method needs accelerations alone: charts have no derivatives and no expressions."""
    return not method.engines and not method.jacobian


def integrate_on_charts(
    system: Embedded,
    q0: ArrayLike,
    v0: ArrayLike,
    duration: float,
    method: str,
    dt: float | None,
    rtol: float | None,
    atol: float | None,
    torque: ArrayLike | TorqueFunction | None,
    save: ArrayLike | int | None,
    progress: bool | ProgressFunction | None,
    events: Event | Sequence[Event] | None,
    t0: float | None,
) -> tuple[RunData, FunctionError | None]:
    """Integrate one state; arguments are those of `mbkit.simulate`, on all coordinates."""
    model, dyn, chosen = system.model, system.dynamics, method_of(method)
    start, duration, dt = times_of(dyn, chosen, t0, duration, dt)
    wanted = as_events(events)
    bar = Progress(progress, f"{model.name}: {method} on independent coordinates")
    started = time.perf_counter()
    if not _on_charts(chosen):
        usable = ", ".join(m.name for m in METHODS.values() if _on_charts(m))
        raise UnsupportedError(
            f"{method}: not on independent coordinates, which Newton's iteration leads to; "
            f"use {usable}, or the form with multipliers, lag.dynamics()"
        )
    q, v = finite_array("q0", q0, (model.nq,)), finite_array("v0", v0, (model.nv,))
    q, v = from_consistent(dyn, q, v, start)
    read = Torque(torque, model, None, None)
    run = _Run(SingularPoses(dyn))
    force = read.of_member(None)(0)
    if chosen.kind == "adaptive":
        if isinstance(save, (int, np.integer)):
            raise InputError(f"save: expected a grid of times for an adaptive method, got the count {save}")
        times = None if save is None else save_times(save, start, start + duration)
        with bar:
            given = {"rtol": rtol, "atol": atol}
            _adaptive(system, run, q, v, start, start + duration, method, given, force, times, wanted, bar)
    else:
        with bar:
            _stepped(system, run, q, v, Grid.of(start, duration, dt), method, force, save, bar)
    for t, value in run.near:
        warn(
            f"{model.name}: {_NEAR} at t = {t:.6g} s: the smallest singular value there is {value:.3g} of the largest",
            MbkitWarning,
        )
    end = start + duration if run.ended == "finished" else run.t[-1] if run.t else start
    doubts = (run.poses.describe(),) if run.poses.times else ()
    seconds = time.perf_counter() - started
    stats = Stats(run.steps, run.evaluations, seconds, run.ended, end, run.message, run.rejected, doubts=doubts)
    states = np.array(run.t), np.array(run.q).reshape(-1, model.nq), np.array(run.v).reshape(-1, model.nq)
    hits = tuple(sorted(run.hits, key=lambda hit: hit.t))
    return RunData(*states, model, method, dyn.engine, stats, dyn, hits, read.applied(None)), run.error


_Part = tuple[RunData, FunctionError | None]


@dataclass
class _Way:
    """Configurations along a part. Later ones start from them, since a place far off may lie on another branch."""

    dyn: EmbeddedDynamics
    times: list[float]
    places: list[Array]
    begin: float
    poses: SingularPoses

    def passed(self, t: float, u: Array) -> Array:
        """Return the configuration at or near a step's end, and keep it."""
        if self.times and self.times[-1] == t:
            return self.places[-1]
        q = _at(self.dyn, t).configuration(u)
        self.times.append(t)
        self.places.append(q)
        if t >= max(self.times):
            self.poses.saw(self.begin + t, q)
        return q

    def state(self, t: float, u: Array, w: Array) -> tuple[Array, Array]:
        """Return q and v at a time of the part, from the nearest kept configuration."""
        near = int(np.abs(np.array(self.times) - t).argmin())
        _at(self.dyn, self.times[near]).remember(self.places[near])
        return _at(self.dyn, t).state(u, w)


class _Whole:
    """As `_Way`, of a part on all coordinates."""

    def state(self, t: float, q: Array, v: Array) -> tuple[Array, Array]:  # noqa: ARG002  # as of `_Way`
        """Return q and v."""
        return q, v


def _pulled(dyn: EmbeddedDynamics, force: Force, begin: float) -> Any:
    """Return a force on all coordinates as one on the independent ones."""
    if isinstance(force, np.ndarray):
        return (lambda t, u, _w: _at(dyn, t).pullback(u, force)) if force.any() else None

    def pulled(t: float, u: Array, w: Array) -> Array:
        own = _at(dyn, t)
        return own.pullback(u, force(begin + t, *own.state(u, w)))

    return pulled


def _at(dyn: EmbeddedDynamics, t: float) -> EmbeddedDynamics:
    return dyn.at(**{dyn.model.time_parameter: t}) if dyn.model.time_parameter else dyn


def _part(
    dyn: Dynamics, q: Array, v: Array, chart: Chart | None, *given: Any, **more: Any
) -> tuple[RunData, FunctionError | None]:
    with warnings.catch_warnings():
        # The whole run warns of its end.
        warnings.simplefilter("ignore", MbkitWarning)
        start = (q, v) if chart is None else (q[chart.independent], v[chart.independent])
        return integrate(dyn, *start, *given, **{"t0": 0.0, **more})


def _adaptive(
    system: Embedded,
    run: _Run,
    q: Array,
    v: Array,
    t: float,
    end: float,
    method: str,
    tolerances: dict[str, Any],
    force: Force,
    times: Array | None,
    events: Sequence[Event],
    progress: Progress,
) -> None:
    across, start = False, t
    left = None if times is None else list(times)
    if left is None or (left and left[0] == t):
        run.keep(t, q, v)
        left = left and left[1:]
    for _ in range(_MOST):
        first = system.chart(q, t)
        near = system.nearness(first, q, t)
        if near < SINGULAR:
            across = across or _passes(system)
            if not (run.near and run.near[-1][0] == t):
                run.near.append((t, near))
        chart, way, dyn, acts, watched = _begun(system, run, None if across else first, q, v, t, force, events)
        rest = end - t
        # Steps end behind the pose, where their errors are not those of a state within a step.
        span = min(rest, _behind(system, first, q, v, t)) if across else rest
        ends = [span] if left is None else sorted({*(s - t for s in left if s - t < span), span})
        part, run.error = _part(
            *(dyn, q, v, chart, span, method),
            torque=acts,
            save=None if left is None else ends,
            events=watched,
            progress=lambda done, t=t, span=span: progress.update((t + done * span - start) / (end - start or 1.0)),
            **tolerances,
        )
        ended = _take(system, run, part, way, first, t, left)
        if not ended and (span == rest or not part.stats.finished):
            return
        if ended:
            across, last = ended == _NEAR, part.events[-1]
            q, v = way.state(last.t, last.q, last.v)
            t += last.t
        else:
            across, q, v = False, part.q[-1], part.v[-1]
            t += span
    run.ended, run.message = "step_too_small", f"the independent coordinates changed {_MOST} times up to t = {t:.6g} s"


def _passes(system: Embedded) -> bool:
    """Return whether a run goes through singular poses: the choice is open, and nothing is moved in time."""
    return system.independent is None and system.model.time_parameter is None


def _later(event: Event, t: float) -> Callable[[float, Array, Array], float]:
    """Return an event's function of a part that begins at t."""
    return lambda s, q, v: event.function(t + s, q, v)


def _behind(system: Embedded, chart: Chart, q: Array, v: Array, t: float) -> float:
    """Return the time, s, in which a motion goes from near a singular pose to well behind it."""
    size, step = float(np.abs(v).max()), 1e-6
    if not size:
        return np.inf
    near = system.nearness(chart, q, t)
    rate = abs(system.nearness(chart, q + step / size * v, t) - near) * size / step
    return _FAR * max(near, SINGULAR) / rate if rate else np.inf


def _begun(
    system: Embedded,
    run: _Run,
    chart: Chart | None,
    q: Array,
    v: Array,
    t: float,
    force: Force,
    events: Sequence[Event],
) -> tuple[Chart | None, _Way | _Whole, Dynamics, Any, list[Event]]:
    """Return the chart, the way, the dynamics, the force and the events of a part."""
    if chart is None:

        def acting(s: float, q: Array, v: Array) -> Array:
            return np.asarray(force(t + s, q, v))  # type: ignore[operator]  # of a function

        shifted = [replace(e, function=_later(e, t)) for e in events]
        acts = force if isinstance(force, np.ndarray) else acting
        return None, _Whole(), system.dynamics, acts, shifted
    dyn = system.on(chart, q, t)
    run.hits.append(Hit(f"independent: {system.names(chart)}", t, q.copy(), v.copy()))
    way = _Way(dyn, [0.0], [q], t, run.poses)
    watched = [_of_all(event, dyn, t) for event in events]
    watched.append(_watch(system, chart, way, t, _NEAR))
    if system.independent is None:
        watched.append(_watch(system, chart, way, t, _WORN))
    return chart, way, dyn, _pulled(dyn, force, t), watched


def _take(
    system: Embedded,
    run: _Run,
    part: RunData,
    way: _Way | _Whole,
    chart: Chart,
    begin: float,
    left: list[float] | None,
) -> str:
    """Add a part; return why the run goes on from its end on another chart, or nothing."""
    run.count(part)
    name = part.events[-1].name if part.stats.ended == "event" else ""
    worn = name == _WORN or (name == _NEAR and _passes(system))
    wanted = None if left is None else {s - begin: s for s in left}
    for k, (s, u, w) in enumerate(zip(part.t, part.q, part.v, strict=True)):
        if wanted is None:
            if k and not (worn and k == len(part.t) - 1):
                run.keep(begin + float(s), *way.state(float(s), u, w))
        elif float(s) in wanted and s > 0:
            run.keep(wanted[float(s)], *way.state(float(s), u, w))
    if left is not None:
        done = begin + float(part.stats.reached)  # type: ignore[arg-type]  # of one state
        left[:] = [s for s in left if s > done and not (run.t and s <= run.t[-1])]
    for hit in part.events:
        if hit.name == _WORN:
            continue
        q, v = way.state(hit.t, hit.q, hit.v)
        run.hits.append(replace(hit, t=begin + hit.t, q=q, v=v))
        if hit.name == _NEAR:
            run.near.append((begin + hit.t, system.nearness(chart, q, begin + hit.t)))
    if worn:
        return name
    run.ended, run.message = part.stats.ended, part.stats.message
    if run.ended == "event" and part.events[-1].name == _NEAR:
        _undetermined(system, run)
    elif run.ended != "finished":
        end = begin + float(part.stats.reached)  # type: ignore[arg-type]  # of one state
        if run.ended == "event":
            run.message = f"stopped by {run.hits[-1].name} at t = {end:.6g} s"
            if run.t[-1:] != [end]:
                run.keep(end, run.hits[-1].q, run.hits[-1].v)
        else:
            run.message = run.message.rpartition(" after t = ")[0] + f" after t = {end:.6g} s"
    return ""


def _undetermined(system: Embedded, run: _Run) -> None:
    """End at a singular pose of a choice that stays."""
    hit = run.hits[-1]
    run.ended = "step_too_small"
    run.message = (
        f"ended {_NEAR} at t = {hit.t:.6g} s, where {', '.join(system.independent or ())} no longer determine "
        "the motion; lag.embedded() changes the choice"
    )
    if run.t[-1:] != [hit.t]:
        run.keep(hit.t, hit.q, hit.v)


def _of_all(event: Event, dyn: EmbeddedDynamics, begin: float) -> Event:
    """Return an event of all coordinates as one of the independent ones."""
    return replace(event, function=lambda t, u, w: event.function(begin + t, *_at(dyn, t).state(u, w)))


def _watch(system: Embedded, chart: Chart, way: _Way, begin: float, what: str) -> Event:
    judge, limit = (system.quality, system.least) if what == _WORN else (system.nearness, SINGULAR)

    def function(t: float, u: Array, _w: Array) -> float:
        # Its logarithm is nearly straight where the value itself bends to zero.
        try:
            value = judge(chart, way.passed(t, u), begin + t)
        except NumericalError:
            value = 0.0
        return float(np.log(max(value, _LEAST) / limit))

    # On coordinates that stay, the motion beyond the pose would come out wrong.
    return Event(function, what, direction=-1, terminal=what == _WORN or system.model.time_parameter is None)


def _stepped(
    system: Embedded,
    run: _Run,
    q: Array,
    v: Array,
    grid: Grid,
    method: str,
    force: Force,
    save: Any,
    progress: Progress,
) -> None:
    kept = set(grid.kept(save, 2 * len(q)).tolist())
    if 0 in kept:
        run.keep(grid.start, q, v)
    k, chart, was_near = 0, None, False
    while k < grid.steps:
        t = grid.time(k)
        progress.update(k / grid.steps)
        if chart is None:
            chart = system.chart(q, t)
            run.hits.append(Hit(f"independent: {system.names(chart)}", t, q.copy(), v.copy()))
        dyn = system.on(chart, q, t)
        end = min(k + _BLOCK, grid.steps)
        part, run.error = _part(
            *(dyn, q, v, chart, grid.span(k, end), method), dt=grid.dt, torque=_pulled(dyn, force, t)
        )
        run.count(part)
        dyn.remember(q)
        begin, worn = k, False
        for s, u, w in zip(part.t[1:], part.q[1:], part.v[1:], strict=True):
            k += 1
            t = grid.time(k)
            q, v = _at(dyn, float(s)).state(u, w)
            if k in kept:
                run.keep(t, q, v)
            near = system.nearness(chart, q, t)
            if near < SINGULAR and not was_near:
                run.near.append((t, near))
                run.hits.append(Hit(_NEAR, t, q, v))
                if system.independent is not None:
                    _undetermined(system, run)
                    return
            was_near = near < SINGULAR
            worn = system.independent is None and system.quality(chart, q, t) < system.least
            if worn:
                break
        if worn or (not part.stats.finished and k > begin and system.independent is None):
            chart = None
        elif not part.stats.finished:
            run.ended = part.stats.ended
            # Of the run, and not of its last block.
            now = f"after t = {t:.6g} s (step {k + 1})"
            run.message = re.sub(r"after t = \S+ s \(step \d+\)", now, part.stats.message)
            return
