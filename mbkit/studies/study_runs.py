"""Runs that studies make: where they start, without warnings, with a time limit."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import InputError, MbkitError, MbkitWarning
from mbkit.model import Model
from mbkit.model.builder import expect_model
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


def free_of_mimic(model: Model) -> Model:
    """Return the model with its mimic joints independent: MuJoCo's own steps would make them soft."""
    return replace(model, joints=tuple(replace(j, mimic=None) for j in model.joints))


def start_state(model: Model, seed: int) -> tuple[Array, Array]:
    """Return a gentle start near the middle of the joints' ranges: a wild one measures chaos, not integrators."""
    q, v = state_within_limits(model, np.random.default_rng([seed, 1]), 0.1)
    return q, 0.1 * v


class TooLongError(MbkitError):
    """A run took longer than it is worth."""


def patience(seconds: float, clock: Callable[[], float] = time.perf_counter) -> Callable[[float], None]:
    """Return a progress function that ends a run after so many seconds, of the wall's or another clock."""
    end = clock() + seconds

    def look(done: float) -> None:
        if clock() > end:
            raise TooLongError(f"given up after {seconds:g} s, {done:.0%} done: stiff, or very fast motion")

    return look


def quiet_simulate(*args: object, **kwargs: object) -> Trajectory:
    """Simulate without the warning of a divergence, which the caller reads from the statistics."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        return simulate(*args, **kwargs)  # type: ignore[arg-type]
