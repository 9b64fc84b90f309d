"""Motions of the textbook's systems along time, written apart from mbkit.

Nothing here imports mbkit. Exact ones first: in elementary functions, in Fresnel's integrals, or by ``quadrature``
where all coordinates but one are cyclic; pendulums, bodies and tops are in ``elliptic``, Kepler's ellipse and the
massive slider-crank in ``textbook``. For systems that have no exact motion, `integrated` runs the equations of
``textbook`` and ``closed_forms``, which were written down by hand. Conventions are theirs: angles from the downward
vertical, SI units; each function returns positions and velocities, (K, n) each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mpmath as mp
import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from scipy.special import fresnel

from validation.closed_forms import Array, System
from validation.quadrature import DIGITS, Swing, one_cyclic
from validation.textbook import BeadOnHoop, Gyroscope, Kapitza, SliderCrank, WheeledSpacecraft

Motion = tuple[Array, Array]


def integrated(rate: Callable[[float, Array], Array], t: Sequence[float], y0: ArrayLike) -> Array:
    """Return y at times, (K, n), by the method of Dormand and Prince of order 8 with 13 digits a step.

    Each time ends a run, as what lies between steps is of lower order.
    """
    y, now, out = np.asarray(y0, dtype=float), 0.0, []
    for end in t:
        if end > now:
            run = solve_ivp(rate, (now, end), y, method="DOP853", rtol=1e-13, atol=1e-13)
            y, now = run.y[:, -1], end
        out.append(y)
    return np.array(out)


def of_system(system: System, t: Sequence[float], q0: ArrayLike, v0: ArrayLike, tau: ArrayLike = 0.0) -> Motion:
    """Return the motion of a system whose velocities are its coordinates' rates, under constant forces."""
    n = len(np.atleast_1d(q0))
    force = np.broadcast_to(np.asarray(tau, dtype=float), n)

    def rate(_: float, y: Array) -> Array:
        return np.concatenate([y[n:], system.forward_dynamics(y[:n], y[n:], force)])

    y = integrated(rate, t, np.concatenate([q0, v0]))
    return y[:, :n], y[:, n:]


# --------------------------------------------------------------------------------------
# Vibrations


def damped(t: ArrayLike, x0: float, v0: float, stiffness: float, damping: float) -> Motion:
    """Return x and ẋ of ẍ + c ẋ + k x = 0 below the critical damping (Landau, Lifshitz 1976, §25)."""
    t, fall = np.atleast_1d(np.asarray(t, dtype=float)), damping / 2
    w = np.sqrt(stiffness - fall**2)
    across, decay = (v0 + fall * x0) / w, np.exp(-fall * t)
    x = decay * (x0 * np.cos(w * t) + across * np.sin(w * t))
    rate = decay * w * (across * np.cos(w * t) - x0 * np.sin(w * t)) - fall * x
    return x[:, None], rate[:, None]


def spring_chain(t: ArrayLike, x0: ArrayLike, v0: ArrayLike, mass: float, stiffness: float, damping: float) -> Motion:
    """Return n equal masses in a row, tied to a wall and each to the next by equal springs and dampers.

    Modes sin(i κ), κ = (2 j - 1) π/(2 n + 1), with ω = 2 √(k/m) sin(κ/2), as the last mass is free (Timoshenko,
    Young, Weaver 1974, ch. 4); dampers that are like the springs leave them uncoupled.
    """
    x0, v0 = np.asarray(x0, dtype=float), np.asarray(v0, dtype=float)
    n = len(x0)
    j = np.arange(1, n + 1)
    wave = (2 * j - 1) * np.pi / (2 * n + 1)
    shapes = np.sin(np.outer(j, wave))
    start = [np.linalg.solve(shapes, x) for x in (x0, v0)]
    squares = 4 * np.sin(wave / 2) ** 2 / mass
    modes = [damped(t, a, b, stiffness * s, damping * s) for a, b, s in zip(*start, squares, strict=True)]
    x, v = (np.concatenate(parts, axis=1) @ shapes.T for parts in zip(*modes, strict=True))
    return x, v


def stretched(t: ArrayLike, s0: float, speed: float, mass: float, stiffness: float, g: float = 9.81) -> Motion:
    """Return θ = 0 and the stretch of an elastic pendulum that swings along the vertical: s = m g/k + A cos(...)."""
    sag = mass * g / stiffness
    s, rate = damped(t, s0 - sag, speed, stiffness / mass, 0.0)
    return np.hstack([0 * s, sag + s]), np.hstack([0 * s, rate])


# --------------------------------------------------------------------------------------
# One coordinate that is not cyclic


