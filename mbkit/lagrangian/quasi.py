"""Quasi-velocities: a system's equations in velocities w that are no coordinates' rates, q̇ = D(q) w.

Boltzmann and Hamel's equations (Greenwood 2003, Advanced Dynamics, ch. 4.3), with T(q, w, t)
and p_k = ∂T/∂w_k::

    d/dt ∂T/∂w_i  -  Σ_r D_ri ∂T/∂q_r  +  Σ_jk γ^k_ij w_j p_k  =  Σ_r D_ri (Q_r - ∂V/∂q_r)

    γ^k_ij = Σ_rs (∂W_kr/∂q_s - ∂W_ks/∂q_r) D_ri D_sj          W = D⁻¹

The upper index k belongs to the momentum, i to the equation, j to the velocity; γ is
skew in i and j. The columns of D are vector fields whose Lie brackets it holds:
[D_i, D_j] = Σ_k γ^k_ij D_k. For a rotation and body-axes rates γ^k_ij = ε_ijk, and the term
is ω × p, Euler's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike
from sympy.core.function import AppliedUndef

from mbkit._check import Array, rows
from mbkit._escape import one_line
from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian import cyclic
from mbkit.lagrangian.cyclic import ConservedQuantity
from mbkit.lagrangian.degree import KineticSplit
from mbkit.lagrangian.inverse import inverse
from mbkit.lagrangian.motion import EquationsOfMotion
from mbkit.lagrangian.numeric import Numeric, values_of
from mbkit.lagrangian.quasi_equations import QuasiEquationsOfMotion, quasi_equations
from mbkit.lagrangian.symbols import fits, in_symbols_of, plain
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.tidy import tidy, tidy_matrix

if TYPE_CHECKING:
    from mbkit.lagrangian.hamilton import Hamiltonian
    from mbkit.lagrangian.quasi_model import QuasiModel
    from mbkit.lagrangian.routh import Routhian

__all__ = ["QuasiEquationsOfMotion", "QuasiLagrangian"]


class QuasiLagrangian(Lagrangian):
    """A system in quasi-velocities; made by `Lagrangian.quasi_velocities`.

    It reads and runs as a `Lagrangian` does, with the velocities w: states are (q, w), and
    ``tau`` is the force on each w, Dᵀ times that on each coordinate (`to_force`). What only
    coordinates' rates have, momenta of cyclic coordinates, Routh's and Hamilton's functions,
    are those of `system`.

    Attributes
    ----------
    system : Lagrangian
        The same in its coordinates' rates.
    D, W : (n, n) sympy.Matrix
        q̇ = D w and w = W q̇.
    """

    def __init__(self, system: Lagrangian, D: Any, names: Any = None) -> None:
        if system.constraints:
            raise UnsupportedError(
                f"quasi_velocities: {system.name} has constraints, whose multipliers act on coordinates; "
                "embed them first"
            )
        self.system = system
        self.D = tidy_matrix(_checked(system, D))
        self.W = inverse(self.D, "D")
        w = _named(system, names)
        k = system.kinetic
        M, b = tidy_matrix(self.D.T * k.M * self.D), tidy_matrix(self.D.T * k.b)
        v = sp.Matrix(w)
        T2, T1 = (v.T * M * v)[0] / 2, (b.T * v)[0]
        # Known, and need not be told apart again.
        self.__dict__["kinetic"] = KineticSplit(T2=tidy(T2), T1=T1, T0=k.T0, M=M, b=b)
        put = dict(zip(system.velocities, self.D * v, strict=True))
        forces = tidy_matrix(self.D.T * system.forces.subs(put, simultaneous=True))
        super().__init__(
            T=tidy(T2) + T1 + k.T0,
            V=system.V,
            coordinates=system.coordinates,
            velocities=w,
            time=system.time,
            forces=dict(zip(system.coordinates, forces, strict=True)),
            dissipation=tidy(system.dissipation.subs(put, simultaneous=True)),
            parameters=system.parameters,
            name=system.name,
        )

    @cached_property
    def hamel_coefficients(self) -> sp.ImmutableDenseNDimArray:
        """γ, (n, n, n), with ``hamel_coefficients[k, i, j]`` = γ^k_ij of the equation above."""
        q, D, n = sp.Matrix(self.coordinates), self.D, len(self.coordinates)
        slopes = [D[:, j].jacobian(q) for j in range(n)]
        out = sp.MutableDenseNDimArray.zeros(n, n, n)
        for i in range(n):
            for j in range(i):
                # [D_i, D_j] in the frame that D's columns are.
                bracket = self.W * (slopes[j] * D[:, i] - slopes[i] * D[:, j])
                for k, x in enumerate(bracket):
                    out[k, i, j] = tidy(x)
                    out[k, j, i] = -out[k, i, j]
        return sp.ImmutableDenseNDimArray(out)

    @property
    def input_forces(self) -> sp.ImmutableMatrix:
        """Dᵀ u of the coordinates' inputs u, (n, 1)."""
        inputs = [self.system.inputs.get(q, sp.Integer(0)) for q in self.coordinates]
        return tidy_matrix(self.D.T * sp.Matrix(inputs))

    @cached_property
    def _equations(self) -> EquationsOfMotion:
        return quasi_equations(self)

    # Variants

    def __reduce__(self) -> tuple[Any, ...]:
        return QuasiLagrangian, (self.system, self.D, self.velocities)

    def _of(self, system: Lagrangian, D: Any) -> QuasiLagrangian:
        return QuasiLagrangian(system, D, self.velocities)

    def substituted(self, values: Mapping[sp.Symbol, Any]) -> QuasiLagrangian:
        """Return the same system with numbers for some parameters."""
        system = self.system.substituted(values)
        return self._of(system, self.D.subs({s: sp.sympify(x) for s, x in values.items()}))

    def conservative(self) -> QuasiLagrangian:
        """Return the same system without dissipation and forces; inputs stay."""
        return self._of(self.system.conservative(), self.D)

    def quasi_velocities(self, D: Any, names: Any = None) -> QuasiLagrangian:
        """Return the system in other quasi-velocities u, with q̇ = D u again."""
        return QuasiLagrangian(self.system, D, names)

    # What coordinates' rates alone have

    def cyclic_coordinates(self) -> tuple[sp.Symbol, ...]:
        """Return those of `system`."""
        return self.system.cyclic_coordinates()

    def forced_cyclic_coordinates(self) -> dict[sp.Symbol, sp.Expr]:
        """Return those of `system`."""
        return self.system.forced_cyclic_coordinates()

    def conserved_momenta(self) -> dict[sp.Symbol, sp.Expr]:
        """Return the momentum Wᵀ p of each cyclic coordinate, in quasi-velocities."""
        p, kept = self.W.T * self.momenta, self.system.cyclic_coordinates()
        return {q: tidy(x) for q, x in zip(self.coordinates, p, strict=True) if q in kept}

    def conserved_quantities(self) -> tuple[ConservedQuantity, ...]:
        """Return what is constant along every motion, in quasi-velocities."""
        return cyclic.conserved_quantities(self.system, self)

    def routhian(self, cyclic: Any = None) -> Routhian:
        """Return Routh's reduction of `system`."""
        return self.system.routhian(cyclic)

    def hamiltonian(self) -> Hamiltonian:
        """Return Hamilton's function of `system`."""
        return self.system.hamiltonian()

    # Running it

    @cached_property
    def model(self) -> QuasiModel:
        """The system as engines take it, with v = w."""
        from mbkit.lagrangian.quasi_model import QuasiModel

        told = self.D.free_symbols - set(self.coordinates)
        if told:
            raise UnsupportedError(
                f"D: to run, it must hold coordinates and numbers only, but it holds {plain(told)}; "
                f"put numbers in first: substituted({{{min(told, key=str)}: ...}})"
            )
        return QuasiModel(self)

    @cached_property
    def _maps(self) -> Numeric:
        return Numeric(sp.Matrix.vstack(self.D, self.W), self.coordinates, tuple(self.parameters))

    def _map(self, name: str, q: ArrayLike, x: ArrayLike, values: dict[str, float]) -> tuple[Array, Array, Array]:
        n = len(self.coordinates)
        q, x = rows("q", q, n, self.name, "nq"), rows(name, x, n, self.name, "nv")
        told = (
            values_of(self, values, name)
            if self.D.free_symbols & set(self.parameters)
            else np.zeros(len(self.parameters))
        )
        both = self._maps(q, told)
        return both[..., :n, :], both[..., n:, :], x

    def to_velocity(self, q: ArrayLike, w: ArrayLike, **values: float) -> Array:
        """Return the coordinates' rates D w in numbers, (n,) or (N, n)."""
        D, _, w = self._map("w", q, w, values)
        return np.asarray(np.einsum("...ij,...j->...i", D, w))

    def to_quasi_velocity(self, q: ArrayLike, v: ArrayLike, **values: float) -> Array:
        """Return w = D⁻¹ v of the coordinates' rates in numbers, (n,) or (N, n)."""
        _, W, v = self._map("v", q, v, values)
        return np.asarray(np.einsum("...ij,...j->...i", W, v))

    def to_force(self, q: ArrayLike, tau: ArrayLike, **values: float) -> Array:
        """Return the forces Dᵀ τ on w of those on the coordinates in numbers, (n,) or (N, n)."""
        D, _, tau = self._map("tau", q, tau, values)
        return np.asarray(np.einsum("...ij,...i->...j", D, tau))

    def __repr__(self) -> str:
        return one_line(f"<QuasiLagrangian {self.name!r}: quasi-velocities {', '.join(map(str, self.velocities))}>")


