"""The measurement of work-precision curves: coarse settings first, then finer ones, then timings in rounds.

One engine and method as a work-precision curve: its points and its observed order.
"""

from __future__ import annotations

import contextlib
import math
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, Final, Literal, NamedTuple, TypeVar

import numpy as np

from mbkit._check import Array
from mbkit._process import fork_safe
from mbkit.catalog import pendulum
from mbkit.codegen.disk_cache import force_recompile
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.registry import find_engine
from mbkit.errors import MbkitError, UnsupportedError
from mbkit.methods.registry import METHODS, Method, method_of
from mbkit.model import Model
from mbkit.simulate import Trajectory
from mbkit.studies.measurement import Measurement, Problem, Truth, farthest, run_name
from mbkit.studies.results import Refusal
from mbkit.studies.study_runs import OUT_OF_TIME, Deadline, TooLongError, quiet_simulate, whole_steps
from mbkit.studies.worker import run

T = TypeVar("T")
#: Errors below so many times the reference's floor, or the rounding level, are not in the regression.
_MIN_ERROR_PER_FLOOR: Final = 100.0
#: Errors above this part of the motion are pre-asymptotic.
_MAX_ERROR_PER_MOTION: Final = 0.03
#: Largest spread of the slopes between neighbouring points in the regression.
_MAX_SLOPE_SPREAD: Final = 0.3
_MIN_POINTS: Final = 3
#: An error that is so many times as large has turned.
_MIN_TURNED_ERROR_RATIO: Final = 1.5
#: A sweep over the study's own grid ends after so many settings in a row that bring no smaller error.
_MAX_SETTINGS_WITHOUT_GAIN: Final = 2
#: A setting is finer if it takes at least so many times the steps: a decade of a tolerance is 1.33 at order 8.
_MIN_STEPS_RATIO: Final = 1.2
#: Larger errors may still fall again, as those of steps that are too large do.
_MAX_CONVERGED_ERROR: Final = 1e-6
#: Errors that differ by less than this part are one: that of an engine's own law, such as soft loops, at any step.
_MAX_SETTLED_SPREAD: Final = 0.01


@dataclass(frozen=True)
class Curve:
    """All settings of one engine and method: its points in the order of the sweep, coarse to fine.

    `order` is the `observed_order`, NaN where fewer than three points show it, and `order_points` is the number of
    points in its regression; `expected` is the method's own order, NaN for adaptive methods. `compile` are the seconds
    of derivation, compilation and construction with empty caches, up to the first step; NaN where that failed. For a
    method that is compiled for each tolerance, they are of one tolerance. `ended` says why there are no finer settings,
    where time ran out.
    """

    engine: str
    method: str
    points: tuple[Measurement, ...]
    order: float
    order_points: int
    expected: float
    compile: float
    ended: str = ""

    @property
    def name(self) -> str:
        """Engine and method; an engine's own integrators have it in their names."""
        return run_name(self.engine, self.method)

    @property
    def turn(self) -> Measurement | None:
        """The point of least error of a fixed step, where each finer step is worse by a half and rounding grows.

        So it is of an engine in single precision, whose error in the sum of steps is some eps / dt.
        """
        fixed = [p for p in self.points if p.setting == "dt" and math.isfinite(p.error)]
        if not fixed:
            return None
        best = min(fixed, key=lambda p: p.error)
        finer = [p.error for p in fixed if p.value < best.value]
        return best if finer and min(finer) > _MIN_TURNED_ERROR_RATIO * best.error else None

    def reach(self, error: float) -> Measurement | None:
        """Return the fastest point with at most this error, if there is one."""
        return min((p for p in self.points if p.error <= error), key=lambda p: p.seconds, default=None)


