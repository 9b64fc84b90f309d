"""xᵀ M⁻¹ y of a mass matrix in symbols, in the shortest of several forms.

Completed squares are how books write H and effective potentials: (p_φ - p_ψ cos θ)² / (2 A sin² θ) + p_ψ² / (2 C),
where entries of M⁻¹ would be long. Which coordinate is eliminated first makes the difference. Where all squares
hold quotients of quotients, the cofactors of M over its determinant are shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import permutations
from typing import Any, Final, Protocol

import sympy as sp

from mbkit.errors import InputError
from mbkit.lagrangian.compact import cost
from mbkit.lagrangian.inverse import blocks
from mbkit.lagrangian.tidy import tidy

__all__ = ["Squares"]

#: Coupled coordinates of which every order is tried.
_TRIED: Final = 3
#: Operations of three coupled rows up to which they are.
_SMALL: Final = 24
#: Operations up to which a step of an elimination is tidied.
_LONG: Final = 250


class _Inverse(Protocol):
    """The inverse of one block of M."""

    def form(self, x: Sequence[sp.Expr], y: Sequence[sp.Expr]) -> sp.Expr: ...

    def solve(self, x: Sequence[sp.Expr]) -> list[sp.Expr]: ...


class Squares:
    """The inverse of a symmetric positive definite matrix, each set of coupled coordinates by itself.

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
        self._blocks: list[tuple[list[int], _Inverse]] = []
        for block in blocks(M):
            part = sp.ImmutableMatrix(M.extract(block, block))
            p = sp.symbols(f"p0:{len(block)}", cls=sp.Dummy)
            tried = _tried(part, f"{what} {sp.Matrix(M).tolist()}")
            self._blocks.append((block, min(tried, key=lambda a: cost(a.form(p, p)) if len(tried) > 1 else 0)))

    def form(self, x: Sequence[sp.Expr], y: Sequence[sp.Expr]) -> sp.Expr:
        """Return xᵀ M⁻¹ y."""
        parts = (a.form([x[i] for i in block], [y[i] for i in block]) for block, a in self._blocks)
        return sum(parts, sp.Integer(0))

    def solve(self, x: Sequence[sp.Expr]) -> list[sp.Expr]:
        """Return M⁻¹ x."""
        out = list(x)
        for block, a in self._blocks:
            for i, value in zip(block, a.solve([x[i] for i in block]), strict=True):
                out[i] = value
        return out


def _tried(M: sp.ImmutableMatrix, what: str) -> list[_Inverse]:
    n = M.shape[0]
    few = n <= _TRIED and (n < _TRIED or sum(x.count_ops() for x in M) <= _SMALL)
    out: list[_Inverse] = []
    for order in permutations(range(n)) if few else (None,):
        with suppress(_NoPivotError):
            out.append(_Eliminated(M, order))
    if not out or (few and n > 1):
        out.append(_Cofactors(M, what))
    return out


def _shorter(x: sp.Expr) -> sp.Expr:
    """Return an expression tidied; one that nobody reads as it is."""
    return tidy(x) if x.count_ops() <= _LONG else x


class _NoPivotError(Exception):
    """All pivots that are left are zero."""


class _Eliminated:
    """M = L D Lᵀ, with pivots in an order, or the shortest first."""

    def __init__(self, M: sp.ImmutableMatrix, order: Sequence[int] | None = None) -> None:
        left, entries = list(range(M.shape[0])), {(i, j): M[i, j] for i in range(M.shape[0]) for j in range(i + 1)}

        def entry(i: int, j: int) -> sp.Expr:
            return entries[max(i, j), min(i, j)]

        #: Of each pivot: its index, its D, and how much of its row goes off each later one.
        self._steps: list[tuple[int, sp.Expr, dict[int, sp.Expr]]] = []
        while left:
            pivots = {i: entry(i, i) for i in left if entry(i, i) != 0}
            if not pivots:
                raise _NoPivotError
            k = min(pivots, key=lambda i: (pivots[i].count_ops(), left.index(i)))
            if order is not None:
                k = next(i for i in order if i in pivots)
            left.remove(k)
            factors = {i: _shorter(entry(i, k) / pivots[k]) for i in left if entry(i, k) != 0}
            for i, factor in factors.items():
                for j in factors:
                    if j <= i:
                        entries[i, j] = _shorter(entries[i, j] - factor * entry(j, k))
            self._steps.append((k, pivots[k], factors))

    def _lowered(self, x: Sequence[sp.Expr]) -> list[sp.Expr]:
        """Return L⁻¹ x."""
        out = list(x)
        for k, _, factors in self._steps:
            for i, factor in factors.items():
                out[i] = _shorter(out[i] - factor * out[k])
        return out

    def form(self, x: Sequence[sp.Expr], y: Sequence[sp.Expr]) -> sp.Expr:
        a, b = self._lowered(x), self._lowered(y)
        return sum((a[k] * b[k] / pivot for k, pivot, _ in self._steps), sp.Integer(0))

    def solve(self, x: Sequence[sp.Expr]) -> list[sp.Expr]:
        out = self._lowered(x)
        for k, pivot, factors in reversed(self._steps):
            out[k] = out[k] / pivot - sum((factor * out[i] for i, factor in factors.items()), sp.Integer(0))
        return out


class _Cofactors:
    """M⁻¹ = adj M / det M."""

    def __init__(self, M: sp.ImmutableMatrix, what: str) -> None:
        self._below = tidy(M.det(method="berkowitz"))
        if self._below == 0:
            raise InputError(f"{what} is singular everywhere")
        self._above = M.adjugate(method="berkowitz").applyfunc(tidy)

    def form(self, x: Sequence[sp.Expr], y: Sequence[sp.Expr]) -> sp.Expr:
        return tidy((sp.Matrix([x]) * self._above * sp.Matrix(list(y)))[0]) / self._below

    def solve(self, x: Sequence[sp.Expr]) -> list[sp.Expr]:
        return [tidy(e) / self._below for e in self._above * sp.Matrix(list(x))]
