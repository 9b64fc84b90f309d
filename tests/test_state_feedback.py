"""A torque as data: the same run as with a function, wherever it is evaluated."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import InputError
from mbkit.simulate import StateFeedback
from mbkit.simulate.solvers import compiled_fixed_step
from tests.random_trees import off, random_tree, states


def law(model: mb.Model, seed: int = 0) -> StateFeedback:
    rng = np.random.default_rng(seed)
    shape = model.nv, model.nq + model.nv
    return StateFeedback(
        rng.normal(size=shape) * (rng.random(shape) < 0.7),
        q=rng.normal(size=model.nq),
        v=rng.normal(size=model.nv),
        torque=rng.normal(size=model.nv),
    )


TREES = {
    "flat": lambda: random_tree(1, 4, ("revolute", "prismatic")),
    "with quaternions": lambda: random_tree(2, 2, ("free", "ball")),
    "with time": mb.catalog.pendulum_on_moving_support if hasattr(mb.catalog, "pendulum_on_moving_support") else None,
    "a loop": mb.catalog.four_bar,
}
TREES = {name: make for name, make in TREES.items() if make is not None}


@pytest.mark.thorough(every=3)
@pytest.mark.parametrize("in_pieces", [False, True])
@pytest.mark.parametrize("method", ["rk4", "semi_implicit_euler"])
@pytest.mark.parametrize("name", TREES)
def test_a_compiled_run_is_that_of_a_function(
    name: str, method: str, in_pieces: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mbkit.derivation.steps import fixed

    if in_pieces:
        monkeypatch.setattr(fixed, "_MAX_OPERATIONS_IN_ONE_PIECE", 0)
    model = TREES[name]()
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    q, v, *_ = states(model, 5)
    if model.constrained:
        q, v = dyn.project(q, v)
    feedback = law(model)
    run: dict[str, Any] = {"duration": 0.0205, "dt": 1e-3, "method": method, "save": 8, "doubt": False}
    want = mb.simulate(dyn, q, 0.1 * v, torque=lambda t, q, v: feedback(t, q, v), **run)
    monkeypatch.setattr(compiled_fixed_step, "run_fixed", None)
    found = mb.simulate(dyn, q, 0.1 * v, torque=feedback, **run)
    # A step's projection onto constraints ends within 1e-12.
    room = 1e-10 if model.constrained else 1e-13
    assert off(found.q, want.q) < room
    assert off(found.v, want.v) < room
    one = mb.simulate(dyn, q[2], 0.1 * v[2], torque=feedback, **run)
    assert off(one.q, found.q[2]) < 1e-14


@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_other_engines_and_methods_take_it_as_a_function(engine: str) -> None:
    model = mb.catalog.double_pendulum()
    feedback = law(model)
    ours, theirs = (mb.dynamics(model, e) for e in ("lagrangian", engine))
    q, v = np.array([0.3, -0.2]), np.array([1.0, 0.5])
    a = mb.simulate(ours, q, v, 0.1, "rk4", dt=1e-3, torque=feedback, save=100, doubt=False)
    b = mb.simulate(theirs, q, v, 0.1, "rk4", dt=1e-3, torque=feedback, save=100, doubt=False)
    c = mb.simulate(ours, q, v, 0.1, "rk853", rtol=1e-12, torque=feedback, save=[0.0, 0.1], doubt=False)
    assert off(a.q[-1], b.q[-1]) < 1e-12
    assert off(a.q[-1], c.q[-1]) < 1e-9


def test_the_law_is_what_it_says() -> None:
    rng = np.random.default_rng(1)
    K, q0, v0, u0, q, v = (rng.normal(size=s) for s in ((2, 4), 2, 2, 2, 2, 2))
    given = K.copy()
    feedback = StateFeedback(given, q0, v0, u0)
    given[:] = 0.0
    assert feedback(0.0, q, v) == pytest.approx(u0 + K @ np.concatenate([q0 - q, v0 - v]), rel=1e-14)
    assert feedback.numbers[2:].tolist() == K.ravel().tolist()
    assert repr(feedback) == "<StateFeedback of 4 numbers to 2 torques>"


def test_zeros_of_a_gain_are_not_in_the_compiled_step() -> None:
    model = random_tree(1, 4, ("revolute", "prismatic"))
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    gains = np.hstack([np.eye(4), np.eye(4)])
    with_gains, alone = (
        sum(code.operations for code in dyn._step_plan("rk4", fed=fed).codes)
        for fed in (StateFeedback(gains).pattern, "")
    )
    # Four stages: a product and a sum for each gain, and two sums for each torque; a full gain has 32 entries.
    assert with_gains - alone <= 4 * (8 + 2 * 4)


def test_a_diverging_run_says_so() -> None:
    model = mb.catalog.double_pendulum()
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    away = StateFeedback(-1e6 * np.eye(2, 4))
    run = mb.simulate(dyn, np.ones((3, 2)), np.ones((3, 2)), 5.0, "rk4", dt=1e-2, torque=away, save=100)
    assert "diverged after" in run.stats.message


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: StateFeedback(1.0), r"gain: expected shape \(nv, nq \+ nv\), got \(\)"),
        (lambda: StateFeedback(np.ones((2, 3))), r"gain: expected shape \(nv, nq \+ nv\), got \(2, 3\)"),
        (lambda: StateFeedback([[1, 2, 3, 4], [1, 2]]), "gain: expected an array"),
        (lambda: StateFeedback(np.full((2, 4), np.nan)), "gain: nan"),
        (lambda: StateFeedback(np.ones((2, 4)), q=0.5), r"q: expected shape \(2,\), got \(\)"),
        (lambda: StateFeedback(np.ones((2, 4)), torque=[1.0]), r"torque: expected shape \(2,\), got \(1,\)"),
    ],
)
def test_numbers_that_do_not_fit_are_named(make: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()


def test_a_gain_of_another_model_is_refused() -> None:
    dyn = mb.dynamics(mb.catalog.double_pendulum())
    with pytest.raises(
        InputError, match=r"torque: expected a gain of shape \(2, 4\), \(nv, nq \+ nv\) of .*got \(3, 6\)"
    ):
        mb.simulate(dyn, [0, 0], [0, 0], 1.0, torque=StateFeedback(np.ones((3, 6))))
