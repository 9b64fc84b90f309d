"""Runs on independent coordinates, from chart to chart.

With a tolerance, a change of the chart and the way into a singular pose are events of the run. With a fixed step the
chart is looked at behind each step. At a singular pose the constraints depend on each other and no chart serves: a run
with a tolerance goes through it on all coordinates, with multipliers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from mbkit._check import EPS, Array, finite_array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.errors import FunctionError, MbkitWarning, NumericalError, UnsupportedError, warn
from mbkit.lagrangian.independent_coordinates import SINGULAR_VALUE_RATIO, Chart, Embedded
from mbkit.methods.registry import METHODS, method_of
from mbkit.model.integration_space import Space
from mbkit.simulate.constraint_projection import along_constraints
from mbkit.simulate.events import Event, Hit
from mbkit.simulate.integrate import integrate
from mbkit.simulate.problem import IntegrationProblem, RunRequest, Solver
from mbkit.simulate.run_data import Ended, RunData, SolverResult
from mbkit.simulate.singular_poses import SingularPoses
from mbkit.simulate.solvers.fixed_step import Step, SteppedRun, Stepper, make_step
from mbkit.simulate.solvers.stretches import Stretch, run_in_stretches
from mbkit.simulate.solvers.trajectory_record import GridRecord, assemble_result
from mbkit.simulate.solvers.vector_field import DivergenceError, Field
from mbkit.simulate.time_grid import Indices
from mbkit.simulate.torque import Force, Torque

_WORN: Final = "the dependent coordinates are badly chosen"
_NEAR: Final = "near a singular pose"
_ENDLESS: Final = "stopped at t = {t:.9g} s, where no independent coordinates serve: charts end where they begin"


def integrate_on_charts(system: Embedded, request: RunRequest) -> tuple[RunData, FunctionError | None]:
    """Integrate one state on all coordinates, as `mbkit.simulate.integrate.integrate` does."""
    model, method = system.model, method_of(request.method)
    if request.wrenches:
        raise UnsupportedError(
            "wrenches: a system written as energies has no frames; give the generalized force, torque="
        )
    # Charts have no derivatives and no expressions.
    usable = [m.name for m in METHODS.values() if not m.engines and not m.jacobian]
    if method.name not in usable:
        raise UnsupportedError(
            f"{method.name}: not on independent coordinates, which Newton's iteration leads to; "
            f"use {', '.join(usable)}, or the form with multipliers, lag.dynamics()"
        )
    finite_array("q0", request.q0, (model.nq,))
    finite_array("v0", request.v0, (model.nv,))
    return integrate(system.dynamics, request, lambda problem, solver: _run(system, problem, solver))


def _run(system: Embedded, problem: IntegrationProblem, solver: Callable[[Dynamics], Solver]) -> SolverResult:
    charts = _Charts(system)
    charts.saw(problem.start, problem.q0)
    if problem.equal_steps is None:
        record = run_in_stretches(problem, 0, charts.stretch, solver, _ENDLESS)
        # Charts look for poses on all of the way.
        record.passed = charts.passed
        if record.ended == "event" and record.events[-1].name == _NEAR:
            record.ended, record.message = charts.undetermined(record.reached)
        result = assemble_result(problem, [record])
    else:
        steps = GridRecord(problem)
        stepper = _ChartStepper(charts, problem.method, steps)
        run = SteppedRun(problem, stepper, problem.v0.copy(), steps)
        run.to_end()
        steps.evaluations = sum(x.evaluations for x in stepper.fields)
        steps.poses = {0: charts.passed}
        result = steps.result(lambda _: run.why)
    poses = charts.near | {hit.t: hit.q for hit in result.events if hit.name == _NEAR}
    for t, q in sorted(poses.items()):
        warn(
            f"{system.model.name}: {_NEAR} at t = {t:.6g} s: the smallest singular value there is "
            f"{system.nearness(system.chart(q, t), q, t):.3g} of the largest",
            MbkitWarning,
        )
    return along_constraints(system.dynamics, result)


class _OnChart:
    """A part of a run on a chart, from a state on all coordinates on.

    Dependent coordinates are searched from those kept nearest in time, since a place far off may lie on another branch.
    """

    def __init__(self, system: Embedded, saw: Callable[[float, Array], None], t: float, q: Array, v: Array) -> None:
        self.system, self.chart, self._saw = system, system.chart(q, t), saw
        self.dyn = system.on(self.chart, q, t)
        self.begin = Hit(f"independent: {system.names(self.chart)}", t, q.copy(), v.copy())
        #: Times of steps' ends and near them, and configurations there.
        self._places = [(t, q)]

    def start(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return a state on the chart."""
        return q[self.chart.independent], v[self.chart.independent]

    def states(self, t: Array, u: Array, w: Array) -> tuple[Array, Array]:
        """Return states at some times on all coordinates."""
        out = tuple(np.empty((len(t), self.system.model.nv)) for _ in "qv")
        for k, s in enumerate(t.tolist()):
            near, place = min(self._places, key=lambda x: abs(x[0] - s))
            at_time(self.dyn, near).remember(place)
            out[0][k], out[1][k] = self.state(s, u[k], w[k])
        return out[0], out[1]

    def state(self, t: float, u: Array, w: Array) -> tuple[Array, Array]:
        """Return q and v on all coordinates, searched from where a search last ended."""
        return at_time(self.dyn, t).state(u, w)

    def pulled(self, force: Force) -> Force:
        """Return a force on the coordinates of the chart."""
        if isinstance(force, np.ndarray):
            if not force.any():
                return np.zeros(self.dyn.model.nv)
            return lambda t, u, _w: at_time(self.dyn, t).pullback(u, force)
        return lambda t, u, w: at_time(self.dyn, t).pullback(u, force(t, *self.state(t, u, w)))

    def events(self, events: Sequence[Event]) -> Sequence[Event]:
        """Return the run's events on the chart, and those of the chart."""
        watched = [_NEAR] if self.system.independent else [_NEAR, _WORN]
        return [*map(self._on_chart, events), *map(self._watch, watched)]

    def _on_chart(self, event: Event) -> Event:
        return replace(event, function=lambda t, u, w: event.function(t, *self.state(t, u, w)))

    def _watch(self, what: str) -> Event:
        system = self.system
        measure, limit = (system.quality, system.least) if what == _WORN else (system.nearness, SINGULAR_VALUE_RATIO)

        def function(t: float, u: Array, _w: Array) -> float:
            # Its logarithm is nearly straight where the value itself bends to zero.
            try:
                value = measure(self.chart, self._place(t, u), t)
            except NumericalError:
                value = 0.0
            return float(np.log(max(value, EPS) / limit))

        # On coordinates that stay, the motion beyond the pose would come out wrong.
        return Event(function, what, direction=-1, terminal=what == _WORN or system.model.time_parameter is None)

    def _place(self, t: float, u: Array) -> Array:
        """Return the configuration at or near a step's end, and keep it."""
        if self._places[-1][0] != t:
            self._places.append((t, at_time(self.dyn, t).configuration(u)))
            self._saw(*self._places[-1])
        return self._places[-1][1]


