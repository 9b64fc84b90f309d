"""Exact motions: closed forms, quadratures, and slow motions of stiff systems by collocation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Final

import mpmath as mp
import numpy as np
from numpy.polynomial.legendre import leggauss, legroots
from numpy.typing import ArrayLike
from scipy.interpolate import BarycentricInterpolator
from scipy.spatial.transform import Rotation
from scipy.special import ellipj, ellipkinc, ellipkm1, elliprf, elliprj

from mbkit._check import COMPLEX_STEP, Array

#: A function from times (K,) to q (K, nq).
Exact = Callable[[Array], Array]

# Slow motions of stiff systems, by collocation in variables in which nothing is stiff.
#
# Where a spring of stiffness k all but holds a coordinate s, k s stays of the size of a force. In it the
# equations have 1/k in them instead of k, and go over into those of the rigid joint. Collocation at Radau's points
# solves them for any k with steps that know nothing of the fast mode, which is hardly excited (Hairer, Wanner 1996,
# VI.3 on singular perturbations, IV.5 on Radau IIA).

_RADAU_STAGES: Final = 8
_MAX_NEWTON_ITERATIONS: Final = 30

#: F(y, ẏ), each (s, n), real or complex.
Residual = Callable[[Any, Any], Any]


def slow_motion(residual: Residual, start: Array, duration: float, steps: int) -> Callable[[Array], Array]:
    """Return y, (K, n), of F(y, ẏ) = 0 up to the duration; F is analytic, for a complex step differentiates it."""
    basis = _radau()[2]
    h = duration / steps
    pieces: list[Array] = []

    def motion(t: Array) -> Array:
        which = np.minimum((t / h).astype(int), steps - 1)
        # Steps are computed when a time needs them: a problem costs nothing.
        while len(pieces) <= int(which.max(initial=0)):
            y = pieces[-1][-1] if pieces else np.asarray(start, dtype=np.float64)
            pieces.append(_step(residual, y, pieces[-1] if pieces else None, h))
        return np.asarray(np.einsum("kj,kjn->kn", basis(t / h - which), np.stack(pieces)[which]))

    return motion


def _step(residual: Residual, y: Array, before: Array | None, h: float) -> Array:
    """Return y at the points of a step, (s + 1, n), by Newton's method with the first iterate's derivatives."""
    s, n = _RADAU_STAGES, len(y)
    points, slopes, basis = _radau()
    slopes = slopes / h
    Y = np.tile(y, (s, 1)) if before is None else basis(1 + points[1:]) @ before
    by_y, by_rate = _jacobians(residual, Y, slopes @ np.vstack([y, Y]))
    J = np.einsum("ik,iab->iakb", slopes[:, 1:], by_rate)
    J[np.arange(s), :, np.arange(s), :] += by_y
    inverse = np.linalg.inv(J.reshape(s * n, s * n))
    last = np.inf
    for _ in range(_MAX_NEWTON_ITERATIONS):
        change = (inverse @ residual(Y, slopes @ np.vstack([y, Y])).ravel()).reshape(s, n)
        Y = Y - change
        size = float(np.abs(change).max())
        # Rounding is reached where it no longer falls.
        if size == 0 or (size < 1e-9 * float(np.abs(Y).max()) and size > 0.5 * last):
            break
        last = size
    return np.vstack([y, Y])


def _jacobians(residual: Residual, Y: Array, dY: Array) -> tuple[Array, Array]:
    """Return ∂F/∂y and ∂F/∂ẏ, (s, n, n) each, of one evaluation at all disturbed states."""
    s, n = Y.shape
    unit = np.broadcast_to(1j * COMPLEX_STEP * np.eye(n)[:, None], (n, s, n))
    disturbed = np.concatenate([Y + unit, np.broadcast_to(Y, (n, s, n))])
    rates = np.concatenate([np.broadcast_to(dY, (n, s, n)), dY + unit])
    F = residual(disturbed.reshape(-1, n), rates.reshape(-1, n)).imag.reshape(2, n, s, n) / COMPLEX_STEP
    return np.moveaxis(F[0], 0, -1), np.moveaxis(F[1], 0, -1)


@cache
def _radau() -> tuple[Array, Array, BarycentricInterpolator]:
    """Return 0 and Radau's points in (0, 1]; the polynomials that are 1 at one of them; before, their derivatives."""
    points = np.concatenate([[0.0], (np.sort(legroots([*[0.0] * (_RADAU_STAGES - 1), -1.0, 1.0])) + 1) / 2])
    points[-1] = 1.0
    basis = BarycentricInterpolator(points, np.eye(_RADAU_STAGES + 1))
    return points, basis.derivative(points[1:]), basis


