"""Small linear algebra that is the same on every processor: products, lengths, rows and what is held by them.

BLAS sums in an order, and with fused operations, that are those of the processor. The digest of a description must not
hang on the last bits of these, and a choice of rows must not hang on which of two equal ones they make the larger.

Whether rows depend on each other is decided here alone, by `DEPENDENT`.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import PRINTED, Array
from mbkit.errors import NumericalError

#: Part of a row that is left of it, once the others are taken away, up to which it follows from them: rounding of J at
#: a pose that is known to all digits, times the some thousand operations that lead to it.
DEPENDENT: Final = 1e-12


def product(A: Array, B: Array) -> Array:
    """Return A B of a matrix (m, n) and a vector (n,) or a matrix (n, k), summed from the first column on."""
    if B.ndim not in (1, 2) or A.shape[1:] != B.shape[:1]:
        raise ValueError(f"product: shapes {A.shape} and {B.shape} do not fit")
    columns = A if B.ndim == 1 else A[..., None]
    out = columns[:, 0] * B[0]
    for k in range(1, len(B)):
        out = out + columns[:, k] * B[k]
    return np.asarray(out)


def turned(R: Array, inertia: Array) -> Array:
    """Return R I Rᵀ, the inertia (3, 3) in the axes in which its own have the rotation R."""
    return product(product(R, inertia), R.T)


def length(x: Array) -> float:
    """Return the Euclidean length of a vector, (n,)."""
    total = 0.0
    for component in x.tolist():
        total += component * component
    return math.sqrt(total)


def pivoted(rows: Array, dependent: float = DEPENDENT) -> tuple[list[int], list[float], Array]:
    """Return independent rows in the order of their choice, the size of each remainder, and a basis of them.

    Gram and Schmidt's orthogonalization, twice for each row, with pivoting (Golub, Van Loan 2013, Matrix Computations,
    5.4.2): the next row is the first one whose remainder is the largest, up to a tie.

    Parameters
    ----------
    rows : (m, n) array
    dependent : float, optional
        Size of a remainder up to which a row follows from the others.

    Returns
    -------
    order : list of int, sizes : list of float, basis : (n, k) array
    """
    left, most = np.array(rows, dtype=np.float64), min(rows.shape)
    basis, order, sizes = np.zeros((most, rows.shape[1])), list[int](), list[float]()
    while len(order) < most:
        norms = np.sqrt((left * left).sum(axis=1))
        norms[order] = 0.0
        largest = float(norms.max())
        if not largest > dependent:
            break
        # Remainders that differ by less are equal but for rounding and a description's digits.
        k = int((norms >= (1 - PRINTED) * largest).argmax())
        known = basis[: len(order)]
        unit = left[k] - (known @ left[k]) @ known
        unit /= math.sqrt(unit @ unit)
        basis[len(order)] = unit
        order.append(k)
        sizes.append(float(norms[k]))
        left -= (left @ unit)[:, None] * unit
    return order, sizes, basis[: len(order)].T


def independent_rows(J: Array, first: int | None = None) -> tuple[tuple[int, ...], float]:
    """Return the largest set of rows that are independent, and the remainder of the last one, by pivoting.

    Of the first rows as many are taken as are independent among themselves, then others: a position that the rates of
    others imply has to be held all the same.
    """
    scaled, first = unit_rows(J), len(J) if first is None else first
    rows, sizes, basis = pivoted(scaled[:first])
    more, others, _ = pivoted(scaled[first:] - scaled[first:] @ basis @ basis.T)
    return (*sorted(rows), *(first + k for k in sorted(more))), min([*sizes, *others], default=0.0)


def unit_rows(J: Array) -> Array:
    """Return J with rows of unit size, (..., m, n), and zeros for a row whose slope is rounding of the others'."""
    size = np.linalg.norm(J, axis=-1, keepdims=True)
    return np.asarray(J / np.where(size > DEPENDENT * size.max(axis=-2, keepdims=True, initial=0.0), size, np.inf))


def under_rows(M: Array, J: Array, force: Array, rate: Array, rounding: float = DEPENDENT) -> tuple[Array, Array, int]:
    """Return x and λ of M x - Jᵀ λ = force, J x = rate, and how many rows are independent.

    By orthogonal factors of the rows in the metric of M and of themselves: M may have no inverse, and where J x is
    given they change neither x nor λ. These factors lose digits with the condition, those of J M⁻¹ Jᵀ with its square.
    Of rows that depend on each other x is the nearest to their rates, and λ has the least norm.

    Raises
    ------
    NumericalError
        M has no inverse on what the rows leave free.
    """
    masses = np.abs(np.diag(M))
    across = 1.0 / np.sqrt(np.where(masses > 0, masses, masses.max(initial=0.0) or 1.0))
    sizes = np.linalg.norm(J * across, axis=1)
    scaled, sizes = unit_rows(J * across), np.where(sizes > 0, sizes, 1.0)
    try:
        L = np.linalg.cholesky(across[:, None] * M * across + scaled.T @ scaled)
    except np.linalg.LinAlgError:
        raise NumericalError("the mass matrix is singular on what the constraints leave free") from None
    U, s, V = np.linalg.svd(np.linalg.solve(L, scaled.T), full_matrices=False)
    rank = int(np.count_nonzero(s > rounding * s.max(initial=0.0)))
    U, s, V = U[:, :rank], s[:rank], V[:rank].T
    x: Array = np.zeros(len(M))
    multipliers: Array = np.zeros(len(J))
    # Refined once: of masses that differ by decades the factors lose digits of the rows.
    for _ in range(2):
        rest = (rate - J @ x) / sizes
        free = np.linalg.solve(L, across * (force - M @ x + J.T @ multipliers) + scaled.T @ rest)
        along, z = U.T @ free, V.T @ rest / s
        beside = free - U @ along
        x = x + across * np.linalg.solve(L.T, beside - U @ (U.T @ beside) + U @ z)
        multipliers = multipliers + V @ ((z - along) / s) / sizes
    if rank < len(J):
        multipliers = np.asarray(np.linalg.lstsq(J.T, J.T @ multipliers, rcond=rounding)[0])
    return x, multipliers, rank


def singular_values(J: Array) -> Array:
    """Return the singular values of one or more matrices; NaN where a matrix is not finite."""
    good = np.asarray(np.isfinite(J).all(axis=(-1, -2)))[..., None]
    sizes = np.linalg.svd(np.where(good[..., None], J, 0.0), compute_uv=False)
    return np.where(good, sizes, np.nan)


def dependent(J: Array) -> NDArray[np.bool_]:
    """Return whether rows of unit size or less depend on each other, of one matrix (m, n) or each of a batch."""
    return np.asarray(~(singular_values(J)[..., -1:] > DEPENDENT).all(axis=-1))
