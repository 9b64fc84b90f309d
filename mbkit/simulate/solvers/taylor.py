"""heyoka's adaptive Taylor method: in double on the own derivation, with 34 digits on the oracle.

A step's series is also its interpolant, as accurate as the step. Only jumps of a held torque end steps early.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.codegen.taylor import Precision, TaylorSystem, precision, taylor_system
from mbkit.engines.base import at_time
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import FunctionError, NumericalError, UnsupportedError
from mbkit.methods.registry import ADAPTIVE_METHOD, SCIPY_METHOD
from mbkit.model import Model
from mbkit.model.manifold import magnitude, unit_quaternions
from mbkit.simulate.events import State, Watch
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import Ended, SolverResult
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord, assemble_result, record_of
from mbkit.simulate.solvers.vector_field import DIVERGED, Rates, is_bounded

# Of a rate, relative to the largest or 1: what no truncation of a series makes.
_JUMP: Final = 1e-6


def run_taylor(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or each of a batch by itself.

    The tolerance bounds each step's error, with the smaller of rtol and atol: absolute up to a factor of ten in the
    numbers of the start, whatever their sizes are, and relative to the largest where the state outgrows them.
    Without `save`, the method's own steps are kept. An evaluation is that of a whole
    series, one a step.

    Raises
    ------
    UnsupportedError
        heyoka is not installed; another engine; a torque that is a function, of which
        there is no series; or a model too large to be written out.
    """
    dyn, save, torque = problem.dyn, problem.save, problem.torque
    if torque.callable:
        raise UnsupportedError(
            f"{problem.method}: a torque function has no Taylor series; use method={ADAPTIVE_METHOD!r} "
            f"or {SCIPY_METHOD!r}, or an array held over each interval of save"
        )
    if not isinstance(dyn, (LagrangianDynamics, OracleDynamics)):
        raise UnsupportedError(
            f"{problem.method}: not on the {dyn.engine} engine; use mbkit.dynamics(model, 'lagrangian')"
        )
    kind = precision(dyn.bits)
    system, tolerance = taylor_system(dyn.equations), max(min(problem.tolerances) / magnitude(problem.y), kind.eps)
    ends = [problem.end, *(save.tolist() if save is not None and torque.held else [])]
    stops = sorted({*ends} - {problem.start})
    members = []
    with system.integrator(kind, tolerance) as integrator:
        for i, start in enumerate(problem.y):
            which = problem.member(i)
            own: Any = dyn if which is None else dyn.of_samples([which])
            # With 34 digits the drift is far below what a double tells.
            settled = Rates(own).settled if dyn.model.constrained and kind.bits == 53 else None
            steps = TaylorSteps(system, integrator, kind, _behind(own, kind), settled)
            watch = Watch(problem.events, which) if problem.events else None
            one = _Run(own, steps, watch, record_of(problem, i), problem.report(i))
            members.append(one.all(problem.start, start, stops, torque.of_member(which)))
    evaluations = sum(member.steps for member in members)
    return assemble_result(problem, members, evaluations=evaluations)


def _behind(dyn: LagrangianDynamics | OracleDynamics, kind: Precision) -> Any:
    """Return the numbers that the equations take behind tau."""
    if isinstance(dyn, OracleDynamics):
        return kind.array(*dyn.constant_values)
    return dyn.parameter_values.reshape(-1)


class StoppedError(Exception):
    """A state that has no next one; never leaves mbkit. `ended` is as in `Stats`."""

    def __init__(self, ended: Ended, message: str) -> None:
        super().__init__(message)
        self.ended = ended


