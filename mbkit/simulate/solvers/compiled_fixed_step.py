"""Fixed steps with torques held over each of them, compiled, on all cores.

A chunk of states runs to its end without looking back. The sum of squares that each carries along shows whether it
diverged; only then is its run repeated, with a look at every step.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from itertools import pairwise
from math import isqrt
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.codegen.compiled import Call, Compiled, KernelSequence, aligned, cores
from mbkit.codegen.interpreter import Machine
from mbkit.codegen.jit import host
from mbkit.derivation.steps.collocation import Collocation
from mbkit.derivation.steps.fixed import LAW, Part
from mbkit.derivation.steps.midpoint import MOST
from mbkit.engines.base import at_time
from mbkit.engines.compiled_calls import Plan
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import FunctionError, NumericalError, TorqueError
from mbkit.methods.registry import method_of
from mbkit.methods.tableaus import ImplicitTableau
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.progress import Progress
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.fixed_step import GridRecord, divergence_reason, run_fixed, to_body_velocity
from mbkit.simulate.solvers.vector_field import BOUND, are_bounded
from mbkit.simulate.time_grid import Grid, Indices

# Half of what a core has in its second cache.
_CACHE: Final = 2**19
#: Samples between two reports of how far a run is.
_REPORTED: Final = 64
#: Steps of a block, at least and at most: as many as have room in the cache, so that Python has little to do for each.
_SHORTEST: Final = 16
_LONGEST: Final = 2048
_LANES: Final = 8
#: Multiplications of an implicit step's system beyond which compiling it takes longer than tens of thousands of steps
#: in Python.
_WORTH_COMPILING: Final = 10_000
_MOST_STATES: Final = 1032
# What a step writes -> what the next one reads.
_STATE: Final = {"q1": "q", "w1": "w", "squares1": "squares", "margin1": "margin"}


class BlockLoop:
    """Room for the states of a block of steps side by side, one trajectory in each column.

    Columns beyond the `count` states repeat the last one. `sizes` has for each name the number of places, one, two that
    take turns or one for each step, and of rows. `block` is the number of steps of the next block, at most; `carried`
    names q and what goes with it; `clock` is the place of the time among the parameters, if it enters.

    A run may stop at any step of a block, read `now`, set other torques by `hold`, and go on.
    """

    block: int
    #: Each step of a block has a torque of its own.
    each_step: bool
    carried: tuple[str, str] = ("q", "w")
    #: The time that the parameters hold in a step, in steps behind its start.
    evaluated: float = 0.0

    def __init__(self, sizes: Mapping[str, tuple[int, int]], count: int, clock: int | None) -> None:
        width, lanes = padded(count), host().width
        self._room = {}
        for name, (places, rows) in sizes.items():
            self._room[name] = aligned(places * rows * width).reshape(places, rows, width)
            self._room[name][:] = 0.0
        self._count, self._taken, self._clock = count, 0, clock
        # Whole vectors of the processor.
        self._columns = -(-count // lanes) * lanes

    def _call(self, code: Compiled, part: Part, step: int, period: int, places: Mapping[str, tuple[str, int]]) -> Call:
        """Return a part's call in a step of the first `period`; `places` has names that stand in another room."""
        arrays, moves = list[Array](), list[int]()
        for name in (*part.reads, *part.writes):
            own, place = places.get(name, (name, step))
            room = self._room[own]
            arrays.append(room[place % len(room)].T[: self._columns])
            moves.append(period * room.strides[0] if len(room) > 2 else 0)
        reads = len(part.reads)
        return Call(code, arrays[:reads], arrays[reads:], moves)

    def _fill(self, name: str, first: int, columns: Array) -> None:
        """Put columns, (steps or 1, rows, n or 1), where they fit from this place on."""
        room = self._room[name]
        room = room[first if len(room) > 1 else 0 :][: len(columns)]
        columns = columns[: len(room)]
        if columns.shape[-1] == 1:
            room[:] = columns
        else:
            room[..., : self._count] = columns
            room[..., self._count :] = columns[..., -1:]

    def _begin(self, parameters: Array, **states: Array) -> None:
        """Put in states, (n, rows), and the values of parameters, (p,) or (n, p)."""
        self._count, self._taken = len(states["q"]), 0
        for name in self._room.keys() & states.keys():
            self._fill(name, 0, states[name].T[None])
        if parameters.size and "parameters" in self._room:
            every = np.atleast_2d(parameters).T
            self._fill("parameters", 0, np.broadcast_to(every, (len(self._room["parameters"]), *every.shape)))

    def hold(self, torques: Array) -> None:
        """Set the torques of the steps from the present one on, (steps or 1, nv, n or 1)."""
        self._fill("tau", self._taken, torques)

    def set_times(self, grid: Grid, first: int, steps: int) -> None:
        """Set length and times of the next steps, which are of equal length and the run's from `first` on."""
        self._room["dt"][:] = dt = grid.step(first)
        if self._clock is not None:
            times = grid.times_of(np.arange(first, first + steps)) + self.evaluated * dt
            self._room["parameters"][self._taken :][:steps, self._clock] = times[:, None]

    def run_to(self, step: int) -> None:
        """Take the steps from where the last ones ended to this one of the block."""
        raise NotImplementedError

    def again(self) -> None:
        """Make the last state the first one of the next block."""
        raise NotImplementedError

    @property
    def good(self) -> Indices | None:
        """Good steps of the block so far, (n,); None where nobody looks."""
        return None

    @property
    def alive(self) -> NDArray[np.bool_]:
        """Which of the present states are good, (n,)."""
        raise NotImplementedError

    def to_body_velocity(self, q: Array, w: Array) -> Array:  # noqa: ARG002
        """Return the saved w, (n, steps, nv)."""
        return w

    def now(self, name: str) -> Array:
        """Return q, w, ... of the present states, (rows, n), which stay as they are until the next step."""
        room = self._room[name]
        return np.asarray(room[self._taken % len(room), :, : self._count])

    def states(self, name: str, which: Sequence[int] | Indices) -> Array:
        """Return q, w, ... after these many steps of the block, (n, steps, rows)."""
        room = self._room[name]
        places: Any = np.asarray(which) % len(room)
        if places[-1] - places[0] == len(places) - 1:
            places = slice(places[0], places[-1] + 1)
        return np.asarray(room[places, :, : self._count].transpose(2, 0, 1))