def cart_pole(
    t: ArrayLike,
    q0: Sequence[float],
    v0: Sequence[float],
    cart: float,
    pole: float,
    length: float,
    force: float,
    g: float,
) -> Motion:
    """Return (x, θ) under a constant force on the cart.

    Derived here: seen from axes that go with the acceleration α = F/(M + m), no force acts along x, and the weight
    has the part -m α along it: V = -m l (g cos θ - α sin θ).
    """
    t = np.atleast_1d(np.asarray(t, dtype=float))
    with mp.workdps(DIGITS):
        M, m, ell = mp.mpf(cart), mp.mpf(pole), mp.mpf(length)
        pull = mp.mpf(force) / (M + m)
        q, v = one_cyclic(
            t,
            (q0[0], q0[1]),
            (v0[0], v0[1]),
            lambda _: M + m,
            lambda x: m * ell * mp.cos(x),
            lambda _: m * ell**2,
            lambda x: m * ell * (pull * mp.sin(x) - mp.mpf(g) * mp.cos(x)),
        )
    return q + np.outer(t**2 / 2, [float(pull), 0.0]), v + np.outer(t, [float(pull), 0.0])


def elbow(t: ArrayLike, q0: Sequence[float], v0: Sequence[float], whole: float, outer: float, reach: float) -> Motion:
    """Return two links without weight, the second angle from the first link.

    M = [[whole + 2 r cos θ₂, outer + r cos θ₂], [., outer]] with r = `reach`: as in `textbook.acrobot`, `whole` is
    I₁ + I₂ + m₂ l₁² and `outer` I₂, about the hinges, and `reach` m₂ l₁ c₂.
    """
    return one_cyclic(
        t,
        (q0[0], q0[1]),
        (v0[0], v0[1]),
        lambda x: whole + 2 * reach * mp.cos(x),
        lambda x: outer + reach * mp.cos(x),
        lambda _: mp.mpf(outer),
        lambda _: mp.mpf(0),
    )


def elastic(
    t: ArrayLike, q0: Sequence[float], v0: Sequence[float], length: float, mass: float, stiffness: float
) -> Motion:
    """Return θ and the stretch of the elastic pendulum without weight: a motion about a centre."""
    return one_cyclic(
        t,
        (q0[0], q0[1]),
        (v0[0], v0[1]),
        lambda s: mass * (length + s) ** 2,
        lambda _: mp.mpf(0),
        lambda _: mp.mpf(mass),
        lambda s: stiffness * s**2 / 2,
    )


def furuta_pendulum(
    t: ArrayLike,
    q0: Sequence[float],
    v0: Sequence[float],
    arm_length: float,
    arm: float,
    mass: float,
    com: float,
    inertia: float,
    g: float = 9.81,
) -> Motion:
    """Return arm and pendulum, a thin rod, without torque; `arm` is the arm's moment about the vertical.

    T as in `textbook.furuta_pendulum`.
    """
    about = inertia + mass * com**2
    return one_cyclic(
        t,
        (q0[0], q0[1]),
        (v0[0], v0[1]),
        lambda x: arm + mass * arm_length**2 + about * mp.sin(x) ** 2,
        lambda x: mass * arm_length * com * mp.cos(x),
        lambda _: mp.mpf(about),
        lambda x: -mass * g * com * mp.cos(x),
    )


def bead_on_hoop(t: ArrayLike, theta0: float, speed0: float, form: BeadOnHoop) -> Motion:
    """Return θ: T₂ - T₀ + V stays."""
    scale = form.mass * form.radius**2
    x, v = Swing(
        lambda _: mp.mpf(scale),
        lambda x: -scale * form.spin**2 * mp.sin(x) ** 2 / 2 - form.mass * form.g * form.radius * mp.cos(x),
        theta0,
        speed0,
    ).at(t)
    return x[:, None], v[:, None]


