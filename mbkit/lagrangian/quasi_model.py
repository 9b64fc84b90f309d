"""A system in quasi-velocities, in the shape in which engines and simulation take a model."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from mbkit._check import Array, batch_of
from mbkit.derivation.machine import Machine
from mbkit.errors import InputError
from mbkit.lagrangian.conversion import Conversion
from mbkit.lagrangian.written import WrittenModel
from mbkit.lagrangian.written_equations import WrittenEquations

if TYPE_CHECKING:
    from mbkit.lagrangian.quasi import QuasiLagrangian

__all__ = ["QuasiEquations", "QuasiModel", "QuasiRates"]


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
