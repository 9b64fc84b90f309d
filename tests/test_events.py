# Events have the signature they are called with.
# ruff: noqa: ARG001, ARG005
"""Events: what is found, how exactly, and functions that misbehave."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit.engines import dynamics
from mbkit.errors import EventError, InputError, UnknownNameError, UnsupportedError
from mbkit.methods.registry import Tolerances
from mbkit.model import Model
from mbkit.simulate import Event, at_energy, at_limits, at_section, simulate
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.progress import Progress
from mbkit.simulate.solvers.adaptive import run_embedded
from mbkit.simulate.solvers.stretches import Stretch, run_in_stretches
from mbkit.simulate.torque import Torque
from tests.scenes import METHODS, mounted
from validation import closed_forms

SCIPY = ("dop853", "radau", "bdf", "lsoda")
# Tolerance, and what the time of an event is good to with it: that of the trajectory,
# which multistep methods exceed by the most.
EXACT = {"dop853": (1e-12, 1e-10), "radau": (1e-9, 1e-8), "bdf": (1e-10, 1e-6), "lsoda": (1e-12, 1e-8)}


def limited() -> Model:
    place = {"axis": (0, -1, 0), "lower": -0.5, "upper": 2.0, "damping": 0.1}
    b = mounted("limited", "rod", "hinge", "revolute", mass=1.0, com=(0, 0, -1.0), **place)
    return b.build()


@pytest.mark.thorough("radau", "bdf")
@pytest.mark.parametrize("method", SCIPY)
def test_a_pendulum_crosses_the_bottom_as_the_elliptic_functions_say(method: str) -> None:
    model = catalog.pendulum()
    rtol, good = EXACT[method]
    run = simulate(
        dynamics(model), [2.0], [0.0], 10.0, method, rtol=rtol, save=[0, 10.0], events=at_section(model, "theta")
    )
    period = closed_forms.pendulum_period(2.0)
    exact = np.arange(period / 4, 10.0, period / 2)
    assert run.stats.ended == "finished"
    assert [hit.name for hit in run.events] == ["theta = 0"] * len(exact)
    assert [hit.t for hit in run.events] == pytest.approx(exact, abs=good)
    speed = 2 * np.sqrt(9.81) * np.sin(1.0)
    for k, hit in enumerate(run.events):
        assert hit.q == pytest.approx([0.0], abs=1e-10)
        assert hit.v == pytest.approx([speed * (-1) ** (k + 1)], abs=10 * good)
        assert hit.member is None


def test_the_states_of_a_one_step_method_at_an_event_are_as_good_as_its_steps() -> None:
    """Radau's interpolant alone would be good to 1e-7 here."""
    model = catalog.pendulum()
    run = simulate(dynamics(model), [2.0], [0.0], 5.0, "radau", rtol=1e-8, events=at_section(model, "theta"))
    for hit in run.events:
        _, v = closed_forms.pendulum_solution(np.array([hit.t]), 2.0)
        assert hit.v == pytest.approx(v, abs=2e-8)


@pytest.mark.parametrize(("direction", "count"), [(-1, 3), (0, 5), (1, 2)])
def test_a_direction_leaves_the_other_crossings_out(direction: int, count: int) -> None:
    model = catalog.pendulum()
    duration = closed_forms.pendulum_period(2.0) * 2.5
    section = at_section(model, "theta", direction=direction)
    run = simulate(dynamics(model), [2.0], [0.0], duration, "dop853", events=section)
    assert len(run.events) == count
    assert all(np.sign(hit.v[0]) == direction for hit in run.events if direction)


@pytest.mark.thorough("radau")
@pytest.mark.parametrize("method", SCIPY)
def test_a_run_ends_at_a_joint_limit(method: str) -> None:
    model = limited()
    save = np.linspace(0, 5, 51)
    run = simulate(dynamics(model), [1.8], [0.0], 5.0, method, rtol=1e-9, save=save, events=at_limits(model))
    assert run.stats.ended == "event"
    assert run.stats.finished
    assert run.stats.reached == run.t[-1] == run.events[-1].t
    assert run.q[-1] == pytest.approx([-0.5], abs=1e-9)
    assert run.v[-1, 0] < 0
    assert np.array_equal(run.t[:-1], save[save < run.t[-1]])
    assert "hinge below -0.5" in run.stats.message
    assert np.array_equal(run.q[-1], run.events[0].q)
    # The states before are those of a run without events.
    free = simulate(dynamics(model), [1.8], [0.0], 5.0, method, rtol=1e-9, save=save)
    assert run.q[:-1] == pytest.approx(free.q[: len(run.t) - 1], abs=1e-6)


def test_a_damped_run_ends_at_an_energy() -> None:
    model = limited()
    dyn = dynamics(model)
    start = simulate(dyn, [1.0], [0.0], 0.0, "dop853").energy()[0]
    bottom = dyn.potential_energy([0.0])
    half = 0.5 * (start + bottom)
    run = simulate(dyn, [1.0], [0.0], 60.0, "dop853", rtol=1e-12, events=at_energy(dyn, half, direction=-1))
    assert run.stats.ended == "event"
    assert run.energy()[-1] == pytest.approx(half, abs=1e-9)
    assert np.all(run.energy()[:-1] > half)
    never = simulate(dyn, [1.0], [0.0], 1.0, "dop853", events=at_energy(dyn, start + 1))
    assert never.stats.ended == "finished"


