"""SciPy's DOP853 on q and v: an independent road to a reference.

Hairer, Nørsett, Wanner 1993, Solving Ordinary Differential Equations I, ch. II.5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import InputError
from mbkit.model import Model
from mbkit.simulate.grid import check_room
from mbkit.simulate.outcome import Outcome
from mbkit.simulate.progress import Progress
from mbkit.simulate.rates import Rates, unit_quaternions
from mbkit.simulate.stats import Ended
from mbkit.simulate.steps import RAN_AWAY, credible
from mbkit.simulate.torque import Force, Torque

__all__ = ["run_dop853"]


@dataclass(frozen=True)
class _Task:
    """One state to integrate; `stops` are the times that steps must end on."""

    y0: Array
    rtol: float
    atol: float
    stops: tuple[float, ...]
    saved: frozenset[float] | None
    force: Callable[[int], Force]
    held: bool


@dataclass
class _Run:
    """What came of it."""

    t: list[float] = field(default_factory=list)
    y: list[Array] = field(default_factory=list)
    steps: int = 0
    reached: float = 0.0
    ended: Ended = "finished"
    message: str = ""

    def stop(self, ended: Ended, message: str) -> _Run:
        self.ended, self.message = ended, f"{message} after t = {self.reached:.6g} s"
        return self


def run_dop853(
    dyn: Dynamics,
    q0: Array,
    v0: Array,
    duration: float,
    rtol: float,
    atol: float,
    torque: Torque,
    save: Array | None,
    bar: Progress,
) -> Outcome:
    """Integrate one state, or each of a batch by itself.

    Steps end exactly on the saved times, because DOP853's interpolant is of lower
    order than its steps. Without `save`, the solver's own steps are kept.
    """
    batch = None if q0.ndim == 1 else len(q0)
    if batch is not None and save is None:
        raise InputError(
            "save: expected a grid of times for a batch with an adaptive method; without it each state has its own"
        )
    y0 = np.concatenate([q0, v0], axis=-1).reshape(-1, q0.shape[-1] + v0.shape[-1])
    if save is not None:
        check_room(len(save) * len(y0), y0.shape[1])
    stops = (duration,) if save is None else tuple(sorted({*save.tolist(), duration} - {0.0}))
    saved = None if save is None else frozenset(save.tolist())
    rates = Rates(dyn)
    runs = []
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for i, start in enumerate(y0):
            if batch is not None:
                rates.only(i)
            force = torque.of_member(None if batch is None else i)
            task = _Task(start, rtol, atol, stops, saved, force, torque.held)
            runs.append(_integrate(rates, task, _reporter(bar, i, len(y0), duration)))
    return _gathered(dyn.model, runs, rates.evaluations, batch)


def _reporter(bar: Progress, i: int, count: int, duration: float) -> Callable[[float], None]:
    def done(t: float) -> None:
        bar.update((i + t / duration) / count)

    return done


def _integrate(rates: Rates, task: _Task, done: Callable[[float], None]) -> _Run:
    run = _Run()
    solver: Any = None
    if task.saved is None or 0.0 in task.saved:
        run.t.append(0.0)
        run.y.append(task.y0)
    for k, stop in enumerate(task.stops):
        if stop <= run.reached:
            continue  # a run of no duration
        if solver is None or task.held:
            # A held force jumps here, and with it the rate that the solver remembers.
            solver = _solver(rates, task, k, solver, stop)
        if solver is None:
            return run.stop("diverged", f"diverged: {rates.why or RAN_AWAY}")
        solver.t_bound, solver.status = stop, "running"
        while solver.status == "running":
            rates.why = ""
            solver.step()
            if solver.status == "failed" and rates.why:
                return run.stop("diverged", f"diverged: {rates.why}")
            # 1/eps steps would never end, though near t = 0 they are above rounding.
            if solver.status == "failed" or solver.h_abs < task.stops[-1] * np.finfo(float).eps:
                told = f"step below rounding at rtol = {task.rtol:g}: stiff, singular or diverging"
                return run.stop("step_too_small", told)
            if not credible(solver.y):
                return run.stop("diverged", f"diverged: {RAN_AWAY}")
            run.steps += 1
            run.reached = float(solver.t)
            if task.saved is None or (solver.status == "finished" and stop in task.saved):
                run.t.append(run.reached)
                run.y.append(solver.y.copy())
            done(run.reached)
    return run


def _solver(rates: Rates, task: _Task, k: int, last: Any, stop: float) -> Any:
    from scipy.integrate import DOP853

    t, y = (0.0, task.y0) if last is None else (last.t, last.y)
    first = None if last is None else min(last.h_abs, stop - t)
    force = task.force(k)

    def rate(t: float, y: Array) -> Array:
        return rates(t, y, force)

    # SciPy would start from a rate that is none.
    if not np.isfinite(rate(t, y)).all():
        return None
    return DOP853(rate, t, y, stop, rtol=task.rtol, atol=task.atol, first_step=first)


def _gathered(model: Model, runs: list[_Run], evaluations: int, batch: int | None) -> Outcome:
    longest = max((run.t for run in runs), key=len, default=[])
    y = np.full((len(runs), len(longest), model.nq + model.nv), np.nan)
    for i, run in enumerate(runs):
        for j, state in enumerate(run.y):
            y[i, j, : model.nq] = unit_quaternions(model, state[: model.nq])[0]
            y[i, j, model.nq :] = state[model.nq :]
    early = [run for run in runs if run.message]
    message = early[0].message if early else ""
    if early and batch is not None:
        message += f"; {len(early)} of {batch} trajectories ended early, see reached"
    reached = np.array([run.reached for run in runs])
    y, reached = (y[0], reached[0]) if batch is None else (y, reached)
    return Outcome(
        t=np.array(longest),
        q=y[..., : model.nq],
        v=y[..., model.nq :],
        steps=sum(run.steps for run in runs),
        evaluations=evaluations,
        ended=early[0].ended if early else "finished",
        reached=np.asarray(reached),
        message=message,
    )
