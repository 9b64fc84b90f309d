"""What one-step methods share, on any arithmetic: NumPy runs it, CasADi writes it into compiled steps.

A state is (q, w) on the space of `mbkit.model.integration_space`. Within a step the configuration is q moved by u, with
u̇ = space.rate(u, w) on rotations (Munthe-Kaas 1999, High order Runge-Kutta methods on manifolds).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Protocol

import numpy as np

from mbkit._check import Array
from mbkit.model.integration_space import Space
from mbkit.model.quaternions import FLOATS, Arithmetic

#: (t, q, u, w) -> (u̇, ẇ) at a stage; u is None where it is zero.
StageRates = Callable[[Any, Any, Any, Any], tuple[Any, Any]]


class Stages(Protocol):
    """Rates (u̇, ẇ) of the stages so far."""

    def __len__(self) -> int: ...

    def append(self, u_rate: Any, w_rate: Any) -> None:
        """Add a stage."""

    def moved(self, h: Any, weights: Array) -> tuple[Any, Any]:
        """Return h times the weighted sums of u̇ and ẇ."""

    def squares(self, weights: Array, scales: tuple[Any, Any]) -> Any:
        """Return the sum of the squares of the weighted sums, each divided by its scale."""


class ArrayStages:
    """Rates of the stages of one state or a batch side by side: a row of a tableau times them is one product."""

    def __init__(self, count: int, shape: tuple[int, ...]) -> None:
        self.shape, self._nv, self._count = shape, shape[-1], 0
        self._moved, self._single = (*shape[:-1], 2 * self._nv), len(shape) == 1
        self._rates = np.empty((count, *self._moved))
        # Views, which are not free: a step of a small model takes some ten microseconds.
        self._u, self._w = self._rates[..., : self._nv], self._rates[..., self._nv :]
        flat = self._rates.reshape(count, -1)
        self._known = [flat[:i] for i in range(count + 1)]

    def __len__(self) -> int:
        return self._count

    def append(self, u_rate: Array, w_rate: Array) -> None:
        """Add a stage."""
        self._u[self._count] = u_rate
        self._w[self._count] = w_rate
        self._count += 1

    def keep(self, count: int) -> None:
        """Forget all stages but the first ones."""
        self._count = count

    def moved(self, h: float, weights: Array) -> tuple[Array, Array]:
        """Return h times the weighted sums of u̇ and ẇ."""
        out, nv = (h * weights) @ self._known[self._count], self._nv
        if self._single:
            return out[:nv], out[nv:]
        out = out.reshape(self._moved)
        return out[..., :nv], out[..., nv:]

    def squares(self, weights: Array, scales: tuple[Array, Array]) -> Any:
        """Return the sum of the squares, for one state."""
        return np.sum((weights @ self._rates / np.concatenate(scales)) ** 2)


@dataclass(frozen=True)
class SemiImplicitEuler:
    """New velocity, then the position with it; symplectic, of order 1."""

    name: ClassVar[str] = "semi_implicit_euler"
    stages: ClassVar[int] = 1
    c: ClassVar[tuple[float, ...]] = (0.0,)
    explicit: ClassVar[bool] = True
    ends_at_a_stage: ClassVar[bool] = False

    def step(
        self, space: Space, rates: StageRates, _stages: Stages, t: Any, h: Any, q: Any, w: Any
    ) -> tuple[Any, Any, Any]:
        """Return the new q and w, and u; arguments are those of `mbkit.methods.tableaus.Tableau.step`."""
        _, a = rates(t, q, None, w)
        w = w + h * a
        u = h * w
        return space.retract(q, u), w, u


#: Newton's iterations for what a step solves.
MAX_NEWTON_ITERATIONS: Final = 25
#: A singular pose is near where J's rows would depend on each other within so many steps at the present pace. At a
#: third of the way a series of the tightest tolerance never arrives.
STEPS_TO_POSE: Final = 4


# Errors and lengths of adaptive steps

#: Largest growth of a step.
MAX_GROWTH: Final = 10.0
#: Smallest length of a step after a rejection, relative to the rejected one.
_MIN_SHRINK: Final = 0.2
_SAFETY: Final = 0.8
#: The 32nd root of the smallest error that is remembered, 1e-4.
FIRST_ROOT: Final = 1e-4 ** (1 / 32)
#: Largest defect of a Rosenbrock step, in tolerances. The method sees a force only through the Jacobian at the step's
#: start: what was stiff there and has gone by its end leaves no error behind. So the rate at the end is compared with
#: that of the step's polynomial; for smooth motions, however stiff, they differ by 20 times the tolerance at most, by a
#: tenth of it as a rule.
_MAX_DEFECT: Final = 100.0
#: Arithmetic of numpy.float64, whose quotients by zero are infinite.
SCALARS: Final = Arithmetic(np.sqrt, np.sin, np.cos, FLOATS.choose)

#: Growth after an accepted step, reduction after a rejected one, and the error's 32nd root to remember.
StepFactors = tuple[Any, Any, Any]


def larger(m: Arithmetic, a: Any, b: Any) -> Any:
    """Return the larger of two, a where one is NaN."""
    return m.choose(a < b, b, a)


def embedded_error(
    m: Arithmetic, errors: Sequence[Array], stages: Stages, scales: tuple[Any, Any], h: Any, n: int
) -> Any:
    """Return the error of a step of Dormand and Prince's pair 8(5, 3) in units of the tolerance, as DOP853 combines it.

    Hairer, Nørsett, Wanner 1993, Solving Ordinary Differential Equations I, II.10. `errors` are b minus the weights of
    order 5 and 3, `scales` the tolerated errors of u and w, and n counts the numbers of a state.
    """
    fifth, third = (stages.squares(weights, scales) for weights in errors)
    total = fifth + 0.01 * third
    # No error at all is 0 and not 0/0.
    safe = m.choose(total > 0, total, 1 + total)
    return h * fifth / m.sqrt(safe * max(n, 1))


def with_defect(m: Arithmetic, error: Any, defect: Any) -> Any:
    """Return the error of a Rosenbrock step, with the defect of its polynomial's slope at the end."""
    defect = defect / _MAX_DEFECT
    # NaN is chosen where it is one of the two.
    return larger(m, error, defect) + 0 * defect


