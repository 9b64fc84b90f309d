"""A `pinocchio.Model` built from a description, and how its numbers map to ours.

Joints are added depth first, because Pinocchio's algorithms take a subtree to be contiguous. Continuous joints are
plain revolute ones, with one angle. A planar joint is two slides and a hinge, whose velocities are the derivatives of
its coordinates (Pinocchio's own planar joint has four numbers and body velocities).

Pinocchio's geometry model of the shapes of a description.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import coal
import numpy as np
import pinocchio as pin

from mbkit._check import Array
from mbkit.engines.base import OF_COUPLINGS, OF_TREES, SOLVED
from mbkit.engines.elements.passive import pull
from mbkit.load.urdf import OF_VELOCITIES
from mbkit.load.xml_reader import reserved
from mbkit.model import Body, Joint, Model, PointSpring
from mbkit.model.elements.kinds import joint_types
from mbkit.model.elements.paths import Path
from mbkit.show import Shape

_X, _Y, _Z = np.eye(3)


@dataclass(frozen=True)
class PinModel:
    """A model of Pinocchio and the maps between its coordinates and the description's."""

    model: pin.Model
    #: Body name -> (joint index, R_JB, p_JB_J).
    bodies: dict[str, tuple[int, Array, Array]]
    #: Pinocchio's coordinate i is full coordinate q_order[i].
    q_order: np.ndarray
    v_order: np.ndarray
    #: Whether both orders are the identity.
    ordered: bool
    #: Σ m p over bodies fixed to the world, which Pinocchio's energy and centre of mass leave out.
    ground_moment: Array
    #: Their inertia, in the world.
    ground: pin.Inertia


def build(description: Model) -> PinModel:
    """Return the description as Pinocchio holds it."""
    model = pin.Model()
    model.name = description.name
    model.gravity = pin.Motion(np.array(description.gravity), np.zeros(3))
    layout = description.layout
    bodies: dict[str, tuple[int, Array, Array]] = {"world": (0, np.eye(3), np.zeros(3))}
    q_order: list[int] = []
    v_order: list[int] = []
    moment, ground = np.zeros(3), pin.Inertia.Zero()
    for joint in description.tree:
        carrier, R, p = bodies[joint.parent]
        R, p = R @ joint.rotation, p + R @ joint.translation
        if joint.type.nv:
            for suffix, motion in _STEPS[joint.kind](joint):
                carrier = model.addJoint(carrier, motion, pin.SE3(R, p), joint.name + suffix)
                R, p = np.eye(3), np.zeros(3)
            first = model.joints[carrier].idx_v + model.joints[carrier].nv - joint.type.nv
            for name in Joint.adding_to("T"):
                numbers = np.array(getattr(model, OF_VELOCITIES[name]))
                numbers[first : first + joint.type.nv] = getattr(joint, name)
                setattr(model, OF_VELOCITIES[name], numbers)
        bodies[joint.child] = (carrier, R, p)
        body = description.body(joint.child)
        if carrier:
            model.appendBodyToJoint(carrier, inertia_of(body), pin.SE3(R, p))
        else:
            moment += body.mass * (p + R @ body.com)
            ground = ground + pin.SE3(R, p).act(inertia_of(body))
        q_order.extend(range(layout.full_q[joint.name].start, layout.full_q[joint.name].stop))
        v_order.extend(range(layout.full_v[joint.name].start, layout.full_v[joint.name].stop))
    for frame in (*(description.frame(body.name) for body in description.bodies), *description.frames):
        if model.existFrame(frame.name):
            continue
        carrier, R, p = bodies[frame.body]
        kind = pin.FrameType.BODY if frame.body == frame.name else pin.FrameType.OP_FRAME
        placement = pin.SE3(R @ frame.rotation, p + R @ frame.translation)
        # Without inertia: the bodies' own is in already.
        model.addFrame(pin.Frame(frame.name, carrier, 0, placement, kind), False)
    ordered = q_order == list(range(len(q_order)))
    return PinModel(model, bodies, np.array(q_order, int), np.array(v_order, int), ordered, moment, ground)


def inertia_of(body: Body) -> pin.Inertia:
    """Return a body's inertia about its origin."""
    # Set part by part: the constructor refuses an inertia that is not positive, which a description may hold.
    out = pin.Inertia.Zero()
    out.mass, out.lever, out.inertia = body.mass, np.array(body.com), np.array(body.inertia)
    return out


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
#: Its rows are formulas of frames, alike for all of them.
PINOCCHIO: Final = Path(
    "pinocchio", "", joint_types(*_STEPS) | OF_TREES | OF_COUPLINGS | {"row", "speed", "t"}, instead=SOLVED
)
_BESIDE: Final = ("point.spring", "point.damper")
#: Joint types of which computeRNEADerivatives and computeABADerivatives of 4.1.0 are wrong (pinocchio#2053).
_WRONG: Final = joint_types("universal", "spherical_zyx")
INVERSE_DERIVATIVES: Final = replace(
    PINOCCHIO,
    name="pinocchio derivatives",
    words="not known of",
    carries=PINOCCHIO.carries - _WRONG - {*_BESIDE},
    why=dict.fromkeys(_WRONG, f"Pinocchio {pin.__version__} differentiates it wrongly")
    | dict.fromkeys(_BESIDE, "Pinocchio's model has nothing between points"),
    instead="mbkit.dynamics(model, 'lagrangian') has them",
)
_NO_DERIVATIVE: Final = (
    f"computeConstraintDynamicsDerivatives of Pinocchio {pin.__version__} is not the derivative by q of "
    "constraintDynamics"
)
FORWARD_DERIVATIVES: Final = replace(
    INVERSE_DERIVATIVES,
    name="pinocchio forward derivatives",
    carries=INVERSE_DERIVATIVES.carries - {"row", "speed"},
    why=INVERSE_DERIVATIVES.why | dict.fromkeys(("row", "speed"), _NO_DERIVATIVE),
)


