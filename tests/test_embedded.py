# Torques have the signature they are called with.
# ruff: noqa: ARG001, ARG005
"""The embedded pair rk853: its tableau, its compiled step, and the runs made of it."""

from __future__ import annotations

import warnings
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit.engines import Dynamics, dynamics
from mbkit.errors import MbkitWarning
from mbkit.methods.registry import Tolerances
from mbkit.methods.tableaus import dormand_prince_853
from mbkit.model import Model
from mbkit.model.integration_space import Space
from mbkit.simulate import Event, Trajectory, at_section, simulate
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.progress import Progress
from mbkit.simulate.solvers.adaptive import CompiledAttempts
from mbkit.simulate.solvers.step_attempts import RungeKuttaAttempts
from mbkit.simulate.solvers.trajectory_record import AcceptedSteps
from mbkit.simulate.torque import Torque
from tests.scenes import mounted

EPS = np.finfo(float).eps


def tumbling() -> Model:
    """A free body with a ball joint and a hinge on it."""
    place = {"translation": (0, 0, 1), "rpy": (0.3, -0.2, 1.0)}
    b = mounted("tumbling", "body", "float", "free", mass=2.0, com=(0.1, -0.2, 0.05), inertia=(0.3, 0.4, 0.6), **place)
    b.add_body("arm", mass=0.7, com=(0.2, 0.1, 0.0), inertia=(0.02, 0.03, 0.04))
    b.add_joint("shoulder", "ball", parent="body", child="arm", translation=(0.3, 0.0, 0.1))
    b.add_body("hand", mass=0.3, com=(0.1, 0.0, 0.1), inertia=(0.01, 0.01, 0.01))
    b.add_joint("elbow", "revolute", parent="arm", child="hand", translation=(0.4, 0.0, 0.0), axis=(0, 1, 0))
    return b.build()


def cases() -> dict[str, tuple[Model, np.ndarray, np.ndarray]]:
    top = catalog.heavy_top()
    tree, double = tumbling(), catalog.double_pendulum()
    rng = np.random.default_rng(7)
    return {
        "double_pendulum": (double, np.array([1.0, 0.5]), np.array([0.3, -0.2])),
        "heavy_top": (top, top.random_state(rng)[0], np.array([0.4, -0.3, 3.0])),
        "floating_tree": (tree, tree.random_state(rng)[0], 2.0 * tree.random_state(rng)[1]),
    }


CASES = cases()


def both(model: Model) -> dict[str, Dynamics]:
    return {"lanes": dynamics(model, "lagrangian", compile=True), "stages": dynamics(model, "pinocchio")}


def trials(kind: str, dyn: Any, rtol: float = 1e-10) -> CompiledAttempts | RungeKuttaAttempts:
    make, model = {"lanes": CompiledAttempts, "stages": RungeKuttaAttempts}[kind], dyn.model
    tolerances, torque = Tolerances(rtol, rtol), Torque(None, model, None, None)
    start = model.neutral(), np.zeros(model.nv)
    problem = IntegrationProblem(dyn, "rk853", *start, 0.0, 1.0, tolerances, torque, None, (), Progress(None, ""))
    return make(problem, Space(model), tolerances)


def quiet(*args: Any, **kwargs: Any) -> Trajectory:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        return simulate(*args, **kwargs)


# The tableau


def test_the_coefficients_are_scipys() -> None:
    theirs = pytest.importorskip("scipy.integrate._ivp.dop853_coefficients")
    pair = dormand_prince_853()
    assert np.array_equal(pair.A, theirs.A[:12, :12])
    assert np.array_equal(pair.b, theirs.B)
    assert np.array_equal(pair.errors[0], theirs.E5[:12])
    assert np.array_equal(pair.errors[1], theirs.E3[:12])


# One step


def fixed_steps(kind: str, dyn: Any, q: np.ndarray, v: np.ndarray, duration: float, n: int) -> np.ndarray:
    """Return q and w after n equal steps."""
    made, space = trials(kind, dyn), Space(dyn.model)
    w = space.to_integrator_velocity(q, v)
    made.start([0], q[None], w[None])
    made.hold(0, duration)
    times = np.linspace(0.0, duration, n + 1)
    for a, b in pairwise(times):
        (q,), (w,) = made.within(0, AcceptedSteps(np.array([a]), q[None], w[None], 0), np.array([b]))
    return np.concatenate([q, w])


