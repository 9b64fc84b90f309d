"""Planar mechanisms with closed loops: four-bars, guides on a straight line, parallel ones, Andrews' squeezer.

Each is a tree of links that loops close, with as few links as can be between the ground and any other. The neutral pose
is closed, so that `Model.neutral` is a state of the mechanism; the axes of all bodies are the world's there, but for
`andrews_squeezer`, whose bodies have the axes of its source.
"""

from __future__ import annotations

from typing import Any, Final

from mbkit.catalog._system import (
    ORIGIN,
    THIRDS,
    TURN,
    Pair,
    X,
    Z,
    add_link,
    add_pin,
    add_rod,
    at,
    down,
    system,
    times,
    triangle,
)
from mbkit.model import Model, ModelBuilder, Number

__all__ = [
    "andrews_squeezer",
    "five_bar",
    "four_bar",
    "four_bars",
    "parallel_gripper",
    "planar_3rrr",
    "scissor",
]


@system
def four_bar(
    *,
    crank: Number = 0.3,
    coupler: Number = 0.9,
    rocker: Number = 0.7,
    ground: Number = 1.0,
    density: Number = 2.0,
    gravity: Number = 9.81,
) -> Model:
    """Return the planar four-bar of uniform thin rods.

    The crank turns about the origin, the rocker about (ground, 0, 0); the coupler hangs on the crank's end, and the
    loop ``pin`` joins it to the rocker's, above the ground line at the start. Three coordinates, with one degree of
    freedom: ``theta``, the crank's angle from +x; ``phi``, the coupler's angle from the crank, and ``psi``, the
    rocker's angle, both from their values at theta = 0. There the crank lies along the ground line; the coupler and the
    rocker are the sides of a triangle over what is left of that line.

    Notes
    -----
    Freudenstein's equation: K1 cos Ψ - K2 cos θ + K3 = cos(θ - Ψ) with the rocker's angle Ψ from +x, K1 = ground/crank,
    K2 = ground/rocker, K3 = (crank² - coupler² + rocker² + ground²)/(2 crank rocker). By Grashof's rule the crank turns
    all the way round where the shortest and the longest length together stay below the other two. `four_bars` has the
    parallelogram.

    References
    ----------
    Freudenstein 1955, Approximate synthesis of four-bar linkages, equation of displacement; Grashof 1883, Theoretische
    Maschinenlehre.
    """
    x, z = triangle("ground - crank, coupler, rocker", ground - crank, coupler, rocker)
    b = ModelBuilder("four_bar", gravity=down(gravity))
    pin = (x + crank - ground, z)
    add_link(b, "theta", "crank", density * crank, (crank, 0.0))
    add_link(b, "phi", "coupler", density * coupler, (x, z), "crank", (crank, 0.0))
    add_link(b, "psi", "rocker", density * rocker, pin, start=(ground, 0.0))
    add_pin(b, "pin", "coupler", (x, z), "rocker", pin)
    return b.build()


@system
def four_bars(*, n: int = 2, length: Number = 1.0, mass: Number = 1.0, gravity: Number = 9.81) -> Model:
    """Return n four-bars of equal thin rods in a row, standing upright; `length` and `mass` are those of each rod.

    The model's name is ``four_bars_2`` for two. Upright rod k = 0 ... n turns about (k length, 0, 0); coupler k hangs
    on the end of the rod before and is closed with rod k by the loop ``pin<k>``. 2 n + 1 coordinates, with one degree
    of freedom: ``theta0``, ``phi1``, ``theta1`` ... : the angle θ of each upright rod, and φ of each coupler from
    the rod that carries it. At zero the rods stand up and the coupler bars lie along +x.

    Notes
    -----
    As parallelograms all rods turn by one angle: (n + 1 + 3 n) m l² θ̈/3 = ((n + 1)/2 + n) m g l sin θ. Where the rods
    lie flat the mechanism is singular, and a parallelogram can go on as an antiparallelogram there.

    References
    ----------
    IFToMM library of computational benchmark problems, A02 (N four-bar mechanism), whose gravity is along -y.
    """
    b = ModelBuilder(f"four_bars_{n}", gravity=down(gravity))
    top, right = (0.0, length), (length, 0.0)
    add_link(b, "theta0", "rod0", mass, top)
    for k in range(1, n + 1):
        add_link(b, f"phi{k}", f"coupler{k}", mass, right, f"rod{k - 1}", top)
        add_link(b, f"theta{k}", f"rod{k}", mass, top, start=(k * length, 0.0))
        add_pin(b, f"pin{k}", f"coupler{k}", right, f"rod{k}", top)
    return b.build()


