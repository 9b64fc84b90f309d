"""Many steps of the implicit midpoint rule for states side by side, in machine code; loads LLVM."""

from __future__ import annotations

from itertools import pairwise
from math import isqrt
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.codegen.compiled import Call, KernelSequence
from mbkit.derivation.steps.midpoint import GUESS, MOST, Midpoint
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.simulate.solvers.compiled_fixed_step import CACHE, BlockLoop, padded

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

    def __init__(self, dyn: LagrangianDynamics, count: int, steps: int, *, torques: bool) -> None:
        midpoint, nq, nv = Midpoint(dyn.equations), dyn.model.nq, dyn.model.nv
        self._newton, self._end = midpoint.newton, midpoint.end
        self._codes = {part.name: dyn.code(part.name, make=part.make) for part in (self._newton, self._end)}
        most = min(CACHE // (8 * padded(count) * (nq + 3 * nv + 1)), _LONGEST, isqrt(steps))
        n, back = max(most, _SHORTEST), len(GUESS) - 1
        self._longest, self.block = n, _FIRST
        # The time is one of the parameters, and another in each step.
        names, clock = list(dyn.model.parameters), dyn.model.time_parameter
        self._clock = None if clock is None else names.index(clock)
        # The velocity of each step behind those of the last ones before the block.
        sizes = {"q": (n + 1, nq), "pi": (n + 1, nv), "misses": (n + 1, 1), "tau": (n if torques else 1, nv)}
        sizes |= {"w": (n + back, nv), "guess": (2, nv), "trial": (2, nv), "miss": (1, 1), "dt": (1, 1)}
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
        # The block's first guess stays where it is, so that the block can be made again.
        tries = [at("guess", min(j, 1)), *(at("trial", i) for i in range(iterations - 1)), at("w", j + self._back)]
        calls = []
        for w, w1 in pairwise(tries):
            given = {**held, "w": w}
            calls.append(self._call(self._newton.name, self._newton.reads, given, [w1, held["miss"]]))
        past = {name: at("w", j + self._back - i) for i, name in enumerate(("w", "w_1", "w_2"))}
        outs = [new[name] for name in self._end.writes]
        return [*calls, self._call(self._end.name, self._end.reads, {**held, **past}, outs)]

    def _call(self, name: str, reads: tuple[str, ...], given: dict[str, Array], outs: list[Array]) -> Call:
        return Call(self._codes[name], [given[n] for n in reads], outs)

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
