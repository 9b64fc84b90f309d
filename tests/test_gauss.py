# Torques have the signature they are called with.
# ruff: noqa: ARG005
"""Gauss-Legendre collocation: its tableaus, its order on any engine, and runs that go wrong."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, MbkitWarning
from mbkit.methods.tableaus import ImplicitTableau, Tableau, gauss_legendre
from mbkit.model import Model
from mbkit.model.integration_space import Space
from mbkit.simulate import METHODS, simulate
from mbkit.simulate.solvers.fixed_step import make_step
from mbkit.simulate.solvers.vector_field import Field
from tests.orders import cases, observed, torque_on
from tests.random_trees import random_tree
from tests.scenes import slider

EPS = np.finfo(float).eps
GAUSS = ("gauss4", "gauss6")


# Tableaus


@pytest.mark.parametrize("stages", [2, 3])
def test_tableaus_are_gauss_and_legendres(stages: int) -> None:
    tableau = gauss_legendre(stages)
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    assert tableau.c == pytest.approx((1 + nodes) / 2, abs=4 * EPS)
    assert tableau.b == pytest.approx(weights / 2, abs=4 * EPS)
    # Symplectic: b_i a_ij + b_j a_ji = b_i b_j. Symmetric: A and its mirror image sum to b.
    b, A = tableau.b, tableau.A
    assert b[:, None] * A + (b[:, None] * A).T == pytest.approx(np.outer(b, b), abs=4 * EPS)
    assert A + A[::-1, ::-1] == pytest.approx(np.tile(b, (stages, 1)), abs=4 * EPS)
    with pytest.raises(InputError, match=f"order {2 * stages + 1} condition"):
        ImplicitTableau("too high", A, b, 2 * stages + 1)
    with pytest.raises(InputError, match="not explicit"):
        Tableau("explicit", A, b, 2 * stages)
    again = pickle.loads(pickle.dumps(tableau))
    assert type(again) is ImplicitTableau
    assert np.array_equal(again.A, A)


# Order


# Long enough steps that rounding is far, short enough that the first term of the error rules.
COUNTS = {"gauss4": (30, 45, 65, 90), "gauss6": (14, 18, 24, 32)}
# The top turns fast; the tree has a joint that swings and damps within a few hundredths of a second.
QUICKER = dict.fromkeys([("heavy top", x) for x in GAUSS], 2) | {
    ("random tree", "gauss4"): 3,
    ("random tree", "gauss6"): 4,
}


@pytest.mark.thorough("gauss4-heavy top", "gauss4-random tree", "gauss6-random tree")
@pytest.mark.parametrize("case", cases())
@pytest.mark.parametrize("method", GAUSS)
def test_observed_order(case: str, method: str) -> None:
    counts = tuple(QUICKER.get((case, method), 1) * n for n in COUNTS[method])
    assert observed(case, method, counts) == pytest.approx(METHODS[method].order, abs=0.2)


@pytest.mark.parametrize("method", GAUSS)
def test_observed_order_with_a_torque_function(method: str) -> None:
    def torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array([np.sin(5 * t), 0.0]) - 2.0 * v - 3.0 * q

    order = observed("double pendulum", method, COUNTS[method], "lagrangian", torque)
    assert order == pytest.approx(METHODS[method].order, abs=0.2)


# Stages solved to rounding


@pytest.mark.parametrize("case", cases())
@pytest.mark.parametrize("method", GAUSS)
def test_stages_are_solved_to_rounding(case: str, method: str) -> None:
    """A step from a good guess and one from none agree, so the iteration's way leaves no trace."""
    model, q, v, duration = cases()[case]
    space, h, force = Space(model), duration / 40, torque_on(model)
    dyn = mb.dynamics(model)
    warm = make_step(method, Field(dyn, space), space)
    state = q, space.to_integrator_velocity(q, v)
    for k in range(4):
        cold = make_step(method, Field(dyn, space), space)
        fresh = cold(k * h, h, *state, force)
        state = warm(k * h, h, *state, force)
        assert np.abs(fresh[0] - state[0]).max() <= 64 * EPS * max(np.abs(state[0]).max(), 1.0)
        assert np.abs(fresh[1] - state[1]).max() <= 256 * EPS * max(np.abs(state[1]).max(), 1.0)


@pytest.mark.parametrize("method", GAUSS)
def test_a_stiff_damper_is_no_reason_for_short_steps(method: str) -> None:
    """On v' = -c v the step is the Padé approximation of exp, whatever h c is."""
    run = simulate(mb.dynamics(slider(damping=1e4).build()), [0.0], [1.0], 0.1, method, dt=0.01)
    z = -100.0
    pade = {
        "gauss4": (1 + z / 2 + z**2 / 12) / (1 - z / 2 + z**2 / 12),
        "gauss6": (1 + z / 2 + z**2 / 10 + z**3 / 120) / (1 - z / 2 + z**2 / 10 - z**3 / 120),
    }
    # The stages' equations have the condition number |z|.
    assert run.v[:, 0] == pytest.approx(pade[method] ** np.arange(11), abs=11 * 16 * abs(z) * EPS)


# Machine code


def both(model: Model, method: str, q: np.ndarray, v: np.ndarray, **more: object) -> list[mb.Trajectory]:
    return [
        simulate(mb.dynamics(model, "lagrangian", compile=compiled), q, v, 0.1, method, dt=0.01, **more)  # type: ignore[arg-type]
        for compiled in (True, False)
    ]


