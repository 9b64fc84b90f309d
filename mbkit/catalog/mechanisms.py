"""Pendulums, chains, and mechanisms with few coordinates."""

from __future__ import annotations

from mbkit.catalog._system import TURN, Vector, X, Z, down, moments, nonnegative, system
from mbkit.model import Model, ModelBuilder, Number, known, nominal

__all__ = [
    "acrobot",
    "cart_pole",
    "chain",
    "double_pendulum",
    "elastic_pendulum",
    "furuta_pendulum",
    "pendulum",
    "slider_crank",
    "spherical_pendulum",
]


@system
def pendulum(*, length: Number = 1.0, mass: Number = 1.0, gravity: Number = 9.81) -> Model:
    """Return a point mass on a massless rod.

    One coordinate, ``theta``, the angle from the downward vertical: at zero the mass hangs at (0, 0, -length); at θ
    it is at length (sin θ, 0, -cos θ).

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §11 problem 1; IFToMM library of computational benchmark problems, A01, which
    starts at θ = -π/2.
    """
    b = ModelBuilder("pendulum", gravity=down(gravity))
    b.add_body("bob", mass=mass, com=(0.0, 0.0, -length))
    b.add_joint("theta", "continuous", parent="world", child="bob", axis=TURN)
    b.add_frame("tip", body="bob", translation=(0.0, 0.0, -length))
    return b.build()


@system
def double_pendulum(
    *, length1: Number = 1.0, mass1: Number = 1.0, length2: Number = 1.0, mass2: Number = 1.0, gravity: Number = 9.81
) -> Model:
    """Return two point masses on massless rods, one below the other.

    Two coordinates: ``theta1``, the angle of the first rod from the downward vertical, and ``theta2``, the angle of
    the second rod from the first (textbooks often take it from the vertical; that is theta1 + theta2). At zero both
    hang down.

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §5 problem 1.
    """
    b = ModelBuilder("double_pendulum", gravity=down(gravity))
    b.add_body("rod1", mass=mass1, com=(0.0, 0.0, -length1))
    b.add_body("rod2", mass=mass2, com=(0.0, 0.0, -length2))
    b.add_joint("theta1", "continuous", parent="world", child="rod1", axis=TURN)
    b.add_joint("theta2", "continuous", parent="rod1", child="rod2", axis=TURN, translation=(0.0, 0.0, -length1))
    b.add_frame("tip", body="rod2", translation=(0.0, 0.0, -length2))
    return b.build()


@system
def cart_pole(
    *, cart_mass: Number = 1.0, pole_mass: Number = 1.0, length: Number = 1.0, gravity: Number = 9.81
) -> Model:
    """Return a cart on a horizontal rail that carries a pole with a point mass at its end.

    Two coordinates: ``x``, the cart's position along +x, and ``theta``, the pole's angle from the downward vertical,
    growing towards +x. At zero the cart is at the origin and the mass at (0, 0, -length).

    References
    ----------
    Tedrake, Underactuated Robotics, ch. 3.2.1, whose coordinates these are. The IFToMM proposal "light cart-pole" is
    cart_mass=1e-6 from θ = π/2 at rest.
    """
    b = ModelBuilder("cart_pole", gravity=down(gravity))
    b.add_body("cart", mass=cart_mass)
    b.add_body("pole", mass=pole_mass, com=(0.0, 0.0, -length))
    b.add_joint("x", "prismatic", parent="world", child="cart", axis=X)
    b.add_joint("theta", "continuous", parent="cart", child="pole", axis=TURN)
    b.add_frame("tip", body="pole", translation=(0.0, 0.0, -length))
    return b.build()


