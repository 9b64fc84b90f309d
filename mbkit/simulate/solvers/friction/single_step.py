"""One step of an explicit method with dry friction, of one state or a batch."""

from __future__ import annotations

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.methods.registry import Method
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.progress import Progress
from mbkit.simulate.solvers.fixed_step import run_fixed
from mbkit.simulate.solvers.friction.phases import Friction
from mbkit.simulate.solvers.friction.runs import run_in_phases
from mbkit.simulate.time_grid import Grid
from mbkit.simulate.torque import Torque


def step(dyn: Dynamics, method: Method, q: Array, v: Array, tau: Array, dt: float) -> tuple[Array, Array]:
    """Return the state after a step, in which joints stop and let go where they do.

    States whose phase does not change, side by side; the others one by one, as a run of one step.
    """
    if q.ndim == 1:
        return _one(dyn, method, q, v, tau, dt)
    if not dyn.derived or dyn._acting[0] or dyn.model.time_parameter is not None:
        each = [_one(dyn._of_sample(i), method, *state, dt) for i, state in enumerate(zip(q, v, tau, strict=True))]
        return np.array([x for x, _ in each]).reshape(q.shape), np.array([x for _, x in each]).reshape(v.shape)
    friction = Friction(dyn)
    phase = friction.phase(0.0, q, v, tau)
    q1, v1 = friction.held(phase, q, *phase.dyn.step(q, v, tau, dt, method.name))
    for i in np.flatnonzero((friction.margins(phase, dt, q1, v1, tau) < 0).any(axis=1)):
        q1[i], v1[i] = _one(dyn._of_sample(int(i)), method, q[i], v[i], tau[i], dt)
    return q1, v1


def _one(dyn: Dynamics, method: Method, q: Array, v: Array, tau: Array, dt: float) -> tuple[Array, Array]:
    clock = dyn.model.time_parameter
    start = 0.0 if clock is None else float(dyn.model.parameters[clock] or 0.0)
    friction = Friction(dyn)
    phase = friction.phase(start, q, v, tau)
    q1, v1 = friction.held(phase, q, *phase.dyn.step(q, v, tau, dt, method.name, t=start))
    if not (friction.margins(phase, start + dt, q1, v1, tau) < 0).any():
        return q1, v1
    grid = Grid(start, start + dt, dt, 1, dt)
    # Without wrenches: they stand behind the force already, and the dynamics know where they act.
    torque = Torque.of_force(tau, dyn.model)
    problem = IntegrationProblem.on_grid(dyn, method.name, q, v, grid, np.arange(2), torque, Progress(None, ""))
    out = run_in_phases(problem, lambda _: run_fixed)
    if len(out.t) < 2:
        return np.full_like(q, np.nan), np.full_like(v, np.nan)
    return out.q[-1], out.v[-1]
