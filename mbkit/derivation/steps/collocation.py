"""A step of an implicit Runge-Kutta method as parts around the inverse dynamics.

On the space of `mbkit.model.integration_space` the stages' unknowns are k_i = ẇ_i, on rotations r_i = u̇_i too, and
under constraints λ_i. With u_i = h Σ a_ij u̇_j and w_i = w0 + h Σ a_ij k_j they solve ::

    F(u_i, w_i, k_i) - Jᵀ λ_i = 0      r_i = dexp⁻¹(u_i) w_i      J v̇_i + γ = 0

with F inverse dynamics less the applied force at q0 ⊕ u_i: nothing is solved but Newton's system. Its derivatives are
exact, stage by stage. It is eliminated from the leaves to the root, without pivoting, all stages of a joint together:
so the tree fills in nothing. The multipliers come last. Under constraints the end is projected as in
`mbkit.derivation.steps.onto_constraints`.

Where a step is not solved, or is near a singular pose, it counts as missed: Python then runs the whole trajectory.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Final

import casadi as ca

from mbkit._check import TYPED, Array
from mbkit.derivation.equations import Equations
from mbkit.derivation.mass_matrix_solve import elimination_size
from mbkit.derivation.steps.fixed import Part, at_time, function_of
from mbkit.derivation.steps.midpoint import MAX_LAST_CORRECTION, MAX_LAST_MOVE, is_lost
from mbkit.derivation.steps.onto_constraints import dependence, nears_singular, thorough_projection
from mbkit.derivation.steps.rosenbrock import Factors
from mbkit.derivation.steps.symbols import SymbolicSpace, choose
from mbkit.methods.tableaus import ImplicitTableau, extrapolation_weights

#: Number of steps through whose stages the first guess of the next ones is continued.
_PAST_STEPS: Final = 2
#: Count of numbers of an unknown behind its stages.
_JUDGEMENTS: Final = 2
#: Largest ratio of corrections with which the iteration goes straight to the solution beside its guess (Kantorovich's
#: condition; Deuflhard 2011, Newton Methods for Nonlinear Problems, ch. 2.1).
_MAX_CONTRACTION: Final = 0.5


class Collocation:
    """The parts of a step from (q, w), with the names that `mbkit.simulate.solvers.machine_code` chains.

    An unknown x has all stages, one behind the other: k, then r of the rotations, then λ. Behind them stand the size of
    the last correction and the worst ratio of one to the one before: where Newton's iteration wanders from its guess it
    may end at another solution than the motion's, and is not believed.
    """

    carried = ("q", "w")
    #: The names of the unknowns of the last steps.
    past = ("x", *(f"x_{i}" for i in range(1, _PAST_STEPS)))
    #: The time that the parameters hold, in steps behind the start of one.
    clock = 0.0

    def __init__(self, equations: Equations, tableau: ImplicitTableau) -> None:
        self._equations, self._tableau, self._space = equations, tableau, _Space(equations.model)
        # Equations under constraints have more than `Equations`.
        eq: Any = equations
        s = tableau.stages
        self._stages, self._rows = s, eq.constraints.jacobian.shape[0] if eq.model.constrained else 0
        self._timed = eq.model.time_parameter is not None
        self._each = eq.model.nv + len(self._space.turning) + self._rows
        #: Entries of a step's unknown.
        self.unknowns = s * self._each + _JUDGEMENTS
        # A tableau of a user's own has no name but its numbers.
        self._prefix = f"{tableau.name}_{tableau.digest}"
        extra, timed = tuple(eq.extra_arguments), ("parameters",) if self._timed else ()
        spread = tuple(name for i in range(s) for name in self._at(i))
        stages, linear = [], tuple(name for i in range(s) for name in (f"residual_{i}", f"slopes_{i}"))
        for i in range(s):
            own = tuple(f"parameters_{i}" if name in timed else name for name in extra)
            reads = ("q", *self._at(i)[:3], "tau", *own)
            stages.append(Part("collocation_stage", reads, linear[2 * i : 2 * i + 2], self._linear))
        #: One step of Newton's iteration, which ends with the new unknown and 0 where it was the last one needed.
        self.iteration = (
            Part(f"{self._prefix}_stages", ("w", "x", "dt", *(extra if timed else ())), spread, self._spread),
            *stages,
            Part(f"{self._prefix}_newton", ("q", "w", "x", "dt", *linear), ("x1", "miss"), self._newton),
        )
        reads = ("q", "w", *self.past, "dt", "miss", "misses", *extra)
        #: The state after the step, the first guess of the next unknown, and the number of steps that were missed.
        self.end = Part(f"{self._prefix}_after", reads, ("q1", "w1", "guess", "misses1"), self._end)
        #: The unknown of a first step, with the accelerations of its start.
        self.start = Part(f"{self._prefix}_guess", ("q", "v", "w", "tau", *extra), ("guess",), self._start)

    @property
    def size(self) -> int:
        """About how many multiplications Newton's system takes, from the tree and the number of constraints alone."""
        return self._stages**3 * (elimination_size(self._equations.model) + self._rows**3 // 3)

    def _at(self, stage: object) -> tuple[str, ...]:
        """Return the names of u, w, x and, where time enters, the parameters of a stage."""
        return (f"u_{stage}", f"w_{stage}", f"x_{stage}_", *([f"parameters_{stage}"] if self._timed else []))

    @cached_property
    def _symbols(self) -> dict[str, Any]:
        eq = self._equations
        nv, each = eq.model.nv, self._each
        sizes = {"q": eq.model.nq, **dict.fromkeys(("u", "v", "w"), nv), "tau": eq.force.numel(), "x_of": each}
        sizes |= dict.fromkeys((*self.past, "guess"), self.unknowns)
        sizes |= dict.fromkeys(("dt", "miss", "misses"), 1)
        return {**{name: ca.SX.sym(name, n) for name, n in sizes.items()}, **eq.extra_arguments}

    def _named(self, *names: str) -> dict[str, Any]:
        return {name: self._symbols[name] for name in (*names, *self._equations.extra_arguments)}

    # The stages of an unknown

    def _split(self, x: Any) -> list[tuple[Any, ...]]:
        """Return k, r and λ of each stage."""
        return [tuple(ca.vertsplit(part, [0, *self._bounds])) for part in self._parts(x)]

    def _parts(self, x: Any) -> list[Any]:
        return list(ca.vertsplit(x[: self._stages * self._each], self._each))

    @property
    def _bounds(self) -> tuple[int, int, int]:
        nv = self._equations.model.nv
        return nv, nv + len(self._space.turning), self._each

    def _moved(self, weights: Array, x: Any) -> tuple[Any, Any]:
        """Return h times the weighted sums of u̇ and of ẇ."""
        w, h = self._symbols["w"], self._symbols["dt"]
        ks, rs, _ = zip(*self._split(x), strict=True)
        # The rate u̇ of positions that add is the stage's velocity.
        speeds = [w + h * _sum(row, ks) for row in self._tableau.A]
        rates = [self._space.with_turns(speed, r) for speed, r in zip(speeds, rs, strict=True)]
        return h * _sum(weights, rates), h * _sum(weights, ks)

    def _spread(self) -> ca.Function:
        s, results = self._symbols, dict[str, Any]()
        for i, own in enumerate(self._parts(s["x"])):
            u, dw = self._moved(self._tableau.A[i], s["x"])
            after = float(self._tableau.c[i]) * s["dt"]
            more = [at_time(self._equations, after)["parameters"]] if self._timed else []
            results |= zip(self._at(i), (u, s["w"] + dw, own, *more), strict=True)
        given = self._named("w", "x", "dt") if self._timed else {name: s[name] for name in ("w", "x", "dt")}
        return function_of(self.iteration[0].name, given, results)

    # The equations of one stage

    @cached_property
    def _stage(self) -> tuple[Any, Any]:
        """The residual of a stage, and its derivatives by u, w and the stage's own unknown side by side."""
        eq: Any = self._equations
        space, s = self._space, self._symbols
        nv, extra = eq.model.nv, eq.extra_arguments.values()
        q, u, w, x = s["q"], s["u"], s["w"], s["x_of"]
        k, r, multipliers = ca.vertsplit(x, [0, *self._bounds])
        there = space.retract(q, u)
        v = space.to_body_velocity(there, w)
        # v̇ of ẇ: the axes may turn below it.
        at, turned = ca.SX.sym("at", q.numel()), ca.SX.sym("turned", q.numel())
        body = ca.Function("body", [at, w], [space.to_body_velocity(at, w)])
        along = ca.Function("along", [at, w, turned], [ca.jtimes(body(at, w), at, turned)])
        qdot = ca.substitute(eq.kin.qdot, ca.vertcat(eq.q, eq.v), ca.vertcat(there, v))
        a = ca.mtimes(ca.jacobian(v, w), k) + along(there, w, qdot)
        rest, held = eq.function("inverse_dynamics")(there, v, a, *extra) - eq.applied(there, s["tau"]), ca.SX(0, 1)
        weight = ca.SX.sym("weight", nv, self._rows)
        if self._rows:
            c = eq.constraints
            J, gamma = ca.Function("rows", [eq.q, eq.v, *extra], [c.jacobian, c.gamma])(there, v, *extra)
            rest, held = rest - ca.mtimes(J.T, multipliers), ca.mtimes(J, a) + gamma
            if eq.constraint_factors.careful:
                # A multiple of the rows, without which a link without mass has no pivot.
                rest = rest + ca.mtimes(weight, held)
        residual = ca.vertcat(rest, r - space.turns_of(space.rate(u, w)), held)
        slopes = ca.jacobian(residual, ca.vertcat(u, w, x))
        if self._rows and eq.constraint_factors.careful:
            stiff = eq.constraints.stiffening(eq.mass_matrix)
            value = ca.Function(
                "weight", [eq.q, *extra], [ca.densify(ca.mtimes(eq.constraints.jacobian.T, ca.diag(stiff)))]
            )
            residual, slopes = (ca.substitute(y, weight, value(there, *extra)) for y in (residual, slopes))
        return residual, ca.sparsify(slopes)

    def _linear(self) -> ca.Function:
        residual, slopes = self._stage
        results = {"residual": residual, "slopes": ca.vertcat(ca.SX(0, 1), *slopes.nonzeros())}
        return function_of("collocation_stage", self._named("q", "u", "w", "x_of", "tau"), results)

    # Newton's system

    def _newton(self) -> ca.Function:
        s, h, A, count = self._symbols, self._symbols["dt"], self._tableau.A, self._stages
        pattern, nv, squares = self._stage[1].sparsity(), self._equations.model.nv, self._tableau.A @ self._tableau.A
        adds, turns = self._space.with_turns(ca.SX.eye(nv), 0.0), self._space.embedded()
        given, residuals, rows = {n: s[n] for n in ("q", "w", "x", "dt")}, [], []
        for i in range(count):
            residual, entries = ca.SX.sym("residual", self._each), ca.SX.sym("slopes", pattern.nnz())
            given |= {f"residual_{i}": residual, f"slopes_{i}": entries}
            by_u, by_w, own = ca.horzsplit(ca.SX(pattern, entries), [0, nv, 2 * nv, 2 * nv + self._each])
            first = h * ca.horzcat(by_w, ca.mtimes(by_u, turns), ca.SX(self._each, self._rows))
            second = h * h * ca.horzcat(ca.mtimes(by_u, adds), ca.SX(self._each, self._each - nv))
            blocks = [float(a) * first + float(b) * second for a, b in zip(A[i], squares[i], strict=True)]
            blocks[i] = blocks[i] + own
            rows.append(ca.horzcat(*blocks))
            residuals.append(residual)
        factors = Factors.of(ca.sparsify(ca.vertcat(*rows)), self._order)
        change = factors.applied(factors.values, ca.vertsplit(ca.vertcat(*residuals)))
        x1, (last, worst) = s["x"][:-_JUDGEMENTS] - change, ca.vertsplit(s["x"][-_JUDGEMENTS:])
        size = ca.sqrt(self._square(change))
        # Once nothing but rounding is left, corrections say no more.
        counts = (last > 0) * (1 - self._is_rest(last**2, x1))
        worst = ca.fmax(worst, choose(counts, size / choose(last > 0, last, 1.0), 0.0))
        solved = self._is_rest(size**2, x1) * (worst <= _MAX_CONTRACTION)
        return function_of(self.iteration[-1].name, given, {"x1": ca.vertcat(x1, size, worst), "miss": 1 - solved})

    @property
    def _order(self) -> list[int]:
        """The order of elimination, from its end: of each velocity all stages' unknowns, the multipliers last."""
        nv, turning, each = self._equations.model.nv, self._space.turning, [*range(self._bounds[1], self._each)]
        for c in self._equations.elimination_order:
            each += [c, *([nv + turning.index(c)] if c in turning else [])]
        return [i * self._each + c for c in each for i in range(self._stages)]

    def _square(self, x: Any) -> Any:
        """Return the sum of squares of velocities in an unknown: of h ẇ, and of u̇ on rotations."""
        h = self._symbols["dt"]
        return sum((ca.sumsqr(h * k) + ca.sumsqr(r) for k, r, _ in self._split(x)), ca.SX(0))

    def _is_rest(self, square: Any, x: Any) -> Any:
        """Return 1 where a correction of this square was the last one needed: what is left after it is its square."""
        s, h = self._symbols, self._symbols["dt"]
        speed = ca.sumsqr(s["w"]) + self._square(x)
        # A NaN is not below anything.
        return square < MAX_LAST_CORRECTION**2 * speed + (MAX_LAST_MOVE / h) ** 2 * (1 + ca.sumsqr(s["q"]))

    # The ends of a step

    def _end(self) -> ca.Function:
        eq, space, s = self._equations, self._space, self._symbols
        extra, behind = eq.extra_arguments.values(), at_time(eq, s["dt"]).values()
        u, dw = self._moved(self._tableau.b, s["x"])
        q1, w1, lost = space.retract(s["q"], u), s["w"] + dw, ca.SX(0.0)
        if self._rows:
            depends = dependence(eq)
            middle = space.retract(s["q"], 0.5 * u), *at_time(eq, 0.5 * s["dt"]).values()
            near = nears_singular(*(depends(*x) for x in ((s["q"], *extra), middle, (q1, *behind))))
            q1, v1, far = thorough_projection(eq)(q1, space.to_body_velocity(q1, w1), *behind)
            w1, lost = space.to_integrator_velocity(q1, v1), ca.logic_or(far, near)
        misses = s["misses"] + s["miss"] + ca.logic_or(lost, is_lost(q1, w1))
        given = self._named("q", "w", *self.past, "dt", "miss", "misses")
        results = {"q1": q1, "w1": w1, "guess": self._continued(), "misses1": misses}
        return function_of(self.end.name, given, results)

    def _continued(self) -> Any:
        """Return the polynomials through the stages of the last steps, at those of the next."""
        times, c = list[float](), self._tableau.c.tolist()
        values = []
        for back, name in enumerate(self.past):
            for end, x in zip(c, self._parts(self._symbols[name]), strict=True):
                time = end - 1 - back
                # A stage at the end of a step and one at the start of the next are at one time.
                if not any(abs(time - other) < TYPED for other in times):
                    times.append(time)
                    values.append(x)
        guesses = [_sum(weights, values) for weights in extrapolation_weights(times, c)]
        return ca.vertcat(*guesses, ca.SX(_JUDGEMENTS, 1))

    def _start(self) -> ca.Function:
        eq, space, s = self._equations, self._space, self._symbols
        extra = eq.extra_arguments.values()
        a = eq.function("forward_dynamics")(s["q"], s["v"], s["tau"], *extra)
        parts = [space.acceleration(s["q"], s["v"], a), space.turns_of(s["w"]), ca.SX(0, 1)]
        if self._rows:
            parts[2] = eq.function("independent_multipliers")(s["q"], s["v"], s["tau"], *extra)
        guess = ca.vertcat(ca.repmat(ca.vertcat(*parts), self._stages, 1), ca.SX(_JUDGEMENTS, 1))
        return function_of(self.start.name, self._named("q", "v", "w", "tau"), {"guess": guess})


class _Space(SymbolicSpace):
    """The integrators' space, with the velocities of rotations apart: `turning` are their indices."""

    def __init__(self, model: Any) -> None:
        super().__init__(model)
        self.turning = [i for _, b in self._turns for i in range(b.start, b.stop)]

    def turns_of(self, x: Any) -> Any:
        """Return the components of rotations."""
        return x[self.turning] if self.turning else ca.SX(0, 1)

    def with_turns(self, x: Any, turns: Any) -> Any:
        """Return x with other components of rotations."""
        if not self.turning:
            return x
        out = self.copied(x)
        out[self.turning, :] = turns
        return ca.sparsify(out)

    def embedded(self) -> Any:
        """Return the matrix that puts components of rotations into their places."""
        return ca.SX.eye(self.nv)[:, self.turning] if self.turning else ca.SX(self.nv, 0)


def _sum(weights: Any, values: Any) -> Any:
    return sum((float(a) * x for a, x in zip(weights, values, strict=True) if a), 0.0 * values[0])
