"""Lagrange's multipliers: forward dynamics under constraints, written out.

::

    M v̇ - Jᵀ λ = τ + applied      J v̇ = -γ

By the factors of W = M + Jᵀ diag(s) J, then by those of J W⁻¹ Jᵀ, and by refinement with what is left of both
equations: near a singular pose of J, and with masses that differ by decades, the factors lose the square of the digits
that the equations themselves lose. The acceleration holds f̈ = 0 and
nothing more: states that drift off the constraints are brought back by who integrates
(`mbkit.simulate.consistent`), with no gains to be chosen as Baumgarte's are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import casadi as ca

from mbkit.derivation.factorize import Factors
from mbkit.lagrangian.constraint_terms import stiffening

if TYPE_CHECKING:
    from mbkit.lagrangian.written_equations import WrittenEquations

__all__ = ["constrained", "derivatives"]

#: Times that a solution is refined. Each time leaves what the factors lose of the error before.
_REFINED: Final = 2


def constrained(eq: WrittenEquations) -> tuple[Any, Any]:
    """Return v̇ and λ as expressions of (q, v, τ)."""
    c, M = eq.constraints, eq.mass_matrix
    J, m = c.jacobian, c.value.shape[0]
    s = stiffening(eq)
    W = Factors(M + ca.mtimes(J.T, s * J), eq.elimination_order)
    Y = W.solve(J.T)
    S = Factors(ca.mtimes(J, Y), range(m))

    def solved(force: Any, rate: Any) -> tuple[Any, Any]:
        """Return x and λ of M x - Jᵀ λ = force, J x = rate."""
        free = W.solve(force + ca.mtimes(J.T, s * rate))
        multipliers = S.solve(rate - ca.mtimes(J, free))
        return free + ca.mtimes(Y, multipliers), multipliers

    force = eq.tau + eq.applied
    a, multipliers = solved(force, -c.gamma)
    for _ in range(_REFINED):
        left = force - ca.mtimes(M, a) + ca.mtimes(J.T, multipliers)
        da, more = solved(left, -c.gamma - ca.mtimes(J, a))
        a, multipliers = a + da, multipliers + more
    return a, multipliers


def derivatives(eq: WrittenEquations) -> tuple[Any, Any, Any]:
    """Return ∂v̇/∂q, ∂v̇/∂v and ∂v̇/∂τ; the last is M⁻¹ on what the constraints leave free."""
    out = eq.forward_dynamics
    return ca.jacobian(out, eq.q), ca.jacobian(out, eq.v), ca.jacobian(out, eq.tau)
