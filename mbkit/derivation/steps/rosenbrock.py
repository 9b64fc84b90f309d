"""An adaptive Rosenbrock step for stiff systems, as parts around the forward dynamics.

On the space of `mbkit.model.integration_space`, u̇ = r(u, w) and ẇ = k(u, w) around the state (q, w), u = 0. With g = γ
h, and
r_i, k_i of stage i at what the stages before it lead to, a stage (u_i, w_i) solves ::

    u_i - g (L u_i + w_i) = g r_i + γ Σ C_ij u_j        L = ∂r/∂u
    w_i - g (∂k/∂u u_i + ∂k/∂w w_i) = g k_i + γ Σ C_ij w_j

k is never differentiated. From F(u, w, k) = 0, inverse dynamics less the applied force, follow M = ∂F/∂k,
K = ∂F/∂u and D = ∂F/∂w, and with u_i eliminated, S = (1 - g L)⁻¹ and the right-hand sides a and b ::

    (M + g D + g² K S) w_i = M b - g K S a        u_i = S (a + g w_i)

The matrix has the zeros of the tree's mass matrix: it is factorized once a step, from the leaves to the root, without
fill-in and without pivoting. Where that meets a zero, the error is no number and the step is tried again, shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca

from mbkit._check import Array
from mbkit.derivation.equations import Equations
from mbkit.derivation.steps.adaptive import AttemptParts
from mbkit.derivation.steps.fixed import SYMBOLS, Part, SymbolicSpace, SymbolicStages, function_of
from mbkit.methods.one_step import elementary_factors, with_defect
from mbkit.methods.tableaus import RosenbrockTableau


def rosenbrock_parts(equations: Equations, tableau: RosenbrockTableau) -> tuple[Part, ...]:
    """Return the parts of one attempt, in order.

    Parameters
    ----------
    equations : Equations
        In which time does not enter.
    tableau : RosenbrockTableau
        Of order 5 with one of order 4 inside.

    Returns
    -------
    tuple of Part
        They read and write what those of `mbkit.derivation.steps.adaptive` do. The parts
        "field" and "solve" stand once for each stage, "field" at the end too; it writes k = ẇ and r = u̇.
    """
    parts = _Parts(equations, tableau)
    parts.begin()
    for i in range(tableau.stages):
        if i:
            parts.add_stage(i)
        parts.add_field("k", "r")
        if not i:
            parts.add_matrix()
        parts.add_solve(i)
    parts.arrive()
    parts.add_field("k", "r")
    parts.end()
    return tuple(parts.parts)


class _Space(SymbolicSpace):
    def spun(self, w: Any, g: Any) -> Any:
        """Return S: 1 on plain coordinates, and on a rotation (1 + g ŵ/2)⁻¹."""
        out = ca.SX.eye(self.nv)
        for _, b in self._turns:
            # Of dexp⁻¹(u) w the part linear in u is ½ u × w.
            x = (g / 2) * w[b]
            out[b, b] = (ca.SX.eye(3) - ca.skew(x) + ca.mtimes(x, x.T)) / (1 + ca.sumsqr(x))
        return out


class _Parts(AttemptParts):
    def __init__(self, equations: Equations, tableau: RosenbrockTableau) -> None:
        super().__init__(equations)
        nv = equations.model.nv
        self._tableau, self._gamma, self._rotating = tableau, tableau.gamma, _Space(equations.model)
        self.symbols |= {name: ca.SX.sym(name, nv) for name in ("k", "r", "sum_u", "sum_w")}
        self._stages, self._increments = SymbolicStages(nv), dict[str, Any]()

    def begin(self) -> None:
        """Choose the length of the step; the first stage is where the state is."""
        super().begin()
        w = self.named("w")
        self.add("sums", w, {"sum_u": 0 * w["w"], "sum_w": 0 * w["w"]})

    # The linear system

    @cached_property
    def _linear(self) -> tuple[Any, Any, Any]:
        """M, D and K at the state, as expressions of q, w and k there."""
        eq, space, s = self._equations, self.space, self.symbols
        q, w, k = s["q"], s["w"], s["k"]
        trailing = list(eq.trailing.values())
        u = ca.SX.sym("u", eq.model.nv)
        v, moved = space.leave(q, w), space.move(q, u)
        by_w = ca.jacobian(v, w)
        # v̇ of ẇ: the axes may turn below it.
        qdot = ca.substitute(eq.kin.qdot, ca.vertcat(eq.q, eq.v), ca.vertcat(q, v))
        rate = ca.mtimes(by_w, k) + ca.jtimes(v, q, qdot)
        a = ca.SX.sym("a", eq.model.nv)
        there = space.leave(moved, w)
        force = eq.function("inverse_dynamics")(moved, there, a, *trailing)
        led = space.acceleration(moved, there, a)
        M = ca.mtimes(ca.substitute(eq.mass_matrix, eq.q, q), by_w)
        K = ca.jacobian(force, u) - ca.mtimes(M, ca.jacobian(led, u))
        D = ca.jacobian(force, w) - ca.mtimes(M, ca.jacobian(led, w))
        at = ca.vertcat(u, a), ca.vertcat(ca.SX.zeros(eq.model.nv), rate)
        K, D = (_pruned(ca.substitute(x, *at)) for x in (K, D))
        return _pruned(M), D, K

    def add_matrix(self) -> None:
        """Form the linear system at the state and factorize it."""
        g = self._gamma * self.symbols["step"]
        arguments = {**self.named("q", "w", "k", "step"), **self._equations.trailing}

        def make() -> ca.Function:
            M, D, K = self._linear
            pull = g * ca.mtimes(K, self._rotating.spun(self.symbols["w"], g))
            factors = Factors.of(M + g * D + g * pull, self._equations.elimination_order)
            results = {"mass": _entries(M), "pull": _entries(pull), "factors": ca.vertcat(*factors.values)}
            return function_of("matrix", arguments, results)

        self.parts.append(Part("matrix", tuple(arguments), ("mass", "pull", "factors"), make))

    def add_solve(self, i: int) -> None:
        """Solve for stage i."""
        names = ("w", "k", "r", "sum_u", "sum_w", "step")

        def make() -> ca.Function:
            s, g = self.symbols, self._gamma * self.symbols["step"]
            M, D, K = self._linear
            spun = self._rotating.spun(s["w"], g)
            pattern = ca.mtimes(K, spun)
            factors = Factors.of(M + D + pattern, self._equations.elimination_order)
            # Symbols with the same zeros.
            mass, pull = ca.SX.sym("mass", M.nnz()), ca.SX.sym("pull", pattern.nnz())
            known = ca.SX.sym("factors", len(factors.values))
            a, b = g * s["r"] + self._gamma * s["sum_u"], g * s["k"] + self._gamma * s["sum_w"]
            right = ca.mtimes(ca.SX(M.sparsity(), mass), b) - ca.mtimes(ca.SX(pattern.sparsity(), pull), a)
            dw = factors.applied(ca.vertsplit(known), right)
            du = ca.mtimes(spun, a + g * dw)
            arguments = {**self.named(*names), "mass": mass, "pull": pull, "factors": known}
            return function_of("solve", arguments, {"du": du, "dw": dw})

        nv = self._equations.model.nv
        increments = {name: ca.SX.sym(name, nv) for name in (f"du_{i}", f"dw_{i}")}

        self.parts.append(Part("solve", (*names, "mass", "pull", "factors"), tuple(increments), make))
        self._increments |= increments
        self._stages.append(*increments.values())

    # Stages and the end

    def add_stage(self, i: int) -> None:
        """Go to where stage i is evaluated."""
        sum_u, sum_w = self._stages.sums(self._tableau.C[i, :i])
        self._go(f"stage_{i}", self._tableau.A[i, :i], {"sum_u": sum_u, "sum_w": sum_w})

    def arrive(self) -> None:
        """Form the new state, where the rates are evaluated too."""
        self._go("arrive", self._tableau.b, {})

    def _go(self, name: str, weights: Array, more: dict[str, Any]) -> None:
        arguments = {**self.named("q", "w"), **self._increments}
        u, dw = self._stages.sums(weights)
        results = {"q_i": self.space.move(arguments["q"], u), "w_i": arguments["w"] + dw, "u_i": u}
        self.add(name, arguments, results | more)

    def end(self) -> None:
        """Estimate the error of the new state, and decide."""
        s, step, own = self.symbols, self.symbols["step"], self._tableau
        q1, w1, u = self.at["q_i"], self.at["w_i"], self.at["u_i"]
        by_u, by_w = self.scales(q1, w1, u)

        def norm(in_u: Any, in_w: Any) -> Any:
            return ca.sqrt((ca.sumsqr(in_w / by_w) + ca.sumsqr(in_u / by_u)) / (2 * self._equations.model.nv))

        # The slope of the polynomial at the end, times the step.
        slope_u, slope_w = self._stages.sums(own.b - own.dense.sum(axis=0))
        defect = norm(step * s["r"] - slope_u, step * s["k"] - slope_w)
        error = with_defect(SYMBOLS, norm(*self._stages.sums(own.error)), defect)
        rates = {**self.at, **self.named("k", "r"), **self._increments}
        self.decide(rates, q1, w1, error, elementary_factors(SYMBOLS, error, s["last"]))


def _pruned(A: Any) -> Any:
    """Return the matrix without entries that are zeros after all."""
    return ca.sparsify(A)


def _entries(A: Any) -> Any:
    return ca.vertcat(ca.SX(0, 1), *A.nonzeros())


@dataclass(frozen=True)
class Factors:
    """Factors of a matrix with the zeros of a tree's mass matrix, eliminated from the leaves to the root.

    There is no fill-in and no pivoting.

    Attributes
    ----------
    values : list of casadi.SX
    steps : list of (i, k)
        Row i loses a multiple of row k, in this order; the first values are the factors.
    rest : list of (k, j)
        What is left in row k before its pivot; the next values. The pivots' inverses come last.
    rows : tuple of int
        Of each coordinate its row.
    """

    values: list[Any]
    steps: list[tuple[int, int]]
    rest: list[tuple[int, int]]
    rows: tuple[int, ...]

    @classmethod
    def of(cls, A: Any, order: Sequence[int]) -> Factors:
        """Return the factors of a matrix; `order` has every parent before its children."""
        rank = {index: k for k, index in enumerate(order)}
        rows: list[dict[int, Any]] = [{} for _ in rank]
        for i, j in zip(*A.sparsity().get_triplet(), strict=True):
            rows[rank[i]][rank[j]] = A[i, j]
        factors: list[Any] = []
        steps: list[tuple[int, int]] = []
        inverses: list[Any] = [None] * len(rows)
        for k in reversed(range(len(rows))):
            # Where nothing moves there is no entry at all: the quotient is then no number.
            inverses[k] = 1 / ca.SX(rows[k].pop(k, 0.0))
            for i in range(k):
                if k not in rows[i]:
                    continue
                factors.append(rows[i].pop(k) * inverses[k])
                steps.append((i, k))
                for j, entry in rows[k].items():
                    if j < k:
                        rows[i][j] = rows[i].get(j, 0.0) - factors[-1] * entry
        rest = [(k, j) for k, row in enumerate(rows) for j in row]
        values = [*factors, *(rows[k][j] for k, j in rest), *inverses]
        return cls(values, steps, rest, tuple(rank[index] for index in range(len(rank))))

    def applied(self, values: Sequence[Any], b: Any) -> Any:
        """Return the solution for a right-hand side."""
        n = len(self.rows)
        x: list[Any] = [None] * n
        for index, row in enumerate(self.rows):
            x[row] = b[index]
        ahead = len(self.steps)
        for factor, (i, k) in zip(values[:ahead], self.steps, strict=True):
            x[i] = x[i] - factor * x[k]
        inverses = values[ahead + len(self.rest) :]
        behind = dict(zip(self.rest, values[ahead : ahead + len(self.rest)], strict=True))
        for k in range(n):
            done = [entry * x[j] for (row, j), entry in behind.items() if row == k]
            x[k] = (x[k] - sum(done, 0.0)) * inverses[k]
        return ca.vertcat(ca.SX(0, 1), *(x[row] for row in self.rows))