@system
def spherical_pendulum(*, length: Number = 1.0, mass: Number = 1.0, gravity: Number = 9.81) -> Model:
    """Return a point mass on a massless rod that hangs in a Cardan suspension.

    Two coordinates: ``alpha``, the turn of the massless fork about -y, which swings the mass towards +x, and ``beta``,
    the turn of the rod in the fork about the fork's +x, which swings it towards +y. The mass is at length (sin α cos β,
    sin β, -cos α cos β): at zero it hangs at (0, 0, -length).

    Notes
    -----
    The textbooks' coordinates, azimuth φ and angle ϑ from the downward vertical, have no inverse of their mass matrix,
    m l² diag(sin² ϑ, 1), where the mass hangs at rest, which is where every study begins. These have m l² diag(cos² β,
    1), singular where the mass lies on the y axis. tan φ = tan β / sin α, cos ϑ = cos α cos β. A ball joint would let a
    point mass spin about the rod, with no inertia.

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §14 problem 1.
    """
    b = ModelBuilder("spherical_pendulum", gravity=down(gravity))
    b.add_body("fork", mass=0.0)
    b.add_body("bob", mass=mass, com=(0.0, 0.0, -length))
    b.add_joint("alpha", "continuous", parent="world", child="fork", axis=TURN)
    b.add_joint("beta", "continuous", parent="fork", child="bob", axis=X)
    b.add_frame("tip", body="bob", translation=(0.0, 0.0, -length))
    return b.build()


@system
def elastic_pendulum(
    *, length: Number = 1.0, mass: Number = 1.0, stiffness: Number = 100.0, gravity: Number = 9.81
) -> Model:
    """Return a point mass that slides on a massless rod against a spring, which is `length` long at rest.

    Two coordinates: ``theta``, the angle of the rod from the downward vertical, and ``stretch``, how much longer than
    `length` the spring is. The mass is at (length + stretch) (sin θ, 0, -cos θ): at zero it hangs at (0, 0, -length)
    and the spring is at rest. The mass matrix is singular where the mass reaches the pivot: the lower limit of
    ``stretch``, half the (nominal) length, keeps random states away from there.

    References
    ----------
    Vitt, Gorelik 1933, Oscillations of an elastic pendulum as an example of two parametrically coupled linear systems:
    swing and stretch exchange their energy where stiffness length' = 4 mass gravity nearly holds, length' the length at
    which it hangs at rest.
    """
    lower = -nominal(length) / 2 if known(length) else None
    b = ModelBuilder("elastic_pendulum", gravity=down(gravity))
    b.add_body("rod", mass=0.0)
    b.add_body("bob", mass=mass, com=(0.0, 0.0, -length))
    b.add_joint("theta", "continuous", parent="world", child="rod", axis=TURN)
    b.add_joint(
        "stretch", "prismatic", parent="rod", child="bob", axis=(0.0, 0.0, -1.0), lower=lower, stiffness=stiffness
    )
    b.add_frame("tip", body="bob", translation=(0.0, 0.0, -length))
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
    generalized forces; the first is zero. `com1` and `com2` are the distances of the centres of mass from the hinges,
    the moments of inertia are about them, across the plane of motion; `length2` only says where the tip is.

    References
    ----------
    Spong 1995, The swing up control problem for the acrobot, whose numbers are the defaults (his first angle is from
    the horizontal); Tedrake, Underactuated Robotics, ch. 3.1, whose coordinates these are.
    """
    b = ModelBuilder("acrobot", gravity=down(gravity))
    b.add_body("link1", mass=mass1, com=(0.0, 0.0, -com1), inertia=(inertia1, inertia1, 0.0))
    b.add_body("link2", mass=mass2, com=(0.0, 0.0, -com2), inertia=(inertia2, inertia2, 0.0))
    b.add_joint("theta1", "continuous", parent="world", child="link1", axis=TURN)
    b.add_joint("theta2", "continuous", parent="link1", child="link2", axis=TURN, translation=(0.0, 0.0, -length1))
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

    Two coordinates: ``arm``, the arm's turn about +z, and ``pendulum``, the pendulum's angle from the downward
    vertical, a turn about the arm. At zero the arm lies along +x and the pendulum hangs at its end; it swings towards
    +y, where the arm's turn takes it. The arm's length is from the vertical axis to the hinge; centres of mass lie
    `arm_com` from the axis and `pendulum_com` from the hinge. `arm_inertia` is about the vertical, `pendulum_inertia`
    about the arm, across arm and rod, and about the rod, each about the part's own centre of mass.

    References
    ----------
    Furuta, Yamakita, Kobayashi 1992, Swing-up control of inverted pendulum using pseudo-state feedback; Cazzolato,
    Prime 2011, On the dynamics of the Furuta pendulum, which keeps all the moments of inertia. The default values are
    those of thin rods on a desk, of no particular device.
    """
    b = ModelBuilder("furuta_pendulum", gravity=down(gravity))
    b.add_body("arm body", mass=arm_mass, com=(arm_com, 0.0, 0.0), inertia=(0.0, arm_inertia, arm_inertia))
    b.add_body("pendulum body", mass=pendulum_mass, com=(0.0, 0.0, -pendulum_com), inertia=pendulum_inertia)
    b.add_joint("arm", "continuous", parent="world", child="arm body", axis=Z)
    end = (arm_length, 0.0, 0.0)
    b.add_joint("pendulum", "continuous", parent="arm body", child="pendulum body", axis=X, translation=end)
    return b.build()


