"""An adaptive Runge-Kutta step with all that decides on it, as parts around the forward dynamics.

One round of the parts tries one step: it ends at the end of the run if that is near,
estimates its error, and either goes on to the new state or stays; the length of the
next try is settled too. The norm of the error is that of Hairer, Nørsett and Wanner's
DOP853 as SciPy has it. The controller looks at the last error too (Gustafsson 1991;
Hairer, Wanner 1996, IV.2): with the exponents below, a fifth to a third fewer tries are
rejected than by DOP853's own, and 15 % fewer tries reach an error of 1e-9 of the UR5,
30 % of the double pendulum. On rotations the step is Munthe-Kaas's, as in
`mbkit.derivation.steps.fixed`, and the error is that of the rotation vector, relative to 1.
"""

from __future__ import annotations

from typing import Any, Final

import casadi as ca

from mbkit._check import Array
from mbkit.derivation.equations import Equations
from mbkit.derivation.steps.fixed import Part, SymbolicSpace, choose, function_of
from mbkit.methods.step_control import GROWTH, LAST, SAFETY, SHRINK

__all__ = ["STATE", "AdaptiveParts", "embedded_parts", "larger"]

#: What a round reads and the next one starts from; it writes the same names with a 1
#: behind. `h` is the length to try, `most` what it may grow by at most, `last` the 32nd
#: root of the last accepted error, `end` the time not to pass. `error` is that of the
#: last try in terms of the tolerance, and `go` is 1 while there is a way to go and a
#: step to go it with.
STATE: Final = ("q", "w", "t", "h", "most", "last", "end", "error", "go")


def embedded_parts(equations: Equations, A: Array, b: Array, errors: tuple[Array, Array]) -> tuple[Part, ...]:
    """Return the parts of one try, in order.

    Parameters
    ----------
    equations : Equations
    A, b : (s, s) and (s,) arrays
        Of an explicit method of order 8.
    errors : pair of (s,) arrays
        b minus the embedded weights, of order 5 and of order 3.

    Returns
    -------
    tuple of Part
        They read the names of `STATE`, tau, rtol, atol, least (the shortest step that is
        worth a try) and the equations' trailing arguments. The part "field", which
        holds the forward dynamics, stands once for each stage, and writes the rates
        k_i = ẇ and r_i = u̇ of stage i.
    """
    stages = _Stages(equations)
    stages.begin()
    for i in range(len(b)):
        if i:
            stages.stage(i, A[i, :i])
        stages.field(i)
    stages.end(b, errors)
    return tuple(stages.parts)


class AdaptiveParts:
    """The parts that any one-step method with an embedded error has, and how it goes on.

    Parameters
    ----------
    equations : Equations

    Attributes
    ----------
    parts : list of Part
        What there is so far, in order.
    """

    def __init__(self, equations: Equations) -> None:
        self.parts: list[Part] = []
        self._equations, self._space = equations, SymbolicSpace(equations.model)
        nq, nv = equations.model.nq, equations.model.nv
        sizes = {"q": nq, **dict.fromkeys(("w", "tau"), nv), **dict.fromkeys(STATE[2:], 1)}
        sizes.update(dict.fromkeys(("step", "t_new", "rtol", "atol", "least"), 1))
        self._s = {name: ca.SX.sym(name, n) for name, n in sizes.items()}
        self._at = {"q_i": ca.SX.sym("q_i", nq), "w_i": ca.SX.sym("w_i", nv), "u_i": ca.SX.sym("u_i", nv)}

    def _part(self, name: str, given: dict[str, Any], made: dict[str, Any]) -> None:
        self.parts.append(Part(name, tuple(given), tuple(made), lambda: function_of(name, given, made)))

    def _given(self, *names: str) -> dict[str, Any]:
        return {name: self._s[name] for name in names}

    def begin(self) -> None:
        """Settle the length of the step; the first stage is where the state is."""
        given = self._given("q", "w", "t", "h", "end")
        t, h, end = given["t"], given["h"], given["end"]
        gap = end - t
        # Two equal steps to the end rather than one and a tiny one.
        within = t + choose(2 * h < gap, h, 0.5 * gap)
        t_new = choose(h < gap, within, end)
        # Not h: by this very number the time will have moved.
        made = {"step": t_new - t, "t_new": t_new, "q_i": given["q"], "w_i": given["w"], "u_i": 0 * given["w"]}
        self._part("begin", given, made)

    def _field(self, k: str, r: str) -> None:
        """Evaluate the rates ẇ and u̇ of a stage, under these names."""
        space, trailing = self._space, self._equations.trailing
        given = {**self._at, **self._given("tau"), **trailing}

        def make() -> ca.Function:
            q, w, u = self._at.values()
            v = space.leave(q, w)
            a = self._equations.function("forward_dynamics")(q, v, self._s["tau"], *trailing.values())
            return function_of("field", given, {"k": space.acceleration(q, v, a), "r": space.rate(u, w)})

        self.parts.append(Part("field", tuple(given), (k, r), make))

    def _scales(self, q1: Any, w1: Any, u: Any) -> list[Any]:
        """Return what errors of w and of u count in."""
        s, space = self._s, self._space
        sizes = (
            (larger(abs(s["w"]), abs(w1))),
            (larger(space.sizes(s["q"], u), space.sizes(q1, u))),
        )
        return [s["atol"] + s["rtol"] * size for size in sizes]

    def _decide(self, rates: dict[str, Any], q1: Any, w1: Any, error: Any) -> None:
        """Go on to the new state if its error is below 1, or stay; settle the length of the next try."""
        names = ("q", "w", "t", "h", "most", "last", "end", "step", "t_new", "rtol", "atol", "least")
        s = self._s
        # NaN is not below 1. Where there is no way to go, nothing changes.
        good = (error < 1) * (s["step"] > 0)
        h, most, last = self._next(error, good)
        t = choose(good, s["t_new"], s["t"])
        made = {
            "q1": choose(good, q1, s["q"]),
            "w1": choose(good, w1, s["w"]),
            "t1": t,
            "h1": h,
            "most1": most,
            "last1": last,
            "end1": s["end"],
            "error1": error,
            "go1": (t < s["end"]) * (s["least"] < h),
        }
        self._part("end", {**self._given(*names), **rates}, made)

    def _next(self, error: Any, good: Any) -> tuple[Any, Any, Any]:
        """Return the length of the next step, what that may grow by, and the root to remember."""
        s, step = self._s, self._s["step"]
        factor, reduction, root = self._factors(error)
        grown = step * choose(factor < s["most"], factor, s["most"])
        # A step that was short only because the end was near says little.
        grown = choose((2 * step < s["h"]) * (grown < s["h"]), s["h"], grown)
        # NaN shrinks as much as anything does.
        shrunk = step * choose(reduction > SHRINK, reduction, SHRINK)
        idle = 1 - (step > 0)
        h = choose(good, grown, choose(idle, s["h"], shrunk))
        last = choose(good, larger(root, LAST), s["last"])
        return h, choose(good, GROWTH, choose(idle, s["most"], 1.0)), last

    def _factors(self, error: Any) -> tuple[Any, Any, Any]:
        """Return what a step grows by after this error, or shrinks by, and the error's root to remember."""
        raise NotImplementedError


