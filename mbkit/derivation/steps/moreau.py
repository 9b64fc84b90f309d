"""Moreau and Jean's step as parts: one round of the parts is one attempt, with what slides and what rests given.

The new velocity solves M (v⁺ - v) = h (τ + τ_passive - nle) + P at the step's start, with the impulse P_j = -h f_j of a
velocity that slides along its side, and any |P_j| <= h s_j of one that is to have none, with the stiction s_j (Moreau
1988, Unilateral contact and dry friction in finite freedom dynamics; Jean 1999, Computer Methods in Applied Mechanics
and Engineering 177). The position moves with the new velocity. What slides is to have none where it would turn. Where a
velocity turns against its side, or an impulse passes its bound, the sides are changed and the attempt is repeated: all
at once as long as fewer of them fail than before, then the last one alone (Murty 1974), so that the exact solution is
found after finitely many.

Forces that hold joints at rest, as expressions of a model whose joints slide or rest as parameters say.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit.derivation.equations import Equations
from mbkit.derivation.steps.fixed import Part, function_of
from mbkit.derivation.steps.symbols import SymbolicSpace, choose
from mbkit.model.parts import POSE_ROUNDING, RESTING, ROUNDING, STOPPED


def holding(equations: Equations, q: Any, v: Any, a: Any, force: Any, parameters: Any) -> Any:
    """Return the forces that an acceleration needs beside what acts, with `parameters` of rotors that turn."""
    needed = equations.function("inverse_dynamics")(q, v, a, parameters)
    return needed - equations.applied(q, force)


def phase_margin(equations: Equations, which: Sequence[int], sides: Sequence[str], locks: Sequence[str]) -> Part:
    """Return the part behind a step that tells how far its end is from that of its phase.

    It writes ``margins1`` of the velocities `which`, and the least of them, ``margin1``: the speed of one that slides,
    of one that rests the part of its bound that is left, and 1 of one without a side; negative beyond. `sides` and
    `locks` are the parameters of their sides and of rotors at rest. The part reads the largest forces at rest,
    ``bound``. A margin is NaN where the parts of bounds are those of a linear program, as what rests follows from more
    than one locked velocity.
    """
    model, space, names = equations.model, SymbolicSpace(equations.model), list(equations.model.parameters)
    place, time = {name: i for i, name in enumerate(names)}, model.time_parameter

    def make() -> ca.Function:
        q, w, dt = ca.SX.sym("q1", model.nq), ca.SX.sym("w1", model.nv), ca.SX.sym("dt")
        tau, given = ca.SX.sym("tau", equations.force.numel()), ca.SX.sym("parameters", len(names))
        values = [x + dt * (name == time) for name, x in zip(names, ca.vertsplit(given), strict=True)]
        locked, side = (ca.vertcat(*(values[place[x]] for x in of)) for of in (locks, sides))
        locked, bound = locked > 0, ca.SX.sym("bound", len(which))
        still = (side == 0) * (bound > 0)
        pick = ca.DM(ca.Sparsity.triplet(len(which), model.nv, list(range(len(which))), list(which)), 1.0)
        ends = space.to_body_velocity(q, w)
        v = (1 - ca.mtimes(pick.T, still)) * ends
        a = equations.function("forward_dynamics")(q, v, tau, ca.vertcat(*values))
        speeds = ca.mtimes(pick, v)
        if model.constrained:
            loose = [0.0 if name in {*locks} else x for name, x in zip(names, values, strict=True)]
            needed = holding(equations, q, v, (1 - ca.mtimes(pick.T, still)) * a, tau, ca.vertcat(*loose))
            moved = _ways(equations, which)(q, ca.vertcat(*values))
            used = _shared(ca.mtimes(pick, moved), ca.mtimes(moved.T, needed), bound, still, locked)
            # A joint that rows alone hold moves as soon as they do.
            size = reduce(ca.fmax, ca.vertsplit(ca.fabs(ends)), ca.SX(1.0))
            left = choose(locked, 1.0, 1 - ca.fabs(ca.mtimes(pick, ends)) / (POSE_ROUNDING * size))
            left = ca.fmin(1 + ROUNDING - used, left)
        else:
            # What holds a joint accelerates its rotor.
            left = 1 + ROUNDING - RESTING * ca.fabs(ca.mtimes(pick, a)) / bound
        margins = choose(still, left, choose(side == 0, 1.0, side * speeds - STOPPED))
        arguments = {"q1": q, "w1": w, "tau": tau, "dt": dt, "bound": bound, "parameters": given}
        results = {"margin1": reduce(ca.fmin, ca.vertsplit(margins)), "margins1": margins}
        return function_of("phase_margin", arguments, results)

    return Part("phase_margin", ("q1", "w1", "tau", "dt", "bound", "parameters"), ("margin1", "margins1"), make)


def _ways(equations: Any, which: Sequence[int]) -> ca.Function:
    """Return (q, parameters) -> velocities by rows for 1 of one of `which` and 0 of what is locked, (nv, k)."""
    J = equations.constraints.jacobian
    unit = ca.DM(ca.Sparsity.triplet(J.shape[1], len(which), list(which), list(range(len(which)))), 1.0)
    moved = unit - equations.constraint_factors.change(ca.mtimes(J, unit))
    return ca.Function("ways", [equations.q, *equations.extra_arguments.values()], [ca.densify(moved)])


def _shared(ways: Any, needed: Any, bound: Any, still: Any, locked: Any) -> Any:
    """Return the parts of their bounds that velocities at rest have of the forces `needed` along ways, (k,).

    `ways` has the velocities by each of them that is locked, (k, k).
    """
    k = bound.numel()
    follows = choose(ca.repmat(locked.T, k, 1) * ca.repmat(still, 1, k) * (ca.fabs(ways) > POSE_ROUNDING), ways, 0.0)
    part = choose(locked, ca.fabs(needed) / ca.mtimes(ca.fabs(follows.T), bound), 0.0)
    links = follows != 0
    return ca.mtimes(links, part) + choose(ca.sum2(links) > 1, np.nan, 0.0)


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
