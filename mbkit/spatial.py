"""Rotations, quaternions (x, y, z, w) and rigid motions, on batches.

Functions of arrays work along the last axes and broadcast over leading ones; the two that begin with a matrix or three
angles take one at a time. Series replace closed forms near zero where those lose digits; each says where.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array, hint_at_degrees
from mbkit.errors import InputError

__all__ = [
    "conjugate",
    "exp_quaternion",
    "exp_se3",
    "left_jacobian",
    "left_jacobian_inverse",
    "log_quaternion",
    "log_se3",
    "matrix_from_quaternion",
    "matrix_from_rpy",
    "multiply",
    "normalized",
    "pose",
    "pose_error",
    "quaternion_from_matrix",
    "rotate",
    "rpy_from_matrix",
    "skew",
]

# Below this angle the truncated series of the coefficients here are exact to
# rounding: the first term left out is below 1e-17 relative.
_SMALL_ANGLE = 1e-2


_F = TypeVar("_F", bound=Callable[..., Any])


def _takes(*shapes: tuple[int, ...]) -> Callable[[_F], _F]:
    """Let a function take lists too, and name an argument whose last axes are others: a scalar is no vector."""

    def decorated(function: _F) -> _F:
        names = tuple(inspect.signature(function).parameters)

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            if kwargs or len(args) != len(names):
                args = tuple(inspect.signature(function).bind(*args, **kwargs).args)
            if any(type(x) is not np.ndarray or x.shape[-len(n) :] != n for x, n in zip(args, shapes, strict=True)):
                args = tuple(map(_shaped, names, args, shapes))
            return function(*args)

        return call  # type: ignore[return-value]

    return decorated


def _shaped(name: str, x: Any, shape: tuple[int, ...]) -> Any:
    try:
        got = np.shape(x)
    except ValueError as error:
        raise InputError(f"{name}: expected an array of numbers, got rows of different lengths ({error})") from None
    if got[-len(shape) :] != shape:
        raise InputError(f"{name}: expected shape {shape} or (..., {str(shape)[1:-1].rstrip(',')}), got {got}")
    return x if isinstance(x, np.ndarray) else finite_array(name, x, got)


@_takes((3,))
def skew(w: Array) -> Array:
    """Return the matrix of ``w ×``, shape (..., 3, 3)."""
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return out


def _cross(a: Array, b: Array) -> Array:
    """Return a × b, (..., 3): the numbers of `numpy.cross`, which takes five times as long for one pair."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


@_takes((4,), (4,))
def multiply(a: Array, b: Array) -> Array:
    """Return the quaternion product a b, (..., 4)."""
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = aw * bv + bw * av + _cross(av, bv)
    scalar = aw * bw - np.sum(av * bv, axis=-1, keepdims=True)
    return np.concatenate([vector, scalar], axis=-1)


@_takes((4,))
def conjugate(a: Array) -> Array:
    """Return the conjugate (..., 4), the inverse of a unit quaternion."""
    return np.asarray(a * np.array([-1.0, -1.0, -1.0, 1.0]))


def normalized(a: Array) -> Array:
    """Return a divided by its norm, (..., n)."""
    return np.asarray(a / np.linalg.norm(a, axis=-1, keepdims=True))


@_takes((4,), (3,))
def rotate(quaternion: Array, x: Array) -> Array:
    """Return the vectors x (..., 3), rotated by unit quaternions (..., 4)."""
    u, w = quaternion[..., :3], quaternion[..., 3:]
    t = 2.0 * _cross(u, x)
    return np.asarray(x + w * t + _cross(u, t))


