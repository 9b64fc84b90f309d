"""A run that finishes and is wrong says so, and one that is right does not."""

from __future__ import annotations

import itertools
import pickle
import re
import warnings

import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import DoubtfulRunWarning
from mbkit.methods.registry import Tolerances
from mbkit.simulate.checks import lost, massless_joints
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.progress import Progress
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord
from mbkit.simulate.torque import Torque
from mbkit.studies.exact_motions import pendulum
from tests.scenes import METHODS, mounted

# Drake's own runs have tests of their own.
LINEAR = sorted(name for name, method in METHODS.items() if method.stability and method.name != "drake_sap")


def hinge(stiffness=0.0, damping=0.0, **kw):
    place = {"axis": (0, 0, 1), "stiffness": stiffness, "damping": damping}
    b = mounted(
        "hinge", "a", "j", "revolute", gravity=(0, 0, 0), mass=1.0, com=(0, 0, 0), inertia=np.eye(3), **kw, **place
    )
    return b.build()


def doubts(model, method, q0, v0=None, duration=1.0, engine=None, **kw):
    """Return a run and what its checks find; what was warned of at once is a part of that."""
    own = engine or ("mujoco" if method.startswith("mujoco") else "lagrangian")
    dyn = mb.dynamics(model, own, **({"compile": False} if own == "lagrangian" else {}))
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        run = mb.simulate(dyn, q0, np.zeros(model.nv) if v0 is None else v0, duration, method, **kw)
    warned = [str(w.message) for w in heard if issubclass(w.category, DoubtfulRunWarning)]
    assert warned == [f"{model.name}: {method}: {one}" for one in run.stats.doubts]
    check = run.check()
    if run.stats.finished:
        assert {kind(one) for one in run.stats.doubts} <= {kind(one) for one in check.doubts}
    return run, list(check.doubts)


def kind(doubt):
    """Return a doubt without its numbers, which depend on the states that were looked at."""
    return re.sub(r"^gained|^lost|[-+]?[0-9][0-9.e+-]*", "", doubt)


# The step of 10 ms meets a spring of 80, 500 and 1e6 rad/s: hω = 0.8, 5, 1e4.
@pytest.mark.parametrize("method", LINEAR)
@pytest.mark.parametrize("omega", [80.0, 500.0, 1e6])
def test_no_fixed_step_method_passes_a_spring_in_silence(method, omega):
    run, told = doubts(hinge(omega**2), method, [0.1], dt=1e-2)
    exact = 0.1 * np.cos(omega * run.t)
    if run.stats.ended == "finished" and np.abs(run.q[:, 0] - exact).max() > 0.05:
        # Gauss's methods lose the phase of what is resolved by few steps a period slowly.
        assert told or omega == 80.0
    if omega > 100:
        assert told or not run.stats.finished


@pytest.mark.thorough("rk4-2.785")
@pytest.mark.parametrize(("method", "stable"), [("rk4", 2.785), ("semi_implicit_euler", 2.0), ("mujoco_rk4", 2.785)])
def test_explicit_methods_meet_a_damper_at_their_limit(method, stable):
    """Beyond the real end of the stability region, told with the step that would do; within, no word."""
    h = 1e-2
    # Within, what the steps make of the motion is gone in less than a hundredth of forty seconds; beyond, it grows.
    _, within = doubts(hinge(damping=0.95 * stable / h), method, [0.0], [1.0], dt=h, duration=40.0)
    run, beyond = doubts(hinge(damping=1.05 * stable / h), method, [0.0], [1.0], dt=h, duration=0.5)
    assert not within
    assert "too long for the fastest mode" in beyond[0]
    assert run.stats.finished  # nothing else would have told


@pytest.mark.parametrize(
    ("method", "damps"), [("mujoco_implicit", True), ("gauss6", False), ("implicit_midpoint", False)]
)
def test_implicit_methods_may_pass_a_damper_if_they_damp(method, damps):
    """Gauss's methods turn the velocity about in every step, and keep it: stable, and wrong."""
    run, told = doubts(hinge(damping=1e6), method, [0.0], [1.0], dt=1e-2)
    assert (np.abs(run.v[-1, 0]) < 1e-3) == damps
    assert bool(told) != damps


