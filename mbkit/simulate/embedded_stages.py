"""The embedded step stage by stage, on any engine's forward dynamics and under any torque."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mbkit._check import Array
from mbkit._step_control import GROWTH, LAST, SAFETY, SHRINK
from mbkit.engines import Dynamics
from mbkit.model.space import Space
from mbkit.simulate.consistent import LOOSEST
from mbkit.simulate.embedded_trials import Stretch, first_length
from mbkit.simulate.methods import Tolerances
from mbkit.simulate.steps import RAN_AWAY, DivergenceError, Field
from mbkit.simulate.tableau import dormand_prince_853
from mbkit.simulate.torque import Force, Torque

__all__ = ["StageTrials"]


class _OneOf(Field):
    """The field of one member of a batch, on single states."""

    def one(self, member: int) -> None:
        self._use(self._dyn.of_samples([member]))

    def consistent(self, t: float, q: Array, w: Array, force: Force) -> Array:
        """Return ẇ beside a single state."""
        return super().consistent(t, q, w, force).reshape(-1)

    def __call__(self, t: float, q: Array, w: Array, force: Force) -> Array:
        """Return ẇ of a single state; one of a batch with parameters of its own is a batch of one."""
        return super().__call__(t, q, w, force).reshape(-1)


class StageTrials:
    """Tries one step at a time, in NumPy; `Trials` says what its methods do."""

    width = rounds = 1
    #: The power of a step's length with which its estimated error grows.
    grows = 8

    def __init__(
        self,
        dyn: Dynamics,
        space: Space,
        tolerances: Tolerances,
        torque: Torque,
        duration: float,
        batch: int | None,
    ) -> None:
        self._space, self._tolerances, self._torque, self._batch = space, tolerances, torque, batch
        self._field = _OneOf(dyn, self._space)
        self._tableau = dormand_prince_853()
        self._c = self._tableau.c.tolist()
        self._least = duration * float(np.finfo(float).eps)
        nv = self._space.nv
        # (u̇, ẇ) of each stage.
        self._rates = np.empty((self._tableau.stages, 2 * nv))
        self._force: Force = np.zeros(nv)
        self._h = self._t = self._stop = 0.0
        self._why = ""
        # What the tolerance is multiplied by.
        self._slack = 1.0

    @property
    def evaluations(self) -> int:
        """Of the forward dynamics so far."""
        return self._field.evaluations

    @property
    def jacobians(self) -> int:
        """Evaluated so far."""
        return 0

    def start(self, which: Sequence[int], q: Array, w: Array, t: float = 0.0, h: float = 0.0) -> None:
        """Begin at a state."""
        (member,) = which
        if self._batch is not None:
            self._field.one(member)
        self._of_interval = self._torque.of_member(None if self._batch is None else member)
        self._q, self._w, self._t, self._h = q[0], w[0], t, h
        self._most, self._last, self._error = GROWTH, LAST, 0.0
        self._dropped, self._fresh = False, True

    def hold(self, k: int, stop: float) -> None:
        """Go on to a time; where nothing else says so, with a first step."""
        self._force, self._stop, self._fresh = self._of_interval(k), stop, True
        if not self._h and not self._dropped:
            self._h = self._first()

    def _first(self) -> float:
        def probe(q: Array, w: Array) -> Array:
            return self._field(self._t, q[0], w[0], self._force)[None]

        q, w = self._q[None], self._w[None]
        try:
            h = float(first_length(self._space, q, w, probe(q, w), self._tolerances, probe, self.grows)[0])
        except DivergenceError:
            h = math.nan
        # Where there is no rate, the step finds that out. At the least length no step
        # would be tried at all, and nobody be told.
        return max(h if h > 0 else 1e-6 * (self._stop - self._t), 2 * self._least)

    def advance(self) -> list[tuple[int, Stretch]]:
        """Try one step."""
        if self._dropped or self._t >= self._stop or self.stuck(0) is not None:
            return []
        gap = self._stop - self._t
        ends = self._h >= gap
        t = self._stop if ends else self._t + (self._h if 2 * self._h < gap else 0.5 * gap)
        step = t - self._t
        before = [self._t], [self._q], [self._w]
        q, w, self._error = self._try(step)
        good = self._error < 1 and step > 0
        self._settle(step, good)
        if good:
            q, w = self._field.settled(t, q, w)
            self._t, self._q, self._w, self._fresh = t, q, w, True
            for row, x in zip(before, (t, q, w), strict=True):
                row.append(x)
        return [(0, Stretch(np.array(before[0]), np.array(before[1]), np.array(before[2]), 1))]

    def _settle(self, step: float, good: bool) -> None:
        factor, under, root = self._factors(self._error if self._error >= 0 else math.nan)
        if good:
            grown = step * min(factor, self._most)
            # A step that was short only because the end was near says little.
            self._h = self._h if 2 * step < self._h and grown < self._h else grown
            self._last, self._slack = max(root, LAST), 1.0
        elif self._field.near_singular and self._slack * self._tolerances.rtol < LOOSEST and self._error >= 1:
            # Near a singular pose shorter steps are no better: their stages are nearer to it, and rounding grows.
            self._slack, self._h = 10 * self._slack, 0.8 * step
        else:
            self._h = step * (SAFETY / under if SHRINK * under < SAFETY else SHRINK)
        self._most = GROWTH if good else 1.0

    def _factors(self, error: float) -> tuple[float, float, float]:
        """Return what a step grows by after this error, what it shrinks in proportion to, and the root to remember."""
        eighth = math.sqrt(math.sqrt(math.sqrt(error)))
        sixteenth = math.sqrt(eighth)
        root = math.sqrt(sixteenth)
        over, under = SAFETY * self._last, sixteenth * root
        return GROWTH if GROWTH * under < over else over / under, eighth, root

    def _try(self, step: float) -> tuple[Array, Array, float]:
        try:
            made = self._tried(step)
        except DivergenceError as error:
            self._why, self._fresh = str(error), True
            return self._q, self._w, math.nan
        self._why, self._fresh = "", False
        return made

    def _tried(self, step: float) -> tuple[Array, Array, float]:
        q, w, u = self._step(self._t, self._q, self._w, step, fresh=self._fresh)
        space, (rtol, atol) = self._space, self._tolerances
        sizes = np.concatenate(
            [np.maximum(space.sizes(self._q, u), space.sizes(q, u)), np.maximum(np.abs(self._w), np.abs(w))]
        )
        scale = self._slack * (atol + rtol * sizes)
        fifth, third = (float(np.sum((e @ self._rates / scale) ** 2)) for e in self._tableau.errors)
        total = fifth + 0.01 * third
        return q, w, 0.0 if total == 0 else step * fifth / math.sqrt(total * len(scale))

    def _step(self, t: float, q: Array, w: Array, h: float, *, fresh: bool = True) -> tuple[Array, Array, Array]:
        """Return q, w and u after h; the first stage is there already unless the start is fresh."""
        A, rates, space, nv = self._tableau.A, self._rates, self._space, self._space.nv
        if fresh:
            rates[0, :nv], rates[0, nv:] = w, self._field(t, q, w, self._force)
        for i in range(1, len(rates)):
            moved = (h * A[i, :i]) @ rates[:i]
            u, w_i = moved[:nv], w + moved[nv:]
            rates[i, :nv] = space.rate(u, w_i)
            rates[i, nv:] = self._field.consistent(t + self._c[i] * h, space.move(q, u), w_i, self._force)
        moved = (h * self._tableau.b) @ rates
        return space.move(q, moved[:nv]), w + moved[nv:], moved[:nv]

    def drop(self, place: int) -> None:  # noqa: ARG002  # there is one
        """Stay here."""
        self._dropped = True

    def stuck(self, place: int) -> bool | None:  # noqa: ARG002
        """Return whether the last try, too short to go on, was no number."""
        return None if self._h > self._least or self._t >= self._stop else math.isnan(self._error)

    def why(self, place: int) -> str:  # noqa: ARG002
        """Return what the engine said."""
        return self._why or RAN_AWAY

    def tighten(self, place: int, tolerances: Tolerances) -> None:  # noqa: ARG002
        """Go on with other tolerances."""
        self._tolerances = tolerances

    def rates(self, place: int, q: Array, w: Array) -> Array:  # noqa: ARG002
        """Return ẇ at states."""
        try:
            return np.array([self._field(self._t, *state, self._force) for state in zip(q, w, strict=True)])
        except DivergenceError:
            return np.full(w.shape, np.nan)

    def within(self, place: int, start: Stretch, times: Array) -> tuple[Array, Array]:  # noqa: ARG002
        """Return states within steps."""
        rows = zip(start.t.tolist(), start.q, start.w, times.tolist(), strict=True)
        made = []
        for t, q, w, end in rows:
            try:
                made.append(self._step(t, q, w, end - t)[:2])
            except DivergenceError:
                made.append((np.full(q.shape, np.nan), np.full(w.shape, np.nan)))
        self._fresh = True
        q, w = (np.array([pair[i] for pair in made]) for i in (0, 1))
        return q, w