@system
def chain(*, n: int = 5, length: Number = 1.0, mass: Number = 1.0, gravity: Number = 9.81) -> Model:
    """Return n equal thin rods hinged end to end, hanging from the origin; `length` and `mass` are those of each rod.

    The model's name is ``chain_5`` for five. n coordinates: ``theta1``, the angle of the first rod from the downward
    vertical, and ``theta2`` ... , the angle of each rod from the one before. At zero the chain hangs straight down.
    Each rod has its centre of mass in its middle and the inertia m L²/12 across, none along.

    References
    ----------
    Featherstone 2004, An empirical study of the joint space inertia matrix: the straight chain's mass matrix has a
    condition number of about 4 n⁴.
    """
    across = mass * length**2 / 12
    b = ModelBuilder(f"chain_{n}", gravity=down(gravity))
    for i in range(1, n + 1):
        parent, top = (f"rod{i - 1}", (0.0, 0.0, -length)) if i > 1 else ("world", (0.0, 0.0, 0.0))
        b.add_body(f"rod{i}", mass=mass, com=(0.0, 0.0, -length / 2), inertia=(across, across, 0.0))
        b.add_joint(f"theta{i}", "continuous", parent=parent, child=f"rod{i}", axis=TURN, translation=top)
    b.add_frame("tip", body=f"rod{n}", translation=(0.0, 0.0, -length))
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

    A crank that is shorter than the rod turns all the way round. Crank and rod may be massless; without both masses,
    no mass moves at the dead centres. Engines take trees without loops and refuse this model.
    `mbkit.lagrangian.from_model` solves it with the loop.

    References
    ----------
    Biezeno, Grammel 1953, Technische Dynamik, vol. 2, on the crank drive. The defaults are those of a benchmark with
    massive links: from rest at theta = 0 with a torque of 0.1 N m on the crank, a quadrature in 30 digits gives
    theta(3 s) = 121.88627750824783. `mbkit.lagrangian.systems.rigid_slider_crank` is this system in ``theta`` alone;
    `mbkit.lagrangian.systems.slider_crank` has a massless crank and rod.
    """
    b = ModelBuilder("slider_crank", gravity=(0.0, 0.0, 0.0))
    for name, length, mass in (("crank", crank, crank_mass), ("rod", rod, rod_mass)):
        across = mass * length**2 / 12
        b.add_body(name, mass=mass, com=(length / 2, 0.0, 0.0), inertia=(0.0, across, across))
    b.add_body("piston", mass=piston_mass)
    b.add_joint("theta", "continuous", parent="world", child="crank", axis=Z)
    b.add_joint("phi", "continuous", parent="crank", child="rod", axis=Z, translation=(crank, 0.0, 0.0))
    b.add_joint("x", "prismatic", parent="world", child="piston", axis=X, translation=(crank + rod, 0.0, 0.0))
    b.add_loop("pin", "point", body_a="rod", translation_a=(rod, 0.0, 0.0), body_b="piston")
    return b.build()
