"""The record of a run while a solver goes on, on a grid or with steps of each trajectory's own, and its result."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines.constrained import AT_SINGULAR_POSE
from mbkit.errors import FunctionError
from mbkit.methods.registry import Tolerances
from mbkit.model.integration_space import Space
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.events import Hit, State, Watch
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.run_data import Ended, SolverResult, Stats
from mbkit.simulate.singular_poses import SingularPoses
from mbkit.simulate.solvers.vector_field import DIVERGED, are_bounded
from mbkit.simulate.time_grid import Indices

#: Number of attempted steps between two looks at the time that they covered, and the smallest share of the run that
#: they must cover. A run at that pace takes 2e10 steps.
_ATTEMPTS_PER_LOOK: Final = 20_000
_MIN_SHARE_COVERED: Final = 1e-6
#: Most attempts of a trajectory between two looks at them.
ROUNDS: Final = 256
#: A batch tells the first of its ends in this order.
_ENDS: Final[tuple[Ended, ...]] = ("function_failed", "diverged", "step_too_small", "event")


class RunRecord:
    """All that is known of a run but its states; `assembled` is the only place that makes a result.

    `early` has how each trajectory ended that did not reach the end, and why; `last` and `error` are as in
    `SolverResult`.
    """

    def __init__(self, problem: IntegrationProblem) -> None:
        self.problem = problem
        self.steps = self.rejected = self.evaluations = self.jacobians = 0
        self.chosen = ""
        self.doubts: list[str] = []
        self.events: list[Hit] = []
        self.last: Array | None = None
        self.error: FunctionError | None = None
        self.early: dict[int, tuple[Ended, str]] = {}
        self.poses: dict[int, SingularPoses] = {}

    def count(self, part: RunRecord | Stats) -> None:
        """Add the cost of a part of the run."""
        for name in ("steps", "rejected", "evaluations", "jacobians"):
            setattr(self, name, getattr(self, name) + getattr(part, name))
        self.chosen = self.chosen or part.chosen

    def assembled(self, t: Array, q: Array, v: Array, reached: list[float]) -> SolverResult:
        """Return the result with states (N, K, ·) at common times, and the time that each trajectory reached."""
        batch = self.problem.batch
        ended, message = self._end(reached)
        return SolverResult(
            t=np.array(t, dtype=np.float64),
            q=q[0] if batch is None else q,
            v=v[0] if batch is None else v,
            steps=self.steps,
            evaluations=self.evaluations,
            ended=ended,
            reached=reached[0] if batch is None else tuple(reached),
            message=message,
            rejected=self.rejected,
            jacobians=self.jacobians,
            events=tuple(self.events),
            error=self.error,
            last=self.last,
            chosen=self.chosen,
            doubts=tuple(dict.fromkeys(self.doubts)),
            poses=self.poses,
        )

    def _end(self, reached: list[float]) -> tuple[Ended, str]:
        if self.error is not None:
            return "function_failed", str(self.error)
        if not self.early:
            return "finished", ""
        ended, message = self.early[min(self.early, key=lambda i: (_ENDS.index(self.early[i][0]), reached[i], i))]
        if self.problem.batch is not None:
            how = "diverged" if {end for end, _ in self.early.values()} == {"diverged"} else "ended early"
            message += f"; {len(self.early)} of {self.problem.batch} trajectories {how}, see reached"
        return ended, message


class GridRecord(RunRecord):
    """Record of a run with a fixed step: kept states of each trajectory, (n, K, ...), and its good steps, (n,).

    The states are put into `room`, q and v, where there is one.
    """

    def __init__(self, problem: IntegrationProblem, *room: Array) -> None:
        super().__init__(problem)
        self.kept = problem.kept
        n, rows = len(problem.q), len(problem.kept)
        # Written by the threads, so that each of them pays for its own pages.
        own = (np.empty((n, rows, x.shape[1])) for x in (problem.q, problem.v))
        # Of a room are views, as results are read-only; a view among results would be copied.
        self.q, self.v = (x[:] for x in room) if room else own
        self.good: Indices = np.zeros(n, dtype=np.intp)
        if self.kept[0] == 0:
            self.q[:, 0], self.v[:, 0] = problem.q, problem.v

    def rows(self, first: int, last: int) -> slice:
        """Return the saved rows of the states from the first to the last."""
        return slice(*self.kept.searchsorted((first, last + 1)).tolist())

    def result(self, why: Callable[[int], str] = lambda _: "") -> SolverResult:
        """Return the result, with NaN behind the good steps; why(i) is why trajectory i diverged, or empty."""
        grid, kept, good, q, v = self.problem.grid, self.kept, self.good, self.q, self.v
        self.steps = self.steps or int(good.sum())
        lost = np.flatnonzero(good < grid.steps)
        for i in lost:
            after = bisect_right(kept, good[i])
            q[i, after:], v[i, after:] = np.nan, np.nan
        if len(lost) and self.error is None and not self.early:
            first = int(lost[np.argmin(good[lost])])
            k, reason = int(good[first]), why(first)
            message = f"diverged after t = {grid.time(k):.6g} s (step {k + 1})" + (f": {reason}" if reason else "")
            if AT_SINGULAR_POSE not in reason:
                message += f"; dt = {grid.dt:g} s may be too long"
            self.early = dict.fromkeys(lost.tolist(), ("diverged", message))
        rows = int(np.count_nonzero(kept <= good.max())) if len(good) else len(kept)
        q, v = (x if rows == len(kept) else x[:, :rows].copy() for x in (q, v))
        # Read-only, so that nobody needs a copy.
        q.setflags(write=False)
        v.setflags(write=False)
        return self.assembled(grid.times_of(kept[:rows]), q, v, grid.times_of(good).tolist())


class StoppedError(Exception):
    """A state that has no next one; never leaves mbkit. `ended` is as in `Stats`."""

    def __init__(self, ended: Ended, message: str) -> None:
        super().__init__(message)
        self.ended = ended


def diverged(reason: str = "") -> StoppedError:
    """Return the end of a run whose states or rates are no numbers."""
    return StoppedError("diverged", f"diverged: {reason or DIVERGED}")


def below_rounding(tolerances: Tolerances) -> StoppedError:
    """Return the end of a run where no step is long enough to change the time."""
    rtol, atol = tolerances
    own = "" if atol == rtol else f", atol = {atol:g}"
    return StoppedError(
        "step_too_small", f"stopped with a step below rounding at rtol = {rtol:g}{own}: stiff, singular or diverging"
    )


@dataclass(frozen=True, eq=False)
class AcceptedSteps:
    """Accepted steps of one trajectory in a row, the state before the first in front."""

    t: Array  # (n + 1,)
    q: Array  # (n + 1, nq)
    w: Array  # (n + 1, nv), of `Space`
    attempts: int = 1

    def rows(self, which: Indices) -> AcceptedSteps:
        """Return some of the states."""
        return AcceptedSteps(self.t[which], self.q[which], self.w[which], 0)


#: (start, times) -> (q, w) at times, (m, nq) and (m, nv), each within the step from the state of the same row.
Within = Callable[[AcceptedSteps, Array], tuple[Array, Array]]


class TrajectoryRecord(RunRecord):
    """Record of one trajectory of an adaptive solver, with its kept states.

    `reached` is the time of the last good state; `ended` is as in `Stats`. Without a space, velocities are mbkit's and
    quaternions of any length.
    """

    def __init__(self, problem: IntegrationProblem, i: int, space: Space | None = None) -> None:
        super().__init__(problem)
        dyn, member, self.index = problem.dyn, problem.member(i), i
        self._model, self._space, self._save = dyn.model, space, problem.save
        self._watch = Watch(problem.events, member) if problem.events else None
        own = dyn if member is None or not dyn.model.constrained else dyn._of_samples([member])
        self.passed = SingularPoses(own) if dyn._projects else None
        self.reached = problem.start
        self._q: Array | None = None
        self.ended: Ended = "finished"
        self.message = ""
        self._look = 0, problem.start
        self._kept: list[tuple[Array, Array, Array]] = []

    def begin(self, q: Array, v: Array) -> None:
        """Keep the start if it is wanted."""
        if self._save is None or (len(self._save) and self._save[0] == self.reached):
            self.keep(np.array([self.reached]), q[None], v[None])
        if self._watch is not None:
            self._watch.start(self.reached, q, v)
        if self.passed is not None:
            self.passed.saw(self.reached, q)

    def take(self, accepted: AcceptedSteps, within: Within) -> bool:
        """Add steps; return whether to go on."""
        steps = len(accepted.t) - 1
        self.rejected += accepted.attempts - steps
        # A state that is not bounded stays so: the last one tells.
        lost = not are_bounded(accepted.q[-1], accepted.w[-1])
        if lost:
            good = are_bounded(accepted.q[1:], accepted.w[1:])
            steps = int(np.argmin(good)) if len(good) else 0
        hit = None if self._watch is None else self._first_end(self._watch, accepted, steps, within)
        if hit is not None:
            steps = int(np.searchsorted(accepted.t, hit.t))
        until = float(accepted.t[steps]) if hit is None else hit.t
        if not self._keep(accepted, steps, until, within):
            # A step shorter than a good one met NaN.
            steps, hit, lost = 0, None, True
            until = float(accepted.t[0])
        self.steps += steps
        self.reached = until
        if steps:
            self._q = accepted.q[steps]
        if self.passed is not None:
            ends = slice(1, steps + (hit is None))
            self.passed.saw(accepted.t[ends], accepted.q[ends])
            if hit is not None:
                self.passed.saw(hit.t, hit.q)
        if hit is not None:
            self.stop_at(hit)
        elif lost:
            self.stop(diverged())
        return hit is None and not lost

    def keep(self, t: Array, q: Array, v: Array) -> None:
        """Keep states, (n,), (n, nq) and (n, nv), in mbkit's velocities."""
        if len(t):
            self._kept.append((t, q, v))

    def _state(self, q: Array, w: Array) -> tuple[Array, Array]:
        """Return q and mbkit's v."""
        if self._space is not None:
            return q, self._space.to_body_velocity(q, w)
        if self._model.quaternions:
            # Row by row: NumPy rounds the norms of several rows otherwise.
            q = np.array([unit_quaternions(self._model, x)[0] for x in np.atleast_2d(q)]).reshape(q.shape)
        return q, w

    def _first_end(self, watch: Watch, accepted: AcceptedSteps, steps: int, within: Within) -> Hit | None:
        """Look for events in the first steps; return the one that ends the run."""

        def in_step(k: int) -> State:
            def state(t: float) -> tuple[Array, Array]:
                if t in (accepted.t[k], accepted.t[k + 1]):
                    at = k + int(t == accepted.t[k + 1])
                    return self._state(accepted.q[at], accepted.w[at])
                q, w = within(accepted.rows(np.array([k])), np.array([t]))
                return self._state(q[0], w[0])

            return state

        for k in range(steps):
            hits, last = watch.look(float(accepted.t[k + 1]), in_step(k))
            self.events += hits
            if last is not None:
                return last
        return None

    def _keep(self, accepted: AcceptedSteps, steps: int, until: float, within: Within) -> bool:
        """Keep the wanted states up to a time in the last step; return False, and keep none, if one is unbounded."""
        if self._save is None:
            ends = slice(1, steps + 1 - int(until != accepted.t[steps]))
            self.keep(accepted.t[ends], *self._state(accepted.q[ends], accepted.w[ends]))
            return True
        first, last = self._save.searchsorted((accepted.t[0], until), side="right")
        if first == last:
            return True
        times = self._save[first:last]
        after = np.searchsorted(accepted.t, times)
        q, w = accepted.q[after], accepted.w[after]
        between = np.flatnonzero(accepted.t[after] != times)
        if len(between):
            q[between], w[between] = inner = within(accepted.rows(after[between] - 1), times[between])
            if not are_bounded(*inner).all():
                return False
        self.keep(times, *self._state(q, w))
        return True

    @property
    def states(self) -> tuple[Array, Array, Array]:
        """Kept t, q and v."""
        if not self._kept:
            return np.empty(0), np.empty((0, self._model.nq)), np.empty((0, self._model.nv))
        t, q, v = (np.concatenate(parts) for parts in zip(*self._kept, strict=True))
        return t, q, v

    def crawls(self) -> bool:
        """End the run where many steps cover next to none of it; return whether they do."""
        attempts, (before, since) = self.steps + self.rejected, self._look
        if attempts - before < _ATTEMPTS_PER_LOOK:
            return False
        covered = self.reached - since
        self._look = attempts, self.reached
        if covered < _MIN_SHARE_COVERED * self.problem.duration:
            why = f"stopped, as {attempts - before} steps covered {covered:.2g} s alone: stiff, singular or diverging"
            self.stop(StoppedError("step_too_small", why))
            return True
        return False

    def stop(self, reason: StoppedError) -> None:
        """End early, after `reached`."""
        self.last = self._q
        self.ended, self.message = reason.ended, f"{reason} after t = {self.reached:.6g} s"

    def stop_at(self, hit: Hit) -> None:
        """End at an event, whose state is the last one."""
        # The state of one of a batch is with the event, off the common times.
        self.ended, self.message = "event", f"stopped by {hit.name} at t = {hit.t:.6g} s"
        if hit.member is None and not (self._kept and self._kept[-1][0][-1] == hit.t):
            self.keep(np.array([hit.t]), hit.q[None], hit.v[None])

    def fail(self, error: FunctionError) -> None:
        """End where a torque or event function failed."""
        self.ended, self.message, self.error = "function_failed", str(error), error


