"""Forces and energy of joint springs and dampers, for engines that leave them out."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from mbkit._check import Array
from mbkit.model import Model

__all__ = ["JointPassive"]


class JointPassive:
    """Springs and dampers at the joints, in full coordinates.

    A joint spring acts on one coordinate per velocity, so `spring_q` picks the
    coordinate that belongs to each sprung velocity.
    """

    def __init__(self, model: Model) -> None:
        layout = model.layout
        n = layout.sizes[3]
        self.damping = np.zeros(n)
        springs: list[tuple[int, int, float, float]] = []
        for joint in model.joints:
            iq, iv = layout.full_q[joint.name], layout.full_v[joint.name]
            self.damping[iv] = joint.damping
            springs += [
                (iq.start + k, iv.start + k, float(joint.stiffness[k]), float(joint.rest[k]))
                for k in range(joint.type.nv)
                if joint.stiffness[k]
            ]
        self.spring_q = np.array([s[0] for s in springs], dtype=int)
        self.spring_v = np.array([s[1] for s in springs], dtype=int)
        self.stiffness = np.array([s[2] for s in springs])
        self.rest = np.array([s[3] for s in springs])

    @cached_property
    def any_damping(self) -> bool:
        """Whether any joint is damped."""
        return bool(self.damping.any())

    def force(self, q: Array, v: Array) -> Array:
        """Return the generalized force, full coordinates."""
        out = -self.damping * v
        if self.stiffness.size:
            out[..., self.spring_v] -= self.stiffness * (q[..., self.spring_q] - self.rest)
        return np.asarray(out)

    def energy(self, q: Array) -> Array:
        """Return the energy stored in the springs."""
        return np.asarray(0.5 * np.sum(self.stiffness * (q[..., self.spring_q] - self.rest) ** 2, axis=-1))
