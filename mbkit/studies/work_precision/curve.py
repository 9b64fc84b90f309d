"""One curve of error against run time while it is measured: coarse settings first, then finer ones."""

from __future__ import annotations

import contextlib
import math
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from mbkit._check import Array
from mbkit._fork import fork_safe
from mbkit.catalog import pendulum
from mbkit.codegen.disk_cache import anew
from mbkit.engines import Dynamics, dynamics
from mbkit.errors import MbkitError, UnsupportedError
from mbkit.model import Model
from mbkit.simulate import Trajectory
from mbkit.studies._processes import run
from mbkit.studies.compare.rollouts import TooLongError, patience, quiet_simulate
from mbkit.studies.results import Refusal
from mbkit.studies.work_precision.result import Curve, PrecisionPoint
from mbkit.studies.work_precision.settings import Plan

__all__ = [
    "OUT_OF_TIME",
    "Allowance",
    "Alone",
    "Found",
    "ObservedOrder",
    "Scene",
    "Shared",
    "Sweeping",
    "Walk",
    "explore",
    "made_ready",
    "observed_order",
    "repeat",
]


# What comes before a run is timed: deriving, compiling and building, told apart.

#: heyoka has one switch for all threads: what it was when each of those came that are in the block.
_BEFORE: Final[list[bool]] = []
_SWITCHING: Final = fork_safe(threading.RLock())


def made_ready(model: Model, engine: str, method: str, first: Callable[[Dynamics], Any]) -> tuple[Dynamics, float]:
    """Return an engine that has run a method once, and how many seconds that took beyond the run itself.

    Everything that belongs to this model is derived, compiled and built anew, whatever
    is kept in this process or on disk. Modules to import, and what is the same for every
    model, are there before the clock starts.

    Parameters
    ----------
    model : Model
    engine, method : str
    first : callable
        Runs the method shortly on the engine.
    """
    _imported(engine, method)
    with _nothing_kept():
        begun = time.perf_counter()
        dyn = dynamics(model, engine)
        first(dyn)
        cold = time.perf_counter() - begun
    begun = time.perf_counter()
    first(dyn)
    return dyn, max(0.0, cold - (time.perf_counter() - begun))


@cache
def _imported(engine: str, method: str) -> None:
    """Have everything imported that a method needs."""
    with contextlib.suppress(MbkitError):
        quiet_simulate(dynamics(pendulum(), engine), [0.1], [0.0], 1e-3, method, save=[1e-3])


