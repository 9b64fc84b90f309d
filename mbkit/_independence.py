"""Which rows of a matrix are independent: the same choice on every processor.

LAPACK's pivoting compares sums that every BLAS rounds in its own way, so that of two rows of equal size now one and now
the other comes first. Here the first of them does.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import Array

#: Of the largest remainder: those that differ by less are equal but for rounding and the digits of a description.
_TIE: Final = 1e-6


def pivoted(rows: Array, dependent: float) -> tuple[list[int], list[float], Array]:
    """Return independent rows in the order of their choice, the size of each remainder, and a basis of them.

    Gram and Schmidt's orthogonalization, twice for each row, with pivoting (Golub, Van Loan 2013, Matrix Computations,
    5.4.2): the next row is the first one whose remainder is the largest, up to a tie.

    Parameters
    ----------
    rows : (m, n) array
    dependent : float
        Size of a remainder up to which a row follows from the others.

    Returns
    -------
    order : list of int, sizes : list of float, basis : (n, k) array
    """
    left, basis = np.array(rows, dtype=np.float64), np.empty((0, rows.shape[1]))
    order, sizes = list[int](), list[float]()
    while len(order) < min(rows.shape):
        norms = np.sqrt(np.sum(left**2, axis=1))
        norms[order] = 0.0
        largest = float(norms.max(initial=0.0))
        if not largest > dependent:
            break
        k = int(np.argmax(norms >= (1 - _TIE) * largest))
        unit = left[k] - basis.T @ (basis @ left[k])
        unit /= np.sqrt(np.sum(unit**2))
        order.append(k)
        sizes.append(float(norms[k]))
        basis = np.vstack([basis, unit])
        left -= np.outer(left @ unit, unit)
    return order, sizes, basis.T
