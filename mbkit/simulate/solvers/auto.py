"""The run that chooses: rk853 where steps follow the motion, rodas5 where stability alone holds them short.

It begins with rk853 and looks, after some tries and each time that their number has doubled, at how many more
the run will take (`mbkit.simulate.solvers.auto`). Everything is decided by counted tries and by states, nothing
by a clock: a run repeats to the bit.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import FunctionError, NumericalError
from mbkit.methods.registry import ADAPTIVE_METHOD, SERIES_METHOD, STIFF_METHOD, Tolerances
from mbkit.model.integration_space import Space
from mbkit.simulate.diagnostics.eigenvalues import Stiffness, linearized, stiffness_of
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.adaptive import TrajectoryRecorder, make_attempts, march, stop_times
from mbkit.simulate.solvers.step_attempts import ROUNDS, AcceptedSteps, StepAttempts
from mbkit.simulate.solvers.trajectory_record import assemble_result

__all__ = [
    "EXPLICIT",
    "IMPLICIT",
    "LEAST",
    "Course",
    "Gauge",
    "Leg",
    "Pace",
    "Scene",
    "kind",
    "pause",
    "run_auto",
    "told",
]


# What all trajectories of a run by method auto share, and how the pace of a method is taken.

EXPLICIT, IMPLICIT = ADAPTIVE_METHOD, STIFF_METHOD
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
        As of `mbkit.simulate.solvers.adaptive.stop_times`.
    pace : Pace
    """

    def __init__(self, asked: IntegrationProblem, space: Space, stops: Sequence[float]) -> None:
        self.dyn, self._torque, self.batch = asked.dyn, asked.torque, asked.batch
        self.space, self.tolerances, self.stops = space, asked.tolerances, stops
        self.start, self.end, self.duration = asked.start, asked.end, asked.duration
        self._trials: list[StepAttempts] = []
        self.pace = _IN_PYTHON

    def make(self, method: str, tolerances: Tolerances) -> StepAttempts:
        """Return what tries a method's steps; its evaluations are counted with all others."""
        given = self.dyn, self.space, tolerances, self._torque, self.duration, self.batch
        made = make_attempts(method, *given)
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

    def saw(self, made: AcceptedSteps) -> None:
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


# The parts of a run by method auto, and how they are told.

#: Changes of the method that are told one by one.
_TOLD: Final = 3


@dataclass
class Leg:
    """A part of a run by one method: from when on and why, and what else there is to say."""

    method: str
    t: float
    why: str = ""
    note: str = ""


def kind(legs: Sequence[Leg]) -> str:
    """Return the methods in their order.

    Examples
    --------
    >>> kind([Leg("rk853", 0.0)]), kind([Leg("rk853", 0.0), Leg("rodas5", 0.1)])
    ('rk853 throughout', 'rk853, then rodas5')
    """
    methods = [leg.method for leg in legs]
    return f"{methods[0]} throughout" if len(methods) == 1 else ", then ".join(methods)


def told(legs: Sequence[Leg]) -> str:
    """Return what was chosen and why.

    Examples
    --------
    >>> told([Leg("rk853", 0.0), Leg("rodas5", 0.1, "where stability held its steps")])
    'rk853 to t = 0.1 s, where stability held its steps; rodas5 from there'
    """
    parts: list[str] = []
    skipped = len(legs) - 1 - 2 * _TOLD
    for i, leg in enumerate(legs):
        if skipped > 0 and _TOLD < i <= _TOLD + skipped:
            if i == _TOLD + 1:
                parts.append(f"{skipped} more changes")
            continue
        part = leg.method + (" from there" if i else "")
        # What a method was given on the way to being left is of no interest.
        until = f" to t = {legs[i + 1].t:.3g} s, {legs[i + 1].why}" if i + 1 < len(legs) else ""
        parts.append(part + (until or (leg.note and f", {leg.note}")))
    return kind(legs) if len(legs) == 1 and not legs[0].note else "; ".join(parts)


