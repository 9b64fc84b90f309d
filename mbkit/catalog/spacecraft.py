"""The spacecraft with reaction wheels."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array, shown
from mbkit.catalog._parameters import Vector, count, moments, nonnegative, positive
from mbkit.catalog.beams import STUB, add_beam
from mbkit.errors import InputError
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["flexible_spacecraft", "spacecraft_with_wheels"]


#: Four wheels on a pyramid, of which any three suffice.
_PYRAMID = ((1.0, 0.0, 1.0), (0.0, 1.0, 1.0), (-1.0, 0.0, 1.0), (0.0, -1.0, 1.0))


def spacecraft_with_wheels(
    *,
    hub_mass: Number = 50.0,
    hub_inertia: Vector = (4.0, 5.0, 3.0),
    wheel_axes: ArrayLike = _PYRAMID,
    wheel_mass: Number = 1.0,
    wheel_inertia: Number = 0.01,
    wheel_distance: Number = 0.2,
) -> Model:
    """Return a free rigid body that carries equal reaction wheels, without gravity.

    One free joint, ``base``: q is the hub's centre and the quaternion (x, y, z, w), v the linear then
    angular velocity in body axes; then ``wheel1``, ``wheel2`` ... , the turn of each wheel about
    its axis. The wheels are thin discs about axes through the hub's centre. A wheel's motor
    torque stands in its own entry of the generalized forces; what acts on the hub is its
    reaction, by itself.

    Parameters
    ----------
    hub_mass, wheel_mass : float or Parameter
        kg, without the wheels and of each wheel.
    hub_inertia : (3,) array_like
        Principal moments of the hub without the wheels about its centre, kg m².
    wheel_axes : (n, 3) array_like
        Axes of the wheels in body axes, of any length.
    wheel_inertia : float or Parameter
        Of each wheel about its axis, kg m²; across it is half of that.
    wheel_distance : float or Parameter
        Of each wheel's centre from the hub's centre, along its axis, m.

    Raises
    ------
    InputError
        A parameter that is not finite, has the wrong sign, moments that no
        body has, or an axis of no length.

    References
    ----------
    Hughes 1986, Spacecraft Attitude Dynamics, on gyrostats; Wie 2008, Space Vehicle Dynamics and
    Control, on reaction wheels and their pyramid. The default values are those of a small satellite.
    """
    axes = _axes(wheel_axes)
    mass, axial = positive("wheel_mass", wheel_mass), positive("wheel_inertia", wheel_inertia)
    distance = nonnegative("wheel_distance", wheel_distance)
    b = ModelBuilder("spacecraft_with_wheels", gravity=(0.0, 0.0, 0.0))
    b.add_body("hub", mass=positive("hub_mass", hub_mass), inertia=moments("hub_inertia", hub_inertia))
    b.add_joint("base", "free", parent="world", child="hub")
    for i, axis in enumerate(axes, start=1):
        share = (np.eye(3) + np.outer(axis, axis)) / 2
        b.add_body(f"disc{i}", mass=mass, inertia=[[x * axial for x in row] for row in share.tolist()])
        b.add_joint(
            f"wheel{i}",
            "continuous",
            parent="hub",
            child=f"disc{i}",
            axis=axis,
            translation=[x * distance for x in axis.tolist()],
        )
    return b.build()


def _axes(value: ArrayLike) -> Array:
    """Return unit vectors, (n, 3)."""
    try:
        given = np.shape(value)
    except ValueError:
        raise InputError("wheel_axes: expected shape (n, 3), got rows of different lengths") from None
    if len(given) != 2 or not given[0] or given[1] != 3:
        raise InputError(f"wheel_axes: expected shape (n, 3) with n of at least 1, got {given}")
    axes = finite_array("wheel_axes", value, (given[0], 3))
    lengths = np.linalg.norm(axes, axis=1)
    if not lengths.all():
        raise InputError(f"wheel_axes: expected axes of some length, got zeros at index {int(np.argmin(lengths))}")
    return np.asarray(axes / lengths[:, None])


# The spacecraft with two flexible appendages.


def flexible_spacecraft(
    *,
    segments: int = 8,
    hub: Literal["planar", "free"] = "planar",
    hub_mass: Number = 500.0,
    hub_inertia: Vector = (200.0, 200.0, 300.0),
    hub_radius: Number = 1.0,
    length: Number = 10.0,
    mass: Number = 20.0,
    bending_stiffness: Number = 1500.0,
) -> Model:
    """Return a hub that floats without gravity and carries two cantilevered beams, each lumped as `clamped_beam`.

    First the joint ``hub``, planar (x, y and the turn about +z) or free; then ``right1``, ``right2`` ... , the turn
    of each segment of the beam along +x from the one before, about the hub's +z, and ``left1`` ...
    of the beam along -x. At zero the hub's centre is at the origin, both beams are straight and their springs at
    rest. They bend in the hub's x-y plane.

    Parameters
    ----------
    segments : int
        Of each beam.
    hub : {"planar", "free"}
        The hub's joint.
    hub_mass : float or Parameter
        kg.
    hub_inertia : (3,) array_like
        Principal moments of the hub alone about its centre, kg m²; in the plane only the third counts.
    hub_radius : float or Parameter
        Distance of the beams' roots from the hub's centre, m.
    length, mass : float or Parameter
        Of each beam, m and kg.
    bending_stiffness : float or Parameter
        E I of each beam, N m².

    Raises
    ------
    InputError
        A parameter that is not finite, has the wrong sign, or moments that no
        body has.

    Notes
    -----
    The stub of h/√6 behind which each beam's segments begin is part of the hub's body, so mass and inertia of
    the straight spacecraft are those of the whole beams.

    References
    ----------
    Junkins, Kim 1993, Introduction to Dynamics and Control of Flexible Structures, for the
    hub with two appendages. The default values are those of no particular craft; the beams' first
    frequency, clamped, is 0.96 rad/s.
    """
    if not isinstance(hub, str) or hub not in ("planar", "free"):
        raise InputError(f"hub: expected 'planar' or 'free', got {shown(hub)}")
    n, centre = count("segments", segments), positive("hub_mass", hub_mass)
    radius, reach, matter = nonnegative("hub_radius", hub_radius), positive("length", length), positive("mass", mass)
    stiffness = positive("bending_stiffness", bending_stiffness)
    along, across, about = moments("hub_inertia", hub_inertia)
    stub, share = STUB / (n + STUB) * reach, STUB / (n + STUB) * matter
    # Two thin rods of length `stub` from the radius outwards.
    added = 2 * share * ((radius + stub / 2) ** 2 + stub**2 / 12)
    b = ModelBuilder("flexible_spacecraft", gravity=(0.0, 0.0, 0.0))
    b.add_body("hub body", mass=centre + 2 * share, inertia=(along, across + added, about + added))
    b.add_joint("hub", hub, parent="world", child="hub body")
    for name in ("right", "left"):
        add_beam(
            b,
            name,
            segments=n,
            length=reach,
            mass=matter,
            bending_stiffness=stiffness,
            parent="hub body",
            root=radius,
            backwards=name == "left",
        )
    return b.build()
