# Torques have the signature they are called with.
# ruff: noqa: ARG001, ARG002, ARG005
"""Every method meets bad input, torque functions that fail, interruption and divergence; none loses what it has."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
import time
import warnings
from functools import cache
from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit._check import finite_array
from mbkit.engines import Dynamics, dynamics
from mbkit.errors import InputError, MbkitWarning, NumericalError, TorqueError, UnknownNameError
from mbkit.simulate import Event, simulate
from mbkit.simulate.time_grid import Grid
from tests.scenes import METHODS, mounted, slider

EPS = float(np.finfo(float).eps)
ADAPTIVE = [m.name for m in METHODS.values() if m.kind == "adaptive"]
ASKING = [m.name for m in METHODS.values() if m.callables]
END = 0.1
#: Of first order: steps by the default tolerances are a thousand times those of the others.
FIRST_ORDER = {"drake_implicit_euler": {"rtol": 1e-3}}


def dynamics_for(method: str, model: Any = None) -> Dynamics:
    engine = METHODS[method].engines[:1]
    return pendulum(*engine) if model is None else dynamics(model, *engine)


@cache
def pendulum(*engine: str) -> Dynamics:
    return dynamics(catalog.pendulum(), *engine)


def saved(method: str, duration: float = END) -> dict[str, Any]:
    """Equal times, which every adaptive method and every step of 1 ms can keep."""
    return {"save": np.linspace(0, duration, 101)} if method in ADAPTIVE else {}


# Times


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("duration", "dt"), [(0.0, 1e-3), (0.0105, 1e-3), (0.1, 0.3), (0.1, 1e300), (1e-9, 1e-3)])
def test_every_method_ends_exactly_at_the_end(method: str, duration: float, dt: float) -> None:
    save = [0.0, duration] if duration else [0.0]
    for states in ([0.1], [[0.1], [0.2]]):
        step = FIRST_ORDER.get(method, {}) if method in ADAPTIVE else {"dt": dt}
        run = simulate(dynamics_for(method), states, [0.3], duration, method, **step, save=save)
        assert run.t.tolist() == save
        assert run.stats.finished
        assert np.isfinite(run.q).all()
        assert np.all(run.stats.reached == np.full(np.shape(states)[:-1], duration))
        if duration > 1e-3:
            assert np.abs(run.q[..., -1, :] - run.q[..., 0, :]).max() > 1e-4


@pytest.mark.parametrize("method", ["rk4", "gauss4", "dop853", "bdf", "mujoco_rk4"])
def test_a_batch_of_none_has_its_times(method: str) -> None:
    run = simulate(dynamics_for(method), np.zeros((0, 1)), np.zeros((0, 1)), END, method, save=[0.0, END])
    assert run.t.tolist() == [0.0, END]
    assert run.q.shape == (0, 2, 1)


def test_a_tolerance_that_cannot_be_met_is_named() -> None:
    # At rest the absolute one is all there is.
    with pytest.warns(MbkitWarning, match="step below rounding at rtol = 1e-10, atol = 1e-300"):
        run = simulate(dynamics(catalog.pendulum()), [1.0], [0.0], END, "dop853", atol=1e-300)
    assert run.stats.ended == "step_too_small"


@pytest.mark.parametrize("start", [0.0, 3.3, -1e4])
def test_grids_name_their_own_times(start: float) -> None:
    for duration, dt in ((0.0, 1e-3), (1.0, 0.1), (1.0, 0.3), (0.7, 1 / 3), (5.0, 7.0)):
        grid = Grid.of(start, duration, dt)
        assert grid.times.tolist() == [grid.time(k) for k in range(grid.steps + 1)]
        assert (grid.times[0], grid.times[-1]) == (start, start + duration)


@pytest.mark.parametrize("method", METHODS)
def test_a_step_and_a_tolerance_are_refused_where_a_method_has_none(method: str) -> None:
    wrong = {"dt": 1e-3} if method in ADAPTIVE else {"rtol": 1e-6}
    with pytest.raises(InputError, match=f"^{next(iter(wrong))}: {method} .*give"):
        simulate(dynamics_for(method), [0.1], [0.3], END, method, **wrong, **saved(method))


@pytest.mark.parametrize("start", [3.0, -2.0])
@pytest.mark.parametrize("method", METHODS)
def test_a_start_time_shifts_all_times(method: str, start: float) -> None:
    """Nothing here depends on the time, so that states are the same; all times are shifted."""
    dyn = dynamics_for(method)
    save, more = np.linspace(0, END, 11), FIRST_ORDER.get(method, {})
    early, late = (simulate(dyn, [0.9], [0.3], END, method, save=t + save, t0=t, **more) for t in (0.0, start))
    assert late.t.tolist() == (start + save).tolist()
    assert late.stats.reached == start + END
    # Times near 3 s have some bits less for the lengths of steps.
    size = np.abs(early.q).max()
    assert np.abs(late.q - early.q).max() <= (1e-9 if method in ADAPTIVE else 64 * EPS) * size
    assert np.abs(late.energy() - early.energy()).max() <= 1e-7


@pytest.mark.parametrize("start", [2.0, -END / 2])
@pytest.mark.parametrize("method", [m for m in ASKING if not METHODS[m].engines])
def test_torque_functions_and_events_get_the_time_from_t0(method: str, start: float) -> None:
    seen: list[float] = []

    def torque(t: float, q: np.ndarray, v: np.ndarray) -> list[float]:
        seen.append(t)
        return [np.sin(5 * t)]

    dyn = dynamics_for(method)
    run = simulate(dyn, [0.1], [0.0], END, method, torque=torque, t0=start, save=[start, start + END])
    assert start <= min(seen) < max(seen) <= start + END + EPS
    shifted = simulate(dyn, [0.1], [0.0], END, method, torque=lambda t, q, v: [np.sin(5 * (t + start))], save=[0, END])
    assert np.abs(run.q[-1] - shifted.q[-1]).max() <= 1e-9
    if METHODS[method].events:
        at = Event(lambda t, q, v: t - start - END / 2, "half", terminal=True)
        ended = simulate(dyn, [0.1], [0.0], END, method, events=at, t0=start)
        assert ended.stats.reached == pytest.approx(start + END / 2, abs=1e-9)
        assert ended.events[-1].t == ended.stats.reached


def test_start_times_without_digits_are_refused() -> None:
    for method, given in (("rk4", {}), ("rk853", {"save": [1e15, 1e15 + END]})):
        with pytest.raises(InputError, match=r"^t0: "):
            simulate(pendulum(), [0.1], [0.0], END, method, t0=1e15, **given)
    for method in METHODS:
        with pytest.raises(InputError, match=r"^duration: "):
            simulate(dynamics_for(method), [0.1], [0.3], 1e-320, method, **saved(method, 0.0))


# Of each argument what only it can be: arguments are read before the method is looked at.
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"duration": -1.0}, "duration: expected a number of at least 0"),
        ({"duration": "long"}, "duration: expected a number"),
        ({"dt": 0.0}, "dt: expected a number above 0"),
        ({"dt": np.nan}, "dt: expected a finite number"),
        ({"dt": 10**400}, "dt: expected a number that a double can hold"),
        ({"dt": 1e-300}, "dt: .* expected a larger step"),
        ({"dt": 1e-12}, "save: .* GiB; keep fewer"),
        ({"save": [0.0, 2 * END]}, "save: expected times between 0 and 0.1"),
        ({"save": [0.0, END, END]}, "save: expected increasing times"),
        ({"save": [[0.0], [0.0, END]]}, "save: .*rows of different lengths"),
        ({"save": [0.0, 0.0005]}, "save: 0.0005 s is not a step"),
        ({"save": 0}, "save: expected a count of at least 1"),
        ({"save": True}, "save: expected increasing times"),
        ({"q0": [1j]}, "q0: expected real numbers, got dtype complex128"),
        ({"q0": [[[0.1]]]}, r"q0: expected shape \(1,\) or \(N, 1\)"),
        ({"q0": np.zeros((2, 1)), "v0": np.zeros((3, 1))}, "batches of different sizes"),
        ({"v0": [np.nan]}, "v0: nan at index"),
        ({"torque": ["one"]}, "torque: expected real numbers"),
        ({"torque": 1.0}, r"torque: expected shape \(1,\).*got \(\)"),
        ({"torque": np.zeros((7, 1))}, r"torque: .*got \(7, 1\); pendulum has nv = 1 and the run has 100 steps"),
        ({"torque": np.where(np.arange(100) == 40, np.nan, 0.0)[:, None]}, r"torque: nan at index \(40, 0\)"),
        ({"progress": "yes"}, "progress: expected None, True or a callable"),
        ({"method": "dop853", "rtol": 1e-15}, "rtol: expected at least 2.22e-14"),
        ({"method": "dop853", "atol": 0.0}, "atol: expected a number above 0"),
        ({"method": "dop853", "save": 5}, "save: expected a grid of times for an adaptive method"),
        ({"method": "dop853", "q0": [[0.1], [0.2]]}, "save: expected a grid of times"),
        ({"method": "dop853", "torque": np.zeros((4, 1))}, "one row per interval needs save="),
        ({"method": 4}, "method: expected a name"),
        ({"dyn": catalog.pendulum()}, "dyn: expected a Dynamics, got Model"),
    ],
)
def test_bad_input_is_named(change: dict[str, Any], message: str) -> None:
    usual = {"dyn": pendulum(), "q0": [0.1], "v0": [0.0], "duration": END, "method": "rk4"}
    with pytest.raises(InputError, match=message):
        simulate(**(usual | change))
    with pytest.raises(UnknownNameError, match="unknown method 'RK-4'; did you mean 'rk4'"):
        simulate(**(usual | {"method": "RK-4"}))


@pytest.mark.parametrize("method", ["rk4", "rk853", "mujoco_rk4"])
def test_quaternions_that_are_none_are_refused(method: str) -> None:
    dyn = dynamics_for(method, catalog.heavy_top())
    for q in ([0, 0, 0, 2.0], [0, 0, 0, 0.0], [0.5, 0.5, 0.5, 0.6]):
        with pytest.raises(InputError, match="q0: the quaternion of joint 'spin'"):
            simulate(dyn, q, [0.0, 0, 0], END, method, **saved(method))


# Torque functions


def after(t0: float, wrong: Any) -> Any:
    def torque(t: float, q: np.ndarray, v: np.ndarray) -> Any:
        if t <= t0:
            return [0.1 * np.cos(9 * t)]
        return wrong()

    return torque


def raises() -> None:
    raise ZeroDivisionError("mine")


@cache
def undisturbed(method: str, *, batch: bool) -> np.ndarray:
    """Return the first trajectory's q under a torque that never fails."""
    states: Any = [[0.1], [0.2], [0.3]] if batch else [0.1]
    q = simulate(dynamics_for(method), states, [0.2], END, method, torque=after(END, raises), **saved(method)).q
    return q[0] if batch else q