# One trajectory of method auto: what is looked at on the way, and what follows from it.
#
# After some tries, and each time that there are several times as many, it is asked how many more the run will take.
# Where that is a lot, the linearized system (`mbkit.simulate.stiffness`) tells what holds the steps: near the edge of
# rk853's region of stability, h|λ| of about 5, they are short for no other reason. There, and where very many are to
# come, rodas5 makes some tries of its own from the state reached. If it gets further with them than rk853, it goes on
# from their end; if not, they are forgotten, and rk853 goes on as if there had been none. The errors of many steps add
# up: rk853 has a tenth of the tolerance that was asked for, and both have less where the number of steps asks for it.
#
# While rodas5 goes on, looks at the linearized system say whether rk853 would be as fast, as where what is stiff has
# come to an end. Where one method's steps fall below rounding the other one may go on; where neither can, as where a
# nearly singular mass matrix leaves few digits, the tolerance is loosened, and the user told.

#: h|λ| from which on stability holds rk853's steps: its region reaches to 6 on the negative axis and to 5 on the
#: imaginary one; steps that follow an oscillation at a tolerance of 1e-6 or less have 2 at most.
_EDGE: Final = 3.0
#: The h|λ| that rk853 keeps at most.
_KEPT: Final = 5.0
#: By how much rodas5 must be faster.
_FASTER: Final = 1.5
#: First step of rodas5, of what remains: too long is soon found out, while growing from rk853's steps takes a
#: try for each factor of ten.
_BEGIN: Final = 1e-3
#: Fastest rate times duration from which on the tolerance follows the number of steps.
_MANY: Final = 1000.0
#: n steps with errors of the tolerance, in a norm that is a mean over 2 nv numbers, add up to at most n √(2 nv)
#: of it. They shall not exceed this much of what was asked for; measured is a third to a three-hundredth of that for
#: rk853, a tenth to a thirtieth for rodas5.
_SUM: Final = {EXPLICIT: 300.0, IMPLICIT: 1000.0}
#: Tries of rodas5 in vain are repeated when there were so many times the tries.
_PATIENCE: Final = 4
#: Steps that are believed to come, for each that there was.
_BELIEVED: Final = 64
#: Where rounding is taken for error before `LEAST`, it shows in steps that shrink with this power of the tolerance,
#: and not with the eighth root as rk853's.
_COLLAPSE: Final = 1 / 3
#: Steps of this part of a run are far from rounding.
_AWAY: Final = 1e-9
#: Where steps fall below rounding: by how much the tolerance is loosened, up to what, and how often anything is done.
_LOOSER: Final = 10.0
_LOOSEST: Final = 1e-5
_RESCUES: Final = 12
#: Points within this part of a step, by whose accelerations their rounding is judged: what a cubic through them leaves.
_NEAR: Final = 0.03
_AHEAD: Final = np.linspace(0.0, 1.0, 12)[:, None]
_CUBIC: Final = np.linalg.qr(_AHEAD ** np.arange(4))[0]
_ROUGH: Final = np.eye(len(_AHEAD)) - _CUBIC @ _CUBIC.T
_LEFT: Final = len(_AHEAD) - 4
#: Of a step's estimated error that is rounding: the length of rk853's weights, and the part that is too much.
_WEIGHT: Final = 2.0
_ROUNDED: Final = 0.03


class _Recorder(TrajectoryRecorder):
    """One trajectory that may go on in another way where a method is stuck."""

    rescues = 0
    stalled = False

    def stuck(self, trials: StepAttempts, place: int) -> bool:
        """Return whether no step can be made any more; where steps were inaccurate however short, it is not the end."""
        if trials.stuck(place) is False and self.rescues < _RESCUES:
            self.rescues += 1
            self.stalled = True
            return True
        return super().stuck(trials, place)


