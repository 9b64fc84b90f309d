"""The trajectories of an adaptive method, each by itself, and all of them as one outcome."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from mbkit._check import Array
from mbkit.errors import FunctionError, InputError
from mbkit.model import Model
from mbkit.simulate.events import Hit
from mbkit.simulate.grid import check_room
from mbkit.simulate.outcome import Outcome
from mbkit.simulate.progress import Progress
from mbkit.simulate.rates import unit_quaternions
from mbkit.simulate.stats import Ended

__all__ = ["Member", "check_save", "gathered", "reporter"]


@dataclass
class Member:
    """What came of one trajectory.

    Attributes
    ----------
    t : list of float
    y : list of (nq + nv,) arrays
        Kept states, with quaternions of any length.
    steps, rejected : int
    reached : float
        Time of the last good state, s.
    ended : str
        As in `Stats`.
    message : str
    events : list of Hit
    error : FunctionError or None
    """

    t: list[float] = field(default_factory=list)
    y: list[Array] = field(default_factory=list)
    steps: int = 0
    rejected: int = 0
    reached: float = 0.0
    ended: Ended = "finished"
    message: str = ""
    events: list[Hit] = field(default_factory=list)
    error: FunctionError | None = None

    def keep(self, t: float, y: Array) -> None:
        """Keep a state."""
        self.t.append(t)
        self.y.append(y.copy())

    def stop(self, ended: Ended, message: str) -> None:
        """End early, after `reached`."""
        self.ended, self.message = ended, f"{message} after t = {self.reached:.6g} s"

    def stop_at(self, hit: Hit) -> None:
        """End at an event; of one of a batch the state is with the event, off the common times."""
        self.ended, self.reached = "event", hit.t
        self.message = f"stopped by {hit.name} at t = {hit.t:.6g} s"
        if hit.member is None and not (self.t and self.t[-1] == hit.t):
            self.keep(hit.t, np.concatenate([hit.q, hit.v]))

    def fail(self, error: FunctionError) -> None:
        """End where a torque or event function failed."""
        self.ended, self.message, self.error = "function_failed", str(error), error


def check_save(save: Array | None, batch: int | None, numbers: int) -> None:
    """Refuse a batch without common times, and more states than a machine holds."""
    if batch is not None and save is None:
        raise InputError(
            "save: expected a grid of times for a batch with an adaptive method; without it each state has its own"
        )
    if save is not None:
        check_room(len(save) * (1 if batch is None else batch), numbers)


def reporter(bar: Progress, i: int, count: int, start: float, duration: float) -> Callable[[float], None]:
    """Return what tells how far the i-th trajectory is, by its time."""

    def done(t: float) -> None:
        bar.update((i + (t - start) / duration) / count)

    return done


def gathered(
    model: Model,
    members: Sequence[Member],
    batch: int | None,
    times: Array | None,
    *,
    evaluations: int,
    jacobians: int = 0,
) -> Outcome:
    """Return one trajectory, or a batch of them as far as they came, as an outcome.

    Parameters
    ----------
    model : Model
    members : sequence of Member
        Those of a batch that were not begun are void.
    batch : int or None
    times : (K,) array or None
        Those that a batch keeps.
    evaluations, jacobians : int
        Of all together.
    """
    # A batch of none has all its times.
    count = max((len(member.t) for member in members), default=0 if times is None or batch else len(times))
    y = np.full((1 if batch is None else batch, count, model.nq + model.nv), np.nan)
    for i, member in enumerate(members):
        for j, state in enumerate(member.y):
            y[i, j, : model.nq] = unit_quaternions(model, state[: model.nq])[0]
            y[i, j, model.nq :] = state[model.nq :]
    reached = np.zeros(len(y))
    reached[: len(members)] = [member.reached for member in members]
    ended, message = _told(members, batch)
    t = members[0].t if batch is None else [] if times is None else times[:count].tolist()
    return Outcome(
        t=np.array(t, dtype=np.float64),
        q=(y[0] if batch is None else y)[..., : model.nq],
        v=(y[0] if batch is None else y)[..., model.nq :],
        steps=sum(member.steps for member in members),
        evaluations=evaluations,
        ended=ended,
        reached=np.asarray(reached[0] if batch is None else reached),
        message=message,
        rejected=sum(member.rejected for member in members),
        jacobians=jacobians,
        events=tuple(hit for member in members for hit in member.events),
        error=next((member.error for member in members if member.error), None),
    )


def _told(members: Sequence[Member], batch: int | None) -> tuple[Ended, str]:
    # What went wrong is told before what was wished for.
    early = [member for member in members if member.ended != "finished"]
    early.sort(key=lambda member: ("function_failed", "diverged", "step_too_small", "event").index(member.ended))
    if not early:
        return "finished", ""
    first = early[0]
    if batch is None or first.error is not None:
        return first.ended, first.message
    return first.ended, f"{first.message}; {len(early)} of {batch} trajectories ended early, see reached"
