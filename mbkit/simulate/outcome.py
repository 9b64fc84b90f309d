"""What an integrator hands back to `simulate`."""

from __future__ import annotations

from dataclasses import dataclass

from mbkit._check import Array
from mbkit.simulate.stats import Ended

__all__ = ["Outcome"]


@dataclass(frozen=True)
class Outcome:
    """Kept states and the figures of a run; `reached` has shape () or (N,)."""

    t: Array
    q: Array
    v: Array
    steps: int
    evaluations: int
    ended: Ended
    reached: Array
    message: str