def test_energy_that_comes_from_nowhere_is_told():
    run, told = doubts(mb.catalog.double_pendulum(), "rk4", [3.0, 1.0], [3.0, -9.0], dt=0.1, duration=4.0)
    assert any("with nothing that drives it" in x for x in told), run.stats


@pytest.mark.thorough("semi_implicit_euler", "implicit_midpoint", "mujoco_euler")
@pytest.mark.parametrize("method", ["rk4", "semi_implicit_euler", "implicit_midpoint", "mujoco_euler"])
def test_ordinary_runs_are_not_doubted(method):
    """A double pendulum, high, and a robot in free fall of its joints, at one millisecond."""
    assert not doubts(mb.catalog.double_pendulum(), method, [1.5, -1.0], [0.5, 0.5], dt=1e-3)[1]


def test_a_method_of_first_order_is_held_against_twice_the_step():
    """Three seconds of a double pendulum: what it is said to be off by is what it is off by."""
    model, q0 = mb.catalog.double_pendulum(), np.array([1.5, 1.0])
    run, told = doubts(model, "semi_implicit_euler", q0, dt=5e-3, duration=3.0)
    truth, none = doubts(model, "rk853", q0, duration=3.0, rtol=1e-11, save=[3.0])
    assert not none
    off = np.abs(run.q[-1] - truth.q[-1]).max() / np.abs(run.q - q0).max()
    said = float(told[-1].split("off by ")[1].split(" of")[0])
    assert 0.5 < said / off < 2


def test_forces_and_dampers_may_change_the_energy():
    pendulum = mb.catalog.pendulum()
    assert not doubts(pendulum, "rk4", [0.1], dt=1e-3, torque=[5.0])[1]
    b = mounted(
        "damped", "a", "j", "revolute", mass=1.0, com=(0, 0, -0.5), inertia=np.eye(3), axis=(0, 1, 0), damping=2.0
    )
    assert not doubts(b.build(), "rk4", [2.0], dt=1e-3)[1]


def test_a_nearly_singular_mass_matrix_is_told_with_its_digits():
    b = mb.ModelBuilder("light", gravity=(0, 0, 0))
    b.add_body("cart", mass=1e-14, com=(0, 0, 0), inertia=1e-14 * np.eye(3))
    b.add_body("pole", mass=1.0, com=(0, 0, -1.0), inertia=1e-14 * np.eye(3))
    b.add_joint("x", "prismatic", parent="world", child="cart", axis=(1, 0, 0))
    b.add_joint("theta", "revolute", parent="cart", child="pole", axis=(0, 1, 0))
    told = doubts(b.build(), "rk4", [0.0, 0.0], [0.0, 0.0], engine="pinocchio", dt=1e-3, duration=0.01)[1]
    assert "singular" in told[0]
    assert "oracle" in told[0]


def test_coordinates_without_digits_are_told():
    body = mb.catalog.free_body()
    q = body.neutral()
    q[0] = 1e11
    told = doubts(body, "rk4", q, np.ones(6), dt=1e-3, duration=0.01)[1]
    assert any("nearer origin" in x for x in told)
    q[0] = 1e7
    told = doubts(body, "dop853", q, np.ones(6), duration=0.01, rtol=1e-8, atol=1e-12)[1]
    assert any("rtol" in x for x in told)


def test_a_step_over_gimbal_lock_is_told():
    b = mounted("ball", "a", "j", "spherical_zyx", gravity=(0, 0, 0), mass=1.0, com=(0, 0, 0), inertia=np.eye(3))
    told = doubts(b.build(), "rk4", [0.0, 1.5, 0.0], [0.0, 1.0, 0.0], dt=1e-2, duration=0.2)[1]
    assert any("gimbal lock" in x for x in told)
    assert not doubts(b.build(), "rk4", [0.0, 1.5, 0.0], [0.0, -1.0, 0.0], dt=1e-2, duration=0.2)[1]


