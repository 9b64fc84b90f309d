"""The integration problem handed to every adaptive solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import InputError
from mbkit.methods.registry import Tolerances
from mbkit.simulate.events import Event
from mbkit.simulate.progress import Progress, reporter
from mbkit.simulate.time_grid import check_save
from mbkit.simulate.torque import Torque

__all__ = ["IntegrationProblem"]


@dataclass(frozen=True, eq=False)
class IntegrationProblem:
    """States to integrate, and how.

    Attributes
    ----------
    dyn : Dynamics
    method : str
        Its name.
    q0, v0 : (nq,) or (N, nq), (nv,) or (N, nv) arrays
    start, duration : float
        Time of the states, and how long they move, s.
    tolerances : Tolerances
    torque : Torque
    save : (K,) array or None
        Times to keep; None for the method's own.
    events : tuple of Event
    bar : Progress

    Raises
    ------
    InputError
        What is to be kept does not fit in memory.
    """

    dyn: Dynamics
    method: str
    q0: Array
    v0: Array
    start: float
    duration: float
    tolerances: Tolerances
    torque: Torque
    save: Array | None
    events: tuple[Event, ...]
    bar: Progress

    def __post_init__(self) -> None:
        check_save(self.save, self.batch, self.q0.shape[-1] + self.v0.shape[-1])

    @property
    def end(self) -> float:
        """Last time, s."""
        return self.start + self.duration

    @property
    def batch(self) -> int | None:
        """How many states; None for one that is not in a batch."""
        return None if self.q0.ndim == 1 else len(self.q0)

    @property
    def q(self) -> Array:
        """Where each begins, (N, nq)."""
        return np.atleast_2d(self.q0)

    @property
    def v(self) -> Array:
        """How fast each begins, (N, nv)."""
        return np.atleast_2d(self.v0)

    @property
    def y(self) -> Array:
        """Both in a row, (N, nq + nv)."""
        return np.concatenate([self.q, self.v], axis=1)

    def member(self, i: int) -> int | None:
        """Return the place of the i-th state in the batch, None where there is none."""
        return None if self.batch is None else i

    def told(self) -> tuple[Array, Array]:
        """Return the times to keep, and those to go through from the start to the end.

        Raises
        ------
        InputError
            None are given, and the method does not tell its own.
        """
        if self.save is None:
            raise InputError(
                f"save: {self.method} does not tell its own steps; give the times to keep, "
                f"such as [{self.start:g}, {self.end:g}]"
            )
        return self.save, np.array([self.start, *sorted({*self.save.tolist(), self.end} - {self.start})])

    def report(self, i: int) -> Callable[[float], None]:
        """Return what is told the time that the i-th state has reached."""
        return reporter(self.bar, i, len(self.q), self.start, self.duration)
