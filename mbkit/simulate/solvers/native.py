"""MuJoCo's own integrators, through the engine that has them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import UnsupportedError
from mbkit.methods.registry import Method
from mbkit.simulate.progress import Progress
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.runge_kutta import is_bounded
from mbkit.simulate.time_grid import Grid, Indices, check_room
from mbkit.simulate.torque import Torque

__all__ = ["HasRollout", "run_native"]


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
    """Run the engine's integrator; from the first state that is none on, nothing is kept."""
    engine, integrator = method.name.split("_", 1)
    if dyn.engine != engine or not isinstance(dyn, HasRollout):
        raise UnsupportedError(
            f"{method.name}: an integrator of {engine}'s own, which {dyn.engine} has not; "
            f"use mbkit.dynamics(model, {engine!r}), or method='rk4' or 'semi_implicit_euler' with its formulas"
        )
    if torque.callable:
        raise UnsupportedError(
            f"{method.name}: {engine} steps by itself and cannot call back; give the torque as an array, "
            "or use method='rk4' or 'semi_implicit_euler'"
        )
    check_room((grid.steps + 1) * (1 if q0.ndim == 1 else len(q0)), q0.shape[-1] + v0.shape[-1])
    if q0.ndim == 2 and not len(q0):
        # mujoco.rollout 4.0.0 does not survive an empty batch.
        empty = np.empty((0, grid.steps + 1, q0.shape[-1])), np.empty((0, grid.steps + 1, v0.shape[-1]))
        return _outcome(method, grid, kept, *empty)
    # MuJoCo's step is fixed for a rollout, so a shortened last step is a rollout of its own.
    whole = grid.steps if grid.last == grid.dt else grid.steps - 1
    first: dict[str, Any] = {"q0": q0, "v0": v0, "dt": grid.dt, "tau": torque.over(0, whole), "steps": whole}
    q, v = dyn.rollout(integrator=integrator, progress=bar.update, **first)
    if whole < grid.steps:
        # What has diverged is void whatever follows; it only must not stop the others.
        good = np.isfinite(q[..., -1, :]).all(-1, keepdims=True) & np.isfinite(v[..., -1, :]).all(-1, keepdims=True)
        q1, v1 = np.where(good, q[..., -1, :], q0), np.where(good, v[..., -1, :], v0)
        tail = torque.over(whole, grid.steps)
        q1, v1 = dyn.rollout(integrator=integrator, q0=q1, v0=v1, dt=grid.last, tau=tail, steps=1)
        q, v = np.concatenate([q, q1[..., 1:, :]], -2), np.concatenate([v, v1[..., 1:, :]], -2)
    return _outcome(method, grid, kept, np.asarray(q), np.asarray(v))


def _outcome(method: Method, grid: Grid, kept: Indices, q: Array, v: Array) -> SolverResult:
    good = is_bounded(q) & is_bounded(v)
    good[..., 0] = True  # the start is the caller's
    # After the first bad state everything is void, even what looks like numbers.
    good = np.logical_and.accumulate(good, axis=-1)
    count = good.sum(-1)
    times = np.array([grid.time(k) for k in range(q.shape[-2])])
    reached = times[count - 1]
    full = grid.steps + 1
    message = ""
    if np.any(count < full):
        first = int(np.min(count))
        message = f"diverged after t = {grid.time(first - 1):.6g} s (step {first}); dt = {grid.dt:g} s may be too long"
        if good.ndim == 2:
            message += f"; {np.count_nonzero(count < full)} of {len(count)} trajectories diverged, see reached"
    q, v = np.where(good[..., None], q, np.nan), np.where(good[..., None], v, np.nan)
    index = kept[kept < np.max(count)] if count.size else kept
    steps = int(np.sum(count - 1))
    return SolverResult(
        t=np.array([grid.time(int(k)) for k in index]),
        q=q[..., index, :],
        v=v[..., index, :],
        steps=steps,
        evaluations=steps * method.stages,
        ended="diverged" if message else "finished",
        reached=np.asarray(reached),
        message=message,
    )