def pareto_front(items: Iterable[T], place: Callable[[T], tuple[float, float]], floor: float) -> list[T]:
    """Return what none beats in both run time and error, fastest first; below the floor all errors are equal."""
    front: list[T] = []
    for item in sorted(items, key=place):
        if not front or max(place(item)[1], floor) < max(place(front[-1])[1], floor):
            front.append(item)
    return front


class ObservedOrder(NamedTuple):
    """The order, NaN where it is not observed, and the number of points in the regression."""

    order: float
    points: int


def observed_order(steps: Sequence[float], errors: Sequence[float], *, floor: float, motion: float) -> ObservedOrder:
    """Return the slope of log error over log step in the asymptotic range.

    Left out are failed runs (NaN), errors above 3 % of the motion (pre-asymptotic), errors below 100 times the
    reference's floor, and, where errors no longer fall, those below 100 times the least of them (rounding). Of the
    rest, the regression takes the longest run of neighbours whose slopes from point to point lie within 0.3 of each
    other; of two as long, the finer. The expected order plays no part in the choice.

    Examples
    --------
    >>> result = observed_order([0.1, 0.05, 0.025], [1e-4, 0.625e-5, 0.390625e-6], floor=1e-14, motion=1.0)
    >>> round(result.order, 6), result.points
    (4.0, 3)
    """
    h, e = np.asarray(steps, dtype=float), np.asarray(errors, dtype=float)
    good = np.isfinite(e) & (e > 0) & (e < _MAX_ERROR_PER_MOTION * motion)
    h, e = h[good], e[good]
    by_step = np.argsort(-h)
    h, e = h[by_step], e[by_step]
    above = e > _MIN_ERROR_PER_FLOOR * max(floor, _rounding_level(h, e))
    x, y = np.log(h[above]), np.log(e[above])
    part = _longest_steady(x, y)
    if part is None:
        return ObservedOrder(float("nan"), 0)
    return ObservedOrder(float(np.polyfit(x[part], y[part], 1)[0]), len(x[part]))


def _rounding_level(h: Array, e: Array) -> float:
    """Return the error that finer steps no longer reduce, 0 where that level is not reached."""
    if len(e) < 2:
        return 0.0
    least = int(np.argmin(e))
    flat = least < len(e) - 1 or np.log(e[-2] / e[-1]) < 0.5 * np.log(h[-2] / h[-1])
    return float(e[least]) if flat else 0.0


def _longest_steady(x: Array, y: Array) -> slice | None:
    slopes = np.diff(y) / np.diff(x)
    best: slice | None = None
    for start in range(len(slopes)):
        for stop in range(start + _MIN_POINTS - 1, len(slopes) + 1):
            if np.ptp(slopes[start:stop]) > _MAX_SLOPE_SPREAD:
                break
            if best is None or stop + 1 - start >= best.stop - best.start:
                best = slice(start, stop + 1)
    return best


def gains_nothing(cells: Sequence[Measurement], floor: float) -> bool:
    """Return whether the last settings, coarse to fine, brought no smaller error: at the floor, or at rounding."""
    # Steps that end on the saved times can be shorter than a coarse tolerance needs: of settings that hardly add a
    # step, only the first shows whether finer ones help.
    counted = [*cells[:1]]
    for cell in cells[1:]:
        if not cell.error > floor or cell.steps >= _MIN_STEPS_RATIO * counted[-1].steps:
            counted.append(cell)
    errors = [cell.error for cell in counted]
    least = min(filter(math.isfinite, errors[:-_MAX_SETTINGS_WITHOUT_GAIN]), default=math.inf)
    last = errors[-_MAX_SETTINGS_WITHOUT_GAIN - 1 :]
    if least > _MAX_CONVERGED_ERROR:
        return len(last) > _MAX_SETTINGS_WITHOUT_GAIN and max(last) - min(last) < _MAX_SETTLED_SPREAD * min(last)
    return all(not e < max(0.5 * least, floor) or e <= floor for e in errors[-_MAX_SETTINGS_WITHOUT_GAIN:])