class _Hostile:
    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise RuntimeError("no array")


ONE, THREE = [0.1], [[0.1], [0.2], [0.3]]
RAISED = (raises, r"torque: the callable raised ZeroDivisionError at t = .*: mine")
#: A function that raises, with every method; whatever else it may return, with one of each kind.
FAILURES: list[Any] = [(m, states, t0, *RAISED) for m in ASKING for states in (ONE, THREE) for t0 in (-1.0, 0.0305)]
FAILURES += [
    (method, ONE, 0.0305, wrong, message)
    for method in ("rk4", "rk853")
    for wrong, message in (
        (lambda: [0.0, 0.0], r"torque: expected shape \(1,\), got \(2,\); it is what the callable returned at t = "),
        (lambda: 0.0, r"torque: expected shape \(1,\), got \(\); .*callable returned at t = "),
        (lambda: [np.nan], r"torque: nan at index .*callable returned at t = "),
        (lambda: [1j], r"torque: expected real numbers, got dtype complex128; .*callable returned at t = "),
        (lambda: "push", r"torque: expected real numbers, .*callable returned at t = "),
        (lambda: None, r"torque: expected real numbers, .*callable returned at t = "),
        (lambda: _Hostile(), r"torque: expected an array of numbers, got _Hostile; .*callable returned at t = "),
    )
]


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize(("method", "states", "t0", "wrong", "message"), FAILURES)
def test_a_torque_that_fails_leaves_the_run_up_to_then(
    method: str, states: Any, t0: float, wrong: Any, message: str
) -> None:
    dyn = dynamics_for(method)
    with pytest.raises(TorqueError, match=message) as caught:
        simulate(dyn, states, [0.2], END, method, torque=after(t0, wrong), **saved(method))
    error = caught.value
    assert isinstance(error, InputError)
    if wrong is raises:
        assert isinstance(error.__cause__, ZeroDivisionError)
    run = error.trajectory
    assert run.stats.ended == "function_failed"
    assert run.stats.message == str(error)
    assert not run.stats.finished
    if np.ndim(states) == 2:
        assert "for trajectory 0" in str(error)
    if t0 < 0:
        assert np.all(np.asarray(run.stats.reached) == 0.0)
        return
    # The step on which it failed is not kept; those before it are, as they would be without it.
    first = run.q[0] if np.ndim(states) == 2 else run.q
    expected = undisturbed(method, batch=np.ndim(states) == 2)
    good = int(np.isfinite(first).all(-1).sum())
    assert good >= 1
    assert run.t[good - 1] <= 0.031
    if METHODS[method].kind == "fixed":
        assert good >= 31
        assert np.array_equal(first[:good], expected[:good])
    assert pickle.loads(pickle.dumps(error)).trajectory.stats == run.stats


