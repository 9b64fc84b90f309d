"""Where each joint's numbers stand in q and v, and how mimic joints follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mbkit._check import Array
from mbkit.model.parts import Joint, JointCoupling

__all__ = ["Layout"]


@dataclass(frozen=True)
class Layout:
    """Index ranges of the coordinates, full and reduced.

    The *full* coordinates hold every joint; the model's own q and v leave the
    mimic joints out, with q_full = G_q q + c and v_full = G v.

    Attributes
    ----------
    joints : tuple of Joint
        In the order of the coordinates.
    """

    joints: tuple[Joint, ...]

    @cached_property
    def full_q(self) -> dict[str, slice]:
        """Range of each joint in the full coordinates."""
        return self._ranges([j.type.nq for j in self.joints])

    @cached_property
    def full_v(self) -> dict[str, slice]:
        """Range of each joint in the full velocities."""
        return self._ranges([j.type.nv for j in self.joints])

    @cached_property
    def q(self) -> dict[str, slice]:
        """Range of each joint in q; a mimic joint's is empty."""
        return self._ranges([0 if j.mimic else j.type.nq for j in self.joints])

    @cached_property
    def v(self) -> dict[str, slice]:
        """Range of each joint in v; a mimic joint's is empty."""
        return self._ranges([0 if j.mimic else j.type.nv for j in self.joints])

    def _ranges(self, sizes: Sequence[int]) -> dict[str, slice]:
        ends = np.cumsum([0, *sizes])
        return {j.name: slice(int(a), int(b)) for j, a, b in zip(self.joints, ends, ends[1:], strict=False)}

    @cached_property
    def sizes(self) -> tuple[int, int, int, int]:
        """(nq, nv, full nq, full nv)."""
        free = [j for j in self.joints if not j.mimic]
        return (
            sum(j.type.nq for j in free),
            sum(j.type.nv for j in free),
            sum(j.type.nq for j in self.joints),
            sum(j.type.nv for j in self.joints),
        )

    @cached_property
    def reduced(self) -> bool:
        """Whether any joint mimics another."""
        return any(j.mimic for j in self.joints)

    @cached_property
    def offsets(self) -> Array:
        """The constant c of q_full = G_q q + c."""
        c = np.zeros(self.sizes[2])
        for j in self.joints:
            if j.mimic:
                c[self.full_q[j.name]] = j.mimic.offset
        c.setflags(write=False)
        return c

    @cached_property
    def G_q(self) -> Array:
        """Matrix of q_full = G_q q + c, shape (full nq, nq)."""
        return self._matrix(self.full_q, self.q, self.sizes[2], self.sizes[0])

    @cached_property
    def G(self) -> Array:
        """Matrix of v_full = G v, shape (full nv, nv)."""
        return self._matrix(self.full_v, self.v, self.sizes[3], self.sizes[1])

    def _matrix(self, rows: dict[str, slice], columns: dict[str, slice], n: int, k: int) -> Array:
        G = np.zeros((n, k))
        for j in self.joints:
            if j.mimic:
                G[rows[j.name], columns[j.mimic.joint]] = j.mimic.ratio
            else:
                part = rows[j.name]
                G[part, columns[j.name]] = np.eye(part.stop - part.start)
        G.setflags(write=False)
        return G

    def coupling_row(self, coupling: JointCoupling) -> Array:
        """Return the row c of a coupling's rate dl/dt = c v_full, shape (full nv,)."""
        row = np.zeros(self.sizes[3])
        for joint, factor in zip(coupling.joints, coupling.factors, strict=True):
            row[self.full_v[joint]] += factor
        return row

    def expand_q(self, q: Array) -> Array:
        """Return the full coordinates, mimic joints included."""
        return np.asarray(q @ self.G_q.T + self.offsets) if self.reduced else q

    def expand_v(self, v: Array) -> Array:
        """Return the full velocities (or accelerations), mimic joints included."""
        return np.asarray(v @ self.G.T) if self.reduced else v
