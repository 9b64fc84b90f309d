"""Drake's own importers of URDF and MJCF, and the plants that they read, described.

The only place that knows the content of a parsed plant: a joint's frames stand off its bodies' frames, inertias are
about a body's origin, a rotor's inertia belongs to an actuator, a pitch is metres per turn, and a base that nothing
holds floats.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from logging.handlers import BufferingHandler
from typing import Any, Final

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces

from mbkit._check import Array
from mbkit.engines.drake.engine import DrakeDynamics
from mbkit.engines.drake.model import DrakeModel, mapped
from mbkit.engines.imported import Imported, Parts, checked, written
from mbkit.errors import UnsupportedError
from mbkit.load.urdf_reader import BASE_JOINT
from mbkit.model import Model
from mbkit.model.joint_types import kind_of
from mbkit.spatial import skew

_KINDS: Final = {
    "weld": "fixed",
    "revolute": "revolute",
    "prismatic": "prismatic",
    "screw": "helical",
    "planar": "planar",
    "ball_rpy": "ball",
    "quaternion_floating": "free",
}
_TURN: Final = 2 * np.pi
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
            welded = _weld(plant, models) if format_ == "urdf" and not floating_base else ""
            plant.Finalize()
        except (Exception, SystemExit) as error:
            # A demand of Drake's that fails comes as SystemExit.
            raise UnsupportedError(f"drake: {' '.join(str(error).replace(f'{path.parent}/', '').split())}") from None
    model, maps = _described(plant, floating_base)
    dyn = _Read.holding(model, maps)
    notes = [f"the base {welded!r} floats by itself; welded to the world here"] if welded else []
    messages = [" ".join(record.getMessage().split("warning: ")[-1].split()) for record in records]
    notes += [text for text in dict.fromkeys(messages) if not any(x in text for x in _IDLE)]
    held = "by constraints" if plant.num_constraints() else ""
    if held:
        notes.append(f"{plant.num_constraints()} constraints, outside M and nle")
    # A plant counts its constraints.
    loops = "pydrake does not give the bodies and points of constraints" if plant.num_constraints() else ()
    return Imported(model, dyn.terms, tuple(notes), loops=loops, holds_mimics=held)


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


def _weld(plant: Any, models: Any) -> str:
    """Hold the bodies that no joint carries, and return the first one's name."""
    carried = {int(plant.get_joint(j).child_body().index()) for j in plant.GetJointIndices()}
    loose = [b for model in models for b in plant.GetBodyIndices(model) if int(b) not in carried]
    for b in loose:
        plant.WeldFrames(plant.world_frame(), plant.get_body(b).body_frame())
    return str(plant.get_body(loose[0]).name()) if loose else ""


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


def _described(plant: Any, floating_base: bool) -> tuple[Model, DrakeModel]:
    """Read a finalized plant joint by joint."""
    rotors, parts = _rotors(plant), Parts()
    #: Drake's body frame in ours, which is the joint's moving one.
    at = {0: RigidTransform()}
    names = {0: "world"}
    theirs: dict[str, list[Any]] = {}
    for joint in _in_order(plant):
        kind = _KINDS.get(joint.type_name())
        if kind is None:
            raise UnsupportedError(
                f"drake: built a {joint.type_name()} joint from {joint.name()!r}, which has no counterpart here"
            )
        parent, child, name = int(joint.parent_body().index()), joint.child_body(), str(joint.name())
        index = int(child.index())
        names[index] = parts.name("body", str(child.name()))
        at[index] = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
        X = at[parent] @ joint.frame_on_parent().GetFixedPoseInBodyFrame()
        if kind == "fixed":
            # A weld may hold its frames apart.
            X = X @ joint.X_FM()
        if floating_base and kind == "free" and not parent:
            # Called after its body by itself.
            name = BASE_JOINT
        kind, numbers = _numbers(joint, kind, *rotors.get(int(joint.index()), (np.inf, 0.0)))
        R, p = np.array(X.rotation().matrix()), np.array(X.translation())
        parts.joint(name, kind, names[parent], names[index], R, p, **numbers)
        _add_body(parts, names[index], child, at[index])
        theirs[name] = [joint]
    # Coordinates stand in the order of Drake's velocities.
    parts.joints.sort(key=lambda own: _first_velocity(*theirs[own.name]))
    model = parts.model("drake", np.array(plant.gravity_field().gravity_vector()))
    bodies = {name: plant.get_body(type(plant.world_body().index())(k)) for k, name in names.items()}
    return checked("drake", model), mapped(plant, model, theirs, bodies)


def _first_velocity(joint: Any) -> int:
    return int(joint.velocity_start()) if joint.num_velocities() else -1


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


def _numbers(joint: Any, kind: str, effort: float, armature: float) -> tuple[str, dict[str, Any]]:
    """Return a joint's kind, continuous where a revolute one has no limits, and its numbers."""
    nv = kind_of(kind).nv
    damping = np.array(joint.default_damping_vector()) if nv else np.zeros(0)
    if kind == "free":
        # Drake's order is angular, linear.
        damping = np.r_[damping[3:], damping[:3]]
    numbers: dict[str, Any] = {"damping": damping, "effort_limit": np.full(nv, effort)}
    if nv == 1:
        axis = {"revolute": "revolute_axis", "prismatic": "translation_axis", "helical": "screw_axis"}[kind]
        lower, upper = np.array(joint.position_lower_limits()), np.array(joint.position_upper_limits())
        numbers |= {"axes": np.array([getattr(joint, axis)()]), "lower": lower, "upper": upper}
        numbers |= {"velocity_limit": np.array(joint.velocity_upper_limits()), "armature": np.full(1, armature)}
        if kind == "helical":
            numbers["pitch"] = float(joint.screw_pitch()) / _TURN
        if kind == "revolute" and not np.isfinite([lower, upper]).any():
            kind = "continuous"
    return kind, numbers
