"""M by composite bodies, about their centres of mass.

What joint k carries moves as one body when v_k alone is not zero. With its mass m, centre c and inertia I about c, and
the joint's column (s, w), the velocity of the centre is u = s + w × c, and by König's theorem ::

    M_kk = m u·u + w·I w        M_ik = S_i · (m u, I w + c × m u), carried to the joint i before it

(Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 6.2: the composite-rigid-body algorithm, there about origins).
About centres of mass every term of the diagonal is a square. Moments about distant origins would cancel where an arm
lies in its own axis, and lose the square of the distances' ratio.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from mbkit.derivation.kinematics import Vector, add
from mbkit.derivation.link_mechanics import LinkMechanics, dot6, negative, rotated6, symmetric_times, with_moment
from mbkit.derivation.links import Inertia, Link
from mbkit.derivation.model_values import is_zero
from mbkit.derivation.rotations import exact_congruence, to_parent
from mbkit.model.joint_types import cross3


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
        """Return it in the frame of the link's parent."""
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
        row, armature = mechanics.coupling(coupling)
        for i, a in row.items():
            for k, b in row.items():
                if i <= k:
                    add_entry(i, k, armature * a * b)
    full = {place: x for (i, k), x in entries.items() if not is_zero(x) for place in ((i, k), (k, i))}
    rows, columns = ([place[i] for place in full] for i in (0, 1))
    return ca.SX.triplet(rows, columns, ca.vertcat(ca.SX(0, 1), *(ca.SX(x) for x in full.values())), n, n)


def _carried(link: Link, wrench: Vector) -> Vector:
    """Return a wrench about the origin of the link's parent, in its axes."""
    at_joint = rotated6(link.fixed, with_moment(rotated6(link.turn, wrench), link.slide))
    return with_moment(at_joint, link.translation)
