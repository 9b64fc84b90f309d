# Torques have the signature they are called with.
# ruff: noqa: ARG001, ARG005
"""Method auto: what it chooses, that nothing is lost on the way, and what it says; and the stiffness it goes by."""

from __future__ import annotations

import re
import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit.engines import Dynamics, dynamics
from mbkit.errors import DoubtfulRunWarning, InputError, MbkitWarning, TorqueError
from mbkit.model import Model, ModelBuilder
from mbkit.simulate import Trajectory, at_section, simulate, stiffness
from mbkit.simulate.solvers.auto import StepRateMonitor, _chosen
from mbkit.simulate.solvers.trajectory_record import AcceptedSteps
from mbkit.studies.exact_motions import cart_pole as light_cart_pole
from mbkit.studies.stress import cases
from tests import scenes
from tests.random_trees import SOUND, random_tree
from validation import closed_forms

IN_MACHINE_CODE: dict[str, Any] = {"lagrangian": {"compile": True}, "pinocchio": {}}
QUICK = IN_MACHINE_CODE["lagrangian"]
START: Any = ([1.0, 0.0], [0.0, 0.0], 1.0)
SAVE = np.linspace(0, 1, 9)


def bent_pendulum(stiffness: Any, damping: Any) -> Model:
    """Two rods whose hinge a spring and a damper hold straight."""
    b = ModelBuilder("bent pendulum")
    for name, parent, place in (("a", "world", 0.0), ("b", "a", -1.0)):
        b.add_body(name, mass=1.0, com=(0, 0, -1.0))
        held = {"stiffness": stiffness, "damping": damping} if name == "b" else {}
        b.add_joint(name, "continuous", parent=parent, child=name, axis=(0, -1, 0), translation=(0, 0, place), **held)
    return b.build()


def slider(stiffness: float, damping: float) -> Model:
    return scenes.slider(gravity=(0, 0, 0), stiffness=stiffness, damping=damping).build()


# One form of the equations for all constants, so that the steps are compiled once.
FORM = bent_pendulum(mb.Parameter("k", 1e8), mb.Parameter("c", 1e5))
COMPILED = dynamics(FORM, "lagrangian", compile=True)
INTERPRETED = dynamics(FORM, "lagrangian", compile=False)
WAYS = {"machine code": COMPILED, "interpreted": INTERPRETED, "pinocchio": dynamics(FORM, "pinocchio")}


def tight(dyn: Dynamics = COMPILED, **given: Any) -> Trajectory:
    return simulate(dyn, *START, "rodas5", rtol=1e-12, **given)


def same(a: Trajectory, b: Trajectory) -> bool:
    """Return whether the runs took the same steps; where one looks back, the time of a step may round otherwise."""
    return len(a.t) == len(b.t) and all(
        np.allclose(getattr(a, name), getattr(b, name), rtol=1e-7, atol=1e-7) for name in ("t", "q", "v")
    )


# What it chooses


@pytest.mark.parametrize("way", WAYS)
def test_where_nothing_is_stiff_it_is_rk853_with_a_tenth_of_the_tolerance(way: str) -> None:
    dyn = WAYS[way].at(k=10.0, c=0.1)
    auto, plain = (simulate(dyn, *START, method, rtol=rtol) for method, rtol in (("auto", 1e-9), ("rk853", 0.1 * 1e-9)))
    assert same(auto, plain)
    assert auto.stats.chosen == "rk853 throughout"
    assert plain.stats.chosen == ""
    assert auto.stats.evaluations <= 1.1 * plain.stats.evaluations
    assert (auto.stats.steps, auto.stats.rejected) == (plain.stats.steps, plain.stats.rejected)


@pytest.mark.parametrize("way", WAYS)
def test_where_stability_holds_the_steps_it_goes_on_with_rodas5(way: str) -> None:
    run, truth = simulate(WAYS[way], *START, "auto", rtol=1e-8, save=SAVE), tight(save=SAVE)
    assert np.abs(run.q - truth.q).max() < 1e-7
    assert np.abs(run.v - truth.v).max() < 1e-6
    assert run.stats.steps < 150
    # Explicitly it takes 80,000 steps.
    assert 0 < run.stats.jacobians < 100
    assert run.stats.chosen.startswith("rk853 to t = ")
    assert "fastest decay 5e+05 1/s); rodas5 from there" in run.stats.chosen
    assert run.stats.chosen in str(run.stats)
    assert run.stats.chosen in repr(run)


