"""Runs on independent coordinates, from chart to chart.

With a tolerance, a change of the chart and the way into a singular pose are events of the run. With a fixed step the
run goes in blocks of steps; a block ends where its chart is worn. At a singular pose the constraints depend on each
other and no chart serves: the run goes through it on all coordinates, with multipliers.
"""

from __future__ import annotations

import re
import time
import warnings
from dataclasses import replace
from typing import Any, Final, cast

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit._warn import warn
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.errors import FunctionError, InputError, MbkitWarning, NumericalError, UnsupportedError
from mbkit.lagrangian.independent_coordinates import SINGULAR, Chart, Embedded, EmbeddedDynamics
from mbkit.methods.registry import METHODS, Method, method_of
from mbkit.simulate.constraint_projection import from_consistent
from mbkit.simulate.events import Event, Hit, as_events
from mbkit.simulate.integrate import integrate, times_of
from mbkit.simulate.progress import Progress
from mbkit.simulate.request import RunRequest
from mbkit.simulate.result import Ended, Stats
from mbkit.simulate.run_data import RunData
from mbkit.simulate.singular_poses import SingularPoses
from mbkit.simulate.time_grid import Grid, save_times
from mbkit.simulate.torque import Torque

_WORN: Final = "the dependent coordinates are badly chosen"
_NEAR: Final = "near a singular pose"
# Steps of a fixed-step method between two looks at the chart.
_BLOCK: Final = 100
# How far behind a singular pose charts serve again, in terms of how near they end.
_FAR: Final = 20
# Least measure; its logarithm must be finite.
_LEAST: Final = 1e-16
_MOST: Final = 10_000


def _on_charts(method: Method) -> bool:
    """Return whether a method needs accelerations alone: charts have no derivatives and no expressions."""
    return not method.engines and not method.jacobian


def integrate_on_charts(system: Embedded, request: RunRequest) -> tuple[RunData, FunctionError | None]:
    """Integrate one state on all coordinates; without checks of the run."""
    if request.wrenches:
        raise UnsupportedError(
            "wrenches: a system written as energies has no frames; give the generalized force, torque="
        )
    if request.hold is not None:
        raise UnsupportedError("hold: not on independent coordinates; take the dynamics of the whole system")
    run = _Run(system, request)
    return run.data(request.q0, request.v0), run.error


