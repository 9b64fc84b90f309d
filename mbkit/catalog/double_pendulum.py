"""The double pendulum."""

from __future__ import annotations

from mbkit.catalog._parameters import SWING, down, positive
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["double_pendulum"]


def double_pendulum(
    *,
    length1: Number = 1.0,
    mass1: Number = 1.0,
    length2: Number = 1.0,
    mass2: Number = 1.0,
    gravity: Number = 9.81,
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

    Raises
    ------
    InputError
        A parameter that is not finite or has the wrong sign.

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §5 problem 1.
    """
    l1, m1 = positive("length1", length1), positive("mass1", mass1)
    l2, m2 = positive("length2", length2), positive("mass2", mass2)
    b = ModelBuilder("double_pendulum", gravity=down(gravity))
    b.add_body("rod1", mass=m1, com=(0.0, 0.0, -l1))
    b.add_body("rod2", mass=m2, com=(0.0, 0.0, -l2))
    b.add_joint("theta1", "continuous", parent="world", child="rod1", axis=SWING)
    b.add_joint("theta2", "continuous", parent="rod1", child="rod2", axis=SWING, translation=(0.0, 0.0, -l1))
    b.add_frame("tip", body="rod2", translation=(0.0, 0.0, -l2))
    return b.build()
