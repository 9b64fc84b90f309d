"""Lagrange's multipliers: forward dynamics under constraints, written out.

::

    M v̇ - Jᵀ λ = τ + applied      J v̇ = -γ

By the factors of M, then by those of J M⁻¹ Jᵀ. The acceleration holds f̈ = 0 and
nothing more: states that drift off the constraints are brought back by who integrates
(`mbkit.simulate.consistent`), with no gains to be chosen as Baumgarte's are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca

from mbkit.derivation.factorize import solve
from mbkit.lagrangian.constraint_terms import weight

if TYPE_CHECKING:
    from mbkit.lagrangian.written_equations import WrittenEquations

__all__ = ["constrained", "derivatives"]


def constrained(eq: WrittenEquations) -> tuple[Any, Any]:
    """Return v̇ and λ as expressions of (q, v, τ)."""
    c, order = eq.constraints, eq.elimination_order
    J, m = c.jacobian, c.value.shape[0]
    W, s = weight(eq)
    force = eq.tau + eq.applied - s * ca.mtimes(J.T, c.gamma)
    both = solve(W, ca.horzcat(force, J.T), order)
    free, Y = both[:, 0], both[:, 1:]
    multipliers = solve(ca.mtimes(J, Y), -c.gamma - ca.mtimes(J, free), range(m))
    return free + ca.mtimes(Y, multipliers), multipliers


def derivatives(eq: WrittenEquations) -> tuple[Any, Any, Any]:
    """Return ∂v̇/∂q, ∂v̇/∂v and ∂v̇/∂τ; the last is M⁻¹ on what the constraints leave free."""
    out = eq.forward_dynamics
    return ca.jacobian(out, eq.q), ca.jacobian(out, eq.v), ca.jacobian(out, eq.tau)
