"""Torques that a controller samples: asked once at each sample and held between them, by every method.

The truth is a run cut at the samples: one run for each interval, under a constant torque, from where the last ended.
"""

from __future__ import annotations

import _thread
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import mbkit as mb
from mbkit.errors import InputError, TorqueError, UnsupportedError
from mbkit.simulate import METHODS, Event, Policy, StateFeedback, simulate
from mbkit.simulate.integrate import _intervals
from mbkit.simulate.solvers import compiled_fixed_step, machine_code_blocks

PERIOD, STEP, COUNT = 0.04, 0.01, 4


def law(t, _q, v):
    return -1.5 * v - np.sin(t + 1.0)


def scene(name):
    """Return a model and a state of it."""
    if name == "loop":
        model = mb.catalog.four_bar()
        return model, *mb.dynamics(model).project([0.5, 0.0, 1.0], [1.0, 0.0, 0.0])
    if name == "friction":
        b = mb.ModelBuilder("rubbed")
        b.add_joint("x", "prismatic", parent="world", child="cart", axis=(1, 0, 0), friction=1.0)
        b.add_body("cart", mass=1.0, inertia=np.eye(3))
        b.add_joint("turn", "revolute", parent="cart", child="bob", axis=(0, 1, 0), friction=0.5)
        b.add_body("bob", mass=1.0, com=(0, 0, -0.5), inertia=0.1 * np.eye(3))
        model = b.build()
        return model, np.array([0.0, 0.4]), np.array([0.02, 0.3])
    if name == "free":
        b = mb.ModelBuilder("thrown")
        b.add_joint("base", "free", parent="world", child="box")
        b.add_body("box", mass=1.0, com=(0.1, 0.0, 0.0), inertia=np.diag([0.1, 0.2, 0.25]))
        model = b.build()
        return model, model.neutral(), np.array([0.3, 0.0, 1.0, 2.0, -1.0, 0.5])
    if name == "time":
        b = mb.ModelBuilder("driven")
        b.add_joint("turn", "revolute", parent="world", child="bob", axis=(0, 1, 0))
        b.add_body("bob", mass=1.0, com=(0, 0, -0.5), inertia=0.1 * np.eye(3))
        b.add_joint_force("push", "turn", lambda t, *_: 0.5 * ca.sin(3 * t))
        return b.build(), np.array([0.4]), np.array([0.3])
    return mb.catalog.double_pendulum(), np.array([0.4, -0.2]), np.array([0.3, 0.3])


def dynamics_of(model, engine):
    """Return the dynamics by an engine; "compiled" is the own derivation as machine code."""
    return mb.dynamics(model, "lagrangian", compile=True) if engine == "compiled" else mb.dynamics(model, engine)


def is_on(method, engine):
    return METHODS[method].on("lagrangian" if engine == "compiled" else engine)


def cut(dyn, q, v, method, dt, t0):
    """Return the states at the samples, by one run for each interval."""
    states = []
    for k in range(COUNT):
        begin = t0 + k * PERIOD
        save = None if dt else [begin, begin + PERIOD]
        run = simulate(dyn, q, v, PERIOD, method, dt, torque=law(begin, q, v), save=save, t0=begin, doubt=False)
        q, v = run.q[-1], run.v[-1]
        states.append((q, v))
    return [np.array(x) for x in zip(*states, strict=True)]


CASES = [
    (name, engine, method)
    for name in ("tree", "loop", "friction", "free", "time")
    for engine in ("lagrangian", "pinocchio", "mujoco", "drake", "oracle", "compiled")
    for method in METHODS
    if is_on(method, engine) and (engine != "oracle" or method in ("rk853", "taylor"))
    # A soft loop's states drift, and no run can be cut there.
    if not (name == "loop" and engine in ("mujoco", "drake"))
]
#: Steps of a run that goes on are others than those of runs that start: of loose methods the difference shows.
ERROR = {"bdf": 1e-7, "lsoda": 1e-7} | {name: 1e-6 for name in METHODS if name.startswith("drake")}