@contextlib.contextmanager
def _nothing_kept() -> Iterator[None]:
    """Have mbkit and heyoka compile anew within the block."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(anew())
        # Whoever has not imported it has nothing compiled by it.
        if "heyoka" in sys.modules:
            stack.enter_context(_heyoka_anew())
        yield


@contextlib.contextmanager
def _heyoka_anew() -> Iterator[None]:
    from heyoka import llvm_state

    # Older ones have no cache on disk.
    if not hasattr(llvm_state, "set_diskcache_enabled"):
        llvm_state.clear_memcache()
        yield
        return
    with _SWITCHING:
        _BEFORE.append(llvm_state.get_diskcache_enabled())
        llvm_state.set_diskcache_enabled(False)
    llvm_state.clear_memcache()
    try:
        yield
    finally:
        with _SWITCHING:
            before = _BEFORE.pop()
            # The last one left, so that of the first that came: what it was before all of them.
            if not _BEFORE:
                llvm_state.set_diskcache_enabled(before)


# The observed order of a fixed-step method: the slope of log error over log step.

#: An error this many times what the reference is known to, or the rounding seen, is the method's own to a hundredth.
_ABOVE: Final = 100.0
#: An error beyond this part of the motion itself tells of no series in the step.
_COARSE: Final = 0.03
#: Within the range of the regression, slopes from point to point differ by less than this.
_STEADY: Final = 0.3
_FEWEST: Final = 3


class ObservedOrder(NamedTuple):
    """The order, NaN where it is not seen, and how many points it is taken from."""

    order: float
    points: int


def observed_order(steps: Sequence[float], errors: Sequence[float], *, floor: float, motion: float) -> ObservedOrder:
    """Return the slope of log error over log step where the method shows its order.

    Points count that are neither pre-asymptotic nor at rounding. At rounding are
    errors below 100 times the reference's floor, and, where the errors have stopped
    falling, below 100 times the least of them. Pre-asymptotic are errors above 3 % of the
    motion. Of what is left the longest run of neighbours is taken whose slopes from
    point to point all lie within 0.3 of each other; of two as long, the finer. The
    expected order plays no part in the choice.

    Parameters
    ----------
    steps, errors : sequences of float
        s; rad or m, NaN where a run failed.
    floor : float
        How well the reference is known.
    motion : float
        Size of the motion in the units of the errors.

    Examples
    --------
    >>> found = observed_order([0.1, 0.05, 0.025], [1e-4, 0.625e-5, 0.390625e-6], floor=1e-14, motion=1.0)
    >>> round(found.order, 6), found.points
    (4.0, 3)
    """
    h, e = np.asarray(steps, dtype=float), np.asarray(errors, dtype=float)
    good = np.isfinite(e) & (e > 0) & (e < _COARSE * motion)
    h, e = h[good], e[good]
    by_step = np.argsort(-h)
    h, e = h[by_step], e[by_step]
    above = e > _ABOVE * max(floor, _rounding(h, e))
    first = _longest(np.log(h[above]), np.log(e[above]))
    if first is None:
        return ObservedOrder(float("nan"), 0)
    x, y = np.log(h[above])[first], np.log(e[above])[first]
    return ObservedOrder(float(np.polyfit(x, y, 1)[0]), len(x))


def _rounding(h: Array, e: Array) -> float:
    """Return the level at which finer steps bring nothing, 0 where that is not reached."""
    if len(e) < 2:
        return 0.0
    least = int(np.argmin(e))
    flat = least < len(e) - 1 or np.log(e[-2] / e[-1]) < 0.5 * np.log(h[-2] / h[-1])
    return float(e[least]) if flat else 0.0


def _longest(x: Array, y: Array) -> slice | None:
    """Return the longest run of neighbouring points with steady slopes, the finer of two as long."""
    slopes = np.diff(y) / np.diff(x)
    best: slice | None = None
    for start in range(len(slopes)):
        for stop in range(start + _FEWEST - 1, len(slopes) + 1):
            part = slopes[start:stop]
            if np.ptp(part) > _STEADY:
                break
            if best is None or stop + 1 - start >= best.stop - best.start:
                best = slice(start, stop + 1)
    return best


OUT_OF_TIME: Final = "not run: the time allowed was used up"

#: A run shorter than this is repeated within a round, s.
_SHORT: Final = 2e-3
_MOST_IN_A_ROUND: Final = 100
#: Settings in a row that bring nothing, after which a sweep of our own grid ends.
_IN_VAIN: Final = 2
#: Times as many steps as before, from which a setting is finer: a decade of a tolerance is 1.33 at order 8.
_FINER: Final = 1.2
#: Errors above this may still fall again, as those of steps that are too large do.
_SMALL: Final = 1e-6


@dataclass(frozen=True)
class Scene:
    """What is integrated, and the trajectory that errors are measured by.

    Attributes
    ----------
    model : Model
    q0, v0 : (nq,), (nv,) arrays
    torque : (nv,) array, callable or None
    times : (K,) array
        From 0 to the horizon, s.
    q : (K, nq) array
        The reference there.
    floor : float
        How well it is known.
    """

    model: Model
    q0: Array
    v0: Array
    torque: Any
    times: Array
    q: Array
    floor: float

    @property
    def duration(self) -> float:
        """The horizon, s."""
        return float(self.times[-1])

    @property
    def motion(self) -> float:
        """How far any coordinate gets from the start."""
        return float(np.abs(self.model.difference(np.broadcast_to(self.q[0], self.q.shape), self.q)).max())

    def run(self, dyn: Dynamics, plan: Plan, value: float, bound: float | None = None) -> Trajectory:
        """Integrate to the horizon; what is still under way after `bound` seconds is given up."""
        return self._simulate(dyn, plan, value, self.duration, self.times, bound)

    def begin(self, dyn: Dynamics, plan: Plan, value: float) -> Trajectory:
        """Integrate a step, or the thousandth part of an interval."""
        duration = value if plan.setting == "dt" else 1e-3 * float(self.times[1])
        return self._simulate(dyn, plan, value, duration, np.array([duration]), None)

    def _simulate(
        self, dyn: Dynamics, plan: Plan, value: float, duration: float, save: Array, bound: float | None
    ) -> Trajectory:
        setting: dict[str, Any] = {plan.setting: value}
        progress = None if bound is None else patience(bound)
        return quiet_simulate(
            dyn, self.q0, self.v0, duration, plan.method, torque=self.torque, save=save, progress=progress, **setting
        )

    def error(self, run: Trajectory) -> float:
        """Return the largest difference to the reference over times and coordinates."""
        return float(np.abs(self.model.difference(self.q, run.q)).max())

    def energy(self, dyn: Dynamics, run: Trajectory) -> float:
        """Return the drift of the energy, relative to the larger of T and of the change of V.

        NaN where there are dampers or applied forces, whose work is not known from so few
        states as well as the methods are good, or where time enters.
        """
        if self.torque is not None or self.model.needs.damping or self.model.clock is not None:
            return math.nan
        kinetic = 0.5 * np.einsum("ni,nij,nj->n", run.v, dyn.mass_matrix(run.q), run.v)
        potential = dyn.potential_energy(run.q)
        if self.model.written is not None:
            # Jacobi's integral T2 - T0 + V, which is the energy where there is no T0.
            potential = potential - dyn.kinetic_energy(run.q, 0 * run.v)
        drift = np.abs((kinetic - kinetic[0]) + (potential - potential[0])).max()
        size = max(float(kinetic.max()), float(np.ptp(potential)))
        return float(drift) / size if size > 0 else math.nan


@dataclass
class _Point:
    """A setting that was run.

    Attributes
    ----------
    value : float
    once, before : float
        Seconds of its first run, and of what only had to be made for it.
    times : list of float
        Timings that count.
    """

    value: float
    once: float = math.nan
    before: float = 0.0
    error: float = math.nan
    energy: float = math.nan
    steps: int = 0
    evaluations: int = 0
    note: str = ""
    times: list[float] = field(default_factory=list)


class Walk:
    """One engine and method under way.

    Parameters
    ----------
    scene : Scene
    plan : Plan

    Attributes
    ----------
    refusal : Refusal or None
        Why the engine and method gave nothing more.
    """

    def __init__(self, scene: Scene, plan: Plan) -> None:
        self.scene, self.plan = scene, plan
        self.refusal: Refusal | None = None
        self._left = list(plan.values)
        self._points: list[_Point] = []
        self._dyn: Dynamics | None = None
        self._compile = math.nan
        self._over = False
        #: The last run, which is not among the points if it took the same steps as the one before.
        self._last: _Point | None = None
        self._ended = ""
        if not self._left:
            self.refuse(f"takes no tolerance below {plan.kind.least:.3g}, and none above was asked for")

    @property
    def over(self) -> bool:
        """Whether there is no setting left that is worth a run."""
        return self._over or not self._left

    @property
    def expected(self) -> float:
        """Seconds that the next run will take, guessed from the last; 0 before the first."""
        return 0.0 if self._last is None else self._last.once * self._growth(self._last)

    @property
    def work(self) -> float:
        """The counted work of the next run, guessed from the last; 0 before the first."""
        last = self._last
        return 0.0 if last is None else self.plan.work(last.steps, last.evaluations) * self._growth(last)

    def _growth(self, last: _Point) -> float:
        """Return how many times as many steps the next setting takes."""
        finer = last.value / self._left[0]
        # A method of order p takes finer**(1/p) as many steps; 2 per decade is p = 3.
        return finer if self.plan.setting == "dt" else float(finer**0.3)

    @property
    def ahead(self) -> float:
        """Seconds until the next run will be done, with what has to be made for it."""
        return self.expected + (self._last.before if self._last else 0.0)

    def make_ready(self) -> None:
        """Derive, compile and build, timed."""
        # Where a tolerance decides on what is compiled, the middle one stands for all.
        value = self._left[len(self._left) // 2]
        with self._refusals():
            self._dyn, self._compile = made_ready(
                self.scene.model,
                self.plan.engine,
                self.plan.method,
                lambda dyn: self.scene.begin(dyn, self.plan, value),
            )

    def step(self, bound: float) -> None:
        """Run the next setting, and give it up after `bound` seconds."""
        point = _Point(self._left.pop(0))
        with self._refusals():
            self._run(point, bound)
            before, self._last = self._last, point
            # Coarse tolerances that bind no step are one run: its first setting stands for all.
            if before is None or self.plan.asked or not _same_steps(before, point):
                self._points.append(point)
            self._over = self._over or (not self.plan.asked and self._in_vain())

    def _run(self, point: _Point, bound: float) -> None:
        assert self._dyn is not None
        begun = time.perf_counter()
        try:
            # What this very setting needs first is no run time.
            self.scene.begin(self._dyn, self.plan, point.value)
            point.before, begun = time.perf_counter() - begun, time.perf_counter()
            run = self.scene.run(self._dyn, self.plan, point.value, bound)
        except TooLongError as error:
            point.once, point.note = time.perf_counter() - begun, str(error)
            # What is finer takes longer still.
            if not self.plan.asked:
                self.end(point.note)
            return
        except UnsupportedError:
            raise
        except MbkitError as error:
            point.once, point.note = time.perf_counter() - begun, str(error)
            return
        point.once = time.perf_counter() - begun
        point.steps, point.evaluations = run.stats.steps, run.stats.evaluations
        if not run.stats.finished or len(run.t) != len(self.scene.times):
            point.note = run.stats.message or f"ended at t = {run.t[-1]:g} s"
            return
        point.error = self.scene.error(run)
        try:
            point.energy = self.scene.energy(self._dyn, run)
        except MbkitError as error:
            point.note = f"no energy: {error}"

    def _in_vain(self) -> bool:
        """Whether the last settings brought nothing: the reference's floor, or rounding."""
        # Steps that end on the saved times can be shorter than a coarse tolerance asks for: of settings that hardly
        # add a step, only the first says whether finer ones bring anything.
        told = self._points[:1]
        for p in self._points[1:]:
            if not p.error > self.scene.floor or p.steps >= _FINER * told[-1].steps:
                told.append(p)
        errors = [p.error for p in told]
        before, last = errors[:-_IN_VAIN], errors[-_IN_VAIN:]
        finite = [e for e in before if math.isfinite(e)]
        if not finite or min(finite) > _SMALL:
            return False
        return all(not e < max(0.5 * min(finite), self.scene.floor) or e <= self.scene.floor for e in last)

    def give_up(self, why: str) -> None:
        """End here; whoever asked for the settings that are left is told why they were not run."""
        if self.plan.asked:
            self._points += [_Point(value, note=why) for value in self._left]
        elif not self._points and self.refusal is None:
            self.refusal = self._refused(why)
        self.end(why)

    def end(self, why: str) -> None:
        """Run no finer setting, for this reason."""
        self._left, self._over, self._ended = [], True, why

    def _refusals(self) -> _Refusals:
        return _Refusals(self)

    def refuse(self, why: str) -> None:
        """End here, for a reason that holds for all settings."""
        self.refusal, self._over = self._refused(why), True

    def _refused(self, why: str) -> Refusal:
        return Refusal(self.plan.engine, self.plan.method, why.removeprefix(f"{self.plan.engine}: "))

    @property
    def timed(self) -> list[tuple[float, Runs]]:
        """The runs worth timing again: what one took, and how to repeat it."""
        return [(p.once, Runs(self, p)) for p in self._points if math.isfinite(p.error)]

    def once_more(self, point: _Point) -> None:
        """Time one setting, a short run several times over."""
        assert self._dyn is not None
        count = int(np.clip(_SHORT / max(point.once, 1e-9), 1, _MOST_IN_A_ROUND))
        begun = time.perf_counter()
        for _ in range(count):
            self.scene.run(self._dyn, self.plan, point.value)
        point.times.append((time.perf_counter() - begun) / count)

    def curve(self) -> Curve | None:
        """Return what there is so far, None where there is nothing."""
        if not self._points:
            return None
        plan, scene = self.plan, self.scene
        fixed = plan.setting == "dt"
        seen = observed_order(
            [p.value for p in self._points] if fixed else [],
            [p.error for p in self._points] if fixed else [],
            floor=scene.floor,
            motion=scene.motion,
        )
        expected = plan.kind.order if fixed and plan.kind.order is not None else math.nan
        points = tuple(self._frozen(p) for p in self._points)
        return Curve(
            plan.engine,
            plan.method,
            points,
            seen.order,
            seen.points,
            float(expected),
            compile=self._compile,
            ended=self._ended,
        )

    def _frozen(self, p: _Point) -> PrecisionPoint:
        # The first run of all counts only where there is no other.
        times = p.times or [p.once]
        low, median, high = np.percentile(times, [25, 50, 75])
        return PrecisionPoint(
            setting=self.plan.setting,
            value=p.value,
            error=p.error,
            energy=p.energy,
            seconds=float(median),
            spread=float(high - low) / 2 if len(times) > 1 else math.nan,
            steps=p.steps,
            evaluations=p.evaluations,
            repeats=len(times) if math.isfinite(times[0]) else 0,
            note=p.note,
        )


