"""Runs of the implicit midpoint rule in (q, p), on `mbkit.derivation.steps.midpoint`'s parts.

The state from step to step is (q, π); velocities follow from it where they are kept. Without a torque function, steps
run as machine code, on all cores. A torque function is evaluated at the midpoint in each iteration, which then
converges linearly, at the rate of the step times the torque's derivative.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import BOUND, EPS, PIECE_SIZE, Array
from mbkit.codegen.backend import Machine
from mbkit.derivation.mass_matrix_solve import factors_written_out
from mbkit.derivation.steps.fixed import Part
from mbkit.derivation.steps.midpoint import (
    GUESS_WEIGHTS,
    MAX_LAST_CORRECTION,
    MAX_LAST_MOVE,
    MAX_NEWTON_ITERATIONS,
    ConstrainedMidpoint,
    Midpoint,
)
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.methods.registry import IMPLICIT_METHODS
from mbkit.model.elements.paths import ALL, Path
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.singular_poses import SingularPosesOfBatch
from mbkit.simulate.solvers.fixed_step import STAGES_NEAR_POSE, SteppedRun, Stepper
from mbkit.simulate.solvers.gauss import MAX_ITERATIONS, StepNearPose
from mbkit.simulate.solvers.trajectory_record import GridRecord
from mbkit.simulate.solvers.vector_field import DIVERGED, DivergenceError, Field, are_bounded
from mbkit.simulate.time_grid import Indices
from mbkit.simulate.torque import Force

_OTHERS: Final = f"{IMPLICIT_METHODS} are the implicit methods for it"
SYMPLECTIC: Final = Path("symplectic runs", "implicit_midpoint: no form is kept of", ALL - {"speed"}, instead=_OTHERS)
_UNSOLVED: Final = "Newton's iteration does not solve the step's equations"


def run_midpoint(problem: IntegrationProblem) -> SolverResult:
    """Step one state or a batch over the grid; a trajectory that diverges stops there, and the others go on."""
    dyn = problem.dyn
    assert isinstance(dyn, LagrangianDynamics)
    midpoint, q0 = midpoint_of(dyn), problem.q
    w0 = np.zeros((len(q0), midpoint.unknowns))
    w0[:, : dyn.model.nv] = Space(dyn.model).to_integrator_velocity(q0, problem.v)
    iterations = 0
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        (pi0,) = called(dyn, midpoint.momentum, None, problem.start, q0, problem.v)
        if _machine_code(dyn, midpoint, problem):
            # It loads LLVM, which interpreting never needs.
            from mbkit.simulate.solvers.machine_code_blocks import run_implicit

            def velocity(t: float, q: Array, pi: Array, members: Indices) -> Array:
                return _velocities(dyn, midpoint, members, t, q, pi)

            poses = SingularPosesOfBatch(dyn, problem.start, problem.q)
            record, iterations, lost = run_implicit(problem, midpoint, pi0, w0, velocity, poses)
            record.poses = poses.members
            # A step from or to a singular pose is one of Python, and so are all others of its trajectory.
            members: Indices | None = np.array(sorted(lost) if dyn._projects else [], dtype=np.intp)

            def why(i: int) -> str:
                return _reason(*lost[i])

        else:
            record, members = GridRecord(problem), None
        if members is None or len(members):
            stepper = MidpointStepper(dyn, problem, w0, members)
            run = SteppedRun(problem, stepper, pi0[0] if problem.batch is None else pi0, record, members)
            run.to_end()
            iterations += stepper.iterations
            record.poses = {**record.poses, **stepper.poses.members}

            def why(i: int) -> str:  # noqa: ARG001  # of a batch the first one's
                return run.why

        _to_velocities(dyn, midpoint, problem, record)
    # Each iteration is an evaluation, and so is the end of each step.
    record.evaluations, record.jacobians = iterations + int(record.good.sum()), iterations
    return record.result(why)


def midpoint_of(dyn: LagrangianDynamics) -> Midpoint:
    """Return the parts of a step of these dynamics; `UnsupportedError` for rows that hold velocities alone."""
    SYMPLECTIC.admit(dyn.model)
    return (ConstrainedMidpoint if dyn.model.constrained else Midpoint)(dyn.equations)


def called(
    dyn: LagrangianDynamics, part: Part, members: Indices | None, t: Array | float, *arguments: Array
) -> list[Array]:
    """Return a part's results for members of a batch, or all: vectors as (n, rows), matrices as (n, rows, columns).

    `t`, one for all or (n,), is the time of evaluation, where the dynamics depends on it.
    """
    n = len(arguments[0])
    args = [np.broadcast_to(x, (n, x.shape[-1])) for x in arguments]
    if dyn.model.parameters:
        values = dyn._parameter_values
        if values.ndim == 2 and members is not None:
            values = values[members]
        own = np.broadcast_to(values, (n, values.shape[-1]))
        if dyn.model.time_parameter is not None:
            own = own.copy()
            own[:, list(dyn.model.parameters).index(dyn.model.time_parameter)] = t
        args.append(own)
    results = dyn._code(part.name, make=part.make)(*args, threads=dyn.threads)
    return [
        x[..., 0] if x.shape[-1] == 1 and name not in ("M", "jacobian") else x
        for name, x in zip(part.writes, results, strict=True)
    ]


def _machine_code(dyn: LagrangianDynamics, midpoint: Midpoint, problem: IntegrationProblem) -> bool:
    if problem.torque.callable or not dyn.model.nv or not dyn.compile or not _written_out(dyn):
        return False
    return not any(isinstance(dyn._code(p.name, make=p.make), Machine) for p in (midpoint.newton, midpoint.end))


def _written_out(dyn: LagrangianDynamics) -> bool:
    return factors_written_out(dyn.model, compiled=dyn.compile)


def _reason(q: Array, pi: Array) -> str:
    # An overflow in the middle of a step leaves no number for the iteration either.
    return DIVERGED if max(np.abs(x).max() for x in (q, pi)) > BOUND**0.5 else _UNSOLVED


class MidpointStepper(Stepper):
    """Newton's iteration for trajectories side by side, one step at a time; `iterations` are of all together."""

    def __init__(
        self, dyn: LagrangianDynamics, problem: IntegrationProblem, w0: Array, members: Indices | None
    ) -> None:
        self._dyn, self._midpoint, self._space = dyn, midpoint_of(dyn), Space(dyn.model)
        self._single = problem.batch is None
        self._members: Indices = np.arange(len(w0))
        self.poses = SingularPosesOfBatch(dyn, problem.start, problem.q, members)
        # The velocities of the last steps, and the first guess of the next one.
        self._last, self._guess = [w0] * len(GUESS_WEIGHTS), w0
        self.iterations, self._why = 0, ""

    def only(self, members: Indices, good: NDArray[np.bool_] | None = None) -> None:
        which = members if good is None else good
        self._members = members
        self._last, self._guess = [w[which] for w in self._last], self._guess[which]

    def settled(self, t: float, q: Array, w: Array) -> tuple[Array, Array]:
        self.poses.saw(t, q, self._members)
        return q, w

    def velocity(self, t: float, q: Array, w: Array) -> Array:
        both = np.atleast_2d(q), np.atleast_2d(w)
        return _velocities(self._dyn, self._midpoint, self._members, t, *both).reshape(w.shape)

    def reason(self, q: Array, w: Array) -> str:
        return self._why or _reason(q, w)

    def __call__(self, t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:
        q, pi = np.atleast_2d(q), np.atleast_2d(w)
        velocity, tau, good = self._velocity(t, h, q, pi, force)
        self._last = [velocity, *self._last[:-1]]
        zero, step = np.zeros((1, 1)), np.array([[h]])
        members, middle = self._members, t + h / 2
        args = q, pi, *self._last, tau, step, zero, zero
        q1, pi1, self._guess, _ = called(self._dyn, self._midpoint.end, members, middle, *args)
        q1[~good] = np.nan
        for i in np.flatnonzero(~are_bounded(q1, pi1)).tolist() if self._dyn._projects else ():
            q1[i], pi1[i], w = self._from_or_to_pose(i, t, h, q[i], pi[i], tau[i])
            for rows in (*self._last, self._guess):
                rows[i], rows[i, : len(w)] = 0.0, w
        return (q1[0], pi1[0]) if self._single else (q1, pi1)

    def _from_or_to_pose(
        self, i: int, t: float, h: float, q: Array, pi: Array, tau: Array
    ) -> tuple[Array, Array, Array]:
        """Return q, π and w of one trajectory after a step that starts or ends in a singular pose; NaN without one.

        J0ᵀ λ leads to no end from there, nor J1ᵀ κ to a velocity: such a step is of collocation.
        """
        members = self._members[[i]]
        field = Field(self._dyn._of_samples(members), self._space)
        (v,) = _velocities(self._dyn, self._midpoint, members, t, q[None], pi[None])
        try:
            step = StepNearPose(field, self._space, STAGES_NEAR_POSE)
            q1, w1 = field.settled(t + h, *step(t, h, q, self._space.to_integrator_velocity(q, v), tau))
        except DivergenceError as error:
            self._why = str(error)
            return np.full(q.shape, np.nan), pi, np.zeros(v.shape)
        v1 = self._space.to_body_velocity(q1, w1)
        ((pi1,),) = called(self._dyn, self._midpoint.momentum, members, t + h, q1[None], v1[None])
        return q1, pi1, w1

    def _velocity(self, t: float, h: float, q: Array, pi: Array, force: Force) -> tuple[Array, Array, Any]:
        """Return the velocity of a step, the torque that acted, and whether the step is solved, per trajectory.

        With a torque function it goes on until corrections stop shrinking.
        """
        w, good = self._guess.copy(), np.full(len(q), False)
        tau = np.empty((len(w), self._dyn.equations.force.numel()))
        if isinstance(force, np.ndarray):
            tau[:] = force
        last, todo = np.full(len(q), np.inf), np.arange(len(q))
        for _ in range(MAX_NEWTON_ITERATIONS if isinstance(force, np.ndarray) else MAX_ITERATIONS):
            # Never call the user's function with a non-finite state.
            todo = todo[np.isfinite(w[todo]).all(axis=1) & ~good[todo]]
            if not len(todo):
                break
            if not isinstance(force, np.ndarray):
                velocity = w[todo, : self._space.nv]
                q_m = self._space.retract(q[todo], (h / 2) * velocity)
                state = q_m, self._space.to_body_velocity(q_m, velocity)
                tau[todo] = force(t + h / 2, *(x[0] for x in state)) if self._single else force(t + h / 2, *state, todo)
            w1, solved = self._newton(self._members[todo], t + h / 2, q[todo], pi[todo], w[todo], tau[todo], h)
            change = np.abs(w1 - w[todo]).max(axis=1, initial=0.0)
            if not isinstance(force, np.ndarray):
                solved &= (change <= 4 * EPS * np.abs(w1).max(axis=1, initial=0.0)) | (change >= last[todo] / 2)
            w[todo], good[todo], last[todo] = w1, solved, change
        return w, tau, good

    def _newton(
        self, members: Indices, t: float, q: Array, pi: Array, w: Array, tau: Array, h: float
    ) -> tuple[Array, NDArray[np.bool_]]:
        self.iterations += len(q)
        args = (q, pi, w, tau, np.array([[h]]))
        if _written_out(self._dyn):
            w1, miss = called(self._dyn, self._midpoint.newton, members, t, *args)
            return w1, miss[:, 0] == 0
        residual, jacobian = called(self._dyn, self._midpoint.system, members, t, *args)
        change = _solved(jacobian, residual)
        w1 = w - change
        limit = MAX_LAST_CORRECTION**2 * np.sum(w1**2, axis=1) + (MAX_LAST_MOVE / h) ** 2 * (1 + np.sum(q**2, axis=1))
        return w1, np.sum(change**2, axis=1) < limit


def _solved(A: Array, b: Array) -> Array:
    try:
        return np.asarray(np.linalg.solve(A, b[..., None])[..., 0])
    except np.linalg.LinAlgError:
        # One singular matrix must not stop the others of a batch.
        if len(b) == 1:
            return np.full(b.shape, np.nan)
        return np.concatenate([_solved(A[i : i + 1], b[i : i + 1]) for i in range(len(b))])


def _to_velocities(
    dyn: LagrangianDynamics, midpoint: Midpoint, problem: IntegrationProblem, record: GridRecord
) -> None:
    """Turn the kept momenta into velocities."""
    kept, (n, rows, nv) = record.kept, record.v.shape
    times = problem.grid.times_of(kept)
    size = max(PIECE_SIZE // max(n * (nv or 1), 1), 1)
    for start in range(0, rows, size):
        q, v = (x[:, start : start + size] for x in (record.q, record.v))
        at_k = kept[start : start + size]
        who, at = np.nonzero((at_k > 0) & (at_k <= record.good[:, None]))
        if not len(who):
            continue
        v[who, at] = _velocities(dyn, midpoint, who, times[start + at], q[who, at], v[who, at])


def _velocities(
    dyn: LagrangianDynamics, midpoint: Midpoint, members: Indices, t: Array | float, q: Array, pi: Array
) -> Array:
    """Return the velocities of states (n, nq) and (n, nv) in positions and momenta."""
    if _written_out(dyn):
        (v,) = called(dyn, midpoint.velocity, members, t, q, pi)
        # At a singular pose its rows ask for no velocity; that of a momentum on them satisfies them.
        if not dyn._projects or np.isfinite(v).all():
            return v
    M, p = called(dyn, midpoint.velocity_system, members, t, q, pi)
    return np.asarray(np.linalg.solve(M, p[..., None])[..., 0])
