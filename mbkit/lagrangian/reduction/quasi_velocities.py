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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike
from sympy.core.function import AppliedUndef

from mbkit._check import Array, batch_of, rows
from mbkit._escape import one_line
from mbkit.codegen.interpreter import Machine
from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian.energies.casadi_equations import WrittenEquations
from mbkit.lagrangian.energies.equations_of_motion import EquationsOfMotion
from mbkit.lagrangian.energies.kinetic_energy import KineticSplit, inverse
from mbkit.lagrangian.energies.model import WrittenModel
from mbkit.lagrangian.energies.symbols import fits, in_symbols_of, plain
from mbkit.lagrangian.energies.sympy_to_casadi import Conversion, Numeric, values_of
from mbkit.lagrangian.reduction import conserved
from mbkit.lagrangian.reduction.conserved import ConservedQuantity
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.trig.simplify import tidy, tidy_matrix

if TYPE_CHECKING:
    from mbkit.lagrangian.reduction.hamilton import Hamiltonian
    from mbkit.lagrangian.reduction.routh import Routhian

__all__ = ["QuasiEquations", "QuasiEquationsOfMotion", "QuasiLagrangian", "QuasiModel", "QuasiRates", "quasi_equations"]


# The equations of motion in quasi-velocities, Boltzmann's and Hamel's; see
# `mbkit.lagrangian.reduction.quasi_velocities`.


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
        return conserved.conserved_quantities(self.system, self)

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


# A system in quasi-velocities, in the shape in which engines and simulation take a model.


