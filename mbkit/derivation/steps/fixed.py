"""Steps of one-step methods as CasADi functions, with the forward dynamics written into them.

The formulas are those of `mbkit.methods`, on the space of `mbkit.model.integration_space`. The torque is held over
the step.

Under constraints the stages are those of the method, and the end is projected as in
`mbkit.derivation.steps.onto_constraints`. Its stages, and its end and its middle where no stage is there, tell whether
a step is near a singular pose (`nears_singular`). Such a step is lost here, and taken by
`mbkit.simulate.solvers.fixed_step.make_step`, by collocation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from hashlib import sha256
from itertools import groupby
from math import frexp
from operator import add, itemgetter
from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit._check import ROUNDING, Array
from mbkit.derivation.equations import Equations
from mbkit.derivation.steps.onto_constraints import dependence, nears_singular, quick_projection, thorough_projection
from mbkit.derivation.steps.symbols import SymbolicSpace
from mbkit.methods.one_step import SemiImplicitEuler
from mbkit.methods.registry import method_of
from mbkit.methods.tableaus import Tableau

_MARCH: Final = ("q", "w", "tau", "dt", "squares")
_MARCHED: Final = ("q1", "w1", "squares1")
#: Number of operations of all stages above which the forward dynamics is compiled once and called for each of them:
#: LLVM's time grows faster than the step, which then runs no faster than its parts.
_MAX_OPERATIONS_IN_ONE_PIECE: Final = 20_000
#: The numbers of a state feedback.
LAW: Final = "law"
#: Names that a march hands on from step to step.
STATE: Final = ("q", "w", "squares")
#: Parts that evaluate forward dynamics, without and with constraints.
DYNAMICS: Final = ("forward_dynamics", "held_dynamics")


class SymbolicStages:
    """Rates of the stages so far as expressions, as `mbkit.methods.one_step.Stages`."""

    def __init__(self, nv: int) -> None:
        self._nv, self._rates = nv, list[tuple[Any, Any]]()

    def __len__(self) -> int:
        return len(self._rates)

    def append(self, u_rate: Any, w_rate: Any) -> None:
        """Add a stage."""
        self._rates.append((u_rate, w_rate))

    def moved(self, h: Any, weights: Array) -> tuple[Any, Any]:
        """Return h times the weighted sums of u̇ and ẇ."""
        used = [(weight, i) for i, weight in enumerate(weights.tolist()) if weight]
        share = 1 / min((abs(weight) for weight, _ in used), default=1.0)
        times = [weight * share for weight, _ in used]
        # Whole multiples of a simple part of the step, as Kutta's weights are, save products.
        if not used or not all(x == int(x) for x in (share, *times)):
            u, w = self.sums(weights)
            return h * u, h * w
        groups = [
            (factor, [i for _, (_, i) in same])
            for factor, same in groupby(zip(times, used, strict=True), itemgetter(0))
        ]
        u, w = (
            sum(factor * reduce(add, (self._rates[i][kind] for i in members)) for factor, members in groups)
            for kind in (0, 1)
        )
        # A product costs less than a quotient, and has the same bits where the share is a power of two.
        part = h * (1 / share) if frexp(share)[0] == 0.5 else h / share
        return part * u, part * w

    def sums(self, weights: Array) -> tuple[Any, Any]:
        """Return the weighted sums of u̇ and ẇ."""
        used = [(weight, pair) for weight, pair in zip(weights.tolist(), self._rates, strict=False) if weight]
        u, w = (sum((weight * pair[kind] for weight, pair in used), ca.SX.zeros(self._nv)) for kind in (0, 1))
        return u, w

    def squares(self, weights: Array, scales: tuple[Any, Any]) -> Any:
        """Return the sum of the squares of the weighted sums, each divided by its scale."""
        u, w = (ca.sumsqr(x / scale) for x, scale in zip(self.sums(weights), scales, strict=True))
        return w + u


@dataclass(frozen=True)
class Part:
    """A part of a step: a function of columns, and the names of what it reads and writes.

    `name` is unique among the functions of one model; `make` derives the function.
    """

    name: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    make: Callable[[], ca.Function]

    @classmethod
    def of(cls, name: str, arguments: dict[str, Any], results: dict[str, Any]) -> Part:
        """Return a part of named symbols and results."""
        arguments = dict(arguments)
        return cls(name, tuple(arguments), tuple(results), lambda: function_of(name, arguments, results))


def march(equations: Equations, method: str, *, thorough: bool = False, fed: str = "") -> tuple[Part, ...]:
    """Return the step of `march_in_stages` as one part."""
    name = f"{_prefix(method, thorough, fed)}_march"
    reads = (*_MARCH, *equations.extra_arguments, *([LAW] if fed else []))

    def make() -> ca.Function:
        known = _symbols(equations, fed)
        given = {name: known[name] for name in reads}
        for part in march_in_stages(equations, method, thorough=thorough, fed=fed):
            known |= zip(part.writes, part.make().call([known[name] for name in part.reads]), strict=True)
        return function_of(name, given, {name: known[name] for name in _MARCHED})

    return (Part(name, reads, _MARCHED, make),)


def velocity_changes(equations: Equations) -> tuple[tuple[Part, ...], tuple[Part, ...]]:
    """Return the parts before and behind a march from (q, v) to (q1, v1); none where the integrators' w is v."""
    s, space = _symbols(equations), SymbolicSpace(equations.model)
    w, v1 = (change(s["q"], s[n]) for change, n in ((space.to_integrator_velocity, "v"), (space.to_body_velocity, "w")))
    if w is s["v"]:
        return (), ()
    before = Part.of("integrator_velocity", {"q": s["q"], "v": s["v"]}, {"w": w})
    return (before,), (Part.of("body_velocity", {"q1": s["q"], "w1": s["w"]}, {"v1": v1}),)


