"""Decorator of cases, values over decades, and problems of motions and of terms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from mbkit.model import Model
from mbkit.studies.measurement import Problem
from mbkit.studies.motions.exact import Exact
from mbkit.studies.stress.case import Case, Family

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
