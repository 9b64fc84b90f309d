"""Runs by an adaptive method that events break into stretches, each with dynamics of its own.

Phases of dry friction are such stretches, and so are charts of a system under constraints. All else of a run goes on
across their ends: saved times, the user's events, samples of a controller, and one record.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from mbkit._check import ROUNDING, Array
from mbkit.engines import Dynamics
from mbkit.errors import FunctionError, NumericalError
from mbkit.simulate.events import Event, Hit
from mbkit.simulate.problem import IntegrationProblem, Solver
from mbkit.simulate.progress import Progress
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord, diverged
from mbkit.simulate.torque import Torque

#: Most stretches in a row that end where they begin.
MAX_EMPTY: Final = 20


@dataclass(frozen=True, eq=False, kw_only=True)
class Stretch:
    """Smooth dynamics from a state on, on coordinates of their own or those of the run.

    Attributes
    ----------
    q, v : array
        The state, on the coordinates of the run.
    follow : callable
        (hit, t, q, v, moved) -> what follows at its end, by one of the events `ends`, another event, or by `until`,
        where hit is None; None where an event ends the run. `moved` tells that time has passed.
    until : float
        s.
    begins : sequence of Hit
        Events of the run with which it begins.
    end : str
        Name of the event that ends it, which the record of the run leaves out.
    start, states, torque, events : callable
        The state on its own coordinates; states of these at times, (n, ·), on those of the run; and the run's force
        and its events on its own coordinates.
    """

    dyn: Dynamics
    q: Array
    v: Array
    follow: Callable[[Hit | None, float, Array, Array, bool], Stretch | None]
    until: float = math.inf
    begins: Sequence[Hit] = ()
    ends: Sequence[Event] = ()
    end: str = ""
    start: Callable[[Array, Array], tuple[Array, Array]] = lambda q, v: (q, v)
    states: Callable[[Array, Array, Array], tuple[Array, Array]] = lambda _, q, v: (q, v)
    torque: Callable[[Torque], Torque] = lambda torque: torque
    events: Callable[[Sequence[Event]], Sequence[Event]] = lambda events: events


def run_in_stretches(
    problem: IntegrationProblem,
    i: int,
    first: Callable[[float, Array, Array], Stretch],
    solver: Callable[[Dynamics], Solver],
    endless: str,
) -> TrajectoryRecord:
    """Integrate the i-th state; `solver` gives that of smooth dynamics.

    `endless` is the message of a run whose stretches end where they begin, with the time as {t}.
    """
    # Stretches look for the events.
    record = TrajectoryRecord(replace(problem, events=()), i)
    try:
        if not _to_end(problem, record, first, solver):
            record.ended, record.message = "step_too_small", endless.format(t=record.reached)
    except FunctionError as error:
        # A torque function failed while it was asked what follows.
        record.fail(error)
    except NumericalError as error:
        record.stop(diverged(str(error)))
    return record


def _to_end(
    problem: IntegrationProblem,
    record: TrajectoryRecord,
    first: Callable[[float, Array, Array], Stretch],
    solver: Callable[[Dynamics], Solver],
) -> bool:
    """Go over the run; return whether its stretches have an end."""
    i, rows, t, empty = record.index, problem.save, problem.start, 0
    q, v = problem.q[i], problem.v[i]
    record.begin(q, v)
    problem.sample(i, 0, t, np.concatenate([q, v]))
    stretch = first(t, q, v) if problem.duration else None
    while stretch is not None:
        record.events += stretch.begins
        if t >= problem.end or record.crawls():
            break
        begun, t = t, min(stretch.until, problem.end)
        result = _solved(problem, record, stretch, begun, t, solver)
        record.count(result)
        record.last, record.doubts = result.last, [*record.doubts, *result.doubts]
        if record.passed and 0 in result.poses:
            record.passed.join(result.poses[0])
        hits = [_of_run(hit, stretch, problem.member(i)) for hit in result.events]
        record.events += [hit for hit in hits if hit.name != stretch.end]
        last = hits[-1] if result.ended == "event" else None
        q, v = stretch.states(result.t, result.q, result.v)
        # The state at an end is kept as that with which another stretch begins.
        inner = result.t > begun
        inner[-1:] &= not result.finished
        record.keep(result.t[inner], q[inner], v[inner])
        if not result.finished:
            assert isinstance(result.reached, float)
            record.reached, record.error = result.reached, result.error
            record.ended, record.message = result.ended, result.message
            break
        t, q, v = (t, q[-1], v[-1]) if last is None else (last.t, last.q, last.v)
        record.reached = t
        problem.report(i)(t)
        moved = t - begun > ROUNDING * max(abs(begun), problem.duration)
        empty, follow, stretch = 0 if moved else empty + 1, stretch.follow, None
        if empty > MAX_EMPTY:
            return False
        if last is not None or t < problem.end:
            problem.sample(i, problem.interval(t), t, np.concatenate([q, v]))
            stretch = follow(last, t, q, v, moved)
        if last is not None and stretch is None:
            record.stop_at(last)
        elif moved if rows is None else bool((rows[rows > begun] == t).any()):
            q, v = (q, v) if stretch is None else (stretch.q, stretch.v)
            record.keep(np.array([t]), q[None], v[None])
    return True


def _solved(
    problem: IntegrationProblem,
    record: TrajectoryRecord,
    stretch: Stretch,
    t: float,
    until: float,
    solver: Callable[[Dynamics], Solver],
) -> SolverResult:
    """Return the run of one stretch."""
    i, rows, span, (q, v) = record.index, problem.save, until - t, stretch.start(stretch.q, stretch.v)
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
        bar=Progress(lambda done: report(t + done * span), ""),
    )
    return solver(stretch.dyn)(own)


def _of_run(hit: Hit, stretch: Stretch, member: int | None) -> Hit:
    """Return an event of a stretch as one of the run."""
    (q,), (v,) = stretch.states(np.array([hit.t]), hit.q[None], hit.v[None])
    return replace(hit, q=q, v=v, member=member)