@pytest.mark.thorough("floating_tree-lanes", "floating_tree-stages")
@pytest.mark.parametrize("kind", ["lanes", "stages"])
@pytest.mark.parametrize("case", list(CASES))
def test_observed_order_is_eight(case: str, kind: str) -> None:
    model, q, v = CASES[case]
    dyn = both(model)[kind]
    # Short enough for the order to show, long enough for the error to stand out of rounding.
    duration, counts = {"heavy_top": (1.0, (8, 10, 12, 15))}.get(case, (0.6, (14, 16, 20, 24)))
    exact = fixed_steps(kind, dyn, q, v, duration, 100)
    errors = [np.abs(fixed_steps(kind, dyn, q, v, duration, n) - exact).max() for n in counts]
    assert min(errors) > 1e4 * EPS
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    # Of a scene whose leading error is small beside the next one more is seen: 8.9 of the top.
    assert 7.8 < order < 9.2


@pytest.mark.parametrize("kind", ["lanes", "stages"])
def test_each_step_is_scipys(kind: str) -> None:
    from scipy.integrate import DOP853

    model, q, v = CASES["double_pendulum"]
    dyn = both(model)[kind]
    forward = dynamics(model, "pinocchio").forward_dynamics

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[2:], forward(y[:2], y[2:], np.zeros(2))])

    solver = DOP853(rates, 0.0, np.concatenate([q, v]), 3.0, rtol=1e-9, atol=1e-9)
    made = trials(kind, dyn)
    made.start([0], q[None], v[None])
    made.hold(0, 3.0)
    while solver.status == "running":
        t, y = solver.t, solver.y.copy()
        solver.step()
        start = AcceptedSteps(np.array([t]), y[None, :2], y[None, 2:], 0)
        (q1,), (w1,) = made.within(0, start, np.array([solver.t]))
        # Weights up to 43 multiply the rounding of accelerations up to 30 rad/s².
        assert np.abs(np.concatenate([q1, w1]) - solver.y).max() < 1e3 * EPS


@pytest.mark.thorough("floating_tree")
@pytest.mark.parametrize("case", list(CASES))
def test_lanes_and_stages_take_the_same_steps(case: str) -> None:
    model, q, v = CASES[case]
    runs = [simulate(dyn, q, v, 1.0, "rk853", rtol=1e-8) for dyn in both(model).values()]
    assert len(runs[0].t) == len(runs[1].t)
    assert runs[0].stats.rejected == runs[1].stats.rejected
    # An estimate of 1e-8 is right to 1e-7 or so of itself, and with it the lengths.
    assert np.abs(runs[0].t - runs[1].t).max() < 1e-5
    assert np.abs(runs[0].q[-1] - runs[1].q[-1]).max() < 1e-11


# Runs


@pytest.mark.thorough("floating_tree-stages", "floating_tree-lanes")
@pytest.mark.parametrize("kind", ["lanes", "stages"])
@pytest.mark.parametrize("case", list(CASES))
def test_tolerance_rules_the_error(case: str, kind: str) -> None:
    model, q, v = CASES[case]
    dyn = both(model)[kind]
    exact = simulate(dyn, q, v, 1.0, "rk853", rtol=1e-15, save=[1.0])
    errors = []
    for rtol in (1e-6, 1e-8, 1e-10, 1e-12):
        run = simulate(dyn, q, v, 1.0, "rk853", rtol=rtol, save=[1.0])
        errors.append(np.abs(run.q[-1] - exact.q[-1]).max())
        # A second of a smooth motion: as many steps as tolerances add up, or less.
        assert errors[-1] < 20 * rtol
    assert errors[-1] < 1e-4 * errors[0]


def test_the_other_road_comes_to_the_same() -> None:
    box, grid = catalog.free_body(), np.linspace(0.0, 1.0, 5)
    q, v = box.random_state(np.random.default_rng(7))[0], np.array([0.3, -0.1, 0.2, 1.0, 3.0, 0.4])
    ours = simulate(both(box)["lanes"], q, v, 1.0, "rk853", rtol=1e-13, save=grid)
    theirs = simulate(both(box)["stages"], q, v, 1.0, "dop853", rtol=1e-13, save=grid)
    assert np.abs(ours.q - theirs.q).max() < 1e-11
    assert np.abs(ours.v - theirs.v).max() < 1e-10


@pytest.mark.parametrize("kind", ["lanes", "stages"])
def test_tolerances_at_rounding_do_not_stall(kind: str) -> None:
    model, q, v = CASES["floating_tree"]
    dyn = both(model)[kind]
    run = simulate(dyn, q, v, 0.3, "rk853", rtol=2.3e-16, save=[0.3])
    close = simulate(dyn, q, v, 0.3, "rk853", rtol=1e-13, save=[0.3])
    assert run.stats.ended == "finished"
    assert run.stats.steps < 20 * close.stats.steps
    assert np.abs(run.q - close.q).max() < 1e-12