@pytest.mark.parametrize(("k", "c"), [(1e6, 1e3), (1e12, 1e9), (0.0, 1e10)])
def test_it_holds_however_stiff(k: float, c: float) -> None:
    dyn = COMPILED.at(k=k, c=c)
    run, truth = simulate(dyn, *START, "auto", rtol=1e-8, save=SAVE), tight(dyn, save=SAVE)
    assert np.abs(run.q - truth.q).max() < 1e-7
    assert run.stats.steps < 800


def test_a_stiffness_without_damping_is_passed_over_where_it_does_not_ring() -> None:
    k, angle = 1e10, 1.0
    b = ModelBuilder("elastic pendulum")
    b.add_body("rod")
    b.add_body("bob", mass=1.0, com=(0, 0, -1.0))
    b.add_joint("theta", "continuous", parent="world", child="rod", axis=(0, -1, 0))
    b.add_joint("stretch", "prismatic", parent="rod", child="bob", axis=(0, 0, -1), stiffness=k)
    dyn = dynamics(b.build(), "pinocchio")
    start = [angle, 9.81 * np.cos(angle) / k], [0.0, 0.0], 1.0
    run = simulate(dyn, *start, "auto", rtol=1e-8, save=SAVE)
    rigid, _ = closed_forms.pendulum_solution(SAVE, angle)
    # The rod is longer by 1e-9.
    assert run.q[:, 0] == pytest.approx(rigid, abs=1e-7)
    assert "rodas5 from there" in run.stats.chosen
    assert run.stats.evaluations < 1500


def test_rodas5_is_tried_where_many_steps_are_to_come_though_stability_does_not_hold_them() -> None:
    """A conical pendulum on a stiff damped spring, whose h|λ| is 1.3: rk853 alone takes 700,000 evaluations."""
    problem = cases.get("damped_point_spring").make(1e8)
    times = problem.duration * np.linspace(0.0, 0.98, 11)
    dyn = dynamics(problem.model, "lagrangian", compile=True)
    run = simulate(dyn, problem.q, problem.v, times[-1], "auto", rtol=1e-8, save=times)
    # Of 24,000 steps the errors add up: a tenth of the allowed sum takes 33,000 evaluations, ten times leave 3e-7.
    assert np.abs(run.q - problem.exact(times)).max() < 2e-7 * problem.scale
    assert "rodas5 got further with a trial" in run.stats.chosen
    assert run.stats.evaluations < 28_000


@pytest.mark.parametrize(
    ("case", "value", "engine", "rtol", "evaluations", "error"),
    [
        # Steps in Python are so dear that a look is worth it after five: after ten none is, and rk853 takes 1,300. A
        # look after two comes too early, and the methods take turns; so does a trial of two steps.
        ("flexible_appendage", 1e5, "pinocchio", 1e-8, 600, 1e-6),
        # The first five steps take 1e-10 of the run: believed to go on so, they ask for a tolerance of 1e-13: 12,000.
        ("critically_damped_joint_spring", 1e12, "pinocchio", 1e-8, 4000, 1e-8),
        # Rounding does not hold the steps: the tolerance is not loosened.
        ("damped_point_spring", 1e8, "lagrangian", 1e-10, 90_000, 5e-9),
    ],
)
def test_what_is_hard_takes_few_evaluations_and_keeps_its_error(
    case: str, value: float, engine: str, rtol: float, evaluations: int, error: float
) -> None:
    problem = cases.get(case).make(value)
    times = problem.duration * np.linspace(0.0, 0.98, 11)
    dyn = dynamics(problem.model, engine, **IN_MACHINE_CODE[engine])
    run = simulate(dyn, problem.q, problem.v, times[-1], "auto", rtol=rtol, save=times, doubt=False)
    assert np.abs(run.q - problem.exact(times)).max() < error * problem.scale
    assert not run.stats.doubts
    assert run.stats.evaluations < evaluations


