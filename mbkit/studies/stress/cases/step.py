"""The largest stable step of each method, beside that of linear theory; and many steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from mbkit import catalog
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import EPS, Make, largest_step, powers, register
from mbkit.studies.stress.cases.exact_motions import released
from mbkit.studies.stress.cases.stiffness import conical, hinge

CASES: Final[list[Case]] = []

#: Enough for what grows by a fifth a step to grow beyond any bar; few enough for what is evaluated slowly.
_STEPS: Final = 200
_METHODS: Final = (
    *("rk4", "semi_implicit_euler", "implicit_midpoint", "gauss4", "gauss6"),
    *("mujoco_euler", "mujoco_rk4", "mujoco_implicit", "mujoco_implicitfast", "mujoco_discrete"),
)
#: ζ of the overdamped spring, and ω: its damper alone has the rate 1/s.
_OVER, _SOFT = 5.0, 0.1
_STIFF: Final = 1e6
# Steps close to either side of what theory says of one of the methods, and coarse ones elsewhere.
_AROUND: Final = (0.1, 1.0, 1.4, 1.7, 1.9, 2.1, 2.4, 2.7, 3.0, 4.0, 10.0, 100.0, 1000.0)
_AROUND_CRITICAL: Final = (0.1, 0.4, 0.78, 0.88, 1.4, 2.0, 2.6, 3.0, 4.0, 4.6, 5.1, 10.0, 100.0, 1000.0)
_AROUND_OVER: Final = (0.1, 1.0, 1.4, 1.85, 2.1, 2.4, 2.65, 3.0, 10.0, 50.0, 190.0, 215.0, 1000.0)


def _limit(_engine: str, method: str, *, frequency: float, damping: float) -> float | None:
    return largest_step(method, frequency, damping)


def _case(
    values: tuple[float, ...], quick: tuple[float, ...], *, frequency: float = 1.0, damping: float = 0.0
) -> Callable[[Make], Make]:
    """Return the decorator of a case whose linear theory is that of an oscillator with this ω and ζ."""
    return register(
        CASES,
        "step",
        "step",
        "s",
        values,
        quick,
        bar=100.0,
        why="growth is asked for, not accuracy: what is stable stays near its start, what is not grows in each step",
        methods=_METHODS,
        theory=partial(_limit, frequency=frequency, damping=damping),
    )


def _hinge(step: float, frequency: float, damping: float, rate: float) -> Problem:
    """Let a body on a hinge with a spring and a damper go from 1 rad, at rest."""
    name = "fastest rate, 1/s" if damping else "fastest frequency, rad/s"
    return Problem(
        hinge(frequency**2, 2 * damping * frequency),
        np.ones(1),
        np.zeros(1),
        duration=_STEPS * step,
        exact=released(1.0, frequency**2, damping * frequency),
        floor=16 * EPS * (1 + _STEPS * step),
        source="damped oscillator, Landau, Lifshitz 1976, §25",
        dt=step,
        facts={name: rate},
    )


@_case(_AROUND, (1.0, 1.9, 2.1, 2.7, 3.0, 100.0))
def step_oscillator(step: float) -> Problem:
    """A body on a spring of 1 rad/s, 200 steps."""
    return _hinge(step, 1.0, 0.0, 1.0)


@_case(_AROUND_CRITICAL, (0.78, 0.88, 2.6, 3.0, 4.6, 5.1, 100.0), damping=1.0)
def step_critically_damped(step: float) -> Problem:
    """A body on a critically damped spring of 1 rad/s, 200 steps."""
    return _hinge(step, 1.0, 1.0, 1.0)


@_case(_AROUND_OVER, (1.85, 2.1, 2.65, 3.0, 190.0, 215.0), frequency=_SOFT, damping=_OVER)
def step_overdamped(step: float) -> Problem:
    """A body on a spring with a strong damper, whose rates are 0.99 and 0.01 /s, 200 steps."""
    return _hinge(step, _SOFT, _OVER, _SOFT * (_OVER + math.sqrt(_OVER**2 - 1)))


@_case(
    tuple(1e-3 * x for x in _AROUND[:-1]),
    tuple(1e-3 * x for x in (1.0, 1.9, 2.1, 2.7, 3.0, 10.0)),
    frequency=math.sqrt(_STIFF),
)
def step_point_spring(step: float) -> Problem:
    """A mass that circles on a point spring of 1000 rad/s, 200 steps."""
    problem, _ = conical(_STIFF, 0.0)
    return replace(problem, duration=_STEPS * step, dt=step, facts={"fastest frequency, rad/s": math.sqrt(_STIFF)})


# Many steps, and whether the energy stays

LONG_CASES: Final[list[Case]] = []
#: RK4 drifts over the bar between a million steps and ten, the midpoint rule never does.
_STEP: Final = 4e-3


@register(
    LONG_CASES,
    "long",
    "steps",
    "",
    powers(3, 7),
    (1e3, 1e4, 1e5),
    measure="energy",
    bar=1e-3,
    why=(
        "along a chaotic motion only what is conserved can be compared; a thousandth of the energy is half a "
        "thousandth of the speed, which no plot shows"
    ),
    methods=(
        *("rk4", "semi_implicit_euler", "implicit_midpoint", "gauss4", "gauss6", "mujoco_euler", "mujoco_rk4"),
        *("mujoco_implicit", "mujoco_implicitfast", "mujoco_discrete", "rk853", "taylor", "auto"),
    ),
    patience=6.0,
)
def long_run(count: float) -> Problem:
    """A double pendulum, chaotic from (2, 1) rad at rest, for ever more steps of 4 ms."""
    return Problem(
        catalog.double_pendulum(),
        np.array([2.0, 1.0]),
        np.zeros(2),
        duration=count * _STEP,
        dt=_STEP,
        facts={"duration, s": count * _STEP},
    )
