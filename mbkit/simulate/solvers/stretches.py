"""Runs by an adaptive method that events break into stretches, each with dynamics of its own.

Phases of dry friction are such stretches, and so are charts of a system under constraints. All else of a run goes on
across their ends: saved times, the user's events, samples of a controller, and one record.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Final, Protocol

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import FunctionError, NumericalError
from mbkit.simulate.events import Event, Hit
from mbkit.simulate.problem import IntegrationProblem, Solver
from mbkit.simulate.progress import Progress
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord, diverged
from mbkit.simulate.torque import Torque

#: Most stretches in a row that end where they begin.
_MAX_EMPTY: Final = 20
#: Largest length of one of these, relative to the run's times.
_NO_TIME: Final = 1e-12


@dataclass(eq=False, kw_only=True)
class Stretch:
    """Smooth dynamics from a state on, on coordinates of their own: here those of the run.

    Attributes
    ----------
    q, v : array
        The state, on the coordinates of the run.
    until : float
        Where it ends if no event ends it, s.
    begins : sequence of Hit
        Events of the run with which it begins.
    ends : sequence of Event
        Events, beside those of the run, that may end it.
    """

    dyn: Dynamics
    q: Array
    v: Array
    until: float = math.inf
    begins: Sequence[Hit] = ()
    ends: Sequence[Event] = ()
    #: Name of the event at its end that is none of the run.
    end: ClassVar[str] = ""

    def start(self) -> tuple[Array, Array]:
        """Return the state on its own coordinates."""
        return self.q, self.v

    def states(self, t: Array, q: Array, v: Array) -> tuple[Array, Array]:  # noqa: ARG002
        """Return its states, (n, ·), on the coordinates of the run."""
        return q, v

    def torque(self, torque: Torque) -> Torque:
        """Return the run's force on its own coordinates."""
        return torque

    def events(self, events: Sequence[Event]) -> Sequence[Event]:
        """Return the run's events on its own coordinates."""
        return events


class Breaks(Protocol):
    """A kind of stretches: with which one a run begins, and what follows at the end of each."""

    #: Message of a run whose stretches end where they begin; {t} is when, s.
    endless: str

    def first(self, t: float, q: Array, v: Array) -> Stretch:
        """Return the stretch with which a run begins."""

    def following(self, last: Stretch, hit: Hit | None, t: float, q: Array, v: Array, *, moved: bool) -> Stretch | None:
        """Return what follows a stretch that an event ended, or its time; None where the event ends the run.

        `moved` tells that time has passed in it.
        """


def run_in_stretches(
    problem: IntegrationProblem, i: int, breaks: Breaks, solver: Callable[[Dynamics], Solver]
) -> TrajectoryRecord:
    """Integrate the i-th state; `solver` gives that of smooth dynamics."""
    # Stretches look for the events.
    record = TrajectoryRecord(replace(problem, events=()), i)
    try:
        _to_end(problem, record, breaks, solver)
    except FunctionError as error:
        # A torque function failed while it was asked what follows.
        record.fail(error)
    except NumericalError as error:
        record.stop(diverged(str(error)))
    return record


def _to_end(
    problem: IntegrationProblem, record: TrajectoryRecord, breaks: Breaks, solver: Callable[[Dynamics], Solver]
) -> None:
    i, rows, t, empty = record.index, problem.save, problem.start, 0
    q, v = problem.q[i], problem.v[i]
    record.begin(q, v)
    if not problem.duration:
        return
    problem.sample(i, 0, t, np.concatenate([q, v]))
    stretch: Stretch | None = breaks.first(t, q, v)
    while stretch is not None:
        record.events += stretch.begins
        if t >= problem.end:
            return
        begun, t = t, min(stretch.until, problem.end)
        result = _solved(problem, record, stretch, begun, t, solver)
        record.add(result)
        record.last, record.doubts = result.last, [*record.doubts, *result.doubts]
        hits = [_of_run(hit, stretch, problem.member(i)) for hit in result.events]
        record.events += [hit for hit in hits if hit.name != stretch.end]
        last = hits[-1] if result.ended == "event" else None
        q, v = stretch.states(result.t, result.q, result.v)
        # The state at an end is kept as that with which another stretch begins.
        inner = result.t > begun
        inner[-1:] &= not result.finished
        record.keep(result.t[inner], q[inner], v[inner])
        if not result.finished:
            record.ended, record.message, record.error = result.ended, result.message, result.error
            return
        t, q, v = (t, q[-1], v[-1]) if last is None else (last.t, last.q, last.v)
        record.reached = t
        problem.report(i)(t)
        moved = t - begun > _NO_TIME * max(abs(begun), problem.duration)
        stretch, before = None, stretch
        if last is not None or t < problem.end:
            empty = 0 if moved else empty + 1
            if empty > _MAX_EMPTY:
                record.ended, record.message = "step_too_small", breaks.endless.format(t=t)
                return
            problem.sample(i, problem.interval(t), t, np.concatenate([q, v]))
            stretch = breaks.following(before, last, t, q, v, moved=moved)
        if last is not None and stretch is None:
            record.stop_at(last)
            return
        if moved if rows is None else bool((rows[rows > begun] == t).any()):
            q, v = (q, v) if stretch is None else (stretch.q, stretch.v)
            record.keep(np.array([t]), q[None], v[None])
        if stretch is not None and record.crawls():
            return


def _solved(
    problem: IntegrationProblem,
    record: TrajectoryRecord,
    stretch: Stretch,
    t: float,
    until: float,
    solver: Callable[[Dynamics], Solver],
) -> SolverResult:
    """Return the run of one stretch."""
    i, rows, span, (q, v) = record.index, problem.save, until - t, stretch.start()
    torque, report = problem.torque.of_part(problem.member(i), problem.interval(t)), problem.report(i)
    own = replace(
        problem,
        dyn=stretch.dyn,
        q0=q,
        v0=v,
        start=t,
        duration=span,
        torque=stretch.torque(torque),
        save=None if rows is None else np.append(rows[(rows > t) & (rows < until)], t + span),
        events=(*stretch.events(problem.events), *stretch.ends),
        passed=record.passed,
        bar=Progress(lambda done: report(t + done * span), ""),
    )
    return solver(stretch.dyn)(own)


def _of_run(hit: Hit, stretch: Stretch, member: int | None) -> Hit:
    """Return an event of a stretch as one of the run."""
    (q,), (v,) = stretch.states(np.array([hit.t]), hit.q[None], hit.v[None])
    return replace(hit, q=q, v=v, member=member)
