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

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit.derivation.equations import Equations
from mbkit.derivation.steps.exchanges import COLUMNS
from mbkit.derivation.steps.fixed import Part, function_of
from mbkit.derivation.steps.onto_constraints import dependence, nears_singular, projection, rows_change
from mbkit.derivation.steps.symbols import SymbolicSpace, choose
from mbkit.methods.exchanges import FORCE_ROUNDING, PATIENCE, PROXIMAL_SHIFT, ROUNDS, Problem, Signs, exchange
from mbkit.model.parts import POSE_ROUNDING, RESTING, ROUNDING, STOPPED
from mbkit.model.stops import StopLaw


def holding(equations: Equations, q: Any, v: Any, a: Any, force: Any, parameters: Any) -> Any:
    """Return the forces that an acceleration needs beside what acts, with `parameters` of rotors that turn."""
    needed = equations.function("inverse_dynamics")(q, v, a, parameters)
    return needed - equations.applied(q, force)


def phase_margin(
    equations: Equations, which: Sequence[int], sides: Sequence[str | None], locks: Sequence[str], stops: StopLaw
) -> Part:
    """Return the part behind a step that tells how far its end is from that of its phase.

    It writes ``margins1`` of the velocities `which`, and the least of them, ``margin1``: the speed of one that slides,
    of one that rests the part of its bound that is left, and 1 of one without a side; beside stops the distance, or the
    part of all forces that pushes it there; negative beyond. `sides` and `locks` are the parameters of their sides and
    of rotors at rest. The part reads the largest forces at rest, ``bound``. A margin is NaN where the parts of bounds
    are those of a linear program, as what rests follows from more than one locked velocity, or is at a stop beside
    constraints. As ``q2`` and ``w2`` it writes the end with what rests where it was at ``q``, to the bit.
    """
    model, space, names = equations.model, SymbolicSpace(equations.model), list(equations.model.parameters)
    place, time = {name: i for i, name in enumerate(names)}, model.time_parameter

    def make() -> ca.Function:
        q, w, dt, start = (ca.SX.sym(x, n) for x, n in (("q1", model.nq), ("w1", model.nv), ("dt", 1), ("q", model.nq)))
        tau, given = ca.SX.sym("tau", equations.force.numel()), ca.SX.sym("parameters", len(names))
        values = [x + dt * (name == time) for name, x in zip(names, ca.vertsplit(given), strict=True)]
        locked, bound = ca.vertcat(*(values[place[x]] for x in locks)), ca.SX.sym("bound", len(which))
        # Without friction the rotor tells whether a joint rests.
        side = ca.vertcat(
            *(lock <= 0 if x is None else values[place[x]] for x, lock in zip(sides, ca.vertsplit(locked), strict=True))
        )
        locked = locked >= RESTING
        rubs, stopped = bound > 0, ca.DM(stops.which[list(which)].astype(float))
        still = (side == 0) * (1 - (1 - rubs) * (1 - stopped))
        pick = ca.DM(ca.Sparsity.triplet(len(which), model.nv, list(range(len(which))), list(which)), 1.0)
        ends = space.to_body_velocity(q, w)
        rests = ca.mtimes(pick.T, still)
        v = (1 - rests) * ends
        a = equations.function("forward_dynamics")(q, v, tau, ca.vertcat(*values))
        speeds = ca.mtimes(pick, v)
        if model.constrained:
            loose = [0.0 if name in {*locks} else x for name, x in zip(names, values, strict=True)]
            needed = holding(equations, q, v, (1 - rests) * a, tau, ca.vertcat(*loose))
            moved = _ways(equations, which)(q, ca.vertcat(*values))
            used = _shared(ca.mtimes(pick, moved), ca.mtimes(moved.T, needed), bound, still, locked)
            # A joint that rows alone hold moves as soon as they do.
            size = reduce(ca.fmax, ca.vertsplit(ca.fabs(ends)), ca.SX(1.0))
            left = choose(locked, 1.0, 1 - ca.fabs(ca.mtimes(pick, ends)) / (POSE_ROUNDING * size))
            left = ca.fmin(1 + ROUNDING - used, left)
        else:
            # What holds a joint accelerates its rotor.
            left = 1 + ROUNDING - RESTING * ca.fabs(ca.mtimes(pick, a)) / bound
        loose = choose(rubs * (side != 0), side * speeds - STOPPED, 1.0)
        if stops:
            pushed = still * ca.vertcat(*(_against(stops, i, start) for i in which))
            if model.constrained:
                left = left + choose(reduce(ca.fmax, ca.vertsplit(pushed**2)), np.nan, 0.0)
            else:
                none, own = ca.SX.zeros(model.nv), ca.vertcat(*values)
                size = ca.fabs(equations.function("inverse_dynamics")(q, v, none, own)) + ca.fabs(tau[: model.nv])
                size = reduce(ca.fmax, ca.vertsplit(size), ca.SX(np.finfo(float).tiny))
                held = bound - pushed * RESTING * ca.mtimes(pick, a)
                left = choose(pushed != 0, held / (bound + size) + ROUNDING, left)
            loose = ca.fmin(loose, ca.vertcat(*(_clearance(stops, i, q, v[int(i)]) for i in which)))
        margins = choose(still, left, loose)
        results = [reduce(ca.fmin, ca.vertsplit(margins)), margins]
        results += [choose(_places(model, rests), start, q), choose(rests, 0.0, w)]
        arguments = dict(zip(reads, (start, q, w, tau, dt, bound, given), strict=True))
        return function_of("phase_margin", arguments, dict(zip(writes, results, strict=True)))

    reads, writes = ("q", "q1", "w1", "tau", "dt", "bound", "parameters"), ("margin1", "margins1", "q2", "w2")
    return Part("phase_margin", reads, writes, make)


