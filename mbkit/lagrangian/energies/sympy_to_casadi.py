"""SymPy's expressions as CasADi's, in which everything else is derived, compiled and measured.

The equations of a system of energies as CasADi expressions: Lagrange's, with constraints, and Hamel's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import SimpleNamespace
from typing import Any, Final

import casadi as ca
import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef

from mbkit._attributes import forwarded
from mbkit._check import Array
from mbkit.codegen.backend import Machine
from mbkit.derivation.constraints import ConstraintQuantities
from mbkit.derivation.equations import Equations
from mbkit.derivation.mass_matrix_solve import ConstraintFactors, ConstraintTerms
from mbkit.derivation.model_values import Constants, Values
from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian.energies.energy_form import EnergyForm, QuasiVelocities
from mbkit.lagrangian.energies.kinetic_energy import MAX_SHOWN_LETTERS
from mbkit.lagrangian.energies.symbols import name_of
from mbkit.model import Model

_SAME_NAME: Final = "sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp log sign"
_UNARY: Final[dict[Any, Callable[[Any], Any]]] = {
    **{getattr(sp, name): getattr(ca, name) for name in _SAME_NAME.split()},
    sp.Abs: ca.fabs,
    sp.sec: lambda x: 1 / ca.cos(x),
    sp.csc: lambda x: 1 / ca.sin(x),
    sp.cot: lambda x: ca.cos(x) / ca.sin(x),
}
_COMPARED: Final[dict[Any, Callable[[Any, Any], Any]]] = {
    sp.StrictLessThan: lambda a, b: a < b,
    sp.LessThan: lambda a, b: a <= b,
    sp.StrictGreaterThan: lambda a, b: b < a,
    sp.GreaterThan: lambda a, b: b <= a,
}


class Conversion:
    """Translates SymPy to CasADi, each subexpression once; `number` returns the number or symbol for a float."""

    def __init__(self, symbols: Mapping[sp.Symbol, Any], number: Callable[[float], Any]) -> None:
        self._done: dict[Any, Any] = dict(symbols)
        self._number = number

    def __call__(self, x: Any) -> Any:
        """Return an expression."""
        if x not in self._done:
            self._done[x] = self._converted(x)
        return self._done[x]

    def matrix(self, x: Any) -> Any:
        """Return a column of expressions."""
        return ca.vertcat(ca.SX(0, 1), *(ca.SX(self(e)) for e in x))

    def _converted(self, x: Any) -> Any:
        if x.is_Rational:
            # Two whole numbers are exact where one quotient is rounded.
            top = self._whole(int(x.p))
            return top if x.q == 1 else top / self._whole(int(x.q))
        if x.is_number:
            return self._number(float(x))
        if x.is_Add:
            return sum((self(e) for e in x.args[1:]), self(x.args[0]))
        if x.is_Mul:
            return self._product(x)
        if x.is_Pow:
            return self._power(x.base, x.exp)
        if x.func in _UNARY:
            return _UNARY[x.func](self(x.args[0]))
        if x.func is sp.atan2:
            return ca.atan2(self(x.args[0]), self(x.args[1]))
        if x.func in (sp.Min, sp.Max):
            pick, out = (ca.fmin if x.func is sp.Min else ca.fmax), self(x.args[0])
            for e in x.args[1:]:
                out = pick(out, self(e))
            return out
        if x.func is sp.Piecewise:
            return self._pieces(x)
        if isinstance(x, (AppliedUndef, sp.Derivative, sp.Subs)):
            function = min(x.atoms(AppliedUndef), key=str)
            shown = function if isinstance(x, AppliedUndef) else f"a derivative of {name_of(function)}"
            raise UnsupportedError(
                f"{shown}: an undefined function has no value; give it one with "
                f"substituted({{{name_of(function)}(x): ...}})"
            )
        raise UnsupportedError(
            f"{x.func}: no engine computes this function; there are powers, sin, cos, tan, their inverses, "
            "sinh, cosh, tanh and theirs, exp, log, Abs, sign, Min, Max and Piecewise"
        )

    def _pieces(self, x: Any) -> Any:
        out: Any = ca.SX(np.nan)
        for value, condition in reversed(x.args):
            out = self(value) if condition is sp.true else ca.if_else(self._holds(condition), self(value), out)
        return out

    def _holds(self, condition: Any) -> Any:
        """Return a comparison, or several joined, as 1 or 0."""
        if condition.func in _COMPARED:
            return _COMPARED[condition.func](ca.SX(self(condition.lhs)), ca.SX(self(condition.rhs)))
        if condition.func in (sp.And, sp.Or):
            join, out = (ca.logic_and if condition.func is sp.And else ca.logic_or), self._holds(condition.args[0])
            for e in condition.args[1:]:
                out = join(out, self._holds(e))
            return out
        raise UnsupportedError(f"Piecewise: {condition} is no comparison of numbers, nor several joined by & or |")

    def _whole(self, n: int) -> Any:
        # Small powers of two change no digit, so they need no symbol.
        return float(n) if abs(n) in (0, 1, 2, 4) else self._number(float(n))

    def _product(self, x: Any) -> Any:
        above, below = [], []
        for e in x.args:
            if e.is_Pow and e.exp.is_Rational and e.exp.is_negative:
                below.append(self._power(e.base, -e.exp))
            else:
                above.append(self(e))
        out: Any = 1.0
        for e in above:
            out = out * e
        for e in below:
            out = out / e
        return out

    def _power(self, base: Any, exponent: Any) -> Any:
        if exponent.is_Rational and exponent.is_negative:
            return 1.0 / self._power(base, -exponent)
        if exponent.is_Integer and int(exponent) <= 64:
            return _repeated(self(base), int(exponent))
        if exponent.is_Rational and exponent.q == 2 and int(exponent.p) <= 64:
            return ca.sqrt(_repeated(self(base), int(exponent.p)))
        if base is sp.E:
            return ca.exp(self(exponent))
        return ca.power(self(base), self(exponent))


def _repeated(x: Any, n: int) -> Any:
    """Return xⁿ by squaring: products are exact to rounding in any precision."""
    out = None
    while n:
        if n & 1:
            out = x if out is None else out * x
        n >>= 1
        if n:
            x = x * x
    return 1.0 if out is None else out


# Expressions as functions of arrays, in CasADi's machine.


class Numeric:
    """A matrix of SymPy expressions as a function of arrays, one argument per sequence of symbols."""

    def __init__(self, expressions: Any, *arguments: Sequence[sp.Symbol]) -> None:
        inputs = [ca.SX.sym(f"x{k}", len(symbols)) for k, symbols in enumerate(arguments)]
        self._shape = expressions.shape
        names = {s: x[i] for symbols, x in zip(arguments, inputs, strict=True) for i, s in enumerate(symbols)}
        column = Conversion(names, float).matrix(list(expressions))
        self._machine = Machine(ca.Function("expressions", inputs, [ca.densify(column)], {"cse": True}))

    def __call__(self, *arguments: Array) -> Array:
        """Return the matrix at one state, (m, n), or at each of a batch, (N, m, n)."""
        lead = np.broadcast_shapes(*(x.shape[:-1] for x in arguments))
        rows = [np.ascontiguousarray(np.broadcast_to(x, (*lead, x.shape[-1])), dtype=np.float64) for x in arguments]
        return self._machine(*rows)[0].reshape(*lead, *self._shape)


#: Largest |D⁻¹| |D|: beyond it rates have less than four digits.
_SINGULAR_CONDITION: Final = 1e12


def _short(x: Any) -> str:
    text = str(x)
    return text if len(text) <= MAX_SHOWN_LETTERS else f"{text[:MAX_SHOWN_LETTERS]} ..."


class EnergyEquations(ConstraintQuantities, Equations):
    """The equations derived from T and V; `constants` says how numbers stand in the expressions."""

    def __init__(self, model: Model, form: EnergyForm, constants: Constants = "literal") -> None:
        values = Values(model, constants)
        self.model, self.form, self.elimination = model, form, "mass matrix"
        self.q, self.v = ca.SX.sym("q", model.nq), ca.SX.sym("v", model.nv)
        self.a = ca.SX.sym("a", model.nv)
        self.force = self.tau = ca.SX.sym("tau", model.nv)
        names = {**{p: values.named[p.name] for p in form.parameters}}
        names |= {c: self.q[i] for i, c in enumerate(form.coordinates)}
        names |= {w: self.v[i] for i, w in enumerate(form.velocities)}
        self.time = None
        if form.time is not None:
            self.time = names[form.time] = values.named[form.time.name]
        read = Conversion(names, values.number)
        self._T, self._V, self._R = ca.SX(read(form.T)), ca.SX(read(form.V)), ca.SX(read(form.dissipation))
        self._Q = read.matrix(form.forces)
        #: (γ^k v)_i = Σ_j γ^k_ij v_j of each momentum k; none where velocities are rates.
        self._turns: list[Any] = []
        qdot, pullback = self.v, lambda x: x
        if form.quasi is not None:
            n, gamma = model.nv, form.quasi.hamel_coefficients
            D = ca.reshape(read.matrix(list(form.quasi.D.T)), n, n)
            qdot, pullback = ca.mtimes(D, self.v), lambda x: ca.mtimes(D.T, x)
            turns = (read.matrix([gamma[k, i, j] for j in range(n) for i in range(n)]) for k in range(n))
            self._turns = [ca.mtimes(ca.reshape(turn, n, n), self.v) for turn in turns]
        self.kin = SimpleNamespace(qdot=qdot, pullback=pullback)  # type: ignore[assignment]
        kinds = ("constraints", form.constraints), ("velocity_constraints", form.velocity_constraints)
        rows = tuple(f"{what}[{k}] ({_short(x)})" for what, rows_of_kind in kinds for k, x in enumerate(rows_of_kind))
        f, speeds = (read.matrix(rows_of_kind) for _, rows_of_kind in kinds)
        self.constraints = ConstraintTerms(f, self.q, self.v, self.time, rows, qdot, speeds)
        self.parameters = values.parameters
        self.constants, self.constant_values = values.constants, values.constant_values

    def _turned(self, p: Any) -> Any:
        """Return Σ_jk γ^k_ij v_j p_k, which quasi-velocities add to the rate of a momentum."""
        return sum((turn * p[k] for k, turn in enumerate(self._turns)), ca.SX(self.model.nv, 1))

    kinetic_energy: ca.SX = forwarded("_T", "T(q, v).")
    potential_energy: ca.SX = forwarded("_V", "V(q).")

    @cached_property
    def gravity(self) -> Any:
        """∂V/∂q, springs included; Dᵀ ∂V/∂q in quasi-velocities."""
        return self.kin.pullback(ca.gradient(self._V, self.q))

    @cached_property
    def damping(self) -> Any:
        """Q - ∂R/∂v."""
        return self._Q - ca.gradient(self._R, self.v)

    passive = forwarded("damping", "The same: springs are in V.")

    @cached_property
    def energy_rate(self) -> Any:
        """d/dt (T + V) along (v, a), with the time's own part."""
        E = self._T + self._V
        rate = ca.jtimes(E, ca.vertcat(self.q, self.v), ca.vertcat(self.kin.qdot, self.a))
        return rate if self.time is None else rate + ca.gradient(E, self.time)

    def _inertial(self, a: ca.SX) -> Any:
        """D/dt ∂T/∂v - ∂T/∂q: M a + C v + d."""
        rate = ca.jtimes(self.momentum, ca.vertcat(self.q, self.v), ca.vertcat(self.kin.qdot, a))
        if self.time is not None:
            rate += ca.jacobian(self.momentum, self.time)
        return rate + self._turned(self.momentum) - self.kin.pullback(ca.gradient(self._T, self.q))

    @cached_property
    def coriolis_force(self) -> Any:
        """C(q, v) v, of T2 alone."""
        T2 = 0.5 * ca.dot(self.v, ca.mtimes(self.mass_matrix, self.v))
        p = ca.mtimes(self.mass_matrix, self.v)
        rate = ca.jtimes(p, self.q, self.kin.qdot) + self._turned(p)
        return rate - self.kin.pullback(ca.gradient(T2, self.q))

    @cached_property
    def coriolis_matrix(self) -> Any:
        """Christoffel's C = ½ ∂(C v)/∂v + ½ M A, with A_kj = -(γ^k v)_j; A v = 0, and M A makes Ṁ - 2C skew."""
        if not self._turns:
            return super().coriolis_matrix
        A = -ca.horzcat(*self._turns).T
        return 0.5 * (ca.jacobian(self.coriolis_force, self.v) + ca.mtimes(self.mass_matrix, A))

    @cached_property
    def nle(self) -> Any:
        """C v + d + ∂V/∂q."""
        return self._inertial(ca.SX(self.model.nv, 1)) + self.gravity

    @cached_property
    def constraint_factors(self) -> ConstraintFactors:
        """Factors of M and of J's rows in its metric."""
        return ConstraintFactors(self.constraints, self.mass_matrix, self.elimination_order, careful=True)

    @cached_property
    def _constrained(self) -> tuple[Any, Any]:
        return self.constraint_factors.motion(self.tau + self.generalized_force)

    all_constraints = forwarded("constraints", "The constraints, which are independent of each other.")

    @property
    def constraint_forces(self) -> Any:
        """λ(q, v, τ) of the constraints."""
        return self._constrained[1]

    @cached_property
    def forward_dynamics(self) -> Any:
        """M⁻¹ (τ + τ_passive - nle + Jᵀ λ); every other term of the equation is the one without constraints."""
        if not self.model.constrained:
            return super().forward_dynamics
        return self._constrained[0]

    @cached_property
    def forward_dynamics_derivatives(self) -> tuple[Any, Any, Any]:
        """∂FD/∂q, ∂FD/∂v and ∂FD/∂τ; under constraints the last is M⁻¹ on what they leave free."""
        if not self.model.constrained:
            return super().forward_dynamics_derivatives
        q, v, tau = (ca.jacobian(self.forward_dynamics, x) for x in (self.q, self.v, self.tau))
        return q, v, tau

    @property
    def least_constraint(self) -> None:
        """None: energies are no sum of squares of rates."""

    @property
    def elimination_order(self) -> tuple[int, ...]:
        """The coordinates in their order."""
        return tuple(range(self.model.nv))

    def _frame(self, name: str) -> tuple[str, Any]:
        raise UnsupportedError(f"frame {name!r}: {self.model.name} was written as energies and has no frames")


