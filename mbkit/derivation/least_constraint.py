"""Accelerations from Gauss's principle of least constraint: forward dynamics that forms no mass matrix.

With the kinetic energy as ½ Σ w ẋ², ẋ = J v, the mass matrix is M = Jᵀ W J, and the accelerations solve ::

    min ½ (J v̇ + c)ᵀ W (J v̇ + c) - fᵀ v̇        c: drifts, f: forces of joints

J's columns are made orthogonal from the leaves to the root, in W's measure, and c with them (modified Gram-Schmidt,
which is backward stable so: Björck 1996, Numerical Methods for Least Squares Problems, ch. 2.4 and 4.1). That gives M's
LᵀDL with D as sums of squares. To form M and eliminate loses eps M_kk/D_k where a light part moves with a heavy one,
for D_k is what is left of M_kk; and so loses who forms Jᵀ W c, the sum of forces that mostly cancel. Here neither is
ever formed. A leaf's column has entries in the rows of what it moves alone, and that stays so.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from mbkit.derivation.scalars import scalar
from mbkit.derivation.squares import Squares

__all__ = ["LeastConstraint"]


class LeastConstraint:
    """The orthogonal elimination of a system's squares.

    Parameters
    ----------
    squares : Squares
    order : sequence of int
        The velocities' indices with every parent before its children.

    Attributes
    ----------
    diagonal : list of casadi.SX
        D_k, by the velocities' indices.
    factors : list of dict of int to casadi.SX
        L_ki of M = Lᵀ D L, whose diagonal is one: of each k those i that come before it.
    """

    def __init__(self, squares: Squares, order: Sequence[int]) -> None:
        self._order, n = tuple(order), len(order)
        self._force = squares.force
        weights = squares.weights
        columns: list[dict[int, Any]] = [{} for _ in range(n)]
        for row, i in zip(*squares.jacobian.sparsity().get_triplet(), strict=True):
            columns[i][row] = scalar(squares.jacobian[row, i])
        drifts = dict(enumerate(squares.drifts))
        self.diagonal: list[Any] = [0.0] * n
        self.factors: list[dict[int, Any]] = [{} for _ in range(n)]
        #: What the drifts weigh along each column.
        self._pulls: list[Any] = [0.0] * n
        for place in reversed(range(n)):
            k = self._order[place]
            column = columns[k]
            weighted = {row: x * weights[row] for row, x in column.items()}
            # A joint that moves nothing has no entry at all: the quotient is then infinite, and whoever evaluates
            # finds it.
            diagonal = self.diagonal[k] = _dot(weighted, column)
            for i in self._order[:place]:
                other = columns[i]
                if not weighted.keys().isdisjoint(other):
                    factor = self.factors[k][i] = _dot(weighted, other) / diagonal
                    _subtract(other, factor, column)
            pull = self._pulls[k] = _dot(weighted, drifts)
            if column:
                _subtract(drifts, pull / diagonal, column)

    def accelerations(self, f: ca.SX) -> ca.SX:
        """Return v̇ under forces f of the joints, (n,), which hold neither gravity nor what v makes."""
        return self._solved(f - self._force, self._pulls)

    def over_mass(self, f: ca.SX) -> ca.SX:
        """Return M⁻¹ f for right-hand sides f, (n,) or (n, k)."""
        return self._solved(f, [0.0] * len(self._order))

    def _solved(self, f: ca.SX, pulls: Sequence[Any]) -> ca.SX:
        x = [scalar(f[k, :]) for k in range(len(self._order))]
        for k in reversed(self._order):
            for i, factor in self.factors[k].items():
                x[i] = x[i] - factor * x[k]
        for k in self._order:
            moved = sum((factor * x[i] for i, factor in self.factors[k].items()), 0.0)
            x[k] = (x[k] - pulls[k]) / self.diagonal[k] - moved
        return ca.vertcat(ca.SX(0, f.shape[1]), *x)


def _dot(weighted: dict[int, Any], x: dict[int, Any]) -> Any:
    return sum((w * x[row] for row, w in weighted.items() if row in x), 0.0)


def _subtract(x: dict[int, Any], factor: Any, y: dict[int, Any]) -> None:
    for row, entry in y.items():
        x[row] = x.get(row, 0.0) - factor * entry
