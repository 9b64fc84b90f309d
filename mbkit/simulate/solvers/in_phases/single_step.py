"""One step of an explicit method with forces that jump, of one state or a batch."""

from __future__ import annotations

from typing import Any

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.methods.registry import Method
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.progress import Progress
from mbkit.simulate.solvers.fixed_step import run_fixed
from mbkit.simulate.solvers.in_phases.fixed import run_fixed_in_phases
from mbkit.simulate.solvers.in_phases.phases import Phases
from mbkit.simulate.time_grid import Grid
from mbkit.simulate.torque import Torque


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
