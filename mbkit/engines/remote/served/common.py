"""What several files of this folder need."""

from __future__ import annotations

from typing import Any

import numpy as np


def center_of(masses: Any, points: Any) -> list[Any]:
    """Return the total mass, kg, and the centre of masses at points, m, of a state or a stack of them."""
    return [np.full(points.shape[:-2], masses.sum()), masses @ points / masses.sum()]


def run(q: Any, v: Any, steps: int, step: Any) -> list[Any]:
    """Return q and v of a state or a stack, and after each step: ``step(k)`` returns views of them."""
    out = [(np.array(q), np.array(v))]
    for k in range(steps):
        q, v = step(k)
        out.append((np.array(q, float), np.array(v, float)))
    return [np.stack(x, axis=-2) for x in zip(*out, strict=True)]


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
