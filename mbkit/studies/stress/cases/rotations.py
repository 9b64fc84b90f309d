"""Fast turns, and many of them; and poses at which something divides by nearly nothing."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from mbkit import catalog, lagrangian
from mbkit._check import Array
from mbkit.load import load
from mbkit.model import Model, ModelBuilder
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import EPS, Exact, motion, powers, register, terms_at
from mbkit.studies.stress.cases.chains import rods
from mbkit.studies.stress.cases.exact_motions import free_rotor, past_gimbal_lock, precession, turning

SPIN_CASES: Final[list[Case]] = []
_spin = partial(register, SPIN_CASES, "spin")
_SPINS: Final = (powers(0, 6), (1.0, 1e2, 1e4, 1e6))
#: Of Gazebo's "boxes" benchmark, complex case without gravity: nearly about the middle axis, rad/s.
_BOX_SPIN: Final = (0.1, 5.0, 0.1)


@_spin("spin", "rad/s", *_SPINS)
def heavy_top(spin: float) -> Problem:
    """A heavy top precesses steadily for 1 s, 30° below the horizontal, and spins."""
    # The top of Terze, Müller and Zlatar.
    mass, radius, g = 15.0, 1.0, 9.81
    across, along = 0.234375 + mass * radius**2, 0.46875
    exact, q, v, rate = precession(spin, 2 * np.pi / 3, mass * g * radius, across, along)
    facts = {"fastest rate, 1/s": spin, "precession, rad/s": rate}
    source = "steady precession, Landau, Lifshitz 1976, §35"
    return motion(catalog.heavy_top(), q, v, 1.0, exact, 8 * EPS * (1 + spin), source, facts)


def box_spin() -> tuple[Exact, float]:
    """Return the quaternions (K, 4) of the tumbling box, and the period of its angular velocity, s."""
    return free_rotor(np.diag(catalog.free_body().bodies[0].inertia), np.array(_BOX_SPIN))


def tumbling(place: Array, velocity: Array, duration: float) -> Problem:
    """Return the box tumbling about its centre, which starts at a place and moves steadily."""
    spin, period = box_spin()

    def exact(t: Array) -> Array:
        return np.concatenate([place + np.multiply.outer(t, velocity), spin(t)], axis=1)

    q, v = np.array([*place, 0.0, 0.0, 0.0, 1.0]), np.array([*velocity, *_BOX_SPIN])
    # Each turn is known to some eps; the place to its own rounding.
    floor = 16 * EPS * (1 + float(np.linalg.norm(_BOX_SPIN)) * duration) + EPS * float(np.abs(place).max())
    source, facts = "free rotation by elliptic functions, Landau, Lifshitz 1976, §37", {"flips": 2 * duration / period}
    # No attitude is farther than π from another.
    return motion(catalog.free_body(), q, v, duration, exact, floor, source, facts, scale=np.pi)


def _ball(spin: float, duration: float, **more: Any) -> Problem:
    """Return a ball that turns steadily about an oblique axis: no torque, no gyroscopic term."""
    b = ModelBuilder("ball", gravity=(0.0, 0.0, 0.0))
    b.add_body("ball", mass=1.0, inertia=(0.4, 0.4, 0.4))
    b.add_joint("turn", "ball", parent="world", child="ball")
    q, axis = np.array([0.0, 0.0, 0.0, 1.0]), np.array([1.0, 2.0, 2.0]) / 3
    exact, floor = turning(axis, spin), 8 * EPS * (1 + spin * duration)
    facts = {"fastest rate, 1/s": spin, "turns": spin * duration / (2 * np.pi)}
    return motion(b.build(), q, spin * axis, duration, exact, floor, "steady turn about one axis", facts, **more)


@_spin("spin", "rad/s", *_SPINS)
def spinning_ball(spin: float) -> Problem:
    """A ball without torque turns steadily about an oblique axis for 1 s."""
    return _ball(spin, 1.0)


@_spin("flips", "", (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0), (1.0, 10.0, 100.0), patience=3.0)
def dzhanibekov_box(count: float) -> Problem:
    """A box without torque turns over again and again, past its unstable axis each time."""
    return tumbling(np.zeros(3), np.zeros(3), count * box_spin()[1] / 2)


_RUNGE_KUTTA: Final = ("rk4", "semi_implicit_euler", "implicit_midpoint", "gauss4", "gauss6")


@_spin(
    *("steps", "", powers(2, 6), (1e2, 1e4, 1e5)), methods=(*_RUNGE_KUTTA, "mujoco_rk4", "mujoco_euler"), patience=3.0
)
def quaternion_drift(steps: float) -> Problem:
    """A ball turns by 0.01 rad in each of many steps: does its quaternion stay one?"""
    # So small a step makes no error of its own: what is left is rounding.
    return _ball(10.0, 1e-3 * steps, dt=1e-3)


# Poses at which something divides by nearly nothing

SINGULAR_CASES: Final[list[Case]] = []
_near = partial(register, SINGULAR_CASES, "near-singular")


def _suspended(inertia: tuple[float, float, float]) -> Model:
    b = ModelBuilder("suspended", gravity=(0.0, 0.0, 0.0))
    b.add_body("body", mass=1.0, inertia=inertia)
    b.add_joint("turn", "spherical_zyx", parent="world", child="body")
    return b.build()


@_near("distance from π/2", "rad", powers(0, -12), (1.0, 1e-3, 1e-6, 1e-12), measure="terms")
def gimbal_lock(distance: float) -> Problem:
    """Terms of a body on a spherical-ZYX joint whose pitch is nearly a right angle."""
    problem = terms_at(_suspended((0.1, 0.2, 0.25)))
    q = problem.q.copy()
    q[:, 1] = np.where(np.arange(len(q)) % 2, -1, 1) * (math.pi / 2 - distance)
    return replace(problem, q=q)


@_near("nearest distance from π/2", "rad", powers(0, -12, 2), (1.0, 1e-4, 1e-8, 1e-12))
def gimbal_pass(distance: float) -> Problem:
    """A ball on a spherical-ZYX joint turns steadily past gimbal lock, where two angles jump by π."""
    model, speed = _suspended((0.1, 0.1, 0.1)), 2.5
    exact, v = past_gimbal_lock(distance, speed)
    facts = {"fastest rate, 1/s": speed / math.sin(distance)}
    return motion(model, np.zeros(3), v, 1.0, exact, 64 * EPS, "steady turn about one axis, in angles", facts)


@_near("distance", "rad", powers(0, -12, 2), (1.0, 1e-6, 1e-12), measure="terms")
def wrist(distance: float) -> Problem:
    """Terms of UR5 with its wrist nearly straight, where axes align: joint space does not care."""
    problem = terms_at(load("ur5"))
    q = problem.q.copy()
    q[:, 4] = distance
    return replace(problem, q=q)


@_near("distance at the end", "rad", (0.5, *powers(-1, -7)), (0.5, 1e-2, 1e-4, 1e-6))
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

    def exact(t: Array) -> Array:
        rest = start + (end - start) * (t / duration)
        square = rest * (2 * l - rest) / (4 * r * (r + l - rest))
        return 2 * np.arcsin(np.sqrt(square))[:, None]

    model = lagrangian.systems.slider_crank(mass=1.0, crank=r, rod=l).model
    # The way left is known to eps of the way, and the angle goes with its root.
    floor, facts = 8 * EPS * (1 + 1 / distance), {"inertia at the end, kg m²": (r * lever(distance)) ** 2}
    source, v = "a piston without force moves steadily", -speed / (r * lever(first))
    return motion(model, np.array([first]), v, duration, exact, floor, source, facts)


@_near("mass of the middle rod", "kg", powers(0, -18, 2), (1.0, 1e-6, 1e-12, 1e-18), measure="terms")
def massless_link(mass: float) -> Problem:
    """Terms of a chain of three rods whose middle one weighs less and less."""
    return terms_at(rods("light_middle", (1.0, mass, 1.0)))
