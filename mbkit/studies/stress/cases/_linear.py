"""Exact motions of linear systems."""

from __future__ import annotations

from typing import Any, Final

import mpmath as mp
import numpy as np

from mbkit._check import Array
from mbkit.studies.stress.cases._sweeps import Exact

__all__ = ["modal", "released", "slowest_mode"]

#: Rates of 1 and of 1e12 per second stand side by side.
_DIGITS: Final = 50


def released(start: float, square: float, rate: float) -> Exact:
    """Return q of q̈ + 2 a q̇ + ω² q = 0, let go at rest (Landau, Lifshitz 1976, §25).

    Parameters
    ----------
    start : float
    square : float
        ω², 1/s².
    rate : float
        a, 1/s.
    """
    discriminant = square - rate * rate
    if discriminant > 0:
        w = np.sqrt(discriminant)
        return lambda t: (start * np.exp(-rate * t) * (np.cos(w * t) + rate / w * np.sin(w * t)))[:, None]
    if discriminant == 0:
        return lambda t: (start * (1 + rate * t) * np.exp(-rate * t))[:, None]
    fast = -(rate + np.sqrt(-discriminant))
    # The other root by the product of the two: a difference would cancel.
    slow = square / fast
    return lambda t: (start * (fast * np.exp(slow * t) - slow * np.exp(fast * t)) / (fast - slow))[:, None]


def modal(M: Array, C: Array, K: Array, q0: Array, v0: Array) -> Exact:
    """Return q of M q̈ + C q̇ + K q = 0, by the eigenvalues of the companion matrix with 50 digits.

    No two of them may be the same (critical damping).
    """
    n = len(M)
    with mp.workdps(_DIGITS):
        inverse = mp.matrix(M.tolist()) ** -1
        companion = mp.zeros(2 * n)
        stiff, damped = inverse * mp.matrix(K.tolist()), inverse * mp.matrix(C.tolist())
        for i in range(n):
            companion[i, n + i] = mp.mpf(1)
            for j in range(n):
                companion[n + i, j], companion[n + i, n + j] = -stiff[i, j], -damped[i, j]
        values, vectors = mp.eig(companion)
        weights = mp.lu_solve(vectors, mp.matrix([*q0.tolist(), *v0.tolist()]))
        rates = np.array([complex(x) for x in values])
        shapes = np.array([[complex(vectors[i, k] * weights[k]) for k in range(2 * n)] for i in range(n)])
    return lambda t: np.real(np.exp(np.multiply.outer(t, rates)) @ shapes.T)


def slowest_mode(M: Array, stiffness: Array) -> tuple[float, Array, float]:
    """Return the slowest frequency of M q̈ + diag(k) q = 0, its shape, and the fastest frequency.

    1/ω² are the eigenvalues of k^-½ M k^-½. Of those, the largest one and its shape are known to rounding,
    however stiff the other springs are.
    """
    root = np.sqrt(stiffness)
    found: tuple[Any, Any] = np.linalg.eigh(M / root[:, None] / root)
    shape = found[1][:, -1] / root
    inverse = np.linalg.inv(M)
    fastest = float(np.sqrt(np.abs(np.linalg.eigvals(inverse * stiffness)).max()))
    return float(found[0][-1] ** -0.5), shape / shape[0], fastest