@pytest.mark.parametrize("method", ["dop853", "bdf"])
def test_each_of_a_batch_ends_by_itself(method: str) -> None:
    model = limited()
    dyn = dynamics(model)
    save = np.linspace(0, 4, 41)
    starts = [[1.8], [0.2], [1.0]]
    run = simulate(dyn, starts, [0.0], 4.0, method, rtol=1e-9, save=save, events=at_limits(model))
    assert run.stats.ended == "event"
    reached = np.array(run.stats.reached)
    assert reached[1] == 4.0
    assert sorted(hit.member for hit in run.events if hit.member is not None) == [0, 2]
    for hit in run.events:
        assert hit.member is not None
        assert reached[hit.member] == hit.t
        alone = simulate(dyn, starts[hit.member], [0.0], 4.0, method, rtol=1e-9, save=save, events=at_limits(model))
        assert hit.t == alone.events[0].t
        assert np.array_equal(np.isfinite(run.q[hit.member, :, 0]), run.t <= hit.t)
        n = len(alone.t) - 1
        assert np.array_equal(run.q[hit.member, :n], alone.q[:n])


def test_events_see_unit_quaternions_and_held_torques() -> None:
    model = catalog.heavy_top()
    seen: list[float] = []

    def tilt(t: float, q: np.ndarray, v: np.ndarray) -> float:
        seen.append(float(np.linalg.norm(q)))
        q[:] = 0.0  # what it is given is its own
        return t - 0.025

    tau = np.random.default_rng(0).standard_normal((5, 3))
    q0, save = model.neutral(), np.linspace(0, 0.05, 6)
    for method in SCIPY:
        run = simulate(dynamics(model), q0, [1.0, 20.0, -4.0], 0.05, method, torque=tau, save=save, events=Event(tilt))
        assert run.t[-1] == pytest.approx(0.025, abs=1e-15)
        assert np.array_equal(run.t[:-1], [0.0, 0.01, 0.02])
        # The end is that of a run which has the time among those that it saves.
        held = np.concatenate([tau[:2], tau[2:3], tau[2:3], tau[3:]])
        given = {"rtol": 1e-12, "torque": held, "save": [*save[:3], 0.025, *save[3:]]}
        other = simulate(dynamics(model), q0, [1.0, 20.0, -4.0], 0.05, "dop853", **given)
        assert run.v[-1] == pytest.approx(other.v[3], abs=1e-5)
    assert seen == pytest.approx(np.ones(len(seen)), abs=1e-12)


def test_a_function_that_is_zero_at_the_start_or_only_touches_zero_is_no_crossing() -> None:
    model = catalog.pendulum()
    dyn = dynamics(model)
    start = simulate(dyn, [0.0], [1.0], 0.5, "dop853", events=at_section(model, "theta", terminal=True))
    assert start.stats.ended == "finished"
    top = 2 * np.arcsin(1 / (2 * np.sqrt(9.81)))  # where a start at 1 rad/s turns
    touch = Event(lambda t, q, v: (q[0] - top) ** 2 + 1e-12, "touch")
    grazing = simulate(dyn, [0.0], [1.0], 2.0, "dop853", events=touch)
    assert grazing.stats.ended == "finished"
    assert not grazing.events


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda t, q, v: np.nan, r"'event' returned nan at t = "),
        (lambda t, q, v: q, r"expected a number from the function"),
        (lambda t, q, v: np.zeros(2), r"expected a number from the function"),
        (lambda t, q, v: None, r"expected a number from the function"),
        (lambda t, q, v: "far", r"expected a number from the function"),
        (lambda t, q, v: np.inf if t > 0.1 else 1.0, r"returned inf at t = "),
    ],
)
def test_functions_that_misbehave_are_named(function: Any, message: str) -> None:
    dyn = dynamics(catalog.pendulum())
    with pytest.raises(InputError, match=message):
        simulate(dyn, [1.0], [0.0], 1.0, "dop853", events=Event(function))


@pytest.mark.parametrize("method", ["dop853", "lsoda"])
def test_what_a_function_raises_gets_through(method: str) -> None:
    def failing(t: float, q: np.ndarray, v: np.ndarray) -> float:
        if t > 0.1:
            raise KeyboardInterrupt
        return 1.0

    with pytest.raises(KeyboardInterrupt):
        simulate(dynamics(catalog.pendulum()), [1.0], [0.0], 1.0, method, events=Event(failing))