def _against(stops: StopLaw, i: int, q: Any) -> Any:
    """Return 1 where a velocity's coordinate is at its lower stop, -1 at its upper one, else 0."""
    low, high = (x - r for x, r in zip(_distances(stops, i, q), stops.room[:, i], strict=True))
    return (low <= 0) - (high <= 0)


def _clearance(stops: StopLaw, i: int, q: Any, v: Any) -> Any:
    """Return the distance from the nearest stop, as `StopLaw.clearance` does."""
    rooms, inwards = 0.5 * stops.room[:, i], (v >= 0, v <= 0)
    return reduce(ca.fmin, (x + r * on for x, r, on in zip(_distances(stops, i, q), rooms, inwards, strict=True)))


def _distances(stops: StopLaw, i: int, q: Any) -> list[Any]:
    low, high = stops.bounds[:, i]
    own = q[int(stops.places[i])]
    return [own - low if np.isfinite(low) else ca.SX(np.inf), high - own if np.isfinite(high) else ca.SX(np.inf)]


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


#: Names of what a round reads, and writes with a 1 behind. `side` and `still` are of the velocities whose forces jump;
#: `k` is the number of steps so far, `end` that to make; `best` is the least number of failures so far and `left` how
#: many attempts may fail to have fewer; `go` is 1 while there are steps to make.
STATE: Final = ("q", "w", "side", "still", "k", "end", "best", "left", "go")
#: The same beside constraints: `low` and `high` are the bounds now and `before` is the last proximal point of
#: `mbkit.methods.exchanges`, `depends` the `dependence` of rows a step ago and `new` is 1 where a step begins.
HELD_STATE: Final = ("q", "w", "side", "still", "low", "high", "before", "depends", "new", *STATE[4:])
#: `best` beyond every velocity: no candidate yet.
MANY: Final = 1e9