#: Errors are measured at the ends of this many equal parts of the horizon.
INTERVALS: Final = 10
#: The coarsest step, s, and the finest, as a part of the horizon.
_COARSEST_STEP_SECONDS: Final = 0.05
_FINEST_STEP_PART: Final = 1e-7
#: Ratio of neighbouring steps, by the method's order: an error falls by 4 to 16 at each.
_STEP_RATIOS: Final[dict[int | None, float]] = {1: 4.0, 2: 2.5, 4: 2.0, 6: 1.5}
#: Compiled evaluations that cost as much as one that is called from Python.
_EVALUATIONS_PER_PYTHON_CALL: Final = 8

#: A run shorter than this is repeated within a round, s.
_SHORT_RUN_SECONDS: Final = 2e-3
#: Parts of the time allowed until which compilation may begin, and until which every setting has run once.
_COMPILING_PART: Final = 0.5
_EXPLORING_PART: Final = 0.65
#: Part of the time that each phase has at the least, however long the phases before took.
_MIN_PHASE_PART: Final = 0.2


# The first run: derivation, compilation and construction.

#: The state of heyoka's switch at each entry of the block: it is one switch for all threads.
_HEYOKA_BEFORE: Final[list[bool]] = []
_HEYOKA_LOCK: Final = fork_safe(threading.RLock())


def first_run(model: Model, engine: str, method: str, start: Callable[[Dynamics], Any]) -> tuple[Dynamics, float]:
    """Return an engine on which `start` ran a method briefly, and the seconds of that beyond the run itself.

    Everything that belongs to the model is derived, compiled and built, whatever the caches in memory and on disk
    hold. Imports, and work that is the same for every model, come before the clock starts.
    """
    _import_for(engine, method)
    with force_recompile(), _without_heyoka_cache() if "heyoka" in sys.modules else contextlib.nullcontext():
        begun = time.perf_counter()
        dyn = dynamics(model, engine)
        start(dyn)
        cold = time.perf_counter() - begun
    begun = time.perf_counter()
    start(dyn)
    return dyn, max(0.0, cold - (time.perf_counter() - begun))


@cache
def _import_for(engine: str, method: str) -> None:
    with contextlib.suppress(MbkitError):
        quiet_simulate(dynamics(pendulum(), engine), [0.1], [0.0], 1e-3, method, save=[1e-3])


@contextlib.contextmanager
def _without_heyoka_cache() -> Iterator[None]:
    from heyoka import llvm_state

    with _HEYOKA_LOCK:
        _HEYOKA_BEFORE.append(llvm_state.get_diskcache_enabled())
        llvm_state.set_diskcache_enabled(False)
    llvm_state.clear_memcache()
    try:
        yield
    finally:
        with _HEYOKA_LOCK:
            before = _HEYOKA_BEFORE.pop()
            # The last thread to leave restores what the first one saw.
            if not _HEYOKA_BEFORE:
                llvm_state.set_diskcache_enabled(before)


@dataclass(frozen=True)
class Settings:
    """The steps, s, or tolerances of one method on one engine, coarse to fine."""

    engine: str
    method: str
    setting: Literal["dt", "rtol"]
    values: tuple[float, ...]
    #: Whether the caller chose the values, so that each is reported. Otherwise the sweep ends where finer values
    #: improve nothing or take too much work.
    required: bool

    @property
    def info(self) -> Method:
        """The method as data."""
        return method_of(self.method)

    def work(self, run: Measurement) -> int:
        """Return the cost of a run in compiled evaluations of the forward dynamics, equal on every machine."""
        each = 1 if self.info.runs_compiled(derived=find_engine(self.engine).derived) else _EVALUATIONS_PER_PYTHON_CALL
        return each * (run.evaluations or run.steps * max(self.info.stages, 1))