@system
def five_bar(
    *, ground: Number = 0.6, proximal: Number = 0.3, distal: Number = 0.5, density: Number = 2.0, gravity: Number = 9.81
) -> Model:
    """Return the symmetric five-bar: two arms of two thin rods each that hold a common tip.

    The left arm turns about (-ground/2, 0, 0), the right one about (ground/2, 0, 0); the loop ``tip`` joins the ends of
    the distal rods. Four coordinates, with two degrees of freedom: ``theta1`` and ``phi1`` of the left arm, ``theta2``
    and ``phi2`` of the right one: the turn of each proximal rod, and the turn of its distal rod against it. At zero the
    proximal rods stand up along +z, and the distal ones meet above the middle: of the default lengths at (0, 0, 0.7).

    Notes
    -----
    The frame ``tip`` stands at p with ‖p - e1‖ = ‖p - e2‖ = distal, e the elbows: a circle's intersections give p of
    the two driven angles, and, arm by arm, the angles of p. Singular where the distal rods are in line.

    References
    ----------
    Liu, Wang, Pritschow 2006, Kinematics, singularity and workspace of planar 5R symmetrical parallel mechanisms.
    """
    x, z = triangle("ground, distal, distal", ground, distal, distal)
    b = ModelBuilder("five_bar", gravity=down(gravity))
    for k, side in ((1, 1.0), (2, -1.0)):
        add_link(b, f"theta{k}", f"proximal{k}", density * proximal, (0.0, proximal), start=(-side * (ground / 2), 0.0))
        add_link(b, f"phi{k}", f"distal{k}", density * distal, (side * x, z), f"proximal{k}", (0.0, proximal))
    add_pin(b, "tip", "distal1", (x, z), "distal2", (-x, z))
    b.add_frame("tip", body="distal1", translation=at((x, z)))
    return b.build()


# Mechanisms of equal parts


@system
def scissor(*, n: int = 3, rod: Number = 0.5, density: Number = 1.0, gravity: Number = 9.81) -> Model:
    """Return a scissor lift of n pairs of crossed thin rods.

    The model's name is ``scissor_3`` for three. The first rod is hinged at the origin, the second on a massless roller
    on the x axis; every further rod is hinged on the end of the crossed rod below. The loop ``pin<k>`` joins the
    middles of pair k. 2 n + 1 coordinates, with one degree of freedom: ``x``, the roller's way along +x from 0.8 rod;
    ``alpha1``, ``beta1`` ... : the turns of the two rods of each pair, the first of which starts on the left; from
    the second pair on against the rod that carries them. At zero all rods rise by 0.6 of their length.

    Notes
    -----
    With the first rod's angle φ from +x the roller is at rod cos φ, and the frame ``top``, the left upper end, at n rod
    sin φ above the origin: ż/ẋ = -n cot φ. So a load on top needs n cot φ times its weight on the roller, inwards. All
    rods are in line where φ = 0, which is singular.

    References
    ----------
    Beer, Johnston, Vector Mechanics for Engineers: Statics, ch. 10 on virtual work, which gives that force.
    """
    b = ModelBuilder(f"scissor_{n}", gravity=down(gravity))
    right, left = (0.8 * rod, 0.6 * rod), (-0.8 * rod, 0.6 * rod)
    b.add_body("roller")
    b.add_joint("x", "prismatic", parent="world", child="roller", axis=X, translation=at((0.8 * rod, 0.0)))
    for k in range(1, n + 1):
        crossed: tuple[str, Pair] = (f"b{k - 1}", left) if k > 1 else ("world", ORIGIN)
        add_link(b, f"alpha{k}", f"a{k}", density * rod, right, *crossed)
        crossed = (f"a{k - 1}", right) if k > 1 else ("roller", ORIGIN)
        add_link(b, f"beta{k}", f"b{k}", density * rod, left, *crossed)
        add_pin(b, f"pin{k}", f"a{k}", times(0.5, *right), f"b{k}", times(0.5, *left))
    b.add_frame("top", body=f"b{n}", translation=at(left))
    return b.build()


