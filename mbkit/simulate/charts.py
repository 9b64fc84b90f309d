"""Runs on independent coordinates: from chart to chart, with a look for singular poses.

With a tolerance, a change of the chart and the way into a singular pose are events of
the run. With a fixed step the run goes in blocks of steps; one in which the chart wears
out ends where it does, and the steps behind are made anew on the next chart.
"""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit.errors import FunctionError, InputError, MbkitWarning, NumericalError, UnsupportedError
from mbkit.lagrangian.embedding import SINGULAR, Chart, Embedded, EmbeddedDynamics
from mbkit.simulate.applied import TorqueFunction
from mbkit.simulate.consistent import from_consistent
from mbkit.simulate.events import Event, Hit
from mbkit.simulate.grid import DEFAULT_STEP, Grid, save_times
from mbkit.simulate.methods import Method
from mbkit.simulate.stats import Stats
from mbkit.simulate.torque import Force, Torque
from mbkit.simulate.trajectory import Trajectory

__all__ = ["METHODS_ON_CHARTS", "run_on_charts"]

METHODS_ON_CHARTS: Final = ("rk853", "dop853", "rk4", "gauss4", "gauss6", "semi_implicit_euler")
_WORN: Final = "the dependent coordinates are badly chosen"
_NEAR: Final = "near a singular pose"
# Steps of a fixed-step method between two looks at the chart.
_BLOCK: Final = 100
# What a singular pose itself is taken for.
_LEAST: Final = 1e-16
# More changes than this without progress are no motion any more.
_MOST: Final = 10_000


@dataclass
class _Run:
    """What has come of a run so far, on all coordinates."""

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

    def count(self, part: Trajectory) -> None:
        self.steps += part.stats.steps
        self.evaluations += part.stats.evaluations
        self.rejected += part.stats.rejected


def run_on_charts(
    system: Embedded,
    method: Method,
    q0: ArrayLike,
    v0: ArrayLike,
    t0: float,
    duration: float,
    dt: float | None,
    rtol: float | None,
    atol: float | None,
    torque: ArrayLike | TorqueFunction | None,
    save: ArrayLike | int | None,
    events: Sequence[Event],
) -> Trajectory:
    """Integrate one state; arguments are those of `mbkit.simulate`, on all coordinates."""
    model, started = system.model, time.perf_counter()
    if method.name not in METHODS_ON_CHARTS:
        raise UnsupportedError(
            f"{method.name}: not on independent coordinates, which Newton's iteration leads to; "
            f"use {', '.join(METHODS_ON_CHARTS)}, or the form with multipliers, lag.dynamics()"
        )
    q, v = finite_array("q0", q0, (model.nq,)), finite_array("v0", v0, (model.nv,))
    q, v = from_consistent(system.dynamics, q, v, t0)
    read = Torque(torque, model, None, None)
    run = _Run()
    force = read.of_member(None)(0)
    if method.kind == "adaptive":
        if isinstance(save, (int, np.integer)):
            raise InputError(f"save: expected a grid of times for an adaptive method, got the count {save}")
        times = None if save is None else save_times(save, t0, t0 + duration)
        _adaptive(system, run, q, v, t0, t0 + duration, method.name, {"rtol": rtol, "atol": atol}, force, times, events)
    else:
        _stepped(system, run, q, v, Grid.of(t0, duration, DEFAULT_STEP if dt is None else dt), method.name, force, save)
    out = _finished(system, run, method, read, t0, t0 + duration, time.perf_counter() - started)
    for t, value in run.near:
        warnings.warn(
            f"{model.name}: {_NEAR} at t = {t:.6g} s: the smallest singular value there is {value:.3g} of the largest",
            MbkitWarning,
            stacklevel=3,
        )
    if run.error is not None:
        run.error.trajectory = out
        raise run.error
    if run.message and run.ended != "event":
        warnings.warn(f"{model.name}: {method.name} {run.message}", MbkitWarning, stacklevel=3)
    return out


def _finished(
    system: Embedded, run: _Run, method: Method, read: Torque, start: float, end: float, seconds: float
) -> Trajectory:
    reached = end if run.ended == "finished" else run.t[-1] if run.t else start
    stats = Stats(run.steps, run.evaluations, seconds, run.ended, reached, run.message, run.rejected)
    n = system.model.nq
    t, q, v = np.array(run.t), np.array(run.q).reshape(-1, n), np.array(run.v).reshape(-1, n)
    dyn = system.dynamics
    hits = tuple(sorted(run.hits, key=lambda hit: hit.t))
    return Trajectory(t, q, v, system.model, method.name, dyn.engine, stats, dyn, hits, read.applied(None))


