"""Sensitivities along a run: closed forms, differences of runs, and what multiplies."""

from __future__ import annotations

from itertools import pairwise

import mpmath as mp
import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import InputError, NumericalError, UnsupportedError
from tests.random_trees import random_tree, states
from tests.scenes import mounted

EPS = np.finfo(float).eps


def close(x, y, limit):
    assert np.abs(x - y).max(initial=0.0) <= limit * max(np.abs(y).max(initial=0.0), 1.0)


@pytest.fixture(scope="module")
def arm():
    model = mb.catalog.double_pendulum(length1=mb.Parameter("l", 1.1), mass1=mb.Parameter("m", 2.0), mass2=0.5)
    return mb.dynamics(model, "lagrangian")


def test_a_pendulum_by_elliptic_functions():
    """From rest: sin(θ/2) = k sn(K + ω t), k = sin(θ₀/2), ω = √(g/l); differentiated by mpmath."""
    dyn = mb.dynamics(mb.catalog.pendulum(length=mb.Parameter("l", 0.8)), "lagrangian")
    out = mb.sensitivities(dyn, [1.2], [0.0], 1.5, dt=0.01, method="gauss6")
    with mp.workdps(40):

        def angle(start, length, t):
            k = mp.sin(start / 2)
            turn = mp.ellipk(k**2) + mp.sqrt(mp.mpf(9.81) / length) * t
            return 2 * mp.asin(k * mp.re(mp.ellipfun("sn", turn, m=k**2)))

        at = mp.mpf(1.2), mp.mpf(0.8), mp.mpf(1.5)
        by_start, by_length = (mp.diff(angle, at, n) for n in ((1, 0, 0), (0, 1, 0)))
        rates = [mp.diff(angle, at, n) for n in ((1, 0, 1), (0, 1, 1))]
    # The method's own error is of order h⁶.
    close(out.state[-1, :, 0], np.array([float(by_start), float(rates[0])]), 1e-11)
    close(out.parameters[-1, :, 0], np.array([float(by_length), float(rates[1])]), 1e-11)


@pytest.mark.thorough("gauss4", "implicit_midpoint")
@pytest.mark.parametrize("method", ["rk4", "semi_implicit_euler", "gauss4", "implicit_midpoint"])
def test_they_are_differences_of_runs(arm, method):
    model, torque = arm.model, np.random.default_rng(0).standard_normal((20, 2))
    start = np.concatenate([[0.5, -0.4, 1.0, 0.3, 0.0, 0.0], [*model.parameters.values()]])

    def end(x):
        own = arm.at(**dict(zip(model.parameters, x[6:], strict=True)))
        # The last of the steps is shorter than the others.
        run = mb.simulate(own, x[:2], x[2:4], 0.987, method, 0.05, torque=torque + x[4:6], doubt=False)
        return np.concatenate([run.q[-1], run.v[-1]])

    out = mb.sensitivities(arm, start[:2], start[2:4], 0.987, dt=0.05, method=method, torque=torque)
    got = np.concatenate([out.state[-1], out.tau[-1], out.parameters[-1]], axis=-1)
    # Richardson's extrapolation of central differences: h⁶, and eps / h.
    e = 4e-3
    for direction in np.random.default_rng(1).standard_normal((2, 8)):
        rules = [(end(start + h * direction) - end(start - h * direction)) / (2 * h) for h in (e, e / 2, e / 4)]
        second = [(4 * b - a) / 3 for a, b in pairwise(rules)]
        close(got @ direction, (16 * second[1] - second[0]) / 15, 1e-10)
    run = mb.simulate(arm, start[:2], start[2:4], 0.987, method, 0.05, torque=torque, doubt=False)
    np.testing.assert_array_equal(out.run.q, run.q)


def test_quaternions_and_other_engines():
    model = random_tree(5, 3, ("free", "ball", "revolute"), springs=False, damping=False, nearest=1)
    q, v, _, tau = (x[0] for x in states(model, 1, 5))
    own, other = (
        mb.sensitivities(mb.dynamics(model, e), q, v, 0.1, dt=0.01, torque=tau) for e in ("lagrangian", "pinocchio")
    )
    close(own.state, other.state, 1e-10)
    close(own.tau, other.tau, 1e-10)
    dyn, n = mb.dynamics(model, "lagrangian"), model.nv

    def end(x):
        run = mb.simulate(dyn, model.integrate(q, x[:n]), v + x[n:], 0.1, dt=0.01, torque=tau, doubt=False)
        return np.concatenate([model.difference(own.run.q[-1], run.q[-1]), run.v[-1]])

    h = 1e-3
    for k, e in enumerate(h * np.eye(2 * n)):
        close(own.state[-1, :, k], (8 * (end(e) - end(-e)) - end(2 * e) + end(-2 * e)) / (12 * h), 1e-8)


