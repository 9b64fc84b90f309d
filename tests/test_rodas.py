# Torques have the signature they are called with.
# ruff: noqa: ARG001
"""Rosenbrock's method rodas5: its tableau, its compiled step beside the one in NumPy, and stiff runs."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit.engines import Dynamics, dynamics
from mbkit.methods.registry import Tolerances
from mbkit.methods.tableaus import rodas5p
from mbkit.model import ModelBuilder
from mbkit.model.integration_space import Space
from mbkit.simulate import at_section, simulate
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.progress import Progress
from mbkit.simulate.solvers.adaptive import CompiledAttempts
from mbkit.simulate.solvers.step_attempts import RosenbrockAttempts
from mbkit.simulate.solvers.trajectory_record import AcceptedSteps
from mbkit.simulate.torque import Torque
from tests.random_trees import SOUND, random_tree
from tests.scenes import slider
from validation import closed_forms

# The tableau


def test_the_tableau_has_its_stages_as_published_and_travels() -> None:
    own = rodas5p()
    assert (own.stages, own.order, own.lower) == (8, 5, 4)
    assert own.c[:2] == pytest.approx([0.0, 3 * own.gamma])
    assert own.c[5:].tolist() == [1.0, 1.0, 1.0]
    # The coefficients of ∂f/∂t as published.
    assert own.d == pytest.approx(
        [own.gamma, -0.42387512638858027, -0.3384627126235924, 1.8046452872882734, 2.325825639765069, 0, 0, 0]
    )
    sent = pickle.loads(pickle.dumps(own))
    assert np.array_equal(sent.A, own.A)


def test_it_is_l_stable() -> None:
    own = rodas5p()

    def growth(z: complex) -> complex:
        k = np.zeros(8, dtype=complex)
        for i in range(8):
            k[i] = (z * (1 + own.A[i] @ k) + own.C[i] @ k) / (1 / own.gamma - z)
        return complex(1 + own.b @ k)

    on_the_axis = [abs(growth(1j * y)) for y in np.geomspace(1e-2, 1e6, 200)]
    assert max(on_the_axis) < 1 + 1e-9
    assert abs(growth(-1e8)) < 1e-6
    # Exact to the fifth power.
    z = 0.05
    assert growth(z) == pytest.approx(np.exp(z), abs=z**6 / 100)


# One step


def both(dyns: dict[str, Dynamics], rtol: float = 1e-10) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for name, dyn in dyns.items():
        model, tolerances = dyn.model, Tolerances(rtol, rtol)
        start, torque = (model.neutral(), np.zeros(model.nv)), Torque(None, model, None, None)
        problem = IntegrationProblem(dyn, "rodas5", *start, 0.0, 1.0, tolerances, torque, None, (), Progress(None, ""))
        own = problem, Space(model), tolerances
        made[name] = CompiledAttempts(*own, RosenbrockAttempts) if name == "lanes" else RosenbrockAttempts(*own)
    return made


def start_of(model: Any, seed: int) -> tuple[np.ndarray, np.ndarray]:
    q, v = model.random_state(np.random.default_rng(seed))
    return q, v


@pytest.mark.parametrize("name", ["plain", "floating"])
def test_the_step_is_of_order_five_on_every_joint_compiled_or_not(name: str) -> None:
    model = catalog.double_pendulum() if name == "plain" else random_tree(1, 4, SOUND)
    q, v = start_of(model, 0)
    dyns = {"lanes": dynamics(model, "lagrangian", compile=True), "stages": dynamics(model, "pinocchio")}
    space, w = Space(model), Space(model).to_integrator_velocity(q, v)
    lengths = np.array([0.02, 0.01, 0.005]) if name == "floating" else np.array([0.08, 0.04, 0.02])
    exact = simulate(dyns["lanes"], q, v, lengths[0], "rk853", rtol=1e-14, save=lengths[::-1])
    for trials in both(dyns).values():
        trials.start([0], q[None], w[None])
        trials.hold(0, 1.0)
        row = AcceptedSteps(np.zeros(3), np.tile(q, (3, 1)), np.tile(w, (3, 1)), 0)
        ends, speeds = trials.within(0, row, lengths)
        errors = [
            max(np.abs(model.difference(a, b)).max(), np.abs(space.to_body_velocity(b, c) - d).max())
            for a, b, c, d in zip(exact.q[::-1], ends, speeds, exact.v[::-1], strict=True)
        ]
        orders = np.log2(np.array(errors[:-1]) / errors[1:])
        # Of a step's error: one more than that of the method.
        assert (orders > 5.4).all(), (errors, orders)


def test_lanes_and_stages_take_the_same_steps() -> None:
    """Of plain joints: a rotation's error is that of a vector in one, and that of four numbers in the other."""
    b = ModelBuilder("stiff pair")
    for name, parent, k in (("a", "world", 0.0), ("b", "a", 1e7)):
        b.add_body(name, mass=1.0, com=(0, 0, -1.0))
        place = (0, 0, 0.0 if parent == "world" else -1.0)
        b.add_joint(
            name,
            "continuous",
            parent=parent,
            child=name,
            axis=(0, -1, 0),
            translation=place,
            stiffness=k,
            damping=k / 1e3,
        )
    model = b.build()
    runs = [
        simulate(dyn, [1.0, 0.0], [0.0, 0.0], 1.0, "rodas5", rtol=1e-8)
        for dyn in (dynamics(model, "lagrangian", compile=True), dynamics(model, "pinocchio"))
    ]
    assert runs[0].stats.steps == runs[1].stats.steps < 120
    assert runs[0].t == pytest.approx(runs[1].t, rel=1e-6)
    assert runs[0].q[-1] == pytest.approx(runs[1].q[-1], abs=1e-10)
    assert runs[0].stats.jacobians == runs[0].stats.steps + runs[0].stats.rejected


