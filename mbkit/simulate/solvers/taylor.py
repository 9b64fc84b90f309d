"""heyoka's adaptive Taylor method: in double on the own derivation, with 34 digits on the oracle.

A step's series is also its interpolant, as accurate as the step. Only jumps of a held torque end steps early.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.codegen.taylor import Precision, TaylorSystem, precision, taylor_system
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.methods.registry import ADAPTIVE_METHOD
from mbkit.model.manifold import magnitude
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.solvers.step_attempts import AcrossPoses
from mbkit.simulate.solvers.trajectory_record import (
    StoppedError,
    TrajectoryRecord,
    assemble_result,
    diverged,
    run_each,
)
from mbkit.simulate.solvers.vector_field import DIVERGED, Rates, is_bounded

#: Smallest jump of a rate, relative to the largest or 1: no truncation of a series makes one.
_MIN_RATE_JUMP: Final = 1e-6


def run_taylor(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or each of a batch by itself.

    The tolerance bounds each step's error, with the smaller of rtol and atol: absolute up to a factor of ten in the
    numbers of the start, whatever their sizes are, and relative to the largest where the state outgrows them. Without
    `save`, the method's own steps are kept. An evaluation is that of a whole series, one a step.
    """
    dyn, torque = problem.dyn, problem.torque
    assert isinstance(dyn, (LagrangianDynamics, OracleDynamics))
    kind, stops = precision(dyn._significand_bits), problem.stops
    system, tolerance = taylor_system(dyn.equations), max(min(problem.tolerances) / magnitude(problem.y), kind.eps)
    # With 34 digits the drift is far below what a double tells.
    across = AcrossPoses.of(problem) if kind.bits == 53 else None
    with system.integrator(kind, tolerance) as integrator:

        def walk(i: int, y: Array, record: TrajectoryRecord) -> Iterator[tuple[float, Array, Any]]:  # noqa: ARG001
            member = problem.member(i)
            own: Any = dyn if member is None else dyn._of_samples([member])
            rates = Rates(own)
            behind = (
                kind.array(*own.constant_values) if dyn._significand_bits > 53 else own._parameter_values.reshape(-1)
            )
            if across is not None:
                across.follow(i)
            steps, held = (
                TaylorSteps(system, integrator, kind, behind, None if across is None else rates.settled, across),
                torque.of_member(member),
            )

            def force(k: int) -> Any:
                problem.sample(i, k, steps.t, rounded(steps.y))
                return held(k)

            try:
                for t in steps(problem.start, y, stops, force):
                    yield t, rounded(steps.y), lambda t: rounded(steps.at(t))
            except StoppedError as error:
                if error.ended != "diverged" or steps.crossed:
                    raise
                last = held(problem.interval(steps.t))
                rates(steps.t, rounded(steps.y), last)
                raise diverged(rates.why) from None

        records = run_each(problem, walk)
    return assemble_result(problem, records, evaluations=sum(record.steps for record in records))


def rounded(y: Any) -> Array:
    """Return numbers of any format as doubles; what no double holds is infinite, and ends a run by its own message."""
    with np.errstate(over="ignore"):
        return np.asarray(y, dtype=np.float64)


