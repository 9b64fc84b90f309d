"""Fixed steps in Python, on any engine and under any torque."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import FunctionError
from mbkit.methods.one_step import ArrayStages, SemiImplicitEuler
from mbkit.methods.registry import method_of
from mbkit.methods.tableaus import ImplicitTableau, Tableau
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.singular_poses import SingularPosesOfBatch, manifold_at
from mbkit.simulate.solvers.gauss import CollocationStep, StepNearPose
from mbkit.simulate.solvers.trajectory_record import GridRecord
from mbkit.simulate.solvers.vector_field import ALL, DIVERGED, DivergenceError, Field, are_bounded
from mbkit.simulate.time_grid import Indices
from mbkit.simulate.torque import Force

#: Stages of a fixed step near a singular pose, for order 8.
STAGES_NEAR_POSE: Final = 4
#: step(t, h, q, w, force) -> (q, w) at t + h; one state or a batch
Step = Callable[[float, float, Array, Array, Force], tuple[Array, Array]]


def to_body_velocity(space: Space, q: Array, w: Array) -> Array:
    """Return mbkit's velocity of the integrators' own, of states (..., nq) and (..., nv)."""
    if space.flat:
        return w
    flat = (np.ascontiguousarray(x).reshape(-1, x.shape[-1]) for x in (q, w))
    # Values of a lost state do not matter here.
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(space.to_body_velocity(*flat).reshape(w.shape))


class Stepper:
    """Steps of one state or a batch, one at a time; w is the velocity or momentum that the method carries along."""

    def __call__(self, t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:
        """Return q and w at t + h; NaN where there are none, or `DivergenceError`."""
        raise NotImplementedError

    def only(self, members: Indices, good: NDArray[np.bool_] | None = None) -> None:
        """Go on with these members of the batch, those of the last ones that are good."""

    def settled(self, t: float, q: Array, w: Array) -> tuple[Array, Array]:  # noqa: ARG002
        """Return the state to go on from."""
        return q, w

    def to_body_velocity(self, q: Array, w: Array) -> Array:  # noqa: ARG002
        """Return the saved w."""
        return w

    def velocity(self, t: float, q: Array, w: Array) -> Array:  # noqa: ARG002
        """Return mbkit's velocity of a state."""
        return self.to_body_velocity(q, w)

    def reason(self, q: Array, w: Array) -> str:  # noqa: ARG002
        """Return why a step from such a state failed."""
        return DIVERGED


