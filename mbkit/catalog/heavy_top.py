"""The heavy top."""

from __future__ import annotations

from mbkit.catalog._parameters import Vector, down, moments, point, positive
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["heavy_top"]


def heavy_top(
    *,
    mass: Number = 15.0,
    inertia: Vector = (0.234375, 0.46875, 0.234375),
    com: Vector = (0.0, 1.0, 0.0),
    gravity: Number = 9.81,
) -> Model:
    """Return a rigid body with one point fixed at the origin.

    One ball joint, ``spin``: q is the quaternion (x, y, z, w) of the body's attitude, v
    the angular velocity in body axes. At the identity the body's axes are the
    world's; with the default `com` the top lies along +y.

    Parameters
    ----------
    mass : float or Parameter
        kg.
    inertia : (3,) array_like
        Principal moments about the centre of mass, along the body's axes, kg m².
    com : (3,) array_like
        Centre of mass in body axes, m.
    gravity : float or Parameter
        m/s², along -z.

    Raises
    ------
    InputError
        A parameter that is not finite, has the wrong sign, or moments that no
        body has.

    References
    ----------
    Terze, Müller, Zlatar 2016, Singularity-free time integration of rotational
    quaternions using non-redundant ordinary differential equations: the default
    values; it starts from the identity with ω = (0, 150, -4.61538) rad/s.
    """
    mass = positive("mass", mass)
    b = ModelBuilder("heavy_top", gravity=down(gravity))
    b.add_body("top", mass=mass, com=point("com", com), inertia=moments("inertia", inertia))
    b.add_joint("spin", "ball", parent="world", child="top")
    return b.build()
