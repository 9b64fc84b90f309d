"""An adaptive Rosenbrock step for stiff systems, as parts around the forward dynamics.

On the space of `mbkit.model.integration_space`, u̇ = r(u, w) and ẇ = k(u, w) around the state (q, w), u = 0. With
g = γ h, and r_i, k_i of stage i at what the stages before it lead to, a stage (u_i, w_i) solves ::

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
from typing import Any

import casadi as ca

from mbkit._check import Array
from mbkit.derivation.equations import Equations
from mbkit.derivation.steps.adaptive import AttemptParts
from mbkit.derivation.steps.fixed import Part, SymbolicStages, function_of
from mbkit.derivation.steps.symbols import SYMBOLS, SymbolicSpace
from mbkit.methods.one_step import elementary_factors, with_defect
from mbkit.methods.tableaus import RosenbrockTableau


def rosenbrock_parts(equations: Equations, tableau: RosenbrockTableau) -> list[Part]:
    """Return the parts of one attempt of a method of order 5 with one of order 4 inside, in order.

    They read and write what those of `mbkit.derivation.steps.adaptive` do; time does not enter. The parts "field" and
    "solve" stand once for each stage, "field" at the end too; it writes k = ẇ and r = u̇.
    """
    parts, nv = AttemptParts(equations), equations.model.nv
    s, space = parts.symbols, _Space(equations.model)
    s |= {name: ca.SX.sym(name, nv) for name in ("k", "r", "sum_u", "sum_w")}
    gamma, stages, increments = tableau.gamma, SymbolicStages(nv), dict[str, Any]()
    linear: list[tuple[Any, Any, Any]] = []

    def system() -> tuple[Any, Any, Any]:
        if not linear:
            linear.append(_linear_system(equations, space, s["q"], s["w"], s["k"], s["tau"]))
        return linear[0]

    def matrix() -> ca.Function:
        M, D, K = system()
        g = gamma * s["step"]
        pull = g * ca.mtimes(K, space.spun(s["w"], g))
        factors = Factors.of(M + g * D + g * pull, equations.elimination_order)
        results = {"mass": _entries(M), "pull": _entries(pull), "factors": ca.vertcat(*factors.values)}
        return function_of(
            "matrix", {**parts.named("q", "w", "k", "tau", "step"), **equations.extra_arguments}, results
        )

    solved = ("w", "k", "r", "sum_u", "sum_w", "step")

    def solve() -> ca.Function:
        M, D, K = system()
        g = gamma * s["step"]
        spun = space.spun(s["w"], g)
        pattern = ca.mtimes(K, spun)
        factors = Factors.of(M + D + pattern, equations.elimination_order)
        # Symbols with the same zeros.
        sizes = {"mass": M.nnz(), "pull": pattern.nnz(), "factors": len(factors.values)}
        known = {name: ca.SX.sym(name, n) for name, n in sizes.items()}
        a, b = g * s["r"] + gamma * s["sum_u"], g * s["k"] + gamma * s["sum_w"]
        pulled = ca.mtimes(ca.SX(pattern.sparsity(), known["pull"]), a)
        dw = factors.applied(ca.vertsplit(known["factors"]), ca.mtimes(ca.SX(M.sparsity(), known["mass"]), b) - pulled)
        return function_of("solve", {**parts.named(*solved), **known}, {"du": ca.mtimes(spun, a + g * dw), "dw": dw})

    def go(name: str, weights: Array, more: dict[str, Any]) -> None:
        u, dw = stages.sums(weights)
        results = {"q_i": parts.space.retract(s["q"], u), "w_i": s["w"] + dw, "u_i": u, **more}
        parts.add(name, {**parts.named("q", "w"), **increments}, results)

    parts.begin()
    parts.add("sums", parts.named("w"), {"sum_u": 0 * s["w"], "sum_w": 0 * s["w"]})
    for i in range(tableau.stages):
        if i:
            sum_u, sum_w = stages.sums(tableau.C[i, :i])
            go(f"stage_{i}", tableau.A[i, :i], {"sum_u": sum_u, "sum_w": sum_w})
        parts.add_field("k", "r")
        if not i:
            reads = ("q", "w", "k", "tau", "step", *equations.extra_arguments)
            parts.parts.append(Part("matrix", reads, ("mass", "pull", "factors"), matrix))
        stage = {name: ca.SX.sym(name, nv) for name in (f"du_{i}", f"dw_{i}")}
        parts.parts.append(Part("solve", (*solved, "mass", "pull", "factors"), tuple(stage), solve))
        increments |= stage
        stages.append(*stage.values())
    go("arrive", tableau.b, {})
    parts.add_field("k", "r")
    q1, w1, u = parts.at.values()
    by_u, by_w = parts.scales(q1, w1, u)

    def norm(in_u: Any, in_w: Any) -> Any:
        return ca.sqrt((ca.sumsqr(in_w / by_w) + ca.sumsqr(in_u / by_u)) / (2 * nv))

    # The slope of the polynomial at the end, times the step.
    slope_u, slope_w = stages.sums(tableau.b - tableau.dense.sum(axis=0))
    defect = norm(s["step"] * s["r"] - slope_u, s["step"] * s["k"] - slope_w)
    error = with_defect(SYMBOLS, norm(*stages.sums(tableau.error)), defect)
    rates = {**parts.at, **parts.named("k", "r"), **increments}
    parts.decide(rates, q1, w1, error, elementary_factors(SYMBOLS, error, s["last"]))
    return parts.parts


class _Space(SymbolicSpace):
    def spun(self, w: Any, g: Any) -> Any:
        """Return S: 1 on plain coordinates, and on a rotation (1 + g ŵ/2)⁻¹."""
        out = ca.SX.eye(self.nv)
        for _, b in self._turns:
            # Of dexp⁻¹(u) w the part linear in u is ½ u × w.
            x = (g / 2) * w[b]
            out[b, b] = (ca.SX.eye(3) - ca.skew(x) + ca.mtimes(x, x.T)) / (1 + ca.sumsqr(x))
        return out


def _linear_system(eq: Equations, space: SymbolicSpace, q: Any, w: Any, k: Any, force: Any) -> tuple[Any, Any, Any]:
    """Return M, D and K at a state, without entries that are zeros after all."""
    u, a = ca.SX.sym("u", eq.model.nv), ca.SX.sym("a", eq.model.nv)
    v, moved = space.to_body_velocity(q, w), space.retract(q, u)
    by_w = ca.jacobian(v, w)
    # v̇ of ẇ: the axes may turn below it.
    qdot = ca.substitute(eq.kin.qdot, ca.vertcat(eq.q, eq.v), ca.vertcat(q, v))
    rate = ca.mtimes(by_w, k) + ca.jtimes(v, q, qdot)
    there = space.to_body_velocity(moved, w)
    rest = eq.function("inverse_dynamics")(moved, there, a, *eq.extra_arguments.values()) - eq.applied(moved, force)
    led = space.acceleration(moved, there, a)
    M = ca.mtimes(ca.substitute(eq.mass_matrix, eq.q, q), by_w)
    K = ca.jacobian(rest, u) - ca.mtimes(M, ca.jacobian(led, u))
    D = ca.jacobian(rest, w) - ca.mtimes(M, ca.jacobian(led, w))
    at = ca.vertcat(u, a), ca.vertcat(ca.SX.zeros(eq.model.nv), rate)
    K, D = (ca.sparsify(ca.substitute(x, *at)) for x in (K, D))
    return ca.sparsify(M), D, K


def _entries(A: Any) -> Any:
    return ca.vertcat(ca.SX(0, 1), *A.nonzeros())


@dataclass(frozen=True)
class Factors:
    """Factors of a matrix with the zeros of a tree's mass matrix, eliminated from the leaves to the root.

    There is no fill-in and no pivoting.
    """

    # The factors of `steps`, the entries of `rest`, and the pivots' inverses.
    values: list[Any]
    # (i, k): row i loses a multiple of row k, in this order.
    steps: list[tuple[int, int]]
    # (k, j): the remainder of row k before its pivot.
    rest: list[tuple[int, int]]
    # Of each coordinate its row.
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
        ahead = len(self.steps)
        x: list[Any] = [None] * len(self.rows)
        for index, row in enumerate(self.rows):
            x[row] = b[index]
        for factor, (i, k) in zip(values[:ahead], self.steps, strict=True):
            x[i] = x[i] - factor * x[k]
        inverses = values[ahead + len(self.rest) :]
        behind = dict(zip(self.rest, values[ahead : ahead + len(self.rest)], strict=True))
        for k, inverse in enumerate(inverses):
            done = [entry * x[j] for (row, j), entry in behind.items() if row == k]
            x[k] = (x[k] - sum(done, 0.0)) * inverse
        return ca.vertcat(ca.SX(0, 1), *(x[row] for row in self.rows))