@pytest.mark.parametrize("way", ["interpreted", "pinocchio"])
def test_a_trial_of_rodas5_does_not_begin_with_a_step_as_long_as_the_run(way: str) -> None:
    """With a tenth of the run it spends its steps on rejections: 5,800 evaluations."""
    run = simulate(WAYS[way], *START, "auto", rtol=1e-8, torque=lambda t, q, v: np.zeros(2), save=SAVE)
    assert run.stats.chosen.endswith("rodas5 from there")
    assert run.stats.evaluations < 1500


def test_no_tolerance_is_tighter_than_rounding_allows_and_none_looser_than_that() -> None:
    """rk853 has a tenth of the tolerance, but no less than 1e-13."""
    # Where a light cart passes, accelerations have few digits: a tolerance of 1e-14 takes 23,000 evaluations.
    dyn = mb.lagrangian.from_model(catalog.cart_pole(cart_mass=1e-6)).dynamics()
    run = simulate(dyn, [0.0, np.pi / 2], [0.0, 0.0], 0.6, "auto", rtol=1e-13, save=[0.0, 0.6], doubt=False)
    assert run.q[-1] == pytest.approx(light_cart_pole(np.pi / 2, 1e-6)(np.array([0.6]))[0], abs=1e-8)
    assert run.stats.evaluations < 14_000
    # With 1e-12 and no tenth of it, the error is 5e-12.
    dyn = dynamics(slider(1e6, 0.0), "lagrangian", compile=True)
    swing = simulate(dyn, [1.0], [0.0], 1.0, "auto", rtol=1e-12, save=[0.0, 1.0])
    assert swing.q[-1, 0] == pytest.approx(np.cos(1e3), abs=1.5e-12)


@pytest.mark.thorough("damped_point_spring-10000.0-pinocchio-1e-08-methods3-400")
@pytest.mark.parametrize(
    ("case", "value", "engine", "rtol", "methods", "steps"),
    [
        # Steps are short in passing; taken for a mean, they would let rodas5 begin where it has long ones ahead.
        ("light_cart_pole", 1e-9, "lagrangian", 1e-8, ["rk853"], 5000),
        # A cubic does not follow the accelerations of so long steps; a second look finds them smooth.
        ("light_cart_pole", 1e-9, "lagrangian", 1e-6, ["rk853"], 4000),
        # Steps grow after the passing, so that a trial of rodas5 there got further.
        ("light_cart_pole", 1e-9, "pinocchio", 1e-6, ["rk853"], 4000),
        # Accuracy holds rk853 at h|λ| = 0.4, so that it would not come back to larger steps.
        ("damped_point_spring", 1e4, "pinocchio", 1e-8, ["rk853", "rodas5"], 400),
    ],
)
def test_methods_do_not_take_turns(
    case: str, value: float, engine: str, rtol: float, methods: list[str], steps: int
) -> None:
    problem = cases.get(case).make(value)
    dyn = dynamics(problem.model, engine, **IN_MACHINE_CODE[engine])
    run = simulate(dyn, problem.q, problem.v, problem.duration, "auto", rtol=rtol)
    assert ["rk853", *re.findall(r"; (\w+) from there", run.stats.chosen)] == methods
    assert run.stats.steps < steps
    # Accelerations that change within a step are no rounding.
    assert not run.stats.doubts


def test_an_oscillation_is_followed_and_its_errors_do_not_add_up() -> None:
    k, times = 1e8, np.linspace(0, 1, 5)
    dyn = dynamics(slider(k, 0.0), "lagrangian", compile=True)
    run = simulate(dyn, [1.0], [0.0], 1.0, "auto", rtol=1e-8, save=times)
    # With twice the sum that is allowed, 1.6e-8; with half of it, 43,400 steps.
    assert run.q[:, 0] == pytest.approx(np.cos(1e4 * times), abs=1.2e-8)
    assert run.stats.steps < 41_500
    assert run.stats.chosen.startswith("rk853, at rtol = ")
    plain = simulate(dyn, [1.0], [0.0], 1.0, "rk853", rtol=1e-8, save=times)
    assert np.abs(plain.q[:, 0] - np.cos(1e4 * times)).max() > 2e-7
    assert plain.stats.steps < run.stats.steps < 3 * plain.stats.steps


