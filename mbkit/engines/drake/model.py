"""Drake's plant, built from a description.

Joints of several coordinates with v = q̇ are stacks of one-coordinate joints on bodies without mass. A ball joint is
Drake's roll-pitch-yaw joint, whose velocities are angular velocities all the same: only its q̇ is singular, which
nothing here uses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody import tree
from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant

from mbkit._check import Array
from mbkit.engines.base import BESIDE, OF_ANY_ENGINE, OF_COUPLINGS, OF_TREES, ROTORS_OF_SEVERAL, SOLVED, STACKS
from mbkit.errors import UnsupportedError
from mbkit.model import Body, Joint, Model
from mbkit.model.elements.kinds import joint_types
from mbkit.model.elements.paths import Path
from mbkit.model.parts import Loop, PointSpring
from mbkit.model.validation import static_bodies

#: Name of the method that runs loops.
SAP: Final = "drake_sap"
#: Drake 1.51: evaluating a continuous plant's accelerations with constraints is an error.
NO_CONSTRAINTS: Final = "Drake's continuous plant has no constraints between bodies"


@dataclass(frozen=True)
class DrakeModel:
    """A finalized plant, and the maps between its coordinates and the description's."""

    plant: Any
    #: Entry i is full coordinate q_index[i], but the three angles of a ball joint, which mean nothing there.
    q_index: np.ndarray
    v_index: np.ndarray
    #: Ball and free joints, with their starts in Drake's positions and velocities.
    turning: tuple[tuple[Joint, int, int], ...]
    bodies: dict[str, Any]
    #: The joint of the plant that has the child, the last one of a stack.
    joints: dict[str, Any]
    #: Stiffness, body, point, body and point of the springs that are bushings, of which Drake has no energy.
    bushings: tuple[tuple[float, Any, Array, Any, Array], ...]


def build(
    description: Model, *, gravity: bool = True, bushings: bool = True, step: float = 0.0, limits: bool = False
) -> DrakeModel:
    """Return the plant, with or without gravity and the springs that have no length at rest.

    With a step, s, it is discrete and holds the loops, and `limits` of joints; a continuous one is the tree alone.
    Raises `UnsupportedError` for numbers that Drake refuses, and names the part.
    """
    # A step of zero makes it continuous: ẋ = f(x) and nothing else.
    plant = MultibodyPlant(step)
    if step:
        # It is the one of Drake's discrete solvers that takes constraints.
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
    plant.mutable_gravity_field().set_gravity_vector(np.array(description.gravity) * gravity)
    bodies: dict[str, Any] = {"world": plant.world_body()}
    static = static_bodies(description.joints)
    for k, body in enumerate(description.bodies):
        # Names of files may hold what Drake's do not; ours are kept in the map.
        bodies[body.name] = plant.AddRigidBody(f"{k}:{body.name}", _inertia(body, body.name in static))
    added = {joint.name: _add(plant, joint, bodies) for joint in description.joints}
    for joint in description.joints if limits else ():
        for k, one in enumerate(added[joint.name] if joint.type.nq == len(joint.lower) > 0 else ()):
            one.set_position_limits(joint.lower[k : k + 1], joint.upper[k : k + 1])
    springs = [s for s in description.springs if bushings or s.rest_length > 0]
    bushings_ = tuple(x for spring in springs for x in _add_spring(plant, spring, bodies))
    ends = dict(bodies)
    if step and any("world" in (loop.body_a, loop.body_b) for loop in description.loops):
        # Drake 1.51.1 ends the process where a constraint holds the world itself.
        ends["world"] = plant.AddRigidBody("ground", tree.SpatialInertia.Zero())
        plant.WeldFrames(plant.world_frame(), ends["world"].body_frame())
    for loop in description.loops if step else ():
        with _refusal(f"drake: refuses loop {loop.name!r}"):
            CONSTRAINTS[loop.kind](plant, loop, ends[loop.body_a], ends[loop.body_b])
    for coupler in description.couplers if step else ():
        (follower,), (leader,) = (added[name] for name in (coupler.joint, *coupler.leaders))
        with _refusal(f"drake: refuses coupler {coupler.name!r}"):
            plant.AddCouplerConstraint(follower, leader, coupler.ratio, coupler.offset)
    with _refusal(f"drake: refuses {description.name}"):
        plant.Finalize()
    return mapped(plant, description, added, bodies, bushings_)


@contextmanager
def _refusal(what: str) -> Iterator[None]:
    """Raise `UnsupportedError` with Drake's reason where a demand of Drake's fails, as an error or as an exit."""
    try:
        yield
    except (RuntimeError, SystemExit) as error:
        reason = (str(error).strip().splitlines() or ["not physical"])[0]
        raise UnsupportedError(f"{what}: {reason}") from None


