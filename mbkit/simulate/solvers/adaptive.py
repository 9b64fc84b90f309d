"""Adaptive runs of one-step methods with an embedded error on the manifold: rk853, rodas5.

Steps do not depend on what is saved or looked for. A state within a step is computed by a shorter step from the same
start, of the same order as the others; no interpolant adds an error of its own. Compiled attempts are those of
`mbkit.simulate.solvers.adaptive_compiled`; those in NumPy run on any engine and under any torque.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Final, Protocol

import numpy as np

from mbkit._check import Array
from mbkit.errors import FunctionError
from mbkit.methods.one_step import (
    FIRST_ROOT,
    MAX_GROWTH,
    SCALARS,
    ArrayStages,
    elementary_factors,
    embedded_error,
    end_of_attempt,
    first_length,
    next_step,
    predictive_factors,
    with_defect,
)
from mbkit.methods.registry import Tolerances, method_of
from mbkit.methods.tableaus import RosenbrockTableau, dormand_prince_853, rodas5p
from mbkit.model.integration_space import Space
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.diagnostics.stiffness import RateJacobian
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import SolverResult
from mbkit.simulate.singular_poses import LOOSEST, Approach
from mbkit.simulate.solvers.trajectory_record import (
    AcceptedSteps,
    StoppedError,
    TrajectoryRecord,
    assemble_result,
    below_rounding,
    diverged,
)
from mbkit.simulate.solvers.vector_field import DivergenceError, Field, Rates
from mbkit.simulate.torque import Force


class StepAttempts(Protocol):
    """Steps of `width` trajectories side by side, each with times and lengths of its own; `place` is one of them.

    `rounds` are the attempts between two looks at them, at most; 1 where nothing is gained by more.
    """

    width: int
    rounds: int

    @property
    def evaluations(self) -> int:
        """Evaluations of the forward dynamics."""

    @property
    def jacobians(self) -> int:
        """Jacobians of the forward dynamics."""

    def start(self, which: Sequence[int], q: Array, w: Array, t: float = 0.0, h: float = 0.0) -> None:
        """Begin with these members of the batch, (n, nq) and (n, nv); without h the first length is estimated."""

    def hold(self, k: int, stop: float) -> None:
        """Go on to a time, under the force of interval k."""

    def advance(self) -> list[tuple[int, AcceptedSteps]]:
        """Attempt some steps; return the place and accepted steps of each trajectory that had a way to go."""

    def drop(self, place: int) -> None:
        """Leave a trajectory where it is."""

    def stuck(self, place: int) -> StoppedError | None:
        """Return why no step is possible; None while there is one."""

    def tighten(self, place: int, tolerances: Tolerances) -> None:
        """Go on with other tolerances."""

    def rates(self, place: int, q: Array, w: Array) -> Array:
        """Return ẇ at states, (n, nq) and (n, nv), of a trajectory's parameters under the force that acts now."""

    def within(self, place: int, start: AcceptedSteps, times: Array) -> tuple[Array, Array]:
        """Return (q, w) at times, (m, nq) and (m, nv), each by one step from the state of the same row."""


