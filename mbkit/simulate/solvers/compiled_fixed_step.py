"""Fixed steps with torques held over each of them, compiled, on all cores.

The formulas are those of `mbkit.simulate.solvers.fixed_step`. A chunk of states runs to its end
without looking back; whether a state got lost on the way is told by the sum of
squares that each carries along, and only then is its run repeated, with a look at
every step.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
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
from mbkit.simulate.solvers.fixed_step import reason
from mbkit.simulate.solvers.runge_kutta import BOUND, is_bounded
from mbkit.simulate.time_grid import Grid, Indices, check_room
from mbkit.simulate.torque import Torque

__all__ = ["BLOCK", "Chunk", "Plan", "run_rollout"]


# Many steps of many states at once, by a compiled step on coordinate-major arrays.

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


class Plan:
    """A method's step for one model, in machine code.

    Parameters
    ----------
    dyn : LagrangianDynamics
    method : {"rk4", "semi_implicit_euler"}

    Attributes
    ----------
    parts : tuple of Part
        What is run for a step, in this order.
    codes : tuple of Compiled
        The parts' machine code.
    sizes : dict of str to int
        Rows of each array that the parts read or write.
    """

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
        return min(max(_padded(_CACHE // (8 * sum(self.sizes.values()))), 9 * _LANES), _MOST)


def _padded(count: int) -> int:
    # An odd number of cache lines, so that no two rows fall on the same ones of a
    # cache that is split by powers of two: 20 % of the time at 1024 states.
    return -(-count // _LANES) * _LANES | _LANES


class Chunk:
    """Room for states side by side, one in each column, on their way through a run.

    Columns beyond the states repeat the last one.

    Parameters
    ----------
    plan : Plan
    most : int
        States that it has room for.
    torques : bool
        Whether each step of a block has a torque of its own.
    all_kept : bool
        Whether all states of a block can be read after it, or the last one alone.
    """

    def __init__(self, plan: Plan, most: int, *, torques: bool, all_kept: bool) -> None:
        width = _padded(most)
        self._places = BLOCK + 1 if all_kept else 2
        self._torques = BLOCK if torques else 1
        rooms = {**dict.fromkeys(_STATE.values(), self._places), "tau": self._torques}
        read = {name: size for name, size in plan.sizes.items() if name not in _STATE}
        self._held = {name: _room(rooms.get(name, 1), size, width) for name, size in read.items()}
        self._calls = len(plan.parts)
        period = BLOCK if all_kept or torques else 2
        steps = [call for j in range(period) for call in self._step(plan, j)]
        self._sequence = KernelSequence(steps, BLOCK // period)
        self._count = self._taken = 0

    def begin(self, q: Array, w: Array, parameters: Array) -> None:
        """Put states in.

        Parameters
        ----------
        q, w : (n, nq) and (n, nv) arrays
            In the integrators' own velocity.
        parameters : (p,) or (n, p) array
            Values of the model's named parameters.
        """
        self._count = len(q)
        self._fill("q", 0, q.T)
        self._fill("w", 0, w.T)
        self._held["squares"][0] = 0.0
        if parameters.size:
            self._fill("parameters", 0, np.atleast_2d(parameters).T)

    def _step(self, plan: Plan, j: int) -> list[Call]:
        def array(name: str) -> Array:
            held = self._held[_STATE.get(name, name)]
            return np.asarray(held[(j + (name in _STATE)) % len(held)].T)

        return [
            Call(code, [array(n) for n in part.reads], [array(n) for n in part.writes])
            for part, code in zip(plan.parts, plan.codes, strict=True)
        ]

    def _fill(self, name: str, place: int, columns: Array) -> None:
        held = self._held[name][place]
        held[:, : self._count] = columns
        held[:, self._count :] = held[:, self._count - 1 : self._count]

    def advance(self, steps: int, dt: float, torques: Array) -> None:
        """Take some steps, at most `BLOCK`, from where the last ones ended.

        Parameters
        ----------
        steps : int
        dt : float
        torques : (steps or 1, nv, n or 1) array
        """
        self._held["dt"][:] = dt
        for j in range(min(steps, self._torques)):
            self._fill("tau", j, torques[j])
        self._sequence.run(0, steps * self._calls)
        self._taken = steps

    def again(self) -> None:
        """Make the last state the first one of the next block."""
        for name in _STATE.values():
            held = self._held[name]
            held[0] = held[self._taken % len(held)]

    def states(self, name: str) -> Array:
        """Return q, w or squares after each step of the block, or after its last one: (steps or 1, rows, n)."""
        held = self._held[name]
        first = self._taken % len(held)
        places = held[1 : self._taken + 1] if self._places > 2 else held[first : first + 1]
        return places[:, :, : self._count]

    def start(self, name: str) -> Array:
        """Return q, w or squares before the block, (rows, n)."""
        return self._held[name][0, :, : self._count]


def _room(places: int, rows: int, width: int) -> Array:
    out = aligned(places * rows * width).reshape(places, rows, width)
    out[:] = 0.0
    return out


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
    """Step one state or a batch over the grid.

    Parameters
    ----------
    workers : int, optional
        Threads; as many as there are cores when not given. No number depends on it.
    """
    single = q0.ndim == 1
    q0, v0 = np.atleast_2d(q0), np.atleast_2d(v0)
    check_room(len(kept) * len(q0), q0.shape[1] + v0.shape[1])
    run = _Run(dyn, method, q0, v0, grid, kept, torque)
    run.all(bar, workers or dyn.threads or cores())
    return run.outcome(single)


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
        self._done: list[int] = []
        self._stop = threading.Event()

    def all(self, bar: Progress, workers: int) -> None:
        """Run every state, and those that got lost once more."""
        parts = _split(len(self._q0), self._plan.widest, workers)
        self._done, self._left = [0] * len(parts), iter(list(enumerate(parts)))
        total = max(len(parts) * self._grid.steps, 1)
        workers = min(workers, len(parts))
        if workers > 1:
            with ThreadPoolExecutor(workers) as pool:
                waiting: set[Future[None]] = {pool.submit(self._work, lambda: None) for _ in range(workers)}
                try:
                    while waiting:
                        done, waiting = wait(waiting, timeout=0.1, return_when=FIRST_EXCEPTION)
                        for future in done:
                            future.result()
                        bar.update(sum(self._done) / total)
                finally:
                    self._stop.set()
        elif parts:
            self._work(lambda: bar.update(sum(self._done) / total))
        # A NaN is not below anything.
        lost = np.flatnonzero(~(self._squares < BOUND**2))
        for start in range(0, len(lost), self._plan.widest):
            self._look(lost[start : start + self._plan.widest])

    def _work(self, tell: Callable[[], None]) -> None:
        # Every block costs some calls: worth it for a state now and then, not for most.
        dense = 2 * len(self._kept) > self._grid.steps
        # The parts differ by one state at most.
        chunk = self._chunk(-(-len(self._q0) // len(self._done)), all_kept=dense)
        # A list's iterator hands each part to one thread.
        for i, members in self._left:
            for end in self._march(chunk, members, dense=dense):
                self._done[i] = end
                tell()
                if self._stop.is_set():
                    return

    def _chunk(self, most: int, *, all_kept: bool) -> Chunk:
        return Chunk(self._plan, most, torques=self._torque.held, all_kept=all_kept)

    def _blocks(self, chunk: Chunk, members: slice | Indices, ends: Indices) -> Iterator[tuple[int, int]]:
        """Take members of the batch through the run in blocks that stop at `ends` too.

        Yields the number of steps before and after each block.
        """
        grid, k, torques = self._grid, 0, np.empty(0)
        own = self._parameters[members] if self._parameters.ndim == 2 else self._parameters
        chunk.begin(self._q0[members], self._w0[members], own)
        # The last step may have a length of its own.
        stops = {int(i) for i in ends} | {grid.steps - 1 if grid.last != grid.dt else grid.steps, grid.steps}
        for stop in sorted(stops):
            while k < stop:
                n = min(BLOCK, stop - k)
                if self._torque.held or not torques.size:
                    torques = self._torque.columns(members, k, k + n)
                chunk.advance(n, grid.step(k), torques)
                yield k, k + n
                chunk.again()
                k += n

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

    def outcome(self, single: bool) -> SolverResult:
        """Return what was kept; NaN where there is nothing."""
        n, grid, kept = len(self._q0), self._grid, self._kept
        steps = np.full(n, grid.steps)
        for i, lost in self._lost.items():
            steps[i] = lost.steps
            self._q[i, kept > lost.steps], self._v[i, kept > lost.steps] = np.nan, np.nan
        message = self._message(single)
        rows = int(np.count_nonzero(kept <= steps.max())) if n else len(kept)
        times = np.array([grid.time(int(k)) for k in steps])
        q, v = (x if rows == len(kept) else x[:, :rows].copy() for x in (self._q, self._v))
        # Handed on as they are, however large, and not copied for fear of a later change.
        q.setflags(write=False)
        v.setflags(write=False)
        return SolverResult(
            t=np.array([grid.time(int(k)) for k in kept[:rows]]),
            q=q[0] if single else q,
            v=v[0] if single else v,
            steps=int(steps.sum()),
            evaluations=method_of(self._method).stages * (int(steps.sum()) + len(self._lost)),
            ended="diverged" if message else "finished",
            reached=np.asarray(times[0] if single else times),
            message=message,
        )

    def _message(self, single: bool) -> str:
        if not self._lost:
            return ""
        i, lost = min(self._lost.items(), key=lambda item: item[1].steps)
        grid, k = self._grid, lost.steps
        force = np.asarray(self._torque.columns(np.array([i]), k, k + 1)[0][:, 0])
        state = (lost.q[None], lost.w[None], force[None])
        why = reason(self._dyn.of_samples([i]), self._method, grid.time(k), grid.step(k), *state)
        message = f"diverged after t = {grid.time(k):.6g} s (step {k + 1}): {why}; dt = {grid.dt:g} s may be too long"
        if not single:
            message += f"; {len(self._lost)} of {len(self._q0)} trajectories diverged, see reached"
        return message


def _split(n: int, widest: int, workers: int) -> list[slice]:
    """Return parts of about equal size, none above `widest`, as many as keep every worker busy."""
    if not n:
        return []
    rounds = -(-n // (widest * workers))
    # A core's vectors hold eight states: fewer are no work to share out.
    parts = max(1, min(rounds * workers, n // 8))
    ends = [n * i // parts for i in range(parts + 1)]
    return [slice(a, b) for a, b in pairwise(ends)]
