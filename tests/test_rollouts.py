# Torques have the signature they are called with.
"""Whole steps as one function, and rollouts compiled from them: the stepwise runs once more, only faster."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from mbkit import catalog
from mbkit.codegen import compiled_calls
from mbkit.codegen.backend import Machine
from mbkit.derivation import Equations
from mbkit.derivation.steps import fixed
from mbkit.derivation.steps.collocation import Collocation
from mbkit.derivation.steps.fixed import march, march_in_stages, velocity_changes
from mbkit.engines import dynamics
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import MbkitWarning
from mbkit.methods.registry import method_of
from mbkit.methods.tableaus import ImplicitTableau
from mbkit.model import Model, ModelBuilder
from mbkit.model.integration_space import Space
from mbkit.simulate import RK4, Trajectory, simulate
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.progress import Progress
from mbkit.simulate.solvers import compiled_fixed_step
from mbkit.simulate.solvers import machine_code_blocks as blocks
from mbkit.simulate.solvers.implicit_midpoint import midpoint_of
from mbkit.simulate.time_grid import Grid
from mbkit.simulate.torque import Torque
from tests.random_trees import ALL, random_tree
from tests.scenes import mounted, slider

EPS = np.finfo(float).eps
FIXED = ("rk4", "semi_implicit_euler")


def tumbling() -> Model:
    """A free body with a ball joint and a hinge on it."""
    b = ModelBuilder("tumbling")
    b.add_body("body", mass=2.0, com=(0.1, -0.2, 0.05), inertia=(0.3, 0.4, 0.6))
    b.add_joint("float", "free", parent="world", child="body", translation=(0, 0, 1), rpy=(0.3, -0.2, 1.0))
    b.add_body("arm", mass=0.7, com=(0.2, 0.1, 0.0), inertia=(0.02, 0.03, 0.04))
    b.add_joint("shoulder", "ball", parent="body", child="arm", translation=(0.3, 0.0, 0.1))
    b.add_body("hand", mass=0.3, com=(0.1, 0.0, 0.1), inertia=(0.01, 0.01, 0.01))
    b.add_joint("elbow", "revolute", parent="arm", child="hand", translation=(0.4, 0.0, 0.0), axis=(0, 1, 0))
    return b.build()


def unstable() -> Model:
    """Two masses on springs, one of them far too stiff for the steps taken."""
    b = ModelBuilder("unstable")
    for name, stiffness in (("x", 1e9), ("y", 1.0)):
        b.add_body(name, mass=1.0)
        b.add_joint(name, "prismatic", parent="world", child=name, axis=(1, 0, 0), stiffness=stiffness)
    return b.build()


@pytest.fixture(scope="module")
def floating() -> LagrangianDynamics:
    return dynamics(tumbling(), "lagrangian", compile=True)


@pytest.fixture(scope="module")
def planar() -> LagrangianDynamics:
    return dynamics(catalog.double_pendulum(), "lagrangian", compile=True)


@pytest.fixture
def in_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fixed, "_MAX_OPERATIONS_IN_ONE_PIECE", 0)
    monkeypatch.setattr(
        LagrangianDynamics,
        "_step_plan",
        lambda dyn, method, **how: compiled_calls.Plan(dyn.equations, method, dyn._part, **how),
    )


def start(dyn: LagrangianDynamics, n: int | None = None, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    q, v = dyn.model.random_state(np.random.default_rng(seed), n)
    return q, 0.5 * v


def stepwise(dyn: LagrangianDynamics, *arguments: Any, **options: Any) -> Trajectory:
    """The same run with the interpreted forward dynamics, stage by stage."""
    return simulate(dynamics(dyn.model, "lagrangian", compile=False), *arguments, **options)


def assert_same(run: Trajectory, other: Trajectory, tolerance: float = 1e-12) -> None:
    assert np.array_equal(run.t, other.t)
    assert run.q.shape == other.q.shape
    scale = np.maximum(1.0, np.abs(other.v))
    assert np.abs(run.q - other.q).max(initial=0.0) < tolerance
    assert (np.abs(run.v - other.v) / scale).max(initial=0.0) < tolerance
    for name in ("steps", "evaluations", "ended", "reached", "message"):
        assert getattr(run.stats, name) == getattr(other.stats, name)


# The step as a function


def step(equations: Equations, method: str) -> ca.Function:
    """The function (q, v, tau, dt) -> (q1, v1)."""
    before, behind = velocity_changes(equations)
    sizes = {"q": equations.model.nq, "v": equations.model.nv, "tau": equations.model.nv, "dt": 1}
    given = {name: ca.SX.sym(name, n) for name, n in sizes.items()}
    held = {**given, "w": given["v"], "squares": ca.SX(0)}
    for part in (*before, *march(equations, method), *behind):
        held |= zip(part.writes, part.make().call([held[name] for name in part.reads]), strict=True)
    ends = held["q1"], held.get("v1", held["w1"])
    return ca.Function("step", list(given.values()), ends, list(given), ["q1", "v1"])


def one_step(model: Model, method: str, q: np.ndarray, v: np.ndarray, tau: np.ndarray, h: float) -> Trajectory:
    return simulate(dynamics(model, "lagrangian", compile=False), q, v, h, method, dt=h, torque=tau, save=[h])


@pytest.mark.thorough("0-rk4", "1-rk4", "3-rk4", "4-rk4")
@pytest.mark.parametrize("method", FIXED)
@pytest.mark.parametrize("seed", range(6))
def test_a_step_is_the_stepwise_one_on_random_trees(seed: int, method: str) -> None:
    model = random_tree(seed, n=4, kinds=tuple(np.roll(ALL, 3 * seed)[:4]), mimic=bool(seed % 2))
    rng = np.random.default_rng(seed)
    q, v = model.random_state(rng, 3)
    tau, h = rng.standard_normal((3, model.nv)), 0.05
    run = [one_step(model, method, *row, h) for row in zip(q, v, tau, strict=True)]
    made = Machine(step(Equations(model), method))(q, v, tau, np.full((3, 1), h))
    for got, wanted in zip(made, ([r.q[0] for r in run], [r.v[0] for r in run]), strict=True):
        # One step of 0.05 s multiplies rounding by the condition of M, which is below 1e3 for these trees.
        assert np.abs(got[..., 0] - wanted).max() < 1e4 * EPS * max(1.0, np.abs(wanted).max())
    model.check_q(made[0][..., 0])


@pytest.mark.parametrize("method", FIXED)
def test_a_step_in_parts_is_the_whole_one(method: str) -> None:
    for model in (tumbling(), random_tree(1, n=3, kinds=("revolute", "planar", "universal"))):
        equations, space = Equations(model), Space(model)
        q, v = model.random_state(np.random.default_rng(0), 3)
        given = {"q": q, "w": space.to_integrator_velocity(q, v), "tau": np.ones_like(v)}
        ends = []
        for parts in (march(equations, method), march_in_stages(equations, method)):
            held = {**given, "dt": np.full((3, 1), 0.01), "squares": np.full((3, 1), 7.0)}
            for part in parts:
                made = Machine(part.make())(*(held[name] for name in part.reads))
                held.update((name, x[..., 0]) for name, x in zip(part.writes, made, strict=True))
            ends.append(held)
        whole, cut = ends
        for name in ("q1", "w1", "squares1"):
            assert np.abs(whole[name] - cut[name]).max() < 1e3 * EPS * np.abs(whole[name]).max()
        squares = 7.0 + (whole["q1"] ** 2).sum(-1) + (whole["w1"] ** 2).sum(-1)
        assert whole["squares1"][:, 0] == pytest.approx(squares, rel=1e-14)
        q1, v1 = Machine(step(equations, method))(q, v, given["tau"], np.full((3, 1), 0.01))
        assert np.abs(q1[..., 0] - whole["q1"]).max() < 1e3 * EPS
        assert (
            np.abs(v1[..., 0] - space.to_body_velocity(whole["q1"], whole["w1"])).max() < 1e3 * EPS * np.abs(v1).max()
        )


def test_kuttas_method_has_the_weights_of_its_tableau() -> None:
    """On v̇ = τ with one mass, a stage's weights show in the step of a force that is linear in v."""
    b = slider("damped", damping=1.0)
    h = 0.3
    _, v1 = Machine(step(Equations(b.build()), "rk4"))(np.zeros(1), np.ones(1), np.zeros(1), np.array([h]))
    z = h * -1.0
    stability = 1 + sum(z ** (k + 1) * RK4.b @ np.linalg.matrix_power(RK4.A, k) @ np.ones(4) for k in range(4))
    assert v1[0, 0] == pytest.approx(stability, abs=4 * EPS)


