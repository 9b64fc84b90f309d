"""Dynamics that depend on the time: the time is one of their model's parameters."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from mbkit._check import Array
from mbkit.engines.base import Dynamics
from mbkit.errors import UnsupportedError

__all__ = ["at_time", "at_times"]

Any_ = TypeVar("Any_", bound=Dynamics)


def at_time(dyn: Any_, t: float) -> Any_:
    """Return the dynamics at a time; the same ones where time does not enter."""
    clock = dyn.model.clock
    return dyn if clock is None else dyn.at(**{clock: t})  # type: ignore[return-value]  # of its own kind


def at_times(dyn: Any_, t: Array, trajectories: int | None = None) -> Any_:
    """Return the dynamics with a sample for each time of a run, where time enters.

    Parameters
    ----------
    dyn : Dynamics
    t : (K,) array
    trajectories : int, optional
        Size of a batch; there is one sample for each time of each trajectory then.
    """
    clock = dyn.model.clock
    if clock is None:
        return dyn
    if not dyn.takes_parameters:
        raise UnsupportedError(f"{dyn.engine}: holds one time; evaluate along a run with the lagrangian engine")
    own = dyn
    if trajectories is not None and dyn.samples is not None:
        own = dyn.of_samples(np.repeat(np.arange(trajectories), len(t)))  # type: ignore[assignment]
    return own.at(**{clock: np.tile(t, trajectories or 1)})  # type: ignore[return-value]