class _Run:
    """A run so far, on all coordinates."""

    def __init__(self, system: Embedded, request: RunRequest) -> None:
        method, self._save = request.method, request.save
        self.system, self.model, self._method = system, system.model, method_of(method)
        self._start, duration, dt = times_of(system.dynamics, self._method, request.t0, request.duration, request.dt)
        self._end, self._duration, self._dt = self._start + duration, duration, dt
        self.events = as_events(request.events)
        self._bar = Progress(request.progress, f"{self.model.name}: {method} on independent coordinates")
        if not _on_charts(self._method):
            usable = ", ".join(m.name for m in METHODS.values() if _on_charts(m))
            raise UnsupportedError(
                f"{method}: not on independent coordinates, which Newton's iteration leads to; "
                f"use {usable}, or the form with multipliers, lag.dynamics()"
            )
        self._torque = Torque(request.torque, self.model, None, None)
        self.force: Any = self._torque.of_member(None)(0)
        self._tolerances: dict[str, Any] = {"rtol": request.rtol, "atol": request.atol}
        self.poses = SingularPoses(system.dynamics)
        #: The run goes through singular poses: the choice is open, and nothing is moved in time.
        self.passes = system.independent is None and self.model.time_parameter is None
        self._states: list[tuple[float, Array, Array]] = []
        self.hits: list[Hit] = []
        self._near: list[tuple[float, float]] = []
        self._counts = np.zeros(3, dtype=int)
        self._ended: Ended = "finished"
        self._message = ""
        self.error: FunctionError | None = None

    def data(self, q0: ArrayLike, v0: ArrayLike) -> RunData:
        """Integrate from a state; return the run."""
        started = time.perf_counter()
        model, dyn = self.model, self.system.dynamics
        q, v = finite_array("q0", q0, (model.nq,)), finite_array("v0", v0, (model.nv,))
        q, v = from_consistent(dyn, q, v, self._start)
        with self._bar:
            if self._method.kind == "adaptive":
                self._adaptive(q, v)
            else:
                self._stepped(q, v, Grid.of(self._start, self._duration, self._dt))
        for t, value in self._near:
            warn(
                f"{model.name}: {_NEAR} at t = {t:.6g} s: the smallest singular value there is {value:.3g} of the "
                "largest",
                MbkitWarning,
            )
        times, positions, velocities = zip(*self._states, strict=True) if self._states else ((), (), ())
        end = self._end if self._ended == "finished" else times[-1] if times else self._start
        doubts = (self.poses.describe(),) if self.poses.times else ()
        steps, evaluations, rejected = self._counts.tolist()
        seconds = time.perf_counter() - started
        stats = Stats(steps, evaluations, seconds, self._ended, end, self._message, rejected, doubts=doubts)
        states = (
            np.array(times),
            np.array(positions).reshape(-1, model.nq),
            np.array(velocities).reshape(-1, model.nv),
        )
        hits = tuple(sorted(self.hits, key=lambda hit: hit.t))
        return RunData(*states, model, self._method.name, dyn.engine, stats, dyn, hits, self._torque.applied(None))

    def _keep_end(self, t: float, q: Array, v: Array) -> None:
        if not self._states or self._states[-1][0] != t:
            self._states.append((t, q, v))

    def integrated(self, way: _Way, q: Array, v: Array, span: float, **options: Any) -> RunData:
        """Return the run of a part, from a state on all coordinates."""
        start = (q, v) if way.chart is None else (q[way.chart.independent], v[way.chart.independent])
        with warnings.catch_warnings():
            # The whole run warns of its end.
            warnings.simplefilter("ignore", MbkitWarning)
            request = RunRequest(*start, span, self._method.name, torque=way.torque(), t0=0.0, **options)
            part, self.error = integrate(way.dyn, request)
        self._counts += [part.stats.steps, part.stats.evaluations, part.stats.rejected]
        return part

    # With a tolerance

    def _adaptive(self, q: Array, v: Array) -> None:
        if isinstance(self._save, (int, np.integer)):
            raise InputError(f"save: expected a grid of times for an adaptive method, got the count {self._save}")
        system, start, t, across = self.system, self._start, self._start, False
        left = None if self._save is None else save_times(self._save, start, self._end).tolist()
        if left is None or left[0] == t:
            self._states.append((t, q, v))
        for _ in range(_MOST):
            left = left and [s for s in left if s > t]
            chart = system.chart(q, t)
            near = system.nearness(chart, q, t)
            if near < SINGULAR:
                across = across or self.passes
                if not (self._near and self._near[-1][0] == t):
                    self._near.append((t, near))
            way = _Way(self, None if across else chart, q, v, t)
            rest = self._end - t
            # Steps end behind the pose, where their errors are not those of a state within a step.
            span = min(rest, self._behind(chart, q, v, t)) if across else rest
            part = self.integrated(
                *(way, q, v, span),
                save=None if left is None else sorted({*(s - t for s in left if s - t < span), span}),
                events=way.events(),
                progress=lambda done, t=t, span=span: self._bar.update(
                    (t + done * span - start) / (self._end - start or 1.0)
                ),
                **self._tolerances,
            )
            ended = self._take(part, way, chart, left)
            if not ended and (span == rest or not part.stats.finished):
                return
            across = ended == _NEAR
            if ended:
                last = part.events[-1]
                q, v = way.state(last.t, last.q, last.v)
                t += last.t
            else:
                q, v = part.q[-1], part.v[-1]
                t += span
        self._ended = "step_too_small"
        self._message = f"the independent coordinates changed {_MOST} times up to t = {t:.6g} s"

    def _behind(self, chart: Chart, q: Array, v: Array, t: float) -> float:
        """Return the time, s, in which a motion goes from near a singular pose to well behind it."""
        size, step = float(np.abs(v).max()), 1e-6
        if not size:
            return np.inf
        near = self.system.nearness(chart, q, t)
        rate = abs(self.system.nearness(chart, q + step / size * v, t) - near) * size / step
        return _FAR * max(near, SINGULAR) / rate if rate else np.inf

    def _take(self, part: RunData, way: _Way, chart: Chart, left: list[float] | None) -> str:
        """Add a part; return why the run goes on from its end on another chart, or nothing."""
        begin, stats = way.begin, part.stats
        name = part.events[-1].name if stats.ended == "event" else ""
        worn = name == _WORN or (name == _NEAR and self.passes)
        saved = None if left is None else {s - begin: s for s in left}
        for k, (s, u, w) in enumerate(zip(part.t.tolist(), part.q, part.v, strict=True)):
            if saved is None:
                if k and not (worn and k == len(part.t) - 1):
                    self._states.append((begin + s, *way.state(s, u, w)))
            elif s in saved and s > 0:
                self._states.append((saved[s], *way.state(s, u, w)))
        for hit in part.events:
            if hit.name == _WORN:
                continue
            q, v = way.state(hit.t, hit.q, hit.v)
            self.hits.append(replace(hit, t=begin + hit.t, q=q, v=v))
            if hit.name == _NEAR:
                self._near.append((begin + hit.t, self.system.nearness(chart, q, begin + hit.t)))
        if worn:
            return name
        self._ended, self._message = stats.ended, stats.message
        end = begin + cast("float", stats.reached)
        if name == _NEAR:
            self._undetermined()
        elif self._ended == "event":
            self._message = f"stopped by {self.hits[-1].name} at t = {end:.6g} s"
            self._keep_end(end, self.hits[-1].q, self.hits[-1].v)
        elif self._ended != "finished":
            self._message = self._message.rpartition(" after t = ")[0] + f" after t = {end:.6g} s"
        return ""

    def _undetermined(self) -> None:
        """End at a singular pose of a choice that stays."""
        hit = self.hits[-1]
        self._ended = "step_too_small"
        self._message = (
            f"ended {_NEAR} at t = {hit.t:.6g} s, where {', '.join(self.system.independent or ())} no longer determine "
            "the motion; lag.embedded() changes the choice"
        )
        self._keep_end(hit.t, hit.q, hit.v)

    # With a fixed step

    def _stepped(self, q: Array, v: Array, grid: Grid) -> None:
        system, stays = self.system, self.system.independent is not None
        kept = set(grid.kept(self._save, 2 * len(q)).tolist())
        if 0 in kept:
            self._states.append((grid.start, q, v))
        k, chart, was_near = 0, None, False
        while k < grid.steps:
            t, first = grid.time(k), k
            self._bar.update(k / grid.steps)
            way = _Way(self, chart or system.chart(q, t), q, v, t, new=chart is None)
            chart = cast("Chart", way.chart)
            part = self.integrated(way, q, v, grid.span(k, min(k + _BLOCK, grid.steps)), dt=grid.dt)
            cast("EmbeddedDynamics", way.dyn).remember(q)
            worn = False
            for s, u, w in zip(part.t[1:].tolist(), part.q[1:], part.v[1:], strict=True):
                k += 1
                t = grid.time(k)
                q, v = way.at(s).state(u, w)
                if k in kept:
                    self._states.append((t, q, v))
                near = system.nearness(chart, q, t)
                if near < SINGULAR and not was_near:
                    self._near.append((t, near))
                    self.hits.append(Hit(_NEAR, t, q, v))
                    if stays:
                        self._undetermined()
                        return
                was_near = near < SINGULAR
                worn = not stays and system.quality(chart, q, t) < system.least
                if worn:
                    break
            if worn or (not part.stats.finished and k > first and not stays):
                chart = None
            elif not part.stats.finished:
                self._ended = part.stats.ended
                # Of the run, and not of its last block.
                now = f"after t = {t:.6g} s (step {k + 1})"
                self._message = re.sub(r"after t = \S+ s \(step \d+\)", now, part.stats.message)
                return