class TaylorSteps:
    """Steps of one trajectory at a time, with a borrowed integrator; t0, y0 and t, y are the ends of the last one.

    `behind` are the values of the equations' trailing argument; settled(t, y) is the state to go on from after a step.
    """

    def __init__(
        self,
        system: TaylorSystem,
        integrator: Any,
        kind: Precision,
        behind: Any,
        settled: Callable[[float, Array], Array] | None = None,
    ) -> None:
        import heyoka

        self._system, self._integrator, self._kind, self._behind = system, integrator, kind, behind
        self._settled = settled
        self._success, self._limit = heyoka.taylor_outcome.success, heyoka.taylor_outcome.time_limit
        self.t0 = self.t = 0.0
        self.y0 = self.y = np.empty(0)

    def __call__(self, t0: float, y0: Any, stops: Sequence[float], force: Callable[[int], Any]) -> Iterator[float]:
        """Take steps from t0 to the last stop that end at each stop, under force(k) before the k-th; yield their ends.

        Raises `StoppedError` where there is no step; t and y are the last good ones.
        """
        integrator, kind = self._integrator, self._kind
        state = integrator.state
        integrator.time = kind.dtype(t0)
        state[:] = y0
        self.t0 = self.t = t0
        self.y0 = self.y = state.copy()
        # 1/eps steps would never end, though near t = 0 they are above rounding.
        least = (stops[-1] - t0) * kind.eps if stops else 0.0
        last = kind.dtype(0.0)
        for k, stop in enumerate(stops):
            self._system.fill(integrator, force(k), self._behind)
            end = kind.dtype(stop)
            while self.t < stop:
                before = integrator.time
                outcome, h = integrator.step(max_delta_t=end - before, write_tc=True)
                # A step like the last one needs no second look.
                if h > 1.5 * last and h > 2 * (holds := self._holds()):
                    integrator.time, state[:] = before, self.y
                    outcome, h = integrator.step(max_delta_t=kind.dtype(holds), write_tc=True)
                    outcome = self._success if outcome == self._limit else outcome
                last = h
                if outcome == self._limit:
                    integrator.time = end
                elif outcome != self._success:
                    raise self._without_series()
                elif h < least:
                    raise StoppedError("step_too_small", "step below rounding: singular or diverging")
                if not is_bounded(_rounded(state)):
                    raise StoppedError("diverged", DIVERGED)
                if self._system.kinked and self._jumped(float(h), force(k)):
                    raise StoppedError(
                        "step_too_small",
                        f"a force jumps, which a series cannot follow and method={ADAPTIVE_METHOD!r} can,",
                    )
                if self._settled is not None:
                    state[:] = self._settled(float(integrator.time), _rounded(state))
                self.t0, self.y0 = self.t, self.y
                self.t, self.y = float(integrator.time), state.copy()
                yield self.t

    def _without_series(self) -> StoppedError:
        """Return why there was no step: the state ran away, or its rates are numbers and their derivatives none."""
        series = _rounded(self._integrator.tc)
        if np.isfinite(series[:, :2]).all() and np.isnan(series[:, 2:4]).any():
            return StoppedError(
                "step_too_small",
                f"a root or power of zero, which has no Taylor series and method={ADAPTIVE_METHOD!r} goes past,",
            )
        return StoppedError("diverged", DIVERGED)

    def _holds(self) -> float:
        """Return how long a step the last series allows, by its last six orders.

        heyoka takes the last two, which may vanish by symmetry: a pendulum from the horizontal has every fourth term.
        """
        series = np.abs(_rounded(self._integrator.tc))
        order = series.shape[1] - 1
        orders = np.arange(max(1, order - 5), order + 1)
        sizes = np.maximum(series[:, orders].max(axis=0), np.finfo(float).tiny)
        radius = (max(1.0, series[:, 0].max()) / sizes) ** (1 / orders)
        return float(radius.min() * np.exp(-2 - 0.7 / (order - 1)))

    def _jumped(self, h: float, force: Array) -> bool:
        """Return whether the rates at the end of a step of length h are others than the series says."""
        nq, state = self._system.rates.size1_in(0), _rounded(self._integrator.state)
        behind = [_rounded(self._behind).copy()] if self._system.rates.n_in() > 3 else []
        if self._system.clock is not None:
            behind[0][self._system.clock] = float(self._integrator.time)
        found = self._system.rates(state[:nq], state[nq:], force, *behind)
        rate = np.concatenate([np.asarray(x).ravel() for x in found])
        series = _rounded(self._integrator.tc)
        powers = np.arange(1, series.shape[1])
        slope = series[:, 1:] @ (powers * h ** (powers - 1))
        # Far above what truncation does, far below what a force does that turns round.
        allowed = max(_JUMP, 1e3 * float(self._integrator.tol)) * max(1.0, float(np.abs(rate).max()))
        return not bool(np.abs(rate - slope).max() <= allowed)

    def at(self, t: float) -> Any:
        """Return the state at a time within the last step, of the format's own type."""
        if t == self.t:
            return self.y
        if t == self.t0:
            return self.y0
        return self._integrator.update_d_output(self._kind.dtype(t)).copy()


class _Run:
    """One trajectory."""

    def __init__(
        self,
        dyn: LagrangianDynamics | OracleDynamics,
        steps: TaylorSteps,
        watch: Watch | None,
        member: TrajectoryRecord,
        done: Callable[[float], None],
    ) -> None:
        self._dyn, self._steps, self._watch, self._done = dyn, steps, watch, done
        self._member = member

    def all(self, t0: float, y0: Array, stops: Sequence[float], force: Callable[[int], Any]) -> TrajectoryRecord:
        """Return what comes of it."""
        member, steps = self._member, self._steps
        member.reached = t0
        member.begin(t0, y0)
        try:
            if self._watch is not None:
                self._watch.start(t0, *_state(self._dyn.model, y0))
            for t in steps(t0, y0, stops, force):
                member.steps += 1
                if self._watch is not None and self._ends(t, self._watch):
                    return member
                member.reached = t
                self._keep(t)
                member.saw(t, _rounded(steps.y)[: self._dyn.model.nq])
                self._done(t)
                if member.crawls():
                    return member
        except StoppedError as error:
            interval = int(np.searchsorted(stops, steps.t, side="right"))
            why = self._reason(force(min(interval, len(stops) - 1))) if error.ended == "diverged" else ""
            member.stop(error.ended, f"diverged: {why}" if why else str(error))
        except FunctionError as error:
            member.fail(error)
        return member

    def _ends(self, t: float, watch: Watch) -> bool:
        """Look for events of the last step, and end where one says so."""
        hits, last = watch.look(t, self._within())
        self._member.events += hits
        if last is None:
            return False
        self._keep(last.t)
        self._member.stop_at(last)
        return True

    def _within(self) -> State:
        return lambda t: _state(self._dyn.model, _rounded(self._steps.at(t)))

    def _keep(self, end: float) -> None:
        """Keep what is wanted of the last step, up to a time."""
        self._member.keep_step(self._steps.t, end, lambda t: _rounded(self._steps.at(t)))

    def _reason(self, force: Array) -> str:
        """Return why there is no step from the last good state, in the engine's words if it has some."""
        y = _rounded(self._steps.y)
        # An engine overflows before its state does, and blames the model for it.
        if np.abs(y).max() < 1e50:
            try:
                q, v = _state(self._dyn.model, y)
                # One of a batch with parameters of its own is a batch of one.
                at_time(self._dyn, self._steps.t).forward_dynamics(q, v, force)
            except NumericalError as error:
                return str(error)
        return DIVERGED


def _rounded(y: Any) -> Array:
    return np.asarray(y, dtype=np.float64)


def _state(model: Model, y: Array) -> tuple[Array, Array]:
    return unit_quaternions(model, y[: model.nq])[0], y[model.nq :]
