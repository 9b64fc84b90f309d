"""The engines' own integrators: MuJoCo's with a step, Drake's with a tolerance."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import UnsupportedError
from mbkit.methods.registry import ADAPTIVE_METHOD, DEFAULT_METHOD, EULER_METHOD, Method, method_of
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.progress import Progress
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord, assemble_result, grid_result, record_of
from mbkit.simulate.solvers.vector_field import DIVERGED, is_bounded
from mbkit.simulate.time_grid import Grid, Indices, check_room
from mbkit.simulate.torque import Torque

if TYPE_CHECKING:
    from mbkit.engines.drake.engine import DrakeRun


@runtime_checkable
class HasRollout(Protocol):
    """An engine with integrators of its own."""

    def rollout(
        self,
        integrator: str,
        q0: Array,
        v0: Array,
        dt: float,
        tau: Array | None,
        steps: int,
        progress: Callable[[float], object] | None = None,
    ) -> tuple[Array, Array]:
        """Return q and v after 0, 1, ... steps: (steps + 1, n) or (N, steps + 1, n).

        `progress` gets the fraction done, several times a second.
        """
        ...


def run_native(
    dyn: Dynamics, method: Method, q0: Array, v0: Array, grid: Grid, kept: Indices, torque: Torque, bar: Progress
) -> SolverResult:
    """Run the engine's integrator; nothing is kept after a trajectory's last bounded state."""
    (engine,), integrator = method.engines, method.scheme
    ours = f"method={DEFAULT_METHOD!r} or {EULER_METHOD!r}"
    if dyn.engine != engine or not isinstance(dyn, HasRollout):
        raise UnsupportedError(
            f"{method.name}: {engine}'s own integrator is not available on the {dyn.engine} engine; "
            f"use mbkit.dynamics(model, {engine!r}), or {ours} with its formulas"
        )
    if torque.callable:
        raise UnsupportedError(
            f"{method.name}: {engine} steps by itself and cannot call back; give the torque as an array, or use {ours}"
        )
    check_room((grid.steps + 1) * (1 if q0.ndim == 1 else len(q0)), q0.shape[-1] + v0.shape[-1])
    if q0.ndim == 2 and not len(q0):
        # mujoco.rollout 4.0.0 does not survive an empty batch.
        empty = np.empty((0, grid.steps + 1, q0.shape[-1])), np.empty((0, grid.steps + 1, v0.shape[-1]))
        return _result(method, grid, kept, *empty, single=False)
    # MuJoCo's step is fixed for a rollout, so a shortened last step is a rollout of its own.
    whole = grid.steps if grid.last == grid.dt else grid.steps - 1
    first: dict[str, Any] = {"q0": q0, "v0": v0, "dt": grid.dt, "tau": torque.over(0, whole), "steps": whole}
    q, v = dyn.rollout(integrator=integrator, progress=bar.update, **first)
    if whole < grid.steps:
        # A state that diverged stays void; it only must not stop the others.
        good = np.isfinite(q[..., -1, :]).all(-1, keepdims=True) & np.isfinite(v[..., -1, :]).all(-1, keepdims=True)
        q1, v1 = np.where(good, q[..., -1, :], q0), np.where(good, v[..., -1, :], v0)
        tail = torque.over(whole, grid.steps)
        q1, v1 = dyn.rollout(integrator=integrator, q0=q1, v0=v1, dt=grid.last, tau=tail, steps=1)
        q, v = np.concatenate([q, q1[..., 1:, :]], -2), np.concatenate([v, v1[..., 1:, :]], -2)
    single = q0.ndim == 1
    q, v = (np.asarray(x)[None] if single else np.asarray(x) for x in (q, v))
    return _result(method, grid, kept, q, v, single=single)


def _result(method: Method, grid: Grid, kept: Indices, q: Array, v: Array, *, single: bool) -> SolverResult:
    good = is_bounded(q) & is_bounded(v)
    good[:, 0] = True  # the start is the caller's
    # After the first bad state everything is void, even what looks like numbers.
    steps = np.logical_and.accumulate(good, axis=1).sum(1) - 1
    return grid_result(
        grid,
        kept,
        q[:, kept],
        v[:, kept],
        steps,
        single=single,
        why=lambda _: "",
        evaluations=int(steps.sum()) * method.stages,
    )


# Drake's own integrators, with a tolerance.


def run_drake(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or each of a batch by itself, to the times of `save`.

    Steps end on the saved times. Drake has one accuracy, relative to a state of size 1 and above, for which
    `rtol` is taken.
    """
    dyn, torque = problem.dyn, problem.torque
    # Drake is an extra.
    from mbkit.engines.drake.engine import DrakeDynamics, DrakeRun

    if not isinstance(dyn, DrakeDynamics) or torque.callable or problem.events:
        raise UnsupportedError(
            f"{problem.method}: takes neither torque functions nor events; use method={ADAPTIVE_METHOD!r}"
        )
    save, times = problem.saved_times()
    scheme, accuracy = method_of(problem.method).scheme, problem.tolerances.rtol
    records, evaluations = [], 0
    for i, (q, v) in enumerate(zip(problem.q, problem.v, strict=True)):
        record = record_of(problem, i)
        run = DrakeRun(dyn, scheme, accuracy, problem.start, q, v, problem.report(i))
        _over(record, run, times, frozenset(save.tolist()), torque.of_member(problem.member(i)))
        record.steps, record.rejected = run.steps, run.rejected
        evaluations += run.evaluations
        records.append(record)
    return assemble_result(problem, records, evaluations=evaluations)


def _over(record: TrajectoryRecord, run: DrakeRun, times: Array, saved: frozenset[float], force: object) -> None:
    """Take one trajectory through the times, as far as it goes."""
    y = np.concatenate(run.state())
    for k, t in enumerate(times.tolist()):
        if k:
            run.push(np.asarray(force(k - 1)))  # type: ignore[operator]  # of what is held
            try:
                y = np.concatenate(run.over(t))
            except RuntimeError as error:
                text = str(error).strip().splitlines()[0]
                record.stop("step_too_small", f"step below the smallest: stiff, singular or diverging ({text})")
                return
            if not is_bounded(y[None]).all():
                record.stop("diverged", f"diverged: {DIVERGED}")
                return
        record.reached = t
        if t in saved:
            record.keep(t, y)
