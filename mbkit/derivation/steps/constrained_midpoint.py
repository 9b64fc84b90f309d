"""The midpoint rule in (q, p) under constraints f(q, t) = 0: RATTLE's form of it, symplectic on the manifold.

The discrete Lagrangian is that of `mbkit.derivation.steps.midpoint`, with f = 0 at both ends of each step (Marsden and
West 2001, Discrete mechanics and variational integrators, ch. 3.4 and 3.5). With J0 and J1 at the ends and the names of
that module, plain coordinates have ::

    p0 + J0ᵀ λ = μ - h/2 f_m      f(q1) = 0      p1 = p0 + J0ᵀ λ + h f_m + J1ᵀ κ      J1 v1 + ∂f/∂t = 0

λ takes q1 onto the constraints, and κ takes p1 = M v1 + b onto their tangent, as in RATTLE (Andersen 1983; Hairer,
Lubich, Wanner 2006, Geometric Numerical Integration, ch. VII.1.4), with the forces at the midpoint. The map from
(q0, p0) to (q1, p1) keeps the symplectic form of the constrained phase space, has order 2, and is its own inverse under
h -> -h. Rotations and free joints are those of the unconstrained rule: λ and κ are momenta that are added at the ends,
in the axes there.

The unknowns of a step are w and, behind it, λ.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Final

import casadi as ca

from mbkit.derivation.steps.fixed import at_time
from mbkit.derivation.steps.midpoint import Midpoint, is_last, is_lost
from mbkit.derivation.steps.rosenbrock import Factors

#: Slope of a row without one, and mass along one that moves links without mass alone.
_MIN_SLOPE: Final = 1e-150


class ConstrainedMidpoint(Midpoint):
    """The parts of a step under constraints, with the names and arguments of `Midpoint`'s."""

    # Equations under constraints have more than `Equations`.
    _equations: Any

    def __init__(self, equations: Any) -> None:
        # Before the parts get their sizes.
        self._rows: int = equations.constraints.value.shape[0]
        super().__init__(equations)

    def _size_of_unknowns(self) -> int:
        return super()._size_of_unknowns() + self._rows

    @cached_property
    def _constraints(self) -> ca.Function:
        """(q) -> f, Jᵀ on the velocities of the integrators' space as columns, and ∂f/∂t."""
        eq, space = self._equations, self._space
        c = eq.constraints
        columns = [space.to_integrator_force(eq.q, c.jacobian[i, :].T) for i in range(self._rows)]
        outs = [c.value, ca.horzcat(ca.SX(eq.model.nv, 0), *columns), c.by_time]
        return ca.Function("constraints", [eq.q, *eq.extra_arguments.values()], outs)

    @cached_property
    def _held(self) -> ca.Function:
        """(q, p) -> v with J v + ∂f/∂t = 0 and κ of M v + b = p + Jᵀ κ, in mbkit's velocity."""
        eq = self._equations
        p = ca.SX.sym("p", eq.model.nv)
        at_rest = ca.substitute(eq.momentum, eq.v, ca.SX.zeros(eq.model.nv))
        outs = eq.constraint_factors.solved(p - at_rest, -eq.constraints.by_time)
        return ca.Function("held", [eq.q, p, *eq.extra_arguments.values()], [*outs])

    def _at(self, part: float) -> Any:
        """Return the extra arguments this part of a step behind its middle, at which they are given."""
        return at_time(self._equations, part * self._s["dt"]).values()

    def _split(self) -> tuple[Any, Any]:
        w, multipliers = ca.vertsplit(self._s["w"], [0, self._equations.model.nv, self.unknowns])
        return w, multipliers

    def _whole(self, w: Any, multipliers: Any) -> tuple[Any, Any, Any]:
        """Return the residual of the momentum, of the constraints at the end over the step, and J0ᵀ."""
        s = self._s
        _, mu, f = self._at_midpoint(w)
        _, pushes, _ = self._constraints(s["q"], *self._at(-0.5))
        start = self._space.to_body(s["q"], s["pi"]) + ca.mtimes(pushes, multipliers)
        momentum = self._space.discrete(s["dt"] * w, mu, f, s["dt"]) - start
        end = self._constraints(self._space.retract(s["q"], s["dt"] * w), *self._at(0.5))[0]
        return momentum, end / s["dt"], pushes

    def _system(self) -> tuple[Any, Any]:
        momentum, end, _ = self._whole(*self._split())
        residual = ca.vertcat(momentum, end)
        return residual, ca.jacobian(residual, self._s["w"])

    def _newton(self) -> tuple[Any, Any]:
        s, eq = self._s, self._equations
        w, multipliers = self._split()
        # λ enters linearly, and each iteration solves for it: the residual without it is that of w.
        momentum, end, pushes = self._whole(w, 0 * multipliers)
        by_w, slopes = ca.jacobian(momentum, s["w"])[:, : eq.model.nv], ca.jacobian(end, s["w"])[:, : eq.model.nv]
        if eq.constraint_factors.careful:
            weight = ca.mtimes(pushes, ca.diag(self._masses(s["q"], *self._at(-0.5))))
            momentum, by_w = momentum + ca.mtimes(weight, end), by_w + ca.mtimes(weight, slopes)
        factors = Factors.of(by_w, eq.elimination_order)
        free, *columns = (
            factors.applied(factors.values, ca.vertsplit(x)) for x in (momentum, *ca.horzsplit(ca.densify(pushes)))
        )
        Y = ca.horzcat(*columns)
        # (A - J0ᵀ; C 0) (dw; λ) = -(momentum; end): C A⁻¹ J0ᵀ λ = C A⁻¹ momentum - end.
        S = Factors.of(ca.mtimes(slopes, Y), range(self._rows))
        new = S.applied(S.values, ca.vertsplit(ca.mtimes(slopes, free) - end))
        change = free - ca.mtimes(Y, new)
        return ca.vertcat(w - change, new), 1 - is_last(change, w - change, s["q"], s["dt"])

    @cached_property
    def _masses(self) -> ca.Function:
        """(q) -> s > 0 of each row, the mean mass along it: J0ᵀ diag(s) J1 has an inverse where the mass has none.

        The term is zero with the constraints, and as heavy as the links that are not without mass.
        """
        eq = self._equations
        squares, masses = eq.constraints.jacobian**2, ca.diag(eq.mass_matrix)
        out = (ca.mtimes(squares, masses) + _MIN_SLOPE) / (ca.sum2(squares) + _MIN_SLOPE) ** 2
        return ca.Function("masses", [eq.q, *eq.extra_arguments.values()], [out])

    def _end(self) -> tuple[Any, ...]:
        s, h, space = self._s, self._s["dt"], self._space
        w, multipliers = self._split()
        q_m, _, f = self._at_midpoint(w)
        q1 = space.retract(s["q"], h * w)
        _, pushes, _ = self._constraints(s["q"], *self._at(-0.5))
        pi1 = s["pi"] + space.to_fixed(s["q"], ca.mtimes(pushes, multipliers)) + h * space.to_fixed(q_m, f)
        _, pushes1, _ = self._constraints(q1, *self._at(0.5))
        _, kappa = self._held(q1, space.to_body_force(q1, space.to_body(q1, pi1)), *self._at(0.5))
        pi1 = pi1 + space.to_fixed(q1, ca.mtimes(pushes1, kappa))
        return q1, pi1, self._guess(), s["misses"] + s["miss"] + is_lost(q1, pi1)

    def _velocity(self) -> tuple[Any]:
        s, space = self._s, self._space
        p = space.to_body_force(s["q"], space.to_body(s["q"], s["pi"]))
        return (self._held(s["q"], p, *self._equations.extra_arguments.values())[0],)
