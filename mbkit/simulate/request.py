"""The request for a run: what a user asks for, one value that is handed on whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from numpy.typing import ArrayLike

from mbkit.engines.frames_and_momenta import ALIGNED
from mbkit.methods.registry import DEFAULT_METHOD
from mbkit.simulate.events import Event
from mbkit.simulate.progress import ProgressFunction
from mbkit.simulate.torque import RunWrenches, TorqueFunction


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
