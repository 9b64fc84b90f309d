"""Quaternion arithmetic on components: floats of one state, arrays of a batch, or symbols.

`mbkit.spatial` has the same formulas on stacked arrays. These take sequences of the components x, y, z, w: on one
state a NumPy call costs twenty times the arithmetic. Functions other than ``+ - * /`` are in the first argument.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

Components = Sequence[Any]

# Below these angles squared the series are exact to rounding (as in mbkit.spatial).
_SMALL_SQUARED_ANGLE_EXP: Final = 1e-4
_SMALL_SQUARED_ANGLE_DEXP: Final = 1e-2


@dataclass(frozen=True)
class Arithmetic:
    """Functions of one kind of scalars."""

    sqrt: Callable[[Any], Any]
    sin: Callable[[Any], Any]
    cos: Callable[[Any], Any]
    choose: Callable[[Any, Any, Any], Any]  # choose(condition, yes, no), both evaluated


def _of_finite(function: Callable[[float], float]) -> Callable[[float], float]:
    # Python's own functions raise where an array's give NaN.
    return lambda x: function(x) if math.isfinite(x) else math.nan


FLOATS: Final = Arithmetic(
    math.sqrt, _of_finite(math.sin), _of_finite(math.cos), lambda condition, yes, no: yes if condition else no
)
ARRAYS: Final = Arithmetic(np.sqrt, np.sin, np.cos, np.where)


def cross(a: Components, b: Components) -> list[Any]:
    """Return a × b."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def product(a: Components, b: Components) -> list[Any]:
    """Return the quaternion a b."""
    (ax, ay, az, aw), (bx, by, bz, bw) = a, b
    return [
        aw * bx + bw * ax + ay * bz - az * by,
        aw * by + bw * ay + az * bx - ax * bz,
        aw * bz + bw * az + ax * by - ay * bx,
        aw * bw - ax * bx - ay * by - az * bz,
    ]


def unit(m: Arithmetic, a: Components) -> list[Any]:
    """Return a / |a|."""
    x, y, z, w = a
    norm = m.sqrt(x * x + y * y + z * z + w * w)
    return [x / norm, y / norm, z / norm, w / norm]


def rotate(quaternion: Components, x: Components) -> list[Any]:
    """Return R x."""
    u, w = quaternion[:3], quaternion[3]
    t0, t1, t2 = cross(u, x)
    t0, t1, t2 = 2 * t0, 2 * t1, 2 * t2
    s0, s1, s2 = cross(u, (t0, t1, t2))
    return [x[0] + w * t0 + s0, x[1] + w * t1 + s1, x[2] + w * t2 + s2]


def rotate_back(quaternion: Components, x: Components) -> list[Any]:
    """Return Rᵀ x."""
    a, b, c, w = quaternion
    return rotate((-a, -b, -c, w), x)


def exponential(m: Arithmetic, u: Components) -> list[Any]:
    """Return the quaternion of the rotation vector u."""
    x, y, z = u
    scale, cosine = _half_angle(m, x * x + y * y + z * z)
    return [scale * x, scale * y, scale * z, cosine]


def _half_angle(m: Arithmetic, square: Any) -> tuple[Any, Any]:
    # sin(θ/2)/θ and cos(θ/2) from θ². The argument of the root is never zero, where it has no derivative.
    small = square < _SMALL_SQUARED_ANGLE_EXP
    angle = m.sqrt(m.choose(small, 1.0, square))
    quarter = square / 4
    sine = 0.5 * (1 - quarter / 6 * (1 - quarter / 20 * (1 - quarter / 42)))
    cosine = 1 - quarter / 2 * (1 - quarter / 12 * (1 - quarter / 30))
    half = angle / 2
    return m.choose(small, sine, m.sin(half) / angle), m.choose(small, cosine, m.cos(half))


def dexp_inverse(m: Arithmetic, u: Components, w: Components) -> list[Any]:
    """Return the rate of u while exp(u) turns with the body-axes velocity w.

    u̇ = w + ½ u × w + (1 - (θ/2) cot(θ/2))/θ² u × (u × w), θ = |u| (Iserles, Munthe-Kaas, Nørsett, Zanna 2000,
    app. B, for velocities in body axes).
    """
    x, y, z = u
    c = _dexp_coefficient(m, x * x + y * y + z * z)
    s = cross(u, w)
    r = cross(u, s)
    return [w[i] + 0.5 * s[i] + c * r[i] for i in range(3)]


def _dexp_coefficient(m: Arithmetic, square: Any) -> Any:
    small = square < _SMALL_SQUARED_ANGLE_DEXP
    safe = m.choose(small, 1.0, square)
    half = m.sqrt(safe) / 2
    series = 1 / 12 + square * (1 / 720 + square * (1 / 30240 + square * (1 / 1209600 + square / 47900160)))
    return m.choose(small, series, (1 - half * m.cos(half) / m.sin(half)) / safe)
