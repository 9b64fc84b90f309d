"""The inverse of a matrix in symbols, block by block."""

from __future__ import annotations

from typing import Any, Final

import sympy as sp

from mbkit.errors import InputError
from mbkit.lagrangian.tidy import tidy

__all__ = ["blocks", "inverse"]

# Above this size cofactors grow faster than elimination does.
_BY_COFACTORS: Final = 4


def inverse(A: Any, what: str) -> sp.ImmutableMatrix:
    """Return A⁻¹ with each entry tidied.

    Rows and columns that are coupled with no others are inverted by themselves, which
    keeps the answer as short as the matrix allows.

    Parameters
    ----------
    A : (n, n) sympy.Matrix
    what : str
        Its name, for the message.

    Raises
    ------
    InputError
        The matrix is singular everywhere.
    """
    A = sp.Matrix(A)
    out = sp.zeros(*A.shape)
    for block in blocks(A):
        part = A.extract(block, block)
        det = tidy(part.det(method="berkowitz"))
        if det == 0:
            raise InputError(f"{what}: {part.tolist()} is singular everywhere")
        if len(block) <= _BY_COFACTORS:
            turned = part.adjugate(method="berkowitz") / det
        else:
            turned = part.LUsolve(sp.eye(len(block)))
        for i, row in enumerate(block):
            for j, column in enumerate(block):
                out[row, column] = tidy(turned[i, j])
    return sp.ImmutableMatrix(out)


def blocks(A: sp.Matrix) -> list[list[int]]:
    """Return the indices that A's entries connect, each set in order."""
    left, out = list(range(A.shape[0])), []
    while left:
        block = [left.pop(0)]
        for i in block:
            block += [j for j in left if A[i, j] != 0 or A[j, i] != 0]
            left = [j for j in left if j not in block]
        out.append(sorted(block))
    return out
