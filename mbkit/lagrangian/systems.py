"""Systems on paper: functions that return a `Lagrangian` in the symbols of textbooks.

Every function takes keyword parameters in SI units, or None for a value that follows when the
system is run; its docstring gives the coordinates, the zero pose and the source.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

import sympy as sp

from mbkit._check import real
from mbkit.errors import require_known
from mbkit.lagrangian.energies.symbols import velocity_of
from mbkit.lagrangian.system import Lagrangian

#: A parameter's value in SI units; None for one that follows when the system is run.
Value = float | None


def _values(arguments: dict[str, Value], symbols: str) -> dict[sp.Symbol, Value]:
    """Return values by symbol, of `argument=symbol` words: those above zero, then, behind a bar, those of any sign."""
    out: dict[sp.Symbol, Value] = {}
    for group, positive in zip(symbols.split("|"), (True, False), strict=False):
        for name, symbol in (word.split("=") for word in group.split()):
            value = arguments[name]
            out[sp.Symbol(symbol)] = None if value is None else real(name, value, positive=positive)
    return out


# Pendulums


def pendulum(*, mass: Value = 1.0, length: Value = 1.0, gravity: Value = 9.81) -> Lagrangian:
    """Return the mathematical pendulum: T = ½ m l² θ̇², V = -m g l cos θ.

    One coordinate, ``theta``, the angle from the downward vertical; at zero the mass hangs.

    References
    ----------
    Landau, Lifshitz 1976, Mechanics, §11 problem 1.
    """
    m, l, g, th = sp.symbols("m l g theta")
    w = velocity_of(th)
    values = _values(locals(), "mass=m length=l | gravity=g")
    return Lagrangian(m * l**2 * w**2 / 2, -m * g * l * sp.cos(th), [th], parameters=values, name="pendulum")


def double_pendulum(
    *, mass1: Value = 1.0, length1: Value = 1.0, mass2: Value = 1.0, length2: Value = 1.0, gravity: Value = 9.81
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
    values = _values(locals(), "mass1=m1 length1=l1 mass2=m2 length2=l2 | gravity=g")
    return Lagrangian(T, V, [th1, th2], parameters=values, name="double_pendulum")


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
    values = _values(locals(), "mass=m length=l stiffness=k | gravity=g")
    return Lagrangian(T, V, [th, s], parameters=values, name="elastic_pendulum")


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
    values = _values(locals(), "mass=m length=l | gravity=g")
    return Lagrangian(T, -m * g * l * sp.cos(th), [th, ph], parameters=values, name="spherical_pendulum")


# Systems with fewer motors than coordinates


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
    values = _values(locals(), "cart_mass=m_c pole_mass=m_p length=l | gravity=g")
    return Lagrangian(T, -m * g * l * sp.cos(th), [x, th], forces={x: F}, parameters=values, name="cart_pole")


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
    values = _values(locals(), "length1=l1 mass1=m1 mass2=m2 com1=l_c1 com2=l_c2 inertia1=I1 inertia2=I2 | gravity=g")
    return Lagrangian(T, V, [th1, th2], forces={th2: tau}, parameters=values, name="acrobot")


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
    from the downward vertical, a turn about the arm. At zero the pendulum hangs. L is the arm's length, J its moment
    about the vertical; the pendulum is a thin rod with its centre of mass l from the hinge and the moment I across it.

    References
    ----------
    Furuta, Yamakita, Kobayashi 1992, Swing-up control of inverted pendulum using pseudo-state feedback.
    """
    m, l, L, J, I, g, tau, al, th = sp.symbols("m l L J I g tau alpha theta")
    u, w = velocity_of(al), velocity_of(th)
    T = (J + m * L**2 + (I + m * l**2) * sp.sin(th) ** 2) * u**2 / 2 + (I + m * l**2) * w**2 / 2
    T += m * L * l * u * w * sp.cos(th)
    symbols = "arm_length=L arm_inertia=J pendulum_mass=m pendulum_com=l pendulum_inertia=I | gravity=g"
    values = _values(locals(), symbols)
    return Lagrangian(T, -m * g * l * sp.cos(th), [al, th], forces={al: tau}, parameters=values, name="furuta_pendulum")


# Motion about a centre


def kepler(*, mass: Value = 1.0, strength: Value = 1.0) -> Lagrangian:
    """Return a point mass in the potential -k/r: T = ½ m (ṙ² + r² φ̇²).

    Two coordinates: ``r``, the distance from the centre, above zero, and ``phi``, the angle, which is cyclic.
    There is no motion through the centre, where T and V are not defined.

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 3.
    """
    m, k, r, ph = sp.symbols("m k r phi")
    u, w = velocity_of(r), velocity_of(ph)
    values = _values(locals(), "mass=m | strength=k")
    return Lagrangian(m * (u**2 + r**2 * w**2) / 2, -k / r, [r, ph], parameters=values, name="kepler")


# Systems that are carried along in time: T has terms below the second degree


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
    values = _values(locals(), "mass=m radius=R | speed=Omega gravity=g")
    return Lagrangian(T, -m * g * R * sp.cos(th), [th], parameters=values, name="bead_on_hoop")


