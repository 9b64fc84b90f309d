"""How errors are measured: per sample, relative to a scale that does not vanish.

Errors e are an engine's value minus the oracle's, both high and low part, so that they are known to many digits
however small they are. A vector x has the error ‖e‖ / max(‖x‖, ‖M‖ ‖v‖²): a term that happens to be small is compared
with the forces at play. Where gravity is among them, so is what it could do: |g| √(m M_jj) is the most that it exerts
on joint j (Cauchy and Schwarz on Σ m_i g · J_ij), and what rounds with it where a pendulum hangs straight down. M's
error is the largest |e_ij| / √(M_ii M_jj), which no unit can change. Forward dynamics loses cond(M) in any arithmetic,
so its error is divided by that (Higham 2002, Accuracy and Stability of Numerical Algorithms, ch. 7), on a scale that
the forces which cancel in M a keep from vanishing; and M e, the force that the error amounts to, must be small beside
M a whatever cond(M) is. An energy, whose zero is arbitrary, is measured by the largest of all samples. Beside each
stands a figure per joint.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from mbkit._check import ITERATED, Array

#: Each of the largest terms of a sum went through about this many roundings on the way.
ROUNDINGS: Final = 4.0


def epsilon(bits: int) -> float:
    """Return eps of a significand of so many bits: the distance from 1 to the next number."""
    return 2.0 ** (1 - bits)


def digits_of(bits: int) -> float:
    """Return the decimal digits of a significand: 7.2 of single precision, 16.0 of double."""
    return bits * math.log10(2.0)


def named_precision(bits: int) -> str:
    """Return the name of a precision."""
    return {24: "single precision", 53: "double precision"}.get(bits, f"{bits} bits")


@dataclass(frozen=True)
class Scales:
    """Scales of the errors, per sample."""

    M: Array  # (N, nv, nv)
    diagonal: Array  # (N, nv), of M
    inertial: Array  # (N,), ‖M‖ ‖v‖²
    weight: Array  # (N,), norm over j of |g| √(m M_jj)
    acting: Array  # (N, nv), |τ| + |nle| + |τ_passive|, which cancel in M a
    size: Array  # (N,), norm of M scaled to a unit diagonal
    condition: Array  # (N,), cond(M) scaled likewise: no unit changes it
    constrained: Array | None = None  # (N,), condition of all equations under constraints; None without any

    @classmethod
    def of(cls, M: Array, v: Array, acting: Array, weight: float = 0.0) -> Scales:
        """Return the scales of the reference's values at the samples; `weight` is |g| √m."""
        diagonal = np.einsum("nii->ni", M).copy()
        norm = np.linalg.norm(M, 2, axis=(1, 2))
        root = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        scaled = M / (root[:, :, None] * root[:, None, :])
        heavy = weight * np.sqrt(np.sum(np.abs(diagonal), axis=1))
        inertial = norm * np.sum(v * v, axis=1)
        size = np.linalg.norm(scaled, 2, axis=(1, 2))
        return cls(M, diagonal, inertial, heavy, acting, size, np.linalg.cond(scaled))

    @property
    def of_accelerations(self) -> Array:
        """Condition of the equations that accelerations solve, (N,)."""
        return self.condition if self.constrained is None else self.constrained


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


def ratio(e: Array, scale: Array) -> Array:
    """Return e / scale, and 0 where e is 0."""
    # 0/0 is no error: both sides say zero.
    return np.where(e == 0, 0.0, e / np.where(scale == 0, np.finfo(float).tiny, scale))


def force_errors(error: Array, reference: Array, scales: Scales, *, heavy: bool = False) -> Errors:
    """Measure errors of generalized forces; `heavy` where gravity is among them."""
    e = np.abs(error)
    floor = np.maximum(scales.inertial, scales.weight) if heavy else scales.inertial
    relative = ratio(np.linalg.norm(e, axis=1), np.maximum(np.linalg.norm(reference, axis=1), floor))
    # A joint's own scale: its force, or its share of the forces at play.
    trace = scales.diagonal.sum(axis=1, keepdims=True)
    share = np.sqrt(scales.diagonal / np.where(trace > 0, trace, 1.0))
    own = np.maximum(np.abs(reference), floor[:, None] * share)
    return Errors(e.max(axis=1, initial=0.0), relative, ratio(e, own).max(axis=0))


def acceleration_errors(error: Array, reference: Array, scales: Scales) -> Errors:
    """Measure errors of accelerations in the norm √M_jj a_j, per cond(M)."""
    e, root = np.abs(error), np.sqrt(scales.diagonal)
    pushed = np.linalg.norm(scales.acting / np.where(root > 0, root, np.inf), axis=1)
    size = np.maximum(np.linalg.norm(root * reference, axis=1), pushed)
    own = np.maximum(np.abs(reference), scales.acting / np.where(scales.diagonal > 0, scales.diagonal, np.inf))
    force = np.einsum("nij,nj->ni", scales.M, error) / np.where(root > 0, root, np.inf)
    # Under constraints M e is no force that is wrong: a part of it is in J's rows.
    free = scales.constrained is None
    backward = ratio(np.linalg.norm(force, axis=1), scales.size * size) if free else 0.0
    condition = scales.of_accelerations
    forward = ratio(np.linalg.norm(root * e, axis=1), size * condition)
    return Errors(
        e.max(axis=1, initial=0.0), np.maximum(forward, backward), ratio(e, own * condition[:, None]).max(axis=0)
    )


