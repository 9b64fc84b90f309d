"""What several files of this folder need."""

from __future__ import annotations

import numpy as np

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any


def center_of(masses: Any, points: Any) -> list[Any]:
    """Return the total mass, kg, and the centre of masses at points, m, for each of a stack of states."""
    return [np.full(len(points), masses.sum()), np.einsum("b,nbi->ni", masses, points) / masses.sum()]


def apply(A: Any, x: Any) -> Any:
    """Return A x for each of a stack of states."""
    return (A @ x[..., None])[..., 0]


def skew(x: Any) -> Any:
    """Return the matrices of x ×."""
    return np.cross(np.asarray(x)[..., None, :], np.eye(3)).swapaxes(-1, -2)


def rotation(x: Any) -> Any:
    """Return the rotation matrices of quaternions x, y, z, w."""
    x = np.array(x, float) / np.linalg.norm(x, axis=-1, keepdims=True)
    K = skew(x[..., :3])
    return np.eye(3) + 2 * (x[..., 3, None, None] * K + K @ K)
