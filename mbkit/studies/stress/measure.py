"""What a worker process of a stress study computes: the reference of one value, and one cell."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

import numpy as np

from mbkit.engines import Dynamics, dynamics
from mbkit.engines.base import DOUBLE_BITS
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import MbkitError
from mbkit.methods.registry import ADAPTIVE_METHOD, AUTOMATIC_METHOD, METHODS, STIFF_METHOD
from mbkit.simulate import Trajectory, simulate
from mbkit.studies.compare.errors import interleaved
from mbkit.studies.stress.case import Case, Truth, problem_of, step_of, times_of
from mbkit.studies.stress.measurements import Measurement
from mbkit.studies.stress.reference import (
    MAX_ERROR,
    TERMS,
    Terms,
    condition,
    error_of,
    reference_motion,
    reference_terms,
)
from mbkit.studies.study_runs import TooLongError, cpu_limit, energy_drift, heard_warnings, patience, quiet_simulate
from mbkit.studies.worker import report_stage

#: Processor time: the wall's is also other processes'. A run has one thread, and Linux gives the time of the whole
#: process to some milliseconds only, unless there is a timer on it.
_clock = time.thread_time

#: Times a run's seconds that making the problem and the engine, and compiling, may take; and at the least, s.
_PREPARATION: Final = 15.0
_MIN_PREPARATION: Final = 6.0
#: A run shorter than this is timed so many times in all, s.
_SHORT: Final = 5e-3
_REPEATS: Final = 3
#: Solvers that do not poll the deadline are interrupted so much later.
_LATER: Final = 1.1
#: Methods that another may switch to, which are compiled before it is timed.
_SWITCHES_TO: Final = {AUTOMATIC_METHOD: (ADAPTIVE_METHOD, STIFF_METHOD)}
#: Times the run's seconds that an untimed run may take, which compiles what it needs on its way.
_UNTIMED: Final = 2.0
#: Part of an interval that is integrated to compile a method; however stiff the system, steps are few in it.
_MOMENT: Final = 1e-15
#: Steps of an engine's own integrator from which the time of all steps is estimated.
_TRIAL: Final = 2000
#: Roundings of a double energy, and the part of the motion's from which on they can hide its error.
_ROUNDING: Final = 16.0 * float(np.finfo(float).eps)
_HIDDEN: Final = 1e-9


@dataclass(frozen=True)
class Prepared:
    """The reference of one value; `how` says how it is known, or why it is not."""

    how: str
    truth: Truth | Terms | None = None
    facts: Mapping[str, float] = field(default_factory=dict)
    #: Step that the problem prescribes, s.
    dt: float | None = None
    #: The cell of every method, where there is no problem.
    failure: Measurement | None = None


@dataclass(frozen=True)
class Limits:
    """Processor time of a run, its step and tolerance."""

    seconds: float
    dt: float
    rtol: float

    @property
    def preparation(self) -> float:
        """Processor time of making the problem and the engine, and compiling, s."""
        return max(_MIN_PREPARATION, _PREPARATION * self.seconds)


class _ValueCache:
    """Problem, oracle and engines of one value of a case, for all calls about it."""

    def __init__(self, case: Case, value: float) -> None:
        self.case, self.value = case, value
        self.problem = problem_of(case, value)
        #: Engine -> dynamics, and the warnings of its construction.
        self.engines: dict[str, tuple[Dynamics, list[str]]] = {}

    @cached_property
    def oracle(self) -> OracleDynamics:
        return OracleDynamics(self.problem.model)

    def dynamics(self, engine: str) -> tuple[Dynamics, list[str]]:
        if engine not in self.engines:
            with heard_warnings() as heard:
                dyn = dynamics(self.problem.model, engine)
            self.engines[engine] = dyn, heard
        return self.engines[engine]


_cache: Final[dict[tuple[str, float], _ValueCache]] = {}


def _value_of(case: Case, value: float) -> _ValueCache:
    """Return the cache of a value, and free that of the value before."""
    key = case.name, value
    if key not in _cache:
        _cache.clear()
        _cache[key] = _ValueCache(case, value)
    return _cache[key]


def prepare(case: Case, value: float, bar: float, seconds: float) -> Prepared:
    """Return the reference of a value, searched for within so many seconds of processor time."""
    cache = _value_of(case, value)
    problem = cache.problem
    truth: Truth | Terms | None = None
    report_stage("truth")
    if case.measure == "terms":
        how, truth = "the own derivation with 34 digits", reference_terms(problem, cache.oracle)
    elif case.measure == "energy":
        how = "the energy at the start, with 34 digits"
    else:
        wanted = 0.1 * bar * problem.scale
        truth, how = reference_motion(problem, times_of(problem, case.measure), wanted, seconds)
    return Prepared(how, truth, {name: float(x) for name, x in problem.facts.items()}, problem.dt)


def condition_number(case: Case, value: float) -> float:
    """Return the condition number of the mass matrix at a value; see `reference.condition`."""
    cache = _value_of(case, value)
    return condition(cache.oracle, cache.problem.q)


def measure(
    case: Case, value: float, engine: str, method: str, limits: Limits, truth: Truth | Terms | None
) -> Measurement:
    """Return one cell: a run by a method, or the evaluation of the term of this name, timed, and its error."""
    cache = _value_of(case, value)
    report_stage("engine")
    dyn, heard = cache.dynamics(engine)
    if isinstance(truth, Terms):
        cell = _evaluate(value, method, dyn, truth)
    elif case.measure == "terms":
        return Measurement(value, "not run", note="not run: no truth")
    else:
        cell = _integrate(cache, method, limits, dyn, truth)
    # A warning of the engine's construction holds for all that it does.
    return replace(cell, warnings=(*heard, *cell.warnings)) if cell.end == "finished" else cell


def _integrate(cache: _ValueCache, method: str, limits: Limits, dyn: Dynamics, truth: Truth | None) -> Measurement:
    value, problem = cache.value, cache.problem
    times = times_of(problem, cache.case.measure)
    kind = METHODS[method]
    adaptive = kind.kind == "adaptive"
    dt = 0.0 if adaptive else step_of(problem, times, limits.dt)
    step: dict[str, Any] = {"rtol": max(limits.rtol, kind.least)} if adaptive else {"dt": dt}
    start, duration = (dyn, problem.q, problem.v), float(times[-1])
    report_stage("method")
    try:
        with cpu_limit(limits.preparation):
            short = _MOMENT * float(times[1]) if adaptive else dt
            for name in (*_SWITCHES_TO.get(method, ()), method):
                quiet_simulate(*start, short, name, save=[short], **step)
        if method in _SWITCHES_TO:
            # The controller's own functions are compiled when it first uses them.
            with cpu_limit(_UNTIMED * limits.seconds):
                quiet_simulate(*start, duration, method, save=times, **step)
        report_stage("run")
        steps = round(duration / dt) if kind.kind == "native" else 0
        if steps >= 2 * _TRIAL:
            # An engine's own integrator does not stop when it is asked to.
            begun = _clock()
            quiet_simulate(*start, _TRIAL * dt, method, save=[_TRIAL * dt], **step)
            expected = (_clock() - begun) * steps / _TRIAL
            if expected > limits.seconds:
                return Measurement(value, "slow", note=f"not run: {steps} steps would take {expected:.2g} s")
        with heard_warnings() as heard:
            begun = _clock()
            look = patience(limits.seconds, _clock)
            with cpu_limit(_LATER * limits.seconds):
                run = simulate(*start, duration, method, save=times, progress=look, doubt=False, **step)
            seconds = [_clock() - begun]
    except TooLongError as error:
        return Measurement(value, "slow", note=str(error))
    while seconds[0] < _SHORT and len(seconds) < _REPEATS:
        begun = _clock()
        quiet_simulate(*start, duration, method, save=times, doubt=False, **step)
        seconds.append(_clock() - begun)
    stats = run.stats
    note = "; ".join(x for x in (stats.message, stats.chosen) if x)
    cell = Measurement(value, "finished", seconds=float(np.median(seconds)), steps=stats.steps, note=note)
    if not stats.finished or len(run.t) != len(times):
        return replace(cell, end="diverged", note=stats.message or f"ended at t = {run.t[-1]:g} s")
    # Its checks integrate again: their time is not the run's.
    report_stage("check")
    doubts = (f"{dyn.model.name}: {method}: {one}" for one in run.check().doubts)
    cell = replace(cell, warnings=tuple(dict.fromkeys([*heard, *doubts])))
    if not (np.isfinite(run.q).all() and np.isfinite(run.v).all()):
        return replace(cell, end="nan", note="states that are not finite, and nothing was said")
    # A run that is judged by its energy alone needs more digits of it than the run has.
    energy = _energy_error(cache.oracle if truth is None else dyn, run)
    if truth is None:
        return replace(cell, error=energy if cache.case.measure == "energy" else math.nan, energy=energy)
    apart = float(np.abs(problem.model.difference(truth.q, run.q)).max()) / problem.scale
    return replace(cell, error=min(apart, MAX_ERROR), energy=energy, floor=truth.floor / problem.scale)


def _energy_error(dyn: Dynamics, run: Trajectory) -> float:
    """Return the relative `energy_drift`, NaN where it is not known or only rounding."""
    try:
        drift, size, largest = energy_drift(dyn, run) or (0.0, 0.0, 0.0)
    except MbkitError:
        return math.nan
    rounding = 0.0 if dyn.bits > DOUBLE_BITS else _ROUNDING * largest
    hidden = rounding > _HIDDEN * size and drift <= rounding
    return min(drift / size, MAX_ERROR) if size > 0 and not hidden else math.nan


def _evaluate(value: float, term: str, dyn: Dynamics, truth: Terms) -> Measurement:
    """Return the error of a term over all states, and the time of one evaluation."""
    report_stage("method")
    arguments = [getattr(truth.at, name) for name in TERMS[term]]
    function: Callable[..., Any] = getattr(dyn, term)
    with heard_warnings() as heard:
        computed = np.asarray(function(*arguments))
    report_stage("run")
    # Writeable arrays, as users have them: engines have a fast path for those.
    one = [np.array(x[0]) for x in arguments]
    ns, _ = interleaved({"": lambda: function(*one)}, rounds=3)[""]
    cell = Measurement(value, "finished", seconds=1e-9 * ns, warnings=tuple(heard))
    if not np.isfinite(computed).all():
        return replace(cell, end="nan", note="numbers that are not finite, and nothing was said")
    if term not in truth.values:
        return replace(cell, note=truth.missing[term])
    return replace(cell, error=error_of(term, computed, truth))
