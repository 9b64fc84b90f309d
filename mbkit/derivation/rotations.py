"""Constant and plane rotations as they stand between links, on floats and expressions.

A rotation is a list of factors, the first one next to the parent: `Permutation` (signed, exact), `PlaneRotation` and
`Matrix`. A plane rotation turns a vector with 6 operations, a symmetric matrix with 13; a full matrix takes 15 and 75.
Symmetric matrices are their six entries xx, xy, xz, yy, yz, zz.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Protocol

Vector = list[Any]
Rows = list[Vector]
#: Place of entry (i, j) of a symmetric matrix among its six.
SYMMETRIC: Final = ((0, 1, 2), (1, 3, 4), (2, 4, 5))


class Factor(Protocol):
    """One factor of a rotation R from a child's axes to its parent's; `numbers` is all that it multiplies by."""

    numbers: Sequence[Any]

    def apply(self, x: Vector) -> Vector:
        """Return R x."""

    def transposed(self, x: Vector) -> Vector:
        """Return Rᵀ x."""

    def congruence(self, A: Vector) -> Vector:
        """Return R A Rᵀ of a symmetric matrix."""

    def two_sided(self, H: Rows) -> Rows:
        """Return R H Rᵀ of any matrix."""


Rotation = Sequence[Factor]


class Permutation:
    """Axes in another order and direction: (R x)_i = sign_i x_{place_i}."""

    numbers: Sequence[Any] = ()

    def __init__(self, places: Sequence[int], signs: Sequence[float]) -> None:
        self.places, self.signs = tuple(places), tuple(signs)

    def apply(self, x: Vector) -> Vector:
        """Return R x."""
        return [signed(s, x[p]) for p, s in zip(self.places, self.signs, strict=True)]

    def transposed(self, x: Vector) -> Vector:
        """Return Rᵀ x."""
        out: Vector = [0.0] * 3
        for i, p in enumerate(self.places):
            out[p] = signed(self.signs[i], x[i])
        return out

    def congruence(self, A: Vector) -> Vector:
        """Return R A Rᵀ of a symmetric matrix."""
        p, s = self.places, self.signs
        return [signed(s[i] * s[j], A[SYMMETRIC[p[i]][p[j]]]) for i in range(3) for j in range(i, 3)]

    def two_sided(self, H: Rows) -> Rows:
        """Return R H Rᵀ of any matrix."""
        p, s = self.places, self.signs
        return [[signed(s[i] * s[j], H[p[i]][p[j]]) for j in range(3)] for i in range(3)]


class PlaneRotation:
    """A turn about one of the axes by an angle with this cosine and sine."""

    def __init__(self, axis: int, cosine: Any, sine: Any) -> None:
        self.axis, self.c, self.s = axis, cosine, sine
        self._i, self._j = (axis + 1) % 3, (axis + 2) % 3
        self.numbers: Sequence[Any] = (cosine, sine)

    def apply(self, x: Vector) -> Vector:
        """Return R x."""
        out, a, b = list(x), x[self._i], x[self._j]
        out[self._i], out[self._j] = self.c * a - self.s * b, self.s * a + self.c * b
        return out

    def transposed(self, x: Vector) -> Vector:
        """Return Rᵀ x."""
        out, a, b = list(x), x[self._i], x[self._j]
        out[self._i], out[self._j] = self.c * a + self.s * b, self.c * b - self.s * a
        return out

    def congruence(self, A: Vector) -> Vector:
        """Return R A Rᵀ of a symmetric matrix: the change of its diagonal is s w, with w = s (a - d) + 2 c b."""
        i, j, k, c, s = self._i, self._j, self.axis, self.c, self.s
        ii, ij, jj, ki, kj = (SYMMETRIC[m][n] for m, n in ((i, i), (i, j), (j, j), (k, i), (k, j)))
        a, b, d, out = A[ii], A[ij], A[jj], list(A)
        w = s * difference(a, d) + 2.0 * c * b
        change = s * w
        out[ii], out[jj], out[ij] = a - change, d + change, c * w - b
        out[ki], out[kj] = c * A[ki] - s * A[kj], s * A[ki] + c * A[kj]
        return out

    def two_sided(self, H: Rows) -> Rows:
        """Return R H Rᵀ of any matrix; the change of its diagonal is s w, with w = s (a - d) + c (b + b')."""
        i, j, k, c, s = self._i, self._j, self.axis, self.c, self.s
        out = [list(row) for row in H]
        w = s * difference(H[i][i], H[j][j]) + c * (H[i][j] + H[j][i])
        change = s * w
        out[i][i], out[j][j] = H[i][i] - change, H[j][j] + change
        out[i][j], out[j][i] = c * w - H[j][i], c * w - H[i][j]
        out[k][i], out[k][j] = c * H[k][i] - s * H[k][j], s * H[k][i] + c * H[k][j]
        out[i][k], out[j][k] = c * H[i][k] - s * H[j][k], s * H[i][k] + c * H[j][k]
        return out


class Matrix:
    """Any rotation, by its rows."""

    def __init__(self, rows: Rows) -> None:
        self.rows = rows
        self.numbers: Sequence[Any] = [x for row in rows for x in row]

    def apply(self, x: Vector) -> Vector:
        """Return R x."""
        return [R[0] * x[0] + R[1] * x[1] + R[2] * x[2] for R in self.rows]

    def transposed(self, x: Vector) -> Vector:
        """Return Rᵀ x."""
        R = self.rows
        return [R[0][i] * x[0] + R[1][i] * x[1] + R[2][i] * x[2] for i in range(3)]

    def congruence(self, A: Vector) -> Vector:
        """Return R A Rᵀ of a symmetric matrix."""
        columns = [self.apply([A[SYMMETRIC[i][j]] for i in range(3)]) for j in range(3)]
        rows = [[columns[j][i] for j in range(3)] for i in range(3)]
        return [sum((self.rows[j][k] * rows[i][k] for k in range(3)), 0.0) for i in range(3) for j in range(i, 3)]

    def two_sided(self, H: Rows) -> Rows:
        """Return R H Rᵀ of any matrix."""
        half = [self.apply([H[i][j] for i in range(3)]) for j in range(3)]
        return [self.apply([half[j][i] for j in range(3)]) for i in range(3)]


def signed(sign: float, x: Any) -> Any:
    """Return x or -x."""
    return x if sign > 0 else 0.0 - x if isinstance(x, float) else -x


def difference(a: Any, b: Any) -> Any:
    """Return a - b, exactly zero for the same expression."""
    return 0.0 if a is b else a - b


def to_parent(R: Rotation, x: Vector) -> Vector:
    """Return R x."""
    for factor in reversed(R):
        x = factor.apply(x)
    return x


def to_child(R: Rotation, x: Vector) -> Vector:
    """Return Rᵀ x."""
    for factor in R:
        x = factor.transposed(x)
    return x


def congruence(R: Rotation, A: Vector) -> Vector:
    """Return R A Rᵀ of a symmetric matrix."""
    for factor in reversed(R):
        A = factor.congruence(A)
    return A


def exact_congruence(R: Rotation, A: Vector) -> Vector:
    """Return R A Rᵀ of a symmetric matrix, row by row: small entries of a matrix with large ones keep their digits."""
    for factor in reversed(R):
        columns = [factor.apply([A[SYMMETRIC[i][j]] for i in range(3)]) for j in range(3)]
        rows = [factor.apply([columns[j][i] for j in range(3)]) for i in range(3)]
        A = [rows[i][j] for i in range(3) for j in range(i, 3)]
    return A


def two_sided(R: Rotation, H: Rows) -> Rows:
    """Return R H Rᵀ of any matrix."""
    for factor in reversed(R):
        H = factor.two_sided(H)
    return H
