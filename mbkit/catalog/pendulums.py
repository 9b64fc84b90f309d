"""Pendulums and chains."""

from __future__ import annotations

from mbkit.catalog._parameters import SWING, down, system
from mbkit.model import Model, ModelBuilder, Number, known, nominal


@system
def pendulum(*, length: Number = 1.0, mass: Number = 1.0, gravity: Number = 9.81) -> Model:
    """Return a point mass on a massless rod.

    One coordinate, ``theta``, the angle from the downward vertical: at zero the mass
    hangs at (0, 0, -length); at θ it is at length (sin θ, 0, -cos θ).

    Parameters
    ----------
    length : float or Parameter
        m.
    mass : float or Parameter
        kg.
    gravity : float or Parameter
        m/s², along -z.

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §11 problem 1; IFToMM library of
    computational benchmark problems, A01, which starts at θ = -π/2.
    """
    b = ModelBuilder("pendulum", gravity=down(gravity))
    b.add_body("bob", mass=mass, com=(0.0, 0.0, -length))
    b.add_joint("theta", "continuous", parent="world", child="bob", axis=SWING)
    b.add_frame("tip", body="bob", translation=(0.0, 0.0, -length))
    return b.build()


@system
def double_pendulum(
    *, length1: Number = 1.0, mass1: Number = 1.0, length2: Number = 1.0, mass2: Number = 1.0, gravity: Number = 9.81
) -> Model:
    """Return two point masses on massless rods, one below the other.

    Two coordinates: ``theta1``, the angle of the first rod from the downward vertical,
    and ``theta2``, the angle of the second rod from the first (textbooks often
    take it from the vertical; that is theta1 + theta2). At zero both hang down.

    Parameters
    ----------
    length1, length2 : float or Parameter
        m.
    mass1, mass2 : float or Parameter
        kg.
    gravity : float or Parameter
        m/s², along -z.

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §5 problem 1.
    """
    b = ModelBuilder("double_pendulum", gravity=down(gravity))
    b.add_body("rod1", mass=mass1, com=(0.0, 0.0, -length1))
    b.add_body("rod2", mass=mass2, com=(0.0, 0.0, -length2))
    b.add_joint("theta1", "continuous", parent="world", child="rod1", axis=SWING)
    b.add_joint("theta2", "continuous", parent="rod1", child="rod2", axis=SWING, translation=(0.0, 0.0, -length1))
    b.add_frame("tip", body="rod2", translation=(0.0, 0.0, -length2))
    return b.build()


@system
def spherical_pendulum(*, length: Number = 1.0, mass: Number = 1.0, gravity: Number = 9.81) -> Model:
    """Return a point mass on a massless rod that hangs in a Cardan suspension.

    Two coordinates: ``alpha``, the turn of the massless fork about -y, which swings the mass towards +x, and ``beta``,
    the turn of the rod in the fork about the fork's +x, which swings it towards +y. The mass is at length (sin α cos β,
    sin β, -cos α cos β): at zero it hangs at (0, 0, -length).

    Parameters
    ----------
    length : float or Parameter
        m.
    mass : float or Parameter
        kg.
    gravity : float or Parameter
        m/s², along -z.

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
    b.add_joint("alpha", "continuous", parent="world", child="fork", axis=SWING)
    b.add_joint("beta", "continuous", parent="fork", child="bob", axis=(1.0, 0.0, 0.0))
    b.add_frame("tip", body="bob", translation=(0.0, 0.0, -length))
    return b.build()


@system
def elastic_pendulum(
    *, length: Number = 1.0, mass: Number = 1.0, stiffness: Number = 100.0, gravity: Number = 9.81
) -> Model:
    """Return a point mass that slides on a massless rod against a spring.

    Two coordinates: ``theta``, the angle of the rod from the downward vertical, and ``stretch``, how much longer than
    `length` the spring is. The mass is at (length + stretch) (sin θ, 0, -cos θ): at zero it hangs at (0, 0, -length)
    and the spring is at rest. The mass matrix is singular where the mass reaches the pivot: the lower limit of
    ``stretch``, half the (nominal) length, keeps random states away from there.

    Parameters
    ----------
    length : float or Parameter
        Of the spring at rest, m.
    mass : float or Parameter
        kg.
    stiffness : float or Parameter
        N/m.
    gravity : float or Parameter
        m/s², along -z.

    References
    ----------
    Vitt, Gorelik 1933, Oscillations of an elastic pendulum as an example of two
    parametrically coupled linear systems: swing and stretch exchange their energy
    where stiffness length' = 4 mass gravity nearly holds, length' the length at which it hangs at rest.
    """
    lower = -nominal(length) / 2 if known(length) else None
    b = ModelBuilder("elastic_pendulum", gravity=down(gravity))
    b.add_body("rod", mass=0.0)
    b.add_body("bob", mass=mass, com=(0.0, 0.0, -length))
    b.add_joint("theta", "continuous", parent="world", child="rod", axis=SWING)
    b.add_joint(
        "stretch", "prismatic", parent="rod", child="bob", axis=(0.0, 0.0, -1.0), lower=lower, stiffness=stiffness
    )
    b.add_frame("tip", body="bob", translation=(0.0, 0.0, -length))
    return b.build()


@system
def chain(*, n: int = 5, length: Number = 1.0, mass: Number = 1.0, gravity: Number = 9.81) -> Model:
    """Return n equal thin rods hinged end to end, hanging from the origin.

    The model's name is ``chain_5`` for five. n coordinates: ``theta1``, the angle of the first rod from the downward
    vertical, and ``theta2`` ... , the angle of each rod from the one before. At zero the chain hangs straight down.
    Each rod has its centre of mass in its middle and the inertia m L²/12 across, none along.

    Parameters
    ----------
    n : int
        Number of rods.
    length, mass : float or Parameter
        Of each rod, m and kg.
    gravity : float or Parameter
        m/s², along -z.

    References
    ----------
    Featherstone 2004, An empirical study of the joint space inertia matrix: the
    straight chain's mass matrix has a condition number of about 4 n⁴.
    """
    across = mass * length**2 / 12
    b = ModelBuilder(f"chain_{n}", gravity=down(gravity))
    for i in range(1, n + 1):
        b.add_body(f"rod{i}", mass=mass, com=(0.0, 0.0, -length / 2), inertia=(across, across, 0.0))
        b.add_joint(
            f"theta{i}",
            "continuous",
            parent=f"rod{i - 1}" if i > 1 else "world",
            child=f"rod{i}",
            axis=SWING,
            translation=(0.0, 0.0, -length if i > 1 else 0.0),
        )
    b.add_frame("tip", body=f"rod{n}", translation=(0.0, 0.0, -length))
    return b.build()
