"""The plane of a picture of a motion in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit.errors import InputError

__all__ = ["Plane", "plane_of"]

_AXES: Final = "xyz"
# A world axis that shows this much of the widest spread reads better than a slanted one.
_NEARLY: Final = 0.9
# A motion flatter than this, seen from the side, is a line: it is seen from above.
_FLAT: Final = 0.02


@dataclass(frozen=True)
class Plane:
    """Two orthonormal directions, to the right and upwards, in world axes."""

    right: Array
    up: Array

    def of(self, points: Array) -> Array:
        """Return points (..., 3) in the plane, (..., 2)."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)

    @property
    def names(self) -> tuple[str, str]:
        """What the directions are called."""
        return _name(self.right), _name(self.up)


def _name(direction: Array) -> str:
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) > 1 - 1e-9:
        return ("-" if direction[k] < 0 else "") + _AXES[k]
    return "(" + ", ".join(f"{x:.2g}" for x in direction + 0.0) + ")"


def plane_of(view: str | ArrayLike | None, points: Array, gravity: Array) -> Plane:
    """Return the plane that a caller asked for, or the one that shows most.

    Parameters
    ----------
    view : str, (2, 3) array_like or None
    points : (P, 3) array
        Whatever is drawn at any time.
    gravity : (3,) array
    """
    if view is None:
        return _widest(points - points.mean(axis=0), gravity)
    if isinstance(view, str):
        if len(view) != 2 or view[0] == view[1] or not set(view) <= set(_AXES):
            raise InputError(f"view: expected two of x, y and z such as 'xz', or two directions, got {view!r}")
        right, up = np.eye(3)[[_AXES.index(a) for a in view]]
        return Plane(right, up)
    right, up = finite_array("view", view, (2, 3))
    lengths = np.linalg.norm(right), np.linalg.norm(up)
    if not all(lengths) or np.linalg.norm(np.cross(right, up)) < 1e-9 * lengths[0] * lengths[1]:
        raise InputError("view: expected two directions that are not along one line")
    right = right / lengths[0]
    up = up - (up @ right) * right
    return Plane(right, up / np.linalg.norm(up))


def _widest(points: Array, gravity: Array) -> Plane:
    g = float(np.linalg.norm(gravity))
    if g:
        up = -gravity / g
        right = _spread(points, up)
        ahead = np.cross(up, right)
        tall, wide, deep = (float(np.ptp(points @ x)) for x in (up, right, ahead))
        if tall > _FLAT * max(wide, deep) or deep <= tall:
            return Plane(right, up)
        return Plane(right, ahead)
    # Nothing says where up is: the plane that shows most, z or else y upwards in it.
    normal = np.linalg.eigh(points.T @ points)[1][:, 0]
    k = int(np.argmax(np.abs(normal)))
    spread = np.linalg.eigvalsh(points.T @ points)
    if points[:, k] @ points[:, k] <= spread[0] / _NEARLY**2 + 1e-12 * spread[2]:
        normal = np.eye(3)[k]
    up = np.eye(3)[1 if abs(normal[2]) > _NEARLY else 2]
    up = up - (up @ normal) * normal
    up /= np.linalg.norm(up)
    right = np.cross(up, normal)
    return Plane(right if right[np.argmax(np.abs(right))] > 0 else -right, up)


def _spread(points: Array, up: Array) -> Array:
    """Return the direction across `up` in which the points are widest, a world axis if one nearly is."""
    across = points - np.outer(points @ up, up)
    squares, axes = np.linalg.eigh(across.T @ across)
    best = axes[:, 2]
    for axis in np.eye(3):
        level = abs(axis @ up) < 1e-9
        if level and np.sum((across @ axis) ** 2) >= _NEARLY**2 * squares[2]:
            return np.asarray(axis)
    best = best - (best @ up) * up
    if not squares[2] or not best.any():
        # Only up and down: any level direction.
        best = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    best /= np.linalg.norm(best)
    return np.asarray(best if best[np.argmax(np.abs(best))] > 0 else -best)
