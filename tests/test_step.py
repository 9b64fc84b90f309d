"""`Dynamics.step`: a run of one step of `simulate`, without the run."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import casadi as ca
import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.derivation.steps import fixed
from mbkit.engines import Dynamics
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, NumericalError, UnknownNameError, UnsupportedError
from mbkit.lagrangian import systems
from mbkit.model import Model
from mbkit.simulate import METHODS, Tableau, register_method, simulate
from tests.random_trees import ALL, random_tree
from tests.scenes import mounted
from tests.test_rollouts import tumbling, unstable

FIXED = ("rk4", "semi_implicit_euler")
#: No joint of these has another velocity in the integrators.
SAME_VELOCITY = tuple(kind for kind in ALL if kind != "free")
H = 0.01
EPS = np.finfo(float).eps


def own(model: Model, *, compiled: bool = True) -> LagrangianDynamics:
    dyn = mb.dynamics(model, "lagrangian", compile=compiled)
    assert isinstance(dyn, LagrangianDynamics)
    return dyn


def states(model: Model, n: int | None = None, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q, v = model.random_state(rng, n)
    return q, v, rng.standard_normal(v.shape)


def simulated(dyn: Dynamics, q: Any, v: Any, tau: Any, h: float = H, method: str = "rk4") -> Any:
    held = tau[:, None] if np.ndim(tau) == 2 else tau
    run = simulate(dyn, q, v, h, method, dt=h, torque=held, save=[h])
    return run.q[..., -1, :], run.v[..., -1, :]


def assert_equal(got: Any, expected: Any, *, rounding: bool = False) -> None:
    for x, y in zip(got, expected, strict=True):
        assert x.shape == y.shape
        if rounding:
            np.testing.assert_allclose(x, y, rtol=0, atol=64 * EPS * max(np.abs(y).max(initial=0), 1))
        else:
            np.testing.assert_array_equal(x, y)


def assert_simulated(dyn: Dynamics, method: str, *, rounding: bool = False, seed: int = 0) -> None:
    """A step of one state and of a batch, on the first and on later calls, is that of `simulate`."""
    q, v, tau = states(dyn.model, 5, seed)
    expected = simulated(dyn, q, v, tau, method=method)
    for _ in range(2):
        assert_equal(dyn.step(q[0], v[0], tau[0], H, method), [x[0] for x in expected], rounding=rounding)
        assert_equal(dyn.step(q, v, tau, H, method), expected, rounding=rounding)
    wide = (np.asfortranarray(x) for x in (q, v, tau))
    assert_equal(dyn.step(*wide, np.float64(H), method=method), expected, rounding=rounding)
    assert_equal(
        dyn.step(q[0].tolist(), v[0].tolist(), tau[0].tolist(), H, method), [x[0] for x in expected], rounding=True
    )


@pytest.mark.thorough("1-rk4", "2-rk4", "2-semi_implicit_euler", "3-rk4")
@pytest.mark.parametrize("method", FIXED)
@pytest.mark.parametrize("seed", range(4))
def test_a_step_has_the_bits_of_simulate_on_random_trees(seed: int, method: str) -> None:
    model = random_tree(seed, n=4, kinds=tuple(np.roll(SAME_VELOCITY, 3 * seed)[:4]), mimic=bool(seed % 2))
    assert_simulated(own(model), method, seed=seed)


@pytest.mark.parametrize("method", FIXED)
def test_with_a_free_joint_it_is_simulate_to_rounding(method: str) -> None:
    assert_simulated(own(tumbling()), method, rounding=True)


@pytest.mark.thorough("kinds1")
@pytest.mark.parametrize("kinds", [SAME_VELOCITY[:3], ("free", "ball", "revolute")])
def test_a_step_in_parts_too(kinds: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fixed, "_MAX_OPERATIONS_IN_ONE_PIECE", 0)
    dyn = own(random_tree(3, n=3, kinds=kinds))
    assert_simulated(dyn, "rk4", rounding="free" in kinds)
    assert len(dyn._step_plan("rk4").parts) > 1


@pytest.mark.thorough("rk4-lagrangian", "rk4-oracle")
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco", "oracle"])
@pytest.mark.parametrize("method", FIXED)
def test_stage_by_stage_it_has_the_bits_of_simulate_on_any_engine(engine: str, method: str) -> None:
    model = random_tree(5, n=3, kinds=("free", "ball", "revolute"), armature=False)
    options = {"compile": False} if engine == "lagrangian" else {}
    assert_simulated(mb.dynamics(model, engine, **options), method)


@pytest.fixture
def heun() -> Iterator[str]:
    register_method(Tableau("heun", [[0, 0], [1, 0]], [0.5, 0.5], order=2))
    yield "heun"
    METHODS.pop("heun", None)


def test_a_method_of_ones_own(heun: str) -> None:
    dyn = own(mb.catalog.double_pendulum())
    assert_simulated(dyn, heun)
    state = (q, v, tau) = states(dyn.model)
    before = dyn.step(*state, H, heun)
    del METHODS[heun]
    with pytest.raises(UnknownNameError):
        dyn.step(*state, H, heun)
    # Ralston's, by the same name.
    register_method(Tableau(heun, [[0, 0], [2 / 3, 0]], [0.25, 0.75], order=2))
    assert_equal(dyn.step(*state, H, heun), simulated(dyn, q, v, tau, method=heun))
    assert not np.array_equal(dyn.step(*state, H, heun)[1], before[1])


def test_parameters_of_one_state_and_of_each() -> None:
    dyn = own(mb.catalog.pendulum(mass=mb.Parameter("m", 2.0)))
    q, v, tau = states(dyn.model, 4)
    masses = np.array([1.0, 2.0, 3.0, 4.0])
    each = dyn.at(m=masses)
    for _ in range(2):
        got = each.step(q, v, tau, H)
        assert_equal(got, simulated(each, q, v, tau))
        for i, mass in enumerate(masses.tolist()):
            assert_equal(dyn.at(m=mass).step(q[i], v[i], tau[i], H), [x[i] for x in got])
    assert_equal(each.step(q[0], v[0], tau[0], H), each.step(q[[0] * 4], v[[0] * 4], tau[[0] * 4], H))
    with pytest.raises(InputError, match="a batch of 3, but the parameters' values are 4"):
        each.step(q[:3], v[:3], tau[:3], H)


@pytest.mark.parametrize("compiled", [True, False])
def test_a_model_that_cannot_move_stays(compiled: bool) -> None:
    b = mounted("block", "block", "weld", "fixed", mass=1.0, inertia=(1, 1, 1))
    q, v = own(b.build(), compiled=compiled).step([], [], [], H)
    assert q.shape == v.shape == (0,)


def test_quaternions_stay_of_unit_length_over_many_steps() -> None:
    dyn = own(tumbling())
    q, v, _ = states(dyn.model)
    tau = np.zeros(dyn.model.nv)
    for _ in range(5000):
        q, v = dyn.step(q, 0.999 * v, tau, H)
    for start, _ in dyn.model.quaternions:
        assert abs(np.linalg.norm(q[start : start + 4]) - 1) < 4 * EPS


def test_nothing_is_shared_and_arguments_stay_as_they_are() -> None:
    dyn = own(tumbling())
    for arguments in (states(dyn.model), states(dyn.model, 3)):
        kept = [x.copy() for x in arguments]
        first = dyn.step(*arguments, H)
        values = [x.copy() for x in first]
        second = dyn.step(*arguments, H)
        memory = [*first, *second, *arguments]
        assert not any(np.shares_memory(x, y) for i, x in enumerate(memory) for y in memory[:i])
        for x in second:
            x[:] = 7.0
        assert_equal(first, values)
        assert_equal(arguments, kept)


def test_threads_get_the_same_bits() -> None:
    dyn = own(mb.load("ur5"))
    q, v, tau = states(dyn.model, 40)
    expected = dyn.step(q, v, tau, H)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            results = list(pool.map(lambda i: dyn.step(q[i % 40], v[i % 40], tau[i % 40], H), range(1000)))
    finally:
        sys.setswitchinterval(interval)
    for i, got in enumerate(results):
        assert_equal(got, [x[i % 40] for x in expected])
    q, v, tau = states(dyn.model, 20_000)
    one, two = (mb.dynamics(dyn.model, "lagrangian", compile=True, threads=n) for n in (1, 2))
    assert_equal(one.step(q, v, tau, H), two.step(q, v, tau, H))


# Refusals, on the fast way and on the checked one


@pytest.fixture(scope="module", params=["compiled", "interpreted", "pinocchio"])
def ready(request: Any) -> Dynamics:
    """A floating body after its first step, when the fast way is there."""
    model = mb.catalog.free_body()
    engine, options = "lagrangian", {"compile": request.param == "compiled"}
    if request.param == "pinocchio":
        engine, options = "pinocchio", {}
    dyn = mb.dynamics(model, engine, **options)
    dyn.step(*states(model), H)
    return dyn


@pytest.mark.parametrize(
    ("dt", "text"),
    [
        (0, "dt: expected a number above 0"),
        (-1e-3, "dt: expected a number above 0"),
        (np.nan, "dt: expected a finite number"),
        (np.inf, "dt: expected a finite number"),
        ("1", "dt: expected a number, got '1'"),
        (True, "dt: expected a number, got True"),
        (np.array([H]), "dt: expected a number"),
    ],
)
def test_steps_that_are_none(ready: Dynamics, dt: Any, text: str) -> None:
    with pytest.raises(InputError, match=text):
        ready.step(*states(ready.model), dt)


@pytest.mark.parametrize("dt", [1, np.float64(1e-3), np.float32(1e-3), np.array(1e-3)])
def test_numbers_of_other_types_are_steps(ready: Dynamics, dt: Any) -> None:
    q, v, tau = states(ready.model)
    assert_equal(ready.step(q, 0 * v, tau, dt), ready.step(q, 0 * v, tau, float(dt)))


def test_wrong_states_are_named(ready: Dynamics) -> None:
    q, v, tau = states(ready.model)
    longer = q.copy()
    longer[3:7] *= 1.1
    for bad, text in (
        ((q[:-1], v, tau), r"q: expected shape \(7,\) or \(N, 7\), got \(6,\)"),
        ((q, v[:-1], tau), r"v: expected shape \(6,\)"),
        ((q, v, np.append(tau, 0.0)), r"tau: expected shape \(6,\)"),
        ((longer, v, tau), "q: the quaternion of joint"),
        ((np.tile(q, (2, 1)), np.tile(v, (3, 1)), tau), "batches of different sizes"),
        ((q, v, None), "tau: "),
        ((q, v, tau + 1j), "tau: expected real numbers"),
    ):
        with pytest.raises(InputError, match=text):
            ready.step(*bad, H)
    for i, name in enumerate(("q", "v", "tau")):
        for value in (np.nan, np.inf):
            bad_ = [x.copy() for x in (q, v, tau)]
            bad_[i][-1] = value
            with pytest.raises(InputError, match=f"{name}: {value} at index"):
                ready.step(*bad_, H)


def test_unknown_methods_have_a_suggestion(ready: Dynamics) -> None:
    state = states(ready.model)
    with pytest.raises(UnknownNameError, match=r"did you mean .*'rk4'"):
        ready.step(*state, H, "rk5")
    for bad in (None, 4, ["rk4"]):
        with pytest.raises(InputError, match="method: expected a name"):
            ready.step(*state, H, bad)  # type: ignore[arg-type]


@pytest.mark.parametrize("method", ["gauss4", "rk853", "moreau", "mujoco_rk4"])
def test_methods_without_an_explicit_step_name_those_with_one(ready: Dynamics, method: str) -> None:
    with pytest.raises(UnsupportedError, match=f"step: {method} has no explicit fixed step; use rk4"):
        ready.step(*states(ready.model), H, method)


def test_quasi_velocities_too() -> None:
    rates = systems.double_pendulum().quasi_velocities([[2, 0], [sp.cos(sp.Symbol("theta1")), 1]], ["a", "b"])
    dyn = rates.dynamics()
    assert dyn.model.velocity_map is not None
    assert_simulated(dyn, "rk4", rounding=True)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("batch", [False, True])
def test_a_state_beyond_all_bounds_is_an_error(compiled: bool, batch: bool) -> None:
    dyn = own(unstable(), compiled=compiled)
    q, v, tau = (np.array([1.0, 1.0]), np.zeros(2), np.zeros(2))
    if batch:
        q, v, tau = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 1.0]]), np.zeros((3, 2)), np.zeros((3, 2))
    where = "in sample 1 after" if batch else "after dt = 1 s"

    def run(q: np.ndarray, v: np.ndarray) -> None:
        for _ in range(40):
            q, v = dyn.step(q, v, tau, 1.0)
            assert np.isfinite(q).all()
            assert np.isfinite(v).all()

    with pytest.raises(NumericalError, match=f"step of unstable by rk4: the state is not finite {where}"):
        run(q, v)


@pytest.mark.parametrize("options", [{"compile": True}, {"compile": False}])
def test_a_stage_beyond_all_bounds_is_an_error(options: dict[str, bool]) -> None:
    b = mounted("slide", "block", "x", "prismatic", gravity=(0, 0, 0), mass=1.0, axis=(1, 0, 0))
    dyn = mb.dynamics(b.build(point_masses=True), "lagrangian", **options)
    for shape in ((1,), (3, 1)):
        state = np.zeros(shape), np.full(shape, 1e307), np.zeros(shape)
        assert np.isfinite(dyn.step(*state, H)).all()
        with pytest.raises(NumericalError, match="step of slide by rk4: the state is not finite"):
            dyn.step(*state, 100.0)


def test_an_acceleration_that_is_not_finite_names_the_suspect() -> None:
    b = mounted("massless", "rod", "hinge", "revolute", mass=0.0, axis=(0, 1, 0))
    for compiled in (True, False):
        dyn = own(b.build(nonphysical="warn"), compiled=compiled)
        with pytest.raises(NumericalError, match="no mass moves"):
            dyn.step([0.0], [0.0], [1.0], H)


# Models in which time enters


def _shaken(friction: float = 0.0) -> Model:
    """A block of 2 kg under 3 cos(50 t)."""
    b = mounted("shaken", "block", "x", "prismatic", gravity=(0, 0, 0), mass=2.0, axis=(1, 0, 0), friction=friction)
    b.add_joint_force("shake", "x", lambda t, q, v: 3.0 * ca.cos(50 * t))  # noqa: ARG005
    return b.build(point_masses=True)


def _carried() -> Model:
    """A slide prescribed as 0.5 sin 3t that carries a pendulum."""
    b = mounted("carried", "slide", "x", "prismatic", mass=1.0, axis=(1, 0, 0))
    b.add_body("bob", mass=0.7, com=(0, 0, -0.5))
    b.add_joint("swing", "revolute", parent="slide", child="bob", axis=(0, 1, 0))
    b.prescribe("x", amplitude=0.5, frequency=3.0)
    return b.build(point_masses=True)


TIMED = [
    *(("lagrangian", {"compile": x}) for x in (True, False)),
    *((engine, {}) for engine in ("pinocchio", "mujoco", "drake", "oracle")),
]


@pytest.mark.parametrize(("engine", "options"), TIMED, ids=lambda x: str(x))
def test_a_force_of_time_acts_at_the_times_of_a_loop(engine: str, options: dict[str, bool]) -> None:
    if engine == "drake":
        pytest.importorskip("pydrake")
    dyn = mb.dynamics(_shaken(), engine, **options)
    q, v, h = np.zeros(1), np.zeros(1), 1e-3
    for k in range(20 if engine == "oracle" else 400):
        q, v = dyn.step(q, v, [0.0], h, t=k * h)
    end = (k + 1) * h
    # ∫∫ 3/2 cos 50t; Simpson's rule in each step is off by (50 h)⁴/2880 of it.
    np.testing.assert_allclose(v, 0.03 * np.sin(50 * end), atol=1e-9)
    np.testing.assert_allclose(q, 6e-4 * (1 - np.cos(50 * end)), atol=1e-11)


def test_a_step_in_parts_has_the_time_of_each_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fixed, "_MAX_OPERATIONS_IN_ONE_PIECE", 0)
    test_a_force_of_time_acts_at_the_times_of_a_loop("lagrangian", {"compile": True})


@pytest.mark.parametrize("model", [_shaken, lambda: _shaken(friction=0.4), _carried])
@pytest.mark.parametrize("compiled", [True, False])
def test_each_state_of_a_batch_has_its_time(model: Any, compiled: bool) -> None:
    dyn = own(model(), compiled=compiled)
    times = np.array([0.3, 1.0, -0.4])
    q, v = dyn.model.random_state(np.random.default_rng(0), 3)
    v[0, -1] = 0.0
    v[:, 0] = v[:, 0] if dyn.model.nv == 1 else 1.5 * np.cos(3 * times)
    q[:, 0] = q[:, 0] if dyn.model.nv == 1 else 0.5 * np.sin(3 * times)
    tau = np.full(v.shape, 0.2)
    for _ in range(2):
        got = dyn.step(q, v, tau, H, t=times)
        for i, t in enumerate(times.tolist()):
            run = simulate(dyn, q[i], v[i], H, dt=H, torque=tau[i], t0=t)
            assert_equal([x[i] for x in got], (run.q[-1], run.v[-1]), rounding=True)
            assert_equal(dyn.step(q[i], v[i], tau[i], H, t=t), (run.q[-1], run.v[-1]), rounding=True)
    same = dyn.step(q[[0] * 3], v[[0] * 3], tau, H, t=0.3)
    assert_equal(same, [np.tile(x[0], (3, 1)) for x in got], rounding=True)
    if dyn.model.nv == 2:
        np.testing.assert_allclose(got[0][:, 0], 0.5 * np.sin(3 * (times + H)), atol=1e-15)


def test_a_run_has_the_times_of_a_loop_whatever_is_kept() -> None:
    dyn, t0, h = own(_shaken(), compiled=True), 0.3, 1e-3
    q, v = np.zeros(1), np.ones(1)
    runs = [simulate(dyn, q, v, 0.06, dt=h, t0=t0, save=save) for save in (None, 7, [t0 + 0.06])]
    for k in range(60):
        q, v = dyn.step(q, v, [0.0], h, t=t0 + k * h)
    for run in runs:
        assert np.array_equal(run.q[-1], q)
        assert np.array_equal(run.v[-1], v)


def test_with_a_wrench_and_parameters_of_each_state_too() -> None:
    b = mounted("shaken", "block", "x", "prismatic", gravity=(0, 0, 0), mass=mb.Parameter("m"), axis=(1, 0, 0))
    b.add_joint_force("shake", "x", lambda t, q, v: 3.0 * ca.cos(50 * t))  # noqa: ARG005
    masses, times, h = np.array([2.0, 4.0]), np.array([0.1, 0.7]), 1e-3
    dyn = own(b.build(point_masses=True)).at(m=masses)
    push = {"block": [0.5, 0, 0, 0, 0, 0]}
    gained = 0.06 * (np.sin(50 * (times + h)) - np.sin(50 * times)) + 0.5 * h
    for _ in range(2):
        _, v = dyn.step(np.zeros((2, 1)), np.zeros((2, 1)), np.zeros(1), h, wrenches=push, t=times)
        np.testing.assert_allclose(v[:, 0], gained / masses, rtol=1e-8)


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_a_model_that_needs_the_time_asks_for_it(engine: str) -> None:
    for model in (_shaken(), _shaken(friction=0.1), _carried()):
        dyn = mb.dynamics(model, engine)
        q, v = dyn.model.neutral(), np.zeros(dyn.model.nv)
        for _ in range(2):
            for same in (dyn, dyn.at(**{str(model.time_parameter): 0.4})):
                with pytest.raises(
                    InputError, match=rf"t: expected the time .* on which {model.name} depends, got None"
                ):
                    same.step(q, v, v, H)
            with pytest.raises(InputError, match=r"t: expected a number or shape \(2,\), got \(3,\)"):
                dyn.step(np.tile(q, (2, 1)), v, v, H, t=[0.0, 1.0, 2.0])
            with pytest.raises(InputError, match="t: nan at index"):
                dyn.step(q, v, v, H, t=np.nan)
            dyn.step(*dyn.at(**{str(model.time_parameter): 0.4}).project(q, v), v, H, t=0.4)
    free = mb.dynamics(mb.catalog.pendulum(), engine)
    assert_equal(free.step([0.3], [0.0], [0.0], H, t=7.0), free.step([0.3], [0.0], [0.0], H))
