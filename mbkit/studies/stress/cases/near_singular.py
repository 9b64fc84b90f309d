"""Poses at which something divides by nearly nothing."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from mbkit import lagrangian
from mbkit._check import Array
from mbkit.load import load
from mbkit.model import Model, ModelBuilder
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import EPS, powers, terms_at
from mbkit.studies.stress.cases.exact_motions import past_gimbal_lock

__all__ = ["CASES"]

_SWING: Final = (0.0, -1.0, 0.0)


def _suspended(inertia: tuple[float, float, float]) -> Model:
    b = ModelBuilder("suspended", gravity=(0.0, 0.0, 0.0))
    b.add_body("body", mass=1.0, inertia=inertia)
    b.add_joint("turn", "spherical_zyx", parent="world", child="body")
    return b.build()


def _gimbal_lock(distance: float) -> Problem:
    made = terms_at(_suspended((0.1, 0.2, 0.25)))
    q = made.q.copy()
    q[:, 1] = np.where(np.arange(len(q)) % 2, -1, 1) * (math.pi / 2 - distance)
    return replace(made, q=q)


def _gimbal_pass(distance: float) -> Problem:
    """Return a ball in a suspension that turns by 2.5 rad about one axis."""
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


def _wrist(distance: float) -> Problem:
    """Return UR5 at random poses whose last but one joint is nearly straight, so that the axes beside it align."""
    made = terms_at(load("ur5"))
    q = made.q.copy()
    q[:, 4] = distance
    return replace(made, q=q)


def _dead_centre(distance: float) -> Problem:
    """Return a piston that moves without force towards the dead centre, until the crank is so far from it.

    x = r cos θ + l cos φ and sin φ = (r/l) sin θ give 4 r x sin²(θ/2) = δ (2 l - δ), where δ = r + l - x is left of
    the way.
    """
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


def _massless_link(mass: float) -> Problem:
    """Return three rods of 1 m, the outer ones of 1 kg."""
    b = ModelBuilder("light_middle")
    for i, m in enumerate((1.0, mass, 1.0)):
        parent = f"rod{i}" if i else "world"
        b.add_body(f"rod{i + 1}", mass=m, com=(0.0, 0.0, -0.5), inertia=(m / 12, m / 12, 0.0))
        place = (0.0, 0.0, -1.0 if i else 0.0)
        b.add_joint(f"theta{i + 1}", "continuous", parent=parent, child=f"rod{i + 1}", axis=_SWING, translation=place)
    return terms_at(b.build())


CASES: Final = (
    Case(
        "gimbal_lock",
        "Terms of a body on a spherical-ZYX joint whose pitch is nearly a right angle.",
        "near-singular",
        "distance from π/2",
        "rad",
        powers(0, -12),
        (1.0, 1e-3, 1e-6, 1e-12),
        _gimbal_lock,
        "terms",
    ),
    Case(
        "gimbal_pass",
        "A ball on a spherical-ZYX joint turns steadily past gimbal lock, where two angles jump by π.",
        "near-singular",
        "nearest distance from π/2",
        "rad",
        powers(0, -12, 2),
        (1.0, 1e-4, 1e-8, 1e-12),
        _gimbal_pass,
    ),
    Case(
        "wrist",
        "Terms of UR5 with its wrist nearly straight, where axes align: joint space does not care.",
        "near-singular",
        "distance",
        "rad",
        powers(0, -12, 2),
        (1.0, 1e-6, 1e-12),
        _wrist,
        "terms",
    ),
    Case(
        "dead_centre",
        "A piston pushes a massless crank to its dead centre: how near can a run come?",
        "near-singular",
        "distance at the end",
        "rad",
        (0.5, *powers(-1, -7)),
        (0.5, 1e-2, 1e-4, 1e-6),
        _dead_centre,
    ),
    Case(
        "massless_link",
        "Terms of a chain of three rods whose middle one weighs less and less.",
        "near-singular",
        "mass of the middle rod",
        "kg",
        powers(0, -18, 2),
        (1.0, 1e-6, 1e-12, 1e-18),
        _massless_link,
        "terms",
    ),
)
