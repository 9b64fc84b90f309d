"""Drake's own importers of URDF, MJCF and SDF, and the plants that they read, described.

The only place that knows the content of a parsed plant: a joint's frames stand off its bodies' frames, inertias are
about a body's origin, a rotor's inertia belongs to an actuator, a pitch is metres per turn, and a base that nothing
holds floats.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from logging.handlers import BufferingHandler
from typing import Any, Final

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ForceElementIndex, FrameIndex, MultibodyForces, UniformGravityFieldElement

from mbkit._check import Array
from mbkit.engines.drake.engine import DrakeDynamics
from mbkit.engines.drake.model import DrakeModel, mapped
from mbkit.engines.imported import Imported, Parts, checked, written
from mbkit.errors import UnsupportedError
from mbkit.load.urdf_reader import BASE_JOINT, Snapper
from mbkit.load.xml_reader import Element
from mbkit.model import Joint, Model, ModelBuilder
from mbkit.model.description import LEFT_OUT
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.joint_types import kind_of
from mbkit.spatial import skew

_KINDS: Final = {
    "weld": "fixed",
    "revolute": "revolute",
    "prismatic": "prismatic",
    "screw": "helical",
    "universal": "universal",
    "planar": "planar",
    "ball_rpy": "ball",
    "quaternion_floating": "free",
}
#: Name of a text in Drake and sdformat.
_PLACE: Final = re.compile(r"<(?:literal|data)-string>(?:\.sdf)?:")
#: Elements that act, and that Drake passes over without a word.
_UNREAD: Final = ("mimic", "fluid_added_mass")
#: Force elements that are a joint's own spring, with the names of its stiffness and rest.
_SPRINGS: Final = {
    "RevoluteSpring": ("default_stiffness", "default_nominal_angle"),
    "PrismaticSpring": ("stiffness", "nominal_position"),
}
#: Parts of messages that Drake gives for every file, or that are not for it.
_IDLE: Final = ("safety_controller", "calibration")


def read(text: str, format_: str, floating_base: bool = False, files: dict[str, bytes] | None = None) -> Imported:
    """Return what Drake's parser makes of a text, its base welded to the world unless it is to float."""
    plant = MultibodyPlant(0.0)
    with _log() as records, written(text, files or {}) as path:
        try:
            if files:
                models = Parser(plant).AddModels(str(path))
            else:
                models = Parser(plant).AddModelsFromString(text, "urdf" if format_ == "urdf" else "xml")
            welded = _weld(plant, _loose(plant, models)) if format_ == "urdf" and not floating_base else ""
            plant.Finalize()
        except (Exception, SystemExit) as error:
            # A demand of Drake's that fails comes as SystemExit.
            raise UnsupportedError(f"drake: {_text(str(error).replace(f'{path.parent}/', ''))}") from None
    model, maps, _ = _described(plant, floating_base)
    dyn = _Read.holding(model, maps)
    notes = [f"the base {welded!r} floats by itself; welded to the world here"] if welded else []
    notes += _told(records)
    held = "by constraints" if plant.num_constraints() else ""
    if held:
        notes.append(f"{plant.num_constraints()} constraints, outside M and nle")
    # A plant counts its constraints, those of a URDF's mimic joints among them.
    other = plant.num_constraints() > (text.count("<mimic") if format_ == "urdf" else 0)
    hidden = "pydrake does not give the bodies and points of constraints" if other else ""
    return Imported(model, dyn.terms, tuple(notes), hidden=hidden, holds_mimics=held)