def test_cheap_checks_run_at_once_and_warn():
    """Energy, condition and coordinates; no run is repeated for them, and none is linearized."""
    dyn = mb.dynamics(mb.catalog.double_pendulum())
    with pytest.warns(DoubtfulRunWarning, match="largest kinetic energy"):
        run = mb.simulate(dyn, [3.0, 1.0], [3.0, -9.0], 4.0, dt=0.1)
    assert "largest kinetic energy" in run.stats.doubts[0]
    body = mb.catalog.free_body()
    q = body.neutral()
    q[0] = 1e11
    with pytest.warns(DoubtfulRunWarning, match="nearer origin"):
        mb.simulate(mb.dynamics(body), q, np.ones(6), 0.01)


@pytest.mark.parametrize(("duration", "states"), [(0.01, 0), (0.06, 3), (3.0, 7)])
def test_cheap_checks_evaluate_a_few_percent_of_what_the_run_did(duration, states, monkeypatch):
    """At most one state for 75 evaluations from Python, and seven in all."""
    dyn, counts = mb.dynamics(mb.catalog.double_pendulum()), []
    for name in ("mass_matrix", "potential_energy"):
        term = getattr(dyn, name)
        monkeypatch.setitem(vars(dyn), name, lambda *a, term=term: counts.append(1) or term(*a))
    mb.simulate(dyn, [1.0, 0.5], [0.0, 0.0], duration, dt=1e-3, doubt=False)
    assert not counts
    mb.simulate(dyn, [1.0, 0.5], [0.0, 0.0], duration, dt=1e-3)
    assert len(counts) == 2 * states


@pytest.mark.parametrize("doubt", [True, False])
def test_a_check_finds_what_the_run_was_not_checked_for(doubt):
    dyn = mb.dynamics(hinge(1e8), "lagrangian")
    run = mb.simulate(dyn, [0.1], [0.0], 0.1, "implicit_midpoint", dt=1e-2, doubt=doubt)
    assert run.stats.doubts == ()
    check = run.check()
    assert not check
    assert not check.passed
    assert check.doubts == pickle.loads(pickle.dumps(run)).check().doubts
    assert check.doubts[0] in str(check)
    assert "h|λ|" in check._repr_html_()
    fine = mb.simulate(dyn, [0.1], [0.0], 1e-4, dt=1e-5, doubt=doubt).check()
    assert fine
    assert "no sign" in str(fine)


def test_a_check_does_not_need_the_start_among_the_saved_states():
    model = mb.catalog.double_pendulum()
    run = mb.simulate(mb.dynamics(model), [1.5, 1.0], [0.0, 0.0], 3.0, "semi_implicit_euler", 5e-3, save=[3.0], t0=0.0)
    later = mb.simulate(
        mb.dynamics(model), [1.5, 1.0], [0.0, 0.0], 3.0, "semi_implicit_euler", 5e-3, save=[9.0], t0=6.0
    )
    assert "a step of 0.01 s" in run.check().doubts[-1]
    assert run.check().doubts == later.check().doubts


def test_a_run_that_ended_early_does_not_pass_its_check():
    with pytest.warns(mb.errors.MbkitWarning):
        run = mb.simulate(mb.dynamics(hinge(1e8)), [0.1], [0.0], 10.0, dt=1e-2)
    assert run.check().doubts == (run.stats.message,)


def test_a_batch_is_checked_by_its_first_trajectories():
    dyn = mb.dynamics(mb.catalog.double_pendulum())
    q, v = np.array([[0.1, 0.0], [3.0, 1.0]]), np.array([[0.0, 0.0], [3.0, -9.0]])
    run = mb.simulate(dyn, q, v, 4.0, dt=0.1, doubt=False)
    assert any("largest kinetic energy" in one for one in run.check().doubts)
    assert run.check().title == "double_pendulum: rk4"


@pytest.mark.parametrize("method", LINEAR)
def test_a_step_of_a_linear_system_is_the_method_s(method):
    """The matrix that doubts rest on is what the method does: one step of a damped spring."""
    h, k, c = 0.1, 3.0, 0.7
    dyn = mb.dynamics(hinge(k, c), "mujoco" if "mujoco" in method else "lagrangian")
    state = np.array([0.3, -0.2])
    run = mb.simulate(dyn, state[:1], state[1:], h, method, dt=h, doubt=False)
    A, B = np.array([[-k]]), np.array([[-c]])
    matrix = METHODS[method].stability.matrix(h, A, B)
    np.testing.assert_allclose(matrix @ state, [run.q[-1, 0], run.v[-1, 0]], atol=1e-14)
    assert np.abs(np.linalg.eigvals(matrix)).max() < 1