def test_bad_events_are_named() -> None:
    model = catalog.pendulum()
    dyn = dynamics(model)
    with pytest.raises(InputError, match="at_limits: pendulum has no joint limits"):
        at_limits(model)
    with pytest.raises(UnknownNameError, match="coordinate"):
        at_section(model, "thet")
    with pytest.raises(InputError, match="direction"):
        Event(lambda t, q, v: 1.0, direction=2)
    for wrong in ({"direction": True}, {"terminal": "no"}):
        with pytest.raises(InputError, match=rf"events: {next(iter(wrong))} of 'event': expected"):
            Event(lambda t, q, v: 1.0, **wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"at_limits: model: expected a Model, got Pin.*mbkit.load"):
        at_limits(dyn)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="at_section: model: expected a Model, got Pin"):
        at_section(dyn, "theta")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"at_energy: dyn: expected a Dynamics, got Model; mbkit.dynamics"):
        at_energy(model, 1.0)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="events: expected"):
        simulate(dyn, [1.0], [0.0], 1.0, "dop853", events=4)  # type: ignore[arg-type]
    for method in (m.name for m in METHODS.values() if not m.events):
        engine = next(iter(METHODS[method].engines), "pinocchio")
        with pytest.raises(UnsupportedError, match=rf"{method}: .*dop853"):
            simulate(mb.dynamics(model, engine), [1.0], [0.0], 1.0, method, events=lambda t, q, v: q[0])


@pytest.mark.parametrize("method", ["rk853", "dop853", "lsoda", "taylor"])
def test_an_event_that_fails_leaves_the_run_up_to_then(method: str) -> None:
    dyn = dynamics(catalog.pendulum(), "lagrangian")

    def fails(t: float, _q: Any, _v: Any) -> float:
        if t > 0.5:
            raise ZeroDivisionError("too late")
        return 1.0

    for function, told in ((fails, "ZeroDivisionError: too late"), (lambda t, q, v: np.nan if t > 0.5 else 1.0, "nan")):
        with pytest.raises(EventError, match=told) as caught:
            simulate(dyn, [1.0], [0.0], 2.0, method, rtol=1e-8, events=function)
        run = caught.value.trajectory
        assert 0 < run.t[-1] <= 0.5 + 0.5
        assert run.stats.ended == "function_failed"
        assert np.isfinite(run.q).all()


# Breaks: a run whose stretches change nothing is the run


def swinging(save: np.ndarray | None, events: tuple[Event, ...] = ()) -> IntegrationProblem:
    """Return two seconds of x = cos t."""
    b = mounted("swing", "mass", "x", "prismatic", mass=1.0, axis=(1, 0, 0), stiffness=1.0)
    dyn, torque, bar = dynamics(b.build(), "lagrangian"), Torque(None, b.build(), None, None), Progress(None, "")
    return IntegrationProblem(
        dyn, "rk853", np.ones(1), np.zeros(1), 0.0, 2.0, Tolerances(1e-12, 1e-12), torque, save, events, bar
    )


@pytest.mark.parametrize("save", [None, np.array([0.0, 0.3, 0.4, 1.1, 2.0])])
def test_breaks_that_change_nothing_leave_the_run_as_it_is(save: np.ndarray | None) -> None:
    ends, hits = [0.3, 1.1, 2.0], []
    meets = Event(lambda t, q, v: q[0] - np.cos(0.3), "meets", terminal=False)
    problem = swinging(save, (meets,))

    def first(t: float, q: np.ndarray, v: np.ndarray) -> Stretch:
        # The first break is a time, the others are events; one is at a saved time, and one at the end.
        end = min(x for x in ends if x > t)
        event = Event(lambda s, q, v: s - end, "break", direction=1)
        where: dict[str, Any] = {"until": end} if t == 0 else {"ends": [event], "end": event.name}
        return Stretch(dyn=problem.dyn, q=q, v=v, follow=follow, **where)

    def follow(hit: Any, t: float, q: np.ndarray, v: np.ndarray, moved: bool) -> Stretch | None:
        hits.append((t, moved))
        return first(t, q, v) if t < 2.0 else None

    record = run_in_stretches(problem, 0, first, lambda _: run_embedded, "")
    t, q, v = record.states
    assert np.isin(ends, t).all()
    assert (np.diff(t) > 0).all()
    assert save is None or np.array_equal(t, save)
    assert np.abs(q[:, 0] - np.cos(t)).max() < 1e-11
    assert np.abs(v[:, 0] + np.sin(t)).max() < 1e-11
    assert [(x.name, pytest.approx(x.t, abs=1e-11)) for x in record.events] == [("meets", 0.3)]
    assert [moved for _, moved in hits] == [True] * 3
    assert record.reached == t[-1] == 2.0


def test_stretches_that_end_where_they_begin_end_the_run() -> None:
    problem, begun = swinging(None), list[float]()

    def first(t: float, q: np.ndarray, v: np.ndarray) -> Stretch:
        begun.append(t)
        end = Event(lambda s, q, v: t + 1e-18 - s, "break")
        return Stretch(dyn=problem.dyn, q=q, v=v, ends=[end], end="break", follow=lambda _, *state: first(*state[:3]))

    record = run_in_stretches(problem, 0, first, lambda _: run_embedded, "no end at t = {t:g} s")
    assert (record.ended, record.message[:9]) == ("step_too_small", "no end at")
    assert len(record.states[0]) == 1
    # Twice, a joint may let go and stop at once.
    assert 2 < len(begun) < 100
