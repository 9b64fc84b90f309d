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
from mbkit.model import Model
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import EPS, Facts, motion, powers, register, terms_at
from mbkit.studies.stress.cases.exact_motions import cart_pole, pendulum
from mbkit.studies.stress.cases.rotations import tumbling

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
    floor, facts = EPS * start + 1e-14, {"spacing of doubles there, rad": math.ulp(start)}
    return motion(catalog.pendulum(), [start], 0.0, 2.0, lambda t: start + (swing(t) - apart), floor, _SOURCE, facts)


@_case("place", "m", *_FAR)
def far_on_rail(place: float) -> Problem:
    """A cart-pole falls from 2 rad for 2 s, far out on its rail."""
    theta, start = 2.0, np.array([place, 0.0])
    falling = cart_pole(theta, 1.0)
    floor, facts = EPS * place + 1e-12, {"spacing of doubles there, m": math.ulp(place)}
    model, source = catalog.cart_pole(), "energy and momentum with a quadrature"
    q = np.array([place, theta])
    return motion(model, q, 0.0, 2.0, lambda t: falling(t) + start, floor, source, facts, scale=2 * theta)


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


def _swing(
    model: Model, gravity: float, speed: float, duration: float, floor: float, facts: Facts | None = None
) -> Problem:
    """Return a pendulum of 1 m that starts at 1 rad."""
    return motion(model, np.ones(1), speed, duration, pendulum(1.0, speed, gravity), floor, _SOURCE, facts)


def _under_gravity(gravity: float, speed: float, duration: float) -> Problem:
    floor, facts = 16 * EPS * (1 + math.sqrt(gravity) * duration), {"fastest frequency, rad/s": math.sqrt(gravity)}
    return _swing(catalog.pendulum(gravity=gravity), gravity, speed, duration, floor, facts)


@_case("gravity", "m/s²", powers(0, 6), (1.0, 1e3, 1e6))
def strong_gravity(gravity: float) -> Problem:
    """A pendulum swings from 1 rad for 1 s under ever stronger gravity."""
    return _under_gravity(gravity, 0.0, 1.0)


@_case("gravity", "m/s²", (*powers(0, -6), 0.0), (1.0, 1e-3, 0.0))
def weak_gravity(gravity: float) -> Problem:
    """A pendulum starts at 1 rad with 1 rad/s under ever weaker gravity, and none."""
    return _under_gravity(gravity, 1.0, 2.0)


_HUGE: Final = (
    (1.0, 1e3, 1e6, 1e9, 1e12, 1e15, 1e20, 1e50, 1e100, 1e150, 1e200, 1e250, 1e300),
    (1.0, 1e15, 1e150, 1e300),
)
_TINY: Final = (
    (1.0, 1e-3, 1e-6, 1e-9, 1e-12, 1e-15, 1e-16, 1e-20, 1e-50, 1e-100, 1e-200, 1e-300, 1e-310),
    (1.0, 1e-12, 1e-16, 1e-310),
)


# The motion of a pendulum of 1 m does not depend on its mass, but all forces do.


@_case("inertia", "kg m²", *_HUGE)
def huge_inertia(inertia: float) -> Problem:
    """A pendulum of 1 m swings from 1 rad for 1 s, ever heavier."""
    return _swing(catalog.pendulum(mass=inertia), 9.81, 0.0, 1.0, 16 * EPS)


@_case("inertia", "kg m²", *_TINY)
def tiny_inertia(inertia: float) -> Problem:
    """A pendulum of 1 m swings from 1 rad for 1 s, ever lighter, down to subnormal numbers."""
    return _swing(catalog.pendulum(mass=inertia), 9.81, 0.0, 1.0, 16 * EPS)


@_case("inertia", "kg m²", *_HUGE, measure="terms")
def huge_inertia_terms(inertia: float) -> Problem:
    """Terms of a double pendulum of 1 m each, ever heavier."""
    return terms_at(catalog.double_pendulum(mass1=inertia, mass2=inertia), force=inertia)


@_case("inertia", "kg m²", *_TINY, measure="terms")
def tiny_inertia_terms(inertia: float) -> Problem:
    """Terms of a double pendulum of 1 m each, ever lighter, down to subnormal numbers."""
    return terms_at(catalog.double_pendulum(mass1=inertia, mass2=inertia), force=inertia)