def pause(trials: StepAttempts, courses: Sequence[Course]) -> None:
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
    asked : IntegrationProblem

    Attributes
    ----------
    track : TrajectoryRecorder
    doubt : str
        What the user must know; empty where all is well.
    """

    def __init__(self, scene: Scene, index: int, asked: IntegrationProblem) -> None:
        self._scene, self._index = scene, index
        self.track = _Recorder(asked, scene.space, index)
        self.doubt = ""
        # As asked for or loosened, and as tightened.
        self._base, self._tolerances = scene.tolerances, scene.granted(EXPLICIT, scene.tolerances)
        self._legs = [Leg(EXPLICIT, scene.start)]
        self._gauge: Gauge | None = None
        self._at: tuple[float, Array, Array] = scene.start, np.empty(0), np.empty(0)
        self._tries = 0
        # At the last look at rk853: its tolerance and the tries for each second.
        self._looser = self._tolerances.rtol, 0.0
        self._tightest = math.inf
        # h|λ| of rk853 when it was left.
        self._kept = _KEPT
        self._returns = 0
        self._least = LEAST
        self._next: StepAttempts | None = None
        self._pilot_from = 0
        self._ahead: list[AcceptedSteps] = []

    # On the way

    @property
    def missing(self) -> int:
        """Tries until the next look."""
        return self._first if self._gauge is None else max(1, self._gauge.missing)

    @property
    def _first(self) -> int:
        # Later after each return, lest the methods take turns for ever.
        returns = self._returns if self._legs[-1].method == EXPLICIT else 0
        return self._scene.pace.first << 2 * returns

    @property
    def _rest(self) -> float:
        return self._scene.end - self._at[0]

    @property
    def _over(self) -> bool:
        member = self.track.member
        return member.ended != "finished" or member.reached >= self._scene.end

    def leaves(self, trials: StepAttempts, place: int, made: AcceptedSteps) -> bool:
        """Look at what was made and taken in; return whether other tries go on from its end."""
        if self._gauge is None:
            self._gauge = self._scene.gauge(float(made.t[0]), self._first)
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
        while self._next is not None and not self._over:
            trials, self._next, self._gauge = self._next, None, None
            ahead, self._ahead = self._ahead, []
            if all(self._goes_on(trials, made) for made in ahead):
                pause(trials, [self])
                for (_, made), *_ in march(trials, [self.track], self._scene.stops, self._interval):
                    if self.leaves(trials, 0, made):
                        trials.drop(0)
                    pause(trials, [self])
                    tell()

    def _goes_on(self, trials: StepAttempts, made: AcceptedSteps) -> bool:
        taken = self.track.take(trials, 0, made)
        return taken and not self.leaves(trials, 0, made)

    @property
    def _interval(self) -> int:
        return int(np.searchsorted(self._scene.stops, self._at[0], side="right"))

    def _begun(self, method: str) -> StepAttempts:
        """Return tries of a method that begin here."""
        t, q, w = self._at
        trials = self._scene.make(method, self._granted(method))
        trials.start([self._index], q[None], w[None], t, _BEGIN * self._rest if method == IMPLICIT else 0.0)
        return trials

    def _granted(self, method: str) -> Tolerances:
        """Return the loosest tolerances that a method has here."""
        return self._scene.granted(method, self._base)

    def _turn(self, method: str, why: str) -> None:
        """Go on with a method from here."""
        self._next, self._tolerances = self._begun(method), self._granted(method)
        self._looser = self._tolerances.rtol, 0.0
        self._legs.append(Leg(method, self._at[0], why))

    # Looks

    def _look(self, trials: StepAttempts, place: int, gauge: Gauge) -> None:
        """Decide on rk853."""
        rate, step, pace = gauge.rate(), gauge.step(), self._scene.pace
        to_come = rate * self._rest
        if to_come < pace.worth or not step:
            self._add_up(trials, place, gauge)
            return
        found = self._spectrum(trials, place, min(_EDGE / step, _MANY / self._scene.duration))
        if self._rounds(trials, place, step, found):
            return
        held = found is not None and step * found.stable >= _EDGE
        # Not where steps have been short alone, but where they are.
        worth = (held or to_come >= pace.guess) and self._tries >= self._pilot_from
        if worth and self._faster(min(rate, 1 / step)):
            seen = "" if found is None else f"; {found}"
            why = "stability held its steps" if held else "rodas5 got further with a try"
            size = "" if found is None else f" (h|λ| = {step * found.stable:.1f}{seen})"
            self._legs.append(Leg(IMPLICIT, self._at[0], f"where {why}{size}"))
            if found is not None:
                self._kept = min(_KEPT, step * found.stable) or _KEPT
            return
        if worth:
            self._pilot_from = _PATIENCE * self._tries
        self._mind(rate)
        self._add_up(trials, place, gauge)

    def _add_up(self, trials: StepAttempts, place: int, gauge: Gauge) -> None:
        """Let the tolerance follow the steps of rk853, by the pace of the whole leg.

        What comes and goes is no sign of what is to come.
        """
        self._tolerate(trials, place, gauge.overall() * self._rest)

    def _faster(self, rate: float) -> bool:
        """Let rodas5 try, and make its tries the next ones if it is faster."""
        pace, trials = self._scene.pace, self._begun(IMPLICIT)
        gauge, ahead, tried = self._scene.gauge(self._at[0], pace.pilot), [], 0
        if trials.rounds > 1:
            trials.rounds = pace.pilot
        try:
            trials.hold(self._interval, self._scene.stops[self._interval])
            while tried < pace.pilot and (got := trials.advance()):
                ahead.append(got[0][1])
                gauge.saw(ahead[-1])
                tried += ahead[-1].tried
        except FunctionError:
            # Of a state where rk853 may never come.
            return False
        # With the tolerance that so many steps ask for.
        tighter = (self._factor(IMPLICIT, gauge.rate() * self._rest) / pace.freely) ** (-1 / 5)
        better = bool(pace.dearer * _FASTER * tighter * gauge.rate() < rate)
        if better:
            self._next, self._ahead, self._tolerances = trials, ahead, self._granted(IMPLICIT)
            self._looser = self._tolerances.rtol, 0.0
        return better

    def _look_back(self, trials: StepAttempts, place: int, gauge: Gauge) -> None:
        """Decide on rodas5."""
        pace, rate = self._scene.pace, gauge.rate()
        # Steps may be growing still.
        to_come = min(rate, 1 / gauge.step() if gauge.step() else math.inf) * self._rest
        collapsed = self._mind(rate)
        if pace.dearer * to_come >= pace.worth and gauge.step() > _AWAY * self._scene.duration and not collapsed:
            found = self._spectrum(trials, place, 0.0)
            if found is not None and found.stable / self._kept < pace.dearer * rate:
                self._returns += 1
                self._turn(EXPLICIT, f"where stability no longer held rk853's steps ({found})")
                return
        self._tolerate(trials, place, to_come)

    def _mind(self, rate: float) -> bool:
        """Note the tries for each second, and return whether the tolerance before would have been better."""
        before, slower = self._looser
        collapsed = bool(slower and rate / slower > (before / self._tolerances.rtol) ** _COLLAPSE > 1)
        if collapsed:
            # Of rodas5, half the way would do: what it meets is an oscillation of its rounding.
            self._least = before if self._legs[-1].method == EXPLICIT else 2 * self._tolerances.rtol
        self._looser = self._tolerances.rtol, rate
        return collapsed

    def _spectrum(self, trials: StepAttempts, place: int, enough: float) -> Stiffness | None:
        """Return how fast the motions here are; None where that is no number."""
        _, q, w = self._at
        try:
            J = linearized(self._scene.space, q, w, lambda q, w: trials.rates(place, q, w))
            return stiffness_of(J, enough, exact=False)
        except (NumericalError, FunctionError):
            return None

    def _factor(self, method: str, to_come: float) -> float:
        """Return what the tolerance is multiplied by, so that the errors of all steps to come are as small together."""
        steps = max(1.0, min(to_come, _BELIEVED * self._tries))
        share = self._granted(method).rtol / self._base.rtol
        return min(share, _SUM[method] / (steps * math.sqrt(2 * self._scene.space.nv)))

    def _tolerate(self, trials: StepAttempts, place: int, to_come: float) -> None:
        """Let the tolerance follow the number of steps to come."""
        if not math.isfinite(to_come):
            return
        leg = self._legs[-1]
        factor = max(self._factor(leg.method, to_come), min(1.0, self._least / self._base.rtol))
        rtol, atol = (x * factor for x in self._base)
        # A change that hardly changes a step is none.
        if not 0.5 < rtol / self._tolerances.rtol < 2.0:
            self._tolerances = Tolerances(rtol, atol)
            trials.tighten(place, self._tolerances)
            if rtol < self._granted(leg.method).rtol and (not leg.note or rtol < self._tightest):
                self._tightest = rtol
                leg.note = f"at rtol = {rtol:.0e} at the tightest, as errors of {to_come:.0e} steps add up"

    def _rounds(self, trials: StepAttempts, place: int, step: float, found: Stiffness | None) -> bool:
        """Return whether rounding takes part in the errors that hold rk853's steps, and let it have less part."""
        share, rough = self._rough(trials, place, step, _NEAR)
        # What is smooth is far smoother nearer by.
        nearer = self._rough(trials, place, step, _NEAR / 10)[0] if share > _ROUNDED else 0.0
        # Steps near rounding themselves are too short for either, and for all motions there are.
        crawls = step < _AWAY * self._scene.duration and found is not None and step * found.rate < _ROUNDED
        if nearer > _ROUNDED or crawls:
            self._loosen(0.0 if crawls else rough, enough=self._tolerances.rtol < self._base.rtol)
            self._tolerate(trials, place, 0.0)
            return True
        asked = self._scene.tolerances
        loosened = self._base.rtol > asked.rtol or self._least == math.inf
        if loosened and share * self._tolerances.rtol / self._scene.granted(EXPLICIT, asked).rtol < _ROUNDED:
            # What was rough is passed.
            self._base, self._least = asked, LEAST
            self._tolerate(trials, place, 0.0)
        return False

    def _rough(self, trials: StepAttempts, place: int, step: float, near: float) -> tuple[float, float]:
        """Return what rounding makes of a step's estimated error, in terms of the tolerance, and of accelerations."""
        (_, q, w), space = self._at, self._scene.space
        try:
            k = trials.rates(place, q[None], w[None])
            ahead = near * step * _AHEAD
            found = trials.rates(place, space.move(np.broadcast_to(q, (len(ahead), len(q))), ahead * w), w + ahead * k)
        except FunctionError:
            return 0.0, 0.0
        rtol, atol = self._tolerances
        scatter = np.sqrt(np.sum((_ROUGH @ found) ** 2, axis=0) / _LEFT)
        share = _WEIGHT * step * float(np.sqrt(np.mean((scatter / (atol + rtol * np.abs(w))) ** 2)))
        return share, float(scatter.max() / max(np.abs(k).max(), np.finfo(float).tiny))

    def _loosen(self, rough: float, *, enough: bool) -> bool:
        """Ask for less where rounding does not give more; return whether that could be done.

        Parameters
        ----------
        rough : float
            What rounding makes of accelerations, of themselves; 0 where that is not known.
        enough : bool
            Whether it may be enough to ask for no more than what the user asked for.
        """
        if enough:
            self._least = math.inf
            return True
        asked, t, before = self._scene.tolerances.rtol, self._at[0], self._base.rtol
        self._base = Tolerances(*(min(_LOOSER * x, max(x, _LOOSEST)) for x in self._base))
        digits = f"to {rough:.0e} of themselves" if rough else "to few digits"
        self.doubt = (
            f"near t = {t:.6g} s accelerations are known {digits}, which is not enough for rtol = {asked:g}; there "
            f"it took {self._base.rtol:.0e}. Leave out what has next to no mass, or compute with 34 digits: "
            f"mbkit.dynamics(model, 'oracle') and method={SERIES_METHOD!r}"
        )
        return self._base.rtol > before

    def _rescue(self) -> None:
        """Go on where steps fell below rounding: by the other method, and each second time with a looser tolerance."""
        method = self._legs[-1].method
        if self.track.rescues % 2 == 0 and not self._loosen(0.0, enough=self._least < math.inf):
            # The next time is the last.
            self.track.rescues = _RESCUES
        self._turn(IMPLICIT if method == EXPLICIT else EXPLICIT, "where its steps fell below rounding")

    def kind(self) -> str:
        """Return the methods in their order."""
        return kind(self._legs)

    def told(self) -> str:
        """Return what was chosen and why."""
        return told(self._legs)