class RungeKuttaAttempts:
    """Attempts of rk853, one step of one trajectory at a time; `StepAttempts` says what its methods do."""

    width = rounds = 1
    #: The power of a step's length with which its estimated error grows.
    grows = 8
    _factors = staticmethod(predictive_factors)
    #: How much longer a step across a singular pose, which is always rk853's, may be than the last one.
    _longer = 1.0

    def __init__(self, problem: IntegrationProblem, space: Space, tolerances: Tolerances) -> None:
        self._space, self._tolerances, self._torque, self._batch = space, tolerances, problem.torque, problem.batch
        self._field, self._tableau, self._wanted = Field(problem.dyn, space), dormand_prince_853(), problem.tolerances
        self._least = problem.duration * float(np.finfo(float).eps)
        self._stages = ArrayStages(self._tableau.stages, (space.nv,))
        self._force: Force = np.zeros(space.nv)
        self._h = self._t = self._stop = 0.0
        self._why = ""
        # What the tolerance is multiplied by, and the length across a singular pose.
        self._slack, self._stretch = 1.0, self._longer

    @property
    def evaluations(self) -> int:
        return self._field.evaluations

    @property
    def jacobians(self) -> int:
        return 0

    @property
    def approach(self) -> Approach:
        """How near a singular pose the run is."""
        return self._field.approach

    def start(self, which: Sequence[int], q: Array, w: Array, t: float = 0.0, h: float = 0.0) -> None:
        (member,) = which
        if self._batch is not None:
            self._field.only(np.array([member]))
        self._of_interval = self._torque.of_member(None if self._batch is None else member)
        self._q, self._w, self._t, self._h = q[0], w[0], t, h
        self._most, self._last, self._error = MAX_GROWTH, FIRST_ROOT, 0.0
        self._dropped, self._fresh = False, True
        self._field.look(t, self._q, self._w)

    def hold(self, k: int, stop: float) -> None:
        self._force, self._stop, self._fresh = self._of_interval(k), stop, True
        if not self._h and not self._dropped:
            self._h = self._first()

    def _first(self) -> float:
        def probe(q: Array, w: Array) -> Array:
            return self._field(self._t, q[0], w[0], self._force)[None]

        q, w = self._q[None], self._w[None]
        try:
            h = float(first_length(self._space, q, w, probe(q, w), self._tolerances, probe, self.grows)[0])
        except DivergenceError:
            h = math.nan
        # Where there is no rate, the step finds that out; at the least length no step would be tried.
        return max(h if h > 0 else 1e-6 * (self._stop - self._t), 2 * self._least)

    def advance(self) -> list[tuple[int, AcceptedSteps]]:
        if self._dropped or self._t >= self._stop or self.stuck(0) is not None:
            return []
        approach = self._field.approach
        length = approach.length(self._h, self._stretch) if approach.crosses(self._stretch * self._h) else self._h
        t = end_of_attempt(SCALARS, self._t, length, self._stop)
        step = t - self._t
        before = [self._t], [self._q], [self._w]
        q, w, self._error = self._checked_attempt(step)
        good = self._error < 1 and step > 0
        self._settle(step, good)
        if good:
            q, w = self._field.settled(t, q, w)
            self._t, self._q, self._w, self._fresh = t, q, w, True
            for row, x in zip(before, (t, q, w), strict=True):
                row.append(x)
        return [(0, AcceptedSteps(np.array(before[0]), np.array(before[1]), np.array(before[2])))]

    def _settle(self, step: float, good: bool) -> None:
        loose = self._slack * self._tolerances.rtol >= LOOSEST
        if self._error >= 1 and not loose and self._field.near_singular:
            # Near a singular pose shorter steps are no better: their stages are nearer to it, and rounding grows.
            across = 0 < self._field.approach.ahead < step
            self._slack, self._h, self._most = 10 * self._slack, step if across else 0.8 * step, 1.0
            return
        self._slack = 1.0 if good else self._slack
        self._stretch = self._longer if good else 1.0
        factors = self._factors(SCALARS, np.float64(self._error if self._error >= 0 else math.nan), self._last)
        # A step of no length, far from the time's zero, ends the run.
        h, self._most, self._last = next_step(
            SCALARS, factors, good, step, self._h if step > 0 else 0.0, self._most, self._last
        )
        self._h = float(h)

    def _checked_attempt(self, step: float) -> tuple[Array, Array, float]:
        try:
            end = self._attempt(step)
        except DivergenceError as error:
            self._why, self._fresh = str(error), True
            return self._q, self._w, math.nan
        self._why, self._fresh = "", False
        return end

    def _attempt(self, step: float) -> tuple[Array, Array, float]:
        """Return q and w after a step, and its error in units of the tolerance."""
        q, w, u = self._step(self._t, self._q, self._w, step, fresh=self._fresh)
        space, (rtol, atol) = self._space, self._tolerances
        sizes = np.maximum(space.magnitude(self._q, u), space.magnitude(q, u)), np.maximum(np.abs(self._w), np.abs(w))
        by_u, by_w = (self._slack * (atol + rtol * x) for x in sizes)
        error = embedded_error(SCALARS, self._tableau.errors, self._stages, (by_u, by_w), step, 2 * space.nv)
        return q, w, float(error)

    def _step(self, t: float, q: Array, w: Array, h: float, *, fresh: bool = True) -> tuple[Array, Array, Array]:
        """Return q, w and u after h; the first stage is there already unless the start is fresh."""

        def rates(t: float, q: Array, u: Array | None, w: Array) -> tuple[Array, Array]:
            if u is None:
                return w, self._field(t, q, w, self._force)
            return self._space.rate(u, w), self._field.consistent(t, q, w, self._force)

        self._stages.keep(0 if fresh else 1)
        return self._tableau.step(self._space, rates, self._stages, t, h, q, w)

    def drop(self, place: int) -> None:  # noqa: ARG002  # there is one
        self._dropped = True

    def stuck(self, place: int) -> StoppedError | None:  # noqa: ARG002
        if self._h > self._least or self._t >= self._stop:
            return None
        return diverged(self._why) if math.isnan(self._error) else below_rounding(self._wanted)

    def tighten(self, place: int, tolerances: Tolerances) -> None:  # noqa: ARG002
        self._tolerances = tolerances

    def rates(self, place: int, q: Array, w: Array) -> Array:  # noqa: ARG002
        try:
            return np.array([self._field(self._t, *state, self._force) for state in zip(q, w, strict=True)])
        except DivergenceError:
            return np.full(w.shape, np.nan)

    def within(self, place: int, start: AcceptedSteps, times: Array) -> tuple[Array, Array]:  # noqa: ARG002
        ends = [self._within(*row) for row in zip(start.t.tolist(), start.q, start.w, times.tolist(), strict=True)]
        return np.array([q for q, _ in ends]), np.array([w for _, w in ends])

    def _within(self, t: float, q: Array, w: Array, end: float) -> tuple[Array, Array]:
        try:
            return self._inner(t, q, w, end)
        except DivergenceError:
            return np.full(q.shape, np.nan), np.full(w.shape, np.nan)

    def _inner(self, t: float, q: Array, w: Array, end: float) -> tuple[Array, Array]:
        self._fresh = True
        return self._step(t, q, w, end - t)[:2]


