"""The acrobot."""

from __future__ import annotations

from mbkit.catalog._parameters import SWING, down, positive
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["acrobot"]


def acrobot(
    *,
    length1: Number = 1.0,
    length2: Number = 2.0,
    mass1: Number = 1.0,
    mass2: Number = 1.0,
    com1: Number = 0.5,
    com2: Number = 1.0,
    inertia1: Number = 0.083,
    inertia2: Number = 0.33,
    gravity: Number = 9.8,
) -> Model:
    """Return two rigid links, one below the other, with a motor at the elbow only.

    Two coordinates: ``theta1``, the angle of the first link from the downward vertical,
    and ``theta2``, the angle of the second link from the first. At zero both hang down.
    The motor's torque stands in the second entry of the generalized forces; the first
    is zero.

    Parameters
    ----------
    length1, length2 : float or Parameter
        Of the links, m; the second only says where the tip is.
    mass1, mass2 : float or Parameter
        kg.
    com1, com2 : float or Parameter
        Distance of each link's centre of mass from its hinge, m.
    inertia1, inertia2 : float or Parameter
        Of each link about its centre of mass, across the plane of motion, kg m².
    gravity : float or Parameter
        m/s², along -z.

    Raises
    ------
    InputError
        A parameter that is not finite or has the wrong sign.

    References
    ----------
    Spong 1995, The swing up control problem for the acrobot, whose numbers are the
    defaults (his first angle is from the horizontal); Tedrake, Underactuated Robotics,
    ch. 3.1, whose coordinates these are.
    """
    l1, m1, c1 = positive("length1", length1), positive("mass1", mass1), positive("com1", com1)
    l2, m2, c2 = positive("length2", length2), positive("mass2", mass2), positive("com2", com2)
    J1, J2 = positive("inertia1", inertia1), positive("inertia2", inertia2)
    b = ModelBuilder("acrobot", gravity=down(gravity))
    b.add_body("link1", mass=m1, com=(0.0, 0.0, -c1), inertia=(J1, J1, 0.0))
    b.add_body("link2", mass=m2, com=(0.0, 0.0, -c2), inertia=(J2, J2, 0.0))
    b.add_joint("theta1", "continuous", parent="world", child="link1", axis=SWING)
    b.add_joint("theta2", "continuous", parent="link1", child="link2", axis=SWING, translation=(0.0, 0.0, -l1))
    b.add_frame("tip", body="link2", translation=(0.0, 0.0, -l2))
    return b.build()