#: Kinds of courses of a batch that are told.
_FEW: Final = 3


def run_auto(asked: IntegrationProblem) -> SolverResult:
    """Integrate one state, or a batch of them, of which each is decided on by itself."""
    q0, v0, batch = asked.q, asked.v, asked.batch
    space = Space(asked.dyn.model)
    scene = Scene(asked, space, stop_times(asked))
    courses = [Course(scene, i, asked) for i in range(len(q0))]
    explicit = scene.make(EXPLICIT, scene.granted(EXPLICIT, asked.tolerances))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for first in range(0, len(q0), explicit.width):
            part = slice(first, first + explicit.width)
            group = _Group(courses[part], first, asked)
            try:
                for course, q, v in zip(group.courses, q0[part], v0[part], strict=True):
                    course.track.begin(q, v)
                begun = space.enter(q0[part], v0[part])
                explicit.start(range(first, first + len(group.courses)), q0[part], begun, asked.start)
                group.together(scene, explicit)
            except FunctionError as error:
                # Where the torque is a function, trajectories run one by one.
                which = getattr(error, "member", None)
                group.courses[0 if which is None else which - first].track.member.fail(error)
                break
    records = [course.track.member for course in courses]
    outcome = assemble_result(asked, records, evaluations=scene.evaluations, jacobians=scene.jacobians)
    told = outcome.ended in ("finished", "event")
    doubts = tuple(dict.fromkeys(course.doubt for course in courses if course.doubt and told))
    return replace(outcome, chosen=_chosen(courses, batch), doubts=(*outcome.doubts, *doubts))


