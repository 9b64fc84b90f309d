"""Drake of any version from 1.35: terms of a description, or of a file, in Drake's own coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody import tree
from pydrake.multibody.plant import MultibodyPlant


def built(data: dict[str, Any]) -> Any:
    """Return the plant of a description, and places of joints and bodies."""
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector(np.array(data["gravity"]))
    bodies = {"world": plant.world_body()}
    for k, (name, body) in enumerate(data["bodies"].items()):
        bodies[name] = plant.AddRigidBody(f"{k}", _inertia(body))
    joints: dict[str, list[Any]] = {}
    for n, joint in enumerate(data["joints"]):
        parent, child = bodies[joint["parent"]], bodies[joint["child"]]
        X_PJ = RigidTransform(RotationMatrix(np.array(joint["rotation"])), np.array(joint["translation"]))
        frame = plant.AddFrame(tree.FixedOffsetFrame(f"{n}.fixed", parent, X_PJ))
        if not joint["steps"]:
            plant.AddJoint(tree.WeldJoint(f"{n}", frame, child.body_frame(), RigidTransform()))
        joints[joint["name"]] = own = []
        for k, step in enumerate(joint["steps"]):
            last = k == len(joint["steps"]) - 1
            body = child if last else plant.AddRigidBody(f"{n}.{k}.between", _inertia(None))
            own.append(plant.AddJoint(_joint(step, f"{n}.{k}", frame, body.body_frame())))
            frame = body.body_frame()
        if len(own) == 1 and len(joint["rotors"]) == 1 and joint["rotors"][0]:
            actuator = plant.AddJointActuator(f"{n}.rotor", own[0])
            actuator.set_default_rotor_inertia(joint["rotors"][0])
            actuator.set_default_gear_ratio(1.0)
    plant.Finalize()
    return plant, joints, bodies


def _inertia(body: Any) -> Any:
    if body is None or (not body["mass"] and (body["static"] or not np.any(body["inertia"]))):
        return tree.SpatialInertia.Zero()
    # Drake refuses some inertias that cannot act, because the body never moves.
    I = np.zeros((3, 3)) if body["static"] else np.array(body["inertia"])
    central = tree.RotationalInertia(I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2])
    return tree.SpatialInertia.MakeFromCentralInertia(body["mass"], np.array(body["com"]), central)


def _joint(step: dict[str, Any], name: str, at: Any, body: Any) -> Any:
    kind, axes = step["type"], [np.array(axis) for axis in step["axes"]]
    if kind == "revolute":
        return tree.RevoluteJoint(name, at, body, axes[0])
    if kind == "prismatic":
        return tree.PrismaticJoint(name, at, body, axes[0])
    if kind == "helical":
        # Metres per radian here, per turn there.
        return tree.ScrewJoint(name, at, body, axes[0], 2 * np.pi * step["pitch"], 0.0)
    return (tree.BallRpyJoint if kind == "ball" else tree.QuaternionFloatingJoint)(name, at, body)


class Engine:
    """A finalized, continuous plant and its context."""

    def __init__(self, parts: Any) -> None:
        self._plant, self._joints, self._bodies = parts
        self._context = self._plant.CreateDefaultContext()
        self._applied = self._plant.get_applied_generalized_force_input_port()
        self._accelerations = self._plant.get_generalized_acceleration_output_port()

    def joints(self) -> dict[str, Any]:
        """Return the places of each joint's numbers in positions and velocities."""
        out = {}
        for name, own in self._joints.items():
            out[name] = [
                [k for j in own for k in range(j.position_start(), j.position_start() + j.num_positions())],
                [k for j in own for k in range(j.velocity_start(), j.velocity_start() + j.num_velocities())],
            ]
        return out

    def _set(self, q: Any, v: Any = None) -> Any:
        self._plant.SetPositions(self._context, q)
        self._plant.SetVelocities(self._context, np.zeros(self._plant.num_velocities()) if v is None else v)
        return self._context

    def mass_matrix(self, q: Any) -> Any:
        return self._plant.CalcMassMatrix(self._set(q))

    def gravity(self, q: Any) -> Any:
        return -self._plant.CalcGravityGeneralizedForces(self._set(q))

    def coriolis_force(self, q: Any, v: Any) -> Any:
        return self._plant.CalcBiasTerm(self._set(q, v))

    def nle(self, q: Any, v: Any) -> Any:
        return self.coriolis_force(q, v) - self._plant.CalcGravityGeneralizedForces(self._context)

    def inverse_dynamics(self, q: Any, v: Any, a: Any) -> Any:
        self._set(q, v)
        forces = tree.MultibodyForces(self._plant)
        self._plant.CalcForceElementsContribution(self._context, forces)
        return self._plant.CalcInverseDynamics(self._context, a, forces)

    def forward_dynamics(self, q: Any, v: Any, tau: Any) -> Any:
        self._applied.FixValue(self._set(q, v), tau)
        return np.array(self._accelerations.Eval(self._context))

    def kinetic_energy(self, q: Any, v: Any) -> Any:
        return self._plant.CalcKineticEnergy(self._set(q, v))

    def potential_energy(self, q: Any) -> Any:
        return self._plant.CalcPotentialEnergy(self._set(q))

    def frame(self, q: Any, body: str) -> Any:
        """Return R_WB, p_WB, and the Jacobians of the body's origin and turning in world axes."""
        self._set(q)
        plant, world, B = self._plant, self._plant.world_frame(), self._bodies[body]
        X = plant.EvalBodyPoseInWorld(self._context, B)
        by_v = tree.JacobianWrtVariable.kV
        J = plant.CalcJacobianSpatialVelocity(self._context, by_v, B.body_frame(), np.zeros(3), world, world)
        return [X.rotation().matrix(), X.translation(), J[3:], J[:3]]

    def matter(self, q: Any) -> Any:
        """Return the mass, kg, and its centre of mass, m."""
        self._set(q)
        return [self._plant.CalcTotalMass(self._context), self._plant.CalcCenterOfMassPositionInWorld(self._context)]
