"""Fixed steps in NumPy, on any engine and under any torque."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import FunctionError
from mbkit.methods.one_step import ArrayStages, SemiImplicitEuler
from mbkit.methods.registry import method_of
from mbkit.methods.tableaus import ImplicitTableau, Tableau
from mbkit.model.integration_space import Space
from mbkit.simulate.progress import Progress
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.gauss import CollocationStep
from mbkit.simulate.solvers.trajectory_record import grid_result
from mbkit.simulate.solvers.vector_field import BOUND, DIVERGED, DivergenceError, Field, is_bounded
from mbkit.simulate.time_grid import Grid, Indices, check_room
from mbkit.simulate.torque import Force, Torque

#: step(t, h, q, w, force) -> (q, w) at t + h; one state or a batch
Step = Callable[[float, float, Array, Array, Force], tuple[Array, Array]]

_GOOD: Final = np.array(True)


def run_fixed(
    dyn: Dynamics,
    method: str,
    q0: Array,
    v0: Array,
    grid: Grid,
    kept: Indices,
    torque: Torque,
    bar: Progress,
) -> SolverResult:
    """Step one state or a batch over the grid.

    A trajectory that diverges stops there; the others of its batch go on. A torque
    function that fails stops all of them, with what they have.
    """
    space = Space(dyn.model)
    field = Field(dyn, space)
    run = _Run(make_step(method, field, space), field, torque, space, q0, v0, grid, kept)
    error: FunctionError | None = None
    # An overflow is a divergence, and reported as one.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for k in range(grid.steps):
            try:
                if not run.advance(k):
                    break
            except FunctionError as caught:
                error = caught
                break
            bar.update((k + 1) / grid.steps)
    return grid_result(
        grid,
        kept,
        run.q_kept,
        run.v_kept,
        run.steps,
        single=q0.ndim == 1,
        why=lambda _: run.why,
        evaluations=field.evaluations,
        error=error,
    )


class _Run:
    """The current states, those kept so far (n, K, ...), good steps of each (n,), and why the first one diverged."""

    def __init__(
        self, step: Step, field: Field, torque: Torque, space: Space, q0: Array, v0: Array, grid: Grid, kept: Indices
    ) -> None:
        self._field = field
        self._step, self._torque, self._space, self._grid, self._kept = step, torque, space, grid, kept
        n = 1 if q0.ndim == 1 else len(q0)
        check_room(len(kept) * n, q0.shape[-1] + v0.shape[-1])
        self.q_kept, self.v_kept = (np.full((n, len(kept), x.shape[-1]), np.nan) for x in (q0, v0))
        self.steps, self.why = np.zeros(n, dtype=np.intp), ""
        # Those of a batch that are still good.
        self._members: Indices | None = None if q0.ndim == 1 else np.arange(n)
        self._row = 0
        self._q, self._w = q0.copy(), space.enter(q0, v0)
        if kept[0] == 0:
            self._keep(q0, v0)

    def advance(self, k: int) -> bool:
        """Take step k; return whether any trajectory goes on."""
        t, h = self._grid.time(k), self._grid.step(k)
        why = DIVERGED
        try:
            q, w = self._step(t, h, self._q, self._w, self._torque.during(k, self._members))
            good = _bounded(q, w)
        except DivergenceError as error:
            q, w, good = self._one_by_one(t, h, k)
            why = str(error)
        if good is not _GOOD and not good.all():
            self.why = self.why or why
            if self._members is None:
                return False
            self._members, q, w = self._members[good], q[good], w[good]
            if not len(self._members):
                return False
            self._field.only(self._members)
        self._q, self._w = self._field.settled(self._grid.time(k + 1), q, w)
        self.steps[... if self._members is None else self._members] = k + 1
        if self._row < len(self._kept) and k + 1 == self._kept[self._row]:
            self._keep(self._q, self._space.leave(self._q, self._w))
        return True

    def _one_by_one(self, t: float, h: float, k: int) -> tuple[Array, Array, NDArray[np.bool_]]:
        # One divergence must not stop the others of a batch: each steps by itself.
        q, w = np.full(self._q.shape, np.nan), np.full(self._w.shape, np.nan)
        if self._members is None:
            return q, w, np.array(False)
        good = np.zeros(len(q), dtype=bool)
        for i in range(len(q)):
            one = slice(i, i + 1)
            force = self._torque.during(k, self._members[one])
            self._field.only(self._members[one])
            try:
                q[one], w[one] = self._step(t, h, self._q[one], self._w[one], force)
            except DivergenceError:
                continue
            good[i] = is_bounded(q[i]) and is_bounded(w[i])
        self._field.only(self._members)
        return q, w, good

    def _keep(self, q: Array, v: Array) -> None:
        which = slice(None) if self._members is None else self._members
        self.q_kept[which, self._row], self.v_kept[which, self._row] = q, v
        self._row += 1


def _bounded(q: Array, w: Array) -> NDArray[np.bool_]:
    """Return which states are bounded; for one state the squares usually tell, and are quicker."""
    if q.ndim == 1 and q @ q + w @ w < BOUND**2:
        return _GOOD
    return np.asarray(is_bounded(q) & is_bounded(w))


def divergence_reason(dyn: Dynamics, method: str, t: float, h: float, q: Array, w: Array, force: Array) -> str:
    """Return why the step from a batch of one state diverges, in the engine's words if it has some."""
    space = Space(dyn.model)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        try:
            make_step(method, Field(dyn, space), space)(t, h, q, w, force)
        except DivergenceError as error:
            return str(error)
    return DIVERGED


def make_step(method: str, field: Field, space: Space) -> Step:
    """Return the step of a fixed-step method."""
    formula = method_of(method).formula
    if isinstance(formula, ImplicitTableau):
        return CollocationStep(formula, field, space)
    assert isinstance(formula, (Tableau, SemiImplicitEuler))
    return _explicit_step(formula, field, space)


def _explicit_step(formula: Tableau | SemiImplicitEuler, field: Field, space: Space) -> Step:
    """Return the step of a method with an explicit formula."""
    stages: ArrayStages | None = None

    def step(t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:
        def rates(t: float, q: Array, u: Array | None, w: Array) -> tuple[Array, Array]:
            return w if u is None else space.rate(u, w), field.consistent(t, q, w, force)

        nonlocal stages
        if stages is None or stages.shape != w.shape:
            stages = ArrayStages(formula.stages, w.shape)
        stages.keep(0)
        q, w, _ = formula.step(space, rates, stages, t, h, q, w)
        return q, w

    return step
