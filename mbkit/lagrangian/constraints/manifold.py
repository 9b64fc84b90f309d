"""The states that holonomic constraints f(q, t) = 0 allow: f = 0 and ḟ = J v + ∂f/∂t = 0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, cast

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit.derivation.mass_matrix_solve import solve
from mbkit.engines.base import Dynamics, at_time
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian.energies.casadi_equations import EnergyEquations

_EPS: Final = float(np.finfo(float).eps)
#: Of each row's scale: what rounding and a few typed digits leave of a consistent state.
_CONSISTENT: Final = 1e-8
# Newton's iteration squares what is left: from here it ends at rounding.
_NEAR: Final = 1e-8
_MOST: Final = 60
_TWIN: Final = "_constrained_twin"


# The functions that are compiled.


def _function(eq: EnergyEquations, name: str, inputs: dict[str, Any], outputs: dict[str, Any]) -> ca.Function:
    inputs = {**inputs, **eq.trailing}
    dense = [ca.densify(x) for x in outputs.values()]
    return ca.Function(name, list(inputs.values()), dense, list(inputs), list(outputs), {"cse": True})


def _rows(eq: EnergyEquations) -> ca.Function:
    c = eq.constraints
    return _function(eq, "constraint_rows", {"q": eq.q}, {"f": c.value, "J": c.jacobian})


def _terms(eq: EnergyEquations) -> ca.Function:
    c, M = eq.constraints, eq.mass_matrix
    outputs = {"f": c.value, "J": c.jacobian, "by_time": c.by_time, "rate": c.rate, "W": c.weight(M), "M": M}
    return _function(eq, "constraint", {"q": eq.q, "v": eq.v}, outputs)


def _step(eq: EnergyEquations) -> ca.Function:
    """(q, v) -> q after a step of Newton's, v outputs consistent there, f before it and its scale."""
    c, m = eq.constraints, eq.constraints.value.shape[0]
    W = c.weight(eq.mass_matrix)
    Y = solve(W, c.jacobian.T, eq.elimination_order)
    S = ca.mtimes(c.jacobian, Y)
    q1 = eq.q - ca.mtimes(Y, solve(S, c.value, range(m)))
    Y1, S1, rate1 = (ca.substitute(x, eq.q, q1) for x in (Y, S, c.rate))
    v1 = eq.v - ca.mtimes(Y1, solve(S1, rate1, range(m)))
    scale = ca.sqrt(ca.sum2(c.jacobian**2))
    return _function(eq, "constraint_step", {"q": eq.q, "v": eq.v}, {"q1": q1, "v1": v1, "f": c.value, "scale": scale})


def _multipliers(eq: EnergyEquations) -> ca.Function:
    return _function(eq, "multipliers", {"q": eq.q, "v": eq.v, "tau": eq.tau}, {"lambda": eq.multipliers})


def _embedded(eq: EnergyEquations) -> ca.Function:
    c = eq.constraints
    outputs = {"J": c.jacobian, "by_time": c.by_time, "gamma": c.gamma, "M": eq.mass_matrix, "force": eq.applied}
    return _function(eq, "embedded", {"q": eq.q, "v": eq.v}, outputs)


def _curvature(eq: EnergyEquations) -> ca.Function:
    """(q, λ) -> ∂(Jᵀ λ)/∂q; λ takes the place of v's first entries."""
    c = eq.constraints
    pull = ca.mtimes(c.jacobian.T, eq.v[: c.value.shape[0]])
    return _function(eq, "curvature", {"q": eq.q, "v": eq.v}, {"H": ca.jacobian(pull, eq.q)})


#: Name -> what derives it.
_FUNCTIONS: Final = {
    "constraint_rows": _rows,
    "constraint": _terms,
    "constraint_step": _step,
    "multipliers": _multipliers,
    "embedded": _embedded,
    "curvature": _curvature,
}


@dataclass(frozen=True)
class _Terms:
    """Numbers at one state: f (m,), J (m, n), ∂f/∂t (m,), ḟ (m,), the weight W and the mass matrix (n, n)."""

    f: Array
    J: Array
    by_time: Array
    rate: Array
    W: Array
    M: Array

    @property
    def scale(self) -> Array:
        """What a row changes by when every coordinate changes by 1."""
        sizes = np.abs(self.J).sum(axis=1)
        return np.where(sizes > 0, sizes, 1.0)


