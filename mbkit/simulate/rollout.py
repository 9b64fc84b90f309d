"""Fixed steps with torques held over each of them, compiled, on all cores.

The formulas are those of `mbkit.simulate.fixed`. A chunk of states runs to its end
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

import numpy as np

from mbkit._check import Array
from mbkit.derivation.compiled import cores
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.model.space import Space
from mbkit.simulate.grid import Grid, Indices, check_room
from mbkit.simulate.marching import BLOCK, Chunk, Plan
from mbkit.simulate.methods import METHODS
from mbkit.simulate.outcome import Outcome
from mbkit.simulate.progress import Progress
from mbkit.simulate.steps import RUNAWAY, credible, reason
from mbkit.simulate.torque import Torque

__all__ = ["run_rollout"]


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
) -> Outcome:
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
    if method not in plans:
        plans[method] = Plan(dyn, method)
    return plans[method]


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
        lost = np.flatnonzero(~(self._squares < RUNAWAY**2))
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
                good = credible(q[j + 1].T) & credible(w[j + 1].T)
                for m in np.flatnonzero(alive & ~good):
                    self._lost[int(members[m])] = _Lost(k + j, q[j, :, m].copy(), w[j, :, m].copy())
                alive &= good
            if not alive.any():
                break

    def outcome(self, single: bool) -> Outcome:
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
        return Outcome(
            t=np.array([grid.time(int(k)) for k in kept[:rows]]),
            q=q[0] if single else q,
            v=v[0] if single else v,
            steps=int(steps.sum()),
            evaluations=METHODS[self._method].stages * (int(steps.sum()) + len(self._lost)),
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
