"""The gyroscope in two gimbals."""

from __future__ import annotations

from mbkit.catalog._parameters import Vector, down, moments, nonnegative, positive
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["gyroscope"]


def gyroscope(
    *,
    rotor_mass: Number = 1.0,
    rotor_axial: Number = 2e-3,
    rotor_across: Number = 1.2e-3,
    offset: Number = 0.02,
    gimbal_mass: Number = 0.2,
    inner_inertia: Vector = (5e-4, 5e-4, 1e-3),
    outer_inertia: Number = 8e-4,
    gravity: Number = 9.81,
) -> Model:
    """Return a symmetric rotor in two gimbals, with its centre of mass on its axis beside the gimbals' centre.

    Three coordinates: ``precession``, the turn α of the outer gimbal about +z, ``nutation``, the
    turn β of the inner gimbal about the outer one's +x, and ``spin``, the turn γ of the rotor
    about the inner gimbal's +y. β is the elevation of the rotor's axis above the horizontal: that axis
    points along (-sin α cos β, cos α cos β, sin β). At zero it lies along +y, where the three axes are at right angles;
    at β = ±π/2 it stands upright and the outer and the rotor's axis are one. All
    gimbals have their centre of mass in the centre.

    Parameters
    ----------
    rotor_mass, gimbal_mass : float or Parameter
        kg; the mass of each gimbal moves nothing.
    rotor_axial, rotor_across : float or Parameter
        Moments of the rotor about its axis, and across it about its centre of mass, kg m².
    offset : float or Parameter
        Distance of the rotor's centre of mass from the gimbals' centre, along its
        axis, m: 0 is the balanced gyroscope.
    inner_inertia : (3,) array_like
        Principal moments of the inner gimbal, about its hinge, about the rotor's axis and across both, kg m².
    outer_inertia : float or Parameter
        Moment of the outer gimbal about the vertical, kg m².
    gravity : float or Parameter
        m/s², along -z.

    Raises
    ------
    InputError
        A parameter that is not finite, has the wrong sign, or moments that no
        body has.

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 5.7, for the rotor; Magnus 1971, Kreisel, for what
    the gimbals' inertia changes. The default values are those of a classroom gyroscope.
    """
    axial, across = positive("rotor_axial", rotor_axial), positive("rotor_across", rotor_across)
    ring, outer = positive("gimbal_mass", gimbal_mass), positive("outer_inertia", outer_inertia)
    b = ModelBuilder("gyroscope", gravity=down(gravity))
    b.add_body("outer gimbal", mass=ring, inertia=(outer, outer, outer))
    b.add_body("inner gimbal", mass=ring, inertia=moments("inner_inertia", inner_inertia))
    b.add_body(
        "rotor",
        mass=positive("rotor_mass", rotor_mass),
        com=(0.0, nonnegative("offset", offset), 0.0),
        inertia=moments("rotor_axial", (across, axial, across)),
    )
    b.add_joint("precession", "continuous", parent="world", child="outer gimbal", axis=(0.0, 0.0, 1.0))
    b.add_joint("nutation", "continuous", parent="outer gimbal", child="inner gimbal", axis=(1.0, 0.0, 0.0))
    b.add_joint("spin", "continuous", parent="inner gimbal", child="rotor", axis=(0.0, 1.0, 0.0))
    return b.build()
