"""Mechanisms with few coordinates: cart-pole, acrobot, Furuta pendulum and slider-crank."""

from __future__ import annotations

from mbkit.catalog._parameters import SWING, Vector, down, moments, nonnegative, system
from mbkit.model import Model, ModelBuilder, Number


@system
def cart_pole(
    *, cart_mass: Number = 1.0, pole_mass: Number = 1.0, length: Number = 1.0, gravity: Number = 9.81
) -> Model:
    """Return a cart on a horizontal rail that carries a pole with a point mass at its end.

    Two coordinates: ``x``, the cart's position along +x, and ``theta``, the pole's angle from the downward vertical,
    growing towards +x. At zero the cart is at the origin and the mass at (0, 0, -length).

    Parameters
    ----------
    cart_mass, pole_mass : float or Parameter
        kg.
    length : float or Parameter
        m.
    gravity : float or Parameter
        m/s², along -z.

    References
    ----------
    Tedrake, Underactuated Robotics, ch. 3.2.1, whose coordinates these are. The
    IFToMM proposal "light cart-pole" is cart_mass=1e-6 from θ = π/2 at rest.
    """
    b = ModelBuilder("cart_pole", gravity=down(gravity))
    b.add_body("cart", mass=cart_mass)
    b.add_body("pole", mass=pole_mass, com=(0.0, 0.0, -length))
    b.add_joint("x", "prismatic", parent="world", child="cart", axis=(1.0, 0.0, 0.0))
    b.add_joint("theta", "continuous", parent="cart", child="pole", axis=SWING)
    b.add_frame("tip", body="pole", translation=(0.0, 0.0, -length))
    return b.build()


@system
def acrobot(
    *,
    length1: Number = 1.0,
    length2: Number = 2.0,
    mass1: Number = 1.0,
    mass2: Number = 1.0,
    com1: Number = 0.5,
    com2: Number = 1.0,
    inertia1: Number = 0.083,
    inertia2: Number = 0.33,
    gravity: Number = 9.8,
) -> Model:
    """Return two rigid links, one below the other, with a motor at the elbow only.

    Two coordinates: ``theta1``, the angle of the first link from the downward vertical, and ``theta2``, the angle of
    the second link from the first. At zero both hang down. The motor's torque stands in the second entry of the
    generalized forces; the first is zero.

    Parameters
    ----------
    length1, length2 : float or Parameter
        Of the links, m; the second only says where the tip is.
    mass1, mass2 : float or Parameter
        kg.
    com1, com2 : float or Parameter
        Distance of each link's centre of mass from its hinge, m.
    inertia1, inertia2 : float or Parameter
        Of each link about its centre of mass, across the plane of motion, kg m².
    gravity : float or Parameter
        m/s², along -z.

    References
    ----------
    Spong 1995, The swing up control problem for the acrobot, whose numbers are the defaults (his first angle is from
    the horizontal); Tedrake, Underactuated Robotics, ch. 3.1, whose coordinates these are.
    """
    b = ModelBuilder("acrobot", gravity=down(gravity))
    b.add_body("link1", mass=mass1, com=(0.0, 0.0, -com1), inertia=(inertia1, inertia1, 0.0))
    b.add_body("link2", mass=mass2, com=(0.0, 0.0, -com2), inertia=(inertia2, inertia2, 0.0))
    b.add_joint("theta1", "continuous", parent="world", child="link1", axis=SWING)
    b.add_joint("theta2", "continuous", parent="link1", child="link2", axis=SWING, translation=(0.0, 0.0, -length1))
    b.add_frame("tip", body="link2", translation=(0.0, 0.0, -length2))
    return b.build()


@system(pendulum_inertia=moments)
def furuta_pendulum(
    *,
    arm_length: Number = 0.25,
    arm_mass: Number = 0.2,
    arm_com: Number = 0.125,
    arm_inertia: Number = 1e-3,
    pendulum_mass: Number = 0.1,
    pendulum_com: Number = 0.15,
    pendulum_inertia: Vector = (7.5e-4, 7.5e-4, 1.25e-6),
    gravity: Number = 9.81,
) -> Model:
    """Return a rotary pendulum: an arm that turns about the vertical carries a pendulum hinged about the arm.

    Two coordinates: ``arm``, the arm's turn about +z, and ``pendulum``, the pendulum's angle
    from the downward vertical, a turn about the arm. At zero the arm lies along +x and
    the pendulum hangs at its end; it swings towards +y, where the arm's turn takes it.

    Parameters
    ----------
    arm_length : float or Parameter
        From the vertical axis to the pendulum's hinge, m.
    arm_mass, pendulum_mass : float or Parameter
        kg.
    arm_com, pendulum_com : float or Parameter
        Distance of the centre of mass from the vertical axis and from the hinge, m.
    arm_inertia : float or Parameter
        About the vertical through the arm's centre of mass, kg m².
    pendulum_inertia : (3,) array_like
        Principal moments about the pendulum's centre of mass: about the arm, across
        arm and rod, and about the rod, kg m².
    gravity : float or Parameter
        m/s², along -z.

    References
    ----------
    Furuta, Yamakita, Kobayashi 1992, Swing-up control of inverted pendulum using pseudo-state feedback; Cazzolato,
    Prime 2011, On the dynamics of the Furuta pendulum, which keeps all the moments of inertia. The default values are
    those of thin rods on a desk, of no particular device.
    """
    b = ModelBuilder("furuta_pendulum", gravity=down(gravity))
    b.add_body("arm body", mass=arm_mass, com=(arm_com, 0.0, 0.0), inertia=(0.0, arm_inertia, arm_inertia))
    b.add_body("pendulum body", mass=pendulum_mass, com=(0.0, 0.0, -pendulum_com), inertia=pendulum_inertia)
    b.add_joint("arm", "continuous", parent="world", child="arm body", axis=(0.0, 0.0, 1.0))
    b.add_joint(
        "pendulum",
        "continuous",
        parent="arm body",
        child="pendulum body",
        axis=(1.0, 0.0, 0.0),
        translation=(arm_length, 0.0, 0.0),
    )
    return b.build()


@system(crank_mass=nonnegative, rod_mass=nonnegative)
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

    References
    ----------
    Biezeno, Grammel 1953, Technische Dynamik, vol. 2, on the crank drive. The defaults are those of a benchmark with
    massive links: from rest at theta = 0 with a torque of 0.1 N m on the crank, a quadrature in 30 digits gives
    theta(3 s) = 121.88627750824783. `mbkit.lagrangian.systems.rigid_slider_crank` is this system in ``theta`` alone;
    `mbkit.lagrangian.systems.slider_crank` has a massless crank and rod.
    """
    normal = (0.0, 0.0, 1.0)
    b = ModelBuilder("slider_crank", gravity=(0.0, 0.0, 0.0))
    for name, length, mass in (("crank", crank, crank_mass), ("rod", rod, rod_mass)):
        across = mass * length**2 / 12
        b.add_body(name, mass=mass, com=(length / 2, 0.0, 0.0), inertia=(0.0, across, across))
    b.add_body("piston", mass=piston_mass)
    b.add_joint("theta", "continuous", parent="world", child="crank", axis=normal)
    b.add_joint("phi", "continuous", parent="crank", child="rod", axis=normal, translation=(crank, 0.0, 0.0))
    b.add_joint(
        "x", "prismatic", parent="world", child="piston", axis=(1.0, 0.0, 0.0), translation=(crank + rod, 0.0, 0.0)
    )
    b.add_loop("pin", "point", body_a="rod", translation_a=(rod, 0.0, 0.0), body_b="piston")
    return b.build()