@pytest.mark.parametrize(
    ("model", "duration", "rtol", "evaluations", "trials"),
    [
        # Stability holds rk853's steps at h|λ| = 4.1: handed over at 6, it takes 2,400 evaluations.
        ("damped", 0.5, 1e-6, 1500, (1, 20)),
        # Accuracy holds them at 2: handed to trials from 1.5 on, it costs four of them.
        ("rings a little", 0.2, 1e-6, 52_000, (0, 36)),
        # 1,300 steps are to come: looked at from 2,600 on, 14,000 evaluations.
        ("damped", 0.3, 1e-6, 1500, (1, 20)),
        # An oscillation costs no trial with 2,600 steps to come, and some with 4,500.
        ("rings", 0.35, 1e-3, 40_000, (0, 0)),
        ("rings", 0.6, 1e-3, 60_000, (1, 47)),
    ],
)
def test_what_is_tried_pays(
    model: str, duration: float, rtol: float, evaluations: int, trials: tuple[int, int]
) -> None:
    if model == "rings":
        dyn, start = dynamics(slider(1e8, 0.0), "lagrangian", compile=True), ([1.0], [0.0])
    else:
        dyn, start = COMPILED.at(k=1e8, c=1e3 if model == "damped" else 0.0), ([1.0, 0.0], [0.0, 0.0])
    run = simulate(dyn, *start, duration, "auto", rtol=rtol, save=[0.0, duration], doubt=False)
    assert run.stats.evaluations < evaluations
    assert trials[0] <= run.stats.jacobians <= trials[1]


