"""Problems as cases make them, checked; and the times and steps of their runs."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from mbkit._check import Array, real
from mbkit.errors import InputError
from mbkit.model import Model
from mbkit.studies.stress.case import Case, Measure, Problem

__all__ = ["problem_of", "step_of", "times_of"]

#: Parts of a run at whose ends errors are measured; the energy is looked at more closely.
_PARTS: Final[dict[Measure, int]] = {"motion": 10, "energy": 200}


def problem_of(case: Case, value: float) -> Problem:
    """Return the problem of one value.

    Raises
    ------
    InputError
        What was made is no problem, or none of this measure.
    """
    made: Any = case.make(value)
    what = f"{case.name} at {value:g}"
    if not isinstance(made, Problem):
        raise InputError(f"{what}: expected make to return a Problem, got {type(made).__name__}")
    if not isinstance(made.model, Model):
        raise InputError(f"{what}: model: expected a Model, got {type(made.model).__name__}")
    made.model.require_values("a study of stress")
    if not made.model.nv:
        raise InputError(f"{what}: nothing moves in {made.model.name} (nv = 0)")
    q, v = made.model.check_q(made.q), made.model.check_v(made.v)
    if case.measure == "terms":
        if made.tau is not None:
            made.model.check_v(made.tau, "tau")
        return made
    if q.ndim != 1 or v.ndim != 1:
        raise InputError(f"{what}: q, v: expected one state for a run, got shapes {q.shape} and {v.shape}")
    real(f"{what}: duration", made.duration, positive=True)
    real(f"{what}: scale", made.scale, positive=True)
    real(f"{what}: floor", made.floor, nonnegative=True)
    if made.dt is not None:
        real(f"{what}: dt", made.dt, positive=True)
    if made.exact is not None and not callable(made.exact):
        raise InputError(f"{what}: exact: expected a function of the times or None, got {made.exact!r}")
    return made


def times_of(problem: Problem, measure: Measure) -> Array:
    """Return the times at which a run is measured, s, on which steps that the problem prescribes end."""
    parts = _PARTS[measure]
    if problem.dt is None:
        return np.linspace(0.0, problem.duration, parts + 1)
    # The last step is whole, too: another length would be another method's.
    steps = max(1, round(problem.duration / problem.dt))
    stride = max(1, steps // parts)
    return np.arange(0, steps + 1, stride, dtype=np.float64) * problem.dt


def step_of(problem: Problem, times: Array, asked: float) -> float:
    """Return the step of fixed-step methods, s: prescribed, or as asked and shortened to end on the times."""
    if problem.dt is not None:
        return problem.dt
    interval = float(times[1])
    return interval / max(1, int(np.ceil(interval / asked * (1 - 1e-9))))
