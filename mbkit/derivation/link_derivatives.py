"""Derivatives of the joints' forces from link to link: composite bodies, and what a moved joint changes for them.

Moving the coordinates along the unit k of the tangent displaces all that joint k carries, rigidly, along a column
S = (u, s) of its link C: the origin by u, the axes by s. In the link's own axes the motion below stays as it is. What
changes is the motion that it inherits. With ω_P, ω̇_P and a_P of the parent's matter at C's origin, of which gravity is
a part, and the relative velocity u_J of the origin::

    δω = ω_P × s
    δa = ω̇_P × u + ω_P × (ω_P × u) - s × a_P + 2 (ω_P × s) × u_J
    δα = ω̇_P × s + ω_P × (ω_P × s)                                  α stands for ω̇, δα = δω̇ + ω × δω

A unit of velocity k changes the inherited motion too, by δω = s, δα = (ω_P + ω) × s and δa = (ω_P + ω) × u + s × u_J.

A point at r from the origin, whose velocity relative to the origin is w, is accelerated by δa + δα × r + 2 δω × w more:
Coriolis's law, for the motion of the whole subtree. So its wrench changes by ::

    δf = m δa + δα × h + 2 δω × ḣ              δn = h × δa + I δα + B δω        B = İ - L×

with the subtree's mass m, first moment h = Σ m r, inertia I, their rates, and L = Σ m r × w. Velocities of the origin
do not enter (Galileo). Rates are gathered as the link's axes see them, h°, I°, L°, to which the link's own matter adds
nothing; then ḣ = h° + ω × h and B = I° - L°× + ω × (2 I - tr I).

The force of a joint below is its column times the change of the wrench that it carries. Written as (JS, b) on (δa, δα,
δω), it is brought up the branch. The force of a joint above is its column times δ(f, n), with the turn of the displaced
wrench itself, s × f and s × n + u × f, if the coordinates were moved. That is brought up the branch too, so that the
work is some constant for each pair of a joint and one that carries it.

Carpentier and Mansard 2018, Analytical Derivatives of Rigid Body Dynamics Algorithms, Robotics: Science and Systems;
Singh, Russell and Wensing 2022, Efficient Analytical Derivatives of Rigid-Body Dynamics Using Spatial Vector Algebra,
IEEE Robotics and Automation Letters 7: their B of spatial velocities has 36 numbers, of which 12 are left here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca

from mbkit.derivation.kinematics import Vector, add
from mbkit.derivation.link_mechanics import (
    LinkMechanics,
    Motion,
    dot6,
    rigid_times,
    rotated6,
    symmetric_times,
    vanishes,
    with_moment,
)
from mbkit.derivation.links import Inertia, Link, Links
from mbkit.derivation.model_values import is_zero
from mbkit.derivation.rotations import SYMMETRIC, Rotation, Rows, congruence, to_child, to_parent
from mbkit.model.joint_types import cross3

#: Entries of a matrix by velocity indices.
Entries = dict[tuple[int, int], Any]


def has_constant_columns(links: Links) -> bool:
    """Return whether each joint's columns stand still in its link, so that displaced links keep their own motion."""
    columns = [x for link in links.links for _, column in link.columns for x in column if isinstance(x, ca.SX)]
    return not ca.depends_on(ca.vertcat(ca.SX(0, 1), *columns), links.kin.q)


@dataclass
class Composite:
    """Inertia of a subtree about a link's origin, and its rates as the link's axes see them."""

    inertia: Inertia
    moment_rate: Vector = field(default_factory=lambda: [0.0] * 3)
    inertia_rate: Vector = field(default_factory=lambda: [0.0] * 6)
    #: L° = Σ m r × w.
    spin: Vector = field(default_factory=lambda: [0.0] * 3)

    def __add__(self, other: Composite) -> Composite:
        return Composite(
            self.inertia + other.inertia,
            add(self.moment_rate, other.moment_rate),
            add(self.inertia_rate, other.inertia_rate),
            add(self.spin, other.spin),
        )

    def turning(self, w: Vector) -> Composite:
        """Return the inertia with its rates seen from axes in which the link's axes turn at w."""
        I = self.inertia.inertia
        columns = [cross3(w, [I[SYMMETRIC[i][j]] for i in range(3)]) for j in range(3)]
        change = [columns[j][i] + columns[i][j] for i in range(3) for j in range(i, 3)]
        return Composite(
            self.inertia,
            add(self.moment_rate, cross3(w, self.inertia.moment)),
            add(self.inertia_rate, change),
            add(self.spin, symmetric_times(I, w)),
        )

    def rotated(self, R: Rotation) -> Composite:
        """Return the same in the axes of the parent."""
        return Composite(
            self.inertia.rotated(R),
            to_parent(R, self.moment_rate),
            congruence(R, self.inertia_rate),
            to_parent(R, self.spin),
        )

    def shifted(self, r: Vector, velocity: Vector) -> Composite:
        """Return the inertia about an origin at -r from its own, relative to which its own moves at `velocity`."""
        if vanishes(r) and vanishes(velocity):
            return self
        moved = self.inertia.shifted(r)
        h, b = self.moment_rate, moved.moment
        # The rate of the second moments is h° rᵀ + b velocityᵀ, and its transpose.
        half = [[h[i] * r[j] + b[i] * velocity[j] for j in range(3)] for i in range(3)]
        trace = 2.0 * (half[0][0] + half[1][1] + half[2][2])
        rate = [(trace if i == j else 0.0) - (half[i][j] + half[j][i]) for i in range(3) for j in range(i, 3)]
        return Composite(
            moved,
            add(h, [self.inertia.mass * x for x in velocity]),
            add(self.inertia_rate, rate),
            add(self.spin, add(cross3(r, h), cross3(b, velocity))),
        )


