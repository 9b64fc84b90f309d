"""The record of each trajectory while an adaptive solver runs, and all of them as one result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import FunctionError
from mbkit.methods.registry import Tolerances
from mbkit.model.integration_space import Space
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.events import Hit, State, Watch
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import Ended, SolverResult, Stats
from mbkit.simulate.singular_poses import SingularPoses, describe_poses
from mbkit.simulate.solvers.vector_field import DIVERGED, are_bounded
from mbkit.simulate.time_grid import Indices

#: Attempted steps between two looks at the time that they covered, and the least part of the run that they must
#: cover. A run at that pace takes 2e10 steps.
_ATTEMPTS: Final = 20_000
_COVERED: Final = 1e-6
#: Attempts of a trajectory between two looks at them, at most.
ROUNDS: Final = 256


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


class TrajectoryRecord:
    """One trajectory of an adaptive solver: kept states, counts, events, and how it ended.

    `reached` is the time and `last` the configuration of the last good state; `ended` is as in `Stats`. Without a
    space, velocities are mbkit's and quaternions of any length.
    """

    def __init__(self, problem: IntegrationProblem, i: int, space: Space | None = None) -> None:
        dyn, member, self.index = problem.dyn, problem.member(i), i
        self._problem, self._model, self._space, self._save = problem, dyn.model, space, problem.save
        self._watch = Watch(problem.events, member) if problem.events else None
        own = dyn if member is None or not dyn.model.constrained else dyn.of_samples([member])
        self.poses = SingularPoses(own) if dyn.projects else None
        self.steps = self.rejected = self.evaluations = self.jacobians = 0
        self.chosen = ""
        self.doubts: list[str] = []
        self.reached = problem.start
        self.last: Array | None = None
        self.ended: Ended = "finished"
        self.message = ""
        self.events: list[Hit] = []
        self.error: FunctionError | None = None
        self._look = 0, problem.start
        self._kept: list[tuple[Array, Array, Array]] = []

    def begin(self, q: Array, v: Array) -> None:
        """Keep the start if it is wanted."""
        if self._save is None or (len(self._save) and self._save[0] == self.reached):
            self.keep(np.array([self.reached]), q[None], v[None])
        if self._watch is not None:
            self._watch.start(self.reached, q, v)
        if self.poses is not None:
            self.poses.began(self.reached, q)

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
            self.last = accepted.q[steps]
        if self.poses is not None:
            self.poses.saw_all(accepted.t[1 : steps + 1], accepted.q[1 : steps + 1])
        if hit is not None:
            self.stop_at(hit)
        elif lost:
            self.stop(diverged())
        return hit is None and not lost

    def add(self, run: Stats, begin: float = 0.0) -> None:
        """Add the cost of a part that was a run of its own and began at a time, s."""
        for name in ("steps", "rejected", "evaluations", "jacobians"):
            setattr(self, name, getattr(self, name) + getattr(run, name))
        assert isinstance(run.reached, float)
        self.reached, self.chosen = begin + run.reached, run.chosen

    def keep(self, t: Array, q: Array, v: Array) -> None:
        """Keep states, (n,), (n, nq) and (n, nv), in mbkit's velocities."""
        if len(t):
            self._kept.append((t, q, v))

    def reach(self, t: float, y: Array) -> None:
        """Go on to a state (q, v), of a solver that does not tell its steps."""
        self.reached, nq = t, self._model.nq
        if self.poses is not None:
            self.poses.saw(t, y[:nq])
        if self._save is not None and t in self._save:
            self.keep(np.array([t]), *self._state(y[None, :nq], y[None, nq:]))

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
        if attempts - before < _ATTEMPTS:
            return False
        covered = self.reached - since
        self._look = attempts, self.reached
        if covered < _COVERED * self._problem.duration:
            why = f"stopped, as {attempts - before} steps covered {covered:.2g} s alone: stiff, singular or diverging"
            self.stop(StoppedError("step_too_small", why))
            return True
        return False

    def stop(self, reason: StoppedError) -> None:
        """End early, after `reached`."""
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

    walk(i, y, record) yields the end of each step as (t, y, at), with at(t) -> y within the step. Where at is None it
    yields saved states, and counts its steps in the record.
    """
    records, nq = [], problem.dyn.model.nq
    for i, y in enumerate(problem.y):
        record, report = TrajectoryRecord(problem, i), problem.report(i)
        records.append(record)
        try:
            record.begin(unit_quaternions(problem.dyn.model, y[:nq])[0], y[nq:])
            t = problem.start
            for t1, y1, at in walk(i, y, record):
                if at is None:
                    record.reach(t1, y1)
                else:
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
    batch, model = problem.batch, problem.dyn.model
    states = [record.states for record in records]
    if batch is None:
        t, q, v = states[0]
    else:
        assert problem.save is not None
        # A batch of none has all its times.
        count = max((len(t) for t, _, _ in states), default=0 if batch else len(problem.save))
        t = problem.save[:count]
        q, v = (np.full((batch, count, n), np.nan) for n in (model.nq, model.nv))
        for i, (own, *state) in enumerate(states):
            q[i, : len(own)], v[i, : len(own)] = state
    reached = [float(record.reached) for record in records] + [problem.start] * (len(problem.q) - len(records))
    ended, message = _end(records, batch)
    poses = describe_poses({i: record.poses for i, record in enumerate(records) if record.poses}, batch)
    return SolverResult(
        t=np.array(t, dtype=np.float64),
        q=q,
        v=v,
        steps=sum(record.steps for record in records),
        evaluations=evaluations + sum(record.evaluations for record in records),
        ended=ended,
        reached=reached[0] if batch is None else tuple(reached),
        message=message,
        rejected=sum(record.rejected for record in records),
        jacobians=jacobians + sum(record.jacobians for record in records),
        events=tuple(hit for record in records for hit in record.events),
        error=next((record.error for record in records if record.error), None),
        last=next((record.last for record in records if record.ended in ("diverged", "step_too_small")), None),
        chosen=next((record.chosen for record in records if record.chosen), ""),
        doubts=tuple(dict.fromkeys(filter(None, (poses, *(x for record in records for x in record.doubts))))),
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
