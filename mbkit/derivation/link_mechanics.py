"""Mechanics of links: the forces that a motion takes, by d'Alembert's principle, and M by composite bodies.

A = (a, ω̇) is the acceleration of a link's origin and its angular acceleration, in the link's axes. From link to link ::

    A = X A_parent + S v̇ + c        wrench: J A + (ω × (ω × h), ω × I ω)

with the drift c of the joint, and the inertia J of mass, first moment h and inertia I about the origin. Gravity
accelerates the world by -g. By d'Alembert's principle in Lagrange's form the forces of the joints are Sᵀ of all the
wrenches that they carry (Lanczos 1970, The Variational Principles of Mechanics, ch. IV; Greenwood 2003, Advanced
Dynamics, ch. 4.1). The operations are those of the recursive Newton-Euler algorithm (Featherstone 2008, ch. 5).

For M: what joint k carries moves as one body when v_k alone is not zero. With its mass m, centre c and inertia I about
c, and the joint's column (s, w), the velocity of the centre is u = s + w × c, and by König's theorem ::

    M_kk = m u·u + w·I w        M_ik = S_i · (m u, I w + c × m u), carried to the joint i before it

(Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 6.2: the composite-rigid-body algorithm, there about origins).
About centres of mass every term of the diagonal is a square. Moments about distant origins would cancel where an arm
lies in its own axis, and lose the square of the distances' ratio.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import casadi as ca

from mbkit.derivation.kinematics import Vector, add, constant_times, constant_transposed_times
from mbkit.derivation.links import Inertia, Link, Links
from mbkit.derivation.model_values import is_zero, scalar
from mbkit.derivation.rotations import SYMMETRIC, Rotation, exact_congruence, to_child, to_parent
from mbkit.model import JointCoupling
from mbkit.model.joint_types import cross3


@dataclass
class Motion:
    """Rates of a link at v̇ = 0: angular velocity, and the products that centripetal accelerations take."""

    spin: Vector
    #: ω ω^T, six entries.
    products: Vector

    @classmethod
    def of(cls, w: Vector) -> Motion:
        """Return the motion with this angular velocity."""
        return cls(w, [w[i] * w[j] for i in range(3) for j in range(i, 3)])

    def centripetal(self, r: Vector) -> Vector:
        """Return ω × (ω × r)."""
        xx, xy, xz, yy, yz, zz = self.products
        return [
            xy * r[1] + xz * r[2] - (yy + zz) * r[0],
            xy * r[0] + yz * r[2] - (xx + zz) * r[1],
            xz * r[0] + yz * r[1] - (xx + yy) * r[2],
        ]

    def gyroscopic(self, I: Vector) -> Vector:
        """Return ω × I ω."""
        xx, xy, xz, yy, yz, zz = self.products
        return [
            (I[5] - I[3]) * yz + I[4] * (yy - zz) + I[2] * xy - I[1] * xz,
            (I[0] - I[5]) * xz + I[2] * (zz - xx) + I[1] * yz - I[4] * xy,
            (I[3] - I[0]) * xy + I[1] * (xx - yy) + I[4] * xz - I[2] * yz,
        ]


_STILL: Final = Motion.of([0.0] * 3)


class LinkMechanics:
    """Motions, drifts and forces of a tree's links.

    Parameters
    ----------
    links : Links
    moving : bool
        Whether velocities are those of the kinematics, or zero.
    falling : bool
        Whether gravity acts.

    Attributes
    ----------
    ground : list of 6 scalars
        Acceleration of the world.
    motions : list of Motion
    drifts, shifts : list of 6 scalars for each link
        What velocities add to A in the link's axes, and at its joint in the parent's.
    """

    def __init__(self, links: Links, *, moving: bool = True, falling: bool = True) -> None:
        self.tree, self.links, self.kin = links, links.links, links.kin
        g = links.kin.values.gravity if falling else [0.0] * 3
        self.ground = [*(negative(x) for x in g), 0.0, 0.0, 0.0]
        self.motions: list[Motion] = []
        self.drifts: list[Vector] = []
        self.shifts: list[Vector] = []
        for link in self.links:
            above = self.motions[link.parent] if link.parent >= 0 else _STILL
            rate, inner = (link.rate, link.drift) if moving else ([0.0] * 6, [0.0] * 6)
            spin, linear, angular = to_child(link.fixed, above.spin), rate[:3], rate[3:]
            carried = to_child(link.turn, spin)
            own, drift = add(carried, angular), inner[:3]
            if not vanishes(link.slide):
                drift = add(drift, to_child(link.turn, Motion.of(spin).centripetal(link.slide)))
            if not vanishes(linear):
                # 2 ω_J × u + ω_relative × u of the relative velocity u.
                drift = add(drift, cross3([2.0 * a + b for a, b in zip(carried, angular, strict=True)], linear))
            self.motions.append(Motion.of(own))
            self.drifts.append([*drift, *add(cross3(own, angular), inner[3:])])
            self.shifts.append([*above.centripetal(link.translation), 0.0, 0.0, 0.0])

    @cached_property
    def _biases(self) -> list[Vector]:
        return [
            [*motion.centripetal(link.inertia.moment), *motion.gyroscopic(link.inertia.inertia)]
            for link, motion in zip(self.links, self.motions, strict=True)
        ]

    def bias(self, index: int) -> Vector:
        """Return (ω × (ω × h), ω × I ω) of a link."""
        return self._biases[index]

    def carried(self, index: int, above: Vector, *, drifts: bool = True) -> Vector:
        """Return X A_parent + c, from A of the parent."""
        link = self.links[index]
        a = add(above[:3], cross3(above[3:], link.translation))
        a = add(a, self.shifts[index][:3]) if drifts else a
        a, turning = to_child(link.fixed, a), to_child(link.fixed, above[3:])
        x = [*to_child(link.turn, add(a, cross3(turning, link.slide))), *to_child(link.turn, turning)]
        return add(x, self.drifts[index]) if drifts else x

    def _accelerations(self, a: Sequence[Any] | None = None) -> list[Vector]:
        """Return A of each link, at v̇ = 0 by default."""
        A: list[Vector] = []
        for index, link in enumerate(self.links):
            x = self.carried(index, A[link.parent] if link.parent >= 0 else self.ground)
            if a is not None:
                for k, column in link.columns:
                    x = add(x, [c * a[k] for c in column])
            A.append(x)
        return A

    def drift_at(self, body: str, point: Vector, rotation: list[Vector]) -> tuple[Vector, Vector, Vector]:
        """Return the acceleration of a body's point at v̇ = 0, ω and ω̇, in axes with this rotation in the body."""
        index, R, p = self.tree.place(body)
        x, motion = (self._accelerations()[index], self.motions[index]) if index >= 0 else (self.ground, _STILL)
        r = add(constant_times(R, point), p)
        linear = add(add(x[:3], cross3(x[3:], r)), motion.centripetal(r))
        parts = (constant_transposed_times(R, y) for y in (linear, motion.spin, x[3:]))
        linear, spin, turning = (constant_transposed_times(rotation, y) for y in parts)
        return linear, spin, turning

    def forces(self, a: Sequence[Any] | None = None) -> list[Any]:
        """Return the forces of the joints, one scalar for each velocity, that a motion with accelerations `a` takes."""
        out: list[Any] = [0.0] * self.kin.model.nv
        wrenches = [
            add(rigid_times(link.inertia, x), bias)
            for link, x, bias in zip(self.links, self._accelerations(a), self._biases, strict=True)
        ]
        for index in reversed(range(len(self.links))):
            link, x = self.links[index], wrenches[index]
            for k, column in link.columns:
                out[k] = out[k] + dot6(column, x)
            if link.parent >= 0:
                x = rotated6(link.fixed, with_moment(rotated6(link.turn, x), link.slide))
                wrenches[link.parent] = add(wrenches[link.parent], with_moment(x, link.translation))
        if a is not None:
            for link in self.links:
                for (k, _), rotor in zip(link.columns, link.rotors, strict=True):
                    out[k] = out[k] + rotor * a[k]
            for coupling in self.kin.model.couplings:
                row, rotor = self.coupling(coupling)
                rate = sum((c * a[k] for k, c in row.items()), 0.0)
                for k, c in row.items():
                    out[k] = out[k] + rotor * c * rate
        return out

    def coupling(self, coupling: JointCoupling) -> tuple[dict[int, Any], Any]:
        """Return the factors of a coupling's rate, by velocity index, and its rotor."""
        rotor = self.kin.values.of(coupling).rotors
        if is_zero(rotor):
            return {}, rotor
        gradient = ca.jacobian(ca.SX(self.kin.coupled_rate(coupling)), self.kin.v)
        entries = {i: scalar(gradient[0, i]) for i in range(self.kin.model.nv)}
        known = {i: x for i, x in entries.items() if not x.is_zero()}
        return {i: float(x) if x.is_constant() else x for i, x in known.items()}, rotor