def _add_spring(
    plant: Any, spring: PointSpring, bodies: dict[str, Any]
) -> Iterator[tuple[float, Any, Array, Any, Array]]:
    """Add a spring; yield it where it is a bushing."""
    ends = bodies[spring.body_a], np.array(spring.point_a), bodies[spring.body_b], np.array(spring.point_b)
    length, stiffness = spring.rest_length, spring.stiffness
    if length == 0:
        # Drake's spring has a length at rest. Without one the pull is k times the gap, along each axis alike,
        # which is a bushing's; the damper along the line is a spring's of no stiffness and any length.
        frames = [
            plant.AddFrame(tree.FixedOffsetFrame(f"{spring.name}.{k}", body, RigidTransform(point)))
            for k, body, point in (("a", *ends[:2]), ("b", *ends[2:]))
        ]
        zero = np.zeros(3)
        plant.AddForceElement(tree.LinearBushingRollPitchYaw(*frames, zero, zero, np.full(3, stiffness), zero))
        yield (stiffness, *ends)
        length, stiffness = 1.0, 0.0
    if stiffness or spring.damping:
        plant.AddForceElement(tree.LinearSpringDamper(*ends, length, stiffness, spring.damping))


def _ball(plant: Any, loop: Loop, a: Any, b: Any) -> None:
    plant.AddBallConstraint(a, np.array(loop.translation_a), b, np.array(loop.translation_b))


def _weld(plant: Any, loop: Loop, a: Any, b: Any) -> None:
    ends = ((loop.rotation_a, loop.translation_a), (loop.rotation_b, loop.translation_b))
    X_AP, X_BQ = (RigidTransform(RotationMatrix(np.array(R)), np.array(p)) for R, p in ends)
    plant.AddWeldConstraint(a, X_AP, b, X_BQ)


def _rod(plant: Any, loop: Loop, a: Any, b: Any) -> None:
    plant.AddDistanceConstraint(a, np.array(loop.translation_a), b, np.array(loop.translation_b), loop.length)


#: Kind of a loop -> what adds Drake's constraint, for the kinds that it has.
CONSTRAINTS: Final[dict[str, Callable[[Any, Loop, Any, Any], None]]] = {
    "point": _ball,
    "frame": _weld,
    "distance": _rod,
}


def _inertia(body: Body, static: bool) -> Any:
    if body.mass == 0 and (static or not body.inertia.any()):
        return tree.SpatialInertia.Zero()
    # Drake refuses some inertias that cannot act, because the body never moves.
    I = np.zeros((3, 3)) if static else body.inertia
    with _refusal(f"drake: refuses body {body.name!r} (mass {body.mass:.4g} kg)"):
        central = tree.RotationalInertia(I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2])
        return tree.SpatialInertia.MakeFromCentralInertia(float(body.mass), np.array(body.com), central)


def _add(plant: Any, joint: Joint, bodies: dict[str, Any]) -> list[Any]:
    """Add a joint, as a stack where it has several real coordinates; return Drake's joints."""
    parent, child = bodies[joint.parent], bodies[joint.child]
    X_PJ = RigidTransform(RotationMatrix(np.array(joint.rotation)), joint.translation)
    if joint.kind == "fixed":
        return [plant.AddJoint(tree.WeldJoint(joint.name, parent.body_frame(), child.body_frame(), X_PJ))]
    frame = plant.AddFrame(tree.FixedOffsetFrame(f"{joint.name}.fixed", parent, X_PJ))
    steps = _STEPS[joint.kind](joint)
    if not steps:
        return [plant.AddJoint(_turning(joint, frame, child.body_frame()))]
    out = []
    for k, (kind, axis) in enumerate(steps):
        name = joint.name if len(steps) == 1 else f"{joint.name}.{k}"
        last = k == len(steps) - 1
        body = child if last else plant.AddRigidBody(f"{name}.between", tree.SpatialInertia.Zero())
        out.append(_one(plant, joint, k, name, kind, axis, frame, body.body_frame()))
        frame = body.body_frame()
    return out


#: `STACKS`, a screw, and joints that Drake has as one.
_STEPS: Final[dict[str, Callable[[Joint], Sequence[tuple[str, Array]]]]] = {
    **STACKS,
    **dict.fromkeys(("fixed", "ball", "free"), lambda _: ()),
    "helical": lambda joint: [("helical", joint.axes[0])],
}


def _numbers_not_held(model: Model) -> Iterator[str]:
    for joint in model.joints:
        parts = np.split(joint.damping, range(3, len(joint.damping), 3)) if joint.type.quaternion is not None else []
        if any(np.ptp(x) > 0 for x in parts):
            yield f"joint {joint.name!r} is damped differently along its body axes; Drake damps it evenly"
        if joint.kind == "helical" and joint.stiffness.any():
            yield f"joint {joint.name!r} has a spring, which Drake's screw joint cannot have"


