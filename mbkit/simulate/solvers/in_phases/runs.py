"""Runs in phases by an adaptive method, phase after phase; those with a fixed step are in `fixed`.

One step of an explicit method with forces that jump, of one state or a batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mbkit._check import EPS, Array
from mbkit.engines import Dynamics
from mbkit.methods.registry import Method
from mbkit.simulate.events import Followed, Hit
from mbkit.simulate.problem import IntegrationProblem, Solver
from mbkit.simulate.progress import Progress
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.solvers.fixed_step import run_fixed
from mbkit.simulate.solvers.in_phases.fixed import UNDECIDED, run_fixed_in_phases
from mbkit.simulate.solvers.in_phases.phases import Phase, Phases
from mbkit.simulate.solvers.stretches import Stretch, run_in_stretches
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord, assemble_result
from mbkit.simulate.time_grid import Grid
from mbkit.simulate.torque import Torque


def run_in_phases(problem: IntegrationProblem, solver: Callable[[Dynamics], Solver]) -> SolverResult:
    """Integrate a problem with forces that jump; `solver` gives that of smooth dynamics."""
    if problem.equal_steps is not None:
        return run_fixed_in_phases(problem, solver)
    records: list[TrajectoryRecord] = []
    for i in range(len(problem.q)):
        if not (records and records[-1].error):
            records.append(run_in_stretches(problem, i, _Friction(problem, i), solver))
    return assemble_result(problem, records)


@dataclass(eq=False, kw_only=True)
class _PhaseStretch(Stretch):
    """One phase; what rests keeps its place and no velocity, to the bit."""

    end = "end of a phase"
    phase: Phase
    phases: Phases

    def states(self, t: Array, q: Array, v: Array) -> tuple[Array, Array]:  # noqa: ARG002
        return self.phases.held(self.phase.still, self.q, q, v)


class _Friction:
    """Phases of the i-th trajectory of a problem, each up to where something stops or lets go."""

    endless = f"{UNDECIDED} at t = {{t:.9g}} s: their phases end where they begin"

    def __init__(self, problem: IntegrationProblem, i: int) -> None:
        self._problem, self._member = problem, problem.member(i)
        dyn = problem.dyn if self._member is None else problem.dyn._of_sample(i)
        self._phases, self._force = Phases(dyn), problem.torque.of_member(self._member)
        # Steps of what rests do not feel a force that changes with time.
        self._timed = callable(self._force(0)) or dyn.model.time_parameter is not None

    def first(self, t: float, q: Array, v: Array) -> Stretch:
        return self._stretch(t, q, self._phases.stopped(self._phases.dyn, t, q, v, v == 0))

    def following(self, last: Stretch, hit: Hit | None, t: float, q: Array, v: Array, *, moved: bool) -> Stretch | None:
        assert isinstance(last, _PhaseStretch)
        if hit is None or hit.name != last.end:
            return None
        v, leaving = self._phases.after(last.phase, t, q, v, self._force(self._problem.interval(t)))
        # A joint that let go and came to rest at once did not let go.
        out = self._stretch(t, q, v, leaving if moved else None)
        changes = self._phases.changes(last.phase, out.phase)
        return replace(out, begins=[Hit(name, t, q, v, self._member) for _, name in changes])

    def _stretch(self, t: float, q: Array, v: Array, leaving: Array | None = None) -> _PhaseStretch:
        phases, force, problem, k = self._phases, self._force, self._problem, self._problem.interval(t)
        phase = phases.phase(t, q, v, force(k), leaving)
        stops = np.array(problem.stops)

        def margin(s: float, q: Array, v: Array) -> float:
            if not np.isfinite([*q, *v]).all():
                # The solver tells that there is no state.
                return 1.0
            row = force(max(k, int(np.searchsorted(stops, s, side="left"))))
            out = float(phases.margins(phase, s, q, v, row).min())
            return max(out, EPS) if s == t else out

        parts = 2 if self._timed and phase.still.any() else 1
        end = Followed(margin, _PhaseStretch.end, parts=parts, noise=max(1e-9, problem.tolerances.rtol))
        return _PhaseStretch(dyn=phase.dyn, q=q, v=v, ends=[end], phase=phase, phases=phases)


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
