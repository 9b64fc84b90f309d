"""Motions of a hanging chain of thin rods, however different their masses are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.studies.stress.cases._slow import slow_motion
from mbkit.studies.stress.cases._sweeps import Exact

__all__ = ["HangingChain"]

_GRAVITY: Final = 9.81
_SMALL: Final = 1e-30
#: Steps a second: what rings faster than these can follow hardly rings in a taut chain.
_STEPS: Final = 200


class HangingChain:
    """Rods of 1 m, hinged end to end, and a load at the last end.

    In angles φ from the vertical, Σ_j a_ij (cos(φ_i - φ_j) φ̈_j + sin(φ_i - φ_j) φ̇_j²) + g w_i sin φ_i = 0, where
    a_ij sums m f_ki f_kj over the rods k, f being 1 above rod k and ½ on it, and m/12 for its own turn; w_i
    sums m f_ki (a Lagrangian exercise).

    Parameters
    ----------
    masses : sequence of float
        Of the rods, kg.
    load : float
        kg.
    """

    def __init__(self, masses: Sequence[float], load: float = 0.0) -> None:
        m, n = np.asarray(masses, dtype=np.float64), len(masses)
        below = np.tril(np.ones((n, n)), -1) + np.eye(n) / 2
        self._a = (below.T * m) @ below + np.diag(m) / 12 + load
        self._w = m @ below + load

    def taut(self, angle: float) -> Array:
        """Return the angles q, from rod to rod, at which it begins to turn as one, let go at rest.

        Near the straight line where the end is heavy; from there the light rods hardly ring.
        """
        n = len(self._w)
        # The common acceleration, and the angles below the first rod's.
        x = np.array([-_GRAVITY * np.sin(angle) / n, *[angle] * (n - 1)])

        def residual(x: Array) -> Array:
            phi = np.concatenate([[angle], x[1:]])
            pull = self._a * np.cos(phi[:, None] - phi)
            return np.asarray((x[0] * pull.sum(axis=1) + _GRAVITY * self._w * np.sin(phi)) / self._w)

        for _ in range(20):
            J = np.stack([residual(x + 1j * _SMALL * e).imag / _SMALL for e in np.eye(n)], axis=1)
            x = x - np.linalg.solve(J, residual(x))
        return np.diff([0.0, angle, *x[1:]])

    def motion(self, q: Array, duration: float) -> Exact:
        """Return q, (K, n), let go at rest."""
        n, a, w = len(q), self._a, self._w

        def residual(y: Array, rate: Array) -> Array:
            phi, turn = y[:, :n], y[:, n:]
            apart = phi[:, :, None] - phi[:, None, :]
            forces = np.einsum("sij,sj->si", a * np.cos(apart), rate[:, n:])
            forces += np.einsum("sij,sj->si", a * np.sin(apart), turn**2) + _GRAVITY * w * np.sin(phi)
            return np.concatenate([rate[:, :n] - turn, forces / w], axis=1)

        start = np.concatenate([np.cumsum(q), np.zeros(n)])
        solved = slow_motion(residual, start, duration, round(_STEPS * duration))
        return lambda t: np.diff(solved(t)[:, :n], axis=1, prepend=0.0)