def run_each(
    problem: IntegrationProblem, walk: Callable[[int, Array, TrajectoryRecord], Iterable[tuple[float, Array, Any]]]
) -> list[TrajectoryRecord]:
    """Integrate the states y = (q, v) one by one.

    walk(i, y, record) yields the end of each step as (t, y, at), with at(t) -> y within the step.
    """
    records, nq = [], problem.dyn.model.nq
    for i, y in enumerate(problem.y):
        record, report = TrajectoryRecord(problem, i), problem.report(i)
        records.append(record)
        try:
            record.begin(unit_quaternions(problem.dyn.model, y[:nq])[0], y[nq:])
            t = problem.start
            for t1, y1, at in walk(i, y, record):
                both = np.array([y, y1])
                accepted = AcceptedSteps(np.array([t, t1]), both[:, :nq], both[:, nq:])
                if not record.take(accepted, _by_rows(at, nq)) or record.crawls():
                    break
                report(t1)
                t, y = t1, y1
        except StoppedError as error:
            record.stop(error)
        except FunctionError as error:
            record.fail(error)
            break
    return records


def _by_rows(at: Callable[[float], Array], nq: int) -> Within:
    def within(_start: AcceptedSteps, times: Array) -> tuple[Array, Array]:
        states = np.array([at(t) for t in times.tolist()])
        return states[:, :nq], states[:, nq:]

    return within