def read_sdf(root: Element, text: str, floating_base: bool, gravity: Array) -> ModelBuilder:
    """Return a builder that holds the one model of an SDF's text, as Drake reads it with sdformat, and notes.

    Bases float in SDF; they are held at their poses unless they are to float.
    """
    for element in root.walk():
        inferred = any(e.attributes.get("auto") in ("true", "1") for e in element.all("inertial"))
        if inferred and any(e.tag == "mesh" for c in element.all("collision") for e in c.walk()):
            name = element.attributes.get("name", "")
            raise UnsupportedError(
                f"link {name!r} ({element.place}) takes its inertia from a mesh (auto), and none is opened; state it"
            )
        if element.tag == "include":
            raise UnsupportedError(f"<include> ({element.place}) is not followed; `gz sdf -p` writes out what it names")
        weightless = element.tag == "gravity" and element.text.strip().lower() in ("false", "0")
        if element.tag in _UNREAD or weightless:
            raise UnsupportedError(f"<{element.tag}> ({element.place}) has no counterpart here")
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector(gravity)
    with _log() as records:
        try:
            models = Parser(plant).AddModelsFromString(text, "sdf")
            loose = _loose(plant, models)
            if not floating_base:
                _weld(plant, loose)
            plant.Finalize()
        except (Exception, SystemExit) as error:
            raise UnsupportedError(_text(_PLACE.sub("line ", str(error).replace(text, "")))) from None
    told = _told(records)
    # Drake goes on with other numbers, and does not give them.
    if impossible := [x for x in told if "inertia" in x]:
        raise UnsupportedError(impossible[0])
    if floating_base and not loose:
        raise UnsupportedError("expected a link that no joint carries, the base; there are: none")
    if n := plant.num_constraints():
        raise UnsupportedError(f"{n} constraints, such as those of closed loops or mimic joints; pydrake tells none")
    model, maps, at = _described(plant, floating_base)
    snap = Snapper()
    joints = (replace(j, rotation=snap(j.rotation), axes=snap(j.axes) if j.axes.size else j.axes) for j in model.joints)
    b = ModelBuilder.of(replace(model, name=root.children[0].attributes["name"], joints=tuple(joints)))
    bodies = {int(body.index()): name for name, body in maps.bodies.items()}
    frames = {x.attributes.get("name") for x in root.walk() if x.tag == "frame"}
    for frame in map(plant.get_frame, map(FrameIndex, range(1, plant.num_frames()))):
        body = int(frame.body().index())
        X = at[body] if frame.is_body_frame() else at[body] @ frame.GetFixedPoseInBodyFrame()
        # A joint may hold a link elsewhere than at its origin.
        if frame.name() in frames if not frame.is_body_frame() else not X.IsNearlyEqualTo(RigidTransform(), 0.0):
            name = bodies[body] if frame.is_body_frame() else _name(plant, frame)
            b.add_frame(name, body=bodies[body], translation=X.translation(), rotation=snap(X.rotation().matrix()))
    bases = ", ".join(repr(_name(plant, x)) for x in loose)
    held = f"the base {bases} floats in SDF, and is held here at its pose; floating_base=True lets it move"
    if len(loose) > 1:
        held = f"the bases {bases} float in SDF, and are held here at their poses; floating_base=True lets them move"
    tags, read = Joint.adding_to("jump"), (j for j in root.walk() if j.tag == "joint")
    pairs = [(j, e.text.strip()) for j in read for e in j.walk() if e.tag in tags]
    dry = ", ".join(f"{j.attributes.get('name')} ({x} N m or N)" for j, x in pairs if x.strip("0."))
    ignored = f"{LEFT_OUT}: {EFFECTS['jump']}, which Drake does not read from SDF: {dry}" if dry else ""
    for note in (held if loose and not floating_base else "", ignored, *told, snap.note):
        if note:
            b.note(note)
    return b


def _text(message: object) -> str:
    return " ".join(str(message).split())


def _told(records: list[logging.LogRecord]) -> list[str]:
    """Return what Drake logged, but what it says of every file."""
    messages = dict.fromkeys(_text(record.getMessage().split("warning: ")[-1]) for record in records)
    return [text for text in messages if not any(x in text for x in _IDLE)]


@contextmanager
def _log() -> Iterator[list[logging.LogRecord]]:
    """Collect what Drake logs."""
    logger, handler = logging.getLogger("drake"), BufferingHandler(1_000_000)
    level, propagate = logger.level, logger.propagate
    logger.propagate = False
    logger.addHandler(handler)
    logger.setLevel(logging.WARNING)
    try:
        yield handler.buffer
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        logger.propagate = propagate