def test_the_same_inputs_give_the_same_bits_in_any_lane() -> None:
    model, q, v = CASES["floating_tree"]
    dyn = both(model)["lanes"]
    grid = np.linspace(0.0, 0.5, 4)
    one = simulate(dyn, q, v, 0.5, "rk853", rtol=1e-9, save=grid)
    again = simulate(dyn, q, v, 0.5, "rk853", rtol=1e-9, save=grid)
    assert np.array_equal(one.q, again.q)
    assert np.array_equal(one.v, again.v)
    others = model.random_state(np.random.default_rng(3), 7)
    for place in (0, 2, 6):
        qs, vs = (x.copy() for x in others)
        qs[place], vs[place] = q, v
        many = simulate(dyn, qs, vs, 0.5, "rk853", rtol=1e-9, save=grid)
        assert np.array_equal(many.q[place], one.q)
        assert np.array_equal(many.v[place], one.v)


@pytest.mark.parametrize("kind", ["lanes", "stages"])
def test_what_is_saved_changes_no_step(kind: str) -> None:
    model, q, v = CASES["floating_tree"]
    dyn = both(model)[kind]
    own = simulate(dyn, q, v, 1.0, "rk853", rtol=1e-9)
    assert own.t[0] == 0.0
    assert own.t[-1] == 1.0
    grid = np.sort(np.concatenate([own.t, np.linspace(0.01, 0.99, 23)]))
    saved = simulate(dyn, q, v, 1.0, "rk853", rtol=1e-9, save=grid)
    assert np.array_equal(saved.t, grid)
    assert saved.stats.steps == own.stats.steps
    assert np.array_equal(saved.q[np.isin(grid, own.t)], own.q)
    exact = simulate(dyn, q, v, 1.0, "rk853", rtol=1e-14, save=grid)
    # Nowhere between is the error more than at the steps' ends, within twice.
    error = np.abs(saved.q - exact.q).max(axis=1)
    assert error[~np.isin(grid, own.t)].max() < 2 * error[np.isin(grid, own.t)].max()


@pytest.mark.parametrize("kind", ["lanes", "stages"])
def test_held_torques_jump_where_they_should(kind: str) -> None:
    b = mounted("cart", "cart", "x", "prismatic", mass=2.0, axis=(1, 0, 0))
    dyn = both(b.build())[kind]
    grid = np.array([0.0, 0.3, 0.35, 1.0])
    run = simulate(dyn, [0.0], [0.0], 1.0, "rk853", rtol=1e-12, save=grid, torque=[[2.0], [-40.0], [0.0]])
    # Between the jumps of -20 m/s² a dozen stages are summed, in an order that is the processor's.
    assert np.abs(run.v[:, 0] - [0.0, 0.3, -0.7, -0.7]).max() < 12 * EPS
    x = [0.0, 0.045, 0.045 + 0.3 * 0.05 - 10 * 0.05**2]
    assert np.abs(run.q[:, 0] - [*x, x[2] - 0.7 * 0.65]).max() < 12 * EPS


# Events


@pytest.mark.parametrize("kind", ["lanes", "stages"])
def test_events_are_found_and_end_the_run(kind: str) -> None:
    model, q, v = CASES["double_pendulum"]
    dyn = both(model)[kind]
    name = model.coordinate_names[0]
    noted = simulate(dyn, q, v, 3.0, "rk853", rtol=1e-11, events=at_section(model, name))
    assert len(noted.events) >= 2
    exact = simulate(dyn, q, v, 3.0, "rk853", rtol=1e-14, save=np.array([hit.t for hit in noted.events]))
    for hit, at in zip(noted.events, exact.q, strict=True):
        assert abs(hit.q[0]) < 1e-14
        assert np.abs(hit.q - at).max() < 1e-9
    # The own steps are those of a run that looks for nothing.
    assert np.array_equal(noted.q, simulate(dyn, q, v, 3.0, "rk853", rtol=1e-11).q)
    for save in (None, np.linspace(0.0, 3.0, 200)):
        stopped = simulate(
            dyn, q, v, 3.0, "rk853", rtol=1e-11, events=at_section(model, name, terminal=True), save=save
        )
        assert stopped.stats.ended == "event"
        assert stopped.stats.reached == stopped.t[-1] == stopped.events[0].t
        assert np.array_equal(stopped.q[-1], stopped.events[0].q)
        assert np.all(np.diff(stopped.t) > 0)
        assert stopped.events[0].t == noted.events[0].t