class _FieldStepper(Stepper):
    """Steps of a method that only evaluates ẇ; it looks for singular poses of constraints on the way."""

    def __init__(self, problem: IntegrationProblem) -> None:
        self.poses = SingularPosesOfBatch(problem.dyn, problem.start, problem.q)
        self._members: Indices = np.arange(len(problem.q))
        self.space = Space(problem.dyn.model)
        self.field = Field(problem.dyn, self.space)
        self._step = make_step(problem.method, self.field, self.space)

    def __call__(self, t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:
        return self._step(t, h, q, w, force)

    def only(self, members: Indices, good: NDArray[np.bool_] | None = None) -> None:  # noqa: ARG002
        self._members = members
        self.field.only(members)

    def settled(self, t: float, q: Array, w: Array) -> tuple[Array, Array]:
        q, w = self.field.settled(t, q, w)
        self.poses.saw(t, q, self._members)
        return q, w

    def to_body_velocity(self, q: Array, w: Array) -> Array:
        return np.asarray(self.space.to_body_velocity(q, w))


def take_step(dyn: Dynamics, method: str, q: Array, v: Array, force: Array, h: float) -> tuple[Array, Array]:
    """Return the states after one step of `run_fixed` under a held force, of one or a batch; NaN where there is none.

    It starts at the time that the dynamics hold.
    """
    space, clock = Space(dyn.model), dyn.model.time_parameter
    field, t = Field(dyn, space), 0.0 if clock is None else float(dyn.model.parameters[clock] or 0.0)
    try:
        q1, w1 = make_step(method, field, space)(t, h, q, space.to_integrator_velocity(q, v), force)
    except DivergenceError:
        if q.ndim == 1 or len(q) < 2:
            return np.full(q.shape, np.nan), np.full(v.shape, np.nan)
        # One must not stop the others.
        rows = (np.array([i]) for i in range(len(q)))
        each = [take_step(dyn._of_samples(i), method, q[i], v[i], force[i], h) for i in rows]
        return np.concatenate([x for x, _ in each]), np.concatenate([x for _, x in each])
    if not are_bounded(q1, w1).all():
        return q1, w1
    q1, w1 = field.settled(t + h, q1, w1)
    return q1, np.asarray(space.to_body_velocity(q1, w1))


def run_fixed(
    problem: IntegrationProblem, record: GridRecord | None = None, members: Indices | None = None
) -> SolverResult:
    """Step one state or a batch over the grid, on any engine.

    A trajectory that diverges stops there; the others of its batch go on. A torque function that fails stops all of
    them, with what they have. With a record of a whole batch, its other members are there already.
    """
    stepper = _FieldStepper(problem)
    run = SteppedRun(problem, stepper, stepper.space.to_integrator_velocity(problem.q0, problem.v0), record, members)
    run.to_end()
    run.record.evaluations = stepper.field.evaluations
    run.record.poses = stepper.poses.members
    return run.record.result(lambda _: run.why)


class SteppedRun:
    """The current states, their record, and why the first of them diverged."""

    def __init__(
        self,
        problem: IntegrationProblem,
        stepper: Stepper,
        w0: Array,
        record: GridRecord | None = None,
        members: Indices | None = None,
    ) -> None:
        self._problem, self._step, self.why = problem, stepper, ""
        self.record = GridRecord(problem) if record is None else record
        # Those of a batch that are still good.
        self._members: Indices | None = None if problem.batch is None else np.arange(problem.batch)
        self._row = self.record.rows(0, 0).stop
        self._q, self._w = problem.q0.copy(), w0
        if members is not None:
            self.record.good[members] = 0
        if members is not None and self._members is not None:
            self._members, self._q, self._w = members, self._q[members], self._w[members]
            stepper.only(members)

    def to_end(self) -> None:
        """Step over the grid, or up to where a torque function fails."""
        steps = self._problem.grid.steps
        # An overflow is a divergence, and reported as one.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for k in range(steps):
                try:
                    if not self._advance(k):
                        break
                except FunctionError as error:
                    self.record.error = error
                    break
                self._problem.bar.update((k + 1) / steps)

    def _advance(self, k: int) -> bool:
        """Take step k; return whether any trajectory goes on."""
        grid, torque, step, record = self._problem.grid, self._problem.torque, self._step, self.record
        t, h, why = grid.time(k), grid.step(k), ""
        if torque.samples is not None:
            torque.sample(k, t, self._q, step.velocity(t, self._q, self._w), self._members)
        try:
            q, w = step(t, h, self._q, self._w, torque.during(k, self._members))
            good = are_bounded(q, w)
        except DivergenceError as error:
            q, w, good, why = self._one_by_one(t, h, k, str(error))
        if good is not ALL and not good.all():
            if self._members is None:
                self.why = why or step.reason(self._q, self._w)
                return False
            first = int(np.argmin(good))
            self.why = self.why or why or step.reason(self._q[first], self._w[first])
            self._members, q, w = self._members[good], q[good], w[good]
            if not len(self._members):
                return False
            step.only(self._members, good)
        self._q, self._w = step.settled(grid.time(k + 1), q, w)
        which: Any = slice(None) if self._members is None else self._members
        record.good[which] = k + 1
        if self._row < len(record.kept) and k + 1 == record.kept[self._row]:
            record.q[which, self._row], record.v[which, self._row] = self._q, step.to_body_velocity(self._q, self._w)
            self._row += 1
        return not record.early

    def _one_by_one(self, t: float, h: float, k: int, why: str) -> tuple[Array, Array, NDArray[np.bool_], str]:
        # One divergence must not stop the others of a batch: each steps by itself.
        q, w = np.full(self._q.shape, np.nan), np.full(self._w.shape, np.nan)
        if self._members is None:
            return q, w, np.array(False), why
        reasons = list[str]()
        for i in range(len(q)):
            one = slice(i, i + 1)
            self._step.only(self._members[one])
            force = self._problem.torque.during(k, self._members[one])
            try:
                q[one], w[one] = self._step(t, h, self._q[one], self._w[one], force)
            except DivergenceError as error:
                reasons.append(str(error))
        self._step.only(self._members)
        return q, w, are_bounded(q, w), next(iter(reasons), "")


def divergence_reason(dyn: Dynamics, method: str, t: float, h: float, q: Array, w: Array, force: Array) -> str:
    """Return why the step from a batch of one state diverges, in the engine's words if it has some."""
    space = Space(dyn.model)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        try:
            make_step(method, Field(dyn, space), space)(t, h, q, w, force)
        except DivergenceError as error:
            return str(error)
    return DIVERGED


def make_step(method: str, field: Field, space: Space) -> Step:
    """Return the step of a fixed-step method, of one state or a batch; under constraints its end is to be projected.

    The states at its ends and its middle alone decide whether it is a `StepNearPose`: no end of a step is looked at.
    """
    formula = method_of(method).formula
    if isinstance(formula, ImplicitTableau):
        attempt: Step = CollocationStep(formula, field, space)
    else:
        assert isinstance(formula, (Tableau, SemiImplicitEuler))
        attempt = _ExplicitStep(formula, field, space)
    near_pose = StepNearPose(field, space, STAGES_NEAR_POSE)
    field.looks = False

    def step(t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:
        if not field.projects:
            return attempt(t, h, q, w, force)
        try:
            q1, w1 = attempt(t, h, q, w, force)
        except DivergenceError:
            # Each member of a batch is then asked by itself.
            if q.size > q.shape[-1]:
                raise
            return near_pose(t, h, q, w, force)
        near = manifold_at(field.dyn, t).nears_pose(t, q, h, q1)
        if not near.any():
            return q1, w1
        if near.size == 1:
            return near_pose(t, h, q, w, force)
        if not isinstance(force, np.ndarray):
            raise DivergenceError
        for i in np.flatnonzero(near):
            own = Field(field.dyn._of_samples([i]), space)
            q1[i], w1[i] = StepNearPose(own, space, STAGES_NEAR_POSE)(
                t, h, q[i], w[i], force if force.ndim == 1 else force[i]
            )
            field.evaluations += own.evaluations
        return q1, w1

    return step


class _ExplicitStep:
    """A step of an explicit method."""

    def __init__(self, formula: Tableau | SemiImplicitEuler, field: Field, space: Space) -> None:
        self._formula, self._field, self._space = formula, field, space
        self._stages = ArrayStages(formula.stages, (space.nv,))

    def __call__(self, t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:
        def rates(t: float, q: Array, u: Array | None, w: Array) -> tuple[Array, Array]:
            return w if u is None else self._space.rate(u, w), self._field(t, q, w, force)

        if self._stages.shape != w.shape:
            self._stages = ArrayStages(self._formula.stages, w.shape)
        self._stages.keep(0)
        return self._formula.step(self._space, rates, self._stages, t, h, q, w)[:2]
