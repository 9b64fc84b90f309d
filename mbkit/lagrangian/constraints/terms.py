"""Holonomic constraints as expressions: f(q, t), what follows from it, and the functions that are compiled.

Twice differentiated the constraints say J v̇ + γ = 0, with γ of J̇ v and of the time's own derivatives.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import casadi as ca

from mbkit.derivation.mass_matrix_solve import Factors, solve

if TYPE_CHECKING:
    from mbkit.lagrangian.energies.casadi_equations import WrittenEquations

__all__ = ["FUNCTIONS", "ConstraintTerms", "constrained", "derivatives", "stiffening", "weight"]


#: Mass of a coordinate that has none, in terms of the mean one.
_MASSLESS: Final = 1e-20
_TINY: Final = 1e-300


class ConstraintTerms:
    """f and what follows from it, as CasADi expressions of (q, v).

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
        f̈ at v̇ = 0: J̇ v and the time's own terms.
    """

    def __init__(self, value: ca.SX, q: ca.SX, v: ca.SX, time: Any) -> None:
        self.value = value
        self.jacobian = ca.jacobian(value, q)
        self.by_time = ca.SX(value.shape[0], 1) if time is None else ca.jacobian(value, time)
        self.rate = ca.mtimes(self.jacobian, v) + self.by_time
        self.gamma = ca.jtimes(self.rate, q, v)
        if time is not None:
            self.gamma = self.gamma + ca.jacobian(self.rate, time)


def stiffening(eq: WrittenEquations) -> Any:
    """Return s > 0 of each row, (m, 1), so that W = M + Jᵀ diag(s) J has an inverse where M has it on J's null space.

    With J v̇ given, the added term changes neither v̇ nor λ, and coordinates that move no mass need no other way. Of a
    row, s is the mean of two masses that are felt along it, the sum's and the lightest coordinate's: W keeps the
    digits of both, in a loop with a light rod as of a light body on a heavy one.
    """
    J, n = eq.constraints.jacobian, eq.model.nv
    M = ca.diag(eq.mass_matrix)
    masses = M + _MASSLESS / n * ca.sum1(M)
    squares = J**2
    heavy, light = ca.mtimes(squares, masses), ca.mtimes(squares, 1 / masses)
    # Of a row without slope the term is zero.
    return ca.sqrt((heavy + _TINY) / (light + _TINY)) / (ca.sum2(squares) + _TINY)


def weight(eq: WrittenEquations) -> Any:
    """Return W = M + Jᵀ diag(s) J of `stiffening`."""
    J = eq.constraints.jacobian
    return eq.mass_matrix + ca.mtimes(J.T, stiffening(eq) * J)


# The functions that are compiled


def _function(eq: WrittenEquations, name: str, given: dict[str, Any], made: dict[str, Any]) -> ca.Function:
    given = {**given, **eq.trailing}
    dense = [ca.densify(x) for x in made.values()]
    return ca.Function(name, list(given.values()), dense, list(given), list(made), {"cse": True})


def _rows(eq: WrittenEquations) -> ca.Function:
    c = eq.constraints
    return _function(eq, "constraint_rows", {"q": eq.q}, {"f": c.value, "J": c.jacobian})


def _all(eq: WrittenEquations) -> ca.Function:
    c = eq.constraints
    made = {"f": c.value, "J": c.jacobian, "by_time": c.by_time, "rate": c.rate, "W": weight(eq), "M": eq.mass_matrix}
    return _function(eq, "constraint", {"q": eq.q, "v": eq.v}, made)


def _step(eq: WrittenEquations) -> ca.Function:
    """(q, v) -> q after a step of Newton's, v made consistent there, f before it and its scale."""
    c, m = eq.constraints, eq.constraints.value.shape[0]
    W = weight(eq)
    Y = solve(W, c.jacobian.T, eq.elimination_order)
    S = ca.mtimes(c.jacobian, Y)
    q1 = eq.q - ca.mtimes(Y, solve(S, c.value, range(m)))
    Y1, S1, rate1 = (ca.substitute(x, eq.q, q1) for x in (Y, S, c.rate))
    v1 = eq.v - ca.mtimes(Y1, solve(S1, rate1, range(m)))
    scale = ca.sqrt(ca.sum2(c.jacobian**2))
    return _function(eq, "constraint_step", {"q": eq.q, "v": eq.v}, {"q1": q1, "v1": v1, "f": c.value, "scale": scale})


def _multipliers(eq: WrittenEquations) -> ca.Function:
    return _function(eq, "multipliers", {"q": eq.q, "v": eq.v, "tau": eq.tau}, {"lambda": eq.multipliers})


def _embedded(eq: WrittenEquations) -> ca.Function:
    c = eq.constraints
    made = {"J": c.jacobian, "by_time": c.by_time, "gamma": c.gamma, "M": eq.mass_matrix, "force": eq.applied}
    return _function(eq, "embedded", {"q": eq.q, "v": eq.v}, made)


def _curvature(eq: WrittenEquations) -> ca.Function:
    """(q, λ) -> ∂(Jᵀ λ)/∂q; λ takes the place of v's first entries."""
    c = eq.constraints
    m = c.value.shape[0]
    pull = ca.mtimes(c.jacobian.T, eq.v[:m])
    return _function(eq, "curvature", {"q": eq.q, "v": eq.v}, {"H": ca.jacobian(pull, eq.q)})


#: Name -> what derives it.
FUNCTIONS: Final = {
    "constraint_rows": _rows,
    "constraint": _all,
    "constraint_step": _step,
    "multipliers": _multipliers,
    "embedded": _embedded,
    "curvature": _curvature,
}


# Lagrange's multipliers: forward dynamics under constraints, written out.
#
# ::
#
#     M v̇ - Jᵀ λ = τ + applied      J v̇ = -γ
#
# By the factors of W = M + Jᵀ diag(s) J, then by those of J W⁻¹ Jᵀ, and by refinement with what is left of both
# equations: near a singular pose of J, and with masses that differ by decades, the factors lose the square of the
# digits
# that the equations themselves lose. The acceleration holds f̈ = 0 and
# nothing more: states that drift off the constraints are brought back by who integrates
# (`mbkit.simulate.constraint_projection`), with no gains to be chosen as Baumgarte's are.

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