@dataclass
class _Way:
    """Configurations on the way of a part, of which later ones follow: a place far off may lie on another branch."""

    dyn: EmbeddedDynamics
    times: list[float]
    places: list[Array]

    def passed(self, t: float, u: Array) -> Array:
        """Return the configuration at a step's end, or near it, and note it."""
        if self.times and self.times[-1] == t:
            return self.places[-1]
        q = _at(self.dyn, t).configuration(u)
        self.times.append(t)
        self.places.append(q)
        return q

    def state(self, t: float, u: Array, w: Array) -> tuple[Array, Array]:
        """Return q and v at a time of the part, reached from the nearest configuration that was noted."""
        near = int(np.abs(np.array(self.times) - t).argmin())
        _at(self.dyn, self.times[near]).remember(self.places[near])
        return _at(self.dyn, t).state(u, w)


def _pulled(dyn: EmbeddedDynamics, force: Force, begin: float) -> Any:
    """Return a force on all coordinates as one on the independent ones."""
    if isinstance(force, np.ndarray):
        return (lambda t, u, _w: _at(dyn, t).pullback(u, force)) if force.any() else None

    def pulled(t: float, u: Array, w: Array) -> Array:
        own = _at(dyn, t)
        return own.pullback(u, force(begin + t, *own.state(u, w)))

    return pulled


def _at(dyn: EmbeddedDynamics, t: float) -> EmbeddedDynamics:
    return dyn.at(**{dyn.model.clock: t}) if dyn.model.clock else dyn


def _part(dyn: EmbeddedDynamics, q: Array, v: Array, chart: Chart, *given: Any, **more: Any) -> Any:
    # The run as a whole tells how it ended.
    from mbkit.simulate.run import simulate

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        try:
            return simulate(dyn, q[chart.independent], v[chart.independent], *given, **{"t0": 0.0, **more}), None
        except FunctionError as error:
            return error.trajectory, error


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
) -> None:
    left = None if times is None else list(times)
    if left is None or (left and left[0] == t):
        run.keep(t, q, v)
        left = left and left[1:]
    for _ in range(_MOST):
        chart = system.chart(q, t)
        dyn = system.on(chart, q, t)
        run.hits.append(Hit(f"independent: {system.names(chart)}", t, q.copy(), v.copy()))
        near = system.nearness(chart, q, t)
        if near < SINGULAR and not (run.near and run.near[-1][0] == t):
            run.near.append((t, near))
        way = _Way(dyn, [0.0], [q])
        watched = [_of_all(event, dyn, t) for event in events]
        watched.append(_watch(system, chart, way, t, _NEAR))
        if system.independent is None:
            watched.append(_watch(system, chart, way, t, _WORN))
        ends = [end - t] if left is None else sorted({*(s - t for s in left), end - t})
        part, run.error = _part(
            *(dyn, q, v, chart, end - t, method),
            torque=_pulled(dyn, force, t),
            save=None if left is None else ends,
            events=watched,
            **tolerances,
        )
        worn = _take(system, run, part, way, chart, t, left)
        if not worn:
            return
        last = part.events[-1]
        q, v = way.state(last.t, last.q, last.v)
        t += last.t
    run.ended, run.message = "step_too_small", f"the independent coordinates changed {_MOST} times up to t = {t:.6g} s"


def _take(
    system: Embedded,
    run: _Run,
    part: Trajectory,
    way: _Way,
    chart: Chart,
    begin: float,
    left: list[float] | None,
) -> bool:
    """Take in a part; return whether the run goes on from its end on another chart."""
    run.count(part)
    worn = part.stats.ended == "event" and part.events[-1].name == _WORN
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
        return True
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
    return False


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

    # On a choice that stays, the motion beyond the pose is another one than that which comes out.
    return Event(function, what, direction=-1, terminal=what == _WORN or system.independent is not None)


def _stepped(system: Embedded, run: _Run, q: Array, v: Array, grid: Grid, method: str, force: Force, save: Any) -> None:
    kept = set(grid.kept(save, 2 * len(q)).tolist())
    if 0 in kept:
        run.keep(grid.start, q, v)
    k, chart, was_near = 0, None, False
    while k < grid.steps:
        t = grid.time(k)
        if chart is None:
            chart = system.chart(q, t)
            run.hits.append(Hit(f"independent: {system.names(chart)}", t, q.copy(), v.copy()))
        dyn = system.on(chart, q, t)
        end = min(k + _BLOCK, grid.steps)
        part, run.error = _part(
            *(dyn, q, v, chart, grid.time(end) - t, method), dt=grid.dt, torque=_pulled(dyn, force, t)
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
