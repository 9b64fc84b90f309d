"""Beams of hinged segments, and spacecraft with wheels or with such beams."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array, shown
from mbkit.catalog._parameters import Vector, moments, nonnegative, point, system
from mbkit.errors import InputError
from mbkit.model import Model, ModelBuilder, Number

# A bending beam as rigid segments.
#
# n equal thin rods of length h stand behind a stub of length a h that belongs to what the beam is clamped to, so h =
# L/(n + a). Between rods lies a spring EI/h: a hinge's turn δ stands for the curvature δ/h along one h. Such rods carry
# waves with an error of h⁴, since the rods' inertia errs by the same 1 - (k h)²/6 as the springs; what errs by h² is
# the clamped end. The first hinge stands for the bending of the stub and half a rod, so its spring is EI/((a + ½) h).
# For a beam with w = c x²/2 + d x³/6 at the wall that leaves, seen from the rods, a displacement -c (a h)²/2 and a
# slope d (3 a² - 1) h²/6 there, which change an eigenvalue by c d (1/6 - a²) h²: by nothing for a = 1/√6. What remains
# is of third order in h.
#
# With a = 0, a spring 2 EI/h at the wall itself, the first frequency of eight segments errs by 7e-3, with
# a = 1/√6 by 1.4e-4.

#: Length of the stub in lengths of a segment.
_STUB: Final = 6**-0.5

#: Limit of a segment's turn, rad: lumping is valid below; random states stay there.
_BEND: Final = 0.2

#: Half a turn about +z.
_BACKWARDS: Final = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))


def _add_beam(
    b: ModelBuilder,
    name: str,
    *,
    segments: int,
    length: Number,
    mass: Number,
    bending_stiffness: Number,
    parent: str,
    root: Number = 0.0,
    backwards: bool = False,
) -> None:
    """Add a beam's segments in the x-y plane, hinged about +z, from `root` along ±x of the parent; the stub is its."""
    h = length / (segments + _STUB)
    share = mass / (segments + _STUB)
    across = share * h**2 / 12
    for i in range(1, segments + 1):
        b.add_body(f"{name} segment{i}", mass=share, com=(h / 2, 0.0, 0.0), inertia=(0.0, across, across))
        first = i == 1
        reach = root + _STUB * h if first else h
        turned = first and backwards
        b.add_joint(
            f"{name}{i}",
            "revolute",
            parent=parent if first else f"{name} segment{i - 1}",
            child=f"{name} segment{i}",
            axis=(0.0, 0.0, 1.0),
            translation=(-reach if turned else reach, 0.0, 0.0),
            rotation=_BACKWARDS if turned else None,
            stiffness=bending_stiffness / ((_STUB + 0.5) * h if first else h),
            lower=-_BEND,
            upper=_BEND,
        )
    b.add_frame(f"{name} tip", body=f"{name} segment{segments}", translation=(h, 0.0, 0.0))


@system
def clamped_beam(
    *, segments: int = 8, length: Number = 10.0, mass: Number = 20.0, bending_stiffness: Number = 1500.0
) -> Model:
    """Return a uniform beam that is clamped to the world, lumped as hinged rigid segments with torsion springs.

    It bends in the x-y plane, without gravity. Coordinates: ``bend1``, ``bend2`` ... , the turn of each
    segment about +z from the one before, from the clamped end. At zero the beam lies
    straight along +x from the origin and its springs are at rest.

    Parameters
    ----------
    segments : int
        Number of segments.
    length, mass : float or Parameter
        Of the whole beam, m and kg.
    bending_stiffness : float or Parameter
        E I, N m².

    Notes
    -----
    Segments of length h = length/(segments + 1/√6) begin behind a stub of h/√6 that
    does not move. Between them stand springs E I/h, and E I/((1/√6 + ½) h) at the first hinge:
    the choice for which the frequencies converge with h³ to (β L)² √(E I length/mass)/length², cos βL cosh βL = -1.
    Eight segments have the first three frequencies with errors of 1e-4, 2e-3 and 4e-3. The joints' limits of ±0.2 rad
    are data: within them lumping makes sense, and nothing enforces them.

    References
    ----------
    Timoshenko, Young, Weaver 1974, Vibration Problems in Engineering, ch. 5, for the beam.
    """
    b = ModelBuilder("clamped_beam", gravity=(0.0, 0.0, 0.0))
    _add_beam(
        b, "bend", segments=segments, length=length, mass=mass, bending_stiffness=bending_stiffness, parent="world"
    )
    return b.build()


