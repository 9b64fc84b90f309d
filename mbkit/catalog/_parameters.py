"""Reading the parameters of a system, and what several of them share."""

from __future__ import annotations

import operator
from typing import Any, Final

from mbkit._check import finite_array, real
from mbkit.errors import InputError

__all__ = ["SWING", "count", "down", "moments", "point", "positive"]

#: Axis of planar hinges: a positive turn about -y swings what hangs down towards +x.
SWING: Final = (0.0, -1.0, 0.0)


def positive(name: str, value: float) -> float:
    """Return a number above zero: a length, a mass."""
    return real(name, value, positive=True)


def down(value: float) -> tuple[float, float, float]:
    """Return the gravity vector of an acceleration of at least zero along -z."""
    return (0.0, 0.0, -real("gravity", value, nonnegative=True))


def point(name: str, value: Any) -> tuple[float, float, float]:
    """Return three finite numbers."""
    x, y, z = finite_array(name, value, (3,)).tolist()
    return (x, y, z)


def moments(name: str, value: Any) -> tuple[float, float, float]:
    """Return three principal moments of inertia that matter can have."""
    a, b, c = point(name, value)
    if min(a, b, c) < 0 or 2 * max(a, b, c) > (a + b + c) * (1 + 1e-12):
        raise InputError(f"{name}: expected moments of at least 0 with A + B >= C, got ({a:g}, {b:g}, {c:g}) kg m²")
    return (a, b, c)


def count(name: str, value: int) -> int:
    """Return a whole number of at least one."""
    try:
        n = 0 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        n = 0
    if n < 1:
        raise InputError(f"{name}: expected a whole number of at least 1, got {value!r}")
    return n
