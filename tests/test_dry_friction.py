"""Dry friction: optimal at rest on every engine, its law at speed, runs against closed forms, bad input."""

from __future__ import annotations

import itertools
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq, lsq_linear

import mbkit as mb
from mbkit.engines.elements.jumps import forces_at_rest
from mbkit.errors import InputError, MbkitWarning, ModelError, TorqueError
from mbkit.lagrangian.summary import SystemSummary, python_code
from mbkit.model import Model
from mbkit.model.changes.jumps import held_at_rest
from tests.random_trees import IN_MUJOCO, SOUND, off, random_tree, states
from tests.scenes import mounted
from tests.test_friction_beside_rows import BARS, four_bar

EPS = float(np.finfo(float).eps)
ENGINES = ("lagrangian", "pinocchio", "mujoco", "drake")


def rubbed(seed: int, n: int = 6, kinds: tuple[str, ...] = IN_MUJOCO, *, curve: bool = True, **more: bool) -> Model:
    """Return a random tree with friction wherever a joint may have it, of the size of the other forces."""
    rng = np.random.default_rng([seed, 7])
    model = random_tree(seed, n, kinds, **more)
    b = mb.ModelBuilder.of(model)
    for joint in model.joints:
        if joint.type.coordinate_velocities and joint.type.nv:
            sliding = rng.uniform(0, 3, joint.type.nv)
            b.set_joint(joint.name, friction=sliding)
            if curve:
                b.set_joint(joint.name, stiction=sliding * rng.uniform(1, 2))
            if curve and rng.random() < 0.7:
                b.set_joint(joint.name, stribeck_velocity=rng.uniform(0.1, 1, joint.type.nv))
    return b.build()


