"""The times of a run: its steps, and the kept ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbkit._check import EPS, Array, finite_array
from mbkit.errors import InputError

Indices = NDArray[np.intp]

#: s
DEFAULT_STEP: Final = 1e-3

#: Most numbers of a result, 8 GiB of float64: beyond it, a system that overcommits memory kills the process.
MAX_NUMBERS = 2**30


@dataclass(frozen=True)
class Grid:
    """Equal steps of `dt` from `start` to `end`, the last one shortened if it must be."""

    # s
    start: float
    end: float
    dt: float
    steps: int
    # Length of the last step, s.
    last: float

    @classmethod
    def of(cls, start: float, duration: float, dt: float) -> Grid:
        """Count the steps; a remainder below rounding is no step of its own."""
        end = start + duration
        ratio = duration / dt
        if not ratio < 2**53:
            raise InputError(f"dt: {dt:g} s makes {ratio:.3g} steps of {duration:g} s; expected a larger step")
        whole = round(ratio)
        if abs(ratio - whole) <= 4 * EPS * ratio:
            return cls(start, end, dt, whole, dt)
        steps = int(np.ceil(ratio))
        return cls(start, end, dt, steps, duration - (steps - 1) * dt)

    def time(self, k: int) -> float:
        """Time of the k-th state, s; start + k dt, so that rounding does not pile up."""
        return self.end if k == self.steps else self.start + k * self.dt

    def times_of(self, k: Indices) -> Array:
        """Return the times of some states, s."""
        out = k * np.float64(self.dt)
        out += self.start
        out[k == self.steps] = self.end
        return out

    @property
    def times(self) -> Array:
        """All of them, (steps + 1,), s."""
        return self.times_of(np.arange(self.steps + 1))

    def step(self, k: int) -> float:
        """Length of the k-th step, s."""
        return self.last if k == self.steps - 1 else self.dt

    def span(self, first: int, end: int) -> float:
        """Length of the steps from state `first` to state `end`, s; without the rounding of times far from zero."""
        return (end - first - 1) * self.dt + self.step(end - 1)

    def kept(self, save: ArrayLike | int | None, numbers: int) -> Indices:
        """Return the indices of the states to keep: all, every n-th and the last, or those at some times.

        A state has so many numbers; more than fit in memory are refused.
        """
        if save is None:
            return self._every(1, numbers)
        if isinstance(save, (int, np.integer)) and not isinstance(save, bool):
            if save < 1:
                raise InputError(f"save: expected a count of at least 1 or a grid of times, got {save}")
            return self._every(int(save), numbers)
        times = save_times(save, self.start, self.end)
        index = np.minimum(np.rint((times - self.start) / self.dt), self.steps).astype(np.intp)
        index = np.where(times == self.end, self.steps, index)
        on_grid = self.times_of(index)
        off = np.abs(on_grid - times) > 1e-6 * self.dt + 4 * EPS * abs(self.start)
        if off.any():
            raise InputError(
                f"save: {times[np.argmax(off)]:.9g} s is not a step of dt = {self.dt:g} s; "
                "give multiples of dt after the start, or use an adaptive method"
            )
        if np.any(np.diff(index) <= 0):
            raise InputError(f"save: two times fall on one step of dt = {self.dt:g} s")
        return index

    def _every(self, n: int, numbers: int) -> Indices:
        check_room(self.steps // n, numbers)
        out = np.arange(0, self.steps + 1, n, dtype=np.intp)
        return out if out[-1] == self.steps else np.append(out, self.steps)


def save_times(save: ArrayLike, start: float, end: float) -> Array:
    """Return a grid of times, checked: increasing, within the run."""
    try:
        shape = np.shape(save)
    except ValueError:
        raise InputError("save: expected increasing times of shape (K,), got rows of different lengths") from None
    if len(shape) != 1 or not shape[0]:
        raise InputError(f"save: expected increasing times of shape (K,), got shape {shape}")
    times = finite_array("save", save, shape)
    if np.any(np.diff(times) <= 0):
        raise InputError("save: expected increasing times")
    if times[0] < start or times[-1] > end + 1e-12 * max(abs(start), abs(end)):
        raise InputError(
            f"save: expected times between {start:.15g} and {end:.15g} s, got {times[0]:.15g} to {times[-1]:.15g} s; "
            "times count from t0"
        )
    return np.minimum(times, end)


def check_room(
    rows: float,
    numbers: int,
    what: str = "save:",
    instead: str = "keep fewer with save=, an every-n-th count or a grid of times",
) -> None:
    """Refuse to keep more numbers than a machine holds, before it is filled."""
    if rows * numbers > MAX_NUMBERS:
        raise InputError(
            f"{what} {rows:.16g} rows of {numbers} numbers, which would take {rows * numbers * 8 / 2**30:.3g} GiB; "
            f"{instead}"
        )
