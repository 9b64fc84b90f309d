"""Method auto: stiffness detection and switching between rk853 and rodas5.

Checks come after some steps, and each time that there are several times as many. Where many steps remain and h|λ| is
near the edge of rk853's stability region (as in LSODA), or where very many remain, rodas5 tries some steps, and goes on
if it gets further. rk853 returns where it would be as fast. Tolerances follow the number of steps, whose errors add up.
Decisions rest on counts and states, never on a clock, so that a run repeats to the bit.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines.base import MAX_NAMES
from mbkit.errors import FunctionError, NumericalError
from mbkit.methods.registry import ADAPTIVE_METHOD, SERIES_METHOD, STIFF_METHOD, Tolerances
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.solvers.adaptive import make_attempts, march, run_groups
from mbkit.simulate.solvers.step_attempts import StepAttempts
from mbkit.simulate.solvers.trajectory_record import ROUNDS, AcceptedSteps, TrajectoryRecord, assemble_result
from mbkit.simulate.stiffness_measure import Stiffness, linearized, stiffness_of

EXPLICIT, IMPLICIT = ADAPTIVE_METHOD, STIFF_METHOD
#: Tightest relative tolerance: below it rounding would count as error, and steps shrink without end.
MIN_RTOL: Final = 1e-13
#: Share of the tolerance that rk853 has: with the whole of it, errors of a thousand steps come to 500 times as much,
#: and a tenth costs a third more steps.
_RK853_SHARE: Final = 0.1
#: Number of steps whose mean length is compared with the rates where they end.
_MEAN_STEPS: Final = 8
#: h|λ| from which on stability holds rk853's steps: its region reaches to 6 on the negative and 5 on the imaginary
#: axis; steps that follow an oscillation at a tolerance of 1e-6 or less have 2 at most.
_STABILITY_LIMIT: Final = 3.0
#: h|λ| up to which steps follow every motion of the linearized system, so that rodas5 is not tried: it could not take
#: longer ones for long, and where steps are short in passing alone, a trial would get further as they grow.
_FOLLOWING_LIMIT: Final = 0.2
#: Errors of n steps, in a mean over 2 nv numbers, add up to n √(2 nv) tolerances at most: the limit, in the user's
#: tolerances. Measured is a third to a three-hundredth of it.
_MAX_ERROR_SUM: Final = 300.0
#: Factor by which a tolerance is loosened where rounding keeps steps short.
_LOOSENING: Final = 10.0
#: Share of a step within which a cubic is fitted to accelerations. Its residual is their rounding: a smooth function
#: has next to none there.
_NOISE_SPAN: Final = 0.003
_NOISE_PLACES: Final = np.linspace(0.0, 1.0, 12)[:, None]
_CUBIC: Final = np.linalg.qr(_NOISE_PLACES ** np.arange(4))[0]
_CUBIC_RESIDUAL: Final = np.eye(len(_NOISE_PLACES)) - _CUBIC @ _CUBIC.T
_RESIDUAL_FREEDOM: Final = len(_NOISE_PLACES) - 4
#: Largest rounding of accelerations times a step, in tolerances; rk853's weights make an error twice as large of it.
_MAX_NOISE: Final = 0.015
#: Cost of a check, in steps of rk853: so many come before the first. Measured by validation/auto.py in processor
#: time: 50 to 100 in machine code, 2 to 5 in Python; a trial takes 60 and 15, a step of rodas5 0.5 to 1.6.
_CHECK_COST_COMPILED: Final = 64
_CHECK_COST_IN_PYTHON: Final = 5
#: Factor of the steps from one check to the next.
_CHECK_GROWTH: Final = 3
#: A check is worth its time where steps of so many times its cost are to come, and a trial of rodas5 where of so many.
_MIN_COSTS_AHEAD: Final = 20
_MIN_COSTS_FOR_TRIAL: Final = 60
#: Number of steps of a trial.
_TRIAL_STEPS: Final = 12


class AutoContext:
    """What all trajectories of a run share: the problem, what a check takes, and all attempts."""

    def __init__(self, problem: IntegrationProblem) -> None:
        self.problem, self.space, self.stops = problem, Space(problem.dyn.model), problem.stops
        self.attempts: list[StepAttempts] = []
        self.check = _CHECK_COST_IN_PYTHON

    def make(self, method: str, tolerances: Tolerances) -> StepAttempts:
        """Return the step attempts of a method, whose evaluations are counted with all others."""
        attempts = make_attempts(self.problem, method, self.space, tolerances)
        self.attempts.append(attempts)
        self.check = _CHECK_COST_COMPILED if attempts.rounds > 1 else _CHECK_COST_IN_PYTHON
        return attempts


def _scaled(tolerances: Tolerances, factor: float) -> Tolerances:
    return Tolerances(*(factor * x for x in tolerances))


def loosest(method: str, base: Tolerances) -> Tolerances:
    """Return the loosest tolerances of a method."""
    return base if method == IMPLICIT else _scaled(base, min(1.0, max(_RK853_SHARE, MIN_RTOL / base.rtol)))


class StepRateMonitor:
    """How fast a method goes, judged by the later half of its attempts."""

    def __init__(self, t: float, first: int) -> None:
        self._next = first
        # Attempts and time; the ends of the last steps.
        self._begin = t
        self._marks = [(0, t)]
        self._ends = [t]

    @property
    def missing(self) -> int:
        """Attempts until the next check."""
        return self._next - self._marks[-1][0]

    def saw(self, steps: AcceptedSteps) -> None:
        """Count attempts."""
        tries = self._marks[-1][0]
        if steps.attempts > 1:
            self._marks.append((tries + steps.attempts // 2, float(steps.t[len(steps.t) // 2])))
        self._marks.append((tries + steps.attempts, float(steps.t[-1])))
        self._ends = [*self._ends, *steps.t[1:].tolist()][-_MEAN_STEPS - 1 :]

    def due(self) -> bool:
        """Return whether a check is due."""
        due = self.missing <= 0
        if due:
            self._next = _CHECK_GROWTH * self._marks[-1][0]
        return due

    def rate(self) -> float:
        """Return the attempts for each second of the motion."""
        half = self._marks[-1][0] / 2
        return self._since(next((mark for mark in reversed(self._marks) if mark[0] <= half), self._marks[0]))

    def overall(self) -> float:
        """Return the attempts for each second of the motion from the beginning."""
        return self._since((0, self._begin))

    def _since(self, mark: tuple[int, float]) -> float:
        tries, t = self._marks[-1]
        return (tries - mark[0]) / (t - mark[1]) if t > mark[1] else math.inf

    def step(self) -> float:
        """Return the mean length of the last steps, s; 0 where there were none."""
        return (self._ends[-1] - self._ends[0]) / max(1, len(self._ends) - 1)


@dataclass
class Segment:
    """A part of a run by one method: its start, the reason, and a note."""

    method: str
    t: float
    why: str = ""
    note: str = ""


def march_watched(
    attempts: StepAttempts, controllers: Sequence[SwitchingController], first: int, report: Callable[[], None]
) -> None:
    """Take trajectories from stop `first` on to the end, or to where another method goes on."""

    def to_next_check(places: Iterable[int]) -> None:
        if attempts.rounds > 1:
            attempts.rounds = max(2, min(ROUNDS, *(controllers[place].missing for place in places)))

    to_next_check(range(len(controllers)))
    for accepted in march(attempts, [x.record for x in controllers], controllers[0].context.stops, first):
        for place, steps in accepted:
            if controllers[place].leaves(attempts, place, steps):
                attempts.drop(place)
        to_next_check(place for place, _ in accepted)
        report()


class SwitchingController:
    """Stiffness detection and switching for one trajectory, and its adaptive tolerance."""

    def __init__(self, context: AutoContext, index: int) -> None:
        problem = context.problem
        self.context, self._index, self._user = context, index, problem.tolerances
        self.record = TrajectoryRecord(problem, index, context.space)
        self.doubt = ""
        # The first is the user's or loosened, the second for the number of steps.
        self._base, self._tolerances = self._user, loosest(EXPLICIT, self._user)
        self._least, self._tightest = MIN_RTOL, math.inf
        # rk853's h|λ| when it was left: where accuracy kept its steps short, it would do so again.
        self._kept = 0.0
        self._segments = [Segment(EXPLICIT, problem.start)]
        self._monitor: StepRateMonitor | None = None
        self._at: tuple[float, Array, Array] = problem.start, np.empty(0), np.empty(0)
        self._tries = self._returns = 0
        self._next: StepAttempts | None = None
        self._ahead: list[AcceptedSteps] = []

    @property
    def _method(self) -> str:
        return self._segments[-1].method

    @property
    def missing(self) -> int:
        """Attempts until the next check."""
        return self._first if self._monitor is None else max(1, self._monitor.missing)

    @property
    def _first(self) -> int:
        # Later after each return, so that the methods do not take turns for ever.
        return self.context.check << 2 * (self._returns if self._method == EXPLICIT else 0)

    @property
    def _rest(self) -> float:
        return self.context.problem.end - self._at[0]

    @property
    def _over(self) -> bool:
        return self.record.ended != "finished" or self.record.reached >= self.context.problem.end

    @property
    def _interval(self) -> int:
        return self.context.problem.interval(self._at[0])

    def leaves(self, attempts: StepAttempts, place: int, steps: AcceptedSteps) -> bool:
        """Add accepted steps; return whether another method goes on from their end."""
        if self._monitor is None:
            self._monitor = StepRateMonitor(float(steps.t[0]), self._first)
        self._monitor.saw(steps)
        self._tries += steps.attempts
        self._at = float(steps.t[-1]), steps.q[-1], steps.w[-1]
        if not self._over and self._monitor.due():
            check = self._check_stiff if self._method == EXPLICIT else self._check_nonstiff
            check(attempts, place, self._monitor)
        return self._next is not None

    def alone(self, report: Callable[[], None]) -> None:
        """Go on to the end with the methods that follow."""
        while self._next is not None and not self._over:
            attempts, self._next, self._monitor = self._next, None, None
            ahead, self._ahead = self._ahead, []
            within = partial(attempts.within, 0)
            if all(self.record.take(steps, within) and not self.leaves(attempts, 0, steps) for steps in ahead):
                march_watched(attempts, [self], self._interval, report)

    def _started(self, method: str) -> StepAttempts:
        """Return step attempts of a method that begin here."""
        t, q, w = self._at
        attempts = self.context.make(method, loosest(method, self._base))
        attempts.start([self._index], q[None], w[None], t, 0.0)
        return attempts

    def _switch(self, method: str, attempts: StepAttempts, why: str) -> None:
        self._next, self._tolerances = attempts, loosest(method, self._base)
        self._segments.append(Segment(method, self._at[0], f"where {why}"))

    def _check_stiff(self, attempts: StepAttempts, place: int, monitor: StepRateMonitor) -> None:
        """Check whether rodas5 shall take over."""
        rate, step, check = monitor.rate(), monitor.step(), self.context.check
        to_come = rate * self._rest
        if to_come >= _MIN_COSTS_AHEAD * check and step:
            rates = self._spectrum(attempts, place)
            if self._rounding_limited(attempts, place, step):
                return
            held = rates is not None and step * rates.stable >= _STABILITY_LIMIT
            # Compared with the steps as they are now, which may be short in passing only.
            fast = rates is None or step * rates.stable >= _FOLLOWING_LIMIT
            if (held or (fast and to_come >= _MIN_COSTS_FOR_TRIAL * check)) and (trial := self._faster_trial(1 / step)):
                why = "stability held its steps" if held else "rodas5 got further with a trial"
                size = "" if rates is None else f" (h|λ| = {step * rates.stable:.1f}; {rates})"
                self._switch(IMPLICIT, trial, why + size)
                self._kept = 0.0 if rates is None else step * rates.stable
                return
        # By the mean rate, which passing changes hardly touch.
        self._adapt_tolerance(attempts, place, monitor.overall() * self._rest)

    def _faster_trial(self, rate: float) -> StepAttempts | None:
        """Let rodas5 try some steps, which are the next ones if it is faster than this rate."""
        trial, ahead, count = self._started(IMPLICIT), list[AcceptedSteps](), 0
        monitor = StepRateMonitor(self._at[0], _TRIAL_STEPS)
        if trial.rounds > 1:
            trial.rounds = _TRIAL_STEPS
        try:
            trial.hold(self._interval, self.context.stops[self._interval])
            while count < _TRIAL_STEPS and (accepted := trial.advance()):
                ahead.append(accepted[0][1])
                monitor.saw(ahead[-1])
                count += ahead[-1].attempts
        except FunctionError:
            # rk853 may never reach this state.
            return None
        # With the tolerance for so many steps.
        tighter = self._factor(IMPLICIT, monitor.rate() * self._rest) ** (-1 / 5)
        if not tighter * monitor.rate() < rate:
            return None
        self._ahead = ahead
        return trial

    def _check_nonstiff(self, attempts: StepAttempts, place: int, monitor: StepRateMonitor) -> None:
        """Check whether rk853 shall take over again."""
        rate = monitor.rate()
        to_come = rate * self._rest
        if to_come >= _MIN_COSTS_AHEAD * self.context.check:
            rates = self._spectrum(attempts, place)
            if rates is not None and rates.stable < self._kept * rate:
                self._returns += 1
                self._switch(EXPLICIT, self._started(EXPLICIT), f"stability no longer held rk853's steps ({rates})")
                return
        self._adapt_tolerance(attempts, place, to_come)

    def _spectrum(self, attempts: StepAttempts, place: int) -> Stiffness | None:
        """Return the rates of the linearized motion; None where they are not finite."""
        _, q, w = self._at
        try:
            J = linearized(self.context.space, q, w, partial(attempts.rates, place))
            return stiffness_of(J, 0.0, exact=False)
        except (NumericalError, FunctionError):
            return None

    def _factor(self, method: str, to_come: float) -> float:
        """Return the factor of the tolerance with which the errors of the steps to come add up to the allowed sum.

        Those until the next check count: then there is another one, and the first steps may be short.
        """
        steps = max(1.0, min(to_come, _CHECK_GROWTH * self._tries))
        share = loosest(method, self._base).rtol / self._base.rtol
        return min(share, _MAX_ERROR_SUM / (steps * math.sqrt(2 * self.context.space.nv)))

    def _adapt_tolerance(self, attempts: StepAttempts, place: int, to_come: float) -> None:
        """Adapt the tolerance to the number of steps to come."""
        if not math.isfinite(to_come):
            return
        segment = self._segments[-1]
        factor = max(self._factor(segment.method, to_come), min(1.0, self._least / self._base.rtol))
        rtol = factor * self._base.rtol
        # A smaller change hardly changes a step.
        if not 0.5 < rtol / self._tolerances.rtol < 2.0:
            self._tolerances = _scaled(self._base, factor)
            attempts.tighten(place, self._tolerances)
            if rtol < loosest(segment.method, self._base).rtol and (not segment.note or rtol < self._tightest):
                self._tightest = rtol
                segment.note = f"at rtol = {rtol:.0e} at the tightest, as errors of {to_come:.0e} steps add up"

    def _rounding_limited(self, attempts: StepAttempts, place: int, step: float) -> bool:
        """Return whether rounding holds rk853's steps short, and loosen the tolerance there."""
        share, noise = self._rounding_noise(attempts, place, step)
        limited = share > _MAX_NOISE
        loosened = self._base.rtol > self._user.rtol or self._least == math.inf
        if limited:
            self._loosen(noise)
        elif loosened and share * self._tolerances.rtol / loosest(EXPLICIT, self._user).rtol < _MAX_NOISE:
            # The noise is passed.
            self._base, self._least = self._user, MIN_RTOL
        else:
            return False
        self._adapt_tolerance(attempts, place, 0.0)
        return limited

    def _rounding_noise(self, attempts: StepAttempts, place: int, step: float) -> tuple[float, float]:
        """Return the part of rounding in a step's estimated error, beside the tolerance, and in accelerations."""
        (_, q, w), space = self._at, self.context.space
        try:
            k = attempts.rates(place, q[None], w[None])
            ahead = _NOISE_SPAN * step * _NOISE_PLACES
            moved = space.retract(np.broadcast_to(q, (len(ahead), len(q))), ahead * w)
            rates = attempts.rates(place, moved, w + ahead * k)
        except FunctionError:
            return 0.0, 0.0
        rtol, atol = self._tolerances
        scatter = np.sqrt(np.sum((_CUBIC_RESIDUAL @ rates) ** 2, axis=0) / _RESIDUAL_FREEDOM)
        share = step * float(np.sqrt(np.mean((scatter / (atol + rtol * np.abs(w))) ** 2)))
        return share, float(scatter.max() / max(np.abs(k).max(), np.finfo(float).tiny))

    def _loosen(self, noise: float) -> None:
        """Loosen the tolerance where rounding, this part of the accelerations, does not allow it."""
        if self._tolerances.rtol < self._base.rtol:
            # The user's own may still be possible.
            self._least = math.inf
            return
        self._base = _scaled(self._base, _LOOSENING)
        self.doubt = (
            f"near t = {self._at[0]:.6g} s accelerations are known to {noise:.0e} of themselves, which is not enough "
            f"for rtol = {self._user.rtol:g}; there it took {self._base.rtol:.0e}. Leave out what has next to no mass, "
            f"or compute with 34 digits: mbkit.dynamics(model, 'oracle') and method={SERIES_METHOD!r}"
        )

    def method_sequence(self) -> str:
        """Return the methods in their order."""
        methods = [segment.method for segment in self._segments]
        return f"{methods[0]} throughout" if len(methods) == 1 else ", then ".join(methods)

    def describe(self) -> str:
        """Return what was chosen and why."""
        segments, parts = self._segments, list[str]()
        if len(segments) == 1 and not segments[0].note:
            return self.method_sequence()
        for i, segment in enumerate(segments):
            until = f" to t = {segments[i + 1].t:.3g} s, {segments[i + 1].why}" if i + 1 < len(segments) else ""
            note = f", {segment.note}" if segment.note else ""
            parts.append(segment.method + (" from there" if i else "") + (until or note))
        return "; ".join(parts)


