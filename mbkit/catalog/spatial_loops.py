"""Spatial mechanisms with closed loops: Bricard's, a governor, a shaft with two joints, parallel robots.

As in `mbkit.catalog.planar_loops` the neutral pose is closed, and the axes of all bodies are the world's there.
"""

from __future__ import annotations

from math import cos, pi, sin, tau
from typing import Any, Final

import numpy as np

from mbkit.catalog._system import (
    THIRDS,
    TURN,
    Point,
    X,
    Y,
    Z,
    acute,
    add_pin,
    add_rod,
    at,
    down,
    leg,
    nonnegative,
    number,
    system,
    times,
)
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["bricard", "delta_robot", "double_cardan_shaft", "flyball_governor", "stewart_platform"]

#: Half the angle between two feet of a Stewart platform, or two joints, that stand together.
_HALF_PAIR_ANGLE: Final = pi / 18


@system(width=nonnegative)
def bricard(*, length: Number = 1.0, width: Number = 0.1, mass: Number = 1.0, gravity: Number = 9.81) -> Model:
    """Return Bricard's rectangular mechanism: six equal bars on six hinges, each square to the next one.

    The sixth bar is the ground. The others go along edges of a cube: from the origin along +x, -z, -y, -x, +z to (0,
    -length, 0), with hinges about z, y, x, z, y, x at the six corners. `length`, `mass` and the square section's
    `width` are those of each bar. Six coordinates, with one degree of freedom: ``q1``, ``q2``, ``q3`` from the origin
    on, and ``q6``, ``q5``, ``q4`` from the other end, the turns of the hinges about +z, +y, +x. Both chains hold one
    half of the third moving bar, and the loop ``middle`` welds the halves.

    Notes
    -----
    Redundant: a loop of six hinges has six conditions and, in general, no freedom left. Here five of them are
    independent. At zero the potential energy is -3 mass gravity length, from the origin.

    References
    ----------
    Bricard 1897, Mémoire sur la théorie de l'octaèdre articulé; IFToMM library of computational benchmark problems, A04
    (rectangular Bricard's mechanism), whose -y is down and whose z is -y here.
    """
    b = ModelBuilder("bricard", gravity=down(gravity))
    # Joint, its axis, body, length in bars and direction, and the joint's place in the bar before.
    first = (
        ("q1", Z, "bar1", 1.0, X, (0.0, 0.0, 0.0)),
        ("q2", Y, "bar2", 1.0, times(-1.0, *Z), (length, 0.0, 0.0)),
        ("q3", X, "half1", 0.5, times(-1.0, *Y), (0.0, 0.0, -length)),
    )
    last = (
        ("q6", X, "bar5", 1.0, times(-1.0, *Z), (0.0, -length, 0.0)),
        ("q5", Y, "bar4", 1.0, X, (0.0, 0.0, -length)),
        ("q4", Z, "half2", 0.5, Y, (length, 0.0, 0.0)),
    )
    for chain in (first, last):
        parent = "world"
        for joint, axis, body, part, along, start in chain:
            across = mass * part * ((length * part) ** 2 + width**2) / 12
            moments = [mass * part * width**2 / 6 if x else across for x in along]
            b.add_body(body, mass=mass * part, com=times(length * (part / 2), *along), inertia=moments)
            b.add_joint(joint, "continuous", parent=parent, child=body, axis=axis, translation=start)
            parent = body
    ends: dict[str, Any] = {"translation_a": (0.0, -length / 2, 0.0), "translation_b": (0.0, length / 2, 0.0)}
    b.add_loop("middle", "frame", body_a="half1", body_b="half2", **ends)
    return b.build()