def _same_steps(a: _Point, b: _Point) -> bool:
    both = math.isfinite(a.error) and math.isfinite(b.error)
    return both and 0 < a.evaluations == b.evaluations and a.steps == b.steps


@dataclass(frozen=True)
class Runs:
    """One setting of one walk, to be timed again."""

    walk: Walk
    point: _Point

    def __call__(self) -> None:
        """Time it once more."""
        self.walk.once_more(self.point)


class _Refusals:
    """Turn whatever ends a method into the walk's refusal, so that no other curve is lost."""

    def __init__(self, walk: Walk) -> None:
        self._walk = walk

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _trace: object) -> bool:
        # Engines raise errors of many kinds; an interruption is none of them.
        if not isinstance(error, Exception):
            return False
        self._walk.refuse(str(error) if isinstance(error, MbkitError) else f"{type(error).__name__}: {error}")
        return True


def explore(walks: Sequence[Walk], until: float, most: float) -> Iterator[Walk]:
    """Run each setting once, the cheapest next run of all walks first; yield whose it was.

    All curves get about as far to the right of the figure, and whatever is coarse is
    there before anything that is fine.

    Parameters
    ----------
    walks : sequence of Walk
    until : float
        On `time.process_time`; nothing is begun that would probably not be done by then.
    most : float
        Counted work that a run of our own grid may take, so that the curves are the same on a slow machine.
    """
    while going := [w for w in walks if not w.over]:
        walk = min(going, key=lambda w: w.expected)
        left = until - time.process_time()
        if walk.ahead > left:
            for other in going:
                other.give_up(OUT_OF_TIME)
            return
        if walk.work > most and not walk.plan.asked:
            walk.end("")
            continue
        # A guess is a guess: one run must not take all that is left.
        walk.step(bound=float(f"{max(left / 4, 2 * walk.expected, 0.1):.2g}"))
        yield walk


