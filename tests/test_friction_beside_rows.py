"""Runs with dry friction beside loops, couplers, rolling contacts and prescribed motions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

import mbkit as mb
from mbkit.model import Model

ADAPTIVE = {"rtol": 1e-11, "atol": 1e-12}


def simulated(dyn: Any, *given: Any, **more: Any) -> mb.Trajectory:
    run = mb.simulate(dyn, *given, **more)
    assert run.stats.ended == "finished", run.stats.message
    return run


def names(run: mb.Trajectory) -> list[str]:
    return [e.name for e in run.events]


def rod(b: mb.ModelBuilder, name: str, parent: str, x: float, length: float, **friction: float | None) -> None:
    """Add a rod of 2 kg/m on a pin."""
    given = {key: value for key, value in friction.items() if value is not None}
    b.add_body(name, mass=2 * length, com=(length / 2, 0, 0), inertia=2 * length**3 / 12 * np.ones(3))
    place = {"axis": (0, 0, 1), "translation": (x, 0, 0)}
    b.add_joint(name, "continuous", parent=parent, child=name, **place, **given)


# A slider-crank, by quadrature in the crank's angle

R, L, SLIDER = 0.3, 0.8, 1.5


def slider_crank(pin: float, wrist: float, guide: float) -> Model:
    b = mb.ModelBuilder("slider_crank", gravity=(0, -9.81, 0))
    rod(b, "crank", "world", 0.0, R, friction=pin)
    rod(b, "rod", "crank", R, L, friction=wrist)
    b.add_body("slider", mass=SLIDER, inertia=np.ones(3))
    b.add_joint("slider", "prismatic", parent="world", child="slider", axis=(1, 0, 0), friction=guide)
    b.add_loop("wrist", "point", body_a="rod", body_b="slider", translation_a=(L, 0, 0))
    return b.build()


def crank_pose(theta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return q, and dq/dθ."""
    phi = np.arcsin(-R * np.sin(theta) / L)
    turn = -R * np.cos(theta) / (L * np.cos(phi))
    q = np.array([theta, phi - theta, R * np.cos(theta) + L * np.cos(phi)])
    return q, np.array([1.0, turn - 1.0, -R * np.sin(theta) - L * np.sin(phi) * turn])


def crank_energies(theta: float) -> tuple[float, float]:
    """Return the kinetic energy at θ̇ = 1, and the potential one."""
    phi = np.arcsin(-R * np.sin(theta) / L)
    _, (_, turn, slide) = crank_pose(theta)
    turn += 1.0
    x = -R * np.sin(theta) - L / 2 * np.sin(phi) * turn
    y = R * np.cos(theta) + L / 2 * np.cos(phi) * turn
    crank, coupler = 2 * R, 2 * L
    kinetic = crank * R**2 / 3 + coupler * (x**2 + y**2 + L**2 / 12 * turn**2) + SLIDER * slide**2
    return kinetic / 2, 9.81 * (crank * R / 2 * np.sin(theta) + coupler * (R * np.sin(theta) + L / 2 * np.sin(phi)))


@pytest.mark.parametrize(("engine", "method", "most"), [
    ("lagrangian", "rk853", 1e-9), ("lagrangian", "dop853", 1e-9), ("lagrangian", "rodas5", 1e-8),
    ("lagrangian", "rk4", 2e-7), ("lagrangian", "gauss4", 2e-7), ("pinocchio", "dop853", 1e-9),
])  # fmt: skip
def test_a_slider_crank_comes_to_rest_where_friction_has_taken_its_energy(
    engine: str, method: str, most: float
) -> None:
    friction = np.array([0.4, 0.3, 3.0])
    dyn, start, speed = mb.dynamics(slider_crank(*friction), engine), 2.6, 3.0
    q, slope = crank_pose(start)

    def left(theta: float) -> float:
        turns = [np.pi * k for k in range(1, 9) if start < np.pi * k < theta]
        lost = quad(lambda x: friction @ np.abs(crank_pose(x)[1]), start, theta, points=turns or None, epsabs=1e-13)[0]
        (first, low), (_, high) = crank_energies(start), crank_energies(theta)
        return float(first * speed**2 + low - high - lost)

    # The first place without energy.
    grid = np.linspace(start, start + 9.0, 400)
    k = next(k for k, x in enumerate(grid) if left(x) < 0)
    end = brentq(left, grid[k - 1], grid[k], xtol=1e-13)
    more = {"dt": 2e-3} if method in ("rk4", "gauss4") else ADAPTIVE
    run = simulated(dyn, q, speed * slope, 2.0, method, **more)
    dead, *stops = run.events[:4]
    assert dead.name == "slider turns"
    assert abs(dead.q[0] - np.pi) < most
    # All three come to rest, or turn, at one time.
    assert [e.name.split()[0] for e in stops] == ["crank", "rod", "slider"]
    assert len({e.t for e in stops}) == 1
    assert abs(stops[0].q[0] - end) < most
    assert np.abs(run.power_balance()).max() < max(1e-6, 10 * most)