def test_transitions_multiply(arm):
    out = mb.sensitivities(arm, [0.5, -0.4], [1.0, 0.3], 0.5, dt=0.01)
    close(out.transition(20, 50) @ out.transition(0, 20), out.state[50], 100 * EPS)
    np.testing.assert_array_equal(out.transition(7, 7), np.eye(4))
    # Forces of each step, carried to the end, are the force that is held all the time.
    held = sum(out.transition(k + 1, 50) @ out.B[k] for k in range(50))
    close(held, out.tau[-1], 100 * EPS)
    for indices in ((3, 2), (0, 51)):
        with pytest.raises(InputError, match="start, end"):
            out.transition(*indices)


def test_a_batch_has_each_ones_parameters(arm):
    many = arm.at(l=np.array([1.0, 1.2, 1.3]))
    torque = np.random.default_rng(0).standard_normal((3, 25, 2))
    out = mb.sensitivities(many, [0.5, -0.4], [1.0, 0.3], 0.25, dt=0.01, torque=torque)
    one = mb.sensitivities(arm.at(l=1.2), [0.5, -0.4], [1.0, 0.3], 0.25, dt=0.01, torque=torque[1])
    assert out.parameters.shape == (3, 26, 4, 2)
    for name in ("A", "B", "state", "tau", "parameters"):
        close(getattr(out, name)[1], getattr(one, name), 100 * EPS)
    close(out.transition(3, 9)[1], one.transition(3, 9), 100 * EPS)


def test_without_parameters_and_without_duration(arm):
    out = mb.sensitivities(arm, [0.5, -0.4], [1.0, 0.3], 0.0, parameters=False)
    assert out.state.shape == (1, 4, 4)
    assert out.A.shape == (0, 4, 4)
    assert out.parameters.shape == (1, 4, 0)
    assert repr(out) == "<Sensitivities of 'double_pendulum': states (1,), 2nv = 4, p = 0>"
    none = mb.sensitivities(arm, np.empty((0, 2)), np.empty((0, 2)), 0.1, dt=0.05)
    assert none.state.shape == (0, 3, 4, 4)


def test_what_cannot_be_differentiated_is_refused(arm):
    start = ([0.5, -0.4], [1.0, 0.3], 0.1)
    with pytest.raises(UnsupportedError, match="array"):
        mb.sensitivities(arm, *start, torque=lambda *state: -state[2])
    with pytest.raises(UnsupportedError, match="rk853"):
        mb.sensitivities(arm, *start, method="rk853")
    with pytest.raises(UnsupportedError, match="finite differences"):
        mb.sensitivities(mb.dynamics(mb.catalog.pendulum(), "mujoco"), [0.1], [0.0], 0.1)
    with pytest.raises(InputError, match="Dynamics"):
        mb.sensitivities(arm.model, *start)
    with pytest.raises(InputError, match="parameters"):
        mb.sensitivities(arm, *start, parameters="l")
    pinocchio = mb.dynamics(arm.model)
    with pytest.raises(UnsupportedError, match="parameter_derivatives"):
        mb.sensitivities(pinocchio, *start)
    assert mb.sensitivities(pinocchio, *start, parameters=False).state.shape == (101, 4, 4)


@pytest.mark.filterwarnings("ignore")
def test_a_run_that_ends_nowhere_is_an_error(arm):
    with pytest.raises(NumericalError, match="double_pendulum"):
        mb.sensitivities(arm, [0.5, -0.4], [1e200, 0.3], 1.0, dt=0.1)


def test_a_force_of_the_time_is_refused_as_one():
    b = mb.ModelBuilder("pushed", gravity=(0, 0, 0))
    b.add_body("block", mass=1.0)
    b.add_joint("x", "prismatic", parent="world", child="block", axis=(1, 0, 0))
    b.add_joint_force("push", "x", lambda t, q, v: 3 * t - q)  # noqa: ARG005
    dyn = mb.dynamics(b.build(), "lagrangian")
    for call in (
        lambda: dyn.discretize([0.1], [0.0], [0.0], dt=0.01),
        lambda: mb.sensitivities(dyn, [0.1], [0.0], 0.1),
    ):
        with pytest.raises(UnsupportedError, match="terms that depend on the time"):
            call()


def test_of_a_model_that_cannot_move():
    b = mounted("wall", "brick", "mortar", "fixed", mass=1.0)
    dyn = mb.dynamics(b.build(), "lagrangian")
    assert mb.sensitivities(dyn, [], [], 0.1, dt=0.05).state.shape == (3, 0, 0)
    assert dyn.linearize([], [], []).discretize(0.1).A.shape == (0, 0)
    assert dyn.discretize([], [], [], 0.1, "implicit_midpoint").A.shape == (0, 0)
