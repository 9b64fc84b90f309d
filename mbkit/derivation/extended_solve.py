"""Solve M a = f in extended precision, for all states at once.

The same elimination as `mbkit.derivation.factorize` (Featherstone 2008, Rigid Body
Dynamics Algorithms, ch. 6.5), on arrays of numbers instead of expressions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mbkit._check import Array
from mbkit.derivation.arithmetic import Arithmetic

__all__ = ["product", "solve"]


def product(M: Any, x: Any) -> Any:
    """Return M x for (N, n, n) and (N, n) arrays of 113-bit numbers."""
    out = np.zeros_like(x)
    for j in range(x.shape[1]):
        out = out + M[:, :, j] * x[:, j : j + 1]
    return out


def solve(M: Any, f: Any, pattern: Array, order: Sequence[int], own: Arithmetic) -> Any:
    """Return M⁻¹ f, shape (N, n); not finite where M is singular.

    Parameters
    ----------
    M, f : (N, n, n) and (N, n) arrays of 113-bit numbers
    pattern : (n, n) bool array
        Where M can be other than zero.
    order : sequence of int
        The indices with every parent before its children.
    own : Arithmetic
    """
    n = len(order)
    zero = own.zeros((1,))
    rows: list[dict[int, Any]] = []
    for k, i in enumerate(order):
        rows.append({m: M[:, i, j] for m, j in enumerate(order[: k + 1]) if pattern[i, j] or m == k})
    x = [f[:, i] for i in order]
    diagonal: list[Any] = [None] * n
    factors: list[dict[int, Any]] = [{} for _ in range(n)]
    with np.errstate(all="ignore"):
        for k in reversed(range(n)):
            row = rows[k]
            diagonal[k] = row.pop(k)
            for i in sorted(row, reverse=True):
                factors[k][i] = own.divide(row[i], diagonal[k])
                for j, entry in row.items():
                    if j <= i:
                        rows[i][j] = rows[i].get(j, zero) - factors[k][i] * entry
            for i, factor in factors[k].items():
                x[i] = x[i] - factor * x[k]
        for k in range(n):
            x[k] = own.divide(x[k], diagonal[k])
            for i, factor in factors[k].items():
                x[k] = x[k] - factor * x[i]
    out = np.empty_like(f)
    for k, i in enumerate(order):
        out[:, i] = x[k]
    return out
