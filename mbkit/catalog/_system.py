"""The decorator of the systems' functions, and checks of their parameters.

Links and pins of the mechanisms with loops.
"""

from __future__ import annotations

import inspect
import operator
from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import Any, Final, ParamSpec, overload

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import ROUNDING, finite_array, real, shown
from mbkit.errors import InputError
from mbkit.model import Expression, Model, ModelBuilder, Number, known, nominal

#: Three numbers.
Vector = ArrayLike | Sequence[Number]

P = ParamSpec("P")

#: Function of each system by its name.
SYSTEMS: Final[dict[str, Callable[..., Model]]] = {}

# Rods and segments; `ModelBuilder.build` has a similar limit.
_MAX_COUNT: Final = 2000
#: Unit of a parameter by the last word of its name; lengths are in m.
_UNITS: Final = {
    "mass": "kg",
    **dict.fromkeys(("inertia", "axial", "across", "product"), "kg m²"),
    "stiffness": "N/m",
    "bending_stiffness": "N m²",
    "gravity": "m/s², along -z",
    "density": "kg/m",
    "ratio": "Without unit",
    **dict.fromkeys(("angle", "tilt"), "rad"),
    "axes": "Of any length",
}
_RAISES: Final = """Raises
------
InputError
    A parameter that is not finite or has the wrong sign, moments that no body has, or lengths of links that do not
    meet.

"""


@overload
def system(make: Callable[P, Model], /) -> Callable[P, Model]: ...
@overload
def system(**rules: Callable[[str, Any], Any]) -> Callable[[Callable[P, Model]], Callable[P, Model]]: ...
def system(make: Callable[..., Model] | None = None, /, **rules: Callable[[str, Any], Any]) -> Any:
    """Register a system's function, check its parameters before it runs, and document their units and the error.

    Parameters
    ----------
    make : callable
        With keyword parameters that have defaults.
    **rules : callable
        By a parameter's name: takes the name and the value, and returns the value to use. By default a whole number is
        a `count`, gravity is nonnegative, and every other parameter is positive.
    """
    if make is None:
        return partial(system, **rules)
    defaults = {name: p.default for name, p in inspect.signature(make).parameters.items()}
    usual = {name: count if type(x) is int else positive for name, x in defaults.items()} | {"gravity": nonnegative}

    @wraps(make)
    def checked(**values: Any) -> Model:
        values = defaults | values
        # An unknown name has no rule, and Python's own error follows.
        return make(**{n: (rules.get(n) or usual.get(n, lambda _, x: x))(n, x) for n, x in values.items()})

    doc = inspect.cleandoc(make.__doc__ or "")
    section = "Notes\n-----" if "Notes\n-----" in doc else "References\n-----"
    fixed = [name for name, rule in rules.items() if rule in (number, acute)]
    parameters = "".join(_described(name, x, name in fixed) for name, x in defaults.items())
    checked.__doc__ = doc.replace(section, f"Parameters\n----------\n{parameters}\n{_RAISES}{section}")
    SYSTEMS[make.__name__] = checked
    return checked


def _described(name: str, default: Any, fixed: bool) -> str:
    """Return the entry of a parameter in its function's docstring."""
    if isinstance(default, str):
        return f"{name} : str\n    Kind of joint.\n"
    if isinstance(default, int):
        return f"{name} : int\n    Number of equal parts.\n"
    unit = _UNITS.get(name) or _UNITS.get(name.rstrip("0123456789").rpartition("_")[2], "m")
    scalar = "float" if fixed else "float or Parameter"
    return f"{name} : {scalar if isinstance(default, float) else 'array_like'}\n    {unit}.\n"


def finite(name: str, value: Number, **sign: bool) -> Number:
    """Return a number, or an expression whose nominal value is one if it is known; of either sign without `sign`."""
    if not isinstance(value, Expression):
        return real(name, value, **sign)
    if known(value):
        real(name, nominal(value), **sign)
    return value


#: The same above zero, and from zero on.
positive: Callable[[str, Number], Number] = partial(finite, positive=True)
nonnegative: Callable[[str, Number], Number] = partial(finite, nonnegative=True)


def number(name: str, value: Any) -> float:
    """Return a number above zero; axes depend on it, so no parameter can stand for it."""
    if isinstance(value, Expression):
        raise InputError(f"{name}: expected a number, got a parameter; the directions of axes depend on it")
    return real(name, value, positive=True)


def acute(name: str, value: Any) -> float:
    """Return a number between zero and π/2, as `number` does."""
    angle = number(name, value)
    if angle >= np.pi / 2:
        raise InputError(f"{name}: expected an angle below π/2, got {angle:g} rad")
    return angle


def down(value: Number) -> tuple[float, float, Number]:
    """Return the gravity vector of an acceleration along -z."""
    return (0.0, 0.0, -value)


def point(name: str, value: Any) -> tuple[Number, Number, Number]:
    """Return three finite numbers or expressions."""
    if isinstance(value, (list, tuple, np.ndarray)) and any(isinstance(x, Expression) for x in value):
        finite_array(name, [nominal(x) if known(x) else 0.0 for x in value], (3,))
        x, y, z = value
    else:
        x, y, z = finite_array(name, value, (3,)).tolist()
    return (x, y, z)


def lengths(name: str, value: Any) -> tuple[Number, Number, Number]:
    """Return three numbers or expressions whose nominal values are above zero."""
    sides = point(name, value)
    values = [nominal(x) for x in sides]
    if any(x <= 0 for x in values):
        raise InputError(f"{name}: expected three lengths above 0, got ({', '.join(f'{x:g}' for x in values)}) m")
    return sides


def moments(name: str, value: Any) -> tuple[Number, Number, Number]:
    """Return three principal moments of inertia that matter can have."""
    principal = point(name, value)
    if not all(known(x) for x in principal):
        return principal
    a, b, c = (nominal(x) for x in principal)
    if min(a, b, c) < 0 or 2 * max(a, b, c) > (a + b + c) * (1 + 1e-12):
        raise InputError(f"{name}: expected moments of at least 0 with A + B >= C, got ({a:g}, {b:g}, {c:g}) kg m²")
    return principal


def count(name: str, value: int) -> int:
    """Return a whole number from one to the most that a description holds."""
    try:
        n = 0 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        n = 0
    if not 1 <= n <= _MAX_COUNT:
        raise InputError(f"{name}: expected a whole number from 1 to {_MAX_COUNT}, got {shown(value)}")
    return n


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
