"""Springs and dampers at joints, on sums of coordinates and between points, for engines that leave them out."""

from __future__ import annotations

from typing import Any

import numpy as np

from mbkit._check import Array
from mbkit.model import Model, PointSpring


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