@_takes((4,))
def matrix_from_quaternion(quaternion: Array) -> Array:
    """Return R, shape (..., 3, 3), of unit quaternions q (..., 4), with R x = q x conj(q)."""
    x, y, z, w = (quaternion[..., i] for i in range(4))
    out = np.empty((*quaternion.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return out


@_takes((3, 3))
def quaternion_from_matrix(R: Array) -> Array:
    """Return the unit quaternion (4,) of one rotation matrix (3, 3), with w >= 0.

    Shepperd's method: it starts from the largest of the four squares, so that no divisor is small.
    """
    trace = float(np.trace(R))
    squares = np.array([*(1 + 2 * np.diag(R) - trace), 1 + trace])
    k = int(np.argmax(squares))
    if k == 3:
        q = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], squares[3]])
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        q = np.empty(4)
        q[k], q[i], q[j], q[3] = squares[k], R[i, k] + R[k, i], R[j, k] + R[k, j], R[j, i] - R[i, j]
    q = normalized(q)
    return -q if q[3] < 0 else q


def matrix_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Return Rz(yaw) Ry(pitch) Rx(roll), shape (3, 3), of angles in radians: URDF's convention."""
    hint_at_degrees("rpy", roll, pitch, yaw)
    (cr, cp, cy), (sr, sp, sy) = (tuple(map(f, (roll, pitch, yaw))) for f in (math.cos, math.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


@_takes((3, 3))
def rpy_from_matrix(R: Array) -> tuple[float, float, float]:
    """Return roll, pitch, yaw in radians with R = Rz(yaw) Ry(pitch) Rx(roll), pitch within ±π/2.

    Yaw comes first and is removed from R, so that roll makes up for what yaw lost near a pitch of ±π/2.
    """
    yaw = float(np.arctan2(R[1, 0], R[0, 0]))
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = float(np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0]))
    return float(np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])), pitch, yaw


@_takes((3,))
def exp_quaternion(w: Array) -> Array:
    """Return the unit quaternions (..., 4) of rotation vectors w (..., 3), in radians."""
    theta = np.linalg.norm(w, axis=-1, keepdims=True)
    half = theta / 2
    safe = np.where(theta < _SMALL_ANGLE, 1.0, theta)
    half2 = half * half
    series = 0.5 * (1 - half2 / 6 * (1 - half2 / 20 * (1 - half2 / 42)))
    scale = np.where(theta < _SMALL_ANGLE, series, np.sin(half) / safe)
    return np.concatenate([scale * w, np.cos(half)], axis=-1)


@_takes((4,))
def log_quaternion(quaternion: Array) -> Array:
    """Return the rotation vectors (..., 3), of length π at most, of unit quaternions (..., 4)."""
    q = np.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
    n = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    safe = np.where(n == 0, 1.0, n)
    # atan2(n, w)/n -> 1/w for n -> 0; atan2 itself keeps every digit down there.
    scale = np.where(n == 0, 2.0 / q[..., 3:], 2.0 * np.arctan2(n, q[..., 3:]) / safe)
    return np.asarray(scale * q[..., :3])


@_takes((3,))
def left_jacobian(w: Array) -> Array:
    """Return V, shape (..., 3, 3), with V(w) u the translation of ``exp_se3([u, w])``.

    Murray, Li, Sastry 1994, eq. 2.36.
    """
    theta2 = np.sum(w * w, axis=-1)
    theta = np.sqrt(theta2)
    small = theta < _SMALL_ANGLE
    safe = np.where(small, 1.0, theta)
    a_series = 0.5 * (1 - theta2 / 12 * (1 - theta2 / 30 * (1 - theta2 / 56)))
    b_series = (1 - theta2 / 20 * (1 - theta2 / 42 * (1 - theta2 / 72))) / 6
    a = np.where(small, a_series, 2 * np.sin(safe / 2) ** 2 / safe**2)
    b = np.where(small, b_series, (safe - np.sin(safe)) / safe**3)
    W = skew(w)
    return np.asarray(np.eye(3) + a[..., None, None] * W + b[..., None, None] * (W @ W))


