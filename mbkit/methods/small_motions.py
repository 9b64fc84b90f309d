"""Small motions M δq̈ + D δq̇ + K δq = 0 whose masses, damping and stiffness differ by many powers of ten.

The eigenproblem is scaled by the factor of M, balanced, and graded from its fastest motion to its slowest, which QR
then keeps apart. Each eigenvalue is refined on the quadratic pencil itself, whose rounding, entry by entry, bounds its
error (Tisseur, Meerbergen 2001, The quadratic eigenvalue problem; Higham, Higham 1998, Structured backward error and
condition of generalized eigenvalue problems). So no entry is judged by the size of another that has another unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit._check import EPS, Array

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