def repeat(walks: Sequence[Walk], repeats: int, until: float, seed: int) -> Iterator[int]:
    """Time every setting in rounds, each round in another order; yield the round's number.

    So a drift of the machine's speed meets all of them alike, and none is always timed
    after the same neighbour. Where the time allowed is short, the longest runs are timed fewer
    times.
    """
    runs = [x for walk in walks for x in walk.timed]
    counts = shares([max(once, _SHORT) for once, _ in runs], repeats, until - time.process_time())
    rng = np.random.default_rng(seed)
    for k in range(repeats):
        for i in rng.permutation(len(runs)):
            if k < counts[i] and time.process_time() + runs[i][0] < until:
                runs[i][1]()
        yield k


def shares(seconds: Sequence[float], most: int, budget: float) -> list[int]:
    """Return how many times to repeat runs of these lengths within a budget, at most `most` each.

    Examples
    --------
    >>> shares([0.1, 0.1, 5.0], most=5, budget=4.0)
    [5, 5, 0]
    >>> shares([0.1, 1.0, 1.0], most=5, budget=4.5)
    [5, 2, 2]
    """
    counts, left = [0] * len(seconds), max(budget, 0.0)
    by_length = sorted(range(len(seconds)), key=lambda i: seconds[i])
    for k, i in enumerate(by_length):
        counts[i] = min(most, int(left / (len(by_length) - k) / seconds[i] * (1 + 1e-9)))
        left -= counts[i] * seconds[i]
    return counts


