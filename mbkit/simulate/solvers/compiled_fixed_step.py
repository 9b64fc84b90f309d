"""Fixed steps with torques held over each of them, compiled, on all cores.

A chunk of states runs to its end without looking back. The sum of squares that each carries along shows whether it
diverged; only then is its run repeated, with a look at every step.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from itertools import pairwise
from math import isqrt
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.codegen.compiled import Call, KernelSequence, aligned, cores
from mbkit.derivation.steps.fixed import Part
from mbkit.derivation.steps.midpoint import GUESS, MOST, Midpoint
from mbkit.engines.compiled_calls import Plan
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.methods.registry import method_of
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.progress import Progress
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.fixed_step import GridRecord, divergence_reason, run_fixed
from mbkit.simulate.solvers.vector_field import BOUND, are_bounded
from mbkit.simulate.time_grid import Indices

#: Largest number of steps between two checks.
BLOCK: Final = 16

# Half of what a core has in its second cache.
_CACHE: Final = 2**19
_LANES: Final = 8
_MOST_STATES: Final = 1032
# What a step writes -> what the next one reads.
_STATE: Final = {"q1": "q", "w1": "w", "squares1": "squares"}


class BlockLoop:
    """Room for the states of a block of steps side by side, one trajectory in each column.

    Columns beyond the `count` states repeat the last one. `sizes` has for each name the number of places, one for each
    step that has its own, and of rows. `block` is the number of steps of the next block, at most; `good` are the good
    steps of the last one, (n,), or None where nobody looked; `carried` names q and what goes with it.
    """

    block: int
    good: Indices | None = None
    carried = ("q", "w")

    def __init__(self, sizes: Mapping[str, tuple[int, int]], count: int) -> None:
        width = padded(count)
        self._room = {}
        for name, (places, rows) in sizes.items():
            self._room[name] = aligned(places * rows * width).reshape(places, rows, width)
            self._room[name][:] = 0.0
        self._count = self._taken = 0

    def _array(self, name: str, place: int) -> Array:
        room = self._room[name]
        return np.asarray(room[place % len(room)].T)

    def _fill(self, name: str, place: int, columns: Array) -> None:
        room = self._room[name][place]
        room[:, : self._count] = columns
        room[:, self._count :] = room[:, self._count - 1 : self._count]

    def _begin(self, parameters: Array, **states: Array) -> None:
        """Put in states, (n, rows), and the values of parameters, (p,) or (n, p)."""
        self._count = len(states["q"])
        for name, x in states.items():
            self._fill(name, 0, x.T)
        for place in range(len(self._room.get("parameters", ())) if parameters.size else 0):
            self._fill("parameters", place, np.atleast_2d(parameters).T)

    def _hold(self, steps: int, dt: float, torques: Array) -> None:
        self._room["dt"][:] = dt
        for j in range(min(steps, len(self._room["tau"]))):
            self._fill("tau", j, torques[j])

    def advance(self, steps: int, start: float, dt: float, torques: Array) -> None:
        """Take at most `block` steps of length dt from where the last ones ended; torques (steps or 1, nv, n or 1)."""
        raise NotImplementedError

    def again(self) -> None:
        """Make the last state the first one of the next block."""
        raise NotImplementedError

    def to_body_velocity(self, q: Array, w: Array) -> Array:  # noqa: ARG002
        """Return the saved w, (n, steps, nv)."""
        return w

    def states(self, name: str, which: Sequence[int] | Indices) -> Array:
        """Return q, w, ... after these many steps of the block, (n, steps, rows)."""
        room = self._room[name]
        places = np.asarray(which) if self._taken < len(room) else np.asarray(which) % len(room)
        return np.asarray(room[:, :, : self._count][places].transpose(2, 0, 1))


def padded(count: int) -> int:
    """Return the number of columns for so many states: whole cache lines, and an odd number of them.

    So no two rows fall on the same lines of a cache that is split by powers of two: 20 % of the time at 1024 states.
    """
    return -(-count // _LANES) * _LANES | _LANES


def run_blocks(
    problem: IntegrationProblem, record: GridRecord, loop: BlockLoop, members: Indices, ends: Iterable[int] = ()
) -> Iterator[tuple[int, dict[int, list[Array]]]]:
    """Take members of the batch, which are in the loop, through the run in blocks that stop at `ends` too.

    Yields the number of steps after each block, and the last good state of the trajectories that were lost in it.
    """
    grid, torque, kept = problem.grid, problem.torque, record.kept
    k, torques, alive = 0, np.empty(0), np.full(len(members), True)
    # Most parts of a batch are contiguous, which is read and written faster.
    whole = slice(int(members[0]), int(members[-1]) + 1)
    which: slice | Indices = whole if whole.stop - whole.start == len(members) else members
    # The last step may have a length of its own.
    stops = {*ends, grid.steps - 1 if grid.last != grid.dt else grid.steps, grid.steps}
    for stop in sorted(stops):
        while k < stop:
            n = min(loop.block, stop - k)
            if torque.held or not torques.size:
                torques = torque.columns(which, k, k + n)
            loop.advance(n, grid.time(k), grid.step(k), torques)
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
            if last and not alive.any():
                return
            loop.again()
            k += n


def run_parts(
    parts: Sequence[slice],
    new_worker: Callable[[], Callable[[slice], Iterator[int]]],
    workers: int,
    steps: int,
    bar: Progress,
) -> None:
    """Run parts of a batch in threads, at most `workers`.

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

    workers = min(workers, len(parts))
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