def row_errors(error: Array, reference: Array, scales: Scales, *, moving: bool = False) -> Errors:
    """Measure errors of f, J and its bias by their largest numbers, or 1.

    With `moving` they are of the bodies' velocities, whose rounding is one of the joints' by up to the root of the
    equations' condition: a disc that lies nearly flat turns about one line by yaw and by spin.
    """
    e = np.abs(error).reshape(len(error), -1)
    size = np.maximum(1.0, np.abs(reference).reshape(len(error), -1).max(axis=1, initial=0.0))
    size = size * np.sqrt(scales.of_accelerations) if moving else size
    return Errors(e.max(axis=1, initial=0.0), ratio(e.max(axis=1, initial=0.0), size), np.empty(0))


def constraint_force_errors(error: Array, reference: Array, scales: Scales) -> Errors:
    """Measure errors of Jᵀ λ in the norm f_j / √M_jj, beside the forces that act, per condition of all equations."""
    e, root = np.abs(error), np.sqrt(np.where(scales.diagonal > 0, scales.diagonal, np.inf))
    size = np.maximum(*(np.linalg.norm(x / root, axis=1) for x in (reference, scales.acting)))
    own = np.maximum(np.abs(reference), scales.acting)
    condition = scales.of_accelerations
    relative = ratio(np.linalg.norm(e / root, axis=1), size * condition)
    return Errors(e.max(axis=1, initial=0.0), relative, ratio(e, own * condition[:, None]).max(axis=0))


def condition_under_constraints(M: Array, J: Array) -> Array:
    """Return cond([[M, Jᵀ], [J, 0]]) of each sample, with M's diagonal and J's rows scaled to one; (N,).

    Redundant rows do not count.
    """
    root = np.sqrt(np.einsum("nii->ni", M))
    root = np.where(root > 0, root, 1.0)
    rows = J / root[:, None, :]
    size = np.linalg.norm(rows, axis=2, keepdims=True)
    rows = rows / np.where(size > 0, size, 1.0)
    scaled = M / (root[:, :, None] * root[:, None, :])
    zero = np.zeros((len(M), J.shape[1], J.shape[1]))
    whole = np.block([[scaled, rows.swapaxes(1, 2)], [rows, zero]])
    singular = np.linalg.svd(whole, compute_uv=False)
    kept = np.where(singular > ITERATED * singular[:, :1], singular, np.inf)
    return np.asarray(singular[:, 0] / kept.min(axis=1))


def matrix_errors(error: Array, reference: Array, scales: Scales) -> Errors:  # noqa: ARG001  # as the others
    """Measure errors of mass matrices entry by entry, each by its two diagonal entries."""
    e = np.abs(error)
    root = np.sqrt(np.abs(scales.diagonal))
    each = ratio(e, root[:, :, None] * root[:, None, :])
    return Errors(e.max(axis=(1, 2), initial=0.0), each.max(axis=(1, 2), initial=0.0), each.max(axis=(0, 1)))


def energy_errors(error: Array, reference: Array, scales: Scales) -> Errors:
    """Measure errors of energies, by the largest of all samples."""
    e = np.abs(error)
    scale = np.maximum(np.abs(reference).max(initial=0.0), scales.inertial)
    return Errors(e, ratio(e, scale), np.empty(0))


# Timings of small calls: interleaved between engines, repeated, median and spread.


def interleaved(
    calls: Mapping[str, Callable[[], Any]], *, rounds: int = 7, budget: float = 2e-4
) -> dict[str, tuple[float, float]]:
    """Return (median, half interquartile range) of each call's time in ns.

    Each of the `rounds` times each call over as many repetitions as fill `budget` seconds, so that a drift of the
    machine's speed is the same for all.
    """
    repetitions: dict[str, int] = {}
    for name, call in calls.items():
        call()
        once = max(_seconds(call, 1), 1e-7)
        repetitions[name] = int(np.clip(budget / once, 1, 1000))
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            times[name].append(_seconds(call, repetitions[name]) / repetitions[name] * 1e9)
    out = {}
    for name, samples in times.items():
        low, median, high = np.percentile(samples, [25, 50, 75])
        out[name] = float(median), float(high - low) / 2
    return out


def _seconds(call: Callable[[], Any], times: int) -> float:
    start = time.perf_counter()
    for _ in range(times):
        call()
    return time.perf_counter() - start
