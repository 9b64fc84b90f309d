"""Systems with fewer motors than coordinates."""

from __future__ import annotations

import sympy as sp

from mbkit.lagrangian.energies.symbols import velocity_of
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.systems._values import Value, values

__all__ = ["acrobot", "cart_pole", "furuta_pendulum"]


def cart_pole(
    *, cart_mass: Value = 1.0, pole_mass: Value = 1.0, length: Value = 1.0, gravity: Value = 9.81
) -> Lagrangian:
    """Return a cart on a horizontal rail that carries a pole with a point mass at its end.

    Two coordinates: ``x``, the cart's position, and ``theta``, the pole's angle from the
    downward vertical, growing towards +x. At zero the pole hangs. ``F`` is the force on the cart.

    References
    ----------
    Tedrake, Underactuated Robotics, ch. 3.2.1.
    """
    M, m, l, g, F, x, th = sp.symbols("m_c m_p l g F x theta")
    u, w = velocity_of(x), velocity_of(th)
    T = (M + m) * u**2 / 2 + m * l * u * w * sp.cos(th) + m * l**2 * w**2 / 2
    positive = {"cart_mass": (M, cart_mass), "pole_mass": (m, pole_mass), "length": (l, length)}
    given = values(positive, {"gravity": (g, gravity)})
    return Lagrangian(T, -m * g * l * sp.cos(th), [x, th], forces={x: F}, parameters=given, name="cart_pole")


def acrobot(
    *,
    length1: Value = 1.0,
    mass1: Value = 1.0,
    mass2: Value = 1.0,
    com1: Value = 0.5,
    com2: Value = 1.0,
    inertia1: Value = 0.083,
    inertia2: Value = 0.33,
    gravity: Value = 9.8,
) -> Lagrangian:
    """Return two rigid links, one below the other, with a motor's torque ``tau`` at the elbow only.

    Two coordinates: ``theta1``, the angle of the first link from the downward vertical, and ``theta2``,
    the angle of the second link from the first. At zero both hang down. Centres of mass lie l_c1 and l_c2
    from the hinges, moments of inertia I1 and I2 are about them.

    References
    ----------
    Spong 1995, The swing up control problem for the acrobot, whose numbers are the
    defaults; Tedrake, Underactuated Robotics, ch. 3.1, whose coordinates these are.
    """
    m1, m2, l1, c1, c2, I1, I2, g, tau = sp.symbols("m1 m2 l1 l_c1 l_c2 I1 I2 g tau")
    th1, th2 = sp.symbols("theta1 theta2")
    w1, w2 = velocity_of(th1), velocity_of(th2)
    both = w1 + w2
    T = (m1 * c1**2 + I1) * w1**2 / 2 + I2 * both**2 / 2
    T += m2 * (l1**2 * w1**2 + c2**2 * both**2 + 2 * l1 * c2 * w1 * both * sp.cos(th2)) / 2
    V = -(m1 * c1 + m2 * l1) * g * sp.cos(th1) - m2 * g * c2 * sp.cos(th1 + th2)
    positive = {"length1": (l1, length1), "mass1": (m1, mass1), "mass2": (m2, mass2), "com1": (c1, com1)}
    positive |= {"com2": (c2, com2), "inertia1": (I1, inertia1), "inertia2": (I2, inertia2)}
    given = values(positive, {"gravity": (g, gravity)})
    return Lagrangian(T, V, [th1, th2], forces={th2: tau}, parameters=given, name="acrobot")


def furuta_pendulum(
    *,
    arm_length: Value = 0.25,
    arm_inertia: Value = 4.125e-3,
    pendulum_mass: Value = 0.1,
    pendulum_com: Value = 0.15,
    pendulum_inertia: Value = 7.5e-4,
    gravity: Value = 9.81,
) -> Lagrangian:
    """Return a rotary pendulum: an arm turned about the vertical by a torque ``tau`` carries a pendulum.

    Two coordinates: ``alpha``, the arm's turn about the vertical, which is cyclic, and ``theta``, the pendulum's angle
    from the downward vertical, a turn about the arm. At zero the pendulum hangs. L is the arm's length,
    J its moment about the vertical; the pendulum is a thin rod with its centre of mass l from the hinge and the moment
    I across it.

    References
    ----------
    Furuta, Yamakita, Kobayashi 1992, Swing-up control of inverted pendulum using pseudo-state feedback.
    """
    m, l, L, J, I, g, tau, al, th = sp.symbols("m l L J I g tau alpha theta")
    u, w = velocity_of(al), velocity_of(th)
    T = (J + m * L**2 + (I + m * l**2) * sp.sin(th) ** 2) * u**2 / 2 + (I + m * l**2) * w**2 / 2
    T += m * L * l * u * w * sp.cos(th)
    positive = {"arm_length": (L, arm_length), "arm_inertia": (J, arm_inertia), "pendulum_mass": (m, pendulum_mass)}
    positive |= {"pendulum_com": (l, pendulum_com), "pendulum_inertia": (I, pendulum_inertia)}
    given = values(positive, {"gravity": (g, gravity)})
    return Lagrangian(T, -m * g * l * sp.cos(th), [al, th], forces={al: tau}, parameters=given, name="furuta_pendulum")