@pytest.mark.thorough(every=31)
@pytest.mark.parametrize(("name", "engine", "method"), CASES)
def test_a_sampled_torque_is_that_of_runs_cut_at_the_samples(name, engine, method):
    """Each method asks once at each sample, of one state, of a batch and of a policy."""
    model, q, v = scene(name)
    dyn, dt, t0 = dynamics_of(model, engine), None if METHODS[method].kind == "adaptive" else STEP, 0.5
    try:
        expected = cut(dyn, q, v, method, dt, t0)
    except UnsupportedError:
        with pytest.raises(UnsupportedError):
            simulate(dyn, q, v, COUNT * PERIOD, method, dt, torque=law, hold=PERIOD, t0=t0)
        return
    asked: list[float] = []

    def told(t, q, v):
        asked.append(t)
        return law(t, q, v)

    times = t0 + PERIOD * np.arange(1, COUNT + 1)
    setting = {"t0": t0, "save": [t0, *times], "doubt": False, "hold": PERIOD}
    run = simulate(dyn, q, v, COUNT * PERIOD, method, dt, torque=told, **setting)
    assert asked == pytest.approx([t0, *times[:-1]])
    close = {"rtol": 0, "atol": ERROR.get(method, 1e-9)}
    for got, want in zip((run.q[1:], run.v[1:]), expected, strict=True):
        np.testing.assert_allclose(got, want, **close)
    held = [law(t, q, v) for t, q, v in zip(times, run.q[1:], run.v[1:], strict=True)]
    np.testing.assert_allclose(run.tau[1:-1], held[:-1], **close)
    members: list[list[int]] = []

    def of_all(t, q, v, who):
        members.append(who.tolist())
        return law(t, q, v)

    pair = np.stack([q, q]), np.stack([v, v])
    both = simulate(dyn, *pair, COUNT * PERIOD, method, dt, torque=Policy(of_all), **setting)
    np.testing.assert_allclose(both.q, np.stack([run.q] * 2), **close)
    assert sorted(i for who in members for i in who) == [0] * COUNT + [1] * COUNT


@pytest.mark.parametrize("method", ["rk853", "dop853", "auto", "taylor"])
def test_an_event_ends_a_run_between_two_samples(method):
    """The event's time and state by SciPy, with the torque of the sample before."""
    model, q, v = scene("tree")
    dyn, bare = mb.dynamics(model, "lagrangian"), mb.dynamics(model, "pinocchio")
    t, x, found = 0.0, np.concatenate([q, v]), None
    for _ in range(50):
        if found is not None:
            break
        tau = law(t, x[:2], x[2:])

        def rate(_t, x, tau=tau):
            return np.concatenate([x[2:], bare.forward_dynamics(x[:2], x[2:], tau)])

        def passes(_t, x):
            return x[0] - 0.1

        passes.terminal = True
        part = solve_ivp(rate, (t, t + PERIOD), x, "DOP853", rtol=1e-12, atol=1e-12, events=passes)
        found = (part.t_events[0][0], part.y_events[0][0]) if len(part.t_events[0]) else None
        t, x = t + PERIOD, part.y[:, -1]
    assert found is not None
    stop = Event(lambda _t, q, _v: q[0] - 0.1, "first joint")
    run = simulate(dyn, q, v, 2.0, method, torque=law, hold=PERIOD, events=stop)
    assert run.stats.ended == "event"
    assert run.t[-1] == pytest.approx(found[0], abs=1e-8)
    np.testing.assert_allclose(np.concatenate([run.q[-1], run.v[-1]]), found[1], atol=1e-7)
    assert np.abs(run.power_balance()).max() < 1e-8


