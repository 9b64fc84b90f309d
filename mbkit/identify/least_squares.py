"""Weighted least squares of triangular systems: estimates, standard deviations, and what the data cannot tell.

Noise of every velocity's torque has a variance of its own, taken from its residuals and used as weight, until both
agree (Gautier and Poignet 2001, Extended Kalman filtering and weighted least squares dynamic identification of robot;
Swevers et al. 1997, Optimal robot excitation and identification). Columns are scaled to equal length before the
singular value decomposition, so that its small values are directions that the data cannot tell, and no matter of units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from mbkit._check import EPS, PRINTED, Array
from mbkit.identify.measurements import Equations
from mbkit.model.base_parameters import eliminated

#: Singular values below this part of the largest one are directions that the data cannot tell. The rest of
#: geometry that counts as parallel is 1e-7 for base parameters; noise would be blown up as much.
SINGULAR_VALUE_RATIO: Final = 1e-8
_MAX_REWEIGHTINGS: Final = 10
#: Change of variances between two rounds at which they are taken as settled.
_VARIANCE_CHANGE: Final = 1e-3


@dataclass(frozen=True, eq=False)
class Fit:
    """The least squares of all equations.

    Attributes
    ----------
    values : (p,) array
        Along directions that the data cannot tell they are as far as before.
    deviations : (p,) array
        Standard deviations, no less than rounding; infinite where the data cannot tell a parameter.
    null : (k, p) array
        Directions that change no torque, each with a one that the others do not have.
    condition : float
        Of the matrix with columns of equal length, without those directions.
    noise : (nv,) array
        Standard deviation of each velocity's torque.
    """

    values: Array
    deviations: Array
    null: Array
    condition: float
    noise: Array


def fit(equations: Sequence[Equations], start: Array, units: Array, *, weighted: bool) -> Fit:
    """Solve the equations.

    Parameters
    ----------
    given : sequence of Equations
        One for each velocity.
    start : (p,) array
        The parameters as they are known before.
    units : (p,) array
        Natural sizes of the columns: one whose length is nothing beside the others in these counts as zero.
    weighted : bool
        Whether the equations have their weights already; else those of their noise are found.
    """
    noise = np.ones(len(equations))
    for _ in range(_MAX_REWEIGHTINGS):
        solution = _Solution(equations, noise, start, units)
        residuals = solution.residual_noise()
        if weighted:
            break
        before, noise = noise, _weighing(residuals, equations)
        if np.abs(noise / before - 1).max(initial=0.0) < _VARIANCE_CHANGE:
            break
    null = solution.null
    # Rounding of a sum of equations moves the estimates together, unlike noise of each.
    rounding = EPS * max((x.count**0.5 * x.size for x in equations), default=0.0)
    deviations = np.where(null.any(axis=0), np.inf, solution.deviations(np.maximum(residuals, rounding)))
    return Fit(solution.values, deviations, null, solution.condition, residuals)


def stacked(equations: Sequence[Equations], noise: Array) -> Array:
    """Return all equations, each over its noise, as one triangular system, (m, p + 1)."""
    out: Array = np.vstack([x.factor / s for x, s in zip(equations, noise, strict=True)])
    return np.asarray(np.linalg.qr(out, mode="r")) if len(out) > out.shape[1] else out


def _weighing(noise: Array, equations: Sequence[Equations]) -> Array:
    """Return the noise that weighs: no less than rounding, nor so small that the other equations would not count."""
    rounding = EPS * (max((x.size for x in equations), default=0.0) or 1.0)
    return np.maximum(noise, max(rounding, PRINTED * float(noise.max(initial=0.0))))


class _Solution:
    """The least squares for noise that is given."""

    def __init__(self, equations: Sequence[Equations], noise: Array, start: Array, units: Array) -> None:
        self._given, self._noise = equations, noise
        system = stacked(equations, noise)
        A, b = system[:, :-1], system[:, -1]
        lengths = np.linalg.norm(A, axis=0)
        natural = lengths / units
        observable = natural > SINGULAR_VALUE_RATIO * natural.max(initial=0.0)
        scale = np.where(observable, lengths, 1.0)
        U, sizes, axes = np.linalg.svd(np.where(observable, A / scale, 0.0))
        rank = int(np.sum(sizes > SINGULAR_VALUE_RATIO * sizes.max(initial=0.0)))
        self.condition = float(sizes[0] / sizes[rank - 1]) if rank else np.nan
        #: Parameters of each unit of the directions that the data can tell.
        self._back = axes[:rank].T / sizes[:rank] / scale[:, None]
        self.values = start + self._back @ (U[:, :rank].T @ (b - A @ start))
        self.null = _directions(axes[rank:], scale)

    def residual_noise(self) -> Array:
        """Return the standard deviation of each velocity's residuals, less the freedom that parameters took."""
        equations, noise = self._given, self._noise
        squares = np.array([np.sum((x.factor[:, :-1] @ self.values - x.factor[:, -1]) ** 2) for x in equations])
        left = np.array([x.count - np.sum(part**2) for x, part in zip(equations, self._parts(), strict=True)])
        # A velocity with next to no freedom left takes the noise of all of them.
        shared = np.sum(squares / noise**2) / max(float(left.sum()), 1.0)
        return np.asarray(np.sqrt(np.where(left >= 1.0, squares / np.maximum(left, 1.0), shared * noise**2)))

    def deviations(self, noise: Array) -> Array:
        """Return the standard deviations of the parameters if the torques have this noise."""
        parts = [x * (s / own) for x, s, own in zip(self._parts(), noise, self._noise, strict=True)]
        return np.asarray(np.linalg.norm(np.vstack(parts) @ self._back.T, axis=0))

    def _parts(self) -> list[Array]:
        """Return the rows of each velocity for units of the directions that the data can tell."""
        return [x.factor[:, :-1] @ self._back / s for x, s in zip(self._given, self._noise, strict=True)]


def _directions(null: Array, scale: Array) -> Array:
    """Return directions in units of the parameters, with an identity matrix among their columns."""
    if not len(null):
        return null
    eliminated_columns, unit = eliminated(null)
    unit[np.abs(unit) < PRINTED * np.abs(unit).max(axis=1, keepdims=True)] = 0.0
    return np.asarray(unit * scale[eliminated_columns, None] / scale)