# How a sweep is carried out: in this process, with interleaved timings, or by workers, a curve each.

#: What is known of a curve: itself, and why there is no more of it.
Found = tuple[Curve | None, Refusal | None]

#: Of the time allowed, deriving and compiling may begin until this part is over, and by
#: the next every setting has been run once; the rest is for repetitions.
_READY: Final = 0.5
_EXPLORED: Final = 0.65
#: What each of these has at the least, however long the others took.
_AT_LEAST: Final = 0.2


@dataclass(frozen=True)
class Allowance:
    """What a sweep may take, in seconds of the processor: a machine that does other things too ends no sweep.

    Attributes
    ----------
    seconds : float
        After which nothing is begun, counted from when this is made.
    usual : float
        After which runs are not timed again.
    work : float
        Counted work of a run of our own grid; see `Plan.work`.
    """

    seconds: float
    usual: float
    work: float
    begun: float = field(default_factory=time.process_time)

    def until(self, part: float, least: float = 0.0) -> float:
        """Return when a part of the seconds is over, and not before there was a least part for what follows."""
        return max(self.begun + part * self.seconds, time.process_time() + least * self.seconds)

    def timed_until(self, least: float) -> float:
        """Return when to stop timing runs again, and not before there was a least part of the usual time for it."""
        return max(self.begun + self.usual, time.process_time() + least * self.usual)


