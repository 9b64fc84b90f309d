"""Places of all bodies at many configurations, and the box that a body's inertia is, from the description alone."""

from __future__ import annotations

import numpy as np

from mbkit._check import Array
from mbkit.model.description import Description
from mbkit.model.parts import Body, Frame, Joint


def body_poses(model: Description, q: Array) -> dict[str, tuple[Array, Array]]:
    """Return R_WB (n, 3, 3) and p_WB (n, 3) in m of every body and of ``"world"`` at configurations (n, nq)."""
    n, full = len(q), model.layout.expand_q(q)
    X = {"world": np.broadcast_to(np.eye(4), (n, 4, 4))}
    for joint in model.tree:
        own = list(full[:, model.layout.full_q[joint.name]].T)
        X[joint.child] = X[joint.parent] @ frame_of(joint) @ pose_of(joint, own, n)
    return {name: (x[:, :3, :3], x[:, :3, 3]) for name, x in X.items()}


def frame_of(part: Joint | Frame) -> Array:
    """Return the pose (4, 4) of a frame, or of a joint's fixed frame, in its body."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = part.rotation, part.translation
    return out


def pose_of(joint: Joint, q: list[Array], n: int) -> Array:
    """Return the child's pose in the joint's frame, (n, 4, 4)."""
    R, p = joint.type.placement(np, joint, q)
    out = np.zeros((n, 4, 4))
    for i, row in enumerate(R):
        for j, x in enumerate((*row, p[i])):
            out[:, i, j] = x
    out[:, 3, 3] = 1.0
    return out


def inertia_box(body: Body) -> tuple[Array, Array]:
    """Return axes (3, 3) and half lengths (3,) in m of the uniform box with a body's mass and inertia, about its com.

    ∫ x² dm along a principal axis is half the sum of the moments less that axis's own; of a box it is m/3 times the
    half length squared.
    """
    moments, axes = np.linalg.eigh(body.inertia)
    squares = np.maximum(moments.sum() / 2 - moments, 0.0)
    return np.asarray(axes), np.sqrt(3 * squares / body.mass) if body.mass else np.zeros(3)
