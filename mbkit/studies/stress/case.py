"""What is swept: a case makes one problem of each value, from mild to extreme."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

from mbkit._check import Array, real
from mbkit.errors import InputError
from mbkit.model import Model

__all__ = ["Case", "Family", "Measure", "Problem", "Truth", "problem_of", "step_of", "times_of"]


Family = Literal["stiffness", "mass ratio", "length", "spin", "near-singular", "large", "long", "step"]
#: What an error is: of q along a run, of the energy along a run, or of terms at given states.
Measure = Literal["motion", "energy", "terms"]


@dataclass(frozen=True)
class Truth:
    """What a run is measured by.

    Attributes
    ----------
    times : (K,) array
        From 0, s.
    q : (K, nq) array
    floor : float
        How well it is known, rad or m.
    how : str
        The closed form with its source, or the runs that agree to the floor.
    """

    times: Array
    q: Array
    floor: float
    how: str


@dataclass(frozen=True)
class Problem:
    """One value of a case.

    Attributes
    ----------
    model : Model
    q, v : (nq,) and (nv,) arrays, or (N, nq) and (N, nv) for terms
        Where a run starts, or the states at which terms are measured.
    tau : (N, nv) array or None
        Generalized force of the terms' forward dynamics.
    duration : float
        Of a run, s; 0 for terms.
    exact : callable or None
        From the times (K,) to q (K, nq), where a closed form is known.
    floor : float
        How well `exact` is known, rad or m.
    source : str
        Of the closed form.
    scale : float
        What an error of q is divided by: the size of the motion, rad or m.
    dt : float or None
        Step of fixed-step methods, s, where the case prescribes it.
    facts : dict
        Numbers worth telling, with a unit behind a comma in their names: ``"fastest frequency, rad/s"``,
        a condition number.
    """

    model: Model
    q: Array
    v: Array
    tau: Array | None = None
    duration: float = 0.0
    exact: Callable[[Array], Array] | None = None
    floor: float = 0.0
    source: str = ""
    scale: float = 1.0
    dt: float | None = None
    facts: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    """A sweep of one number over decades.

    Attributes
    ----------
    name : str
        As `mbkit stress` takes it.
    about : str
        One sentence: the system, and what is asked of it.
    family : str
    parameter, unit : str
        What is swept; the unit is empty for a pure number.
    values, quick : tuple of float
        From mild to extreme; the fewer of a quick run.
    make : callable
        From a value to its `Problem`; a function of a module, for it is called in other processes.
    measure : {"motion", "energy", "terms"}
    bar : float or None
        The error up to which a value is held, where the study's own has no meaning here.
    why : str
        Reason of that bar.
    methods : tuple of str
        The only ones that are asked, where others have no meaning; all where empty.
    theory : callable or None
        From an engine and a method to the value at which linear theory lets it break, or None.
    patience : float
        How many times as long as the study allows a run may take here; more than 1 for long motions.
    """

    name: str
    about: str
    family: Family
    parameter: str
    unit: str
    values: tuple[float, ...]
    quick: tuple[float, ...]
    make: Callable[[float], Problem]
    measure: Measure = "motion"
    bar: float | None = None
    why: str = ""
    methods: tuple[str, ...] = ()
    theory: Callable[[str, str], float | None] | None = None
    patience: float = 1.0

    def facts(self) -> dict[str, Any]:
        """Return what a result keeps of it, as plain data."""
        kept = ("name", "about", "family", "parameter", "unit", "measure", "bar", "why")
        return {name: getattr(self, name) for name in kept}


# Problems as cases make them, checked; and the times and steps of their runs.

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