# Runs


def test_tolerance_rules_the_error() -> None:
    dyn, t = dynamics(catalog.pendulum(), "lagrangian", compile=True), np.linspace(0, 3, 7)
    exact, speed = closed_forms.pendulum_solution(t, 2.0)
    errors = []
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12):
        run = simulate(dyn, [2.0], [0.0], 3.0, "rodas5", rtol=rtol, save=t)
        errors.append(max(np.abs(run.q[:, 0] - exact).max(), np.abs(run.v[:, 0] - speed).max()) / rtol)
    assert max(errors) < 200


def test_a_stiff_oscillator_follows_its_closed_form_with_few_steps() -> None:
    k, c = 1e12, 1e9
    b = slider("slider", gravity=(0, 0, 0), stiffness=k, damping=c)
    root = np.sqrt(c * c / 4 - k)
    fast = -(c / 2 + root)
    slow = k / fast
    t = np.linspace(0, 5e-3, 11)
    exact = (fast * np.exp(slow * t) - slow * np.exp(fast * t)) / (fast - slow)
    run = simulate(dynamics(b.build()), [1.0], [0.0], 5e-3, "rodas5", rtol=1e-8, save=t)
    assert run.q[:, 0] == pytest.approx(exact, abs=1e-8)
    assert run.stats.steps < 300


def test_where_time_enters_it_keeps_its_order() -> None:
    dyn = dynamics(catalog.pendulum())

    def push(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array([5 * np.sin(7 * t) - 1e5 * (v[0] - np.cos(3 * t))])

    save = [0.5, 1.0]
    truth = simulate(dyn, [0.5], [1.0], 1.0, "radau", rtol=1e-11, torque=push, save=save)
    loose, fine = (simulate(dyn, [0.5], [1.0], 1.0, "rodas5", rtol=r, torque=push, save=save) for r in (1e-6, 1e-8))
    assert np.abs(loose.q - truth.q).max() < 1e-6
    assert np.abs(fine.q - truth.q).max() < 1e-8
    assert fine.stats.steps < 4 * loose.stats.steps


def test_batches_events_and_held_torques() -> None:
    model = catalog.double_pendulum(mass2=mb.Parameter("m", 1.0))
    dyn = dynamics(model, "lagrangian", compile=True)
    grid, tau = np.linspace(0, 0.4, 5), np.random.default_rng(0).standard_normal((4, 2))
    masses = [1.0, 3.0, 0.5, 2.0, 10.0]
    run = simulate(dyn.at(m=masses), [0.5, 0.2], [0.0, 0.0], 0.4, "rodas5", rtol=1e-9, torque=tau, save=grid)
    for mass, q in zip(masses, run.q, strict=True):
        alone = simulate(dyn.at(m=mass), [0.5, 0.2], [0.0, 0.0], 0.4, "rodas5", rtol=1e-9, torque=tau, save=grid)
        assert np.array_equal(alone.q, q)
    truth = simulate(dyn, [0.5, 0.2], [0.0, 0.0], 0.4, "rk853", rtol=1e-12, torque=tau, save=grid)
    assert run.q[0] == pytest.approx(truth.q, abs=1e-8)
    events = [at_section(model, "theta1", 0.4, terminal=True)]
    ends = [simulate(dyn, [0.5, 0.2], [0.0, 0.0], 1.0, m, rtol=1e-11, events=events).t[-1] for m in ("rodas5", "rk853")]
    assert ends[0] == pytest.approx(ends[1], abs=1e-10)


@pytest.mark.thorough("True")
@pytest.mark.parametrize("compiled", [True, False])
def test_the_clock_s_start_changes_no_step(compiled: bool) -> None:
    """A four-bar does not know the time: its steps are the same from every start, compiled or not."""
    b = ModelBuilder("four_bar", gravity=(0, -9.81, 0))
    for name, parent, x, length in (("a", "world", 0.0, 0.3), ("b", "a", 0.3, 0.9), ("c", "world", 1.0, 0.7)):
        b.add_body(name, mass=2 * length, com=(length / 2, 0, 0), inertia=length**3 / 6 * np.ones(3))
        b.add_joint(name, "continuous", parent=parent, child=name, axis=(0, 0, 1), translation=(x, 0, 0))
    b.add_loop("pin", "point", body_a="b", body_b="c", translation_a=(0.9, 0, 0), translation_b=(0.7, 0, 0))
    dyn = dynamics(b.build(), "lagrangian", compile=compiled)
    q, v = dyn.project([1.2, -0.6, 1.5], [8.0, 0, 0])
    first = simulate(dynamics(dyn.model, "lagrangian", compile=False), q, v, 0.1, "rodas5")
    for start in (0.5, 0.8, 3.0, 64.0):
        run = simulate(dyn, q, v, 0.1, "rodas5", t0=start)
        assert run.stats.ended == "finished"
        assert run.t - start == pytest.approx(first.t, rel=1e-5, abs=1e-12)
        assert run.q[-1] == pytest.approx(first.q[-1], abs=1e-9)