class Manifold:
    """The consistent states of dynamics with constraints, in numbers."""

    def __init__(self, dyn: LagrangianDynamics) -> None:
        self.dyn = dyn

    def at(self, t: float) -> Manifold:
        """Return the states at a time."""
        return Manifold(at_time(self.dyn, t)) if self.dyn.model.time_parameter else self

    # Compiled functions

    @property
    def equations(self) -> EnergyEquations:
        """The equations of the energies."""
        return cast("EnergyEquations", self.dyn.equations)

    def call(self, name: str, *arguments: Array) -> list[Array]:
        """Return the outputs of a compiled function, with its parameters behind."""
        code = self.dyn.code(name, make=lambda: _FUNCTIONS[name](self.equations))
        if self.dyn.model.parameters:
            p, lead = self.dyn.parameter_values, arguments[0].shape[:-1]
            if p.ndim > 1 and not lead:
                # One of a batch is a batch of one.
                (p,) = p
            return list(code(*arguments, np.broadcast_to(p, (*lead, p.shape[-1]))))
        return list(code(*arguments))

    def value(self, q: Array) -> Array:
        """Return f, (m,) or (N, m)."""
        return np.asarray(self.call("constraint_rows", q)[0][..., 0])

    def jacobian(self, q: Array) -> Array:
        """Return J, (m, n) or (N, m, n)."""
        return self.call("constraint_rows", q)[1]

    def multipliers(self, q: Array, v: Array, tau: Array) -> Array:
        """Return λ, (m,) or (N, m)."""
        return np.asarray(self.call("multipliers", q, v, tau)[0][..., 0])

    def _terms(self, q: Array, v: Array) -> _Terms:
        f, J, by_time, rate, W, M = self.call("constraint", q, v)
        return _Terms(f[:, 0], J, by_time[:, 0], rate[:, 0], W, M)

    # Consistency

    def check(self, q: Array, v: Array) -> None:
        """Refuse an inconsistent state, of one or a batch, with the residuals (InputError)."""
        states = zip(np.atleast_2d(q), np.atleast_2d(v), strict=True)
        for k, (one_q, one_v) in enumerate(states):
            terms = self.member(k)._terms(one_q, one_v)
            limits = [_CONSISTENT * terms.scale * max(1.0, float(np.abs(x).max())) for x in (one_q, one_v)]
            for name, what, residual, limit in (
                ("q0", "f", terms.f, limits[0]),
                ("v0", "J v + ∂f/∂t", terms.rate, limits[1]),
            ):
                if not (np.abs(residual) <= limit).all():
                    where = "" if q.ndim == 1 else f" of state {k}"
                    residuals = ", ".join(f"{x:.3g}" for x in residual)
                    raise InputError(
                        f"{name}: the constraints of {self.dyn.model.name} ask for {what} = 0, which is [{residuals}]"
                        f"{where}; lag.project(q0, v0) returns the nearest consistent state"
                    )

    def member(self, k: int) -> Manifold:
        """Return the states of one sample of a batch of parameters; the same where there is none."""
        if self.dyn.samples is None:
            return self
        one = self.dyn.of_samples([k])
        return Manifold(one.at(**dict(zip(one.model.parameters, one.parameter_values[0].tolist(), strict=True))))

    def pulled(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the consistent state beside one that has drifted a little, or of each of a batch.

        A state that is far from the constraints or not finite comes back as it is or as NaN.
        """
        for _ in range(4):
            q, v, f, scale = self.call("constraint_step", q, v)
            q, v = q[..., 0], v[..., 0]
            left = np.abs(f[..., 0]) / scale[..., 0]
            if not bool((left > _NEAR).any()):
                break
        return q, v

    def project(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the nearest consistent state, in the metric of the mass matrix there; InputError if none is found."""
        x = self.restored(q, v)
        M = self._terms(q, v).M
        # Stationary: M (x - q) + Jᵀ μ = 0 with f(x) = 0.
        last = np.inf
        for _ in range(_MOST):
            terms = self._terms(x, v)
            step = _kkt(M, terms.J, M @ (q - x), -terms.f)
            size = float(np.linalg.norm(step))
            if size <= 1e-12 * (1 + float(np.linalg.norm(x))):
                break
            # Where the constraints bend strongly, whole steps go to and fro about the foot.
            x = self.restored(x + (step if size < last else 0.5 * step), v)
            last = min(last, size)
        terms = self._terms(x, v)
        return x, v + least_change(terms.W, terms.J, -terms.rate)

    def restored(self, q: Array, v: Array) -> Array:
        """Return a configuration with f = 0, by steps that are the least in the mass matrix's metric."""
        x, terms = q, self._terms(q, v)
        best = float(np.linalg.norm(terms.f / terms.scale))
        for _ in range(_MOST):
            if best <= 4 * _EPS * (1 + float(np.abs(x).max())):
                break
            step, length, moved = least_change(terms.W, terms.J, -terms.f), 1.0, False
            while length > 1e-6 and not moved:
                tried = self._terms(x + length * step, v)
                size = float(np.linalg.norm(tried.f / tried.scale))
                moved = size < best
                length *= 0.5
            if not moved:
                break
            x, terms, best = x + 2 * length * step, tried, size
        if not best <= 1e-10 * (1 + float(np.abs(x).max())):
            residuals = ", ".join(f"{e:.3g}" for e in terms.f)
            raise InputError(
                f"q: no consistent state of {self.dyn.model.name} found near it; f = [{residuals}] is the least reached"
            )
        return np.asarray(x)


def manifold_of(dyn: Dynamics) -> Manifold:
    """Return the consistent states of dynamics; those of another engine by the own derivation."""
    if isinstance(dyn, LagrangianDynamics):
        return Manifold(dyn)
    if dyn.model.has_bodies:
        raise UnsupportedError(f"{dyn.model.name}: has no constraints; mbkit.lagrangian.Lagrangian takes them")
    # Deriving costs more than most runs: once for each engine's object.
    if _TWIN not in vars(dyn):
        vars(dyn)[_TWIN] = LagrangianDynamics(dyn.model)
    return Manifold(vars(dyn)[_TWIN])


def least_change(W: Array, J: Array, wanted: Array) -> Array:
    """Return the x with J x = wanted that is the least in xᵀ W x; the nearest to it where J has dependent rows."""
    try:
        L = np.linalg.cholesky(W)
    except np.linalg.LinAlgError:
        L = np.eye(len(W))
    A = np.linalg.solve(L, J.T).T
    y = np.linalg.lstsq(A, wanted, rcond=1e-12)[0]
    return np.asarray(np.linalg.solve(L.T, y))


def _kkt(W: Array, J: Array, force: Array, wanted: Array) -> Array:
    """Return x of W x + Jᵀ μ = force, J x = wanted."""
    m, n = J.shape
    K = np.block([[W, J.T], [J, np.zeros((m, m))]])
    return np.asarray(np.linalg.lstsq(K, np.concatenate([force, wanted]), rcond=1e-14)[0][:n])