def test_a_sampled_run_has_all_that_a_run_has():
    """Doubts and checks, friction's events, the balance of power, a saved file."""
    model, q, v = scene("friction")
    run = simulate(mb.dynamics(model, "lagrangian"), q, v, 1.0, dt=STEP, torque=law, hold=PERIOD)
    assert run.check()
    assert any("stops" in hit.name for hit in run.events)
    assert np.abs(run.power_balance()).max() < 1e-6
    tree = mb.dynamics(scene("tree")[0])
    wild = simulate(tree, [1.0, 0.5], [0.0, 0.0], 10.0, dt=0.5, torque=law, hold=0.5, doubt=False)
    assert not wild.check()


#: Machine code, steps and stages in Python, and an engine's own run.
OF_EACH_KIND = [("compiled", "rk4"), ("compiled", "gauss4"), ("pinocchio", "rk4"), ("mujoco", "mujoco_rk4")]


@pytest.mark.parametrize(("engine", "method"), OF_EACH_KIND)
def test_a_trajectory_that_ended_is_asked_no_more(engine, method):
    """One of three runs away; the others go on, and a policy gets the states of these."""
    dyn = dynamics_of(scene("tree")[0], engine)
    who: list[list[int]] = []

    def push(_t, q, v, members):
        who.append(members.tolist())
        assert np.isfinite([q, v]).all()
        return np.where(members[:, None] == 1, 1e80, 0.1) * np.ones(2)

    q, v = np.tile([0.1, 0.2], (3, 1)), np.zeros((3, 2))
    with pytest.warns(mb.errors.MbkitWarning, match="1 of 3 trajectories diverged"):
        run = simulate(dyn, q, v, 0.4, method, dt=STEP, torque=Policy(push), hold=PERIOD)
    assert [0, 1, 2] in who
    assert who[-1] == [0, 2]
    alone = simulate(dyn, q[0], v[0], 0.4, method, dt=STEP, torque=[0.1, 0.1])
    np.testing.assert_allclose(run.q[[0, 2]], np.stack([alone.q] * 2), atol=1e-13)
    assert np.isnan(run.q[1, -1]).all()
    assert run.stats.reached[1] < 0.1


