"""What a worker process of a stress study computes: the reference of one value, and one cell."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.base import DOUBLE_BITS
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import MbkitError, MbkitWarning
from mbkit.methods.registry import ADAPTIVE_METHOD, AUTOMATIC_METHOD, METHODS, STIFF_METHOD
from mbkit.simulate import Trajectory, simulate
from mbkit.studies.compare.errors import interleaved
from mbkit.studies.stress.case import Case, Truth, problem_of, step_of, times_of
from mbkit.studies.stress.measurements import Measurement
from mbkit.studies.stress.reference import (
    TERMS,
    ReferenceSearch,
    Terms,
    condition,
    cpu_limit,
    error_of,
    reference_terms,
)
from mbkit.studies.study_runs import TooLongError, patience, quiet_simulate
from mbkit.studies.worker import report_stage

#: Processor time: the wall's is also other processes'. A run has one thread, and Linux gives the time of the whole
#: process to some milliseconds only, unless there is a timer on it.
_clock = time.thread_time

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
_EPS: Final = float(np.finfo(float).eps)
#: Roundings of a double energy, and the part of the motion's from which on they can hide its error.
_ROUNDINGS: Final = 16.0
_HIDDEN: Final = 1e-9
#: The largest error that a result holds, for JSON has no infinity.
_MAX_ERROR: Final = 1e300


@dataclass(frozen=True)
class Prepared:
    """The reference of one value; `how` says how it is known, or why it is not."""

    how: str
    truth: Truth | Terms | None = None
    facts: Mapping[str, float] = field(default_factory=dict)
    #: Step that the problem prescribes, s.
    dt: float | None = None


@dataclass(frozen=True)
class Setting:
    """How a cell is computed; for terms, the method is the term."""

    engine: str
    method: str
    dt: float
    rtol: float
    #: Processor time of the run, and of deriving and compiling for it.
    seconds: float
    compile_seconds: float


class _ValueCache:
    """Problem, oracle and engines of one value of a case, for all calls about it."""

    def __init__(self, case: Case, value: float) -> None:
        self.case, self.value = case, value
        self.problem = problem_of(case, value)
        #: Engine -> dynamics, and the warnings when it was made.
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


_cache: _ValueCache | None = None
_searches: Final[dict[str, ReferenceSearch]] = {}


@contextmanager
def _value_of(case: Case, value: float) -> Iterator[_ValueCache]:
    """Give the cache of a value, and free that of the value before."""
    global _cache
    try:
        if _cache is None or (_cache.case.name, _cache.value) != (case.name, value):
            _cache = None
            _cache = _ValueCache(case, value)
        yield _cache
    except MemoryError:
        _cache = None
        raise


def prepare(case: Case, value: float, bar: float, seconds: float) -> Prepared:
    """Return the reference of a value, searched for within so many seconds of processor time."""
    with _value_of(case, value) as cache:
        problem = cache.problem
        facts = {name: float(x) for name, x in problem.facts.items()}
        report_stage("truth")
        if case.measure == "terms":
            terms = reference_terms(problem, cache.oracle)
            return Prepared("the own derivation with 34 digits", terms, facts)
        if case.measure == "energy":
            return Prepared("the energy at the start, with 34 digits", None, facts, problem.dt)
        search = _searches.setdefault(case.name, ReferenceSearch())
        truth, how = search.truth(problem, times_of(problem, case.measure), 0.1 * bar * problem.scale, seconds)
        return Prepared(how, truth, facts, problem.dt)


def condition_number(case: Case, value: float) -> float:
    """Return the condition number of the mass matrix at a value; see `reference.condition`."""
    with _value_of(case, value) as cache:
        return condition(cache.oracle, cache.problem.q)


def measure(case: Case, value: float, setting: Setting, truth: Truth | Terms | None) -> Measurement:
    """Return one cell: a run, or the evaluation of a term, timed, and its error."""
    with _value_of(case, value) as cache:
        report_stage("engine")
        dyn, heard = cache.dynamics(setting.engine)
        if case.measure != "terms":
            assert not isinstance(truth, Terms)
            cell = _integrate(cache, setting, dyn, truth)
        elif isinstance(truth, Terms):
            cell = _evaluate(value, setting.method, dyn, truth)
        else:
            return Measurement(value, "not run", note="not run: no truth")
        # A warning when the engine was made holds for all that it does.
        return replace(cell, warnings=(*heard, *cell.warnings)) if cell.end == "finished" else cell


def _integrate(cache: _ValueCache, setting: Setting, dyn: Dynamics, truth: Truth | None) -> Measurement:
    value, problem, method = cache.value, cache.problem, setting.method
    times = times_of(problem, cache.case.measure)
    kind = METHODS[method]
    adaptive = kind.kind == "adaptive"
    dt = 0.0 if adaptive else step_of(problem, times, setting.dt)
    step: dict[str, Any] = {"rtol": max(setting.rtol, kind.least)} if adaptive else {"dt": dt}
    start, duration = (dyn, problem.q, problem.v), float(times[-1])
    report_stage("method")
    try:
        with cpu_limit(setting.compile_seconds):
            short = _MOMENT * float(times[1]) if adaptive else dt
            for name in (*_SWITCHES_TO.get(method, ()), method):
                quiet_simulate(*start, short, name, save=[short], **step)
        if method in _SWITCHES_TO:
            # The controller's own functions are compiled when it first uses them.
            with cpu_limit(_UNTIMED * setting.seconds):
                quiet_simulate(*start, duration, method, save=times, **step)
        report_stage("run")
        steps = round(duration / dt) if kind.kind == "native" else 0
        if steps >= 2 * _TRIAL:
            # An engine's own integrator does not stop when it is asked to.
            begun = _clock()
            quiet_simulate(*start, _TRIAL * dt, method, save=[_TRIAL * dt], **step)
            expected = (_clock() - begun) * steps / _TRIAL
            if expected > setting.seconds:
                return Measurement(value, "slow", note=f"not run: {steps} steps would take {expected:.2g} s")
        with heard_warnings() as heard:
            begun = _clock()
            look = patience(setting.seconds, _clock)
            with cpu_limit(_LATER * setting.seconds):
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
    try:
        # A run that is judged by its energy alone needs more digits of it than the run has.
        energy = _energy_error(cache.oracle if truth is None else dyn, run)
    except MbkitError:
        energy = math.nan
    if truth is None:
        return replace(cell, error=energy if cache.case.measure == "energy" else math.nan, energy=energy)
    apart = float(np.abs(problem.model.difference(truth.q, run.q)).max()) / problem.scale
    return replace(cell, error=min(apart, _MAX_ERROR), energy=energy, floor=truth.floor / problem.scale)


def _energy_error(dyn: Dynamics, run: Trajectory) -> float:
    """Return the largest energy change relative to T or the change of V; NaN with dampers, time or much rounding."""
    model = dyn.model
    if model.needs.damping or model.time_parameter is not None:
        return math.nan
    T, V = _energy(dyn, "kinetic_energy", run.q, run.v), _energy(dyn, "potential_energy", run.q)
    if not model.has_bodies:
        # Jacobi's integral T2 - T0 + V, which is the energy where there is no T0.
        T0 = _energy(dyn, "kinetic_energy", run.q, 0 * run.v)
        T, V = (T[0] - T0[0], T[1] - T0[1]), (V[0] - T0[0], V[1] - T0[1])
    gained, change = ((high - high[0]) + (low - low[0]) for high, low in (T, V))
    drift, size = float(np.abs(gained + change).max()), max(float(T[0].max()), float(np.ptp(change)))
    rounding = 0.0 if dyn.bits > DOUBLE_BITS else _ROUNDINGS * _EPS * float(np.abs([T[0], V[0]]).max())
    hidden = rounding > _HIDDEN * size and drift <= rounding
    return min(drift / size, _MAX_ERROR) if size > 0 and not hidden else math.nan


def _energy(dyn: Dynamics, name: str, *state: Array) -> tuple[Array, Array]:
    """Return an energy as (high, low); a double has no low part."""
    if isinstance(dyn, OracleDynamics):
        return dyn.extended(name, *state)
    if name == "kinetic_energy":
        # By the mass matrix, which no known defect of an engine touches.
        high = 0.5 * np.einsum("ni,nij,nj->n", state[1], dyn.mass_matrix(state[0]), state[1])
    else:
        high = np.asarray(getattr(dyn, name)(*state))
    return high, np.zeros_like(high)


@contextmanager
def heard_warnings() -> Iterator[list[str]]:
    """Collect the library's warnings."""
    heard: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield heard
    heard += [" ".join(str(w.message).split()) for w in caught if issubclass(w.category, MbkitWarning)]


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
    cell = Measurement(value, "finished", seconds=1e-9 * ns, warnings=tuple(dict.fromkeys(heard)))
    if not np.isfinite(computed).all():
        return replace(cell, end="nan", note="numbers that are not finite, and nothing was said")
    if term not in truth.values:
        return replace(cell, note=truth.missing[term])
    return replace(cell, error=error_of(term, computed, truth))