class _Attempt:
    """Symbols of an attempt: what a round reads, and the parameters of a step with given sides and rotors at rest."""

    def __init__(
        self, equations: Equations, which: list[int], sides: list[str], locks: list[str], state: Sequence[str]
    ) -> None:
        model, n, nv = equations.model, len(which), equations.model.nv
        self.equations, self.space, self.n, self.nv = equations, SymbolicSpace(model), n, nv
        sizes = dict.fromkeys(("side", "still", "low", "high", "before", "bound"), n) | {"q": model.nq, "w": nv}
        sizes |= {"tau": equations.force.numel()}
        self.s = s = {name: ca.SX.sym(name, sizes.get(name, 1)) for name in (*state, "tau", "dt", "bound")}
        rest = [name for name in model.parameters if name not in {*sides, *locks}]
        others = ca.SX.sym("parameters", len(rest))
        self.extra = {"parameters": others} if rest else {}
        # The time is that of step zero, if all steps had this length.
        self._at_step = [
            x + s["k"] * s["dt"] if name == model.time_parameter else x
            for name, x in zip(rest, ca.vertsplit(others), strict=True)
        ]
        self._timed = [name == model.time_parameter for name in rest]
        place = {name: i for i, name in enumerate((*sides, *locks, *rest))}
        self._order = [place[name] for name in model.parameters]
        self.pick = ca.DM(ca.Sparsity.triplet(n, nv, list(range(n)), which), 1.0)

    def spread(self, x: Any) -> Any:
        """Return numbers of the velocities that may rest among all."""
        return ca.mtimes(self.pick.T, x)

    def parameters(self, side: Any = None, lock: Any = None, later: Any = 0.0) -> Any:
        """Return the parameters of a step so long after its start; without sides and rotors nothing jumps."""
        none = ca.SX.zeros(self.n)
        rest = [x + later if timed else x for x, timed in zip(self._at_step, self._timed, strict=True)]
        return ca.vertcat(none if side is None else side, none if lock is None else lock, *rest)[self._order]

    def part(self, name: str, reads: Sequence[str], writes: Sequence[str], make: Callable[..., Sequence[Any]]) -> Part:
        """Return a part; `make` gets what other parts write, in the order of the names that it reads."""
        given = {x: (self.s | self.extra).get(x) for x in reads}

        def function() -> ca.Function:
            sizes = {
                "a": self.nv,
                "needed": self.n,
                "free": self.nv,
                "A": self.nv * self.n,
                "slides": self.n,
                "least": self.n,
            }
            sizes |= dict.fromkeys(("forces", "holds", "side_", "still_", "low_", "high_", "before_"), self.n)
            own = {x: ca.SX.sym(x, sizes.get(x, 1)) if y is None else y for x, y in given.items()}
            made = make(*(own[x] for x, y in given.items() if y is None))
            return function_of(name, own, dict(zip(writes, made, strict=True)))

        return Part(name, tuple(reads), tuple(writes), function)


def moreau_parts(equations: Equations, which: list[int], sides: list[str], locks: list[str]) -> list[Part]:
    """Return the parts of an attempt, of the equations of a model whose joints slide or rest as parameters say.

    `which` are the velocities whose forces jump, `sides` and `locks` the parameters of their sides and of their rotors
    at rest. The parts read `STATE`, or `HELD_STATE` of a model with constraints, tau, dt, bound (the largest forces at
    rest, in the order of `which`) and the other parameters.
    """
    if equations.model.constrained:
        return _held_parts(_Attempt(equations, which, sides, locks, HELD_STATE))
    own = _Attempt(equations, which, sides, locks, STATE)
    s, space, pick, spread = own.s, own.space, own.pick, own.spread
    v, h, still, side = space.to_body_velocity(s["q"], s["w"]), s["dt"], s["still"], s["side"]

    def solve() -> tuple[Any, Any]:
        # A joint that comes to rest is accelerated so that it has no velocity at the end: a force on a giant rotor.
        target = -ca.mtimes(pick, v) / h
        force = s["tau"] + ca.vertcat(spread(RESTING * still * target), ca.SX(s["tau"].numel() - own.nv, 1))
        forward = equations.function("forward_dynamics")
        a = forward(s["q"], v, force, own.parameters(side * (1 - still), RESTING * still))
        a = (1 - spread(still)) * a + spread(still * target)
        needed = holding(equations, s["q"], v, a, s["tau"], own.parameters(side * (1 - still)))
        return a, ca.mtimes(pick, needed)

    def decide(a: Any, needed: Any) -> list[Any]:
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
        change = choose(alone, wrong * (COLUMNS.behind(wrong) == 1), wrong)
        new_still = choose(change, 1 - still, still)
        new_side = choose(change * loose, -ca.sign(needed), side)
        good = count <= 0
        q1 = space.retract(s["q"], h * space.to_integrator_velocity(s["q"], after))
        w1 = space.to_integrator_velocity(q1, after)
        k = s["k"] + good
        new = (q1, w1, side, still, k, s["end"], MANY, PATIENCE)
        old = (s["q"], s["w"], new_side, new_still, k, s["end"], best, left)
        return [*(choose(good, x, y) for x, y in zip(new, old, strict=True)), k < s["end"]]

    first = ("q", "w", "side", "still", "k", "tau", "dt", *own.extra)
    second = (*STATE[:-1], "dt", "bound", "a", "needed")
    return [
        own.part("moreau_solve", first, ("a", "needed"), solve),
        own.part("moreau_decide", second, tuple(f"{name}1" for name in STATE), decide),
    ]


