"""Forces given by functions beside an engine's own terms: compiled from mbkit's expressions, added as generalized ones.

With the elements' force F(q, v, t) an engine gives, of its own terms at τ + F::

    forward_dynamics(q, v, τ) = own(q, v, τ + F)        inverse_dynamics(q, v, a) = own(q, v, a) - F
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit.codegen.backend import DERIVING, compile_by_default, executable
from mbkit.derivation.elements.forces import ElementForces
from mbkit.derivation.kinematics import Kinematics
from mbkit.model import Model

#: Quantities whose argument is a force, with its place among them; they are evaluated at τ + F.
_UNDER_FORCE: Final = {
    "forward_dynamics": 2,
    "forward_dynamics_with_wrenches": 2,
    "constraint_forces": 2,
    "generalized_constraint_force": 2,
}


class CompiledForces:
    """Force, energy and derivatives of a model's elements, at states and parameters of dynamics of this model."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._codes: dict[str, Any] = {}

    def force(self, dyn: Any, q: Array, v: Array) -> Array:
        """Return F(q, v) at the time and parameters of the dynamics, (nv,) or (N, nv)."""
        return self._value("force", dyn, q, v)[..., 0]

    def lost(self, dyn: Any, q: Array, v: Array) -> Array:
        """Return the part of F that no potential accounts for, (nv,) or (N, nv)."""
        return self._value("lost", dyn, q, v)[..., 0]

    def energy(self, dyn: Any, q: Array) -> Any:
        """Return the potential energy, () or (N,)."""
        return self._value("energy", dyn, q)[..., 0, 0]

    def slopes(self, dyn: Any, q: Array, v: Array) -> tuple[Array, Array]:
        """Return ∂F/∂q along the manifold and ∂F/∂v, each (nv, nv) or (N, nv, nv)."""
        out, n = self._value("slopes", dyn, q, v), self._model.nv
        return out[..., :n], out[..., n:]

    def beside(self, quantity: str, method: Callable[..., Any], dyn: Any) -> Callable[..., Any]:
        """Return an engine's method for a quantity with these forces added, or itself where they do not enter."""
        if quantity in _UNDER_FORCE:
            place = _UNDER_FORCE[quantity]

            def pushed(*states: Any) -> Any:
                force = self.force(dyn, states[0], states[1])
                return method(*states[:place], states[place] + force, *states[place + 1 :])

            return pushed
        if quantity == "passive":
            return lambda q, v: method(q, v) + self.force(dyn, q, v)
        if quantity in ("inverse_dynamics", "inverse_dynamics_with_wrenches"):
            return lambda q, v, *rest: method(q, v, *rest) - self.force(dyn, q, v)
        if quantity == "potential_energy":
            return lambda q: method(q) + self.energy(dyn, q)
        if quantity == "inverse_dynamics_derivatives":

            def of_inverse(q: Array, v: Array, a: Array) -> Array:
                by_q, by_v = self.slopes(dyn, q, v)
                return np.asarray(method(q, v, a) - np.stack([by_q, by_v, np.zeros_like(by_q)], axis=-3))

            return of_inverse
        if quantity == "forward_dynamics_derivatives":

            def of_forward(q: Array, v: Array, tau: Array) -> Array:
                own, (by_q, by_v) = method(q, v, tau + self.force(dyn, q, v)), self.slopes(dyn, q, v)
                inverse = own[..., 2, :, :]
                return np.asarray(own + np.stack([inverse @ by_q, inverse @ by_v, np.zeros_like(by_q)], axis=-3))

            return of_forward
        return method

    def _value(self, name: str, dyn: Any, *states: Array) -> Array:
        if name not in self._codes:
            with DERIVING:
                key = (self._model.form_digest, "elements", name)
                self._codes[name] = executable(key, lambda: self._derived(name), compile=compile_by_default())
        trailing: list[Array] = []
        if self._model.parameters:
            # The own derivation's may differ from sample to sample.
            own = hasattr(type(dyn), "parameter_values")
            values = dyn.parameter_values if own else np.array([*dyn.model.parameters.values()], dtype=np.float64)
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
