"""Single rigid bodies, beams of hinged segments, and spacecraft with wheels or with such beams."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array, shown
from mbkit.catalog._system import Vector, X, Y, Z, down, lengths, moments, nonnegative, point, system
from mbkit.errors import InputError
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["clamped_beam", "flexible_spacecraft", "free_body", "gyroscope", "heavy_top", "spacecraft_with_wheels"]


@system(sides=lengths)
def free_body(*, mass: Number = 10.0, sides: Vector = (0.1, 0.4, 0.9), gravity: Number = 0.0) -> Model:
    """Return a homogeneous box that floats freely.

    One free joint, ``float``: q is the centre's position and the quaternion (x, y, z, w), v the linear then angular
    velocity in body axes. At zero the centre is at the origin and the box's edges, `sides`, lie along the world's axes.

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
    axes. At the identity the body's axes are the world's; with the default `com` the top lies along +y. `inertia` has
    the principal moments about the centre of mass, along the body's axes, and `com` is in body axes.

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
    rotor's axis are one. All gimbals have their centre of mass in the centre, where their mass moves nothing.

    The rotor's moments are about its axis and across it, about its centre of mass, which lies `offset` from the
    gimbals' centre along its axis: 0 is the balanced gyroscope. `inner_inertia` has the inner gimbal's moments about
    its hinge, about the rotor's axis and across both, `outer_inertia` is the outer one's about the vertical.

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 5.7, for the rotor; Magnus 1971, Kreisel, for what
    the gimbals' inertia changes. The default values are those of a classroom gyroscope.
    """
    b = ModelBuilder("gyroscope", gravity=down(gravity))
    b.add_body("outer gimbal", mass=gimbal_mass, inertia=(outer_inertia, outer_inertia, outer_inertia))
    b.add_body("inner gimbal", mass=gimbal_mass, inertia=inner_inertia)
    rotor = moments("rotor_axial", (rotor_across, rotor_axial, rotor_across))
    b.add_body("rotor", mass=rotor_mass, com=(0.0, offset, 0.0), inertia=rotor)
    b.add_joint("precession", "continuous", parent="world", child="outer gimbal", axis=Z)
    b.add_joint("nutation", "continuous", parent="outer gimbal", child="inner gimbal", axis=X)
    b.add_joint("spin", "continuous", parent="inner gimbal", child="rotor", axis=Y)
    return b.build()


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
_STUB_LENGTH_RATIO: Final = 6**-0.5

#: Limit of a segment's turn, rad: lumping is valid below; random states stay there.
_MAX_SEGMENT_TURN: Final = 0.2

#: Half a turn about +z.
_BACKWARDS: Final = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), Z)


#: Number of segments; length, mass and bending stiffness of the whole beam.
_Beam = tuple[int, Number, Number, Number]


def _add_beam(
    b: ModelBuilder, name: str, parent: str, beam: _Beam, root: Number = 0.0, backwards: bool = False
) -> None:
    """Add a beam's segments in the x-y plane, hinged about +z, from `root` along ±x of the parent; the stub is its."""
    segments, length, mass, bending_stiffness = beam
    h = length / (segments + _STUB_LENGTH_RATIO)
    share = mass / (segments + _STUB_LENGTH_RATIO)
    across = share * h**2 / 12
    for i in range(1, segments + 1):
        b.add_body(f"{name} segment{i}", mass=share, com=(h / 2, 0.0, 0.0), inertia=(0.0, across, across))
        first, turned = i == 1, i == 1 and backwards
        reach = root + _STUB_LENGTH_RATIO * h if first else h
        b.add_joint(
            f"{name}{i}",
            "revolute",
            parent=parent if first else f"{name} segment{i - 1}",
            child=f"{name} segment{i}",
            axis=Z,
            translation=(-reach if turned else reach, 0.0, 0.0),
            rotation=_BACKWARDS if turned else None,
            stiffness=bending_stiffness / ((_STUB_LENGTH_RATIO + 0.5) * h if first else h),
            lower=-_MAX_SEGMENT_TURN,
            upper=_MAX_SEGMENT_TURN,
        )
    b.add_frame(f"{name} tip", body=f"{name} segment{segments}", translation=(h, 0.0, 0.0))


@system
def clamped_beam(
    *, segments: int = 8, length: Number = 10.0, mass: Number = 20.0, bending_stiffness: Number = 1500.0
) -> Model:
    """Return a uniform beam that is clamped to the world, lumped as hinged rigid segments with torsion springs.

    It bends in the x-y plane, without gravity. Coordinates: ``bend1``, ``bend2`` ... , the turn of each segment about
    +z from the one before, from the clamped end. At zero the beam lies straight along +x from the origin and its
    springs are at rest. `length`, `mass` and `bending_stiffness`, E I, are those of the whole beam.

    Notes
    -----
    Segments of length h = length/(segments + 1/√6) begin behind a stub of h/√6 that does not move. Between them stand
    springs E I/h, and E I/((1/√6 + ½) h) at the first hinge: the choice for which the frequencies converge with h³ to
    (β L)² √(E I length/mass)/length², cos βL cosh βL = -1.
    Eight segments have the first three frequencies with errors of 1e-4, 2e-3 and 4e-3. The joints' limits of ±0.2 rad
    are data: within them lumping makes sense, and nothing enforces them.

    References
    ----------
    Timoshenko, Young, Weaver 1974, Vibration Problems in Engineering, ch. 5, for the beam.
    """
    b = ModelBuilder("clamped_beam", gravity=(0.0, 0.0, 0.0))
    _add_beam(b, "bend", "world", (segments, length, mass, bending_stiffness))
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
    acts on the hub is its reaction, by itself. Mass and principal moments of the hub are those without the wheels,
    about its centre. `wheel_axes`, (n, 3) in body axes, may have any length; a wheel's centre lies `wheel_distance`
    along its axis, and its moment across the axis is half of `wheel_inertia`.

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
        place = [x * wheel_distance for x in axis.tolist()]
        b.add_joint(f"wheel{i}", "continuous", parent="hub", child=f"disc{i}", axis=axis, translation=place)
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
    of each segment of the beam along +x from the one before, about the hub's +z, and ``left1`` ... of the beam along
    -x. At zero the hub's centre is at the origin, both beams are straight and their springs at rest. They bend in the
    hub's x-y plane. The hub's principal moments are those of the hub alone about its centre; in the plane only the
    third counts. The beams begin at `hub_radius`; number of segments, length, mass and E I are those of each beam.

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
    stub, share = (
        _STUB_LENGTH_RATIO / (segments + _STUB_LENGTH_RATIO) * length,
        _STUB_LENGTH_RATIO / (segments + _STUB_LENGTH_RATIO) * mass,
    )
    # Two thin rods of length `stub` from the radius outwards.
    added = 2 * share * ((hub_radius + stub / 2) ** 2 + stub**2 / 12)
    b = ModelBuilder("flexible_spacecraft", gravity=(0.0, 0.0, 0.0))
    b.add_body("hub body", mass=hub_mass + 2 * share, inertia=(along, across + added, about + added))
    b.add_joint("hub", hub, parent="world", child="hub body")
    for name in ("right", "left"):
        beam = (segments, length, mass, bending_stiffness)
        _add_beam(b, name, "hub body", beam, root=hub_radius, backwards=name == "left")
    return b.build()
