"""An adaptive Rosenbrock step for stiff systems, as parts around the forward dynamics.

On the space of `mbkit.model.integration_space`, u̇ = r(u, w) and ẇ = k(u, w) around the state (q, w), u = 0. With
g = γ h, and r_i, k_i of stage i at what the stages before it lead to, a stage (u_i, w_i) solves ::

    u_i - g (L u_i + w_i) = g r_i + γ Σ C_ij u_j        L = ∂r/∂u
    w_i - g (∂k/∂u u_i + ∂k/∂w w_i) = g k_i + γ Σ C_ij w_j

k is never differentiated. From F(u, w, k) = 0, inverse dynamics less the applied force, follow M = ∂F/∂k,
K = ∂F/∂u and D = ∂F/∂w, and with u_i eliminated, S = (1 - g L)⁻¹ and the right-hand sides a and b ::

    (M + g D + g² K S) w_i = M b - g K S a        u_i = S (a + g w_i)

Under constraints F has the force -Jᵀ λ too, whose λ joins the unknowns, and the rows J v̇ + γ = 0. They are
differentiated like F, with λ held: of these rows M is J, and D and K have the index c ::

    (M + g D + g² K S) w_i - Jᵀ μ_i = M b - g K S a        (J + g D_c + g² K_c S) w_i = J b - g K_c S a

The first matrix has the zeros of the tree's mass matrix but for those that Jᵀ λ fills in: it is factorized once a step,
from the leaves to the root, without pivoting, and the constraints' part after it. Where that meets a zero, the error is
no number and the step is tried again, shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

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

    @cache
    def system() -> _StageSystem:
        return _StageSystem(equations, space, s, gamma)

    def matrix() -> ca.Function:
        given = {**parts.named("q", "w", "k", "tau", "step"), **equations.extra_arguments}
        return function_of("matrix", given, system().results)

    solved = ("w", "k", "r", "sum_u", "sum_w", "step")

    def solve() -> ca.Function:
        known = {name: ca.SX.sym(name, x.numel()) for name, x in system().results.items()}
        g = gamma * s["step"]
        a, b = g * s["r"] + gamma * s["sum_u"], g * s["k"] + gamma * s["sum_w"]
        dw = system().solution(a, b, **known)
        du = ca.mtimes(space.spun(s["w"], g), a + g * dw)
        return function_of("solve", {**parts.named(*solved), **known}, {"du": du, "dw": dw})

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
            parts.parts.append(Part("matrix", reads, _StageSystem.NAMES, matrix))
        stage = {name: ca.SX.sym(name, nv) for name in (f"du_{i}", f"dw_{i}")}
        parts.parts.append(Part("solve", (*solved, *_StageSystem.NAMES), tuple(stage), solve))
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
    if equations.model.constrained:
        q1, w1, error = parts.onto_constraints(q1, w1, error)
    rates = {**parts.at, **parts.named("k", "r"), **increments}
    parts.decide(rates, q1, w1, error, elementary_factors(SYMBOLS, error, s["last"]))
    return parts.parts


class _Space(SymbolicSpace):
    def spun(self, w: Any, g: Any) -> Any:
        """Return S: 1 on plain coordinates, and on a rotation (1 + g ŵ/2)⁻¹."""
        out = ca.SX.eye(self.nv)
        for _, b in self._turns:
            # The linear part of dexp⁻¹(u) w is ½ u × w.
            x = (g / 2) * w[b]
            out[b, b] = (ca.SX.eye(3) - ca.skew(x) + ca.mtimes(x, x.T)) / (1 + ca.sumsqr(x))
        return out


class _StageSystem:
    """The linear system of a step's stages: `results` are its entries and factors at the start, as columns by name."""

    NAMES: Final = ("mass", "pull", "factors", "rows")

    def __init__(self, eq: Any, space: _Space, symbols: dict[str, Any], gamma: float) -> None:
        w, g, nv = symbols["w"], gamma * symbols["step"], eq.model.nv
        M, D, K, self._transposed = _linear_system(eq, space, symbols["q"], w, symbols["k"], symbols["tau"])
        self._mass, self._pull = M, g * ca.mtimes(K, space.spun(w, g))
        whole = M + g * D + g * self._pull
        A, self._rows = whole[:nv, :], whole[nv:, :]
        # A multiple of the rows, which the right-hand side takes back; without it a link without mass has no pivot.
        self._stiff = ca.SX(nv, 0)
        if eq.model.constrained and eq.constraint_factors.careful:
            s = ca.substitute(eq.constraints.stiffening(eq.mass_matrix), eq.q, symbols["q"])
            self._stiff = ca.sparsify(ca.mtimes(self._transposed, ca.diag(s)))
            A = A + ca.mtimes(self._stiff, self._rows)
        self._tree = Factors.of(A, eq.elimination_order)
        many = [self._tree.applied(self._tree.values, x) for x in ca.horzsplit(self._transposed)]
        self._responses = ca.sparsify(ca.horzcat(ca.SX(nv, 0), *many))
        held = ca.sparsify(ca.mtimes(self._rows, self._responses))
        self._constraint_factors = Factors.of(held, range(held.shape[0]))
        factors = ca.vertcat(ca.SX(0, 1), *self._tree.values, *self._constraint_factors.values)
        rows = ca.vertcat(*map(_entries, (self._rows, self._responses, self._stiff)))
        columns = (_entries(self._mass), _entries(self._pull), factors, rows)
        self.results = dict(zip(self.NAMES, columns, strict=True))

    def solution(self, a: Any, b: Any, mass: Any, pull: Any, factors: Any, rows: Any) -> Any:
        """Return w_i for right-hand sides, from numbers in the place of `results`."""
        nv, matrices, first = len(self._tree.rows), [], 0
        for x in (self._rows, self._responses, self._stiff):
            matrices.append(ca.SX(x.sparsity(), rows[first : first + x.nnz()]))
            first += x.nnz()
        G, Y, stiff = matrices
        right = ca.mtimes(ca.SX(self._mass.sparsity(), mass), b) - ca.mtimes(ca.SX(self._pull.sparsity(), pull), a)
        force, rates = right[:nv], right[nv:]
        tree, held = (ca.vertsplit(x) for x in ca.vertsplit(factors, [0, len(self._tree.values), factors.numel()]))
        free = self._tree.applied(tree, force + ca.mtimes(stiff, rates) if stiff.nnz() else force)
        if not Y.nnz():
            return free
        return free + ca.mtimes(Y, self._constraint_factors.applied(held, rates - ca.mtimes(G, free)))


