"""Fixed steps of a batch on a GPU: many in one launch, states stay there until they are kept."""

from __future__ import annotations

import time
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.codegen.cuda.driver import in_parts
from mbkit.codegen.cuda.runs import Arena
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.solvers.fixed_step import to_body_velocity
from mbkit.simulate.solvers.trajectory_record import GridRecord
from mbkit.simulate.time_grid import Indices

#: Number of steps of the first launch.
_FIRST_LAUNCH_STEPS: Final = 8
#: Launches take twice as many steps until one lasts so long, s, so that Ctrl-C is heard.
_LAUNCH_SECONDS: Final = 0.1
#: Bytes of held torques that go to the GPU at once.
_MAX_TORQUE_BYTES: Final = 2**28


def step_on_device(
    problem: IntegrationProblem, record: GridRecord, w0: Array, members: Indices, *, thorough: bool
) -> Array:
    """Take members of the batch to the end; return the sum of the squares of all states of each.

    As many go side by side as the GPU has room for. `w0` are the integrators' own velocities of the whole batch.
    """
    dyn = problem.dyn
    assert isinstance(dyn, LagrangianDynamics)
    law = problem.torque.feedback
    steps = dyn._device_steps(problem.method, thorough=thorough, fed=law.pattern if law else "")
    squares = np.zeros(len(members))

    def run(part: slice) -> None:
        with steps.arena(part.stop - part.start) as arena:
            _run(problem, record, arena, w0, members[part], part.start / len(members), part.stop / len(members))
            squares[part] = arena.get("squares")[0]

    in_parts(len(members), run)
    return squares


def _run(
    problem: IntegrationProblem, record: GridRecord, arena: Arena, w0: Array, members: Indices, done: float, end: float
) -> None:
    dyn, grid, torque = problem.dyn, problem.grid, problem.torque
    assert isinstance(dyn, LagrangianDynamics)
    space = Space(dyn.model)
    # A list of indices would copy the rows of an array of torques.
    which = slice(int(members[0]), int(members[-1]) + 1)
    rows: slice | Indices = which if which.stop - which.start == len(members) else members
    values = dyn._parameter_values
    arena.put("q", problem.q[members].T)
    arena.put("w", w0[members].T)
    arena.put("squares", np.zeros((1, 1)))
    if torque.feedback is not None:
        arena.share(torque.feedback.numbers)
    arena.put("parameters", values[members].T if values.ndim == 2 else values[:, None])
    # The last step may have a length of its own.
    stops = {*record.kept.tolist(), grid.steps - 1 if grid.last != grid.dt else grid.steps, grid.steps} - {0}
    k, most, dt = 0, _FIRST_LAUNCH_STEPS, np.nan
    for stop in sorted(stops):
        while k < stop:
            if grid.step(k) != dt:
                dt = grid.step(k)
                arena.put("dt", np.full((1, 1), dt))
            count = min(most, stop - k)
            force = torque.columns(rows, k, k + (count if torque.held else 1))
            if torque.held:
                count = max(1, min(count, _MAX_TORQUE_BYTES // max(force[0].nbytes, 1)))
            began = time.perf_counter()
            arena.take_steps(count, force[:count])
            if time.perf_counter() - began < _LAUNCH_SECONDS:
                most *= 2
            k += count
            problem.bar.update(done + (end - done) * k / grid.steps)
        if (kept := record.rows(stop, stop)).start < kept.stop:
            q, w = (np.ascontiguousarray(arena.get(name).T) for name in ("q", "w"))
            record.q[rows, kept.start] = q
            record.v[rows, kept.start] = to_body_velocity(space, q, w)
    record.good[members] = grid.steps
