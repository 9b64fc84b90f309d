"""A kinetic energy as a sum of squares: M = L D Lᵀ in symbols, shortest pivots first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sympy as sp

from mbkit.errors import InputError
from mbkit.lagrangian.quotients import reduced

__all__ = ["Squares"]


class Squares:
    """A symmetric positive definite matrix, eliminated.

    Completed squares are how books write H and effective potentials:
    (p_φ - p_ψ cos θ)² / (2 A sin² θ) + p_ψ² / (2 C), where entries of M⁻¹ would be long.

    Parameters
    ----------
    M : (n, n) sympy.Matrix
    what : str
        Its name, for the message.

    Raises
    ------
    InputError
        The matrix is singular everywhere.
    """

    def __init__(self, M: Any, what: str) -> None:
        left, entries = list(range(M.shape[0])), {(i, j): M[i, j] for i in range(M.shape[0]) for j in range(i + 1)}

        def entry(i: int, j: int) -> sp.Expr:
            return entries[max(i, j), min(i, j)]

        #: Of each pivot: its index, its D, and how much of its row goes off each later one.
        self._steps: list[tuple[int, sp.Expr, dict[int, sp.Expr]]] = []
        while left:
            pivots = {i: entry(i, i) for i in left if entry(i, i) != 0}
            if not pivots:
                raise InputError(f"{what} {sp.Matrix(M).tolist()} is singular everywhere")
            k = min(pivots, key=lambda i: (pivots[i].count_ops(), left.index(i)))
            left.remove(k)
            factors = {i: reduced(entry(i, k) / pivots[k]) for i in left if entry(i, k) != 0}
            for i, factor in factors.items():
                for j in factors:
                    if j <= i:
                        entries[i, j] = reduced(entries[i, j] - factor * entry(j, k))
            self._steps.append((k, pivots[k], factors))

    def lowered(self, x: Sequence[sp.Expr]) -> list[sp.Expr]:
        """Return L⁻¹ x."""
        out = list(x)
        for k, _, factors in self._steps:
            for i, factor in factors.items():
                out[i] = reduced(out[i] - factor * out[k])
        return out

    def form(self, x: Sequence[sp.Expr], y: Sequence[sp.Expr]) -> sp.Expr:
        """Return xᵀ M⁻¹ y, as a sum over the pivots."""
        a, b = self.lowered(x), self.lowered(y)
        return sum((a[k] * b[k] / pivot for k, pivot, _ in self._steps), sp.Integer(0))

    def solve(self, x: Sequence[sp.Expr]) -> list[sp.Expr]:
        """Return M⁻¹ x."""
        out = self.lowered(x)
        for k, pivot, factors in reversed(self._steps):
            out[k] = out[k] / pivot - sum((factor * out[i] for i, factor in factors.items()), sp.Integer(0))
        return out
