"""Wrenches on frames in runs and steps: closed forms, all engines and methods, their work, bad input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines import Dynamics
from mbkit.errors import InputError, TorqueError, UnknownNameError, UnsupportedError
from mbkit.lagrangian import systems
from mbkit.model import Model
from tests.random_trees import random_tree
from tests.scenes import METHODS, mounted

EPS = np.finfo(float).eps
ENGINES = ("lagrangian", "pinocchio", "mujoco", "drake")
AXES = ("local", "local_world_aligned", "world")
WRENCH = np.array([3.0, -1.0, 2.0, 0.4, 0.3, -0.2])


def brick(gravity: Any = (0, 0, 0)) -> Model:
    b = mounted("brick", "brick", "float", "free", gravity=gravity, mass=2.0, inertia=(0.1, 0.2, 0.3))
    b.add_frame("corner", body="brick", translation=(0.3, 0.0, 0.1), rpy=(0.2, -0.3, 0.5))
    return b.build()


def arm() -> Model:
    """A chain without quaternions, whose integrators' velocity is v."""
    return random_tree(3, n=4, kinds=("revolute", "prismatic", "revolute", "universal"))


def tip(model: Model) -> str:
    return model.bodies[-1].name


@pytest.fixture(scope="module")
def own() -> Dynamics:
    return mb.dynamics(arm(), "lagrangian")


@pytest.fixture(scope="module")
def start(own: Dynamics) -> tuple[np.ndarray, np.ndarray]:
    return own.model.random_state(np.random.default_rng(1), 3)


def close(run: Any, other: Any, digits: float = 1e-9) -> None:
    """The last states are those of the other run."""
    for x, y in ((run.q, other.q), (run.v, other.v)):
        np.testing.assert_allclose(x[..., -1, :], y[..., -1, :], rtol=0, atol=digits * max(np.abs(y).max(), 1))


# Closed forms


def test_a_constant_force_makes_a_parabola_and_a_constant_moment_a_spin() -> None:
    # The force acts at the centre of mass in the world's axes, the moment about a principal axis.
    model = brick(gravity=(0, 0, -9.81))
    wrench = np.array([3.0, -1.0, 2.0, 0.0, 0.0, 0.6])
    v0 = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    run = mb.simulate(
        mb.dynamics(model, "lagrangian"),
        *(model.neutral(), v0, 1.0),
        dt=0.01,
        wrenches={"brick": wrench},
        wrench_axes="local_world_aligned",
    )
    t = run.t[:, None]
    force = wrench[:3] / 2.0 + model.gravity
    steps = len(run.t) * EPS
    np.testing.assert_allclose(run.q[:, :3], v0[:3] * t + force * t**2 / 2, rtol=0, atol=10 * steps)
    half = 0.6 / 0.3 * run.t**2 / 4
    np.testing.assert_allclose(run.q[:, 5:], np.column_stack([np.sin(half), np.cos(half)]), rtol=0, atol=10 * steps)
    np.testing.assert_allclose(run.v[:, 5], 2.0 * run.t, rtol=0, atol=10 * steps)
    # A force in the world's axes does the work F Δp, and the moment n Δθ.
    np.testing.assert_allclose(run.work(), run.q[:, :3] @ wrench[:3] + 0.6 * 2 * half, rtol=0, atol=1e-8)


def test_what_is_held_is_the_wrench_and_not_its_generalized_force() -> None:
    # A force tangential to a pendulum's rod stays so as it turns: θ̈ = F / (m l) without gravity.
    b = mounted("spoke", "rod", "hinge", "revolute", gravity=(0, 0, 0), mass=2.0, com=(0.5, 0, 0), axis=(0, 0, 1))
    b.add_frame("end", body="rod", translation=(0.5, 0, 0))
    dyn = mb.dynamics(b.build(), "lagrangian")
    for method in ("rk4", "rk853"):
        grid = {"dt": 2.0} if METHODS[method].kind == "fixed" else {"save": [2.0]}
        run = mb.simulate(
            dyn, [0.0], [0.0], 2.0, method, wrenches={"end": [0, 3.0, 0, 0, 0, 0]}, wrench_axes="local", **grid
        )  # type: ignore[arg-type]
        assert run.q[-1, 0] == pytest.approx(3.0 / (2.0 * 0.5) * 2.0**2 / 2, abs=100 * EPS)
    # In the world's axes the force stands still: its energy is F Δy, for which a long step must see the turn.
    run = mb.simulate(
        *(dyn, [0.0], [0.0], 1.0),
        dt=0.01,
        wrenches={"end": [0, 3.0, 0, 0, 0, 0]},
        wrench_axes="local_world_aligned",
    )
    assert run.energy()[-1] == pytest.approx(3.0 * 0.5 * np.sin(run.q[-1, 0]), abs=1e-8)


# Engines and methods


@pytest.fixture(scope="module")
def exact() -> Any:
    model = brick()
    oracle = mb.dynamics(model, "oracle")
    run = mb.simulate(
        *(oracle, model.neutral(), WRENCH, 0.5, "taylor"), rtol=1e-25, save=[0.5], wrenches={"corner": WRENCH}
    )
    return model, run


