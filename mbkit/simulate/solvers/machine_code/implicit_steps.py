"""Implicit fixed steps with torques held over each of them, compiled: many steps for states side by side."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import isqrt
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit._child_process import cores
from mbkit.codegen.compiled import KernelSequence
from mbkit.codegen.interpreter import Machine
from mbkit.derivation.steps.collocation import Collocation
from mbkit.derivation.steps.fixed import Part
from mbkit.derivation.steps.midpoint import MAX_NEWTON_ITERATIONS
from mbkit.engines.base import at_time
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.methods.tableaus import ImplicitTableau
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.fixed_step import run_fixed, to_body_velocity
from mbkit.simulate.solvers.machine_code.blocks import CACHE, SHORTEST, BlockLoop, padded, run_members
from mbkit.simulate.solvers.trajectory_record import GridRecord
from mbkit.simulate.time_grid import Indices

#: Number of multiplications of an implicit step's system beyond which compiling it takes longer than tens of thousands
#: of steps in Python.
_MAX_MULTIPLICATIONS: Final = 10_000
#: Most states that go side by side: enough for the processor's vectors, and nine
#: cache lines in a row of them, because an even number would meet in the same sets.
WIDEST: Final = 72
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
) -> tuple[GridRecord, int, dict[int, list[Array]]]:
    """Run every trajectory, some side by side, and such chunks at once on several cores.

    `other` is what goes with q, (n, nv), and `guess` the first unknown; velocity(t, q, other, members) is mbkit's.
    Returns also Newton's iterations, and the last state of each trajectory that was lost, by its index. The record
    holds `other` in the place of v.
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

    run_members(
        *(problem, record, np.arange(len(other)), WIDEST, workers, lambda _: begin, velocity),
        after_block=lambda _chunk, _members, _k, last: lost.update(last),
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
