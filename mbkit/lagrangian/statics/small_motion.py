"""Small motions about a state of rest: M δq̈ + D δq̇ + K δq = 0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from mbkit._check import Array

__all__ = ["SmallMotion", "small_motion"]

# Of the largest: what rounding and differences leave of a part that is zero.
_ZERO: Final = 1e-8


@dataclass(frozen=True)
class SmallMotion:
    """Whether small motions stay small, their angular frequencies in rad/s and eigenvalues in 1/s."""

    stable: bool | None
    frequencies: Array
    eigenvalues: Any


def small_motion(M: Array, D: Array, K: Array, scale: float = 0.0) -> SmallMotion:
    """Return the eigenvalues of a linear system and what they say.

    Parameters
    ----------
    M, D, K : (n, n) arrays
        M may be singular, as of coordinates that move no mass there: those eigenvalues
        are left out.
    scale : float
        How large K is round about, where that is more than here: what is rounding beside
        it is taken for zero.

    References
    ----------
    Merkin 1997, Introduction to the Theory of Stability, ch. 3 (Lagrange and Dirichlet)
    and 6 (Kelvin and Tait).
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
    """Return K without what rounding left of directions that have no stiffness."""
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
    """Return whether D is nothing beside the geometric mean of what stands around it."""
    return bool(np.abs(D).max() <= 1e-12 * np.sqrt(np.abs(M).max() * np.abs(K).max()))
