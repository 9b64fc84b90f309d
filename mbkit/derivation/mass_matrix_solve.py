"""Sparse LᵀDL solution of M a = f, written out as expressions.

Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 6.5: eliminating from the
leaves to the root fills in nothing on a tree. Mimic joints and the rotors of joint
couplings couple branches; the entries that they fill in are added to the pattern.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit.derivation.model_values import scalar
from mbkit.model import Model


def elimination_order(model: Model) -> tuple[int, ...]:
    """Return the velocity indices with every parent before its children."""
    parts = [model.layout.v[j.name] for j in model.tree]
    return tuple(i for part in parts for i in range(part.start, part.stop))


def elimination_size(model: Model) -> int:
    """Return about how many multiplications `solve` takes, from the tree alone."""
    rank = {index: k for k, index in enumerate(elimination_order(model))}
    moving: dict[str, frozenset[int]] = {"world": frozenset()}
    before: dict[int, set[int]] = {i: set() for i in rank}
    for joint in model.tree:
        part = model.layout.v[joint.mimic.joint if joint.mimic else joint.name]
        moving[joint.child] = moving[joint.parent] | frozenset(range(part.start, part.stop))
        # Of two velocities that move one body, the later one's row has an entry.
        for i in moving[joint.child]:
            before[i] |= {j for j in moving[joint.child] if rank[j] <= rank[i]}
    rotors = [c for c in model.couplings if c.armature or any(b.part == c.name for b in model.bindings)]
    for coupling in rotors:
        row = np.flatnonzero(model.layout.coupling_row(coupling) @ model.layout.G).tolist()
        for i in row:
            before[i] |= {j for j in row if rank[j] <= rank[i]}
    if rotors:
        # They couple branches: eliminating one velocity after the other fills in more entries.
        for k in sorted(rank, key=rank.__getitem__, reverse=True):
            for i in before[k] - {k}:
                before[i] |= {j for j in before[k] if rank[j] <= rank[i]}
    return sum(len(earlier) ** 2 for earlier in before.values())


#: Multiplications of a factorization up to which it is written out as an expression, interpreted and compiled: beyond,
#: an implicit method's system is formed and solved in LAPACK.
_WRITTEN_OUT: Final = {False: 6000, True: 100_000}


def factors_written_out(model: Model, *, compiled: bool) -> bool:
    """Return whether a factorization with the pattern of M is worth an expression."""
    # Under constraints there is no other way.
    return model.constrained or elimination_size(model) <= _WRITTEN_OUT[compiled]


def solve(M: ca.SX, f: ca.SX, order: Sequence[int]) -> ca.SX:
    """Return M⁻¹ f for a sparse positive definite M and right-hand sides f, (n,) or (n, k).

    `order` has every parent before its children; structural zeros of f are kept where possible.
    """
    return Factors(M, order).solve(f)


def reciprocal(x: Any) -> Any:
    """Return 1/x; infinite where x is zero for good."""
    if isinstance(x, ca.SX):
        # CasADi makes a quotient of a product with 1/x, and a processor divides at a twentieth of its speed.
        return scalar(2.0 / (x + x))
    return 1.0 / x if x else float("inf")


class Elimination:
    """M = LᵀDL, for several right-hand sides one after the other.

    Attributes
    ----------
    inverse : list of casadi.SX
        1/D_k, by the velocities' indices.
    factors : list of dict of int to casadi.SX
        L_ki, whose diagonal is one: of each k those i that come before it.
    """

    def __init__(self, order: Sequence[int]) -> None:
        self._order = tuple(order)
        self.inverse: list[Any] = [0.0] * len(self._order)
        self.factors: list[dict[int, Any]] = [{} for _ in self._order]

    def solve(self, f: ca.SX, pulls: Sequence[Any] | None = None) -> ca.SX:
        """Return M⁻¹ f, (n,) or (n, k); less L⁻¹ D⁻¹ of pulls."""
        x = self._lowered(f)
        return self._raised([a - b for a, b in zip(x, pulls, strict=True)] if pulls else x, self.inverse)

    def half(self, f: ca.SX) -> ca.SX:
        """Return D^-½ L^-ᵀ f, (n,) or (n, k), whose squares are those of f in the metric of M⁻¹."""
        x = (a * root for a, root in zip(self._lowered(f), self._roots, strict=True))
        return ca.vertcat(ca.SX(0, f.shape[1]), *x)

    def whole(self, y: ca.SX) -> ca.SX:
        """Return L⁻¹ D^-½ y: M⁻¹ f of y = `half`(f)."""
        return self._raised([scalar(y[k, :]) for k in range(len(self._order))], self._roots)

    @cached_property
    def _roots(self) -> list[Any]:
        return [ca.sqrt(x) for x in self.inverse]

    def _lowered(self, f: ca.SX) -> list[Any]:
        """Return L^-ᵀ f by its rows."""
        x = [scalar(f[k, :]) for k in range(len(self._order))]
        for k in reversed(self._order):
            for i, factor in self.factors[k].items():
                x[i] = x[i] - factor * x[k]
        return x

    def _raised(self, x: list[Any], scales: list[Any]) -> ca.SX:
        """Return L⁻¹ of rows times their scales."""
        for k in self._order:
            moved = sum((factor * x[i] for i, factor in self.factors[k].items()), 0.0)
            x[k] = x[k] * scales[k] - moved
        return ca.vertcat(*x) if x else ca.SX(0, 1)


class Factors(Elimination):
    """The elimination of a matrix; parameters as of `solve`."""

    def __init__(self, M: ca.SX, order: Sequence[int]) -> None:
        super().__init__(order)
        rank = {index: k for k, index in enumerate(order)}
        rows: list[dict[int, Any]] = [{} for _ in order]
        for i, j in zip(*M.sparsity().get_triplet(), strict=True):
            if rank[j] <= rank[i]:
                rows[i][j] = scalar(M[i, j])
        for k in reversed(self._order):
            row = rows[k]
            # A joint that moves nothing has no entry at all: the inverse is then infinite, and the evaluation
            # reports it.
            inverse = self.inverse[k] = reciprocal(row.pop(k, 0.0))
            for i in sorted(row, key=rank.__getitem__, reverse=True):
                factor = self.factors[k][i] = row[i] * inverse
                for j, entry in row.items():
                    if rank[j] <= rank[i]:
                        rows[i][j] = rows[i].get(j, 0.0) - factor * entry


def implicit(inverse: ca.SX, L: ca.SX, *by: ca.SX) -> tuple[ca.SX, ...]:
    """Return -M⁻¹ of each sparse matrix, (n, k), and M⁻¹ = L D⁻¹ Lᵀ, of D⁻¹ as a column and a sparse L.

    These are the derivatives of the x that solves f(x, y) = τ, with ∂f/∂x = M. A column of one branch takes products in
    another branch only with the velocities that both hang on.
    """
    weighted, lowered = (ca.mtimes(ca.diag(x), L.T) for x in (inverse, -inverse))
    # The upper half would be computed in another order, and not be the same.
    whole = ca.mtimes(L, weighted)
    whole = ca.tril(whole) + ca.tril(whole, False).T
    return *(ca.mtimes(L, ca.mtimes(lowered, x)) for x in by), whole