def run_auto(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or a batch of them, of which each is decided on by itself."""
    context = AutoContext(problem)
    controllers = [SwitchingController(context, i) for i in range(len(problem.q))]
    explicit = context.make(EXPLICIT, loosest(EXPLICIT, problem.tolerances))

    def to_end(group: Sequence[TrajectoryRecord], report: Callable[[], None]) -> None:
        # Explicitly side by side; what leaves that one by one.
        own = [controllers[record.index] for record in group]
        march_watched(explicit, own, 0, report)
        for controller in own:
            controller.alone(report)

    records = [controller.record for controller in controllers]
    run_groups(problem, context.space, explicit, records, to_end)
    evaluations, jacobians = (sum(getattr(x, name) for x in context.attempts) for name in ("evaluations", "jacobians"))
    if records:
        records[0].chosen = _chosen(controllers, problem.batch)
    if all(record.ended in ("finished", "event") for record in records):
        for controller in controllers:
            controller.record.doubts += [controller.doubt] if controller.doubt else []
    return assemble_result(problem, records, evaluations=evaluations, jacobians=jacobians)


def _chosen(controllers: Sequence[SwitchingController], batch: int | None) -> str:
    if batch is None:
        return controllers[0].describe()
    sequences = [controller.method_sequence() for controller in controllers]
    kinds, parts = Counter(sequences), list[str]()
    for kind, count in kinds.most_common(MAX_NAMES):
        example = sequences.index(kind)
        text = controllers[example].describe()
        such = "" if text == kind else f", such as trajectory {example}"
        parts.append(f"{count} of {batch}{such}: {text}")
    if len(kinds) > MAX_NAMES:
        parts.append(f"and {len(kinds) - MAX_NAMES} more kinds")
    return "; ".join(parts)
