"""Runs of studies: their start and time limit, and the warnings of the library."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines.consistent.random_states import states_of
from mbkit.errors import InputError, MbkitError, MbkitWarning
from mbkit.model import Model
from mbkit.model.builder import expect_model
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.manifold import limits_box
from mbkit.simulate import Trajectory, simulate

#: The note of what was left out because no time was left.
OUT_OF_TIME: Final = "not run: the time allowed was used up"


def state_within_limits(model: Model, rng: np.random.Generator, share: float = 0.5) -> tuple[Array, Array]:
    """Return a random state in the middle `share` of the limits."""
    q, v = model.random_state(rng)
    if model.constrained:
        return q, v
    lower, upper = limits_box(model)
    bounded = np.isfinite(lower)
    middle = 0.5 * (lower[bounded] + upper[bounded])
    q[bounded] = middle + share * (q[bounded] - middle)
    return q, v


def require_motion(model: object, purpose: str) -> Model:
    """Return a model that has a velocity."""
    model = expect_model(model)
    if not model.nv:
        raise InputError(
            f"model: nothing moves in {model.name} (nv = 0), so there is nothing to {purpose}; add a joint"
        )
    return model


def integrable(model: Model, *, native: bool = True) -> tuple[Model, list[str]]:
    """Return a model that references by series and, where `native`, engines' own integrators hold, and what differs."""
    notes = []
    if "jump" in model.effects:
        # No reference of series crosses jumps, and no engine's own integrator holds them exactly.
        model, notes = model.smooth, [f"without {EFFECTS['jump']}"]
    if native and model.layout.reduced:
        model, notes = free_of_mimic(model), [*notes, "mimic joints free"]
    return model, notes


def free_of_mimic(model: Model) -> Model:
    """Return the model with its mimic joints independent: MuJoCo's own steps would make them soft."""
    return replace(model, joints=tuple(replace(j, mimic=None) for j in model.joints))


def start_state(model: Model, seed: int) -> tuple[Array, Array]:
    """Return a gentle start near the middle of the joints' ranges: a wild one measures chaos, not integrators."""
    q, v = state_within_limits(model, np.random.default_rng([seed, 1]), 0.1)
    if model.time_parameter is not None and model.constrained:
        # A motion in time has the velocity that it has.
        return states_of(model).manifold.project(q, 0.1 * v)
    return q, 0.1 * v


def whole_steps(interval: float, step: float) -> int:
    """Return the least number of equal steps, none longer than `step` but by rounding, that fill an interval."""
    return max(1, int(np.ceil(interval / step * (1 - 1e-9))))


class TooLongError(MbkitError):
    """A run took longer than it is worth."""


class Deadline:
    """The time limit of a run or a search, by the wall's or another clock.

    `tell` gets the part of the time that is over; by default nobody does.
    """

    def __init__(
        self,
        seconds: float,
        tell: Callable[[float], object] = float,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._tell, self._clock = tell, clock
        #: Seconds that do not count, of all parts together.
        self._uncounted = [0.0]
        self._seconds, self._begun = seconds, self._now()
        self._end = self._begun + seconds

    def _now(self) -> float:
        return self._clock() - self._uncounted[0]

    @property
    def left(self) -> float:
        """Seconds."""
        return self._end - self._now()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the clock of this and all parts, for derivation and compilation."""
        start = self._clock()
        yield
        self._uncounted[0] += self._clock() - start

    def part(self, seconds: float) -> Deadline:
        """Return the limit for a part of the way, which has less time."""
        part = copy(self)
        part._end = min(self._end, self._now() + seconds)
        return part

    def look(self, done: float) -> None:
        """Raise `TooLongError` when the time is up."""
        self._tell(min((self._now() - self._begun) / self._seconds, 1.0))
        if self.left < 0:
            raise TooLongError(f"stopped after {self._seconds:g} s, {done:.0%} done: stiff, or very fast motion")


def quiet_simulate(*args: object, **kwargs: object) -> Trajectory:
    """Simulate without the warning of a divergence, which the caller reads from the statistics."""
    with warnings.catch_warnings(action="ignore", category=MbkitWarning):
        return simulate(*args, **kwargs)  # type: ignore[arg-type]


@contextmanager
def heard_warnings() -> Iterator[list[str]]:
    """Collect the library's warnings, each once."""
    heard: list[str] = []
    with warnings.catch_warnings(record=True, action="always") as caught:
        yield heard
    heard += dict.fromkeys(" ".join(str(w.message).split()) for w in caught if issubclass(w.category, MbkitWarning))