def mostly_at_rest(model: Model, n: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Return q, v, tau, with two thirds of the velocities zero and forces around what friction holds."""
    q, v, _, tau = states(model, n, seed)
    rng = np.random.default_rng([seed, 5])
    v[rng.random(v.shape) < 2 / 3] = 0.0
    return q, v, 4 * tau * rng.random((n, 1)) ** 2


def sizes(model: Model, v: np.ndarray) -> np.ndarray:
    """Return f(|v|) of full velocities, from the joints' numbers."""
    out = np.zeros(model.layout.G.shape[0])
    for joint in model.joints:
        part = model.layout.full_v[joint.name]
        f = joint.friction
        fall = np.zeros(joint.type.nv)
        if joint.stiction is not None and joint.stribeck_velocity is not None:
            fall = (joint.stiction - f) * np.exp(-((v[part] / joint.stribeck_velocity) ** 2))
        out[part] = f + fall
    return out


def bounds(model: Model) -> np.ndarray:
    """Return the largest friction at rest of independent velocities."""
    full = [j.friction if j.stiction is None else j.stiction for j in model.joints]
    return np.abs(model.layout.G.T) @ np.concatenate([np.zeros(0), *full])


# The law


@pytest.mark.parametrize("engine", ENGINES)
def test_at_speed_it_is_a_passive_force_against_the_velocity_of_each_joint(engine: str) -> None:
    model = rubbed(0, mimic=True)
    q, v, a, tau = states(model, 4)
    dyn, bare = mb.dynamics(model, engine), mb.dynamics(model.without("friction"), engine)
    full = v @ model.layout.G.T
    force = -np.array([sizes(model, x) * np.sign(x) for x in full]) @ model.layout.G
    assert off(dyn.passive(q, v) - bare.passive(q, v), force) < 1e3 * EPS
    assert off(bare.inverse_dynamics(q, v, a) - dyn.inverse_dynamics(q, v, a), force) < 1e4 * EPS
    assert off(dyn.forward_dynamics(q, v, tau), bare.forward_dynamics(q, v, tau + force)) < 1e4 * EPS
    # Power is lost, and never won.
    assert ((force * v).sum(axis=1) < 0).all()


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_derivatives_at_speed_are_those_of_the_curve(engine: str) -> None:
    model = rubbed(3, 4, SOUND, mimic=True, springs=False, damping=False)
    q, v, a, tau = (x[0] for x in states(model, 1))
    dyn, h = mb.dynamics(model, engine), 1e-6
    for derivatives, of, x in (
        (dyn.inverse_dynamics_derivatives, dyn.inverse_dynamics, a),
        (dyn.forward_dynamics_derivatives, dyn.forward_dynamics, tau),
    ):
        by_v = np.array([of(q, v + h * e, x) - of(q, v - h * e, x) for e in np.eye(len(v))]).T / (2 * h)
        # Differences lose half of the digits.
        assert off(derivatives(q, v, x).v, by_v) < 1e-7


def test_equations_on_paper_programs_and_c_hold_the_friction_of_motion_and_tell_of_rest() -> None:
    """A block, and a wheel that follows it by -2: f at the rate of each, and Stribeck's curve."""
    b = mb.ModelBuilder("sled", gravity=(0, 0, 0))
    b.add_body("block", mass=2.0)
    b.add_body("wheel", mass=0.0, inertia=(0.1, 0.1, 0.1))
    rubs = {"friction": 3.0, "stiction": 4.0, "stribeck_velocity": 0.5}
    b.add_joint("slide", "prismatic", parent="world", child="block", axis=(1, 0, 0), **rubs)
    follows = {"mimic": ("slide", -2.0, 0.1), "friction": 0.7}
    b.add_joint("turn", "revolute", parent="block", child="wheel", axis=(0, 1, 0), **follows)
    model = b.build(nonphysical="warn")
    v, tau = -0.3, 1.0
    expected = (tau + 3.0 + (4.0 - 3.0) * np.exp(-((v / 0.5) ** 2)) + 2 * 0.7) / (2.0 + 2.0**2 * 0.1)
    told = r"f sign\(v\): zero at rest, where it can hold up to 5.4 at 'slide'"
    with pytest.warns(MbkitWarning, match=told):
        lag = mb.lagrangian.from_model(model)
    assert lag.dynamics(options={"compile": False}).forward_dynamics([0.2], [v], [tau]) == pytest.approx(expected)
    program, modules = mb.lagrangian.program(model, "forward_dynamics"), ({}, {})
    exec(program.python(), modules[0])
    exec(python_code(lag, held_at_rest(model)), modules[1])
    for module in modules:
        assert module["forward_dynamics"]([0.2], [v], [tau]) == pytest.approx(expected)
    summary = SystemSummary(lag, note=held_at_rest(model))
    texts = [str(program), program.latex(), program.python(), program.c(), summary.text(), summary.latex()]
    texts += [python_code(lag, held_at_rest(model)), mb.lagrangian.export_c(model).header, summary.data()["note"]]
    for text in texts:
        assert re.search(told, " ".join(text.replace("\n *", " ").split()))
    assert "left out" not in re.sub("limits and contacts are left out", "", texts[-2])
    assert "rest" not in str(mb.lagrangian.program(model, "mass_matrix"))


# At rest


@pytest.mark.thorough("0-lagrangian", "0-drake", "1-lagrangian")
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("seed", [0, 1])
def test_at_rest_friction_is_what_the_least_constraint_needs(engine: str, seed: int) -> None:
    model = rubbed(seed, curve=False, mimic=seed % 2 == 0)
    q, v, tau = mostly_at_rest(model, 12, seed)
    a = mb.dynamics(model, engine).forward_dynamics(q, v, tau)
    # Friction of what moves is in the passive force of the model itself.
    held = mb.dynamics(model, engine).inverse_dynamics(q, v, a) - tau
    rest = (v == 0) & (bounds(model) > 0)
    bound = np.where(rest, bounds(model), 0.0)
    noise = 1e-11 * (1 + np.abs(held).max() + np.abs(a).max())
    assert (np.abs(held) <= bound + noise).all()
    begins = rest & (a != 0)
    assert off(held[begins], (-bound * np.sign(a))[begins]) < noise
    assert begins.any()
    assert (rest & (a == 0)).any()


@pytest.mark.parametrize("seed", [2])
def test_at_rest_accelerations_are_the_best_of_all_patterns(seed: int) -> None:
    model = rubbed(seed, 4, ("revolute", "prismatic", "universal"), curve=False)
    q, v, tau = mostly_at_rest(model, 4, seed)
    bare = mb.dynamics(model.without("friction"), "lagrangian")
    law = -np.array([sizes(model, x) * np.sign(x) for x in v])
    M, free = bare.mass_matrix(q), tau + law + bare.passive(q, v) - bare.nle(q, v)
    got = mb.dynamics(model, "lagrangian").forward_dynamics(q, v, tau)
    for i in range(len(q)):
        rest = np.flatnonzero((v[i] == 0) & (bounds(model) > 0))

        def cost(a: np.ndarray, i: int = i, rest: np.ndarray = rest) -> float:
            return float(a @ M[i] @ a / 2 - free[i] @ a + bounds(model)[rest] @ np.abs(a[rest]))

        best, value = np.zeros(model.nv), np.inf
        for signs in itertools.product((-1, 0, 1), repeat=len(rest)):
            force, moves = free[i].copy(), np.ones(model.nv, dtype=bool)
            force[rest] -= np.array(signs) * bounds(model)[rest]
            moves[rest[np.array(signs) == 0]] = False
            a = np.zeros(model.nv)
            a[moves] = np.linalg.solve(M[i][np.ix_(moves, moves)], force[moves])
            if cost(a) < value:
                best, value = a, cost(a)
        assert off(got[i], best) < 1e-11


@settings(max_examples=150)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(0, 8), st.sampled_from([0.0, 1e-3, 1.0, 1e3]))
# Exchanges of a singular A come back to where they were.
@example(2614055815, 8, 3, 0.0)
@example(2512495316, 5, 2, 1e-3)
@example(3053861555, 8, 3, 1.0)
def test_forces_with_bounds_are_the_least_squares_of_scipy(seed: int, n: int, rank: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    # A has this rank; with bodies' inertias it is regular, with loops it need not be.
    C, d, bound = rng.standard_normal((rank, n)), rng.standard_normal(rank), scale * rng.random(n)
    A, b = C.T @ C, C.T @ d
    forces = forces_at_rest(A, b, bound)
    assert (np.abs(forces) <= bound * (1 + 1e-13)).all()
    wide = bound + 1e-300
    best = lsq_linear(C, -d, (-wide, wide), method="bvls", tol=1e-14).x if rank and scale else np.zeros(n)
    size = np.abs(b) + np.abs(A) @ bound

    def cost(x: np.ndarray) -> float:
        return float(x @ A @ x / 2 + b @ x)

    assert cost(forces) <= cost(best) + 1e-12 * (1 + float(size @ bound))
    # The accelerations are unique, though the forces of a singular A are not.
    a = b + A @ forces
    noise = 1e-10 * size
    assert (((np.abs(a) <= noise) | (forces == -np.sign(a) * bound)) | (bound == 0)).all()


def test_a_follower_rubs_at_its_own_rate() -> None:
    """A slider of 1 kg, another of 2 kg at -3 times its rate: friction 4 + 3 * 5 N against m = 1 + 9 * 2 kg."""
    b = mb.ModelBuilder("pair", gravity=np.zeros(3))
    b.add_body("one", mass=1.0)
    b.add_body("two", mass=2.0)
    b.add_joint("x", "prismatic", parent="world", child="one", axis=(1, 0, 0), friction=4.0)
    b.add_joint("y", "prismatic", parent="world", child="two", axis=(0, 1, 0), friction=5.0, mimic=("x", -3.0, 0.1))
    model = b.build()
    for engine in ENGINES:
        dyn = mb.dynamics(model, engine)
        pulled = dyn.forward_dynamics([[0.0]] * 4, [[0.0]] * 4, [[18.9], [-18.9], [20.9], [-20.9]])
        assert pulled[:, 0] == pytest.approx([0, 0, 0.1, -0.1], abs=1e-14)
        assert dyn.passive([0.0], [-2.0])[0] == pytest.approx(19.0, rel=1e-15)


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_a_four_bar_at_rest_yields_to_what_friction_cannot_hold(engine: str) -> None:
    model, friction = four_bar(), BARS
    dyn, bare = mb.dynamics(model, engine), mb.dynamics(model.without("friction"), "lagrangian")
    q, _ = bare.project([1.2, -0.6, 1.5], np.zeros(3))
    # The one direction in which it can move: everything else follows from its inertia and what pulls along it.
    n = np.linalg.svd(bare.constraint_jacobian(q))[2][-1]
    assert np.abs(n).min() > 0.1
    still, M = np.zeros(3), bare.mass_matrix(q)
    resists = friction @ np.abs(n)
    for pull in (0.0, 0.9, 1.1, -0.9, -1.5, 4.0):
        tau = bare.nle(q, still) + pull * resists * n
        rate = np.sign(pull) * max(abs(pull) - 1, 0) * resists / (n @ M @ n)
        assert off(dyn.forward_dynamics(q, still, tau), rate * n) < 1e-9


# Runs


def slider(**friction: float) -> Model:
    """Return 2 kg on a spring of 50 N/m."""
    b = mounted(
        "slider", "block", "x", "prismatic", gravity=np.zeros(3), mass=2.0, axis=(1, 0, 0), stiffness=50.0, **friction
    )
    return b.build()


@pytest.mark.thorough("rk853-more0-pinocchio", "auto-more1-lagrangian", "auto-more1-pinocchio")
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
@pytest.mark.parametrize(("method", "more"), [("rk853", {"rtol": 1e-13}), ("auto", {"rtol": 1e-13})])
def test_an_oscillator_loses_the_same_in_each_half_swing_and_rests_in_its_dead_band(
    engine: str, method: str, more: dict[str, float]
) -> None:
    """Den Hartog 1931: amplitudes fall by 2 f/k; each half swing takes π √(m/k); it rests where k |x| <= f."""
    run = mb.simulate(mb.dynamics(slider(friction=3.0), engine), [1.0], [0.0], 8.0, method, **more)
    turns = [1 - 0.12 * k for k in range(1, 9)]
    half = np.pi / 5
    assert [e.name for e in run.events] == ["x turns"] * 7 + ["x stops"]
    assert [e.t for e in run.events] == pytest.approx([half * k for k in range(1, 9)], rel=1e-12)
    assert [e.q[0] * (-1) ** k for k, e in enumerate(run.events, 1)] == pytest.approx(turns, rel=1e-11, abs=1e-12)
    assert run.q[-1, 0] == run.events[-1].q[0]
    assert run.v[-1, 0] == 0.0


@pytest.mark.parametrize("method", ["rk4", "gauss6", "moreau", "semi_implicit_euler", "rodas5"])
def test_what_rests_stays_where_it_is_to_the_last_bit(method: str) -> None:
    model = slider(friction=1.0, stiction=3.0)
    more = {"dt": 1e-2} if method != "rodas5" else {}
    run = mb.simulate(mb.dynamics(model, "lagrangian"), [0.059], [0.0], 1.0, method, **more)
    assert (run.q == 0.059).all()
    assert not run.v.any()
    moved = mb.simulate(mb.dynamics(model, "lagrangian"), [0.061], [0.0], 1.0, method, **more)
    assert moved.q[-1, 0] < 0.061


def test_a_block_slides_down_a_slope_up_to_where_it_rests() -> None:
    """3 kg thrown up a slope of 30°, μ = 0.7 and so at rest at its height: v²/2 (sin + μ cos) g; or down with 0.3."""
    for mu, rests in ((0.7, True), (0.3, False)):
        up, down = (9.81 * (0.5 + sign * mu * np.sqrt(0.75)) for sign in (1, -1))
        b = mb.ModelBuilder("slope", gravity=(-9.81 * 0.5, 0, -9.81 * np.sqrt(0.75)))
        b.add_body("block", mass=3.0)
        force = 3 * 9.81 * mu * np.sqrt(0.75)
        b.add_joint("x", "prismatic", parent="world", child="block", axis=(1, 0, 0), friction=force)
        run = mb.simulate(mb.dynamics(b.build(), "lagrangian"), [0.0], [4.0], 2.0, "rk853")
        (event,) = run.events
        assert event.name == ("x stops" if rests else "x turns")
        assert event.t == pytest.approx(4 / up, rel=1e-13)
        assert event.q[0] == pytest.approx(8 / up, rel=1e-13)
        end = 8 / up - (0 if rests else down * (2 - 4 / up) ** 2 / 2)
        assert run.q[-1, 0] == pytest.approx(end, rel=1e-12)


def belt(speed: float) -> Model:
    """Return 2 kg on a spring of 50 N/m to the ground, seen from a belt that moves: 3 N of friction, 5 N at rest."""
    b = mounted(
        "belt", "block", "x", "prismatic", gravity=np.zeros(3), mass=2.0, axis=(1, 0, 0), friction=3.0, stiction=5.0
    )
    b.add_joint_force("spring", "x", lambda t, q, v: -50.0 * (q + speed * t))  # noqa: ARG005
    return b.build()


@pytest.mark.thorough("auto")
@pytest.mark.parametrize("method", ["rk853", "auto"])
def test_a_block_on_a_belt_sticks_and_slips_with_the_period_of_the_closed_form(method: str) -> None:
    """It lets go at s/k, and slips about f/k until it has the belt's speed again."""
    speed, k, m, f, s = 0.2, 50.0, 2.0, 3.0, 5.0
    omega = np.sqrt(k / m)
    slip = (2 * np.pi - 2 * np.arctan((s - f) * omega / (k * speed))) / omega
    stick = 2 * (s - f) / (k * speed)
    start = (2 * f - s) / k
    run = mb.simulate(
        mb.dynamics(belt(speed), "lagrangian"), [start], [0.0], 2 * (slip + stick) + 0.1, method, rtol=1e-13
    )
    exact = np.array([(n + 1) * stick + n * slip + late * slip for n in range(2) for late in (0, 1)])
    assert [e.name for e in run.events] == ["x lets go", "x stops"] * 2
    assert [e.t for e in run.events] == pytest.approx(exact.tolist(), rel=1e-11)
    places = [e.q[0] + speed * e.t for e in run.events]
    assert places == pytest.approx([s / k, start] * 2, abs=1e-12)


@pytest.mark.thorough("True-auto", "True-dop853", "False-rk853", "False-dop853", "False-auto")
@pytest.mark.parametrize("method", ["rk853", "auto", "dop853"])
@pytest.mark.parametrize("clock", [False, True])
def test_a_force_that_passes_the_bound_for_a_while_is_not_stepped_over(method: str, clock: bool) -> None:
    windows(3.5, 5.0, method, clock)


@pytest.mark.thorough("dop853")
@pytest.mark.parametrize("method", ["rk853", "dop853"])
def test_a_force_that_hardly_passes_the_bound_is_not_stepped_over(method: str) -> None:
    """For a ninth of the time, by 2 %: parabolas have to follow the force closely."""
    windows(3.05, 7.0, method, clock=False)


def windows(pull: float, omega: float, method: str, clock: bool) -> None:
    """What rests takes steps of any length: a force over the bound and below again within one moved nothing."""
    f = 3.0
    b = mounted("block", "block", "x", "prismatic", gravity=np.zeros(3), mass=2.0, axis=(1, 0, 0), friction=f)
    torque = None if clock else lambda t, q, v: [pull * np.sin(omega * t)]  # noqa: ARG005
    if clock:
        b.add_joint_force("pull", "x", lambda t, q, v: pull * np.sin(omega * t))  # noqa: ARG005
    run = mb.simulate(mb.dynamics(b.build(), "lagrangian"), [0.0], [0.0], 6.2 * np.pi / omega, method, torque=torque)
    begins = np.arcsin(f / pull) / omega + np.pi / omega * np.arange(6)

    def speed(t: float) -> float:
        return pull / omega * (np.cos(omega * begins[0]) - np.cos(omega * t)) - f * (t - begins[0])

    stops = brentq(speed, np.pi / omega - begins[0], begins[1]) - begins[0] + begins
    exact = np.stack([begins, stops], axis=1).ravel()
    assert [e.name for e in run.events] == ["x lets go", "x stops"] * 6
    assert [e.t for e in run.events] == pytest.approx(exact.tolist(), rel=1e-9)


@pytest.mark.thorough("rk4")
@pytest.mark.parametrize("method", ["rk853", "auto", "rk4"])
def test_what_has_friction_at_rest_alone_swings_and_sticks_where_it_turns(method: str) -> None:
    """Without friction of motion the side of what let go was zero: it came to rest at once, or never again."""
    more = {"dt": 1e-3} if method == "rk4" else {}
    swings = mb.dynamics(slider(friction=0.0, stiction=5.0), "lagrangian")
    run = mb.simulate(swings, [0.2], [0.0], 2.0, method, **more)
    assert run.q[-1, 0] == pytest.approx(0.2 * np.cos(10.0), rel=1e-8)
    assert [e.name for e in run.events] == ["x turns"] * 3
    # Amplitudes fall by exp(-π ζ / √(1 - ζ²)), ζ = 0.1: the third half swing ends below the 0.1 m that 5 N hold.
    damped = mb.dynamics(slider(friction=0.0, stiction=5.0, damping=2.0), "lagrangian")
    run = mb.simulate(damped, [0.2], [0.0], 4.0, method, **more)
    ratio = np.exp(-np.pi * 0.1 / np.sqrt(0.99))
    assert run.q[-1, 0] == pytest.approx(-0.2 * ratio**3, rel=1e-8)
    assert run.v[-1, 0] == 0.0


@pytest.mark.parametrize("method", ["rk4", "gauss6", "semi_implicit_euler"])
def test_what_lets_go_at_a_time_of_the_grid_lets_go(method: str) -> None:
    """At its bound to the bit it was held, and over it in the next instant: the run stopped as undecided."""
    dyn = mb.dynamics(joint_with("prismatic", axis=(1, 0, 0), friction=3.0, stiction=4.0), "lagrangian")
    run = mb.simulate(dyn, [0.0], [0.0], 2.0, method, 1e-2, torque=lambda t, q, v: [5 * t])  # noqa: ARG005
    (event,) = run.events
    assert (event.name, event.t) == ("hinge lets go", pytest.approx(0.8, rel=1e-12))
    exact = 5 * (8 - 0.512) / 6 - 3 * (4 - 0.64) / 2 - 1.2 * (5 * 0.32 - 3 * 0.8)
    assert run.q[-1, 0] == pytest.approx(exact, rel=1e-2 if method == "semi_implicit_euler" else 1e-9)


def test_of_a_batch_each_ends_at_its_own_event_beside_phases() -> None:
    """x = f/k + (x0 - f/k) cos ωt on the way down: the state of an event between saved times is none of these."""
    dyn, save = mb.dynamics(slider(friction=3.0), "lagrangian"), np.array([0.0, 0.1, 0.2, 0.25, 0.3, 0.4])
    passes = mb.simulate.Event(lambda t, q, v: q[0] - 0.1, "passes", direction=-1)  # noqa: ARG005
    run = mb.simulate(dyn, [[0.2], [0.08]], [0.0], 0.4, "rk853", rtol=1e-12, save=save, events=passes)
    middle, rate = 3.0 / 50.0, np.sqrt(50.0 / 2.0)
    end = np.arccos((0.1 - middle) / (0.2 - middle)) / rate
    exact = middle + (0.2 - middle) * np.cos(rate * save)
    assert run.q[0, :, 0] == pytest.approx(np.where(save < end, exact, np.nan), rel=1e-9, nan_ok=True)
    assert np.isfinite(run.q[1]).all()
    assert (run.stats.reached, run.events[0].t) == (pytest.approx((end, 0.4)), pytest.approx(end))


def test_progress_of_phases_is_that_of_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mbkit.simulate.progress.LOOK_SECONDS", 0.0)
    told: list[float] = []
    dyn = mb.dynamics(slider(friction=0.2), "lagrangian")
    run = mb.simulate(dyn, [[0.2], [0.1]], [0.0], 3.0, "rk853", save=[3.0], progress=told.append)
    assert len(run.events) > 4
    assert told == sorted(told)
    assert told[-1] == 1.0


@pytest.mark.parametrize("method", ["rk853", "rk4", "moreau"])
def test_a_run_of_no_time_is_its_start(method: str) -> None:
    run = mb.simulate(mb.dynamics(slider(friction=3.0), "lagrangian"), [0.5], [1.0], 0.0, method)
    assert (run.q.tolist(), run.v.tolist()) == ([[0.5]], [[1.0]])


@pytest.mark.thorough("numbers1")
@pytest.mark.parametrize("numbers", [(0.0, 5.0, 2.0), (1.0, 5.5, 0.0)])
def test_what_turns_in_moreau_s_step_is_held_by_its_stiction(
    numbers: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It once turned wherever the force at the turn was above the friction of motion."""
    from mbkit.simulate.solvers.in_phases import moreau

    friction, stiction, damping = numbers
    model = slider(friction=friction, stiction=stiction, damping=damping)
    dyn, start = mb.dynamics(model, "lagrangian", compile=True), ([0.34], [0.0], 4.0)
    exact = mb.simulate(dyn, *start, "rk853", rtol=1e-11, save=[4.0])
    assert exact.v[-1, 0] == 0.0
    assert 50.0 * abs(exact.q[-1, 0]) > friction
    coarse, fine = (mb.simulate(dyn, *start, "moreau", dt=dt, save=[4.0]) for dt in (4e-3, 2e-3))
    errors = [abs(run.q[-1, 0] - exact.q[-1, 0]) for run in (coarse, fine)]
    # Of first order.
    assert errors[1] < 2e-3
    assert errors[1] < 0.6 * errors[0]
    monkeypatch.setattr(moreau, "_compiles", lambda _: False)
    slow = mb.simulate(dyn, *start, "moreau", dt=4e-3, save=[4.0])
    assert coarse.q[-1] == pytest.approx(slow.q[-1], abs=1e-12)


def test_a_last_step_of_moreau_that_is_shorter_is_so_in_machine_code() -> None:
    model = slider(friction=1.0)
    fast, slow = (
        mb.simulate(dyn, [0.34], [0.0], 0.0105, "moreau", dt=1e-3)
        for dyn in (mb.dynamics(model, "lagrangian", compile=True), mb.dynamics(model, "pinocchio"))
    )
    assert fast.t[-1] == slow.t[-1] == 0.0105
    assert fast.q[-1] == pytest.approx(slow.q[-1], abs=1e-14)


def test_what_lets_go_in_moreau_s_step_has_the_friction_of_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    from mbkit.simulate.solvers.in_phases import moreau

    dyn = mb.dynamics(slider(friction=3.0, stiction=5.0), "lagrangian", compile=True)
    pull = np.linspace(0, 20, 101)[:-1, None]
    fast = mb.simulate(dyn, [0.0], [0.0], 1.0, "moreau", dt=1e-2, torque=pull)
    monkeypatch.setattr(moreau, "_compiles", lambda _: False)
    slow = mb.simulate(dyn, [0.0], [0.0], 1.0, "moreau", dt=1e-2, torque=pull)
    first = np.flatnonzero(fast.v[:, 0])[0]
    assert fast.v[first, 0] == pytest.approx(1e-2 * (pull[first - 1, 0] - 3) / 2, rel=1e-13)
    assert off(slow.q, fast.q) < 1e2 * EPS


def test_moreau_s_step_in_machine_code_is_that_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    from mbkit.simulate.solvers.in_phases import moreau

    model = rubbed(3, 4, ("revolute", "universal", "prismatic", "spherical_zyx"), mimic=True)
    q, v, tau = mostly_at_rest(model, 2)
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    assert dyn._compiles_steps
    pulls = np.repeat(tau[:, None], 100, axis=1)
    fast = mb.simulate(dyn, q, v, 0.1, "moreau", dt=1e-3, torque=pulls)
    monkeypatch.setattr(moreau, "_compiles", lambda _: False)
    slow = mb.simulate(dyn, q, v, 0.1, "moreau", dt=1e-3, torque=pulls)
    assert off(fast.q, slow.q) < 1e-11
    assert ((fast.v == 0) == (slow.v == 0)).all()
    assert (fast.v[:, 1:] == 0).any()
    own = mb.simulate(mb.dynamics(model, "mujoco"), q[0], v[0], 0.1, "moreau", dt=1e-3, torque=tau[0])
    assert off(own.q, fast.q[0]) < 1e-9


@pytest.mark.thorough("moreau-1-steps0", "gauss6-6-steps3")
@pytest.mark.parametrize(
    ("method", "order", "steps"),
    [
        ("moreau", 1, (100, 200, 400, 800, 1600)),
        ("semi_implicit_euler", 1, (100, 200, 400)),
        ("rk4", 4, (80, 160, 320)),
        ("gauss6", 6, (10, 20, 40, 80)),
    ],
)
def test_methods_keep_their_order_across_turns(method: str, order: int, steps: tuple[int, ...]) -> None:
    dyn = mb.dynamics(slider(friction=3.0, stiction=4.0), "lagrangian")
    exact = mb.simulate(dyn, [1.0], [0.3], 1.5, "rk853", rtol=1e-13)
    assert len(exact.events) == 3
    runs = [mb.simulate(dyn, [1.0], [0.3], 1.5, method, dt=1.5 / n) for n in steps]
    errors = [abs(run.q[-1] - exact.q[-1])[0] for run in runs]
    assert -np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(order, abs=0.35), errors


# Files and builders


def test_an_mjcf_with_friction_on_a_ball_or_free_joint_loads_without_it_and_says_so(tmp_path: Path) -> None:
    body = '<body name="{0}"><joint name="{1}" {2}/><inertial pos="0 0 .1" mass="1" diaginertia="1 1 1"/>{3}</body>'
    inner = body.format("b", "hip", 'type="ball" frictionloss="0.5"', body.format("c", "knee", 'frictionloss=".1"', ""))
    text = body.format("a", "base", 'type="free" frictionloss="2"', inner)
    path = tmp_path / "robot.xml"
    path.write_text(f"<mujoco><worldbody>{text}</worldbody></mujoco>", encoding="utf-8")
    model = mb.load(path)
    assert [j.friction.tolist() for j in model.joints] == [[0.0] * 6, [0.0] * 3, [0.1]]
    for joint in ("free joint 'base'", "ball joint 'hip'"):
        assert sum(joint in note and "left out" in note for note in model.notes) == 1


def test_a_builder_gives_stiction_to_a_joint_that_had_none_and_takes_it_away_with_friction() -> None:
    b = mb.ModelBuilder.of(slider(friction=1.0))
    b.set_joint("x", stiction=3.0, stribeck_velocity=0.2)
    model = b.build()
    joint = model.joint("x")
    assert (joint.friction, joint.stiction, joint.stribeck_velocity) == (1.0, 3.0, 0.2)
    bare = model.without("friction").joint("x")
    assert (bare.friction, bare.stiction, bare.stribeck_velocity) == (0.0, None, None)


# Bad input


def joint_with(kind: str = "revolute", **numbers: object) -> Model:
    axis = {"axis": (0, 0, 1)} if kind == "revolute" else {}
    return mounted("bad", "body", "hinge", kind, mass=1.0, inertia=np.ones(3), **axis, **numbers).build()


@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        ({"friction": -1.0}, "friction"),
        ({"friction": 2.0, "stiction": 1.0}, "stiction"),
        ({"friction": 1.0, "stribeck_velocity": 1.0}, "stiction"),
        ({"friction": 1.0, "stiction": 2.0, "stribeck_velocity": -1.0}, "stribeck_velocity"),
        ({"kind": "ball", "friction": 1.0}, "moving axes"),
        ({"kind": "planar", "stiction": [1.0, -1.0, 0.0]}, "stiction"),
    ],
)
def test_impossible_friction_is_refused_by_name(numbers: dict[str, object], says: str) -> None:
    with pytest.raises((ModelError, InputError), match=says) as refusal:
        joint_with(**numbers)
    assert "hinge" in str(refusal.value)


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_a_check_of_the_step_sees_no_mode_in_the_jump_of_friction_and_derivatives_at_rest_warn(engine):
    b = mounted(
        "block", "m", "x", "prismatic", gravity=(0, 0, 0), mass=2.0, axis=(1, 0, 0), friction=3.0, stiffness=50.0
    )
    dyn = mb.dynamics(b.build(), engine)
    run = mb.simulate(dyn, [1.0], [0.0], 0.2, "rk4", 1e-3)
    assert run.check()
    with pytest.warns(MbkitWarning, match="no derivative at rest under dry friction"):
        dyn.linearize([0.1], [0.0], [0.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dyn.linearize([0.1], [1.0], [0.0])


@pytest.mark.parametrize(("method", "calls"), [("rk4", 0), ("rk853", 60), ("moreau", 60)])
def test_a_torque_that_fails_where_a_phase_is_looked_at_keeps_the_run(method, calls):
    b = mounted(
        "block", "m", "x", "prismatic", gravity=(0, 0, 0), mass=2.0, axis=(1, 0, 0), friction=3.0, stiffness=50.0
    )
    asked = itertools.count()

    def torque(_t, _q, _v):
        return [1 / (next(asked) < calls) - 1]

    with pytest.raises(TorqueError, match="ZeroDivisionError") as failed:
        mb.simulate(mb.dynamics(b.build(), "lagrangian"), [1.0], [0.0], 3.0, method, torque=torque)
    assert failed.value.trajectory.stats.ended == "function_failed"
    assert failed.value.trajectory.q[0].tolist() == [1.0]


def test_friction_of_what_follows_by_a_ratio_of_zero_does_nothing():
    b = mb.ModelBuilder("still")
    part = {"mass": 1.0, "com": (0.1, 0, 0), "inertia": (1, 1, 1)}
    b.add_body("a", **part)
    b.add_body("b", **part)
    b.add_joint("j", "revolute", parent="world", child="a", axis=(0, 1, 0), friction=0.1)
    b.add_joint("k", "revolute", parent="a", child="b", axis=(0, 1, 0), friction=5.0, mimic=("j", 0.0, 0.3))
    model = b.build()
    bare = mb.ModelBuilder.of(model)
    bare.set_joint("k", friction=0.0)
    runs = [mb.simulate(mb.dynamics(m, "lagrangian"), [0.1], [1.0], 0.5).q for m in (model, bare.build())]
    np.testing.assert_array_equal(*runs)


@pytest.mark.thorough("rk4")
@pytest.mark.parametrize("method", ["rk4", "rk853", "moreau"])
def test_what_rests_keeps_its_place_to_the_bit(method):
    """Beside joints that move, at zero too, where an armature alone would let it creep by 1e-34."""
    model = mb.load("talos_arm")
    dyn, q, v = mb.dynamics(model, "lagrangian"), model.neutral(), np.zeros(model.nv)
    push = 20.0 * np.eye(model.nv)[3]
    still = dyn.forward_dynamics(q, v, push) == 0
    run = mb.simulate(dyn, q, v, 1e-3, method, torque=push, doubt=False)
    assert not run.events
    assert still.any()
    assert not still.all()
    assert not run.q[:, still].any()
    stepped = dyn.step(q, v, push, 1e-3)[0], dyn.step([q, q], v, push, 1e-3)[0][1]
    assert not any(x[still].any() for x in stepped)
