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
from mbkit.derivation.steps.adaptive import AdaptiveParts
from mbkit.derivation.steps.fixed import Part, SymbolicSpace, choose, function_of
from mbkit.methods.step_control import DEFECT, GROWTH, SAFETY

__all__ = ["rosenbrock_parts"]


def rosenbrock_parts(
    equations: Equations, gamma: float, A: Array, C: Array, b: Array, error: Array, dense: Array
) -> tuple[Part, ...]:
    """Return the parts of one try, in order.

    Parameters
    ----------
    equations : Equations
        In which time does not enter.
    gamma : float
    A, C, b, error, dense : (s, s), (s, s), (s,), (s,) and (3, s) arrays
        Of a method of order 5 with one of order 4 inside, as in `mbkit.methods.tableaus`.

    Returns
    -------
    tuple of Part
        They read and write what those of `mbkit.derivation.steps.adaptive` do. The parts
        "field" and "solve" stand once for each stage, "field" at the end too; it writes k = ẇ and r = u̇.
    """
    stages = _Stages(equations, gamma, len(b))
    stages.begin()
    for i in range(len(b)):
        if i:
            stages.stage(i, A[i, :i], C[i, :i])
        stages.field()
        if not i:
            stages.matrix()
        stages.solve(i)
    stages.arrive(b)
    stages.field()
    stages.end(b, error, dense)
    return tuple(stages.parts)


class _Space(SymbolicSpace):
    def spun(self, w: Any, g: Any) -> Any:
        """Return S: 1 on plain coordinates, and on a rotation (1 + g ŵ/2)⁻¹."""
        out = ca.SX.eye(self.nv)
        for _, b in self._turns:
            # Of dexp⁻¹(u) w the part linear in u is ½ u × w.
            x = (g / 2) * w[b]
            out[b, b] = (ca.SX.eye(3) - ca.skew(x) + ca.mtimes(x, x.T)) / (1 + ca.sumsqr(x))
        return out


