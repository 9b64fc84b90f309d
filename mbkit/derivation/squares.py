"""The kinetic energy as a sum of squares, and what Gauss's principle makes of them.

::

    T = ½ Σ w ẋ²        ẋ linear in v

The rates ẋ are those of the bodies' centres of mass and their angular velocities, in their own axes, where a tree's
zeros are exact, and those of rotors. Of all accelerations that the joints allow a motion takes those that make
Z = ½ Σ w (ẍ - ẍ_free)² least (Gauss 1829; Lanczos 1970, The Variational Principles of Mechanics, ch. IV.8): a linear
least-squares problem in v̇, for ẍ = J v̇ + what v makes of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from mbkit.derivation.inertia_squares import inertia_squares
from mbkit.derivation.kinematics import Kinematics, Vector, add, constant_times, dot3
from mbkit.derivation.scalars import scalar
from mbkit.derivation.values import is_zero
from mbkit.model import Body, Model
from mbkit.model.kinds import cross3

__all__ = ["Squares", "has_squares", "squares"]


@dataclass(frozen=True)
class Squares:
    """The rows of the sum, those that move.

    Attributes
    ----------
    weights : list of scalars
        w, floats or expressions of parameters.
    jacobian : (rows, nv) casadi.SX
        J = ∂ẋ/∂v.
    drifts : list of scalars
        ẍ - ẍ_free at v̇ = 0.
    force : (nv,) casadi.SX
        Of the turning of bodies whose inertia is a parameter, which may become zero: a force on the left, like nle.
    """

    weights: list[Any]
    jacobian: Any
    drifts: list[Any]
    force: Any


def has_squares(model: Model) -> bool:
    """Return whether the kinetic energy is such a sum: no parameter off an inertia's diagonal, nor a mere product."""
    bound = {(b.part, b.index) for b in model.bindings if b.where == "bodies" and b.field == "inertia"}
    return all(_has_squares(body, {index for part, index in bound if part == body.name}) for body in model.bodies)


def _has_squares(body: Body, bound: set[tuple[int, ...]]) -> bool:
    if bound:
        off = [(i, j) for i in range(3) for j in range(3) if i != j]
        return not any(index in bound or body.inertia[index] for index in off)
    diagonal = not (body.inertia - np.diag(np.diagonal(body.inertia))).any()
    return diagonal or inertia_squares(tuple(body.inertia.ravel().tolist())) is not None


def squares(kin: Kinematics) -> Squares:
    """Return the sum, of a model that `has_squares`."""
    if not has_squares(kin.model):
        raise ValueError(f"{kin.model.name}: an inertia is no sum of squares")
    rows = _Rows(kin)
    for body in kin.model.bodies:
        rows.body(body.name)
    for joint in kin.model.joints:
        for rotor, rate in zip(kin.values.joints[joint.name].armature, kin.velocities(joint), strict=True):
            rows.row(rotor, rate, 0.0)
    for coupling in kin.model.couplings:
        rows.row(kin.values.couplings[coupling.name].armature, kin.coupled(coupling)[1], 0.0)
    return rows.finished()


class _Rows:
    def __init__(self, kin: Kinematics) -> None:
        self._kin = kin
        self._gravity: dict[str, Vector] = {"world": kin.values.gravity}
        for joint in kin.model.tree:
            self._gravity[joint.child] = kin.from_parent(joint, self._gravity[joint.parent])
        self._weights: list[Any] = []
        self._rates: list[Any] = []
        self._drifts: list[Any] = []
        self._turned: list[tuple[Any, Any]] = []

    def row(self, weight: Any, rate: Any, drift: Any) -> None:
        """Add a square; drift is what its acceleration is beside the derivative of the rate."""
        # What nothing moves is a zero.
        if not is_zero(weight) and isinstance(rate, ca.SX):
            self._weights.append(weight)
            self._rates.append(rate)
            self._drifts.append(drift)

    def body(self, name: str) -> None:
        """Add the squares of a body."""
        linear, angular = self._kin.twists[name]
        values = self._kin.values.bodies[name]
        at_com = add(linear, cross3(angular, values.com))
        # The axes turn below the vector.
        for rate, turned, g in zip(at_com, cross3(angular, at_com), self._gravity[name], strict=True):
            self.row(values.mass, rate, turned - g)
        entries = [x for row in values.inertia for x in row]
        found = inertia_squares(tuple(entries)) if all(isinstance(x, float) for x in entries) else None
        if found is not None:
            for square in found:
                turning = (c * (angular[i] * angular[j]) for (i, j), c in square.turning)
                self.row(square.weight, dot3(square.direction, angular), sum(turning, 0.0))
        elif not all(is_zero(values.inertia[i][j]) for i in range(3) for j in range(3) if i != j):
            raise ValueError(
                f"{name}: an inertia with numbers off its diagonal that are not known, or no sum of squares"
            )
        else:
            # Of parameters, which may become zero; or flat, turning where nothing resists.
            torque = cross3(angular, constant_times(values.inertia, angular))
            for k in range(3):
                self.row(values.inertia[k][k], angular[k], 0.0)
                self._turned.append((angular[k], torque[k]))

    def finished(self) -> Squares:
        v, q = self._kin.v, self._kin.q
        rates = ca.vertcat(ca.SX(0, 1), *self._rates)
        own = ca.jtimes(rates, q, self._kin.qdot)
        drifts = [scalar(own[i]) + drift for i, drift in enumerate(self._drifts)]
        force: Any = ca.SX(v.shape[0], 1)
        turned = [(rate, torque) for rate, torque in self._turned if not is_zero(torque)]
        if turned:
            angular, torque = (ca.vertcat(*(ca.SX(x) for x in column)) for column in zip(*turned, strict=True))
            force = ca.jtimes(angular, v, torque, True)
        return Squares(self._weights, ca.jacobian(rates, v), drifts, force)
