"""Slow motions of stiff systems, by collocation in variables in which nothing is stiff.

Where a spring of stiffness k all but holds a coordinate s, k s stays of the size of a force. In it the
equations have 1/k in them instead of k, and go over into those of the rigid joint. Collocation at Radau's points
solves them for any k with steps that know nothing of the fast mode, which is hardly excited (Hairer, Wanner 1996,
VI.3 on singular perturbations, IV.5 on Radau IIA).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.polynomial.legendre import legroots

from mbkit._check import Array

__all__ = ["slow_motion"]

_STAGES: Final = 8
_SMALL: Final = 1e-30
_ITERATIONS: Final = 30

#: F(y, ẏ), each (s, n), real or complex.
Residual = Callable[[Any, Any], Any]


def slow_motion(residual: Residual, start: Array, duration: float, steps: int) -> Callable[[Array], Array]:
    """Return y, (K, n), of F(y, ẏ) = 0 up to the duration.

    Parameters
    ----------
    residual : callable
        From y and ẏ, (s, n) each, to F, (s, n); analytic, for it is differentiated by a complex step.
    start : (n,) array
    duration : float
        s.
    steps : int
    """
    points, slopes = _radau()
    h = duration / steps
    pieces: list[Array] = []

    def motion(t: Array) -> Array:
        which = np.minimum((t / h).astype(int), steps - 1)
        # No farther than it is asked for: making a problem costs nothing.
        while len(pieces) <= int(which.max(initial=0)):
            y = pieces[-1][-1] if pieces else np.asarray(start, dtype=np.float64)
            pieces.append(_step(residual, y, pieces[-1] if pieces else None, h, points, slopes))
        weights = _lagrange(points, t / h - which)
        return np.asarray(np.einsum("kj,kjn->kn", weights, np.stack(pieces)[which]))

    return motion


def _step(residual: Residual, y: Array, before: Array | None, h: float, points: Array, slopes: Array) -> Array:
    """Return y at the points of a step, (s + 1, n), by Newton's method with the first iterate's derivatives."""
    s, n = _STAGES, len(y)
    Y = np.tile(y, (s, 1)) if before is None else _lagrange(points, 1 + points[1:]) @ before
    by_y, by_rate = _jacobians(residual, Y, slopes @ np.vstack([y, Y]) / h)
    J = np.einsum("ik,iab->iakb", slopes[:, 1:] / h, by_rate)
    J[np.arange(s), :, np.arange(s), :] += by_y
    inverse = np.linalg.inv(J.reshape(s * n, s * n))
    last = np.inf
    for _ in range(_ITERATIONS):
        F = residual(Y, slopes @ np.vstack([y, Y]) / h)
        change = (inverse @ F.ravel()).reshape(s, n)
        Y = Y - change
        size = float(np.abs(change).max())
        # Rounding is reached where it no longer falls.
        if size == 0 or (size < 1e-9 * float(np.abs(Y).max()) and size > 0.5 * last):
            break
        last = size
    return np.vstack([y, Y])


def _jacobians(residual: Residual, Y: Array, dY: Array) -> tuple[Array, Array]:
    """Return ∂F/∂y and ∂F/∂ẏ, (s, n, n) each, of one evaluation at all disturbed states."""
    s, n = Y.shape
    unit = np.broadcast_to(1j * _SMALL * np.eye(n)[:, None], (n, s, n))
    disturbed = np.concatenate([Y + unit, np.broadcast_to(Y, (n, s, n))])
    rates = np.concatenate([np.broadcast_to(dY, (n, s, n)), dY + unit])
    F = residual(disturbed.reshape(-1, n), rates.reshape(-1, n)).imag.reshape(2, n, s, n) / _SMALL
    return np.moveaxis(F[0], 0, -1), np.moveaxis(F[1], 0, -1)


@cache
def _radau() -> tuple[Array, Array]:
    """Return 0 and Radau's points in (0, 1], and the derivatives there of the polynomial through all of them."""
    ends = np.zeros(_STAGES + 1)
    ends[-2:] = -1.0, 1.0
    points = np.concatenate([[0.0], (np.sort(legroots(ends)) + 1) / 2])
    points[-1] = 1.0
    apart = points[:, None] - points + np.eye(len(points))
    w = 1 / apart.prod(axis=1)
    slopes = (w / w[:, None]) / apart
    np.fill_diagonal(slopes, 0.0)
    np.fill_diagonal(slopes, -slopes.sum(axis=1))
    return points, slopes[1:]


def _lagrange(points: Array, x: Array) -> Array:
    """Return the weights, (K, s + 1), of values at the points for the polynomial's value at x."""
    others = x[:, None, None] - points[None, None, :]
    apart = points[:, None] - points[None, :]
    own = np.eye(len(points), dtype=bool)
    return np.asarray(np.where(own, 1.0, others / np.where(own, 1.0, apart)).prod(axis=2))
