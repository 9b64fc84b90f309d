"""Result of a solver, and the cost and end of a run."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Final, Literal

from mbkit._check import Array
from mbkit.errors import FunctionError
from mbkit.simulate.events import Hit

Ended = Literal["finished", "event", "diverged", "step_too_small", "function_failed"]


@dataclass(frozen=True)
class Stats:
    """Cost and end of a run.

    Attributes
    ----------
    steps, evaluations : int
        Accepted steps, and evaluations of the forward dynamics, summed over a batch.
    seconds : float
        Time on the wall.
    ended : {"finished", "event", "diverged", "step_too_small", "function_failed"}
        ``"event"`` when one asked for the end; ``"diverged"`` when a state or acceleration of any trajectory stopped
        being finite, or a state passed 1e100; ``"step_too_small"`` when an adaptive method could not go on;
        ``"function_failed"`` when a torque or event function did.
    reached : float or tuple of float
        Time of the last good state, s; one per trajectory of a batch.
    message : str
        Why a run ended early; empty for one that finished.
    rejected : int
        Steps that an adaptive method rejected, where it reports them.
    jacobians : int
        Of implicit adaptive methods: evaluations of the Jacobian of the forward dynamics, summed over a batch; of
        ``"implicit_midpoint"``: iterations of Newton's method, each with the exact Jacobian of the step's equations.
    chosen : str
        Of ``"auto"``: which methods ran, from when to when, and why.
    doubts : tuple of str
        Signs that a finished run is wrong, each with its measured reason and a remedy.
    """

    steps: int = 0
    evaluations: int = 0
    seconds: float = 0.0
    ended: Ended = "finished"
    reached: float | tuple[float, ...] = 0.0
    message: str = ""
    rejected: int = 0
    jacobians: int = 0
    chosen: str = ""
    doubts: tuple[str, ...] = ()

    @property
    def finished(self) -> bool:
        """Whether every trajectory reached the end, or the event that was to stop it."""
        return self.ended in ("finished", "event")

    def __str__(self) -> str:
        end = self.message or ("finished, with doubts" if self.doubts else "finished")
        chosen = f"; {self.chosen}" if self.chosen else ""
        return f"{self.steps} steps, {self.evaluations} evaluations, {self.seconds:.3g} s; {end}{chosen}"


_FIGURES: Final = tuple(x.name for x in fields(Stats))


@dataclass(frozen=True, kw_only=True)
class SolverResult(Stats):
    """Kept states of a run, with its cost and end.

    `last` is the last good configuration of the first trajectory that could not go on, where the method reports it;
    `error` is that of a torque or event function.
    """

    t: Array
    q: Array
    v: Array
    events: tuple[Hit, ...] = ()
    error: FunctionError | None = None
    last: Array | None = None

    def stats(self, **more: Any) -> Stats:
        """Return the cost and the end alone, with what else is known of them."""
        return Stats(**{name: getattr(self, name) for name in _FIGURES} | more)
