"""Kinematics of a model as CasADi expressions: nothing but placements and twists.

Vectors are lists of three `Scalar`s or floats, so that every zero and one of the
description vanishes while the graph is built.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca

from mbkit.derivation import scalars
from mbkit.derivation.scalars import scalar
from mbkit.derivation.values import Constants, Values, is_zero
from mbkit.model import Joint, JointCoupling, Model
from mbkit.model.kinds import cross3

__all__ = ["Kinematics", "add", "constant_times", "constant_transposed_times", "dot3"]

Vector = list[Any]


def add(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return [x + y for x, y in zip(a, b, strict=True)]


def dot3(a: Any, b: Any) -> Any:
    """Return a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def constant_times(A: list[Vector], x: Vector) -> Vector:
    """Return A x for a matrix of the model's numbers, leaving out its zeros."""
    return [sum((A[i][k] * x[k] for k in range(3) if not is_zero(A[i][k])), 0.0) for i in range(3)]


def constant_transposed_times(A: list[Vector], x: Vector) -> Vector:
    """Return Aᵀ x for a matrix of the model's numbers, leaving out its zeros."""
    return [sum((A[k][i] * x[k] for k in range(3) if not is_zero(A[k][i])), 0.0) for i in range(3)]


class Kinematics:
    """Symbols q and v of a model, and what moves with them.

    Attributes
    ----------
    q, v : casadi.SX
        The model's own (reduced) coordinates and velocities.
    values : Values
        The model's numbers.
    """

    def __init__(self, model: Model, constants: Constants = "literal") -> None:
        self.model = model
        self.values = Values(model, constants)
        self.q = ca.SX.sym("q", model.nq)
        self.v = ca.SX.sym("v", model.nv)
        layout = model.layout
        self._q_of: dict[str, Vector] = {}
        self._v_of: dict[str, Vector] = {}
        for joint in model.joints:
            if joint.mimic:
                leader_q = scalar(self.q[layout.q[joint.mimic.joint].start])
                leader_v = scalar(self.v[layout.v[joint.mimic.joint].start])
                values = self.values.joints[joint.name]
                self._q_of[joint.name] = [values.ratio * leader_q + values.offset]
                self._v_of[joint.name] = [values.ratio * leader_v]
            else:
                self._q_of[joint.name] = [scalar(self.q[i]) for i in _range(layout.q[joint.name])]
                self._v_of[joint.name] = [scalar(self.v[i]) for i in _range(layout.v[joint.name])]
        self._carrier = {j.child: j for j in model.joints}

    def coordinates(self, joint: Joint) -> Vector:
        """Return the joint's coordinates, those of its leader if it mimics."""
        return self._q_of[joint.name]

    def velocities(self, joint: Joint) -> Vector:
        """Return the joint's velocities."""
        return self._v_of[joint.name]

    def coupled(self, coupling: JointCoupling) -> tuple[Any, Any]:
        """Return a coupling's length and its rate."""
        factors = self.values.couplings[coupling.name].factors
        pairs = list(zip(factors, coupling.joints, strict=True))
        length, rate = (sum((c * of[joint][0] for c, joint in pairs), 0.0) for of in (self._q_of, self._v_of))
        return length, rate

    @cached_property
    def placements(self) -> dict[str, tuple[Any, Vector]]:
        """(R_JC, p_JC_J) of every joint."""
        return {
            j.name: j.type.placement(scalars, self.values.joints[j.name], self._q_of[j.name]) for j in self.model.tree
        }

    @cached_property
    def twists(self) -> dict[str, tuple[Vector, Vector]]:
        """Linear and angular velocity of every body's origin in the world, in its own axes."""
        out: dict[str, tuple[Vector, Vector]] = {"world": ([0.0] * 3, [0.0] * 3)}
        for joint in self.model.tree:
            linear, angular = out[joint.parent]
            values = self.values.joints[joint.name]
            at_joint = add(linear, cross3(angular, values.translation))
            R, p = self.placements[joint.name]
            angular_J = constant_transposed_times(values.rotation, angular)
            linear_J = add(constant_transposed_times(values.rotation, at_joint), cross3(angular_J, p))
            own = joint.type.twist(scalars, values, self._q_of[joint.name], self._v_of[joint.name])
            out[joint.child] = (
                add(_transposed_times(R, linear_J), own[0]),
                add(_transposed_times(R, angular_J), own[1]),
            )
        return out

    def to_parent(self, joint: Joint, x: Vector, weight: Any = 1.0) -> Vector:
        """Return R_PC x + weight · p_PC: a point (weight 1), vector (0) or first moment (mass)."""
        R, p = self.placements[joint.name]
        in_J = add(_times(R, x), [weight * c for c in p])
        values = self.values.joints[joint.name]
        in_P = constant_times(values.rotation, in_J)
        return add(in_P, [weight * c for c in values.translation])

    def from_parent(self, joint: Joint, x: Vector) -> Vector:
        """Return R_PCᵀ x of a vector."""
        R, _ = self.placements[joint.name]
        return _transposed_times(R, constant_transposed_times(self.values.joints[joint.name].rotation, x))

    def to_world(self, body: str, x: Vector, weight: float = 1.0) -> Vector:
        """Return a point (weight 1) or vector (weight 0) of a body in world axes."""
        while body != "world":
            joint = self._carrier[body]
            x = self.to_parent(joint, x, weight)
            body = joint.parent
        return x

    @cached_property
    def qdot(self) -> ca.SX:
        """D(q) v."""
        parts = [x for j in self.model.independent_joints for x in j.type.qdot(self._q_of[j.name], self._v_of[j.name])]
        return ca.vertcat(ca.SX(0, 1), *parts)

    def pullback(self, gradient: ca.SX) -> ca.SX:
        """Return D(q)ᵀ g for a gradient with respect to q."""
        parts: Vector = []
        for j in self.model.independent_joints:
            g = [scalar(gradient[i]) for i in _range(self.model.layout.q[j.name])]
            parts += j.type.pullback(self._q_of[j.name], g)
        return ca.vertcat(ca.SX(0, 1), *parts)


def _range(part: slice) -> range:
    return range(part.start, part.stop)


def _times(R: Any, x: Vector) -> Vector:
    return [R[i][0] * x[0] + R[i][1] * x[1] + R[i][2] * x[2] for i in range(3)]


def _transposed_times(R: Any, x: Vector) -> Vector:
    return [R[0][i] * x[0] + R[1][i] * x[1] + R[2][i] * x[2] for i in range(3)]
