"""The record of each trajectory while a solver runs, and all of them as one result."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from math import inf
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import FunctionError
from mbkit.methods.registry import Tolerances
from mbkit.model import Model
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.constraint_projection import SingularPoses
from mbkit.simulate.events import Hit
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import Ended, SolverResult
from mbkit.simulate.time_grid import Grid, Indices

#: Attempted steps between two looks at the time that they covered, and the least part of the run that they must
#: cover. A run at that pace takes 2e10 steps.
_ATTEMPTS: Final = 20_000
_COVERED: Final = 1e-6


class TrajectoryRecord:
    """One trajectory of an adaptive solver: `save` are times to keep, None for the end of every step.

    `reached` is the time and `last` the configuration of the last good state; `ended` is as in `Stats`.
    """

    def __init__(
        self,
        model: Model,
        save: Sequence[float] | None = None,
        start: float = 0.0,
        duration: float = inf,
        poses: SingularPoses | None = None,
    ) -> None:
        self._model, self._save, self._duration = model, save, duration
        self.steps = self.rejected = 0
        self.reached = self._last_time = start
        self.poses = poses
        self.last: Array | None = None
        self.ended: Ended = "finished"
        self.message = ""
        self.events: list[Hit] = []
        self.error: FunctionError | None = None
        self._look = 0, start
        self._kept: list[tuple[Array, Array, Array]] = []
        self._count = 0

    def begin(self, t: float, y: Array) -> None:
        """Keep the start if it is wanted."""
        if self._save is None or (len(self._save) and self._save[0] == t):
            self.keep(t, y)

    def add(self, t: Array, q: Array, v: Array) -> None:
        """Keep states: (n,), (n, nq) and (n, nv)."""
        if len(t):
            self._kept.append((t, q, v))
            self._count += len(t)
            self._last_time = float(t[-1])

    def keep(self, t: float, y: Array) -> None:
        """Keep a state (q, v) with quaternions of any length."""
        nq = self._model.nq
        q, _ = unit_quaternions(self._model, y[:nq])
        self.add(np.array([t]), q[None].copy(), y[None, nq:].copy())

    def keep_step(self, t: float, end: float, state: Callable[[float], Array]) -> None:
        """Keep what is wanted of a step that ended at t, up to `end`; state(t) is (q, v) within the step."""
        if self._save is None:
            if end == t:
                self.keep(t, state(t))
            return
        while self._count < len(self._save) and self._save[self._count] <= end:
            self.keep(self._save[self._count], state(self._save[self._count]))

    @property
    def states(self) -> tuple[Array, Array, Array]:
        """Kept t, q and v."""
        if not self._kept:
            return np.empty(0), np.empty((0, self._model.nq)), np.empty((0, self._model.nv))
        t, q, v = (np.concatenate(parts) for parts in zip(*self._kept, strict=True))
        return t, q, v

    def saw(self, t: float, q: Array) -> None:
        """Take in the end of a step that is part of the run."""
        self.last = q
        if self.poses is not None:
            self.poses.saw(t, q)

    def crawls(self) -> bool:
        """End the run where many steps cover next to none of it; return whether they do."""
        attempts, (before, since) = self.steps + self.rejected, self._look
        if attempts - before < _ATTEMPTS:
            return False
        covered = self.reached - since
        self._look = attempts, self.reached
        if covered < _COVERED * self._duration:
            self.stop(
                "step_too_small",
                f"{attempts - before} steps covered {covered:.2g} s alone: stiff, singular or diverging",
            )
            return True
        return False

    def stop(self, ended: Ended, message: str) -> None:
        """End early, after `reached`."""
        self.ended, self.message = ended, f"{message} after t = {self.reached:.6g} s"

    def stop_below_rounding(self, tolerances: Tolerances) -> None:
        """End where no step is long enough to change the time."""
        rtol, atol = tolerances
        own = "" if atol == rtol else f", atol = {atol:g}"
        self.stop("step_too_small", f"step below rounding at rtol = {rtol:g}{own}: stiff, singular or diverging")

    def stop_at(self, hit: Hit) -> None:
        """End at an event; of one of a batch the state is with the event, off the common times."""
        self.ended, self.reached = "event", hit.t
        self.message = f"stopped by {hit.name} at t = {hit.t:.6g} s"
        if hit.member is None and not (self._kept and self._last_time == hit.t):
            self.add(np.array([hit.t]), hit.q[None], hit.v[None])

    def fail(self, error: FunctionError) -> None:
        """End where a torque or event function failed."""
        self.ended, self.message, self.error = "function_failed", str(error), error


def record_of(problem: IntegrationProblem, i: int) -> TrajectoryRecord:
    """Return the empty record of the i-th trajectory."""
    dyn, member = problem.dyn, problem.member(i)
    poses = SingularPoses(dyn if member is None else dyn.of_samples([member])) if dyn.model.constrained else None
    save = None if problem.save is None else problem.save.tolist()
    return TrajectoryRecord(dyn.model, save, problem.start, problem.duration, poses)


def assemble_result(
    problem: IntegrationProblem, records: Sequence[TrajectoryRecord], *, evaluations: int, jacobians: int = 0
) -> SolverResult:
    """Return one trajectory, or a batch of them as far as they came; those that were not begun have no record.

    `evaluations` and `jacobians` are of all together.
    """
    batch, model = problem.batch, problem.dyn.model
    states = [record.states for record in records]
    if batch is None:
        t, q, v = states[0]
        reached = np.asarray(records[0].reached)
    else:
        assert problem.save is not None
        # A batch of none has all its times.
        count = max((len(t) for t, _, _ in states), default=0 if batch else len(problem.save))
        t, reached = problem.save[:count], np.zeros(batch)
        reached[: len(records)] = [record.reached for record in records]
        q, v = (np.full((batch, count, n), np.nan) for n in (model.nq, model.nv))
        for i, (own, *state) in enumerate(states):
            q[i, : len(own)], v[i, : len(own)] = state
    ended, message = _end(records, batch)
    return SolverResult(
        t=np.array(t, dtype=np.float64),
        q=q,
        v=v,
        steps=sum(record.steps for record in records),
        evaluations=evaluations,
        ended=ended,
        reached=reached,
        message=message,
        rejected=sum(record.rejected for record in records),
        jacobians=jacobians,
        events=tuple(hit for record in records for hit in record.events),
        error=next((record.error for record in records if record.error), None),
        last=next((record.last for record in records if record.ended in ("diverged", "step_too_small")), None),
        doubts=tuple(
            dict.fromkeys(record.poses.describe() for record in records if record.poses and record.poses.times)
        ),
    )


def _end(records: Sequence[TrajectoryRecord], batch: int | None) -> tuple[Ended, str]:
    # Failures come before events.
    early = [record for record in records if record.ended != "finished"]
    early.sort(key=lambda record: ("function_failed", "diverged", "step_too_small", "event").index(record.ended))
    if not early:
        return "finished", ""
    first = early[0]
    if batch is None or first.error is not None:
        return first.ended, first.message
    return first.ended, f"{first.message}; {len(early)} of {batch} trajectories ended early, see reached"


def grid_result(
    grid: Grid,
    kept: Indices,
    q: Array,
    v: Array,
    steps: Indices,
    *,
    single: bool,
    why: Callable[[int], str],
    evaluations: int,
    jacobians: int = 0,
    error: FunctionError | None = None,
) -> SolverResult:
    """Return the result of a run with a fixed step.

    `kept` are the indices of the states q and v, (n, K, ...), which are overwritten by NaN behind the good `steps` of
    each trajectory, (n,). why(i) is the reason why trajectory i diverged, or empty.
    """
    lost = np.flatnonzero(steps < grid.steps)
    for i in lost:
        after = bisect_right(kept, steps[i])
        q[i, after:], v[i, after:] = np.nan, np.nan
    message = "" if error is None else str(error)
    if error is None and len(lost):
        first = int(lost[np.argmin(steps[lost])])
        k, reason = int(steps[first]), why(first)
        message = f"diverged after t = {grid.time(k):.6g} s (step {k + 1})" + (f": {reason}" if reason else "")
        message += f"; dt = {grid.dt:g} s may be too long"
        if not single:
            message += f"; {len(lost)} of {len(steps)} trajectories diverged, see reached"
    rows = int(np.count_nonzero(kept <= steps.max())) if len(steps) else len(kept)
    q, v = (x if rows == len(kept) else x[:, :rows].copy() for x in (q, v))
    # Read-only, so that nobody needs a copy.
    q.setflags(write=False)
    v.setflags(write=False)
    reached = np.array([grid.time(int(k)) for k in steps])
    return SolverResult(
        t=np.array([grid.time(int(k)) for k in kept[:rows]]),
        q=q[0] if single else q,
        v=v[0] if single else v,
        steps=int(steps.sum()),
        evaluations=evaluations,
        ended="function_failed" if error is not None else "diverged" if message else "finished",
        reached=np.asarray(reached[0] if single else reached),
        message=message,
        jacobians=jacobians,
        error=error,
    )