def gyroscope(t: ArrayLike, q0: Sequence[float], v0: Sequence[float], form: Gyroscope) -> Motion:
    """Return precession, nutation and spin.

    p_γ = C (γ̇ + α̇ sin β) and p_α = K α̇ + p_γ sin β stay, with K = O + (A + c) cos² β + b sin² β; so
    U = m g r sin β + (p_α - p_γ sin β)²/(2 K).
    """
    A, C, (a, b, c) = form.across, form.rotor_axial, form.inner_inertia

    def outer(x: mp.mpf) -> mp.mpf:
        return form.outer_inertia + (A + c) * mp.cos(x) ** 2 + b * mp.sin(x) ** 2

    with mp.workdps(DIGITS):
        x0 = mp.mpf(q0[1])
        p = C * (mp.mpf(v0[2]) + v0[0] * mp.sin(x0))
        p_outer = outer(x0) * v0[0] + p * mp.sin(x0)

    def precession(x: mp.mpf) -> mp.mpf:
        return (p_outer - p * mp.sin(x)) / outer(x)

    def spin(x: mp.mpf) -> mp.mpf:
        return p / C - precession(x) * mp.sin(x)

    swing = Swing(
        lambda _: mp.mpf(A + a),
        lambda x: form.moment * mp.sin(x) + (p_outer - p * mp.sin(x)) ** 2 / (2 * outer(x)),
        q0[1],
        v0[1],
    )
    x, speed = swing.at(t)
    turned = [start + swing.gathered(t, f) for start, f in ((q0[0], precession), (q0[2], spin))]
    rates = [np.array([float(f(y)) for y in map(mp.mpf, x)]) for f in (precession, spin)]
    return np.stack([turned[0], x, turned[1]], axis=-1), np.stack([rates[0], speed, rates[1]], axis=-1)


def half_trace(form: Kapitza, theta: float) -> float:
    """Return cos of the phase per period of small motions about θ = 0 or π: those are stable where it lies within ±1.

    Half the trace of the monodromy of x'' = -cos θ (g - a Ω² cos Ωt) x/l (Landau, Lifshitz 1976, §27).
    """

    def rate(t: float, y: Array) -> Array:
        return np.concatenate([y[2:], -np.cos(theta) * (form.g + form.pivot(t)[2]) / form.length * y[:2]])

    y = integrated(rate, [2 * np.pi / form.frequency], [1.0, 0.0, 0.0, 1.0])[-1]
    return float((y[0] + y[3]) / 2)


# --------------------------------------------------------------------------------------
# Forces


def pushed_piston(t: ArrayLike, theta0: float, speed0: float, push: float, form: SliderCrank) -> Motion:
    """Return the massless crank's angle, between 0 and π, under a constant force on the piston outwards.

    Nothing but the piston has mass, so it obeys Newton: s = s₀ + ṡ₀ t + F t²/(2 m), and the triangle of crank and rod
    gives cos θ = (s² + r² - l²)/(2 r s).
    """
    t = np.atleast_1d(np.asarray(t, dtype=float))
    pull = push / form.mass
    s = form.position(theta0) + form.velocity(theta0, speed0) * t + pull * t**2 / 2
    theta = np.arccos((s**2 + form.crank**2 - form.rod**2) / (2 * form.crank * s))
    speed = (form.velocity(theta0, speed0) + pull * t) / form.slope(theta)
    return theta[:, None], speed[:, None]


def thrown_upwards(t: ArrayLike, z0: float, speed0: float, mass: float, drag: float, g: float = 9.81) -> Motion:
    """Return the height of a body thrown up at `speed0` ≥ 0 against -c ż |ż|.

    With the fall's last speed V = √(m g/c): ż = V tan(φ - g t/V), tan φ = ż₀/V, up to the top, and -V tanh(g t/V) from
    there (Landau, Lifshitz 1987, Fluid Mechanics, §45, for the force; derived here).
    """
    t = np.atleast_1d(np.asarray(t, dtype=float))
    last = np.sqrt(mass * g / drag)
    phi = np.arctan(speed0 / last)
    left = phi - g * t / last
    up, down = np.clip(left, 0, None), np.clip(-left, 0, None)
    z = z0 + last**2 / g * (np.log(np.cos(up) / np.cos(phi)) - np.log(np.cosh(down)))
    return z[:, None], (last * (np.tan(up) - np.tanh(down)))[:, None]


def sliding_block(t: ArrayLike, speed0: float, slope: float, friction: float, creep: float, g: float = 9.81) -> Motion:
    """Return the way down a slope from 0 against μ g cos α tanh(ẋ/v₀), from rest or faster.

    Derived here: with a = g sin α > b = μ g cos α the time is ∫ dv/(a - b tanh(v/v₀)), which is
    (a v + b v₀ ln(a cosh(v/v₀) - b sinh(v/v₀)))/(a² - b²); the way is ∫ v dv/(a - b tanh(v/v₀)).
    """
    out = []
    with mp.workdps(DIGITS):
        a, b = mp.mpf(g) * mp.sin(slope), mp.mpf(friction) * mp.mpf(g) * mp.cos(slope)
        v0, first = mp.mpf(creep), mp.mpf(speed0)

        def pull(v: mp.mpf) -> mp.mpf:
            return a - b * mp.tanh(v / v0)

        def spent(v: mp.mpf) -> mp.mpf:
            return (a * v + b * v0 * mp.log(a * mp.cosh(v / v0) - b * mp.sinh(v / v0))) / (a**2 - b**2)

        for now in np.atleast_1d(np.asarray(t, dtype=float)):
            target = spent(first) + mp.mpf(now)
            v = mp.findroot(lambda v, end=target: spent(v) - end, first + (a - b) * mp.mpf(now))
            # Its poles lie π v₀/2 off the real axis.
            cuts = mp.linspace(first, v, 2 + int((v - first) / v0)) if v > first else [first, v]
            out.append((float(mp.quad(lambda v: v / pull(v), cuts)), float(v)))
    x, v = np.array(out).T
    return x[:, None], v[:, None]


