# Torques have the signature they are called with.
# ruff: noqa: ARG005
"""Radau, BDF and LSODA: the exact Jacobian, stiff scenes, and runs that go wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit.engines import dynamics
from mbkit.errors import MbkitWarning
from mbkit.model import Model, ModelBuilder
from mbkit.simulate import simulate
from mbkit.simulate.solvers.vector_field import Rates
from mbkit.simulate.stiffness_measure import RateJacobian
from tests.random_trees import ALL, random_tree
from tests.scenes import slider
from validation import closed_forms

IMPLICIT = ("radau", "bdf", "lsoda")
SCIPY = ("dop853", *IMPLICIT)
# A tolerance that gives 1e-6 on a scene of a few swings; multistep methods exceed theirs the most.
ENOUGH = {"dop853": 1e-9, "radau": 1e-8, "bdf": 1e-11, "lsoda": 1e-10}


def elastic_pendulum(stiffness: float, damping: float) -> Model:
    """A bob on a rod that stretches along itself."""
    b = ModelBuilder("elastic pendulum")
    b.add_body("rod", mass=0.1, com=(0, 0, -0.5), inertia=(0.01, 0.01, 0.001))
    b.add_joint("swing", "revolute", parent="world", child="rod", axis=(0, -1, 0))
    b.add_body("bob", mass=1.0, com=(0, 0, -1.0))
    b.add_joint(
        "stretch", "prismatic", parent="rod", child="bob", axis=(0, 0, -1), stiffness=stiffness, damping=damping
    )
    return b.build()


def bent_pendulum(stiffness: float, damping: float) -> Model:
    """Two links that a joint spring all but holds straight."""
    b = ModelBuilder("bent pendulum")
    for name, parent, place in (("a", "world", 0.0), ("b", "a", -1.0)):
        b.add_body(name, mass=1.0, com=(0, 0, -0.5), inertia=(0.1, 0.1, 0.01))
        spring = {"stiffness": stiffness, "damping": damping} if name == "b" else {}
        at = (0.0, 0.0, place)
        b.add_joint(f"to {name}", "revolute", parent=parent, child=name, axis=(0, -1, 0), translation=at, **spring)
    return b.build()


def apart(model: Model, run: Any, other: Any) -> float:
    return float(max(np.abs(model.difference(run.q[-1], other.q[-1])).max(), np.abs(run.v[-1] - other.v[-1]).max()))


# The Jacobian


def differences(rates: Rates, y: np.ndarray, force: Any, h: float = 1e-3) -> np.ndarray:
    """Central differences of sixth order of the rates, in every raw component."""
    columns = []
    for e in np.eye(len(y)):
        at = {s: rates(0.3, y + s * h * e, force) for s in (-3, -2, -1, 1, 2, 3)}
        columns.append((45 * (at[1] - at[-1]) - 9 * (at[2] - at[-2]) + at[3] - at[-3]) / (60 * h))
    return np.array(columns).T


def state(model: Model, seed: int) -> np.ndarray:
    """A state whose quaternions have any length."""
    rng = np.random.default_rng(seed)
    q, v = model.random_state(rng)
    for start, _ in model.quaternions:
        q[start : start + 4] *= rng.uniform(0.5, 2.0)
    return np.concatenate([q, v])


def close(J: np.ndarray, numeric: np.ndarray, good: float) -> None:
    assert np.linalg.norm(J - numeric) <= good * np.linalg.norm(numeric)


@pytest.mark.thorough("0-pinocchio", "0-mujoco", "1-lagrangian", "1-mujoco")
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco"])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_jacobian_is_that_of_the_rates(seed: int, engine: str) -> None:
    kinds = tuple(k for k in ALL if k != "helical") if engine == "mujoco" else ALL
    model = random_tree(seed, 11, kinds)
    dyn = dynamics(model, engine)
    y, tau = state(model, seed), np.random.default_rng(seed).standard_normal(model.nv)
    exact = RateJacobian(dyn)
    # The differences are good to h⁶ of a seventh derivative beside 2e-16 / h of the rates.
    close(exact(0.3, y, tau), differences(Rates(dyn), y, tau), 1e-10)
    assert exact.evaluations == 1

    def spring(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return tau * np.sin(t + q.sum()) - 0.3 * v

    # Of a torque function, forward differences: half of the digits.
    close(exact(0.3, y, spring), differences(Rates(dyn), y, spring), 1e-7)


def test_the_jacobian_has_the_parameters_values() -> None:
    model = catalog.double_pendulum(mass1=mb.Parameter("m", 2.0))
    dyn = dynamics(model, "lagrangian")
    y, tau = np.array([0.3, -0.5, 1.0, 2.0]), np.zeros(2)
    plain = RateJacobian(dynamics(catalog.double_pendulum(mass1=3.0), "lagrangian"))(0.0, y, tau)
    assert RateJacobian(dyn.at(m=3.0))(0.0, y, tau) == pytest.approx(plain, abs=1e-12)
    assert RateJacobian(dynamics(model).at(m=3.0))(0.0, y, tau) == pytest.approx(plain, abs=1e-12)
    many = RateJacobian(dyn.at(m=[1.0, 3.0]))
    many.only(1)
    assert many(0.0, y, tau) == pytest.approx(plain, abs=1e-12)


def test_where_there_is_no_jacobian_the_last_one_stays() -> None:
    model = catalog.pendulum()
    exact = RateJacobian(dynamics(model, "lagrangian"))
    assert not exact(0.0, np.array([np.nan, 0.0]), np.zeros(1)).any()
    known = exact(0.0, np.array([0.3, 0.0]), np.zeros(1))
    assert np.array_equal(exact(0.0, np.array([0.3, np.inf]), np.zeros(1)), known)


# Accuracy


@pytest.mark.thorough("radau", "bdf")
@pytest.mark.parametrize("method", IMPLICIT)
def test_tolerance_rules_the_error(method: str) -> None:
    dyn = dynamics(catalog.pendulum(), "lagrangian")
    t = np.linspace(0, 3, 7)
    exact, speed = closed_forms.pendulum_solution(t, 2.0)
    errors, cost = [], []
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10):
        run = simulate(dyn, [2.0], [0.0], 3.0, method, rtol=rtol, save=t)
        assert np.array_equal(run.t, t)
        errors.append(max(np.abs(run.q[:, 0] - exact).max(), np.abs(run.v[:, 0] - speed).max()))
        cost.append(run.stats.evaluations)
    assert all(error < 2e4 * rtol for error, rtol in zip(errors, (1e-4, 1e-6, 1e-8, 1e-10), strict=True))
    assert errors == sorted(errors, reverse=True)
    assert cost == sorted(cost)


@pytest.fixture(scope="module")
def every_kind() -> tuple[Any, ...]:
    """A tree of every joint kind, how to run it, and its run with dop853."""
    model = random_tree(3, 12)
    q, v = model.random_state(np.random.default_rng(0))
    given, save = (dynamics(model, "lagrangian"), q, v, 0.04), [0.0, 0.02, 0.04]
    return model, given, save, simulate(*given, "dop853", rtol=1e-12, save=save)


@pytest.mark.thorough("radau", "bdf")
@pytest.mark.parametrize("method", IMPLICIT)
def test_every_joint_kind_moves_as_with_dop853(method: str, every_kind: tuple[Any, ...]) -> None:
    model, given, save, truth = every_kind
    run = simulate(*given, method, rtol=ENOUGH[method], save=save)
    assert apart(model, run, truth) < 1e-6
    model.check_q(run.q)
    # LSODA stays with Adams where nothing is stiff.
    assert run.stats.jacobians > 0 or method == "lsoda"


@pytest.mark.thorough("radau")
@pytest.mark.parametrize("method", SCIPY)
def test_a_dense_grid_costs_little_and_loses_nothing(method: str) -> None:
    """Saved times between the steps: interpolated, or ended on without starting over."""
    dyn = dynamics(catalog.pendulum())
    few = simulate(dyn, [2.0], [0.0], 2.0, method, rtol=1e-10, save=[0, 2.0])
    times = np.sort(np.append(np.linspace(0, 2, 41), np.linspace(0, 2, 41)[1:-1] + 1e-9))
    many = simulate(dyn, [2.0], [0.0], 2.0, method, rtol=1e-10, save=times)
    assert many.stats.finished
    exact, _ = closed_forms.pendulum_solution(times, 2.0)
    assert many.q[:, 0] == pytest.approx(exact, abs=2e-7)
    if method in ("bdf", "lsoda"):
        assert many.stats.evaluations == few.stats.evaluations
    else:
        assert many.stats.steps <= few.stats.steps + 2 * len(times)


# Stiffness, counted in evaluations


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("scene", [elastic_pendulum, bent_pendulum])
@pytest.mark.parametrize(("stiffness", "damping"), [(1e6, 1e4), (1e9, 1e6)])
def test_stiff_scenes_are_reached_with_few_evaluations(scene: Any, stiffness: float, damping: float) -> None:
    model = scene(stiffness, damping)
    dyn = dynamics(model, "lagrangian")
    start = [1.0, 0.0], [0.0, 0.0], 1.0
    truth = simulate(dyn, *start, "radau", rtol=1e-11, save=[0, 1.0])
    # The reference is held by a method of another family.
    assert apart(model, simulate(dyn, *start, "lsoda", rtol=1e-12, save=[0, 1.0]), truth) < 1e-9
    for method, rtol in (("radau", 1e-7), ("bdf", 1e-8), ("lsoda", 1e-9)):
        run = simulate(dyn, *start, method, rtol=rtol, save=[0, 1.0])
        assert apart(model, run, truth) < 1e-6, method
        assert run.stats.evaluations < 1000, method
        assert 0 < run.stats.jacobians < 100, method


def test_a_stiff_linear_oscillator_follows_its_closed_form() -> None:
    k, c, m = 1e9, 1e6, 1.0
    b = slider("slider", mass=m, stiffness=k, damping=c)
    dyn = dynamics(b.build(), "lagrangian")
    root = np.sqrt(c * c / 4 - k * m)
    slow, fast = -k / (c / 2 + root), -(c / 2 + root)
    t = np.linspace(0, 5e-3, 11)
    exact = (fast * np.exp(slow * t) - slow * np.exp(fast * t)) / (fast - slow)
    for method in IMPLICIT:
        run = simulate(dyn, [1.0], [0.0], 5e-3, method, rtol=ENOUGH[method], save=t)
        assert run.q[:, 0] == pytest.approx(exact, abs=1e-6), method
        assert run.stats.evaluations < 5000, method


# Runs that go wrong


def pushed(t: float) -> float:
    """A force that is without bound at 0.7 s."""
    return 1.0 / (0.7 - t) ** 2


@pytest.mark.thorough("dop853", "radau")
@pytest.mark.parametrize("method", SCIPY)
def test_a_step_below_rounding_is_told(method: str) -> None:
    dyn = dynamics(catalog.pendulum())
    save = np.linspace(0, 1, 11)
    with pytest.warns(MbkitWarning, match=r"after t = 0\.[67]"):
        run = simulate(dyn, [0.1], [0.0], 1.0, method, rtol=1e-8, torque=lambda t, q, v: [pushed(t)], save=save)
    assert run.stats.ended in ("step_too_small", "diverged")
    assert run.stats.reached == pytest.approx(0.7, abs=1e-3)
    assert np.array_equal(run.t, save[:7])