class _Way:
    """One part of a run: on a chart, or on all coordinates where that is None; its time runs from `begin`, s.

    Dependent coordinates are searched from those kept nearest in time, since a place far off may lie on another branch.
    """

    def __init__(self, run: _Run, chart: Chart | None, q: Array, v: Array, begin: float, *, new: bool = True) -> None:
        self._run, self.chart, self.begin = run, chart, begin
        self.dyn: Dynamics = run.system.dynamics if chart is None else run.system.on(chart, q, begin)
        self._times, self._places = [0.0], [q]
        if chart is not None and new:
            run.hits.append(Hit(f"independent: {run.system.names(chart)}", begin, q.copy(), v.copy()))

    def at(self, t: float) -> EmbeddedDynamics:
        """Return the dynamics at a time of the part."""
        return cast("EmbeddedDynamics", at_time(self.dyn, t))

    def state(self, t: float, u: Array, w: Array) -> tuple[Array, Array]:
        """Return q and v at a time of the part, from the nearest kept configuration."""
        if self.chart is None:
            return u, w
        near = int(np.abs(np.array(self._times) - t).argmin())
        self.at(self._times[near]).remember(self._places[near])
        return self.at(t).state(u, w)

    def _passed(self, t: float, u: Array) -> Array:
        """Return the configuration at or near a step's end, and keep it."""
        if self._times[-1] == t:
            return self._places[-1]
        q = self.at(t).configuration(u)
        self._times.append(t)
        self._places.append(q)
        if t >= max(self._times):
            self._run.poses.saw(self.begin + t, q)
        return q

    def torque(self) -> Any:
        """Return the run's force on the part's coordinates."""
        force, begin = self._run.force, self.begin
        if isinstance(force, np.ndarray):
            if self.chart is None or not force.any():
                return force if self.chart is None else None
            return lambda t, u, _w: self.at(t).pullback(u, force)
        if self.chart is None:
            return lambda t, q, v: np.asarray(force(begin + t, q, v))

        def pulled(t: float, u: Array, w: Array) -> Array:
            own = self.at(t)
            return own.pullback(u, force(begin + t, *own.state(u, w)))

        return pulled

    def events(self) -> list[Event]:
        """Return the run's events on the part's coordinates, and those of its chart."""
        out = [self._shifted(event) for event in self._run.events]
        if self.chart is not None:
            out.append(self._watch(self.chart, _NEAR))
            if self._run.system.independent is None:
                out.append(self._watch(self.chart, _WORN))
        return out

    def _shifted(self, event: Event) -> Event:
        def function(t: float, u: Array, w: Array) -> float:
            state = (u, w) if self.chart is None else self.at(t).state(u, w)
            return event.function(self.begin + t, *state)

        return replace(event, function=function)

    def _watch(self, chart: Chart, what: str) -> Event:
        system = self._run.system
        measure, limit = (system.quality, system.least) if what == _WORN else (system.nearness, SINGULAR)

        def function(t: float, u: Array, _w: Array) -> float:
            # Its logarithm is nearly straight where the value itself bends to zero.
            try:
                value = measure(chart, self._passed(t, u), self.begin + t)
            except NumericalError:
                value = 0.0
            return float(np.log(max(value, _LEAST) / limit))

        # On coordinates that stay, the motion beyond the pose would come out wrong.
        return Event(function, what, direction=-1, terminal=what == _WORN or system.model.time_parameter is None)
