"""The loop of the fixed-step methods: keep what is wanted, stop what diverges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import FunctionError
from mbkit.methods.one_step import SemiImplicitEuler
from mbkit.methods.registry import method_of
from mbkit.methods.tableaus import ImplicitTableau, Tableau
from mbkit.model.integration_space import Space
from mbkit.simulate.progress import Progress
from mbkit.simulate.result import Ended, SolverResult
from mbkit.simulate.solvers.gauss import CollocationStep
from mbkit.simulate.solvers.runge_kutta import (
    DIVERGED,
    DivergenceError,
    Field,
    Step,
    explicit_step,
    is_bounded,
)
from mbkit.simulate.time_grid import Grid, Indices, check_room
from mbkit.simulate.torque import Torque

__all__ = ["make_step", "reason", "run_fixed"]


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
    # What overflows is a divergence, and told as one.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for k in range(grid.steps):
            try:
                if not run.advance(k):
                    break
            except FunctionError as error:
                run.failed(k, error)
                break
            bar.update((k + 1) / grid.steps)
    return run.outcome(field.evaluations)


class _Run:
    """The states on their way; `members` are those of a batch that are still good."""

    def __init__(
        self, step: Step, field: Field, torque: Torque, space: Space, q0: Array, v0: Array, grid: Grid, kept: Indices
    ) -> None:
        self._field = field
        self._step, self._torque, self._space, self._grid, self._kept = step, torque, space, grid, kept
        lead = q0.shape[:-1]
        check_room(len(kept) * (lead[0] if lead else 1), q0.shape[-1] + v0.shape[-1])
        self._q_kept = np.full((*lead, len(kept), q0.shape[-1]), np.nan)
        self._v_kept = np.full((*lead, len(kept), v0.shape[-1]), np.nan)
        self._row, self._next = 0, int(kept[0])
        self._members: Indices | None = np.arange(lead[0]) if lead else None
        self._reached = np.full(lead, grid.end)
        self._message = ""
        self._error: FunctionError | None = None
        self._steps = 0
        self._q, self._w = q0.copy(), space.enter(q0, v0)
        if self._next == 0:
            self._keep(q0, v0)

    def advance(self, k: int) -> bool:
        """Take step k; return whether anything is left to go on with."""
        t, h = self._grid.time(k), self._grid.step(k)
        why = DIVERGED
        try:
            q, w = self._step(t, h, self._q, self._w, self._torque.during(k, self._members))
            good = np.asarray(is_bounded(q) & is_bounded(w))
        except DivergenceError as error:
            q, w, good = self._one_by_one(t, h, k)
            why = str(error)
        if not good.all():
            self._message = self._message or (
                f"diverged after t = {t:.6g} s (step {k + 1}): {why}; dt = {self._grid.dt:g} s may be too long"
            )
            if self._members is None:
                self._reached[...] = t
                return False
            self._reached[self._members[~good]] = t
            self._members, q, w = self._members[good], q[good], w[good]
            if not len(self._members):
                return False
            self._field.only(self._members)
        q, w = self._field.settled(self._grid.time(k + 1), q, w)
        self._q, self._w = q, w
        self._steps += 1 if self._members is None else len(self._members)
        if k + 1 == self._next:
            self._keep(q, self._space.leave(q, w))
        return True

    def failed(self, k: int, error: FunctionError) -> None:
        """End the run before step k, because the torque function did."""
        self._error = error
        self._reached[... if self._members is None else self._members] = self._grid.time(k)

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
        which = ... if self._members is None else self._members
        self._q_kept[which, self._row, :], self._v_kept[which, self._row, :] = q, v
        self._row += 1
        self._next = int(self._kept[self._row]) if self._row < len(self._kept) else -1

    def outcome(self, evaluations: int) -> SolverResult:
        """Return what was kept."""
        message = self._message
        if message and self._members is not None:
            batch = len(self._reached)
            message += f"; {batch - len(self._members)} of {batch} trajectories diverged, see reached"
        ended: Ended = "diverged" if message else "finished"
        if self._error is not None:
            ended, message = "function_failed", str(self._error)
        return SolverResult(
            t=np.array([self._grid.time(int(k)) for k in self._kept[: self._row]]),
            q=self._q_kept[..., : self._row, :],
            v=self._v_kept[..., : self._row, :],
            steps=self._steps,
            evaluations=evaluations,
            ended=ended,
            reached=self._reached,
            message=message,
            error=self._error,
        )


def reason(dyn: Dynamics, method: str, t: float, h: float, q: Array, w: Array, force: Array) -> str:
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
    return explicit_step(formula, field, space)
