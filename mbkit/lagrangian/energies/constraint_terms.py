"""Holonomic constraints f(q, t) = 0 as CasADi expressions, and forward dynamics with multipliers."""

from __future__ import annotations

from typing import Any, Final

import casadi as ca

from mbkit.derivation.mass_matrix_solve import Factors

__all__ = ["ConstraintTerms", "constrained"]

#: Mass of a coordinate that has none, in terms of the mean one.
_MASSLESS: Final = 1e-20
_TINY: Final = 1e-300
#: Times that a solution is refined. Each time leaves what the factors lose of the error before.
_REFINED: Final = 2


class ConstraintTerms:
    """f and its derivatives, of (q, v); f̈ = J v̇ + γ.

    Attributes
    ----------
    value : (m, 1) casadi.SX
        f.
    jacobian : (m, n) casadi.SX
        J = ∂f/∂q.
    by_time : (m, 1) casadi.SX
        ∂f/∂t.
    rate : (m, 1) casadi.SX
        ḟ = J v + ∂f/∂t.
    gamma : (m, 1) casadi.SX
        γ = f̈ at v̇ = 0: J̇ v and the time's own terms.
    """

    def __init__(self, value: ca.SX, q: ca.SX, v: ca.SX, time: Any) -> None:
        self.value = value
        self.jacobian = ca.jacobian(value, q)
        self.by_time = ca.SX(value.shape[0], 1) if time is None else ca.jacobian(value, time)
        self.rate = ca.mtimes(self.jacobian, v) + self.by_time
        self.gamma = ca.jtimes(self.rate, q, v)
        if time is not None:
            self.gamma = self.gamma + ca.jacobian(self.rate, time)

    def stiffening(self, M: Any) -> Any:
        """Return s > 0, (m, 1), so that W = M + Jᵀ diag(s) J has an inverse where M has it on J's null space.

        With J v̇ given, the added term changes neither v̇ nor λ, and coordinates that move no mass need no other way.
        Of a row, s is the mean of two masses that are felt along it, the sum's and the lightest coordinate's: W keeps
        the digits of both, in a loop with a light rod as of a light body on a heavy one.
        """
        masses = ca.diag(M)
        masses = masses + _MASSLESS / masses.shape[0] * ca.sum1(masses)
        squares = self.jacobian**2
        heavy, light = ca.mtimes(squares, masses), ca.mtimes(squares, 1 / masses)
        # Of a row without slope the term is zero.
        return ca.sqrt((heavy + _TINY) / (light + _TINY)) / (ca.sum2(squares) + _TINY)

    def weight(self, M: Any) -> Any:
        """Return W = M + Jᵀ diag(s) J of `stiffening`."""
        return M + ca.mtimes(self.jacobian.T, self.stiffening(M) * self.jacobian)


def constrained(c: ConstraintTerms, M: Any, force: Any, order: tuple[int, ...]) -> tuple[Any, Any]:
    """Return v̇ and λ of M v̇ - Jᵀ λ = force, J v̇ = -γ.

    By the factors of W = M + Jᵀ diag(s) J in an elimination order, then by those of J W⁻¹ Jᵀ, and by refinement with
    the residuals of both equations: near a singular pose of J, and with masses that differ by decades, the factors
    lose the square of the digits that the equations themselves lose. The acceleration holds f̈ = 0 only: integrators
    project states that drift off the constraints (`mbkit.simulate.constraint_projection`), so that no gains as
    Baumgarte's are needed.
    """
    J, m = c.jacobian, c.value.shape[0]
    s = c.stiffening(M)
    W = Factors(M + ca.mtimes(J.T, s * J), order)
    Y = W.solve(J.T)
    S = Factors(ca.mtimes(J, Y), range(m))

    def solved(force: Any, rate: Any) -> tuple[Any, Any]:
        """Return x and λ of M x - Jᵀ λ = force, J x = rate."""
        free = W.solve(force + ca.mtimes(J.T, s * rate))
        multipliers = S.solve(rate - ca.mtimes(J, free))
        return free + ca.mtimes(Y, multipliers), multipliers

    a, multipliers = solved(force, -c.gamma)
    for _ in range(_REFINED):
        left = force - ca.mtimes(M, a) + ca.mtimes(J.T, multipliers)
        da, more = solved(left, -c.gamma - ca.mtimes(J, a))
        a, multipliers = a + da, multipliers + more
    return a, multipliers