#: Of a step: how far apart the rates are that tell the time's own part, by a parabola.
_APART: Final = 1e-3


class RosenbrockAttempts(RungeKuttaAttempts):
    """Attempts of rodas5 on y = (q, v), with quaternions as four numbers, whose length the exact flow keeps.

    A state within a step is that of the method's polynomial of order 4: a shorter step would cost as much as the step.
    """

    grows = 5
    _factors = staticmethod(elementary_factors)
    _longer = 8.0

    def __init__(self, problem: IntegrationProblem, space: Space, tolerances: Tolerances) -> None:
        super().__init__(problem, space, tolerances)
        self._model = model = problem.dyn.model
        self._own_rates, self._exact = Rates(problem.dyn), RateJacobian(problem.dyn)
        self._own = rodas5p()
        self._ends, self._d = self._own.c.tolist(), self._own.d
        self._timed = problem.torque.callable or model.time_parameter is not None
        # Each number of y is as large as itself, those of a quaternion as 1.
        self._turning = np.zeros(model.nq + model.nv)
        for start, _ in model.quaternions:
            self._turning[start : start + 4] = 1.0
        # y, ẏ and ∂ẏ/∂y at the start; y and ẏ at the end of the last attempt; its t and y at both ends, and stages.
        self._start: tuple[Array, Array, Array] | None = None
        # The last attempt was rk853's, across a singular pose.
        self._across = False
        self._arrived: tuple[Array, Array] | None = None
        self._last_attempt: tuple[float, float, Array, Array, Array] | None = None

    @property
    def evaluations(self) -> int:
        return self._field.evaluations + self._own_rates.evaluations

    @property
    def jacobians(self) -> int:
        return self._exact.evaluations

    def start(self, which: Sequence[int], q: Array, w: Array, t: float = 0.0, h: float = 0.0) -> None:
        super().start(which, q, w, t, h)
        if self._batch is not None:
            self._own_rates.only(which[0])
            self._exact.only(which[0])

    def _attempt(self, step: float) -> tuple[Array, Array, float]:
        self._across = self._field.approach.crosses(step)
        if self._across:
            # Its stages are not on the constraints, and its derivatives are those of accelerations that grow there.
            self._start, self._fresh = None, True
            return super()._attempt(step)
        own, (rtol, atol) = self._own, self._tolerances
        y, there, J = self._known()
        k = self._increments(self._t, y, step, there, J)
        y1, error, t1 = y + own.b @ k, own.error @ k, self._t + step
        self._last_attempt = self._t, t1, y, y1, k
        scale = atol + rtol * np.maximum(np.maximum(np.abs(y), np.abs(y1)), self._turning)
        size = _norm(error / scale)
        if size < 1:
            rate = self._rate(t1, y1)
            slope = (own.b - own.dense.sum(axis=0)) @ k
            size = float(with_defect(SCALARS, size, _norm((step * rate - slope) / scale)))
            self._arrived = y1, rate
            if not math.isfinite(size):
                raise DivergenceError(self._own_rates.why)
        return *self._state(y1), size

    def _known(self) -> tuple[Array, Array, Array]:
        """Return y, ẏ and ∂ẏ/∂y where the step starts, evaluated once for all attempts from there."""
        if self._fresh or self._start is None:
            self._own_rates.why = ""
            y = self._vector(self._q, self._w)
            arrived, self._arrived = self._arrived, None
            # Where the last step ended the rate is known, unless another force acts from there.
            known = arrived is not None and np.array_equal(arrived[0], y)
            rate = arrived[1] if known and arrived is not None else self._rate(self._t, y)
            self._start = y, rate, self._exact(self._t, y, self._force)
        return self._start

    def hold(self, k: int, stop: float) -> None:
        self._arrived = None
        super().hold(k, stop)

    def _rate(self, t: float, y: Array) -> Array:
        return self._own_rates(t, y, self._force)

    def _vector(self, q: Array, w: Array) -> Array:
        return np.concatenate([q, self._space.to_body_velocity(q, w)])

    def _state(self, y: Array) -> tuple[Array, Array]:
        nq = self._model.nq
        q = unit_quaternions(self._model, y[:nq])[0]
        return q, self._space.to_integrator_velocity(q, y[nq:])

    def _increments(self, t: float, y: Array, h: float, there: Array, J: Array) -> Array:
        """Return what the stages of a step of length h come to, (s, n)."""
        from scipy.linalg import lapack

        own, n = self._own, len(y)
        g = own.gamma * h
        matrix = -g * J
        matrix.flat[:: n + 1] += 1.0
        lu, pivots, _ = lapack.dgetrf(matrix)
        by_time = h * self._by_time(t, y, h, there) if self._timed else None
        k = np.empty((own.stages, n))
        for i in range(own.stages):
            rate = there if not i else self._rate(t + self._ends[i] * h, y + own.A[i, :i] @ k[:i])
            right = g * rate + own.gamma * (own.C[i, :i] @ k[:i])
            if by_time is not None:
                right += (g * self._d[i]) * by_time
            k[i], _ = lapack.dgetrs(lu, pivots, right)
        # A value that was NaN anywhere is NaN here.
        if not np.isfinite(k).all():
            raise DivergenceError(self._own_rates.why)
        return k

    def _by_time(self, t: float, y: Array, h: float, there: Array) -> Array:
        apart = _APART * h
        near, far = self._rate(t + apart, y), self._rate(t + 2 * apart, y)
        return (4 * near - far - 3 * there) / (2 * apart)

    def _inner(self, t: float, q: Array, w: Array, end: float) -> tuple[Array, Array]:
        if self._across:
            return super()._inner(t, q, w, end)
        last = self._last_attempt
        if last is not None and last[0] == t and end <= last[1]:
            t0, t1, y0, y1, k = last
            part = (end - t0) / (t1 - t0)
            one, two, three = self._own.dense @ k
            bend = (1 - part) * (one + part * (two + part * three))
            return self._state((1 - part) * y0 + part * (y1 + bend))
        self._own_rates.why = ""
        y = self._vector(q, w)
        k = self._increments(t, y, end - t, self._rate(t, y), self._exact(t, y, self._force))
        return self._state(y + self._own.b @ k)


