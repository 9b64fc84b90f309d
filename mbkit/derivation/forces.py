"""Forces given by functions as CasADi expressions: their energy, and the generalized force of the rest.

Every element has rates r(q, v), linear in v, on which its force acts: f · r is its power, and so (∂r/∂v)ᵀ f its
generalized force (virtual work; Greenwood 2003, Advanced Dynamics, ch. 2). A joint's rates are its velocities, a
frame's its velocity, a bushing's those of its displacement.

A bushing's displacement is the position of one frame in the other and its rotation vector θ, of the rotation by the
angle |θ| about θ. With w = √(1 + tr R) = 2 cos(|θ|/2), u = vee(R - Rᵀ) / w = 2 sin(|θ|/2) θ/|θ|.

The operations of formulas on CasADi's scalars.

Velocity and acceleration of a motion law, exactly differentiated.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Final, NamedTuple

import casadi as ca

from mbkit.derivation.body_motion import BodyMotion
from mbkit.derivation.kinematics import Kinematics, Vector, column, compensation_energies
from mbkit.derivation.model_values import is_zero, scalar
from mbkit.model.elements.forces import TIME, Bushing, Force, FrameForce, JointElement, coordinate_arguments
from mbkit.model.elements.formula import Arithmetic, Formula
from mbkit.model.elements.motion_laws import Motion, position
from mbkit.model.joint_types import dot3

#: Operations of one number, and of two; CasADi calls them so too.
UNARY: Final = (
    *("neg", "sq", "twice", "inv", "fabs", "sign", "not", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan"),
    *("exp", "expm1", "log", "log1p", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
)
BINARY: Final = (
    *("add", "sub", "mul", "div", "pow", "hypot", "atan2", "fmin", "fmax"),
    *("lt", "le", "eq", "ne", "and", "or", "if_else_zero"),
)


def _unary(code: int) -> Callable[[Any], Any]:
    return lambda x: scalar(ca.SX.unary(code, ca.SX(x)))


def _binary(code: int) -> Callable[[Any, Any], Any]:
    return lambda a, b: scalar(ca.SX.binary(code, ca.SX(a), ca.SX(b)))


_OPERATIONS: Final[dict[str, Callable[..., Any]]] = {
    **{name: _unary(getattr(ca, f"OP_{name.upper()}")) for name in UNARY},
    **{name: _binary(getattr(ca, f"OP_{name.upper()}")) for name in BINARY},
}


def casadi_arithmetic(number: Callable[[float], Any] = float) -> Arithmetic:
    """Return the arithmetic in which `number` stands for the numbers that a formula holds."""
    return Arithmetic(number, _OPERATIONS)


#: Squares of 2 sin(|θ|/2) up to which asin has its series, of which so many terms leave 1e-38.
_SMALL: Final = 1e-3
_TERMS: Final = 10


class _Port(NamedTuple):
    """What an element acts on.

    `own` has its arguments by name, and `rates` what its force acts on. `linear` are the displacement, its stiffness
    and its damping, of a bushing.
    """

    own: dict[str, Any]
    rates: Vector
    linear: tuple[Vector, Any, Any] | None = None


def _of_joints(kin: Kinematics, force: JointElement) -> _Port:
    joints = [kin.model.joint(name) for name in force.joints]
    q, v = ([x for j in joints for x in of(j)] for of in (kin.coordinates, kin.velocities))
    return _Port(dict(zip(force.own(kin.model), (*q, *v), strict=True)), v)


def _of_frame(kin: Kinematics, force: FrameForce) -> _Port:
    motion, frame = BodyMotion(kin, ca.SX(kin.model.nv, 1)), kin.model.frame(force.frame)
    place = kin.to_world(frame.body, kin.values.of(frame).translation)
    linear, angular = motion.velocity(force.frame, force.axes)
    rates = [*linear, *angular]
    return _Port(dict(zip(force.own(kin.model), (*place, *rates), strict=True)), rates)


def _of_bushing(kin: Kinematics, bushing: Bushing) -> _Port:
    values = kin.values.of(bushing)
    (p_a, a), (p_b, b) = kin.ends(bushing)
    gap = [y - x for x, y in zip(p_a, p_b, strict=True)]
    x = [*(dot3(axis, gap) for axis in a), *rotation_vector([[dot3(row, e) for e in b] for row in a])]
    rates = [scalar(e) for e in ca.vertsplit(ca.jtimes(column(x), kin.q, kin.qdot))]
    return _Port(
        dict(zip(bushing.own(kin.model), (*x, *rates), strict=True)), rates, (x, values.stiffness, values.damping)
    )


def rotation_vector(R: list[Vector]) -> Vector:
    """Return the rotation vector of a rotation matrix by less than half a turn."""
    trace = 1.0 + (R[0][0] + (R[1][1] + R[2][2]))
    root = ca.sqrt(ca.SX(trace))
    u = [scalar(ca.SX(R[(k + 2) % 3][(k + 1) % 3] - R[(k + 1) % 3][(k + 2) % 3]) / root) for k in range(3)]
    square = ca.SX(dot3(u, u))
    small = square < _SMALL
    # asin z / z = Σ a_n z²ⁿ, a_{n+1}/a_n = (2n+1)² / ((2n+2)(2n+3)), with whole numbers for any precision.
    z2, series = square / 4.0, ca.SX(1.0)
    for n in reversed(range(_TERMS)):
        series = 1.0 + z2 * float((2 * n + 1) ** 2) / float((2 * n + 2) * (2 * n + 3)) * series
    # The branch that is not taken must have finite derivatives.
    length = ca.sqrt(ca.if_else(small, 1.0, square))
    factor = scalar(ca.if_else(small, series, 2.0 * ca.atan2(length, root) / length))
    return [x * factor for x in u]


#: Class of an element that acts on rates -> what it acts on.
_PORTS: Final[dict[type, Callable[[Kinematics, Any], _Port]]] = {
    JointElement: _of_joints,
    FrameForce: _of_frame,
    Bushing: _of_bushing,
}


class ElementForces:
    """Energy and generalized force of a model's forces by functions; both are zero where there are none."""

    def __init__(self, kin: Kinematics) -> None:
        self._kin = kin

    @cached_property
    def _others(self) -> dict[str, Any]:
        """Coordinates and velocities of the model by their names in formulas."""
        kin = self._kin
        return {
            name: scalar((kin.v if rate else kin.q)[i]) for name, (rate, i) in coordinate_arguments(kin.model).items()
        }

    @cached_property
    def _ports(self) -> list[tuple[Force, _Port]]:
        forces = self._kin.model.forces
        ports = [(f, next((_PORTS[c] for c in type(f).__mro__ if c in _PORTS), None)) for f in forces]
        return [(force, port(self._kin, force)) for force, port in ports if port]

    def _evaluated(self, force: Force, port: _Port, formula: Formula) -> list[Any]:
        kin = self._kin
        constants = dict(zip(force.symbols, kin.values.of(force).numbers, strict=True))
        clock = kin.model.time_parameter
        time = {} if clock is None else {TIME: kin.values.named[clock]}
        return formula(self._others | constants | time | port.own, casadi_arithmetic(kin.values.number))

    @cached_property
    def _weights(self) -> dict[tuple[str, ...], Any]:
        return compensation_energies(self._kin)

    @cached_property
    def energy(self) -> Any:
        """V(q) of linear bushings, of potentials, and of what holds weights."""
        total = self._kin.zero + self._weights.get((), 0.0)
        for force, port in self._ports:
            if port.linear is not None:
                x, stiffness, _ = port.linear
                for i in range(6):
                    for j in range(6):
                        if not is_zero(stiffness[i][j]):
                            total += self._kin.half * stiffness[i][j] * x[i] * x[j]
            if force.potential is not None:
                total += self._evaluated(force, port, force.potential)[0]
        return total

    @cached_property
    def force(self) -> Any:
        """The generalized force of what has no energy."""
        kin = self._kin
        total: Any = ca.SX(kin.model.nv, 1)
        for without, V in self._weights.items():
            if without:
                mask: Any = ca.DM.ones(kin.model.nv, 1)
                for name in without:
                    mask[kin.model.layout.v[name]] = 0
                total -= mask * kin.pullback(ca.gradient(V, kin.q))
        for force, port in self._ports:
            acting: Vector = [0.0] * len(port.rates)
            if port.linear is not None:
                damping = port.linear[2]
                for i in range(6):
                    terms = [damping[i][j] * port.rates[j] for j in range(6) if not is_zero(damping[i][j])]
                    acting[i] = -1.0 * sum(terms, 0.0)
            if force.formula is not None:
                given = self._evaluated(force, port, force.formula)
                acting = [x + y for x, y in zip(acting, given, strict=True)]
            total += ca.jtimes(column(port.rates), kin.v, column(acting), True)
        return total


def law_rates(motion: Motion) -> Callable[[float], tuple[float, float, float]]:
    """Return a function of the time, s, that gives a motion's x, ẋ and ẍ at its own numbers."""
    t = ca.SX.sym("t")
    x = ca.SX(position(motion, t, casadi_arithmetic()))
    speed = ca.jacobian(x, t)
    call = ca.Function("law", [t], [ca.densify(e) for e in (x, speed, ca.jacobian(speed, t))])

    def rates(time: float) -> tuple[float, float, float]:
        at, first, second = call(time)
        return float(at), float(first), float(second)

    return rates
