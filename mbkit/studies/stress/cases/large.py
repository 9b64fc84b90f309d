"""Numbers that are large, or very small, though the motion is an ordinary one."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Final

import mpmath as mp
import numpy as np

from mbkit import catalog
from mbkit.load import load
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import EPS, powers, register, terms_at
from mbkit.studies.stress.cases.exact_motions import cart_pole, pendulum
from mbkit.studies.stress.cases.spin import tumbling

CASES: Final[list[Case]] = []
_case = partial(register, CASES, "large")

_FAR: Final = ((1.0, 1e2, 1e4, 1e6, 1e7, 1e8, 1e9), (1.0, 1e4, 1e7, 1e9))
_PLACE: Final = np.array([1.0, -1.0, 0.5])
_SOURCE: Final = "pendulum by elliptic functions, Landau, Lifshitz 1976, §11"


@_case("angle", "rad", *_FAR)
def many_turns(angle: float) -> Problem:
    """A pendulum swings from 1 rad for 2 s after many whole turns."""
    with mp.workdps(40):
        turn = 2 * mp.pi
        turns = mp.nint(angle / turn)
        start = float(turns * turn + 1)
        # The rounded angle less its whole turns.
        apart = float(mp.mpf(start) - turns * turn)
    swing = pendulum(apart, 0.0, 9.81)
    return Problem(
        catalog.pendulum(),
        np.array([start]),
        np.zeros(1),
        duration=2.0,
        exact=lambda t: start + (swing(t) - apart),
        floor=EPS * start + 1e-14,
        source=_SOURCE,
        facts={"spacing of doubles there, rad": math.ulp(start)},
    )


@_case("place", "m", *_FAR)
def far_on_rail(place: float) -> Problem:
    """A cart-pole falls from 2 rad for 2 s, far out on its rail."""
    theta = 2.0
    motion = cart_pole(theta, 1.0)
    return Problem(
        catalog.cart_pole(),
        np.array([place, theta]),
        np.zeros(2),
        duration=2.0,
        exact=lambda t: motion(t) + np.array([place, 0.0]),
        floor=EPS * place + 1e-12,
        source="energy and momentum with a quadrature",
        scale=2 * theta,
        facts={"spacing of doubles there, m": math.ulp(place)},
    )


@_case("place", "m", *_FAR)
def far_base(place: float) -> Problem:
    """A box tumbles and drifts for 1 s, far from the origin."""
    problem = tumbling(place * _PLACE, np.array([1.0, 2.0, -1.0]), 1.0)
    return replace(problem, facts={"spacing of doubles there, m": math.ulp(place)})


@_case("place", "m", *_FAR, measure="terms")
def far_base_terms(place: float) -> Problem:
    """Terms of a quadruped on a floating base far from the origin."""
    problem = terms_at(load("anymal_b", floating_base=True))
    q = problem.q.copy()
    q[:, :3] += place * _PLACE
    return replace(problem, q=q, facts={"spacing of doubles there, m": math.ulp(place)})


def _swing(gravity: float, speed: float, duration: float) -> Problem:
    return Problem(
        catalog.pendulum(gravity=gravity),
        np.ones(1),
        np.array([speed]),
        duration=duration,
        exact=pendulum(1.0, speed, gravity),
        floor=16 * EPS * (1 + math.sqrt(gravity) * duration),
        source=_SOURCE,
        facts={"fastest frequency, rad/s": math.sqrt(gravity)},
    )


@_case("gravity", "m/s²", powers(0, 6), (1.0, 1e3, 1e6))
def strong_gravity(gravity: float) -> Problem:
    """A pendulum swings from 1 rad for 1 s under ever stronger gravity."""
    return _swing(gravity, 0.0, 1.0)


@_case("gravity", "m/s²", (*powers(0, -6), 0.0), (1.0, 1e-3, 0.0))
def weak_gravity(gravity: float) -> Problem:
    """A pendulum starts at 1 rad with 1 rad/s under ever weaker gravity, and none."""
    return _swing(gravity, 1.0, 2.0)


_HUGE: Final = (
    (1.0, 1e3, 1e6, 1e9, 1e12, 1e15, 1e20, 1e50, 1e100, 1e150, 1e200, 1e250, 1e300),
    (1.0, 1e15, 1e150, 1e300),
)
_TINY: Final = (
    (1.0, 1e-3, 1e-6, 1e-9, 1e-12, 1e-15, 1e-16, 1e-20, 1e-50, 1e-100, 1e-200, 1e-300, 1e-310),
    (1.0, 1e-12, 1e-16, 1e-310),
)


def _pendulum_of(inertia: float) -> Problem:
    """Return a pendulum of 1 m: its motion does not depend on its mass, but all forces do."""
    return Problem(
        catalog.pendulum(mass=inertia),
        np.ones(1),
        np.zeros(1),
        duration=1.0,
        exact=pendulum(1.0, 0.0, 9.81),
        floor=16 * EPS,
        source=_SOURCE,
    )


def _terms_of(inertia: float) -> Problem:
    """Return the terms of a double pendulum; forces of the size of its inertia."""
    return terms_at(catalog.double_pendulum(mass1=inertia, mass2=inertia), force=inertia)


@_case("inertia", "kg m²", *_HUGE)
def huge_inertia(inertia: float) -> Problem:
    """A pendulum of 1 m swings from 1 rad for 1 s, ever heavier."""
    return _pendulum_of(inertia)


@_case("inertia", "kg m²", *_TINY)
def tiny_inertia(inertia: float) -> Problem:
    """A pendulum of 1 m swings from 1 rad for 1 s, ever lighter, down to subnormal numbers."""
    return _pendulum_of(inertia)


@_case("inertia", "kg m²", *_HUGE, measure="terms")
def huge_inertia_terms(inertia: float) -> Problem:
    """Terms of a double pendulum of 1 m each, ever heavier."""
    return _terms_of(inertia)


@_case("inertia", "kg m²", *_TINY, measure="terms")
def tiny_inertia_terms(inertia: float) -> Problem:
    """Terms of a double pendulum of 1 m each, ever lighter, down to subnormal numbers."""
    return _terms_of(inertia)
