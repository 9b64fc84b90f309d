"""Gauss-Legendre collocation on the space of `mbkit.model.integration_space`, with its stages solved to rounding.

Hairer, Nørsett, Wanner 1993, Solving Ordinary Differential Equations I, II.7, with Munthe-Kaas's velocities on
rotations. Without quaternions they are symmetric: the step -h undoes the step h. They are symplectic on (q, p), but not
on (q, v) as here.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.methods.tableaus import ImplicitTableau
from mbkit.model.integration_space import Space
from mbkit.simulate.solvers.vector_field import DIVERGED, DivergenceError, Field
from mbkit.simulate.torque import Force

_EPS: Final = float(np.finfo(float).eps)
_MOST: Final = 60
_MOST_NEWTON: Final = 25
# Where a correction is not this much smaller than the last one, plain iteration gives
# way to Newton's, and Newton's matrix to a new one.
_SLOW: Final = 0.05
# Corrections that have stopped shrinking are rounding below this part of the velocity,
# or where they move the configuration by less than this, in rad or m.
_ROUNDING: Final = 1e-11
_LEAST: Final = 1e-13
_UNSOLVED: Final = "the iteration does not solve the equations of the step's stages"


@dataclass(frozen=True)
class _Past:
    """The last step: where it ended, the stages' ẇ, its length, and Newton's matrix if there was one."""

    q: Array
    rates: Array
    h: float
    inverse: Array | None


class CollocationStep:
    """The step of an implicit Runge-Kutta method; it remembers its last step, from which it guesses the next one.

    The unknowns are the stages' rates (u̇, ẇ) side by side, (stages, ..., 2 nv).
    """

    def __init__(self, tableau: ImplicitTableau, field: Field, space: Space) -> None:
        self._A, self._b, self._c, self._s = tableau.A, tableau.b, tableau.c, tableau.stages
        self._times = tableau.c.tolist()
        self._field, self._space, self._nv = field, space, space.nv
        self._past: _Past | None = None

    def __call__(self, t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:
        """Return q and w after a step of h seconds."""
        past = self._past if self._past is not None and self._past.q is q else None
        inverse = past.inverse if past is not None and past.h == h else None
        rates, inverse = self._solved(t, h, q, w, force, self._guess(h, w, past), inverse)
        moved = _mixed(h * self._b, rates)
        q1 = self._space.move(q, moved[..., : self._nv])
        self._past = _Past(q1, rates[..., self._nv :], h, inverse)
        return q1, w + moved[..., self._nv :]

    def _guess(self, h: float, w: Array, past: _Past | None) -> Array:
        # The polynomial through the last step's ẇ, continued.
        nv = self._nv
        rates = np.zeros((self._s, *w.shape[:-1], 2 * nv))
        if past is not None:
            rates[..., nv:] = _mixed(self._continued(h / past.h), past.rates)
        rates[..., :nv] = w + _mixed(h * self._A, rates[..., nv:])
        return rates

    def _continued(self, ratio: float) -> Array:
        c, s = self._c, self._s
        out = np.ones((s, s))
        for i in range(s):
            for j in range(s):
                for k in range(s):
                    if k != j:
                        out[i, j] *= (1 + ratio * c[i] - c[k]) / (c[j] - c[k])
        return out

    def _solved(
        self, t: float, h: float, q: Array, w: Array, force: Force, guess: Array, inverse: Array | None
    ) -> tuple[Array, Array | None]:
        """Return the rates, and Newton's matrix if plain iteration was too slow.

        Plain iteration, or a matrix of an earlier step, gives way to the matrix at the start of this one, and
        that to one of every iterate, with the derivatives at its stages: where a stiff direction turns during
        the step, no other leads there.
        """
        try:
            return self._iterated(t, h, q, w, force, guess, inverse)
        except DivergenceError:
            rates = self._newton(t, h, q, w, force, guess)
            if rates is None:
                raise
            return rates, None

    def _iterated(
        self, t: float, h: float, q: Array, w: Array, force: Force, guess: Array, inverse: Array | None
    ) -> tuple[Array, Array | None]:
        rates, last, fresh = guess, np.full(w.shape[:-1], np.inf), False
        for _ in range(_MOST):
            try:
                change = self._mapped(t, h, q, w, force, rates) - rates
            except DivergenceError:
                # An iteration that runs away is no sign that the motion does.
                if fresh or rates is guess:
                    raise
                rates, slow = guess, True
            else:
                change = change if inverse is None else _times(inverse, change)
                tried, size = rates + change, self._size(h, change)
                done, slowly = self._judged(h, w, tried, size, last)
                if done.all():
                    return tried, inverse
                slow = bool(slowly[~done].any())
                rates = guess if slow and not fresh and not (size < last).all() else tried
                last = size
            if slow and not fresh:
                inverse, fresh = self._inverse(t, h, q, w, force), True
                last = np.full(w.shape[:-1], np.inf)
        raise DivergenceError(_UNSOLVED)

    def _newton(self, t: float, h: float, q: Array, w: Array, force: Force, rates: Array) -> Array | None:
        """Return the rates by Newton's method proper; None where that leads nowhere."""
        last = np.full(w.shape[:-1], np.inf)
        for _ in range(_MOST_NEWTON):
            try:
                change = self._mapped(t, h, q, w, force, rates) - rates
                change = _times(self._inverse_at(t, h, q, w, force, rates), change)
            except DivergenceError:
                return None
            rates, size = rates + change, self._size(h, change)
            done, _ = self._judged(h, w, rates, size, last)
            if done.all():
                return rates
            last = size
        return None

    def _judged(
        self, h: float, w: Array, rates: Array, size: Array, last: Array
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return, per state, whether the rates are solved for, and whether that takes too long."""
        speed = np.maximum(_largest(w), self._size(h, rates))
        # The first correction follows from the guess, and tells no factor.
        measurable = np.isfinite(last)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = size / last
            rest = size * factor / (1 - factor)
        done = (size <= _EPS * speed) | (measurable & (factor < 1) & (rest <= _EPS / 4 * speed))
        done |= measurable & (factor > 0.5) & ((size <= _ROUNDING * speed) | (h * size <= _LEAST))
        return done, measurable & ~(factor < _SLOW)

    def _size(self, h: float, rates: Array) -> Array:
        """Return, per state, the largest velocity among u̇ and h ẇ of all stages."""
        weighted = np.abs(rates)
        weighted[..., self._nv :] *= h
        return np.asarray(weighted.max(axis=(0, -1), initial=0.0))

    def _mapped(self, t: float, h: float, q: Array, w: Array, force: Force, rates: Array) -> Array:
        """Return the rates at the stages that these rates lead to."""
        nv, s = self._nv, self._s
        moved = _mixed(h * self._A, rates)
        u, w_i = moved[..., :nv], w + moved[..., nv:]
        out = np.empty(rates.shape)
        for i in range(s):
            self._rates(t + self._times[i] * h, q, u[i], w_i[i], force, out[i])
        return out

    def _rates(self, t: float, q: Array, u: Array, w: Array, force: Force, out: Array) -> Array:
        out[..., : self._nv] = self._space.rate(u, w)
        out[..., self._nv :] = self._field(t, self._space.move(q, u), w, force)
        return out

    def _inverse(self, t: float, h: float, q: Array, w: Array, force: Force) -> Array:
        """Return (1 - h A⊗J)⁻¹ with J = ∂(u̇, ẇ)/∂(u, w) at the start of the step."""
        J = self._slopes(t, q, np.zeros(w.shape), w, force)
        return _inverse_of(np.einsum("ij,...kl->...ikjl", h * self._A, J))

    def _inverse_at(self, t: float, h: float, q: Array, w: Array, force: Force, rates: Array) -> Array:
        """Return (1 - h A⊗J)⁻¹ with J of row i at stage i of these rates."""
        moved = _mixed(h * self._A, rates)
        u, w_i = moved[..., : self._nv], w + moved[..., self._nv :]
        J = np.stack([self._slopes(t + c * h, q, u[i], w_i[i], force) for i, c in enumerate(self._times)])
        return _inverse_of(np.einsum("ij,i...kl->...ikjl", h * self._A, J))

    def _slopes(self, t: float, q: Array, u: Array, w: Array, force: Force) -> Array:
        """Return J = ∂(u̇, ẇ)/∂(u, w) by differences: half of the digits are enough for the iteration."""
        nv = self._nv
        size = sqrt(_EPS) * max(1.0, float(np.abs(w).max(initial=0.0)))
        J = np.empty((*w.shape[:-1], 2 * nv, 2 * nv))
        there, moved = np.empty(J.shape[:-1]), np.empty(J.shape[:-1])
        y = np.concatenate([u, w], axis=-1)
        self._rates(t, q, u, w, force, there)
        for k in range(2 * nv):
            y[..., k] += size
            self._rates(t, q, y[..., :nv], y[..., nv:], force, moved)
            y[..., k] = (u if k < nv else w)[..., k % nv]
            J[..., k] = (moved - there) / size
        return J


def _inverse_of(product: Array) -> Array:
    """Return (1 - product)⁻¹ of (..., s, m, s, m) as (..., s m, s m)."""
    rows = product.shape[-1] * product.shape[-2]
    product = product.reshape(*product.shape[:-4], rows, rows)
    try:
        return np.asarray(np.linalg.inv(np.eye(rows) - product))
    except np.linalg.LinAlgError:
        raise DivergenceError(_UNSOLVED if np.isfinite(product).all() else DIVERGED) from None


def _mixed(weights: Array, rates: Array) -> Array:
    """Return sums of the stages' rates."""
    return np.asarray((weights @ rates.reshape(len(rates), -1)).reshape(*weights.shape[:-1], *rates.shape[1:]))


def _largest(x: Array) -> Array:
    return np.asarray(np.abs(x).max(axis=-1, initial=0.0))


def _times(inverse: Array, change: Array) -> Array:
    """Return the product with the stages' changes, (stages, ..., 2 nv), of each state."""
    if change.ndim == 2:
        return np.asarray(inverse @ change.ravel()).reshape(change.shape)
    s, rows = len(change), change.shape[-1]
    stacked = np.moveaxis(change, 0, -2)
    product = inverse @ stacked.reshape(*stacked.shape[:-2], s * rows, 1)
    return np.moveaxis(product.reshape(stacked.shape), -2, 0)
