"""Runs on independent coordinates, from chart to chart.

With a tolerance, a change of the chart and the way into a singular pose are events of the run. With a fixed step the
run goes in blocks of steps; a block ends where its chart is worn. At a singular pose the constraints depend on each
other and no chart serves: the run goes through it on all coordinates, with multipliers.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from typing import Any, Final, cast

import numpy as np

from mbkit._check import Array, finite_array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.errors import FunctionError, MbkitWarning, NumericalError, UnsupportedError, warn
from mbkit.lagrangian.independent_coordinates import SINGULAR_VALUE_RATIO, Chart, Embedded, EmbeddedDynamics
from mbkit.methods.registry import METHODS, Method, method_of
from mbkit.simulate.events import Event, Hit
from mbkit.simulate.integrate import integrate
from mbkit.simulate.problem import IntegrationProblem, RunRequest
from mbkit.simulate.run_data import RunData, SolverResult
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord, assemble_result

_WORN: Final = "the dependent coordinates are badly chosen"
_NEAR: Final = "near a singular pose"
#: Number of fixed steps between two looks at the chart.
_STEPS_PER_LOOK: Final = 100
#: Distance behind a singular pose from which charts serve again, in distances at which they end.
_DISTANCE_BEHIND_POSE: Final = 20
#: Smallest measure of a chart; its logarithm must be finite.
_MIN_MEASURE: Final = 1e-16
#: Most changes of the chart.
_MAX_CHANGES: Final = 10_000


def _on_charts(method: Method) -> bool:
    """Return whether a method needs accelerations alone: charts have no derivatives and no expressions."""
    return not method.engines and not method.jacobian


def integrate_on_charts(system: Embedded, request: RunRequest) -> tuple[RunData, FunctionError | None]:
    """Integrate one state on all coordinates, as `mbkit.simulate.integrate.integrate` does."""
    model, method = system.model, method_of(request.method)
    if request.wrenches:
        raise UnsupportedError(
            "wrenches: a system written as energies has no frames; give the generalized force, torque="
        )
    if not _on_charts(method):
        usable = ", ".join(m.name for m in METHODS.values() if _on_charts(m))
        raise UnsupportedError(
            f"{method.name}: not on independent coordinates, which Newton's iteration leads to; "
            f"use {usable}, or the form with multipliers, lag.dynamics()"
        )
    finite_array("q0", request.q0, (model.nq,))
    finite_array("v0", request.v0, (model.nv,))
    return integrate(system.dynamics, request, lambda problem: _Run(system, problem).result())


class _Run:
    """A run so far, on all coordinates."""

    def __init__(self, system: Embedded, problem: IntegrationProblem) -> None:
        self.system, self.model, self.problem = system, system.model, problem
        # Parts look for the events.
        self.record = TrajectoryRecord(replace(problem, events=()), 0)
        self._force_of = problem.torque.of_member(None)
        self.force: Any = None
        #: The run goes through singular poses: the choice is open, and nothing is moved in time.
        self.passes = system.independent is None and self.model.time_parameter is None
        self._near: list[tuple[float, float]] = []

    def result(self) -> SolverResult:
        """Integrate; return the run."""
        problem = self.problem
        try:
            (self._adaptive if problem.equal_steps is None else self._stepped)(problem.q0, problem.v0)
        except FunctionError as error:
            # A sampled torque failed.
            self.record.fail(error)
        for t, value in self._near:
            warn(
                f"{self.model.name}: {_NEAR} at t = {t:.6g} s: the smallest singular value there is {value:.3g} of the "
                "largest",
                MbkitWarning,
            )
        self.record.events.sort(key=lambda hit: hit.t)
        return assemble_result(problem, [self.record])

    def _keep(self, t: float, q: Array, v: Array) -> None:
        self.record.keep(np.array([t]), q[None], v[None])

    def saw(self, t: float, q: Array) -> None:
        """Look for singular poses at the end of a step."""
        if self.record.passed is not None:
            self.record.passed.saw(t, q)

    def _hold(self, k: int, t: float, q: Array, v: Array) -> None:
        """Take the force from interval or step k on."""
        self.problem.sample(0, k, t, np.concatenate([q, v]))
        self.force = self._force_of(k)

    def integrated(self, way: _Way, q: Array, v: Array, span: float, **options: Any) -> RunData:
        """Return the run of a part, from a state on all coordinates."""
        start = (q, v) if way.chart is None else (q[way.chart.independent], v[way.chart.independent])
        with warnings.catch_warnings():
            # The whole run warns of its end.
            warnings.simplefilter("ignore", MbkitWarning)
            request = RunRequest(*start, span, self.problem.method, torque=way.torque(), t0=0.0, **options)
            part, self.record.error = integrate(way.dyn, request)
        self.record.add(part.stats, way.begin)
        return part

    # With a tolerance

    def _adaptive(self, q: Array, v: Array) -> None:
        problem, system, record, chart = self.problem, self.system, self.record, None
        (rtol, atol), start, t, across, changes = problem.tolerances, problem.start, problem.start, False, 0
        left = None if problem.save is None else problem.save.tolist()
        if left is None or left[0] == t:
            self._keep(t, q, v)
        while t < problem.end:
            left = left and [s for s in left if s > t]
            k = problem.interval(t)
            stop = problem.stops[k]
            self._hold(k, t, q, v)
            new, chart = chart is None, chart or system.chart(q, t)
            near = system.nearness(chart, q, t)
            if near < SINGULAR_VALUE_RATIO:
                across = across or self.passes
                if not (self._near and self._near[-1][0] == t):
                    self._near.append((t, near))
            way = _Way(self, None if across else chart, q, v, t, new=new)
            # Steps end behind the pose, where their errors are not those of a state within a step.
            span = min(stop - t, self._behind(chart, q, v, t)) if across else stop - t
            part = self.integrated(
                *(way, q, v, span),
                save=None if left is None else sorted({*(s - t for s in left if s - t < span), span}),
                events=way.events(),
                progress=lambda done, t=t, span=span: problem.bar.update((t + done * span - start) / problem.duration),
                rtol=rtol,
                atol=atol,
            )
            ended = self._take(part, way, chart, left)
            if not ended and part.stats.ended != "finished":
                return
            if ended:
                last = part.events[-1]
                q, v = way.state(last.t, last.q, last.v)
                t += last.t
            else:
                q, v = way.state(span, part.q[-1], part.v[-1])
                t = stop if span == stop - t else t + span
            record.reached = t
            if ended or across:
                chart, changes = None, changes + 1
            across = ended == _NEAR
            if changes == _MAX_CHANGES:
                record.ended = "step_too_small"
                record.message = f"the independent coordinates changed {_MAX_CHANGES} times up to t = {t:.6g} s"
                return

    def _behind(self, chart: Chart, q: Array, v: Array, t: float) -> float:
        """Return the time, s, in which a motion goes from near a singular pose to well behind it."""
        size, step = float(np.abs(v).max()), 1e-6
        if not size:
            return np.inf
        near = self.system.nearness(chart, q, t)
        rate = abs(self.system.nearness(chart, q + step / size * v, t) - near) * size / step
        return _DISTANCE_BEHIND_POSE * max(near, SINGULAR_VALUE_RATIO) / rate if rate else np.inf

    def _take(self, part: RunData, way: _Way, chart: Chart, left: list[float] | None) -> str:
        """Add a part; return why the run goes on from its end on another chart, or nothing."""
        begin, stats = way.begin, part.stats
        name = part.events[-1].name if stats.ended == "event" else ""
        worn = name == _WORN or (name == _NEAR and self.passes)
        saved = None if left is None else {s - begin: s for s in left}
        for k, (s, u, w) in enumerate(zip(part.t.tolist(), part.q, part.v, strict=True)):
            if saved is None:
                if k and not (worn and k == len(part.t) - 1):
                    self._keep(begin + s, *way.state(s, u, w))
            elif s in saved and s > 0:
                self._keep(saved[s], *way.state(s, u, w))
        for hit in part.events:
            if hit.name == _WORN:
                continue
            q, v = way.state(hit.t, hit.q, hit.v)
            self.record.events.append(replace(hit, t=begin + hit.t, q=q, v=v))
            if hit.name == _NEAR:
                self._near.append((begin + hit.t, self.system.nearness(chart, q, begin + hit.t)))
        if worn:
            return name
        record = self.record
        record.ended, record.message = stats.ended, stats.message
        if name == _NEAR:
            self._undetermined()
        elif stats.ended == "event":
            record.stop_at(record.events[-1])
        elif stats.ended not in ("finished", "function_failed"):
            record.message = record.message.rpartition(" after t = ")[0] + f" after t = {record.reached:.6g} s"
        return ""

    def _undetermined(self) -> None:
        """End at a singular pose of a choice that stays."""
        record = self.record
        record.stop_at(record.events[-1])
        record.ended = "step_too_small"
        record.message = (
            f"ended {_NEAR} at t = {record.events[-1].t:.6g} s, where {', '.join(self.system.independent or ())} no "
            "longer determine the motion; lag.embedded() changes the choice"
        )

    # With a fixed step

    def _stepped(self, q: Array, v: Array) -> None:
        problem, system, grid, record = self.problem, self.system, self.problem.grid, self.record
        kept, stays, torque = set(problem.kept.tolist()), system.independent is not None, problem.torque
        if 0 in kept:
            self._keep(grid.start, q, v)
        k, chart, was_near = 0, None, False
        while k < grid.steps:
            t, first = grid.time(k), k
            problem.bar.update(k / grid.steps)
            self._hold(k, t, q, v)
            end = k + 1 if torque.in_each_step else min(k + _STEPS_PER_LOOK, torque.next_sample(k, grid.steps))
            way = _Way(self, chart or system.chart(q, t), q, v, t, new=chart is None)
            chart = cast("Chart", way.chart)
            part = self.integrated(way, q, v, grid.span(k, end), dt=grid.dt)
            cast("EmbeddedDynamics", way.dyn).remember(q)
            worn = False
            for s, u, w in zip(part.t[1:].tolist(), part.q[1:], part.v[1:], strict=True):
                k += 1
                record.reached = t = grid.time(k)
                q, v = way.at(s).state(u, w)
                if k in kept:
                    self._keep(t, q, v)
                near = system.nearness(chart, q, t)
                if near < SINGULAR_VALUE_RATIO and not was_near:
                    self._near.append((t, near))
                    record.events.append(Hit(_NEAR, t, q, v))
                    if stays:
                        self._undetermined()
                        return
                was_near = near < SINGULAR_VALUE_RATIO
                worn = not stays and system.quality(chart, q, t) < system.least
                if worn:
                    break
            if worn or (not part.stats.finished and k > first and not stays):
                chart = None
            elif not part.stats.finished:
                record.ended = part.stats.ended
                # The message is that of the run, and not of its last block.
                now = f"after t = {t:.6g} s (step {k + 1})"
                record.message = re.sub(r"after t = \S+ s \(step \d+\)", now, part.stats.message)
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
            run.record.events.append(Hit(f"independent: {run.system.names(chart)}", begin, q.copy(), v.copy()))

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
            self._run.saw(self.begin + t, q)
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
        out = [self._shifted(event) for event in self._run.problem.events]
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
        measure, limit = (system.quality, system.least) if what == _WORN else (system.nearness, SINGULAR_VALUE_RATIO)

        def function(t: float, u: Array, _w: Array) -> float:
            # Its logarithm is nearly straight where the value itself bends to zero.
            try:
                value = measure(chart, self._passed(t, u), self.begin + t)
            except NumericalError:
                value = 0.0
            return float(np.log(max(value, _MIN_MEASURE) / limit))

        # On coordinates that stay, the motion beyond the pose would come out wrong.
        return Event(function, what, direction=-1, terminal=what == _WORN or system.model.time_parameter is None)