_GRAVITY: Final = 9.81
#: Steps a second: a taut chain hardly rings at frequencies above.
_STEPS_PER_SECOND: Final = 200


class HangingChain:
    """Rods of 1 m with masses in kg, hinged end to end, and a load at the last end.

    In angles φ from the vertical, Σ_j a_ij (cos(φ_i - φ_j) φ̈_j + sin(φ_i - φ_j) φ̇_j²) + g w_i sin φ_i = 0, where a_ij
    sums m f_ki f_kj over the rods k, f being 1 above rod k and ½ on it, and m/12 for its own turn; w_i sums m f_ki.
    """

    def __init__(self, masses: Sequence[float], load: float = 0.0) -> None:
        m, n = np.asarray(masses, dtype=np.float64), len(masses)
        below = np.tril(np.ones((n, n)), -1) + np.eye(n) / 2
        self._a = (below.T * m) @ below + np.diag(m) / 12 + load
        self._w = m @ below + load

    def taut(self, angle: float) -> Array:
        """Return the angles q at which a chain let go at rest begins to turn as one: light rods then hardly ring."""
        n = len(self._w)
        # The common acceleration, and the angles below the first rod's.
        x = np.array([-_GRAVITY * np.sin(angle) / n, *[angle] * (n - 1)])

        def residual(x: Array) -> Array:
            phi = np.concatenate([[angle], x[1:]])
            pull = self._a * np.cos(phi[:, None] - phi)
            return np.asarray((x[0] * pull.sum(axis=1) + _GRAVITY * self._w * np.sin(phi)) / self._w)

        for _ in range(20):
            J = np.stack([residual(x + 1j * COMPLEX_STEP * e).imag / COMPLEX_STEP for e in np.eye(n)], axis=1)
            x = x - np.linalg.solve(J, residual(x))
        return np.diff([0.0, angle, *x[1:]])

    def motion(self, q: Array, duration: float) -> Exact:
        """Return q, (K, n), let go at rest."""
        n, a, w = len(q), self._a, self._w

        def residual(y: Array, rate: Array) -> Array:
            phi, turn = y[:, :n], y[:, n:]
            apart = phi[:, :, None] - phi[:, None, :]
            forces = np.einsum("sij,sj->si", a * np.cos(apart), rate[:, n:])
            forces += np.einsum("sij,sj->si", a * np.sin(apart), turn**2) + _GRAVITY * w * np.sin(phi)
            return np.concatenate([rate[:, :n] - turn, forces / w], axis=1)

        start = np.concatenate([np.cumsum(q), np.zeros(n)])
        solved = slow_motion(residual, start, duration, round(_STEPS_PER_SECOND * duration))
        return lambda t: np.diff(solved(t)[:, :n], axis=1, prepend=0.0)


# Exact motions of linear systems.

#: Rates of 1 and of 1e12 per second stand side by side.
_DIGITS: Final = 50


