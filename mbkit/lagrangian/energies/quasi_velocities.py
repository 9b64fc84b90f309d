"""Quasi-velocities w that are not the coordinates' rates: q̇ = D(q) w, in symbols and in numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp

from mbkit._check import Array
from mbkit.codegen.interpreter import Machine
from mbkit.errors import InputError
from mbkit.lagrangian.energies.sympy_to_casadi import Conversion
from mbkit.lagrangian.trig.simplify import tidy


@dataclass(frozen=True, eq=False)
class QuasiVelocities:
    """q̇ = D w in symbols, with W = D⁻¹; `input_forces` are Dᵀ u of the coordinates' inputs u."""

    D: sp.ImmutableMatrix
    W: sp.ImmutableMatrix
    coordinates: tuple[sp.Symbol, ...]
    rates: tuple[sp.Symbol, ...]
    input_forces: sp.ImmutableMatrix

    @cached_property
    def hamel_coefficients(self) -> sp.ImmutableDenseNDimArray:
        """γ, (n, n, n), of `mbkit.lagrangian.reduction.quasi_equations`; ``hamel_coefficients[k, i, j]`` = γ^k_ij."""
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


class VelocityMap:
    """q̇ = D(q) v and its consequences, on arrays of one state or a batch and on CasADi's symbols."""

    def __init__(self, quasi: QuasiVelocities) -> None:
        n = len(quasi.coordinates)
        q, x, y = (ca.SX.sym(name, n) for name in "qxy")
        read = Conversion({c: q[i] for i, c in enumerate(quasi.coordinates)}, float)
        D, W = (ca.reshape(read.matrix(list(A.T)), n, n) for A in (quasi.D, quasi.W))
        moving = ca.mtimes(D, x)
        outputs = {
            "enter": ([q, x], moving),
            "leave": ([q, x], ca.mtimes(W, x)),
            "enter_force": ([q, x], ca.mtimes(W.T, x)),
            "leave_force": ([q, x], ca.mtimes(D.T, x)),
            "acceleration": ([q, x, y], ca.mtimes(D, y) + ca.jtimes(moving, q, moving)),
            "linear": ([q, x], ca.horzcat(ca.jacobian(moving, q), D, W)),
        }
        self._functions = {
            name: ca.Function(name, arguments, [ca.densify(out)], {"cse": True})
            for name, (arguments, out) in outputs.items()
        }
        self._machines = {name: Machine(f) for name, f in self._functions.items()}

    def _call(self, name: str, *arguments: Any) -> Any:
        if isinstance(arguments[0], ca.SX):
            return self._functions[name](*arguments)
        lead = np.broadcast_shapes(*(x.shape[:-1] for x in arguments))
        full = (np.ascontiguousarray(np.broadcast_to(x, (*lead, x.shape[-1]))) for x in arguments)
        return self._machines[name](*full)[0]

    def _column(self, name: str, *arguments: Any) -> Any:
        out = self._call(name, *arguments)
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
        by_q, D, W = np.split(self._call("linear", q, v), 3, axis=-1)
        return by_q, D, W