@pytest.mark.thorough("0-3", "1-3")
@pytest.mark.parametrize(("seed", "n"), [(1, 2), (0, 3), (1, 3)])
def test_compiled_steps_are_those_of_python(seed: int, n: int) -> None:
    """Springs, damping, armature, rotations; states and torques of their own in a batch."""
    model = random_tree(seed, n, ("ball", "prismatic") if n == 2 else ("free", "ball", "revolute", "prismatic")[seed:])
    q, v = model.random_state(np.random.default_rng(seed), 3)
    rows = np.random.default_rng(seed).standard_normal((3, 10, model.nv))
    for method in GAUSS if n > 2 else GAUSS[:1]:
        compiled, interpreted = both(model, method, q, v, torque=rows)
        for x, y in ((compiled.q, interpreted.q), (compiled.v, interpreted.v)):
            # Ten steps of rounding, which inverse and forward dynamics have their own of.
            assert np.abs(x - y).max() <= 1e4 * EPS * max(1.0, np.abs(y).max())


@pytest.mark.thorough("0")
@pytest.mark.parametrize("seed", [0, 5])
def test_steps_that_are_long_lead_to_the_same_solution(seed: int) -> None:
    """At seed 5 Newton's iteration from a far guess would end at another solution of the stages' equations."""
    model = catalog.double_pendulum()
    q, v = model.random_state(seed)
    for method, dt in ((method, dt) for method in GAUSS for dt in (0.05, 0.1)):
        compiled, interpreted = (
            simulate(mb.dynamics(model, "lagrangian", compile=x), q, 3 * v, 3.0, method, dt=dt) for x in (True, False)
        )
        # Sixty steps of a chaotic motion: no step is off by what an iteration too few would leave, 1e-10 and more.
        assert np.abs(compiled.q - interpreted.q).max() < 2e-11


def test_compiled_steps_take_wrenches_and_a_start() -> None:
    model = random_tree(4, n=2, kinds=("revolute", "prismatic"))
    q, v = model.random_state(np.random.default_rng(4))
    push = {model.frames[-1].name: np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])}
    compiled, interpreted = both(model, "gauss4", q, v, wrenches=push, t0=3.0)
    free = simulate(mb.dynamics(model, "lagrangian", compile=False), q, v, 0.1, "gauss4", dt=0.01)
    assert np.abs(compiled.q - interpreted.q).max() <= 1e3 * EPS * max(1.0, np.abs(interpreted.q).max())
    assert np.abs(compiled.q - free.q).max() > 1e-6


@pytest.mark.thorough
def test_a_large_loop_is_not_compiled_for_a_few_steps() -> None:
    """Compiling the delta robot's step takes ten seconds, as many as some twenty thousand steps in Python."""
    robot = catalog.delta_robot()
    dyn = mb.dynamics(robot, "lagrangian", compile=True)
    assert isinstance(dyn, LagrangianDynamics)
    run = simulate(dyn, *robot.random_state(0), 0.01, "gauss4", dt=0.005)
    assert run.stats.ended == "finished"
    assert not any("collocation" in name for names in dyn._machines for name in names)


def test_a_part_that_is_too_large_to_compile_leaves_the_run_to_python(monkeypatch: pytest.MonkeyPatch) -> None:
    from mbkit.codegen import backend

    model, start = catalog.furuta_pendulum(), ([0.3, 0.4], [1.0, 2.0])
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    dyn.forward_dynamics(*start, [0.0, 0.0])
    monkeypatch.setattr(backend, "_MAX_COMPILED_OPERATIONS", 20)
    run = simulate(dyn, *start, 0.1, "gauss4", dt=0.01)
    expected = simulate(mb.dynamics(model, "lagrangian", compile=False), *start, 0.1, "gauss4", dt=0.01)
    assert np.abs(run.q - expected.q).max() < 1e-14


# What goes wrong


@pytest.mark.parametrize("method", GAUSS)
def test_a_step_that_is_too_long_is_told_and_what_was_good_is_kept(method: str) -> None:
    dyn = mb.dynamics(catalog.double_pendulum())
    with pytest.warns(MbkitWarning, match=r"diverged after t = .* s \(step .*may be too long"):
        run = simulate(dyn, [2.0, 1.0], [8.0, -9.0], 300.0, method, dt=1.5)
    assert run.stats.ended == "diverged"
    assert np.isfinite(run.q).all()
    assert run.t[-1] == run.stats.reached < 300.0
    q, v = np.array([[2.0, 1.0], [0.01, 0.0]]), np.array([[8.0, -9.0], [0.0, 0.0]])
    with pytest.warns(MbkitWarning, match="1 of 2 trajectories diverged"):
        batch = simulate(dyn, q, v, 60.0, method, dt=1.5)
    assert np.isnan(batch.q[0, -1]).all()
    assert np.isfinite(batch.q[1]).all()


def test_a_torque_function_that_jumps_within_a_step_is_told() -> None:
    dyn = mb.dynamics(catalog.pendulum(gravity=0.0))
    with pytest.warns(MbkitWarning, match="the iteration does not solve"):
        run = simulate(dyn, [0.0], [1e-3], 1.0, "gauss4", dt=0.1, torque=lambda t, q, v: -9 * np.sign(v))
    assert run.stats.ended == "diverged"


@pytest.mark.parametrize("method", GAUSS)
def test_time_can_be_turned_back_without_quaternions(method: str) -> None:
    model, q, v, duration = cases()["double pendulum"]
    dyn = mb.dynamics(model)
    there = simulate(dyn, q, v, duration, method, dt=0.02)
    back = simulate(dyn, there.q[-1], -there.v[-1], duration, method, dt=0.02)
    assert back.q[-1] == pytest.approx(q, abs=1e-13)
    assert back.v[-1] == pytest.approx(-v, abs=1e-12)
