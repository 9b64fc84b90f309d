"""An adaptive step as parts around the forward dynamics: one round of the parts is one attempt.

It ends at the end of the run if that is near, estimates its error, and either goes on to the new state or stays; the
length of the next attempt is chosen too. The formulas are those of `mbkit.methods`. On rotations the error is that of
the rotation vector, relative to 1.

Under constraints the new state is the consistent one beside the step's end. A step whose end is too far from them is
rejected, and one that ends near a singular pose has an infinite error, by which the caller knows it.
"""

from __future__ import annotations

from math import inf
from typing import Any, Final

import casadi as ca

from mbkit.derivation.equations import Equations
from mbkit.derivation.steps.fixed import Part, SymbolicStages, function_of
from mbkit.derivation.steps.onto_constraints import dependence, thorough_projection
from mbkit.derivation.steps.symbols import SYMBOLS, SymbolicSpace, choose
from mbkit.methods.one_step import StepFactors, embedded_error, end_of_attempt, larger, next_step, predictive_factors
from mbkit.methods.tableaus import EmbeddedTableau

#: Smallest error, in tolerances, of a step whose end is too far from its constraints.
_MIN_ERROR_TOO_FAR: Final = 1e3
#: Largest dependence of rows before a pose counts as singular: a hundredth of the usual distance from one.
_MAX_DEPENDENCE: Final = 1e4

#: A round reads these and writes the same names with a 1 behind, from which the next one starts. `h` is the length to
#: try, `most` what it may grow by at most, `last` the 32nd root of the last accepted error, `end` the time not to pass.
#: `error` is that of the last attempt in terms of the tolerance, and `go` is 1 while there is a way to go and a step to
#: go it with.
STATE: Final = ("q", "w", "t", "h", "most", "last", "end", "error", "go")


def embedded_parts(equations: Equations, tableau: EmbeddedTableau) -> list[Part]:
    """Return the parts of one attempt of a method of order 8, with errors of order 5 and of order 3, in order.

    They read the names of `STATE`, tau, rtol, atol, least (the shortest step that is worth an attempt) and the
    equations' extra arguments. The part "field", which holds the forward dynamics, stands once for each stage, and
    writes the rates k_i = ẇ and r_i = u̇ of stage i.
    """
    parts, stages = AttemptParts(equations), SymbolicStages(equations.model.nv)
    s, known = parts.symbols, dict[str, Any]()

    def rates(t: Any, q: Any, u: Any, w: Any) -> tuple[Any, Any]:  # noqa: ARG001  # the time is a parameter
        i = len(stages)
        if u is not None:
            parts.add(f"stage_{i}", {**parts.named("q", "w", "step"), **known}, {"q_i": q, "w_i": w, "u_i": u})
        k, r = (ca.SX.sym(f"{kind}_{i}", equations.model.nv) for kind in "kr")
        parts.add_field(f"k_{i}", f"r_{i}")
        known.update({f"k_{i}": k, f"r_{i}": r})
        return r, k

    parts.begin()
    q1, w1, u = tableau.step(parts.space, rates, stages, s["t"], s["step"], s["q"], s["w"])
    scales = parts.scales(q1, w1, u)
    error = embedded_error(SYMBOLS, tableau.errors, stages, scales, s["step"], 2 * equations.model.nv)
    if equations.model.constrained:
        q1, w1, error = parts.onto_constraints(q1, w1, error)
    parts.decide(known, q1, w1, error, predictive_factors(SYMBOLS, error, s["last"]))
    return parts.parts


