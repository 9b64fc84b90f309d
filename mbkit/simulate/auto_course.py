"""One trajectory of method auto: what is looked at on the way, and what follows from it.

After some tries, and each time that there are several times as many, it is asked how many more the run will take.
Where that is a lot, the linearized system (`mbkit.simulate.stiffness`) tells what holds the steps: near the edge of
rk853's region of stability, h|λ| of about 5, they are short for no other reason. There, and where very many are to
come, rodas5 makes some tries of its own from the state reached. If it gets further with them than rk853, it goes on
from their end; if not, they are forgotten, and rk853 goes on as if there had been none. The errors of many steps add
up: rk853 has a tenth of the tolerance that was asked for, and both have less where the number of steps asks for it.

While rodas5 goes on, looks at the linearized system say whether rk853 would be as fast, as where what is stiff has
come to an end. Where one method's steps fall below rounding the other one may go on; where neither can, as where a
nearly singular mass matrix leaves few digits, the tolerance is loosened, and the user told.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import FunctionError, NumericalError
from mbkit.simulate.auto_legs import Leg, kind, told
from mbkit.simulate.auto_scene import EXPLICIT, IMPLICIT, LEAST, Gauge, Scene
from mbkit.simulate.embedded import Track, march
from mbkit.simulate.embedded_trials import ROUNDS, Stretch, Trials
from mbkit.simulate.events import Event
from mbkit.simulate.members import member_of
from mbkit.simulate.methods import Tolerances
from mbkit.simulate.stiffness import Stiffness, linearized, stiffness_of

__all__ = ["Course", "pause"]

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


class _Track(Track):
    """One trajectory that may go on in another way where a method is stuck."""

    rescues = 0
    stalled = False

    def stuck(self, trials: Trials, place: int) -> bool:
        """Return whether no step can be made any more; where steps were inaccurate however short, it is not the end."""
        if trials.stuck(place) is False and self.rescues < _RESCUES:
            self.rescues += 1
            self.stalled = True
            return True
        return super().stuck(trials, place)


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
        What the user must know; empty where all is well.
    """

    def __init__(self, scene: Scene, index: int, nq: int, save: Array | None, events: tuple[Event, ...]) -> None:
        self._scene, self._index = scene, index
        member = member_of(scene.dyn, None if scene.batch is None else index, scene.start, scene.duration)
        self.track = _Track(scene.space, nq, index, scene.batch, save, events, scene.tolerances, member)
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
        self._next: Trials | None = None
        self._pilot_from = 0
        self._ahead: list[Stretch] = []

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

    def leaves(self, trials: Trials, place: int, made: Stretch) -> bool:
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

    def _goes_on(self, trials: Trials, made: Stretch) -> bool:
        taken = self.track.take(trials, 0, made)
        return taken and not self.leaves(trials, 0, made)

    @property
    def _interval(self) -> int:
        return int(np.searchsorted(self._scene.stops, self._at[0], side="right"))

    def _begun(self, method: str) -> Trials:
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

    def _look(self, trials: Trials, place: int, gauge: Gauge) -> None:
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

    def _add_up(self, trials: Trials, place: int, gauge: Gauge) -> None:
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

    def _look_back(self, trials: Trials, place: int, gauge: Gauge) -> None:
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

    def _spectrum(self, trials: Trials, place: int, enough: float) -> Stiffness | None:
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

    def _tolerate(self, trials: Trials, place: int, to_come: float) -> None:
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

    def _rounds(self, trials: Trials, place: int, step: float, found: Stiffness | None) -> bool:
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

    def _rough(self, trials: Trials, place: int, step: float, near: float) -> tuple[float, float]:
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
            "mbkit.dynamics(model, 'oracle') and method='taylor'"
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