# A four-bar that rests

BARS = np.array([0.5, 1.0, 2.0])


def four_bar(stiction: float = 1.0, gravity: float = 9.81) -> Model:
    b = mb.ModelBuilder("four_bar", gravity=(0, -gravity, 0))
    for (name, parent, x, length), f in zip(
        (("crank", "world", 0.0, 0.3), ("coupler", "crank", 0.3, 0.9), ("rocker", "world", 1.0, 0.7)), BARS, strict=True
    ):
        rod(b, name, parent, x, length, friction=f, stiction=stiction * f)
    b.add_loop("pin", "point", body_a="coupler", body_b="rocker", translation_a=(0.9, 0, 0), translation_b=(0.7, 0, 0))
    return b.build()


def four_bar_pose(theta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return q, and dq/dθ."""
    x, y = 1.0 - 0.3 * np.cos(theta), -0.3 * np.sin(theta)
    far = np.hypot(x, y)
    coupler = np.arctan2(y, x) + np.arccos((far**2 + 0.9**2 - 0.7**2) / (2 * far * 0.9))
    rocker = np.arctan2(0.3 * np.sin(theta) + 0.9 * np.sin(coupler), 0.9 * np.cos(coupler) - x)
    # The loop's rate: crank, coupler and rocker turn their ends.
    ends = np.array([[-0.9 * np.sin(coupler), 0.7 * np.sin(rocker)], [0.9 * np.cos(coupler), -0.7 * np.cos(rocker)]])
    turns = np.linalg.solve(ends, [0.3 * np.sin(theta), -0.3 * np.cos(theta)])
    return np.array([theta, coupler - theta, rocker]), np.array([1.0, turns[0] - 1.0, turns[1]])


def four_bar_weight(theta: float) -> float:
    """Return dV/dθ."""

    def potential(x: complex) -> Any:
        (a, b, c), _ = four_bar_pose(x.real)
        return 0.6 * 0.15 * np.sin(a) + 1.8 * (0.3 * np.sin(a) + 0.45 * np.sin(a + b)) + 1.4 * 0.35 * np.sin(c)

    h = 1e-5
    return (
        9.81
        * (8 * (potential(theta + h) - potential(theta - h)) - potential(theta + 2 * h) + potential(theta - 2 * h))
        / (12 * h)
    )


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
@pytest.mark.parametrize(("method", "more"), [
    ("rk853", ADAPTIVE), ("dop853", ADAPTIVE), ("rk4", {"dt": 0.01}), ("gauss4", {"dt": 0.01}),
])  # fmt: skip
@pytest.mark.parametrize("stiction", [1.0, 1.5])
def test_a_four_bar_lets_go_where_the_virtual_work_passes_that_of_all_its_pins(
    engine: str, method: str, more: dict[str, float], stiction: float
) -> None:
    q, slope = four_bar_pose(1.2)
    dyn, none = mb.dynamics(four_bar(stiction), engine), np.zeros(3)
    # What the pins hold together: no share of it is unique.
    time = (stiction * BARS @ np.abs(slope) + four_bar_weight(1.2)) / 2.0
    run = simulated(dyn, q, none, time + 0.05, method, torque=lambda t, *_: np.array([2.0 * t, 0, 0]), **more)
    assert names(run) == [f"{x} lets go" for x in ("crank", "coupler", "rocker")]
    assert [e.t for e in run.events] == pytest.approx([time] * 3, rel=1e-11)
    rests = run.t < time
    assert (run.q[rests] == q).all()
    assert (run.v[rests] == 0).all()
    assert np.sign(run.v[-1]).tolist() == np.sign(slope).tolist()
    assert np.abs(dyn.constraint_residual(run.q[-1])).max() < 1e-12