class _Group:
    """Trajectories that begin side by side."""

    def __init__(self, courses: Sequence[Course], first: int, asked: IntegrationProblem) -> None:
        self.courses, self._first, self._asked = courses, first, asked

    def together(self, scene: Scene, explicit: StepAttempts) -> None:
        """Take all to the end: explicitly side by side, what leaves that one by one."""
        tracks = [course.track for course in self.courses]
        pause(explicit, self.courses)
        for made in march(explicit, tracks, scene.stops):
            for place, stretch in made:
                if self.courses[place].leaves(explicit, place, stretch):
                    explicit.drop(place)
            pause(explicit, [self.courses[place] for place, _ in made])
            self._tell()
        for course in self.courses:
            course.alone(self._tell)

    def _tell(self) -> None:
        asked = self._asked
        done = sum(course.track.member.reached - asked.start for course in self.courses) / asked.duration
        asked.bar.update((self._first + done) / len(asked.q))


def _chosen(courses: Sequence[Course], batch: int | None) -> str:
    if batch is None:
        return courses[0].told()
    kinds = Counter(course.kind() for course in courses)
    parts = []
    for kind, count in kinds.most_common(_FEW):
        example = next(i for i, course in enumerate(courses) if course.kind() == kind)
        told = courses[example].told()
        such = "" if told == kind else f", such as trajectory {example}"
        parts.append(f"{count} of {batch}{such}: {told}")
    if len(kinds) > _FEW:
        parts.append(f"and {len(kinds) - _FEW} more kinds")
    return "; ".join(parts)