class VelocityMap:
    """q̇ = D(q) v and its consequences, on arrays of one state or a batch and on CasADi's symbols."""

    def __init__(self, quasi: QuasiVelocities) -> None:
        n = len(quasi.coordinates)
        q, x, y = (ca.SX.sym(name, n) for name in "qxy")
        read = Conversion({c: q[i] for i, c in enumerate(quasi.coordinates)}, float)
        D, W = (ca.reshape(read.matrix(list(A.T)), n, n) for A in (quasi.D, quasi.W))
        moving = ca.mtimes(D, x)
        outputs = {
            "enter": ([q, x], moving),
            "leave": ([q, x], ca.mtimes(W, x)),
            "enter_force": ([q, x], ca.mtimes(W.T, x)),
            "leave_force": ([q, x], ca.mtimes(D.T, x)),
            "acceleration": ([q, x, y], ca.mtimes(D, y) + ca.jtimes(moving, q, moving)),
            "linear": ([q, x], ca.horzcat(ca.jacobian(moving, q), D, W)),
        }
        self._functions = {
            name: ca.Function(name, arguments, [ca.densify(out)], {"cse": True})
            for name, (arguments, out) in outputs.items()
        }
        self._machines = {name: Machine(f) for name, f in self._functions.items()}

    def _call(self, name: str, *arguments: Any) -> Any:
        if isinstance(arguments[0], ca.SX):
            return self._functions[name](*arguments)
        lead = np.broadcast_shapes(*(x.shape[:-1] for x in arguments))
        full = (np.ascontiguousarray(np.broadcast_to(x, (*lead, x.shape[-1]))) for x in arguments)
        return self._machines[name](*full)[0]

    def _column(self, name: str, *arguments: Any) -> Any:
        out = self._call(name, *arguments)
        return out if isinstance(out, ca.SX) else out[..., 0]

    def check_start(self, q: Array, v: Array) -> None:
        """Raise `InputError` where D or its inverse has no value at a state to start from."""
        q, v = np.atleast_2d(q), np.atleast_2d(v)
        _, D, W = self.linear(q, v)
        # cos π/2 is 6e-17, and the inverse of zero is none.
        with np.errstate(invalid="ignore"):
            bad = ~(np.abs(W) @ np.abs(D) < _SINGULAR_CONDITION).all(axis=(1, 2))
        if bad.any():
            raise InputError(
                f"q0: D(q) of q̇ = D v is singular at {q[int(np.argmax(bad))].tolist()}; start elsewhere, "
                "or take other coordinates"
            )

    def to_integrator_velocity(self, q: Any, v: Any) -> Any:
        """Return q̇ = D v."""
        return self._column("enter", q, v)

    def to_body_velocity(self, q: Any, w: Any) -> Any:
        """Return v = D⁻¹ q̇."""
        return self._column("leave", q, w)

    def to_integrator_force(self, q: Any, f: Any) -> Any:
        """Return the force or momentum on q̇ of one on v: D⁻ᵀ f."""
        return self._column("enter_force", q, f)

    def to_body_force(self, q: Any, f: Any) -> Any:
        """Return the force or momentum on v of one on q̇: Dᵀ f."""
        return self._column("leave_force", q, f)

    def acceleration(self, q: Any, v: Any, a: Any) -> Any:
        """Return q̈ = D v̇ + Ḋ v."""
        return self._column("acceleration", q, v, a)

    def linear(self, q: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return ∂(D v)/∂q, D and D⁻¹ at a state, (n, n) each."""
        by_q, D, W = np.split(self._call("linear", q, v), 3, axis=-1)
        return by_q, D, W
