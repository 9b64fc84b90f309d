"""A force beside an engine's own terms, added to them as a generalized one.

With the force F(q, v) an engine gives, of its own terms at τ + F::

    forward_dynamics(q, v, τ) = own(q, v, τ + F)        inverse_dynamics(q, v, a) = own(q, v, a) - F
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.model.quantities import QUANTITIES

#: Loads of mechanisms.
LOADS: Final = tuple(name for name, x in QUANTITIES.items() if x.group == "load" and not x.listed)
#: Place of the force among the arguments, by quantity.
_PLACE: Final = {
    name: x.arguments.index("tau")
    for name, x in QUANTITIES.items()
    if "tau" in x.arguments and x.group in ("equation", "wrenches", "row", "load")
}
#: Quantities of the motion under a force.
UNDER_FORCE: Final = tuple(name for name in _PLACE if name not in LOADS)


class AddedForce:
    """A generalized force of the state, for the quantities of an engine."""

    def force(self, dyn: Any, q: Array, v: Array) -> Array:
        """Return F(q, v) at the time and parameters of the dynamics, (nv,) or (N, nv)."""
        raise NotImplementedError

    def slopes(self, dyn: Any, q: Array, v: Array) -> tuple[Array, Array]:
        """Return ∂F/∂q along the manifold and ∂F/∂v, each (nv, nv) or (N, nv, nv)."""
        raise NotImplementedError

    def beside(self, quantity: str, method: Callable[..., Any], dyn: Any) -> Callable[..., Any]:
        """Return an engine's method for a quantity with the force added, or itself where it does not enter."""
        if quantity in _PLACE:
            place = _PLACE[quantity]

            def pushed(*states: Any) -> Any:
                return method(*states[:place], states[place] + self.force(dyn, *states[:2]), *states[place + 1 :])

            return pushed
        if quantity == "passive":
            return lambda q, v: method(q, v) + self.force(dyn, q, v)
        if quantity in ("inverse_dynamics", "inverse_dynamics_with_wrenches"):
            return lambda q, v, *rest: method(q, v, *rest) - self.force(dyn, q, v)
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
