"""Attempts of rk853 and rodas5, one step of one trajectory at a time, on any engine and under any torque.

`StepAttempts` says what attempts are asked; those in machine code are in `mbkit.simulate.solvers.adaptive`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from mbkit._attributes import forwarded
from mbkit._check import EPS, Array
from mbkit.methods.one_step import (
    FIRST_ROOT,
    MAX_GROWTH,
    SCALARS,
    STEPS_TO_POSE,
    ArrayStages,
    elementary_factors,
    embedded_error,
    end_of_attempt,
    first_length,
    next_step,
    predictive_factors,
    with_defect,
)
from mbkit.methods.registry import Tolerances
from mbkit.methods.tableaus import EmbeddedTableau, RosenbrockTableau, dormand_prince_853, rodas5p
from mbkit.model.integration_space import Space
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.singular_poses import LOOSEST, Approach
from mbkit.simulate.solvers.gauss import AT_END, StepNearPose, StepPolynomial
from mbkit.simulate.solvers.trajectory_record import AcceptedSteps, StoppedError, below_rounding, diverged
from mbkit.simulate.solvers.vector_field import DivergenceError, Field, Rates
from mbkit.simulate.stiffness_measure import RateJacobian
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
    #: Coefficients of the same steps in machine code.
    formula: Callable[[], EmbeddedTableau | RosenbrockTableau] = staticmethod(dormand_prince_853)

    def __init__(self, problem: IntegrationProblem, space: Space, tolerances: Tolerances) -> None:
        self._space, self._tolerances, self._torque, self._batch = space, tolerances, problem.torque, problem.batch
        self._field, self._tableau, self._wanted = Field(problem.dyn, space), dormand_prince_853(), problem.tolerances
        self._least = problem.duration * EPS
        self._stages = ArrayStages(self._tableau.stages, (space.nv,))
        self._force: Force = np.zeros(space.nv)
        self._h = self._t = self._stop = 0.0
        # The error of a step with 8 stages near a singular pose grows as that of rk853.
        self._why, self._near_pose = "", StepNearPose(self._field, space, 8)
        #: The states within the last step, if it was near a singular pose.
        self._within_last: StepPolynomial | None = None

    @property
    def evaluations(self) -> int:
        return self._field.evaluations

    @property
    def jacobians(self) -> int:
        return 0

    approach: Approach = forwarded("_field.approach", "How near a singular pose the run is.")

    def start(self, which: Sequence[int], q: Array, w: Array, t: float = 0.0, h: float = 0.0) -> None:
        self.follow(*which)
        self._begin(t, q[0], w[0], h)

    def follow(self, member: int) -> None:
        """Go on with this trajectory of a batch."""
        self._member = member
        if self._batch is not None:
            self._field.only(np.array([member]))
        self._of_interval = self._torque.of_member(None if self._batch is None else member)

    def _begin(self, t: float, q: Array, w: Array, h: float = 0.0) -> None:
        self._q, self._w, self._t, self._h = q, w, t, h
        self._most, self._last, self._error = MAX_GROWTH, FIRST_ROOT, 0.0
        self._dropped, self._fresh = False, True
        self._field.look(t, q, w)

    def go_on(self, most: float, last: float) -> None:
        """Take over what the next length may be at most, and the root of the last error, from steps made elsewhere."""
        self._most, self._last = most, last

    @property
    def now(self) -> tuple[float, Array, Array, float, float, float]:
        """The time, q and w, and with what steps made elsewhere go on: the next length, and what `go_on` takes."""
        return self._t, self._q, self._w, self._h, self._most, self._last

    @property
    def passed(self) -> bool:
        """Whether the last step was accepted and no singular pose is near."""
        return self._error < 1 and not self._field.near_singular

    def hold(self, k: int, stop: float) -> None:
        if self._torque.samples is not None and not self._dropped:
            v = self._space.to_body_velocity(self._q, self._w)
            self._torque.sample(k, self._t, self._q[None], v[None], np.array([self._member]))
        self._force, self._stop, self._fresh = self._of_interval(k), stop, True
        if not self._h and not self._dropped:
            self._h = self._first()

    def _first(self) -> float:
        def probe(q: Array, w: Array) -> Array:
            try:
                return self._field(self._t, q[0], w[0], self._force)[None]
            except DivergenceError:
                # At a singular pose there is a motion, and no rate.
                return np.zeros(w.shape)

        q, w = self._q[None], self._w[None]
        h = float(first_length(self._space, q, w, probe(q, w), self._tolerances, probe, self.grows)[0])
        # The step finds out where there is no rate; at the least length no step would be tried.
        return max(h if h > 0 else 1e-6 * (self._stop - self._t), 2 * self._least)

    def advance(self) -> list[tuple[int, AcceptedSteps]]:
        if self._dropped or self._t >= self._stop or self.stuck(0) is not None:
            return []
        end = end_of_attempt(SCALARS, self._t, self._h, self._stop)
        step = end - self._t
        start, self._within_last = (self._t, self._q, self._w), None
        near = self._field.approach.crosses(self._h) and abs(float(self.approach.ahead)) < AT_END * self._reach * step
        end, q, w, self._error = self._checked_attempt(end, self._attempt_near_pose if near else self._attempt)
        good = self._error < 1 and step > 0
        self._settle(step, good)
        return [(0, _accepted(start, self._arrive(end, q, w)) if good else _accepted(start))]

    def _arrive(self, t: float, q: Array, w: Array) -> tuple[float, Array, Array]:
        q, w = self._field.settled(t, q, w)
        self._t, self._q, self._w, self._fresh = t, q, w, True
        return t, q, w

    def _settle(self, step: float, good: bool) -> None:
        factors = self._factors(SCALARS, np.float64(self._error if self._error >= 0 else math.nan), self._last)
        # A step of no length, far from the time's zero, ends the run.
        h, self._most, self._last = next_step(
            SCALARS, factors, good, step, self._h if step > 0 else 0.0, self._most, self._last
        )
        self._h = float(h)

    def _checked_attempt(
        self, end: float, attempt: Callable[[float], tuple[float, Array, Array, float]]
    ) -> tuple[float, Array, Array, float]:
        try:
            state = attempt(end)
        except DivergenceError as error:
            self._why, self._fresh = str(error), True
            return end, self._q, self._w, math.nan
        self._why = ""
        return state

    def _attempt(self, end: float) -> tuple[float, Array, Array, float]:
        """Return the end of a step, q and w there, and its error in units of the tolerance."""
        step = end - self._t
        q, w, u = self._step(self._t, self._q, self._w, step, fresh=self._fresh)
        self._fresh = False
        scales = self._scales(q, w, u)
        error = embedded_error(SCALARS, self._tableau.errors, self._stages, scales, step, 2 * self._space.nv)
        return end, q, w, float(error)

    def _attempt_near_pose(self, end: float) -> tuple[float, Array, Array, float]:
        h = self._reach * (end - self._t)
        end, part = self._near_pose.part(self._t, h, self._stop, self._q, self._w, self._force)
        q, w = part.at(end)
        self._within_last, self._fresh = part, True
        by_u, _ = self._scales(q, w, part.last, LOOSEST)
        return end, q, w, float((part.last / by_u).max(initial=0.0))

    @property
    def _reach(self) -> float:
        """Length of a step near a pose, in those of rk853, as its tolerance may be the looser one."""
        return float(max(1.0, LOOSEST / self._tolerances.rtol) ** (1 / self.grows))

    def _scales(self, q: Array, w: Array, u: Array, least: float = 0.0) -> tuple[Array, Array]:
        """Return the tolerated errors of u and of w in a step that moves q by u, by tolerances of at least so much."""
        space, (rtol, atol) = self._space, (max(x, least) for x in self._tolerances)
        sizes = np.maximum(space.magnitude(self._q, u), space.magnitude(q, u)), np.maximum(np.abs(self._w), np.abs(w))
        by_u, by_w = (atol + rtol * x for x in sizes)
        return by_u, by_w

    def _step(self, t: float, q: Array, w: Array, h: float, *, fresh: bool = True) -> tuple[Array, Array, Array]:
        """Return q, w and u after h; the first stage is there already unless the start is fresh."""

        def rates(t: float, q: Array, u: Array | None, w: Array) -> tuple[Array, Array]:
            if u is None:
                return w, self._field(t, q, w, self._force)
            return self._space.rate(u, w), self._field(t, q, w, self._force)

        self._stages.keep(0 if fresh else 1)
        return self._tableau.step(self._space, rates, self._stages, t, h, q, w)

    def step(self) -> AcceptedSteps | None:
        """Return the next step; None where there is none."""
        while attempts := self.advance():
            ((_, done),) = attempts
            if len(done.t) > 1:
                return done
        return None

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
        if self._within_last is not None and self._within_last.t == t:
            return self._within_last.at(end)
        self._fresh = True
        return self._step(t, q, w, end - t)[:2]


def _accepted(*ends: tuple[float, Array, Array]) -> AcceptedSteps:
    times, places, rates = zip(*ends, strict=True)
    return AcceptedSteps(np.array(times), np.array(places), np.array(rates))


class AcrossPoses(RungeKuttaAttempts):
    """Steps of rk853, and of its own near a singular pose, in place of another method's; from and to y = (q, v).

    A series, an implicit stage and a method's past all need accelerations at places where these have few digits.
    """

    def __init__(self, problem: IntegrationProblem) -> None:
        super().__init__(problem, Space(problem.dyn.model), problem.tolerances)
        self._model = problem.dyn.model
        self._last_step: AcceptedSteps | None = None
        #: Part of a step of rk853 by which to look ahead, s; and the time at which it is to be estimated again.
        self._usual, self._estimate_until = 0.0, math.inf

    @classmethod
    def of(cls, problem: IntegrationProblem) -> AcrossPoses | None:
        """Return those of a run; None where nothing is projected."""
        return cls(problem) if problem.dyn._projects else None

    def crosses(self, t: float, y: Array, h: float | None, k: int | None = None, stop: float = math.inf) -> bool:
        """Return whether a step of length h from a state would meet a pose; `cross` then starts there.

        Steps of SciPy's methods, under force k, are tiny after a start, where h is None, and shrink with the way to a
        pose: none would ever meet it. These methods look ahead by a step of rk853 too.
        """
        q, v = unit_quaternions(self._model, y[: self._model.nq])[0], y[self._model.nq :]
        w = self._space.to_integrator_velocity(q, v)
        self._begin(t, q, w)
        if k is not None and (h is None or t >= self._estimate_until):
            self.hold(k, stop)
            self._usual, self._estimate_until = self._h / STEPS_TO_POSE, t + self._h
        out = self.approach.crosses(max(h or 0.0, self._usual))
        if out:
            # A method of several steps leaves the constraints by its errors.
            self._q, self._w = self._field.settled(t, q, w)
        return out

    def cross(self, k: int, stop: float) -> tuple[float, Array]:
        """Return the time and the state after a step under force k; `StoppedError` where there is none."""
        self.hold(k, stop)
        self._last_step = done = self.step()
        if done is None:
            raise self.stuck(0) or below_rounding(self._wanted)
        return float(done.t[-1]), self._vector(done.q[-1], done.w[-1])

    def at(self, t: float) -> Array:
        """Return the state at a time within the last step."""
        assert self._last_step is not None
        q, w = self.within(0, self._last_step.rows(np.array([0])), np.array([t]))
        return self._vector(q[0], w[0])

    def _vector(self, q: Array, w: Array) -> Array:
        return np.concatenate([q, self._space.to_body_velocity(q, w)])


class RosenbrockAttempts(RungeKuttaAttempts):
    """Attempts of rodas5 on y = (q, v), with quaternions as four numbers, whose length the exact flow keeps.

    A state within a step is that of the method's polynomial of order 4: a shorter step would cost as much as the step.
    """

    grows = 5
    formula = staticmethod(rodas5p)
    _factors = staticmethod(elementary_factors)

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
        # Its stages are not on the constraints, and its derivatives are those of accelerations that grow at a pose.
        self._field.looks, self._k = False, 0
        self._across = AcrossPoses.of(problem)
        self._crossing = self._crossed = False
        self._arrived: tuple[Array, Array] | None = None
        self._last_attempt: tuple[float, float, Array, Array, Array] | None = None

    @property
    def evaluations(self) -> int:
        across = 0 if self._across is None else self._across.evaluations
        return self._field.evaluations + self._own_rates.evaluations + across

    @property
    def jacobians(self) -> int:
        return self._exact.evaluations

    def start(self, which: Sequence[int], q: Array, w: Array, t: float = 0.0, h: float = 0.0) -> None:
        super().start(which, q, w, t, h)
        if self._batch is not None:
            self._own_rates.only(which[0])
            self._exact.only(which[0])
        if self._across is not None:
            self._across.follow(which[0])

    @property
    def passed(self) -> bool:
        return self._error < 1 and not (self._across and self._across.approach.near)

    def tighten(self, place: int, tolerances: Tolerances) -> None:
        super().tighten(place, tolerances)
        if self._across is not None:
            self._across.tighten(place, tolerances)

    def advance(self) -> list[tuple[int, AcceptedSteps]]:
        across = self._across
        if across is None or self._dropped or self._t >= self._stop:
            return super().advance()
        if not self._crossing and self._fresh and across.crosses(self._t, self._vector(self._q, self._w), self._h):
            across.hold(self._k, self._stop)
            self._crossing = True
        self._crossed = self._crossing
        if not self._crossing:
            return super().advance()
        out = across.advance()
        if across.now[0] > self._t:
            self._t, self._q, self._w, *_ = across.now
            self._fresh, self._crossing, self._error = True, False, 0.0
        return out

    def stuck(self, place: int) -> StoppedError | None:
        return super().stuck(place) if self._across is None or not self._crossing else self._across.stuck(place)

    def _attempt(self, end: float) -> tuple[float, Array, Array, float]:
        own, (rtol, atol), step = self._own, self._tolerances, end - self._t
        y, there, J = self._known()
        k = self._increments(self._t, y, step, there, J)
        y1, error, t1 = y + own.b @ k, own.error @ k, end
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
        return end, *self._state(y1), size

    def _known(self) -> tuple[Array, Array, Array]:
        """Return y, ẏ and ∂ẏ/∂y where the step starts, evaluated once for all attempts from there."""
        if self._fresh or self._start is None:
            self._own_rates.why = ""
            y = self._vector(self._q, self._w)
            arrived, self._arrived = self._arrived, None
            # The rate is known where the last step ended, unless another force acts from there.
            known = arrived is not None and np.array_equal(arrived[0], y)
            rate = arrived[1] if known and arrived is not None else self._rate(self._t, y)
            self._start = y, rate, self._exact(self._t, y, self._force)
        return self._start

    def hold(self, k: int, stop: float) -> None:
        self._arrived, self._k = None, k
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
        # The parabola through three rates near each other has their change by the time alone.
        apart = 1e-3 * h
        near, far = self._rate(t + apart, y), self._rate(t + 2 * apart, y)
        return (4 * near - far - 3 * there) / (2 * apart)

    def _inner(self, t: float, q: Array, w: Array, end: float) -> tuple[Array, Array]:
        if self._crossed and self._across is not None:
            return self._across._inner(t, q, w, end)
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