def linear(rates: ArrayLike, start: ArrayLike) -> Exact:
    """Return the first half of x of ẋ = A x, by exp(A t) with 50 digits."""
    A, x = np.asarray(rates, dtype=np.float64), np.asarray(start, dtype=np.float64)

    def motion(t: Array) -> Array:
        with mp.workdps(_DIGITS):
            states = [mp.expm(mp.matrix(A.tolist()) * mp.mpf(time)) * mp.matrix(x.tolist()) for time in t.tolist()]
            return np.array([[float(y) for y in state[: len(x) // 2, 0]] for state in states])

    return motion


def slowest_mode(M: Array, stiffness: Array) -> tuple[float, Array, float]:
    """Return the slowest frequency of M q̈ + diag(k) q = 0, its shape, and the fastest frequency.

    The largest eigenvalue 1/ω² of k^-½ M k^-½ and its shape are known to rounding, however stiff other springs are.
    """
    root = np.sqrt(stiffness)
    squares, shapes = np.linalg.eigh(M / root[:, None] / root)
    shape = shapes[:, -1] / root
    inverse = np.linalg.inv(M)
    fastest = float(np.sqrt(np.abs(np.linalg.eigvals(inverse * stiffness)).max()))
    return float(squares[-1] ** -0.5), shape / shape[0], fastest


# Exact motions of the pendulum and the cart-pole, in double.

_QUADRATURE_NODES: Final = 128
_TABLE_ROWS: Final = 4000


def pendulum(theta: float, speed: float, square: float) -> Exact:
    """Return θ, (K, 1), of θ̈ + ω² sin θ = 0 from θ₀, below π, and θ̇₀, rad and rad/s, and ω² = g/l, 1/s².

    sin(θ/2) = k sn(ω t + u₀ | k²) where it swings, θ/2 = am(k ω t + u₀ | 1/k²) where it goes round, with
    k² = sin²(θ₀/2) + θ̇₀²/(4 ω²) (Landau, Lifshitz 1976, §11; Whittaker 1937, §44).
    """
    w = math.sqrt(square)
    # k² ω², which stays what it is where there is no gravity.
    scaled = (w * math.sin(theta / 2)) ** 2 + (speed / 2) ** 2
    if scaled < square:
        k = math.sqrt(scaled) / w
        start = ellipkinc(math.atan2(math.sin(theta / 2), speed / (2 * w)), k * k)
        return lambda t: 2 * np.arcsin(k * ellipj(w * t + start, k * k)[0])[:, None]
    rate, m = math.copysign(math.sqrt(scaled), speed), square / scaled
    start = ellipkinc(theta / 2, m)
    return lambda t: 2 * ellipj(rate * t + start, m)[3][:, None]


class _Phase:
    """A phase y from 0 to `last` whose time is ∫ slope dy, by Gauss-Legendre; inverted by a table and Newton steps."""

    def __init__(self, slope: Exact, last: float) -> None:
        self._slope, self._last = slope, last
        self.whole = float(self.integral(slope, np.array([last]))[0])

    @staticmethod
    def integral(of: Exact, y: Array) -> Array:
        """Return ∫ of dy from 0."""
        nodes, weights = leggauss(_QUADRATURE_NODES)
        return np.asarray(y / 2 * (of(y[:, None] / 2 * (1 + nodes)) @ weights))

    def at(self, t: Array) -> Array:
        """Return the phase at times from 0 to the whole one."""
        table = np.linspace(0, self._last, _TABLE_ROWS)
        y = np.interp(t, self.integral(self._slope, table), table)
        for _ in range(4):
            y = np.clip(y + (t - self.integral(self._slope, y)) / self._slope(y), 0, self._last)
        return y


def cart_pole(theta: float, cart: float) -> Exact:
    """Return (x, θ), (K, 2), of a cart of M kg with a pole of 1 kg and 1 m, let go at rest at x = 0, 0 < θ₀ < π.

    No force acts along x, so x = (sin θ₀ - sin θ)/(M + 1), and energy gives
    θ̇² = 2 g (M + 1)(cos θ - cos θ₀)/(M + sin² θ). With sin(θ/2) = k sin φ, k = sin(θ₀/2), φ grows for ever, and
    dt = √(M/(1 - k² sin² φ) + 4 k² sin² φ) dφ/√(g (M + 1)): a quadrature in y, φ = ε sinh y, for the root bends within
    ε = √M/(2 k) of φ = 0.
    """
    k = math.sin(theta / 2)
    bend = math.sqrt(cart) / (2 * k)

    def slope(y: Array) -> Array:
        s2 = np.sin(bend * np.sinh(y)) ** 2
        root = np.sqrt(cart / (1 - k * k * s2) + 4 * k * k * s2)
        return np.asarray(root * bend * np.cosh(y) / math.sqrt(_GRAVITY * (cart + 1)))

    quarter = _Phase(slope, math.asinh(math.pi / 2 / bend))

    def motion(t: Array) -> Array:
        # φ = π/2 at the start; the time is folded onto the quarter period in which φ runs from 0 to π/2.
        turns = np.rint((t / quarter.whole + 1) / 2)
        rest = t - (2 * turns - 1) * quarter.whole
        phi = np.sign(rest) * bend * np.sinh(quarter.at(np.abs(rest))) + math.pi * turns
        angle = 2 * np.arcsin(k * np.sin(phi))
        return np.stack([(math.sin(theta) - np.sin(angle)) / (cart + 1), angle], axis=-1)

    return motion


# Exact rotations: a free body, a top in steady precession, a turn about one axis past gimbal lock.


def turning(axis: Array, speed: float) -> Exact:
    """Return quaternions (K, 4) of a steady turn about an axis, from the identity."""
    unit = axis / np.linalg.norm(axis)

    def motion(t: Array) -> Array:
        half = speed * t / 2
        return np.concatenate([np.multiply.outer(np.sin(half), unit), np.cos(half)[:, None]], axis=1)

    return motion


def free_rotor(inertia: Array, spin: Array) -> tuple[Exact, float]:
    """Return quaternions (K, 4) of a torque-free body from the identity, and the period of its angular velocity.

    Principal moments C > B > A about x, y and z, kg m², and a spin with ω_x > 0 and L² > 2 E B, rad/s. Landau, Lifshitz
    1976, §37: ω = (c dn, b sn, a cn); the x axis goes round L at φ̇ = (L/C)(1 + (C - A)/A / (1 - n sn²)), an integral of
    the third kind (Carlson 1979 for it).
    """
    (C, B, A), (z, y, x) = inertia, spin
    # Terms that do not cancel.
    upper = A * (C - A) * x * x + B * (C - B) * y * y  # 2 E C - L²
    lower = B * (B - A) * y * y + C * (C - A) * z * z  # L² - 2 E A
    a, b, c = math.sqrt(upper / (A * (C - A))), math.sqrt(upper / (B * (C - B))), math.sqrt(lower / (C * (C - A)))
    m = (B - A) * upper / ((C - B) * lower)
    rest = (C - A) * (C * (C - B) * z * z - A * (B - A) * x * x) / ((C - B) * lower)  # 1 - m
    # Backwards, for the moments fall from x to z.
    rate = -math.sqrt((C - B) * lower / (A * B * C))
    momentum = float(np.linalg.norm(inertia * spin))
    n = -((C * c) ** 2) * m * (C - A) / (A * upper)
    quarter = float(ellipkm1(rest))
    whole = 2 * float(_third_kind(n, rest, np.array([1.0]), np.array([0.0]))[0])
    start = float(ellipkinc(math.atan2(y / b, x / a), m))

    def jacobi(t: Array) -> tuple[Array, Array]:
        """Return the angular velocity and ∫ dt/(1 - n sn²)."""
        u = rate * t + start
        turns = np.rint(u / (2 * quarter))
        sn, cn, dn, _ = ellipj(u - 2 * turns * quarter, m)
        sign = (-1.0) ** turns
        spins = np.stack([c * dn, b * sign * sn, a * sign * cn], axis=-1)
        return spins, (turns * whole + _third_kind(n, rest, sn, cn)) / rate

    (_, before), first = jacobi(np.zeros(1)), _momentum_axes(inertia, spin[None])[0]

    def motion(t: Array) -> Array:
        spins, poles = jacobi(t)
        turned = momentum / C * (t + (C - A) / A * (poles - before))
        about = Rotation.from_rotvec(np.multiply.outer(turned, [0.0, 0.0, 1.0])).as_matrix()
        attitude = first @ about @ np.swapaxes(_momentum_axes(inertia, spins), 1, 2)
        return np.asarray(Rotation.from_matrix(attitude).as_quat())

    return motion, 4 * quarter / abs(rate)


def _third_kind(n: float, rest: float, sn: Array, cn: Array) -> Array:
    """Return Π(n; φ | m) for |φ| ≤ π/2 and 1 - m, in Carlson's forms."""
    c2, d2 = cn * cn, cn * cn + rest * sn * sn
    return np.asarray(sn * elliprf(c2, d2, 1.0) + n / 3 * sn**3 * elliprj(c2, d2, 1.0, 1 - n * sn * sn))


def _momentum_axes(inertia: Array, spins: Array) -> Array:
    """Return, in body axes, the columns: the x axis' part normal to L, their product, L's direction."""
    L = inertia * spins
    third = L / np.linalg.norm(L, axis=1, keepdims=True)
    first = np.array([1.0, 0.0, 0.0]) - third * third[:, :1]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(third, first), third], axis=-1)


def precession(
    spin: float, tilt: float, moment: float, across: float, along: float
) -> tuple[Exact, Array, Array, float]:
    """Return quaternions (K, 4) of a symmetric top in steady precession, its start (4,) and (3,), and its rate.

    The axis is the body's y, at `tilt` from the upward vertical. A Ω² cos θ - C ω₃ Ω + m g r = 0 (Landau, Lifshitz
    1976, §35 problem 2) with ω₃ = spin, m g r = moment, A = across and C = along; the result is the slow root.
    """
    root = math.sqrt((along * spin) ** 2 - 4 * across * moment * math.cos(tilt))
    slow = 2 * moment / (along * spin + root)
    own = spin - slow * math.cos(tilt)
    leaning = Rotation.from_rotvec([math.pi / 2 - tilt, 0.0, 0.0])

    def motion(t: Array) -> Array:
        round_ = Rotation.from_rotvec(np.multiply.outer(slow * t, [0.0, 0.0, 1.0]))
        about = Rotation.from_rotvec(np.multiply.outer(own * t, [0.0, 1.0, 0.0]))
        return np.asarray((round_ * leaning * about).as_quat())

    v = leaning.inv().apply([0.0, 0.0, slow]) + np.array([0.0, own, 0.0])
    return motion, np.asarray(leaning.as_quat()), np.asarray(v), slow


def past_gimbal_lock(distance: float, speed: float) -> tuple[Exact, Array]:
    """Return the angles about z, y and x, (K, 3), of a turn about one axis, and their rates at the start.

    From the identity about (0, cos d, sin d), less than half a turn: after a quarter of a turn the pitch is π/2 - d,
    and the other angles jump by nearly π within the time of a turn by some d.
    """
    sd, cd = math.sin(distance), math.cos(distance)

    def motion(t: Array) -> Array:
        s, c = np.sin(speed * t), np.cos(speed * t)
        yaw = np.arctan2(s * sd, c)
        # Not by an arcsine, which knows half of the digits near ±1.
        pitch = np.arctan2(s * cd, np.hypot(c, s * sd))
        roll = np.arctan2(sd * cd * (1 - c), cd * cd * c + sd * sd)
        return np.stack([yaw, pitch, roll], axis=-1)

    return motion, speed * np.array([sd, cd, 0.0])


# The exact motion of a mass on a spring, without gravity: Kepler's problem with another force.


def ringing_spring(square: float, radius: float, push: float, turn: float) -> tuple[Exact, float]:
    """Return (θ, r - 1), (K, 2), of a mass on a spring of length 1 at rest that turns and rings, and its period.

    Energy and angular momentum L give r² ṙ² = -ω² (r - r₁)(r - r₂)(r² + p r + s) with the turning points r₁, r₂ as
    roots. With r = a - b cos φ between them, dt = r dφ/(ω √(r² + p r + s)) and dθ = L dt/r² (Landau, Lifshitz 1976,
    §14), both even in φ and with the period 2 π. `square` is ω² = stiffness/mass, 1/s²; `radius`, `push` and `turn` are
    r, ṙ > 0 and θ̇ at the start, m, m/s and rad/s.
    """
    momentum = radius**2 * turn
    energy = (push**2 + momentum**2 / radius**2 + square * (radius - 1) ** 2) / 2
    r1 = _turning_point(momentum / math.sqrt(2 * energy), square, energy, momentum)
    r2 = _turning_point(1 + math.sqrt(2 * energy / square), square, energy, momentum)
    p, s = r1 + r2 - 2, momentum**2 / (square * r1 * r2)
    a, b = (r1 + r2) / 2, (r2 - r1) / 2

    def slope(phi: Array) -> Array:
        r = a - b * np.cos(phi)
        return np.asarray(r / np.sqrt(square * (r * (r + p) + s)))

    def turning(phi: Array) -> Array:
        return momentum * slope(phi) / (a - b * np.cos(phi)) ** 2

    half = _Phase(slope, math.pi)
    # sin φ from the push and cos φ from the place: either alone is blind somewhere.
    pace = push * radius / math.sqrt(square * (radius * (radius + p) + s))
    first = np.array([math.atan2(pace, a - radius)])
    (begun,), (before,) = half.integral(slope, first), half.integral(turning, first)
    (half_turn,) = half.integral(turning, np.array([math.pi]))

    def motion(t: Array) -> Array:
        # Folded onto half a period, in which φ runs from 0 to π.
        rounds = np.rint((t + begun) / (2 * half.whole))
        rest = t - 2 * rounds * half.whole + begun
        phi = half.at(np.abs(rest))
        theta = 2 * rounds * half_turn + np.sign(rest) * half.integral(turning, phi) - before
        return np.stack([theta, a - 1 - b * np.cos(phi)], axis=-1)

    return motion, 2 * half.whole


def _turning_point(bound: float, square: float, energy: float, momentum: float) -> float:
    """Return the root of r² ṙ² = (2 E - ω² (r - 1)²) r² - L² nearest to a bound of it, by Newton's method."""
    r, last = bound, math.inf
    while True:
        kinetic = 2 * energy - square * (r - 1) ** 2
        step = (kinetic * r * r - momentum**2) / (2 * r * kinetic - 2 * square * (r - 1) * r * r)
        if not abs(step) < last:
            return r
        r, last = r - step, abs(step)