#: Four wheels on a pyramid, of which any three suffice.
_PYRAMID = ((1.0, 0.0, 1.0), (0.0, 1.0, 1.0), (-1.0, 0.0, 1.0), (0.0, -1.0, 1.0))


def _axes(name: str, value: ArrayLike) -> Array:
    """Return unit vectors, (n, 3)."""
    try:
        shape = np.shape(value)
    except ValueError:
        raise InputError(f"{name}: expected shape (n, 3), got rows of different lengths") from None
    if len(shape) != 2 or not shape[0] or shape[1] != 3:
        raise InputError(f"{name}: expected shape (n, 3) with n of at least 1, got {shape}")
    axes = finite_array(name, value, (shape[0], 3))
    lengths = np.linalg.norm(axes, axis=1)
    if not lengths.all():
        raise InputError(f"{name}: expected axes of some length, got zeros at index {int(np.argmin(lengths))}")
    return np.asarray(axes / lengths[:, None])


def _planar_or_free(name: str, value: object) -> str:
    if not isinstance(value, str) or value not in ("planar", "free"):
        raise InputError(f"{name}: expected 'planar' or 'free', got {shown(value)}")
    return value


@system(hub_inertia=moments, wheel_axes=_axes, wheel_distance=nonnegative)
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

    One free joint, ``base``: q is the hub's centre and the quaternion (x, y, z, w), v the linear then angular velocity
    in body axes; then ``wheel1``, ``wheel2`` ... , the turn of each wheel about its axis. The wheels are thin discs
    about axes through the hub's centre. A wheel's motor torque stands in its own entry of the generalized forces; what
    acts on the hub is its reaction, by itself.

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

    References
    ----------
    Hughes 1986, Spacecraft Attitude Dynamics, on gyrostats; Wie 2008, Space Vehicle Dynamics and
    Control, on reaction wheels and their pyramid. The default values are those of a small satellite.
    """
    b = ModelBuilder("spacecraft_with_wheels", gravity=(0.0, 0.0, 0.0))
    b.add_body("hub", mass=hub_mass, inertia=hub_inertia)
    b.add_joint("base", "free", parent="world", child="hub")
    for i, axis in enumerate(np.asarray(wheel_axes), start=1):
        share = (np.eye(3) + np.outer(axis, axis)) / 2
        b.add_body(f"disc{i}", mass=wheel_mass, inertia=[[x * wheel_inertia for x in row] for row in share.tolist()])
        b.add_joint(
            f"wheel{i}",
            "continuous",
            parent="hub",
            child=f"disc{i}",
            axis=axis,
            translation=[x * wheel_distance for x in axis.tolist()],
        )
    return b.build()


@system(hub=_planar_or_free, hub_inertia=moments, hub_radius=nonnegative)
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

    Notes
    -----
    The stub of h/√6 behind which each beam's segments begin is part of the hub's body, so mass and inertia of
    the straight spacecraft are those of the whole beams.

    References
    ----------
    Junkins, Kim 1993, Introduction to Dynamics and Control of Flexible Structures, for the hub with two appendages. The
    default values are those of no particular craft; the beams' first frequency, clamped, is 0.96 rad/s.
    """
    along, across, about = point("hub_inertia", hub_inertia)
    stub, share = _STUB / (segments + _STUB) * length, _STUB / (segments + _STUB) * mass
    # Two thin rods of length `stub` from the radius outwards.
    added = 2 * share * ((hub_radius + stub / 2) ** 2 + stub**2 / 12)
    b = ModelBuilder("flexible_spacecraft", gravity=(0.0, 0.0, 0.0))
    b.add_body("hub body", mass=hub_mass + 2 * share, inertia=(along, across + added, about + added))
    b.add_joint("hub", hub, parent="world", child="hub body")
    for name in ("right", "left"):
        _add_beam(
            b,
            name,
            segments=segments,
            length=length,
            mass=mass,
            bending_stiffness=bending_stiffness,
            parent="hub body",
            root=hub_radius,
            backwards=name == "left",
        )
    return b.build()