def rigid_times(inertia: Inertia, x: Vector) -> Vector:
    """Return J x of a rigid body."""
    m, h, a, w = inertia.mass, inertia.moment, x[:3], x[3:]
    return add([m * c for c in a], cross3(w, h)) + add(cross3(h, a), symmetric_times(inertia.inertia, w))


def negative(x: Any) -> Any:
    """Return -x, and 0 of 0."""
    return 0.0 - x if isinstance(x, float) else -x


def rotated6(R: Rotation, x: Vector) -> Vector:
    """Return both halves turned to the parent's axes."""
    return [*to_parent(R, x[:3]), *to_parent(R, x[3:])]


def with_moment(x: Vector, r: Vector) -> Vector:
    """Return a force and moment about the origin that is at -r."""
    return [*x[:3], *add(x[3:], cross3(r, x[:3]))]


def dot6(a: Vector, b: Vector) -> Any:
    """Return a · b of six entries."""
    return sum((x * y for x, y in zip(a, b, strict=True) if not is_zero(x)), 0.0)


def symmetric_times(A: Vector, x: Vector) -> Vector:
    """Return A x of a symmetric matrix."""
    return [sum((A[SYMMETRIC[i][j]] * x[j] for j in range(3)), 0.0) for i in range(3)]


def vanishes(x: Vector) -> bool:
    """Return whether all entries are zero for good."""
    return all(is_zero(c) for c in x)