def _norm(x: Array) -> float:
    return math.sqrt(float(x @ x) / max(len(x), 1))


def run_embedded(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or a batch of them, each with steps of its own.

    Where the own derivation is compiled and the torque is no function, the steps run as machine code; elsewhere stage
    by stage, by the same formulas. Torques held as an array start a new step at each interval.
    """
    return compiled_or_not(problem, problem.method, partial(_run, problem))


def compiled_or_not(problem: IntegrationProblem, method: str, run: Callable[[bool], SolverResult]) -> SolverResult:
    """Return run(True), in machine code; run(False) where there is none, or where it ends near a singular pose."""
    if _compiles(problem, method):
        # Loads LLVM, which interpreting never needs.
        from mbkit.simulate.solvers.adaptive_compiled import NearSingularPoseError

        with suppress(NearSingularPoseError):
            return run(True)
    return run(False)


def _run(problem: IntegrationProblem, compiled: bool) -> SolverResult:
    space, stops = Space(problem.dyn.model), problem.stops
    attempts = make_attempts(problem, problem.method, space, problem.tolerances, compiled=compiled)
    records = [TrajectoryRecord(problem, i, space) for i in range(len(problem.q))]

    def to_end(group: Sequence[TrajectoryRecord], report: Callable[[], None]) -> None:
        for _ in march(attempts, group, stops):
            report()

    run_groups(problem, space, attempts, records, to_end)
    return assemble_result(problem, records, evaluations=attempts.evaluations, jacobians=attempts.jacobians)


def run_groups(
    problem: IntegrationProblem,
    space: Space,
    attempts: StepAttempts,
    records: Sequence[TrajectoryRecord],
    to_end: Callable[[Sequence[TrajectoryRecord], Callable[[], None]], None],
) -> None:
    """Begin as many trajectories as go side by side, and take them to the end by to_end(group, report)."""
    q0, v0 = problem.q, problem.v
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for first in range(0, len(q0), attempts.width):
            part = slice(first, first + attempts.width)
            group = records[part]
            try:
                for record, q, v in zip(group, q0[part], v0[part], strict=True):
                    record.begin(q, v)
                which = range(first, first + len(group))
                attempts.start(which, q0[part], space.to_integrator_velocity(q0[part], v0[part]), problem.start)
                to_end(group, partial(_report, problem, group, first))
            except FunctionError as error:
                # Where the torque is a function, trajectories run one by one.
                member = getattr(error, "member", None)
                group[0 if member is None else member - first].fail(error)
                break


def _report(problem: IntegrationProblem, group: Sequence[TrajectoryRecord], first: int) -> None:
    done = sum(record.reached - problem.start for record in group) / problem.duration
    problem.bar.update((first + done) / len(problem.q))


def make_attempts(
    problem: IntegrationProblem, method: str, space: Space, tolerances: Tolerances, *, compiled: bool = True
) -> StepAttempts:
    """Return the step attempts of ``"rk853"`` or ``"rodas5"``: machine code where there can be some, and is wanted."""
    if compiled and _compiles(problem, method):
        from mbkit.simulate.solvers.adaptive_compiled import CompiledAttempts

        return CompiledAttempts(problem, space, tolerances, method)
    stiff = isinstance(method_of(method).formula, RosenbrockTableau)
    return (RosenbrockAttempts if stiff else RungeKuttaAttempts)(problem, space, tolerances)


def _compiles(problem: IntegrationProblem, method: str) -> bool:
    """Return whether there can be machine code of an attempt."""
    dyn, stiff = problem.dyn, isinstance(method_of(method).formula, RosenbrockTableau)
    # A compiled step has one value of the time.
    plain = not problem.torque.callable and not dyn.model.time_parameter
    if not (dyn.derived and plain and dyn.model.nv):
        return False
    # Other engines need no CasADi.
    from mbkit.codegen.backend import has_compiler
    from mbkit.derivation.mass_matrix_solve import factors_written_out
    from mbkit.engines.lagrangian import LagrangianDynamics

    small = not stiff or factors_written_out(dyn.model, compiled=True)
    return isinstance(dyn, LagrangianDynamics) and dyn.compile and small and has_compiler()


def march(
    attempts: StepAttempts, group: Sequence[TrajectoryRecord], stops: Sequence[float], first: int = 0
) -> Iterator[list[tuple[int, AcceptedSteps]]]:
    """Take trajectories to the end, from stop `first` on; yields accepted steps after they are recorded."""
    for k in range(first, len(stops)):
        attempts.hold(k, stops[k])
        while accepted := attempts.advance():
            for place, steps in accepted:
                if not group[place].take(steps, partial(attempts.within, place)) or _ended(attempts, place, group):
                    attempts.drop(place)
            yield accepted


def _ended(attempts: StepAttempts, place: int, group: Sequence[TrajectoryRecord]) -> bool:
    reason = attempts.stuck(place)
    if reason is not None:
        group[place].stop(reason)
    return reason is not None or group[place].crawls()