def test_a_step_can_be_differentiated_at_rest() -> None:
    """The exponential's root has no derivative at zero; optimal control starts there."""
    model = tumbling()
    for method in FIXED:
        f = step(Equations(model), method)
        arguments = [ca.SX.sym(f.name_in(i), f.size1_in(i)) for i in range(4)]
        jacobian = ca.Function("J", arguments, [ca.jacobian(ca.vertcat(*f(*arguments)), ca.vertcat(*arguments[:3]))])
        q, v, h = model.neutral(), np.zeros(model.nv), 1e-3
        J = np.array(jacobian(q, v, np.zeros(model.nv), h))
        assert np.isfinite(J).all()
        d = 1e-6 * np.eye(model.nv)[model.nv - 2]
        ends = [np.concatenate([np.array(x)[:, 0] for x in f(q, v + s * d, np.zeros(model.nv), h)]) for s in (1, -1)]
        assert J[:, model.nq + model.nv - 2] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-8)


# Rollouts


@pytest.mark.thorough("floating-rk4", "floating-semi_implicit_euler")
@pytest.mark.parametrize("method", FIXED)
@pytest.mark.parametrize("which", ["floating", "planar"])
def test_rollouts_are_the_stepwise_runs(which: str, method: str, request: pytest.FixtureRequest) -> None:
    dyn = request.getfixturevalue(which)
    for n in (None, 1, 19):
        assert_same(simulate(dyn, *start(dyn, n), 0.2, method), stepwise(dyn, *start(dyn, n), 0.2, method))


