"""Gauss-Legendre collocation on the space of `mbkit.model.integration_space`, with its stages solved to rounding.

Hairer, Nørsett, Wanner 1993, Solving Ordinary Differential Equations I, II.7, with Munthe-Kaas's velocities on
rotations. Without quaternions they are symmetric: the step -h undoes the step h. They are symplectic on (q, p), but not
on (q, v) as here.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from mbkit._check import EPS, ITERATED, Array
from mbkit.methods.one_step import MAX_NEWTON_ITERATIONS
from mbkit.methods.tableaus import ImplicitTableau, extrapolation_weights, gauss_legendre
from mbkit.model.integration_space import Space
from mbkit.simulate.singular_poses import time_ahead, undetermined
from mbkit.simulate.solvers.vector_field import DIVERGED, DivergenceError, Field
from mbkit.simulate.torque import Force

#: Most iterations of a step that converge linearly: with one matrix at most, or under a torque function.
MAX_ITERATIONS: Final = 60
#: Largest ratio of a correction to the last one with which an iteration goes on. Beyond it plain iteration gives way to
#: Newton's, and Newton's matrix to a new one.
_MAX_CONTRACTION: Final = 0.05
#: Largest move of the configuration that is rounding where corrections have stopped shrinking, rad or m.
_MAX_MOVE_ROUNDING: Final = 1e-13
#: Largest difference of two times that are one, in steps.
_MAX_TIME_ROUNDING: Final = 1e-9
#: Distance of a pose from the start, in lengths of the step, from which it is far behind the end. Near the end f̈ = 0 at
#: the stages leaves the distance from the constraints open.
AT_END: Final = 1.5
_UNSOLVED: Final = "the iteration does not solve the equations of the step's stages"


class _Start(NamedTuple):
    """Where a step starts, and what acts on it."""

    t: float
    h: float
    q: Array
    w: Array
    force: Force


class _Past(NamedTuple):
    """A step: when it ended, the stages' ẇ, its length, and Newton's matrix if there was one."""

    end: float
    rates: Array
    h: float
    inverse: Array | None


class CollocationStep:
    """The step of an implicit Runge-Kutta method; it remembers its last step, from which it guesses the next one.

    The unknowns are the stages' rates (u̇, ẇ) side by side, (stages, ..., 2 nv).
    """

    def __init__(self, tableau: ImplicitTableau, field: Field, space: Space, *, near_pose: bool = False) -> None:
        self._A, self._b, self._c, self._s = tableau.A, tableau.b, tableau.c, tableau.stages
        self._times = tableau.c.tolist()
        self._field, self._space, self._nv, self._near_pose = field, space, space.nv, near_pose
        # The last step, and the one before, from which it may be tried again.
        self._past: list[_Past] = []

    def __call__(self, t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:
        """Return q and w after a step of h seconds."""
        rates = self.rates(t, h, q, w, force)
        moved = _mixed(h * self._b, rates)
        return self._space.retract(q, moved[..., : self._nv]), w + moved[..., self._nv :]

    def rates(self, t: float, h: float, q: Array, w: Array, force: Force) -> Array:
        """Return the stages' rates of such a step, (stages, ..., 2 nv)."""
        start = _Start(t, h, q, w, force)
        near = (x for x in self._past if abs(x.end - t) < _MAX_TIME_ROUNDING * h)
        past = next((x for x in near if x.rates.shape[1:] == w.shape), None)
        rates, inverse = self._solved(start, self._guess(start, past), past.inverse if past and past.h == h else None)
        self._past = [_Past(t + h, rates[..., self._nv :], h, inverse), *([] if past is None else [past])]
        return rates

    def _guess(self, start: _Start, past: _Past | None) -> Array:
        # The polynomial through the last step's ẇ is continued; a first step has the ẇ at its start.
        nv, w = self._nv, start.w
        rates = np.zeros((self._s, *w.shape[:-1], 2 * nv))
        if past is not None:
            weights = extrapolation_weights(self._times, 1 + start.h / past.h * self._c)
            rates[..., nv:] = _mixed(weights, past.rates)
        elif not self._near_pose:
            rates[..., nv:] = self._field(start.t, start.q, w, start.force)
        rates[..., :nv] = w + _mixed(start.h * self._A, rates[..., nv:])
        return rates

    def _solved(self, start: _Start, guess: Array, inverse: Array | None) -> tuple[Array, Array | None]:
        """Return the rates, and Newton's matrix if plain iteration was too slow.

        Plain iteration, or a matrix of an earlier step, gives way to the matrix at the start of this one, and
        that to one of every iterate, with the derivatives at its stages: where a stiff direction turns during
        the step, no other leads there, and none near a singular pose.
        """
        if self._near_pose:
            return self._newton(start, guess), None
        try:
            return self._iterated(start, guess, inverse)
        except DivergenceError as error:
            try:
                return self._newton(start, guess), None
            except DivergenceError:
                raise error from None

    def _iterated(self, start: _Start, guess: Array, inverse: Array | None) -> tuple[Array, Array | None]:
        unknown = np.full(start.w.shape[:-1], np.inf)
        rates, last, fresh = guess, unknown, False
        for _ in range(MAX_ITERATIONS):
            try:
                change = self._mapped(start, rates) - rates
            except DivergenceError:
                # An iteration that runs away is no sign that the motion does.
                if fresh or rates is guess:
                    raise
                rates, slow = guess, True
            else:
                change = change if inverse is None else _times(inverse, change)
                corrected, size = rates + change, self._size(start.h, change)
                done, slowly = self._judged(start, corrected, size, last)
                if done.all():
                    return corrected, inverse
                slow = bool(slowly[~done].any())
                rates = guess if slow and not fresh and not (size < last).all() else corrected
                last = size
            if slow and not fresh:
                J = self._slopes(start, 0.0, np.zeros(start.w.shape), start.w)
                inverse = _inverse_of(np.einsum("ij,...kl->...ikjl", start.h * self._A, J))
                fresh, last = True, unknown
        raise DivergenceError(_UNSOLVED)

    def _newton(self, start: _Start, rates: Array) -> Array:
        """Return the rates by Newton's method proper."""
        last = np.full(start.w.shape[:-1], np.inf)
        for _ in range(MAX_NEWTON_ITERATIONS):
            change = self._mapped(start, rates) - rates
            stages = zip(self._times, *self._stages(start, rates), strict=True)
            J = np.stack([self._slopes(start, c, u, w) for c, u, w in stages])
            change = _times(_inverse_of(np.einsum("ij,i...kl->...ikjl", start.h * self._A, J)), change)
            rates, size = rates + change, self._size(start.h, change)
            done, _ = self._judged(start, rates, size, last)
            if done.all():
                return rates
            last = size
        raise DivergenceError(_UNSOLVED)

    def _judged(
        self, start: _Start, rates: Array, size: Array, last: Array
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return, per state, whether the rates are solved for, and whether that takes too long."""
        speed = np.maximum(np.abs(start.w).max(axis=-1, initial=0.0), self._size(start.h, rates))
        # The first correction follows from the guess, and tells no factor.
        measurable = np.isfinite(last)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = size / last
            rest = size * factor / (1 - factor)
        done = (size <= EPS * speed) | (measurable & (factor < 1) & (rest <= EPS / 4 * speed))
        done |= measurable & (factor > 0.5) & ((size <= ITERATED * speed) | (start.h * size <= _MAX_MOVE_ROUNDING))
        return done, measurable & ~(factor < _MAX_CONTRACTION)

    def _size(self, h: float, rates: Array) -> Array:
        """Return, per state, the largest velocity among u̇ and h ẇ of all stages."""
        weighted = np.abs(rates)
        weighted[..., self._nv :] *= h
        return np.asarray(weighted.max(axis=(0, -1), initial=0.0))

    def _stages(self, start: _Start, rates: Array) -> tuple[Array, Array]:
        """Return u and w of the stages that these rates lead to."""
        moved = _mixed(start.h * self._A, rates)
        return moved[..., : self._nv], start.w + moved[..., self._nv :]

    def _mapped(self, start: _Start, rates: Array) -> Array:
        """Return the rates at the stages that these rates lead to."""
        u, w = self._stages(start, rates)
        out = np.empty(rates.shape)
        for i, c in enumerate(self._times):
            self._rates(start, c, u[i], w[i], out[i])
        return out

    def _rates(self, start: _Start, c: float, u: Array, w: Array, out: Array) -> None:
        out[..., : self._nv] = self._space.rate(u, w)
        out[..., self._nv :] = self._field(start.t + c * start.h, self._space.retract(start.q, u), w, start.force)

    def _slopes(self, start: _Start, c: float, u: Array, w: Array) -> Array:
        """Return J = ∂(u̇, ẇ)/∂(u, w) by differences: half of the digits are enough for the iteration."""
        nv = self._nv
        size = math.sqrt(EPS) * max(1.0, float(np.abs(w).max(initial=0.0)))
        J = np.empty((*w.shape[:-1], 2 * nv, 2 * nv))
        there, moved = np.empty(J.shape[:-1]), np.empty(J.shape[:-1])
        y = np.concatenate([u, w], axis=-1)
        self._rates(start, c, u, w, there)
        for k in range(2 * nv):
            y[..., k] += size
            self._rates(start, c, y[..., :nv], y[..., nv:], moved)
            y[..., k] = (u if k < nv else w)[..., k % nv]
            J[..., k] = (moved - there) / size
        return J


class StepPolynomial:
    """The states within a step of collocation, by the polynomials of its stages' rates.

    Attributes
    ----------
    t, h : float
        Where it starts, and its length, s.
    last : (..., nv) array
        Size of the last term in u: the error of places within the step. Those of its end are of twice the order.
    """

    def __init__(self, space: Space, times: Array, start: _Start, rates: Array) -> None:
        self._space, self._start, self.t, self.h = space, start, start.t, start.h
        terms = _mixed(np.asarray(np.linalg.inv(legendre.legvander(2 * times - 1, len(times) - 1)), float), rates)
        self._moved = legendre.legint(terms, lbnd=-1, scl=self.h / 2)
        self.last = self.h * np.abs(terms[-1, ..., : space.nv])

    def at(self, t: float) -> tuple[Array, Array]:
        """Return q and w at a time within the step."""
        u, w = np.split(legendre.legval(2 * (t - self.t) / self.h - 1, self._moved), 2, axis=-1)
        return self._space.retract(self._start.q, u), self._start.w + w


class StepNearPose:
    """Steps of one state near a singular pose, by Gauss's collocation, which Newton's iteration solves.

    f̈ = 0 divides the stages' distance from the constraints by J's smallest singular value. Those of collocation are
    close to the motion, and none is at an end, which may be the pose. A polynomial that ends at the pose or soon behind
    it is not determined, and one that goes twice as far as the pose is.
    """

    def __init__(self, field: Field, space: Space, stages: int) -> None:
        tableau = gauss_legendre(stages)
        self._field, self._space, self._times = field, space, tableau.c
        self._collocation = CollocationStep(tableau, field, space, near_pose=True)

    def part(self, t: float, h: float, stop: float, q: Array, w: Array, force: Force) -> tuple[float, StepPolynomial]:
        """Return the end of a step over at least h seconds, which is not behind the stop, and the step's polynomial."""
        v = self._space.to_body_velocity(q, w)
        ahead = float(np.ravel(time_ahead(self._field.dyn, t, q, v))[0])
        if not ahead and (why := undetermined(self._field.dyn, t, q, v)):
            raise DivergenceError(f"the motion is {why}")
        if 0 < ahead < AT_END * h:
            h = max(h, 2 * ahead)
        rates = self._collocation.rates(t, h, q, w, force)
        return min(t + h, stop), StepPolynomial(self._space, self._times, _Start(t, h, q, w, force), rates)

    def __call__(self, t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:
        """Return q and w of one state after h seconds."""
        return self.part(t, h, math.inf, q, w, force)[1].at(t + h)


def _inverse_of(coupled: Array) -> Array:
    """Return (1 - coupled)⁻¹ of (..., s, m, s, m) as (..., s m, s m)."""
    rows = coupled.shape[-1] * coupled.shape[-2]
    coupled = coupled.reshape(*coupled.shape[:-4], rows, rows)
    try:
        return np.asarray(np.linalg.inv(np.eye(rows) - coupled))
    except np.linalg.LinAlgError:
        raise DivergenceError(_UNSOLVED if np.isfinite(coupled).all() else DIVERGED) from None


def _mixed(weights: Array, rates: Array) -> Array:
    """Return sums of the stages' rates."""
    return np.asarray((weights @ rates.reshape(len(rates), -1)).reshape(*weights.shape[:-1], *rates.shape[1:]))


def _times(inverse: Array, change: Array) -> Array:
    """Return the product with the stages' changes, (stages, ..., 2 nv), of each state."""
    if change.ndim == 2:
        return np.asarray(inverse @ change.ravel()).reshape(change.shape)
    s, rows = len(change), change.shape[-1]
    stacked = np.moveaxis(change, 0, -2)
    changed = inverse @ stacked.reshape(*stacked.shape[:-2], s * rows, 1)
    return np.moveaxis(changed.reshape(stacked.shape), -2, 0)
