"""The Furuta pendulum."""

from __future__ import annotations

from mbkit.catalog._parameters import Vector, down, moments, positive
from mbkit.model import Model, ModelBuilder, Number

__all__ = ["furuta_pendulum"]


def furuta_pendulum(
    *,
    arm_length: Number = 0.25,
    arm_mass: Number = 0.2,
    arm_com: Number = 0.125,
    arm_inertia: Number = 1e-3,
    pendulum_mass: Number = 0.1,
    pendulum_com: Number = 0.15,
    pendulum_inertia: Vector = (7.5e-4, 7.5e-4, 1.25e-6),
    gravity: Number = 9.81,
) -> Model:
    """Return a rotary pendulum: an arm that turns about the vertical carries a pendulum hinged about the arm.

    Two coordinates: ``arm``, the arm's turn about +z, and ``pendulum``, the pendulum's angle
    from the downward vertical, a turn about the arm. At zero the arm lies along +x and
    the pendulum hangs at its end; it swings towards +y, where the arm's turn takes it.

    Parameters
    ----------
    arm_length : float or Parameter
        From the vertical axis to the pendulum's hinge, m.
    arm_mass, pendulum_mass : float or Parameter
        kg.
    arm_com, pendulum_com : float or Parameter
        Distance of the centre of mass from the vertical axis and from the hinge, m.
    arm_inertia : float or Parameter
        About the vertical through the arm's centre of mass, kg m².
    pendulum_inertia : (3,) array_like
        Principal moments about the pendulum's centre of mass: about the arm, across
        arm and rod, and about the rod, kg m².
    gravity : float or Parameter
        m/s², along -z.

    Raises
    ------
    InputError
        A parameter that is not finite, has the wrong sign, or moments that no
        body has.

    References
    ----------
    Furuta, Yamakita, Kobayashi 1992, Swing-up control of inverted pendulum using
    pseudo-state feedback; Cazzolato, Prime 2011, On the dynamics of the Furuta
    pendulum, which keeps all the moments of inertia. The default values are those of thin
    rods on a desk, of no particular device.
    """
    reach, across = positive("arm_length", arm_length), positive("arm_inertia", arm_inertia)
    b = ModelBuilder("furuta_pendulum", gravity=down(gravity))
    b.add_body(
        "arm body",
        mass=positive("arm_mass", arm_mass),
        com=(positive("arm_com", arm_com), 0.0, 0.0),
        inertia=(0.0, across, across),
    )
    b.add_body(
        "pendulum body",
        mass=positive("pendulum_mass", pendulum_mass),
        com=(0.0, 0.0, -positive("pendulum_com", pendulum_com)),
        inertia=moments("pendulum_inertia", pendulum_inertia),
    )
    b.add_joint("arm", "continuous", parent="world", child="arm body", axis=(0.0, 0.0, 1.0))
    b.add_joint(
        "pendulum",
        "continuous",
        parent="arm body",
        child="pendulum body",
        axis=(1.0, 0.0, 0.0),
        translation=(reach, 0.0, 0.0),
    )
    return b.build()
