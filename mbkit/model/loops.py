"""Loops: what their ends hold together, as rows that are zero where a loop is closed, on any arithmetic."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from mbkit._check import Array
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
