"""The elastic pendulum."""

from __future__ import annotations

from mbkit.catalog._parameters import SWING, down, positive
from mbkit.model import Model, ModelBuilder, Number, known, nominal

__all__ = ["elastic_pendulum"]


def elastic_pendulum(
    *, length: Number = 1.0, mass: Number = 1.0, stiffness: Number = 100.0, gravity: Number = 9.81
) -> Model:
    """Return a point mass that slides on a massless rod against a spring.

    Two coordinates: ``theta``, the angle of the rod from the downward vertical, and
    ``stretch``, how much longer than `length` the spring is. The mass is at
    (length + stretch) (sin θ, 0, -cos θ): at zero it hangs at (0, 0, -length) and the
    spring is at rest. The mass matrix is singular where the mass reaches the pivot: the
    lower limit of ``stretch``, half the (nominal) length, keeps random states away from there.

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

    Raises
    ------
    InputError
        A parameter that is not finite or has the wrong sign.

    References
    ----------
    Vitt, Gorelik 1933, Oscillations of an elastic pendulum as an example of two
    parametrically coupled linear systems: swing and stretch exchange their energy
    where stiffness length' = 4 mass gravity nearly holds, length' the length at which it hangs at rest.
    """
    length, mass = positive("length", length), positive("mass", mass)
    lower = -nominal(length) / 2 if known(length) else None
    b = ModelBuilder("elastic_pendulum", gravity=down(gravity))
    b.add_body("rod", mass=0.0)
    b.add_body("bob", mass=mass, com=(0.0, 0.0, -length))
    b.add_joint("theta", "continuous", parent="world", child="rod", axis=SWING)
    b.add_joint(
        "stretch",
        "prismatic",
        parent="rod",
        child="bob",
        axis=(0.0, 0.0, -1.0),
        lower=lower,
        stiffness=positive("stiffness", stiffness),
    )
    b.add_frame("tip", body="bob", translation=(0.0, 0.0, -length))
    return b.build()
