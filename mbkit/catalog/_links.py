"""Links and pins of the mechanisms with loops."""

from __future__ import annotations

from typing import Any, Final

from mbkit._check import ROUNDING
from mbkit.errors import InputError
from mbkit.model import ModelBuilder, Number, known, nominal

Point = tuple[Number, Number, Number]
#: A point (x, z) of the plane in which a mechanism moves.
Pair = tuple[Number, Number]

#: Axis of hinges in the x-z plane: a positive turn about -y takes +x towards +z.
TURN: Final = (0.0, -1.0, 0.0)
X: Final = (1.0, 0.0, 0.0)
Y: Final = (0.0, 1.0, 0.0)
Z: Final = (0.0, 0.0, 1.0)
ORIGIN: Final[Pair] = (0.0, 0.0)
#: Cosine and sine of three directions in a plane, 120° apart.
THIRDS: Final = ((1.0, 0.0), (-0.5, 0.75**0.5), (-0.5, -(0.75**0.5)))


def at(point: Pair) -> Point:
    """Return a point of the x-z plane in space."""
    return (point[0], 0.0, point[1])


def times(factor: Number, *values: Number) -> Any:
    """Return a point or direction times a number."""
    return tuple(_product(factor, x) for x in values)


def _product(a: Number, b: Number) -> Number:
    # An expression times zero would stay one.
    return 0.0 if a == 0.0 or b == 0.0 else a * b


def add_rod(b: ModelBuilder, name: str, mass: Number, along: Point, radius: Number = 0.0) -> None:
    """Add a uniform rod from the body's origin along a vector; it is thin, or a solid cylinder of a radius."""
    square = [_product(x, x) for x in along]
    length = square[0] + square[1] + square[2]
    # Inertia of a cylinder: m/12 (|e|² 1 - e eᵀ) + m r²/4 (1 + e eᵀ/|e|²).
    mixed = -mass / 12 if radius == 0.0 else mass * (radius**2 / (4 * length) - 1 / 12)
    equal = mass / 12 * length if radius == 0.0 else mass * (length / 12 + radius**2 / 4)
    inertia = [[_product(mixed, _product(along[min(i, j)], along[max(i, j)])) for j in range(3)] for i in range(3)]
    for i in range(3):
        inertia[i][i] = equal + inertia[i][i]
    b.add_body(name, mass=mass, com=times(0.5, *along), inertia=inertia)


def add_link(
    b: ModelBuilder, joint: str, body: str, mass: Number, along: Pair, parent: str = "world", start: Pair = ORIGIN
) -> None:
    """Add a thin rod in the x-z plane, and the hinge at its beginning."""
    add_rod(b, body, mass, at(along))
    b.add_joint(joint, "continuous", parent=parent, child=body, axis=TURN, translation=at(start))


def add_pin(b: ModelBuilder, name: str, body_a: str, end_a: Pair, body_b: str, end_b: Pair = ORIGIN) -> None:
    """Close a loop in the x-z plane by a hinge."""
    b.add_loop(name, "point", body_a=body_a, translation_a=at(end_a), body_b=body_b, translation_b=at(end_b))


def leg(names: str, side: Number, other: Number) -> Number:
    """Return the second leg of a right triangle with a hypotenuse and a leg; `names` are for the message."""
    square = side**2 - other**2
    if known(square) and nominal(square) <= ROUNDING * nominal(side) ** 2:
        a, b = (abs(nominal(x)) for x in (side, other))
        raise InputError(
            f"{names}: expected links that meet at an angle, got a reach of {a:g} m for {b:g} m; change one"
        )
    return square**0.5


def triangle(names: str, base: Number, first: Number, second: Number) -> Pair:
    """Return where two sides over a base meet: the distance along the base from the first one's foot, and the height.

    A negative base points the other way.
    """
    if known(base) and nominal(base) == 0:
        raise InputError(f"{names}: expected a base above or below 0, got 0 m; change one")
    # Equations show the formula, so it is to be short.
    along = base / 2 if first == second else (base**2 + first**2 - second**2) / (2 * base)
    return along, leg(names, first, along)