class _PulledBack(Torque):
    """The force of a run on the coordinates of a chart."""

    def __init__(self, torque: Torque, chart: _OnChart) -> None:
        vars(self).update(vars(torque))
        self._chart = chart

    def during(self, k: int, members: int | Indices | None) -> Force:
        return self._chart.pulled(super().during(k, members))

    def sample(self, k: int, t: float, q: Array, v: Array, members: Indices | None = None) -> None:
        super().sample(k, t, *self._chart.states(np.array([t]), q, v), members)


class _Charts:
    """The charts of a system; near singular poses stretches on all coordinates stand between them."""

    def __init__(self, system: Embedded) -> None:
        self.system, self.stays, self.passed = system, system.independent is not None, SingularPoses(system.dynamics)
        #: The run goes through singular poses: the choice is open, and nothing is moved in time.
        self._passes = not self.stays and system.model.time_parameter is None
        #: Configurations near singular poses with which stretches begin, by their times.
        self.near: dict[float, Array] = {}
        self._seen = -np.inf

    def saw(self, t: float, q: Array) -> None:
        """Look for singular poses at the end of a step; a search within a step that was seen tells nothing."""
        if t > self._seen:
            self.passed.saw(t, q)
            self._seen = t

    def stretch(self, t: float, q: Array, v: Array, *, across: bool = False) -> Stretch:
        """Return the stretch from a state on: on the best chart, or on all coordinates `across` a singular pose."""
        on = _OnChart(self.system, self.saw, t, q, v)
        near = self.system.nearness(on.chart, q, t)
        if near < SINGULAR_VALUE_RATIO:
            self.near[t] = q
        if across or (near < SINGULAR_VALUE_RATIO and self._passes):
            # Steps end behind the pose, where their errors are not those of a state within a step.
            until = t + self._behind(on.chart, q, v, t)
            return Stretch(dyn=self.system.dynamics, q=q, v=v, until=until, follow=self._follow)
        own: dict[str, Any] = {name: getattr(on, name) for name in ("dyn", "start", "states", "events")}
        own |= {"torque": lambda torque: _PulledBack(torque, on), "begins": [on.begin], "end": _WORN}
        return Stretch(q=q, v=v, follow=self._follow, **own)

    def _follow(self, hit: Hit | None, t: float, q: Array, v: Array, _moved: bool) -> Stretch | None:
        across = hit is not None and hit.name == _NEAR
        if hit is None or hit.name == _WORN or (across and self._passes):
            return self.stretch(t, q, v, across=across)
        return None

    def undetermined(self, t: float) -> tuple[Ended, str]:
        """Return the end at a singular pose of a choice that stays."""
        return "step_too_small", (
            f"ended {_NEAR} at t = {t:.6g} s, where {', '.join(self.system.independent or ())} no longer determine the "
            "motion; lag.embedded() changes the choice"
        )

    def _behind(self, chart: Chart, q: Array, v: Array, t: float) -> float:
        """Return the time, s, in which a motion goes from near a singular pose to well behind it."""
        size, step = float(np.abs(v).max()), 1e-6
        if not size:
            return np.inf
        near = self.system.nearness(chart, q, t)
        rate = abs(self.system.nearness(chart, q + step / size * v, t) - near) * size / step
        # Behind the pose charts serve again at some times the distance at which they end.
        return 20 * max(near, SINGULAR_VALUE_RATIO) / rate if rate else np.inf


