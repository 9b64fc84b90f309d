"""What the families of cases share: their table, values over decades, and problems of motions and of terms."""

from __future__ import annotations

from collections.abc import Callable
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
#: All cases, as the modules of this package write them down.
TABLE: Final[list[Case]] = []


class Series:
    """What the cases of one sweep have in common; it decorates the function that makes the problems of one."""

    def __init__(
        self,
        family: Family,
        parameter: str,
        unit: str,
        values: tuple[float, ...],
        quick: tuple[float, ...],
        **more: Any,
    ) -> None:
        self._swept, self._more = (family, parameter, unit, values, quick), more

    def __call__(self, make: Make) -> Make:
        return rows(self.row(make.__name__, " ".join((make.__doc__ or "").split())))(make)

    def row(self, name: str, about: str, **numbers: Any) -> Callable[[Callable[..., Problem]], Case]:
        """Return a case but for the function that makes its problems, which gets these numbers besides the value."""
        return lambda make: Case(name, about, *self._swept, partial(make, **numbers), **self._more)


def rows(*some: Callable[[Callable[..., Problem]], Case]) -> Callable[[Make], Make]:
    """Return a decorator that adds the cases of these rows, whose problems the function makes."""

    def add(make: Make) -> Make:
        TABLE.extend(row(make) for row in some)
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
    model: Model,
    q: ArrayLike,
    v: ArrayLike,
    duration: float,
    exact: Exact,
    floor: float,
    source: str,
    facts: Facts | None = None,
    **more: Any,
) -> Problem:
    """Return the problem of a motion with a closed form; 0 for `v` is a start at rest."""
    v = np.zeros(model.nv) + np.asarray(v, dtype=np.float64)
    return Problem(model, np.asarray(q), v, None, duration, exact, floor, source, facts=facts or {}, **more)


def terms_at(model: Model, *, samples: int = 8, force: float = 1.0, facts: Facts | None = None) -> Problem:
    """Return the problem of a model's terms at its neutral configuration and at random states.

    The generalized forces are of the size `force`, N or N m.
    """
    rng = np.random.default_rng(0)
    q, v = model.random_state(rng, samples)
    q[0] = model.neutral()
    return Problem(model, q, v, tau=force * rng.standard_normal((samples, model.nv)), facts=facts or {})
