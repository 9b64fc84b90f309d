"""A `pinocchio.Model` made from a description, and how its numbers map to ours.

Joints are added depth first, because Pinocchio's algorithms take a subtree to be
contiguous. Continuous joints are plain revolute ones, with one angle. A planar
joint is two slides and a hinge, whose velocities are the derivatives of its
coordinates (Pinocchio's own planar joint has four numbers and body velocities).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from mbkit._check import Array
from mbkit.model import Body, Joint, Model

__all__ = ["PinModel", "build"]

_X, _Y, _Z = np.eye(3)


@dataclass(frozen=True)
class PinModel:
    """The built model and the maps between its coordinates and the description's.

    Attributes
    ----------
    model : pinocchio.Model
    bodies : dict
        Body name -> (joint index, R_JB, p_JB_J).
    q_order, v_order : (n,) integer arrays
        Pinocchio's coordinate i is full coordinate ``q_order[i]``.
    ordered : bool
        Whether both orders are the identity.
    ground_moment : (3,) array
        Σ m p over bodies fixed to the world: Pinocchio's energy leaves them out.
    unaligned_armature : tuple of str
        Revolute joints off the positive axes that have armature.
    """

    model: pin.Model
    bodies: dict[str, tuple[int, Array, Array]]
    q_order: np.ndarray
    v_order: np.ndarray
    ordered: bool
    ground_moment: Array
    unaligned_armature: tuple[str, ...]


def build(description: Model) -> PinModel:
    """Return the description as Pinocchio holds it."""
    made = pin.Model()
    made.name = description.name
    made.gravity = pin.Motion(np.array(description.gravity), np.zeros(3))
    layout = description.layout
    bodies: dict[str, tuple[int, Array, Array]] = {"world": (0, np.eye(3), np.zeros(3))}
    q_order: list[int] = []
    v_order: list[int] = []
    unaligned: list[str] = []
    ground = np.zeros(3)
    for joint in description.tree:
        carrier, R, p = bodies[joint.parent]
        R, p = R @ joint.rotation, p + R @ joint.translation
        if joint.kind != "fixed":
            for suffix, motion in _motions(joint):
                carrier = made.addJoint(carrier, motion, pin.SE3(R, p), joint.name + suffix)
                R, p = np.eye(3), np.zeros(3)
            first = made.joints[carrier].idx_v + made.joints[carrier].nv - joint.type.nv
            armature = np.array(made.armature)
            armature[first : first + joint.type.nv] = joint.armature
            made.armature = armature
            if np.any(joint.armature) and isinstance(motion, pin.JointModelRevoluteUnaligned):
                unaligned.append(joint.name)
        bodies[joint.child] = (carrier, R, p)
        body = description.body(joint.child)
        if carrier:
            made.appendBodyToJoint(carrier, _inertia(body), pin.SE3(R, p))
        else:
            ground += body.mass * (p + R @ body.com)
        q_order.extend(range(layout.full_q[joint.name].start, layout.full_q[joint.name].stop))
        v_order.extend(range(layout.full_v[joint.name].start, layout.full_v[joint.name].stop))
    ordered = q_order == list(range(len(q_order)))
    return PinModel(made, bodies, np.array(q_order, int), np.array(v_order, int), ordered, ground, tuple(unaligned))


def _motions(joint: Joint) -> list[tuple[str, object]]:
    """Return name suffix and Pinocchio joint of each step of a joint."""
    kind = joint.kind
    if kind in ("revolute", "continuous"):
        return [("", _aligned(joint, "R", pin.JointModelRevoluteUnaligned))]
    if kind == "prismatic":
        return [("", _aligned(joint, "P", pin.JointModelPrismaticUnaligned))]
    if kind == "helical":
        return [("", pin.JointModelHelicalUnaligned(np.array(joint.axes[0]), joint.pitch))]
    if kind == "universal":
        return [("", pin.JointModelUniversal(np.array(joint.axes[0]), np.array(joint.axes[1])))]
    if kind == "spherical_zyx":
        return [("", pin.JointModelSphericalZYX())]
    if kind == "ball":
        return [("", pin.JointModelSpherical())]
    if kind == "planar":
        return [(".x", pin.JointModelPX()), (".y", pin.JointModelPY()), (".theta", pin.JointModelRZ())]
    return [("", pin.JointModelFreeFlyer())]


def _inertia(body: Body) -> pin.Inertia:
    # Set part by part: the constructor refuses an inertia that is not positive, which
    # a description may hold after a warning.
    made = pin.Inertia.Zero()
    made.mass, made.lever, made.inertia = body.mass, np.array(body.com), np.array(body.inertia)
    return made


def _aligned(joint: Joint, letter: str, general: type) -> object:
    """Return Pinocchio's cheaper joint where the axis is exactly x, y or z."""
    for name, unit in (("X", _X), ("Y", _Y), ("Z", _Z)):
        if np.array_equal(joint.axes[0], unit):
            return getattr(pin, f"JointModel{letter}{name}")()
    return general(np.array(joint.axes[0]))
