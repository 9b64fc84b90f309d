"""The forces at rest of one system, how they change with the configuration, and small motions about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines.base import Dynamics, at_time
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, UnknownNameError
from mbkit.lagrangian.constraints.manifold import manifold_of
from mbkit.lagrangian.constraints.redundancy import refuse_unreachable, require_independent

#: Of the forces that balance: what rounding leaves of them.
BALANCED: Final = 1e-11
# rad or m: a neighbourhood, in which stiffness that vanishes at a threshold does not.
_ASIDE: Final = 0.1
_EPS: Final = float(np.finfo(float).eps)
#: s: when a system that depends on the time is looked at again, and what may differ then.
_LATER: Final = (0.7310585786300049, 2.0178)
_SAME: Final = 1e-9


class Balance:
    """The forces that balance at rest at time t, s, with a wrench (6,) on each frame by name."""

    def __init__(self, dyn: Dynamics, wrenches: Mapping[str, Array], t: float = 0.0) -> None:
        self._whole = dyn
        self.dyn, self.model = at_time(dyn, t) if dyn.model.time_parameter else dyn, dyn.model
        self._wrenches = wrenches
        for name in self._wrenches:
            self.model.frame(name)
            if not self.model.has_bodies:
                raise UnknownNameError("frame", name, (), hint="a system on paper takes tau=")
        self._manifold: Any = None
        self.rows = 0
        if self.model.constrained:
            self._manifold = manifold_of(dyn).at(t)
            self.rows = len(self._manifold.value(self.model.neutral()))
        self._zero = np.zeros(self.model.nv)

    # What balances

    def load(self, q: Array) -> Array:
        """Return nle - τ_passive - Σ J_Fᵀ F at rest: the force to be held, (nv,)."""
        out = self.dyn.inverse_dynamics(q, self._zero, self._zero)
        for name, wrench in self._wrenches.items():
            out = out - self.dyn.jacobian(q, name).T @ wrench
        return np.asarray(out)

    def scale(self, q: Array, tau: Array) -> float:
        """Return the size of the forces that balance, which scales the residual's rounding."""
        sizes = [np.abs(tau).max(initial=0.0), np.abs(self.load(q)).max(initial=0.0)]
        # The stiffness gives a scale where all forces are zero.
        sizes.append(np.abs(self.stiffness(q)).max(initial=0.0))
        return float(max(*sizes, np.finfo(float).tiny))

    def residual(self, q: Array, multipliers: Array, tau: Array) -> Array:
        """Return the residual, (nv,) of forces and (m,) of constraints."""
        left = self.load(q) - tau
        if not self.rows:
            return np.asarray(left)
        return np.concatenate([left - self._manifold.jacobian(q).T @ multipliers, self._manifold.value(q)])

    def size(self, q: Array, multipliers: Array, tau: Array) -> float:
        """Return the largest force left over."""
        return float(np.abs(self.residual(q, multipliers, tau)[: self.model.nv]).max(initial=0.0))

    def stiffness(self, q: Array) -> Array:
        """Return ∂load/∂q along the manifold, (nv, nv)."""
        if isinstance(self.dyn, LagrangianDynamics):
            K = self.dyn.inverse_dynamics_derivatives(q, self._zero, self._zero).q
            return np.asarray(K + self._differences(q, self._loads_of_frames) if self._wrenches else K)
        return self._differences(q, self.load)

    def _loads_of_frames(self, q: Array) -> Array:
        return np.asarray(-sum(self.dyn.jacobian(q, n).T @ w for n, w in self._wrenches.items()))

    def _differences(self, q: Array, function: Any) -> Array:
        # Of fourth order: the error is far below half of the digits.
        h = _EPS**0.2
        columns = []
        for e in np.eye(self.model.nv):
            ahead, behind, far, back = (function(self.model.integrate(q, s * h * e)) for s in (1.0, -1.0, 2.0, -2.0))
            columns.append((8 * (ahead - behind) - (far - back)) / (12 * h))
        return np.array(columns).T.reshape(self.model.nv, self.model.nv)

    def whole_stiffness(self, q: Array, multipliers: Array) -> Array:
        """Return ∂(load - Jᵀ λ)/∂q at these multipliers."""
        K = self.stiffness(q)
        if not self.rows:
            return K
        padded = np.zeros(self.model.nv)
        padded[: self.rows] = multipliers
        return np.asarray(K - self._manifold.call("curvature", q, padded)[0])

    def allowed(self, q: Array) -> Array:
        """Return a configuration on the constraints."""
        if not self.rows:
            return q
        try:
            return np.asarray(self._manifold.restored(q, self._zero))
        except InputError:
            refuse_unreachable(self._manifold.dyn, q)
            raise

    def require_independent(self, q: Array) -> None:
        """Refuse constraints that depend on each other at a configuration: they share the load in no one way."""
        if self.rows:
            require_independent(self._manifold.dyn, q)

    def multipliers(self, q: Array, tau: Array) -> Array:
        """Return the λ that balance best, (m,)."""
        if not self.rows:
            return np.empty(0)
        return np.asarray(np.linalg.lstsq(self._manifold.jacobian(q).T, self.load(q) - tau, rcond=None)[0])

    def matrix(self, q: Array, multipliers: Array) -> Array:
        """Return the derivative of the residual by q and λ."""
        K = self.whole_stiffness(q, multipliers)
        if not self.rows:
            return K
        J = self._manifold.jacobian(q)
        return np.block([[K, -J.T], [J, np.zeros((self.rows, self.rows))]])

    def held(self, q: Array) -> tuple[Array, Array]:
        """Return the least τ that holds a configuration, and the multipliers with it."""
        load = self.load(q)
        if not self.rows:
            return load, np.empty(0)
        multipliers = self.multipliers(q, np.zeros(self.model.nv))
        return load - self._manifold.jacobian(q).T @ multipliers, multipliers

    def check_constraints(self, q: Array) -> None:
        """Refuse a configuration that the constraints do not allow."""
        if self.rows:
            self._manifold.check(q, self._zero)

    # Small motions

    def small_motion(self, q: Array, multipliers: Array) -> SmallMotion:
        """Return the small motions about a configuration, on what the constraints leave free."""
        M, D, K = self._linear(q, multipliers)
        return small_motion(M, D, K, self._round_about(q, multipliers))

    def _linear(self, q: Array, multipliers: Array) -> tuple[Array, Array, Array]:
        N = self._free(q)
        parts = self.dyn.mass_matrix(q), self._damping(q), self.whole_stiffness(q, multipliers)
        M, D, K = (np.asarray(N.T @ A @ N) for A in parts)
        return M, D, K

    def changes(self, q: Array, tau: Array, multipliers: Array) -> bool:
        """Return whether the small motions change with the time; refuse forces or constraints that do (InputError)."""
        if self.model.time_parameter is None:
            return False
        now, moved = self._linear(q, multipliers), False
        for t in _LATER:
            later = Balance(self._whole, self._wrenches, t)
            theirs = later.multipliers(q, tau)
            left = np.abs(later.residual(q, theirs, tau)).max(initial=0.0)
            if left > _SAME * (1 + later.scale(q, tau)):
                raise InputError(
                    f"dynamics: {self.model.name} depends on the time {self.model.time_parameter}, which moves it; "
                    "there is no equilibrium of such a system"
                )
            pairs = zip(now, later._linear(q, theirs), strict=True)
            moved = moved or any(np.abs(a - b).max(initial=0.0) > _SAME * (1 + np.abs(a).max()) for a, b in pairs)
        return moved

    def _round_about(self, q: Array, multipliers: Array) -> float:
        """Return how large the stiffness is in the neighbourhood."""
        there = (self.model.integrate(q, s * np.ones(self.model.nv)) for s in (-_ASIDE, _ASIDE))
        return max(float(np.abs(self.whole_stiffness(p, multipliers)).max(initial=0.0)) for p in there)

    def _free(self, q: Array) -> Array:
        """Return a basis of what the constraints leave free, (nv, f)."""
        if not self.rows:
            return np.eye(self.model.nv)
        _, sizes, V = np.linalg.svd(self._manifold.jacobian(q))
        return np.asarray(V[int(np.count_nonzero(sizes > 1e-10 * sizes[0])) :].T)

    def _damping(self, q: Array) -> Array:
        """Return ∂(inverse dynamics)/∂v at rest."""
        if isinstance(self.dyn, LagrangianDynamics):
            return np.asarray(self.dyn.inverse_dynamics_derivatives(q, self._zero, self._zero).v)
        zero, h = self._zero, 1.0
        # Central differences of a quadratic are exact.
        columns = [
            (self.dyn.inverse_dynamics(q, h * e, zero) - self.dyn.inverse_dynamics(q, -h * e, zero)) / (2 * h)
            for e in np.eye(self.model.nv)
        ]
        return np.array(columns).T.reshape(self.model.nv, self.model.nv)


