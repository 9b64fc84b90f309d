"""The spherical pendulum."""

from __future__ import annotations

from mbkit.catalog._parameters import SWING, down, positive
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["spherical_pendulum"]


def spherical_pendulum(*, length: Number = 1.0, mass: Number = 1.0, gravity: Number = 9.81) -> Model:
    """Return a point mass on a massless rod that hangs in a Cardan suspension.

    Two coordinates: ``alpha``, the turn of the massless fork about -y, which swings
    the mass towards +x, and ``beta``, the turn of the rod in the fork about the
    fork's +x, which swings it towards +y. The mass is at length (sin α cos β,
    sin β, -cos α cos β): at zero it hangs at (0, 0, -length).

    Parameters
    ----------
    length : float or Parameter
        m.
    mass : float or Parameter
        kg.
    gravity : float or Parameter
        m/s², along -z.

    Raises
    ------
    InputError
        A parameter that is not finite or has the wrong sign.

    Notes
    -----
    The textbooks' coordinates, azimuth φ and angle ϑ from the downward vertical, have no
    inverse of their mass matrix, m l² diag(sin² ϑ, 1), where the mass hangs at
    rest, which is where every study begins. These have m l² diag(cos² β, 1),
    singular where the mass lies on the y axis. tan φ = tan β / sin α,
    cos ϑ = cos α cos β. A ball joint would let a point mass spin about the rod,
    with no inertia.

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §14 problem 1.
    """
    length, mass = positive("length", length), positive("mass", mass)
    b = ModelBuilder("spherical_pendulum", gravity=down(gravity))
    b.add_body("fork", mass=0.0)
    b.add_body("bob", mass=mass, com=(0.0, 0.0, -length))
    b.add_joint("alpha", "continuous", parent="world", child="fork", axis=SWING)
    b.add_joint("beta", "continuous", parent="fork", child="bob", axis=(1.0, 0.0, 0.0))
    b.add_frame("tip", body="bob", translation=(0.0, 0.0, -length))
    return b.build()