def plans(
    pairs: Mapping[str, Sequence[str]],
    interval: float,
    steps: Sequence[float] | None,
    tolerances: Sequence[float] | None,
) -> tuple[Settings, ...]:
    """Return the settings for every engine's methods.

    A step of the caller is shortened so that a whole number of them is an interval between two saved states; a
    tolerance below a method's least is left out.
    """
    settings = []
    for engine, name in ((engine, name) for engine, names in pairs.items() for name in names):
        method = METHODS[name]
        if method.kind == "adaptive":
            # A Taylor series is compiled for each order that a tolerance needs.
            own = [float(f"1e-{k}") for k in range(3, 16, 4 if method.extended else 1)]
            wanted = own if tolerances is None else tolerances
            values = tuple(sorted({float(x) for x in wanted if x >= method.least}, reverse=True))
            settings.append(Settings(engine, name, "rtol", values, tolerances is not None))
        else:
            wanted = _steps(method, interval) if steps is None else steps
            counts = sorted({whole_steps(interval, h) for h in wanted})
            settings.append(Settings(engine, name, "dt", tuple(interval / n for n in counts), steps is not None))
    return tuple(settings)


def _steps(method: Method, interval: float) -> tuple[float, ...]:
    ratio = _STEP_RATIOS.get(method.order, 2.0)
    coarsest = min(interval, _COARSEST_STEP_SECONDS)
    count = int(np.log(coarsest / (interval * INTERVALS * _FINEST_STEP_PART)) / np.log(ratio)) + 1
    return tuple(coarsest / ratio**k for k in range(count))


@dataclass
class _Run:
    """One setting: what was measured, the seconds of the first run and of preparing it, and the timings."""

    value: float
    cell: Measurement
    first: float = math.nan
    preparation: float = 0.0
    times: list[float] = field(default_factory=list)

    @property
    def known(self) -> bool:
        """Whether it has an error."""
        return math.isfinite(self.cell.error)

    def repeats(self, before: _Run) -> bool:
        """Whether it took the same steps."""
        new, old = self.cell, before.cell
        same = new.steps == old.steps and new.evaluations == old.evaluations > 0
        return same and self.known and before.known

    def point(self, setting: Literal["dt", "rtol"]) -> Measurement:
        """Return the measurement with its times."""
        # The first run counts only if it was not repeated.
        times = self.times or [self.first]
        low, median, high = map(float, np.percentile(times, [25, 50, 75]))
        spread = (high - low) / 2 if len(times) > 1 else math.nan
        count = len(times) if math.isfinite(times[0]) else 0
        return replace(self.cell, setting=setting, seconds=median, spread=spread, repeats=count)