class TaylorSteps:
    """Steps of one trajectory at a time, with a borrowed integrator; t0, y0 and t, y are the ends of the last one.

    `behind` are the values of the equations' extra arguments; settled(t, y) is the state to go on from after a step,
    and `across` takes those near a singular pose. `crossed` is whether it took the last one.
    """

    def __init__(
        self,
        system: TaylorSystem,
        integrator: Any,
        kind: Precision,
        behind: Any,
        settled: Callable[[float, Array], Array] | None = None,
        across: AcrossPoses | None = None,
    ) -> None:
        import heyoka

        self._system, self._integrator, self._kind, self._behind = system, integrator, kind, behind
        self._settled, self._across, self.crossed = settled, across, False
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
                # At the pose itself there is no series.
                if self._across is not None and self._stepped_across(
                    k, stop, h if h > 0 and outcome in (self._success, self._limit) else np.inf
                ):
                    integrator.time, state[:] = kind.dtype(self.t), self.y
                    yield self.t
                    continue
                if outcome == self._limit:
                    integrator.time = end
                elif outcome != self._success:
                    raise self._without_series()
                elif h < least:
                    raise StoppedError("step_too_small", "stopped with a step below rounding: singular or diverging")
                if not is_bounded(rounded(state)):
                    raise StoppedError("diverged", DIVERGED)
                if self._system.kinked and self._jumped(float(h), force(k)):
                    raise StoppedError(
                        "step_too_small",
                        f"stopped where a force jumps, which a series cannot follow (method={ADAPTIVE_METHOD!r} can),",
                    )
                if self._settled is not None:
                    state[:] = self._settled(float(integrator.time), rounded(state))
                self.t0, self.y0 = self.t, self.y
                self.t, self.y = float(integrator.time), state.copy()
                yield self.t

    def _stepped_across(self, k: int, stop: float, h: float) -> bool:
        """Take a step across a singular pose if a series of length h would meet one; return whether there was one."""
        assert self._across is not None
        self.crossed = self._across.crosses(self.t, rounded(self.y), float(h))
        if self.crossed:
            self.t0, self.y0 = self.t, self.y
            self.t, self.y = self._across.cross(k, stop)
        return self.crossed

    def _without_series(self) -> StoppedError:
        """Return why there was no step: the state ran away, or its rates are numbers and their derivatives none."""
        series = rounded(self._integrator.tc)
        if np.isfinite(series[:, :2]).all() and np.isnan(series[:, 2:4]).any():
            return StoppedError(
                "step_too_small",
                f"stopped at a root or power of zero, which has no series (method={ADAPTIVE_METHOD!r} goes past it),",
            )
        return StoppedError("diverged", DIVERGED)

    def _holds(self) -> float:
        """Return how long a step the last series allows, by its last six orders.

        heyoka takes the last two, which may vanish by symmetry: a pendulum from the horizontal has every fourth term.
        """
        series = np.abs(rounded(self._integrator.tc))
        order = series.shape[1] - 1
        orders = np.arange(max(1, order - 5), order + 1)
        sizes = np.maximum(series[:, orders].max(axis=0), np.finfo(float).tiny)
        with np.errstate(over="ignore"):
            # Terms that all vanish bound no radius.
            radius = (max(1.0, series[:, 0].max()) / sizes) ** (1 / orders)
        return float(radius.min() * np.exp(-2 - 0.7 / (order - 1)))

    def _jumped(self, h: float, force: Array) -> bool:
        """Return whether the rates at the end of a step of length h are others than the series says."""
        nq, state = self._system.rates.size1_in(0), rounded(self._integrator.state)
        behind = [rounded(self._behind).copy()] if self._system.rates.n_in() > 3 else []
        if self._system.clock is not None:
            behind[0][self._system.clock] = float(self._integrator.time)
        outs = self._system.rates(state[:nq], state[nq:], force, *behind)
        rate = np.concatenate([np.asarray(x).ravel() for x in outs])
        series = rounded(self._integrator.tc)
        powers = np.arange(1, series.shape[1])
        slope = series[:, 1:] @ (powers * h ** (powers - 1))
        # Far above what truncation does, far below what a force does that turns round.
        allowed = max(_MIN_RATE_JUMP, 1e3 * float(self._integrator.tol)) * max(1.0, float(np.abs(rate).max()))
        return not bool(np.abs(rate - slope).max() <= allowed)

    def at(self, t: float) -> Any:
        """Return the state at a time within the last step, of the format's own type."""
        if t == self.t:
            return self.y
        if t == self.t0:
            return self.y0
        if self.crossed:
            return self._across.at(t)  # type: ignore[union-attr]  # crossed by it
        return self._integrator.update_d_output(self._kind.dtype(t)).copy()