@_takes((3,))
def left_jacobian_inverse(w: Array) -> Array:
    """Return the inverse of `left_jacobian`, shape (..., 3, 3)."""
    theta2 = np.sum(w * w, axis=-1)
    theta = np.sqrt(theta2)
    # (1 - (t/2) cot(t/2))/t^2 cancels as eps/t^2, so its series serves up to 0.1:
    # the first term left out is t^8 / 4.7e7 relative to 1/12.
    small = theta < 0.1
    safe = np.where(small, 1.0, theta)
    series = 1 / 12 + theta2 * (1 / 720 + theta2 * (1 / 30240 + theta2 * (1 / 1209600 + theta2 / 47900160)))
    c = np.where(small, series, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    W = skew(w)
    return np.asarray(np.eye(3) - W / 2 + c[..., None, None] * (W @ W))


@_takes((6,))
def exp_se3(xi: Array) -> tuple[Array, Array]:
    """Return translation (..., 3) and quaternion (..., 4) of exp of twists (..., 6), linear then angular."""
    u, w = xi[..., :3], xi[..., 3:]
    return np.einsum("...ij,...j->...i", left_jacobian(w), u), exp_quaternion(w)


@_takes((3,), (4,))
def log_se3(p: Array, quaternion: Array) -> Array:
    """Return the twists (..., 6), linear then angular, whose `exp_se3` are these rigid motions.

    Parameters
    ----------
    p : (..., 3) array
        Translations.
    quaternion : (..., 4) array
        Unit quaternions. The turn is at most π, and near π its axis is that of the quaternion.

    Examples
    --------
    >>> import numpy as np
    >>> from mbkit import spatial
    >>> xi = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    >>> bool(np.allclose(spatial.log_se3(*spatial.exp_se3(xi)), xi))
    True
    """
    w = log_quaternion(quaternion)
    return np.concatenate([np.einsum("...ij,...j->...i", left_jacobian_inverse(w), p), w], axis=-1)


def pose(translation: ArrayLike = (0.0, 0.0, 0.0), *, rpy: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Return the homogeneous matrix, (4, 4), of a translation in m and of URDF's roll, pitch, yaw in rad.

    Examples
    --------
    >>> import mbkit as mb
    >>> mb.spatial.pose((0, 0, 0.5))[:, 3]
    array([0. , 0. , 0.5, 1. ])
    """
    X = np.eye(4)
    X[:3, :3] = matrix_from_rpy(*finite_array("rpy", rpy, (3,)))
    X[:3, 3] = finite_array("translation", translation, (3,))
    return X


def checked_pose(name: str, X: ArrayLike) -> Array:
    """Return a homogeneous matrix, (4, 4), or raise `InputError` for another one."""
    out = finite_array(name, X, (4, 4))
    R = out[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-9 or np.linalg.det(R) < 0 or (out[3] != [0.0, 0.0, 0.0, 1.0]).any():
        raise InputError(f"{name}: expected a homogeneous matrix, R and p with the row 0 0 0 1 below, got another one")
    return out


@_takes((4, 4), (4, 4))
def pose_error(X: Array, X_goal: Array) -> Array:
    """Return what is missing from a pose to a goal, (..., 6), as controllers in task space use it.

    Linear first: p_goal - p, m. Then angular: the rotation vector that turns the pose's axes into the goal's, rad. Both
    are in the axes of the world, those of a Jacobian in ``"local_world_aligned"`` axes, so that
    ``v = J⁺ k pose_error`` goes straight to the goal.

    Parameters
    ----------
    X, X_goal : (4, 4) or (..., 4, 4) array
        Poses such as those of `Dynamics.pose`.

    Examples
    --------
    >>> import mbkit as mb
    >>> dyn = mb.dynamics(mb.catalog.pendulum(length=2.0))
    >>> mb.spatial.pose_error(dyn.pose([0.0], "tip"), dyn.pose([0.1], "tip"))[3:].round(12) + 0.0
    array([ 0. , -0.1,  0. ])
    """
    R = np.einsum("...ij,...kj->...ik", X_goal[..., :3, :3], X[..., :3, :3])
    flat = R.reshape(-1, 3, 3)
    turn = np.array([log_quaternion(quaternion_from_matrix(one)) for one in flat]).reshape(*R.shape[:-2], 3)
    return np.concatenate([X_goal[..., :3, 3] - X[..., :3, 3], turn], axis=-1)


def __dir__() -> list[str]:
    return __all__