@pytest.mark.parametrize("engine", ["compiled", "pinocchio"])
@pytest.mark.parametrize("batch", [False, True])
def test_a_trajectory_that_ends_late_keeps_the_samples_before(engine, batch):
    """The states up to there are those of a run under the same torques as an array."""

    def push(t, _q, v):
        return np.full(v.shape, 1e80 if t > 0.195 else np.sin(50.0 * t))

    model, q, v = scene("tree")
    policy = Policy(lambda t, q, v, members: np.where(members[:, None] == 1, push(t, q, v), 0.1))
    given = (np.stack([q, q]), np.stack([v, v]), 0.4) if batch else (q, v, 0.4)
    with pytest.warns(mb.errors.MbkitWarning, match=r"diverged after t = 0\.2 s.*grew beyond all bounds"):
        run = simulate(dynamics_of(model, engine), *given, dt=STEP, torque=policy if batch else push, hold=PERIOD)
    table = np.array([push(PERIOD * (k // 4), q, v) for k in range(20)])
    until = simulate(mb.dynamics(model), q, v, 0.2, dt=STEP, torque=table)
    np.testing.assert_allclose(run.q[1, :21] if batch else run.q, until.q, rtol=0, atol=1e-12)


def test_an_interrupt_does_not_wait_for_the_samples_of_a_block(request):
    """Ctrl-C while several threads meet at slow samples."""
    # A shell lets background processes ignore it.
    request.addfinalizer(
        partial(signal.signal, signal.SIGINT, signal.signal(signal.SIGINT, signal.default_int_handler))
    )
    begun: list[float] = []

    def slow(_t, _q, v, _members):
        begun.append(time.monotonic())
        if len(begun) == 3:
            _thread.interrupt_main()
        time.sleep(0.05)
        return -v

    model, q, v = scene("tree")
    dyn = mb.dynamics(model, "lagrangian", compile=True, threads=2)
    with pytest.raises(KeyboardInterrupt):
        simulate(dyn, np.tile(q, (40, 1)), np.tile(v, (40, 1)), 5.0, dt=STEP, torque=Policy(slow), hold=STEP)
    assert len(begun) < 20


def test_saved_times_beside_the_ends_are_no_samples():
    """Times that are the start or the end but for rounding; and many of them beside many samples."""
    model, q, v = scene("tree")
    dyn = mb.dynamics(model)
    plain, beside = (
        simulate(dyn, q, v, 0.1, "rk853", torque=law, hold=PERIOD, save=save)
        for save in ([0.0, 0.05, 0.1], [1e-9, 0.05, 0.1 - 1e-9])
    )
    np.testing.assert_allclose(beside.q, plain.q, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(beside.tau[0], plain.tau[0])
    ends, begins, _ = _intervals(np.linspace(0.0, 100.0, 100_001), 0.0, 100.0, 1e-3, rows=False)
    np.testing.assert_allclose(ends, np.linspace(0.0, 100.0, 100_001), rtol=0, atol=1e-12)
    assert begins[-1] == 100_000


@pytest.mark.parametrize("engine", ["compiled", "pinocchio"])
@pytest.mark.parametrize("setting", [{"dt": STEP}, {"method": "rk853", "save": [0.5]}])
def test_a_run_of_no_time_has_the_torque_of_its_state(engine, setting):
    model, q, v = scene("tree")
    dyn = dynamics_of(model, engine)
    run = simulate(dyn, q, v, 0.0, torque=law, hold=PERIOD, t0=0.5, **setting)
    np.testing.assert_array_equal(run.tau, [law(0.5, q, v)])
    pair = simulate(dyn, [q, q], [v, 2 * v], 0.0, torque=law, hold=PERIOD, t0=0.5, **setting)
    np.testing.assert_array_equal(pair.tau[:, 0], [law(0.5, q, v), law(0.5, q, 2 * v)])


@pytest.mark.parametrize("engine", ["compiled", "pinocchio"])
def test_progress_ends_with_the_run(engine):
    model, q, v = scene("tree")
    told: list[float] = []
    simulate(dynamics_of(model, engine), q, v, 1.0, dt=STEP, torque=law, hold=PERIOD, progress=told.append)
    assert told[-1] == 1.0


@pytest.mark.parametrize(("engine", "method"), [*OF_EACH_KIND, ("compiled", "rk853"), ("lagrangian", "rk853")])
@pytest.mark.parametrize("batch", [False, True])
def test_a_policy_that_fails_keeps_what_was_computed(engine, method, batch):

    def policy(t, _q, v, _members):
        if t > 0.35:
            raise ValueError("no battery")
        return np.zeros_like(v)

    model, q, v = scene("tree")
    q, v = (np.stack([q, q]), np.stack([v, v])) if batch else (q, v)
    dt = None if method == "rk853" else STEP
    times = np.linspace(0.0, 0.8, 9)
    with pytest.raises(TorqueError, match=r"raised ValueError at t = 0\.4 s.*no battery") as told:
        simulate(dynamics_of(model, engine), q, v, 0.8, method, dt, torque=Policy(policy), hold=0.1, save=times)
    kept = told.value.trajectory
    assert kept.stats.ended == "function_failed"
    assert np.max(kept.stats.reached) == pytest.approx(0.4)
    free = simulate(dynamics_of(model, engine), q, v, 0.4, method, dt, save=times[:5])
    got, want = kept.q[..., :5, :], free.q[..., : kept.q.shape[-2], :]
    if batch and method == "rk853" and engine != "compiled":
        # Stages in Python go trajectory by trajectory, and the second was not begun.
        got, want = got[0], want[0]
    np.testing.assert_allclose(got, want, atol=1e-8)


def test_bad_samples_are_refused():
    dyn = mb.dynamics(scene("tree")[0])
    q = v = np.zeros(2)
    with pytest.raises(InputError, match="expected a callable of"):
        Policy(3.0)
    with pytest.raises(
        TorqueError, match=r"expected shape \(2, 2\), got \(2,\); it is what the callable returned at t"
    ):
        simulate(dyn, [q, q], [v, v], 0.1, dt=STEP, torque=Policy(lambda _t, _q, v, _i: v[0]), hold=PERIOD)
    with pytest.raises(TorqueError, match=r"torque: nan at index \(1,\)"):
        simulate(dyn, q, v, 0.1, dt=STEP, torque=lambda *_: [0.0, np.nan], hold=PERIOD)
    for hold in (0.0, -1.0, np.nan, "a", 0.015, 1e-10, 1e308):
        with pytest.raises(InputError, match="hold: expected"):
            simulate(dyn, q, v, 0.1, dt=STEP, torque=law, hold=hold)
    with pytest.raises(InputError, match="expected a torque function"):
        simulate(dyn, q, v, 0.1, dt=STEP, hold=PERIOD)
    # Times that a double does not tell apart, and more samples than a machine holds.
    for hold, t0, why in ((1e-9, 1e8, "at times that differ"), (1e-11, 0.0, "which would take"), (1e-300, 0.0, "")):
        with pytest.raises(InputError, match=f"hold: .*{why}"):
            simulate(dyn, q, v, 0.1, "rk853", torque=law, hold=hold, t0=t0)


def test_a_feedback_is_sampled_or_acts_at_every_stage():
    """The same law as data: held it is the discrete map's, and without `hold` the continuous motion's."""
    model, q, v = scene("tree")
    feedback = StateFeedback(np.hstack([5.0 * np.eye(2), 2.0 * np.eye(2)]))
    by_function = lambda t, q, v: feedback(t, q, v)  # noqa: E731
    dyn = dynamics_of(model, "compiled")
    for hold in (None, PERIOD):
        runs = [simulate(dyn, q, v, 0.4, dt=STEP, torque=f, hold=hold) for f in (feedback, by_function)]
        np.testing.assert_allclose(runs[0].q, runs[1].q, atol=1e-13)


def test_a_policy_acts_at_stages_too():
    """Without `hold` it is asked at each stage, of all trajectories at once."""
    model, q, v = scene("tree")
    calls: list[int] = []

    def policy(t, q, v, members):
        calls.append(len(members))
        return law(t, q, v)

    q, v = np.stack([q, 0.5 * q, -q]), np.stack([v, v, v])
    many = simulate(mb.dynamics(model), q, v, 0.2, dt=STEP, torque=Policy(policy))
    assert calls == [3] * 80
    one = simulate(mb.dynamics(model), q, v, 0.2, dt=STEP, torque=law)
    np.testing.assert_allclose(many.q, one.q, atol=1e-14)


@pytest.mark.parametrize("hold", [None, PERIOD])
def test_a_policy_may_write_into_what_it_is_given(hold):
    """And answer with the same array each time."""
    model, q, v = scene("tree")
    buffer = np.zeros((2, 2))

    def careless(t, q, v, members):
        buffer[:] = law(t, q, v)
        q[:], v[:], members[:] = 77.0, 99.0, 0
        return buffer

    states = np.stack([q, -q]), np.stack([v, v])
    plain, written = (
        simulate(mb.dynamics(model), *states, 0.2, dt=STEP, torque=torque, hold=hold)
        for torque in (law, Policy(careless))
    )
    np.testing.assert_array_equal(written.q, plain.q)


@pytest.mark.thorough(every=2)
@pytest.mark.parametrize("engine", ["compiled", "lagrangian", "pinocchio"])
@pytest.mark.parametrize("method", ["rk4", "moreau"])
def test_dry_friction_of_many_is_that_of_runs_cut_at_the_samples(engine, method):
    """Some start at rest; phases end at steps of their own, between samples and at them."""
    model, (q, v) = scene("friction")[0], np.random.default_rng(3).normal(size=(2, 8, 2))
    q[::2, 1] = v[::2] = 0.0
    dyn = dynamics_of(model, engine)

    def kicks(t, q, _v):
        return np.array([2.5 * np.sign(np.sin(30.0 * t + q[0])), 0.6 * np.cos(45.0 * t)])

    run = simulate(dyn, q, v, 0.4, method, dt=STEP, torque=kicks, hold=PERIOD, save=4)
    for i in range(3):
        state = q[i], v[i]
        for k in range(10):
            part = simulate(dyn, *state, PERIOD, method, dt=STEP, torque=kicks(k * PERIOD, *state), doubt=False)
            state = part.q[-1], part.v[-1]
            np.testing.assert_allclose(
                np.concatenate([run.q[i, k + 1], run.v[i, k + 1]]), np.concatenate(state), atol=1e-12
            )


@pytest.mark.parametrize("engine", ["compiled", "pinocchio"])
def test_a_sample_of_impulses_that_fails_keeps_what_was_computed(engine):
    model, q, v = scene("friction")
    torque = {"hold": PERIOD, "torque": lambda t, *_: [1 / (t < 0.19), 0.0]}
    with pytest.raises(TorqueError, match=r"ZeroDivisionError at t = 0\.2 s") as told:
        simulate(dynamics_of(model, engine), q, v, 0.4, "moreau", STEP, **torque)
    assert told.value.trajectory.t[-1] == pytest.approx(0.2)


@pytest.mark.parametrize("method", ["rk4", "gauss4"])
def test_a_sampled_batch_takes_no_more_threads_than_it_may(method):
    """And has the same states with one thread as with three."""
    model, q, v = scene("tree")
    q, v = np.linspace(0.5, 1.0, 300)[:, None] * q, np.tile(v, (300, 1))
    runs = []
    for threads in (1, 3):
        seen = set()

        def policy(t, q, v, _members, seen=seen):
            seen.add(threading.get_ident())
            return law(t, q, v)

        dyn = mb.dynamics(model, "lagrangian", compile=True, threads=threads)
        runs.append(simulate(dyn, q, v, 0.1, method, dt=STEP, torque=Policy(policy), hold=STEP))
        assert len(seen) <= threads
    np.testing.assert_array_equal(runs[0].q, runs[1].q)


def test_a_sampled_run_passes_a_singular_pose_as_a_run_without_samples_does():
    """A torque of zero at each step: the same bits, and the same words about the pose."""
    dyn = mb.dynamics(mb.catalog.four_bars(n=1), "lagrangian", compile=True)
    side = np.array([-1.0 if name.startswith("phi") else 1.0 for name in dyn.model.coordinate_names])
    start = (1.0 * side, 3.0 * side, 1.0)
    with pytest.warns(mb.errors.DoubtfulRunWarning, match="singular pose"):
        plain = simulate(dyn, *start, dt=STEP, doubt=False)
    with pytest.warns(mb.errors.DoubtfulRunWarning, match="singular pose"):
        run = simulate(dyn, *start, dt=STEP, torque=lambda _t, _q, v: 0 * v, hold=STEP, doubt=False)
    assert run.stats.doubts == plain.stats.doubts
    np.testing.assert_array_equal(run.q, plain.q)


@pytest.mark.parametrize(("members", "period", "threads"), [(200, 1, 1), (200, 64, 4), (2200, 1, 2)])
def test_threads_share_a_batch_where_enough_is_between_two_samples(members, period, threads, monkeypatch):
    """They meet at each sample, which takes as long as some hundred steps."""
    seen: list[int] = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, count: int) -> None:
            seen.append(count)
            super().__init__(count)

    monkeypatch.setattr(machine_code_blocks, "ThreadPoolExecutor", Pool)
    monkeypatch.setattr(compiled_fixed_step, "cores", lambda: 4)
    dyn = mb.dynamics(mb.catalog.pendulum(), "lagrangian", compile=True)
    push = Policy(lambda _t, q, _v, _i: -q)
    q = np.linspace(-1.0, 1.0, members)[:, None]
    simulate(dyn, q, 0 * q, 64 * STEP, dt=STEP, torque=push, hold=period * STEP, save=64)
    assert seen == ([threads] if threads > 1 else [])