@system
def flyball_governor(
    *,
    arm: Number = 1.0,
    height: Number = 1.0,
    offset: Number = 0.05,
    density: Number = 0.3,
    ball_mass: Number = 5.0,
    sleeve_mass: Number = 3.0,
    gravity: Number = 9.81,
) -> Model:
    """Return the centrifugal governor: a shaft turns two arms with balls, and two links lift a sleeve by them.

    The shaft stands along z. At the height `height` two arms of length `arm` are hinged, `offset` from its axis, with
    point masses at their ends. Links of half that length join the arms' middles to the sleeve, `offset` from the axis
    too, by the loops ``pin1`` and ``pin2``. Shaft, arms and links are thin rods of `density`, the sleeve is a point
    mass. Six coordinates, with two degrees of freedom: ``turn``, the shaft's turn about +z; ``s``, the sleeve's way up
    from height - arm/2; ``alpha1``, ``alpha2``, the turns of the arms, which raise the balls; ``beta1``, ``beta2``, the
    turns of the links against the arms in the same sense. At zero the arms are 30° below the level, in the x-z plane.

    Notes
    -----
    With the arms' angle γ = 30° - alpha below the level the sleeve is at height - arm sin γ. The balls stay level at
    the turning speed ω with ½ ω² I'(γ) = V'(γ): moment of inertia about z and potential energy.

    References
    ----------
    Maxwell 1868, On governors; IFToMM library of computational benchmark problems, A05 (stiff flyball governor), whose
    numbers these are, but that its sleeve is a cube and that it has stiff springs in place of the links; it starts with
    ω = 2 π rad/s.
    """
    b = ModelBuilder("flyball_governor", gravity=down(gravity))
    half = arm / 2
    add_rod(b, "shaft", density * height, (0.0, 0.0, height))
    b.add_body("sleeve", mass=sleeve_mass)
    b.add_joint("turn", "continuous", parent="world", child="shaft", axis=Z)
    b.add_joint("s", "prismatic", parent="shaft", child="sleeve", axis=Z, translation=at((0.0, height - half)))
    for k, side in ((1, 1.0), (2, -1.0)):
        mass = density * arm + ball_mass
        # The ball is at the end of the arm: reduced mass times the square of the distance of the two centres.
        lever = (density * arm / 2 + ball_mass) / mass
        across = arm**2 * (density * arm / 12 + density * arm * ball_mass / mass / 4)
        # 30° below the level.
        out = (side * 0.75**0.5, -0.5)
        inertia = [[across * (float(i == j) - at(out)[i] * at(out)[j]) for j in range(3)] for i in range(3)]
        b.add_body(f"arm{k}", mass=mass, com=at(times(arm * lever, *out)), inertia=inertia)
        add_rod(b, f"link{k}", density * half, at(times(half, -out[0], out[1])))
        hinge: dict[str, Any] = {"kind": "continuous", "axis": times(side, *TURN)}
        b.add_joint(f"alpha{k}", parent="shaft", child=f"arm{k}", translation=at((side * offset, height)), **hinge)
        middle = at(times(half, *out))
        b.add_joint(f"beta{k}", parent=f"arm{k}", child=f"link{k}", translation=middle, **hinge)
        add_pin(b, f"pin{k}", f"link{k}", times(half, -out[0], out[1]), "sleeve", (side * offset, 0.0))
    return b.build()