def driven_pendulum(
    *, mass: Value = 1.0, length: Value = 1.0, amplitude: Value = 0.1, frequency: Value = 100.0, gravity: Value = 9.81
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
    values = _values(locals(), "mass=m length=l | amplitude=a frequency=Omega gravity=g")
    return Lagrangian(T, V, [th], time=t, parameters=values, name="driven_pendulum")


# One degree of freedom: J(q) q̈ + ½ J′(q) q̇² + V′(q) = Q


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
    *, mass: Value = 1.0, crank: Value = 0.1, rod: Value = 0.3, torque: Value = 0.0, force: Value = 0.0
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
    values = _values(locals(), "mass=m crank=r rod=l | torque=tau force=F")
    J, Q = m * r**2 * lever**2, tau + F * r * lever
    return one_degree(J, 0, Q, coordinate=th, parameters=values, name="slider_crank")


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
    crank. It adds to the ``torque=`` of `mbkit.simulate`; with ``torque=0`` here, that is the whole input. J = J1 + m1
    L1²/4 + m2 (x2′² + y2′²) + J2 ψ′² + m3 x3′², never zero: dead centres are passed.

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
    values = _values(locals(), "crank=L1 rod=L2 crank_mass=m1 rod_mass=m2 piston_mass=m3 | torque=tau")
    return one_degree(J, 0, tau, coordinate=th, parameters=values, name="rigid_slider_crank")


def sliding_block(
    *, mass: Value = 1.0, slope: Value = 0.3, friction: Value = 0.2, creep: Value = 1e-3, gravity: Value = 9.81
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
    values = _values(locals(), "mass=m creep=v_0 | slope=alpha friction=mu gravity=g")
    V, Q = -m * g * x * sp.sin(al), -mu * m * g * sp.cos(al) * sp.tanh(u / v0)
    return one_degree(m, V, Q, coordinate=x, parameters=values, name="sliding_block")


def falling_body(*, mass: Value = 1.0, drag: Value = 0.25, gravity: Value = 9.81) -> Lagrangian:
    """Return a body that falls through air: ``Q = -c ż |ż|``.

    One coordinate, ``z``, the height. c is ½ ρ c_w A; the fall ends at the speed √(m g/c).

    References
    ----------
    Landau, Lifshitz 1987, Fluid Mechanics, §45.
    """
    m, c, g, z = sp.symbols("m c g z")
    u = velocity_of(z)
    values = _values(locals(), "mass=m | drag=c gravity=g")
    return one_degree(m, m * g * z, -c * u * sp.Abs(u), coordinate=z, parameters=values, name="falling_body")


# Rotating bodies in Euler's angles


def heavy_top(
    *, mass: Value = 1.0, length: Value = 0.1, across: Value = 0.02, axial: Value = 0.005, gravity: Value = 9.81
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
    values = _values(locals(), "mass=m length=l across=A axial=C | gravity=g")
    return Lagrangian(T, m * g * l * sp.cos(th), [ph, th, ps], parameters=values, name="heavy_top")


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

    Three coordinates: ``alpha``, the outer gimbal's turn about the vertical, ``beta``, the inner gimbal's turn about
    the outer one, which is the elevation of the rotor's axis above the horizontal, and ``gamma``, the rotor's turn in
    the inner gimbal; α and γ are cyclic. A and C are the rotor's moments across and along its axis, about its centre of
    mass, which lies l from the gimbals' centre; A_i, B_i and C_i the inner gimbal's about its hinge, along the rotor's
    axis and across both, J_o the outer one's about the vertical. At β = ±π/2 the mass matrix is singular but for J_o.

    References
    ----------
    Goldstein, Poole, Safko 2002, Classical Mechanics, ch. 5.7; Magnus 1971, Kreisel, for the gimbals.
    """
    m, l, A, C, Ai, Bi, Ci, Jo, g = sp.symbols("m l A C A_i B_i C_i J_o g")
    al, be, ga = sp.symbols("alpha beta gamma")
    u, w, s = map(velocity_of, (al, be, ga))
    T = (A + Ai + m * l**2) * w**2 / 2 + C * (s + u * sp.sin(be)) ** 2 / 2
    T += (Jo + (A + Ci + m * l**2) * sp.cos(be) ** 2 + Bi * sp.sin(be) ** 2) * u**2 / 2
    symbols = "rotor_mass=m rotor_axial=C rotor_across=A | offset=l inner_hinge=A_i inner_axial=B_i inner_across=C_i"
    values = _values(locals(), f"{symbols} outer_inertia=J_o gravity=g")
    return Lagrangian(T, m * g * l * sp.sin(be), [al, be, ga], parameters=values, name="gyroscope")


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
    values = _values(locals(), "A=A B=B C=C")
    return Lagrangian(T, 0, [ph, th, ps], parameters=values, name="rigid_body")


_SYSTEMS: Final[dict[str, Callable[..., Lagrangian]]] = {
    f.__name__: f
    for f in (
        *(pendulum, double_pendulum, elastic_pendulum, spherical_pendulum, cart_pole, acrobot, furuta_pendulum),
        *(kepler, bead_on_hoop, driven_pendulum, slider_crank, rigid_slider_crank, heavy_top, gyroscope, rigid_body),
        *(sliding_block, falling_body),
    )
}
__all__ = ["get", "names", "one_degree", *_SYSTEMS]


def names() -> tuple[str, ...]:
    """Return the systems' names.

    Examples
    --------
    >>> import mbkit as mb
    >>> mb.lagrangian.systems.names()[:3]
    ('pendulum', 'double_pendulum', 'elastic_pendulum')
    """
    return tuple(_SYSTEMS)


def get(name: str) -> Callable[..., Lagrangian]:
    """Return the function of the system of this name.

    Raises
    ------
    UnknownNameError
        With near names.
    """
    require_known("system on paper", _SYSTEMS, name)
    return _SYSTEMS[name]