@pytest.mark.parametrize("method", ASKING)
def test_interruption_gets_through(method: str) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    for states in ([0.1], [[0.1], [0.2]]):
        with pytest.raises(KeyboardInterrupt):
            simulate(dynamics_for(method), states, [0.2], END, method, torque=after(0.03, interrupt), **saved(method))


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("method", ASKING)
def test_what_a_torque_does_to_its_arguments_does_not_matter(method: str) -> None:
    kept = np.zeros(1)

    def plain(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array([np.sin(t) - 0.3 * v[0]])

    def careless(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        kept[:] = np.sin(t) - 0.3 * v[0]  # and what it returns is written again the next time
        q[:], v[:] = np.nan, 1e300
        return kept

    for states in ([0.1], [[0.1], [0.2]]):
        runs = [
            simulate(dynamics_for(method), states, [0.2], END, method, torque=f, **saved(method))
            for f in (plain, careless)
        ]
        assert np.array_equal(runs[0].q, runs[1].q)
        assert np.array_equal(runs[0].v, runs[1].v)


# Same input, same bits


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("method", METHODS)
def test_same_input_same_bits(method: str) -> None:
    model = catalog.pendulum() if method == "mujoco_discrete" or method.startswith("drake") else catalog.heavy_top()
    q, v = model.random_state(np.random.default_rng(0), 3)
    more = saved(method) | FIRST_ORDER.get(method, {})
    first, second = (simulate(dynamics_for(method, model), q, v, END, method, **more) for _ in range(2))
    assert np.array_equal(first.q, second.q)
    assert np.array_equal(first.v, second.v)
    assert first.stats.steps == second.stats.steps


# Batches

#: How far a method's run of a few steps of 10 ms, or with a tolerance of 1e-9, may be from the motion.
FAR = {"semi_implicit_euler": 0.05, "moreau": 0.05, "implicit_midpoint": 1e-3}


@pytest.mark.thorough("True-gauss6", "True-auto", "True-dop853", "True-radau", "True-bdf", "True-lsoda")
@pytest.mark.parametrize("method", [m.name for m in METHODS.values() if not m.engines or "lagrangian" in m.engines])
@pytest.mark.parametrize("compiled", [False, True])
def test_a_batch_is_its_members_with_torques_and_parameters_of_their_own(method: str, compiled: bool) -> None:
    model = catalog.double_pendulum(mass1=mb.Parameter("m", 2.0))
    dyn, masses, grid = dynamics(model, "lagrangian", compile=compiled), [0.5, 1.0, 3.0], np.linspace(0, 0.04, 5)
    q, v = model.random_state(np.random.default_rng(0), 3)
    torque = np.random.default_rng(1).standard_normal((3, 4, 2))
    given = {"save": grid} | ({"dt": 0.01} if METHODS[method].kind == "fixed" else {"rtol": 1e-9})
    many = simulate(dyn.at(m=masses), q, v, 0.04, method, torque=torque, **given)
    assert np.array_equal(many.stats.reached, np.full(3, 0.04))
    for i, mass in enumerate(masses):
        one = simulate(dyn.at(m=mass), q[i], v[i], 0.04, method, torque=torque[i], **given)
        assert np.abs(many.q[i] - one.q).max() <= 1e-12
        assert np.abs(many.v[i] - one.v).max() <= 1e-11
        plain = dynamics(catalog.double_pendulum(mass1=mass), "pinocchio")
        truth = simulate(plain, q[i], v[i], 0.04, "dop853", rtol=1e-12, torque=torque[i], save=grid)
        assert np.abs(one.q - truth.q).max() < FAR.get(method, 1e-6)
    # One state beside a batch is repeated.
    both = simulate(dyn.at(m=1.0), q[:2], v[1], 0.04, method, torque=torque[:2], **given)
    assert np.abs(both.q[1] - many.q[1]).max() <= 1e-12


# Divergence


@pytest.mark.thorough("auto", "rodas5", "radau", "bdf")
@pytest.mark.parametrize("method", METHODS)
def test_a_run_away_keeps_what_it_has_and_says_when(
    method: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log where it stands
    if not METHODS[method].callables:
        pytest.skip("no torque function, so nothing to run away with")
    b = slider("pushed_away")
    model = b.build()
    with pytest.warns(MbkitWarning, match="pushed_away: .* after t = ") as told:
        run = simulate(
            *(dynamics_for(method, model), [0.0], [1.0], 0.3, method),
            torque=lambda t, q, v: 1e4 * v,
            rtol=1e-6 if method in ADAPTIVE else None,
            **saved(method, 0.3),
        )
    assert len(told) == 1
    assert run.stats.ended in ("diverged", "step_too_small")
    assert run.stats.message
    assert isinstance(run.stats.reached, float)
    assert run.t[-1] <= run.stats.reached < 0.3
    assert np.isfinite(run.q).all()
    assert np.isfinite(run.v).all()


class _Wall(Dynamics):
    """A pendulum whose engine fails past 1 rad; not in the registry."""

    engine = "wall"

    def _forward_dynamics(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        if np.any(q > 1.0):
            raise NumericalError("wall: no acceleration past 1 rad")
        return tau - 9.81 * np.sin(q)

    def _other(self, *_: Any) -> np.ndarray:
        raise NotImplementedError

    _mass_matrix = _potential_energy = _kinetic_energy = _gravity = _nle = _passive = _inverse_dynamics = _other
    _pose = _jacobian = _other


@pytest.mark.parametrize("method", [m for m in ASKING if not METHODS[m].engines])
def test_an_engine_that_fails_ends_the_run_close_to_there(method: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.warns(MbkitWarning, match=r"no acceleration past 1 rad") as heard:
        run = simulate(_Wall(catalog.pendulum()), [0.9], [2.0], 1.0, method, rtol=1e-8 if method in ADAPTIVE else None)
    assert len(heard) == 1
    assert run.stats.ended == "diverged"
    assert 0.04 < run.stats.reached < 0.06
    assert 0.98 < run.q[-1, 0] <= 1.002
    assert run.t[-1] == run.stats.reached
    with pytest.warns(MbkitWarning):
        assert simulate(_Wall(catalog.pendulum()), [1.1], [0.0], 1.0, method).stats.reached == 0.0
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("method", [m.name for m in METHODS.values() if not m.engines])
def test_a_rotation_that_overflows_is_a_divergence(method: str, capfd: pytest.CaptureFixture[str]) -> None:
    box = catalog.free_body()
    for engine in ("lagrangian", "pinocchio"):
        with pytest.warns(MbkitWarning, match=r"after t = 0(\.001)? s"):
            run = simulate(dynamics(box, engine), box.neutral(), [0, 0, 0, 0, 0, 1e155], END, method, **saved(method))
        assert run.stats.ended in ("diverged", "step_too_small")
        assert len(run.t) < 3
        assert np.isfinite(run.q).all()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("method", [m.name for m in METHODS.values() if not m.engines or "lagrangian" in m.engines])
def test_a_model_without_velocities_stands_still(method: str) -> None:
    b = mounted("stone", "stone", "glue", "fixed", mass=1.0)
    for compiled in (True, False):
        run = simulate(dynamics(b.build(), "lagrangian", compile=compiled), [], [], END, method, **saved(method))
        assert run.q.shape == (101, 0)


@pytest.mark.thorough("auto", "rodas5", "radau", "bdf")
@pytest.mark.parametrize("method", [m for m in ASKING if not METHODS[m].engines])
def test_a_run_away_is_not_blamed_on_the_torque(method: str) -> None:
    """τ = 3 v |v| grows without bounds in finite time; squared, a stage's velocity overflows."""
    dyn = dynamics(catalog.double_pendulum())
    with pytest.warns(MbkitWarning, match=r"after t = 0\.[23]"):
        run = simulate(
            *(dyn, [1.0, 0.5], [0.0, 0.0], 2.0, method),
            **({"rtol": 1e-6} if method in ADAPTIVE else {"dt": 1e-2}),
            torque=lambda t, q, v: 3 * v * abs(v),
        )
    assert run.stats.ended in ("diverged", "step_too_small")


_NATIVE = """
import sys
import mbkit as mb, mbkit.engines.drake.engine as rollout
# With steps as long as these Drake does not come back.
rollout.SimulatorConfig = lambda config=rollout.SimulatorConfig, **given: config(max_step_size=1e9, **given)
over = rollout.DrakeRun.over
def waiting(self, t):
    print("running", flush=True)
    return over(self, t + 1.0)
rollout.DrakeRun.over = waiting
model = mb.catalog.double_pendulum()
if {study}:
    mb.work_precision(model, engines=["drake"], methods=["drake_runge_kutta5"], duration=1.0)
else:
    mb.simulate(mb.dynamics(model, "drake"), [1.0, 0.5], [0.0, 0.0], 1.0, "drake_runge_kutta5", save=[0, 1])
"""


def test_drake_s_own_steps_are_no_longer_than_its_own_longest() -> None:
    pytest.importorskip("pydrake")
    model = mb.catalog.double_pendulum()
    arguments = [1.0, 0.5], [0.0, 0.0], 1.0
    run = mb.simulate(mb.dynamics(model, "drake"), *arguments, "drake_runge_kutta5", save=[0, 1])
    exact = mb.simulate(mb.dynamics(model, "lagrangian"), *arguments, "rk853", rtol=1e-12, save=[0, 1])
    assert abs(run.q - exact.q).max() < 1e-7


@pytest.mark.thorough("True")
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("study", [False, True])
def test_a_native_run_ends_at_ctrl_c(study: bool) -> None:
    pytest.importorskip("pydrake")
    process = subprocess.Popen(
        [sys.executable, "-c", _NATIVE.format(study=study)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "running\n"
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        # Two seconds, and more on a machine with other work.
        _, said = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode
    assert "Interrupt" in said


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_large_table_is_read_in_pieces_between_which_ctrl_c_is_heard() -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    # One number, repeated: it takes no memory, and half a second to be read.
    table, before = np.broadcast_to(1.0, 2**28), signal.signal(signal.SIGPROF, stop)
    try:
        begin = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, 0.05)
        with pytest.raises(KeyboardInterrupt):
            finite_array("torque", table, table.shape)
        assert time.process_time() - begin < 0.15
    finally:
        signal.signal(signal.SIGPROF, before)
    # A wrong number in the middle is named as in a small one.
    table = np.zeros((3, 2**16))
    table[1, 7] = np.nan
    with pytest.raises(InputError, match=r"nan at index \(1, 7\)"):
        finite_array("torque", table, table.shape)


@pytest.mark.thorough("True")
@pytest.mark.parametrize("compiled", [True, False])
def test_a_run_a_step_and_their_work_change_nothing_of_their_arguments(compiled: bool) -> None:
    dyn = dynamics(catalog.four_bar(), "lagrangian", compile=compiled)
    q, v = dyn.project([0.5, 0.0, 1.0], [1.0, 0.0, 0.0])
    frame = dyn.model.bodies[-1].name
    given = {"torque": np.full((10, 3), 0.1), "save": np.arange(11) * 0.01, "wrenches": {frame: np.ones((10, 6))}}
    kept = pickle.dumps((q, v, given))
    calls = (
        lambda: simulate(dyn, q, v, 0.1, dt=0.01, **given).work(),
        lambda: simulate(dyn, q, v, 0.1, dt=0.01, torque=lambda t, q, v: -v, hold=0.05),
        lambda: simulate(dyn, q, v, 0.1, "dop853").check(),
        lambda: dyn.step(q, v, given["torque"][0], 0.01),
        lambda: dyn.step(q, v, given["torque"][0], 0.01, wrenches={frame: np.ones(6)}),
    )
    for call in calls:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "constraint", MbkitWarning)
            call()
        assert pickle.dumps((q, v, given)) == kept
        assert all(x.flags.writeable for x in (q, v, given["torque"], given["save"], given["wrenches"][frame]))
    # Of its first acceleration.
    with pytest.warns(MbkitWarning, match="is open by"):
        dyn.forward_dynamics([0.5, 0.1, 1.0], v, np.zeros(3))