class Sweeping(Protocol):
    """A sweep under way."""

    def steps(self) -> Iterator[tuple[float, str]]:
        """Carry it out; after each little step, yield the fraction done and what is done now."""
        ...

    def found(self) -> list[Found]:
        """Return what is known of each curve by now."""
        ...


class Alone:
    """All curves in this process, their timings interleaved.

    Parameters
    ----------
    scene : Scene
    wanted : sequence of Plan
    repeats, seed : int
    allowance : Allowance
    """

    def __init__(self, scene: Scene, wanted: Sequence[Plan], repeats: int, seed: int, allowance: Allowance) -> None:
        self._walks = [Walk(scene, plan) for plan in wanted]
        self._repeats, self._seed, self._allowance = repeats, seed, allowance

    def found(self) -> list[Found]:
        """Return what is known of each curve by now."""
        return [(walk.curve(), walk.refusal) for walk in self._walks]

    def steps(self) -> Iterator[tuple[float, str]]:
        """Make every engine ready, run every setting once, and time them in rounds."""
        until = self._allowance.until(_READY, _AT_LEAST)
        # What takes long to derive, Jacobians most of all, must not keep the others from having any time at all.
        for k, walk in enumerate(sorted(self._walks, key=_how_long_to_derive)):
            yield 0.2 * k / len(self._walks), f"compiling {walk.plan.method} on {walk.plan.engine}"
            if k and time.process_time() > until:
                walk.give_up(OUT_OF_TIME)
            elif not walk.over:
                walk.make_ready()
        begun, until = time.process_time(), self._allowance.until(_EXPLORED, _AT_LEAST)
        for walk in explore(self._walks, until, self._allowance.work):
            # Cheap settings are done in no time: the root of the time shows how far it is.
            done = ((time.process_time() - begun) / (_EXPLORED * self._allowance.usual)) ** 0.5
            yield 0.2 + 0.4 * min(done, 1.0), f"{walk.plan.method} on {walk.plan.engine}"
        yield 0.6, "timing"
        for k in repeat(self._walks, self._repeats, self._allowance.timed_until(_AT_LEAST), self._seed):
            yield 0.6 + 0.4 * (k + 1) / self._repeats, f"timing, round {k + 1} of {self._repeats}"


