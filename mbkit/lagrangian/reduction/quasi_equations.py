"""Quasi-velocities: a system's equations in velocities w that are no coordinates' rates, q̇ = D(q, t) w + e(q, t).

Boltzmann and Hamel's equations (Greenwood 2003, Advanced Dynamics, ch. 4.3), with T(q, w, t) and p_k = ∂T/∂w_k::

    d/dt ∂T/∂w_i  -  Σ_r D_ri ∂T/∂q_r  +  Σ_k (Σ_j γ^k_ij w_j + γ^k_i0) p_k  =  Σ_r D_ri (Q_r - ∂V/∂q_r)

    γ^k_ij = Σ_rs (∂W_kr/∂q_s - ∂W_ks/∂q_r) D_ri D_sj          W = D⁻¹
    γ^k_i0 = Σ_r W_kr (Σ_s D_si ∂e_r/∂q_s - e_s ∂D_ri/∂q_s - ∂D_ri/∂t)

The time is a coordinate with the rate 1 there, and (e, 1) the column D_0 beside the others: γ^k_i0 are the terms of
transport, which a frame has that moves by itself.

The upper index k belongs to the momentum, i to the equation, j to the velocity; γ is skew in i and j. The columns of D
are vector fields whose Lie brackets it holds: [D_i, D_j] = Σ_k γ^k_ij D_k. For a rotation and body-axes rates γ^k_ij =
ε_ijk, and the term is ω × p, Euler's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian.energies.energy_form import EnergyForm, QuasiVelocities, read_expression, symbols_of
from mbkit.lagrangian.energies.equations_of_motion import EquationsOfMotion, constraint_fields
from mbkit.lagrangian.energies.kinetic_energy import KineticSplit, inverse
from mbkit.lagrangian.energies.symbols import fits, listed, velocity_of
from mbkit.lagrangian.trig.simplify import gradient, settled, settled_matrix, tidy, tidy_matrix


@dataclass(frozen=True, repr=False)
class QuasiEquationsOfMotion(EquationsOfMotion):
    """M ẇ + C w + d + Dᵀ ∂V/∂q = Dᵀ Q, with q̇ = D w + e.

    `velocities` are w, `potential_gradient` is Dᵀ ∂V/∂q and `forces` Dᵀ Q. C is Christoffel's
    with the structure of D in it, so that Ṁ - 2C is skew where D and M do not depend on the time and e is zero. d has
    the terms of transport as well.

    Attributes
    ----------
    D : (n, n) sympy.Matrix
    rates : tuple of sympy.Symbol
        q̇.
    hamel_coefficients : (n, n, n) sympy array
        γ, with ``hamel_coefficients[k, i, j]`` = γ^k_ij.
    drift_velocity : (n, 1) sympy.Matrix
        e.
    transport_coefficients : (n, n) sympy.Matrix
        ``transport_coefficients[k, i]`` = γ^k_i0.
    """

    D: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 0, []))
    rates: tuple[sp.Symbol, ...] = ()
    hamel_coefficients: sp.ImmutableDenseNDimArray = field(default_factory=lambda: sp.ImmutableDenseNDimArray([]))
    drift_velocity: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 1, []))
    transport_coefficients: sp.ImmutableMatrix = field(default_factory=lambda: sp.ImmutableMatrix(0, 0, []))

    def kinematics(self) -> tuple[sp.Eq, ...]:
        """Return q̇ = D w + e, one equation per coordinate."""
        right = self.D * sp.Matrix(self.velocities) + self.drift_velocity
        return tuple(sp.Eq(a, b, evaluate=False) for a, b in zip(self.rates, right, strict=True))


def quasi_equations(system: EnergyForm, quasi: QuasiVelocities) -> QuasiEquationsOfMotion:
    """Return Boltzmann's and Hamel's equations of a system, term by term."""
    k, n = system.kinetic, len(system.coordinates)
    v, gamma, w = sp.Matrix(system.velocities), quasi.hamel_coefficients, system.velocities
    drift = sp.zeros(n, 1)
    if any(k.b) or k.T0 != 0:
        slope = sp.Matrix.hstack(*_along(quasi, k.b))
        turned = sp.Matrix(n, n, lambda i, j: sum(gamma[h, i, j] * k.b[h] for h in range(n)))
        drift += (slope - slope.T + turned) * v - sp.Matrix(_along(quasi, k.T0))
    transport = quasi.transport_coefficients
    if quasi.moves:
        drift += transport.T * (k.M * v + k.b)
    if quasi.moves or system.time is not None:
        drift += quasi.transported(k.M) * v + quasi.transported(k.b)
    losses = sp.Matrix(gradient(system.dissipation, w))
    return QuasiEquationsOfMotion(
        coordinates=system.coordinates,
        velocities=w,
        accelerations=system.accelerations,
        mass_matrix=k.M,
        coriolis_matrix=_coriolis_matrix(system, quasi),
        drift=tidy_matrix(drift),
        potential_gradient=tidy_matrix(_along(quasi, system.V)),
        forces=tidy_matrix(sp.Matrix(system.forces) + quasi.input_forces - losses),
        **constraint_fields(system, quasi.D * v + quasi.drift),
        D=quasi.D,
        rates=quasi.rates,
        hamel_coefficients=gamma,
        drift_velocity=quasi.drift,
        transport_coefficients=transport,
    )


def _along(quasi: QuasiVelocities, x: Any) -> list[Any]:
    """Return the derivative of x along each column of D."""
    by = [sp.diff(x, q) for q in quasi.coordinates]
    n = len(by)
    return [sum((quasi.D[r, i] * by[r] for r in range(n)), 0 * x) for i in range(n)]


def _coriolis_matrix(system: EnergyForm, quasi: QuasiVelocities) -> sp.ImmutableMatrix:
    """Return C_ij = ½ Σ_k (D_k M_ij + D_j M_ik - D_i M_jk + c_ikj - c_jki - c_kji) w_k (Koszul's formula).

    D_k is the derivative along a column of D, and c_lij = Σ_h M_lh γ^h_ij.
    """
    M, n, gamma = system.kinetic.M, len(system.coordinates), quasi.hamel_coefficients
    slopes = _along(quasi, sp.Matrix(M))
    c = [[[sum(M[h, m] * gamma[m, i, j] for m in range(n)) for j in range(n)] for i in range(n)] for h in range(n)]

    def entry(i: int, j: int) -> sp.Expr:
        twice = (
            slopes[k][i, j] + slopes[j][i, k] - slopes[i][j, k] + c[i][k][j] - c[j][k][i] - c[k][j][i] for k in range(n)
        )
        terms = (settled(x / 2) * v for x, v in zip(twice, system.velocities, strict=True))
        return tidy(sum(terms, sp.Integer(0)))

    return sp.ImmutableMatrix(n, n, entry)


def in_quasi_velocities(
    system: EnergyForm, D: Any, names: Any, drift: Any = None
) -> tuple[dict[str, Any], KineticSplit, QuasiVelocities]:
    """Return the arguments of the system in w with q̇ = D w + e, the parts of its T, and D with its inverse."""
    if system.constraints:
        raise UnsupportedError(
            f"quasi_velocities: {system.name} has holonomic constraints; embed them first, or write their rates as "
            "velocity_constraints"
        )
    n = len(system.coordinates)
    D = tidy_matrix(_checked(system, "D", D, (n, n)))
    e = tidy_matrix(_checked(system, "drift", sp.zeros(n, 1) if drift is None else drift, (n, 1)))
    W, w, k = inverse(D, "D"), _named(system, names), system.kinetic
    M, b, v = settled_matrix(D.T * k.M * D), settled_matrix(D.T * (k.M * e + k.b)), sp.Matrix(w)
    T2, T1, T0 = (v.T * M * v)[0] / 2, (b.T * v)[0], k.T0
    if any(e):
        T0 = tidy((e.T * k.M * e)[0] / 2 + (k.b.T * e)[0] + T0)
    rates = dict(zip(system.velocities, D * v + e, strict=True))
    forces = tidy_matrix(D.T * system.forces.subs(rates, simultaneous=True))
    inputs = [system.inputs.get(q, sp.Integer(0)) for q in system.coordinates]
    arguments = {
        "T": tidy(T2) + T1 + T0,
        "V": system.V,
        "coordinates": system.coordinates,
        "velocities": w,
        "time": system.clock,
        "forces": dict(zip(system.coordinates, forces, strict=True)),
        "dissipation": tidy(system.dissipation.subs(rates, simultaneous=True)),
        "parameters": system.parameters,
        "velocity_constraints": [tidy(x.subs(rates, simultaneous=True)) for x in system.velocity_constraints],
        "name": system.name,
    }
    quasi = QuasiVelocities(
        D,
        W,
        system.coordinates,
        system.velocities,
        tidy_matrix(D.T * sp.Matrix(inputs)),
        e,
        next((system.clock for x in (D, e) if system.clock in x.free_symbols), system.time),
    )
    return arguments, KineticSplit(T2=tidy(T2), T1=T1, T0=T0, M=M, b=b), quasi


def _checked(system: EnergyForm, what: str, matrix: Any, shape: tuple[int, int]) -> sp.ImmutableMatrix:
    try:
        A = sp.ImmutableMatrix(matrix)
    except (TypeError, ValueError):
        raise InputError(f"{what}: expected a SymPy matrix {shape}, got {type(matrix).__name__}") from None
    names = ", ".join(map(str, system.coordinates))
    if A.shape != shape:
        raise InputError(f"{what}: expected shape {shape}, one row for each of {names}, got {A.shape}")
    if A.has(sp.nan, sp.zoo, sp.oo, -sp.oo):
        raise InputError(f"{what}: expected finite entries, got {A.tolist()}")
    A = A.applyfunc(lambda x: read_expression(system, what, x, also=_clock(system), others=True))
    own = {*system.coordinates, *system.parameters, *_clock(system)}
    others = A.free_symbols - own | A.atoms(AppliedUndef)
    if others:
        raise InputError(
            f"{what}: expected the coordinates {names}, time and parameters only, got "
            f"{', '.join(sorted(map(str, others)))}; q̇ = D w + drift with D and drift of q and t alone"
            + ("; give the time to the system as time=..." if system.clock is None else "")
        )
    return A


def _clock(system: EnergyForm) -> list[sp.Symbol]:
    """Return the time, whether or not the system depends on it."""
    return [] if system.clock is None else [system.clock]


def _named(system: EnergyForm, names: Any) -> list[sp.Symbol]:
    n = len(system.coordinates)
    if isinstance(names, str):
        names = names.replace(",", " ").split()
    symbols: Sequence[Any] = [f"w{i + 1}" for i in range(n)] if names is None else listed("names", names)
    if len(symbols) != n:
        raise InputError(f"names: expected {n}, one for each column of D, got {len(symbols)}")
    out: list[sp.Symbol] = []
    used = {s.name for s in (*symbols_of(system), *_clock(system))}
    for x in symbols:
        if not isinstance(x, (str, sp.Symbol)) or not str(x):
            raise InputError(f"names: expected names or symbols, got {x!r}")
        out.append(sp.Symbol(x) if isinstance(x, str) else x)
        fits("velocities", out[-1])
        own = {out[-1].name, velocity_of(out[-1]).name}
        if own & used:
            raise InputError(f"names: {min(own & used)!r} stands for something else already")
        used |= own
    return out
