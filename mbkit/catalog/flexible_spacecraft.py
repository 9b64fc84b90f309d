"""The spacecraft with two flexible appendages."""

from __future__ import annotations

from typing import Literal

from mbkit._check import shown
from mbkit.catalog._beam import STUB, add_beam
from mbkit.catalog._parameters import Vector, count, moments, nonnegative, positive
from mbkit.errors import InputError
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["flexible_spacecraft"]


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