#: Its terms are those of the tree, whatever binds it.
DRAKE: Final = Path(
    "drake",
    "",
    joint_types(*_STEPS) | OF_TREES - {ROTORS_OF_SEVERAL} | {"row", "speed", "t"},
    dict.fromkeys(OF_COUPLINGS, "Drake has nothing on a sum of joint coordinates")
    | {ROTORS_OF_SEVERAL: "Drake has no rotor for it"},
    also=_numbers_not_held,
    instead=SOLVED,
)
#: Parts that a continuous plant does not carry.
DRAKE_RUNS: Final = replace(
    DRAKE,
    name="drake runs",
    words="drake: its integrators do not hold all of",
    carries=DRAKE.carries - BESIDE - {"row", "speed", "t", "mimic"} - joint_types("ball"),
    why={
        "mimic": "Drake does not reduce it; load with mimic='free'",
        "joint_type.ball": "its roll, pitch and yaw there end at a pole",
        "coupler.curve": "Drake has fixed ratios alone",
        "coupler.several": "Drake takes one alone",
        "speed": "its plants have no constraint of velocities",
        "row": f"{NO_CONSTRAINTS}; method={SAP!r} runs loops in the discrete one",
    },
    instead=OF_ANY_ENGINE,
)
DRAKE_SAP: Final = replace(
    DRAKE_RUNS,
    name="drake sap",
    words="drake: its discrete plant does not hold all of",
    carries=DRAKE_RUNS.carries | {"coupler", *(f"loop.{x}" for x in CONSTRAINTS)},
    why=DRAKE_RUNS.why | {"row": "Drake has no such constraint"},
    instead=SOLVED,
)


def _one(plant: Any, joint: Joint, k: int, name: str, kind: str, axis: Array, at: Any, body: Any) -> Any:
    damping, axis = float(joint.damping[k]), np.array(axis)
    if kind == "revolute":
        added = plant.AddJoint(tree.RevoluteJoint(name, at, body, axis, damping))
    elif kind == "prismatic":
        added = plant.AddJoint(tree.PrismaticJoint(name, at, body, axis, damping=damping))
    else:
        # Metres per radian here, per turn there.
        added = plant.AddJoint(tree.ScrewJoint(name, at, body, axis, 2 * np.pi * joint.pitch, damping))
    if rotor := float(joint.rotors[k]):
        actuator = plant.AddJointActuator(f"{name}.rotor", added)
        actuator.set_default_rotor_inertia(rotor)
        actuator.set_default_gear_ratio(1.0)
    stiffness, rest = float(joint.stiffness[k]), float(joint.rest[k])
    if stiffness:
        spring = tree.RevoluteSpring if kind == "revolute" else tree.PrismaticSpring
        with _refusal(f"drake: refuses the spring of joint {joint.name!r}"):
            plant.AddForceElement(spring(added, rest, stiffness))
    return added


def _turning(joint: Joint, at: Any, body: Any) -> Any:
    angular, linear = float(joint.damping[-1]), float(joint.damping[0])
    if joint.kind == "ball":
        return tree.BallRpyJoint(joint.name, at, body, angular)
    return tree.QuaternionFloatingJoint(joint.name, at, body, angular, linear)


def mapped(
    plant: Any, description: Model, added: dict[str, list[Any]], bodies: dict[str, Any], bushings: tuple[Any, ...] = ()
) -> DrakeModel:
    """Return a finalized plant with the maps between its coordinates and the description's."""
    layout = description.layout
    q_index, v_index = np.full(plant.num_positions(), -1), np.full(plant.num_velocities(), -1)
    turning = []
    for joint in description.joints:
        if not joint.type.nv:
            continue
        first_q, first_v, own = layout.full_q[joint.name].start, layout.full_v[joint.name].start, added[joint.name]
        order_q, order_v = [*range(joint.type.nq)], [*range(joint.type.nv)]
        if joint.type.quaternion is not None:
            turning.append((joint, own[0].position_start(), own[0].velocity_start()))
            if joint.kind == "free":
                # w, x, y, z, then the position; the angular velocity first.
                order_q, order_v = [6, 3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2]
            else:
                order_q = [0, 0, 0]
        for one in own:
            q, v, nq, nv = one.position_start(), one.velocity_start(), one.num_positions(), one.num_velocities()
            q_index[q : q + nq], order_q = first_q + np.array(order_q[:nq]), order_q[nq:]
            v_index[v : v + nv], order_v = first_v + np.array(order_v[:nv]), order_v[nv:]
    last = {name: own[-1] for name, own in added.items()}
    return DrakeModel(plant, q_index, v_index, tuple(turning), bodies, last, bushings)