def test_what_a_slow_drift_of_phase_loses():
    """Semi-implicit Euler's phase is off by ω³ h² t / 24 in leading order."""
    spring, none, rates = np.array([[-100.0]]), np.zeros((1, 1)), np.array([10j, -10j])
    steps = np.linalg.eigvals(METHODS["semi_implicit_euler"].stability.matrix(0.01, spring, none))
    part, rate = lost(steps, 0.01, rates, duration=24.0)
    assert part == pytest.approx(10.0**3 * 0.01**2, abs=1e-3)
    assert abs(rate.imag) == 10.0


@pytest.mark.parametrize("crowded", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_modes_are_paired_with_steps_so_that_all_together_are_nearest(seed: int, crowded: bool) -> None:
    """Crowded, several modes have the same nearest step."""
    rng = np.random.default_rng(seed)
    rates = 1j * (rng.uniform(1.0, 1.1, 4) if crowded else np.array([1.0, 5.0, 9.0, 13.0]))
    h, off = 0.1, rng.uniform(-0.02, 0.02, (2, 4))
    steps = np.exp(h * rates + off[0] + 1j * off[1])
    gaps = np.abs(np.log(steps)[None, :] - h * rates[:, None])
    best = min(itertools.permutations(range(4)), key=lambda places: gaps[range(4), places].sum())
    assert (len(set(gaps.argmin(axis=1))) < 4) == crowded
    part, _ = lost(rng.permutation(steps), h, rates, duration=1.0)
    assert part * h == pytest.approx(gaps[range(4), best].max(), rel=1e-9)


# What a sweep of all cases and methods found wrong by more than a hundredth, and unsaid.


@pytest.mark.thorough("rk4")
@pytest.mark.parametrize("method", ["rk4", "mujoco_rk4"])
def test_a_phase_that_drifts_slowly_and_an_energy_that_falls_slowly_are_told(method):
    """The pole swings under next to no cart; 4 percent of it, and half a percent of its energy, are gone in 10 s."""
    run, told = doubts(mb.catalog.cart_pole(cart_mass=0.01), method, [0.0, np.pi / 2], duration=10.0, dt=1e-3)
    assert run.stats.finished
    assert any("of it is lost over the run" in x for x in told)
    assert any("largest kinetic energy" in x for x in told)


@pytest.mark.parametrize(("method", "gravity"), [("implicit_midpoint", 1e4), ("rk4", 1e5)])
def test_a_large_swing_doubles_what_a_phase_is_off(method, gravity):
    model = mb.catalog.pendulum(gravity=gravity)
    run, told = doubts(model, method, [2.5], dt=1e-3)
    assert np.abs(run.q - pendulum(2.5, 0.0, gravity)(run.t)).max() > 0.01 * 2.5
    assert "of it is lost over the run" in told[0]


def test_what_rings_where_it_should_be_gone_is_told():
    """The midpoint rule turns a critically damped spring's offset about, and lets it die in 25 steps."""
    run, told = doubts(hinge(1e10, damping=2e5), "implicit_midpoint", [0.1], dt=1e-3)
    assert np.abs(run.q[1:10]).max() > 0.05
    assert "a motion with h|λ| = 1e+02" in told[0]


def test_taylor_s_tolerance_is_not_relative_to_the_largest_rate():
    """Of a ball at 1e5 rad/s the quaternion was off by 6 percent at rtol = 1e-8, and nothing said so."""
    b = mounted("ball", "ball", "turn", "ball", gravity=(0.0, 0.0, 0.0), mass=1.0, inertia=(0.4, 0.4, 0.4))
    run, told = doubts(b.build(), "taylor", [0, 0, 0, 1], [0, 0, 1e5], duration=0.1, rtol=1e-8, save=[0.0, 0.1])
    half = 0.5e5 * 0.1
    assert np.abs(run.q[-1] - [0, 0, np.sin(half), np.cos(half)]).max() < 1e-6
    assert not told
    # And so is a coordinate far from its origin: 7e-9 is half of what its doubles are apart.
    swing = mb.catalog.pendulum()
    far = 1e8 - 1e8 % (2 * np.pi)
    near = doubts(swing, "taylor", [1.0], rtol=1e-8, save=[0.0, 1.0])[0].q
    run, told = doubts(swing, "taylor", [far + 1.0], rtol=1e-8, save=[0.0, 1.0])
    assert np.abs(run.q - far - near).max() < 1e-7
    assert not told


def test_a_state_that_outgrows_its_start_is_told_by_taylor():
    """A flywheel is driven to 1e8 rad/s; beside it a pendulum is off by a tenth of a radian."""
    b = mb.ModelBuilder("two")
    b.add_body("fly", mass=1.0, inertia=(1, 1, 1))
    b.add_body("bob", mass=1.0, com=(0, 0, -0.5), inertia=(0.1, 0.1, 0.02))
    b.add_joint("f", "continuous", parent="world", child="fly", axis=(1, 0, 0))
    b.add_joint("s", "continuous", parent="world", child="bob", axis=(0, 1, 0))
    more = {"duration": 10.0, "rtol": 1e-8, "save": [0.0, 10.0], "torque": np.array([1e7, 0.0])}
    run, told = doubts(b.build(), "taylor", [0.0, 1.0], [0.0, 0.0], **more)
    assert run.stats.finished
    assert any("outgrew" in x or "grew to 5e+08" in x for x in told)


def test_digits_that_are_not_lost_are_not_doubted():
    """A cart of 1e-13 kg: M is singular to rounding, and nothing is computed from it."""
    model = mb.catalog.cart_pole(cart_mass=1e-13)
    more = {"duration": 1e-6, "rtol": 1e-12, "save": [0.0, 1e-6]}
    assert not doubts(model, "rk853", [0, 0.0], [0, 1.0], **more)[1]


@pytest.mark.thorough
def test_errors_that_add_up_over_many_steps_are_told():
    """As of a box that tumbles for 300 flips, of which a multistep method loses a hundredth at rtol = 1e-8."""
    told = doubts(hinge(1e6), "radau", [0.1], duration=1.0, rtol=1e-4, save=[0.0, 1.0])[1]
    assert any("errors of" in x and "add up" in x for x in told)
    assert not doubts(hinge(1e2), "radau", [0.1], duration=1.0, rtol=1e-8, save=[0.0, 1.0])[1]


def test_a_joint_that_moves_no_mass_in_a_pose_is_named():
    # A point on a massless rod: where the second axis has turned the rod along the first one, nothing turns about it.
    b = mounted("rod", "rod", "hook", "universal", mass=1.0, com=(0, 0, -1), axis=(1, 0, 0), axis2=(0, 1, 0))
    dyn = mb.dynamics(b.build(), "lagrangian")
    told = massless_joints(dyn, np.array([0.3, np.pi / 2 - 1e-6]))
    assert "'hook'" in told
    assert "gimbal lock" in told
    assert not massless_joints(dyn, np.array([0.3, 0.3]))


@pytest.mark.parametrize(("reached", "ends"), [(0.5, False), (1e-5, False), (1e-8, True)])
def test_steps_that_cover_nothing_end_a_run(reached, ends):
    dyn, rule = mb.dynamics(mb.catalog.pendulum()), Tolerances(1e-9, 1e-9)
    torque, start = Torque(None, dyn.model, None, None), (np.zeros(1), np.zeros(1))
    problem = IntegrationProblem(dyn, "rk853", *start, 0.0, 1.0, rule, torque, None, (), Progress(None, ""))
    member = TrajectoryRecord(problem, 0)
    member.steps, member.rejected, member.reached = 19_000, 900, reached / 2
    assert not member.crawls()
    member.rejected, member.reached = 1_000, reached
    assert member.crawls() == ends
    assert member.ended == ("step_too_small" if ends else "finished")


@pytest.mark.parametrize(
    ("engine", "method"), [("lagrangian", "rk4"), ("pinocchio", "rk4"), ("mujoco", "rk4"), ("mujoco", "mujoco_rk4")]
)
def test_a_wild_run_of_one_step_is_told_at_once(engine, method):
    """One step of Runge and Kutta's over ω h = 10 leads to 1 - 50 + 10⁴/24 and to -(10 - 10³/6) ω."""
    b = mounted("sprung", "m", "x", "prismatic", gravity=(0, 0, 0), mass=1.0, axis=(1, 0, 0), stiffness=100.0)
    dyn = mb.dynamics(b.build(point_masses=True), engine)
    x, w = 1 - 50 + 1e4 / 24, -(10 - 1e3 / 6)
    with pytest.warns(DoubtfulRunWarning, match=r"gained 8e.06 J, 118 % of the run's largest kinetic energy"):
        run = mb.simulate(dyn, [1.0], [0.0], 1.0, method, dt=1.0)
    assert [run.q[-1, 0], run.v[-1, 0] / 10] == pytest.approx([x, w])
    assert f"{50 * (x**2 + w**2 - 1):.0e}" == "8e+06"
    assert "with doubts" in repr(run)


def test_a_short_run_in_machine_code_compiles_nothing_for_its_checks():
    b = mounted("sprung", "m", "x", "prismatic", gravity=(0, 0, 0), mass=1.03, axis=(1, 0, 0), stiffness=100.0)
    dyn = mb.dynamics(b.build(point_masses=True), "lagrangian", compile=True)
    assert not mb.simulate(dyn, [1.0], [0.0], 1.0, dt=0.05).stats.doubts
    assert not {("mass_matrix",), ("potential_energy",)} & set(dyn._machines)
    assert mb.simulate(dyn, [1.0], [0.0], 1.0, dt=0.25).stats.doubts
    assert ("potential_energy",) in dyn._machines


def test_soft_loops_are_doubted_in_each_run_of_one_engine():
    """The warning comes once; the run's own check tells it each time, with how far the accelerations are off."""
    model = mb.catalog.four_bar()
    dyn = mb.dynamics(model, "mujoco")
    tau = np.zeros(model.nv)
    q, _ = dyn.project([1.1, -0.4, 0.7], tau)
    rigid = mb.dynamics(model, "lagrangian").forward_dynamics(q, tau, tau)
    off = np.linalg.norm(dyn.forward_dynamics(q, tau, tau) - rigid) / np.linalg.norm(rigid)
    for _ in range(2):
        (doubt,) = (x for x in mb.simulate(dyn, q, tau, 0.01, "rk4", dt=1e-3).check().doubts if "soft" in x)
        assert f"{100 * off:.2g} %" in doubt
    assert not mb.simulate(mb.dynamics(model, "lagrangian"), q, tau, 0.01, "rk4", dt=1e-3).check().doubts


def test_a_motion_as_small_as_its_tolerance_is_doubted():
    """A block of 1e-3 m/s comes up a slope by 4.2e-8 m: `bdf` is a quarter of it off, within an atol of 1e-8."""
    b = mounted("block", "block", "x", "prismatic", gravity=(0, 0, 0), mass=1.0, axis=(1, 0, 0), damping=0.0)
    dyn = mb.dynamics(b.build(), "lagrangian")
    torque = [-12.0]
    for speed, atol, doubted in ((1e-3, 1e-8, True), (1e-3, 1e-12, False), (1.0, 1e-8, False)):
        run = mb.simulate(dyn, [0.0], [speed], 1e-4, "bdf", rtol=1e-8, atol=atol, torque=torque)
        error = abs(run.q[-1, 0] - (speed * 1e-4 - 6e-8))
        assert error < 1e3 * atol
        assert any("smaller atol" in x for x in run.check().doubts) == doubted
    assert not mb.simulate(dyn, [0.0], [1e-3], 1e-4, "rk4", dt=1e-5, torque=torque).check().doubts
    # What stands still may do so, also where a projection left rounding in its velocity.
    for rounding in (0.0, 1e-16):
        assert not mb.simulate(dyn, [0.0], [rounding], 1e-4, "rk853", rtol=1e-8).check().doubts