class _Stages(AdaptiveParts):
    def __init__(self, equations: Equations, gamma: float, count: int) -> None:
        super().__init__(equations)
        nv = equations.model.nv
        self._gamma, self._rotating = gamma, _Space(equations.model)
        self._s |= {name: ca.SX.sym(name, nv) for name in ("k", "r", "sum_u", "sum_w")}
        self._solved = [(ca.SX.sym(f"du_{i}", nv), ca.SX.sym(f"dw_{i}", nv)) for i in range(count)]

    def _named(self, count: int) -> dict[str, Any]:
        pairs = enumerate(self._solved[:count])
        return {f"{kind}_{i}": x for i, pair in pairs for kind, x in zip(("du", "dw"), pair, strict=True)}

    def begin(self) -> None:
        """Settle the length of the step; the first stage is where the state is."""
        super().begin()
        w = self._given("w")
        self._part("sums", w, {"sum_u": 0 * w["w"], "sum_w": 0 * w["w"]})

    def field(self) -> None:
        """Evaluate the rates where the stage is."""
        self._field("k", "r")

    # The linear system

    @cached_property
    def _linear(self) -> tuple[Any, Any, Any]:
        """M, D and K at the state, as expressions of q, w and k there."""
        eq, space, s = self._equations, self._space, self._s
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

    def matrix(self) -> None:
        """Form the linear system at the state and factorize it."""
        g = self._gamma * self._s["step"]

        def make() -> ca.Function:
            M, D, K = self._linear
            pull = g * ca.mtimes(K, self._rotating.spun(self._s["w"], g))
            factors = _factorized(M + g * D + g * pull, self._equations.elimination_order)
            made = {"mass": _entries(M), "pull": _entries(pull), "factors": ca.vertcat(*factors.values)}
            return function_of("matrix", given, made)

        given = {**self._given("q", "w", "k", "step"), **self._equations.trailing}
        self.parts.append(Part("matrix", tuple(given), ("mass", "pull", "factors"), make))

    def solve(self, i: int) -> None:
        """Solve for stage i."""
        names = ("w", "k", "r", "sum_u", "sum_w", "step")

        def make() -> ca.Function:
            s, g = self._s, self._gamma * self._s["step"]
            M, D, K = self._linear
            spun = self._rotating.spun(s["w"], g)
            pattern = ca.mtimes(K, spun)
            factors = _factorized(M + D + pattern, self._equations.elimination_order)
            held = {"mass": _held(M, "mass"), "pull": _held(pattern, "pull")}
            # Of the same zeros, whatever the numbers.
            known = ca.SX.sym("factors", len(factors.values))
            a, b = g * s["r"] + self._gamma * s["sum_u"], g * s["k"] + self._gamma * s["sum_w"]
            right = ca.mtimes(held["mass"][0], b) - ca.mtimes(held["pull"][0], a)
            dw = factors.applied(ca.vertsplit(known), right)
            du = ca.mtimes(spun, a + g * dw)
            given = {**self._given(*names), **{name: column for name, (_, column) in held.items()}, "factors": known}
            return function_of("solve", given, {"du": du, "dw": dw})

        self.parts.append(Part("solve", (*names, "mass", "pull", "factors"), (f"du_{i}", f"dw_{i}"), make))

    # Stages and the end

    def _sum(self, weights: Array) -> tuple[Any, Any]:
        totals = []
        for kind in (0, 1):
            total = ca.SX.zeros(self._equations.model.nv)
            for weight, pair in zip(weights.tolist(), self._solved, strict=False):
                if weight:
                    total = total + weight * pair[kind]
            totals.append(total)
        return totals[0], totals[1]

    def stage(self, i: int, places: Array, sums: Array) -> None:
        """Go to where stage i is evaluated."""
        given = {**self._given("q", "w"), **self._named(i)}
        u, dw = self._sum(places)
        sum_u, sum_w = self._sum(sums)
        made = {"q_i": self._space.move(given["q"], u), "w_i": given["w"] + dw, "u_i": u}
        self._part(f"stage_{i}", given, made | {"sum_u": sum_u, "sum_w": sum_w})

    def arrive(self, b: Array) -> None:
        """Form the new state, where the rates are looked at too."""
        given = {**self._given("q", "w"), **self._named(len(b))}
        u, dw = self._sum(b)
        made = {"q_i": self._space.move(given["q"], u), "w_i": given["w"] + dw, "u_i": u}
        self._part("arrive", given, made)

    def end(self, b: Array, error: Array, dense: Array) -> None:
        """Estimate the error of the new state, and decide."""
        s, step = self._s, self._s["step"]
        q1, w1, u = self._at["q_i"], self._at["w_i"], self._at["u_i"]
        by_w, by_u = self._scales(q1, w1, u)

        def norm(in_u: Any, in_w: Any) -> Any:
            return ca.sqrt((ca.sumsqr(in_w / by_w) + ca.sumsqr(in_u / by_u)) / (2 * self._equations.model.nv))

        # The slope of the polynomial at the end, times the step.
        slope_u, slope_w = self._sum(b - dense.sum(axis=0))
        defect = norm(step * s["r"] - slope_u, step * s["k"] - slope_w) / DEFECT
        found = norm(*self._sum(error))
        # NaN is chosen where it is one of the two.
        worst = choose(found < defect, defect, found) + 0 * defect
        self._decide({**self._at, **self._given("k", "r"), **self._named(len(b))}, q1, w1, worst)

    def _factors(self, error: Any) -> tuple[Any, Any, Any]:
        eighth = ca.sqrt(ca.sqrt(ca.sqrt(error)))
        sixteenth = ca.sqrt(eighth)
        # Error to the power of -3/16, near the fifth root that its order asks for.
        under = eighth * sixteenth
        factor = choose(GROWTH * under < SAFETY, GROWTH, SAFETY / under)
        return factor, SAFETY / under, ca.sqrt(sixteenth)


def _pruned(A: Any) -> Any:
    """Return the matrix without entries that are zeros after all."""
    return ca.sparsify(A)


def _entries(A: Any) -> Any:
    return ca.vertcat(ca.SX(0, 1), *A.nonzeros())


def _held(A: Any, name: str) -> tuple[Any, Any]:
    """Return a matrix of symbols with the same zeros, and the column of them."""
    column = ca.SX.sym(name, A.nnz())
    return ca.SX(A.sparsity(), column), column


@dataclass(frozen=True)
class _Factors:
    """What eliminating leaves behind: numbers, and where they belong.

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


def _factorized(A: Any, order: Sequence[int]) -> _Factors:
    """Return the factors of a matrix with the zeros of a tree's mass matrix, leaves first."""
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
    return _Factors(values, steps, rest, tuple(rank[index] for index in range(len(rank))))
