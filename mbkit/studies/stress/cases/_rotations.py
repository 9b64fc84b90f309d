"""Exact rotations: a free body, a top in steady precession, a turn about one axis past gimbal lock."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ellipj, ellipkinc, ellipkm1, elliprf, elliprj

from mbkit._check import Array
from mbkit.studies.stress.cases._sweeps import Exact

__all__ = ["free_rotor", "past_gimbal_lock", "precession", "turning"]


def turning(axis: Array, speed: float) -> Exact:
    """Return quaternions (K, 4) of a steady turn about an axis, from the identity."""
    unit = axis / np.linalg.norm(axis)

    def motion(t: Array) -> Array:
        half = speed * t / 2
        return np.concatenate([np.multiply.outer(np.sin(half), unit), np.cos(half)[:, None]], axis=1)

    return motion


def free_rotor(inertia: Array, spin: Array) -> tuple[Exact, float]:
    """Return quaternions (K, 4) of a torque-free body from the identity, and the period of its angular velocity.

    Landau, Lifshitz 1976, §37: with A < B < C, or A > B > C where L² < 2 E B, ω = (a cn, b sn, c dn); the third axis
    goes round L at φ̇ = (L/C)(1 + (C - A)/A / (1 - n sn²)), an integral of the third kind (Carlson 1979 for it).

    Parameters
    ----------
    inertia : (3,) array
        Three different principal moments, kg m².
    spin : (3,) array
        At the start, in body axes, rad/s; about none of the axes alone.
    """
    order = np.argsort(inertia)
    (A, B, C), (x, y, z) = inertia[order], spin[order]
    # L² - 2 E B, like all that follows of terms that do not cancel.
    if C * (C - B) * z * z < A * (B - A) * x * x:
        order = order[::-1]
        (A, B, C), (x, y, z) = inertia[order], spin[order]
    upper = A * (C - A) * x * x + B * (C - B) * y * y  # 2 E C - L²
    lower = B * (B - A) * y * y + C * (C - A) * z * z  # L² - 2 E A
    a, b, c = math.sqrt(upper / (A * (C - A))), math.sqrt(upper / (B * (C - B))), math.sqrt(lower / (C * (C - A)))
    m = (B - A) * upper / ((C - B) * lower)
    rest = (C - A) * (C * (C - B) * z * z - A * (B - A) * x * x) / ((C - B) * lower)  # 1 - m
    # Euler's equations run backwards in a mirrored frame (an odd order of the axes), and again where the
    # moments fall instead of rise.
    even = (order[1] - order[0]) % 3 == 1
    rate = math.copysign(math.sqrt((C - B) * lower / (A * B * C)), (C - A) * (1 if even else -1))
    side = math.copysign(1.0, z)
    momentum = float(np.linalg.norm(inertia * spin))
    n = -((C * c) ** 2) * m * (C - A) / (A * upper)
    quarter = float(ellipkm1(rest))
    whole = 2 * float(_third_kind(n, rest, np.array([1.0]), np.array([0.0]))[0])
    start = float(ellipkinc(math.atan2(y / b, side * x / a), m))

    def jacobi(t: Array) -> tuple[Array, Array]:
        """Return the angular velocity and ∫ dt/(1 - n sn²)."""
        u = rate * t + start
        turns = np.rint(u / (2 * quarter))
        sn, cn, dn, _ = ellipj(u - 2 * turns * quarter, m)
        sign = (-1.0) ** turns
        spins = np.empty((len(t), 3))
        spins[:, order] = np.stack([side * a * sign * cn, b * sign * sn, side * c * dn], axis=-1)
        return spins, (turns * whole + _third_kind(n, rest, sn, cn)) / rate

    (_, before), first = jacobi(np.zeros(1)), _momentum_axes(inertia, spin[None], order[2])[0]

    def motion(t: Array) -> Array:
        spins, poles = jacobi(t)
        turned = momentum / C * (t + (C - A) / A * (poles - before))
        about = Rotation.from_rotvec(np.multiply.outer(turned, [0.0, 0.0, 1.0])).as_matrix()
        told = first @ about @ np.swapaxes(_momentum_axes(inertia, spins, order[2]), 1, 2)
        return np.asarray(Rotation.from_matrix(told).as_quat())

    return motion, 4 * quarter / abs(rate)


def _third_kind(n: float, rest: float, sn: Array, cn: Array) -> Array:
    """Return Π(n; φ | m) for |φ| ≤ π/2 and 1 - m, in Carlson's forms."""
    c2, d2 = cn * cn, cn * cn + rest * sn * sn
    return np.asarray(sn * elliprf(c2, d2, 1.0) + n / 3 * sn**3 * elliprj(c2, d2, 1.0, 1 - n * sn * sn))


def _momentum_axes(inertia: Array, spins: Array, axis: int) -> Array:
    """Return, in body axes, the columns: the third axis' part normal to L, their product, L's direction."""
    L = inertia * spins
    third = L / np.linalg.norm(L, axis=1, keepdims=True)
    first = np.eye(3)[axis] - third * third[:, axis : axis + 1]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(third, first), third], axis=-1)


def precession(
    spin: float, tilt: float, moment: float, across: float, along: float
) -> tuple[Exact, Array, Array, float]:
    """Return quaternions (K, 4) of a symmetric top in steady precession, its start (4,) and (3,), and its rate.

    The axis is the body's y. A Ω² cos θ - C ω₃ Ω + m g r = 0 (Landau, Lifshitz 1976, §35 problem 2), of which the
    slow root is taken; below the horizontal (θ > π/2) there is one at any spin.

    Parameters
    ----------
    spin : float
        ω₃, the angular velocity's part along the axis, rad/s.
    tilt : float
        θ of the axis from the upward vertical, rad.
    moment : float
        m g r, N m.
    across, along : float
        A, about the fixed point, and C, kg m².
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

    From the identity about (0, cos d, sin d): after a quarter of a turn the pitch is π/2 - d, and the other two angles
    jump by nearly π within the time that it takes to turn by some d. For less than half a turn.

    Parameters
    ----------
    distance : float
        d, rad.
    speed : float
        rad/s.
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