def _prefix(method: str, thorough: bool, fed: str) -> str:
    gain = f"_fed_{sha256(fed.encode()).hexdigest()[:16]}" if fed else ""
    return method_of(method).code_name + ("_thorough" if thorough else "") + gain


def _entries(fed: str, q: Any, v: Any) -> tuple[list[int], list[int], list[int]]:
    """Return rows and columns of the entries of a state feedback's gain that are not zero, and limited torques."""
    size = v.numel() * (q.numel() + v.numel())
    # Bits that are not there are zeros: no torque is limited.
    bits = np.unpackbits(np.frombuffer(bytes.fromhex(fed), dtype=np.uint8), count=size + v.numel())
    rows, columns = np.nonzero(bits[:size].reshape(v.numel(), -1))
    return rows.tolist(), columns.tolist(), np.flatnonzero(bits[size:]).tolist()


def _fed(fed: str, law: Any, q: Any, v: Any) -> Any:
    """Return the torque of a state feedback with these numbers, its constants, the entries of its gain and limits."""
    nv, x = v.numel(), ca.vertcat(q, v)
    rows, columns, limited = _entries(fed, q, v)
    behind = nv + len(rows)
    torque = law[:nv] - ca.SX.triplet(rows, columns, law[nv:behind], nv, x.numel()) @ x
    for i, limit in zip(limited, ca.vertsplit(law[behind:]), strict=True):
        torque[i] = ca.fmin(ca.fmax(torque[i], -limit), limit)
    return torque


