"""Point-to-point springs and dampers on Pinocchio's kinematics."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from mbkit._check import Array
from mbkit.engines.pinocchio_model import PinModel
from mbkit.model import Model, PointSpring

__all__ = ["PointSprings"]


class PointSprings:
    """Forces and energy of all point springs of a model, in Pinocchio's coordinates."""

    def __init__(self, model: Model, made: PinModel) -> None:
        self._ends: list[tuple[PointSpring, tuple[int, Array], tuple[int, Array]]] = []
        for spring in model.springs:
            a, b = (
                (made.bodies[body][0], made.bodies[body][2] + made.bodies[body][1] @ point)
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
        pin.computeJointJacobians(m, d, q)
        out = np.zeros(m.nv)
        for spring, (i, a), (j, b) in self._ends:
            gap = d.oMi[j].act(b) - d.oMi[i].act(a)
            J = self._point_jacobian(m, d, j, b) - self._point_jacobian(m, d, i, a)
            # k (l - l0) / l written so that l0 = 0 needs no direction at l = 0. Where one
            # is needed and there is none, the answer is NaN, which the caller finds.
            length = float(np.linalg.norm(gap))
            pull = spring.stiffness * gap
            with np.errstate(invalid="ignore", divide="ignore"):
                if spring.stiffness and spring.rest_length:
                    pull = pull - spring.stiffness * spring.rest_length * (gap / length)
                if spring.damping:
                    pull = pull + spring.damping * (gap / length) * float(gap @ (J @ v)) / np.float64(length)
            out -= J.T @ pull
        return out

    @staticmethod
    def _point_jacobian(m: Any, d: Any, joint: int, point: Array) -> Array:
        if not joint:
            return np.zeros((3, m.nv))
        # One column comes back as a vector.
        J = pin.getJointJacobian(m, d, joint, pin.LOCAL).reshape(6, m.nv)
        R = d.oMi[joint].rotation
        return np.asarray(R @ (J[:3] - pin.skew(point) @ J[3:]))
