"""What all trajectories of a run by method auto share, and how the pace of a method is taken."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from mbkit.model.space import Space
from mbkit.simulate.asked import Asked
from mbkit.simulate.embedded import make_trials
from mbkit.simulate.embedded_trials import Stretch, Trials
from mbkit.simulate.methods import Tolerances

__all__ = ["EXPLICIT", "IMPLICIT", "LEAST", "Gauge", "Pace", "Scene"]

EXPLICIT, IMPLICIT = "rk853", "rodas5"
#: No tolerance below: rounding would be taken for error, and steps shrink without end.
LEAST: Final = 1e-13
#: What rk853 has of the tolerance that is asked for: with the whole of it, errors of a thousand steps come to 500
#: times as much, and a tenth costs a third more steps.
_SHARE: Final = 0.1
#: Steps whose mean is compared with the rates where they end.
_RECENT: Final = 8


@dataclass(frozen=True)
class Pace:
    """When to look, by how the tries are made.

    Attributes
    ----------
    first, later : int
        Tries before the first look, and by how much more before each next one.
    worth, guess : int
        Tries that a run must still have before it for a look at the linearized system; and for tries of
        rodas5 where stability does not hold the steps.
    pilot : int
        Tries by which rodas5 is judged.
    dearer : float
        Time of a try of rodas5 over that of one of rk853.
    freely : float
        How much of the tolerance rodas5 has where its steps are few: its error is about the tolerance then,
        that of rk853 up to a hundred times as much.
    """

    first: int
    later: int
    worth: int
    guess: int
    pilot: int
    dearer: float
    freely: float


# Measured by validation/auto.py, in time of the processor. In machine code a look takes as long as 50 to 100 tries of
# rk853, and those of rodas5 as long as 60; in Python as 2 to 5, and as 15. A try of rodas5 takes 0.5 to 1.2 times as
# long as one of rk853 in machine code, where eight stages, a Jacobian and its factors stand against twelve
# stages, and 1.2 to 1.6 times in Python. So all looks together cost at most a tenth of a run.
_COMPILED: Final = Pace(first=64, later=4, worth=1500, guess=3000, pilot=24, dearer=1.2, freely=1.0)
_IN_PYTHON: Final = Pace(first=5, later=2, worth=100, guess=300, pilot=8, dearer=1.3, freely=2.0)


class Scene:
    """What all trajectories of a run share.

    Attributes
    ----------
    space : Space
    tolerances : Tolerances
    start, end, duration : float
        s.
    batch : int or None
    stops : sequence of float
        As of `mbkit.simulate.embedded.stops_of`.
    pace : Pace
    """

    def __init__(self, asked: Asked, space: Space, stops: Sequence[float]) -> None:
        self.dyn, self._torque, self.batch = asked.dyn, asked.torque, asked.batch
        self.space, self.tolerances, self.stops = space, asked.tolerances, stops
        self.start, self.end, self.duration = asked.start, asked.end, asked.duration
        self._trials: list[Trials] = []
        self.pace = _IN_PYTHON

    def make(self, method: str, tolerances: Tolerances) -> Trials:
        """Return what tries a method's steps; its evaluations are counted with all others."""
        given = self.dyn, self.space, tolerances, self._torque, self.duration, self.batch
        made = make_trials(method, *given)
        self._trials.append(made)
        self.pace = _COMPILED if made.rounds > 1 else _IN_PYTHON
        return made

    def granted(self, method: str, base: Tolerances) -> Tolerances:
        """Return the loosest tolerances that a method has, of those that stand."""
        share = self.pace.freely if method == IMPLICIT else min(1.0, max(_SHARE, LEAST / base.rtol))
        return Tolerances(*(share * x for x in base))

    def gauge(self, t: float, first: int) -> Gauge:
        """Return what takes the pace from a time on, with the first look after some tries."""
        return Gauge(t, first, self.pace.later)

    @property
    def evaluations(self) -> int:
        """Of the forward dynamics, by all trials."""
        return sum(trials.evaluations for trials in self._trials)

    @property
    def jacobians(self) -> int:
        """Of the forward dynamics, by all trials."""
        return sum(trials.jacobians for trials in self._trials)


class Gauge:
    """How fast a method goes, judged by the later half of its tries."""

    def __init__(self, t: float, first: int, later: int) -> None:
        self._next, self._later, self._begin = first, later, t
        # Tries and time.
        self._marks = [(0, t)]
        self._ends = [t]

    @property
    def missing(self) -> int:
        """Tries until the next look."""
        return self._next - self._marks[-1][0]

    def saw(self, made: Stretch) -> None:
        """Count tries."""
        tries = self._marks[-1][0]
        if made.tried > 1:
            self._marks.append((tries + made.tried // 2, float(made.t[len(made.t) // 2])))
        self._marks.append((tries + made.tried, float(made.t[-1])))
        self._ends = [*self._ends, *made.t[1:].tolist()][-_RECENT - 1 :]

    def due(self) -> bool:
        """Return whether it is time to look."""
        due = self.missing <= 0
        if due:
            self._next = self._later * self._marks[-1][0]
            # What lies before a quarter of the tries is never asked for again.
            self._marks = [mark for mark in self._marks if 4 * mark[0] >= self._marks[-1][0]]
        return due

    def rate(self) -> float:
        """Return the tries for each second of the motion."""
        tries, t = self._marks[-1]
        before = next((mark for mark in reversed(self._marks) if mark[0] <= tries / 2), self._marks[0])
        return (tries - before[0]) / (t - before[1]) if t > before[1] else math.inf

    def overall(self) -> float:
        """Return the tries for each second of the motion from the beginning."""
        tries, t = self._marks[-1]
        return tries / (t - self._begin) if t > self._begin else math.inf

    def step(self) -> float:
        """Return the mean length of the last steps, s; 0 where there were none."""
        return (self._ends[-1] - self._ends[0]) / max(1, len(self._ends) - 1)
