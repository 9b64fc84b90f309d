"""Explicit fixed steps with torques held over each of them, compiled, on all cores.

A chunk of states runs to its end without looking back. The sum of squares that each carries along shows whether it
diverged; only then is its run repeated, with a look at every step.

Fixed steps of a batch on a GPU: many in one launch, states stay there until they are kept.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import BOUND, Array
from mbkit._child_process import cores
from mbkit._process import LOOK_SECONDS
from mbkit.codegen.compiled import Call, KernelSequence
from mbkit.codegen.compiled_calls import Plan
from mbkit.codegen.cuda.driver import in_parts
from mbkit.codegen.cuda.runs import Arena
from mbkit.derivation.steps.fixed import LAW, Part
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import NumericalError, TorqueError
from mbkit.methods.registry import method_of
from mbkit.methods.tableaus import ImplicitTableau
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.solvers.fixed_step import divergence_reason, run_fixed, to_body_velocity
from mbkit.simulate.solvers.machine_code_blocks import (
    CACHE,
    LANES,
    SHORTEST,
    BlockLoop,
    padded,
    run_blocks,
    run_collocation,
    run_members,
)
from mbkit.simulate.solvers.trajectory_record import GridRecord
from mbkit.simulate.solvers.vector_field import are_bounded
from mbkit.simulate.time_grid import Indices
from mbkit.simulate.torque import within

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
    # Launches take twice as many steps until one lasts so long that Ctrl-C would have to wait.
    k, most, dt = 0, 8, np.nan
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
            if time.perf_counter() - began < LOOK_SECONDS:
                most *= 2
            k += count
            problem.bar.update(done + (end - done) * k / grid.steps)
        if (kept := record.rows(stop, stop)).start < kept.stop:
            q, w = (np.ascontiguousarray(arena.get(name).T) for name in ("q", "w"))
            record.q[rows, kept.start] = q
            record.v[rows, kept.start] = to_body_velocity(space, q, w)
    record.good[members] = grid.steps


#: Number of steps between two reports of how far a run is.
_STEPS_PER_REPORT: Final = 64
#: Most steps of a block: as many as have room in the cache, so that Python has little to do for each.
_MAX_BLOCK_STEPS: Final = 2048
#: Most states of a chunk.
_MAX_CHUNK_STATES: Final = 1032
# Name that a step writes -> name that the next one reads.
_STATE: Final = {"q1": "q", "w1": "w", "squares1": "squares", "margin1": "margin"}
#: The same where a part behind the step changes its end.
_CHANGED: Final = {"q2": "q", "w2": "w", "squares1": "squares", "margin1": "margin"}


def _widest(plan: Plan) -> int:
    """Return how many states the cache holds with all that belongs to them, from 72 to 1032."""
    # Margins of each velocity are for the search of an end, and nobody reads them here.
    sizes = sum(rows for name, rows in plan.sizes.items() if name != "margins1")
    return min(max(padded(CACHE // (8 * sizes)), 9 * LANES), _MAX_CHUNK_STATES)


class Chunk(BlockLoop):
    """At most `most` states that take explicit steps.

    `torques`: each step of a block has its own; `all_kept`: each state of a block can be read, not only the last, which
    is so of few states anyway; `watched`: it is looked for steps that are not good; `steps`: those of the run.
    """

    def __init__(
        self,
        plan: Plan,
        space: Space,
        most: int,
        steps: int,
        *,
        torques: bool,
        all_kept: bool,
        watched: bool = False,
        clock: int | None = None,
    ) -> None:
        #: Name that a step writes -> name that the next one reads, or the host.
        every = _CHANGED if "q2" in plan.sizes else _STATE
        state = {name: before for name, before in every.items() if name in plan.sizes}
        sizes = {state.get(name, name): rows for name, rows in plan.sizes.items()}
        own = [*state.values(), *(["tau"] if torques else []), *([] if clock is None else ["parameters"])]
        fits = CACHE // (8 * padded(most) * sum(sizes[name] for name in own))
        self.block = max(min(fits, _MAX_BLOCK_STEPS, steps), SHORTEST)
        self.each_step = torques
        self.all_kept = all_kept or fits >= SHORTEST
        places = dict.fromkeys(own, self.block)
        places |= dict.fromkeys(state.values(), self.block + 1 if self.all_kept else 2)
        super().__init__({name: (places.get(name, 1), rows) for name, rows in sizes.items()}, most, clock)
        self._calls, self._space, self._watched = len(plan.parts), space, watched
        # A round has both places of states that take turns.
        period = 1 if self.all_kept else 2
        calls = list[Call]()
        for j in range(period):
            after = {name: (before, j + 1) for name, before in state.items()}
            calls += [self._call(*pair, j, period, after) for pair in zip(plan.codes, plan.parts, strict=True)]
        self._sequence = KernelSequence(calls)

    def begin(self, q: Array, w: Array, parameters: Array, **more: Array) -> None:
        """Put in states, (n, nq) and (n, nv) of `Space`, the values of parameters, (p,) or (n, p), and what is more."""
        self._begin(parameters, q=q, w=w, squares=np.zeros((len(q), 1)), **more)

    def run_to(self, step: int) -> None:
        self._sequence.run(self._taken * self._calls, step * self._calls)
        self._taken = step

    @property
    def alive(self) -> NDArray[np.bool_]:
        return np.asarray(self.now("squares")[0] < BOUND**2)

    @property
    def good(self) -> Indices | None:
        if not self._watched:
            return None
        q, w = (self.states(name, np.arange(1, self._taken + 1)) for name in self.carried)
        return np.asarray(np.logical_and.accumulate(are_bounded(q, w), axis=1).sum(axis=1))

    def to_body_velocity(self, q: Array, w: Array) -> Array:
        return to_body_velocity(self._space, q, w)

    def again(self) -> None:
        for name in self._room.keys() & {*_STATE.values()}:
            room = self._room[name]
            room[0] = room[self._taken % len(room)]
        self._taken = 0


def run_rollout(
    problem: IntegrationProblem,
    workers: int | None = None,
    behind: Sequence[Part] = (),
    margins: Array | None = None,
    record: GridRecord | None = None,
    **read: Array,
) -> SolverResult:
    """Step one state or a batch over the grid; no number depends on `workers`, by default one for each core.

    `behind` are parts that follow each step, of which each trajectory has what they `read`, (N, rows), by name;
    `margins`, (N, steps), takes what they write of that name, NaN where they do not follow.
    """
    dyn, method, grid = problem.dyn, problem.method, problem.grid
    assert isinstance(dyn, LagrangianDynamics)
    if isinstance(formula := method_of(method).formula, ImplicitTableau):
        return run_collocation(problem, formula)
    free = not (dyn.model.constrained or problem.torque.in_each_step)
    if problem.batch is None and problem.torque.samples is not None and free:
        # Single steps do not look for singular poses.
        return _run_step_by_step(problem)
    record = record or GridRecord(problem)
    space = Space(dyn.model)
    w0, values = space.to_integrator_velocity(problem.q, problem.v), dyn._parameter_values
    clock = None if dyn.model.time_parameter is None else list(dyn.model.parameters).index(dyn.model.time_parameter)
    law = problem.torque.feedback
    fed = law.pattern if law else ""
    workers = workers or dyn.threads or cores()
    # Every block costs some calls: worth it for a state now and then, not for most.
    dense = 2 * len(record.kept) > grid.steps

    def new_chunk(plan: Plan, most: int, *, all_kept: bool, watched: bool = False) -> Chunk:
        torques = problem.torque.in_each_step
        return Chunk(plan, space, most, grid.steps, torques=torques, all_kept=all_kept, watched=watched, clock=clock)

    def begin(chunk: Chunk, members: Indices) -> Chunk:
        more = {name: x[members] for name, x in read.items()} | ({} if law is None else {LAW: law.numbers[None]})
        chunk.begin(problem.q[members], w0[members], values[members] if values.ndim == 2 else values, **more)
        return chunk

    def read_margins(chunk: Chunk, members: Indices, k: int, _last: object) -> None:
        if margins is not None:
            margins[members, k - chunk.taken : k] = chunk.states("margin", np.arange(1, chunk.taken + 1))[..., 0]

    def suspects_of(members: Indices, *, thorough: bool) -> Indices:
        """Take members of the batch to the end; return those that were not bounded, or lost to their constraints."""
        squares = np.zeros(len(members))
        if dyn.device is not None and problem.batch is not None and clock is None and problem.torque.samples is None:
            squares = step_on_device(problem, record, w0, members, thorough=thorough)
            return members[~(squares < BOUND**2)]
        plan = dyn._step_plan(method, thorough=thorough, fed=fed, behind=behind)

        def new_loop(width: int) -> Callable[[Indices], Chunk]:
            return partial(begin, new_chunk(plan, width, all_kept=dense))

        def after_part(chunk: Chunk, part: slice) -> None:
            squares[part] = chunk.now("squares")[0]

        velocity = lambda _t, q, w, _members: to_body_velocity(space, q, w)  # noqa: E731
        run_members(problem, record, members, _widest(plan), workers, new_loop, velocity, read_margins, after_part)
        # A NaN is not below anything.
        return members[~(squares < BOUND**2)]

    lost = dict[int, list[Array]]()
    suspects = suspects_of(np.arange(len(problem.q)), thorough=False)
    if record.error is not None:
        suspects = suspects[:0]
    if len(suspects) and dyn.model.constrained:
        if problem.torque.samples is None:
            suspects = suspects_of(suspects, thorough=True)
        if len(suspects):
            # Near a singular pose steps are of collocation, and the pose is named. The others of a batch are done.
            if margins is not None:
                margins[suspects] = np.nan
            return run_fixed(problem, record, suspects)
    if len(suspects):
        plan = dyn._step_plan(method, fed=fed)
        for first in range(0, len(suspects), _widest(plan)):
            members = suspects[first : first + _widest(plan)]
            chunk = begin(new_chunk(plan, len(members), all_kept=True, watched=True), members)
            for _, last in run_blocks(problem, record, chunk, members):
                lost |= last or {}

    def why(i: int) -> str:
        k, (q, w) = int(record.good[i]), lost[i]
        force = problem.torque.columns(np.array([i]), k, k + 1)[0, :, 0]
        if law is not None:
            force = law(grid.time(k), q, to_body_velocity(space, q, w))
        return divergence_reason(
            dyn._of_samples([i]), method, grid.time(k), grid.step(k), q[None], w[None], force[None]
        )

    record.evaluations = method_of(method).stages * (int(record.good.sum()) + len(lost))
    return record.result(why)


def _run_step_by_step(problem: IntegrationProblem) -> SolverResult:
    """Step one state under a torque that samples: blocks that stop at each sample take longer than their steps.

    The loop is flat, and its checks are those of the machine code where they can be: Python's share is a microsecond.
    """
    dyn, grid, record, torque, method = problem.dyn, problem.grid, GridRecord(problem), problem.torque, problem.method
    samples, forces = torque.samples, torque.table
    assert isinstance(dyn, LagrangianDynamics)
    assert samples is not None
    controller, begins = samples.controller, [*torque.changes(grid.steps), grid.steps]
    ask, nv, timed = controller.function, dyn.model.nv, dyn.model.time_parameter is not None
    # A step whose force is the answer alone.
    step: Any = dyn._single_step(method) if forces.shape[1] == nv and not dyn.model.parameters else None
    # Its answers are kept as they are, and go into the step as they are.
    plain = step is not None and torque.limits is None
    q, v, start, dt, steps, force = problem.q0, problem.v0, grid.start, grid.dt, grid.steps, forces[0]
    row = int(record.kept[0] == 0)
    kept = iter(record.kept[row:].tolist())
    all_q, all_v, following = record.q[0], record.v[0], next(kept, -1)
    k = s = sample = 0
    new = False
    try:
        for first, end in pairwise(sorted({*range(0, steps, _STEPS_PER_REPORT), max(steps - 1, 0), steps})):
            h = grid.step(first)
            problem.bar.update(first / steps)
            for k in range(first, end):
                if k == sample:
                    # Copies: the function may write into them.
                    force = ask(start + k * dt, q.copy(), v.copy())
                    if not plain:
                        forces[s, :nv] = controller.checked(force, start + k * dt)
                        force = within(torque.limits, forces[s])
                    s, new = s + 1, plain
                    sample = begins[s]
                state = None if step is None else step(q, v, force, h, 0.0)
                if state is None:
                    if step is not None:
                        force = controller.checked(force, start + k * dt)
                    state = dyn.step(q, v, force, h, method, t=grid.time(k) if timed else None)
                if new:
                    forces[s - 1], new = force, False
                q, v = state
                if k + 1 == following:
                    all_q[row], all_v[row] = state
                    row, following = row + 1, next(kept, -1)
        k = steps
        problem.bar.update(1.0)
    except TorqueError as failed:
        record.error = failed
    except Exception as failed:
        # The answer of the last sample is known.
        if isinstance(failed, NumericalError) and k != sample:
            if new:
                forces[s - 1] = force
            # The reason is found in Python, with the same answers.
            samples.asked[0] = s
            return run_fixed(problem)
        record.error = controller.failure(failed, start + k * dt)
    samples.asked[0] = s
    record.good[0], record.evaluations = k, method_of(method).stages * k
    return record.result()