class Response:
    """Change of the wrench of a subtree with the motion that it inherits."""

    def __init__(self, composite: Composite, w: Vector) -> None:
        self.inertia = composite.inertia
        I, rate, L = self.inertia.inertia, composite.inertia_rate, composite.spin
        self.momentum = add(cross3(w, self.inertia.moment), composite.moment_rate)
        # ω × (2 I - tr I), column by column.
        trace = I[0] + I[3] + I[5]
        columns = [
            cross3(w, [2.0 * I[SYMMETRIC[i][j]] - (trace if i == j else 0.0) for i in range(3)]) for j in range(3)
        ]
        skew = [[0.0, -L[2], L[1]], [L[2], 0.0, -L[0]], [-L[1], L[0], 0.0]]
        self.B: Rows = [[columns[j][i] + (rate[SYMMETRIC[i][j]] - skew[i][j]) for j in range(3)] for i in range(3)]

    def times(self, change: Vector, spin: Vector) -> Vector:
        """Return δ(f, n) of (δa, δα) and δω."""
        f = cross3([2.0 * x for x in spin], self.momentum)
        n = [sum((x * y for x, y in zip(row, spin, strict=True)), 0.0) for row in self.B]
        return add(rigid_times(self.inertia, change), f + n)

    def transposed(self, column: Vector) -> Vector:
        """Return b, the column's force for each δω."""
        n = [sum((row[j] * x for row, x in zip(self.B, column[3:], strict=True)), 0.0) for j in range(3)]
        return add(cross3(self.momentum, [2.0 * x for x in column[:3]]), n)


@dataclass
class Row:
    """A joint's force as a function of the motion that a link above it, or its own, inherits."""

    velocity: int
    #: JS and b.
    inertial: Vector
    turning: Vector
    #: Change of the wrench with the joint's velocity.
    wrench: Vector