def test_where_a_stiff_part_comes_to_its_end_rk853_comes_back() -> None:
    def brake(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        # Stiff for a quarter of the run, afterwards a pendulum that is shaken.
        return np.array([0.0, -1e7 * v[1] if t < 0.1 else 40 * np.sin(300 * t)])

    start = *START[:2], 0.4
    soft, save = WAYS["pinocchio"].at(k=1.0, c=0.0), [0.2, 0.4]
    run = simulate(soft, *start, "auto", rtol=1e-8, torque=brake, save=save)
    assert "rodas5 from there to t = 0." in run.stats.chosen
    assert run.stats.chosen.endswith("rk853 from there")
    other = simulate(soft, *start, "rodas5", rtol=1e-9, torque=brake, save=save)
    assert np.abs(run.q - other.q).max() < 1e-7


# Nothing is lost on the way


@pytest.mark.parametrize("way", ["machine code", "interpreted"])
def test_events_and_own_steps_survive_the_change(way: str) -> None:
    events = [at_section(FORM, "a", 0.5), at_section(FORM, "a", -0.2, terminal=True)]
    run, truth = (simulate(dyn, *START, m, rtol=r, events=events) for dyn, m, r in (
        (WAYS[way], "auto", 1e-8), (COMPILED, "rodas5", 1e-12)))  # fmt: skip
    assert [hit.name for hit in run.events] == ["a = 0.5", "a = -0.2"]
    for hit, exact in zip(run.events, truth.events, strict=True):
        assert hit.t == pytest.approx(exact.t, abs=1e-8)
    assert run.stats.ended == "event"
    assert run.t[-1] == run.events[-1].t
    assert (np.diff(run.t) > 0).all()
    assert len(run.t) == run.stats.steps + 1


@pytest.mark.parametrize("way", ["machine code", "interpreted"])
def test_torques_held_or_of_a_function_act_on_both_sides_of_the_change(way: str) -> None:
    tau = np.random.default_rng(0).standard_normal((8, 2)) * [5.0, 50.0]
    run, truth = simulate(WAYS[way], *START, "auto", rtol=1e-8, torque=tau, save=SAVE), tight(torque=tau, save=SAVE)
    assert "rodas5" in run.stats.chosen
    assert np.abs(run.q - truth.q).max() < 1e-7
    assert np.array_equal(run.tau[:-1], tau)

    def steer(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array([3 * np.sin(4 * t) - 0.2 * v[0], 0.0])

    steered = simulate(WAYS[way], *START, "auto", rtol=1e-8, torque=steer, save=SAVE)
    other = simulate(INTERPRETED, *START, "radau", rtol=1e-8, torque=steer, save=SAVE)
    assert "rodas5" in steered.stats.chosen
    assert np.abs(steered.q - other.q).max() < 1e-7


def test_a_damper_that_holds_the_steps_is_handed_to_rodas5_before_it_would_be_tried_anyway() -> None:
    """With 2,300 steps to come and h|λ| = 6.4: rk853 alone takes 28,000 evaluations."""
    run = simulate(COMPILED.at(k=0.0, c=3e3), *START, "auto", rtol=1e-8, save=SAVE)
    assert "stability held its steps (h|λ| = 6.4" in run.stats.chosen
    assert run.stats.evaluations < 3000


def test_an_oscillation_of_many_steps_that_the_tolerance_holds_costs_no_trial_of_rodas5() -> None:
    """With 2,000 steps to come and h|λ| = 0.3: a look is worth its 5 evaluations, a trial of 24 steps is not."""
    dyn = dynamics(slider(4e5, 0.0), "lagrangian", compile=True)
    run, plain = (simulate(dyn, [1.0], [0.0], 1.0, m, rtol=r) for m, r in (("auto", 1e-8), ("rk853", 1e-9)))
    assert run.stats.jacobians == 0
    assert run.stats.evaluations < plain.stats.evaluations + 60


def test_each_of_a_batch_is_decided_on_by_itself() -> None:
    k, c = [1e2, 1e8, 1e10, 1e4, 1e9], [1.0, 1e5, 1e7, 10.0, 1e6]
    both = simulate(COMPILED.at(k=k, c=c), *START, "auto", rtol=1e-8, save=SAVE)
    alone = [simulate(COMPILED.at(k=x, c=y), *START, "auto", rtol=1e-8, save=SAVE) for x, y in zip(k, c, strict=True)]
    for i, one in enumerate(alone):
        assert np.array_equal(both.q[i], one.q)
    for figure in ("steps", "evaluations", "rejected", "jacobians"):
        assert getattr(both.stats, figure) == sum(getattr(one.stats, figure) for one in alone)
    assert "3 of 5, such as trajectory 1: rk853 to t" in both.stats.chosen
    assert "2 of 5: rk853 throughout" in both.stats.chosen
    with pytest.raises(InputError, match="save: expected a grid of times for a batch"):
        simulate(COMPILED, np.zeros((2, 2)), [0.0, 0.0], 1.0, "auto")


# What goes wrong


def test_accelerations_of_few_digits_are_passed_and_told() -> None:
    """The cart weighs next to nothing: where the pole hangs down, rounding is all that rk853 finds in energies' M.

    Whether a look at rounding comes in time hangs on the last bits: of 24 starts that differ by 1e-13, 20 pass.
    """
    dyn, told = mb.lagrangian.from_model(catalog.cart_pole(cart_mass=1e-11)).dynamics(options=QUICK), 0
    exact = light_cart_pole(np.pi / 2, 1e-11)(np.array([0.6]))[0]
    for k in range(12):
        start = [0.0, np.pi / 2 * (1 + k * 1e-13)]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run = simulate(dyn, start, [0.0, 0.0], 0.6, "auto", rtol=1e-8, save=[0.0, 0.6], doubt=False)
        if not run.stats.finished:
            continue
        assert run.q[-1] == pytest.approx(exact, abs=1e-5)
        heard = [str(w.message) for w in caught if issubclass(w.category, DoubtfulRunWarning)]
        assert len(heard) == len(run.stats.doubts)
        for one, doubt in zip(heard, run.stats.doubts, strict=True):
            assert doubt in one
            assert re.search(r"near t = 0\.45\d+ s accelerations are known to .* there it took 1e-0[67]\.", doubt)
            told += 1
    assert told >= 6


def test_what_cannot_go_on_says_so_once() -> None:
    box = catalog.free_body()
    with pytest.warns(MbkitWarning, match="auto diverged: the state grew beyond all bounds after t = 0 s") as heard:
        run = simulate(dynamics(box), box.neutral(), [0, 0, 0, 0, 0, 1e155], 1.0, "auto")
    assert len(heard) == 1
    assert np.array_equal(run.q, [box.neutral()])

    def fails(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        if t > 0.3:
            raise ValueError("no more")
        return np.zeros(2)

    with pytest.raises(TorqueError, match="no more") as told:
        simulate(WAYS["pinocchio"], *START, "auto", rtol=1e-8, torque=fails)
    assert 0.2 < told.value.trajectory.t[-1] <= 0.3


def test_the_pace_is_that_of_the_later_half() -> None:
    gauge = StepRateMonitor(0.0, 2)
    for k in range(8):
        t = np.array([k, k + 1.0]) if k < 4 else np.array([4 + (k - 4) / 10, 4 + (k - 3) / 10])
        gauge.saw(AcceptedSteps(t, np.zeros((2, 1)), np.zeros((2, 1)), 1))
        assert gauge.due() == (k in (1, 5))
    assert gauge.rate() == pytest.approx(10.0)
    assert gauge.overall() == pytest.approx(8 / 4.4)
    assert gauge.step() == pytest.approx(4.4 / 8)


# The stiffness


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco"])
def test_the_stiffness_of_a_slider_is_that_of_its_roots(engine: str) -> None:
    for k, c in ((1e12, 0.0), (1e12, 1e3), (1e6, 1e4), (1.0, 1e10)):
        found = stiffness(dynamics(slider(k, c), engine), [0.3], [-0.2])
        roots = np.roots([1.0, c, k])
        assert found.rate == pytest.approx(np.abs(roots).max(), rel=1e-6)
        # Differences keep nine digits of what is fastest.
        slack = 1e-6 * found.rate
        assert found.decay == pytest.approx(max(0.0, -roots.real.min()), abs=slack)
        assert found.oscillation == pytest.approx(np.abs(roots.imag).max(), abs=slack)
        assert found.exact == (engine == "lagrangian")


def test_the_stiffness_is_that_of_what_follows_from_a_state() -> None:
    """Of all joint kinds, differences and derivatives agree; so do those of a torque function."""
    model = random_tree(3, 9, SOUND)
    q, v = model.random_state(np.random.default_rng(0))

    def torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return -1e4 * v

    exact, near = (stiffness(dynamics(model, e), q, v, torque) for e in ("lagrangian", "pinocchio"))
    assert near.rate == pytest.approx(exact.rate, rel=1e-5)
    assert near.decay == pytest.approx(exact.decay, rel=1e-5)
    both = stiffness(dynamics(model), np.stack([q, q]), np.stack([0 * v, v]))
    assert both.member in (0, 1)
    assert repr(both).startswith("<Stiffness of trajectory")


def test_the_bound_comes_first_and_bad_input_is_named() -> None:
    beam = catalog.clamped_beam(segments=12)
    dyn, q = dynamics(beam), np.zeros(12)
    exact = stiffness(dyn, q, q)
    bound = stiffness(dyn, q, q, enough=10 * exact.rate)
    assert not len(bound.eigenvalues)
    assert exact.rate <= bound.rate <= 10 * exact.rate
    assert str(bound) == f"no rate above {bound.bound:.2g} 1/s"
    grows = stiffness(dynamics(catalog.pendulum()), [np.pi], [0.0])
    assert grows.growth == pytest.approx(9.81**0.5, rel=1e-6)
    assert "fastest growth 3.1 1/s" in str(grows)
    with pytest.raises(InputError, match="v: expected shape"):
        stiffness(dyn, q, [0.0])
    with pytest.raises(InputError, match="q"):
        stiffness(dyn, q * np.nan, q)
    with pytest.raises(InputError, match="dyn: expected a Dynamics"):
        stiffness("beam", q, q)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="empty batch"):
        stiffness(dyn, np.empty((0, 12)), q)


def test_a_batch_tells_its_three_commonest_sequences_of_methods():
    ways = ["rk853"] * 4 + ["rodas5"] * 3 + ["rk853, rodas5"] * 2 + ["rodas5, rk853", "rodas5, rk853, rodas5"]
    batch: Any = [SimpleNamespace(method_sequence=lambda way=way: way, describe=lambda way=way: way) for way in ways]
    told = _chosen(batch, len(batch))
    assert told == "4 of 11: rk853; 3 of 11: rodas5; 2 of 11: rk853, rodas5; and 2 more kinds"
