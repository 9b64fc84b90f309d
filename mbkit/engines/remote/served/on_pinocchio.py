"""Pinocchio of any version from 2.6: terms of a description, or of a file, in Pinocchio's own coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

_LETTERS = {(1.0, 0.0, 0.0): "X", (0.0, 1.0, 0.0): "Y", (0.0, 0.0, 1.0): "Z"}


def _joint_model(step: dict[str, Any]) -> Any:
    kind, axes = step["type"], [np.array(axis) for axis in step["axes"]]
    if kind in ("revolute", "prismatic"):
        # The cheaper joint where the axis is exactly x, y or z.
        letter = _LETTERS.get(tuple(axes[0].tolist()))
        if letter:
            return getattr(pin, "JointModel" + kind[0].upper() + letter)()
        return getattr(pin, f"JointModel{kind.capitalize()}Unaligned")(axes[0])
    name = {
        "helical": "JointModelHelicalUnaligned",
        "universal": "JointModelUniversal",
        "spherical_zyx": "JointModelSphericalZYX",
        "ball": "JointModelSpherical",
        "free": "JointModelFreeFlyer",
    }[kind]
    if not hasattr(pin, name):
        raise NotImplementedError(f"this version has no {name}")
    return getattr(pin, name)(*axes, *([step["pitch"]] if kind == "helical" else []))


def built(data: dict[str, Any]) -> Any:
    """Return the model of a description: the model, places of joints and bodies, and the moment of what stands."""
    model = pin.Model()
    model.gravity = pin.Motion(np.array(data["gravity"]), np.zeros(3))
    bodies = {"world": (0, np.eye(3), np.zeros(3))}
    numbers: dict[str, list[int]] = {}
    rotors: list[float] = []
    moment = np.zeros(3)
    for joint in data["joints"]:
        carrier, R, p = bodies[joint["parent"]]
        R, p = R @ np.array(joint["rotation"]), p + R @ np.array(joint["translation"])
        numbers[joint["name"]] = []
        for k, step in enumerate(joint["steps"]):
            carrier = model.addJoint(carrier, _joint_model(step), pin.SE3(R, p), f"{joint['name']}.{k}")
            numbers[joint["name"]].append(carrier)
            R, p = np.eye(3), np.zeros(3)
        rotors += joint["rotors"]
        body = data["bodies"][joint["child"]]
        bodies[joint["child"]] = (carrier, R, p)
        if carrier:
            inertia = pin.Inertia.Zero()
            inertia.mass, inertia.lever = body["mass"], np.array(body["com"])
            inertia.inertia = np.array(body["inertia"])
            model.appendBodyToJoint(carrier, inertia, pin.SE3(R, p))
        else:
            moment += body["mass"] * (p + R @ np.array(body["com"]))
    if any(rotors):
        if not hasattr(model, "armature"):
            raise NotImplementedError("this version has no armature")
        model.armature = np.array(rotors)
    return model, numbers, bodies, moment


class Engine:
    """A model and its data."""

    def __init__(self, parts: Any) -> None:
        self._m, self._numbers, self._bodies, self._moment = parts
        self._d = self._m.createData()

    def joints(self) -> dict[str, Any]:
        """Return the places of each joint's numbers in q and v."""
        out = {}
        for name, numbers in self._numbers.items():
            own = [self._m.joints[j] for j in numbers]
            out[name] = [
                [k for j in own for k in range(j.idx_q, j.idx_q + j.nq)],
                [k for j in own for k in range(j.idx_v, j.idx_v + j.nv)],
            ]
        return out

    def mass_matrix(self, q: Any) -> Any:
        return np.array(pin.crba(self._m, self._d, q))

    def coriolis_matrix(self, q: Any, v: Any) -> Any:
        return np.array(pin.computeCoriolisMatrix(self._m, self._d, q, v))

    def coriolis_force(self, q: Any, v: Any) -> Any:
        return self.coriolis_matrix(q, v) @ v

    def gravity(self, q: Any) -> Any:
        return np.array(pin.computeGeneralizedGravity(self._m, self._d, q))

    def nle(self, q: Any, v: Any) -> Any:
        return np.array(pin.nonLinearEffects(self._m, self._d, q, v))

    def inverse_dynamics(self, q: Any, v: Any, a: Any) -> Any:
        return np.array(pin.rnea(self._m, self._d, q, v, a))

    def forward_dynamics(self, q: Any, v: Any, tau: Any) -> Any:
        return np.array(pin.aba(self._m, self._d, q, v, tau))

    def kinetic_energy(self, q: Any, v: Any) -> Any:
        return pin.computeKineticEnergy(self._m, self._d, q, v)

    def potential_energy(self, q: Any) -> Any:
        # Pinocchio leaves out what is fixed to the world.
        still = float(np.array(self._m.gravity.linear) @ self._moment)
        return pin.computePotentialEnergy(self._m, self._d, q) - still

    def frame(self, q: Any, body: str) -> Any:
        """Return R_WB, p_WB, and the Jacobians of the body's origin and turning in world axes."""
        carrier, R, p = self._bodies[body]
        pin.computeJointJacobians(self._m, self._d, q)
        X = self._d.oMi[carrier]
        J = np.zeros((6, self._m.nv))
        if carrier:
            # One column comes back as a vector.
            J = np.array(pin.getJointJacobian(self._m, self._d, carrier, pin.LOCAL)).reshape(6, self._m.nv)
        linear, angular = X.rotation @ (J[:3] - pin.skew(p) @ J[3:]), X.rotation @ J[3:]
        return [X.rotation @ R, X.translation + X.rotation @ p, linear, angular]

    def matter(self, q: Any) -> Any:
        """Return the mass of what moves, kg, and its centre of mass, m."""
        return [pin.computeTotalMass(self._m), np.array(pin.centerOfMass(self._m, self._d, q))]
