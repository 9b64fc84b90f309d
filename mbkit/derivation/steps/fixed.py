"""A whole step of a fixed-step method as one function, with the forward dynamics written into it.

The formulas are those of `mbkit.simulate`, which are MuJoCo 4's: on rotations the
exponential, inside a Runge-Kutta step the inverse of its differential
(Munthe-Kaas 1999), and a free joint's linear velocity in the axes of its fixed
frame (`mbkit.model.integration_space`). The torque is held over the step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import casadi as ca

from mbkit.derivation.equations import Equations
from mbkit.errors import UnknownNameError
from mbkit.model.integration_space import Space
from mbkit.model.quaternions import Arithmetic

__all__ = ["STEPS", "Part", "SymbolicSpace", "choose", "function_of", "march", "march_in_stages", "step"]

Rate = Callable[[Any, Any], Any]

_MARCH: Final = ("q", "w", "tau", "dt", "squares")
_MARCHED: Final = ("q1", "w1", "squares1")


def choose(condition: ca.SX, yes: Any, no: Any) -> Any:
    """Return `yes` where the condition is 1, `no` where it is 0, whatever the other one is."""
    # casadi.if_else would negate the condition by an operation of its own.
    chosen = ca.SX.binary(ca.OP_IF_ELSE_ZERO, condition, ca.SX(yes))
    return chosen + ca.SX.binary(ca.OP_IF_ELSE_ZERO, 1 - condition, ca.SX(no))


_SYMBOLS: Final = Arithmetic(ca.sqrt, ca.sin, ca.cos, choose)


class SymbolicSpace(Space):
    """The integrators' space on casadi.SX columns."""

    @staticmethod
    def arithmetic(x: Any) -> Arithmetic:  # noqa: ARG004  # of symbols there is one kind
        """Return the functions of symbols."""
        return _SYMBOLS

    @staticmethod
    def part(x: Any, part: slice) -> Any:
        """Return a part of a column."""
        return x[part]

    @staticmethod
    def components(x: Any, part: slice) -> list[Any]:
        """Return the scalars of a part of a column."""
        return ca.vertsplit(x[part])

    @staticmethod
    def put(x: Any, part: slice, components: Any) -> None:
        """Write scalars or a column into a part of a column."""
        x[part] = ca.vertcat(*components) if isinstance(components, list) else components

    @staticmethod
    def copied(x: Any) -> Any:
        """Return a copy to write into."""
        return ca.SX(x)


def _semi_implicit_euler(space: Space, rate: Rate, q: Any, w: Any, h: Any) -> tuple[Any, Any]:
    w = w + h * rate(q, w)
    return space.move(q, h * w), w


def _rk4(space: Space, rate: Rate, q: Any, w: Any, h: Any) -> tuple[Any, Any]:
    # Kutta's classical method: each stage starts from the one before it alone.
    us, ws = [w], [rate(q, w)]
    for part in (0.5, 0.5, 1.0):
        u, w_i = (part * h) * us[-1], w + (part * h) * ws[-1]
        us.append(space.rate(u, w_i))
        ws.append(rate(space.move(q, u), w_i))
    u, dw = ((h / 6) * (x[0] + 2 * (x[1] + x[2]) + x[3]) for x in (us, ws))
    return space.move(q, u), w + dw


#: Name of each method -> its step.
STEPS: Final = {"rk4": _rk4, "semi_implicit_euler": _semi_implicit_euler}


@dataclass(frozen=True)
class Part:
    """A part of a step: a function, and the names of what it reads and writes.

    Attributes
    ----------
    name : str
        Unique among the functions of one model.
    reads, writes : tuple of str
        As many as the function has arguments and results, all of them columns.
    make : callable
        Derives the function.
    """

    name: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    make: Callable[[], ca.Function]


def step(equations: Equations, method: str) -> ca.Function:
    """Return (q, v, tau, dt) -> (q1, v1), with the equations' trailing arguments behind.

    Parameters
    ----------
    equations : Equations
    method : {"rk4", "semi_implicit_euler"}

    Returns
    -------
    casadi.Function
        The state after dt seconds under the torque tau; q1 has unit quaternions
        and v1 is mbkit's velocity, body axes on a free joint.

    Raises
    ------
    UnknownNameError
        No method of this name has a step here.
    """
    s, space = _symbols(equations), SymbolicSpace(equations.model)
    given = {n: s[n] for n in ("q", "v", "tau", "dt", *equations.trailing)}
    rate = _rate(equations, space, s)
    q1, w1 = _formula(method)(space, rate, s["q"], space.enter(s["q"], s["v"]), s["dt"])
    return function_of(f"{method}_step", given, {"q1": q1, "v1": space.leave(q1, w1)})


