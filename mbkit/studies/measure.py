"""How errors are measured: per sample, relative to a scale that does not vanish.

For a vector x with error e the error is ‖e‖ / max(‖x‖, ‖M‖ ‖v‖²): a term that
happens to be small is compared with the forces at play. M's is the largest
|e_ij| / √(M_ii M_jj), which no unit can change. Forward dynamics loses cond(M)
in any arithmetic, so its error is divided by that (Higham 2002, Accuracy and
Stability of Numerical Algorithms, ch. 7). Beside each stands a figure per joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbkit._check import Array

__all__ = ["Errors", "Scales", "force_errors", "matrix_errors", "scalar_errors"]


@dataclass(frozen=True)
class Scales:
    """What errors are measured against, per sample.

    Attributes
    ----------
    diagonal : (N, nv) array
        Of M.
    floor : (N,) array
        ‖M‖ ‖v‖².
    condition : (N,) array
        cond(M), after scaling to a unit diagonal (no unit can change it).
    """

    diagonal: Array
    floor: Array
    condition: Array

    @classmethod
    def of(cls, M: Array, v: Array) -> Scales:
        """Take the scales from the reference's M at the samples."""
        diagonal = np.einsum("nii->ni", M).copy()
        norm = np.linalg.norm(M, 2, axis=(1, 2))
        root = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        scaled = M / (root[:, :, None] * root[:, None, :])
        return cls(diagonal, norm * np.sum(v * v, axis=1), np.linalg.cond(scaled))


@dataclass(frozen=True)
class Errors:
    """Errors of one term: per sample, and per velocity (NaN where it has none)."""

    absolute: Array
    relative: Array
    per_velocity: Array

    @property
    def worst(self) -> int:
        """The worst sample."""
        return int(np.argmax(self.relative))


def _ratio(e: Array, scale: Array) -> Array:
    # 0/0 is no error: both sides say zero.
    return np.where(e == 0, 0.0, e / np.where(scale == 0, np.finfo(float).tiny, scale))


def force_errors(x: Array, reference: Array, scales: Scales, *, by_condition: bool = False) -> Errors:
    """Compare vectors of generalized forces, or accelerations with `by_condition`."""
    e = np.abs(x - reference)
    size = np.linalg.norm(reference, axis=1)
    if by_condition:
        # The natural norm of an acceleration is the energy's: √(M_jj) a_j.
        root = np.sqrt(scales.diagonal)
        weighted = np.linalg.norm(root * (x - reference), axis=1)
        relative = _ratio(weighted, np.linalg.norm(root * reference, axis=1) * scales.condition)
        own = np.abs(reference) * scales.condition[:, None]
    else:
        relative = _ratio(np.linalg.norm(x - reference, axis=1), np.maximum(size, scales.floor))
        # A joint's own scale: its force, or what its own inertia makes of v².
        trace = scales.diagonal.sum(axis=1, keepdims=True)
        share = np.sqrt(scales.diagonal / np.where(trace > 0, trace, 1.0))
        own = np.maximum(np.abs(reference), scales.floor[:, None] * share)
    return Errors(e.max(axis=1, initial=0.0), relative, _ratio(e, own).max(axis=0))


def matrix_errors(M: Array, reference: Array, scales: Scales) -> Errors:
    """Compare mass matrices entry by entry, each by its two diagonal entries."""
    e = np.abs(M - reference)
    root = np.sqrt(np.abs(scales.diagonal))
    ratio = _ratio(e, root[:, :, None] * root[:, None, :])
    return Errors(e.max(axis=(1, 2), initial=0.0), ratio.max(axis=(1, 2), initial=0.0), ratio.max(axis=(0, 1)))


def scalar_errors(x: Array, reference: Array, scale: Array) -> Errors:
    """Compare energies, each by its own scale."""
    e = np.abs(x - reference)
    return Errors(e, _ratio(e, np.maximum(np.abs(reference), scale)), np.empty(0))