def assemble_result(
    problem: IntegrationProblem, records: Sequence[TrajectoryRecord], *, evaluations: int = 0, jacobians: int = 0
) -> SolverResult:
    """Return one trajectory, or a batch of them as far as they came; those that were not begun have no record.

    `evaluations` and `jacobians` are those of all together that no record has.
    """
    batch, model, run = problem.batch, problem.dyn.model, RunRecord(problem)
    run.evaluations, run.jacobians = evaluations, jacobians
    reached = [problem.start] * len(problem.q)
    for record in records:
        run.count(record)
        run.doubts += record.doubts
        run.events += record.events
        run.error = run.error or record.error
        run.last = record.last if run.last is None else run.last
        reached[record.index] = float(record.reached)
        if record.ended != "finished":
            run.early[record.index] = record.ended, record.message
    run.poses = {record.index: record.passed for record in records if record.passed}
    states = [record.states for record in records]
    if batch is None:
        t, q, v = states[0][0], *(x[None] for x in states[0][1:])
    else:
        assert problem.save is not None
        # A batch of none has all its times.
        count = max((len(t) for t, _, _ in states), default=0 if batch else len(problem.save))
        t = problem.save[:count]
        q, v = (np.full((batch, count, n), np.nan) for n in (model.nq, model.nv))
        for i, (own, *state) in enumerate(states):
            q[i, : len(own)], v[i, : len(own)] = state
    return run.assembled(t, q, v, reached)
