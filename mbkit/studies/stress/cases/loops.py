"""Cases with loops and drives: poses that are nearly singular, redundant rows, stiff drives, and many turns."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit import catalog
from mbkit._check import Array
from mbkit.engines.consistent.random_states import states_of
from mbkit.model import Model, ModelBuilder
from mbkit.model.parts import Prescribed
from mbkit.studies.stress.case import Problem
from mbkit.studies.stress.cases._common import EPS, Series, motion, powers

#: Of the four-bar that is cut down to a change point: crank, coupler, rocker, m.
_CRANK, _COUPLER, _ROCKER = 0.3, 0.9, 0.7
_near = Series(
    *("near-singular", "distance", "m", powers(-1, -7), (1e-1, 1e-3, 1e-5)),
    measure="energy",
    bar=1e-6,
    why="what a run loses where rows nearly depend on each other shows in its energy",
)


def pose(theta: Array, ground: float) -> Array:
    """Return the configurations (K, 3) of the catalog's four-bar at crank angles (K,), by its two triangles."""

    def angles(theta: Array) -> Array:
        x, y = _CRANK * np.cos(theta) - ground, _CRANK * np.sin(theta)
        far = np.hypot(x, y)
        inside = np.arccos((far**2 + _ROCKER**2 - _COUPLER**2) / (2 * _ROCKER * far))
        # The crank's end is left of the rocker's pivot, where the angle has no jump.
        rocker = np.pi + np.arctan2(-y, -x) - inside
        coupler = np.arctan2(_ROCKER * np.sin(rocker) - y, _ROCKER * np.cos(rocker) - x)
        return np.stack([theta, coupler - theta, rocker], axis=-1)

    return np.asarray(angles(theta) - angles(np.zeros(1)) * [0.0, 1.0, 1.0])


def _moving(model: Model, q: ArrayLike, v: ArrayLike, duration: float, **facts: float) -> Problem:
    """Return the problem of a motion that begins near a state, and is judged by its energy."""
    start = states_of(model).manifold.project(np.array(q, dtype=np.float64), np.array(v, dtype=np.float64))
    return Problem(model, *start, duration=duration, facts=facts)


@_near
def change_point(distance: float) -> Problem:
    """A four-bar swings past the pose in which its rods would lie in line if the ground were shorter by so much."""
    ground = _COUPLER + _CRANK - _ROCKER + distance
    # Of a shorter ground the rods fold flat at zero, and two motions meet there.
    model = catalog.four_bar(crank=_CRANK, coupler=_COUPLER, rocker=_ROCKER, ground=ground, gravity=0.0)
    return _moving(model, pose(np.array([1.5]), ground)[0], [-3.0, 3.0, 0.0], 1.0)


@_near
def dead_centre(distance: float) -> Problem:
    """A slider-crank turns past the pose in which its piston stands nearly on the crank's axis."""
    # Of equal lengths crank and rod fold onto each other there, and the piston could stand still from then on.
    model = catalog.slider_crank(crank=1.0, rod=1.0 + distance)
    return _moving(model, [0.0, 0.0, 0.0], [2.0, -4.0, 0.0], 2.0)


@Series(
    *("mass ratio", "one bar over the others", "", powers(0, 9), (1.0, 1e3, 1e6)),
    measure="energy",
    bar=1e-6,
    why="a row that follows from the others may cost the digits of all of them",
)
def heavy_bricard(ratio: float) -> Problem:
    """Bricard's mechanism, of six rows five, falls for 1 s with one bar heavier than the others."""
    model = catalog.bricard()
    first, *others = model.bodies
    heavy = replace(first, mass=ratio * first.mass, inertia=ratio * first.inertia)
    model = replace(model, bodies=(heavy, *others))
    q = model.neutral()
    return _moving(model, q, np.zeros(model.nv), 1.0)


#: Of a drive: amplitude, m, and frequency, rad/s.
_AMPLITUDE, _FREQUENCY = 0.1, 3.0


@Series("stiffness", "stiffness", "N/m", powers(2, 12), (1e2, 1e6, 1e10))
def stiff_drive(stiffness: float) -> Problem:
    """A mass of 1 kg on a spring follows a carriage whose motion is prescribed, for 2 s."""
    b, along = ModelBuilder("driven_mass", gravity=(0.0, 0.0, 0.0)), (1.0, 0.0, 0.0)
    b.add_body("carriage", mass=1.0)
    b.add_body("mass", mass=1.0)
    b.add_joint("drive", "prismatic", parent="world", child="carriage", axis=along)
    b.add_joint("spring", "prismatic", parent="carriage", child="mass", axis=along, stiffness=stiffness)
    b.prescribe("drive", amplitude=_AMPLITUDE, frequency=_FREQUENCY)
    # m (ẍ + ÿ) = -k y with x = a sin ω t: y = a ω²/(k/m - ω²) sin ω t is the motion without vibration.
    bent = _AMPLITUDE * _FREQUENCY**2 / (stiffness - _FREQUENCY**2)
    size = np.array([_AMPLITUDE, bent])

    def exact(t: Array) -> Array:
        return np.asarray(np.multiply.outer(np.sin(_FREQUENCY * t), size))

    facts = {"fastest frequency, rad/s": math.sqrt(stiffness)}
    source = "steady motion of a linear system"
    return motion(b.build(), [0.0, 0.0], _FREQUENCY * size, 2.0, exact, 16 * EPS * _AMPLITUDE, source, facts, scale=0.1)


#: Of a crank that turns steadily, rad/s, and its ground, m; the four-bar of `validation.four_bar` has the same.
_RATE, _GROUND = 5.0, 1.0
_STEP: Final = 4e-3


@Series(
    *("long", "steps", "", powers(3, 6), (1e3, 1e4, 1e5)),
    methods=("rk4", "semi_implicit_euler", "gauss4"),
    patience=6.0,
)
def driven_loop(steps: float) -> Problem:
    """A four-bar whose crank is driven steadily: its loop and its drive open by what steps leave of them."""
    model = catalog.four_bar(crank=_CRANK, coupler=_COUPLER, rocker=_ROCKER, ground=_GROUND)
    model = replace(model, prescribed=(Prescribed("theta", rate=_RATE),))

    def exact(t: Array) -> Array:
        return pose(_RATE * t, _GROUND)

    first = exact(np.array([1e-4, -1e-4]))
    guess = (first[0] - first[1]) / 2e-4
    _, v = states_of(model).manifold.project(np.zeros(3), guess)
    floor = 16 * EPS * (1 + _RATE * steps * _STEP)
    source = "two triangles"
    return motion(model, np.zeros(3), v, steps * _STEP, exact, floor, source, dt=_STEP)
