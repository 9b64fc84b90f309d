"""The equations of motion in quasi-velocities, Boltzmann's and Hamel's; see `mbkit.lagrangian.quasi`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import sympy as sp

from mbkit.lagrangian.motion import EquationsOfMotion
from mbkit.lagrangian.tidy import tidy, tidy_matrix

if TYPE_CHECKING:
    from mbkit.lagrangian.quasi import QuasiLagrangian

__all__ = ["QuasiEquationsOfMotion", "quasi_equations"]


@dataclass(frozen=True)
class QuasiEquationsOfMotion(EquationsOfMotion):
    """M ẇ + C w + d + Dᵀ ∂V/∂q = Dᵀ Q, with q̇ = D w.

    `velocities` are w, `potential_gradient` is Dᵀ ∂V/∂q and `forces` Dᵀ Q. C is Christoffel's
    with the structure of D in it, so that Ṁ - 2C is skew.

    Attributes
    ----------
    D : (n, n) sympy.Matrix
    rates : tuple of sympy.Symbol
        q̇.
    hamel_coefficients : (n, n, n) sympy array
        γ, with ``hamel_coefficients[k, i, j]`` = γ^k_ij.
    """

    D: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 0, []))
    rates: tuple[sp.Symbol, ...] = ()
    hamel_coefficients: sp.ImmutableDenseNDimArray = field(default_factory=lambda: sp.ImmutableDenseNDimArray([]))

    def kinematics(self) -> tuple[sp.Eq, ...]:
        """Return q̇ = D w, one equation per coordinate."""
        right = self.D * sp.Matrix(self.velocities)
        return tuple(sp.Eq(a, b, evaluate=False) for a, b in zip(self.rates, right, strict=True))


def quasi_equations(system: QuasiLagrangian) -> QuasiEquationsOfMotion:
    """Return Boltzmann's and Hamel's equations of a system, term by term."""
    k, n, t = system.kinetic, len(system.coordinates), system.time
    v, gamma, w = sp.Matrix(system.velocities), system.hamel_coefficients, system.velocities
    drift = sp.zeros(n, 1)
    if any(k.b) or k.T0 != 0:
        slope = sp.Matrix.hstack(*_along(system, k.b))
        turned = sp.Matrix(n, n, lambda i, j: sum(gamma[h, i, j] * k.b[h] for h in range(n)))
        drift += (slope - slope.T + turned) * v - sp.Matrix(_along(system, k.T0))
    if t is not None:
        drift += sp.diff(k.M, t) * v + sp.diff(k.b, t)
    friction = sp.Matrix([sp.diff(system.dissipation, x) for x in w])
    return QuasiEquationsOfMotion(
        coordinates=system.coordinates,
        velocities=w,
        accelerations=system.accelerations,
        mass_matrix=k.M,
        coriolis_matrix=_coriolis_matrix(system),
        drift=tidy_matrix(drift),
        potential_gradient=tidy_matrix(_along(system, system.V)),
        forces=tidy_matrix(sp.Matrix(system.forces) + system.input_forces - friction),
        D=system.D,
        rates=system.system.velocities,
        hamel_coefficients=gamma,
    )


def _along(system: QuasiLagrangian, x: Any) -> list[Any]:
    """Return the derivative of x along each column of D."""
    by = [sp.diff(x, q) for q in system.coordinates]
    n = len(by)
    return [sum((system.D[r, i] * by[r] for r in range(n)), 0 * x) for i in range(n)]


def _coriolis_matrix(system: QuasiLagrangian) -> sp.ImmutableMatrix:
    """Return C_ij = ½ Σ_k (D_k M_ij + D_j M_ik - D_i M_jk + c_ikj - c_jki - c_kji) w_k.

    Koszul's formula for the connection of M in the frame of D's columns, with D_k the derivative
    along a column and c_lij = Σ_h M_lh γ^h_ij.
    """
    M, n, gamma = system.kinetic.M, len(system.coordinates), system.hamel_coefficients
    slopes = _along(system, sp.Matrix(M))
    c = [[[sum(M[h, m] * gamma[m, i, j] for m in range(n)) for j in range(n)] for i in range(n)] for h in range(n)]

    def entry(i: int, j: int) -> sp.Expr:
        terms = (
            (slopes[k][i, j] + slopes[j][i, k] - slopes[i][j, k] + c[i][k][j] - c[j][k][i] - c[k][j][i])
            * system.velocities[k]
            for k in range(n)
        )
        return tidy(sum(terms, sp.Integer(0)) / 2)

    return sp.ImmutableMatrix(n, n, entry)