@pytest.mark.usefixtures("in_stages")
@pytest.mark.parametrize("method", FIXED)
def test_rollouts_in_stages_are_the_stepwise_runs(method: str, floating: LagrangianDynamics) -> None:
    q, v = start(floating, 11)
    tau = np.random.default_rng(1).standard_normal((11, 50, floating.model.nv))
    run = simulate(floating, q, v, 0.05, method, torque=tau)
    assert_same(run, stepwise(floating, q, v, 0.05, method, torque=tau))
    assert len(floating._step_plan(method).parts) > 1


@pytest.mark.thorough("1", "3", "save7", "save8", "save9")
@pytest.mark.parametrize("save", [None, 1, 2, 3, 17, 50, [0.0], [0.0355], [0.0, 0.001, 0.016, 0.0355], [0.016, 0.017]])
def test_what_is_kept_is_the_same_whatever_else_is(save: Any, floating: LagrangianDynamics) -> None:
    q, v = start(floating, 9)
    tau = np.random.default_rng(1).standard_normal((9, 36, floating.model.nv))
    every = simulate(floating, q, v, 0.0355, torque=tau)
    some = simulate(floating, q, v, 0.0355, torque=tau, save=save)
    index = np.flatnonzero(np.isin(every.t, some.t))
    assert np.array_equal(every.t[index], some.t)
    assert np.array_equal(every.q[:, index], some.q)
    assert np.array_equal(every.v[:, index], some.v)
    assert_same(some, stepwise(floating, q, v, 0.0355, torque=tau, save=save))


def test_runs_of_nothing(planar: LagrangianDynamics) -> None:
    none = simulate(planar, np.empty((0, 2)), np.empty((0, 2)), 0.05)
    assert none.q.shape == none.v.shape == (0, 51, 2)
    assert none.stats.finished
    assert none.stats.reached == ()
    q, v = start(planar, 3)
    still = simulate(planar, q, v, 0.0)
    assert np.array_equal(still.q, q[:, None])
    assert still.stats.steps == 0
    assert still.stats.reached == (0.0, 0.0, 0.0)


def outcome(dyn: LagrangianDynamics, q: np.ndarray, v: np.ndarray, workers: int, steps: int = 40) -> Any:
    grid = Grid.of(0.0, steps * 1e-3, 1e-3)
    tau = Torque(np.linspace(-1, 1, len(q) * steps * dyn.model.nv).reshape(len(q), steps, -1), dyn.model, len(q), steps)
    with Progress(None, "") as bar:
        problem = IntegrationProblem.on_grid(dyn, "rk4", q, v, grid, np.arange(0, steps + 1), tau, bar)
        return compiled_fixed_step.run_rollout(problem, workers)


