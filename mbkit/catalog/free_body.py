"""The free rigid body."""

from __future__ import annotations

from mbkit.catalog._parameters import Vector, down, point, positive
from mbkit.errors import InputError
from mbkit.model import Model, ModelBuilder, Number, nominal

__all__ = ["free_body"]


def free_body(*, mass: Number = 10.0, sides: Vector = (0.1, 0.4, 0.9), gravity: Number = 0.0) -> Model:
    """Return a homogeneous box that floats freely.

    One free joint, ``float``: q is the centre's position and the quaternion
    (x, y, z, w), v the linear then angular velocity in body axes. At zero the centre
    is at the origin and the box's edges lie along the world's axes.

    Parameters
    ----------
    mass : float or Parameter
        kg.
    sides : (3,) array_like
        Along x, y and z, m.
    gravity : float or Parameter
        m/s², along -z.

    Raises
    ------
    InputError
        A parameter that is not finite or has the wrong sign.

    References
    ----------
    Gazebo's "boxes" benchmark, complex case without gravity: it starts with
    ω = (0.1, 5, 0.1) rad/s about the middle axis and tumbles, as Dzhanibekov saw a wing nut
    do (Ashbaugh, Chicone, Cushman 1991, The twisting tennis racket).
    """
    mass = positive("mass", mass)
    a, b, c = point("sides", sides)
    told = [nominal(x) for x in (a, b, c)]
    if any(x <= 0 for x in told):
        raise InputError(f"sides: expected three lengths above 0, got ({', '.join(f'{x:g}' for x in told)}) m")
    inertia = tuple(mass / 12 * x for x in (b * b + c * c, a * a + c * c, a * a + b * b))
    builder = ModelBuilder("free_body", gravity=down(gravity))
    builder.add_body("box", mass=mass, inertia=inertia)
    builder.add_joint("float", "free", parent="world", child="box")
    return builder.build()
