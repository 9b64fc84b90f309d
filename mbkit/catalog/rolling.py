"""Systems that roll or glide without slip: a disc, Chaplygin's sleigh, and a bicycle.

The ground is the plane z = 0, gravity along -z. In its neutral pose each stands upright on the ground, facing +x.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import Final

from mbkit.catalog._system import Vector, X, Y, Z, acute, down, finite, nonnegative, point, system
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["bicycle", "chaplygin_sleigh", "rolling_disc"]

#: Joints that carry a body anywhere in any attitude but those of a gimbal lock, which is a lean by a right angle.
_CARRIERS: Final = (
    ("x", "prismatic", X),
    ("y", "prismatic", Y),
    ("z", "prismatic", Z),
    ("yaw", "continuous", Z),
    ("lean", "continuous", X),
)


def _carry(b: ModelBuilder, body: str, last: str, height: Number) -> None:
    """Add the joints that carry a body from a height above the ground, the last one about +y, and frames between."""
    parent, place = "world", (0.0, 0.0, height)
    for name, kind, axis in _CARRIERS:
        b.add_body(f"{name} carrier")
        b.add_joint(name, kind, parent=parent, child=f"{name} carrier", axis=axis, translation=place)
        parent, place = f"{name} carrier", (0.0, 0.0, 0.0)
    b.add_joint(last, "continuous", parent=parent, child=body, axis=Y)


@system
def rolling_disc(
    *, radius: Number = 0.5, mass: Number = 1.0, axial: Number = 0.125, across: Number = 0.0625, gravity: Number = 9.81
) -> Model:
    """Return a thin disc that rolls on the ground without slip: a coin, or a hoop.

    Six coordinates: ``x``, ``y``, ``z`` of its centre from (0, 0, radius), ``yaw`` about +z, ``lean`` about the heading
    and ``spin`` about its axis, +y at zero. Rolling ahead, spin grows; a lean to the right is positive. `axial` and
    `across` are the moments of inertia about its axis and a diameter; by default those of a homogeneous disc. Three
    degrees of freedom of velocity, five of configuration. The contact is ``floor``.

    Notes
    -----
    With the rates ψ̇ of yaw and φ̇ of spin and a constant lean θ the disc moves on a circle where

        (axial + m R²) (φ̇ + ψ̇ sin θ) ψ̇ cos θ - across ψ̇² sin θ cos θ + m g R sin θ = 0.

    Upright it rolls stably along a line if φ̇² > m g R across / ((axial + m R²) axial), and the small lean
    then swings with the frequency (φ̇² (axial + m R²) axial / across - m g R)½ / (across + m R²)½. At the default
    values a speed of R φ̇ = (g R / 3)½ is critical; of a hoop it is (g R / 4)½.

    References
    ----------
    Neimark and Fufaev 1972, Dynamics of Nonholonomic Systems, on the rolling disc; O'Reilly 1996, The dynamics of
    rolling disks and sliding disks, Nonlinear Dynamics 10.
    """
    b = ModelBuilder("rolling_disc", gravity=down(gravity))
    b.add_body("disc", mass=mass, inertia=(across, axial, across))
    _carry(b, "disc", "spin", radius)
    b.add_rolling("floor", "disc", body_a="disc", radius=radius, axis_a=Y)
    return b.build()


@system(offset=nonnegative)
def chaplygin_sleigh(*, mass: Number = 1.0, inertia: Number = 0.5, offset: Number = 0.3) -> Model:
    """Return a sleigh on a smooth level ground, with one blade that does not slip sideways.

    One planar joint, ``glide``: x and y of the blade's point, and the heading θ. The centre of mass stands `offset`
    ahead of the blade, and `inertia` is the moment about it. Two degrees of freedom of velocity, three of
    configuration. The blade is ``blade``.

    Notes
    -----
    With the speed u along the blade and the rate ω of the heading, a = offset and I = inertia + mass a²:

        u̇ = a ω²,   ω̇ = -(mass a / I) u ω.

    The energy E = ½ mass u² + ½ I ω² stays, and u = U tanh(k U (t - t₀)), ω = ±(mass / I)½ U / cosh(k U (t - t₀)) with
    U = (2 E / mass)½, k = mass a / I: the sleigh turns until its centre of mass leads, and then runs straight.

    References
    ----------
    Chaplygin 1911, On the theory of motion of nonholonomic systems, the reducing-multiplier theorem, in translation in
    Regular and Chaotic Dynamics 13 (2008); Bloch 2015, Nonholonomic Mechanics and Control, ch. 1.7.
    """
    b = ModelBuilder("chaplygin_sleigh", gravity=(0.0, 0.0, 0.0))
    b.add_body("sleigh", mass=mass, com=(offset, 0.0, 0.0), inertia=(inertia / 2, inertia / 2, inertia))
    b.add_joint("glide", "planar", parent="world", child="sleigh")
    b.add_blade("blade", body_a="sleigh", axis_a=Y)
    return b.build()


@system(
    trail=finite,
    tilt=acute,
    rear_com=point,
    front_com=point,
    rear_inertia=point,
    front_inertia=point,
    rear_product=finite,
    front_product=finite,
)
def bicycle(
    *,
    wheelbase: Number = 1.02,
    trail: Number = 0.08,
    tilt: float = pi / 10,
    rear_radius: Number = 0.3,
    rear_wheel_mass: Number = 2.0,
    rear_wheel_across: Number = 0.0603,
    rear_wheel_axial: Number = 0.12,
    rear_com: Vector = (0.3, 0.0, 0.9),
    rear_mass: Number = 85.0,
    rear_inertia: Vector = (9.2, 11.0, 2.8),
    rear_product: Number = -2.4,
    front_com: Vector = (0.9, 0.0, 0.7),
    front_mass: Number = 4.0,
    front_inertia: Vector = (0.05892, 0.06, 0.00708),
    front_product: Number = 0.00756,
    front_radius: Number = 0.35,
    front_wheel_mass: Number = 3.0,
    front_wheel_across: Number = 0.1405,
    front_wheel_axial: Number = 0.28,
    gravity: Number = 9.81,
) -> Model:
    """Return Whipple's bicycle: a rear frame with a rigid rider, a front frame with the handlebar, and two wheels.

    Nine coordinates: ``x``, ``y``, ``z`` of the rear wheel's centre from (0, 0, rear_radius); the rear frame's ``yaw``
    about +z, ``lean`` about its heading, positive to the right, and ``pitch`` about +y; ``rear_spin``; ``steer`` of the
    front frame about the axis that points down at an angle `tilt` from the vertical, positive to the right; and
    ``front_spin``. Rolling ahead, both spins grow. Three degrees of freedom of velocity and seven of configuration. The
    contacts are ``rear`` and ``front``.

    The rear contact is the origin of the centres of mass, `rear_com` and `front_com`, in the neutral pose: x ahead, z
    up. `trail` is how far the steering axis meets the ground ahead of the front contact. Moments of inertia are about
    centres of mass, along x, y, z; `rear_product` and `front_product` are -∫ x z dm, z upwards.

    Notes
    -----
    The default values are the benchmark's. Upright and straight ahead the speed v is rear_radius rear_spin; the motion
    is stable from the weave speed, 4.29 m/s, to the capsize speed, 6.02 m/s.

    References
    ----------
    Meijaard, Papadopoulos, Ruina, Schwab 2007, Linearized dynamics equations for the balance and steer of a bicycle: a
    benchmark and review, Proceedings of the Royal Society A 463, 1955-1982; its z-axis points down.
    """
    b = ModelBuilder("bicycle", gravity=down(gravity))
    c, s = cos(tilt), sin(tilt)
    # Origin of the front frame: the point of the steering axis at the height of the front hub.
    ahead = wheelbase + trail - front_radius * (s / c)
    for name, mass, com, inertia, product, at in (
        ("rear frame", rear_mass, rear_com, rear_inertia, rear_product, (0.0, rear_radius)),
        ("front frame", front_mass, front_com, front_inertia, front_product, (ahead, front_radius)),
    ):
        (x, y, z), (xx, yy, zz) = point("com", com), point("inertia", inertia)
        matrix = [[xx, 0.0, product], [0.0, yy, 0.0], [product, 0.0, zz]]
        b.add_body(name, mass=mass, com=(x - at[0], y, z - at[1]), inertia=matrix)
    rear = rear_wheel_across, rear_wheel_axial, rear_wheel_across
    front = front_wheel_across, front_wheel_axial, front_wheel_across
    b.add_body("rear wheel", mass=rear_wheel_mass, inertia=rear)
    b.add_body("front wheel", mass=front_wheel_mass, inertia=front)
    _carry(b, "rear frame", "pitch", rear_radius)
    b.add_joint("rear_spin", "continuous", parent="rear frame", child="rear wheel", axis=Y)
    place = (ahead, 0.0, front_radius - rear_radius)
    b.add_joint("steer", "continuous", parent="rear frame", child="front frame", axis=(s, 0.0, -c), translation=place)
    hub = (wheelbase - ahead, 0.0, 0.0)
    b.add_joint("front_spin", "continuous", parent="front frame", child="front wheel", axis=Y, translation=hub)
    b.add_rolling("rear", "disc", body_a="rear wheel", radius=rear_radius, axis_a=Y)
    b.add_rolling("front", "disc", body_a="front wheel", radius=front_radius, axis_a=Y)
    return b.build()
