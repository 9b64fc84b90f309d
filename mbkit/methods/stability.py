"""Linear stability of methods with a fixed step (Hairer, Wanner 1996, Solving Ordinary Differential Equations II, IV).

A step on ẍ = A x + B ẋ is a matrix on (x, ẋ), and a Runge-Kutta method makes of y' = λ y the factor R(h λ)::

    R(z) = 1 + z bᵀ (1 - z A)⁻¹ 1 = N(z) / D(z)      N(z) = det(1 - z A + z 1 bᵀ)      D(z) = det(1 - z A)

Small motions M δq̈ + D δq̇ + K δq = 0 whose masses, damping and stiffness differ by many powers of ten.

The eigenproblem is scaled by the factor of M, balanced, and graded from its fastest motion to its slowest, which QR
then keeps apart. Each eigenvalue is refined on the quadratic pencil itself, whose rounding, entry by entry, bounds its
error (Tisseur, Meerbergen 2001, The quadratic eigenvalue problem; Higham, Higham 1998, Structured backward error and
condition of generalized eigenvalue problems). So no entry is judged by the size of another that has another unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from mbkit._check import EPS, Array
from mbkit.methods.tableaus import Tableau

#: A coefficient of |D|² - |N|² below this part of the sum of its terms' sizes is rounding.
_ROUNDING: Final = 1e-13


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
        gap[np.abs(gap) <= _ROUNDING * terms] = 0.0
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


#: Number of refinements; each squares the error.
_REFINEMENTS: Final = 5


class SmallMotion(NamedTuple):
    """Whether small motions stay small, their angular frequencies in rad/s and eigenvalues in 1/s."""

    stable: bool | None
    frequencies: Array
    eigenvalues: Any


def small_motion(M: Array, D: Array, K: Array, errors: Sequence[Any] = (0.0, 0.0, 0.0)) -> SmallMotion:
    """Return the eigenvalues of M δq̈ + D δq̇ + K δq = 0 and its stability; massless coordinates have none.

    `errors` bound those of the entries of M, D and K beside their rounding. A part of an eigenvalue that is within its
    error bound is zero. Stable is what a minimum of the potential without negative damping is (Merkin 1997,
    Introduction to the Theory of Stability, ch. 3 and 6: Lagrange and Dirichlet, Kelvin and Tait), or where all
    motions decay; None where the error bounds or the linear equation do not decide.
    """
    if not len(M):
        return SmallMotion(None, np.empty(0), np.empty(0, dtype=complex))
    bounds = [EPS * np.abs(A) + e for A, e in zip((M, D, K), errors, strict=True)]
    D, K = (np.where(np.abs(A) > e, A, 0.0) for A, e in zip((D, K), bounds[1:], strict=True))
    symmetric = bool((np.abs(K - K.T) <= bounds[2] + bounds[2].T).all())
    M, K = (M + M.T) / 2, (K + K.T) / 2 if symmetric else K
    values, _ = eigenvalues((M, D, K), bounds)
    kind = definite(K, bounds[2]) if symmetric else 0
    stable = None
    if (values.real > 0).any() or (kind < 0 and not D.any()):
        stable = False
    elif (kind > 0 and definite((D + D.T) / 2, (bounds[1] + bounds[1].T) / 2) >= 0) or (values.real < 0).all():
        stable = True
    return SmallMotion(stable, np.sort(values.imag[values.imag > 0]), np.sort_complex(values))


def definite(A: Array, error: Array) -> int:
    """Return 1 where a symmetric matrix is positive definite beyond its entries' error, -1 where it is sure not to be.

    The unit of each coordinate is that which makes its own entry 1 (van der Sluis 1969; Demmel, Veselić 1992).
    """
    size = np.sqrt(np.abs(A.diagonal()))
    across = np.abs(A).max(axis=1) / (size.max() or np.sqrt(np.abs(A).max()) or 1.0)
    size = np.where(size > 0, size, np.where(across > 0, across, 1.0))
    scale = np.outer(size, size)
    least = float(np.linalg.eigvalsh(A / scale)[0])
    slack = 4 * len(A) * EPS + float(np.linalg.norm(np.where(A, error, 0.0) / scale))
    return int(least > slack) - int(least < -slack)


def eigenvalues(pencil: Sequence[Array], errors: Sequence[Array]) -> tuple[Any, Any]:
    """Return all finite λ of det(A λ² + B λ + C) = 0, and bounds of their errors.

    Real and imaginary parts within the bound of an eigenvalue are zero.
    """
    scale = _unit(pencil[0])
    values, x, y = _first(*(scale[:, None] * P * scale for P in pencil))
    half = values.imag >= 0
    values, x, y = values[half], x.T[half] * scale, y.T[half] * scale
    pair, apart = values.imag > 0, 2 * values.imag
    error, due, at = np.full(len(values), np.inf), np.arange(len(values)), values
    for turn in range(_REFINEMENTS):
        powers, slopes = np.array([at**2, at, at**0])[:, :, None], np.array([2 * at, at**0, 0 * at])[:, :, None]
        residual, slope = (sum(c * (x @ P.T) for c, P in zip(z, pencil, strict=True)) for z in (powers, slopes))
        rounding = sum(abs(c) * (abs(x) @ E.T) for c, E in zip(powers, errors, strict=True)) * 4 * (len(scale) + 2)
        with np.errstate(all="ignore"):
            along = (y.conj() * slope).sum(axis=1)
            step = (y.conj() * residual).sum(axis=1) / along
            # Vectors that are not near leave a residual that is more than rounding.
            left = np.maximum(rounding, np.abs(residual))
            least, bound = ((abs(y) * a).sum(axis=1) / abs(along) for a in (rounding, left))
            bound = np.nan_to_num(bound + np.abs(step), nan=np.inf)
        at = np.where(np.isfinite(step), at - step, at)
        better = bound < error[due]
        values[due[better]], error[due[better]] = at[better], bound[better]
        more = ~(bound <= 2 * least)
        due, at, x, y = due[more], at[more], x[more], y[more]
        if not len(due) or turn + 1 == _REFINEMENTS:
            break
        x, y = _inverse_iteration(pencil, at, x, y)
    values.real[np.abs(values.real) <= error] = 0.0
    values.imag[np.abs(values.imag) <= error] = 0.0
    # A pair that came to the real axis may be of two that differ.
    others = np.where(values.imag == 0, np.maximum(error, apart), error)[pair]
    twins = np.where(np.abs(values[pair]) > others, values[pair].conj(), 0.0)
    return np.append(values, twins), np.append(error, others)


def _inverse_iteration(pencil: Sequence[Array], at: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Return better rows of right and left eigenvectors, of pencils in units in which their entries are about 1."""
    A, B, C = pencil
    z = at[:, None, None]
    size = np.diagonal(np.abs(z * z) * np.abs(A) + np.abs(z) * np.abs(B) + np.abs(C), axis1=1, axis2=2)
    scale = 1 / np.sqrt(np.where(size > 0, size, 1.0))
    # A number of the size of rounding keeps the matrix regular, and changes its inverse along the sought vectors alone.
    inverse = np.linalg.inv(
        (z * z * A + z * B + C) * scale[:, :, None] * scale[:, None, :] + (1 + 1j) * EPS * np.eye(len(A))
    )
    slope = 2 * z * A + B
    ahead = scale * np.einsum("kij,kj->ki", inverse, scale * np.einsum("kij,kj->ki", slope, x))
    back = scale * np.einsum("kji,kj->ki", inverse.conj(), scale * np.einsum("kji,kj->ki", slope.conj(), y))
    return ahead, back


