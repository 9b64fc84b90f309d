"""Sparse LᵀDL solution of M a = f, written out as expressions.

Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 6.5: eliminating from the
leaves to the root fills in nothing on a tree. Mimic joints couple branches; the
entries that they fill in are simply added to the pattern.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

__all__ = ["solve"]


def solve(M: ca.SX, f: ca.SX, order: Sequence[int]) -> ca.SX:
    """Return M⁻¹ f.

    Parameters
    ----------
    M : (n, n) casadi.SX
        Symmetric positive definite, sparse.
    f : (n,) casadi.SX
    order : sequence of int
        The indices with every parent before its children.
    """
    n = M.shape[0]
    rank = {index: k for k, index in enumerate(order)}
    rows: list[dict[int, Any]] = [{} for _ in range(n)]
    for i, j in zip(*M.sparsity().get_triplet(), strict=True):
        if rank[j] <= rank[i]:
            rows[rank[i]][rank[j]] = M[i, j]
    x = [f[index] for index in order]
    diagonal: list[Any] = [None] * n
    factors: list[dict[int, Any]] = [{} for _ in range(n)]
    for k in reversed(range(n)):
        row = rows[k]
        # A joint that moves nothing has no entry at all: the quotient is then
        # infinite, and whoever evaluates finds it.
        diagonal[k] = row.pop(k, 0.0)
        for i in sorted(row, reverse=True):
            factors[k][i] = row[i] / ca.SX(diagonal[k])
            for j, entry in row.items():
                if j <= i:
                    rows[i][j] = rows[i].get(j, 0.0) - factors[k][i] * entry
    for k in reversed(range(n)):
        for i, factor in factors[k].items():
            x[i] = x[i] - factor * x[k]
    for k in range(n):
        x[k] = x[k] / ca.SX(diagonal[k]) - sum((factor * x[i] for i, factor in factors[k].items()), 0.0)
    out = ca.SX(n, 1)
    for k, index in enumerate(order):
        out[index] = x[k]
    return out
