"""Blocks of steps of many states side by side, and the threads that share a batch of them.

A block runs to its end without looking back. What samples stops it, where all parts of a batch meet.

Implicit fixed steps with torques held over each of them, compiled: many steps for states side by side.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from itertools import pairwise
from math import isqrt
from typing import Any, Final, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit._child_process import cores
from mbkit.codegen.backend import Machine
from mbkit.codegen.compiled import Call, Compiled, KernelSequence, aligned
from mbkit.codegen.jit import host
from mbkit.derivation.steps.collocation import Collocation
from mbkit.derivation.steps.fixed import Part
from mbkit.derivation.steps.midpoint import MAX_NEWTON_ITERATIONS
from mbkit.engines.base import at_time
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import FunctionError
from mbkit.methods.tableaus import ImplicitTableau
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.singular_poses import SingularPosesOfBatch
from mbkit.simulate.solvers.fixed_step import run_fixed, to_body_velocity
from mbkit.simulate.solvers.trajectory_record import GridRecord
from mbkit.simulate.time_grid import Grid, Indices

#: Half of the second cache of a core, bytes.
CACHE: Final = 2**19
#: Fewest steps of a block.
SHORTEST: Final = 16
#: Number of doubles in a cache line.
LANES: Final = 8


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
    #: Each state of a block can be read, not only the last.
    all_kept = True
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

    @property
    def taken(self) -> int:
        """Steps of the block so far."""
        return self._taken

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


_Loop = TypeVar("_Loop", bound=BlockLoop)


def padded(count: int) -> int:
    """Return the number of columns for so many states: whole cache lines, and an odd number of them.

    So no two rows fall on the same lines of a cache that is split by powers of two: 20 % of the time at 1024 states.
    """
    return -(-count // LANES) * LANES | LANES


def run_blocks(
    problem: IntegrationProblem,
    record: GridRecord,
    loop: BlockLoop,
    members: Indices,
) -> Iterator[tuple[int, dict[int, list[Array]] | None]]:
    """Take members of the batch, which are in the loop, through the run in blocks.

    Yields the number of steps after each block, and the last good state of the trajectories that were lost in it; None
    in place of these at a sample, before which the torque is to be asked.
    """
    grid, torque, kept = problem.grid, problem.torque, record.kept
    k, torques, alive = 0, np.empty(0), np.full(len(members), True)
    samples = [*reversed(torque.changes(grid.steps))]
    # Most parts of a batch are contiguous, which is read and written faster.
    whole = slice(int(members[0]), int(members[-1]) + 1)
    which: slice | Indices = whole if whole.stop - whole.start == len(members) else members
    # The last step may have a length of its own.
    ends = () if loop.all_kept else kept.tolist()
    stops = {*ends, grid.steps - 1 if grid.last != grid.dt else grid.steps, grid.steps}
    for stop in sorted(stops):
        while k < stop:
            n, at = min(loop.block, stop - k), k
            loop.set_times(grid, k, n)
            while at < k + n:
                if samples and samples[-1] == at:
                    samples.pop()
                    yield at, None
                    if record.error is not None:
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
                record.good[which] = k + n
            else:
                record.good[members[alive]] = k + good[alive]
                for m in np.flatnonzero(alive & (good < n)).tolist():
                    last[int(members[m])] = [loop.states(name, [good[m]])[m, 0] for name in loop.carried]
                alive &= good == n
            yield k + n, last
            if record.error is not None or (last and not alive.any()):
                return
            loop.again()
            k += n


def run_members(
    problem: IntegrationProblem,
    record: GridRecord,
    members: Indices,
    widest: int,
    workers: int,
    new_loop: Callable[[int], Callable[[Indices], _Loop]],
    velocity: Callable[[float, Array, Array, Indices], Array],
    after_block: Callable[[_Loop, Indices, int, dict[int, list[Array]]], None],
    after_part: Callable[[_Loop, slice], None],
) -> None:
    """Take members of a batch to the end, or up to where a torque function that samples fails.

    They go in parts of at most `widest` states in at most `workers` threads; under a torque that samples, which is
    asked once for all, in a part for each thread. new_loop(width), called in each thread, returns begin(members), the
    loop with these states in it, at most `width`; velocity(t, q, w, members) is mbkit's of states (n, nq) and (n, nv).
    `after_block` gets the loop, its members and what `run_blocks` yields.
    """
    grid, torque, bar = problem.grid, problem.torque, problem.bar
    sampled, n = torque.samples is not None, len(members)
    if sampled:
        # Threads meet at each sample.
        steps = n * grid.steps // max(len(torque.changes(grid.steps)), 1)
        workers = max(1, min(workers, steps // MIN_STEPS_OF_A_THREAD))
    parts = _split(n, max(-(-n // workers), 1) if sampled else widest, workers)
    width = max((part.stop - part.start for part in parts), default=0)
    ways: dict[int, tuple[_Loop, Iterator[tuple[int, dict[int, list[Array]] | None]]]] = {}
    done, stop, local = [0] * len(parts), threading.Event(), threading.local()
    total = max(len(parts) * grid.steps, 1)

    def advance(i: int) -> bool:
        """Take a part to its next sample, or to the end; return whether it waits there."""
        own = members[parts[i]]
        if i not in ways:
            begin = getattr(local, "begin", None)
            if begin is None or sampled:
                begin = local.begin = new_loop(width)
            loop = begin(own)
            ways[i] = loop, run_blocks(problem, record, loop, own)
        loop, blocks = ways[i]
        for done[i], lost in blocks:
            if lost is None:
                return True
            after_block(loop, own, done[i], lost)
            if pool is None:
                bar.update(sum(done) / total)
            if stop.is_set():
                return False
        after_part(loop, parts[i])
        return False

    def ask(waiting: list[int]) -> None:
        loops = [(ways[i][0], members[parts[i]]) for i in waiting]
        good = [loop.alive for loop, _ in loops]
        # Most often all go on, and are read where they are.
        which = [slice(None) if x.all() else x for x in good]
        who: Indices = np.concatenate([own[x] for (_, own), x in zip(loops, which, strict=True)])
        if len(who):
            k = done[waiting[0]]
            q, w = (
                np.concatenate([loop.now(name).T[x] for (loop, _), x in zip(loops, which, strict=True)])
                for name in loops[0][0].carried
            )
            try:
                torque.sample(k, grid.time(k), q, velocity(grid.time(k), q, w, who), who)
            except FunctionError as error:
                record.error = error

    def outcome(future: Future[bool]) -> bool:
        while True:
            try:
                return future.result(timeout=0.1)
            except TimeoutError:
                if future.done():
                    raise
                bar.update(sum(done) / total)

    waiting, several = [*range(len(parts))], min(workers, len(parts)) > 1
    with ThreadPoolExecutor(min(workers, len(parts))) if several else nullcontext() as pool:
        try:
            while waiting:
                if pool is None:
                    waiting = [i for i in waiting if advance(i)]
                else:
                    futures = [pool.submit(advance, i) for i in waiting]
                    waiting = [i for i, future in zip(waiting, futures, strict=True) if outcome(future)]
                bar.update(sum(done) / total)
                if waiting:
                    ask(waiting)
        finally:
            stop.set()


def _split(n: int, widest: int, workers: int) -> list[slice]:
    """Return parts of about equal size, none above `widest`, as many as keep every worker busy."""
    if not n:
        return []
    rounds = -(-n // (widest * workers))
    # A core's vectors hold eight states: fewer are no work to share out.
    parts = max(1, min(rounds * workers, n // 8))
    ends = [n * i // parts for i in range(parts + 1)]
    return [slice(a, b) for a, b in pairwise(ends)]


#: Number of multiplications of an implicit step's system beyond which compiling it takes longer than tens of thousands
#: of steps in Python.
_MAX_MULTIPLICATIONS: Final = 10_000
#: Most states that go side by side: enough for the processor's vectors, and nine
#: cache lines in a row of them, because an even number would meet in the same sets.
WIDEST: Final = 72
#: Fewest steps of all members between two samples for which a thread pays.
MIN_STEPS_OF_A_THREAD: Final = 1024
#: Number of blocks without a miss after which one iteration less is tried.
_BLOCKS_WITHOUT_MISS: Final = 32
#: Most steps of a block: one that is not solved is repeated.
_MAX_BLOCK_STEPS: Final = 256


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
        self._codes = {part.name: dyn._code(part.name, make=part.make) for part in every}
        rows = dict[str, int]()
        for part in every:
            code = self._codes[part.name]
            rows |= dict(zip(part.reads, code.inputs, strict=True))
            rows |= dict(zip(part.writes, (r * c for r, c in code.shapes), strict=True))
        x, q, other = parts.past[0], *parts.carried
        fits = CACHE // (8 * padded(count) * (rows[q] + rows[other] + 2 * rows[x] + 1))
        n, back = max(min(fits, _MAX_BLOCK_STEPS, isqrt(steps)), SHORTEST), len(parts.past) - 1
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
        if self._smooth >= _BLOCKS_WITHOUT_MISS and self._iterations > 1:
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
            if iterations == MAX_NEWTON_ITERATIONS:
                break
            iterations = min(iterations + max(iterations // 2, 1), MAX_NEWTON_ITERATIONS)
        self._iterations, self._taken = iterations, step
        if missed.any():
            # Trajectories that are lost ask for no more iterations.
            self._alive &= ~missed
            if self._iterations == MAX_NEWTON_ITERATIONS:
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
    poses: SingularPosesOfBatch | None = None,
) -> tuple[GridRecord, int, dict[int, list[Array]]]:
    """Run every trajectory, some side by side, and such chunks at once on several cores.

    `other` is what goes with q, (n, nv), and `guess` the first unknown; velocity(t, q, other, members) is mbkit's.
    Returns also Newton's iterations, and the last state of each trajectory that was lost, by its index. The record
    holds `other` in the place of v. `poses` take in the end of each step.
    """
    dyn, record, grid = problem.dyn, GridRecord(problem), problem.grid
    assert isinstance(dyn, LagrangianDynamics)
    values, workers = dyn._parameter_values, min(dyn.threads or cores(), max(-(-len(other) // WIDEST), 1))
    # Threads append to it, and write their own members.
    iterations, lost = list[int](), dict[int, list[Array]]()

    def begin(members: Indices) -> ImplicitChunk:
        chunk = ImplicitChunk(dyn, parts, len(members), grid.steps, torques=problem.torque.in_each_step)
        own = (problem.q, other, guess, *([values] if values.ndim == 2 else []))
        chunk.begin(*(x[members] for x in own), *([] if values.ndim == 2 else [values]))
        return chunk

    def after_block(chunk: ImplicitChunk, members: Indices, k: int, last: dict[int, list[Array]]) -> None:
        lost.update(last)
        if poses is not None and poses.members:
            times, q = grid.times_of(np.arange(k - chunk.taken, k) + 1), chunk.states("q", np.arange(chunk.taken) + 1)
            for i, good, at in zip(members.tolist(), chunk.good.tolist(), q, strict=True):
                poses.members[i].saw(times[:good], at[:good])

    run_members(
        *(problem, record, np.arange(len(other)), WIDEST, workers, lambda _: begin, velocity),
        after_block=after_block,
        after_part=lambda chunk, _part: iterations.append(chunk.iterations),
    )
    return record, sum(iterations), lost


def run_collocation(problem: IntegrationProblem, tableau: ImplicitTableau) -> SolverResult:
    """Take implicit steps; trajectories with one that is not solved, or is near a singular pose, run in Python."""
    dyn = problem.dyn
    assert isinstance(dyn, LagrangianDynamics)
    parts, space, q0, v0 = Collocation(dyn.equations, tableau), Space(dyn.model), problem.q, problem.v
    every = (parts.start, *parts.iteration, parts.end)
    if parts.size > _MAX_MULTIPLICATIONS or any(isinstance(dyn._code(x.name, make=x.make), Machine) for x in every):
        return run_fixed(problem)
    w0, first = space.to_integrator_velocity(q0, v0), problem.torque.columns(np.arange(len(q0)), 0, 1)[0].T
    more = at_time(dyn, problem.start)._trailing(q0)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        tau = np.broadcast_to(first, (len(q0), first.shape[-1]))
        guess = dyn._code(parts.start.name, make=parts.start.make)(q0, v0, w0, tau, *more)[0][..., 0]
        velocity = lambda _t, q, w, _members: to_body_velocity(space, q, w)  # noqa: E731
        record, iterations, lost = run_implicit(problem, parts, w0, guess, velocity)
        if not space.flat:
            # The start is there already, as it was given.
            q, w = (x[:, record.kept > 0] for x in (record.q, record.v))
            flat = space.to_body_velocity(*(x.reshape(-1, x.shape[-1]) for x in (q, w)))
            record.v[:, record.kept > 0] = flat.reshape(w.shape)
    if lost and record.error is None:
        return run_fixed(problem, record, np.array(sorted(lost)))
    record.evaluations, record.jacobians = tableau.stages * iterations, iterations
    return record.result()
