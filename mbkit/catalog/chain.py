"""A planar chain of thin rods."""

from __future__ import annotations

from mbkit.catalog._parameters import SWING, count, down, positive
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["chain"]


def chain(*, n: int = 5, length: Number = 1.0, mass: Number = 1.0, gravity: Number = 9.81) -> Model:
    """Return n equal thin rods hinged end to end, hanging from the origin.

    The model's name is ``chain_5`` for five. n coordinates: ``theta1``, the angle of the first rod from the downward
    vertical, and ``theta2`` ... , the angle of each rod from the one before. At zero
    the chain hangs straight down. Each rod has its centre of mass in its middle
    and the inertia m L²/12 across, none along.

    Parameters
    ----------
    n : int
        Number of rods.
    length, mass : float or Parameter
        Of each rod, m and kg.
    gravity : float or Parameter
        m/s², along -z.

    Raises
    ------
    InputError
        A parameter that is not finite or has the wrong sign.

    References
    ----------
    Featherstone 2004, An empirical study of the joint space inertia matrix: the
    straight chain's mass matrix has a condition number of about 4 n⁴.
    """
    n = count("n", n)
    length, mass = positive("length", length), positive("mass", mass)
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
