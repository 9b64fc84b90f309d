"""Pendulums, written as in the textbooks."""

from __future__ import annotations

import sympy as sp

from mbkit.lagrangian.energies.symbols import velocity_of
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.systems._values import Value, values

__all__ = ["double_pendulum", "elastic_pendulum", "pendulum", "spherical_pendulum"]


def pendulum(*, mass: Value = 1.0, length: Value = 1.0, gravity: Value = 9.81) -> Lagrangian:
    """Return the mathematical pendulum: T = ½ m l² θ̇², V = -m g l cos θ.

    One coordinate, ``theta``, the angle from the downward vertical; at zero the mass hangs.

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §11 problem 1.
    """
    m, l, g, th = sp.symbols("m l g theta")
    w = velocity_of(th)
    given = values({"mass": (m, mass), "length": (l, length)}, {"gravity": (g, gravity)})
    return Lagrangian(m * l**2 * w**2 / 2, -m * g * l * sp.cos(th), [th], parameters=given, name="pendulum")


def double_pendulum(
    *,
    mass1: Value = 1.0,
    length1: Value = 1.0,
    mass2: Value = 1.0,
    length2: Value = 1.0,
    gravity: Value = 9.81,
) -> Lagrangian:
    """Return two point masses on massless rods, one below the other.

    Two coordinates, ``theta1`` and ``theta2``, both angles from the downward vertical; at zero
    both hang down. (`mbkit.catalog.double_pendulum` counts the second from the first rod.)

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §5 problem 1.
    """
    m1, m2, l1, l2, g, th1, th2 = sp.symbols("m1 m2 l1 l2 g theta1 theta2")
    w1, w2 = velocity_of(th1), velocity_of(th2)
    T = (m1 + m2) * l1**2 * w1**2 / 2 + m2 * l2**2 * w2**2 / 2 + m2 * l1 * l2 * w1 * w2 * sp.cos(th1 - th2)
    V = -(m1 + m2) * g * l1 * sp.cos(th1) - m2 * g * l2 * sp.cos(th2)
    positive = {"mass1": (m1, mass1), "length1": (l1, length1), "mass2": (m2, mass2), "length2": (l2, length2)}
    given = values(positive, {"gravity": (g, gravity)})
    return Lagrangian(T, V, [th1, th2], parameters=given, name="double_pendulum")


def elastic_pendulum(
    *, mass: Value = 1.0, length: Value = 1.0, stiffness: Value = 100.0, gravity: Value = 9.81
) -> Lagrangian:
    """Return a point mass that slides on a massless rod against a spring.

    Two coordinates: ``theta``, the angle from the downward vertical, and ``s``, how much longer
    than l the spring is. At zero the mass hangs and the spring is at rest. The mass matrix is singular
    where the mass reaches the pivot, s = -l.

    References
    ----------
    Vitt, Gorelik 1933, Oscillations of an elastic pendulum as an example of two
    parametrically coupled linear systems.
    """
    m, l, k, g, th, s = sp.symbols("m l k g theta s")
    w, u = velocity_of(th), velocity_of(s)
    T = m * (u**2 + (l + s) ** 2 * w**2) / 2
    V = k * s**2 / 2 - m * g * (l + s) * sp.cos(th)
    positive = {"mass": (m, mass), "length": (l, length), "stiffness": (k, stiffness)}
    given = values(positive, {"gravity": (g, gravity)})
    return Lagrangian(T, V, [th, s], parameters=given, name="elastic_pendulum")


def spherical_pendulum(*, mass: Value = 1.0, length: Value = 1.0, gravity: Value = 9.81) -> Lagrangian:
    """Return a point mass on a massless rod that swings in space: T = ½ m l² (θ̇² + φ̇² sin² θ).

    Two coordinates: ``theta``, the angle from the downward vertical, and ``phi``, the azimuth from +x
    towards +y, which is cyclic. The mass is at l (sin θ cos φ, sin θ sin φ, -cos θ). The mass matrix
    is singular where the mass hangs, θ = 0, and where it stands upright.

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §14 problem 1.
    """
    m, l, g, th, ph = sp.symbols("m l g theta phi")
    w, u = velocity_of(th), velocity_of(ph)
    T = m * l**2 * (w**2 + u**2 * sp.sin(th) ** 2) / 2
    given = values({"mass": (m, mass), "length": (l, length)}, {"gravity": (g, gravity)})
    return Lagrangian(T, -m * g * l * sp.cos(th), [th, ph], parameters=given, name="spherical_pendulum")
