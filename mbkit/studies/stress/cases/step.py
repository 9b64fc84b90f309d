"""The largest stable step of each method, beside that of linear theory."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import EPS, largest_step
from mbkit.studies.stress.cases.exact_motions import released
from mbkit.studies.stress.cases.stiffness import conical, hinge

__all__ = ["CASES"]

#: Enough for what grows by a fifth a step to grow beyond any bar; few enough for what is evaluated slowly.
_STEPS: Final = 200
_METHODS: Final = (
    "rk4",
    "semi_implicit_euler",
    "implicit_midpoint",
    "gauss4",
    "gauss6",
    "mujoco_euler",
    "mujoco_rk4",
    "mujoco_implicit",
    "mujoco_implicitfast",
    "mujoco_discrete",
)
#: ζ of the overdamped spring, and ω: its damper alone has the rate 1/s.
_OVER, _SOFT = 5.0, 0.1
_STIFF: Final = 1e6


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


def _oscillator(step: float) -> Problem:
    return _hinge(step, 1.0, 0.0, 1.0)


def _critical(step: float) -> Problem:
    return _hinge(step, 1.0, 1.0, 1.0)


def _overdamped(step: float) -> Problem:
    return _hinge(step, _SOFT, _OVER, _SOFT * (_OVER + math.sqrt(_OVER**2 - 1)))


def _circling(step: float) -> Problem:
    """Return a mass that circles on an undamped point spring."""
    made, _ = conical(_STIFF, 0.0)
    return replace(made, duration=_STEPS * step, dt=step, facts={"fastest frequency, rad/s": math.sqrt(_STIFF)})


def _limit(engine: str, method: str, frequency: float, damping: float) -> float | None:  # noqa: ARG001  # the same on all
    return largest_step(method, frequency, damping)


def _case(
    name: str,
    about: str,
    make: Callable[[float], Problem],
    linear: tuple[float, float],
    values: tuple[float, ...],
    quick: tuple[float, ...],
) -> Case:
    return Case(
        name,
        f"{about}, {_STEPS} steps.",
        "step",
        "step",
        "s",
        values,
        quick,
        make,
        bar=100.0,
        why="growth is asked for, not accuracy: what is stable stays near its start, what is not grows in each step",
        methods=_METHODS,
        theory=partial(_limit, frequency=linear[0], damping=linear[1]),
    )


# Steps close to either side of what theory says of one of the methods, and coarse ones elsewhere.
_AROUND: Final = (0.1, 1.0, 1.4, 1.7, 1.9, 2.1, 2.4, 2.7, 3.0, 4.0, 10.0, 100.0, 1000.0)
_AROUND_CRITICAL: Final = (0.1, 0.4, 0.78, 0.88, 1.4, 2.0, 2.6, 3.0, 4.0, 4.6, 5.1, 10.0, 100.0, 1000.0)
_AROUND_OVER: Final = (0.1, 1.0, 1.4, 1.85, 2.1, 2.4, 2.65, 3.0, 10.0, 50.0, 190.0, 215.0, 1000.0)

CASES: Final = (
    _case(
        "step_oscillator",
        "A body on a spring of 1 rad/s",
        _oscillator,
        (1.0, 0.0),
        _AROUND,
        (1.0, 1.9, 2.1, 2.7, 3.0, 100.0),
    ),
    _case(
        "step_critically_damped",
        "A body on a critically damped spring of 1 rad/s",
        _critical,
        (1.0, 1.0),
        _AROUND_CRITICAL,
        (0.78, 0.88, 2.6, 3.0, 4.6, 5.1, 100.0),
    ),
    _case(
        "step_overdamped",
        "A body on a spring with a strong damper, whose rates are 0.99 and 0.01 /s",
        _overdamped,
        (_SOFT, _OVER),
        _AROUND_OVER,
        (1.85, 2.1, 2.65, 3.0, 190.0, 215.0),
    ),
    _case(
        "step_point_spring",
        "A mass that circles on a point spring of 1000 rad/s",
        _circling,
        (math.sqrt(_STIFF), 0.0),
        tuple(1e-3 * x for x in _AROUND[:-1]),
        tuple(1e-3 * x for x in (1.0, 1.9, 2.1, 2.7, 3.0, 10.0)),
    ),
)