def _how_long_to_derive(walk: Walk) -> tuple[bool, bool]:
    # Implicit methods and series vary in their stages; the others derive a step at the most.
    return walk.plan.kind.stages == 0, walk.plan.engine == "lagrangian"


class Shared:
    """Each curve by a worker of an executor.

    Parameters
    ----------
    executor : concurrent.futures.Executor
    scene, wanted, repeats, seed, allowance
        As of `Alone`; each curve has its part of the time, whatever the workers do side by side.
    """

    def __init__(
        self,
        executor: Executor,
        scene: Scene,
        wanted: Sequence[Plan],
        repeats: int,
        seed: int,
        allowance: Allowance,
    ) -> None:
        self._executor, self._wanted = executor, wanted
        left = allowance.until(1.0, 2 * _AT_LEAST) - time.process_time()
        each = 1 / max(len(wanted), 1)
        part = replace(allowance, seconds=left * each, usual=min(allowance.usual, left) * each)
        self._calls = {str(i): partial(_one, scene, plan, repeats, seed, part) for i, plan in enumerate(wanted)}
        self._found: dict[int, Found] = {}

    def found(self) -> list[Found]:
        """Return what is known of each curve by now."""
        return [self._found.get(i, (None, None)) for i in range(len(self._wanted))]

    def steps(self) -> Iterator[tuple[float, str]]:
        """Collect the curves as they come; one whose worker died is refused with that reason."""
        yield 0.0, f"{len(self._wanted)} curves by {type(self._executor).__name__}"
        # Threads that leave out warnings side by side put back each other's filters in the end.
        with warnings.catch_warnings():
            for name, made in run(self._calls, executor=self._executor):
                plan = self._wanted[int(name)]
                if isinstance(made, Exception):
                    why = f"{type(made).__name__}: {made}"
                    self._found[int(name)] = None, Refusal(plan.engine, plan.method, why)
                else:
                    self._found[int(name)] = made
                yield len(self._found) / len(self._wanted), f"{plan.method} on {plan.engine}"


def _one(scene: Scene, plan: Plan, repeats: int, seed: int, allowance: Allowance) -> Found:
    """Measure one curve, wherever this is."""
    alone = Alone(scene, [plan], repeats, seed, replace(allowance, begun=time.process_time()))
    for _ in alone.steps():
        pass
    return alone.found()[0]