@system(angle=acute)
def double_cardan_shaft(
    *,
    length: Number = 0.6,
    shaft: Number = 0.2,
    radius: Number = 0.02,
    density: Number = 10.0,
    angle: float = 0.5,
    gravity: Number = 9.81,
) -> Model:
    """Return a shaft with two universal joints between two parallel shafts, which turns one as fast as the other.

    The input shaft lies on the x axis and ends in the origin; the intermediate one, of the nominal length `length`,
    rises from there at `angle`, in the x-z plane; the output shaft goes on along x from its end. All are solid round
    rods of one radius, `shaft` is the length of input and output. The intermediate shaft is three equal parts: the
    front, a spline in it, and the rear, which hangs on the output. The loop ``weld`` joins the spline to the rear.
    Seven coordinates, with one degree of freedom: ``theta1`` and ``theta2``, the turns of input and output about +x;
    ``cross1`` and ``cross2``, the two turns of each joint's cross: about the fork of the input (or output), which is
    along y at zero, and about that of the intermediate shaft; ``slide``, the spline's way out.

    Notes
    -----
    One universal joint turns the intermediate shaft by tan φ = cos(angle) tan θ, from this start. Two forks of the
    intermediate shaft in one plane, and equal angles, take this back: theta2 = theta1 in every pose, and the spline
    does not move.

    References
    ----------
    Seherr-Thoss, Schmelz, Aucktor 2006, Universal Joints and Driveshafts, ch. 1 and 2.
    """
    b = ModelBuilder("double_cardan_shaft", gravity=down(gravity))
    c, s = cos(angle), sin(angle)
    along, fork = (c, 0.0, s), (-s, 0.0, c)
    third: Point = times(length / 3, *along)
    back: Point = times(-1.0, *third)
    add_rod(b, "input", density * shaft, (-shaft, 0.0, 0.0), radius)
    add_rod(b, "output", density * shaft, (shaft, 0.0, 0.0), radius)
    for name, vector in (("front", third), ("spline", third), ("rear", back)):
        add_rod(b, name, density * (length / 3), vector, radius)
    b.add_joint("theta1", "continuous", parent="world", child="input", axis=X)
    b.add_joint("cross1", "universal", parent="input", child="front", axis=Y, axis2=fork)
    b.add_joint("slide", "prismatic", parent="front", child="spline", axis=along, translation=third)
    b.add_joint("theta2", "continuous", parent="world", child="output", axis=X, translation=times(length, *along))
    b.add_joint("cross2", "universal", parent="output", child="rear", axis=Y, axis2=fork)
    b.add_loop("weld", "frame", body_a="spline", translation_a=third, body_b="rear", translation_b=back)
    return b.build()


# Parallel robots


def _add_platform(b: ModelBuilder, mass: Number, radius: Number, height: Number) -> None:
    """Add a homogeneous disc that is free in space: its way along x, y, z, and three turns."""
    across = mass * radius**2 / 4
    b.add_body("x carrier")
    b.add_body("y carrier")
    b.add_body("z carrier")
    b.add_body("platform", mass=mass, inertia=(across, across, 2 * across))
    b.add_joint("x", "prismatic", parent="world", child="x carrier", axis=X, translation=(0.0, 0.0, height))
    b.add_joint("y", "prismatic", parent="x carrier", child="y carrier", axis=Y)
    b.add_joint("z", "prismatic", parent="y carrier", child="z carrier", axis=Z)
    b.add_joint("turn", "spherical_zyx", parent="z carrier", child="platform")


