"""Systems that are carried along in time: T has terms below the second degree."""

from __future__ import annotations

import sympy as sp

from mbkit.lagrangian.energies.symbols import velocity_of
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.systems._values import Value, values

__all__ = ["bead_on_hoop", "driven_pendulum"]


def bead_on_hoop(*, mass: Value = 1.0, radius: Value = 1.0, speed: Value = 4.0, gravity: Value = 9.81) -> Lagrangian:
    """Return a bead on a hoop that turns about its vertical diameter: T = ½ m R² (θ̇² + Ω² sin² θ).

    One coordinate, ``theta``, the bead's angle from the bottom; T0 = ½ m R² Ω² sin² θ is not zero. Where
    Ω² > g/R the bottom is unstable, and the bead rests at cos θ = g/(R Ω²). h = T2 - T0 + V is conserved; T + V is not.

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 2.7 and ch. 2, exercise 18.
    """
    m, R, Om, g, th = sp.symbols("m R Omega g theta")
    w = velocity_of(th)
    T = m * R**2 * (w**2 + Om**2 * sp.sin(th) ** 2) / 2
    given = values({"mass": (m, mass), "radius": (R, radius)}, {"speed": (Om, speed), "gravity": (g, gravity)})
    return Lagrangian(T, -m * g * R * sp.cos(th), [th], parameters=given, name="bead_on_hoop")


def driven_pendulum(
    *,
    mass: Value = 1.0,
    length: Value = 1.0,
    amplitude: Value = 0.1,
    frequency: Value = 100.0,
    gravity: Value = 9.81,
) -> Lagrangian:
    """Return Kapitza's pendulum, whose pivot moves up and down as a cos Ωt.

    One coordinate, ``theta``, the angle from the downward vertical, and the time ``t``; T1 and T0 are not zero.
    The mass is at (l sin θ, a cos Ωt - l cos θ). Upright is stable where a² Ω² > 2 g l, as with the defaults.

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §30 problem 1; Kapitza 1951.
    """
    m, l, a, Om, g, th, t = sp.symbols("m l a Omega g theta t")
    w = velocity_of(th)
    rise = -a * Om * sp.sin(Om * t)
    T = m * (l**2 * w**2 + 2 * l * rise * w * sp.sin(th) + rise**2) / 2
    V = m * g * (a * sp.cos(Om * t) - l * sp.cos(th))
    positive = {"mass": (m, mass), "length": (l, length)}
    free = {"amplitude": (a, amplitude), "frequency": (Om, frequency), "gravity": (g, gravity)}
    return Lagrangian(T, V, [th], time=t, parameters=values(positive, free), name="driven_pendulum")