def _checked(system: Lagrangian, given: Any) -> sp.ImmutableMatrix:
    n = len(system.coordinates)
    try:
        D = sp.ImmutableMatrix(given)
    except (TypeError, ValueError):
        raise InputError(f"D: expected a SymPy matrix ({n}, {n}), got {type(given).__name__}") from None
    if D.shape != (n, n):
        raise InputError(
            f"D: expected shape ({n}, {n}), one row for each of {', '.join(map(str, system.coordinates))}, "
            f"got {D.shape}"
        )
    if D.has(sp.nan, sp.zoo, sp.oo, -sp.oo):
        raise InputError(f"D: expected finite entries, got {D.tolist()}")
    D = D.applyfunc(lambda x: in_symbols_of(system, "D", x, others=True))
    if system.time is not None and system.time in D.free_symbols:
        raise InputError(f"D: expected coordinates and parameters only, got the time {system.time}")
    others = {str(x) for x in D.free_symbols - set(system.coordinates) - set(system.parameters)}
    others |= {str(x) for x in D.atoms(AppliedUndef)}
    if others:
        raise InputError(
            f"D: expected the coordinates {', '.join(map(str, system.coordinates))} and parameters only, "
            f"got {', '.join(sorted(others))}; q̇ = D w with D of q alone"
        )
    return D


def _named(system: Lagrangian, names: Any) -> list[sp.Symbol]:
    n = len(system.coordinates)
    if names is None:
        names = [f"w{i + 1}" for i in range(n)]
    if isinstance(names, str):
        names = names.replace(",", " ").split()
    given: Sequence[Any] = list(names)
    if len(given) != n:
        raise InputError(f"names: expected {n}, one for each column of D, got {len(given)}")
    out = []
    for x in given:
        if not isinstance(x, (str, sp.Symbol)) or not str(x):
            raise InputError(f"names: expected names or symbols, got {x!r}")
        out.append(sp.Symbol(x) if isinstance(x, str) else x)
        fits("velocities", out[-1])
    known = (*system.coordinates, *system.velocities, *system.parameters, *system.inputs.values())
    taken = {s.name for s in (*known, *([system.time] if system.time else []))}
    for s in out:
        if s.name in taken:
            raise InputError(f"names: {s.name!r} stands for something else already")
        taken.add(s.name)
    return out
