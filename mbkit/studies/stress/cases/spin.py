"""Fast turns, and many of them."""

from __future__ import annotations

from functools import partial
from typing import Final

import numpy as np

from mbkit import catalog
from mbkit._check import Array
from mbkit.model import ModelBuilder
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import EPS, Exact, powers, register
from mbkit.studies.stress.cases.exact_motions import free_rotor, precession, turning

CASES: Final[list[Case]] = []
_case = partial(register, CASES, "spin")

#: Of Gazebo's "boxes" benchmark, complex case without gravity: nearly about the middle axis, rad/s.
_BOX_SPIN: Final = (0.1, 5.0, 0.1)


@_case("spin", "rad/s", powers(0, 6), (1.0, 1e2, 1e4, 1e6))
def heavy_top(spin: float) -> Problem:
    """A heavy top precesses steadily for 1 s, 30° below the horizontal, and spins."""
    # The top of Terze, Müller and Zlatar.
    mass, radius, g = 15.0, 1.0, 9.81
    across, along = 0.234375 + mass * radius**2, 0.46875
    motion, q, v, rate = precession(spin, 2 * np.pi / 3, mass * g * radius, across, along)
    duration = 1.0
    return Problem(
        catalog.heavy_top(),
        q,
        v,
        duration=duration,
        exact=motion,
        floor=8 * EPS * (1 + spin * duration),
        source="steady precession, Landau, Lifshitz 1976, §35",
        facts={"fastest rate, 1/s": spin, "precession, rad/s": rate},
    )


def box_spin() -> tuple[Exact, float]:
    """Return the quaternions (K, 4) of the tumbling box, and the period of its angular velocity, s."""
    inertia = catalog.free_body().bodies[0].inertia
    return free_rotor(np.diag(inertia), np.array(_BOX_SPIN))


def tumbling(place: Array, velocity: Array, duration: float) -> Problem:
    """Return the box tumbling about its centre, which starts at a place and moves steadily."""
    spin, period = box_spin()

    def motion(t: Array) -> Array:
        return np.concatenate([place + np.multiply.outer(t, velocity), spin(t)], axis=1)

    return Problem(
        catalog.free_body(),
        np.array([*place, 0.0, 0.0, 0.0, 1.0]),
        np.array([*velocity, *_BOX_SPIN]),
        duration=duration,
        exact=motion,
        # Each turn is known to some eps; the place to its own rounding.
        floor=16 * EPS * (1 + float(np.linalg.norm(_BOX_SPIN)) * duration) + EPS * float(np.abs(place).max()),
        source="free rotation by elliptic functions, Landau, Lifshitz 1976, §37",
        # No attitude is farther from another.
        scale=np.pi,
        facts={"flips": 2 * duration / period},
    )


def _ball(spin: float, duration: float, dt: float | None = None) -> Problem:
    """Return a ball that turns steadily about an oblique axis: no torque, no gyroscopic term."""
    b = ModelBuilder("ball", gravity=(0.0, 0.0, 0.0))
    b.add_body("ball", mass=1.0, inertia=(0.4, 0.4, 0.4))
    b.add_joint("turn", "ball", parent="world", child="ball")
    axis = np.array([1.0, 2.0, 2.0]) / 3
    return Problem(
        b.build(),
        np.array([0.0, 0.0, 0.0, 1.0]),
        spin * axis,
        duration=duration,
        exact=turning(axis, spin),
        floor=8 * EPS * (1 + spin * duration),
        source="steady turn about one axis",
        dt=dt,
        facts={"fastest rate, 1/s": spin, "turns": spin * duration / (2 * np.pi)},
    )


@_case("spin", "rad/s", powers(0, 6), (1.0, 1e2, 1e4, 1e6))
def spinning_ball(spin: float) -> Problem:
    """A ball without torque turns steadily about an oblique axis for 1 s."""
    return _ball(spin, 1.0)


@_case("flips", "", (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0), (1.0, 10.0, 100.0), patience=3.0)
def dzhanibekov_box(count: float) -> Problem:
    """A box without torque turns over again and again, past its unstable axis each time."""
    return tumbling(np.zeros(3), np.zeros(3), count * box_spin()[1] / 2)


_DRIFTING: Final = (
    *("rk4", "semi_implicit_euler", "implicit_midpoint", "gauss4", "gauss6"),
    *("mujoco_rk4", "mujoco_euler"),
)


@_case("steps", "", powers(2, 6), (1e2, 1e4, 1e5), methods=_DRIFTING, patience=3.0)
def quaternion_drift(steps: float) -> Problem:
    """A ball turns by 0.01 rad in each of many steps: does its quaternion stay one?"""
    # So small a step makes no error of its own: what is left is rounding.
    return _ball(10.0, 1e-3 * steps, dt=1e-3)
