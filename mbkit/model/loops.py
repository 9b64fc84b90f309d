"""Loops: what their ends hold together, as rows that are zero where a loop is closed, on any arithmetic.

Points that do not slip: blades, discs and spheres on a plane, as geometry on any arithmetic.

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


@dataclass(frozen=True)
class LoopEnds:
    """The two ends of a loop in the axes of the body that carries both: gap a - b, and each frame's three axes.

    Numbers may be of any arithmetic.
    """

    gap: Vector
    a: list[Vector]
    b: list[Vector]
    length: Any

    def across(self) -> list[Any]:
        """Return the rows that keep frame b's z-axis along frame a's."""
        return [dot3(self.a[0], self.b[2]), dot3(self.a[1], self.b[2])]

    def sideways(self) -> list[Any]:
        """Return the gap across frame a's z-axis."""
        return [dot3(self.a[0], self.gap), dot3(self.a[1], self.gap)]

    def turn(self) -> list[Any]:
        """Return ½ Σ b_k x a_k: the axis of the turn from frame b to frame a, times the sine of its angle."""
        x, y, z = (cross3(b, a) for a, b in zip(self.a, self.b, strict=True))
        return [0.5 * (x[i] + y[i] + z[i]) for i in range(3)]

    def way(self, kind: str) -> Any:
        """Return a number that is negative where the frames of a closed loop of this kind point opposite ways."""
        if kind in HINGED:
            return dot3(self.a[2], self.b[2])
        if kind in WELDED:
            return sum((dot3(a, b) for a, b in zip(self.a, self.b, strict=True)), 0.0)
        return 0.0

    def excess(self) -> Any:
        """Return the square of the distance less that of the rod's length."""
        return dot3(self.gap, self.gap) - self.length * self.length

    def stretch(self) -> list[Any]:
        """Return the excess of the distance over the rod's length, to first order."""
        return [self.excess() / (2.0 * self.length)]


_GAP: Final = ("x", "y", "z")
_TURN: Final = ("about x", "about y", "about z")
_ACROSS: Final = ("axis along x", "axis along y")
_SIDEWAYS: Final = ("across x", "across y")
_CROSSING: Final = ("axes",)
#: Names of the rows that hold directions; the others hold places.
TURNING: Final = (*_TURN, *_ACROSS, *_CROSSING)
#: Kind of a loop -> names of its rows, and the rows. They stay where the loop's own joint could not move.
LOOP_ROWS: Final[dict[str, tuple[tuple[str, ...], Callable[[LoopEnds], list[Any]]]]] = {
    "point": (_GAP, lambda e: list(e.gap)),
    "frame": ((*_GAP, *_TURN), lambda e: [*e.gap, *e.turn()]),
    "revolute": ((*_GAP, *_ACROSS), lambda e: [*e.gap, *e.across()]),
    "universal": ((*_GAP, *_CROSSING), lambda e: [*e.gap, dot3(e.a[2], e.b[2])]),
    "cylindrical": ((*_SIDEWAYS, *_ACROSS), lambda e: [*e.sideways(), *e.across()]),
    "prismatic": ((*_SIDEWAYS, *_TURN), lambda e: [*e.sideways(), *e.turn()]),
    "distance": (("length",), lambda e: e.stretch()),
}
LoopKind = Literal["point", "frame", "revolute", "universal", "cylindrical", "prismatic", "distance"]
#: Kind of loop -> how many equations it has.
LOOP_KINDS: Final = {kind: len(names) for kind, (names, _) in LOOP_ROWS.items()}

#: Kinds whose frames' z-axes lie along each other, those whose frames do not turn against each other, those that slide,
#: and the one whose axes cross.
HINGED: Final = ("revolute", "cylindrical")
WELDED: Final = ("frame", "prismatic")
SLIDING: Final = ("cylindrical", "prismatic")
CROSSED: Final = "universal"


def held_directions(kind: str, A: Array, B: Array) -> tuple[Array, Array]:
    """Return the directions in which a closed loop lets its ends neither move nor turn, (k, 3) and (l, 3).

    A and B are the axes of its frames in their columns, and the result is in the same axes. A rod's direction is
    taken along frame a's z-axis.
    """
    along, across, every = A.T[2:], A.T[:2], np.eye(3)
    directions = {
        "point": (every, every[:0]),
        "frame": (every, every),
        "revolute": (every, across),
        "universal": (every, np.cross(along, B.T[2:])),
        "cylindrical": (across, across),
        "prismatic": (across, every),
        "distance": (along, every[:0]),
    }
    return directions[kind]


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