# Point-to-point springs and dampers on Pinocchio's kinematics.


#: A body, and a force on it in the axes and about the origin of the joint that carries it.
OnBody = tuple[str, Any]


class PointSprings:
    """Forces and energy of all point springs of a model, in Pinocchio's coordinates."""

    def __init__(self, model: Model, maps: PinModel) -> None:
        self._ends: list[tuple[PointSpring, tuple[int, Array], tuple[int, Array]]] = []
        for spring in model.springs:
            a, b = (
                (maps.bodies[body][0], maps.bodies[body][2] + maps.bodies[body][1] @ point)
                for body, point in ((spring.body_a, spring.point_a), (spring.body_b, spring.point_b))
            )
            self._ends.append((spring, a, b))

    def energy(self, m: Any, d: Any, q: Array) -> float:
        """Return Σ ½ k (l - l0)²."""
        pin.forwardKinematics(m, d, q)
        total = 0.0
        for spring, (i, a), (j, b) in self._ends:
            length = np.linalg.norm(d.oMi[j].act(b) - d.oMi[i].act(a))
            total += 0.5 * spring.stiffness * float(length - spring.rest_length) ** 2
        return total

    def force(self, m: Any, d: Any, q: Array, v: Array) -> Array:
        """Return the generalized force, by the points' Jacobians."""
        out = np.zeros(m.nv)
        for J, force in self._pulls(m, d, q, v):
            out -= J.T @ force
        return out

    def forces(self, m: Any, d: Any, q: Array, v: Array) -> list[OnBody]:
        """Return the pulls on the bodies at the ends."""
        out = []
        for (spring, *ends), (_, on_first) in zip(self._ends, self._pulls(m, d, q, v), strict=True):
            for sign, body, (joint, point) in zip((1, -1), (spring.body_a, spring.body_b), ends, strict=True):
                force = sign * d.oMi[joint].rotation.T @ on_first
                out.append((body, pin.Force(force, pin.skew(point) @ force)))
        return out

    def _pulls(self, m: Any, d: Any, q: Array, v: Array) -> Iterator[tuple[Array, Array]]:
        """Yield the Jacobian of the gap of each spring, and the pull on its first end in world axes."""
        pin.computeJointJacobians(m, d, q)
        for spring, (i, a), (j, b) in self._ends:
            gap = d.oMi[j].act(b) - d.oMi[i].act(a)
            J = self._point_jacobian(m, d, j, b) - self._point_jacobian(m, d, i, a)
            yield J, pull(spring, gap, J @ v)

    @staticmethod
    def _point_jacobian(m: Any, d: Any, joint: int, point: Array) -> Array:
        if not joint:
            return np.zeros((3, m.nv))
        # One column comes back as a vector.
        J = pin.getJointJacobian(m, d, joint, pin.LOCAL).reshape(6, m.nv)
        R = d.oMi[joint].rotation
        return np.asarray(R @ (J[:3] - pin.skew(point) @ J[3:]))


#: Kind -> coal's solid; boxes and heights are whole lengths there.
_SOLIDS: Final[dict[str, Callable[..., Any]]] = {
    "box": lambda a, b, c: coal.Box(2 * a, 2 * b, 2 * c),
    "sphere": coal.Sphere,
    "cylinder": lambda r, half: coal.Cylinder(r, 2 * half),
    "capsule": lambda r, half: coal.Capsule(r, 2 * half),
    "ellipsoid": coal.Ellipsoid,
}


def geometry(maps: PinModel, shapes: Sequence[Shape]) -> Any:
    """Return the geometry model; a mesh of several colours is as many objects."""
    out = pin.GeometryModel()
    names: set[str] = set()
    meshes: dict[int, Any] = {}
    for shape in shapes:
        carrier, R, p = maps.bodies[shape.body]
        place = pin.SE3(R @ shape.rotation, p + R @ shape.translation)
        frame = maps.model.getFrameId(shape.body) if shape.body != "world" else 0
        if shape.kind != "mesh":
            solids = [(_SOLIDS[shape.kind](*shape.size), shape.color)]
        else:
            for surface in shape.meshes:
                if id(surface) not in meshes:
                    meshes[id(surface)] = _mesh(surface.vertices, surface.triangles)
            solids = [(meshes[id(surface)], surface.color or shape.color) for surface in shape.meshes]
        for solid, color in solids:
            one = pin.GeometryObject(reserved(shape.name, names), carrier, frame, place, solid)
            one.meshColor, one.overrideMaterial = np.array(color), True
            out.addGeometryObject(one)
    return out


def _mesh(vertices: Any, triangles: Any) -> Any:
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(triangles), len(vertices))
    mesh.addVertices(vertices)
    mesh.addTriangles(triangles)
    mesh.endModel()
    return mesh