def _linear_system(eq: Any, space: SymbolicSpace, q: Any, w: Any, k: Any, force: Any) -> tuple[Any, Any, Any, Any]:
    """Return M, D and K at a state, with the constraints' rows below, and Jᵀ; without entries that are zeros."""
    u, a, extra = ca.SX.sym("u", eq.model.nv), ca.SX.sym("a", eq.model.nv), eq.extra_arguments.values()
    v, moved = space.to_body_velocity(q, w), space.retract(q, u)
    by_w = ca.jacobian(v, w)
    # v̇ of ẇ: the axes may turn below it.
    qdot = ca.substitute(eq.kin.qdot, ca.vertcat(eq.q, eq.v), ca.vertcat(q, v))
    rate = ca.mtimes(by_w, k) + ca.jtimes(v, q, qdot)
    there = space.to_body_velocity(moved, w)
    rest = eq.function("inverse_dynamics")(moved, there, a, *extra) - eq.applied(moved, force)
    M, columns, at = ca.substitute(eq.mass_matrix, eq.q, q), ca.SX(eq.model.nv, 0), [(u, 0 * u), (a, rate)]
    if eq.model.constrained:
        c = eq.constraints
        rows = ca.Function("rows", [eq.q, eq.v, *extra], [c.jacobian, c.gamma])
        here, (J, gamma) = rows(q, v, *extra)[0], rows(moved, there, *extra)
        multipliers = ca.SX.sym("multipliers", J.shape[0])
        at.append((multipliers, eq.function("independent_multipliers")(q, v, force, *extra)))
        rest = ca.vertcat(rest - ca.mtimes(J.T, multipliers), ca.mtimes(J, a) + gamma)
        M, columns = ca.vertcat(M, here), ca.sparsify(here.T)
    led = space.acceleration(moved, there, a)
    M = ca.mtimes(M, by_w)
    K = ca.jacobian(rest, u) - ca.mtimes(M, ca.jacobian(led, u))
    D = ca.jacobian(rest, w) - ca.mtimes(M, ca.jacobian(led, w))
    symbols, values = (ca.vertcat(*x) for x in zip(*at, strict=True))
    K, D = (ca.sparsify(ca.substitute(x, symbols, values)) for x in (K, D))
    return ca.sparsify(M), D, K, columns


def _entries(A: Any) -> Any:
    return ca.vertcat(ca.SX(0, 1), *A.nonzeros())


@dataclass(frozen=True)
class Factors:
    """Factors of a sparse matrix, eliminated from the last row of an order to the first, without pivoting.

    A matrix with the zeros of a tree's mass matrix is not filled in.
    """

    # The factors of `steps`, the entries of `rest`, and the pivots' inverses.
    values: list[Any]
    # (i, k): row i loses a multiple of row k, in this order.
    steps: list[tuple[int, int]]
    # (k, j): the remainder of row k before its pivot.
    rest: list[tuple[int, int]]
    # Row of each coordinate.
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
            # A coordinate that moves nothing has no entry: the quotient is then no number.
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
