"""Poses at which something divides by nearly nothing."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from mbkit import lagrangian
from mbkit._check import Array
from mbkit.load import load
from mbkit.model import Model, ModelBuilder
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import EPS, powers, register, rods, terms_at
from mbkit.studies.stress.cases.exact_motions import past_gimbal_lock

CASES: Final[list[Case]] = []
_case = partial(register, CASES, "near-singular")


def _suspended(inertia: tuple[float, float, float]) -> Model:
    b = ModelBuilder("suspended", gravity=(0.0, 0.0, 0.0))
    b.add_body("body", mass=1.0, inertia=inertia)
    b.add_joint("turn", "spherical_zyx", parent="world", child="body")
    return b.build()


@_case("distance from π/2", "rad", powers(0, -12), (1.0, 1e-3, 1e-6, 1e-12), measure="terms")
def gimbal_lock(distance: float) -> Problem:
    """Terms of a body on a spherical-ZYX joint whose pitch is nearly a right angle."""
    problem = terms_at(_suspended((0.1, 0.2, 0.25)))
    q = problem.q.copy()
    q[:, 1] = np.where(np.arange(len(q)) % 2, -1, 1) * (math.pi / 2 - distance)
    return replace(problem, q=q)


@_case("nearest distance from π/2", "rad", powers(0, -12, 2), (1.0, 1e-4, 1e-8, 1e-12))
def gimbal_pass(distance: float) -> Problem:
    """A ball on a spherical-ZYX joint turns steadily past gimbal lock, where two angles jump by π."""
    speed, duration = 2.5, 1.0
    motion, v = past_gimbal_lock(distance, speed)
    return Problem(
        _suspended((0.1, 0.1, 0.1)),
        np.zeros(3),
        v,
        duration=duration,
        exact=motion,
        floor=64 * EPS,
        source="steady turn about one axis, in angles",
        facts={"fastest rate, 1/s": speed / math.sin(distance)},
    )


@_case("distance", "rad", powers(0, -12, 2), (1.0, 1e-6, 1e-12), measure="terms")
def wrist(distance: float) -> Problem:
    """Terms of UR5 with its wrist nearly straight, where axes align: joint space does not care."""
    problem = terms_at(load("ur5"))
    q = problem.q.copy()
    q[:, 4] = distance
    return replace(problem, q=q)


@_case("distance at the end", "rad", (0.5, *powers(-1, -7)), (0.5, 1e-2, 1e-4, 1e-6))
def dead_centre(distance: float) -> Problem:
    """A piston pushes a massless crank to its dead centre: how near can a run come?"""
    # It moves without force. x = r cos θ + l cos φ and sin φ = (r/l) sin θ give 4 r x sin²(θ/2) = δ (2 l - δ), where
    # δ = r + l - x is left of the way.
    r, l, first, duration = 0.1, 0.3, 1.2, 1.0

    def lever(theta: float) -> float:
        """Return -dx/dθ over r."""
        return math.sin(theta) * (1 + r * math.cos(theta) / math.sqrt(l * l - (r * math.sin(theta)) ** 2))

    def left(theta: float) -> float:
        """Return δ, of terms that do not cancel."""
        sine = r / l * math.sin(theta)
        return 2 * r * math.sin(theta / 2) ** 2 + l * sine * sine / (1 + math.sqrt(1 - sine * sine))

    start, end = left(first), left(distance)
    speed = (start - end) / duration

    def motion(t: Array) -> Array:
        rest = start + (end - start) * (t / duration)
        square = rest * (2 * l - rest) / (4 * r * (r + l - rest))
        return 2 * np.arcsin(np.sqrt(square))[:, None]

    return Problem(
        lagrangian.systems.slider_crank(mass=1.0, crank=r, rod=l).model,
        np.array([first]),
        np.array([-speed / (r * lever(first))]),
        duration=duration,
        exact=motion,
        # The way left is known to eps of the way, and the angle goes with its root.
        floor=8 * EPS * (1 + 1 / distance),
        source="a piston without force moves steadily",
        facts={"inertia at the end, kg m²": (r * lever(distance)) ** 2},
    )


@_case("mass of the middle rod", "kg", powers(0, -18, 2), (1.0, 1e-6, 1e-12, 1e-18), measure="terms")
def massless_link(mass: float) -> Problem:
    """Terms of a chain of three rods whose middle one weighs less and less."""
    return terms_at(rods("light_middle", (1.0, mass, 1.0)))
