"""A case of a stress study: one number swept from mild to extreme, and the problem of each value.

Decorator of cases, values over decades, and problems of motions and of terms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, real
from mbkit.errors import InputError
from mbkit.model import Model
from mbkit.studies.exact_motions import Exact
from mbkit.studies.measurement import Problem
from mbkit.studies.study_runs import whole_steps

#: Families stand in the order of a study: stiff ones first, those that take longest last.
Family = Literal["stiffness", "mass ratio", "length", "spin", "near-singular", "friction", "large", "step", "long"]
#: The error of q along a run, of the energy along a run, or of terms at states.
Measure = Literal["motion", "energy", "terms"]


@dataclass(frozen=True)
class Case:
    """A sweep of one number over decades.

    Attributes
    ----------
    name, about, family : str
        The argument of `mbkit stress`, one sentence on the system and its task, and the kind of extreme.
    parameter, unit : str
        The number that is swept; the unit is empty for a pure number.
    values, quick : tuple of float
        From mild to extreme, and the few of a quick study.
    make : callable
        From a value to its `Problem`; a function of a module, because other processes call it.
    measure : {"motion", "energy", "terms"}
    bar, why : float or None, and str
        The error up to which a value is held, None for the study's own, and its reason.
    methods : tuple of str
        The only ones with a meaning here; all where empty.
    theory : callable or None
        From an engine and a method to the value at which linear theory lets it break, or None.
    patience : float
        Factor on the time that the study allows a run; more than 1 for long motions.
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
        """Return the case's entries in a result, as plain data."""
        kept = ("name", "about", "family", "parameter", "unit", "measure", "bar", "why")
        return {name: getattr(self, name) for name in kept}


#: Parts of a run at whose ends errors are measured; the energy at more of them.
_INTERVALS: Final[dict[Measure, int]] = {"motion": 10, "energy": 200}


def problem_of(case: Case, value: float) -> Problem:
    """Return the problem of one value, checked; `InputError` where it is unusable or has another measure."""
    problem: Any = case.make(value)
    what = f"{case.name} at {value:g}"
    if not isinstance(problem, Problem):
        raise InputError(f"{what}: expected make to return a Problem, got {type(problem).__name__}")
    model: Any = problem.model
    if not isinstance(model, Model):
        raise InputError(f"{what}: model: expected a Model, got {type(model).__name__}")
    model.require_values("a study of stress")
    if not model.nv:
        raise InputError(f"{what}: nothing moves in {model.name} (nv = 0)")
    q, v = model.check_q(problem.q), model.check_v(problem.v)
    if case.measure == "terms":
        if problem.tau is not None:
            model.check_v(problem.tau, "tau")
        return problem
    if q.ndim != 1 or v.ndim != 1:
        raise InputError(f"{what}: q, v: expected one state for a run, got shapes {q.shape} and {v.shape}")
    if problem.tau is not None and not callable(problem.tau):
        model.check_v(problem.tau, "tau")
    real(f"{what}: duration", problem.duration, positive=True)
    real(f"{what}: scale", problem.scale, positive=True)
    real(f"{what}: floor", problem.floor, nonnegative=True)
    if problem.dt is not None:
        real(f"{what}: dt", problem.dt, positive=True)
    if problem.exact is not None and not callable(problem.exact):
        raise InputError(f"{what}: exact: expected a function of the times or None, got {problem.exact!r}")
    return problem


def times_of(problem: Problem, measure: Measure) -> Array:
    """Return the times at which a run is measured, s; steps of a given size end on them."""
    parts = _INTERVALS[measure]
    if problem.dt is None:
        return np.linspace(0.0, problem.duration, parts + 1)
    # The last step is whole, too: another length would be another method's.
    steps = max(1, round(problem.duration / problem.dt))
    stride = max(1, steps // parts)
    return np.arange(0, steps + 1, stride, dtype=np.float64) * problem.dt


def step_of(problem: Problem, times: Array, dt: float) -> float:
    """Return the step of fixed-step methods, s: the given one, or `dt` shortened to end on the times."""
    if problem.dt is not None:
        return problem.dt
    interval = float(times[1])
    return interval / whole_steps(interval, dt)


Make = TypeVar("Make", bound=Callable[..., Problem])
#: Name with unit -> number, for the report.
Facts = dict[str, float]

#: The axis of a hinge about which a body that hangs down swings.
SWING: Final = (0.0, -1.0, 0.0)
#: All cases by name, as the modules of this package add them.
TABLE: Final[dict[str, Case]] = {}


def case(
    family: Family,
    parameter: str,
    unit: str,
    values: tuple[float, ...],
    quick: tuple[float, ...],
    name: str = "",
    about: str = "",
    **more: Any,
) -> Callable[[Make], Make]:
    """Return a decorator that adds a case, whose problems a function makes.

    The function's name and docstring are the case's where no others are given. `more` are attributes of the `Case`, and
    arguments that the function gets besides the value.
    """
    options = {f.name: more.pop(f.name) for f in fields(Case) if f.name in more}

    def add(make: Make) -> Make:
        known = name or make.__name__
        assert known not in TABLE, f"two cases have the name {known}"
        text = about or " ".join((make.__doc__ or "").split())
        TABLE[known] = Case(known, text, family, parameter, unit, values, quick, partial(make, **more), **options)
        return make

    return add


def powers(first: int, last: int, step: int = 1) -> tuple[float, ...]:
    """Return the powers of ten from one exponent to another, both among them.

    Examples
    --------
    >>> powers(0, -6, 2)
    (1.0, 0.01, 0.0001, 1e-06)
    """
    sign = 1 if last >= first else -1
    # Parsed and not multiplied: 1e-9 is to be the double that everybody writes.
    return tuple(float(f"1e{n}") for n in range(first, last + sign, sign * step))


def motion(
    model: Model, q: ArrayLike, v: ArrayLike, duration: float, exact: Exact, floor: float, source: str, **more: Any
) -> Problem:
    """Return the problem of a motion with a closed form; 0 for `v` is a start at rest."""
    v = np.zeros(model.nv) + np.asarray(v, dtype=np.float64)
    return Problem(model, np.asarray(q), v, None, duration, exact, floor, source, **more)


def terms_at(model: Model, *, samples: int = 8, force: float = 1.0, facts: Facts | None = None) -> Problem:
    """Return the problem of a model's terms at its neutral configuration and at random states.

    The generalized forces are of the size `force`, N or N m.
    """
    rng = np.random.default_rng(0)
    q, v = model.random_state(rng, samples)
    q[0] = model.neutral()
    return Problem(model, q, v, tau=force * rng.standard_normal((samples, model.nv)), facts=facts or {})
