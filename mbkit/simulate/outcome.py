"""What an integrator hands back to `simulate`."""

from __future__ import annotations

from dataclasses import dataclass

from mbkit._check import Array
from mbkit.errors import FunctionError
from mbkit.simulate.events import Hit
from mbkit.simulate.stats import Ended

__all__ = ["Outcome"]


@dataclass(frozen=True)
class Outcome:
    """Kept states and the figures of a run; `reached` has shape () or (N,).

    `last` is the last good configuration of the first trajectory that could not go on, where the method tells it.

    The `error` of a torque or event function is handed on with what was computed before it.
    """

    t: Array
    q: Array
    v: Array
    steps: int
    evaluations: int
    ended: Ended
    reached: Array
    message: str
    rejected: int = 0
    jacobians: int = 0
    events: tuple[Hit, ...] = ()
    error: FunctionError | None = None
    chosen: str = ""
    doubts: tuple[str, ...] = ()
    last: Array | None = None
