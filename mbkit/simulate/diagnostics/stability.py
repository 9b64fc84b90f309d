"""What one step of a method makes of a linear system: by how much its fastest mode grows.

Of ẍ = A x + B ẋ a step of length h is a matrix on (x, ẋ); the method is stable where its spectral
radius is at most that of the exact flow (Hairer, Wanner 1996, IV.2).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.methods.registry import method_of
from mbkit.methods.stability import companion

__all__ = ["growth", "lost"]


#: Of a run: what is gone after that is a transient.
_BRIEF: Final = 0.01


def growth(method: str, h: float, A: Array, B: Array) -> float:
    """Return by how much a step amplifies the mode that grows most: the spectral radius.

    Parameters
    ----------
    method : str
        With a fixed step.
    h : float
        s.
    A, B : (nv, nv) arrays
        ∂v̇/∂q along the manifold and ∂v̇/∂v.

    Examples
    --------
    >>> import numpy as np
    >>> spring, none = np.array([[-1.0]]), np.zeros((1, 1))
    >>> growth("rk4", 2.8, spring, none) < 1 < growth("rk4", 2.9, spring, none)
    True
    >>> growth("semi_implicit_euler", 1.99, spring, none) < 1 + 1e-12
    True
    """
    return float(np.abs(np.linalg.eigvals(_matrix(method, h, A, B))).max())


def lost(method: str, h: float, A: Array, B: Array, duration: float) -> tuple[float, complex]:
    """Return what the modes lose of their phase or amplitude over some time, the worst, and that mode's rate.

    A step makes μ of a mode where the exact flow makes exp(h λ); over n steps the mode is off by the factor
    exp(n (ln μ - h λ)), and of one that decays only as long as there is anything of it; one that is gone soon, with
    the steps too, is passed over.

    Examples
    --------
    >>> import numpy as np
    >>> spring, none = np.array([[-100.0]]), np.zeros((1, 1))
    >>> part, rate = lost("semi_implicit_euler", 0.01, spring, none, duration=24.0)
    >>> bool(abs(part - 10.0**3 * 0.01**2 / 24 * 24.0) < 1e-3), abs(round(rate.imag, 6))
    (True, 10.0)
    """
    rates = np.linalg.eigvals(companion(A, B))
    made = np.linalg.eigvals(_matrix(method, h, A, B))
    # Beyond a turn a step no phase is its own; and what a step ends has no logarithm.
    made = np.log(np.where(np.abs(made) > 1e-300, made, 1e-300).astype(complex))
    exact = h * rates
    gap = made[None, :] - exact[:, None]
    gap.imag = (gap.imag + np.pi) % (2 * np.pi) - np.pi
    modes, partners = _paired(np.abs(gap))
    off = np.abs(gap[modes, partners])
    # As long as there is anything of it, in truth or in what the steps made of it.
    dies = np.minimum(-rates.real[modes], -made.real[partners] / h)
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
    taken: set[int] = set()
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        if row not in partner and column not in taken:
            partner[row] = column
            taken.add(column)
    return np.array(list(partner)), np.array(list(partner.values()))
