"""The engines' own integrators: MuJoCo's and those in a process of their own with a step, Drake's with a tolerance."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.remote.dynamics import VersionDynamics
from mbkit.errors import FunctionError
from mbkit.methods.registry import method_of
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.fixed_step import SteppedRun, Stepper
from mbkit.simulate.solvers.trajectory_record import (
    GridRecord,
    StoppedError,
    TrajectoryRecord,
    assemble_result,
    run_each,
)
from mbkit.simulate.solvers.vector_field import DivergenceError, are_bounded
from mbkit.simulate.time_grid import check_room
from mbkit.simulate.torque import Force


def run_native(problem: IntegrationProblem) -> SolverResult:
    """Run the engine's integrator; nothing is kept after a trajectory's last bounded state."""
    method, grid, torque = method_of(problem.method), problem.grid, problem.torque
    dyn, q0, v0 = problem.dyn, problem.q0, problem.v0
    rollout = _in_its_process(dyn) if isinstance(dyn, VersionDynamics) else _in_mujoco(dyn)
    check_room((grid.steps + 1) * len(problem.q), q0.shape[-1] + v0.shape[-1])
    record, parts, now = GridRecord(problem), [(q0[..., None, :], v0[..., None, :])], (q0, v0)
    # MuJoCo's step is fixed for a rollout, so a shortened last step is a rollout of its own.
    whole = grid.steps if grid.last == grid.dt else grid.steps - 1
    for k, end in pairwise(sorted({0, *torque.changes(grid.steps), whole, grid.steps})):
        # A state that diverged stays void; it only must not stop the others.
        good = are_bounded(*now)
        if not good.any():
            break
        q, v = (np.where(good[..., None], x, first) for x, first in zip(now, (q0, v0), strict=True))
        try:
            who = np.flatnonzero(good)
            torque.sample(k, grid.time(k), np.atleast_2d(q)[who], np.atleast_2d(v)[who], who)
        except FunctionError as failed:
            record.error = failed
            break
        tau = torque.rows(range(k, end)) if torque.held or torque.table.any() else None
        if tau is not None and torque.samples is not None:
            # Nobody is asked for the torque of what diverged.
            tau = np.nan_to_num(tau)

        def report(done: float, k: int = k, end: int = end) -> None:
            problem.bar.update((k + done * (end - k)) / grid.steps)

        q, v = rollout(method.scheme, q0=q, v0=v, dt=grid.step(k), tau=tau, steps=end - k, progress=report)
        q, v = (np.where(good[..., None, None], np.asarray(x), np.nan) for x in (q, v))
        parts.append((q[..., 1:, :], v[..., 1:, :]))
        now = q[..., -1, :], v[..., -1, :]
    q, v = (np.concatenate(x, axis=-2) for x in zip(*parts, strict=True))
    missing = grid.steps + 1 - q.shape[-2]
    q, v = (np.pad(x, [(0, 0)] * (x.ndim - 2) + [(0, missing), (0, 0)], constant_values=np.nan) for x in (q, v))
    q, v = (x[None] if problem.batch is None else x for x in (q, v))
    good = are_bounded(q, v)
    good[:, 0] = True  # the start is the caller's
    # After the first bad state everything is void, even what looks like numbers.
    record.good[:] = np.logical_and.accumulate(good, axis=1).sum(1) - 1
    record.q, record.v = q[:, record.kept], v[:, record.kept]
    problem.bar.update(1.0)
    record.evaluations = int(record.good.sum()) * method.stages
    return record.result()


_Rollout = Callable[..., tuple[Array, Array]]


def _in_mujoco(dyn: Dynamics) -> _Rollout:
    # MuJoCo is an extra.
    from mbkit.engines.mujoco.engine import MujocoDynamics

    assert isinstance(dyn, MujocoDynamics)
    return dyn.rollout


def _in_its_process(dyn: VersionDynamics) -> _Rollout:
    """Return the rollouts of an engine in an environment of its own."""

    def rollout(integrator: str, **more: Any) -> tuple[Array, Array]:
        return dyn.own_run(method=integrator, **more)

    return rollout


# Drake's own integrators, with a tolerance.


def run_drake(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or each of a batch by itself, to the times of `save`.

    Steps end on the saved times. Drake has one accuracy, relative to a state of size 1 and above, for which
    `rtol` is taken.
    """
    # Drake is an extra.
    from mbkit.engines.drake.engine import DrakeDynamics
    from mbkit.engines.drake.rollout import DrakeRun

    dyn = problem.dyn
    assert isinstance(dyn, DrakeDynamics)
    scheme, (_, times), runs = method_of(problem.method).scheme, problem.saved_times(), list[DrakeRun]()

    def walk(i: int, y: Array, record: TrajectoryRecord) -> Iterator[tuple[float, Array, Any]]:
        force = problem.torque.of_member(problem.member(i))
        run = DrakeRun(
            dyn, scheme, problem.tolerances.rtol, problem.start, problem.q[i], problem.v[i], problem.report(i)
        )
        runs.append(run)
        try:
            for begin, t in pairwise(times.tolist()):
                k = problem.interval(begin)
                problem.sample(i, k, begin, y)
                run.push(np.asarray(force(k)))
                try:
                    y = np.concatenate(run.over(t))
                except RuntimeError as error:
                    text = str(error).strip().splitlines()[0]
                    why = f"stopped with a step below the smallest: stiff, singular or diverging ({text})"
                    raise StoppedError("step_too_small", why) from None
                # Saved times lie at the ends of these parts alone.
                yield t, y, None
        finally:
            # Drake's own steps, and not the parts.
            record.steps, record.rejected = run.steps, run.rejected

    records = run_each(problem, walk)
    return assemble_result(problem, records, evaluations=sum(run.evaluations for run in runs))


class _DiscreteStepper(Stepper):
    """Steps of Drake's discrete plants, state by state; the step's length is part of a plant."""

    def __init__(self, dyn: Dynamics) -> None:
        self._dyn, self._runs = dyn, dict[float, Any]()

    def __call__(self, t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:  # noqa: ARG002
        from mbkit.engines.drake.engine import DrakeDynamics
        from mbkit.engines.drake.rollout import DiscreteRun

        assert isinstance(self._dyn, DrakeDynamics)
        if h not in self._runs:
            self._runs[h] = DiscreteRun(self._dyn, h)
        tau = np.broadcast_to(np.asarray(force), w.shape)
        try:
            if q.ndim == 1:
                return self._runs[h].step(q, w, tau)  # type: ignore[no-any-return]  # Drake is an extra
            pairs = [self._runs[h].step(*state) for state in zip(q, w, tau, strict=True)]
        except RuntimeError as error:
            raise DivergenceError(str(error).strip().splitlines()[0]) from None
        return np.array([x for x, _ in pairs]), np.array([x for _, x in pairs])


def run_drake_discrete(problem: IntegrationProblem) -> SolverResult:
    """Step one state, or each of a batch by itself, on Drake's discrete plant."""
    stepper = _DiscreteStepper(problem.dyn)
    run = SteppedRun(problem, stepper, problem.v0.copy())
    run.to_end()
    run.record.evaluations = int(run.record.good.sum())
    return run.record.result(lambda _: run.why)
