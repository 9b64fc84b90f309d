"""The trajectories of an adaptive method, each by itself, and all of them as one outcome."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import FunctionError
from mbkit.model import Model
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.constraint_projection import SingularPoses
from mbkit.simulate.events import Hit
from mbkit.simulate.result import Ended, SolverResult

__all__ = ["TrajectoryRecord", "assemble_result", "record_of"]

#: Tried steps between two looks at the time that they covered, and the least part of the run that they must cover.
#: A run at that pace takes 2e10 steps.
_TRIED: Final = 20_000
_COVERED: Final = 1e-6


@dataclass
class TrajectoryRecord:
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
    duration : float
        Of the whole run, s.
    poses : SingularPoses or None
        Where constraints act.
    last : (nq,) array or None
        Configuration of the last good state.
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
    duration: float = inf
    poses: SingularPoses | None = None
    last: Array | None = None
    _look: tuple[int, float] = (0, 0.0)

    def saw(self, t: float, q: Array) -> None:
        """Take in the end of a step that is part of the run."""
        self.last = q
        if self.poses is not None:
            self.poses.saw(t, q)

    def crawls(self) -> bool:
        """End the run where many steps cover next to none of it; return whether they do."""
        tried, (before, since) = self.steps + self.rejected, self._look
        if tried - before < _TRIED:
            return False
        covered = self.reached - since
        self._look = tried, self.reached
        if covered < _COVERED * self.duration:
            self.stop(
                "step_too_small", f"{tried - before} steps covered {covered:.2g} s alone: stiff, singular or diverging"
            )
            return True
        return False

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


def record_of(dyn: Dynamics, which: int | None, start: float, duration: float) -> TrajectoryRecord:
    """Return what comes of one trajectory that has not begun.

    Parameters
    ----------
    dyn : Dynamics
    which : int or None
        Its place in a batch.
    start, duration : float
        s.
    """
    poses = SingularPoses(dyn if which is None else dyn.of_samples([which])) if dyn.model.constrained else None
    return TrajectoryRecord(reached=start, duration=duration, poses=poses, _look=(0, start))


def assemble_result(
    model: Model,
    members: Sequence[TrajectoryRecord],
    batch: int | None,
    times: Array | None,
    *,
    evaluations: int,
    jacobians: int = 0,
) -> SolverResult:
    """Return one trajectory, or a batch of them as far as they came, as an outcome.

    Parameters
    ----------
    model : Model
    members : sequence of TrajectoryRecord
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
    return SolverResult(
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
        last=next((member.last for member in members if member.ended in ("diverged", "step_too_small")), None),
        doubts=tuple(dict.fromkeys(member.poses.told() for member in members if member.poses and member.poses.times)),
    )


def _told(members: Sequence[TrajectoryRecord], batch: int | None) -> tuple[Ended, str]:
    # What went wrong is told before what was wished for.
    early = [member for member in members if member.ended != "finished"]
    early.sort(key=lambda member: ("function_failed", "diverged", "step_too_small", "event").index(member.ended))
    if not early:
        return "finished", ""
    first = early[0]
    if batch is None or first.error is not None:
        return first.ended, first.message
    return first.ended, f"{first.message}; {len(early)} of {batch} trajectories ended early, see reached"