#: Of the motion below, with a step of 5 ms or a tolerance of 1e-9.
ERRORS = {
    "semi_implicit_euler": 0.05,
    "moreau": 0.05,
    "implicit_midpoint": 1e-3,
    "rk4": 1e-8,
    "gauss4": 1e-8,
    "bdf": 1e-5,
}


@pytest.mark.thorough("implicit_midpoint", "gauss4", "gauss6", "rk853", "rodas5")
@pytest.mark.parametrize("method", [m.name for m in METHODS.values() if not m.engines or "lagrangian" in m.engines])
def test_every_method_meets_34_digits(exact: Any, method: str) -> None:
    model, reference = exact
    setting: dict[str, Any] = {"dt": 5e-3} if METHODS[method].kind == "fixed" else {"rtol": 1e-9, "save": [0.0, 0.5]}
    dyn = mb.dynamics(model, "lagrangian", compile=METHODS[method].kind == "fixed" or method in ("rk853", "rodas5"))
    run = mb.simulate(dyn, model.neutral(), WRENCH, 0.5, method, wrenches={"corner": WRENCH}, **setting)
    close(run, reference, ERRORS.get(method, 1e-7))


@pytest.mark.thorough("rodas5")
@pytest.mark.parametrize("method", ["rk4", "semi_implicit_euler", "rk853", "rodas5", "implicit_midpoint"])
def test_machine_code_is_the_general_way(method: str, own: Dynamics, start: Any) -> None:
    interpreted = mb.dynamics(own.model, "lagrangian", compile=False)
    rng = np.random.default_rng(0)
    setting: dict[str, Any] = {"dt": 0.01}
    if METHODS[method].kind == "adaptive":
        setting = {"rtol": 1e-12, "save": np.linspace(0, 0.05, 6)}
    for wrench in (rng.standard_normal((3, 6)), rng.standard_normal((3, 5, 6))):
        runs = [
            mb.simulate(dyn, *start, 0.05, method, wrenches={tip(own.model): wrench}, wrench_axes="world", **setting)
            for dyn in (own, interpreted)
        ]
        close(*runs, digits=1e-10)


def test_engines_own_integrators_refuse_by_name() -> None:
    model = brick()
    for method in METHODS.values():
        if not method.wrenches:
            setting: dict[str, Any] = {"dt": 0.01} if method.kind == "native" else {"save": [0.1]}
            dyn = mb.dynamics(model, method.engines[0])
            with pytest.raises(UnsupportedError, match=f"{method.name}: wrenches on frames"):
                mb.simulate(
                    *(dyn, model.neutral(), np.zeros(6), 0.1, method.name), wrenches={"brick": WRENCH}, **setting
                )


# Forms of the argument


def test_a_batch_is_its_trajectories(own: Dynamics, start: Any) -> None:
    rng, frame = np.random.default_rng(2), tip(own.model)
    each, held, torque = rng.standard_normal((3, 6)), rng.standard_normal((3, 4, 6)), rng.standard_normal((4, 5))
    for wrench in (each, held):
        batch = mb.simulate(own, *start, 0.04, dt=0.01, wrenches={frame: wrench}, torque=torque)
        work = batch.work()
        for i in range(3):
            one = mb.simulate(own, start[0][i], start[1][i], 0.04, dt=0.01, wrenches={frame: wrench[i]}, torque=torque)
            np.testing.assert_array_equal(one.q, batch.q[i])
            np.testing.assert_allclose(one.work(), work[i], rtol=0, atol=1e-12 * np.abs(work).max())
    # One wrench a trajectory is held as the same one for each step.
    tiled = np.repeat(each[:, None], 4, axis=1)
    runs = [mb.simulate(own, *start, 0.04, dt=0.01, wrenches={frame: w}) for w in (each, tiled)]
    np.testing.assert_array_equal(runs[0].q, runs[1].q)


def test_named_parameters_may_differ_beside_wrenches() -> None:
    model = mb.catalog.pendulum(mass=mb.Parameter("m"), length=0.7)
    dyn = mb.dynamics(model, "lagrangian").at(m=[1.0, 2.0, 3.0])
    push = {"tip": [0.5, 0, 0.5, 0, 0, 0]}
    run = mb.simulate(dyn, [0.3], [0.0], 0.1, dt=0.01, wrenches=push)
    stepped = dyn.step([0.3], [0.0], [0.0], 0.01, wrenches=push)
    np.testing.assert_array_equal(stepped[0], run.q[:, 1])
    for i, m in enumerate((1.0, 2.0, 3.0)):
        one = mb.simulate(mb.dynamics(model.with_parameters(m=m)), [0.3], [0.0], 0.1, dt=0.01, wrenches=push)
        np.testing.assert_allclose(run.q[i], one.q, rtol=0, atol=64 * EPS)