class _Stages(AdaptiveParts):
    """Of an explicit method."""

    def __init__(self, equations: Equations) -> None:
        super().__init__(equations)
        self._rates: list[tuple[Any, Any]] = []

    def _named_rates(self) -> dict[str, Any]:
        return {f"{kind}_{i}": x for i, pair in enumerate(self._rates) for kind, x in zip("kr", pair, strict=True)}

    def field(self, i: int) -> None:
        """Evaluate the rates of stage i."""
        self._field(f"k_{i}", f"r_{i}")
        nv = self._equations.model.nv
        self._rates.append((ca.SX.sym(f"k_{i}", nv), ca.SX.sym(f"r_{i}", nv)))

    def stage(self, i: int, weights: Array) -> None:
        """Go to where stage i is evaluated."""
        given = {**self._given("q", "w", "step"), **self._named_rates()}
        dw, u = self._moved(weights)
        made = {"q_i": self._space.move(given["q"], u), "w_i": given["w"] + dw, "u_i": u}
        self._part(f"stage_{i}", given, made)

    def _sum(self, weights: Array) -> tuple[Any, Any]:
        totals = []
        for kind in (0, 1):
            total = ca.SX.zeros(self._equations.model.nv)
            for weight, pair in zip(weights.tolist(), self._rates, strict=True):
                if weight:
                    total = total + weight * pair[kind]
            totals.append(total)
        return totals[0], totals[1]

    def _moved(self, weights: Array) -> tuple[Any, Any]:
        dw, u = self._sum(weights)
        return self._s["step"] * dw, self._s["step"] * u

    def end(self, b: Array, errors: tuple[Array, Array]) -> None:
        """Form the new state and its error, and decide."""
        s, space = self._s, self._space
        dw, u = self._moved(b)
        q1, w1 = space.move(s["q"], u), s["w"] + dw
        self._decide(self._named_rates(), q1, w1, self._error(q1, w1, u, errors))

    def _error(self, q1: Any, w1: Any, u: Any, errors: tuple[Array, Array]) -> Any:
        scales = self._scales(q1, w1, u)
        squares = []
        for weights in errors:
            parts = self._sum(weights)
            squares.append(sum(ca.sumsqr(x / scale) for x, scale in zip(parts, scales, strict=True)))
        fifth, third = squares
        total = fifth + 0.01 * third
        # No error at all is no error, and not 0/0.
        safe = choose(total > 0, total, 1 + total)
        return self._s["step"] * fifth / ca.sqrt(safe * (2 * self._equations.model.nv))

    def _factors(self, error: Any) -> tuple[Any, Any, Any]:
        eighth = ca.sqrt(ca.sqrt(ca.sqrt(error)))
        sixteenth = ca.sqrt(eighth)
        root = ca.sqrt(sixteenth)
        # Error to the power of -3/32, times the last one's 1/32.
        over, under = SAFETY * self._s["last"], sixteenth * root
        return choose(GROWTH * under < over, GROWTH, over / under), SAFETY / eighth, root


def larger(a: Any, b: Any) -> Any:
    """Return the larger of two, entry by entry."""
    return choose(a < b, b, a)