def _widest(plan: Plan) -> int:
    """Return how many states the cache holds with all that belongs to them, from 72 to 1032."""
    return min(max(padded(_CACHE // (8 * sum(plan.sizes.values()))), 9 * _LANES), _MOST_STATES)


class Chunk(BlockLoop):
    """At most `most` states that take explicit steps.

    `torques`: each step of a block has its own; `all_kept`: each state of a block can be read, not only the last;
    `watched`: it is looked for steps that are not good; `clock`: place of the time among the parameters.
    """

    block = BLOCK

    def __init__(
        self,
        plan: Plan,
        space: Space,
        most: int,
        *,
        torques: bool,
        all_kept: bool,
        watched: bool = False,
        clock: int | None = None,
    ) -> None:
        places = {**dict.fromkeys(_STATE.values(), BLOCK + 1 if all_kept else 2), "tau": BLOCK if torques else 1}
        places["parameters"] = 1 if clock is None else BLOCK
        self._clock = clock
        own = {name: (places.get(name, 1), rows) for name, rows in plan.sizes.items() if name not in _STATE}
        super().__init__(own, most)
        self._calls, self._space, self._watched = len(plan.parts), space, watched
        period = BLOCK if all_kept or torques or clock is not None else 2
        steps = [call for j in range(period) for call in self._step(plan, j)]
        self._sequence = KernelSequence(steps, BLOCK // period)

    def _step(self, plan: Plan, j: int) -> list[Call]:
        def array(name: str) -> Array:
            return self._array(_STATE.get(name, name), j + (name in _STATE))

        return [
            Call(code, [array(n) for n in part.reads], [array(n) for n in part.writes])
            for part, code in zip(plan.parts, plan.codes, strict=True)
        ]

    def begin(self, q: Array, w: Array, parameters: Array) -> None:
        """Put in states, (n, nq) and (n, nv) of `Space`, and the values of parameters, (p,) or (n, p)."""
        self._begin(parameters, q=q, w=w, squares=np.zeros((len(q), 1)))

    def advance(self, steps: int, start: float, dt: float, torques: Array) -> None:
        self._hold(steps, dt, torques)
        if self._clock is not None:
            self._room["parameters"][:steps, self._clock] = (start + np.arange(steps) * dt)[:, None]
        self._sequence.run(0, steps * self._calls)
        self._taken = steps
        if self._watched:
            q, w = (self.states(name, np.arange(1, steps + 1)) for name in self.carried)
            self.good = np.logical_and.accumulate(are_bounded(q, w), axis=1).sum(axis=1)

    def to_body_velocity(self, q: Array, w: Array) -> Array:
        if self._space.flat:
            return w
        flat = (np.ascontiguousarray(x).reshape(-1, x.shape[-1]) for x in (q, w))
        # What a lost state has become is nobody's concern here.
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(self._space.to_body_velocity(*flat).reshape(w.shape))

    def again(self) -> None:
        for name in _STATE.values():
            room = self._room[name]
            room[0] = room[self._taken % len(room)]


def run_rollout(problem: IntegrationProblem, workers: int | None = None) -> SolverResult:
    """Step one state or a batch over the grid; no number depends on `workers`, by default one for each core."""
    dyn, method, grid, record = problem.dyn, problem.method, problem.grid, GridRecord(problem)
    assert isinstance(dyn, LagrangianDynamics)
    space = Space(dyn.model)
    w0, values = space.to_integrator_velocity(problem.q, problem.v), dyn.parameter_values
    clock = None if dyn.model.time_parameter is None else list(dyn.model.parameters).index(dyn.model.time_parameter)
    workers = workers or dyn.threads or cores()
    # Every block costs some calls: worth it for a state now and then, not for most.
    dense = 2 * len(record.kept) > grid.steps

    def new_chunk(plan: Plan, most: int, *, all_kept: bool, watched: bool = False) -> Chunk:
        return Chunk(plan, space, most, torques=problem.torque.held, all_kept=all_kept, watched=watched, clock=clock)

    def blocks(chunk: Chunk, members: Indices, ends: Indices) -> Iterator[tuple[int, dict[int, list[Array]]]]:
        chunk.begin(problem.q[members], w0[members], values[members] if values.ndim == 2 else values)
        return run_blocks(problem, record, chunk, members, ends.tolist())

    def suspects_of(plan: Plan, members: Indices) -> Indices:
        """Take members of the batch to the end; return those that were not bounded, or lost to their constraints."""
        n, squares = len(members), np.zeros(len(members))
        parts = _split(n, _widest(plan), workers)

        def new_worker() -> Callable[[slice], Iterator[int]]:
            # The parts differ by one state at most.
            chunk = new_chunk(plan, -(-n // len(parts)), all_kept=dense)

            def run(part: slice) -> Iterator[int]:
                for end, _ in blocks(chunk, members[part], record.kept[:0] if dense else record.kept):
                    yield end
                squares[part] = chunk.states("squares", [0])[:, 0, 0]

            return run

        run_parts(parts, new_worker, workers, grid.steps, problem.bar)
        # A NaN is not below anything.
        return members[~(squares < BOUND**2)]

    plan, lost = dyn.step_plan(method), dict[int, list[Array]]()
    suspects = suspects_of(plan, np.arange(len(problem.q)))
    if len(suspects) and dyn.model.constrained:
        suspects = suspects_of(dyn.step_plan(method, thorough=True), suspects)
        if len(suspects):
            # Near a singular pose stages are projected too, and the pose is named. The others of a batch are done.
            return run_fixed(problem, record, suspects)
    for first in range(0, len(suspects), _widest(plan)):
        members = suspects[first : first + _widest(plan)]
        for _, last in blocks(new_chunk(plan, len(members), all_kept=True, watched=True), members, members[:0]):
            lost |= last

    def why(i: int) -> str:
        k, (q, w) = int(record.steps[i]), lost[i]
        force = np.asarray(problem.torque.columns(np.array([i]), k, k + 1)[0][:, 0])
        return divergence_reason(dyn.of_samples([i]), method, grid.time(k), grid.step(k), q[None], w[None], force[None])

    return record.result(why, method_of(method).stages * (int(record.steps.sum()) + len(lost)))


def _split(n: int, widest: int, workers: int) -> list[slice]:
    """Return parts of about equal size, none above `widest`, as many as keep every worker busy."""
    if not n:
        return []
    rounds = -(-n // (widest * workers))
    # A core's vectors hold eight states: fewer are no work to share out.
    parts = max(1, min(rounds * workers, n // 8))
    ends = [n * i // parts for i in range(parts + 1)]
    return [slice(a, b) for a, b in pairwise(ends)]


# The implicit midpoint rule: many steps for states side by side.

#: States that go side by side, at most: enough for the processor's vectors, and nine
#: cache lines in a row of them, because an even number would meet in the same sets.
WIDEST: Final = 72
# Blocks without a miss after which one iteration less is tried.
_PATIENCE: Final = 32
# Steps of a block, whose states fill half of a core's second cache.
_SHORTEST, _LONGEST = 16, 256
# Until there are velocities to guess the next one from, more iterations are needed.
_FIRST: Final = len(GUESS)


class MidpointChunk(BlockLoop):
    """At most `WIDEST` trajectories that take blocks of steps with equally many Newton iterations each.

    Where a step is not solved, the block is repeated with more. `torques`: each step has its own torque.
    """

    carried = ("q", "pi")

    def __init__(self, dyn: LagrangianDynamics, midpoint: Midpoint, count: int, steps: int, *, torques: bool) -> None:
        nq, nv, unknowns = dyn.model.nq, dyn.model.nv, midpoint.unknowns
        self._newton, self._end = midpoint.newton, midpoint.end
        self._codes = {part.name: dyn.code(part.name, make=part.make) for part in (self._newton, self._end)}
        most = min(_CACHE // (8 * padded(count) * (nq + nv + 2 * unknowns + 1)), _LONGEST, isqrt(steps))
        n, back = max(most, _SHORTEST), len(GUESS) - 1
        self._longest, self.block = n, _FIRST
        # The time is one of the parameters, and another in each step.
        names, clock = list(dyn.model.parameters), dyn.model.time_parameter
        self._clock = None if clock is None else names.index(clock)
        # The velocity of each step behind those of the last ones before the block.
        sizes = {"q": (n + 1, nq), "pi": (n + 1, nv), "misses": (n + 1, 1)}
        sizes |= {"w": (n + back, unknowns), **dict.fromkeys(("guess", "trial"), (2, unknowns))}
        sizes |= {"miss": (1, 1), "dt": (1, 1)}
        sizes["tau"] = n if torques else 1, dyn.equations.force.numel()
        sizes["parameters"] = 1 if clock is None else n, len(names)
        super().__init__(sizes, count)
        self._count, self._back = count, back
        self._sequences: dict[tuple[int, int], KernelSequence] = {}
        self._iterations, self._smooth = 2, 0
        self.iterations = 0
        self._alive = np.full(count, True)

    def begin(self, q: Array, pi: Array, w: Array, parameters: Array) -> None:
        """Put (n, nq) configurations, (n, nv) momenta and velocities in, and the parameters' values, (p,) or (n, p)."""
        self._begin(parameters, q=q, pi=pi, guess=w)
        for place in range(self._back):
            self._fill("w", place, w.T)

    def _sequence(self, iterations: int) -> KernelSequence:
        key = iterations, self.block
        if key not in self._sequences:
            calls = [call for j in range(self.block) for call in self._step(j, iterations)]
            self._sequences[key] = KernelSequence(calls)
        return self._sequences[key]

    def _step(self, j: int, iterations: int) -> list[Call]:
        at = self._array
        held = {name: at(name, j) for name in ("q", "pi", "tau", "misses", "parameters")}
        held |= {name: at(name, 0) for name in ("dt", "miss")}
        new = {"q1": at("q", j + 1), "pi1": at("pi", j + 1), "misses1": at("misses", j + 1), "guess": at("guess", 1)}
        # The block's first guess stays unchanged, so that the block can be repeated.
        tries = [at("guess", min(j, 1)), *(at("trial", i) for i in range(iterations - 1)), at("w", j + self._back)]
        calls = []
        for w, w1 in pairwise(tries):
            arrays = {**held, "w": w}
            calls.append(self._call(self._newton, arrays, [w1, held["miss"]]))
        past = {name: at("w", j + self._back - i) for i, name in enumerate(("w", "w_1", "w_2"))}
        outs = [new[name] for name in self._end.writes]
        return [*calls, self._call(self._end, {**held, **past}, outs)]

    def _call(self, part: Part, arrays: dict[str, Array], outs: list[Array]) -> Call:
        return Call(self._codes[part.name], [arrays[n] for n in part.reads], outs)

    def advance(self, steps: int, start: float, dt: float, torques: Array) -> None:
        """Take some steps, and count in `good` how many of them are solved."""
        self._hold(steps, dt, torques)
        if self._clock is not None:
            middles = start + (np.arange(steps) + 0.5) * dt
            self._room["parameters"][:steps, self._clock] = middles[:, None]
        self._room["misses"][0] = 0.0
        if self._smooth >= _PATIENCE and self._iterations > 1:
            self._iterations, self._smooth = self._iterations - 1, 0
        iterations = self._iterations
        while True:
            self._sequence(iterations).run(0, steps * (iterations + 1))
            self.iterations += iterations * steps * int(self._alive.sum())
            missed = self._room["misses"][steps, 0, : self._count] > 0
            if not (missed & self._alive).any():
                self._smooth += 1
                break
            self._smooth = 0
            if iterations == MOST:
                break
            iterations = min(iterations + max(iterations // 2, 1), MOST)
        self._iterations, self._taken = iterations, steps
        self.good = np.full(self._count, steps)
        if missed.any():
            self.good = np.count_nonzero(self._room["misses"][1 : steps + 1, 0, : self._count] == 0, axis=0)
            # What is lost asks for no more iterations.
            self._alive &= ~missed
            if self._iterations == MOST:
                self._iterations = 2

    def again(self) -> None:
        n = self._taken
        if self.block != self._longest:
            self.block, self._iterations = self._longest, 2
        for name in ("q", "pi"):
            self._room[name][0] = self._room[name][n]
        self._room["guess"][0] = self._room["guess"][1]
        self._room["w"][: self._back] = self._room["w"][n : n + self._back].copy()