@system(base_radius=number, platform_radius=number, height=number)
def stewart_platform(
    *,
    base_radius: float = 0.5,
    platform_radius: float = 0.3,
    height: float = 0.6,
    leg_mass: Number = 1.0,
    platform_mass: Number = 10.0,
    gravity: Number = 9.81,
) -> Model:
    """Return the platform of Gough and Stewart: a disc on six legs that change their lengths.

    The feet are in the plane z = 0 at `base_radius`, at the angles ∓10° from 0°, 120°, 240°; the platform's joints at
    `platform_radius`, at ∓10° from 60°, 180°, 300°, in its own x-y plane; leg 1 goes from +10° to 50°, leg 2 from 110°
    to 70° and so on. A leg is two thin rods of mass `leg_mass`, each half as long as the leg at zero, on a universal
    joint about x and y; the loops ``ball1`` ... ``ball6`` are ball joints. 24 coordinates, with six degrees of freedom:
    ``x``, ``y``, ``z`` of the platform from its middle place (0, 0, height), and ``turn``, its angles about z, y', x'';
    of leg k ``swing<k>``, the two turns of its foot, and ``length<k>``, by how much it is longer than at zero.

    Notes
    -----
    length<k> = ‖p + R b - a‖ - ‖p0 + b - a‖ with the foot a, the joint b in the platform's axes, its place p and
    rotation R. The other way round there are up to 40 poses for six lengths.

    References
    ----------
    Stewart 1965, A platform with six degrees of freedom; Merlet 2006, Parallel Robots, ch. 3 and 4 on inverse and
    direct kinematics.
    """
    b = ModelBuilder("stewart_platform", gravity=down(gravity))
    _add_platform(b, platform_mass, platform_radius, height)
    for k in range(1, 7):
        # Two feet about every third of a turn, two joints about the sixth between.
        side = 1.0 if k % 2 else -1.0
        middle = (k // 2) * tau / 3
        foot, joint = (
            np.array([r * cos(angle), r * sin(angle), 0.0])
            for r, angle in (
                (base_radius, middle + side * _HALF_PAIR_ANGLE),
                (platform_radius, middle + side * (pi / 3 - _HALF_PAIR_ANGLE)),
            )
        )
        leg = joint + np.array([0.0, 0.0, height]) - foot
        x, y, z = (leg / 2).tolist()
        for part in ("lower", "upper"):
            add_rod(b, f"{part}{k}", leg_mass, (x, y, z))
        b.add_joint(f"swing{k}", "universal", parent="world", child=f"lower{k}", axis=X, axis2=Y, translation=foot)
        place: dict[str, Any] = {"axis": leg, "translation": leg / 2}
        b.add_joint(f"length{k}", "prismatic", parent=f"lower{k}", child=f"upper{k}", **place)
        ends: dict[str, Any] = {"translation_a": leg / 2, "translation_b": joint}
        b.add_loop(f"ball{k}", "point", body_a=f"upper{k}", body_b="platform", **ends)
    return b.build()


@system
def delta_robot(
    *,
    base_radius: Number = 0.15,
    platform_radius: Number = 0.05,
    arm: Number = 0.2,
    rod: Number = 0.5,
    width: Number = 0.08,
    density: Number = 0.5,
    platform_mass: Number = 0.5,
    gravity: Number = 9.81,
) -> Model:
    """Return Clavel's robot Delta: three arms move a platform that never turns, by a pair of parallel rods each.

    The arms' hinges are at `base_radius` around the z axis, at 0°, 120° and 240°; at zero the arms lie level, pointing
    outwards. Two thin rods of length `rod`, `width` apart, lead from each arm's end down to the platform, a disc with
    its joints at `platform_radius`. Their upper ends are universal joints, and the loops ``ball1a`` ... ``ball3b`` are
    ball joints at their lower ends. 21 coordinates, with three degrees of freedom: ``x``, ``y``, ``z`` of the platform
    from its place at zero, on the z axis, and ``turn``, its angles about z, y', x''; of arm k its turn ``theta<k>``,
    downwards; and the two turns of its rods, ``rod<k>a`` and ``rod<k>b``.

    Notes
    -----
    turn = 0 in every pose in which the pairs are parallelograms. The arms' angles follow from the platform's place p:
    ‖p + platform_radius u - base_radius u - arm (cos θ u - sin θ e_z)‖ = rod with the direction u of the arm, a
    quadratic equation in tan(θ/2).

    References
    ----------
    Clavel 1988, Delta, a fast robot with parallel geometry; Merlet 2006, Parallel Robots, ch. 3 on inverse kinematics.
    """
    reach = base_radius + arm - platform_radius
    b = ModelBuilder("delta_robot", gravity=down(gravity))
    depth = leg("rod, base_radius + arm - platform_radius", rod, reach)
    _add_platform(b, platform_mass, platform_radius, -depth)
    for k, (c, s) in enumerate(THIRDS, 1):
        outwards, level = (c, s, 0.0), (-s, c, 0.0)
        add_rod(b, f"arm{k}", density * arm, times(arm, *outwards))
        start = times(base_radius, *outwards)
        b.add_joint(f"theta{k}", "continuous", parent="world", child=f"arm{k}", axis=level, translation=start)
        for name, aside in ((f"rod{k}a", -width / 2), (f"rod{k}b", width / 2)):
            along = (-c * reach, -s * reach, -depth)
            add_rod(b, name, density * rod, along)
            upper, lower = (
                tuple(r * x + aside * y for x, y in zip(outwards, level, strict=True)) for r in (arm, platform_radius)
            )
            place: dict[str, Any] = {"axis": level, "axis2": outwards, "translation": upper}
            b.add_joint(name, "universal", parent=f"arm{k}", child=name, **place)
            ends: dict[str, Any] = {"translation_a": along, "translation_b": lower}
            b.add_loop(f"ball{name[3:]}", "point", body_a=name, body_b="platform", **ends)
    return b.build()
