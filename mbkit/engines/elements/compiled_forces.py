"""Forces given by functions beside an engine's own terms, compiled from mbkit's expressions."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit.codegen.backend import DERIVING, compile_by_default, executable
from mbkit.derivation.forces import ElementForces
from mbkit.derivation.kinematics import Kinematics
from mbkit.engines.elements.passive import AddedForce
from mbkit.model import Model


class CompiledForces(AddedForce):
    """Force, energy and derivatives of a model's elements, at states and parameters of dynamics of this model."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._codes: dict[str, Any] = {}

    def force(self, dyn: Any, q: Array, v: Array) -> Array:
        return self._value("force", dyn, q, v)[..., 0]

    def lost(self, dyn: Any, q: Array, v: Array) -> Array:
        """Return the part of F that no potential accounts for, (nv,) or (N, nv)."""
        return self._value("lost", dyn, q, v)[..., 0]

    def energy(self, dyn: Any, q: Array) -> Any:
        """Return the potential energy, () or (N,)."""
        return self._value("energy", dyn, q)[..., 0, 0]

    def slopes(self, dyn: Any, q: Array, v: Array) -> tuple[Array, Array]:
        out, n = self._value("slopes", dyn, q, v), self._model.nv
        return out[..., :n], out[..., n:]

    def beside(self, quantity: str, method: Callable[..., Any], dyn: Any) -> Callable[..., Any]:
        if quantity == "potential_energy":
            return lambda q: method(q) + self.energy(dyn, q)
        return super().beside(quantity, method, dyn)

    def _value(self, name: str, dyn: Any, *states: Array) -> Array:
        if name not in self._codes:
            with DERIVING:
                key = (self._model.form_digest, "elements", name)
                self._codes[name] = executable(key, lambda: self._derived(name), compile=compile_by_default())
        trailing: list[Array] = []
        if self._model.parameters:
            # The own derivation's may differ from sample to sample.
            own = hasattr(type(dyn), "_parameter_values")
            values = dyn._parameter_values if own else np.array([*dyn.model.parameters.values()], dtype=np.float64)
            trailing = [np.broadcast_to(values, (*states[0].shape[:-1], values.shape[-1]))]
        given = [np.ascontiguousarray(x, dtype=np.float64) for x in (*states, *trailing)]
        return np.asarray(self._codes[name](*given)[0])

    @cached_property
    def _expressions(self) -> tuple[Kinematics, ElementForces]:
        kin = Kinematics(self._model)
        return kin, ElementForces(kin)

    def _derived(self, name: str) -> ca.Function:
        kin, elements = self._expressions
        parameters = kin.values.parameters
        given = [kin.q, kin.v] if name != "energy" else [kin.q]
        if name == "energy":
            out: Any = ca.SX(elements.energy)
        elif name == "lost":
            out = elements.force
        else:
            out = elements.force - kin.pullback(ca.gradient(ca.SX(elements.energy), kin.q))
        if name == "slopes":
            tangent = ca.jacobian(kin.qdot, kin.v)
            out = ca.horzcat(ca.mtimes(ca.jacobian(out, kin.q), tangent), ca.jacobian(out, kin.v))
        return ca.Function(name, [*given, *([parameters] if parameters.numel() else [])], [ca.densify(out)])
