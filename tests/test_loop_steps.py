"""Compiled steps under constraints: one iteration of the projection or three, factors, adaptive attempts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import mbkit as mb
from mbkit.derivation.steps.onto_constraints import quick_projection
from mbkit.engines import constraint_manifold
from mbkit.engines.lagrangian import LagrangianDynamics
from tests.test_loop_dynamics import closed_tree

FAST = np.array([10.0, 0.0, 0.0])


def plans(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Return the list of plans that are asked for: whether each is the thorough one."""
    asked: list[bool] = []
    plan = LagrangianDynamics._step_plan

    def step_plan(self: LagrangianDynamics, method: str, *, thorough: bool = False, **how: bool) -> object:
        asked.append(thorough)
        return plan(self, method, thorough=thorough, **how)

    monkeypatch.setattr(LagrangianDynamics, "_step_plan", step_plan)
    return asked


@pytest.mark.thorough("0.001-False", "0.004-False")
@pytest.mark.parametrize(("dt", "thorough"), [(1e-3, False), (4e-3, False), (1.6e-2, True), (3.2e-2, True)])
def test_long_steps_are_taken_again_with_three_iterations(
    dt: float, thorough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = mb.catalog.four_bar()
    dyn, asked = mb.dynamics(model, "lagrangian", compile=True), plans(monkeypatch)
    q, v = dyn.project([0.5, -0.3, 1.2], FAST)
    run = mb.simulate(dyn, q, v, 0.32, "rk4", dt=dt, doubt=False)
    assert run.stats.finished
    assert asked == ([False, True] if thorough else [False])
    # Steps one by one: nothing projects their ends but they themselves.
    tau = np.zeros(3)
    for _ in range(10):
        q, v = dyn.step(q, v, tau, dt)
        assert np.abs(dyn.constraint_residual(q)).max() < 2e-15
        assert np.abs(dyn.constraint_rate(q, v)).max() < 1e-14 * np.abs(v).max()


def test_one_iteration_says_what_it_leaves() -> None:
    """Beside closed states, by factors of a pose that is near: at rounding, or told to be too far."""
    model = mb.catalog.four_bar()
    dyn, rng = mb.dynamics(model, "lagrangian"), np.random.default_rng(0)
    project, near_enough = quick_projection(dyn.equations), 0
    for size in (1e-14, 1e-12, 1e-10, 1e-8, 1e-6):
        for apart in (1e-9, 1e-6, 1e-3):
            q, v = dyn.project(*model.random_state(rng))
            away, beside = size * rng.standard_normal(3), apart * rng.standard_normal(3)
            q1, v1, far = project(q + away, v + away, q + beside)
            near_enough += not far
            if not far:
                assert np.abs(dyn.constraint_residual(np.array(q1)[:, 0])).max() < 2e-15
                assert np.abs(dyn.constraint_rate(*(np.array(x)[:, 0] for x in (q1, v1)))).max() < 1e-14
    assert 5 <= near_enough <= 10


def test_a_batch_takes_only_lost_members_again(monkeypatch: pytest.MonkeyPatch) -> None:
    model = mb.catalog.four_bar()
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    asked = plans(monkeypatch)
    q, fast = dyn.project([0.5, -0.3, 1.2], FAST)
    starts = np.tile(q, (9, 1)), np.linspace(0.05, 1.0, 9)[:, None] * fast
    run = mb.simulate(dyn, *starts, 0.32, "rk4", dt=8e-3, doubt=False)
    assert asked == [False, True]
    for k in (0, 4, 8):
        one = mb.simulate(dyn, q, starts[1][k], 0.32, "rk4", dt=8e-3, doubt=False)
        assert np.array_equal(one.q, run.q[k])


def light_cart(mass: float) -> mb.Model:
    """Return a cart below a pole whose tip a rod holds: at an upright pole the pole's mass leaves the cart alone."""
    b = mb.ModelBuilder("light_cart")
    b.add_body("cart", mass=mass)
    b.add_joint("x", "prismatic", parent="world", child="cart", axis=(1, 0, 0))
    b.add_body("pole", mass=1.0, com=(0, 0, 1.0))
    b.add_joint("theta", "revolute", parent="cart", child="pole", axis=(0, 1, 0))
    ends = {"translation_a": (0, 0, 2.0), "translation_b": (1.0, 0, 1.5)}
    b.add_loop("rod", "distance", body_a="pole", body_b="world", length=float(np.sqrt(1.25)), **ends)
    return b.build()


def test_factors_of_the_mass_matrix_keep_all_digits_of_light_links_in_loops() -> None:
    """A Stewart platform's Euler angles lock; a rod holds a cart of a billionth of its pole's mass."""
    for model in (mb.catalog.stewart_platform(), mb.catalog.delta_robot(), light_cart(1e-9), light_cart(1.0)):
        dyn = mb.dynamics(model, "lagrangian", compile=False)
        assert not dyn.equations.constraint_factors.careful
        oracle = mb.dynamics(dyn.model, "oracle")
        q, v = dyn.model.random_state(np.random.default_rng(1), 4)
        tau = np.random.default_rng(2).standard_normal(v.shape)
        exact = np.asarray(oracle.forward_dynamics(q, v, tau), dtype=float)
        error = np.linalg.norm(dyn.forward_dynamics(q, v, tau) - exact, axis=1) / np.linalg.norm(exact, axis=1)
        # Without the refinement the delta robot's are above 1e-13.
        assert error.max() < 5e-14


@pytest.mark.thorough("0.0001", "1e-12")
@pytest.mark.parametrize("rtol", [1e-4, 1e-8, 1e-12])
def test_rk853_takes_the_same_steps_in_machine_code(rtol: float) -> None:
    model = mb.catalog.four_bar()
    runs = []
    for compiled in (True, False):
        dyn = mb.dynamics(model, "lagrangian", compile=compiled)
        q, v = dyn.project([0.5, -0.3, 1.2], FAST)
        runs.append(mb.simulate(dyn, q, v, 1.0, "rk853", rtol=rtol, atol=rtol, doubt=False))
    assert runs[0].stats.steps == pytest.approx(runs[1].stats.steps, abs=2)
    assert np.abs(runs[0].q[-1] - runs[1].q[-1]).max() < max(20 * rtol, 1e-11)
    assert np.abs(dyn.constraint_residual(runs[0].q)).max() < 1e-14
    batch = mb.simulate(
        mb.dynamics(model, "lagrangian", compile=True),
        np.tile(q, (6, 1)),
        np.linspace(0.5, 1.0, 6)[:, None] * v,
        1.0,
        "rk853",
        rtol=rtol,
        atol=rtol,
        save=[0.0, 1.0],
        doubt=False,
    )
    assert np.abs(dyn.constraint_residual(batch.q.reshape(-1, 3))).max() < 1e-14
    assert np.abs(batch.q[-1, -1] - runs[0].q[-1]).max() < max(20 * rtol, 1e-11)


def test_compiled_attempts_give_way_near_a_singular_pose() -> None:
    """Equal rods lie flat once a turn: the run passes there with projected stages, as from Python, and tells it."""
    model = mb.catalog.four_bars(n=1)
    runs = []
    for compiled in (True, False):
        dyn = mb.dynamics(model, "lagrangian", compile=compiled)
        q, v = dyn.project([1.0, -1.0, 1.0], [2.0, -2.0, 2.0])
        with pytest.warns(mb.errors.DoubtfulRunWarning, match="singular pose"):
            runs.append(mb.simulate(dyn, q, v, 1.0, "rk853", rtol=1e-9, atol=1e-9))
    assert np.array_equal(*(run.t for run in runs)) or runs[0].stats.steps == pytest.approx(runs[1].stats.steps, abs=3)
    assert np.abs(runs[0].q[-1] - runs[1].q[-1]).max() < 1e-6


def test_reproducible_is_judged_once_for_all_times(monkeypatch: pytest.MonkeyPatch) -> None:
    model, q = closed_tree(1, "point", drive=True)
    dyn = mb.dynamics(model, "lagrangian", compile=False)
    start, asked = dyn.project(q, np.zeros(model.nv)), []
    judge = constraint_manifold.require_independent

    def counted(*arguments: object, **options: object) -> None:
        asked.append(1)
        judge(*arguments, **options)  # type: ignore[arg-type]  # handed on

    monkeypatch.setattr(constraint_manifold, "require_independent", counted)
    mb.simulate(dyn, *start, 0.02, "rk4", dt=1e-3)
    assert len(asked) <= 3


def stiff_four_bar() -> mb.Model:
    """Return the four-bar with a damper at the rocker that brings it to rest within nanoseconds."""
    model = mb.catalog.four_bar()
    joints = [replace(j, damping=(1e8,)) if j.name == "psi" else j for j in model.joints]
    return replace(model, joints=tuple(joints))


MODELS = {
    "stiff four-bar": stiff_four_bar,
    **{name: getattr(mb.catalog, name) for name in ("four_bar", "flyball_governor", "bricard", "rolling_disc")},
    "links without mass": lambda: mb.catalog.slider_crank(crank_mass=0.0, rod_mass=0.0),
}


@pytest.mark.thorough(
    "stiff four-bar-rodas5", "flyball_governor-rodas5", "bricard-rodas5", "rolling_disc-rodas5", "rolling_disc-auto"
)
@pytest.mark.parametrize(
    ("name", "method"), [*((name, "rodas5") for name in MODELS), ("stiff four-bar", "auto"), ("rolling_disc", "auto")]
)
def test_stiff_methods_take_the_same_steps_in_machine_code(name: str, method: str) -> None:
    model = MODELS[name]()
    q, v = mb.dynamics(model, "lagrangian").project(*model.random_state(np.random.default_rng(3)))
    runs = []
    for compiled in (True, False):
        dyn = mb.dynamics(model, "lagrangian", compile=compiled)
        runs.append(mb.simulate(dyn, q, 0.3 * v, 0.15, method, rtol=1e-8, doubt=False))
        assert runs[-1].stats.finished
        assert np.abs(dyn.constraint_residual(runs[-1].q)).max() < 2e-14
        # Attempts in machine code are kept with the equations.
        assert ("lanes" in dyn.equations.kept) is compiled
    # Their checks cost other shares of a run, so that `auto` may turn to rodas5 at another step.
    assert runs[0].stats.steps == pytest.approx(runs[1].stats.steps, abs=1 if method == "rodas5" else 64)
    assert np.abs(runs[0].q[-1] - runs[1].q[-1]).max() < 1e-7 * max(1.0, np.abs(q).max())
    if name == "stiff four-bar" and method == "auto":
        assert all("rodas5" in run.stats.chosen for run in runs)


@pytest.mark.thorough
@pytest.mark.parametrize(("seed", "kind"), [(1, "revolute"), (2, "distance")])
def test_rodas5_keeps_its_tolerance_on_random_loops(seed: int, kind: str) -> None:
    """Of random trees with free and ball joints; the linear system of a stage has all their derivatives."""
    model, q = closed_tree(seed, kind)
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    q, v = dyn.project(q, 0.2 * np.random.default_rng(seed).standard_normal(model.nv))
    exact = mb.simulate(dyn, q, v, 0.05, "rk853", rtol=1e-12, doubt=False).q[-1]
    errors, steps = [], []
    for rtol in (1e-5, 1e-10):
        run = mb.simulate(dyn, q, v, 0.05, "rodas5", rtol=rtol, atol=rtol, doubt=False)
        errors.append(float(np.abs(run.q[-1] - exact).max()))
        steps.append(run.stats.steps)
    assert "lanes" in dyn.equations.kept
    assert errors[1] < 1e-8
    # Of order five at least: a wrong derivative would leave a method of order one or two, with thousands of steps.
    assert steps[1] < 12 * max(steps[0], 4)


def test_rodas5_in_machine_code_gives_way_near_a_singular_pose() -> None:
    model = mb.catalog.four_bars(n=1)
    for method in ("rodas5", "auto"):
        runs = []
        for compiled in (True, False):
            dyn = mb.dynamics(model, "lagrangian", compile=compiled)
            q, v = dyn.project([1.0, -1.0, 1.0], [2.0, -2.0, 2.0])
            with pytest.warns(mb.errors.DoubtfulRunWarning, match="singular pose"):
                runs.append(mb.simulate(dyn, q, v, 1.0, method, rtol=1e-9, atol=1e-9))
        # Near the pose machine code hands over a few steps before those that Python alone would choose otherwise.
        assert runs[0].stats.steps == pytest.approx(runs[1].stats.steps, rel=0.2)
        assert np.abs(runs[0].q[-1] - runs[1].q[-1]).max() < 1e-6
