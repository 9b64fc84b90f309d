"""Quaternion arithmetic on components: floats of one state, or arrays of a batch.

`mbkit.spatial` has the same formulas on stacked arrays. A step needs a dozen of
them, and on one state NumPy's call costs twenty times the arithmetic, so these
take and return sequences of components: x, y, z, w.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

__all__ = ["cross", "dexp_inverse", "exponential", "product", "rotate", "rotate_back", "unit"]

Components = Sequence[Any]

# Below these angles squared the series are exact to rounding (as in mbkit.spatial).
_SMALL_EXP = 1e-4
_SMALL_DEXP = 1e-2


def cross(a: Components, b: Components) -> list[Any]:
    """Return a × b."""
    (a0, a1, a2), (b0, b1, b2) = a, b
    return [a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0]


def product(a: Components, b: Components) -> list[Any]:
    """Return the quaternion a b."""
    (ax, ay, az, aw), (bx, by, bz, bw) = a, b
    return [
        aw * bx + bw * ax + ay * bz - az * by,
        aw * by + bw * ay + az * bx - ax * bz,
        aw * bz + bw * az + ax * by - ay * bx,
        aw * bw - ax * bx - ay * by - az * bz,
    ]


def unit(a: Components) -> list[Any]:
    """Return a / |a|."""
    x, y, z, w = a
    square = x * x + y * y + z * z + w * w
    norm = math.sqrt(square) if isinstance(square, float) else np.sqrt(square)
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


def exponential(u: Components) -> list[Any]:
    """Return the quaternion of the rotation vector u."""
    x, y, z = u
    scale, cosine = _half_angle(x * x + y * y + z * z)
    return [scale * x, scale * y, scale * z, cosine]


def _half_angle(square: Any) -> tuple[Any, Any]:
    # sin(θ/2)/θ and cos(θ/2) from θ²
    if isinstance(square, float):
        if not math.isfinite(square):
            return math.nan, math.nan
        theta = math.sqrt(square)
        sine = _exp_series(square) if square < _SMALL_EXP else math.sin(theta / 2) / theta
        return sine, math.cos(theta / 2)
    angle = np.sqrt(square)
    small = square < _SMALL_EXP
    scale = np.where(small, _exp_series(square), np.sin(angle / 2) / np.where(small, 1.0, angle))
    return scale, np.cos(angle / 2)


def _exp_series(square: Any) -> Any:
    quarter = square / 4
    return 0.5 * (1 - quarter / 6 * (1 - quarter / 20 * (1 - quarter / 42)))


def dexp_inverse(u: Components, w: Components) -> list[Any]:
    """Return the rate of u while exp(u) turns with the body-axes velocity w.

    u̇ = w + ½ u × w + (1 - (θ/2) cot(θ/2))/θ² u × (u × w), θ = |u|: the inverse of
    exp's differential (Iserles, Munthe-Kaas, Nørsett, Zanna 2000, app. B, for
    velocities in body axes).
    """
    x, y, z = u
    c = _dexp_coefficient(x * x + y * y + z * z)
    s = cross(u, w)
    r = cross(u, s)
    return [w[i] + 0.5 * s[i] + c * r[i] for i in range(3)]


def _dexp_coefficient(square: Any) -> Any:
    if isinstance(square, float):
        if not math.isfinite(square):
            return math.nan
        if square < _SMALL_DEXP:
            return _dexp_series(square)
        half = math.sqrt(square) / 2
        return (1 - half / math.tan(half)) / square
    small = square < _SMALL_DEXP
    safe = np.where(small, 1.0, square)
    halves = np.sqrt(safe) / 2
    return np.where(small, _dexp_series(square), (1 - halves / np.tan(halves)) / safe)


def _dexp_series(square: Any) -> Any:
    return 1 / 12 + square * (1 / 720 + square * (1 / 30240 + square * (1 / 1209600 + square / 47900160)))