@system
def parallel_gripper(
    *,
    arm: Number = 0.1,
    base: Number = 0.03,
    palm: Number = 0.05,
    finger: Number = 0.08,
    density: Number = 1.0,
    finger_mass: Number = 0.05,
    gravity: Number = 9.81,
) -> Model:
    """Return a gripper whose two fingers stay parallel: each is led by a parallelogram, and gears couple the two.

    On each side two arms turn about the ground at (±palm/2, 0, 0) and (±(palm/2 + base), 0, 0) and carry a finger, a
    rod of length `finger` along +z above the inner arm. The inner right arm mimics the inner left one in the mirror.
    The fingers hang on the inner arms; the loops ``left`` and ``right`` close them with the outer ones. Five
    coordinates, with one degree of freedom: ``theta``, the turn of the inner arms, which opens the gripper; ``phi1``
    and ``psi1``, the turns of the left finger against its arm and of the left outer arm; ``phi2`` and ``psi2`` of the
    right ones. At zero the arms stand up. The frames ``pad1`` and ``pad2`` are the tips of the fingers.

    Notes
    -----
    The fingers keep their direction, and their tips are palm + 2 arm sin θ apart, at arm cos θ + finger above the
    ground. Singular at θ = ±π/2, where the parallelograms are flat.

    References
    ----------
    Monkman, Hesse, Steinmann, Schunk 2007, Robot Grippers. The numbers are of no particular device.
    """
    b = ModelBuilder("parallel_gripper", gravity=down(gravity))
    top = at((0.0, arm))
    for k, side in ((1, -1.0), (2, 1.0)):
        # A turn about -y opens the left side, the mirrored one the right.
        axis = times(-side, *TURN)
        hinge: dict[str, Any] = {"kind": "continuous", "axis": axis}
        for name, x in ((f"inner{k}", palm / 2), (f"outer{k}", palm / 2 + base)):
            add_rod(b, name, density * arm, top)
            joint = f"psi{k}" if name.startswith("outer") else "theta" if k == 1 else "theta2"
            follow = ("theta", 1.0, 0.0) if joint == "theta2" else None
            b.add_joint(joint, parent="world", child=name, translation=at((side * x, 0.0)), mimic=follow, **hinge)
        add_rod(b, f"finger{k}", finger_mass, at((0.0, finger)))
        b.add_joint(f"phi{k}", parent=f"inner{k}", child=f"finger{k}", translation=top, **hinge)
        add_pin(b, "left" if k == 1 else "right", f"finger{k}", (side * base, 0.0), f"outer{k}", (0.0, arm))
        b.add_frame(f"pad{k}", body=f"finger{k}", translation=at((0.0, finger)))
    return b.build()


@system
def planar_3rrr(
    *,
    base_radius: Number = 0.5,
    platform_radius: Number = 0.14,
    proximal: Number = 0.3,
    distal: Number = 0.3,
    density: Number = 2.0,
    platform_mass: Number = 2.0,
) -> Model:
    """Return the planar parallel robot 3-RRR: a platform on three arms of two thin rods each, without gravity.

    It moves in the x-y plane. Arm k = 1, 2, 3 turns about the corner of an equilateral triangle at base_radius (cos,
    sin)(120° (k - 1)); the loop ``corner<k>`` joins its end to the platform's corner, at `platform_radius` in the same
    direction. Nine coordinates, with three degrees of freedom: ``platform``, with x, y and the angle of the platform
    against the world; ``theta1``, ``phi1`` ... of the arms: the turn of each proximal rod about +z, and of its distal
    rod against it. At zero the platform is in the middle, and each arm is bent to the left of the way inwards. The
    platform is a homogeneous disc.

    Notes
    -----
    Arm by arm ‖p + R(angle) c - e(θ)‖ = distal with the platform's corner c and the elbow e: a quadratic equation in
    tan(θ/2).

    References
    ----------
    Gosselin, Angeles 1988, The optimum kinematic design of a planar three-degree-of-freedom parallel manipulator.
    """
    names = "base_radius - platform_radius, proximal, distal"
    reach, bend = triangle(names, base_radius - platform_radius, proximal, distal)
    rest = base_radius - platform_radius - reach
    b = ModelBuilder("planar_3rrr", gravity=(0.0, 0.0, 0.0))
    across = platform_mass * platform_radius**2 / 4
    b.add_body("disc", mass=platform_mass, inertia=(across, across, 2 * across))
    b.add_joint("platform", "planar", parent="world", child="disc")
    for k, (c, s) in enumerate(THIRDS, 1):
        # Inwards is (-c, -s), to its left (s, -c).
        elbow = (-c * reach + s * bend, -s * reach - c * bend, 0.0)
        end = (-c * rest - s * bend, -s * rest + c * bend, 0.0)
        foot, corner = ((c * r, s * r, 0.0) for r in (base_radius, platform_radius))
        for joint, body, length, along, parent, start in (
            (f"theta{k}", f"proximal{k}", proximal, elbow, "world", foot),
            (f"phi{k}", f"distal{k}", distal, end, f"proximal{k}", elbow),
        ):
            add_rod(b, body, density * length, along)
            b.add_joint(joint, "continuous", parent=parent, child=body, axis=Z, translation=start)
        b.add_loop(f"corner{k}", "point", body_a=f"distal{k}", translation_a=end, body_b="disc", translation_b=corner)
    return b.build()


