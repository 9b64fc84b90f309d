"""Runs in phases by an adaptive method, phase after phase; those with a fixed step are in `fixed`.

One step of an explicit method with forces that jump, of one state or a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

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
from mbkit.simulate.solvers.in_phases.phases import Phase, Phases, in_order
from mbkit.simulate.solvers.stretches import Stretch, run_in_stretches
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord, assemble_result
from mbkit.simulate.time_grid import Grid
from mbkit.simulate.torque import Torque

_END: Final = "end of a phase"


def run_in_phases(problem: IntegrationProblem, solver: Callable[[Dynamics], Solver]) -> SolverResult:
    """Integrate a problem with forces that jump; `solver` gives that of smooth dynamics."""
    if problem.equal_steps is not None:
        return run_fixed_in_phases(problem, solver)
    records: list[TrajectoryRecord] = []
    for i in range(len(problem.q)):
        if not (records and records[-1].error):
            first = _Friction(problem, i).first
            endless = f"{UNDECIDED} at t = {{t:.9g}} s: their phases end where they begin"
            records.append(run_in_stretches(problem, i, first, solver, endless))
            records[-1].events = in_order(records[-1].events, records[-1].reached)
    return assemble_result(problem, records)


class _Friction:
    """Phases of the i-th trajectory of a problem, each up to where something stops or lets go."""

    def __init__(self, problem: IntegrationProblem, i: int) -> None:
        self._problem, self._member = problem, problem.member(i)
        dyn = problem.dyn if self._member is None else problem.dyn._of_sample(i)
        self._phases, self._force = Phases(dyn), problem.torque.of_member(self._member)
        # Steps of what rests do not feel a force that changes with time.
        self._timed = callable(self._force(0)) or dyn.model.time_parameter is not None

    def first(self, t: float, q: Array, v: Array) -> Stretch:
        """Return the phase with which the run begins."""
        phases, force = self._phases, self._force(0)
        v, _, impacts = phases.hit(phases.dyn, t, q, phases.stopped(phases.dyn, t, q, v, v == 0), force)
        begins = [x.event(t, q, self._member) for x in impacts]
        return self._stretch(phases.phase(t, q, v, force), t, q, v, begins)

    def _follow(self, phase: Phase, hit: Hit | None, t: float, q: Array, v: Array, moved: bool) -> Stretch | None:
        if hit is None or hit.name != _END:
            return None
        phases, force = self._phases, self._force(self._problem.interval(t))
        q, v, leaving, impacts = phases.after(phase, t, q, v, force)
        # A joint that let go and came to rest at once did not let go.
        new = phases.phase(t, q, v, force, leaving if moved else None)
        changes = [x.event(t, q, self._member) for x in impacts]
        changes += [Hit(name, t, q, v, self._member) for _, name in phases.changes(phase, new, q, impacts)]
        return self._stretch(new, t, q, v, changes)

    def _stretch(self, phase: Phase, begun: float, q: Array, v: Array, begins: Sequence[Hit] = ()) -> Stretch:
        phases, force, k = self._phases, self._force, self._problem.interval(begun)
        stops = np.array(self._problem.stops)

        def margin(t: float, q: Array, v: Array) -> float:
            if not np.isfinite([*q, *v]).all():
                # The solver tells that there is no state.
                return 1.0
            row = force(max(k, int(np.searchsorted(stops, t, side="left"))))
            out = float(phases.margins(phase, t, q, v, row).min(initial=1.0))
            return max(out, EPS) if t == begun else out

        parts = 2 if self._timed and phase.still.any() else 1
        end = Followed(margin, _END, parts=parts, noise=max(1e-9, self._problem.tolerances.rtol))
        held = partial(phases.held, phase.still, q)
        more: dict[str, Any] = {"states": lambda _, q, v: held(q, v), "follow": partial(self._follow, phase)}
        return Stretch(dyn=phase.dyn, q=q, v=v, begins=begins, ends=[end], end=_END, **more)


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
