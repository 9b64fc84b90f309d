"""One trajectory of method auto: what is looked at on the way, and what follows from it.

After some tries, and each time that there are several times as many, it is asked how many more the run will take.
Where that is a lot, rodas5 makes some tries of its own from the state reached. If it gets further with them than
rk853, it goes on from there; if not, they are forgotten, and rk853 goes on as if there had been none. The
linearized system (`mbkit.simulate.stiffness`) tells why: near the edge of rk853's region of stability, h|λ| of about
5, its steps are short for no other reason. Where rk853 stays, to follow an oscillation, the errors of its many steps
add up, and their tolerance is tightened to what their number asks for.

While rodas5 goes on, looks at the linearized system say whether rk853 would be as fast, as where what is stiff has
come to an end. Where one method's steps fall below rounding the other one may go on; where neither can, as where a
nearly singular mass matrix leaves few digits, the tolerance is loosened, and the user told.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import NumericalError
from mbkit.model.space import Space
from mbkit.simulate.embedded import Track, make_trials, march
from mbkit.simulate.embedded_trials import ROUNDS, Stretch, Trials
from mbkit.simulate.events import Event
from mbkit.simulate.methods import Tolerances
from mbkit.simulate.stiffness import Stiffness, linearized, stiffness_of
from mbkit.simulate.torque import Torque

__all__ = ["EXPLICIT", "IMPLICIT", "Course", "Scene", "pause"]

EXPLICIT, IMPLICIT = "rk853", "rodas5"


@dataclass(frozen=True)
class _Pace:
    """When to look, by how the tries are made.

    Attributes
    ----------
    first, later : int
        Tries before the first look, and by how much more before each next one.
    worth : int
        Tries that a run must still have before it for a look.
    pilot : int
        Tries by which rodas5 is judged.
    dearer : float
        Time of a try of rodas5 over that of one of rk853.
    """

    first: int
    later: int
    worth: int
    pilot: int
    dearer: float


# Measured by validation/auto.py, in time of the processor: in machine code a look takes as long as 100 to 150 tries
# of rk853, in Python as 15 to 20, those of rodas5 among them; a try of rodas5 takes 0.8 to 1.2 times as long as one of
# rk853 in machine code, where eight stages, a Jacobian and its factors stand against twelve stages, and 1.2 to 1.6
# times in Python. A look then costs at most a tenth of the run.
_COMPILED: Final = _Pace(first=64, later=4, worth=1500, pilot=24, dearer=1.2)
_IN_PYTHON: Final = _Pace(first=8, later=2, worth=100, pilot=10, dearer=1.5)

#: h|λ| from which on stability holds rk853's steps: its region reaches to 6 on the negative axis and to 5 on the
#: imaginary one; steps that follow an oscillation at a tolerance of 1e-6 or less have 2 at most.
_EDGE: Final = 3.0
#: The h|λ| that rk853 keeps where stability holds its steps.
_KEPT: Final = 5.0
#: Steps whose mean is compared with the rates where they end.
_RECENT: Final = 8
#: By how much rodas5 must be faster.
_FASTER: Final = 1.5
#: First step of rodas5, of what remains: too long is soon found out, while growing from rk853's steps takes a
#: try for each factor of ten.
_BEGIN: Final = 1e-3
#: Turns of an oscillation, rad, from which on the tolerance follows the number of steps.
_MANY: Final = 1000.0
#: n steps with errors of the tolerance, in a norm that is a mean over 2 nv numbers, add up to at most n √(2 nv)
#: of it. They shall not exceed _SUM of it; what was measured is a third to a three-hundredth of that.
_SUM: Final = 400.0
#: Steps in all that are believed in, by how many there were.
_BELIEVED: Final = 64
#: No tolerance below: rounding would be taken for error, and steps shrink without end.
_LEAST: Final = 1e-13
#: Where steps fall below rounding: by how much the tolerance is loosened, how often in a run, and up to what.
_LOOSER: Final = 10.0
_RESCUES: Final = 8
_LOOSEST: Final = 1e-5
#: Changes of the method that are told one by one.
_TOLD: Final = 3


class Scene:
    """What all trajectories of a run share.

    Attributes
    ----------
    space : Space
    tolerances : Tolerances
    duration : float
        s.
    stops : sequence of float
        As of `mbkit.simulate.embedded.stops_of`.
    compiled : bool
        Whether steps run as machine code.
    """

    def __init__(
        self,
        dyn: Dynamics,
        space: Space,
        tolerances: Tolerances,
        torque: Torque,
        duration: float,
        batch: int | None,
        stops: Sequence[float],
    ) -> None:
        self._dyn, self._torque, self.batch = dyn, torque, batch
        self.space, self.tolerances, self.duration, self.stops = space, tolerances, duration, stops
        self._trials: list[Trials] = []
        self.compiled = False

    def make(self, method: str, tolerances: Tolerances) -> Trials:
        """Return what tries a method's steps; its evaluations are counted with all others."""
        given = self._dyn, self.space, tolerances, self._torque, self.duration, self.batch
        made = make_trials(method, *given)
        self._trials.append(made)
        self.compiled = made.rounds > 1
        return made

    @property
    def evaluations(self) -> int:
        """Of the forward dynamics, by all trials."""
        return sum(trials.evaluations for trials in self._trials)

    @property
    def jacobians(self) -> int:
        """Of the forward dynamics, by all trials."""
        return sum(trials.jacobians for trials in self._trials)