class AttemptParts:
    """The `parts` that any one-step method with an embedded error has, in order, and how it goes on.

    `symbols` are the state and numbers by name, `at` is the state of the stage that is evaluated.
    """

    def __init__(self, equations: Equations) -> None:
        self.parts: list[Part] = []
        self.equations, self.space = equations, SymbolicSpace(equations.model)
        nq, nv = equations.model.nq, equations.model.nv
        sizes = {"q": nq, "w": nv, "tau": equations.force.numel(), **dict.fromkeys(STATE[2:], 1)}
        sizes.update(dict.fromkeys(("step", "t_new", "rtol", "atol", "least"), 1))
        self.symbols = {name: ca.SX.sym(name, n) for name, n in sizes.items()}
        self.at = {"q_i": ca.SX.sym("q_i", nq), "w_i": ca.SX.sym("w_i", nv), "u_i": ca.SX.sym("u_i", nv)}

    def add(self, name: str, arguments: dict[str, Any], results: dict[str, Any]) -> None:
        """Add a part of named symbols and results."""
        self.parts.append(Part.of(name, arguments, results))

    def named(self, *names: str) -> dict[str, Any]:
        """Return some of the symbols by name."""
        return {name: self.symbols[name] for name in names}

    def begin(self) -> None:
        """Choose the length of the attempt; the first stage is where the state is."""
        s = self.named("q", "w", "t", "h", "end")
        t_new = end_of_attempt(SYMBOLS, s["t"], s["h"], s["end"])
        # Not h: by this very number the time will have moved.
        results = {"step": t_new - s["t"], "t_new": t_new, "q_i": s["q"], "w_i": s["w"], "u_i": 0 * s["w"]}
        self.add("begin", s, results)

    def add_field(self, k: str, r: str) -> None:
        """Evaluate the rates ẇ and u̇ of a stage, under these names."""
        space, extra = self.space, self.equations.extra_arguments
        arguments = {**self.at, **self.named("tau"), **extra}

        def make() -> ca.Function:
            q, w, u = self.at.values()
            v = space.to_body_velocity(q, w)
            a = self.equations.function("forward_dynamics")(q, v, self.symbols["tau"], *extra.values())
            return function_of("field", arguments, {"k": space.acceleration(q, v, a), "r": space.rate(u, w)})

        self.parts.append(Part("field", tuple(arguments), (k, r), make))

    def scales(self, q1: Any, w1: Any, u: Any) -> tuple[Any, Any]:
        """Return the tolerated errors of u and of w."""
        s, space = self.symbols, self.space
        by_u, by_w = (
            s["atol"] + s["rtol"] * larger(SYMBOLS, *sizes)
            for sizes in ((space.magnitude(s["q"], u), space.magnitude(q1, u)), (abs(s["w"]), abs(w1)))
        )
        return by_u, by_w

    def onto_constraints(self, q1: Any, w1: Any, error: Any) -> tuple[Any, Any, Any]:
        """Return the consistent state beside a step's end, and the error that it counts as."""
        extra, space = self.equations.extra_arguments, self.space
        q, v, far = thorough_projection(self.equations)(q1, space.to_body_velocity(q1, w1), *extra.values())
        # NaN counts too: there is no acceleration at the pose itself.
        singular = ca.logic_not(dependence(self.equations)(q1, *extra.values()) <= _MAX_DEPENDENCE)
        error = choose(far, larger(SYMBOLS, error, _MIN_ERROR_TOO_FAR), error)
        return q, space.to_integrator_velocity(q, v), choose(singular, inf, error)

    def decide(self, rates: dict[str, Any], q1: Any, w1: Any, error: Any, factors: StepFactors) -> None:
        """Go on to the new state if its error is below 1, or stay; choose the length of the next attempt."""
        s = self.named("q", "w", "t", "h", "most", "last", "end", "step", "t_new", "rtol", "atol", "least")
        # NaN is not below 1. Where there is no way to go, nothing changes.
        good = (error < 1) * (s["step"] > 0)
        h, most, last = next_step(SYMBOLS, factors, good, s["step"], s["h"], s["most"], s["last"])
        q, w, t = (choose(good, new, s[old]) for new, old in ((q1, "q"), (w1, "w"), (s["t_new"], "t")))
        # Near a singular pose this loop ends; a NaN is tried again, shorter.
        goes = (t < s["end"]) * (s["least"] < h) * (error != inf)
        state = q, w, t, h, most, last, s["end"], error, goes
        extra = self.equations.extra_arguments if self.equations.model.constrained else {}
        self.add("end", {**s, **rates, **extra}, {f"{name}1": value for name, value in zip(STATE, state, strict=True)})
