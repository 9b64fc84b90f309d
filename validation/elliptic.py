"""Exact motions by elliptic functions and quadrature, to 30 digits, written apart from mbkit.

Nothing here imports mbkit. Each function returns positions and velocities at given
times as float64 arrays of exact numbers rounded once; mpmath works with 40 digits in
between, so that a thousand periods lose none that count. Conventions are those of
``closed_forms``: angles from the downward vertical, quaternions x, y, z, w with no
sign preferred, angular velocities in body axes, SI units.

Sources: Landau, Lifshitz 1976, Mechanics, §11 (pendulum), §14 (spherical pendulum), §35
(symmetric top), §37 (free body); Whittaker 1937, Analytical Dynamics, ch. 6;
Abramowitz, Stegun 1964, ch. 16 and 17. Π(n; φ | m) is ∫ dθ / ((1 - n sin² θ) √(1 - m sin² θ)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import mpmath as mp
import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
DIGITS = 40
NODES = 48


# --------------------------------------------------------------------------------------
# Jacobi's functions along a motion


@dataclass(frozen=True)
class _Clock:
    """Jacobi's argument u = rate t + start, whose amplitude started at `phase`."""

    rate: Any
    m: Any
    phase: Any

    @property
    def start(self) -> Any:
        return mp.ellipf(self.phase, self.m)

    def at(self, t: Any) -> tuple[Any, Any, Any, Any]:
        """Return sn, cn, dn and the amplitude, which counts its turns."""
        u = self.rate * t + self.start
        sn, cn, dn = (mp.ellipfun(f, u, m=self.m) for f in ("sn", "cn", "dn"))
        if self.m == 1:  # the separatrix never turns round
            return sn, cn, dn, mp.asin(sn)
        turns = mp.nint(u / (2 * mp.ellipk(self.m)))
        return sn, cn, dn, turns * mp.pi + mp.atan2(sn * (-1) ** int(turns), cn * (-1) ** int(turns))

    def third_kind(self, n: Any, amplitude: Any) -> Any:
        """Return ∫ dt / (1 - n sn²) since the start."""
        return (mp.ellippi(n, amplitude, self.m) - mp.ellippi(n, self.phase, self.m)) / self.rate


def _times(t: ArrayLike) -> list[Any]:
    return [mp.mpf(float(x)) for x in np.atleast_1d(np.asarray(t, dtype=float))]


def _array(rows: Sequence[Any], t: ArrayLike) -> Array:
    out = np.array([[float(x) for x in row] for row in rows])
    return out if np.ndim(t) else out[0]


# --------------------------------------------------------------------------------------
# Pendulum


def pendulum(t: ArrayLike, theta0: Any, speed0: Any = 0, length: Any = 1, g: Any = 9.81) -> tuple[Array, Array]:
    """Return θ and θ̇, (K, 1) each, of a pendulum from any start; θ counts its turns.

    sin(θ/2) = k sn(ω₀ t + u₀ | k²) where it swings, θ/2 = am(k ω₀ t + u₀ | 1/k²) where it goes
    round, with k² = sin²(θ₀/2) + θ̇₀²/(4 ω₀²) (Landau, Lifshitz, §11; Whittaker, §44).
    """
    with mp.workdps(DIGITS):
        theta0, speed0 = mp.mpf(theta0), mp.mpf(speed0)
        w = mp.sqrt(mp.mpf(g) / mp.mpf(length))
        turns = 2 * mp.pi * mp.nint(theta0 / (2 * mp.pi))
        half = (theta0 - turns) / 2
        m = mp.sin(half) ** 2 + (speed0 / (2 * w)) ** 2
        k = mp.sqrt(m)
        angles, speeds = [], []
        if m == 0:
            angles, speeds = [[turns]] * len(_times(t)), [[0]] * len(_times(t))
        elif m <= 1:
            clock = _Clock(w, m, mp.atan2(mp.sin(half), speed0 / (2 * w)))
            for x in _times(t):
                sn, cn, _, _ = clock.at(x)
                angles.append([turns + 2 * mp.asin(k * sn)])
                speeds.append([2 * w * k * cn])
        else:
            sense = mp.sign(speed0)
            clock = _Clock(sense * k * w, 1 / m, half)
            for x in _times(t):
                _, _, dn, amplitude = clock.at(x)
                angles.append([turns + 2 * amplitude])
                speeds.append([2 * sense * k * w * dn])
        return _array(angles, t), _array(speeds, t)


