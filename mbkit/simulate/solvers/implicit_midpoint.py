"""Runs of the implicit midpoint rule in (q, p), on `mbkit.derivation.steps.midpoint`'s parts.

The state from step to step is (q, π); velocities follow from it where they are kept. Without a torque function, steps
run as machine code, on all cores. A torque function is evaluated at the midpoint in each iteration, which then
converges linearly, at the rate of the step times the torque's derivative.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.codegen.interpreter import Machine
from mbkit.derivation.steps.fixed import Part
from mbkit.derivation.steps.midpoint import GUESS, LEAST, MOST, SMALL, Midpoint
from mbkit.engines import Dynamics
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import FunctionError, UnsupportedError
from mbkit.methods.registry import IMPLICIT_METHODS
from mbkit.model.integration_space import Space
from mbkit.simulate.constraint_projection import refuse_constraints
from mbkit.simulate.progress import Progress
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.trajectory_record import grid_result
from mbkit.simulate.solvers.vector_field import BOUND, DIVERGED
from mbkit.simulate.time_grid import Grid, Indices, check_room
from mbkit.simulate.torque import Torque

# With a torque function the iteration converges linearly.
_WITH_FUNCTION: Final = 60
_EPS: Final = float(np.finfo(float).eps)


def called(
    dyn: LagrangianDynamics, part: Part, members: slice | Indices, t: Array | float, *arguments: Array
) -> list[Array]:
    """Return a part's results for members of a batch: vectors as (n, rows), matrices as (n, rows, columns).

    `t`, one for all or (n,), is the time of evaluation, where the dynamics depends on it.
    """
    n = len(arguments[0])
    given = [np.broadcast_to(x, (n, x.shape[-1])) for x in arguments]
    if dyn.model.parameters:
        values = dyn.parameter_values
        own = values[members] if values.ndim == 2 else np.broadcast_to(values, (n, len(values)))
        if dyn.model.time_parameter is not None:
            own = own.copy()
            own[:, list(dyn.model.parameters).index(dyn.model.time_parameter)] = t
        given.append(own)
    results = dyn.code(part.name, make=part.make)(*given, threads=dyn.threads)
    return [
        x[..., 0] if x.shape[-1] == 1 and name not in ("M", "jacobian") else x
        for name, x in zip(part.writes, results, strict=True)
    ]


class MidpointSolver:
    """Newton's iteration for trajectories side by side, one step at a time; `iterations` are of all together."""

    def __init__(self, dyn: LagrangianDynamics, torque: Torque, *, single: bool) -> None:
        self._dyn, self._torque, self._single = dyn, torque, single
        self._midpoint, self._space = Midpoint(dyn.equations), Space(dyn.model)
        self.iterations = 0

    def velocity(
        self, members: Indices, k: int, t: float, h: float, q: Array, pi: Array, guess: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return the velocity of step k, the torque that acted, and whether the step is solved, per trajectory.

        With a torque function it goes on until corrections stop shrinking.
        """
        w, good = guess.copy(), np.full(len(q), False)
        tau = np.empty(w.shape)
        if not self._torque.callable:
            tau[:] = self._torque.columns(members, k, k + 1)[0].T
        last, todo = np.full(len(q), np.inf), np.arange(len(q))
        for _ in range(_WITH_FUNCTION if self._torque.callable else MOST):
            # A user's function never sees a state that is none.
            todo = todo[np.isfinite(w[todo]).all(axis=1) & ~good[todo]]
            if not len(todo):
                break
            if self._torque.callable:
                tau[todo] = self._function(members[todo], k, t, h, q[todo], w[todo])
            w1, solved = self._newton(members[todo], t + h / 2, q[todo], pi[todo], w[todo], tau[todo], h)
            change = np.abs(w1 - w[todo]).max(axis=1, initial=0.0)
            if self._torque.callable:
                solved &= (change <= 4 * _EPS * np.abs(w1).max(axis=1, initial=0.0)) | (change >= last[todo] / 2)
            w[todo], good[todo], last[todo] = w1, solved, change
        return w, tau, good

    def _function(self, members: Indices, k: int, t: float, h: float, q: Array, w: Array) -> Array:
        force = self._torque.during(k, None if self._single else members)
        assert callable(force)
        q_m = self._space.move(q, (h / 2) * w)
        state = q_m, self._space.leave(q_m, w)
        if self._single:
            return np.asarray(force(t + h / 2, *(x[0] for x in state)))[None]
        return force(t + h / 2, *state)

    def _newton(
        self, members: Indices, t: float, q: Array, pi: Array, w: Array, tau: Array, h: float
    ) -> tuple[Array, NDArray[np.bool_]]:
        self.iterations += len(q)
        given = (q, pi, w, tau, np.array([[h]]))
        if self._dyn.written_out:
            w1, miss = called(self._dyn, self._midpoint.newton, members, t, *given)
            return w1, miss[:, 0] == 0
        residual, jacobian = called(self._dyn, self._midpoint.system, members, t, *given)
        change = _solved(jacobian, residual)
        w1 = w - change
        limit = SMALL**2 * np.sum(w1**2, axis=1) + (LEAST / h) ** 2 * (1 + np.sum(q**2, axis=1))
        return w1, np.sum(change**2, axis=1) < limit

    def end(
        self, members: Indices, t: float, h: float, q: Array, pi: Array, ws: list[Array], tau: Array
    ) -> tuple[Array, Array, Array]:
        """Return q and π after the step, and the first guess of the next velocity, from those of the last steps."""
        zero = np.zeros((1, 1))
        outs = called(self._dyn, self._midpoint.end, members, t + h / 2, q, pi, *ws, tau, np.array([[h]]), zero, zero)
        return outs[0], outs[1], outs[2]


def _solved(A: Array, b: Array) -> Array:
    try:
        return np.asarray(np.linalg.solve(A, b[..., None])[..., 0])
    except np.linalg.LinAlgError:
        # One singular matrix must not stop the others of a batch.
        out = np.full(b.shape, np.nan)
        for i in range(len(b)):
            try:
                out[i] = np.linalg.solve(A[i], b[i])
            except np.linalg.LinAlgError:
                continue
        return out


_UNSOLVED: Final = "Newton's iteration does not solve the step's equations"
# Numbers that are turned from momenta into velocities at a time.
_SLICE: Final = 2**16


def run_midpoint(
    dyn: Dynamics,
    method: str,
    q0: Array,
    v0: Array,
    grid: Grid,
    kept: Indices,
    torque: Torque,
    bar: Progress,
) -> SolverResult:
    """Step one state or a batch over the grid; a trajectory that diverges stops there, and the others go on."""
    if not isinstance(dyn, LagrangianDynamics):
        raise UnsupportedError(
            f"{method}: {dyn.engine} gives neither momenta nor ∂T/∂q, which the midpoint rule in (q, p) is made of; "
            f"mbkit.dynamics(model, 'lagrangian') has them; {IMPLICIT_METHODS} run on any engine"
        )
    refuse_constraints(dyn, method, "which its step in (q, p) does not know")
    single = q0.ndim == 1
    q0, v0 = np.atleast_2d(q0), np.atleast_2d(v0)
    check_room(len(kept) * len(q0), q0.shape[1] + v0.shape[1])
    run = _Run(dyn, q0, v0, grid, kept, torque)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        if _machine_code(dyn, torque):
            run.in_chunks(bar)
        else:
            run.step_by_step(bar, single=single)
        return run.result(single)


def _machine_code(dyn: LagrangianDynamics, torque: Torque) -> bool:
    if torque.callable or not dyn.model.nv or not dyn.compile or not dyn.written_out:
        return False
    midpoint = Midpoint(dyn.equations)
    return not any(isinstance(dyn.code(p.name, make=p.make), Machine) for p in (midpoint.newton, midpoint.end))


class _Run:
    """Kept states of all trajectories: momenta at first, velocities in the end."""

    def __init__(
        self, dyn: LagrangianDynamics, q0: Array, v0: Array, grid: Grid, kept: Indices, torque: Torque
    ) -> None:
        self._dyn, self._grid, self._kept, self._torque = dyn, grid, kept, torque
        self._midpoint = Midpoint(dyn.equations)
        self._q0, self._v0, self._w0 = q0, v0, Space(dyn.model).enter(q0, v0)
        n, rows = len(q0), len(kept)
        (self._pi0,) = called(self._dyn, self._midpoint.momentum, slice(None), grid.start, q0, v0)
        self._q, self._v = np.full((n, rows, q0.shape[1]), np.nan), np.full((n, rows, v0.shape[1]), np.nan)
        self._steps = np.zeros(n, dtype=np.intp)
        self._last = np.zeros(n)
        # Threads append to it.
        self._iterations: list[int] = []
        self._error: FunctionError | None = None

    def _rows(self, first: int, last: int) -> slice:
        """Return the rows of what is kept of the states from the first to the last."""
        return slice(*np.searchsorted(self._kept, (first, last + 1), side="left"))

    # In machine code

    def in_chunks(self, bar: Progress) -> None:
        """Run every trajectory, some side by side, and such chunks at once on several cores."""
        # These load LLVM, which interpreting never needs.
        from mbkit.codegen.compiled import cores
        from mbkit.simulate.solvers.compiled_fixed_step import blocks, run_parts
        from mbkit.simulate.solvers.implicit_midpoint_compiled import WIDEST, MidpointChunk

        n, grid = len(self._q0), self._grid
        count = -(-n // WIDEST)
        ends = [n * i // max(count, 1) for i in range(count + 1)]

        def run(members: slice) -> Iterator[int]:
            chunk = MidpointChunk(self._dyn, members.stop - members.start, grid.steps, torques=self._torque.held)
            own = values[members] if values.ndim == 2 else values
            chunk.begin(self._q0[members], self._pi0[members], self._w0[members], own)
            alive = np.full(members.stop - members.start, True)
            for k, end in blocks(chunk, grid, self._torque, members):
                good, block = chunk.good, end - k
                if (rows := self._rows(k + 1, end)).start < rows.stop:
                    at = self._kept[rows] - k
                    self._q[members, rows], self._v[members, rows] = chunk.states("q", at), chunk.states("pi", at)
                self._steps[members][alive] = k + good[alive]
                for m in np.flatnonzero(alive & (good < block)):
                    last = [chunk.states(name, good[m : m + 1])[m] for name in ("q", "pi")]
                    self._last[members.start + m] = max(np.abs(x).max() for x in last)
                alive &= good == block
                yield end
                if not alive.any():
                    break
            self._iterations.append(chunk.iterations)

        values = self._dyn.parameter_values
        parts = [slice(a, b) for a, b in pairwise(ends)]
        run_parts(parts, lambda: run, self._dyn.threads or cores(), grid.steps, bar)

    # In Python

    def step_by_step(self, bar: Progress, *, single: bool) -> None:
        """Run all trajectories side by side, with a look at every step."""
        grid = self._grid
        members: Indices = np.arange(len(self._q0))
        solver = MidpointSolver(self._dyn, self._torque, single=single)
        q, pi, ws, guess = self._q0, self._pi0, [self._w0] * len(GUESS), self._w0
        try:
            for k in range(grid.steps):
                w, tau, good = solver.velocity(members, k, grid.time(k), grid.step(k), q, pi, guess)
                ws = [w, *ws[:-1]]
                q1, pi1, guess = solver.end(members, grid.time(k), grid.step(k), q, pi, ws, tau)
                good &= (np.abs(q1) < BOUND).all(axis=1) & (np.abs(pi1) < BOUND).all(axis=1)
                if not good.all():
                    self._last[members[~good]] = np.maximum(np.abs(q).max(axis=1), np.abs(pi).max(axis=1))[~good]
                    members, q1, pi1, guess = members[good], q1[good], pi1[good], guess[good]
                    ws = [w[good] for w in ws]
                    if not len(members):
                        break
                q, pi = q1, pi1
                self._steps[members] = k + 1
                if (rows := self._rows(k + 1, k + 1)).start < rows.stop:
                    self._q[members, rows.start], self._v[members, rows.start] = q, pi
                bar.update((k + 1) / grid.steps)
        except FunctionError as error:
            self._error = error
        self._iterations.append(solver.iterations)

    # In the end

    def result(self, single: bool) -> SolverResult:
        """Return what was kept, with velocities."""
        for i in np.flatnonzero(self._steps < self._grid.steps):
            self._v[i, self._kept > self._steps[i]] = np.nan
        self._to_velocities()
        if self._kept[0] == 0:
            self._q[:, 0], self._v[:, 0] = self._q0, self._v0
        iterations = sum(self._iterations)
        return grid_result(
            self._grid,
            self._kept,
            self._q,
            self._v,
            self._steps,
            single=single,
            # An overflow in the middle of a step leaves no number for the iteration either.
            why=lambda i: DIVERGED if self._last[i] > BOUND**0.5 else _UNSOLVED,
            # Each iteration is one, and so is the end of each step.
            evaluations=iterations + int(self._steps.sum()),
            jacobians=iterations,
            error=self._error,
        )

    def _to_velocities(self) -> None:
        n, rows, nv = self._v.shape
        times = np.array([self._grid.time(int(k)) for k in self._kept])
        size = max(_SLICE // max(n * (nv or 1), 1), 1)
        for start in range(0, rows, size):
            q, v = (x[:, start : start + size] for x in (self._q, self._v))
            good = np.isfinite(v).all(axis=2)
            who, at = np.nonzero(good)
            if len(who):
                v[who, at] = self._velocities(who, times[start + at], q[who, at], v[who, at])

    def _velocities(self, members: Indices, t: Array, q: Array, pi: Array) -> Array:
        if self._dyn.written_out:
            return called(self._dyn, self._midpoint.velocity, members, t, q, pi)[0]
        M, p = called(self._dyn, self._midpoint.velocity_system, members, t, q, pi)
        return np.asarray(np.linalg.solve(M, p[..., None])[..., 0])
