"""The exact motion of a mass on a spring, without gravity: Kepler's problem with another force."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from mbkit.studies.stress.cases._sweeps import Exact

__all__ = ["ringing_spring"]

_POINTS: Final = 256


def ringing_spring(square: float, radius: float, push: float, turn: float) -> tuple[Exact, float]:
    """Return (θ, r - 1), (K, 2), of a mass on a spring of length 1 at rest that turns and rings, and its period.

    Energy and angular momentum L give r² ṙ² = -ω² (r - r₁)(r - r₂)(r² + p r + s) with the turning points r₁, r₂ as
    roots. With r = a - b cos φ between them, dt = r dφ/(ω √(r² + p r + s)) and dθ = L dt/r² (Landau, Lifshitz 1976,
    §14), both even and periodic in φ: sums of a Fourier series' integrals.

    Parameters
    ----------
    square : float
        ω² = stiffness/mass, 1/s².
    radius, push, turn : float
        r, ṙ > 0 and θ̇ at the start, m, m/s and rad/s.
    """
    momentum = radius**2 * turn
    energy = (push**2 + momentum**2 / radius**2 + square * (radius - 1) ** 2) / 2
    r1, r2 = _turning_points(square, energy, momentum)
    p, s = r1 + r2 - 2, momentum**2 / (square * r1 * r2)
    a, b = (r1 + r2) / 2, (r2 - r1) / 2
    grid = a - b * np.cos(2 * math.pi * np.arange(_POINTS) / _POINTS)
    rate = grid / np.sqrt(square * (grid * (grid + p) + s))
    order = np.arange(1, _POINTS // 2)

    def integral(values: np.ndarray) -> tuple[float, np.ndarray]:
        terms = np.fft.rfft(values).real / _POINTS
        return float(terms[0]), 2 * terms[1:-1] / order

    (mean, waves), (mean_turn, waves_turn) = integral(rate), integral(momentum * rate / grid**2)
    # sin φ from the push and cos φ from the place: either alone is blind somewhere.
    pace = push * radius / math.sqrt(square * (radius * (radius + p) + s))
    first = math.atan2(pace, a - radius)

    def spent(phi: np.ndarray, line: float, terms: np.ndarray) -> np.ndarray:
        told: np.ndarray = line * phi + np.sin(np.multiply.outer(phi, order)) @ terms
        return told

    def motion(t: np.ndarray) -> np.ndarray:
        start = spent(np.array([first]), mean, waves)[0]
        phi = first + t / mean
        for _ in range(20):
            r = a - b * np.cos(phi)
            slope = r / np.sqrt(square * (r * (r + p) + s))
            phi = phi - (spent(phi, mean, waves) - start - t) / slope
        theta = spent(phi, mean_turn, waves_turn) - spent(np.array([first]), mean_turn, waves_turn)[0]
        return np.stack([theta, a - 1 - b * np.cos(phi)], axis=-1)

    return motion, 2 * math.pi * mean


def _turning_points(square: float, energy: float, momentum: float) -> tuple[float, float]:
    """Return the two roots of r² ṙ² = (2 E - ω² (r - 1)²) r² - L² between which it moves.

    By Newton's method from outside: neither the spring nor the turning alone has energy for more.
    """
    ends = []
    for bound in (momentum / math.sqrt(2 * energy), 1 + math.sqrt(2 * energy / square)):
        r, last = bound, math.inf
        while abs(step := _step(r, square, energy, momentum)) < last:
            r, last = r - step, abs(step)
        ends.append(r)
    return ends[0], ends[1]


def _step(r: float, square: float, energy: float, momentum: float) -> float:
    kinetic = 2 * energy - square * (r - 1) ** 2
    return (kinetic * r * r - momentum**2) / (2 * r * kinetic - 2 * square * (r - 1) * r * r)