def march(equations: Equations, method: str) -> tuple[Part, ...]:
    """Return one part: the whole step in the integrators' own velocity, for many steps in a row.

    It reads q, w, tau, dt, squares and writes q1, w1, squares1. The last is the sum
    of the squares of all states so far: whatever once was no number, or beyond all
    bounds, shows in it for ever.
    """
    name, behind = f"{method}_march", tuple(equations.trailing)

    def make() -> ca.Function:
        s, space = _symbols(equations), SymbolicSpace(equations.model)
        rate = _rate(equations, space, s)
        q1, w1 = _formula(method)(space, rate, s["q"], s["w"], s["dt"])
        return function_of(name, {n: s[n] for n in (*_MARCH, *behind)}, _watched(s, q1, w1))

    _formula(method)
    return (Part(name, (*_MARCH, *behind), _MARCHED, make),)


def march_in_stages(equations: Equations, method: str) -> tuple[Part, ...]:
    """Return the same step cut at each evaluation of the forward dynamics.

    The forward dynamics, most of the step, is then compiled once instead of once a
    stage. Between the parts go the stages' states (q_i, v_i) and accelerations a_i.
    """
    s, space = _symbols(equations), SymbolicSpace(equations.model)
    given = {n: s[n] for n in ("q", "w", "dt")}
    parts: list[Part] = []

    def cut(name: str, made: dict[str, Any]) -> None:
        held = dict(given)
        parts.append(Part(name, tuple(held), tuple(made), lambda: function_of(name, held, made)))

    def rate(q: Any, w: Any) -> Any:
        i = sum(part.name == "forward_dynamics" for part in parts)
        v = space.leave(q, w)
        at = ("q", "w")
        if i or not space.flat:
            at = (f"q_{i}", f"v_{i}")
            cut(f"{method}_stage_{i}", dict(zip(at, (q, v), strict=True)))
        reads = (*at, "tau", *equations.trailing)
        parts.append(Part("forward_dynamics", reads, (f"a_{i}",), lambda: equations.function("forward_dynamics")))
        a = given[f"a_{i}"] = ca.SX.sym(f"a_{i}", equations.model.nv)
        return space.acceleration(q, v, a)

    q1, w1 = _formula(method)(space, rate, s["q"], s["w"], s["dt"])
    given["squares"] = s["squares"]
    cut(f"{method}_end", _watched(s, q1, w1))
    return tuple(parts)


def _formula(method: str) -> Any:
    if method not in STEPS:
        raise UnknownNameError("method", method, STEPS)
    return STEPS[method]


def _symbols(equations: Equations) -> dict[str, Any]:
    nq, nv = equations.model.nq, equations.model.nv
    sizes = {"q": nq, "v": nv, "w": nv, "tau": nv, "dt": 1, "squares": 1}
    return {**{name: ca.SX.sym(name, n) for name, n in sizes.items()}, **equations.trailing}


def _rate(equations: Equations, space: Space, s: dict[str, Any]) -> Rate:
    forward = equations.function("forward_dynamics")
    behind = [s["tau"], *equations.trailing.values()]

    def rate(q: Any, w: Any) -> Any:
        v = space.leave(q, w)
        return space.acceleration(q, v, forward(q, v, *behind))

    return rate


def _watched(s: dict[str, Any], q1: Any, w1: Any) -> dict[str, Any]:
    return dict(zip(_MARCHED, (q1, w1, s["squares"] + (ca.sumsqr(q1) + ca.sumsqr(w1))), strict=True))


def function_of(name: str, given: dict[str, Any], made: dict[str, Any]) -> ca.Function:
    """Return the function of named symbols whose named results are dense."""
    outs = [ca.densify(x) for x in made.values()]
    return ca.Function(name, list(given.values()), outs, list(given), list(made))
