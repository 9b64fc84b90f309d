"""The slider-crank, a loop of crank, rod and piston."""

from __future__ import annotations

from mbkit.catalog._parameters import nonnegative, positive
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["slider_crank"]

_NORMAL = (0.0, 0.0, 1.0)


def slider_crank(
    *,
    crank: Number = 0.1,
    rod: Number = 0.3,
    crank_mass: Number = 0.2,
    rod_mass: Number = 0.2,
    piston_mass: Number = 0.4,
) -> Model:
    """Return the slider-crank of thin homogeneous rods with mass and a piston, without gravity.

    It moves in the x-y plane. The crank turns about the origin, the piston slides along the x axis, and the loop
    ``pin`` joins the rod's end to the piston. Three coordinates, with one degree of freedom: ``theta``, the crank's
    angle from +x, a right-handed turn about +z (counterclockwise); ``phi``, the rod's angle from the crank, in the same
    sense; and ``x``, the piston's displacement along +x. All three are zero at the dead centre where the piston is
    farthest from the crank's axis, at crank + rod. The loop is closed there.

    Engines take trees without loops and refuse this model. `mbkit.lagrangian.from_model` solves it with the loop.

    Parameters
    ----------
    crank, rod : float or Parameter
        Lengths, m. A crank that is shorter than the rod turns all the way round.
    crank_mass, rod_mass : float or Parameter
        kg; each may be zero. Without both, no mass moves at the dead centres.
    piston_mass : float or Parameter
        kg, at the rod's end.

    Raises
    ------
    InputError
        A parameter that is not finite or has the wrong sign.

    References
    ----------
    Biezeno, Grammel 1953, Technische Dynamik, vol. 2, on the crank drive. The defaults are those of a benchmark with
    massive links: from rest at theta = 0 with a torque of 0.1 N m on the crank, a quadrature in 30 digits gives
    theta(3 s) = 121.88627750824783. `mbkit.lagrangian.systems.rigid_slider_crank` is this system in ``theta`` alone;
    `mbkit.lagrangian.systems.slider_crank` has a massless crank and rod.
    """
    crank, rod = positive("crank", crank), positive("rod", rod)
    b = ModelBuilder("slider_crank", gravity=(0.0, 0.0, 0.0))
    rods = (("crank", crank, "crank_mass", crank_mass), ("rod", rod, "rod_mass", rod_mass))
    for name, length, argument, value in rods:
        mass = nonnegative(argument, value)
        across = mass * length**2 / 12
        b.add_body(name, mass=mass, com=(length / 2, 0.0, 0.0), inertia=(0.0, across, across))
    b.add_body("piston", mass=positive("piston_mass", piston_mass))
    b.add_joint("theta", "continuous", parent="world", child="crank", axis=_NORMAL)
    b.add_joint("phi", "continuous", parent="crank", child="rod", axis=_NORMAL, translation=(crank, 0.0, 0.0))
    b.add_joint(
        "x", "prismatic", parent="world", child="piston", axis=(1.0, 0.0, 0.0), translation=(crank + rod, 0.0, 0.0)
    )
    b.add_loop("pin", "point", body_a="rod", translation_a=(rod, 0.0, 0.0), body_b="piston")
    return b.build()
