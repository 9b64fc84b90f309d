"""The integration problem handed to every solver.

The request for a run: what a user asks for, one value that is handed on whole.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.frames_and_momenta import ALIGNED
from mbkit.errors import InputError
from mbkit.methods.registry import DEFAULT_METHOD, Tolerances
from mbkit.model.elements.paths import ALL, Path
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.events import Event
from mbkit.simulate.progress import Progress, ProgressFunction
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.time_grid import Grid, Indices, check_room
from mbkit.simulate.torque import RunWrenches, Torque, TorqueFunction


@dataclass(frozen=True, eq=False)
class RunRequest:
    """The arguments of `mbkit.simulate`, as they were given; its documentation has their meaning."""

    q0: ArrayLike
    v0: ArrayLike
    duration: float
    method: str = DEFAULT_METHOD
    dt: float | None = None
    rtol: float | None = None
    atol: float | None = None
    torque: ArrayLike | TorqueFunction | None = None
    save: ArrayLike | int | None = None
    progress: bool | ProgressFunction | None = None
    events: Event | Sequence[Event] | None = None
    doubt: bool = False
    t0: float | None = None
    wrenches: RunWrenches | None = None
    wrench_axes: str = ALIGNED
    hold: float | None = None
    saturate: bool = False


#: Runs whose jumps are those of phases, or of the method.
RUNS: Final = Path("runs", "simulate: not known of", ALL)
#: States side by side that machine code takes through a step in the time of one.
SIDE_BY_SIDE: Final = 8


@dataclass(frozen=True, eq=False)
class IntegrationProblem:
    """States to integrate, and how: an adaptive method by tolerances, one with a fixed step on a grid."""

    dyn: Dynamics
    method: str
    # (nq,) or (N, nq), and (nv,) or (N, nv).
    q0: Array
    v0: Array
    # s
    start: float
    duration: float
    tolerances: Tolerances
    torque: Torque
    # Times to keep; None for the method's own.
    save: Array | None
    events: tuple[Event, ...]
    bar: Progress
    # Ends of the intervals with one force each, where an adaptive run has several; by default the times to keep.
    jumps: Array | None = None
    # Equal steps, and the indices of the states to keep, of a method with a fixed step.
    equal_steps: Grid | None = None
    kept: Indices = field(default_factory=lambda: np.empty(0, dtype=np.intp))

    def __post_init__(self) -> None:
        kept = self.save if self.equal_steps is None else self.kept
        if kept is not None:
            check_room(len(kept) * len(self.q), self.q0.shape[-1] + self.v0.shape[-1])
        elif self.batch is not None:
            raise InputError(
                "save: expected a grid of times for a batch with an adaptive method; without it each state has its own"
            )

    @classmethod
    def on_grid(
        cls, dyn: Dynamics, method: str, q0: Array, v0: Array, grid: Grid, kept: Indices, torque: Torque, bar: Progress
    ) -> IntegrationProblem:
        """Return the problem of a method with a fixed step."""
        none = Tolerances(0.0, 0.0)
        length = grid.end - grid.start
        return cls(dyn, method, q0, v0, grid.start, length, none, torque, None, (), bar, None, grid, kept)

    @property
    def grid(self) -> Grid:
        """Steps of a method with a fixed step."""
        assert self.equal_steps is not None
        return self.equal_steps

    @property
    def end(self) -> float:
        """Last time, s."""
        return self.start + self.duration

    @property
    def batch(self) -> int | None:
        """Number of states; None for one that is not in a batch."""
        return None if self.q0.ndim == 1 else len(self.q0)

    @property
    def q(self) -> Array:
        """Configurations at the start, (N, nq)."""
        return np.atleast_2d(self.q0)

    @property
    def v(self) -> Array:
        """Velocities at the start, (N, nv)."""
        return np.atleast_2d(self.v0)

    @property
    def y(self) -> Array:
        """States at the start, (N, nq + nv)."""
        return np.concatenate([self.q, self.v], axis=1)

    @cached_property
    def stops(self) -> list[float]:
        """Times at which an adaptive run must stop on its way: where a held force changes, and the end."""
        jumps = self.save if self.jumps is None else self.jumps
        held = [] if jumps is None or not self.torque.held else jumps.tolist()
        return [*sorted({t for t in held if self.start < t < self.end}), self.end] if self.duration else []

    def interval(self, t: float) -> int:
        """Return which of the intervals between stops begins at a time, or holds it."""
        return min(bisect_right(self.stops, t), max(len(self.stops) - 1, 0))

    def sample(self, i: int, k: int, t: float, y: Array) -> None:
        """Ask a torque that samples for its value from interval k on, where the i-th trajectory is in a state y."""
        if self.torque.samples is not None:
            model = self.dyn.model
            q, v = unit_quaternions(model, y[: model.nq])[0], y[model.nq :]
            self.torque.sample(k, t, q[None], v[None], np.array([i]))

    def member(self, i: int) -> int | None:
        """Return the place of the i-th state in the batch, None where there is none."""
        return None if self.batch is None else i

    def report(self, i: int) -> Callable[[float], None]:
        """Return a function that reports the time that the i-th state has reached."""
        return lambda t: self.bar.update((i + (t - self.start) / self.duration) / len(self.q))


#: problem -> result.
Solver = Callable[[IntegrationProblem], SolverResult]
