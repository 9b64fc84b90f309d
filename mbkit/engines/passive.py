"""Forces and energy of springs and dampers at joints and between them, for engines that leave them out."""

from __future__ import annotations

import numpy as np

from mbkit._check import Array
from mbkit.model import Model

__all__ = ["JointPassive"]


class JointPassive:
    """Springs and dampers at the joints, and joint couplings, in full coordinates of a given order.

    Parameters
    ----------
    model : Model
    q_order, v_order : integer arrays
        Entry i here is full coordinate ``q_order[i]`` of the description.

    Attributes
    ----------
    armature : (n, n) array or None
        What the couplings' rotors add to M; None where there are none.
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
        couplings = model.couplings
        rows = np.array([layout.coupling_row(c) for c in couplings]).reshape(len(couplings), layout.sizes[3])
        # The couplings' lengths are self._lengths q, the rates self._rates v.
        self._rates, self._lengths = rows[:, v_order], np.zeros((len(couplings), layout.sizes[2]))
        for name in {name for c in couplings for name in c.joints}:
            iq, iv = layout.full_q[name].start, layout.full_v[name].start
            self._lengths[:, q_place[iq]] = rows[:, iv]
        stiffness, rest, damping, armature = (
            np.array([getattr(c, field) for c in couplings])
            for field in ("stiffness", "rest_length", "damping", "armature")
        )
        self._coupled = (stiffness, rest, damping)
        self.armature = (self._rates.T * armature) @ self._rates if armature.any() else None

    def force(self, q: Array, v: Array) -> Array:
        """Return the generalized force."""
        out: Array = self._against * v
        if self._stiffness.size:
            out[self._spring_v] -= self._stiffness * (q[self._spring_q] - self._rest)
        if len(self._rates):
            stiffness, rest, damping = self._coupled
            out -= self._rates.T @ (stiffness * (self._lengths @ q - rest) + damping * (self._rates @ v))
        return out

    def energy(self, q: Array) -> float:
        """Return the energy stored in the springs."""
        stored = 0.5 * np.sum(self._stiffness * (q[self._spring_q] - self._rest) ** 2)
        stiffness, rest, _ = self._coupled
        return float(stored + 0.5 * np.sum(stiffness * (self._lengths @ q - rest) ** 2))