def _unit(M: Array) -> Array:
    """Return the unit of each coordinate in which its entry of M is 1, or 0."""
    size = np.sqrt(np.abs(M.diagonal()))
    return np.asarray(1 / np.where(size > 0, size, 1.0))


def _first(A: Array, B: Array, C: Array) -> tuple[Any, Any, Any]:
    """Return eigenvalues and columns of right and left eigenvectors, near enough to be refined."""
    from scipy.linalg import eig

    n, unit, zero = len(A), np.eye(len(A)), np.zeros_like(A)
    ahead, lead = np.block([[zero, unit], [-C, -B]]), np.block([[unit, zero], [zero, A]])
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(lead))
    except np.linalg.LinAlgError:
        values, left, right = eig(ahead, lead, left=True)
        kept = np.isfinite(values)
        return values[kept], right[:n, kept], left[-n:, kept]
    values, left, right = graded(inverse @ ahead @ inverse.T)
    return values, (inverse.T @ right)[:n], (inverse.T @ left)[-n:]


def graded(J: Array, *, vectors: bool = True) -> tuple[Any, Any, Any]:
    """Return eigenvalues of a matrix, and columns of left and right eigenvectors where they are asked for.

    Balanced and ordered from its largest entries to its smallest, which QR then computes to their own size.
    """
    from scipy.linalg import eig, matrix_balance

    balanced, (size, _) = matrix_balance(J, permute=False, separate=True)
    order = np.argsort(-np.abs(balanced).max(axis=0, initial=0.0), kind="stable")
    balanced = balanced[np.ix_(order, order)]
    if not vectors:
        return np.linalg.eigvals(balanced).astype(complex), None, None
    values, left, right = eig(balanced, left=True)
    back = np.argsort(order)
    return values, left[back] / size[:, None], right[back] * size[:, None]
