"""Points that do not slip: blades, discs and spheres on a plane, as geometry on any arithmetic.

A disc of radius R about the unit axis a touches the plane with unit normal n in its lowest point. With
s = |n - (n·a) a| the way there from its centre is -R (n - (n·a) a) / s, and its centre stands R s above the plane at
contact. It rolls along t = a x n / s and slips sideways along n x t. Where the disc lies flat, s = 0, and it touches in
no single point. The contact point of a sphere is R below its centre.

The velocity of the material point there, as body b sees it, has no component along any of these directions. That along
n is the rate of the height, so the row of the height holds it; those along the plane have no integral
(Neimark and Fufaev 1972, Dynamics of Nonholonomic Systems, ch. I and III).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np

from mbkit._check import Array
from mbkit._reproducible import length, product
from mbkit.model.joint_types import cross3, dot3

Vector = list[Any]
RollingKind = Literal["disc", "sphere"]
ROLLING_KINDS: Final[tuple[RollingKind, ...]] = get_args(RollingKind)
#: Kind of a part without slip -> names of its rows that hold positions, and of those that hold velocities alone.
NO_SLIP_ROWS: Final[dict[str, tuple[tuple[str, ...], tuple[str, ...]]]] = {
    "blade": ((), ("velocity",)),
    "disc": (("height",), ("forward velocity", "sideways velocity")),
    "sphere": (("height",), ("velocity along x", "velocity along y")),
}

#: Kinds whose contact ceases to be a point in some poses: a disc that lies flat.
LIES_FLAT: Final = frozenset({"disc"})


def discs_of(model: Any) -> list[Any]:
    """Return the parts of a description that can lie flat."""
    return [x for x in model.constraints if getattr(x, "kind", "") in LIES_FLAT]


@dataclass(frozen=True)
class Contact:
    """The contact point of a part without slip, in the axes in which its directions were given.

    Attributes
    ----------
    offset : list of 3
        From the centre, or the blade's point, to the contact point.
    reach : scalar
        Height of the centre above the plane at contact.
    up, along : lists of vectors
        Directions of the rows that hold positions, and of those that hold velocities.
    """

    offset: Vector
    reach: Any
    up: list[Vector]
    along: list[Vector]

    def rows(self, gap: Vector, velocity: Vector, speed: Any) -> tuple[list[Any], list[Any]]:
        """Return the rows that hold positions and those that hold velocities.

        They come from the way of the centre, from a point of the plane, and from the velocity of the material point at
        the contact, both as body b sees them.
        """
        return [dot3(gap, n) - self.reach for n in self.up], [dot3(velocity, t) - speed for t in self.along]


def _blade(a: Vector, b: Vector, tangents: list[Vector], radius: Any, length: Callable[[Any], Any]) -> Contact:  # noqa: ARG001
    # One of the two directions is zero.
    return Contact([0.0] * 3, 0.0, [], [[x + y for x, y in zip(a, b, strict=True)]])


def _disc(a: Vector, n: Vector, tangents: list[Vector], radius: Any, length: Callable[[Any], Any]) -> Contact:  # noqa: ARG001
    side = cross3(a, n)
    # n - (n·a) a, of which nothing cancels where the disc lies nearly flat.
    lowest = cross3(side, a)
    s = length(dot3(side, side))
    forward = [x / s for x in side]
    return Contact([-radius * x / s for x in lowest], radius * s, [n], [forward, cross3(n, forward)])


def _sphere(a: Vector, n: Vector, tangents: list[Vector], radius: Any, length: Callable[[Any], Any]) -> Contact:  # noqa: ARG001
    return Contact([-radius * x for x in n], radius, [n], tangents)


_CONTACTS: Final = {"blade": _blade, "disc": _disc, "sphere": _sphere}


def contact(kind: str, a: Vector, b: Vector, tangents: list[Vector], radius: Any, length: Any) -> Contact:
    """Return the contact of a part of a kind, from its directions on both bodies and two along the plane.

    `length` takes a squared length.
    """
    return _CONTACTS[kind](a, b, tangents, radius, length)


def tangents(normal: Array) -> Array:
    """Return two unit vectors along the plane of a unit normal, (2, 3): x and y where that is z.

    The first is as near as can be to the axis that is farthest from the normal.
    """
    sizes = np.abs(normal)
    # The first of components that are equal but for rounding.
    first = np.eye(3)[np.argmax(sizes <= sizes.min() + 1e-9)]
    first = first - product(first[None], normal) * normal
    first = first / length(first)
    return np.array([first, np.cross(normal, first)])
