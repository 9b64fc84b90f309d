"""Sparse LᵀDL solution of M a = f, free or under constraints, written out as expressions.

Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 6.5: eliminating from the
leaves to the root fills in nothing on a tree. Mimic joints and the rotors of joint
couplings couple branches; the entries that they fill in are added to the pattern.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, reduce
from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit._check import TINY
from mbkit._reproducible import DEPENDENT
from mbkit.derivation.model_values import scalar
from mbkit.model import Model

#: Mass of a coordinate that has none, in terms of the mean one.
_MASSLESS: Final = 1e-20
#: Later columns from which on a reflection onto a row of their own saves more than its root costs.
_WORTH_A_ROOT: Final = 4


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
        # Two velocities that move one body share an entry, in the later one's row.
        for i in moving[joint.child]:
            before[i] |= {j for j in moving[joint.child] if rank[j] <= rank[i]}
    turned = [c for c in model.couplings if c.rotors or any(b.part == c.name for b in model.bindings)]
    for coupling in turned:
        row = np.flatnonzero(model.layout.coupling_row(coupling) @ model.layout.G).tolist()
        for i in row:
            before[i] |= {j for j in row if rank[j] <= rank[i]}
    if turned:
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
        return self._raised([a - b for a, b in zip(x, pulls, strict=True)] if pulls else x)

    def lowered(self, f: ca.SX) -> ca.SX:
        """Return L^-ᵀ f, (n,) or (n, k), whose squares in the metric of D⁻¹ are those of f in that of M⁻¹."""
        return ca.vertcat(ca.SX(0, f.shape[1]), *self._lowered(f))

    def raised(self, y: ca.SX) -> ca.SX:
        """Return L⁻¹ D⁻¹ y: M⁻¹ f of y = `lowered`(f)."""
        return self._raised([scalar(y[k, :]) for k in range(len(self._order))])

    def _lowered(self, f: ca.SX) -> list[Any]:
        """Return L^-ᵀ f by its rows."""
        x = [scalar(f[k, :]) for k in range(len(self._order))]
        for k in reversed(self._order):
            for i, factor in self.factors[k].items():
                x[i] = x[i] - factor * x[k]
        return x

    def _raised(self, x: list[Any]) -> ca.SX:
        """Return L⁻¹ D⁻¹ of rows."""
        for k in self._order:
            moved = sum((factor * x[i] for i, factor in self.factors[k].items()), 0.0)
            x[k] = x[k] * self.inverse[k] - moved
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


# Under constraints


class ConstraintTerms:
    """f(q, t), and of all rows J, the rate J v + c, and γ, with the rate's derivative J v̇ + γ.

    `names` has one text for each row, and `qdot` is D(q) v where velocities are not the coordinates' rates. `speeds`
    has A v - b of the rows that hold velocities alone, which stand behind those of f. `by_time` is c: ∂f/∂t, then -b.
    `known` gives γ of rows by name, where there is a shorter form of it than the derivative of the rate.
    """

    def __init__(
        self,
        value: ca.SX,
        q: ca.SX,
        v: ca.SX,
        time: Any,
        names: tuple[str, ...],
        qdot: ca.SX | None = None,
        speeds: ca.SX | None = None,
        known: Callable[[], dict[str, Any]] | None = None,
    ) -> None:
        self.value, self.names, self._known = value, names, known
        self._q, self._v, self._qdot, self._time = q, v, qdot, time
        by_q = ca.jacobian(value, q)
        J = by_q if qdot is None else ca.mtimes(by_q, ca.jacobian(qdot, v))
        speeds = ca.SX(0, 1) if speeds is None else speeds
        self.jacobian = ca.vertcat(J, ca.jacobian(speeds, v))
        by_time = ca.SX(value.shape[0], 1) if time is None else ca.jacobian(value, time)
        self.by_time = ca.vertcat(by_time, ca.substitute(speeds, v, ca.SX.zeros(*v.shape)))
        self.rate = ca.vertcat(ca.mtimes(J, v) + by_time, speeds)

    @cached_property
    def gamma(self) -> Any:
        """γ."""
        out = ca.jtimes(self.rate, self._q, self._v if self._qdot is None else self._qdot)
        if self._time is not None:
            out = out + ca.jacobian(self.rate, self._time)
        known = self._known() if self._known else {}
        for i in (i for i, name in enumerate(self.names) if name in known):
            out[i] = known[self.names[i]]
        return out

    def rate_along(self, by: Any) -> Any:
        """Return the derivative of ḟ along a move of the configuration, (nv,), with v and the time held."""
        move = by if self._qdot is None else ca.substitute(self._qdot, self._v, by)
        return ca.jtimes(self.rate, self._q, move)

    @property
    def positions(self) -> int:
        """How many rows hold positions: the first ones."""
        return int(self.value.shape[0])

    def stiffening(self, M: Any) -> Any:
        """Return s > 0, (m, 1), so that W = M + Jᵀ diag(s) J has an inverse where M has it on J's null space.

        With J v̇ given, the term changes neither v̇ nor λ. s is the geometric mean of the sum's and the lightest
        coordinate's mass along a row: W keeps the digits of both, of a light rod in a loop as of a heavy body.
        """
        masses = ca.diag(M)
        masses = masses + _MASSLESS / masses.shape[0] * ca.sum1(masses)
        squares = self.jacobian**2
        heavy, light = ca.mtimes(squares, masses), ca.mtimes(squares, 1 / masses)
        # The term of a row without slope is zero.
        return ca.sqrt((heavy + TINY) / (light + TINY)) / (ca.sum2(squares) + TINY)

    def weight(self, M: Any) -> Any:
        """Return W = M + Jᵀ diag(s) J of `stiffening`."""
        return M + ca.mtimes(self.jacobian.T, self.stiffening(M) * self.jacobian)


class ConstraintFactors:
    """Factors of M = LᵀDL and of J's rows in the metric of M, which give v̇ and λ.

    B = L^-ᵀ Jᵀ = Q R with Q orthogonal in the metric of D⁻¹: v̇ is the free acceleration with its part along Q replaced
    (Golub and Van Loan 2013, Matrix Computations, ch. 5.3 and 6.2). So errors grow with the condition κ of D^-½ B;
    that of J M⁻¹ Jᵀ is its square. Where M itself would lose digits or has no inverse, as with links without mass in a
    loop, `careful` ones are those of W = M + Jᵀ diag(s) J, and a solution is refined once.
    """

    def __init__(self, c: ConstraintTerms, M: Any, order: tuple[int, ...], *, careful: bool) -> None:
        self._c, self._M, self.careful = c, M, careful
        self._stiffening: Any = c.stiffening(M) if careful else None
        self._W = Factors(c.weight(M) if careful else M, order)
        self.rows = OrthogonalColumns(self._W.lowered(c.jacobian.T), self._W.inverse)

    def change(self, residual: Any, rows: int | None = None) -> Any:
        """Return the least x in the metric of M with J x = residual, of all rows or of the first ones."""
        return self._W.raised(self.rows.least(residual, rows))

    def solved(self, force: Any, rate: Any) -> tuple[Any, Any]:
        """Return x and λ of M x - Jᵀ λ = force, J x = rate, of one right-hand side or several, (n, k) and (m, k)."""
        J = self._c.jacobian
        given = force + ca.mtimes(J.T, ca.mtimes(ca.diag(self._stiffening), rate)) if self.careful else force
        x, multipliers = self.rows.held(self._W.lowered(given), rate)
        return self._W.raised(x), multipliers

    def motion(self, force: Any, rate: Any | None = None) -> tuple[Any, Any]:
        """Return x and λ of M x - Jᵀ λ = force, J x = rate; by default v̇ with J v̇ = -γ.

        Only the rate's derivative is zero: integrators project states (`mbkit.derivation.steps.onto_constraints`).
        """
        c, M = self._c, self._M
        rate = -c.gamma if rate is None else rate
        x, multipliers = self.solved(force, rate)
        if self.careful:
            left = force - ca.mtimes(M, x) + ca.mtimes(c.jacobian.T, multipliers)
            dx, more = self.solved(left, rate - ca.mtimes(c.jacobian, x))
            x, multipliers = x + dx, multipliers + more
        # No digit is left where the rows depend on each other.
        doubt = ca.if_else(self.rows.independent, 0.0, np.nan)
        return x + doubt, multipliers + doubt


class OrthogonalColumns:
    """B = Q R of a matrix (n, m) whose columns are independent, with Q orthogonal in a diagonal metric, by default 1.

    Modified Gram-Schmidt: each column is taken out of the later ones. That is a reflection of the column onto a row of
    zeros below B, and as stable (Björck and Paige 1992, SIAM J. Matrix Anal. Appl. 13); with its square as the metric
    of this row no root is taken. A column that many others follow is reflected onto a row of its own, which then is
    R's and no later column's: the one that the fewest of them have. So a leg of a platform fills in nothing in the
    others (Golub and Van Loan 2013, Matrix Computations, ch. 5.1 and 11.1).
    """

    def __init__(self, B: Any, metric: Sequence[Any] | None = None) -> None:
        self._B, (self._n, self._m) = B, B.shape
        metric = [1.0] * self._n if metric is None else metric
        columns: list[dict[int, Any]] = [{} for _ in range(self._m)]
        for i, j in zip(*B.sparsity().get_triplet(), strict=True):
            columns[j][i] = scalar(B[i, j])
        #: Squares of the columns, and of their parts beside the columns before them.
        self.squares: list[Any] = []
        self.remainders: list[Any] = []
        #: Of each column the row of R_jj, its metric and the inverse, 1/R_jj, and the other entries of R.
        self._pivots: list[int] = []
        self._metric: list[Any] = []
        self._scales: list[Any] = []
        self._inverse: list[Any] = []
        self._R: list[dict[int, Any]] = []
        #: Vectors of the reflections 1 + u w pᵀ.
        self._reflections: list[tuple[dict[int, Any], Any, dict[int, Any]]] = []
        for j, u in enumerate(columns):
            own = {i: u.pop(p) for i, p in enumerate(self._pivots) if p in u}
            dual = {i: metric[i] * x for i, x in u.items()}
            left = _dot(u, dual)
            self._R.append(own)
            self.remainders.append(left)
            self.squares.append(left + sum(self._metric[i] * x**2 for i, x in own.items()))
            later = [x for x in columns[j + 1 :] if not u.keys().isdisjoint(x)]
            if len(later) < _WORTH_A_ROOT:
                # One without entries follows from those before; the evaluation reports it.
                pivot, inverse, weight = self._n + j, -1.0, scalar(-1.0 / ca.SX(left))
                u[pivot], dual[pivot], scale = 1.0, left, -weight
            else:
                pivot = min(u, key=lambda i: sum(i in x for x in later))
                scale = reciprocal(metric[pivot])
                # Away from the column, so that nothing cancels.
                size = (1.0 - 2.0 * (u[pivot] < 0)) * ca.sqrt(left * scale)
                weight = -1.0 / (left + dual[pivot] * size)
                u[pivot] = u[pivot] + size
                dual[pivot] = metric[pivot] * u[pivot]
                inverse = weight * dual[pivot]
            self._pivots.append(pivot)
            self._metric.append(metric[pivot] if pivot < self._n else left)
            self._scales.append(scale)
            self._inverse.append(inverse)
            self._reflections.append((u, weight, dual))
            for other in later:
                self._reflect(j, other)

    @property
    def independent(self) -> Any:
        """Whether each column has a part beside the columns before it, relative to its size, and beside the largest."""
        out: Any = reduce(ca.fmin, self.squares) > DEPENDENT**2 * sum(self.squares)
        for left, square, before in zip(self.remainders, self.squares, self._R, strict=True):
            if before:
                out = ca.logic_and(out, left > DEPENDENT**2 * square)
        return out

    def _reflect(self, j: int, y: dict[int, Any]) -> None:
        u, weight, dual = self._reflections[j]
        if not u.keys().isdisjoint(y):
            factor = weight * _dot(dual, y)
            for i, x in u.items():
                y[i] = y.get(i, 0.0) + factor * x

    def least(self, rate: Any, rows: int | None = None) -> Any:
        """Return the least y with Bᵀ y = rate, of all columns or of the first ones."""
        z = self._coordinates(rate, self._m if rows is None else rows)
        return self._back(dict(zip(self._pivots, z, strict=False)), len(z), rate.shape[1])

    def held(self, free: Any, rate: Any) -> tuple[Any, Any]:
        """Return the y nearest to `free` with Bᵀ y = rate, and λ with y = free + B λ; columns (n, k) and (m, k).

        In a metric G it is Bᵀ G y.
        """
        z, y = self._coordinates(rate, self._m), self._turned(free)
        weights = self.weights([a - y.get(p, 0.0) for a, p in zip(z, self._pivots, strict=True)])
        # Columns that fill the space leave nothing of it but rounding.
        y = y if self._m < self._n else {}
        return self._back(y | dict(zip(self._pivots, z, strict=True)), self._m, rate.shape[1]), weights

    def balanced(self, f: Any, which: list[int]) -> tuple[Any, Any, list[Any]]:
        """Return the least f - B λ whose entries `which` are zero, λ, and how far B's rows `which` determine it.

        With μ = R λ it is f - Q μ: of the μ with the rows of Q μ = f the nearest to Qᵀ f. The last are squares of the
        parts of these rows beside those before, of one at most.
        """
        y = self._turned(f)
        mu, rows = ca.vertcat(ca.SX(0, 1), *(y.get(p, ca.SX(1, 1)) for p in self._pivots)), self._B[which, :]
        shares = ca.vertcat(ca.SX(0, len(which)), *self._coordinates(rows.T, self._m))
        own = OrthogonalColumns(shares, self._metric)
        mu, _ = own.held(mu, f[which])
        parts = [scalar(mu[i]) for i in range(self._m)]
        left = f - self._back(dict(zip(self._pivots, parts, strict=True)), self._m, 1)
        # It vanishes up to rounding.
        left[which] = 0.0
        return left, self.weights(parts), own.remainders

    def weights(self, z: list[Any]) -> Any:
        """Return λ with R λ = z."""
        left, out = [*z], [ca.SX(0.0)] * self._m
        for j in reversed(range(self._m)):
            out[j] = left[j] * self._inverse[j]
            for i, r in self._R[j].items():
                left[i] = left[i] - r * out[j]
        return ca.vertcat(*out)

    def _turned(self, y: Any) -> dict[int, Any]:
        """Return the entries of the reflections of y, (n, k); those at the pivots are Qᵀ y."""
        out = {i: scalar(y[i, :]) for i in range(self._n)}
        for j in range(self._m):
            self._reflect(j, out)
        return out

    def _coordinates(self, rate: Any, rows: int) -> list[Any]:
        """Return R^-ᵀ rate over the metric."""
        out: list[Any] = []
        for j in range(rows):
            known = sum((r * out[i] for i, r in self._R[j].items()), 0.0)
            out.append((scalar(rate[j, :]) - known) * self._inverse[j])
        return [x * scale for x, scale in zip(out, self._scales, strict=False)]

    def _back(self, y: dict[int, Any], rows: int, k: int) -> Any:
        """Return Q y, (n, k)."""
        for j in reversed(range(rows)):
            self._reflect(j, y)
        return ca.vertcat(ca.SX(0, k), *(y.get(i, ca.SX(1, k)) for i in range(self._n)))


def _dot(a: dict[int, Any], b: dict[int, Any]) -> Any:
    # In two sums: in one, each product waits for those before it.
    terms = [x * b[i] for i, x in a.items() if i in b]
    return sum(terms[::2]) + sum(terms[1::2])