# Small motions about a state of rest: M δq̈ + D δq̇ + K δq = 0

# Of the largest: what rounding and differences leave of a part that is zero.
_ZERO: Final = 1e-8


@dataclass(frozen=True)
class SmallMotion:
    """Whether small motions stay small, their angular frequencies in rad/s and eigenvalues in 1/s."""

    stable: bool | None
    frequencies: Array
    eigenvalues: Any


def small_motion(M: Array, D: Array, K: Array, scale: float = 0.0) -> SmallMotion:
    """Return the eigenvalues of M δq̈ + D δq̇ + K δq = 0 and its stability; massless coordinates have none.

    Entries of K that are rounding beside `scale` count as zero. Merkin 1997, Introduction to the Theory of Stability,
    ch. 3 (Lagrange and Dirichlet) and 6 (Kelvin and Tait).
    """
    n = len(M)
    if not n:
        return SmallMotion(None, np.empty(0), np.empty(0, dtype=complex))
    K = _cleaned(K, max(scale, float(np.abs(K).max())))
    eigenvalues = _eigenvalues(M, D, K)
    size = float(np.abs(eigenvalues).max(initial=0.0))
    turning = eigenvalues[eigenvalues.imag > _ROOT * size] if size else eigenvalues[:0]
    return SmallMotion(_judged(M, D, K, eigenvalues, size), np.sort(turning.imag), eigenvalues)