def _loose(plant: Any, models: Any) -> list[Any]:
    """Return the bodies that no joint carries."""
    carried = {int(plant.get_joint(j).child_body().index()) for j in plant.GetJointIndices()}
    return [plant.get_body(b) for model in models for b in plant.GetBodyIndices(model) if int(b) not in carried]


def _weld(plant: Any, loose: list[Any]) -> str:
    """Hold bodies where they are, and return the first one's name."""
    for body in loose:
        X = plant.GetDefaultFloatingBaseBodyPose(body)
        plant.WeldFrames(plant.world_frame(), body.body_frame(), X)
    return _name(plant, loose[0]) if loose else ""


def _name(plant: Any, thing: Any) -> str:
    """Return the name of a body, joint or frame, with the names of the nested models that hold it."""
    scope = str(plant.GetModelInstanceName(thing.model_instance()))
    return "::".join([*scope.split("::")[1:], str(thing.name())])


class _Read(DrakeDynamics):
    """Drake on its own plant."""

    def terms(self, q: Array, v: Array, without: tuple[str, ...] = ()) -> dict[str, Array]:  # noqa: ARG002
        """Return M, g, nle and passive at a batch of states."""
        return {"M": self.mass_matrix(q), "g": self.gravity(q), "nle": self.nle(q, v), "passive": self.passive(q, v)}

    def _passive(self, q: Array, v: Array) -> Array:
        plant, context, forces = self.plant, self._context, MultibodyForces(self.plant)
        self._place(q, v)
        plant.CalcForceElementsContribution(context, forces)
        # Gravity is among Drake's force elements.
        weight = plant.CalcGravityGeneralizedForces(context)
        return self._force(plant.CalcGeneralizedForces(context, forces) - weight)


def _described(plant: Any, floating_base: bool) -> tuple[Model, DrakeModel, dict[int, Any]]:
    """Read a finalized plant joint by joint; with the poses of Drake's bodies in ours, by index."""
    rotors, springs, parts = _rotors(plant), _springs(plant), Parts()
    #: Drake's body frame in ours, which is the joint's moving one.
    at = {0: RigidTransform()}
    names = {0: "world"}
    theirs: dict[str, list[Any]] = {}
    ordered = _in_order(plant)
    several = sum(_KINDS.get(j.type_name()) == "free" and not int(j.parent_body().index()) for j in ordered) > 1
    for joint in ordered:
        kind = _KINDS.get(joint.type_name())
        if kind is None:
            raise UnsupportedError(
                f"drake: built a {joint.type_name()} joint from {joint.name()!r}, which has no counterpart here"
            )
        parent, child, name = int(joint.parent_body().index()), joint.child_body(), _name(plant, joint)
        index = int(child.index())
        names[index] = parts.name("body", _name(plant, child))
        at[index] = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
        X = at[parent] @ joint.frame_on_parent().GetFixedPoseInBodyFrame()
        if kind == "fixed":
            # A weld may hold its frames apart.
            X = X @ joint.X_FM()
        if floating_base and kind == "free" and not parent:
            # Called after its body by itself.
            name = f"{BASE_JOINT}_{names[index]}" if several else BASE_JOINT
        kind, numbers = _numbers(joint, kind, *rotors.get(int(joint.index()), (np.inf, 0.0)))
        numbers |= springs.get(int(joint.index()), {})
        R, p = np.array(X.rotation().matrix()), np.array(X.translation())
        parts.joint(name, kind, names[parent], names[index], R, p, **numbers)
        _add_body(parts, names[index], child, at[index])
        theirs[name] = [joint]
    # Coordinates stand in the order of Drake's velocities.
    firsts = {n: int(x.velocity_start()) if x.num_velocities() else -1 for n, (x,) in theirs.items()}
    parts.joints.sort(key=lambda own: firsts[own.name])
    model = parts.model("drake", np.array(plant.gravity_field().gravity_vector()))
    bodies = {name: plant.get_body(type(plant.world_body().index())(k)) for k, name in names.items()}
    return checked("drake", model), mapped(plant, model, theirs, bodies), at


