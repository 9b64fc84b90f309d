"""Pinocchio's regressors in the description's parameters.

Pinocchio merges bodies that fixed joints hold. The pseudo-inertia of one is X J Xᵀ in the frame that its carrier's
joint moves, X being its pose there, so that each of its columns is a combination of its carrier's ten. These stand as
m, hx, hy, hz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz (`pinocchio.Inertia.toDynamicParameters`).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Final

import numpy as np
import pinocchio as pin

from mbkit._check import Array
from mbkit.engines.pinocchio.model import PinModel
from mbkit.model import Model
from mbkit.model.base_parameters import STANDARD, parameters_of, pseudo_inertia

#: Where each of Pinocchio's parameters stands among the standard ones.
_ORDER: Final = tuple(map(STANDARD.index, ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")))
_SIZE: Final = len(STANDARD)


class PinRegressors:
    """Regressors of all standard parameters, in Pinocchio's velocities.

    Its `_map` has Pinocchio's parameters in its rows, the description's in its columns.
    """

    def __init__(self, description: Model, maps: PinModel, data: Any) -> None:
        self._description, self._maps, self._m, self._d = description, maps, maps.model, data

    @cached_property
    def _map(self) -> Array:
        bodies = [self._maps.bodies[joint.child] for joint in self._description.tree]
        out = np.zeros((_SIZE * self._m.njoints, _SIZE * len(bodies)))
        for k, (carrier, R, p) in enumerate(bodies):
            X = np.eye(4)
            X[:3, :3], X[:3, 3] = R, p
            moved = parameters_of(X @ pseudo_inertia(np.eye(_SIZE)) @ X.T).T
            out[_SIZE * carrier : _SIZE * (carrier + 1), _SIZE * k : _SIZE * (k + 1)] = moved[_ORDER, :]
        return out

    @cached_property
    def _ground(self) -> Array:
        """The potential energy of units of parameters of bodies at rest, which Pinocchio leaves out."""
        return np.asarray(-self._description.gravity @ self._map[1:4])

    def torques(self, q: Array, v: Array, a: Array) -> Array:
        """Return Y(q, v, a)."""
        # One row comes back as a vector.
        own = pin.computeJointTorqueRegressor(self._m, self._d, q, v, a).reshape(
            self._m.nv, _SIZE * (self._m.njoints - 1)
        )
        return np.asarray(own @ self._map[_SIZE:])

    def momentum(self, q: Array, v: Array) -> Array:
        """Return Y(q, v) of the momentum: the forces of accelerations v at rest, without gravity."""
        still = np.zeros(self._m.nv)
        return self.torques(q, still, v) - self.torques(q, still, still)

    def energies(self, q: Array, v: Array) -> Array:
        """Return Y(q, v) of kinetic and potential energy."""
        kinetic = pin.computeKineticEnergyRegressor(self._m, self._d, q, v) @ self._map[_SIZE:]
        potential = pin.computePotentialEnergyRegressor(self._m, self._d, q) @ self._map[_SIZE:]
        return np.vstack([kinetic, potential + self._ground])
