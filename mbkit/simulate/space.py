"""The space that the fixed-step methods move in: vectors, and rotations by their exponential."""

from __future__ import annotations

from typing import Any

import numpy as np

from mbkit._check import Array
from mbkit.model import Model
from mbkit.simulate import rotation
from mbkit.simulate.free_joint import acceleration_in_parent, velocity_in_body, velocity_in_parent

__all__ = ["Space"]


def _components(x: Array, part: slice) -> list[Any]:
    return x[part].tolist() if x.ndim == 1 else list(x.T[part])


class Space:
    """Configurations and velocities of one model as the integrators hold them.

    A configuration is mbkit's q. A velocity `w` is mbkit's v with the linear part
    of each free joint in the axes of the joint's fixed frame. All methods take
    one state or a batch. On a model without quaternions they cost one addition.

    Parameters
    ----------
    model : Model
    """

    def __init__(self, model: Model) -> None:
        self.flat = not model.quaternions
        self.nv = model.nv
        self._turns: list[tuple[slice, slice]] = []
        self._free: list[tuple[slice, slice, slice]] = []
        self._sums: list[tuple[slice, slice]] = []
        for joint in model.independent_joints:
            q, v = model.layout.q[joint.name], model.layout.v[joint.name]
            start = joint.type.quaternion
            plain = joint.type.nq if start is None else start
            self._add(slice(q.start, q.start + plain), slice(v.start, v.start + plain))
            if start is not None:
                turn = slice(q.start + start, q.stop), slice(v.start + start, v.stop)
                self._turns.append(turn)
                if start:
                    self._free.append((turn[0], slice(v.start, v.start + start), turn[1]))

    def _add(self, q: slice, v: slice) -> None:
        if q.start == q.stop:
            return
        last = self._sums[-1] if self._sums else None
        if last and last[0].stop == q.start and last[1].stop == v.start:
            self._sums[-1] = slice(last[0].start, q.stop), slice(last[1].start, v.stop)
        else:
            self._sums.append((q, v))

    def move(self, q: Array, u: Array) -> Array:
        """Return q moved by u: positions add, rotations turn by exp(u) in body axes."""
        if self.flat:
            return np.asarray(q + u)
        out = np.empty(q.shape)
        for a, b in self._sums:
            out[..., a] = q[..., a] + u[..., b]
        for a, b in self._turns:
            turned = rotation.product(_components(q, a), rotation.exponential(_components(u, b)))
            out.T[a] = rotation.unit(turned)
        return out

    def rate(self, u: Array, w: Array) -> Array:
        """Return u̇ where q moved by u(t) has the velocity w: dexp⁻¹ on rotations."""
        if self.flat:
            return w
        out = w.copy()
        for _, b in self._turns:
            out.T[b] = rotation.dexp_inverse(_components(u, b), _components(w, b))
        return out

    def enter(self, q: Array, v: Array) -> Array:
        """Return w of mbkit's v."""
        return self._changed(q, v, velocity_in_parent)

    def leave(self, q: Array, w: Array) -> Array:
        """Return mbkit's v of w."""
        return self._changed(q, w, velocity_in_body)

    def _changed(self, q: Array, v: Array, change: Any) -> Array:
        if not self._free:
            return v
        out = v.copy()
        for turn, linear, _ in self._free:
            out.T[linear] = change(_components(q, turn), _components(v, linear))
        return out

    def acceleration(self, q: Array, v: Array, a: Array) -> Array:
        """Return ẇ of mbkit's v and v̇."""
        if not self._free:
            return a
        out = a.copy()
        for turn, linear, angular in self._free:
            out.T[linear] = acceleration_in_parent(
                _components(q, turn), _components(v, linear), _components(v, angular), _components(a, linear)
            )
        return out