class CurveMeasurement:
    """The measurement of one curve."""

    def __init__(self, problem: Problem, truth: Truth, settings: Settings) -> None:
        self.problem, self.truth, self.settings = problem, truth, settings
        #: Why the engine and method have no further points.
        self.refusal: Refusal | None = None
        self._left = list(settings.values)
        self._runs: list[_Run] = []
        self._dyn: Dynamics | None = None
        self._compile = math.nan
        #: The last run, which is not among `_runs` if it took the same steps as the one before.
        self._last: _Run | None = None
        self._ended = ""
        if not self._left:
            self._refuse(
                f"takes no tolerance below {settings.info.least:.3g}, and every tolerance asked for is smaller"
            )

    @property
    def over(self) -> bool:
        """Whether no setting is left to run."""
        return not self._left

    @property
    def expected(self) -> float:
        """Estimated seconds of the next run, with its compilation; 0 before the first."""
        return 0.0 if self._last is None else self._last.first * self._growth(self._last) + self._last.preparation

    @property
    def work(self) -> float:
        """Estimated counted work of the next run; 0 before the first."""
        last = self._last
        return 0.0 if last is None else self.settings.work(last.cell) * self._growth(last)

    def _growth(self, last: _Run) -> float:
        finer = last.value / self._left[0]
        # A method of order p takes finer**(1/p) times the steps; 2 per decade is p = 3.
        return finer if self.settings.setting == "dt" else float(finer**0.3)

    def compile(self) -> None:
        """Derive, compile and build, timed."""
        # Where the code depends on the tolerance, the middle one stands for all.
        settings, value = self.settings, self._left[len(self._left) // 2]
        with self._refusing():
            start = partial(self._start, value=value)
            self._dyn, self._compile = first_run(self.problem.model, settings.engine, settings.method, start)

    def run_next(self, limit: float) -> None:
        """Run the next setting; give up after `limit` seconds."""
        value = self._left.pop(0)
        with self._refusing():
            one = self._run(value, limit)
            before, self._last = self._last, one
            # Coarse tolerances that lead to the same steps are one point.
            if self.settings.required or before is None or not one.repeats(before):
                self._runs.append(one)
            if not self.settings.required and gains_nothing([one.cell for one in self._runs], self.truth.floor):
                self._left = []

    def _start(self, dyn: Dynamics, value: float) -> None:
        """Integrate one step, or a thousandth of an interval."""
        duration = value if self.settings.setting == "dt" else 1e-3 * float(self.truth.times[1])
        self._solve(dyn, value, np.array([duration]))

    def _solve(self, dyn: Dynamics, value: float, save: Array, limit: float | None = None) -> Trajectory:
        """Integrate to the last time; give up after `limit` seconds."""
        problem, progress = self.problem, None if limit is None else Deadline(limit).look
        more: dict[str, Any] = {self.settings.setting: value, "torque": problem.tau, "progress": progress}
        return quiet_simulate(dyn, problem.q, problem.v, float(save[-1]), self.settings.method, save=save, **more)

    def _run(self, value: float, limit: float) -> _Run:
        assert self._dyn is not None
        dyn, times, begun, preparation = self._dyn, self.truth.times, time.perf_counter(), 0.0
        try:
            self._start(dyn, value)
            preparation, begun = time.perf_counter() - begun, time.perf_counter()
            run = self._solve(dyn, value, times, limit)
        except UnsupportedError:
            raise
        except MbkitError as error:
            first, late = time.perf_counter() - begun, isinstance(error, TooLongError)
            if late and not self.settings.required:
                self.end(str(error))
            return _Run(value, Measurement(value, "slow" if late else "refused", note=str(error)), first, preparation)
        first = time.perf_counter() - begun
        return _Run(value, self.problem.measured(value, self.truth, times, dyn, run), first, preparation)

    def give_up(self, reason: str) -> None:
        """End here; settings that the caller chose are reported with the reason why they were not run."""
        if self.settings.required:
            self._runs += [_Run(value, Measurement(value, "not run", note=reason)) for value in self._left]
        elif not self._runs and self.refusal is None:
            self._refuse(reason)
        self.end(reason)

    def end(self, reason: str) -> None:
        """Run no finer setting, for this reason."""
        self._left, self._ended = [], reason

    @contextlib.contextmanager
    def _refusing(self) -> Iterator[None]:
        """Turn any error into the refusal of this curve, so that no other curve is lost."""
        try:
            yield
        except Exception as error:  # engines raise errors of many kinds
            self._refuse(str(error) if isinstance(error, MbkitError) else f"{type(error).__name__}: {error}")

    def _refuse(self, reason: str) -> None:
        name = self.settings.engine
        self.refusal = Refusal(name, self.settings.method, reason.removeprefix(f"{name}: "))
        self._left = []

    def repeatable(self) -> list[tuple[float, Callable[[], None]]]:
        """Return the runs that are worth timing again: seconds of each, and how to repeat it."""
        return [(one.first, partial(self._repeat, one)) for one in self._runs if one.known]

    def _repeat(self, one: _Run) -> None:
        assert self._dyn is not None
        count = max(1, int(_SHORT_RUN_SECONDS / one.first))
        begun = time.perf_counter()
        for _ in range(count):
            self._solve(self._dyn, one.value, self.truth.times)
        one.times.append((time.perf_counter() - begun) / count)

    def curve(self) -> Curve | None:
        """Return the curve so far, None without any point."""
        if not self._runs:
            return None
        settings, truth = self.settings, self.truth
        points = tuple(one.point(settings.setting) for one in self._runs)
        fixed = points if settings.setting == "dt" else ()
        steps, errors = [p.value for p in fixed], [p.error for p in fixed]
        motion = farthest(self.problem.model, truth.q)
        order, used = observed_order(steps, errors, floor=truth.floor, motion=motion)
        expected = float(settings.info.order) if fixed and settings.info.order is not None else math.nan
        return Curve(settings.engine, settings.method, points, order, used, expected, self._compile, self._ended)


def repetitions(seconds: Sequence[float], most: int, budget: float) -> list[int]:
    """Return how many times to repeat runs of these lengths within a budget, at most `most` each.

    Examples
    --------
    >>> repetitions([0.1, 0.1, 5.0], most=5, budget=4.0)
    [5, 5, 0]
    >>> repetitions([0.1, 1.0, 1.0], most=5, budget=4.5)
    [5, 2, 2]
    """
    counts, left = [0] * len(seconds), max(budget, 0.0)
    by_length = sorted(range(len(seconds)), key=lambda i: seconds[i])
    for k, i in enumerate(by_length):
        counts[i] = min(most, int(left / (len(by_length) - k) / seconds[i] * (1 + 1e-9)))
        left -= counts[i] * seconds[i]
    return counts


@dataclass(frozen=True)
class TimeBudget:
    """Limits of a sweep, in seconds of the processor: other load on the machine ends no sweep."""

    #: Nothing is begun after these, counted from `begun`, and no run is timed again after the usual ones.
    seconds: float
    usual: float
    #: Counted work of a run with the study's own settings; see `Settings.work`.
    work: float
    begun: float = field(default_factory=lambda: time.process_time())

    def until(self, part: float, least: float = 0.0) -> float:
        """Return when a part of `seconds` is over, leaving at least the part `least` from now on."""
        return max(self.begun + part * self.seconds, time.process_time() + least * self.seconds)


#: A curve, and why it has no further points.
Outcome = tuple[Curve | None, Refusal | None]


@dataclass(eq=False)
class Sweep:
    """The measurement of all curves: interleaved in this process, or one curve a call of an executor.

    With an executor each curve has its part of the time, however many run side by side.
    """

    problem: Problem
    truth: Truth
    settings: Sequence[Settings]
    repeats: int
    seed: int
    budget: TimeBudget
    executor: Executor | None = None

    def __post_init__(self) -> None:
        here = () if self.executor else self.settings
        self._curves = [CurveMeasurement(self.problem, self.truth, one) for one in here]
        self._answers: dict[int, Outcome] = {}

    def outcomes(self) -> list[Outcome]:
        """Return the curves and refusals so far."""
        if self.executor:
            return [self._answers.get(i, (None, None)) for i in range(len(self.settings))]
        return [(one.curve(), one.refusal) for one in self._curves]

    def steps(self) -> Iterator[tuple[float, str]]:
        """Measure; after each small step yield the fraction done and a text."""
        return self._in_executor(self.executor) if self.executor else self._here()

    def _here(self) -> Iterator[tuple[float, str]]:
        until = self.budget.until(_COMPILING_PART, _MIN_PHASE_PART)
        # Jacobians and series take longest to derive; they come last, so that the others have their time. Engines take
        # turns, so that each has a curve before the time is used up.
        engines = {x.settings.engine for x in self._curves}
        turn = {x: k for e in engines for k, x in enumerate(x for x in self._curves if x.settings.engine == e)}
        by_cost = sorted(
            self._curves, key=lambda x: (x.settings.info.stages == 0, turn[x], find_engine(x.settings.engine).derived)
        )
        for k, one in enumerate(by_cost):
            yield 0.2 * k / len(self._curves), f"compiling {one.settings.method} on {one.settings.engine}"
            if k >= len(engines) and time.process_time() > until:
                one.give_up(OUT_OF_TIME)
            elif not one.over:
                one.compile()
        begun = time.process_time()
        for one in self._coarse_to_fine(self.budget.until(_EXPLORING_PART, _MIN_PHASE_PART)):
            # Costs grow geometrically, so the root of the time shows the progress.
            done = ((time.process_time() - begun) / (_EXPLORING_PART * self.budget.usual)) ** 0.5
            yield 0.2 + 0.4 * min(done, 1.0), f"{one.settings.method} on {one.settings.engine}"
        yield 0.6, "timing"
        usual = self.budget.usual
        for k in self._repeat(max(self.budget.begun + usual, time.process_time() + _MIN_PHASE_PART * usual)):
            yield 0.6 + 0.4 * (k + 1) / self.repeats, f"timing, round {k + 1} of {self.repeats}"

    def _coarse_to_fine(self, until: float) -> Iterator[CurveMeasurement]:
        """Run each setting once, the cheapest next run of all curves first; begin none that would not end in time.

        The coarsest run of each compiled method is always begun, so that no engine is left without one.
        """
        while going := [one for one in self._curves if not one.over]:
            one = min(going, key=lambda x: x.expected)
            left = until - time.process_time()
            if one.expected > max(left, 0.0):
                for other in going:
                    other.give_up(OUT_OF_TIME)
            elif one.work > self.budget.work and not one.settings.required:
                one.end("")
            else:
                # The estimate may be wrong: one run must not take all that is left.
                one.run_next(limit=float(f"{max(left / 4, 2 * one.expected, 0.1):.2g}"))
                yield one

    def _repeat(self, until: float) -> Iterator[int]:
        """Time every setting in rounds, each in another order, so that drifts of the machine meet all runs alike.

        Where time is short, the longest runs are repeated less.
        """
        runs = [x for one in self._curves for x in one.repeatable()]
        counts = repetitions(
            [max(first, _SHORT_RUN_SECONDS) for first, _ in runs], self.repeats, until - time.process_time()
        )
        rng = np.random.default_rng(self.seed)
        for k in range(self.repeats):
            for i in rng.permutation(len(runs)):
                if k < counts[i] and time.process_time() + runs[i][0] < until:
                    runs[i][1]()
            yield k

    def _in_executor(self, executor: Executor) -> Iterator[tuple[float, str]]:
        yield 0.0, f"{len(self.settings)} curves by {type(executor).__name__}"
        left = self.budget.until(1.0, 2 * _MIN_PHASE_PART) - time.process_time()
        each = 1 / max(len(self.settings), 1)
        part = replace(self.budget, seconds=left * each, usual=min(self.budget.usual, left) * each)
        calls = {
            str(i): partial(_measure, self.problem, self.truth, one, self.repeats, self.seed, part)
            for i, one in enumerate(self.settings)
        }
        # Threads that suppress warnings side by side restore each other's filters.
        with warnings.catch_warnings():
            for name, answer in run(calls, executor=executor):
                one = self.settings[int(name)]
                if isinstance(answer, Exception):
                    answer = None, Refusal(one.engine, one.method, f"{type(answer).__name__}: {answer}")
                self._answers[int(name)] = answer
                yield len(self._answers) / len(self.settings), f"{one.method} on {one.engine}"


def _measure(problem: Problem, truth: Truth, one: Settings, repeats: int, seed: int, budget: TimeBudget) -> Outcome:
    sweep = Sweep(problem, truth, [one], repeats, seed, replace(budget, begun=time.process_time()))
    deque(sweep.steps(), maxlen=0)
    return sweep.outcomes()[0]