def _held_parts(own: _Attempt) -> list[Part]:
    """Return the parts of an attempt beside constraints: exchanges in their responses, and a projection at its end.

    Rows hold the velocity at the end of the step: else no velocities of what rests together may be zero. `go` is 0,
    with fewer than `end` steps, where a step is lost, as a singular pose is near.
    """
    equations: Any = own.equations
    s, space, n, nv = own.s, own.space, own.n, own.nv
    v, h, on = space.to_body_velocity(s["q"], s["w"]), s["dt"], s["bound"] > 0
    terms, factors, more = equations.constraints, equations.constraint_factors, [*equations.extra_arguments.values()]

    def at(parameters: Any) -> list[Any]:
        return [parameters] if more else []

    def free() -> list[Any]:
        now, later = at(own.parameters()), at(own.parameters(later=h))
        smooth = v + h * equations.function("forward_dynamics")(s["q"], v, s["tau"], *now)
        rate = ca.Function("rate", [equations.q, equations.v, *more], [ca.densify(terms.rate)])
        smooth = smooth + rows_change(equations)(s["q"], rate(s["q"], smooth, *later), *later)
        A, _ = factors.motion(own.pick.T, ca.SX.zeros(terms.jacobian.shape[0], n))
        masses = ca.mtimes(own.pick, ca.diag(equations.mass_matrix))
        least = choose(masses > 0, PROXIMAL_SHIFT / masses, 0.0)
        A, least = ca.Function("responses", [equations.q, *more], [ca.densify(A), least])(s["q"], *later)
        passive = ca.Function("passive", [equations.q, equations.v, *more], [ca.densify(equations.passive)])
        rubs = (passive(s["q"], v, *at(own.parameters(ca.SX.ones(n) * x))) for x in (0.0, 1.0))
        slides = ca.fabs(ca.mtimes(own.pick, -reduce(lambda x, y: y - x, rubs)))
        return [smooth, ca.vec(A), least, slides, dependence(equations)(s["q"], *now)]

    def exchanges(smooth: Any, A: Any, least: Any, slides: Any, _: Any) -> list[Any]:
        A = ca.mtimes(own.pick, ca.reshape(A, nv, n))
        # A joint that loops hold responds by rounding alone, of either sign; the least response keeps A definite.
        A = 0.5 * (A + A.T) + ca.diag(ca.fmax(least - ca.diag(A), 0.0))
        rests = choose(s["new"], ca.mtimes(own.pick, v) == 0, s["still"])
        most, less, b = h * choose(rests, s["bound"], slides), h * slides, ca.mtimes(own.pick, smooth)
        shift = PROXIMAL_SHIFT * ca.fabs(ca.diag(A))
        noise = FORCE_ROUNDING * (ca.fabs(b) + ca.mtimes(ca.fabs(A), most))
        problem = Problem(A, A + ca.diag(shift), b, most, less, on, ca.SX.zeros(n), noise, shift)
        low, high = (choose(s["new"], x, y) for x, y in ((-most, s["low"]), (most, s["high"])))
        best, left = (choose(s["new"], x, y) for x, y in ((n + 1.0, s["best"]), (PATIENCE, s["left"])))
        signs = Signs(low, high, ca.SX.zeros(n), s["side"] * on, best, left, s["before"] * (1 - s["new"]))
        for _ in range(ROUNDS):
            signs, forces, holds, going = exchange(COLUMNS, problem, signs, n)
        return [signs.side, rests, signs.low, signs.high, signs.before, signs.best, signs.left, forces, holds, going]

    def end(*given: Any) -> list[Any]:
        smooth, A, least, slides, depends, side, rests, low, high, before, best, left, forces, holds, going = given
        A = ca.reshape(A, nv, n)
        along = choose(own.spread(holds), 0.0, smooth + ca.mtimes(A, forces))
        # A joint that stops or turns may be held by its stiction.
        turns = on * (1 - rests) * (ca.mtimes(own.pick, v * along) <= 0) * (slides < s["bound"]) * (1 - going)
        turned = COLUMNS.largest(turns)
        most = h * choose(rests + turns > 0, s["bound"], slides)
        q1 = space.retract(s["q"], h * space.to_integrator_velocity(s["q"], along))
        middle = space.retract(s["q"], 0.5 * h * space.to_integrator_velocity(s["q"], along))
        later = at(own.parameters(lock=RESTING * locked(ca.mtimes(own.pick, A), least, holds), later=h))
        onto = projection(equations)
        _, v1, moved, _ = onto(q1, along, ca.SX.zeros(nv), *later)
        q1, v1, _, far = onto(q1, v1, moved, *later)
        q1, v1 = choose(_places(equations.model, own.spread(holds)), s["q"], q1), choose(own.spread(holds), 0.0, v1)
        between = dependence(equations)(middle, *at(own.parameters(later=0.5 * h)))
        near = nears_singular(s["depends"], depends) * (s["depends"] > 0)
        lost = ca.logic_or(ca.logic_or(near, nears_singular(depends, between)), far * (1 - going) * (1 - turned))
        good = (1 - going) * (1 - turned) * (1 - lost)
        k = s["k"] + good
        w1 = space.to_integrator_velocity(q1, v1)
        new = (q1, w1, side, holds, low, high, before, depends, 1.0, k, s["end"], best, left)
        low, high, before = (choose(turned, x, y) for x, y in ((-most, low), (most, high), (0.0, before)))
        best, left = (choose(turned, x, y) for x, y in ((n + 1.0, best), (PATIENCE, left)))
        old = (s["q"], s["w"], side, rests + turns > 0, low, high, before, s["depends"], 0.0, k, s["end"], best, left)
        return [*(choose(good, x, y) for x, y in zip(new, old, strict=True)), (k < s["end"]) * (1 - lost)]

    made = ("free", "A", "least", "slides", "depends_now")
    tried = ("side_", "still_", "low_", "high_", "before_", "best_", "left_", "forces", "holds", "going")
    changed = ("side", "still", "low", "high", "before", "new", "best", "left")
    return [
        own.part("moreau_free", ("q", "w", "k", "tau", "dt", *own.extra), made, free),
        own.part("moreau_exchanges", ("q", "w", *changed, "dt", "bound", *made), tried, exchanges),
        own.part(
            "moreau_end",
            ("q", "w", "depends", "k", "end", "dt", "bound", *own.extra, *made, *tried),
            tuple(f"{name}1" for name in HELD_STATE),
            end,
        ),
    ]


def locked(A: Any, least: Any, holds: Any) -> Any:
    """Return as many of the joints that hold, (n,), as rest in independent ways.

    By their responses, (n, n): what responds with the `least` is held by rows already.
    """
    n, out = holds.numel(), []
    a = [[A[i, j] for j in range(i + 1)] for i in range(n)]
    for j in range(n):
        out.append(holds[j] * (a[j][j] > ca.fmax(POSE_ROUNDING * A[j, j], least[j])))
        inverse = choose(out[-1], 1 / a[j][j], 0.0)
        for i in range(j + 1, n):
            for k in range(j + 1, i + 1):
                a[i][k] = a[i][k] - a[i][j] * inverse * a[k][j]
    return ca.vertcat(*out)


def _places(model: Any, rests: Any) -> Any:
    """Return which coordinates keep their place: joints whose forces jump have one for each velocity."""
    out = ca.SX.zeros(model.nq)
    for joint in model.independent_joints:
        q, v = model.layout.q[joint.name], model.layout.v[joint.name]
        if q.stop - q.start == v.stop - v.start:
            out[q] = rests[v]
    return out