def padded(count: int) -> int:
    """Return the number of columns for so many states: whole cache lines, and an odd number of them.

    So no two rows fall on the same lines of a cache that is split by powers of two: 20 % of the time at 1024 states.
    """
    return -(-count // _LANES) * _LANES | _LANES


class SampleBarrier:
    """Asks a torque that samples, once at each sample for all parts of a batch, which wait there for one another.

    velocity(t, q, w, members) is mbkit's velocity of states (n, nq) and (n, nv).
    """

    def __init__(
        self, problem: IntegrationProblem, parts: int, velocity: Callable[[float, Array, Array, Indices], Array]
    ) -> None:
        self._problem, self._velocity, self._k = problem, velocity, 0
        self._loops: list[tuple[BlockLoop, Indices]] = []
        self._barrier, self._left = threading.Barrier(parts, self._ask) if parts > 1 else None, False
        #: Of a torque function that failed.
        self.error: FunctionError | None = None

    def join(self, loop: BlockLoop, members: Indices) -> None:
        """Add a part."""
        self._loops.append((loop, members))

    def __call__(self, k: int) -> bool:
        """Ask at a step, when all parts are there; return whether to go on."""
        self._k = k
        if self._barrier is None:
            self._ask()
        elif self._left:
            # Who leaves would wait for a turn beside many parts that meet often.
            raise threading.BrokenBarrierError
        else:
            self._barrier.wait()
        return self.error is None

    def leave(self) -> None:
        """Let nobody wait for a part that goes no further."""
        self._left = True
        if self._barrier is not None:
            self._barrier.abort()

    def _ask(self) -> None:
        problem, k, t = self._problem, self._k, self._problem.grid.time(self._k)
        members: Indices = np.concatenate([who[loop.alive] for loop, who in self._loops])
        if not len(members):
            return
        order, states = np.argsort(members), list[Array]()
        for name in self._loops[0][0].carried:
            states.append(np.concatenate([loop.now(name).T[loop.alive] for loop, _ in self._loops])[order])
        q, w = states
        v = self._velocity(t, q, w, members[order])
        try:
            if problem.batch is None:
                problem.torque.sample(k, t, q[0], v[0])
            else:
                problem.torque.sample(k, t, q, v, members[order])
        except FunctionError as error:
            self.error = error


def run_blocks(
    problem: IntegrationProblem,
    record: GridRecord,
    loop: BlockLoop,
    members: Indices,
    ends: Iterable[int] = (),
    barrier: SampleBarrier | None = None,
) -> Iterator[tuple[int, dict[int, list[Array]]]]:
    """Take members of the batch, which are in the loop, through the run in blocks that stop at `ends` too.

    Yields the number of steps after each block, and the last good state of the trajectories that were lost in it.
    Within a block it stops at samples, where all parts of a batch meet.
    """
    grid, torque, kept = problem.grid, problem.torque, record.kept
    k, torques, alive = 0, np.empty(0), np.full(len(members), True)
    samples, going = [*reversed(torque.changes(grid.steps))], True
    # Most parts of a batch are contiguous, which is read and written faster.
    whole = slice(int(members[0]), int(members[-1]) + 1)
    which: slice | Indices = whole if whole.stop - whole.start == len(members) else members
    # The last step may have a length of its own.
    stops = {*ends, grid.steps - 1 if grid.last != grid.dt else grid.steps, grid.steps}
    for stop in sorted(stops):
        while k < stop:
            n, at = min(loop.block, stop - k), k
            loop.set_times(grid, k, n)
            while at < k + n:
                if samples and samples[-1] == at:
                    samples.pop()
                    going = barrier is None or barrier(at)
                    if not going:
                        break
                end = min(k + n, samples[-1]) if samples else k + n
                if torque.held or not torques.size:
                    torques = torque.columns(which, at, end if loop.each_step else at + 1)
                loop.hold(torques)
                loop.run_to(end - k)
                at = end
            n = at - k
            rows, good, last = record.rows(k + 1, k + n), loop.good, dict[int, list[Array]]()
            if rows.start < rows.stop:
                q, w = (loop.states(name, kept[rows] - k) for name in loop.carried)
                record.q[which, rows], record.v[which, rows] = q, loop.to_body_velocity(q, w)
            if good is None:
                record.steps[which] = k + n
            else:
                record.steps[members[alive]] = k + good[alive]
                for m in np.flatnonzero(alive & (good < n)).tolist():
                    last[int(members[m])] = [loop.states(name, [good[m]])[m, 0] for name in loop.carried]
                alive &= good == n
            yield k + n, last
            if not going or (last and barrier is None and not alive.any()):
                return
            loop.again()
            k += n


@contextmanager
def _joined(barrier: SampleBarrier | None, loop: BlockLoop, members: Indices) -> Iterator[None]:
    """Let a part take part in the samples; when it is closed before its end, the others end too."""
    if barrier is None:
        yield
        return
    barrier.join(loop, members)
    try:
        yield
    except threading.BrokenBarrierError:
        # Another part was stopped.
        return
    except BaseException:
        barrier.leave()
        raise


def run_parts(
    parts: Sequence[slice],
    new_worker: Callable[[], Callable[[slice], Iterator[int]]],
    workers: int,
    steps: int,
    bar: Progress,
    barrier: SampleBarrier | None = None,
) -> None:
    """Run parts of a batch in threads, at most `workers`; parts that meet wait for one another, in a thread each.

    new_worker(), called in each thread, returns run(part), which yields the number of `steps` done.
    """
    done, left, stop = [0] * len(parts), iter(list(enumerate(parts))), threading.Event()
    total = max(len(parts) * steps, 1)

    def work(report: Callable[[], None]) -> None:
        run = new_worker()
        # A list's iterator hands each part to one thread.
        for i, part in left:
            for end in run(part):
                done[i] = end
                report()
                if stop.is_set():
                    return

    workers = min(workers, len(parts)) if barrier is None else len(parts)
    if workers < 2:
        if parts:
            work(lambda: bar.update(sum(done) / total))
        return
    with ThreadPoolExecutor(workers) as pool:
        waiting: set[Future[None]] = {pool.submit(work, lambda: None) for _ in range(workers)}
        try:
            while waiting:
                finished, waiting = wait(waiting, timeout=0.1, return_when=FIRST_EXCEPTION)
                for future in finished:
                    future.result()
                bar.update(sum(done) / total)
        finally:
            stop.set()
            if barrier is not None:
                # A block may take as long as all its samples.
                barrier.leave()


def _widest(plan: Plan) -> int:
    """Return how many states the cache holds with all that belongs to them, from 72 to 1032."""
    return min(max(padded(_CACHE // (8 * sum(plan.sizes.values()))), 9 * _LANES), _MOST_STATES)


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
        #: What is written -> what the next step reads, or the host.
        state = {name: before for name, before in _STATE.items() if name in plan.sizes}
        sizes = {state.get(name, name): rows for name, rows in plan.sizes.items()}
        own = [*state.values(), *(["tau"] if torques else []), *([] if clock is None else ["parameters"])]
        fits = _CACHE // (8 * padded(most) * sum(sizes[name] for name in own))
        self.block = max(min(fits, _LONGEST, steps), _SHORTEST)
        self.each_step = torques
        self.all_kept = all_kept or fits >= _SHORTEST
        places = dict.fromkeys(own, self.block)
        places |= dict.fromkeys(state.values(), self.block + 1 if self.all_kept else 2)
        super().__init__({name: (places.get(name, 1), rows) for name, rows in sizes.items()}, most, clock)
        self._calls, self._space, self._watched = len(plan.parts), space, watched
        # Of states that take turns a round has both.
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
    **read: Array,
) -> SolverResult:
    """Step one state or a batch over the grid; no number depends on `workers`, by default one for each core.

    `behind` are parts that follow each step, of which each trajectory has what they `read`, (N, rows), by name;
    `margins`, (N, steps), takes what they write of that name.
    """
    dyn, method, grid = problem.dyn, problem.method, problem.grid
    assert isinstance(dyn, LagrangianDynamics)
    if isinstance(formula := method_of(method).formula, ImplicitTableau):
        return _run_collocation(problem, formula)
    free = not (dyn.model.constrained or problem.torque.in_each_step)
    if problem.batch is None and problem.torque.samples is not None and free:
        # Single steps do not look for singular poses.
        return _run_step_by_step(problem)
    record = GridRecord(problem)
    space = Space(dyn.model)
    w0, values = space.to_integrator_velocity(problem.q, problem.v), dyn.parameter_values
    clock = None if dyn.model.time_parameter is None else list(dyn.model.parameters).index(dyn.model.time_parameter)
    law = problem.torque.feedback
    workers = workers or dyn.threads or cores()
    # Every block costs some calls: worth it for a state now and then, not for most.
    dense = 2 * len(record.kept) > grid.steps

    def new_chunk(plan: Plan, most: int, *, all_kept: bool, watched: bool = False) -> Chunk:
        torques = problem.torque.in_each_step
        return Chunk(plan, space, most, grid.steps, torques=torques, all_kept=all_kept, watched=watched, clock=clock)

    def blocks(
        chunk: Chunk, members: Indices, ends: Indices, barrier: SampleBarrier | None = None
    ) -> Iterator[tuple[int, dict[int, list[Array]]]]:
        more = {name: x[members] for name, x in read.items()} | ({} if law is None else {LAW: law.numbers[None]})
        chunk.begin(problem.q[members], w0[members], values[members] if values.ndim == 2 else values, **more)
        return run_blocks(problem, record, chunk, members, ends.tolist(), barrier)

    def suspects_of(members: Indices, *, thorough: bool) -> Indices:
        """Take members of the batch to the end; return those that were not bounded, or lost to their constraints."""
        n, squares = len(members), np.zeros(len(members))
        if dyn.device is not None and problem.batch is not None and clock is None and problem.torque.samples is None:
            from mbkit.simulate.solvers.compiled_device_steps import step_on_device

            squares = step_on_device(problem, record, w0, members, thorough=thorough)
            return members[~(squares < BOUND**2)]
        plan = dyn.step_plan(method, thorough=thorough, fed=law is not None, behind=behind)
        # Parts that wait for one another have a thread each.
        parts = _split(n, _widest(plan) if problem.torque.samples is None else max(-(-n // workers), 1), workers)
        barrier = None
        if problem.torque.samples is not None:
            barrier = SampleBarrier(problem, len(parts), lambda t, q, w, i: to_body_velocity(space, q, w))  # noqa: ARG005

        def new_worker() -> Callable[[slice], Iterator[int]]:
            # The parts differ by one state at most.
            chunk = new_chunk(plan, -(-n // len(parts)), all_kept=dense)

            def run(part: slice) -> Iterator[int]:
                ends, before = record.kept[:0] if chunk.all_kept else record.kept, 0
                with _joined(barrier, chunk, members[part]):
                    for end, _ in blocks(chunk, members[part], ends, barrier):
                        if margins is not None:
                            own = chunk.states("margin", np.arange(1, end - before + 1))
                            margins[members[part], before:end] = own[..., 0]
                        before = end
                        yield end
                squares[part] = chunk.now("squares")[0]

            return run

        run_parts(parts, new_worker, workers, grid.steps, problem.bar, barrier)
        if barrier is not None and barrier.error is not None:
            failures.append(barrier.error)
        # A NaN is not below anything.
        return members[~(squares < BOUND**2)]

    lost, failures = dict[int, list[Array]](), list[FunctionError]()
    suspects = suspects_of(np.arange(len(problem.q)), thorough=False)
    if failures:
        return record.result(lambda _: "", method_of(method).stages * int(record.steps.sum()), error=failures[0])
    if len(suspects) and dyn.model.constrained:
        if problem.torque.samples is None:
            suspects = suspects_of(suspects, thorough=True)
        if len(suspects):
            # Near a singular pose stages are projected too, and the pose is named. The others of a batch are done.
            return run_fixed(problem, record, suspects)
    if len(suspects):
        plan = dyn.step_plan(method, fed=law is not None)
        for first in range(0, len(suspects), _widest(plan)):
            members = suspects[first : first + _widest(plan)]
            for _, last in blocks(new_chunk(plan, len(members), all_kept=True, watched=True), members, members[:0]):
                lost |= last

    def why(i: int) -> str:
        k, (q, w) = int(record.steps[i]), lost[i]
        force = np.asarray(problem.torque.columns(np.array([i]), k, k + 1)[0][:, 0])
        if law is not None:
            force = law(grid.time(k), q, to_body_velocity(space, q, w))
        return divergence_reason(dyn.of_samples([i]), method, grid.time(k), grid.step(k), q[None], w[None], force[None])

    return record.result(why, method_of(method).stages * (int(record.steps.sum()) + len(lost)))


def _run_step_by_step(problem: IntegrationProblem) -> SolverResult:
    """Step one state under a torque that samples: blocks that stop at each sample take longer than their steps.

    The loop is flat, and its checks are those of the machine code where they can be: Python's share is a microsecond.
    """
    dyn, grid, record, torque, method = problem.dyn, problem.grid, GridRecord(problem), problem.torque, problem.method
    samples, forces = torque.samples, torque.sampled_rows
    assert isinstance(dyn, LagrangianDynamics)
    assert samples is not None
    controller, begins = samples.controller, [*torque.changes(grid.steps), grid.steps]
    ask, nv, timed = controller.function, dyn.model.nv, dyn.model.time_parameter is not None
    # A step whose force is the answer alone.
    step: Any = dyn.single_step(method) if forces.shape[1] == nv and not dyn.model.parameters else None
    q, v, start, dt, steps, force = problem.q0, problem.v0, grid.start, grid.dt, grid.steps, forces[0]
    row = int(record.kept[0] == 0)
    kept = iter(record.kept[row:].tolist())
    all_q, all_v, following, error = record.q[0], record.v[0], next(kept, -1), None
    k = s = sample = 0
    new, shorter = False, steps - 1 if grid.last != dt else steps
    try:
        for k in range(steps):
            if k == sample:
                # Copies: the function may write into them.
                force = ask(start + k * dt, q.copy(), v.copy())
                if step is None:
                    forces[s, :nv] = controller.checked(force, start + k * dt)
                    force = forces[s]
                if not s % _REPORTED:
                    problem.bar.update(k / steps)
                s, new = s + 1, True
                sample = begins[s]
            state = None if step is None else step(q, v, force, dt, 0.0)
            if state is None or k == shorter:
                if step is not None:
                    force = controller.checked(force, start + k * dt)
                state = dyn.step(q, v, force, grid.step(k), method, t=grid.time(k) if timed else None)
            if new:
                forces[s - 1], new = force, False
            q, v = state
            if k + 1 == following:
                all_q[row], all_v[row] = q, v
                row, following = row + 1, next(kept, -1)
        k = steps
        problem.bar.update(1.0)
    except TorqueError as failed:
        error = failed
    except Exception as failed:
        # A sample at which the answer is known is behind.
        if isinstance(failed, NumericalError) and k != sample:
            if new:
                forces[s - 1] = force
            # The reason is found in Python, with the same answers.
            samples.asked[0] = s
            return run_fixed(problem)
        error = controller.failure(failed, start + k * dt)
    samples.asked[0] = s
    record.steps[0] = k
    return record.result(lambda _: "", method_of(method).stages * k, error=error)


def _run_collocation(problem: IntegrationProblem, tableau: ImplicitTableau) -> SolverResult:
    """Take implicit steps; trajectories with one that is not solved, or is near a singular pose, run in Python."""
    dyn = problem.dyn
    assert isinstance(dyn, LagrangianDynamics)
    parts, space, q0, v0 = Collocation(dyn.equations, tableau), Space(dyn.model), problem.q, problem.v
    every = (parts.start, *parts.iteration, parts.end)
    if parts.size > _WORTH_COMPILING or any(isinstance(dyn.code(x.name, make=x.make), Machine) for x in every):
        return run_fixed(problem)
    w0, first = space.to_integrator_velocity(q0, v0), problem.torque.columns(np.arange(len(q0)), 0, 1)[0].T
    more = at_time(dyn, problem.start)._trailing(q0)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        tau = np.broadcast_to(first, (len(q0), first.shape[-1]))
        guess = dyn.code(parts.start.name, make=parts.start.make)(q0, v0, w0, tau, *more)[0][..., 0]

        def velocity(t: float, q: Array, w: Array, members: Indices) -> Array:  # noqa: ARG001
            return to_body_velocity(space, q, w)

        record, iterations, lost, error = run_implicit(problem, parts, w0, guess, velocity)
        if not space.flat:
            # The start is there already, as it was given.
            q, w = (x[:, record.kept > 0] for x in (record.q, record.v))
            flat = space.to_body_velocity(*(x.reshape(-1, x.shape[-1]) for x in (q, w)))
            record.v[:, record.kept > 0] = flat.reshape(w.shape)
    if lost and error is None:
        return run_fixed(problem, record, np.array(sorted(lost)))
    return record.result(lambda _: "", tableau.stages * iterations, iterations, error)


def _split(n: int, widest: int, workers: int) -> list[slice]:
    """Return parts of about equal size, none above `widest`, as many as keep every worker busy."""
    if not n:
        return []
    rounds = -(-n // (widest * workers))
    # A core's vectors hold eight states: fewer are no work to share out.
    parts = max(1, min(rounds * workers, n // 8))
    ends = [n * i // parts for i in range(parts + 1)]
    return [slice(a, b) for a, b in pairwise(ends)]


# Implicit methods: many steps for states side by side.

#: States that go side by side, at most: enough for the processor's vectors, and nine
#: cache lines in a row of them, because an even number would meet in the same sets.
WIDEST: Final = 72
# Blocks without a miss after which one iteration less is tried.
_PATIENCE: Final = 32
# Steps of a block at most: one that is not solved is repeated.
_LONGEST_IMPLICIT: Final = 256


class ImplicitParts(Protocol):
    """The parts of a step of an implicit method: `Midpoint` or `Collocation` of `mbkit.derivation.steps`.

    `carried` are the names of q and of what goes with it, `past` those of the unknowns of the last steps, the step's
    own first; `clock` is the time that the parameters hold, in steps behind the start of one. `iteration` ends with a
    new unknown and 0 where it was the last one needed; `end` writes the state, the next guess and the missed steps.
    """

    carried: tuple[str, str]
    clock: float
    unknowns: int
    end: Part

    @property
    def past(self) -> tuple[str, ...]: ...
    @property
    def iteration(self) -> tuple[Part, ...]: ...


class ImplicitChunk(BlockLoop):
    """At most `WIDEST` trajectories that take blocks of steps with equally many Newton iterations each.

    Where a step is not solved, the block is repeated with more. `torques`: each step has its own torque.
    """

    def __init__(self, dyn: LagrangianDynamics, parts: ImplicitParts, count: int, steps: int, *, torques: bool) -> None:
        self._parts, self.carried, self.evaluated, self.each_step = parts, parts.carried, parts.clock, torques
        every = (*parts.iteration, parts.end)
        self._codes = {part.name: dyn.code(part.name, make=part.make) for part in every}
        rows = dict[str, int]()
        for part in every:
            code = self._codes[part.name]
            rows |= dict(zip(part.reads, code.inputs, strict=True))
            rows |= dict(zip(part.writes, (r * c for r, c in code.shapes), strict=True))
        x, q, other = parts.past[0], *parts.carried
        fits = _CACHE // (8 * padded(count) * (rows[q] + rows[other] + 2 * rows[x] + 1))
        n, back = max(min(fits, _LONGEST_IMPLICIT, isqrt(steps)), _SHORTEST), len(parts.past) - 1
        # Until there are unknowns to guess the next one from, more iterations are needed.
        self._longest, self.block = n, back + 1
        # The time is one of the parameters, and another in each step.
        clock = dyn.model.time_parameter
        # The unknown of each step behind those of the last ones before the block.
        places = {q: n + 1, other: n + 1, "misses": n + 1, x: n + back, "guess": n + 1, "trial": 2}
        places |= {"tau": n if torques else 1, "parameters": 1 if clock is None else n}
        rows |= {"trial": rows[x], "tau": dyn.equations.force.numel()}
        ends = {*parts.past[1:], *parts.end.writes, f"{x}1"} - {"guess"}
        at = None if clock is None else list(dyn.model.parameters).index(clock)
        super().__init__({name: (places.get(name, 1), rows[name]) for name in rows if name not in ends}, count, at)
        self._back = back
        self._sequences: dict[int, KernelSequence] = {}
        self._iterations, self._smooth = 2, 0
        self.iterations = 0
        self._alive = np.full(count, True)

    def begin(self, q: Array, other: Array, guess: Array, parameters: Array) -> None:
        """Put in (n, nq) configurations, what goes with them, unknowns, and values of parameters, (p,) or (n, p)."""
        self._begin(parameters, **{self.carried[0]: q, self.carried[1]: other}, guess=guess)
        for place in range(self._back):
            self._fill(self._parts.past[0], place, guess.T[None])

    def _sequence(self, iterations: int) -> KernelSequence:
        if iterations not in self._sequences:
            x, back = self._parts.past[0], self._back
            tries = [("guess", 0), *(("trial", i) for i in range(iterations - 1)), (x, back)]
            calls = [
                self._call(self._codes[part.name], part, 0, 1, {x: before, f"{x}1": after})
                for before, after in pairwise(tries)
                for part in self._parts.iteration
            ]
            places = {name: (x, back - i) for i, name in enumerate(self._parts.past)} | {"guess": ("guess", 1)}
            places |= {f"{name}1": (name, 1) for name in (*self.carried, "misses")}
            end = self._parts.end
            self._sequences[iterations] = KernelSequence([*calls, self._call(self._codes[end.name], end, 0, 1, places)])
        return self._sequences[iterations]

    def run_to(self, step: int) -> None:
        first, steps = self._taken, step - self._taken
        if self._smooth >= _PATIENCE and self._iterations > 1:
            self._iterations, self._smooth = self._iterations - 1, 0
        iterations, calls = self._iterations, len(self._parts.iteration)
        while True:
            every = iterations * calls + 1
            self._sequence(iterations).run(first * every, step * every)
            self.iterations += iterations * steps * int(self._alive.sum())
            missed = self._room["misses"][step, 0, : self._count] > 0
            if not (missed & self._alive).any():
                self._smooth += 1
                break
            self._smooth = 0
            if iterations == MOST:
                break
            iterations = min(iterations + max(iterations // 2, 1), MOST)
        self._iterations, self._taken = iterations, step
        if missed.any():
            # What is lost asks for no more iterations.
            self._alive &= ~missed
            if self._iterations == MOST:
                self._iterations = 2

    @property
    def alive(self) -> NDArray[np.bool_]:
        return self._alive

    @property
    def good(self) -> Indices:
        solved = self._room["misses"][1 : self._taken + 1, 0, : self._count] == 0
        return np.asarray(solved.sum(axis=0))

    def again(self) -> None:
        n, past = self._taken, self._room[self._parts.past[0]]
        if self.block != self._longest:
            self.block, self._iterations = self._longest, 2
        for name in (*self.carried, "guess"):
            self._room[name][0] = self._room[name][n]
        self._room["misses"][0] = 0.0
        past[: self._back] = past[n : n + self._back].copy()
        self._taken = 0


def run_implicit(
    problem: IntegrationProblem,
    parts: ImplicitParts,
    other: Array,
    guess: Array,
    velocity: Callable[[float, Array, Array, Indices], Array],
) -> tuple[GridRecord, int, dict[int, list[Array]], FunctionError | None]:
    """Run every trajectory, some side by side, and such chunks at once on several cores.

    `other` is what goes with q, (n, nv), and `guess` the first unknown; velocity(t, q, other, members) is mbkit's.
    Returns also Newton's iterations, the last state of each trajectory that was lost, by its index, and the error of a
    torque function that ended the run. The record holds `other` in the place of v.
    """
    dyn, record, grid = problem.dyn, GridRecord(problem), problem.grid
    assert isinstance(dyn, LagrangianDynamics)
    values, n = dyn.parameter_values, len(other)
    count, workers = -(-n // WIDEST), dyn.threads or cores()
    if problem.torque.samples is not None:
        # Parts that wait for one another have a thread each.
        count = min(count, workers)
    ends = [n * i // max(count, 1) for i in range(count + 1)]
    # Threads append to it, and write their own members.
    iterations, lost = list[int](), dict[int, list[Array]]()

    barrier = None if problem.torque.samples is None else SampleBarrier(problem, count, velocity)

    def run(part: slice) -> Iterator[int]:
        members = np.arange(n)[part]
        chunk = ImplicitChunk(dyn, parts, len(members), grid.steps, torques=problem.torque.in_each_step)
        chunk.begin(problem.q[part], other[part], guess[part], values[part] if values.ndim == 2 else values)
        with _joined(barrier, chunk, members):
            for end, last in run_blocks(problem, record, chunk, members, (), barrier):
                lost.update(last)
                yield end
        iterations.append(chunk.iterations)

    run_parts([slice(a, b) for a, b in pairwise(ends)], lambda: run, workers, grid.steps, problem.bar, barrier)
    return record, sum(iterations), lost, None if barrier is None else barrier.error
