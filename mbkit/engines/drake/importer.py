"""Drake's own importers of URDF and MJCF, and the plants that they read, described.

The only place that knows what a parsed plant holds: a joint's frames stand off its bodies' frames,
inertias are about a body's origin, a rotor's inertia belongs to an actuator, a pitch is metres per
turn, and a base that nothing holds floats.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces

from mbkit._check import Array
from mbkit.engines.base import Dynamics, by_sample
from mbkit.engines.drake.engine import DrakeDynamics
from mbkit.engines.drake.model import DrakeModel
from mbkit.engines.imported import Imported, checked, joint_of, unused, written
from mbkit.errors import UnsupportedError
from mbkit.load.urdf_reader import BASE_JOINT
from mbkit.model import Body, Joint, Model
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
    with _heard() as heard, written(text, files or {}) as path:
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
    described = _Description(plant, floating_base)
    dyn = _Read(checked("drake", described.model), described.maps)
    notes = [f"the base {welded!r} floats by itself; welded to the world here"] if welded else []
    notes += [h for h in dict.fromkeys(heard) if not any(x in h for x in _IDLE)]
    if plant.num_constraints():
        notes.append(f"{plant.num_constraints()} constraints, outside M and nle")
    return Imported(described.model, dyn.terms, tuple(notes))


@contextmanager
def _heard() -> Iterator[list[str]]:
    """Collect what Drake logs."""
    heard: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            heard.append(" ".join(record.getMessage().split("warning: ")[-1].split()))

    logger, collector = logging.getLogger("drake"), Collector()
    level, propagate = logger.level, logger.propagate
    logger.addHandler(collector)
    logger.setLevel(logging.WARNING)
    logger.propagate = False
    try:
        yield heard
    finally:
        logger.removeHandler(collector)
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

    def __init__(self, model: Model, maps: DrakeModel) -> None:
        Dynamics.__init__(self, model)
        self._hold(maps)

    def terms(self, q: Array, v: Array, without: tuple[str, ...] = ()) -> dict[str, Array]:  # noqa: ARG002
        """Return M, g, nle and passive at a batch of states."""
        return {"M": self.mass_matrix(q), "g": self.gravity(q), "nle": self.nle(q, v), "passive": self.passive(q, v)}

    @by_sample
    def _passive(self, q: Array, v: Array) -> Array:
        plant, context, forces = self.plant, self._context, MultibodyForces(self.plant)
        self._set(q, v)
        plant.CalcForceElementsContribution(context, forces)
        # Gravity is among Drake's force elements.
        weight = plant.CalcGravityGeneralizedForces(context)
        return self._force(plant.CalcGeneralizedForces(context, forces) - weight)


class _Description:
    """Reads a finalized plant joint by joint."""

    def __init__(self, plant: Any, floating_base: bool) -> None:
        self.plant = plant
        rotors = self._rotors()
        #: R and p of Drake's body frame in ours, which is the joint's moving one.
        self.at: dict[int, tuple[Array, Array]] = {0: (np.eye(3), np.zeros(3))}
        self.names = {0: "world"}
        bodies, joints = [], []
        self.theirs: list[tuple[str, Any]] = []
        for joint in self._in_order():
            kind = _KINDS.get(joint.type_name())
            if kind is None:
                raise UnsupportedError(
                    f"drake: made a {joint.type_name()} joint of {joint.name()!r}, which has no counterpart here"
                )
            parent, child = joint.parent_body(), joint.child_body()
            index = int(child.index())
            self.names[index] = unused(str(child.name()), self.names.values())
            R_BM, p_BM = _fixed(joint.frame_on_child())
            self.at[index] = R_BM.T, -R_BM.T @ p_BM
            R_P, p_P = self.at[int(parent.index())]
            R_F, p_F = _fixed(joint.frame_on_parent())
            if kind == "fixed":
                # A weld may hold its frames apart.
                X_FM = joint.X_FM()
                R_F, p_F = R_F @ np.array(X_FM.rotation().matrix()), p_F + R_F @ np.array(X_FM.translation())
            name = str(joint.name())
            effort, armature = rotors.get(int(joint.index()), (np.inf, 0.0))
            if floating_base and kind == "free" and not int(parent.index()):
                # Called after its body by itself.
                name = BASE_JOINT
            place = self.names[int(parent.index())], self.names[index], R_P @ R_F, p_P + R_P @ p_F
            joints.append(_described(name, joint, kind, place, effort, armature))
            bodies.append(_matter(self.names[index], child, *self.at[index]))
            self.theirs.append((name, joint))
        # Coordinates stand in the order of Drake's velocities.
        order = sorted(range(len(joints)), key=lambda k: self._first_velocity(self.theirs[k][1]))
        joints, self.theirs = [joints[k] for k in order], [self.theirs[k] for k in order]
        gravity = np.array(plant.gravity_field().gravity_vector())
        self.model = Model(name="drake", gravity=gravity, bodies=tuple(bodies), joints=tuple(joints))
        self.maps = self._mapped()

    @staticmethod
    def _first_velocity(joint: Any) -> int:
        return int(joint.velocity_start()) if joint.num_velocities() else -1

    def _in_order(self) -> list[Any]:
        """Return the joints, every parent before its children."""
        plant = self.plant
        waiting = [plant.get_joint(j) for j in plant.GetJointIndices()]
        known, out = {0}, []
        while waiting:
            ready = [j for j in waiting if int(j.parent_body().index()) in known]
            if not ready:
                raise UnsupportedError("drake: made joints that no tree connects to the world")
            out += ready
            known |= {int(j.child_body().index()) for j in ready}
            waiting = [j for j in waiting if j not in ready]
        return out

    def _rotors(self) -> dict[int, tuple[float, float]]:
        """Return effort limit and reflected inertia of each actuated joint."""
        out: dict[int, tuple[float, float]] = {}
        for a in self.plant.GetJointActuatorIndices():
            actuator = self.plant.get_joint_actuator(a)
            ratio = float(actuator.default_gear_ratio())
            reflected = float(actuator.default_rotor_inertia()) * ratio * ratio
            joint = int(actuator.joint().index())
            out[joint] = float(actuator.effort_limit()), out.get(joint, (0.0, 0.0))[1] + reflected
        return out

    def _mapped(self) -> DrakeModel:
        plant, layout = self.plant, self.model.layout
        q_index, v_index = np.full(plant.num_positions(), -1), np.full(plant.num_velocities(), -1)
        turning = []
        for own, (_, joint) in zip(self.model.joints, self.theirs, strict=True):
            if not own.type.nv:
                continue
            q, v = joint.position_start(), joint.velocity_start()
            if own.type.quaternion is not None:
                turning.append((own, q, v))
                continue
            q_index[q : q + own.type.nq] = range(layout.q[own.name].start, layout.q[own.name].stop)
            v_index[v : v + own.type.nv] = range(layout.v[own.name].start, layout.v[own.name].stop)
        bodies = {name: plant.get_body(type(plant.world_body().index())(k)) for k, name in self.names.items()}
        return DrakeModel(plant, q_index, v_index, tuple(turning), bodies, ())


def _fixed(frame: Any) -> tuple[Array, Array]:
    X = frame.GetFixedPoseInBodyFrame()
    return np.array(X.rotation().matrix()), np.array(X.translation())


def _matter(name: str, body: Any, R: Array, p: Array) -> Body:
    """Return a body's matter, in our axes; Drake's inertia is about its frame's origin."""
    M = body.default_spatial_inertia()
    mass, com = float(M.get_mass()), np.array(M.get_com())
    about = np.array(M.CalcRotationalInertia().CopyToFullMatrix3())
    # A body without mass has no centre of mass; Drake writes NaN there.
    if not np.isfinite(about).all() or not np.isfinite(com).all():
        about, com = np.zeros((3, 3)), np.zeros(3)
    central = about + mass * skew(com) @ skew(com)
    turned = R @ central @ R.T
    return Body(name, mass, p + R @ com, 0.5 * (turned + turned.T))


def _described(
    name: str, joint: Any, kind: str, place: tuple[str, str, Array, Array], effort: float, armature: float
) -> Joint:
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
    return joint_of(name, kind, *place, **numbers)
