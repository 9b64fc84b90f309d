"""A `pinocchio.Model` made from a description, and how its numbers map to ours.

Joints are added depth first, because Pinocchio's algorithms take a subtree to be
contiguous. Continuous joints are plain revolute ones, with one angle. A planar
joint is two slides and a hinge, whose velocities are the derivatives of its
coordinates (Pinocchio's own planar joint has four numbers and body velocities).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import pinocchio as pin

from mbkit._check import Array
from mbkit.engines.base import unknown_joint
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
    """

    model: pin.Model
    bodies: dict[str, tuple[int, Array, Array]]
    q_order: np.ndarray
    v_order: np.ndarray
    ordered: bool
    ground_moment: Array


def build(description: Model) -> PinModel:
    """Return the description as Pinocchio holds it.

    Raises
    ------
    UnsupportedError
        For a joint of a type that Pinocchio does not have; named.
    """
    made = pin.Model()
    made.name = description.name
    made.gravity = pin.Motion(np.array(description.gravity), np.zeros(3))
    layout = description.layout
    bodies: dict[str, tuple[int, Array, Array]] = {"world": (0, np.eye(3), np.zeros(3))}
    q_order: list[int] = []
    v_order: list[int] = []
    ground = np.zeros(3)
    for joint in description.tree:
        carrier, R, p = bodies[joint.parent]
        R, p = R @ joint.rotation, p + R @ joint.translation
        if joint.kind not in _STEPS:
            raise unknown_joint("pinocchio", joint)
        if joint.type.nv:
            for suffix, motion in _STEPS[joint.kind](joint):
                carrier = made.addJoint(carrier, motion, pin.SE3(R, p), joint.name + suffix)
                R, p = np.eye(3), np.zeros(3)
            first = made.joints[carrier].idx_v + made.joints[carrier].nv - joint.type.nv
            armature = np.array(made.armature)
            armature[first : first + joint.type.nv] = joint.armature
            made.armature = armature
        bodies[joint.child] = (carrier, R, p)
        body = description.body(joint.child)
        if carrier:
            made.appendBodyToJoint(carrier, _inertia(body), pin.SE3(R, p))
        else:
            ground += body.mass * (p + R @ body.com)
        q_order.extend(range(layout.full_q[joint.name].start, layout.full_q[joint.name].stop))
        v_order.extend(range(layout.full_v[joint.name].start, layout.full_v[joint.name].stop))
    ordered = q_order == list(range(len(q_order)))
    return PinModel(made, bodies, np.array(q_order, int), np.array(v_order, int), ordered, ground)


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


#: Joint type -> name suffix and Pinocchio joint of each step of a joint of this type.
_STEPS: Final[dict[str, Callable[[Joint], list[tuple[str, object]]]]] = {
    "fixed": lambda _: [],
    "revolute": lambda joint: [("", _aligned(joint, "R", pin.JointModelRevoluteUnaligned))],
    "continuous": lambda joint: [("", _aligned(joint, "R", pin.JointModelRevoluteUnaligned))],
    "prismatic": lambda joint: [("", _aligned(joint, "P", pin.JointModelPrismaticUnaligned))],
    "helical": lambda joint: [("", pin.JointModelHelicalUnaligned(np.array(joint.axes[0]), joint.pitch))],
    "universal": lambda joint: [("", pin.JointModelUniversal(np.array(joint.axes[0]), np.array(joint.axes[1])))],
    "spherical_zyx": lambda _: [("", pin.JointModelSphericalZYX())],
    "ball": lambda _: [("", pin.JointModelSpherical())],
    "planar": lambda _: [(".x", pin.JointModelPX()), (".y", pin.JointModelPY()), (".theta", pin.JointModelRZ())],
    "free": lambda _: [("", pin.JointModelFreeFlyer())],
}