class _Track(Track):
    """One trajectory that may go on in another way where one method is stuck."""

    rescues = 0
    stalled = False

    def stuck(self, trials: Trials, place: int) -> bool:
        """Return whether no step can be made any more; where steps were inaccurate however short, it is not the end."""
        if trials.stuck(place) is False and self.rescues < _RESCUES:
            self.rescues += 1
            self.stalled = True
            return True
        return super().stuck(trials, place)


class _Gauge:
    """How fast a method goes, judged by the later half of its tries."""

    def __init__(self, t: float, first: int, later: int) -> None:
        self._next, self._later = first, later
        # Tries and time.
        self._marks = [(0, t)]
        self._ends = [t]

    @property
    def missing(self) -> int:
        """Tries until the next look."""
        return self._next - self._marks[-1][0]

    def saw(self, made: Stretch) -> None:
        """Count tries."""
        tries, half = self._marks[-1][0], len(made.t) // 2
        if made.tried > 1:
            self._marks.append((tries + made.tried // 2, float(made.t[half])))
        self._marks.append((tries + made.tried, float(made.t[-1])))
        self._ends = [*self._ends, *made.t[1:].tolist()][-_RECENT - 1 :]

    def due(self) -> bool:
        """Return whether it is time to look."""
        due = self.missing <= 0
        if due:
            self._next = self._later * self._marks[-1][0]
            self._marks = [mark for mark in self._marks if mark[0] >= self._marks[-1][0] // 4]
        return due

    def pace(self) -> float:
        """Return the tries for each second of the motion."""
        tries, t = self._marks[-1]
        before = next((mark for mark in reversed(self._marks) if mark[0] <= tries / 2), self._marks[0])
        return (tries - before[0]) / (t - before[1]) if t > before[1] else math.inf

    def step(self) -> float:
        """Return the mean length of the last steps, s; 0 where there were none."""
        return (self._ends[-1] - self._ends[0]) / max(1, len(self._ends) - 1)


@dataclass
class _Leg:
    """A part of a run by one method: from when and why, and what else there is to say."""

    method: str
    t: float
    why: str = ""
    note: str = ""


def pause(trials: Trials, courses: Sequence[Course]) -> None:
    """Let tries be made up to the next look of any of the trajectories."""
    if trials.rounds > 1:
        trials.rounds = max(2, min(ROUNDS, *(course.missing for course in courses)))


class Course:
    """The decisions on one trajectory.

    Parameters
    ----------
    scene : Scene
    index : int
        Which trajectory.
    nq : int
    save : (K,) array or None
    events : tuple of Event

    Attributes
    ----------
    track : Track
    doubt : str
        What the user should know; empty where all is well.
    """

    def __init__(self, scene: Scene, index: int, nq: int, save: Array | None, events: tuple[Event, ...]) -> None:
        self._scene, self._index, self._tolerances = scene, index, scene.tolerances
        self.track = _Track(scene.space, nq, index, scene.batch, save, events, scene.tolerances)
        self.doubt = ""
        self._legs = [_Leg(EXPLICIT, 0.0)]
        self._gauge: _Gauge | None = None
        self._at: tuple[float, Array, Array] = 0.0, np.empty(0), np.empty(0)
        self._next: Trials | None = None
        self._ahead: list[Stretch] = []
        self._tries = 0
        self._stalled_at = -1.0

    # On the way

    @property
    def missing(self) -> int:
        """Tries until the next look."""
        return self._pace.first if self._gauge is None else max(1, self._gauge.missing)

    @property
    def _pace(self) -> _Pace:
        return _COMPILED if self._scene.compiled else _IN_PYTHON

    @property
    def _rest(self) -> float:
        return self._scene.duration - self._at[0]

    @property
    def _over(self) -> bool:
        member = self.track.member
        return member.ended != "finished" or member.reached >= self._scene.duration

    def leaves(self, trials: Trials, place: int, made: Stretch) -> bool:
        """Look at what was made; return whether other tries go on from its end."""
        if self._gauge is None:
            self._gauge = _Gauge(float(made.t[0]), self._pace)
        self._gauge.saw(made)
        self._tries += made.tried
        self._at = float(made.t[-1]), made.q[-1], made.w[-1]
        if self.track.stalled:
            self.track.stalled = False
            self._rescue()
        elif not self._over and self._gauge.due():
            (self._look if self._legs[-1].method == EXPLICIT else self._look_back)(trials, place, self._gauge)
        return self._next is not None

    def alone(self, tell: Callable[[], None]) -> None:
        """Go on to the end, where other tries were to."""
        stops = self._scene.stops
        while self._next is not None and not self._over:
            trials, self._next, self._gauge = self._next, None, None
            first = int(np.searchsorted(stops, self._at[0], side="right"))
            ahead, self._ahead = self._ahead, []
            pause(trials, [self])
            for made in march(trials, [self.track], stops, first, ahead):
                if self.leaves(trials, 0, made[0][1]):
                    trials.drop(0)
                pause(trials, [self])
                tell()

    def _begin(self, method: str, t: float) -> Trials:
        """Return tries that begin here."""
        t, q, w = self._at
        trials = self._scene.make(method, self._tolerances)
        trials.start([self._index], q[None], w[None], t, _BEGIN * self._rest if method == IMPLICIT else 0.0)
        return trials

    def _go_on(self, method: str, why: str, note: str = "") -> None:
        self._legs.append(_Leg(method, self._at[0], why, note))

    # Looks

    def _look(self, trials: Trials, place: int, gauge: _Gauge) -> None:
        """Decide on rk853."""
        tries, step = gauge.pace(), gauge.step()
        if tries * self._rest < self._pace.worth or not step:
            return
        found = self._spectrum(trials, place, min(_EDGE / step, _MANY / self._scene.duration))
        held = found is not None and step * found.stable >= _EDGE
