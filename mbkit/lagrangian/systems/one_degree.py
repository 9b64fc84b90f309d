"""One degree of freedom: J(q) q̈ + ½ J′(q) q̇² + V′(q) = Q."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import sympy as sp

from mbkit.lagrangian.energies.symbols import velocity_of
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.systems._values import Value, values

__all__ = ["falling_body", "one_degree", "rigid_slider_crank", "slider_crank", "sliding_block"]


def one_degree(
    J: Callable[[sp.Symbol], Any] | Any = 1,
    V: Callable[[sp.Symbol], Any] | Any = 0,
    Q: Callable[[sp.Symbol, sp.Symbol], Any] | Any = 0,
    *,
    coordinate: sp.Symbol | None = None,
    parameters: Mapping[sp.Symbol, float | None] | Iterable[sp.Symbol] | None = None,
    name: str = "one_degree",
) -> Lagrangian:
    """Return any system of one degree of freedom: T = ½ J(q) q̇², J q̈ + ½ J′ q̇² + V′ = Q.

    Parameters
    ----------
    J, V : callable or sympy.Expr
        The inertia and the potential energy, functions of the coordinate.
    Q : callable or sympy.Expr
        The generalized force, a function of the coordinate and its velocity.
    coordinate : sympy.Symbol, optional
        ``q`` if not given.
    parameters : mapping of sympy.Symbol to float or None, or sequence of symbols, optional
        What else stands in them.
    name : str

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 1.6.

    Examples
    --------
    >>> import sympy as sp
    >>> import mbkit as mb
    >>> k = sp.Symbol("k")
    >>> lag = mb.lagrangian.systems.one_degree(lambda q: 1 + q**2, lambda q: k * q**2 / 2, parameters={k: 1.0})
    >>> print(lag.equations())
    qddot*(q**2 + 1) + q*qdot**2 + k*q = 0
    """
    q = sp.Symbol("q") if coordinate is None else coordinate
    w = velocity_of(q)
    J, V = (f(q) if callable(f) else f for f in (J, V))
    force = Q(q, w) if callable(Q) else Q
    forces = {} if force == 0 else {q: force}
    return Lagrangian(sp.sympify(J) * w**2 / 2, V, [q], forces=forces, parameters=parameters, name=name)


def slider_crank(
    *,
    mass: Value = 1.0,
    crank: Value = 0.1,
    rod: Value = 0.3,
    torque: Value = 0.0,
    force: Value = 0.0,
) -> Lagrangian:
    """Return a piston driven by a massless crank and rod: J(θ) = m r² sin²(θ + φ)/cos² φ, sin φ = (r/l) sin θ.

    One coordinate, ``theta``, the crank's angle from the dead centre at which the piston is farthest from the crank's
    axis, x = r cos θ + l cos φ; it is positive counterclockwise with the piston along +x. ``tau`` is the torque on
    the crank, along θ; ``F`` the force on the piston, towards
    the crank's axis as that of a gas. J θ̈ + ½ J′ θ̇² = τ + F r sin(θ + φ)/cos φ.

    At the dead centres, θ = 0 and π, J is zero: a massless crank carries nothing there, no
    torque finds an inertia, and θ̈ does not exist. A motion that reaches one with the piston at rest
    ends there; give the crank an inertia (`rigid_slider_crank`) to pass it.

    References
    ----------
    Biezeno, Grammel 1953, Technische Dynamik, vol. 2, on the crank drive.
    """
    m, r, l, tau, F, th = sp.symbols("m r l tau F theta")
    # sin(θ + φ)/cos φ, without the angle φ: l cos φ is the root.
    lever = sp.sin(th) * (1 + r * sp.cos(th) / sp.sqrt(l**2 - r**2 * sp.sin(th) ** 2))
    positive = {"mass": (m, mass), "crank": (r, crank), "rod": (l, rod)}
    given = values(positive, {"torque": (tau, torque), "force": (F, force)})
    J, Q = m * r**2 * lever**2, tau + F * r * lever
    return one_degree(J, 0, Q, coordinate=th, parameters=given, name="slider_crank")


def rigid_slider_crank(
    *,
    crank: Value = 0.1,
    rod: Value = 0.3,
    crank_mass: Value = 0.2,
    rod_mass: Value = 0.2,
    piston_mass: Value = 0.4,
    torque: Value = 0.1,
) -> Lagrangian:
    """Return the slider-crank of thin rods with mass and a piston, without gravity.

    One coordinate, ``theta``, the crank's angle from the dead centre at which the piston is farthest; it is positive
    from there towards +y, counterclockwise with the piston along +x. The parameter ``tau`` is a constant torque on the
    crank. It adds to the ``torque=`` of `mbkit.simulate`; with ``torque=0`` here, that is the whole input. J = J1 +
    m1 L1²/4 + m2 (x2′² + y2′²) + J2 ψ′² + m3 x3′², never zero: dead centres are
    passed.

    References
    ----------
    The defaults are a benchmark's: started at rest from θ = 0. At 3 s, a quadrature in 30 digits and the oracle give
    θ = 121.88627750824783 and θ̇ = 101.365645114971. The benchmark prints the end of a simulation,
    121.88627750756837 and 101.36564506591814, which is off by 7e-10 and 5e-8.
    """
    L1, L2, m1, m2, m3, tau, th = sp.symbols("L1 L2 m1 m2 m3 tau theta")
    s, c = sp.sin(th), sp.cos(th)
    root = sp.sqrt(L2**2 - L1**2 * s**2)
    turn = -L1 * c / root
    slide = -L1 * s * (1 + L1 * c / root)
    middle = -L1 * s * (1 + L1 * c / (2 * root))
    J = m1 * L1**2 / 3 + m2 * (middle**2 + (L1 * c / 2) ** 2) + m2 * L2**2 / 12 * turn**2 + m3 * slide**2
    positive = {"crank": (L1, crank), "rod": (L2, rod), "crank_mass": (m1, crank_mass)}
    positive |= {"rod_mass": (m2, rod_mass), "piston_mass": (m3, piston_mass)}
    given = values(positive, {"torque": (tau, torque)})
    return one_degree(J, 0, tau, coordinate=th, parameters=given, name="rigid_slider_crank")


def sliding_block(
    *,
    mass: Value = 1.0,
    slope: Value = 0.3,
    friction: Value = 0.2,
    creep: Value = 1e-3,
    gravity: Value = 9.81,
) -> Lagrangian:
    """Return a block that slides down a slope against dry friction: Q = -μ m g cos α tanh(ẋ/v₀).

    One coordinate, ``x``, the way down the slope of angle α. Coulomb's friction is regularized: it reaches three
    quarters of its value at the speed v₀ (v_0), so a block that would stick creeps, at v₀ artanh(tan α/μ).

    References
    ----------
    Andersson, Söderberg, Björklund 2007, Friction models for sliding dry, boundary and
    mixed lubricated contacts.
    """
    m, al, mu, v0, g, x = sp.symbols("m alpha mu v_0 g x")
    u = velocity_of(x)
    positive = {"mass": (m, mass), "creep": (v0, creep)}
    given = values(positive, {"slope": (al, slope), "friction": (mu, friction), "gravity": (g, gravity)})
    return one_degree(
        m,
        -m * g * x * sp.sin(al),
        -mu * m * g * sp.cos(al) * sp.tanh(u / v0),
        coordinate=x,
        parameters=given,
        name="sliding_block",
    )


def falling_body(*, mass: Value = 1.0, drag: Value = 0.25, gravity: Value = 9.81) -> Lagrangian:
    """Return a body that falls through air: Q = -c ż |ż|.

    One coordinate, ``z``, the height. c is ½ ρ c_w A; the fall ends at the speed √(m g/c).

    References
    ----------
    Landau, Lifshitz 1987, Fluid Mechanics, §45.
    """
    m, c, g, z = sp.symbols("m c g z")
    u = velocity_of(z)
    given = values({"mass": (m, mass)}, {"drag": (c, drag), "gravity": (g, gravity)})
    return one_degree(m, m * g * z, -c * u * sp.Abs(u), coordinate=z, parameters=given, name="falling_body")