def predictive_factors(m: Arithmetic, error: Any, last: Any) -> StepFactors:
    """Return the factors for an error of order 8; growth looks at the last error too.

    Gustafsson 1991; Hairer, Wanner 1996, IV.2. Error to the power of -3/32 times the last one's 1/32: a fifth to a
    third fewer steps are rejected than by DOP853's own rule, and 15 % fewer attempts reach an error of 1e-9 of the
    UR5, 30 % of the double pendulum.
    """
    eighth = m.sqrt(m.sqrt(m.sqrt(error)))
    sixteenth = m.sqrt(eighth)
    root = m.sqrt(sixteenth)
    over, under = _SAFETY * last, sixteenth * root
    return m.choose(MAX_GROWTH * under < over, MAX_GROWTH, over / under), _SAFETY / eighth, root


def elementary_factors(m: Arithmetic, error: Any, last: Any) -> StepFactors:  # noqa: ARG001  # as `predictive_factors`
    """Return the factors for an error of order 5: to the power of -3/16, near the fifth root."""
    eighth = m.sqrt(m.sqrt(m.sqrt(error)))
    sixteenth = m.sqrt(eighth)
    under = eighth * sixteenth
    growth = m.choose(MAX_GROWTH * under < _SAFETY, MAX_GROWTH, _SAFETY / under)
    return growth, _SAFETY / under, m.sqrt(sixteenth)


def end_of_attempt(m: Arithmetic, t: Any, h: Any, end: Any) -> Any:
    """Return the time at which the next attempt ends: two equal steps to the end rather than one and a tiny one."""
    gap = end - t
    within = t + m.choose(2 * h < gap, h, 0.5 * gap)
    return m.choose(h < gap, within, end)


def next_step(
    m: Arithmetic, factors: StepFactors, accepted: Any, step: Any, h: Any, growth: Any, last: Any
) -> tuple[Any, Any, Any]:
    """Return the length of the next attempt, its largest growth, and the error's root to remember.

    `h` is the length that was chosen for this attempt before the end of the run shortened it to `step`; `last` is the
    root of the last accepted error.
    """
    factor, reduction, root = factors
    grown = step * m.choose(factor < growth, factor, growth)
    # A step that was short only because the end was near says little.
    grown = m.choose((2 * step < h) * (grown < h), h, grown)
    # NaN shrinks as much as anything does.
    shrunk = step * m.choose(reduction > _MIN_SHRINK, reduction, _MIN_SHRINK)
    idle = 1 - (step > 0)
    h1 = m.choose(accepted, grown, m.choose(idle, h, shrunk))
    remembered = m.choose(accepted, larger(m, root, FIRST_ROOT), last)
    return h1, m.choose(accepted, MAX_GROWTH, m.choose(idle, growth, 1.0)), remembered


def first_length(
    space: Space,
    q: Array,
    w: Array,
    k: Array,
    tolerances: tuple[float, float],
    probe: Callable[[Array, Array], Array],
    grows: int = 8,
) -> Array:
    """Return the length of the first step from each state, (n,); k is ẇ there, and probe(q, w) is ẇ elsewhere.

    Hairer, Nørsett, Wanner 1993, II.4, as in SciPy. The error of a step grows with its length to the power `grows`.
    """
    rtol, atol = tolerances
    sizes = np.concatenate([space.magnitude(q, w), np.abs(w)], axis=-1)
    scale = atol + rtol * sizes

    def norm(x: Array) -> Array:
        return np.asarray(np.sqrt(np.sum((x / scale) ** 2, axis=-1) / max(x.shape[-1], 1)))

    d0, d1 = norm(sizes), norm(np.concatenate([w, k], axis=-1))
    h0 = np.where((d0 < 1e-5) | (d1 < 1e-5), 1e-6, 0.01 * d0 / d1)
    by = h0[:, None]
    bent = probe(space.retract(q, by * w), w + by * k)
    d2 = norm(np.concatenate([by * k, bent - k], axis=-1)) / h0
    steep = np.maximum(d1, d2)
    h1 = np.where(steep <= 1e-15, np.maximum(1e-6, h0 * 1e-3), (0.01 / steep) ** (1 / grows))
    return np.asarray(np.minimum(100 * h0, h1))
