"""Springs and dampers at joints, on sums of coordinates and between points, for engines that leave them out.

A force beside an engine's own terms, added to them as a generalized one.

With the force F(q, v) an engine gives, of its own terms at τ + F::

    forward_dynamics(q, v, τ) = own(q, v, τ + F)        inverse_dynamics(q, v, a) = own(q, v, a) - F
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.model import Model, PointSpring
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


class JointPassive:
    """Springs and dampers at the joints, and joint couplings; entry i is full coordinate q_order[i].

    `rotors` is the couplings' part of M, None without one. `stiffness_matrix` and `damping_matrix` are the
    derivatives of the force by q and by v, with the other sign.
    """

    def __init__(self, model: Model, q_order: np.ndarray, v_order: np.ndarray) -> None:
        layout = model.layout
        lengths, rates = np.eye(layout.sizes[2]), np.eye(layout.sizes[3])
        damping = np.zeros(layout.sizes[3])
        # Each row is a length, linear in q, with its rate, stiffness, rest length, damping and rotor.
        rows: list[tuple[Any, ...]] = []
        for joint in model.joints:
            iq, iv = layout.full_q[joint.name], layout.full_v[joint.name]
            damping[iv] = joint.damping
            # A joint spring acts on one coordinate per velocity.
            rows += [
                (lengths[iq.start + k], rates[iv.start + k], joint.stiffness[k], joint.rest[k], 0.0, 0.0)
                for k in range(joint.type.nv)
                if joint.stiffness[k]
            ]
        for c in model.couplings:
            rate = layout.coupling_row(c)
            length = sum(
                rate[layout.full_v[x].start] * lengths[layout.full_q[x].start] for x in dict.fromkeys(c.joints)
            )
            rows.append((length, rate, c.stiffness, c.rest_length, c.damping, c.rotors))
        self.damping = damping[v_order]
        self._against = -self.damping
        self._lengths, rates = (
            np.array([row[i] for row in rows]).reshape(len(rows), order.size)[:, order]
            for i, order in enumerate((q_order, v_order))
        )
        self._stiffness, self._rest, dampers, inertias = (np.array([row[i] for row in rows]) for i in range(2, 6))
        self._pull = rates.T * self._stiffness
        self.stiffness_matrix = self._pull @ rates
        self.rotors = (rates.T * inertias) @ rates if inertias.any() else None
        self._coupled_damping = (rates.T * dampers) @ rates if dampers.any() else None
        self.damping_matrix = np.diag(self.damping) + (rates.T * dampers) @ rates

    def force(self, q: Array, v: Array) -> Array:
        """Return the generalized force."""
        out: Array = self._against * v
        if self._rest.size:
            out -= self._pull @ (self._lengths @ q - self._rest)
        if self._coupled_damping is not None:
            out -= self._coupled_damping @ v
        return out

    def energy(self, q: Array) -> float:
        """Return the energy stored in the springs."""
        return float(0.5 * np.sum(self._stiffness * (self._lengths @ q - self._rest) ** 2))


def pull(spring: PointSpring, gap: Array, rate: Array) -> Array:
    """Return the force on a spring's first end, from the vector to its second end and that vector's rate, (..., 3).

    NaN where the force needs a direction and there is none, which the caller finds.
    """
    length = np.linalg.norm(gap, axis=-1, keepdims=True)
    # k (l - l0) / l written so that l0 = 0 needs no direction at l = 0.
    out = spring.stiffness * gap
    with np.errstate(invalid="ignore", divide="ignore"):
        if spring.stiffness and spring.rest_length:
            out = out - spring.stiffness * spring.rest_length * (gap / length)
        if spring.damping:
            out = out + spring.damping * (gap / length) * np.sum(gap * rate, axis=-1, keepdims=True) / length
    return np.asarray(out)
