"""First partial derivatives of inverse and forward dynamics, for linearization and optimal control.

The derivative with respect to q is the one along the configuration manifold:
column k is d/dt f(q ⊕ t e_k) at t = 0, with `Model.integrate`'s ⊕. Its tangent is
q̇ = D(q) e_k, so the column is one directional derivative along a column of D; for
joints whose velocities are their coordinates' rates it is plain ∂/∂q. Components
of v, a and τ are held fixed, those in moving axes (free and ball joints) too.

Forward dynamics is never differentiated through its factorization. From
ID(q, v, FD(q, v, τ)) = τ follows, at a = FD (Carpentier and Mansard 2018, Analytical
Derivatives of Rigid Body Dynamics Algorithms)::

    ∂FD/∂q = -M⁻¹ ∂ID/∂q      ∂FD/∂v = -M⁻¹ ∂ID/∂v      ∂FD/∂τ = M⁻¹
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from mbkit._check import Array

if TYPE_CHECKING:
    from mbkit.derivation.equations import Equations

__all__ = [
    "ForwardDynamicsDerivatives",
    "InverseDynamicsDerivatives",
    "forward_dynamics",
    "inverse_dynamics",
    "through_inverse",
]


class InverseDynamicsDerivatives(NamedTuple):
    """Derivatives of τ = M a + nle - τ_passive, each (nv, nv) or (N, nv, nv).

    Attributes
    ----------
    q : array
        ∂τ/∂q along the manifold: column k is that of q ⊕ t e_k.
    v : array
        ∂τ/∂v.
    a : array
        ∂τ/∂a, the mass matrix.
    """

    q: Array
    v: Array
    a: Array


class ForwardDynamicsDerivatives(NamedTuple):
    """Derivatives of v̇ = M⁻¹ (τ + τ_passive - nle), each (nv, nv) or (N, nv, nv).

    Attributes
    ----------
    q : array
        ∂v̇/∂q along the manifold: column k is that of q ⊕ t e_k.
    v : array
        ∂v̇/∂v.
    tau : array
        ∂v̇/∂τ, the inverse of the mass matrix.
    """

    q: Array
    v: Array
    tau: Array


def inverse_dynamics(eq: Equations) -> tuple[Any, Any, Any]:
    """Return ∂ID/∂q, ∂ID/∂v and ∂ID/∂a as expressions of (q, v, a)."""
    tangent = ca.jacobian(eq.kin.qdot, eq.v)
    by_q = ca.jtimes(eq.inverse_dynamics, eq.q, tangent)
    return by_q, ca.jacobian(eq.inverse_dynamics, eq.v), eq.mass_matrix


def forward_dynamics(eq: Equations) -> tuple[Any, Any, Any]:
    """Return ∂FD/∂q, ∂FD/∂v and ∂FD/∂τ as expressions of (q, v, τ)."""
    by_q, by_v, _ = inverse_dynamics(eq)
    n = eq.model.nv
    by_q, by_v = ca.substitute([by_q, by_v], [eq.a], [eq.forward_dynamics])
    out = eq.over_mass(ca.horzcat(-by_q, -by_v, ca.SX.eye(n)))
    by_q, by_v, by_tau = ca.horzsplit(out, [0, n, 2 * n, 3 * n])
    return by_q, by_v, by_tau


def through_inverse(inverse_derivatives: Array) -> Array:
    """Return the three derivatives of forward dynamics from those of inverse dynamics.

    Parameters
    ----------
    inverse_derivatives : (nv, 3 nv) or (N, nv, 3 nv) array
        ∂ID/∂q, ∂ID/∂v and M side by side, at a = FD(q, v, τ).

    Returns
    -------
    (nv, 3 nv) or (N, nv, 3 nv) array
        ∂FD/∂q, ∂FD/∂v and ∂FD/∂τ side by side.
    """
    by_q, by_v, M = np.split(inverse_derivatives, 3, axis=-1)
    unit = np.broadcast_to(np.eye(M.shape[-1]), M.shape)
    return np.asarray(np.linalg.solve(M, np.concatenate([-by_q, -by_v, unit], axis=-1)))