def _in_order(plant: Any) -> list[Any]:
    """Return the joints, every parent before its children."""
    waiting = [plant.get_joint(j) for j in plant.GetJointIndices()]
    known, out = {0}, []
    while waiting:
        ready = [j for j in waiting if int(j.parent_body().index()) in known]
        if not ready:
            raise UnsupportedError("drake: built joints that no tree connects to the world")
        out += ready
        known |= {int(j.child_body().index()) for j in ready}
        waiting = [j for j in waiting if j not in ready]
    return out


def _rotors(plant: Any) -> dict[int, tuple[float, float]]:
    """Return effort limit and reflected inertia of each actuated joint."""
    out: dict[int, tuple[float, float]] = {}
    for a in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(a)
        ratio = float(actuator.default_gear_ratio())
        reflected = float(actuator.default_rotor_inertia()) * ratio * ratio
        joint = int(actuator.joint().index())
        out[joint] = float(actuator.effort_limit()), out.get(joint, (0.0, 0.0))[1] + reflected
    return out


def _springs(plant: Any) -> dict[int, dict[str, Array]]:
    """Return stiffness and rest of each joint that has a spring; other forces than weight are refused."""
    out = {}
    for element in map(plant.get_force_element, map(ForceElementIndex, range(plant.num_force_elements()))):
        kind = type(element).__name__
        if kind in _SPRINGS:
            stiffness, rest = (np.full(1, getattr(element, name)()) for name in _SPRINGS[kind])
            out[int(element.joint().index())] = {"stiffness": stiffness, "rest": rest}
        elif not isinstance(element, UniformGravityFieldElement):
            raise UnsupportedError(f"drake: built a {kind}, which has no counterpart here")
    return out


def _add_body(parts: Parts, name: str, body: Any, X: Any) -> None:
    """Add a body's matter, in our axes; Drake's inertia is about its frame's origin."""
    M = body.default_spatial_inertia()
    mass, com = float(M.get_mass()), np.array(M.get_com())
    about = np.array(M.CalcRotationalInertia().CopyToFullMatrix3())
    # A body without mass has no centre of mass; Drake writes NaN there.
    if not np.isfinite(about).all() or not np.isfinite(com).all():
        about, com = np.zeros((3, 3)), np.zeros(3)
    R = np.array(X.rotation().matrix())
    parts.body(name, mass, np.array(X.multiply(com)), R @ (about + mass * skew(com) @ skew(com)) @ R.T)


def _numbers(joint: Any, kind: str, effort: float, rotor: float) -> tuple[str, dict[str, Any]]:
    """Return a joint's kind, continuous where a revolute one has no limits, and its numbers."""
    nv = kind_of(kind).nv
    damping = np.array(joint.default_damping_vector()) if nv else np.zeros(0)
    if kind == "free":
        # Drake's order is angular, linear.
        damping = np.r_[damping[3:], damping[:3]]
    numbers: dict[str, Any] = {"damping": damping, "effort_limit": np.full(nv, effort)}
    if kind == "universal":
        numbers["axes"] = np.eye(3)[:2]
    if nv == 1:
        ways = {"revolute": "revolute_axis", "prismatic": "translation_axis"}
        axis = getattr(joint, ways[kind])() if kind in ways else _screw_axis(joint)
        lower, upper = np.array(joint.position_lower_limits()), np.array(joint.position_upper_limits())
        numbers |= {"axes": np.array([axis]), "lower": lower, "upper": upper}
        numbers |= {"velocity_limit": np.array(joint.velocity_upper_limits())}
        numbers |= dict.fromkeys(Joint.adding_to("T"), np.full(1, rotor))
        if kind == "helical":
            numbers["pitch"] = float(joint.screw_pitch()) / (2 * np.pi)
        if kind == "revolute" and not np.isfinite([lower, upper]).any():
            kind = "continuous"
    return kind, numbers


def _screw_axis(joint: Any) -> Array:
    """Return a screw's axis, which pydrake gives by its pose alone."""
    plant = joint.GetParentPlant()
    context = plant.CreateDefaultContext()
    q = plant.GetPositions(context)
    q[joint.position_start()] = 1.0
    plant.SetPositions(context, q)
    turn = joint.frame_on_child().CalcPose(context, joint.frame_on_parent()).rotation()
    return np.array(turn.ToAngleAxis().axis())
