"""Fixed steps with torques held over each of them, compiled, on all cores.

A chunk of states runs to its end without looking back. The sum of squares that each carries along shows whether it
diverged; only then is its run repeated, with a look at every step.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.codegen.compiled import Call, Compiled, KernelSequence, aligned, cores
from mbkit.derivation.steps.fixed import Part, march, march_in_stages
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.methods.registry import method_of
from mbkit.model.integration_space import Space
from mbkit.simulate.progress import Progress
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.fixed_step import divergence_reason
from mbkit.simulate.solvers.trajectory_record import grid_result
from mbkit.simulate.solvers.vector_field import BOUND, is_bounded
from mbkit.simulate.time_grid import Grid, Indices, check_room
from mbkit.simulate.torque import Torque

#: Steps that are made without a look at them, at most.
BLOCK: Final = 16

# Above this many operations the forward dynamics is compiled once and called for each
# stage: LLVM's time grows faster than the step, which then runs no faster than its parts.
_ONE_PIECE: Final = 20_000
# Half of what a core has in its second cache.
_CACHE: Final = 2**19
_LANES: Final = 8
_MOST: Final = 1032
# What a step writes -> what the next one reads.
_STATE: Final = {"q1": "q", "w1": "w", "squares1": "squares"}


class BlockLoop:
    """Room for the states of a block of steps side by side, one trajectory in each column.

    Columns beyond the `count` states repeat the last one. `sizes` has for each name the number of places, one for each
    step that has its own, and of rows.
    """

    block: int  # steps of the next block, at most

    def __init__(self, sizes: Mapping[str, tuple[int, int]], count: int) -> None:
        self._width = padded(count)
        self._room = {name: _room(places, rows, self._width) for name, (places, rows) in sizes.items()}
        self._count = self._taken = 0

    def _array(self, name: str, place: int) -> Array:
        room = self._room[name]
        return np.asarray(room[place % len(room)].T)

    def _fill(self, name: str, place: int, columns: Array) -> None:
        room = self._room[name][place]
        room[:, : self._count] = columns
        room[:, self._count :] = room[:, self._count - 1 : self._count]

    def _fill_parameters(self, values: Array) -> None:
        for place in range(len(self._room.get("parameters", ())) if values.size else 0):
            self._fill("parameters", place, np.atleast_2d(values).T)

    def advance(self, steps: int, start: float, dt: float, torques: Array) -> None:
        """Take at most `block` steps of length dt from where the last ones ended; torques (steps or 1, nv, n or 1)."""
        raise NotImplementedError

    def again(self) -> None:
        """Make the last state the first one of the next block."""
        raise NotImplementedError


def padded(count: int) -> int:
    """Return the number of columns for so many states: whole cache lines, and an odd number of them.

    So no two rows fall on the same lines of a cache that is split by powers of two: 20 % of the time at 1024 states.
    """
    return -(-count // _LANES) * _LANES | _LANES


def _room(places: int, rows: int, width: int) -> Array:
    out = aligned(places * rows * width).reshape(places, rows, width)
    out[:] = 0.0
    return out


def blocks(
    loop: BlockLoop, grid: Grid, torque: Torque, members: slice | Indices, ends: Iterable[int] = ()
) -> Iterator[tuple[int, int]]:
    """Take members of the batch, which are in the loop, through the run in blocks that stop at `ends` too.

    Yields the number of steps before and after each block.
    """
    k, torques = 0, np.empty(0)
    # The last step may have a length of its own.
    stops = {*ends, grid.steps - 1 if grid.last != grid.dt else grid.steps, grid.steps}
    for stop in sorted(stops):
        while k < stop:
            n = min(loop.block, stop - k)
            if torque.held or not torques.size:
                torques = torque.columns(members, k, k + n)
            loop.advance(n, grid.time(k), grid.step(k), torques)
            yield k, k + n
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


class Plan:
    """A method's step for one model in machine code: its parts in order, and the rows of each array they use."""

    def __init__(self, dyn: LagrangianDynamics, method: str) -> None:
        def code(part: Part) -> Compiled:
            made: Compiled = dyn.code(part.name, make=part.make)
            return made

        self.parts = march_in_stages(dyn.equations, method)
        forward = next(part for part in self.parts if part.name == "forward_dynamics")
        if method_of(method).stages * code(forward).operations <= _ONE_PIECE:
            self.parts = march(dyn.equations, method)
        self.codes = tuple(code(part) for part in self.parts)
        self.sizes: dict[str, int] = {}
        for part, made in zip(self.parts, self.codes, strict=True):
            self.sizes.update(zip(part.reads, made.inputs, strict=True))
            self.sizes.update(zip(part.writes, (rows for rows, _ in made.shapes), strict=True))

    @property
    def widest(self) -> int:
        """States that the cache holds with all that belongs to them, from 72 to 1032."""
        return min(max(padded(_CACHE // (8 * sum(self.sizes.values()))), 9 * _LANES), _MOST)


class Chunk(BlockLoop):
    """At most `most` states that take explicit steps.

    `torques`: each step of a block has its own; `all_kept`: each state of a block can be read, not only the last.
    """

    block = BLOCK

    def __init__(self, plan: Plan, most: int, *, torques: bool, all_kept: bool) -> None:
        self._all_kept, self._torques = all_kept, BLOCK if torques else 1
        places = {**dict.fromkeys(_STATE.values(), BLOCK + 1 if all_kept else 2), "tau": self._torques}
        own = {name: (places.get(name, 1), rows) for name, rows in plan.sizes.items() if name not in _STATE}
        super().__init__(own, most)
        self._calls = len(plan.parts)
        period = BLOCK if all_kept or torques else 2
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
        self._count = len(q)
        self._fill("q", 0, q.T)
        self._fill("w", 0, w.T)
        self._room["squares"][0] = 0.0
        self._fill_parameters(parameters)

    def advance(self, steps: int, start: float, dt: float, torques: Array) -> None:  # noqa: ARG002  # no time enters
        """Take some steps."""
        self._room["dt"][:] = dt
        for j in range(min(steps, self._torques)):
            self._fill("tau", j, torques[j])
        self._sequence.run(0, steps * self._calls)
        self._taken = steps

    def again(self) -> None:
        """Make the last state the first one of the next block."""
        for name in _STATE.values():
            room = self._room[name]
            room[0] = room[self._taken % len(room)]

    def states(self, name: str) -> Array:
        """Return q, w or squares after each step of the block, or after its last one: (steps or 1, rows, n)."""
        room = self._room[name]
        first = self._taken % len(room)
        places = room[1 : self._taken + 1] if self._all_kept else room[first : first + 1]
        return places[:, :, : self._count]

    def start(self, name: str) -> Array:
        """Return q, w or squares before the block, (rows, n)."""
        return self._room[name][0, :, : self._count]


def run_rollout(
    dyn: LagrangianDynamics,
    method: str,
    q0: Array,
    v0: Array,
    grid: Grid,
    kept: Indices,
    torque: Torque,
    bar: Progress,
    workers: int | None = None,
) -> SolverResult:
    """Step one state or a batch over the grid; no number depends on `workers`, by default one for each core."""
    single = q0.ndim == 1
    q0, v0 = np.atleast_2d(q0), np.atleast_2d(v0)
    check_room(len(kept) * len(q0), q0.shape[1] + v0.shape[1])
    run = _Run(dyn, method, q0, v0, grid, kept, torque)
    run.all(bar, workers or dyn.threads or cores())
    return run.result(single)


def _plan(dyn: LagrangianDynamics, method: str) -> Plan:
    plans: dict[str, Plan] = dyn.equations.kept.setdefault("rollout", {})
    name = method_of(method).code_name
    if name not in plans:
        plans[name] = Plan(dyn, method)
    return plans[name]


@dataclass(frozen=True)
class _Lost:
    """A state that diverged: steps that were good, and what it was after them."""

    steps: int
    q: Array
    w: Array


class _Run:
    def __init__(
        self, dyn: LagrangianDynamics, method: str, q0: Array, v0: Array, grid: Grid, kept: Indices, torque: Torque
    ) -> None:
        self._dyn, self._method, self._grid, self._kept, self._torque = dyn, method, grid, kept, torque
        self._plan, self._space = _plan(dyn, method), Space(dyn.model)
        self._parameters = dyn.parameter_values
        self._q0, self._w0 = q0, self._space.enter(q0, v0)
        n = len(q0)
        # Written by the threads, so that each of them pays for its own pages.
        self._q, self._v = np.empty((n, len(kept), q0.shape[1])), np.empty((n, len(kept), v0.shape[1]))
        if kept[0] == 0:
            self._q[:, 0], self._v[:, 0] = q0, v0
        self._squares = np.zeros(n)
        self._lost: dict[int, _Lost] = {}

    def all(self, bar: Progress, workers: int) -> None:
        """Run every state, and those that got lost once more."""
        parts = _split(len(self._q0), self._plan.widest, workers)
        # Every block costs some calls: worth it for a state now and then, not for most.
        dense = 2 * len(self._kept) > self._grid.steps

        def new_worker() -> Callable[[slice], Iterator[int]]:
            # The parts differ by one state at most.
            chunk = self._chunk(-(-len(self._q0) // len(parts)), all_kept=dense)
            return lambda members: self._march(chunk, members, dense=dense)

        run_parts(parts, new_worker, workers, self._grid.steps, bar)
        # A NaN is not below anything.
        lost = np.flatnonzero(~(self._squares < BOUND**2))
        for start in range(0, len(lost), self._plan.widest):
            self._look(lost[start : start + self._plan.widest])

    def _chunk(self, most: int, *, all_kept: bool) -> Chunk:
        return Chunk(self._plan, most, torques=self._torque.held, all_kept=all_kept)

    def _blocks(self, chunk: Chunk, members: slice | Indices, ends: Indices) -> Iterator[tuple[int, int]]:
        own = self._parameters[members] if self._parameters.ndim == 2 else self._parameters
        chunk.begin(self._q0[members], self._w0[members], own)
        return blocks(chunk, self._grid, self._torque, members, ends.tolist())

    def _march(self, chunk: Chunk, members: slice, *, dense: bool) -> Iterator[int]:
        kept = self._kept
        for k, end in self._blocks(chunk, members, kept[:0] if dense else kept):
            rows = slice(*np.searchsorted(kept, (k, end), side="right"))
            if rows.start < rows.stop:
                self._keep(members, rows, chunk, kept[rows] - k - 1 if dense else slice(None))
            yield end
        self._squares[members] = chunk.start("squares")[0]

    def _keep(self, members: slice, rows: slice, chunk: Chunk, which: Indices | slice) -> None:
        q, w = (chunk.states(name)[which].transpose(2, 0, 1) for name in ("q", "w"))
        self._q[members, rows] = q
        if self._space.flat:
            self._v[members, rows] = w
            return
        (n, count, nq), nv = q.shape, w.shape[2]
        flat = np.ascontiguousarray(q).reshape(n * count, nq), np.ascontiguousarray(w).reshape(n * count, nv)
        # What a lost state has become is nobody's concern here.
        with np.errstate(over="ignore", invalid="ignore"):
            self._v[members, rows] = self._space.leave(*flat).reshape(n, count, nv)

    def _look(self, members: Indices) -> None:
        chunk = self._chunk(len(members), all_kept=True)
        alive = np.full(len(members), True)
        for k, _ in self._blocks(chunk, members, members[:0]):
            q, w = (np.concatenate([chunk.start(n)[None], chunk.states(n)]) for n in ("q", "w"))
            for j in range(len(q) - 1):
                good = is_bounded(q[j + 1].T) & is_bounded(w[j + 1].T)
                for m in np.flatnonzero(alive & ~good):
                    self._lost[int(members[m])] = _Lost(k + j, q[j, :, m].copy(), w[j, :, m].copy())
                alive &= good
            if not alive.any():
                break

    def result(self, single: bool) -> SolverResult:
        """Return what was kept; NaN where there is nothing."""
        steps = np.full(len(self._q0), self._grid.steps)
        for i, lost in self._lost.items():
            steps[i] = lost.steps
        evaluations = method_of(self._method).stages * (int(steps.sum()) + len(self._lost))
        return grid_result(
            self._grid, self._kept, self._q, self._v, steps, single=single, why=self._reason, evaluations=evaluations
        )

    def _reason(self, i: int) -> str:
        lost, grid, k = self._lost[i], self._grid, self._lost[i].steps
        force = np.asarray(self._torque.columns(np.array([i]), k, k + 1)[0][:, 0])
        state = (lost.q[None], lost.w[None], force[None])
        return divergence_reason(self._dyn.of_samples([i]), self._method, grid.time(k), grid.step(k), *state)


def _split(n: int, widest: int, workers: int) -> list[slice]:
    """Return parts of about equal size, none above `widest`, as many as keep every worker busy."""
    if not n:
        return []
    rounds = -(-n // (widest * workers))
    # A core's vectors hold eight states: fewer are no work to share out.
    parts = max(1, min(rounds * workers, n // 8))
    ends = [n * i // parts for i in range(parts + 1)]
    return [slice(a, b) for a, b in pairwise(ends)]
