"""Turning bodies in Euler angles."""

from __future__ import annotations

import sympy as sp

from mbkit.lagrangian.energies.symbols import velocity_of
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.systems._values import Value, values

__all__ = ["gyroscope", "heavy_top", "rigid_body"]


def heavy_top(
    *,
    mass: Value = 1.0,
    length: Value = 0.1,
    across: Value = 0.02,
    axial: Value = 0.005,
    gravity: Value = 9.81,
) -> Lagrangian:
    """Return Lagrange's top: a symmetric body with a point of its axis fixed.

    Three coordinates, Euler's angles z-x-z: ``phi``, the precession, ``theta``, the axis's angle from the upward
    vertical, and ``psi``, the spin; φ and ψ are cyclic. A and C are the moments about the fixed point, across and
    along the axis; the centre of mass lies l up the axis. The mass matrix is singular at θ = 0 and π, where φ and
    ψ turn the same way.

    T = ½ A (θ̇² + φ̇² sin² θ) + ½ C (ψ̇ + φ̇ cos θ)², V = m g l cos θ.

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 5.7; Landau, Lifshitz 1976, Mechanics, §35 problem 1.
    """
    m, l, A, C, g, ph, th, ps = sp.symbols("m l A C g phi theta psi")
    u, w, s = velocity_of(ph), velocity_of(th), velocity_of(ps)
    T = A * (w**2 + u**2 * sp.sin(th) ** 2) / 2 + C * (s + u * sp.cos(th)) ** 2 / 2
    positive = {"mass": (m, mass), "length": (l, length), "across": (A, across), "axial": (C, axial)}
    given = values(positive, {"gravity": (g, gravity)})
    return Lagrangian(T, m * g * l * sp.cos(th), [ph, th, ps], parameters=given, name="heavy_top")


def gyroscope(
    *,
    rotor_mass: Value = 1.0,
    rotor_axial: Value = 2e-3,
    rotor_across: Value = 1.2e-3,
    offset: Value = 0.02,
    inner_hinge: Value = 5e-4,
    inner_axial: Value = 5e-4,
    inner_across: Value = 1e-3,
    outer_inertia: Value = 8e-4,
    gravity: Value = 9.81,
) -> Lagrangian:
    """Return a symmetric rotor in two gimbals, with its centre of mass on its axis.

    Three coordinates: ``alpha``, the outer gimbal's turn about the vertical, ``beta``, the inner gimbal's turn
    about the outer one, which is the elevation of the rotor's axis above the horizontal, and ``gamma``, the
    rotor's turn in the inner gimbal; α and γ are cyclic. A and C are the rotor's moments across and along its
    axis, about its centre of mass, which lies l from the gimbals' centre; A_i, B_i and C_i the inner gimbal's
    about its hinge, along the rotor's axis and across both, J_o the outer one's about the vertical. At β = ±π/2
    the mass matrix is singular but for J_o.

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 5.7; Magnus 1971, Kreisel, for the gimbals.
    """
    m, l, A, C, Ai, Bi, Ci, Jo, g = sp.symbols("m l A C A_i B_i C_i J_o g")
    al, be, ga = sp.symbols("alpha beta gamma")
    u, w, s = map(velocity_of, (al, be, ga))
    T = (A + Ai + m * l**2) * w**2 / 2 + C * (s + u * sp.sin(be)) ** 2 / 2
    T += (Jo + (A + Ci + m * l**2) * sp.cos(be) ** 2 + Bi * sp.sin(be) ** 2) * u**2 / 2
    positive = {"rotor_mass": (m, rotor_mass), "rotor_axial": (C, rotor_axial), "rotor_across": (A, rotor_across)}
    free = {"offset": (l, offset), "inner_hinge": (Ai, inner_hinge), "inner_axial": (Bi, inner_axial)}
    free |= {"inner_across": (Ci, inner_across), "outer_inertia": (Jo, outer_inertia), "gravity": (g, gravity)}
    return Lagrangian(T, m * g * l * sp.sin(be), [al, be, ga], parameters=values(positive, free), name="gyroscope")


def rigid_body(*, A: Value = 1.0, B: Value = 2.0, C: Value = 2.5) -> Lagrangian:
    """Return a body that turns about its centre of mass without torque: T = ½ (A ω₁² + B ω₂² + C ω₃²).

    Three coordinates, Euler's angles z-x-z: ``phi``, which is cyclic, ``theta`` and ``psi``. A, B and C are the
    principal moments, and ω in body axes is ω₁ = θ̇ cos ψ + φ̇ sin θ sin ψ, ω₂ = -θ̇ sin ψ + φ̇ sin θ cos ψ, ω₃ =
    ψ̇ + φ̇ cos θ. The mass matrix is singular at θ = 0 and π.

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, eq. (4.87) and ch. 5.6.
    """
    a, b, c, ph, th, ps = sp.symbols("A B C phi theta psi")
    u, w, s = velocity_of(ph), velocity_of(th), velocity_of(ps)
    first = w * sp.cos(ps) + u * sp.sin(th) * sp.sin(ps)
    second = -w * sp.sin(ps) + u * sp.sin(th) * sp.cos(ps)
    third = s + u * sp.cos(th)
    T = (a * first**2 + b * second**2 + c * third**2) / 2
    given = values({"A": (a, A), "B": (b, B), "C": (c, C)})
    return Lagrangian(T, 0, [ph, th, ps], parameters=given, name="rigid_body")
