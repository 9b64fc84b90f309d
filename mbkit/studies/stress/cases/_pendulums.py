"""Exact motions of the pendulum and the cart-pole, in double."""

from __future__ import annotations

import math
from functools import cache
from typing import Final

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.special import ellipj, ellipkinc

from mbkit._check import Array
from mbkit.studies.stress.cases._sweeps import Exact

__all__ = ["cart_pole", "pendulum"]

_NODES: Final = 128
_TABLE: Final = 4000


@cache
def _nodes() -> tuple[Array, Array]:
    return leggauss(_NODES)


def pendulum(theta: float, speed: float, square: float) -> Exact:
    """Return θ, (K, 1), of θ̈ + ω² sin θ = 0.

    sin(θ/2) = k sn(ω t + u₀ | k²) where it swings, θ/2 = am(k ω t + u₀ | 1/k²) where it goes round, with
    k² = sin²(θ₀/2) + θ̇₀²/(4 ω²) (Landau, Lifshitz 1976, §11; Whittaker 1937, §44).

    Parameters
    ----------
    theta, speed : float
        At the start, |θ| below π, rad and rad/s.
    square : float
        ω² = g/l, 1/s².
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


def cart_pole(theta: float, cart: float, square: float = 9.81) -> Exact:
    """Return (x, θ), (K, 2), of a cart-pole let go at rest at x = 0; pole of 1 kg and 1 m.

    No force acts along x, so x = (sin θ₀ - sin θ)/(M + 1), and energy gives
    θ̇² = 2 g (M + 1)(cos θ - cos θ₀)/(M + sin² θ). With sin(θ/2) = k sin φ, k = sin(θ₀/2), φ grows for ever, and
    dt = √(M/(1 - k² sin² φ) + 4 k² sin² φ) dφ/√(g (M + 1)): a quadrature, by Gauss-Legendre in y, φ = ε sinh y, for
    the root bends within ε = √M/(2 k) of φ = 0. Inverted by a table and Newton's method.

    Parameters
    ----------
    theta : float
        At the start, between 0 and π, rad.
    cart : float
        M, kg.
    square : float
        g/l, 1/s².
    """
    k = math.sin(theta / 2)
    bend = math.sqrt(cart) / (2 * k)
    nodes, weights = _nodes()
    last = math.asinh(math.pi / 2 / bend)

    def slope(y: Array) -> Array:
        s2 = np.sin(bend * np.sinh(y)) ** 2
        root = np.sqrt(cart / (1 - k * k * s2) + 4 * k * k * s2)
        return np.asarray(root * bend * np.cosh(y) / math.sqrt(square * (cart + 1)))

    def spent(y: Array) -> Array:
        return y / 2 * (slope(y[:, None] / 2 * (1 + nodes)) @ weights)

    quarter = float(spent(np.array([last]))[0])

    def motion(t: Array) -> Array:
        # φ = π/2 at the start; the time is folded onto the quarter period in which φ runs from 0 to π/2.
        quarters = t / quarter + 1
        turns = np.rint(quarters / 2)
        rest = t - (2 * turns - 1) * quarter
        table = np.linspace(0, last, _TABLE)
        y = np.interp(np.abs(rest), spent(table), table)
        for _ in range(4):
            y = np.clip(y + (np.abs(rest) - spent(y)) / slope(y), 0, last)
        phi = np.sign(rest) * bend * np.sinh(y) + math.pi * turns
        angle = 2 * np.arcsin(k * np.sin(phi))
        return np.stack([(math.sin(theta) - np.sin(angle)) / (cart + 1), angle], axis=-1)

    return motion
