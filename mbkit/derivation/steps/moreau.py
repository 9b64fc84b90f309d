"""Moreau and Jean's step as parts: one round of the parts is one attempt, with what slides and what rests given.

The new velocity solves M (v⁺ - v) = h (τ + τ_passive - nle) + P at the step's start, with the impulse P_j = -h f_j of a
velocity that slides along its side, and any |P_j| <= h s_j of one that is to have none, with the stiction s_j (Moreau
1988, Unilateral contact and dry friction in finite freedom dynamics; Jean 1999, Computer Methods in Applied Mechanics
and Engineering 177). The position moves with the new velocity. What slides is to have none where it would turn. Where a
velocity turns against its side, or an impulse passes its bound, the sides are changed and the attempt is repeated: all
at once as long as fewer of them fail than before, then the last one alone (Murty 1974), so that the exact solution is
found after finitely many.
"""

from __future__ import annotations

from typing import Any, Final

import casadi as ca

from mbkit.derivation.equations import Equations
from mbkit.derivation.steps.fixed import Part, function_of
from mbkit.derivation.steps.rest import holding
from mbkit.derivation.steps.symbols import SymbolicSpace, choose
from mbkit.model.parts import RESTING, ROUNDING

#: A round reads these and writes the same names with a 1 behind. `side` and `still` are of the velocities whose
#: forces jump; `k` is the number of steps so far, `end` that to make; `best` is the least number of failures so far and
#: `left` how many attempts may fail to have fewer; `go` is 1 while there are steps to make.
STATE: Final = ("q", "w", "side", "still", "k", "end", "best", "left", "go")
#: Attempts that may not have fewer failures before sides are changed one by one.
PATIENCE: Final = 3
#: `best` beyond every velocity: no candidate yet.
MANY: Final = 1e9


def moreau_parts(equations: Equations, which: list[int], sides: list[str], locks: list[str]) -> list[Part]:
    """Return the parts of an attempt, of the equations of a model whose joints slide or rest as parameters say.

    `which` are the velocities whose forces jump, `sides` and `locks` the parameters of their sides and of their rotors
    at rest. The parts read `STATE`, tau, dt, bound (the largest forces at rest, in the order
    of `which`) and the other parameters.
    """
    model, space = equations.model, SymbolicSpace(equations.model)
    n, nv = len(which), model.nv
    s = {name: ca.SX.sym(name, size) for name, size in (("q", model.nq), ("w", nv), ("side", n), ("still", n))}
    s |= {name: ca.SX.sym(name) for name in STATE[4:]}
    s |= {"tau": ca.SX.sym("tau", equations.force.numel()), "dt": ca.SX.sym("dt"), "bound": ca.SX.sym("bound", n)}
    rest = [name for name in model.parameters if name not in {*sides, *locks}]
    others = ca.SX.sym("parameters", len(rest))
    # The time is that of step zero, if all steps had this length.
    at_step = [
        x + s["k"] * s["dt"] if n == model.time_parameter else x
        for n, x in zip(rest, ca.vertsplit(others), strict=True)
    ]
    place = {name: i for i, name in enumerate((*sides, *locks, *rest))}
    order = [place[name] for name in model.parameters]
    pick = ca.DM(ca.Sparsity.triplet(n, nv, list(range(n)), which), 1.0)
    v, h, still, side = space.to_body_velocity(s["q"], s["w"]), s["dt"], s["still"], s["side"]

    def spread(x: Any) -> Any:
        """Return numbers of the velocities that may rest among all."""
        return ca.mtimes(pick.T, x)

    def parameters(side: Any, lock: Any) -> Any:
        return ca.vertcat(side, lock, *at_step)[order]

    def solve() -> ca.Function:
        # A joint that comes to rest is accelerated so that it has no velocity at the end: a force on a giant rotor.
        target = -ca.mtimes(pick, v) / h
        force = s["tau"] + ca.vertcat(spread(RESTING * still * target), ca.SX(s["tau"].numel() - nv, 1))
        forward = equations.function("forward_dynamics")
        a = forward(s["q"], v, force, parameters(side * (1 - still), RESTING * still))
        a = (1 - spread(still)) * a + spread(still * target)
        needed = holding(equations, s["q"], v, a, s["tau"], parameters(side * (1 - still), ca.SX(n, 1)))
        given = {name: s[name] for name in first[: -len(extra) or None]} | extra
        return function_of("moreau_solve", given, {"a": a, "needed": ca.mtimes(pick, needed)})

    extra = {"parameters": others} if others.numel() else {}
    first = ("q", "w", "side", "still", "k", "tau", "dt", *extra)
    a, needed = ca.SX.sym("a", nv), ca.SX.sym("needed", n)

    def decide() -> ca.Function:
        after = v + h * a
        after = (1 - spread(still)) * after
        along = ca.mtimes(pick, after)
        back = (1 - still) * (side * along < 0)
        # A velocity of zero that is to slide, and does not, rests.
        loose = still * (ca.fabs(needed) > s["bound"] * (1 + ROUNDING))
        wrong = back + loose
        count = ca.sum1(wrong)
        fewer = count < s["best"]
        best, left = choose(fewer, count, s["best"]), choose(fewer, PATIENCE, s["left"] - (s["left"] > 0))
        alone = (1 - fewer) * (s["left"] <= 0)
        later, last = ca.SX(0), []
        for k in reversed(range(n)):
            last.append(wrong[k] * (later <= 0))
            later = later + wrong[k]
        change = choose(alone, ca.vertcat(*reversed(last)), wrong)
        new_still = choose(change, 1 - still, still)
        new_side = choose(change * loose, -ca.sign(needed), side)
        good = count <= 0
        q1 = space.retract(s["q"], h * space.to_integrator_velocity(s["q"], after))
        w1 = space.to_integrator_velocity(q1, after)
        k = s["k"] + good
        state = {
            "q1": choose(good, q1, s["q"]),
            "w1": choose(good, w1, s["w"]),
            "side1": choose(good, side, new_side),
            "still1": choose(good, still, new_still),
            "k1": k,
            "end1": s["end"],
            "best1": choose(good, MANY, best),
            "left1": choose(good, PATIENCE, left),
            "go1": k < s["end"],
        }
        given = {name: s[name] for name in (*STATE[:-1], "dt", "bound")} | {"a": a, "needed": needed}
        return function_of("moreau_decide", given, state)

    second = (*STATE[:-1], "dt", "bound", "a", "needed")
    return [
        Part("moreau_solve", first, ("a", "needed"), solve),
        Part("moreau_decide", second, tuple(f"{name}1" for name in STATE), decide),
    ]