def march_in_stages(equations: Equations, method: str, *, thorough: bool = False, fed: str = "") -> tuple[Part, ...]:
    """Return a step in the integrators' own velocity, for many in a row, cut at each evaluation of forward dynamics.

    It reads q, w, tau, dt, squares and writes q1, w1, squares1. The last is the sum of the squares of all states so
    far: a number that once was not finite, or beyond all bounds, shows in it for ever; so does a step that is lost to
    its constraints, as it is near a singular pose, or so long that its projection is not done. `thorough` projections
    lose fewer steps. `fed`: it reads the numbers of a state feedback too, whose torque is added to tau. They are those
    of a gain with this `StateFeedback.pattern`, so that zeros cost nothing.

    The forward dynamics, most of the step, is compiled once and not for each stage. Between the parts go the stages'
    states (q_i, v_i) and accelerations a_i.
    """
    s, space, formula = _symbols(equations, fed), SymbolicSpace(equations.model), method_of(method).formula
    assert isinstance(formula, (Tableau, SemiImplicitEuler))
    timed, held = equations.model.time_parameter is not None, equations.model.constrained
    known = {n: s[n] for n in ("q", "w", "dt")} | (equations.extra_arguments if held or timed else {})
    own = {n: s[n] for n in ("tau", LAW)} if fed else {}
    parts, dependences, prefix = list[Part](), list[Any](), _prefix(method, thorough, fed)
    last = s["q"]

    def rates(t: Any, q: Any, u: Any, w: Any) -> tuple[Any, Any]:
        nonlocal last
        i, v, last = sum(part.name in DYNAMICS for part in parts), space.to_body_velocity(q, w), q
        at, force, more = ("q", "w"), "tau", (*equations.extra_arguments,)
        stage = dict[str, Any]()
        if i or not space.flat:
            at = (f"q_{i}", f"v_{i}")
            stage |= dict(zip(at, (q, v), strict=True))
            if timed:
                more = (f"parameters_{i}",)
                stage[more[0]] = at_time(equations, t)["parameters"]
        if fed:
            force = f"tau_{i}"
            stage[force] = s["tau"] + _fed(fed, s[LAW], q, v)
        if stage:
            parts.append(Part.of(f"{prefix}_stage_{i}", known | own, stage))
        reads = (*at, force, *more)
        if held:
            writes = f"a_{i}", f"depends_{i}"
            parts.append(Part("held_dynamics", reads, writes, lambda: _held_dynamics(equations)))
            known[writes[1]] = ca.SX.sym(writes[1])
            dependences.append(known[writes[1]])
        else:
            parts.append(Part("forward_dynamics", reads, (f"a_{i}",), lambda: equations.function("forward_dynamics")))
        a = known[f"a_{i}"] = ca.SX.sym(f"a_{i}", equations.model.nv)
        return w if u is None else space.rate(u, w), space.acceleration(q, v, a)

    q1, w1, _ = formula.step(space, rates, SymbolicStages(space.nv), 0.0, s["dt"], s["q"], s["w"])
    lost: Any = 0.0
    if held:
        behind, v1 = at_time(equations, s["dt"]).values(), space.to_body_velocity(q1, w1)
        if not formula.ends_at_a_stage:
            dependences.append(dependence(equations)(q1, *behind))
        if not any(0 < c < 1 - ROUNDING for c in formula.c):
            # A pose may lie between that both ends are as far from.
            middle = space.retract(s["q"], 0.5 * s["dt"] * w1), *at_time(equations, 0.5 * s["dt"]).values()
            dependences.append(dependence(equations)(*middle))
        if thorough or not formula.ends_at_a_stage:
            q1, v1, far = thorough_projection(equations)(q1, v1, *behind)
        else:
            q1, v1, far = quick_projection(equations)(q1, v1, last, *behind)
        w1, lost = space.to_integrator_velocity(q1, v1), ca.logic_or(far, nears_singular(*dependences))
    # Infinite where it is lost.
    squares = s["squares"] + (ca.sumsqr(q1) + ca.sumsqr(w1)) + lost / (1 - lost)
    results = dict(zip(_MARCHED, (q1, w1, squares), strict=True))
    return (*parts, Part.of(f"{prefix}_end", known | {"squares": s["squares"]}, results))


def parts_of(
    equations: Equations,
    method: str,
    operations: Callable[[Part], int],
    *,
    thorough: bool = False,
    fed: str = "",
    most: int = _MAX_OPERATIONS_IN_ONE_PIECE,
) -> tuple[Part, ...]:
    """Return the step in one part, or cut at its forward dynamics where these have more than `most` operations."""
    staged = march_in_stages(equations, method, thorough=thorough, fed=fed)
    forward = next(part for part in staged if part.name in DYNAMICS)
    law = len(_entries(fed, equations.q, equations.v)[0]) if fed else 0
    if method_of(method).stages * (operations(forward) + law) > min(most, _MAX_OPERATIONS_IN_ONE_PIECE):
        return staged
    return march(equations, method, thorough=thorough, fed=fed)


def _held_dynamics(equations: Equations) -> ca.Function:
    """Return (q, v, tau, more) -> v̇ and the `dependence` of rows at q, by one factorization."""
    forward = equations.function("forward_dynamics")
    q, v, tau, *more = forward.sx_in()
    outs = {"a": forward(q, v, tau, *more), "depends": dependence(equations)(q, *more)}
    return function_of("held_dynamics", dict(zip(forward.name_in(), (q, v, tau, *more), strict=True)), outs)


def _symbols(equations: Equations, fed: str = "") -> dict[str, Any]:
    nq, nv = equations.model.nq, equations.model.nv
    sizes = {"q": nq, "v": nv, "w": nv, "tau": equations.force.numel(), "dt": 1, "squares": 1}
    if fed:
        sizes[LAW] = nv + sum(map(len, _entries(fed, equations.q, equations.v)[1:]))
    return {**{name: ca.SX.sym(name, n) for name, n in sizes.items()}, **equations.extra_arguments}


def at_time(equations: Equations, t: Any) -> dict[str, Any]:
    """Return the extra arguments t seconds after the step's start: the time is the last of the parameters."""
    given = dict(equations.extra_arguments)
    if equations.model.time_parameter is not None:
        parameters = given["parameters"]
        *others, time = ca.vertsplit(parameters)
        given["parameters"] = ca.vertcat(*others, time + t)
    return given


def function_of(name: str, arguments: dict[str, Any], results: dict[str, Any]) -> ca.Function:
    """Return the function of named symbols whose named results are dense."""
    outs = [ca.densify(x) for x in results.values()]
    return ca.Function(name, list(arguments.values()), outs, list(arguments), list(results))