@pytest.mark.parametrize("kind", ["lanes", "stages"])
def test_of_a_batch_each_stops_at_its_own_event(kind: str) -> None:
    model = catalog.pendulum()
    dyn = both(model)[kind]
    q = np.array([[0.5], [-0.5], [1.0], [0.0], [2.0]])
    below = Event(lambda t, q, v: float(q[0]), "below", direction=-1)
    grid = np.linspace(0.0, 2.0, 41)
    run = simulate(dyn, q, [0.0], 2.0, "rk853", rtol=1e-10, save=grid, events=below)
    assert {hit.member for hit in run.events} == {0, 1, 2, 4}
    assert run.stats.ended == "event"
    reached = np.array(run.stats.reached)
    for i in range(5):
        assert np.array_equal(np.isnan(run.q[i, :, 0]), grid[: run.q.shape[1]] > reached[i])
    assert reached[3] == 2.0


# What goes wrong


def test_a_state_beyond_all_bounds_is_none() -> None:
    b = mounted("runaway", "x", "x", "prismatic", mass=1.0, axis=(1, 0, 0))
    dyn = dynamics(b.build(), "lagrangian", compile=True)
    # 1e100 m are passed with 1e300 N after a while.
    rows = np.full((2, 1), 1e302)
    run = quiet(dyn, [0.0], [0.0], 2.0, "rk853", save=[0.0, 1e-102, 2.0], torque=rows)
    assert run.stats.ended == "diverged"
    assert "beyond all bounds" in run.stats.message
    assert np.isfinite(run.q).all()
    assert run.stats.reached < 1e-100


@pytest.mark.parametrize("kind", ["lanes", "stages"])
def test_a_run_that_cannot_go_on_keeps_what_it_has(kind: str) -> None:
    model = catalog.pendulum()
    # A torque that no state survives, from half a second on.
    dyn = both(model)[kind]
    grid = np.linspace(0.0, 1.0, 11)
    rows = np.zeros((10, 1))
    rows[5:] = 1e305
    with pytest.warns(MbkitWarning, match="after t = 0.5"):
        run = simulate(dyn, [1.0], [0.0], 1.0, "rk853", save=grid, torque=rows)
    assert run.stats.ended in ("diverged", "step_too_small")
    assert run.stats.reached >= 0.5
    assert np.isfinite(run.q).all()
    assert len(run.t) == 6
    calm = simulate(dyn, [1.0], [0.0], 0.5, "rk853", save=grid[:6])
    assert np.abs(run.q - calm.q).max() < 1e-9
    # Beside it the others go on.
    many = np.zeros((3, 10, 1))
    many[1] = rows
    batch = quiet(dyn, np.ones((3, 1)), [0.0], 1.0, "rk853", save=grid, torque=many)
    assert np.isfinite(batch.q[[0, 2]]).all()
    assert np.array_equal(np.isnan(batch.q[1, :, 0]), grid > 0.55)
    assert batch.stats.reached[0] == batch.stats.reached[2] == 1.0


def test_interruptions_and_progress_get_through() -> None:
    model, q, v = CASES["double_pendulum"]

    def stop(done: float) -> None:
        raise KeyboardInterrupt

    for dyn in both(model).values():
        with pytest.raises(KeyboardInterrupt):
            simulate(dyn, q, v, 1e5, "rk853", progress=stop)
        told: list[float] = []
        simulate(dyn, q, v, 1.0, "rk853", progress=told.append)
        assert told[-1] == 1.0


@pytest.mark.parametrize("engine", ["pinocchio", "lagrangian"])
@pytest.mark.parametrize("speed", [1e12, 1e20, 1e60])
def test_a_first_step_below_rounding_is_told(engine: str, speed: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        run = mb.simulate(mb.dynamics(mb.catalog.pendulum(), engine), [1.0], [speed], 0.01, "rk853")
    assert run.t[-1] == run.stats.reached
    assert (run.t[-1] == 0.01) if run.stats.ended == "finished" else run.stats.message


def test_evaluations_are_those_of_all_attempts() -> None:
    model, q, v = catalog.double_pendulum(), [2.0, 1.0], [3.0, -2.0]
    for kind, dyn in both(model).items():
        run = simulate(dyn, q, v, 2.0, "rk853", rtol=1e-10)
        attempts, stages = run.stats.steps + run.stats.rejected, dormand_prince_853().stages
        # The first stage of the next step is where the last one ended, which Python keeps, and machine code computes.
        assert (stages - 1) * attempts <= run.stats.evaluations <= stages * attempts + 4, kind