# Eigenvalues are roots where they meet: half of the digits.
_ROOT: Final = 1e-6


def _cleaned(K: Array, scale: float) -> Array:
    """Return K with the rounding of directions without stiffness removed."""
    if not _symmetric(K) and np.abs(K).max() > _ZERO * scale:
        return K
    values, vectors = np.linalg.eigh((K + K.T) / 2)
    values[np.abs(values) <= _ZERO * scale] = 0.0
    return np.asarray(vectors * values @ vectors.T)


def _eigenvalues(M: Array, D: Array, K: Array) -> Any:
    from scipy.linalg import eig, eigh

    n = len(M)
    if _is_zero(D, M, K) and _symmetric(K):
        try:
            squares = eigh((K + K.T) / 2, (M + M.T) / 2, eigvals_only=True)
        except np.linalg.LinAlgError:
            pass
        else:
            # What rounding leaves of a free direction is no frequency.
            squares[np.abs(squares) < _ZERO * np.abs(squares).max()] = 0.0
            roots = np.sqrt(-squares.astype(complex))
            return np.sort_complex(np.concatenate([roots, -roots]))
    unit, zero = np.eye(n), np.zeros((n, n))
    A = np.block([[zero, unit], [-K, -D]])
    B = np.block([[unit, zero], [zero, M]])
    values = eig(A, B, right=False)
    return np.sort_complex(values[np.isfinite(values)])


def _judged(M: Array, D: Array, K: Array, eigenvalues: Any, size: float) -> bool | None:
    if _symmetric(K):
        squares = np.linalg.eigvalsh((K + K.T) / 2)
        scale = float(np.abs(squares).max())
        friction = np.linalg.eigvalsh((D + D.T) / 2)
        # Neither damping nor gyroscopic forces undo a minimum of the potential.
        if scale and squares[0] > _ZERO * scale and friction[0] >= -_ZERO * max(float(np.abs(D).max()), 1e-300):
            return True
        if scale and squares[0] < -_ZERO * scale and _is_zero(D, M, K):
            return False
    growth = float(eigenvalues.real.max(initial=-np.inf))
    if growth > _ROOT * size:
        return False
    return True if growth < -_ROOT * size else None


def _symmetric(K: Array) -> bool:
    return bool(np.abs(K - K.T).max() <= _ZERO * np.abs(K).max())


def _is_zero(D: Array, M: Array, K: Array) -> bool:
    """Return whether D is negligible beside the geometric mean of M and K."""
    return bool(np.abs(D).max() <= 1e-12 * np.sqrt(np.abs(M).max() * np.abs(K).max()))
