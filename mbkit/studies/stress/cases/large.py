"""Numbers that are large, or very small, though the motion is an ordinary one."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import mpmath as mp
import numpy as np

from mbkit import catalog
from mbkit.load import load
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import EPS, powers, terms_at
from mbkit.studies.stress.cases.exact_motions import cart_pole, pendulum
from mbkit.studies.stress.cases.spin import tumbling

__all__ = ["CASES"]

_FAR: Final = (1.0, 1e2, 1e4, 1e6, 1e7, 1e8, 1e9)
_QUICK_FAR: Final = (1.0, 1e4, 1e7, 1e9)
_SOURCE: Final = "pendulum by elliptic functions, Landau, Lifshitz 1976, §11"


def _many_turns(angle: float) -> Problem:
    """Return a pendulum let go 1 rad from below, after so many whole turns."""
    with mp.workdps(40):
        turn = 2 * mp.pi
        turns = mp.nint(angle / turn)
        start = float(turns * turn + 1)
        # What the rounded angle is, less its whole turns.
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


def _far_on_rail(place: float) -> Problem:
    """Return a cart-pole let go 2 rad from below."""
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


def _far_base(place: float) -> Problem:
    made = tumbling(place * np.array([1.0, -1.0, 0.5]), np.array([1.0, 2.0, -1.0]), 1.0)
    return replace(made, facts={"spacing of doubles there, m": math.ulp(place)})


def _far_base_terms(place: float) -> Problem:
    made = terms_at(load("anymal_b", floating_base=True))
    q = made.q.copy()
    q[:, :3] += place * np.array([1.0, -1.0, 0.5])
    return replace(made, q=q, facts={"spacing of doubles there, m": math.ulp(place)})


def _gravity(gravity: float, speed: float, duration: float) -> Problem:
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


def _strong_gravity(gravity: float) -> Problem:
    return _gravity(gravity, 0.0, 1.0)


def _weak_gravity(gravity: float) -> Problem:
    return _gravity(gravity, 1.0, 2.0)


def _inertia(inertia: float) -> Problem:
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


def _inertia_terms(inertia: float) -> Problem:
    """Return the terms of a double pendulum; forces of the size of its inertia."""
    return terms_at(catalog.double_pendulum(mass1=inertia, mass2=inertia), force=inertia)


_HUGE: Final = (1.0, 1e3, 1e6, 1e9, 1e12, 1e15, 1e20, 1e50, 1e100, 1e150, 1e200, 1e250, 1e300)
_TINY: Final = (1.0, 1e-3, 1e-6, 1e-9, 1e-12, 1e-15, 1e-16, 1e-20, 1e-50, 1e-100, 1e-200, 1e-300, 1e-310)
_QUICK_HUGE: Final = (1.0, 1e15, 1e150, 1e300)
_QUICK_TINY: Final = (1.0, 1e-12, 1e-16, 1e-310)

CASES: Final = (
    Case(
        "many_turns",
        "A pendulum swings from 1 rad for 2 s after many whole turns.",
        "large",
        "angle",
        "rad",
        _FAR,
        _QUICK_FAR,
        _many_turns,
    ),
    Case(
        "far_on_rail",
        "A cart-pole falls from 2 rad for 2 s, far out on its rail.",
        "large",
        "place",
        "m",
        _FAR,
        _QUICK_FAR,
        _far_on_rail,
    ),
    Case(
        "far_base",
        "A box tumbles and drifts for 1 s, far from the origin.",
        "large",
        "place",
        "m",
        _FAR,
        _QUICK_FAR,
        _far_base,
    ),
    Case(
        "far_base_terms",
        "Terms of a quadruped on a floating base far from the origin.",
        "large",
        "place",
        "m",
        _FAR,
        _QUICK_FAR,
        _far_base_terms,
        "terms",
    ),
    Case(
        "strong_gravity",
        "A pendulum swings from 1 rad for 1 s under ever stronger gravity.",
        "large",
        "gravity",
        "m/s²",
        powers(0, 6),
        (1.0, 1e3, 1e6),
        _strong_gravity,
    ),
    Case(
        "weak_gravity",
        "A pendulum starts at 1 rad with 1 rad/s under ever weaker gravity, and none.",
        "large",
        "gravity",
        "m/s²",
        (*powers(0, -6), 0.0),
        (1.0, 1e-3, 0.0),
        _weak_gravity,
    ),
    Case(
        "huge_inertia",
        "A pendulum of 1 m swings from 1 rad for 1 s, ever heavier.",
        "large",
        "inertia",
        "kg m²",
        _HUGE,
        _QUICK_HUGE,
        _inertia,
    ),
    Case(
        "tiny_inertia",
        "A pendulum of 1 m swings from 1 rad for 1 s, ever lighter, down to subnormal numbers.",
        "large",
        "inertia",
        "kg m²",
        _TINY,
        _QUICK_TINY,
        _inertia,
    ),
    Case(
        "huge_inertia_terms",
        "Terms of a double pendulum of 1 m each, ever heavier.",
        "large",
        "inertia",
        "kg m²",
        _HUGE,
        _QUICK_HUGE,
        _inertia_terms,
        "terms",
    ),
    Case(
        "tiny_inertia_terms",
        "Terms of a double pendulum of 1 m each, ever lighter, down to subnormal numbers.",
        "large",
        "inertia",
        "kg m²",
        _TINY,
        _QUICK_TINY,
        _inertia_terms,
        "terms",
    ),
)
