"""Forces and energy of joint springs and dampers, for engines that leave them out."""

from __future__ import annotations

import numpy as np

from mbkit._check import Array
from mbkit.model import Model

__all__ = ["JointPassive"]


class JointPassive:
    """Springs and dampers at the joints, in full coordinates of a given order.

    Parameters
    ----------
    model : Model
    q_order, v_order : integer arrays
        Entry i here is full coordinate ``q_order[i]`` of the description.
    """

    def __init__(self, model: Model, q_order: np.ndarray, v_order: np.ndarray) -> None:
        layout = model.layout
        q_place, v_place = np.argsort(q_order), np.argsort(v_order)
        self.damping = np.zeros(layout.sizes[3])
        springs: list[tuple[int, int, float, float]] = []
        for joint in model.joints:
            iq, iv = layout.full_q[joint.name], layout.full_v[joint.name]
            self.damping[v_place[iv]] = joint.damping
            # A joint spring acts on one coordinate per velocity.
            springs += [
                (q_place[iq.start + k], v_place[iv.start + k], float(joint.stiffness[k]), float(joint.rest[k]))
                for k in range(joint.type.nv)
                if joint.stiffness[k]
            ]
        self._against = -self.damping
        self._spring_q = np.array([s[0] for s in springs], dtype=int)
        self._spring_v = np.array([s[1] for s in springs], dtype=int)
        self._stiffness = np.array([s[2] for s in springs])
        self._rest = np.array([s[3] for s in springs])

    def force(self, q: Array, v: Array) -> Array:
        """Return the generalized force."""
        out: Array = self._against * v
        if self._stiffness.size:
            out[self._spring_v] -= self._stiffness * (q[self._spring_q] - self._rest)
        return out

    def energy(self, q: Array) -> float:
        """Return the energy stored in the springs."""
        return float(0.5 * np.sum(self._stiffness * (q[self._spring_q] - self._rest) ** 2))
