"""One engine and method at one value: the run, timed, and its error."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import MbkitError, MbkitWarning
from mbkit.methods.registry import METHODS
from mbkit.simulate import Trajectory, simulate
from mbkit.studies.compare.errors import interleaved
from mbkit.studies.compare.rollouts import TooLongError, patience, quiet_simulate
from mbkit.studies.stress.case import Measure, Problem, Truth, step_of
from mbkit.studies.stress.messages import Doing, Run
from mbkit.studies.stress.reference import TERMS, Terms, error_of, limited
from mbkit.studies.stress.result import Cell

__all__ = ["evaluated", "heard_warnings", "integrated"]

#: Seconds of the processor: those of the wall are other processes' too. A run has one thread, and Linux tells
#: those of the whole process to some milliseconds only while there is a timer on them.
_clock = time.thread_time

#: A run shorter than this is timed so many times in all, s.
_SHORT: Final = 5e-3
_REPEATS: Final = 3
#: What asks nobody whether to go on is stopped so much later than what does.
_LATER: Final = 1.1
#: What a method may turn to under way, and is compiled before.
_TURNS_TO: Final = {"auto": ("rk853", "rodas5")}
#: What a run may take that compiles on its way, beside one that does not.
_FIRST: Final = 2.0
#: Part of an interval in which nothing happens.
_MOMENT: Final = 1e-15
#: Steps of an engine's own integrator after which it is known how long all of them will take.
_TRIAL: Final = 2000
_EPS: Final = float(np.finfo(float).eps)
#: Roundings of a double energy, and the part of the motion's from which on they can hide its error.
_ROUNDINGS: Final = 16.0
_HIDDEN: Final = 1e-9
#: Beyond which an error is no number for JSON.
_LARGEST: Final = 1e300


def integrated(
    asked: Run,
    problem: Problem,
    dyn: Dynamics,
    times: Array,
    truth: Truth | None,
    energies: OracleDynamics | None,
    measure: Measure,
    tell: Callable[[Doing], None],
) -> Cell:
    """Return what comes of a run.

    Parameters
    ----------
    asked : Run
    problem : Problem
    dyn : Dynamics
    times : (K,) array
        Where the error is measured, s.
    truth : Truth or None
        None where the energy alone is known.
    energies : OracleDynamics or None
        Who says the energy; None for `dyn` itself.
    measure : {"motion", "energy"}
    tell : callable
        Is told when the run begins, after all that only has to be made for it.
    """
    setting = _setting(asked, problem, times)
    duration = float(times[-1])
    start = dyn, problem.q, problem.v
    tell("method")
    try:
        with limited(asked.making):
            _begin(asked, problem, dyn, times, setting)
        if asked.method in _TURNS_TO:
            # What it looks at on its way is compiled where it first looks.
            with limited(_FIRST * asked.seconds):
                quiet_simulate(*start, duration, asked.method, save=times, **setting)
        tell("run")
        if told := _too_many(asked, problem, dyn, times, setting):
            return Cell(asked.value, "slow", note=told)
        with heard_warnings() as heard:
            begun = _clock()
            look = patience(asked.seconds, _clock)
            with limited(_LATER * asked.seconds):
                run = simulate(*start, duration, asked.method, save=times, progress=look, **setting)
            seconds = [_clock() - begun]
    except TooLongError as error:
        return Cell(asked.value, "slow", note=str(error))
    while seconds[0] < _SHORT and len(seconds) < _REPEATS:
        begun = _clock()
        quiet_simulate(*start, duration, asked.method, save=times, doubt=False, **setting)
        seconds.append(_clock() - begun)
    stats = run.stats
    note = "; ".join(x for x in (stats.message, stats.chosen) if x)
    out = Cell(asked.value, "finished", seconds=float(np.median(seconds)), steps=stats.steps, note=note)
    if not stats.finished or len(run.t) != len(times):
        return replace(out, end="diverged", note=stats.message or f"ended at t = {run.t[-1]:g} s")
    out = replace(out, warnings=tuple(dict.fromkeys(heard)))
    if not (np.isfinite(run.q).all() and np.isfinite(run.v).all()):
        return replace(out, end="nan", note="states that are not finite, and nothing was said")
    return _judged(out, problem, dyn, run, truth, energies, measure)


def _judged(
    out: Cell,
    problem: Problem,
    dyn: Dynamics,
    run: Trajectory,
    truth: Truth | None,
    energies: OracleDynamics | None,
    measure: Measure,
) -> Cell:
    try:
        energy = _energy_error(energies or dyn, run)
    except MbkitError:
        energy = math.nan
    if truth is None:
        return replace(out, error=energy if measure == "energy" else math.nan, energy=energy)
    error = float(np.abs(problem.model.difference(truth.q, run.q)).max()) / problem.scale
    return replace(out, error=min(error, _LARGEST), energy=energy, floor=truth.floor / problem.scale)


def _energy_error(dyn: Dynamics, run: Trajectory) -> float:
    """Return the largest change of the energy, relative to T or to the change of V.

    NaN where there are dampers, where time enters, and where rounding hides it.
    """
    model = dyn.model
    if model.needs.damping or model.clock is not None:
        return math.nan
    T, V = _parts(dyn, "kinetic_energy", run.q, run.v), _parts(dyn, "potential_energy", run.q)
    if model.written is not None:
        # Jacobi's integral T2 - T0 + V, which is the energy where there is no T0.
        none = _parts(dyn, "kinetic_energy", run.q, 0 * run.v)
        T, V = (T[0] - none[0], T[1] - none[1]), (V[0] - none[0], V[1] - none[1])
    (gained, kinetic), (change, _) = _since_the_start(T), _since_the_start(V)
    drift, size = float(np.abs(gained + change).max()), max(float(kinetic.max()), float(np.ptp(change)))
    rounding = 0.0 if dyn.engine == OracleDynamics.engine else _ROUNDINGS * _EPS * float(np.abs([T[0], V[0]]).max())
    hidden = rounding > _HIDDEN * size and drift <= rounding
    return min(drift / size, _LARGEST) if size > 0 and not hidden else math.nan


def _parts(dyn: Dynamics, name: str, *state: Array) -> tuple[Array, Array]:
    """Return an energy as (high, low); a double has no low part."""
    if isinstance(dyn, OracleDynamics):
        return dyn.extended(name, *state)
    if name == "kinetic_energy":
        # By the mass matrix, which no known defect of an engine touches.
        high = 0.5 * np.einsum("ni,nij,nj->n", state[1], dyn.mass_matrix(state[0]), state[1])
    else:
        high = np.asarray(getattr(dyn, name)(*state))
    return high, np.zeros_like(high)


def _since_the_start(energy: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return how much an energy has changed, and itself."""
    high, low = energy
    return (high - high[0]) + (low - low[0]), high


