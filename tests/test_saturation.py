# Torques have the signature they are called with.
# ruff: noqa: ARG001, ARG005
"""Effort limits that act: a run with ``saturate=True`` is the run under the torque that is clipped by hand."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import InputError, MbkitWarning, TorqueError
from mbkit.simulate import METHODS, Event, Policy, StateFeedback, Trajectory
from tests.random_trees import off

LIMITS = np.array([1.5, np.inf])
Q, V = np.array([0.3, -0.4]), np.array([0.2, 0.5])


def crane(friction: float = 0.0, **last: Any) -> mb.Model:
    """Return a slider whose effort is limited, and a pendulum on it, whose effort is not."""
    b = mb.ModelBuilder("crane")
    b.add_joint("x", "prismatic", parent="world", child="cart", axis=(1, 0, 0), effort_limit=1.5, friction=friction)
    b.add_body("cart", mass=1.0, inertia=np.eye(3))
    b.add_joint("turn", "revolute", parent="cart", child="bob", axis=(0, 1, 0), **last)
    b.add_body("bob", mass=0.7, com=(0, 0, -0.5), inertia=0.1 * np.eye(3))
    return b.build()


def mass() -> mb.Model:
    """Return one mass on a rail, with a force of at most 2 N."""
    b = mb.ModelBuilder("mass")
    b.add_joint("x", "prismatic", parent="world", child="cart", axis=(1, 0, 0), effort_limit=2.0)
    b.add_body("cart", mass=1.0, inertia=np.eye(3))
    return b.build()


def clipped(force: Any) -> Any:
    return np.clip(force, -LIMITS, LIMITS)


def same(a: Trajectory, b: Trajectory) -> bool:
    return all(np.array_equal(getattr(a, x), getattr(b, x), equal_nan=True) for x in ("t", "q", "v", "tau"))


def dynamics_of(engine: str, model: mb.Model | None = None) -> mb.Dynamics:
    model = model or crane()
    return mb.dynamics(model, "lagrangian", compile=True) if engine == "compiled" else mb.dynamics(model, engine)


#: Engines, methods and their settings; a table has five rows.
RUNS = {
    **{f"{engine} {method}": (engine, method) for engine in ("compiled", "pinocchio") for method in ("rk4", "moreau")},
    **{f"compiled {m}": ("compiled", m) for m in ("semi_implicit_euler", "implicit_midpoint", "gauss4", "rk853")},
    **{f"pinocchio {m}": ("pinocchio", m) for m in ("gauss6", "rk853", "dop853", "lsoda", "auto", "rodas5")},
    **{f"mujoco {m}": ("mujoco", m) for m in ("mujoco_euler", "mujoco_rk4", "mujoco_discrete")},
    "compiled taylor": ("compiled", "taylor"),
    "drake": ("drake", "drake_runge_kutta3"),
}


def run_of(name: str, torque: Any, batch: int = 0, **more: Any) -> Trajectory:
    engine, method = RUNS[name]
    adaptive = METHODS[method].kind == "adaptive"
    q, v = (np.tile(Q, (batch, 1)) + 0.1 * np.arange(batch)[:, None], V) if batch else (Q, V)
    setting: dict[str, Any] = {"save": np.linspace(0.0, 0.1, 6)} if adaptive else {"dt": 0.02}
    return mb.simulate(dynamics_of(engine), q, v, 0.1, method, torque=torque, doubt=False, **setting, **more)


TABLES = {
    "constant": np.array([-4.0, 1.0]),
    "rows": np.random.default_rng(0).normal(size=(5, 2)) * 3,
    "rows of each": np.random.default_rng(1).normal(size=(3, 5, 2)) * 3,
}


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("name", RUNS)
def test_an_array_acts_as_the_clipped_array(name: str, table: str) -> None:
    tau, batch = TABLES[table], 3 if table == "rows of each" else 0
    found = run_of(name, tau, batch, saturate=True)
    assert same(found, run_of(name, clipped(tau), batch))
    assert (np.abs(found.tau) <= LIMITS).all()
    (one,) = found.stats.saturated
    over = np.abs(tau[..., 0]) - 1.5
    assert (one.velocity, one.excess) == ("x", over.max())
    assert one.fraction == pytest.approx((over > 0).mean(), rel=1e-9)
    first = 0.02 * np.argmax((over > 0).any(0)) if batch else 0.02 * np.argmax(over > 0)
    assert one.first == pytest.approx(first, abs=1e-12)


def law(t: float, q: Any, v: Any) -> Any:
    return np.stack([8.0 * (0.5 - q[..., 0]) - 6.0 * v[..., 0] + 3 * np.sin(40 * t), -0.5 * v[..., 1]], axis=-1)


FUNCTIONS = {
    "function": (lambda cut: lambda t, q, v: cut(law(t, q, v)), {}),
    "policy": (lambda cut: Policy(lambda t, q, v, _: cut(law(t, q, v))), {}),
    "samples": (lambda cut: lambda t, q, v: cut(law(t, q, v)), {"hold": 0.02}),
    "sampled policy": (lambda cut: Policy(lambda t, q, v, _: cut(law(t, q, v))), {"hold": 0.04}),
    "function and wrench": (
        lambda cut: lambda t, q, v: cut(law(t, q, v)),
        {"wrenches": {"cart": [9.0, 0, 0, 0, 0, 0], "bob": lambda t, q, v: [7 * t, 0, 0, 0, 0, 0]}},
    ),
    "samples and wrench": (
        lambda cut: lambda t, q, v: cut(law(t, q, v)),
        {"hold": 0.02, "wrenches": {"cart": np.outer(np.arange(5), [9.0, 0, 0, 0, 0, 0])}},
    ),
}


#: Those that a method has.
THERE = [
    (name, kind)
    for name, (_, method) in RUNS.items()
    for kind, (_, more) in FUNCTIONS.items()
    if (METHODS[method].wrenches or "wrenches" not in more) and (METHODS[method].callables or "hold" in more)
    if METHODS[method].callables or "function" not in kind
]


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("batch", [0, 3])
@pytest.mark.parametrize(("name", "kind"), THERE)
def test_a_function_acts_as_the_clipped_function(name: str, kind: str, batch: int) -> None:
    make, more = FUNCTIONS[kind]
    found = run_of(name, make(lambda x: x), batch, saturate=True, **more)
    want = run_of(name, make(clipped), batch, **more)
    assert same(found, want)
    assert all(np.array_equal(x, want.wrenches()[frame]) for frame, x in found.wrenches().items())
    (one,) = found.stats.saturated
    assert one.velocity == "x"
    assert found.power_balance() == pytest.approx(want.power_balance(), abs=1e-14)


@pytest.mark.parametrize("name", ["compiled rk4", "pinocchio rk853", "mujoco mujoco_rk4"])
def test_a_torque_within_limits_changes_no_bit(name: str) -> None:
    for torque, more in ((np.array([1.5, -40.0]), {}), (np.array([-0.0, 0.0]), {}), (law, {"hold": 0.02})):
        weak = torque if not callable(torque) else lambda t, q, v: 0.1 * law(t, q, v)
        found = run_of(name, weak, saturate=True, **more)
        assert same(found, run_of(name, weak, **more))
        assert found.stats.saturated == ()
    assert same(run_of(name, None, saturate=True), run_of(name, None))


@pytest.mark.parametrize("hold", [None, 0.02])
@pytest.mark.parametrize(("engine", "method"), [("compiled", "rk4"), ("pinocchio", "rk853"), ("compiled", "moreau")])
def test_stops_and_effort_limits_act_together(engine: str, method: str, hold: float | None) -> None:
    b = mb.ModelBuilder("struck")
    wall = {"upper": 0.02, "stops": True, "restitution": 0.4}
    b.add_joint("x", "prismatic", parent="world", child="cart", axis=(1, 0, 0), effort_limit=1.5, **wall)
    b.add_body("cart", mass=1.0, inertia=np.eye(3))
    dyn = dynamics_of(engine, b.build())
    setting: dict[str, Any] = {"dt": 0.01} if METHODS[method].kind == "fixed" else {"save": np.linspace(0.0, 0.3, 4)}
    push = lambda t, q, v: [40.0 * (0.05 - q[0])]  # noqa: E731
    cut = lambda t, q, v: np.clip(push(t, q, v), -1.5, 1.5)  # noqa: E731
    for start in (([0.0], [0.1]), (np.zeros((2, 1)), [[0.1], [0.3]])):
        runs = [
            mb.simulate(dyn, *start, 0.3, method, torque=torque, hold=hold, saturate=saturate, doubt=False, **setting)
            for torque, saturate in ((push, True), (cut, False))
        ]
        assert same(*runs)
        assert runs[0].stats.saturated
        assert len(runs[0].events) == len(runs[1].events)


# State feedback

GAIN = np.array([[8.0, 0.0, 6.0, 0.0], [0.0, 2.0, 0.0, 0.5]])


@pytest.mark.thorough(every=3)
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("engine", ["compiled", "lagrangian", "pinocchio"])
@pytest.mark.parametrize("method", ["rk4", "semi_implicit_euler", "rk853", "gauss4", "dop853"])
def test_feedback_is_clipped_in_machine_code_too(engine: str, method: str, friction: float) -> None:
    dyn, feedback = dynamics_of(engine, crane(friction)), StateFeedback(GAIN, q=[1.0, 0.2])
    q = np.array([Q, [0.9, 0.1], [-1.0, 0.3]])
    adaptive = METHODS[method].kind == "adaptive"
    run: dict[str, Any] = {"save": [0.0, 0.1, 0.2]} if adaptive else {"dt": 2e-3}
    # Steps of an adaptive method follow rounding.
    room = 1e-9 if adaptive else 1e-13
    want = mb.simulate(dyn, q, V, 0.2, method, torque=lambda t, q, v: clipped(feedback(t, q, v)), doubt=False, **run)
    found = mb.simulate(dyn, q, V, 0.2, method, torque=feedback, saturate=True, doubt=False, **run)
    assert off(found.q, want.q) < room
    assert off(found.v, want.v) < room
    assert off(found.tau, want.tau) < 10 * room
    assert [x.velocity for x in found.stats.saturated] == ["x"]
    # The law itself is as it was.
    assert feedback(0.0, np.array([-5.0, 0.0]), np.zeros(2))[0] == 48.0


def test_each_torque_of_a_feedback_has_its_own_limit() -> None:
    b = mb.ModelBuilder("three")
    for i, most in enumerate([np.inf, 0.4, 0.0]):
        b.add_joint(
            f"j{i}", "revolute", parent=f"b{i - 1}" if i else "world", child=f"b{i}", axis=(0, 1, 0), effort_limit=most
        )
        b.add_body(f"b{i}", mass=1.0, com=(0.2, 0.1, 0.0), inertia=0.1 * np.eye(3))
    model = b.build()
    feedback = StateFeedback(np.hstack([np.ones((3, 3)), np.eye(3)]), q=[1.0, 2.0, 3.0])
    limits = model.effort_limits
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    start = np.zeros((2, 3)), np.zeros((2, 3))
    found = mb.simulate(dyn, *start, 0.1, dt=1e-2, torque=feedback, saturate=True)
    by_hand = lambda t, q, v: np.clip(feedback(t, q, v), -limits, limits)  # noqa: E731
    want = mb.simulate(dyn, *start, 0.1, dt=1e-2, torque=by_hand)
    assert off(found.v, want.v) < 1e-14
    assert [(x.velocity, x.first) for x in found.stats.saturated] == [("j1", 0.0), ("j2", 0.0)]


# A closed form: a mass under F = clip(-4 x - 4 v, ±2) from rest at x = 3 m. It falls freely in the field of 2 N up to
# t₁ with 4 x + 4 v = 2, and from there x = (x₁ + c s) exp(-2 s), critically damped and within the limits.

_T1 = (-8.0 + np.sqrt(224.0)) / 8.0
PD = StateFeedback([[4.0, 4.0]])


def exact(t: Any) -> tuple[Any, Any]:
    x1, v1, s = 3.0 - _T1**2, -2.0 * _T1, np.maximum(t - _T1, 0.0)
    c = v1 + 2 * x1
    late = (x1 + c * s) * np.exp(-2 * s), (c - 2 * (x1 + c * s)) * np.exp(-2 * s)
    return np.where(t < _T1, 3.0 - t**2, late[0]), np.where(t < _T1, -2.0 * t, late[1])


@pytest.mark.parametrize("torque", [PD, lambda t, q, v: PD(t, q, v), Policy(lambda t, q, v, _: PD(t, q, v))])
@pytest.mark.parametrize("method", ["rk4", "gauss4", "rk853", "dop853", "radau", "bdf", "lsoda", "rodas5", "auto"])
def test_a_saturated_servo_is_a_bang_and_a_linear_arc(method: str, torque: Any) -> None:
    adaptive = METHODS[method].kind == "adaptive"
    times = np.linspace(0.0, 2.0, 41)
    # One kink costs a fixed step h² of the rate by which it bends.
    setting, room = ({"rtol": 1e-9, "save": times}, 2e-7) if adaptive else ({"dt": 1e-3, "save": 50}, 2e-6)
    run = mb.simulate(
        dynamics_of("compiled", mass()), [3.0], [0.0], 2.0, method, torque=torque, saturate=True, **setting
    )
    x, v = exact(run.t)
    assert np.abs(run.q[:, 0] - x).max() < room
    assert np.abs(run.v[:, 0] - v).max() < room
    assert np.abs(run.tau[:, 0] - np.clip(-4 * x - 4 * v, -2, 2)).max() < 10 * room
    (one,) = run.stats.saturated
    assert one.excess == pytest.approx(10.0, rel=1e-12)
    # Kept states, of which those up to t₁ are beyond the limit.
    assert one.fraction == pytest.approx((run.t < _T1).mean())


def test_a_sampled_servo_goes_by_parabolas() -> None:
    """Under held forces each interval is a parabola: the recursion is exact."""
    dyn, hold, x, v, forces = dynamics_of("compiled", mass()), 0.1, 3.0, 0.0, []
    ask = lambda t, q, v: PD(t, q, v)  # noqa: E731
    for _ in range(20):
        forces.append(float(np.clip(-4 * x - 4 * v, -2, 2)))
        x, v = x + hold * v + 0.5 * hold**2 * forces[-1], v + hold * forces[-1]
    many = int(np.argmax(np.abs(forces) < 2))
    for q0, method, setting in (
        ([3.0], "rk4", {"dt": 0.05}),
        ([[3.0], [0.1]], "rk4", {"dt": 0.05}),
        ([3.0], "rk853", {}),
    ):
        run = mb.simulate(dyn, q0, [0.0], 2.0, method, torque=ask, hold=hold, saturate=True, **setting)
        last = run.q[..., -1, 0], run.v[..., -1, 0]
        assert (np.ravel(last[0])[0], np.ravel(last[1])[0]) == pytest.approx((x, v), abs=1e-12)
        (one,) = run.stats.saturated
        # The second trajectory of the batch is never beyond the limit.
        assert one.fraction == pytest.approx(many / 20 / np.size(last[0]), rel=1e-9)
        assert (one.first, one.excess) == pytest.approx((0.0, 10.0))
        assert run.work()[..., -1].ravel()[0] == pytest.approx(v**2 / 2, abs=1e-12)


# What a run tells


def test_rows_between_kept_states_count_up_to_where_the_run_ended() -> None:
    rows = np.array([[0.0, 0.0], [3.5, 0.0], [0.0, 9.0], [-2.0, 0.0], [5.0, 0.0]])
    dyn = dynamics_of("pinocchio")
    run = mb.simulate(dyn, Q, V, 0.1, dt=0.02, torque=rows, save=[0.0, 0.1], saturate=True)
    assert run.stats.saturated == (("x", pytest.approx(0.6), pytest.approx(0.02), 3.5),)
    assert "; torque on x clipped in 60 % of the run, first at t = 0.02 s, by at most 3.5" in str(run.stats)
    stop = Event(lambda t, q, v: t - 0.05, "stop", terminal=True)
    times = np.linspace(0.0, 0.1, 6)
    run = mb.simulate(dyn, Q, V, 0.1, "rk853", save=times, torque=rows, events=stop, saturate=True)
    assert run.stats.reached == pytest.approx(0.05)
    assert run.stats.saturated == (("x", pytest.approx(0.4), pytest.approx(0.02), 2.0),)
    # In a batch each trajectory counts up to its own end.
    apart = Event(lambda t, q, v: q[0] + 5.0, "far")
    start = np.array([Q, [-5.001, -0.4]])
    run = mb.simulate(dyn, start, [0.5, 0.0], 0.1, "rk853", save=times, torque=rows, events=apart, saturate=True)
    second = float(run.stats.reached[1])
    assert second < 0.02
    assert run.stats.saturated == (("x", pytest.approx(0.06 / (0.1 + second)), pytest.approx(0.02), 3.5),)


def test_a_function_of_a_wrench_does_not_change_how_an_array_is_counted() -> None:
    calls: list[float] = []

    def gust(t: float, q: Any, v: Any) -> list[float]:
        calls.append(t)
        return [50.0, 0, 0, 0, 0, 0]

    rows = np.array([[0.0, 0.0], [3.5, 0.0], [0.0, 9.0], [-2.0, 0.0], [5.0, 0.0]])
    run: dict[str, Any] = {"dt": 0.02, "save": [0.0, 0.1], "wrenches": {"bob": gust}, "doubt": False}
    found = mb.simulate(dynamics_of("pinocchio"), Q, V, 0.1, torque=rows, saturate=True, **run)
    assert found.stats.saturated == (("x", pytest.approx(0.6), pytest.approx(0.02), 3.5),)
    assert len(calls) == 20
    want = mb.simulate(dynamics_of("pinocchio"), Q, V, 0.1, torque=clipped(rows), **run)
    assert same(found, want)
    assert found.wrenches()["bob"][:, 0].tolist() == [50.0, 50.0]


def test_of_a_function_kept_states_count_and_it_is_called_once_for_each() -> None:
    calls: list[float] = []

    def push(t: float, q: Any, v: Any) -> list[float]:
        calls.append(t)
        return [100.0 * t, 0.0]

    run = mb.simulate(
        dynamics_of("pinocchio"), Q, V, 0.1, dt=0.01, torque=push, save=[0.0, 0.01, 0.04, 0.1], saturate=True
    )
    assert calls[40:] == pytest.approx([0.0, 0.01, 0.04, 0.1])
    assert run.stats.saturated == (("x", 0.5, pytest.approx(0.04), pytest.approx(8.5)),)
    assert run.tau[:, 0] == pytest.approx([0.0, 1.0, 1.5, 1.5])
    assert len(calls) == 44


def test_a_policy_is_asked_once_for_each_kept_time() -> None:
    asked: list[list[int]] = []

    def push(t: float, q: Any, v: Any, members: Any) -> Any:
        asked.append(members.tolist())
        return np.column_stack([2.0 * members, 0.0 * members])

    run = mb.simulate(
        dynamics_of("pinocchio"), np.tile(Q, (3, 1)), V, 0.04, dt=0.02, torque=Policy(push), saturate=True
    )
    assert asked[8:] == [[0, 1, 2]] * 3
    assert run.stats.saturated == (("x", pytest.approx(2 / 3), 0.0, 2.5),)
    assert run.tau[:, 0, 0].tolist() == [0.0, 1.5, 1.5]


def test_the_record_travels(tmp_path: Path) -> None:
    run = run_of("pinocchio rk4", law, saturate=True)
    run.save(tmp_path / "run.npz")
    for again in (Trajectory.load(tmp_path / "run.npz", run.model), pickle.loads(pickle.dumps(run))):
        assert again.stats.saturated == run.stats.saturated
        assert again.stats.saturated[0].fraction > 0
        assert np.array_equal(again.tau, run.tau)


def test_a_function_that_fails_still_tells_what_acted() -> None:
    def push(t: float, q: Any, v: Any) -> list[float]:
        if t > 0.05:
            raise ValueError("enough")
        return [4.0, 0.0]

    for hold in (None, 0.02):
        with pytest.raises(TorqueError, match="enough") as failed:
            run_of("compiled rk4", push, saturate=True, hold=hold)
        (one,) = failed.value.trajectory.stats.saturated
        assert (one.velocity, one.first, one.excess) == ("x", 0.0, 2.5)


def test_wrong_answers_are_named_as_ever() -> None:
    for hold in (None, 0.02):
        with pytest.raises(TorqueError, match=r"expected shape \(2,\), got \(3,\); it is what the callable returned"):
            run_of("compiled rk4", lambda t, q, v: [1.0, 2.0, 3.0], saturate=True, hold=hold)


# Refusals


@pytest.mark.parametrize("value", [1, "yes", None, 0.0])
def test_saturate_is_true_or_false(value: Any) -> None:
    with pytest.raises(InputError, match="saturate: expected True or False, got"):
        mb.simulate(dynamics_of("pinocchio"), Q, V, 0.1, saturate=value)


def test_without_effort_limits_nothing_can_saturate() -> None:
    for dyn in (mb.dynamics(mb.catalog.double_pendulum()), dynamics_of("pinocchio", crane().without("limits"))):
        with pytest.raises(
            InputError, match=rf"saturate: expected joints with effort_limit=...; {dyn.model.name} has none$"
        ):
            mb.simulate(dyn, Q, V, 0.1, torque=[5.0, 0.0], saturate=True)
    system = mb.lagrangian.from_model(mb.catalog.four_bar())
    q, v = system.dynamics().project([0.5, 0.0, 1.0], [1.0, 0.0, 0.0])
    with pytest.raises(InputError, match="saturate: expected joints with effort_limit"):
        mb.simulate(system.embedded(), q, v, 0.1, torque=np.ones(3), saturate=True)


def test_limits_of_mimic_joints_are_left_out_aloud() -> None:
    def fingers(limit: float) -> mb.Model:
        b = mb.ModelBuilder("fingers")
        for name, own, more in (("left", limit, {}), ("right", 0.5, {"mimic": ("left", -1.0, 0.0)})):
            b.add_joint(
                name, "prismatic", parent="world", child=f"{name}_tip", axis=(1, 0, 0), effort_limit=own, **more
            )
            b.add_body(f"{name}_tip", mass=1.0, inertia=np.eye(3))
        return b.build()

    dyn = mb.dynamics(fingers(2.0))
    with pytest.warns(MbkitWarning, match="effort limits act on independent joints; those of mimic joints .*: right"):
        run = mb.simulate(dyn, [0.0], [0.0], 0.1, dt=0.01, torque=[3.0], saturate=True)
    assert run.tau.tolist() == [[2.0]] * 11
    with pytest.raises(InputError, match="has none; those of mimic joints do not act in a run: right"):
        mb.simulate(mb.dynamics(fingers(np.inf)), [0.0], [0.0], 0.1, saturate=True)
