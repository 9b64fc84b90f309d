"""Runs in phases by an adaptive method: phase after phase, each ended where something stops or lets go.

The end of a phase is an event. Methods with a fixed step are in `fixed`.

One step of an explicit method with forces that jump, of one state or a batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np

from mbkit._check import EPS, Array
from mbkit.engines import Dynamics
from mbkit.errors import FunctionError, NumericalError
from mbkit.methods.registry import Method
from mbkit.simulate.events import Followed, Hit
from mbkit.simulate.problem import RUNS, IntegrationProblem
from mbkit.simulate.progress import Progress
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.solvers.fixed_step import run_fixed
from mbkit.simulate.solvers.in_phases.fixed import MAX_EMPTY_PHASES, UNDECIDED, Solver, run_fixed_in_phases
from mbkit.simulate.solvers.in_phases.phases import Phase, Phases
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord, assemble_result, diverged
from mbkit.simulate.time_grid import Grid
from mbkit.simulate.torque import Torque

_END: Final = "end of a phase"


def run_in_phases(problem: IntegrationProblem, solver: Callable[[Dynamics], Solver]) -> SolverResult:
    """Integrate a problem with forces that jump; `solver` gives that of smooth dynamics."""
    dyn = problem.dyn
    RUNS.admit(dyn.model)
    if problem.equal_steps is not None:
        return run_fixed_in_phases(problem, solver)
    records = []
    for i in range(len(problem.q)):
        run = _Member(problem, i, solver)
        records.append(run.record)
        try:
            _adaptive(run)
        except FunctionError as error:
            # A torque function failed while it was asked whether a phase ends.
            run.record.fail(error)
        except NumericalError as error:
            run.record.stop(diverged(str(error)))
        if run.record.error is not None:
            break
    return assemble_result(problem, records)


class _Member:
    """One trajectory of a problem."""

    def __init__(self, problem: IntegrationProblem, i: int, solver: Callable[[Dynamics], Solver]) -> None:
        self.problem, self.member, self._solver = problem, problem.member(i), solver
        dyn = problem.dyn if self.member is None else problem.dyn._of_sample(i)
        self.phases = Phases(dyn)
        self.q, self.v = problem.q[i].copy(), problem.v[i].copy()
        self.force = problem.torque.of_member(self.member)
        # Parts look for the events, and for singular poses.
        self.record = TrajectoryRecord(replace(problem, events=()), i)
        self._stuck = 0

    def begin(self, k: int, t: float, leaving: Array | None = None) -> Phase:
        """Return the phase from here, with a torque that samples asked for its value."""
        self.problem.sample(self.member or 0, k, t, np.concatenate([self.q, self.v]))
        return self.phases.phase(t, self.q, self.v, self.force(k), leaving)

    def solve(self, phase: Phase, k: int, **changes: object) -> SolverResult:
        """Solve the rest of the problem from here, with the force from row k on."""
        torque = self.problem.torque.of_part(self.member, k)
        own = replace(self.problem, dyn=phase.dyn, q0=self.q, v0=self.v, torque=torque, **changes)  # type: ignore[arg-type]
        result = self._solver(phase.dyn)(own)
        q, v = self.phases.held(phase.still, self.q, result.q, result.v)
        return replace(result, q=q, v=v)

    def next(self, phase: Phase, k: int, t: float, q: Array, v: Array, *, moved: bool) -> Phase | None:
        """Go to the end of a phase, and return the next one; None where it cannot be decided.

        `moved` tells that time has passed.
        """
        q, v = self.phases.held(phase.still, self.q, q, v)
        v, leaving = self.phases.after(phase, t, q, v, self.force(k))
        self._stuck = 0 if moved else self._stuck + 1
        if self._stuck > MAX_EMPTY_PHASES:
            self.record.ended = "step_too_small"
            self.record.message = f"{UNDECIDED} at t = {t:.9g} s: their phases end where they begin"
            return None
        self.q, self.v = q, v
        # A joint that let go and came to rest at once did not let go.
        out = self.begin(k, t, leaving if moved else None)
        for _, name in self.phases.changes(phase, out):
            self.record.events.append(Hit(name, t, self.q.copy(), self.v.copy(), self.member))
        return out


def _adaptive(run: _Member) -> None:
    problem, record = run.problem, run.record
    t, k, rows = problem.start, 0, problem.save
    stops = np.array(problem.stops)
    # Steps of what rests do not feel a force that changes with time.
    timed = callable(run.force(0)) or problem.dyn.model.time_parameter is not None
    noise = max(1e-9, problem.tolerances.rtol)
    if rows is None or (len(rows) and rows[0] == t):
        record.keep(np.array([t]), run.q[None], run.v[None])
    run.v = run.phases.stopped(run.phases.dyn, t, run.q, run.v, run.v == 0)
    phase: Phase | None = run.begin(0, t) if problem.duration else None
    while phase is not None and t < problem.end:
        own, begun = phase, t

        def end(s: float, q: Array, v: Array, own: Phase = own, begun: float = begun, k: int = k) -> float:
            if not np.isfinite([*q, *v]).all():
                # The solver tells that there is no state.
                return 1.0
            row = run.force(max(k, int(np.searchsorted(stops, s, side="left"))))
            out = float(run.phases.margins(own, s, q, v, row).min())
            return max(out, EPS) if s == begun else out

        save = None if rows is None else np.append(rows[(rows > t) & (rows < problem.end)], problem.end)
        events = (*problem.events, Followed(end, _END, parts=2 if timed and own.still.any() else 1, noise=noise))
        result = run.solve(own, k, start=t, duration=problem.end - t, save=save, events=events)
        phase_ended = bool(result.events) and result.events[-1].name == _END and result.ended == "event"
        record.add(result)
        record.last, record.doubts = result.last, [*record.doubts, *result.doubts]
        record.events += [replace(x, member=run.member) for x in result.events if x.name != _END]
        _keep(record, result, rows, t, at_end=not phase_ended)
        if not phase_ended:
            record.ended, record.message, record.error = result.ended, result.message, result.error
            break
        hit = result.events[-1]
        moved = hit.t - t > 1e-12 * max(abs(t), problem.duration)
        t, k = hit.t, int(np.searchsorted(stops, hit.t, side="right"))
        phase = run.next(own, min(k, len(stops) - 1), t, hit.q, hit.v, moved=moved)
        if rows is None and moved:
            record.keep(np.array([t]), run.q[None], run.v[None])


def _keep(record: TrajectoryRecord, result: SolverResult, rows: Array | None, begun: float, *, at_end: bool) -> None:
    which = result.t > begun
    if not at_end and len(result.t):
        which[-1] = rows is not None and bool(np.isin(result.t[-1], rows))
    elif rows is not None and result.ended == "finished":
        which &= np.isin(result.t, rows)
    record.keep(result.t[which], result.q[which], result.v[which])


def step(dyn: Dynamics, method: Method, q: Array, v: Array, tau: Array, dt: float) -> tuple[Array, Array]:
    """Return the state after a step, in which joints stop and let go where they do.

    States whose phase does not change take one step of their method; the others run it in parts.
    """
    together = q.ndim == 2 and dyn._derived
    if q.ndim == 2 and not together:
        each = [step(dyn._of_sample(i), method, *state, dt) for i, state in enumerate(zip(q, v, tau, strict=True))]
        return np.array([x for x, _ in each]).reshape(q.shape), np.array([x for _, x in each]).reshape(v.shape)
    clock = dyn.model.time_parameter
    start = 0.0 if clock is None else float(dyn.model.parameters[clock] or 0.0)
    phases = Phases(dyn, side_by_side=together)
    phase = phases.phase(start, q, v, tau)
    q1, v1 = phases.held(phase.still, q, *phase.dyn.step(q, v, tau, dt, method.name, t=start))
    over = (phases.margins(phase, start + dt, q1, v1, tau) < 0).any(axis=-1)
    if over.any():
        which: Any = np.flatnonzero(over) if together else ...
        own = dyn._of_samples(which) if together else dyn
        grid, kept, silent = Grid(start, start + dt, dt, 1, dt), np.arange(2), Progress(None, "")
        # Without wrenches: they stand behind the force already, and the dynamics know where they act.
        torque = Torque.of_force(tau[which], dyn.model)
        problem = IntegrationProblem.on_grid(own, method.name, q[which], v[which], grid, kept, torque, silent)
        out = run_fixed_in_phases(problem, lambda _: run_fixed)
        for now, states in ((q1, out.q), (v1, out.v)):
            now[which] = states[..., -1, :] if len(out.t) == len(kept) else np.nan
    return q1, v1
