"""Places of all bodies at many configurations, and the box that a body's inertia is, from the description alone."""

from __future__ import annotations

import numpy as np

from mbkit._check import Array
from mbkit.model.description import Description
from mbkit.model.parts import Body


def body_poses(model: Description, q: Array) -> dict[str, tuple[Array, Array]]:
    """Return R_WB (n, 3, 3) and p_WB (n, 3) in m of every body and of ``"world"`` at configurations (n, nq)."""
    n, full = len(q), model.layout.expand_q(q)
    poses = {"world": (np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)))}
    for joint in model.tree:
        R_WP, p_WP = poses[joint.parent]
        R, p = joint.type.placement(np, joint, list(full[:, model.layout.full_q[joint.name]].T))
        R_JC = np.array([[np.broadcast_to(x, n) for x in row] for row in R]).transpose(2, 0, 1)
        p_JC = np.array([np.broadcast_to(x, n) for x in p]).T
        R_WJ = R_WP @ joint.rotation
        p_WC = p_WP + R_WP @ joint.translation + np.einsum("nij,nj->ni", R_WJ, p_JC)
        poses[joint.child] = R_WJ @ R_JC, p_WC
    return poses


def inertia_box(body: Body) -> tuple[Array, Array]:
    """Return axes (3, 3) and half lengths (3,) in m of the uniform box with a body's mass and inertia, about its com.

    ∫ x² dm along a principal axis is half the sum of the moments less that axis's own; of a box it is m/3 times the
    half length squared.
    """
    moments, axes = np.linalg.eigh(body.inertia)
    squares = np.maximum(moments.sum() / 2 - moments, 0.0)
    return np.asarray(axes), np.sqrt(3 * squares / body.mass) if body.mass else np.zeros(3)
