"""Stability of a method's step on a linear system, ẍ = A x + B ẋ (Hairer, Wanner 1996, IV.2)."""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.methods.registry import method_of
from mbkit.methods.stability import companion

#: Of a run: what is gone after that is a transient.
_BRIEF: Final = 0.01


def growth(method: str, h: float, A: Array, B: Array) -> float:
    """Return the spectral radius of a step of h (s); A = ∂v̇/∂q along the manifold, B = ∂v̇/∂v."""
    return float(np.abs(np.linalg.eigvals(_matrix(method, h, A, B))).max())


def lost(method: str, h: float, A: Array, B: Array, duration: float) -> tuple[float, complex]:
    """Return the largest loss of a mode's phase or amplitude over some time, and that mode's rate.

    A step multiplies a mode by μ, the exact flow by exp(h λ); n steps are off by the factor exp(n (ln μ - h λ)). It
    counts as long as the mode lasts; one that is soon gone is passed over.

    Examples
    --------
    >>> import numpy as np
    >>> spring, none = np.array([[-100.0]]), np.zeros((1, 1))
    >>> part, rate = lost("semi_implicit_euler", 0.01, spring, none, duration=24.0)
    >>> bool(abs(part - 10.0**3 * 0.01**2 / 24 * 24.0) < 1e-3), abs(round(rate.imag, 6))
    (True, 10.0)
    """
    rates = np.linalg.eigvals(companion(A, B))
    steps = np.linalg.eigvals(_matrix(method, h, A, B))
    # Zero has no logarithm.
    steps = np.log(np.where(np.abs(steps) > 1e-300, steps, 1e-300).astype(complex))
    exact = h * rates
    gap = steps[None, :] - exact[:, None]
    gap.imag = (gap.imag + np.pi) % (2 * np.pi) - np.pi
    modes, partners = _paired(np.abs(gap))
    off = np.abs(gap[modes, partners])
    dies = np.minimum(-rates.real[modes], -steps.real[partners] / h)
    lasting = np.minimum(duration, 1 / np.maximum(dies, 1e-300))
    part = np.where(lasting < _BRIEF * duration, 0.0, off * lasting / h)
    worst = int(part.argmax())
    return float(part[worst]), complex(rates[modes[worst]])


def _matrix(method: str, h: float, A: Array, B: Array) -> Array:
    stability = method_of(method).stability
    assert stability is not None
    return stability.matrix(h, A, B)


def _paired(gap: Array) -> tuple[Array, Array]:
    """Return rows and columns of pairs, the nearest first, each once."""
    rows, columns = np.unravel_index(np.argsort(gap, axis=None, kind="stable"), gap.shape)
    partner: dict[int, int] = {}
    paired: set[int] = set()
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        if row not in partner and column not in paired:
            partner[row] = column
            paired.add(column)
    return np.array(list(partner)), np.array(list(partner.values()))