# M by composite bodies


@dataclass
class CentralInertia:
    """Mass, centre of mass and inertia about it; the mass is a number."""

    mass: float = 0.0
    centre: Vector = field(default_factory=lambda: [0.0] * 3)
    inertia: Vector = field(default_factory=lambda: [0.0] * 6)

    @classmethod
    def of(cls, matter: Inertia) -> CentralInertia:
        """Return an inertia of numbers about an origin, about the centre of mass."""
        if not matter.mass:
            return cls(0.0, inertia=matter.rounded.inertia)
        centre = [h / matter.mass for h in matter.moment]
        steiner = Inertia(matter.mass).shifted(centre)
        inertia = [a - b for a, b in zip(matter.inertia, steiner.inertia, strict=True)]
        rounded = Inertia(matter.mass, centre, inertia).rounded
        return cls(rounded.mass, rounded.moment, rounded.inertia)

    def __add__(self, other: CentralInertia) -> CentralInertia:
        inertia = add(self.inertia, other.inertia)
        if not self.mass or not other.mass:
            heavy = self if self.mass else other
            return CentralInertia(heavy.mass, heavy.centre, inertia)
        mass = self.mass + other.mass
        apart = [b - a for a, b in zip(self.centre, other.centre, strict=True)]
        centre = add(self.centre, [other.mass / mass * x for x in apart])
        pull = [self.mass * (other.mass / mass) * x for x in apart]
        xx, yy, zz = (a * b for a, b in zip(pull, apart, strict=True))
        products = [negative(pull[i] * apart[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
        return CentralInertia(
            mass, centre, add(inertia, [yy + zz, products[0], products[1], xx + zz, products[2], xx + yy])
        )

    def in_parent(self, link: Link) -> CentralInertia:
        """Return the inertia in the frame of the link's parent."""
        centre = add(to_parent(link.turn, self.centre), link.slide)
        centre = add(to_parent(link.fixed, centre), link.translation)
        return CentralInertia(self.mass, centre, exact_congruence(link.rotation, self.inertia))

    def wrench(self, column: Vector) -> tuple[Vector, Vector]:
        """Return the momentum about the origin and the velocity of the centre, for motion along a column."""
        velocity = add(column[:3], cross3(column[3:], self.centre))
        p = [self.mass * x for x in velocity]
        return [*p, *add(symmetric_times(self.inertia, column[3:]), cross3(self.centre, p))], velocity


def mass_matrix(mechanics: LinkMechanics) -> Any:
    """Return M of links whose matter is all in numbers, as a sparse casadi.SX."""
    links, n = mechanics.links, mechanics.kin.model.nv
    entries: dict[tuple[int, int], Any] = {}

    def add_entry(i: int, k: int, x: Any) -> None:
        key = (i, k) if i <= k else (k, i)
        entries[key] = entries.get(key, 0.0) + x

    carried = [CentralInertia.of(link.exact) for link in links]
    for index in reversed(range(len(links))):
        link, matter = links[index], carried[index]
        wrenches: list[tuple[int, Vector]] = []
        for place, ((k, column), rotor) in enumerate(zip(link.columns, link.rotors, strict=True)):
            wrench, velocity = matter.wrench(column)
            turning = symmetric_times(matter.inertia, column[3:])
            square = [matter.mass * x * x for x in velocity] + [a * b for a, b in zip(column[3:], turning, strict=True)]
            add_entry(k, k, sum(square, 0.0) + rotor)
            for i, other in link.columns[:place]:
                add_entry(i, k, dot6(other, wrench) * (2.0 if i == k else 1.0))
            wrenches.append((k, wrench))
        while link.parent >= 0:
            wrenches = [(k, _carried(link, wrench)) for k, wrench in wrenches]
            link = links[link.parent]
            for k, wrench in wrenches:
                for i, column in link.columns:
                    add_entry(i, k, dot6(column, wrench) * (2.0 if i == k else 1.0))
        link = links[index]
        if link.parent >= 0:
            carried[link.parent] = carried[link.parent] + matter.in_parent(link)
    for coupling in mechanics.kin.model.couplings:
        row, rotor = mechanics.coupling(coupling)
        for i, a in row.items():
            for k, b in row.items():
                if i <= k:
                    add_entry(i, k, rotor * a * b)
    full = {place: x for (i, k), x in entries.items() if not is_zero(x) for place in ((i, k), (k, i))}
    rows, columns = ([place[i] for place in full] for i in (0, 1))
    return ca.SX.triplet(rows, columns, ca.vertcat(ca.SX(0, 1), *(ca.SX(x) for x in full.values())), n, n)


def _carried(link: Link, wrench: Vector) -> Vector:
    """Return a wrench about the origin of the link's parent, in its axes."""
    at_joint = rotated6(link.fixed, with_moment(rotated6(link.turn, wrench), link.slide))
    return with_moment(at_joint, link.translation)
