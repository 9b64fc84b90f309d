"""The mathematical pendulum."""

from __future__ import annotations

from mbkit.catalog._parameters import SWING, down, positive
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["pendulum"]


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

    Raises
    ------
    InputError
        A parameter that is not finite or has the wrong sign.

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §11 problem 1; IFToMM library of
    computational benchmark problems, A01, which starts at θ = -π/2.
    """
    length, mass = positive("length", length), positive("mass", mass)
    b = ModelBuilder("pendulum", gravity=down(gravity))
    b.add_body("bob", mass=mass, com=(0.0, 0.0, -length))
    b.add_joint("theta", "continuous", parent="world", child="bob", axis=SWING)
    b.add_frame("tip", body="bob", translation=(0.0, 0.0, -length))
    return b.build()