@pytest.mark.parametrize("n", [1, 7, 8, 9, 65, 300])
def test_no_bit_depends_on_neighbours_or_threads(
    n: int, floating: LagrangianDynamics, monkeypatch: pytest.MonkeyPatch
) -> None:
    q, v = start(floating, n)
    runs = []
    for widest, workers in ((1032, 1), (1032, 2), (72, 1), (72, 3), (8, 5)):
        monkeypatch.setattr(compiled_fixed_step, "_widest", lambda _, most=widest: most)
        runs.append(outcome(floating, q, v, workers))
    for other in runs[1:]:
        assert np.array_equal(other.q, runs[0].q)
        assert np.array_equal(other.v, runs[0].v)
    order = np.random.default_rng(0).permutation(n)
    monkeypatch.setattr(compiled_fixed_step, "_widest", lambda _: 40)
    shuffled = simulate(floating, q[order], v[order], 0.02)
    assert np.array_equal(shuffled.q, simulate(floating, q, v, 0.02).q[order])
    assert np.array_equal(simulate(floating, q[-1], v[-1], 0.02).v, simulate(floating, q, v, 0.02).v[-1])


@pytest.mark.parametrize("n", [1, 11, 300])
def test_a_block_stops_anywhere_for_another_torque(n: int, floating: LagrangianDynamics) -> None:
    (q, v), steps, space = start(floating, n), 75, Space(floating.model)
    stops = [0, 1, 4, 5, 17, 33, 40, 74, steps]
    tau = np.random.default_rng(1).normal(size=(n, len(stops) - 1, floating.model.nv))
    table = np.repeat(tau, np.diff(stops), axis=1)
    run = simulate(floating, q, v, steps * 1e-3, dt=1e-3, torque=table)
    chunk = compiled_fixed_step.Chunk(floating._step_plan("rk4"), space, n, steps, torques=False, all_kept=False)
    chunk.begin(q, space.to_integrator_velocity(q, v), np.empty(0))
    chunk.set_times(Grid.of(0.0, 1.0, 1e-3), 0, steps)
    done = 0
    for i, stop in enumerate(stops[1:]):
        chunk.hold(tau[:, i].T[None])
        for k in (*range(done + chunk.block, stop, chunk.block), stop):
            chunk.run_to(k - done)
            if k - done == chunk.block:
                chunk.again()
                done = k
        assert np.array_equal(chunk.now("q"), run.q[:, stop].T)
        assert np.array_equal(space.to_body_velocity(run.q[:, stop], chunk.now("w").T), run.v[:, stop])


@pytest.mark.parametrize("method", ["gauss4", "implicit_midpoint"])
def test_a_block_of_implicit_steps_stops_anywhere(method: str, planar: LagrangianDynamics) -> None:
    (q, v), steps = start(planar, 3), 40
    tau = np.linspace(-1, 1, 3 * steps).reshape(3, steps, 1) + np.zeros(2)
    run = simulate(planar, q, v, steps * 1e-3, method, dt=1e-3, torque=tau)
    formula = method_of(method).formula
    parts = Collocation(planar.equations, formula) if isinstance(formula, ImplicitTableau) else midpoint_of(planar)
    momenta = np.einsum("nkij,nkj->nki", [planar.mass_matrix(x) for x in run.q], run.v)
    carried = {"q": run.q, "w": run.v, "pi": momenta}
    chunk = blocks.ImplicitChunk(planar, parts, 3, steps, torques=False)
    chunk.begin(q, carried[chunk.carried[1]][:, 0], np.zeros((3, parts.unknowns)), np.empty(0))
    chunk.set_times(Grid.of(0.0, 1.0, 1e-3), 0, steps)
    j = 0
    for k in range(steps):
        if j == chunk.block:
            chunk.again()
            j = 0
        chunk.hold(tau[:, k].T[None])
        j += 1
        chunk.run_to(j)
        for name in chunk.carried:
            np.testing.assert_allclose(chunk.now(name), carried[name][:, k + 1].T, rtol=1e-12, atol=1e-13)


# Runs that go wrong


