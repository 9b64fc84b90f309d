"""The Rosenbrock step stage by stage, on any engine's forward dynamics and under any torque.

It acts on y = (q, v) with quaternions as four numbers, whose exact flow keeps their length, and takes the exact
Jacobian of `mbkit.simulate.linearization`. A state within a step is that of the method's own polynomial of order 4,
whose error is a part of the one that the step is judged by; a shorter step would cost as much as the step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit._step_control import DEFECT, GROWTH, SAFETY
from mbkit.engines import Dynamics
from mbkit.model.space import Space
from mbkit.simulate.embedded_stages import StageTrials
from mbkit.simulate.embedded_trials import Stretch
from mbkit.simulate.linearization import Linearization
from mbkit.simulate.methods import Tolerances
from mbkit.simulate.rates import Rates, unit_quaternions
from mbkit.simulate.rosenbrock_tableau import rodas5p
from mbkit.simulate.steps import RAN_AWAY, DivergenceError
from mbkit.simulate.torque import Torque

__all__ = ["RosenbrockTrials"]

#: Of a step: how far apart the rates are that tell the time's own part, by a parabola.
_APART: Final = 1e-3


class RosenbrockTrials(StageTrials):
    """Tries one step at a time, in NumPy; `Trials` says what its methods do."""

    grows = 5

    def __init__(
        self,
        dyn: Dynamics,
        space: Space,
        tolerances: Tolerances,
        torque: Torque,
        duration: float,
        batch: int | None,
    ) -> None:
        super().__init__(dyn, space, tolerances, torque, duration, batch)
        self._model = dyn.model
        self._own_rates, self._exact = Rates(dyn), Linearization(dyn)
        own = rodas5p()
        self._gamma, self._A, self._C, self._b, self._d = own.gamma, own.A, own.C, own.b, own.d
        self._ends, self._e = own.c.tolist(), own.error
        self._timed = torque.callable or dyn.model.clock is not None
        # Each number of y is as large as itself, those of a quaternion as 1.
        self._turning = np.zeros(dyn.model.nq + dyn.model.nv)
        for start, _ in dyn.model.quaternions:
            self._turning[start : start + 4] = 1.0
        self._dense = own.dense
        self._start: tuple[Array, Array, Array] | None = None
        self._arrived: tuple[Array, Array] | None = None
        # Of the last try: t and y at both ends, and the stages.
        self._last_try: tuple[float, float, Array, Array, Array] | None = None

    @property
    def evaluations(self) -> int:
        """Of the forward dynamics so far."""
        return self._field.evaluations + self._own_rates.evaluations

    @property
    def jacobians(self) -> int:
        """Evaluated so far."""
        return self._exact.evaluations

    def start(self, which: Sequence[int], q: Array, w: Array, t: float = 0.0, h: float = 0.0) -> None:
        """Begin at a state."""
        super().start(which, q, w, t, h)
        if self._batch is not None:
            self._own_rates.only(which[0])
            self._exact.only(which[0])

    def _factors(self, error: float) -> tuple[float, float, float]:
        eighth = math.sqrt(math.sqrt(math.sqrt(error)))
        sixteenth = math.sqrt(eighth)
        under = eighth * sixteenth
        return GROWTH if GROWTH * under < SAFETY else SAFETY / under, under, math.sqrt(sixteenth)

    def _tried(self, step: float) -> tuple[Array, Array, float]:
        y, there, J = self._known()
        k = self._stages(self._t, y, step, there, J)
        y1, error = y + self._b @ k, self._e @ k
        t1 = self._t + step
        self._last_try = self._t, t1, y, y1, k
        rtol, atol = self._tolerances
        scale = atol + rtol * np.maximum(np.maximum(np.abs(y), np.abs(y1)), self._turning)
        found = _norm(error / scale)
        if found < 1:
            rate = self._rate(t1, y1)
            slope = (self._b - self._dense.sum(axis=0)) @ k
            found = max(found, _norm((step * rate - slope) / scale) / DEFECT)
            self._arrived = y1, rate
            if not math.isfinite(found):
                raise DivergenceError(self._own_rates.why or RAN_AWAY)
        return *self._state(y1), found

    def _known(self) -> tuple[Array, Array, Array]:
        """Return y, ẏ and ∂ẏ/∂y where the step starts, evaluated once for all tries from there."""
        if self._fresh or self._start is None:
            self._own_rates.why = ""
            y = np.concatenate([self._q, self._space.leave(self._q, self._w)])
            arrived, self._arrived = self._arrived, None
            # Where the last step ended the rate is known, unless another force acts from there.
            known = arrived is not None and np.array_equal(arrived[0], y)
            rate = arrived[1] if known and arrived is not None else self._rate(self._t, y)
            self._start = y, rate, self._exact(self._t, y, self._force)
        return self._start

    def hold(self, k: int, stop: float) -> None:
        """Go on to a time, under the force of an interval."""
        self._arrived = None
        super().hold(k, stop)

    def _rate(self, t: float, y: Array) -> Array:
        return self._own_rates(t, y, self._force)

    def _state(self, y: Array) -> tuple[Array, Array]:
        nq = self._model.nq
        q = unit_quaternions(self._model, y[:nq])[0]
        return q, self._space.enter(q, y[nq:])

    def _stages(self, t: float, y: Array, h: float, there: Array, J: Array) -> Array:
        """Return what the stages of a step of length h come to, (s, n)."""
        from scipy.linalg import lapack

        g, n = self._gamma * h, len(y)
        matrix = -g * J
        matrix.flat[:: n + 1] += 1.0
        lu, pivots, _ = lapack.dgetrf(matrix)
        by_time = h * self._by_time(t, y, h, there) if self._timed else None
        k = np.empty((len(self._b), n))
        for i in range(len(k)):
            rate = there if not i else self._rate(t + self._ends[i] * h, y + self._A[i, :i] @ k[:i])
            right = g * rate + self._gamma * (self._C[i, :i] @ k[:i])
            if by_time is not None:
                right += (g * self._d[i]) * by_time
            k[i], _ = lapack.dgetrs(lu, pivots, right)
        # What was no number anywhere is none here.
        if not np.isfinite(k).all():
            raise DivergenceError(self._own_rates.why or RAN_AWAY)
        return k

    def _by_time(self, t: float, y: Array, h: float, there: Array) -> Array:
        apart = _APART * h
        near, far = self._rate(t + apart, y), self._rate(t + 2 * apart, y)
        return (4 * near - far - 3 * there) / (2 * apart)

    def within(self, place: int, start: Stretch, times: Array) -> tuple[Array, Array]:  # noqa: ARG002
        """Return states within steps: of the last one by its polynomial, of others by shorter steps."""
        made = [
            self._within(t, q, w, end) for t, q, w, end in zip(start.t.tolist(), start.q, start.w, times, strict=True)
        ]
        q, w = (np.array([pair[i] for pair in made]) for i in (0, 1))
        return q, w

    def _within(self, t: float, q: Array, w: Array, end: float) -> tuple[Array, Array]:
        last = self._last_try
        try:
            if last is not None and last[0] == t and end <= last[1]:
                t0, t1, y0, y1, k = last
                part = (end - t0) / (t1 - t0)
                one, two, three = self._dense @ k
                bend = (1 - part) * (one + part * (two + part * three))
                return self._state((1 - part) * y0 + part * (y1 + bend))
            self._own_rates.why = ""
            y = np.concatenate([q, self._space.leave(q, w)])
            k = self._stages(t, y, end - t, self._rate(t, y), self._exact(t, y, self._force))
            return self._state(y + self._b @ k)
        except DivergenceError:
            return np.full(q.shape, np.nan), np.full(w.shape, np.nan)


def _norm(x: Array) -> float:
    return math.sqrt(float(x @ x) / max(len(x), 1))
