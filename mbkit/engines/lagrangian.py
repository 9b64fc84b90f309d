"""mbkit's own derivation behind the protocol: kinematics and energies, no rigid-body algorithm."""

from __future__ import annotations

from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.engines.base import Dynamics
from mbkit.lagrangian.equations import Equations
from mbkit.lagrangian.machine import Machine
from mbkit.model import Model

__all__ = ["LagrangianDynamics"]

# Written out, forward dynamics grows as the cube of a chain's length; beyond this
# many multiplications forming M and solving in LAPACK is faster to build and run.
_WRITTEN_OUT: Final = 6000


class LagrangianDynamics(Dynamics):
    """Terms derived from T and V, each when it is first asked for.

    Attributes
    ----------
    equations : mbkit.lagrangian.Equations
        The expressions, free to read.
    """

    engine = "lagrangian"

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.equations = Equations(model)
        self._machines: dict[tuple[str, ...], Machine] = {}

    def _machine(self, name: str, *extra: str) -> Machine:
        key = (name, *extra)
        if key not in self._machines:
            if name in ("pose", "jacobian", "applied_function"):
                made = getattr(self.equations, name)(*extra)
            else:
                made = self.equations.function(name)
            self._machines[key] = Machine(made)
        return self._machines[key]

    def _vector(self, name: str, *arguments: Array) -> Array:
        return self._machine(name)(*arguments)[0][..., 0]

    def _mass_matrix(self, q: Array) -> Array:
        return self._machine("mass_matrix")(q)[0]

    def _coriolis_matrix(self, q: Array, v: Array) -> Array:
        return self._machine("coriolis_matrix")(q, v)[0]

    def _coriolis_force(self, q: Array, v: Array) -> Array:
        return self._vector("coriolis_force", q, v)

    def energy_rate(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Any:
        """Return dE/dt of kinetic and potential energy along (D v, a), exactly differentiated."""
        return self._scalar(
            self._evaluate("energy_rate", lambda q, v, a: self._vector("energy_rate", q, v, a)[..., 0], q=q, v=v, a=a)
        )

    def _gravity(self, q: Array) -> Array:
        return self._vector("gravity", q)

    def _nle(self, q: Array, v: Array) -> Array:
        return self._vector("nle", q, v)

    def _passive(self, q: Array, v: Array) -> Array:
        return self._vector("passive", q, v)

    def _inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        return self._vector("inverse_dynamics", q, v, a)

    @cached_property
    def _written_out(self) -> bool:
        return self.equations.elimination_size() <= _WRITTEN_OUT

    def _forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array:
        if self._written_out:
            return self._vector("forward_dynamics", q, v, tau)
        M, f = self._machine("applied_function")(q, v)
        return np.asarray(np.linalg.solve(M, f + tau[..., None])[..., 0])

    def _kinetic_energy(self, q: Array, v: Array) -> Array:
        return self._vector("kinetic_energy", q, v)[..., 0]

    def _potential_energy(self, q: Array) -> Array:
        return self._vector("potential_energy", q)[..., 0]

    def _pose(self, q: Array, frame: str) -> Array:
        return self._machine("pose", frame)(q)[0]

    def _jacobian(self, q: Array, frame: str, axes: str) -> Array:
        return self._machine("jacobian", frame, axes)(q)[0]

    def _function(self, name: str) -> Any:
        return self.equations.function(name)
