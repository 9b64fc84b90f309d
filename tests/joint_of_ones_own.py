"""A joint type of one's own: a cylindrical joint, which turns about its axis and slides along it."""

# ruff: noqa: ARG002  # formulas keep their arguments

from __future__ import annotations

from mbkit.model import KINDS, JointType, register_joint_type


class Cylindrical(JointType):
    name, nq, nv, n_axes = "cylindrical", 2, 2, 1
    lengths, angular = (0,), (1,)
    suffixes = velocity_suffixes = ("d", "angle")
    axial = True

    def placement(self, m, joint, q):
        R, _ = KINDS["revolute"].placement(m, joint, q[1:])
        return R, [a * q[0] for a in joint.axes[0]]

    def twist(self, m, joint, q, v):
        # The axis has the same components in the moving frame.
        return [a * v[0] for a in joint.axes[0]], [a * v[1] for a in joint.axes[0]]


class SlidingBall(JointType):
    """A ball joint that slides along an axis: coordinates that are lengths, then a quaternion."""

    name, nq, nv, n_axes = "sliding_ball", 5, 4, 1
    lengths, quaternion = (0,), 1
    suffixes, velocity_suffixes = ("d", "qx", "qy", "qz", "qw"), ("d", "wx", "wy", "wz")

    def placement(self, m, joint, q):
        R, _ = KINDS["ball"].placement(m, joint, q[1:])
        return R, [a * q[0] for a in joint.axes[0]]

    def twist(self, m, joint, q, v):
        R, _ = KINDS["ball"].placement(m, joint, q[1:])
        along = [v[0] * sum(R[k][i] * joint.axes[0][k] for k in range(3)) for i in range(3)]
        return along, list(v[1:])


OWN = tuple(register_joint_type(joint_type).name for joint_type in (Cylindrical(), SlidingBall()))
