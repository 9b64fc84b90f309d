"""The equations of a system that was written as energies, as CasADi expressions."""

from __future__ import annotations

from functools import cached_property
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import casadi as ca

from mbkit.derivation.equations import Equations
from mbkit.derivation.model_values import Constants, Values
from mbkit.errors import UnsupportedError
from mbkit.lagrangian.constraints.terms import ConstraintTerms, constrained, derivatives
from mbkit.lagrangian.energies.sympy_to_casadi import Conversion

if TYPE_CHECKING:
    from mbkit.lagrangian.energies.model import WrittenModel

__all__ = ["WrittenEquations"]


class WrittenEquations(Equations):
    """The equations of a `WrittenModel`, derived from its T and V as those of a robot are."""

    model: WrittenModel

    def __init__(self, model: WrittenModel, constants: Constants = "literal") -> None:
        values = Values(model, constants)
        self.model = model
        self.q, self.v = ca.SX.sym("q", model.nq), ca.SX.sym("v", model.nv)
        self.a, self.tau = ca.SX.sym("a", model.nv), ca.SX.sym("tau", model.nv)
        s = model.system
        names = {**{p: values.named[p.name] for p in s.parameters}}
        names |= {c: self.q[i] for i, c in enumerate(s.coordinates)}
        names |= {w: self.v[i] for i, w in enumerate(s.velocities)}
        self.time = values.named[model.clock] if model.clock else None
        if s.time is not None:
            names[s.time] = values.named[s.time.name]
        read = Conversion(names, values.number)
        self._T, self._V, self._R = ca.SX(read(s.T)), ca.SX(read(s.V)), ca.SX(read(s.dissipation))
        self._Q = read.matrix(s.forces)
        self.constraints = ConstraintTerms(read.matrix(s.constraints), self.q, self.v, self.time)
        self._kinematics(read)
        self.parameters = values.parameters
        self.constants, self.constant_values = values.constants, values.constant_values

    def _kinematics(self, read: Conversion) -> None:  # noqa: ARG002  # quasi-velocities have something to read
        """Set what velocities are to coordinates: their rates."""
        self.kin = SimpleNamespace(qdot=self.v, pullback=lambda x: x)  # type: ignore[assignment]

    def _turned(self, p: Any) -> Any:  # noqa: ARG002
        """Return what quasi-velocities add to the rate of a momentum."""
        return 0

    @property
    def kinetic_energy(self) -> Any:
        """T(q, v)."""
        return self._T

    @property
    def potential_energy(self) -> Any:
        """V(q)."""
        return self._V

    @cached_property
    def gravity(self) -> Any:
        """∂V/∂q, whatever it comes from."""
        return self.kin.pullback(ca.gradient(self._V, self.q))

    @cached_property
    def damping(self) -> Any:
        """Q - ∂R/∂v."""
        return self._Q - ca.gradient(self._R, self.v)

    @property
    def passive(self) -> Any:
        """The same: springs are in V."""
        return self.damping

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
    def nle(self) -> Any:
        """C v + d + ∂V/∂q."""
        return self._inertial(ca.SX(self.model.nv, 1)) + self.gravity

    @cached_property
    def _constrained(self) -> tuple[Any, Any]:
        return constrained(self)

    @property
    def multipliers(self) -> Any:
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
        """∂FD/∂q, ∂FD/∂v and ∂FD/∂τ, under the constraints."""
        return derivatives(self) if self.model.constrained else super().forward_dynamics_derivatives

    @property
    def least_constraint(self) -> None:
        """Nothing: energies as written are no sum of squares of rates."""

    @property
    def elimination_order(self) -> tuple[int, ...]:
        """The coordinates as they stand."""
        return tuple(range(self.model.nv))

    def _frame(self, name: str) -> tuple[str, Any]:
        raise UnsupportedError(f"frame {name!r}: {self.model.name} was written as energies and has no frames")