def thruster(
    t: ArrayLike, q0: Sequence[float], v0: Sequence[float], mass: float, inertia: float, thrust: float, arm: float
) -> Motion:
    """Return (x, y, θ) of a plane body pushed along its own x-axis, `arm` beside its centre so that it turns faster.

    Derived here: θ = θ_c + α u²/2 with α = F d/I and u = t + θ̇₀/α, so that x + i y has the acceleration
    (F/m) e^{iθ_c} e^{i α u²/2}, whose integral is Fresnel's, and whose second one follows by parts.
    """
    t = np.atleast_1d(np.asarray(t, dtype=float))
    turning = thrust * arm / inertia
    start = v0[2] / turning
    u = t + start
    wide = np.sqrt(np.pi / turning)

    def once(u: ArrayLike) -> Array:
        s, c = fresnel(np.asarray(u) / wide)
        return np.asarray(wide * (c + 1j * s))

    push = thrust / mass * np.exp(1j * (q0[2] - turning * start**2 / 2))
    gained = once(u) - once(start)
    ends = np.exp(1j * turning * u**2 / 2) - np.exp(1j * turning * start**2 / 2)
    way = push * (u * gained + 1j / turning * ends)
    place, velocity = complex(*q0[:2]) + complex(*v0[:2]) * t + way, complex(*v0[:2]) + push * gained
    theta = q0[2] + v0[2] * t + turning * t**2 / 2
    return (
        np.stack([place.real, place.imag, theta], axis=-1),
        np.stack([velocity.real, velocity.imag, v0[2] + turning * t], axis=-1),
    )


# --------------------------------------------------------------------------------------
# Spacecraft with wheels


def dual_spin(t: ArrayLike, form: WheeledSpacecraft, R0: Array, w0: ArrayLike, speed: float) -> tuple[Array, Array]:
    """Return attitudes, (K, 3, 3), and body rates, (K, 3), of a symmetric hub with one free wheel on its z-axis.

    Hughes 1986, ch. 7, on gyrostats: ω₃ and the wheel's rate Ω stay, the others go round at
    λ = ((C - A) ω₃ + J Ω)/A; as ω = L/A - λ e₃, R(t) = exp(L t/A) R₀ exp(-λ t e₃) with L in space.
    """
    t, w0 = np.atleast_1d(np.asarray(t, dtype=float)), np.asarray(w0, dtype=float)
    A, _, C = np.diag(form.central_inertia)
    wheel = form.wheel_inertia * speed
    L = R0 @ (form.central_inertia @ w0 + [0.0, 0.0, wheel])
    rate = ((C - A) * w0[2] + wheel) / A
    before = Rotation.from_rotvec(np.outer(t / A, L)).as_matrix()
    after = Rotation.from_rotvec(np.outer(-rate * t, [0.0, 0.0, 1.0])).as_matrix()
    c, s = np.cos(rate * t), np.sin(rate * t)
    w = np.stack([c * w0[0] - s * w0[1], s * w0[0] + c * w0[1], np.full(len(t), w0[2])], axis=-1)
    return np.asarray(before @ R0 @ after), w


def wheeled(
    t: Sequence[float], form: WheeledSpacecraft, R0: Array, w0: ArrayLike, speeds: ArrayLike, torques: ArrayLike
) -> tuple[Array, Array, Array]:
    """Return attitudes, body rates and the wheels' rates under constant motor torques, integrated.

    By `WheeledSpacecraft.attitude_rates` and Ṙ = R ω̂.
    """
    torques = np.asarray(torques, dtype=float)

    def rate(_: float, y: Array) -> Array:
        turning, spinning = form.attitude_rates(y[:3], y[3:-9], torques)
        return np.concatenate([turning, spinning, np.cross(y[-9:].reshape(3, 3), y[:3]).ravel()])

    y = integrated(rate, t, np.concatenate([w0, speeds, R0.ravel()]))
    return y[:, -9:].reshape(-1, 3, 3), y[:, :3], y[:, 3:-9]