# Andrews' squeezing mechanism

_A, _B, _C = (-0.06934, -0.00227, 0.0), (-0.03635, 0.03273, 0.0), (0.014, 0.072, 0.0)
#: Coordinate, its published value at the start, what carries the body and where; then the body's mass, centre of mass
#: and moment of inertia.
_SQUEEZER: Final = (
    ("beta", -0.0617138900142764496358948458001, "world", (0.0, 0.0, 0.0), 0.04325, (0.00092, 0.0), 2.194e-6),
    ("Theta", 0.0, "K1", (0.007, 0.0, 0.0), 0.00365, (-0.0115, 0.0), 4.41e-7),
    ("gamma", 0.455279819163070380255912382449, "world", _B, 0.02373, (0.01043, -0.01874), 5.255e-6),
    ("Phi", 0.222668390165885884674473185609, "K5", (0.04, 0.0, 0.0), 0.00706, (0.0, 0.01421 - 0.02), 5.667e-7),
    ("delta", 0.487364979543842550225598953530, "world", _A, 0.0705, (0.02308, 0.00916), 1.169e-5),
    ("Omega", -0.222668390165885884674473185609, "K7", (0.0, -0.04, 0.0), 0.00706, (0.02 - 0.01421, 0.0), 5.667e-7),
    ("epsilon", 1.23054744454982119249735015568, "world", _A, 0.05498, (-0.00449, -0.01228), 1.912e-5),
)


@system
def andrews_squeezer(*, stiffness: Number = 4530.0, rest_length: Number = 0.07785) -> Model:
    """Return Andrews' squeezing mechanism: seven bodies in the x-y plane with three loops, without gravity.

    The crank K1 turns about the origin and pushes, by K2, the common end of three chains: K3, which turns about B; K4
    on K5, and K6 on K7, which both turn about A. The loops ``K3``, ``K4``, ``K6`` join the end of K2 to the body of
    that name, and a spring pulls K3 from the point C of the ground. Seven coordinates, with one degree of freedom:
    ``beta``, ``Theta``, ``gamma``, ``Phi``, ``delta``, ``Omega``, ``epsilon``, the source's angles less their published
    values at the start, which is the neutral pose. The motor's torque stands in the first entry of the generalized
    forces; the benchmark has 0.033 N m there, constant, from rest to t = 0.03 s. Its geometry, masses and moments of
    inertia are fixed.

    References
    ----------
    Schiehlen 1990, Multibody Systems Handbook; Hairer, Wanner 1996, Solving Ordinary Differential Equations II, section
    VII.7; Mazzia, Magherini 2008, Test Set for Initial Value Problem Solvers, problem andrews, whose numbers these are;
    IFToMM library of computational benchmark problems, A03, which starts elsewhere.
    """
    b = ModelBuilder("andrews_squeezer", gravity=(0.0, 0.0, 0.0))
    for k, (name, angle, parent, start, mass, (x, y), inertia) in enumerate(_SQUEEZER, 1):
        b.add_body(f"K{k}", mass=mass, com=(x, y, 0.0), inertia=(0.0, inertia, inertia))
        place: dict[str, Any] = {"parent": parent, "translation": start, "rpy": (0.0, 0.0, angle)}
        b.add_joint(name, "continuous", child=f"K{k}", axis=Z, **place)
    for body, end in (("K3", (0.0, -0.035, 0.0)), ("K4", (0.0, -0.02, 0.0)), ("K6", (0.02, 0.0, 0.0))):
        b.add_loop(body, "point", body_a="K2", translation_a=(-0.028, 0.0, 0.0), body_b=body, translation_b=end)
    ends: dict[str, Any] = {"body_a": "K3", "point_a": (0.02, -0.018, 0.0), "body_b": "world", "point_b": _C}
    b.add_spring("spring", stiffness=stiffness, rest_length=rest_length, **ends)
    return b.build()
