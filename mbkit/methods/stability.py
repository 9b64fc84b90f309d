"""Linear stability of methods with a fixed step (Hairer, Wanner 1996, Solving Ordinary Differential Equations II, IV).

A step on ẍ = A x + B ẋ is a matrix on (x, ẋ), and a Runge-Kutta method makes of y' = λ y the factor R(h λ)::

    R(z) = 1 + z bᵀ (1 - z A)⁻¹ 1 = N(z) / D(z)      N(z) = det(1 - z A + z 1 bᵀ)      D(z) = det(1 - z A)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Protocol

import numpy as np

from mbkit._check import ROUNDING, Array
from mbkit.methods.tableaus import Tableau


class Stability(Protocol):
    """Stability of a method: its step on linear systems."""

    def matrix(self, h: float, A: Array, B: Array) -> Array:
        """Return the (2n, 2n) matrix of a step of h seconds on (x, ẋ) of ẍ = A x + B ẋ."""

    def largest_step(self, frequency: float, damping: float) -> float:
        """Return the largest stable step of q̈ + 2 ζ ω q̇ + ω² q = 0, s; infinite where every step is stable.

        Parameters
        ----------
        frequency : float
            ω, rad/s.
        damping : float
            ζ: 0 for none, or at least 1, with two real rates.
        """


def companion(A: Array, B: Array) -> Array:
    """Return the matrix of ẍ = A x + B ẋ as a system of first order in (x, ẋ)."""
    n = len(A)
    return np.block([[np.zeros((n, n)), np.eye(n)], [A, B]])


class TableauStability:
    """Stability of a Runge-Kutta method, from its tableau.

    Attributes
    ----------
    imaginary_limit, real_limit : float
        The method is stable for h λ = i y and h λ = -x from 0 to these; infinite where there is no limit.
    """

    def __init__(self, tableau: Tableau) -> None:
        self._tableau = tableau

    @cached_property
    def _polynomials(self) -> tuple[Array, Array]:
        """N and D, the coefficient of z⁰ first."""
        A, b = self._tableau.A, self._tableau.b
        if not self._tableau.explicit:
            above, below = (np.asarray(np.poly(x).real, np.float64) for x in (A - np.outer(np.ones(len(b)), b), A))
            return above, below
        powers = [np.ones(len(b))]
        for _ in b[1:]:
            powers.append(A @ powers[-1])
        return np.array([1.0, *(b @ x for x in powers)]), np.ones(1)

    def matrix(self, h: float, A: Array, B: Array) -> Array:
        """Return R(h times the system's matrix)."""
        Z = h * companion(A, B)
        above, below = (_at_matrix(coefficients, Z) for coefficients in self._polynomials)
        return above if self._tableau.explicit else np.asarray(np.linalg.solve(below, above))

    def largest_step(self, frequency: float, damping: float) -> float:
        """Return the largest stable step, s."""
        if damping == 0:
            return self.imaginary_limit / frequency
        return self.real_limit / (frequency * (damping + math.sqrt(damping**2 - 1)))

    @cached_property
    def imaginary_limit(self) -> float:
        """See the class."""
        return self._limit(1j)

    @cached_property
    def real_limit(self) -> float:
        """See the class."""
        return self._limit(-1.0)

    def _limit(self, direction: complex) -> float:
        # |D|² - |N|² along a ray is a polynomial in the distance, and the method is stable where it is not negative.
        turned = [p * direction ** np.arange(len(p)) for p in self._polynomials]
        length = 2 * max(map(len, turned)) - 1
        above, below = (_padded(np.convolve(x, x.conj()).real, length) for x in turned)
        # A coefficient may be a sum that cancels: its rounding is that of the terms.
        terms = sum(_padded(np.convolve(np.abs(x), np.abs(x)), length) for x in turned)
        gap = below - above
        gap[np.abs(gap) <= ROUNDING * terms] = 0.0
        roots = np.roots(gap[::-1])
        edges = np.sort(roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-9)].real)
        inside = 0.0
        for edge in (*edges.tolist(), math.inf):
            middle = 2 * inside + 1 if edge == math.inf else (inside + edge) / 2
            if np.polyval(gap[::-1], middle) < 0:
                return inside
            inside = edge
        return math.inf


def _padded(coefficients: Array, length: int) -> Array:
    return np.pad(coefficients, (0, length - len(coefficients)))


def _at_matrix(coefficients: Array, Z: Array) -> Array:
    power = np.eye(len(Z))
    out = coefficients[0] * power
    for c in coefficients[1:]:
        power = power @ Z
        out = out + c * power
    return np.asarray(out)


@dataclass(frozen=True)
class _EulerStability:
    """New velocity v⁺ from a linear system, then x⁺ = x + h v⁺."""

    # (h, A, B) -> what the unit matrix loses on the left of the velocity's equation.
    implicit: Callable[[float, Array, Array], Array]
    # (h, B) -> what v is multiplied by on its right, beside h A x.
    explicit: Callable[[float, Array], Array]
    # ζ -> largest stable ω h.
    limit: Callable[[float], float]

    def matrix(self, h: float, A: Array, B: Array) -> Array:
        """Return the matrix of a step."""
        one = np.eye(len(A))
        v = np.linalg.solve(one - self.implicit(h, A, B), np.hstack([h * A, one + self.explicit(h, B)]))
        return np.vstack([np.hstack([one, 0 * one]) + h * v, v])

    def largest_step(self, frequency: float, damping: float) -> float:
        """Return the largest stable step, s."""
        return self.limit(damping) / frequency


# A step on the oscillator, with x = ω h, has the characteristic polynomials below, stable where both roots are within
# the unit circle (Jury 1964).

#: λ² - (2 - 2ζx - x²) λ + 1 - 2ζx; at λ = -1, x² + 4ζx = 4.
SYMPLECTIC_EULER: Final = _EulerStability(
    lambda h, A, B: 0 * B,  # noqa: ARG005
    lambda h, B: h * B,
    lambda damping: 2 * (math.sqrt(damping**2 + 1) - damping),
)
#: Dampers implicit: (1 + 2ζx) λ² - (2 + 2ζx - x²) λ + 1; at λ = -1, x² - 4ζx = 4.
IMPLICIT_IN_VELOCITY: Final = _EulerStability(
    lambda h, A, B: h * B,  # noqa: ARG005
    lambda h, B: 0 * B,  # noqa: ARG005
    lambda damping: 2 * (math.sqrt(damping**2 + 1) + damping),
)
#: Dampers and springs implicit: stable with every step.
IMPLICIT_EULER: Final = _EulerStability(
    lambda h, A, B: h * B + h * h * A,
    lambda h, B: 0 * B,  # noqa: ARG005
    lambda damping: math.inf,  # noqa: ARG005
)