class _ChartStepper(Stepper):
    """Fixed steps on a chart, from and to all coordinates."""

    def __init__(self, charts: _Charts, method: str, record: GridRecord) -> None:
        self._charts, self._method, self._record = charts, method, record
        self._on: _OnChart | None = None
        self._step: Step
        #: One for each chart, which count evaluations.
        self.fields: list[Field] = []
        self._near = False

    def __call__(self, t: float, h: float, q: Array, v: Array, force: Force) -> tuple[Array, Array]:
        if self._on is not None:
            try:
                return self._stepped(self._on, t, h, q, v, force)
            except DivergenceError:
                if self._charts.stays:
                    raise
        self._on = _OnChart(self._charts.system, self._charts.saw, t, q, v)
        self._record.events.append(self._on.begin)
        space = Space(self._on.dyn.model)
        self.fields.append(Field(self._on.dyn, space))
        self._step = make_step(self._method, self.fields[-1], space)
        return self._stepped(self._on, t, h, q, v, force)

    def _stepped(self, on: _OnChart, t: float, h: float, q: Array, v: Array, force: Force) -> tuple[Array, Array]:
        u, w = self._step(t, h, *on.start(q, v), on.pulled(force))
        try:
            return on.state(t + h, u, w)
        except NumericalError as error:
            raise DivergenceError(str(error)) from None

    def settled(self, t: float, q: Array, w: Array) -> tuple[Array, Array]:
        assert self._on is not None
        charts, chart = self._charts, self._on.chart
        charts.saw(t, q)
        system, before = charts.system, self._near
        self._near = system.nearness(chart, q, t) < SINGULAR_VALUE_RATIO
        if self._near and not before:
            self._record.events.append(Hit(_NEAR, t, q, w))
            if charts.stays:
                self._record.early[0] = charts.undetermined(t)
        if not charts.stays and system.quality(chart, q, t) < system.least:
            self._on = None
        return q, w
