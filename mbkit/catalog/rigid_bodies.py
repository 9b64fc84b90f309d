"""Single rigid bodies: free, with a fixed point, and in gimbals."""

from __future__ import annotations

from mbkit.catalog._parameters import Vector, down, lengths, moments, nonnegative, point, system
from mbkit.model import Model, ModelBuilder, Number


@system(sides=lengths)
def free_body(*, mass: Number = 10.0, sides: Vector = (0.1, 0.4, 0.9), gravity: Number = 0.0) -> Model:
    """Return a homogeneous box that floats freely.

    One free joint, ``float``: q is the centre's position and the quaternion (x, y, z, w), v the linear then angular
    velocity in body axes. At zero the centre is at the origin and the box's edges lie along the world's axes.

    Parameters
    ----------
    mass : float or Parameter
        kg.
    sides : (3,) array_like
        Along x, y and z, m.
    gravity : float or Parameter
        m/s², along -z.

    References
    ----------
    Gazebo's "boxes" benchmark, complex case without gravity: it starts with ω = (0.1, 5, 0.1) rad/s about the middle
    axis and tumbles, as Dzhanibekov saw a wing nut do (Ashbaugh, Chicone, Cushman 1991, The twisting tennis racket).
    """
    a, b, c = point("sides", sides)
    inertia = tuple(mass / 12 * x for x in (b * b + c * c, a * a + c * c, a * a + b * b))
    builder = ModelBuilder("free_body", gravity=down(gravity))
    builder.add_body("box", mass=mass, inertia=inertia)
    builder.add_joint("float", "free", parent="world", child="box")
    return builder.build()


@system(inertia=moments, com=point)
def heavy_top(
    *,
    mass: Number = 15.0,
    inertia: Vector = (0.234375, 0.46875, 0.234375),
    com: Vector = (0.0, 1.0, 0.0),
    gravity: Number = 9.81,
) -> Model:
    """Return a rigid body with one point fixed at the origin.

    One ball joint, ``spin``: q is the quaternion (x, y, z, w) of the body's attitude, v the angular velocity in body
    axes. At the identity the body's axes are the world's; with the default `com` the top lies along +y.

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

    References
    ----------
    Terze, Müller, Zlatar 2016, Singularity-free time integration of rotational quaternions using non-redundant ordinary
    differential equations: the default values; it starts from the identity with ω = (0, 150, -4.61538) rad/s.
    """
    b = ModelBuilder("heavy_top", gravity=down(gravity))
    b.add_body("top", mass=mass, com=com, inertia=inertia)
    b.add_joint("spin", "ball", parent="world", child="top")
    return b.build()


@system(inner_inertia=moments, offset=nonnegative)
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

    Three coordinates: ``precession``, the turn α of the outer gimbal about +z, ``nutation``, the turn β of the inner
    gimbal about the outer one's +x, and ``spin``, the turn γ of the rotor about the inner gimbal's +y. β is the
    elevation of the rotor's axis above the horizontal: that axis points along (-sin α cos β, cos α cos β, sin β). At
    zero it lies along +y, where the three axes are at right angles; at β = ±π/2 it stands upright and the outer and the
    rotor's axis are one. All gimbals have their centre of mass in the centre.

    Parameters
    ----------
    rotor_mass, gimbal_mass : float or Parameter
        kg; the mass of each gimbal moves nothing.
    rotor_axial, rotor_across : float or Parameter
        Moments of the rotor about its axis, and across it about its centre of mass, kg m².
    offset : float or Parameter
        Distance of the rotor's centre of mass from the gimbals' centre, along its axis, m: 0 is the balanced gyroscope.
    inner_inertia : (3,) array_like
        Principal moments of the inner gimbal, about its hinge, about the rotor's axis and across both, kg m².
    outer_inertia : float or Parameter
        Moment of the outer gimbal about the vertical, kg m².
    gravity : float or Parameter
        m/s², along -z.

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 5.7, for the rotor; Magnus 1971, Kreisel, for what
    the gimbals' inertia changes. The default values are those of a classroom gyroscope.
    """
    b = ModelBuilder("gyroscope", gravity=down(gravity))
    b.add_body("outer gimbal", mass=gimbal_mass, inertia=(outer_inertia, outer_inertia, outer_inertia))
    b.add_body("inner gimbal", mass=gimbal_mass, inertia=inner_inertia)
    b.add_body(
        "rotor",
        mass=rotor_mass,
        com=(0.0, offset, 0.0),
        inertia=moments("rotor_axial", (rotor_across, rotor_axial, rotor_across)),
    )
    b.add_joint("precession", "continuous", parent="world", child="outer gimbal", axis=(0.0, 0.0, 1.0))
    b.add_joint("nutation", "continuous", parent="outer gimbal", child="inner gimbal", axis=(1.0, 0.0, 0.0))
    b.add_joint("spin", "continuous", parent="inner gimbal", child="rotor", axis=(0.0, 1.0, 0.0))
    return b.build()