class QuasiRates:
    """q̇ = D(q) v and what follows from it, on arrays of one state or a batch and on CasADi's symbols.

    Parameters
    ----------
    system : QuasiLagrangian
        Whose D holds coordinates and numbers only.
    """

    def __init__(self, system: QuasiLagrangian) -> None:
        n = len(system.coordinates)
        q, x, y = (ca.SX.sym(name, n) for name in "qxy")
        read = Conversion({c: q[i] for i, c in enumerate(system.coordinates)}, float)
        D, W = (ca.reshape(read.matrix(list(A.T)), n, n) for A in (system.D, system.W))
        moving = ca.mtimes(D, x)
        made = {
            "enter": ([q, x], moving),
            "leave": ([q, x], ca.mtimes(W, x)),
            "enter_force": ([q, x], ca.mtimes(W.T, x)),
            "leave_force": ([q, x], ca.mtimes(D.T, x)),
            "acceleration": ([q, x, y], ca.mtimes(D, y) + ca.jtimes(moving, q, moving)),
            "linear": ([q, x], ca.horzcat(ca.jacobian(moving, q), D, W)),
        }
        self._functions = {
            name: ca.Function(name, given, [ca.densify(out)], {"cse": True}) for name, (given, out) in made.items()
        }
        self._machines = {name: Machine(f) for name, f in self._functions.items()}

    def _found(self, name: str, *given: Any) -> Any:
        if isinstance(given[0], ca.SX):
            return self._functions[name](*given)
        lead = np.broadcast_shapes(*(x.shape[:-1] for x in given))
        full = (np.ascontiguousarray(np.broadcast_to(x, (*lead, x.shape[-1]))) for x in given)
        return self._machines[name](*full)[0]

    def _column(self, name: str, *given: Any) -> Any:
        out = self._found(name, *given)
        return out if isinstance(out, ca.SX) else out[..., 0]

    def check_start(self, q: Array, v: Array) -> None:
        """Raise `InputError` where D or its inverse has no value at a state to start from."""
        q, v = np.atleast_2d(q), np.atleast_2d(v)
        bad = ~np.isfinite([self._column(name, q, v) for name in ("enter", "leave")]).all(axis=(0, 2))
        if bad.any():
            raise InputError(
                f"q0: D(q) of q̇ = D v is singular at {q[int(np.argmax(bad))].tolist()}; start elsewhere, "
                "or take other coordinates"
            )

    def enter(self, q: Any, v: Any) -> Any:
        """Return q̇ = D v."""
        return self._column("enter", q, v)

    def leave(self, q: Any, w: Any) -> Any:
        """Return v = D⁻¹ q̇."""
        return self._column("leave", q, w)

    def enter_force(self, q: Any, f: Any) -> Any:
        """Return the force or momentum on q̇ of one on v: D⁻ᵀ f."""
        return self._column("enter_force", q, f)

    def leave_force(self, q: Any, f: Any) -> Any:
        """Return the force or momentum on v of one on q̇: Dᵀ f."""
        return self._column("leave_force", q, f)

    def acceleration(self, q: Any, v: Any, a: Any) -> Any:
        """Return q̈ = D v̇ + Ḋ v."""
        return self._column("acceleration", q, v, a)

    def linear(self, q: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return ∂(D v)/∂q, D and D⁻¹ at a state, (n, n) each."""
        by_q, D, W = np.split(self._found("linear", q, v), 3, axis=-1)
        return by_q, D, W


class QuasiModel(WrittenModel):
    """A `QuasiLagrangian` as a model: v is w, and q̇ = D(q) v."""

    system: QuasiLagrangian

    @property
    def written(self) -> Callable[..., WrittenEquations]:
        """What makes the equations: a function of how numbers stand in them."""
        return partial(QuasiEquations, self)

    @cached_property
    def rates(self) -> QuasiRates:
        """How velocities become the coordinates' rates."""
        return QuasiRates(self.system)

    @cached_property
    def velocity_names(self) -> tuple[str, ...]:
        """The quasi-velocities' names."""
        return tuple(w.name for w in self.system.velocities)

    @cached_property
    def _form(self) -> str:
        # D is not seen in the energies.
        return "\n".join((WrittenModel._form.func(self), sp.srepr(self.system.D)))  # type: ignore[attr-defined]

    def integrate(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """Return q + D(q) dq: what moves by dq in the space of v."""
        q, dq = self.check_q(q), self.check_v(dq, "dq")
        batch_of(q=q, dq=dq)
        return np.asarray(q + self.rates.enter(q, dq))

    def difference(self, q0: ArrayLike, q1: ArrayLike) -> Array:
        """Return the dq with ``integrate(q0, dq) = q1``."""
        q0, q1 = self.check_q(q0, "q0"), self.check_q(q1, "q1")
        batch_of(q0=q0, q1=q1)
        return np.asarray(self.rates.leave(q0, q1 - q0))


class QuasiEquations(WrittenEquations):
    """The equations of a `QuasiModel`: Boltzmann and Hamel's."""

    model: QuasiModel

    def _kinematics(self, read: Conversion) -> None:
        s, n = self.model.system, self.model.nv
        D = ca.reshape(read.matrix(list(s.D.T)), n, n)
        self.kin = SimpleNamespace(  # type: ignore[assignment]
            qdot=ca.mtimes(D, self.v), pullback=lambda x: ca.mtimes(D.T, x)
        )
        gamma = s.hamel_coefficients
        # Of each momentum, what its γ make of the velocities: (γ^k v)_i = Σ_j γ^k_ij v_j.
        self._turns = [
            ca.mtimes(ca.reshape(read.matrix([gamma[k, i, j] for j in range(n) for i in range(n)]), n, n), self.v)
            for k in range(n)
        ]

    def _turned(self, p: Any) -> Any:
        """Σ_jk γ^k_ij v_j p_k."""
        return sum((turn * p[k] for k, turn in enumerate(self._turns)), ca.SX(self.model.nv, 1))

    @cached_property
    def coriolis_matrix(self) -> Any:
        """Christoffel's C = ½ ∂(C v)/∂v + ½ M A, with A_kj = -(γ^k v)_j; A v = 0, and M A makes Ṁ - 2C skew."""
        A = -ca.horzcat(*self._turns).T
        return 0.5 * (ca.jacobian(self.coriolis_force, self.v) + ca.mtimes(self.mass_matrix, A))