# --------------------------------------------------------------------------------------
# Cart-pole let go at rest


@dataclass(frozen=True)
class CartPole:
    """The cart-pole let go at rest at x = 0, θ = `theta0`.

    No force acts along x, so x = m l (sin θ₀ - sin θ)/(M + m), and energy gives
    θ̇² = 2 g (M + m)(cos θ - cos θ₀)/(l (M + m sin² θ)). With sin(θ/2) = k sin φ,
    k = sin(θ₀/2), φ grows for ever and
    dt = √(l/(g (M + m))) √(M/(1 - k² sin² φ) + 4 m k² sin² φ) dφ, a quadrature of genus 2, hence by
    Gauss-Legendre in y, φ = ε sinh y: for a light cart the root bends within ε = √(M/m)/(2 k) of φ = 0.
    """

    theta0: float
    cart_mass: float = 1.0
    pole_mass: float = 1.0
    length: float = 1.0
    g: float = 9.81

    @property
    def period(self) -> float:
        with mp.workdps(DIGITS):
            return float(4 * self._quarter)

    @property
    def peak_speed(self) -> float:
        """θ̇ where the pole hangs down, rad/s."""
        with mp.workdps(DIGITS):
            M, m, ell, g = self._numbers()
            return float(mp.sqrt(2 * g * (M + m) * (1 - mp.cos(mp.mpf(self.theta0))) / (ell * M)))

    def crossings(self, duration: float) -> int:
        """Return how often θ = 0 is passed up to this time."""
        quarter = self.period / 4
        return int((duration / quarter + 1) // 2)

    def states(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return (x, θ) and (ẋ, θ̇), (K, 2) each."""
        with mp.workdps(DIGITS):
            M, m, ell, g = self._numbers()
            theta0 = mp.mpf(self.theta0)
            k, quarter = mp.sin(theta0 / 2), self._quarter
            # φ = π/2 at the start; fold the time onto the quarter period where φ runs from 0 to π/2.
            quarters = [x / quarter + 1 for x in _times(t)]
            turns = [mp.nint(x / 2) for x in quarters]
            rests = [(x - 2 * n) * quarter for x, n in zip(quarters, turns, strict=True)]
            q, v = [], []
            for n, rest, angle in zip(turns, rests, self._angles([abs(x) for x in rests]), strict=True):
                phi = mp.pi * n + mp.sign(rest) * angle
                theta = 2 * mp.asin(k * mp.sin(phi))
                # cos θ - cos θ₀ = 2 k² cos² φ, which cancels nothing.
                speed = 2 * k * mp.cos(phi) * mp.sqrt(g * (M + m) / (ell * (M + m * mp.sin(theta) ** 2)))
                q.append([m * ell * (mp.sin(theta0) - mp.sin(theta)) / (M + m), theta])
                v.append([-m * ell * mp.cos(theta) * speed / (M + m), speed])
            return _array(q, t), _array(v, t)

    def _numbers(self) -> tuple[Any, Any, Any, Any]:
        return mp.mpf(self.cart_mass), mp.mpf(self.pole_mass), mp.mpf(self.length), mp.mpf(self.g)

    def _bend(self) -> Any:
        return mp.sqrt(mp.mpf(self.cart_mass) / mp.mpf(self.pole_mass)) / (2 * mp.sin(mp.mpf(self.theta0) / 2))

    def _rate(self, phi: Any, maths: Any = mp) -> Any:
        """Return dt/dφ, with mpmath or on arrays."""
        M, m, ell, g = self._numbers()
        k2 = mp.sin(mp.mpf(self.theta0) / 2) ** 2
        factor, slope = mp.sqrt(ell / (g * (M + m))), 4 * m * k2
        if maths is np:
            factor, slope, k2, M = float(factor), float(slope), float(k2), float(M)
        s2 = maths.sin(phi) ** 2
        return factor * maths.sqrt(M / (1 - k2 * s2) + slope * s2)

    @cached_property
    def _quarter(self) -> Any:
        return self._time(mp.pi / 2)

    def _time(self, phi: Any) -> Any:
        """Return the time from the bottom to φ."""
        bend = self._bend()
        half = mp.asinh(phi / bend) / 2
        ys = [(half * (1 + x), w) for x, w in _nodes()]
        return half * sum(w * self._rate(bend * mp.sinh(y)) * bend * mp.cosh(y) for y, w in ys)

    def _angles(self, times: Sequence[Any]) -> list[Any]:
        """Return φ in [0, π/2] at times since the bottom: by a table and Newton in double, then one step in full.

        What double leaves, 1e-15, becomes 1e-30.
        """
        bend = float(self._bend())
        nodes, weights = leggauss(2 * NODES)

        def slope(y: Array) -> Array:
            return np.asarray(self._rate(bend * np.sinh(y), np) * bend * np.cosh(y))

        def spent(y: Array) -> Array:
            return y / 2 * (slope(y[:, None] / 2 * (1 + nodes)) @ weights)

        target, table = np.array(times, dtype=float), np.linspace(0, np.arcsinh(np.pi / 2 / bend), 2000)
        y = np.interp(target, spent(table), table)
        for _ in range(4):
            y += (target - spent(y)) / slope(y)
        angles = [mp.mpf(x) for x in bend * np.sinh(y)]
        return [phi - (self._time(phi) - t) / self._rate(phi) for phi, t in zip(angles, times, strict=True)]


@cache
def _nodes() -> list[tuple[Any, Any]]:
    # The integrand is analytic within a Bernstein ellipse of 1.87 even for M/m = 1e-6: 1.87^-96 = 1e-26.
    with mp.workdps(DIGITS):
        edges = [mp.findroot(lambda x: mp.legendre(NODES, x), x) for x in leggauss(NODES)[0]]
        return [(x, 2 * (1 - x * x) / (NODES * mp.legendre(NODES - 1, x)) ** 2) for x in edges]


# --------------------------------------------------------------------------------------
# Free body


def free_body(t: ArrayLike, inertia: Sequence[Any], w0: Sequence[Any], q0: Sequence[Any] = (0, 0, 0, 1)) -> Spin:
    """Return the torque-free rotation of a body with three different moments.

    Landau, Lifshitz, §37: with A < B < C, or A > B > C where L² < 2 E B, the third axis never
    crosses the plane normal to L, ω = (a cn, b sn, c dn), and it goes round L at
    φ̇ = L (A ω₁² + B ω₂²)/(A² ω₁² + B² ω₂²), which is (L/C)(1 + (C - A)/A / (1 - n sn²)).
    """
    with mp.workdps(DIGITS):
        J, w = [mp.mpf(x) for x in inertia], [mp.mpf(x) for x in w0]
        order = sorted(range(3), key=lambda i: J[i])
        twice_energy = sum(j * x * x for j, x in zip(J, w, strict=True))
        square = sum((j * x) ** 2 for j, x in zip(J, w, strict=True))
        if square < twice_energy * J[order[1]]:
            order = order[::-1]
        (A, B, C), (x, y, z) = [J[i] for i in order], [w[i] for i in order]
        a = mp.sqrt((twice_energy * C - square) / (A * (C - A)))
        b = mp.sqrt((twice_energy * C - square) / (B * (C - B)))
        c = mp.sqrt((square - twice_energy * A) / (C * (C - A)))
        side = mp.sign(z)
        # Euler's equations run backwards in a mirrored frame (an odd order of the axes), and again where
        # the moments fall instead of rise.
        even = (order[1] - order[0]) % 3 == 1
        sense = (1 if even else -1) * mp.sign(C - A)
        rate = sense * mp.sqrt((C - B) * (square - twice_energy * A) / (A * B * C))
        m = (B - A) * (twice_energy * C - square) / ((C - B) * (square - twice_energy * A))
        clock = _Clock(rate, m, mp.atan2(y / b, side * x / a))
        momentum = mp.sqrt(square)
        n = -((C * c) ** 2) * m * (C - A) / (A * (twice_energy * C - square))
        R0 = _matrix([mp.mpf(x) for x in q0])
        first = _momentum_axes(J, w, order[2])
        q, spin = [], []
        for now in _times(t):
            sn, cn, dn, amplitude = clock.at(now)
            rates = [mp.mpf(0)] * 3
            for axis, value in zip(order, (side * a * cn, b * sn, side * c * dn), strict=True):
                rates[axis] = value
            turned = momentum / C * (now + (C - A) / A * clock.third_kind(n, amplitude))
            R = R0 * first * _about_z(turned) * _momentum_axes(J, rates, order[2]).T
            q.append(_quaternion(R))
            spin.append(rates)
        return Spin(_array(q, t), _array(spin, t), float(4 * mp.ellipk(m) / abs(rate)))


@dataclass(frozen=True)
class Spin:
    """Attitudes (K, 4), angular velocities (K, 3) and the period of ω, s."""

    q: Array
    w: Array
    period: float


def _momentum_axes(J: Sequence[Any], w: Sequence[Any], axis: int) -> Any:
    """Return, in body axes, the columns: the third axis' part normal to L, their product, L's direction."""
    L = mp.matrix([j * x for j, x in zip(J, w, strict=True)])
    third = L / mp.norm(L)
    e = mp.matrix([int(i == axis) for i in range(3)])
    first = e - third * third[axis]
    first /= mp.norm(first)
    second = _cross(third, first)
    return mp.matrix([[first[i], second[i], third[i]] for i in range(3)])


# --------------------------------------------------------------------------------------
# Symmetric top, of which the spherical pendulum is the one without spin


@dataclass(frozen=True)
class Nutation:
    """How a symmetric top's axis moves: u = cos θ from the *upward* vertical.

    u̇² = (1 - u²)(α - β u) - (b - a u)² with a = C ω₃/A, b = L_z/A, β = 2 m g r/A (Landau, Lifshitz, §35 problem
    1; Whittaker, §72), a cubic with roots u₁ ≤ u ≤ u₂ < u₃: u = u₁ + (u₂ - u₁) sn². The azimuth
    goes at φ̇ = (b - a u)/(1 - u²), the spin at ψ̇ = ω₃ - u φ̇: integrals of the third kind.
    """

    u1: Any
    u2: Any
    a: Any
    b: Any
    spin: Any
    clock: _Clock

    @classmethod
    def of(cls, u0: Any, rate0: Any, a: Any, b: Any, beta: Any, spin: Any) -> Nutation:
        """Take cos θ, its rate, a, b, β and ω₃ at the start."""
        alpha = beta * u0 + (rate0**2 + (b - a * u0) ** 2) / (1 - u0**2)
        u1, u2, u3 = _cubic_roots(beta, -(alpha + a * a), 2 * a * b - beta, alpha - b * b)
        width = u2 - u1
        phase = mp.mpf(0)
        if width > mp.mpf(10) ** (-DIGITS // 2):
            phase = mp.asin(mp.sqrt(min(max((u0 - u1) / width, 0), 1)))
            phase = -phase if rate0 < 0 else phase
        return cls(u1, u2, a, b, spin, _Clock(mp.sqrt(beta * (u3 - u1)) / 2, width / (u3 - u1), phase))

    @property
    def period(self) -> Any:
        """Time from one highest point to the next."""
        return 2 * mp.ellipk(self.clock.m) / self.clock.rate

    def azimuth(self, amplitude: Any) -> Any:
        """Return φ - φ₀ at an amplitude of Jacobi's functions."""
        above, below = self._poles(amplitude)
        return ((self.b - self.a) * above + (self.b + self.a) * below) / 2

    def at(self, t: Any) -> tuple[Any, Any, Any, Any]:
        """Return u, u̇, φ - φ₀ and ψ - ψ₀."""
        sn, cn, dn, amplitude = self.clock.at(t)
        width = self.u2 - self.u1
        u = self.u1 + width * sn**2
        above, below = self._poles(amplitude)
        turned = (self.spin - self.a) * t - ((self.b - self.a) * above - (self.b + self.a) * below) / 2
        return u, 2 * width * self.clock.rate * sn * cn * dn, self.azimuth(amplitude), turned

    def _poles(self, amplitude: Any) -> tuple[Any, Any]:
        """Return ∫ dt/(1 - u) and ∫ dt/(1 + u)."""
        width = self.u2 - self.u1
        above = self.clock.third_kind(width / (1 - self.u1), amplitude) / (1 - self.u1)
        below = self.clock.third_kind(-width / (1 + self.u1), amplitude) / (1 + self.u1)
        return above, below


def _cubic_roots(a: Any, b: Any, c: Any, d: Any) -> list[Any]:
    """Return the three real roots of a x³ + b x² + c x + d, ascending, by Viète's cosines.

    The phase of a motion that starts at a turning point is the root of a difference of two
    of these numbers, and roots close together hold half the digits: hence three times as many.
    """
    with mp.workdps(3 * DIGITS):
        p = (b / a) ** 2 / 9 - c / (3 * a)
        q = (b / a) ** 3 / 27 - b * c / (6 * a * a) + d / (2 * a)
        third = mp.acos(max(min(-q / mp.sqrt(p) ** 3, 1), -1)) / 3
        return sorted(2 * mp.sqrt(p) * mp.cos(third + 2 * mp.pi * k / 3) - b / (3 * a) for k in range(3))


@dataclass(frozen=True)
class SphericalPendulum:
    """A point mass on a rod from the angle `theta0` from down and azimuth 0, with θ̇₀ and φ̇₀ ≠ 0.

    Neither it nor `heavy_top` passes through the vertical, where an azimuth is none.
    """

    theta0: float
    thetadot0: float
    phidot0: float
    length: float = 1.0
    g: float = 9.81

    @property
    def period(self) -> float:
        """Time from one greatest θ to the next, s."""
        with mp.workdps(DIGITS):
            return float(self._nutation().period)

    @property
    def apsidal_angle(self) -> float:
        """Azimuth from one greatest θ to the next, rad."""
        with mp.workdps(DIGITS):
            motion = self._nutation()
            phase = motion.clock.phase
            return float(motion.azimuth(phase + mp.pi) - motion.azimuth(phase))

    def angles(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return (φ, θ) and (φ̇, θ̇), (K, 2) each; φ counts its turns."""
        with mp.workdps(DIGITS):
            motion = self._nutation()
            q, v = [], []
            for now in _times(t):
                u, rate, azimuth, _ = motion.at(now)
                q.append([azimuth, mp.acos(-u)])
                v.append([motion.b / (1 - u * u), rate / mp.sqrt(1 - u * u)])
            return _array(q, t), _array(v, t)

    def positions(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return the mass's place and velocity, (K, 3) each."""
        (phi, theta), (turning, swinging) = (np.moveaxis(x, -1, 0) for x in self.angles(t))
        out, round_ = np.sin(theta), np.cos(theta)
        c, s = np.cos(phi), np.sin(phi)
        place = self.length * np.stack([out * c, out * s, -round_], axis=-1)
        along = swinging * np.stack([round_ * c, round_ * s, out])
        across = turning * np.stack([-out * s, out * c, 0 * out])
        return place, self.length * np.moveaxis(along + across, 0, -1)

    def _nutation(self) -> Nutation:
        theta, thetadot, phidot = mp.mpf(self.theta0), mp.mpf(self.thetadot0), mp.mpf(self.phidot0)
        beta = 2 * mp.mpf(self.g) / mp.mpf(self.length)
        zero = mp.mpf(0)
        return Nutation.of(-mp.cos(theta), mp.sin(theta) * thetadot, zero, mp.sin(theta) ** 2 * phidot, beta, zero)


def heavy_top(
    t: ArrayLike,
    mass: Any,
    across: Any,
    along: Any,
    com: Sequence[Any],
    w0: Sequence[Any],
    q0: Sequence[Any] = (0, 0, 0, 1),
    g: Any = 9.81,
) -> Spin:
    """Return the motion of Lagrange's top, symmetric about the line from the fixed point to its centre of mass.

    `across` and `along` are the moments about the centre of mass across and along that
    line. The `period` is that of the nutation.
    """
    with mp.workdps(DIGITS):
        r = mp.matrix([mp.mpf(x) for x in com])
        reach = mp.norm(r)
        e, w, R0 = r / reach, mp.matrix([mp.mpf(x) for x in w0]), _matrix([mp.mpf(x) for x in q0])
        A, C = mp.mpf(across) + mp.mpf(mass) * reach**2, mp.mpf(along)  # Steiner
        spin = _dot(w, e)
        axis, w_space = R0 * e, R0 * w
        a = C * spin / A
        momentum = (A * (w_space[2] - spin * axis[2]) + C * spin * axis[2]) / A
        motion = Nutation.of(
            axis[2], _cross(w_space, axis)[2], a, momentum, 2 * mp.mpf(mass) * mp.mpf(g) * reach / A, spin
        )
        # R = Rz(φ) Ry(θ) Rz(ψ) Q, where Q takes the body's axis to z.
        Q = _onto_z(e)
        phi0 = mp.atan2(axis[1], axis[0])
        start = (_about_z(phi0) * _about_y(mp.acos(axis[2]))).T * R0 * Q.T
        psi0 = mp.atan2(start[1, 0], start[0, 0])
        q, rates = [], []
        for now in _times(t):
            u, rate, azimuth, turned = motion.at(now)
            theta, phi = mp.acos(u), phi0 + azimuth
            out = mp.sqrt(1 - u * u)
            phidot = (motion.b - motion.a * u) / (1 - u * u)
            R = _about_z(phi) * _about_y(theta) * _about_z(psi0 + turned) * Q
            swing = mp.matrix([-mp.sin(phi), mp.cos(phi), 0]) * (-rate / out)
            whole = swing + mp.matrix([0, 0, phidot]) + (R * e) * (spin - phidot * u)
            q.append(_quaternion(R))
            rates.append(R.T * whole)
        return Spin(_array(q, t), _array(rates, t), float(motion.period))


# --------------------------------------------------------------------------------------
# Rotations


def _dot(a: Any, b: Any) -> Any:
    return sum(a[i] * b[i] for i in range(3))


def _cross(a: Any, b: Any) -> Any:
    return mp.matrix([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _about_z(angle: Any) -> Any:
    c, s = mp.cos(angle), mp.sin(angle)
    return mp.matrix([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _about_y(angle: Any) -> Any:
    c, s = mp.cos(angle), mp.sin(angle)
    return mp.matrix([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _onto_z(e: Any) -> Any:
    """Return a rotation that takes the unit vector e to z."""
    return (_about_z(mp.atan2(e[1], e[0])) * _about_y(mp.acos(e[2]))).T


def _matrix(q: Sequence[Any]) -> Any:
    x, y, z, w = q
    return mp.matrix(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion(R: Any) -> list[Any]:
    """Return x, y, z, w, dividing by the largest of the four (Shepperd 1978)."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    squares = [1 + 2 * R[i, i] - trace for i in range(3)] + [1 + trace]
    k = max(range(4), key=lambda i: squares[i])
    big = 2 * mp.sqrt(squares[k])
    if k == 3:
        return [(R[2, 1] - R[1, 2]) / big, (R[0, 2] - R[2, 0]) / big, (R[1, 0] - R[0, 1]) / big, big / 4]
    i, j = (k + 1) % 3, (k + 2) % 3
    out = [mp.mpf(0)] * 4
    out[k], out[i], out[j] = big / 4, (R[i, k] + R[k, i]) / big, (R[j, k] + R[k, j]) / big
    out[3] = (R[j, i] - R[i, j]) / big
    return out
