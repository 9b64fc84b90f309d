"""Ways to get a rotation wrong."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.studies.causes.hypothesis import angle_of

__all__ = ["misread", "reordered"]


def reordered(R: Array) -> tuple[Array, Array]:
    """Return the rotation with its quaternion written w first and read w last, and the other way round."""
    x, y, z, w = spatial.quaternion_from_matrix(R)
    first = spatial.matrix_from_quaternion(np.array([w, x, y, z]))
    return first, spatial.matrix_from_quaternion(np.array([y, z, w, x]))


def misread(R: Array) -> Iterator[tuple[str, str, Array]]:
    """Yield kind of mistake, what was done, and the rotation that comes of it."""
    for other in reordered(R):
        yield "quaternion order", "reads the joint's quaternion in the wrong order", other
    if angle_of(R) < 1e-12:
        return
    yield "inverse rotation", "has the joint's rotation the wrong way round", R.T
    yield "rotation left out", "has no rotation at the joint", np.eye(3)
    roll, pitch, yaw = spatial.rpy_from_matrix(R)
    about = [spatial.matrix_from_rpy(*x) for x in ((roll, 0, 0), (0, pitch, 0), (0, 0, yaw))]
    yield "order of angles", "turns by roll, pitch, yaw in the other order", about[0] @ about[1] @ about[2]
    for factor, says in ((180 / np.pi, "degrees for radians"), (np.pi / 180, "radians for degrees")):
        angles = factor * np.array([roll, pitch, yaw])
        yield "unit of angle", f"takes {says} in the joint's rotation", spatial.matrix_from_rpy(*angles)