def _setting(asked: Run, problem: Problem, times: Array) -> dict[str, Any]:
    method = METHODS[asked.method]
    if method.kind == "adaptive":
        return {"rtol": max(asked.rtol, method.least)}
    return {"dt": step_of(problem, times, asked.dt)}


def _begin(asked: Run, problem: Problem, dyn: Dynamics, times: Array, setting: dict[str, Any]) -> None:
    """Integrate a step, or next to nothing of an interval, for all that is compiled."""
    # However stiff the system, steps are not many in that.
    short = setting.get("dt", _MOMENT * float(times[1]))
    for method in (*_TURNS_TO.get(asked.method, ()), asked.method):
        quiet_simulate(dyn, problem.q, problem.v, short, method, save=[short], **setting)


def _too_many(asked: Run, problem: Problem, dyn: Dynamics, times: Array, setting: dict[str, Any]) -> str:
    """Return why an engine's own integrator would take too long: it does not stop when it is asked to."""
    if METHODS[asked.method].kind != "native":
        return ""
    dt = setting["dt"]
    steps = round(float(times[-1]) / dt)
    if steps < 2 * _TRIAL:
        return ""
    begun = _clock()
    quiet_simulate(dyn, problem.q, problem.v, _TRIAL * dt, asked.method, save=[_TRIAL * dt], **setting)
    expected = (_clock() - begun) * steps / _TRIAL
    return f"not run: {steps} steps would take {expected:.2g} s" if expected > asked.seconds else ""


@contextmanager
def heard_warnings() -> Iterator[list[str]]:
    """Collect what the library warns of."""
    out: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield out
    out += [" ".join(str(w.message).split()) for w in caught if issubclass(w.category, MbkitWarning)]


def evaluated(asked: Run, dyn: Dynamics, truth: Terms, tell: Callable[[Doing], None]) -> Cell:
    """Return the error and the time of one evaluation of a term.

    Parameters
    ----------
    asked : Run
        Whose method is the term.
    dyn : Dynamics
    truth : Terms
    tell : callable
        As in `integrated`.
    """
    tell("method")
    arguments = [getattr(truth.at, name) for name in TERMS[asked.method]]
    term: Callable[..., Any] = getattr(dyn, asked.method)
    with heard_warnings() as heard:
        value = np.asarray(term(*arguments))
    tell("run")
    # Writeable ones, as users have: engines have a short way for them.
    one = [np.array(x[0]) for x in arguments]
    ns, _ = interleaved({"": lambda: term(*one)}, rounds=3)[""]
    out = Cell(asked.value, "finished", seconds=1e-9 * ns, warnings=tuple(dict.fromkeys(heard)))
    if not np.isfinite(value).all():
        return replace(out, end="nan", note="numbers that are not finite, and nothing was said")
    if asked.method not in truth.values:
        return replace(out, note=truth.missing[asked.method])
    return replace(out, error=error_of(asked.method, value, truth))
