"""The space that fixed-step methods move in: vectors, and rotations by their exponential."""

from __future__ import annotations

from typing import Any

from mbkit.model import quaternions as rotation
from mbkit.model.model import Model


class Space:
    """Configurations q and velocities w of one model in the integrators, one state or a batch.

    w is mbkit's v with the linear part of each free joint in the axes of the joint's fixed frame, and q̇ where the
    model has a `velocity_map`. A subclass for other arithmetic than arrays overrides the methods at the end.
    """

    def __init__(self, model: Model) -> None:
        self._rates, self._adds = model.velocity_map, not model.quaternions
        #: Whether positions add and w is v.
        self.flat = self._adds and self._rates is None
        self.nv = model.nv
        self._turns: list[tuple[slice, slice]] = []
        self._free: list[tuple[slice, slice, slice]] = []
        self._sums: list[tuple[slice, slice]] = []
        for joint in model.independent_joints:
            q, v = model.layout.q[joint.name], model.layout.v[joint.name]
            start = joint.type.quaternion
            plain = joint.type.nq if start is None else start
            last = self._sums[-1] if self._sums else None
            if last and last[0].stop == q.start and last[1].stop == v.start and plain:
                self._sums[-1] = slice(last[0].start, q.start + plain), slice(last[1].start, v.start + plain)
            elif plain:
                self._sums.append((slice(q.start, q.start + plain), slice(v.start, v.start + plain)))
            if start is not None:
                turn = slice(q.start + start, q.stop), slice(v.start + start, v.stop)
                self._turns.append(turn)
                if joint.type.floating:
                    self._free.append((turn[0], slice(v.start, v.start + start), turn[1]))

    def retract(self, q: Any, u: Any) -> Any:
        """Return q moved by u: positions add, rotations turn by exp(u) in body axes."""
        if self._adds:
            return q + u
        m, out = self.arithmetic(q), self.copied(q)
        for a, b in self._sums:
            self.put(out, a, self.part(q, a) + self.part(u, b))
        for a, b in self._turns:
            turned = rotation.product(self.components(q, a), rotation.exponential(m, self.components(u, b)))
            self.put(out, a, rotation.unit(m, turned))
        return out

    def rate(self, u: Any, w: Any) -> Any:
        """Return u̇ where q moved by u(t) has the velocity w: dexp⁻¹ on rotations."""
        if self._adds:
            return w
        m, out = self.arithmetic(w), self.copied(w)
        for _, b in self._turns:
            self.put(out, b, rotation.dexp_inverse(m, self.components(u, b), self.components(w, b)))
        return out

    def magnitude(self, q: Any, u: Any) -> Any:
        """Return the size of q along each component of a u: |q| where positions add, 1 for a rotation."""
        if self._adds:
            return abs(q)
        out = 0 * u + 1
        for a, b in self._sums:
            self.put(out, b, abs(self.part(q, a)))
        return out

    def to_integrator_velocity(self, q: Any, v: Any) -> Any:
        """Return w of mbkit's v."""
        return self._changed(q, v, rotation.rotate) if self._rates is None else self._rates.to_integrator_velocity(q, v)

    def to_body_velocity(self, q: Any, w: Any) -> Any:
        """Return mbkit's v of w."""
        return self._changed(q, w, rotation.rotate_back) if self._rates is None else self._rates.to_body_velocity(q, w)

    def to_integrator_force(self, q: Any, f: Any) -> Any:
        """Return the momentum or force on w of one on mbkit's v; on free joints they turn as velocities do."""
        return self.to_integrator_velocity(q, f) if self._rates is None else self._rates.to_integrator_force(q, f)

    def to_body_force(self, q: Any, f: Any) -> Any:
        """Return the momentum or force on mbkit's v of one on w."""
        return self.to_body_velocity(q, f) if self._rates is None else self._rates.to_body_force(q, f)

    def _changed(self, q: Any, v: Any, change: Any) -> Any:
        if not self._free:
            return v
        out = self.copied(v)
        for turn, linear, _ in self._free:
            self.put(out, linear, change(self.components(q, turn), self.components(v, linear)))
        return out

    def acceleration(self, q: Any, v: Any, a: Any) -> Any:
        """Return ẇ of mbkit's v and v̇."""
        if self._rates is not None:
            return self._rates.acceleration(q, v, a)
        if not self._free:
            return a
        out = self.copied(a)
        for turn, linear, angular in self._free:
            # a_J = R (a + w × v)
            turned = rotation.cross(self.components(v, angular), self.components(v, linear))
            rate = [x + y for x, y in zip(self.components(a, linear), turned, strict=True)]
            self.put(out, linear, rotation.rotate(self.components(q, turn), rate))
        return out

    @staticmethod
    def arithmetic(x: Any) -> rotation.Arithmetic:
        """Return the functions for components of x."""
        return rotation.FLOATS if x.ndim == 1 else rotation.ARRAYS

    @staticmethod
    def part(x: Any, part: slice) -> Any:
        """Return a part of x, its components along the first axis."""
        return x.T[part]

    @staticmethod
    def components(x: Any, part: slice) -> list[Any]:
        """Return the components of a part of x."""
        return x[part].tolist() if x.ndim == 1 else list(x.T[part])

    @staticmethod
    def put(x: Any, part: slice, components: Any) -> None:
        """Write components into a part of x."""
        x.T[part] = components

    @staticmethod
    def copied(x: Any) -> Any:
        """Return a copy to write into."""
        return x.copy()