@pytest.mark.parametrize("method", ["rk4", "semi_implicit_euler"])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_step_is_a_run_of_one_step(engine: str, method: str, start: Any, own: Dynamics) -> None:
    dyn, tau = mb.dynamics(own.model, engine), np.arange(5.0)
    q, v, frame = start[0], start[1], tip(own.model)
    run = mb.simulate(dyn, q, v, 0.01, method, 0.01, torque=tau, wrenches={frame: WRENCH}, wrench_axes="world")
    stepped = dyn.step(q, v, tau, 0.01, method, wrenches={frame: WRENCH}, axes="world")
    np.testing.assert_array_equal(np.hstack(stepped), np.hstack([run.q[:, -1], run.v[:, -1]]))
    assert not np.array_equal(dyn.step(q, v, tau, 0.01, method)[1], stepped[1])


# Work


@pytest.mark.thorough("local_world_aligned", "world")
@pytest.mark.parametrize("axes", AXES)
def test_the_work_of_wrenches_is_the_change_of_the_energy(axes: str) -> None:
    # On a body with a free joint, with dampers and springs beside it; of fourth order in the step.
    model = random_tree(5, n=4, kinds=("free", "revolute", "ball", "prismatic"), damping=True, springs=True)
    dyn, (q, v) = mb.dynamics(model, "pinocchio"), model.random_state(np.random.default_rng(3))
    names = [model.bodies[0].name, tip(model)]
    rows = np.repeat(np.random.default_rng(4).standard_normal((5, 6)), 2, axis=0)
    off = []
    for count in (1, 4):
        wrenches = {names[0]: WRENCH, names[1]: np.repeat(rows, count, axis=0)}
        run = mb.simulate(dyn, q, v, 0.1, dt=0.01 / count, wrenches=wrenches, wrench_axes=axes)
        off.append(np.abs(run.power_balance()).max())
        assert np.abs(run.work()).max() > 1e-2
    assert off[1] < off[0] / 4**3
    assert off[1] < 1e-6 * np.abs(run.energy()).max()


def test_functions_stand_beside_samples() -> None:
    model = arm()
    q, v = model.random_state(np.random.default_rng(0))
    rows = np.random.default_rng(1).standard_normal((5, 6))

    def torque(_t: float, _q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return -v

    runs = [
        mb.simulate(mb.dynamics(model, engine), q, v, 0.05, dt=0.01, torque=torque, wrenches={tip(model): rows})
        for engine in ENGINES
    ]
    for run in runs:
        close(run, runs[0])
        np.testing.assert_array_equal(run.wrenches()[tip(model)], rows[[0, 1, 2, 3, 4, 4]])
        np.testing.assert_array_equal(run.tau, -run.v)


# Bad input


BAD: list[tuple[Any, type[Exception], str]] = [
    ({"wrenches": {"bric": WRENCH}}, UnknownNameError, "brick"),
    ({"wrenches": [WRENCH]}, InputError, "wrenches: expected a dict"),
    ({"wrenches": {"brick": WRENCH[:5]}}, InputError, r"wrench on 'brick': expected shape .*, got \(5,\)"),
    ({"wrenches": {"brick": np.zeros((9, 6))}}, InputError, r"got \(9, 6\).* the run has 10 steps"),
    ({"wrenches": {"brick": [WRENCH, WRENCH[:3]]}}, InputError, "rows of different lengths"),
    ({"wrenches": {"brick": WRENCH * np.nan}}, InputError, "wrench on 'brick': nan at index"),
    ({"wrenches": {"brick": WRENCH}, "wrench_axes": "body-ish"}, InputError, "axes: expected one of"),
    ({"wrenches": {"brick": lambda t, *_: WRENCH * (np.nan if t > 0.045 else 1)}}, TorqueError, "at t = 0.05 s"),
    ({"wrenches": {"brick": lambda *_: WRENCH[:3]}}, TorqueError, r"wrench on 'brick': expected shape \(6,\)"),
    ({"wrenches": {"brick": lambda *_: 1 / 0}}, TorqueError, "wrench on 'brick': .* ZeroDivisionError"),
]


@pytest.mark.parametrize(("change", "error", "text"), BAD)
def test_bad_input_is_named(change: Any, error: type[Exception], text: str) -> None:
    model = brick()
    with pytest.raises(error, match=text):
        mb.simulate(mb.dynamics(model), model.neutral(), np.zeros(6), 0.1, "semi_implicit_euler", 0.01, **change)


def test_rows_for_trajectories_or_steps_must_be_told_apart() -> None:
    dyn, q = mb.dynamics(brick(), "pinocchio"), np.tile(brick().neutral(), (2, 1))
    with pytest.raises(InputError, match=r"each trajectory or for each step; give \(2, 2, 6\)"):
        mb.simulate(dyn, q, np.zeros(6), 0.02, dt=0.01, wrenches={"brick": np.zeros((2, 6))})
    with pytest.raises(InputError, match="needs save="):
        mb.simulate(dyn, q[0], np.zeros(6), 0.02, "rk853", wrenches={"brick": np.zeros((2, 6))})


def test_systems_without_frames_refuse() -> None:
    with pytest.raises(UnsupportedError, match="no frames"):
        mb.simulate(systems.pendulum().dynamics(), [0.1], [0.0], 0.1, wrenches={"tip": WRENCH})