@pytest.mark.parametrize("method", FIXED)
@pytest.mark.parametrize("save", [None, 7, [0.0, 1.0]])
def test_divergence_is_told_as_the_stepwise_run_tells_it(method: str, save: Any) -> None:
    dyn = dynamics(unstable(), "lagrangian", compile=True)
    q, v = np.zeros((20, 2)), np.zeros((20, 2))
    q[3, 0], q[11, 0], q[:, 1] = 1.0, 1e-30, 0.3
    with pytest.warns(MbkitWarning, match="2 of 20 trajectories diverged"):
        run = simulate(dyn, q, v, 1.0, method, dt=0.01, save=save)
    with pytest.warns(MbkitWarning):
        other = stepwise(dyn, q, v, 1.0, method, dt=0.01, save=save)
    assert run.stats.message == other.stats.message
    assert run.stats.reached == other.stats.reached
    assert run.stats.steps == other.stats.steps
    assert np.array_equal(run.t, other.t)
    assert np.array_equal(np.isnan(run.q), np.isnan(other.q))
    assert run.stats.reached[3] < run.stats.reached[11] < run.stats.reached[0] == 1.0
    good = np.isfinite(other.q)
    assert run.q[good] == pytest.approx(other.q[good], rel=1e-9)

    with pytest.warns(MbkitWarning, match="beyond all bounds"):
        one = simulate(dyn, q[3], v[3], 1.0, method, dt=0.01)
    assert one.stats.ended == "diverged"
    assert one.t[-1] == one.stats.reached == run.stats.reached[3]
    assert np.isfinite(one.q).all()
    assert np.isfinite(one.v).all()


def test_a_state_that_comes_back_from_beyond_all_bounds_is_lost_too() -> None:
    b = slider("mass")
    dyn = dynamics(b.build().without("gravity"), "lagrangian", compile=True)
    tau = np.zeros((2, 30, 1))
    tau[1, 4], tau[1, 5] = 1e105, -1e105
    with pytest.warns(MbkitWarning, match=r"diverged after t = 0.004 s \(step 5\).*1 of 2"):
        run = simulate(dyn, np.zeros((2, 1)), np.zeros((2, 1)), 0.03, torque=tau, save=[0.0, 0.03])
    assert run.stats.reached == (0.03, 0.004)
    assert np.isnan(run.q[1, 1]).all()


def test_a_model_that_cannot_move_says_who_is_to_blame() -> None:
    b = mounted("string", "mass", "plane", "planar", mass=1.0, inertia=(0.1, 0.1, 0.1))
    b.add_spring("string", body_a="world", body_b="mass", stiffness=1.0, rest_length=0.5)
    dyn = dynamics(b.build(), "lagrangian", compile=True)
    with pytest.warns(MbkitWarning, match=r"point spring.*direction.*'string'"):
        run = simulate(dyn, np.zeros(3), np.zeros(3), 0.1)
    assert run.stats.reached == 0.0
    assert run.q.shape == (1, 3)


# Around it


def test_progress_is_told_up_to_the_end(planar: LagrangianDynamics, monkeypatch: pytest.MonkeyPatch) -> None:
    q, v = start(planar, 40)
    monkeypatch.setattr(compiled_fixed_step, "_widest", lambda _: 8)
    monkeypatch.setattr("mbkit.simulate.progress.LOOK_SECONDS", 0.0)
    for threads in (1, 2):
        told: list[float] = []
        dyn = dynamics(planar.model, "lagrangian", compile=True, threads=threads)
        simulate(dyn, q, v, 0.5, progress=told.append)
        assert told[-1] == 1.0
        assert told == sorted(told)


def test_an_error_in_the_callers_function_stops_the_threads(
    planar: LagrangianDynamics, monkeypatch: pytest.MonkeyPatch
) -> None:
    class StopError(Exception):
        pass

    def stop(_: float) -> None:
        raise StopError

    q, v = start(planar, 40)
    monkeypatch.setattr(compiled_fixed_step, "_widest", lambda _: 8)
    monkeypatch.setattr("mbkit.simulate.progress.LOOK_SECONDS", 0.0)
    for threads in (1, 2):
        dyn = dynamics(planar.model, "lagrangian", compile=True, threads=threads)
        with pytest.raises(StopError):
            simulate(dyn, q, v, 1e3, save=[0.0], progress=stop)


def test_a_body_without_forces_keeps_its_velocity_to_the_bit() -> None:
    dyn = dynamics(catalog.free_body().without("gravity"), "lagrangian", compile=True)
    q, v = dyn.model.random_state(np.random.default_rng(0), 4)
    run = simulate(dyn, q, v, 0.5)
    world = Space(dyn.model).to_integrator_velocity(run.q.reshape(-1, 7), run.v.reshape(-1, 6))[:, :3].reshape(4, -1, 3)
    assert np.abs(world - world[:, :1]).max() < 32 * EPS * np.abs(world).max()
