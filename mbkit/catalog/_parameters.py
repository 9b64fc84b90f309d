"""Reading the parameters of a system, and what several of them share."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import finite_array, real, shown
from mbkit.errors import InputError
from mbkit.model import Expression, Number, known, nominal

__all__ = ["SWING", "Vector", "count", "down", "moments", "nonnegative", "point", "positive"]

#: What a system takes for three numbers.
Vector = ArrayLike | Sequence[Number]

#: Axis of planar hinges: a positive turn about -y swings what hangs down towards +x.
SWING: Final = (0.0, -1.0, 0.0)

# Rods and segments; `ModelBuilder.build` takes few more.
_MOST: Final = 2000


def positive(name: str, value: Number) -> Number:
    """Return a number above zero, or an expression that is above zero as far as is known: a length, a mass."""
    if not isinstance(value, Expression):
        return real(name, value, positive=True)
    if known(value):
        real(name, nominal(value), positive=True)
    return value


def nonnegative(name: str, value: Number) -> Number:
    """Return a number of at least zero, or an expression that is so as far as is known."""
    if not isinstance(value, Expression):
        return real(name, value, nonnegative=True)
    if known(value):
        real(name, nominal(value), nonnegative=True)
    return value


def down(value: Number) -> tuple[float, float, Number]:
    """Return the gravity vector of an acceleration of at least zero along -z."""
    return (0.0, 0.0, -nonnegative("gravity", value))


def point(name: str, value: Any) -> tuple[Number, Number, Number]:
    """Return three finite numbers or expressions."""
    if isinstance(value, (list, tuple, np.ndarray)) and any(isinstance(x, Expression) for x in value):
        finite_array(name, [nominal(x) if known(x) else 0.0 for x in value], (3,))
        x, y, z = value
    else:
        x, y, z = finite_array(name, value, (3,)).tolist()
    return (x, y, z)


def moments(name: str, value: Any) -> tuple[Number, Number, Number]:
    """Return three principal moments of inertia that matter can have."""
    given = point(name, value)
    if not all(known(x) for x in given):
        return given
    a, b, c = (nominal(x) for x in given)
    if min(a, b, c) < 0 or 2 * max(a, b, c) > (a + b + c) * (1 + 1e-12):
        raise InputError(f"{name}: expected moments of at least 0 with A + B >= C, got ({a:g}, {b:g}, {c:g}) kg m²")
    return given


def count(name: str, value: int) -> int:
    """Return a whole number of at least one, and of no more than a description holds."""
    try:
        n = 0 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        n = 0
    if not 1 <= n <= _MOST:
        raise InputError(f"{name}: expected a whole number from 1 to {_MOST}, got {shown(value)}")
    return n
