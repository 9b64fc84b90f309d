"""From energies to the equation of motion, each quantity derived when it is asked for.

Boltzmann and Hamel's form of Lagrange's equations (Greenwood 2003, Advanced
Dynamics, ch. 4.3), with momenta p = ∂T/∂v::

    d/dt p + hamel(v, p) - Dᵀ ∂T/∂q + Dᵀ ∂V/∂q = τ + τ_damping

For coordinate velocities D = 1 and the hamel term vanishes: Lagrange's own form.
d/dt p is one directional derivative along (D v, a).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit.errors import UnknownNameError
from mbkit.lagrangian import energies
from mbkit.lagrangian.factorize import solve
from mbkit.lagrangian.kinematics import Kinematics, add, constant_times
from mbkit.model import Model
from mbkit.model.kinds import cross3

__all__ = ["FUNCTIONS", "Equations"]

#: Name of each quantity -> the arguments of its function.
FUNCTIONS: Final = {
    "mass_matrix": ("q",),
    "coriolis_matrix": ("q", "v"),
    "gravity": ("q",),
    "nle": ("q", "v"),
    "coriolis_force": ("q", "v"),
    "passive": ("q", "v"),
    "inverse_dynamics": ("q", "v", "a"),
    "forward_dynamics": ("q", "v", "tau"),
    "kinetic_energy": ("q", "v"),
    "potential_energy": ("q",),
    "energy_rate": ("q", "v", "a"),
}


class Equations:
    """The equations of motion of a model as CasADi expressions and functions."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.kin = Kinematics(model)
        self.q, self.v = self.kin.q, self.kin.v
        self.a = ca.SX.sym("a", model.nv)
        self.tau = ca.SX.sym("tau", model.nv)

    @cached_property
    def kinetic_energy(self) -> Any:
        """T(q, v)."""
        return energies.kinetic_energy(self.kin)

    @cached_property
    def momentum(self) -> Any:
        """p = ∂T/∂v."""
        return ca.gradient(self.kinetic_energy, self.v)

    @cached_property
    def potential_energy(self) -> Any:
        """V(q) of gravity and springs."""
        return energies.gravity_energy(self.kin) + energies.spring_energy(self.kin)

    @cached_property
    def energy_rate(self) -> Any:
        """d/dt (T + V) along (D v, a)."""
        along = ca.vertcat(self.kin.qdot, self.a)
        return ca.jtimes(self.kinetic_energy + self.potential_energy, ca.vertcat(self.q, self.v), along)

    @cached_property
    def gravity(self) -> Any:
        """g = Dᵀ ∂V_gravity/∂q."""
        return self.kin.pullback(ca.gradient(energies.gravity_energy(self.kin), self.q))

    @cached_property
    def passive(self) -> Any:
        """Forces of springs and dampers."""
        stored = self.kin.pullback(ca.gradient(energies.spring_energy(self.kin), self.q))
        return energies.damping_forces(self.kin) - stored

    @cached_property
    def _hamel(self) -> Any:
        parts: list[Any] = []
        for joint in self.model.independent_joints:
            part = self.model.layout.v[joint.name]
            p = [self.momentum[i] for i in range(part.start, part.stop)]
            parts += joint.type.hamel(self.kin.velocities(joint), p)
        return ca.vertcat(ca.SX(0, 1), *parts)

    def _inertial(self, a: ca.SX) -> Any:
        """M a + C v."""
        along = ca.vertcat(self.kin.qdot, a)
        rate = ca.jtimes(self.momentum, ca.vertcat(self.q, self.v), along)
        return rate + self._hamel - self.kin.pullback(ca.gradient(self.kinetic_energy, self.q))

    @cached_property
    def coriolis_force(self) -> Any:
        """C(q, v) v."""
        return self._inertial(ca.SX(self.model.nv, 1))

    @cached_property
    def nle(self) -> Any:
        """C v + g."""
        return self.coriolis_force + self.gravity

    @cached_property
    def inverse_dynamics(self) -> Any:
        """M a + C v + g - τ_passive."""
        return self._inertial(self.a) + self.gravity - self.passive

    @cached_property
    def mass_matrix(self) -> Any:
        """M = ∂p/∂v."""
        return ca.jacobian(self.momentum, self.v)

    @cached_property
    def coriolis_matrix(self) -> Any:
        """Christoffel's C = ½ ∂(C v)/∂v + ½ M A(v).

        A holds the quasi-velocities' structure: [[ω̂, v̂], [0, ω̂]] for a free joint
        and ω̂ for a ball joint, zero otherwise. A(v) v = 0 leaves C v as it is, and
        the second term makes Ṁ - 2C skew.
        """
        half = 0.5 * ca.jacobian(self.coriolis_force, self.v)
        if not self.model.quaternions:
            return half
        A: Any = ca.SX(self.model.nv, self.model.nv)
        for joint in self.model.independent_joints:
            start = self.model.layout.v[joint.name].start
            if joint.kind == "ball":
                A[start : start + 3, start : start + 3] = ca.skew(self.v[start : start + 3])
            elif joint.kind == "free":
                linear, angular = self.v[start : start + 3], self.v[start + 3 : start + 6]
                A[start : start + 3, start : start + 3] = ca.skew(angular)
                A[start : start + 3, start + 3 : start + 6] = ca.skew(linear)
                A[start + 3 : start + 6, start + 3 : start + 6] = ca.skew(angular)
        return half + 0.5 * ca.mtimes(self.mass_matrix, A)

    @cached_property
    def applied(self) -> Any:
        """τ_passive - C v - g: what accelerates a system without τ."""
        return self.passive - self.nle

    @cached_property
    def forward_dynamics(self) -> Any:
        """M⁻¹ (τ + τ_passive - C v - g), by the tree's sparse factorisation."""
        return solve(self.mass_matrix, self.tau + self.applied, self.elimination_order)

    @cached_property
    def elimination_order(self) -> tuple[int, ...]:
        """Velocity indices with every parent before its children."""
        parts = [self.model.layout.v[j.name] for j in self.model.tree]
        return tuple(i for part in parts for i in range(part.start, part.stop))

    def elimination_size(self) -> int:
        """Return about how many multiplications `forward_dynamics` adds to M and nle."""
        pattern = np.array(ca.DM(self.mass_matrix.sparsity(), 1).full(), dtype=bool)
        order = list(self.elimination_order)
        below = np.tril(pattern[np.ix_(order, order)]).sum(axis=1)
        return int((below * below).sum())

    def function(self, name: str) -> ca.Function:
        """Return a quantity as a function of its arguments."""
        if name not in FUNCTIONS:
            raise UnknownNameError("quantity", name, FUNCTIONS)
        symbols = {"q": self.q, "v": self.v, "a": self.a, "tau": self.tau}
        names = FUNCTIONS[name]
        return self.named(name, names, [symbols[n] for n in names], getattr(self, name))

    def applied_function(self) -> ca.Function:
        """Return M and τ_passive - nle together, for a numerical solution."""
        outs = [ca.densify(self.mass_matrix), ca.densify(self.applied)]
        return ca.Function("mass_and_force", [self.q, self.v], outs, ["q", "v"], ["M", "f"], {"cse": True})

    def named(self, name: str, argument_names: Any, arguments: list[ca.SX], out: ca.SX) -> ca.Function:
        """Return one dense output as a function."""
        return ca.Function(name, arguments, [ca.densify(out)], list(argument_names), [name], {"cse": True})

    def pose(self, frame: str) -> ca.Function:
        """Return X_WF(q), 4 by 4."""
        f = self.model.frame(frame)
        columns = [self.kin.to_world(f.body, [float(x) for x in f.rotation[:, k]], 0.0) for k in range(3)]
        columns.append(self.kin.to_world(f.body, [float(x) for x in f.translation]))
        top = ca.horzcat(*(ca.vertcat(*c) for c in columns))
        X = ca.vertcat(ca.SX(top), ca.SX([[0.0, 0.0, 0.0, 1.0]]))
        return self.named("pose", ["q"], [self.q], X)

    def jacobian(self, frame: str, axes: str) -> ca.Function:
        """Return the Jacobian of a frame's velocity, linear then angular."""
        f = self.model.frame(frame)
        linear, angular = self.kin.twists[f.body]
        linear = add(linear, cross3(angular, [float(x) for x in f.translation]))
        if axes == "world":
            halves = [self.kin.to_world(f.body, x, 0.0) for x in (linear, angular)]
        else:
            halves = [constant_times(f.rotation.T, x) for x in (linear, angular)]
        twist = ca.vertcat(*(ca.SX(x) for half in halves for x in half))
        return self.named("jacobian", ["q"], [self.q], ca.jacobian(twist, self.v))