class LinkDerivatives:
    """Derivatives of M a + C v + g, with respect to q on the tangent.

    Parameters
    ----------
    mechanics : LinkMechanics
        Of links that have constant columns.

    Attributes
    ----------
    by_v : dict of (int, int) to scalar
        The entries of ∂/∂v that are not zero for good.
    """

    def __init__(self, mechanics: LinkMechanics) -> None:
        self.mechanics, self.links = mechanics, mechanics.links
        self.by_v: Entries = {}
        still = [0.0] * 3
        above = [mechanics.motions[link.parent].spin if link.parent >= 0 else still for link in self.links]
        #: Angular velocity of the parent, in the axes of the parent, of J and of C.
        self._inherited = [
            (w, to_child(link.fixed, w), to_child(link.rotation, w)) for link, w in zip(self.links, above, strict=True)
        ]
        #: Rows of all joints that each link carries.
        self._rows: list[list[Row]] = [[] for _ in self.links]
        self._fold()

    @cached_property
    def _composites(self) -> list[Composite]:
        out = [Composite(link.inertia) for link in self.links]
        for index in reversed(range(len(self.links))):
            link = self.links[index]
            if link.parent >= 0:
                seen = out[index].turning(link.rate[3:]).rotated(link.turn)
                seen = seen.shifted(link.slide, to_parent(link.turn, link.rate[:3])).rotated(link.fixed)
                out[link.parent] = out[link.parent] + seen.shifted(link.translation, [0.0] * 3)
        return out

    @cached_property
    def _responses(self) -> list[Response]:
        return [Response(x, m.spin) for x, m in zip(self._composites, self.mechanics.motions, strict=True)]

    def _fold(self) -> None:
        """Gather ∂/∂v from the leaves to the root."""
        for index in reversed(range(len(self.links))):
            link, response = self.links[index], self._responses[index]
            w, below = self._inherited[index][2], self._rows[index]
            slip, spin = link.rate[:3], link.rate[3:]
            own: list[Row] = []
            changes: list[Vector] = []
            for k, column in link.columns:
                u, s = column[:3], column[3:]
                # (ω_P + ω) × of both, with ω = ω_P + ω_J.
                relative = [*add(cross3(spin, u), cross3(s, slip)), *cross3(spin, s)]
                change = add([2.0 * x for x in (*cross3(w, u), *cross3(w, s))], relative)
                wrench = response.times(change, s) if link.parent >= 0 else []
                own.append(Row(k, rigid_times(response.inertia, column), response.transposed(column), wrench))
                changes.append(change)
            for (k, column), change in zip(link.columns, changes, strict=True):
                for row in (*own, *below):
                    force = dot6(change, row.inertial) + _dot(column[3:], row.turning)
                    _raise(self.by_v, (row.velocity, k), force)
                for row in below:
                    _raise(self.by_v, (k, row.velocity), dot6(column, row.wrench))
            self._rows[index] = [*own, *below]
            if link.parent >= 0:
                self._rows[link.parent] += self._raised(index)

    def _raised(self, index: int) -> list[Row]:
        """Return a link's rows for the motion that its parent inherits."""
        link, (above, within, _) = self.links[index], self._inherited[index]
        slip = add(cross3(within, link.slide), to_parent(link.turn, link.rate[:3]))
        slip, swing = ([2.0 * x for x in w] for w in (slip, cross3(above, link.translation)))
        out = []
        for row in self._rows[index]:
            x, b = rotated6(link.turn, row.inertial), to_parent(link.turn, row.turning)
            b = to_parent(link.fixed, add(b, cross3(slip, x[:3])))
            x = rotated6(link.fixed, with_moment(x, link.slide))
            b = add(b, cross3(swing, x[:3]))
            out.append(Row(row.velocity, with_moment(x, link.translation), b, _carried_up(link, row.wrench)))
        return out

    def by_q(self, a: Sequence[Any]) -> Entries:
        """Return ∂/∂q at accelerations `a`, one scalar for each velocity."""
        out: Entries = {}
        inherited, wrenches = self._accelerations(a)
        #: Change of the wrench that each link carries, by the coordinates below.
        turned: list[list[tuple[int, Vector]]] = [[] for _ in self.links]
        for index in reversed(range(len(self.links))):
            link, response, wrench = self.links[index], self._responses[index], wrenches[index]
            w, slip = self._inherited[index][2], link.rate[:3]
            pull, turning = inherited[index][:3], inherited[index][3:]
            motion, own = Motion.of(w), []
            for k, column in link.columns:
                u, s = column[:3], column[3:]
                spin = cross3(w, s)
                linear = add(cross3(turning, u), add(motion.centripetal(u), cross3(pull, s)))
                linear = add(linear, cross3([2.0 * x for x in spin], slip))
                change = [*linear, *add(cross3(turning, s), motion.centripetal(s))]
                for row in self._rows[index]:
                    _raise(out, (row.velocity, k), dot6(change, row.inertial) + _dot(spin, row.turning))
                for i, x in turned[index]:
                    _raise(out, (k, i), dot6(column, x))
                if link.parent >= 0:
                    turn = [*cross3(s, wrench[:3]), *add(cross3(s, wrench[3:]), cross3(u, wrench[:3]))]
                    own.append((k, add(response.times(change, spin), turn)))
            if link.parent >= 0:
                turned[link.parent] += [(k, _carried_up(link, x)) for k, x in (*own, *turned[index])]
                wrenches[link.parent] = add(wrenches[link.parent], _carried_up(link, wrench))
        return out

    def _accelerations(self, a: Sequence[Any]) -> tuple[list[Vector], list[Vector]]:
        """Return of each link the acceleration of its parent's matter at its origin, and its own wrench."""
        A: list[Vector] = []
        inherited, wrenches = [], []
        for index, link in enumerate(self.links):
            above = A[link.parent] if link.parent >= 0 else self.mechanics.ground
            linear = add(above[:3], cross3(above[3:], link.translation))
            linear = to_child(link.fixed, add(linear, self.mechanics.shifts[index][:3]))
            angular = to_child(link.fixed, above[3:])
            if not vanishes(link.slide):
                linear = add(linear, cross3(angular, link.slide))
                linear = add(linear, Motion.of(self._inherited[index][1]).centripetal(link.slide))
            inherited.append([*to_child(link.turn, linear), *to_child(link.turn, angular)])
            x = self.mechanics.carried(index, above)
            for k, column in link.columns:
                x = add(x, [c * a[k] for c in column])
            A.append(x)
            wrenches.append(add(rigid_times(link.inertia, x), self.mechanics.bias(index)))
        return inherited, wrenches


def _carried_up(link: Link, x: Vector) -> Vector:
    """Return a wrench about the origin of the link's parent, in its axes."""
    x = with_moment(rotated6(link.turn, x), link.slide)
    return with_moment(rotated6(link.fixed, x), link.translation)


def _dot(a: Vector, b: Vector) -> Any:
    return sum((x * y for x, y in zip(a, b, strict=True)), 0.0)


def _raise(entries: Entries, key: tuple[int, int], x: Any) -> None:
    if not is_zero(x):
        entries[key] = entries.get(key, 0.0) + x
