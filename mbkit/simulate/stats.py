"""What a run cost and how it ended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["Ended", "Stats"]

Ended = Literal["finished", "diverged", "step_too_small"]


@dataclass(frozen=True)
class Stats:
    """Cost and end of a run.

    Attributes
    ----------
    steps : int
        Accepted steps, summed over a batch.
    evaluations : int
        Evaluations of the forward dynamics, summed over a batch.
    seconds : float
        Time on the wall.
    ended : {"finished", "diverged", "step_too_small"}
        ``"diverged"`` when a state or acceleration of any trajectory stopped being
        finite, or a state passed 1e100; ``"step_too_small"`` when an adaptive method could not go on.
    reached : float or tuple of float
        Time of the last good state, s; one per trajectory of a batch.
    message : str
        Why a run ended early; empty for one that finished.
    """

    steps: int
    evaluations: int
    seconds: float
    ended: Ended
    reached: float | tuple[float, ...]
    message: str = ""

    @property
    def finished(self) -> bool:
        """Whether every trajectory reached the end."""
        return self.ended == "finished"

    def __str__(self) -> str:
        end = self.message or "finished"
        return f"{self.steps} steps, {self.evaluations} evaluations, {self.seconds:.3g} s; {end}"
