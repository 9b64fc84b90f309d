# Torques and stub engines have the signature they are called with.
# ruff: noqa: ARG005
"""Integrators: their order, MuJoCo's own steps, and runs that go wrong."""

from __future__ import annotations

import csv
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from operator import add, mul
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mbkit as mb
from mbkit import catalog, spatial
from mbkit.engines import Dynamics, dynamics
from mbkit.errors import (
    InputError,
    MbkitWarning,
    OutputError,
    UnsupportedError,
)
from mbkit.methods.tableaus import (
    RosenbrockTableau,
    _stage_weights,
    density,
    dormand_prince_853,
    gauss_legendre,
    rodas5p,
    rooted_trees,
    rounding_of_condition,
)
from mbkit.model import Model, quaternions
from mbkit.model.integration_space import Space
from mbkit.simulate import METHODS, RK4, Tableau, Trajectory, simulate
from mbkit.simulate.time_grid import Grid
from tests import orders
from tests.scenes import chain, damped_arm, slider
from validation import closed_forms

EPS = np.finfo(float).eps
FIXED = ("rk4", "semi_implicit_euler")
NATIVE = {"rk4": "mujoco_rk4", "semi_implicit_euler": "mujoco_euler"}


def tumbling() -> tuple[Model, np.ndarray, np.ndarray]:
    """A free body with everything on: gravity, off-centre, moving and turning fast."""
    base = {"mass": 2.0, "com": (0.1, -0.2, 0.05), "inertia": (0.3, 0.4, 0.6), "translation": (0, 0, 1)}
    arm = {"mass": 0.7, "com": (0.2, 0.1, 0.0), "inertia": (0.02, 0.03, 0.04), "translation": (0.3, 0.0, 0.1)}
    hand = {"mass": 0.3, "com": (0.1, 0.0, 0.1), "inertia": (0.01, 0.01, 0.01), "translation": (0.4, 0.0, 0.0)}
    base |= {"kind": "free", "rpy": (0.3, -0.2, 1.0)}
    model = chain(base, arm | {"kind": "ball"}, hand | {"axis": (0, 1, 0)}, name="tumbling").build()
    q, v = model.random_state(np.random.default_rng(3))
    return model, q, v


def stiff(stiffness: float = 1e9) -> Dynamics:
    return dynamics(slider(stiffness=stiffness).build())


# Tableaus


def test_tableaus_check_themselves() -> None:
    # Cayley's numbers.
    assert [len(rooted_trees(n)) for n in range(1, 9)] == [1, 1, 2, 4, 9, 20, 48, 115]
    eighths = Tableau(
        "3/8", [[0, 0, 0, 0], [1 / 3, 0, 0, 0], [-1 / 3, 1, 0, 0], [1, -1, 1, 0]], [1 / 8, 3 / 8, 3 / 8, 1 / 8], 4
    )
    assert eighths.c == pytest.approx([0, 1 / 3, 2 / 3, 1])
    for A, b, order, words in (
        (RK4.A, RK4.b, 5, "order 5"),
        # Kutta's third-order weights pass for order 4 where only the quadrature is looked at.
        ([[0, 0, 0], [0.5, 0, 0], [-1, 2, 0]], [1 / 6, 2 / 3, 1 / 6], 4, "order 4 condition"),
        (RK4.A, [1 / 6, 1 / 3, 1 / 3, 1 / 3], 4, "order 1"),
        ([[0.5]], [1.0], 2, "not explicit"),
        ([[0.0]], [0.5, 0.5], 1, r"expected A \(s, s\)"),
    ):
        with pytest.raises(InputError, match=words):
            Tableau("wrong", A, b, order)
    assert np.array_equal(pickle.loads(pickle.dumps(RK4)).A, RK4.A)


def fractions(matrix: np.ndarray) -> list[list[Fraction]]:
    return [[Fraction(x) for x in row] for row in matrix.tolist()]


def exact_weights(alpha: list[list[Fraction]], beta: list[list[Fraction]]) -> Callable[[Any], list[Fraction]]:
    """Return the elementary weights of the stages by the tree."""

    @cache
    def sums(branch: Any, alone: bool) -> list[Fraction]:
        return [sum(map(mul, row, weights(branch))) for row in (beta if alone else alpha)]

    @cache
    def weights(tree: Any) -> list[Fraction]:
        out = [Fraction(1)] * len(alpha)
        for branch in tree:
            out = list(map(mul, out, sums(branch, len(tree) == 1)))
        return out

    return weights


def rosenbrock_form(own: RosenbrockTableau, weights: np.ndarray) -> tuple[Any, Any, list[Fraction]]:
    """α, α + Γ and b of a Rosenbrock method in exact arithmetic, from its published coefficients."""
    s, gamma, C, A = own.stages, Fraction(own.gamma), fractions(own.C), fractions(own.A)
    coupling = [[Fraction(0)] * s for _ in range(s)]
    for i in range(s):
        for j in range(i + 1):
            coupling[i][j] = gamma * ((i == j) + sum(C[i][k] * coupling[k][j] for k in range(j, i)))
    columns = list(zip(*coupling, strict=True))
    alpha = [[sum(map(mul, row, column)) for column in columns] for row in A]
    b = [Fraction(x) for x in weights.tolist()]
    beta = [list(map(add, *rows)) for rows in zip(alpha, coupling, strict=True)]
    return alpha, beta, [sum(map(mul, b, column)) for column in columns]


PAIR, ROSENBROCK = dormand_prince_853(), rodas5p()


@pytest.mark.parametrize(
    ("tableau", "weights", "order"),
    [
        (RK4, RK4.b, 4),
        (gauss_legendre(2), gauss_legendre(2).b, 4),
        (gauss_legendre(3), gauss_legendre(3).b, 6),
        (PAIR, PAIR.b, 8),
        (PAIR, PAIR.b - PAIR.errors[0], 5),
        (PAIR, PAIR.b - PAIR.errors[1], 3),
        (ROSENBROCK, ROSENBROCK.b, 5),
        (ROSENBROCK, ROSENBROCK.b - ROSENBROCK.error, 4),
    ],
    ids=lambda x: getattr(x, "name", ""),
)
def test_the_coefficients_of_ours_fulfil_their_order_in_exact_arithmetic(
    tableau: Tableau | RosenbrockTableau, weights: np.ndarray, order: int
) -> None:
    """They are the doubles nearest to numbers that fulfil it: what is left is half an eps for each node of a tree."""
    if isinstance(tableau, RosenbrockTableau):
        alpha, beta, b = rosenbrock_form(tableau, weights)
    else:
        alpha = beta = fractions(tableau.A)
        b = [Fraction(x) for x in weights.tolist()]
    weights = exact_weights(alpha, beta)
    sizes = exact_weights(*([[abs(x) for x in row] for row in matrix] for matrix in (alpha, beta)))
    for p in range(1, order + 1):
        for tree in rooted_trees(p):
            rest = sum(map(mul, b, weights(tree))) - Fraction(1, density(tree))
            size = sum(map(mul, map(abs, b), sizes(tree)))
            # The doubles of a Rosenbrock method pass through an inverse, whose condition is 2.6e3.
            assert abs(rest) <= Fraction(EPS) / 2 * (p + 1) * size * (10 if alpha is not beta else 1)


@pytest.mark.parametrize("seed", range(3))
def test_no_order_of_summation_lets_a_tableau_of_ones_own_fail(seed: int) -> None:
    """Another BLAS sums in another order, as a permutation of the stages does: the bound holds for all of them."""
    A, b, rng = PAIR.A, PAIR.b, np.random.default_rng(seed)
    for _ in range(20):
        order = rng.permutation(len(b))
        for tree in rooted_trees(8)[:: 5 + seed]:
            got = b[order] @ _stage_weights(A[np.ix_(order, order)], tree)
            assert abs(got - 1 / density(tree)) <= rounding_of_condition(A, b, tree)
    assert Tableau("of one's own", A, b, 8).order == 8
    # A digit that is wrong shows all the same.
    wrong = b.copy()
    wrong[int(np.argmax(np.abs(b)))] *= 1 + 1e-12
    with pytest.raises(InputError, match="order"):
        Tableau("misprint", A, wrong, 8)


# Rotations and the space


def test_dexp_inverse_is_the_rate_of_the_rotation_vector() -> None:
    """exp(u(t)) turning with body velocity w: u̇ found by differences of the logarithm."""

    rng = np.random.default_rng(0)
    for size in (1e-9, 0.05, 0.0999, 0.1001, 1.0, 3.0):
        u = rng.standard_normal(3)
        u *= size / np.linalg.norm(u)
        w = rng.standard_normal(3)
        h = 1e-6
        ends = [
            spatial.log_quaternion(spatial.multiply(spatial.exp_quaternion(u), spatial.exp_quaternion(s * h * w)))
            for s in (-1, 1)
        ]
        rate = (ends[1] - ends[0]) / (2 * h)
        got = np.array(quaternions.dexp_inverse(quaternions.FLOATS, u.tolist(), w.tolist()))
        assert got == pytest.approx(rate, abs=2e-9)
        # One state and a batch, and the repository's other formula, give the same.
        many = [np.full(2, x) for x in u], [np.full(2, x) for x in w]
        batch = np.array(quaternions.dexp_inverse(quaternions.ARRAYS, *many))
        assert batch[:, 0] == pytest.approx(got, abs=8 * EPS)
        assert got == pytest.approx(spatial.left_jacobian_inverse(-u) @ w, abs=1e-13)


def test_space_round_trip_and_parent_axes() -> None:
    model, q, v = tumbling()
    space = Space(model)
    w = space.to_integrator_velocity(q, v)
    assert w[:3] == pytest.approx(Rotation.from_quat(q[3:7]).as_matrix() @ v[:3], abs=1e-14)
    assert np.array_equal(w[3:], v[3:])
    assert space.to_body_velocity(q, w) == pytest.approx(v, abs=1e-14)
    many = np.stack([q, q]), np.stack([v, 2 * v])
    assert space.to_integrator_velocity(*many) == pytest.approx(np.stack([w, 2 * w]), abs=1e-14)
    moved = space.retract(*many)
    assert moved[0] == pytest.approx(space.retract(q, v), abs=1e-14)
    model.check_q(moved)


# Order of convergence


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("case", orders.cases())
@pytest.mark.parametrize("method", FIXED)
def test_observed_order(case: str, method: str) -> None:
    counts = (60, 90, 140, 200) if method == "rk4" else (300, 450, 700, 1000)
    assert orders.observed(case, method, counts) == pytest.approx(METHODS[method].order, abs=0.2)


# MuJoCo's own integrators


def assert_as_mujoco(model: Model, q: np.ndarray, v: np.ndarray, duration: float = 1.0, dt: float = 1e-3) -> None:
    engines = {name: dynamics(model, name) for name in ("pinocchio", "mujoco")}
    for method in FIXED:
        own = simulate(engines["mujoco"], q, v, duration, NATIVE[method], dt)
        for dyn in engines.values():
            run = simulate(dyn, q, v, duration, method, dt)
            assert run.stats.finished
            assert own.stats.finished
            assert np.array_equal(run.t, own.t)
            assert np.abs(run.q - own.q).max() <= 1e-12, (method, dyn.engine)
            assert np.abs(run.v - own.v).max() <= 1e-10, (method, dyn.engine)


def kinds() -> Model:
    """Return one joint of each kind that MuJoCo has."""
    links: list[dict[str, Any]] = [
        {"kind": "planar"},
        {"kind": "universal", "axis": (1, 0, 0), "axis2": (0, 1, 0)},
        {"kind": "ball"},
        {"kind": "prismatic", "axis": (0, 1, 1)},
        {"kind": "spherical_zyx"},
        {"kind": "revolute", "axis": (1, 1, 0)},
        {"kind": "free", "parent": "world"},
    ]
    place = {"translation": (0.1, 0.2, 0.3), "rpy": (0.1, 0.2, 0.3)}
    body = {"mass": 1.0, "com": (0.1, 0.05, -0.1), "inertia": (0.1, 0.12, 0.15)}
    return chain(*(body | place | link for link in links)).build()


def test_rollouts_of_every_joint_and_with_dampers_and_springs_are_mujocos() -> None:
    model = kinds()
    assert_as_mujoco(model, *model.random_state(np.random.default_rng(0)), duration=0.2)
    model, q, v = tumbling()
    # Long steps: at 1 ms the last term of dexp⁻¹ is below rounding.
    assert_as_mujoco(model, q, 3 * v, duration=0.3035, dt=0.01)
    assert_as_mujoco(damped_arm(), np.array([1.0, -0.5]), np.array([2.0, 1.0]))


def test_native_batches_torques_and_implicit_methods() -> None:
    model = catalog.double_pendulum()
    dyn = dynamics(model, "mujoco")
    q, v = model.random_state(np.random.default_rng(0), 3)
    tau = np.random.default_rng(1).standard_normal((3, 50, 2))
    own = simulate(dyn, q, v, 0.05, "mujoco_rk4", torque=tau, save=10)
    run = simulate(dynamics(model), q, v, 0.05, "rk4", torque=tau, save=10)
    assert own.q.shape == (3, 6, 2)
    assert own.q == pytest.approx(run.q, abs=1e-13)
    assert own.stats.steps == run.stats.steps == 150
    assert own.stats.evaluations == run.stats.evaluations == 600
    for method in ("mujoco_implicit", "mujoco_implicitfast"):
        other = simulate(dyn, q, v, 0.05, method, torque=tau, save=10)
        assert 1e-9 < np.abs(other.q - own.q).max() < 1e-1
    constant = simulate(dyn, q, v, 0.05, "mujoco_euler", torque=[0.3, -0.2])
    assert constant.q == pytest.approx(simulate(dyn, q, v, 0.05, FIXED[1], torque=[0.3, -0.2]).q, abs=1e-13)


@pytest.mark.parametrize(
    ("engine", "method", "words"),
    [
        ("pinocchio", "mujoco_rk4", r"not on the pinocchio engine; use mbkit.dynamics\(model, 'mu"),
        ("mujoco", "implicit_midpoint", "not on the mujoco engine, which .*momenta nor ∂T/∂q.*; use mbkit.dyn"),
        ("mujoco", "taylor", "not on the mujoco engine, which .*no expressions.*; use mbkit.dyn"),
    ],
)
def test_a_method_that_only_some_engines_have_says_why(engine: str, method: str, words: str) -> None:
    dyn = dynamics(catalog.pendulum(), engine)
    with pytest.raises(UnsupportedError, match=f"{method}: {words}"):
        simulate(dyn, [0.1], [0.0], 1.0, method)
    if engine == "mujoco":
        with pytest.raises(UnsupportedError, match="torque functions are not there"):
            simulate(dyn, [0.1], [0.0], 1.0, "mujoco_rk4", torque=lambda t, q, v: -v)


@pytest.mark.thorough("pinocchio-rk4", "pinocchio-rk853", "mujoco-mujoco_rk4")
@pytest.mark.parametrize(
    ("engine", "method"),
    [("pinocchio", "rk4"), ("pinocchio", "gauss4"), ("pinocchio", "rk853"), ("mujoco", "mujoco_rk4")],
)
def test_nothing_is_loaded_that_a_run_does_not_need(engine: str, method: str) -> None:
    code = (
        "import sys, mbkit as mb; model = mb.catalog.pendulum()\n"
        f"run = mb.simulate(mb.dynamics(model, {engine!r}), [0.1], [0.0], 0.01, {method!r})\n"
        "run.energy(), run.power_balance(), run.momentum(), repr(run)\n"
        "heavy = {'casadi', 'heyoka', 'llvmlite', 'matplotlib', 'mujoco', 'pinocchio', 'scipy'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    env = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    made = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert made.stdout == f"[{engine!r}]\n", made.stderr


# DOP853


def test_dop853_tolerance_rules_the_error() -> None:
    dyn = dynamics(catalog.pendulum())
    exact = closed_forms.pendulum_solution(np.array([5.0]), 2.0)[0][0]
    errors, cost = [], []
    for rtol in (1e-4, 1e-7, 1e-10):
        run = simulate(dyn, [2.0], [0.0], 5.0, "dop853", rtol=rtol)
        errors.append(abs(run.q[-1, 0] - exact))
        cost.append(run.stats.evaluations)
    assert errors[0] > 10 * errors[1] > 100 * errors[2]
    assert cost[0] < cost[1] < cost[2]


# Grids


def test_runs_end_exactly_and_equal_steps_are_not_split_by_rounding() -> None:
    for duration, dt in ((1.0, 1e-3), (10.0, 1e-3), (0.7, 0.1), (1.0, 1 / 3), (2.4, 0.8), (1e4, 1e-3)):
        grid = Grid.of(0.0, duration, dt)
        assert grid.steps == round(duration / dt)
        assert grid.last == dt
    for duration, dt, steps in ((0.0105, 1e-3, 11), (0.1, 0.03, 4), (0.3, 0.1, 3), (0.0, 0.1, 0)):
        for method in (*FIXED, "mujoco_rk4"):
            run = simulate(dynamics(catalog.pendulum(), "mujoco"), [1.0], [0.0], duration, method, dt)
            assert (run.t[-1], len(run.t), run.stats.steps) == (duration, steps + 1, steps)
            if method != "semi_implicit_euler" and duration:
                assert run.q[:, 0] == pytest.approx(closed_forms.pendulum_solution(run.t, 1.0)[0], abs=5e-5)


def test_save_keeps_the_same_states() -> None:
    model, q, v = tumbling()
    dyn = dynamics(model)
    every = simulate(dyn, q, v, 0.0205)
    some = simulate(dyn, q, v, 0.0205, save=5)
    assert np.array_equal(some.t, every.t[[0, 5, 10, 15, 20, 21]])
    assert np.array_equal(some.q, every.q[[0, 5, 10, 15, 20, 21]])
    named = simulate(dyn, q, v, 0.0205, save=[0.003, 0.02, 0.0205])
    assert np.array_equal(named.v, every.v[[3, 20, 21]])


# Torques


@pytest.mark.parametrize("method", FIXED)
def test_torques_as_arrays_and_callables(method: str) -> None:
    model = catalog.double_pendulum()
    dyn = dynamics(model)
    q, v, tau = [0.5, -0.2], [0.0, 0.3], np.array([0.4, -0.7])

    def run(torque: Any, q: Any = q) -> Trajectory:
        return simulate(dyn, q, v, 0.05, method, torque=torque)

    held = run(tau)
    assert np.abs(held.q - run(None).q).max() > 1e-6
    assert np.array_equal(run(np.tile(tau, (50, 1))).q, held.q)
    assert np.array_equal(run(lambda t, q, v: tau).q, held.q)
    assert run(tau, [q, q]).q[1] == pytest.approx(held.q, abs=1e-15)
    assert run(np.tile(tau, (50, 1)), [q, q]).q[1] == pytest.approx(held.q, abs=1e-15)
    assert run(lambda t, q, v: tau.tolist(), [q, q]).q[0] == pytest.approx(held.q, abs=1e-15)
    late = np.zeros((50, 2))
    late[25:] = tau
    assert np.array_equal(run(late).q[:26], run(None).q[:26])
    assert np.array_equal(run(late).q, run(lambda t, q, v: tau if t >= 0.025 - 1e-9 else 0 * tau).q) == (
        method == "semi_implicit_euler"
    ), "an array is held over the step; a callable is asked at each stage"


def test_a_callable_sees_stage_times_and_body_velocities() -> None:
    model, q0, v0 = tumbling()
    dyn = dynamics(model)
    seen: list[tuple[float, np.ndarray, np.ndarray]] = []

    def drag(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        seen.append((t, q.copy(), v.copy()))
        q[:], v_old = 0.0, v.copy()  # what it is given is its own
        return -0.5 * v_old

    run = simulate(dyn, q0, v0, 0.002, "rk4", torque=drag)
    assert [t for t, _, _ in seen] == pytest.approx([0, 5e-4, 5e-4, 1e-3, 1e-3, 1.5e-3, 1.5e-3, 2e-3], abs=1e-18)
    assert np.array_equal(seen[0][1], q0)
    assert seen[0][2] == pytest.approx(v0, abs=1e-14)
    assert seen[4][2] == pytest.approx(run.v[1], abs=1e-13)
    # The same drag by the independent road.
    fine = simulate(dyn, q0, v0, 0.01, "rk4", dt=1e-4, torque=lambda t, q, v: -0.5 * v)
    other = simulate(dyn, q0, v0, 0.01, "dop853", rtol=1e-13, torque=lambda t, q, v: -0.5 * v)
    assert fine.v[-1] == pytest.approx(other.v[-1], abs=1e-10)
    assert np.abs(fine.v[-1] - simulate(dyn, q0, v0, 0.01, "rk4", dt=1e-4).v[-1]).max() > 1e-3


# Divergence


def test_one_divergence_does_not_stop_the_others() -> None:
    dyn = stiff()
    q = [[0.0], [1.0], [0.0], [1e-150]]
    with pytest.warns(MbkitWarning, match="2 of 4 trajectories diverged"):
        run = simulate(dyn, q, [0.0], 0.2)
    assert run.t[-1] == 0.2
    reached = run.stats.reached
    assert isinstance(reached, tuple)
    assert reached[0] == reached[2] == 0.2
    assert reached[1] < reached[3] < 0.2
    for i in (1, 3):
        with pytest.warns(MbkitWarning):
            alone = simulate(dyn, q[i], [0.0], 0.2)
        n = len(alone.t)
        assert run.q[i, :n] == pytest.approx(alone.q, rel=1e-12)
        assert np.isnan(run.q[i, n:]).all()
        assert np.isnan(run.energy()[i, n:]).all()
    assert np.isfinite(run.q[[0, 2]]).all()
    with pytest.warns(MbkitWarning):
        lost = simulate(dyn, [[1.0], [2.0]], [0.0], 0.2)
    assert len(lost.t) < 201
    assert lost.t[-1] == max(lost.stats.reached)  # type: ignore[type-var]


def test_native_divergence_is_void_from_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log where it stands
    dyn = dynamics(stiff().model, "mujoco")
    with pytest.warns(MbkitWarning, match="mujoco_rk4 diverged after t = .*2 of 4"):
        run = simulate(dyn, [[0.0], [1.0], [0.0], [1e-150]], [0.0], 0.1005, "mujoco_rk4")
    assert run.t[-1] == 0.1005
    for row, end in zip(run.q, run.stats.reached, strict=True):  # type: ignore[arg-type]
        assert np.array_equal(np.isfinite(row[:, 0]), run.t <= end)
    with pytest.warns(MbkitWarning, match="diverged"):
        alone = simulate(dyn, [1.0], [0.0], 0.1, "mujoco_euler")
    assert np.isfinite(alone.q).all()
    assert alone.t[-1] == alone.stats.reached < 0.1


# Trajectories


def test_trajectories_are_frozen_and_travel() -> None:
    model, q, v = tumbling()
    run = simulate(dynamics(model, "lagrangian"), q, v, 0.01)
    with pytest.raises(ValueError, match="read-only"):
        run.q[0, 0] = 1.0
    with pytest.raises(AttributeError):
        run.t = run.t  # type: ignore[misc]
    data = pickle.dumps(run)
    again = pickle.loads(data)
    assert np.array_equal(again.q, run.q)
    assert again.stats == run.stats
    assert again.model == model
    assert again.energy() == pytest.approx(run.energy(), abs=0)
    for told in ("tumbling", "lagrangian", "rk4", "10 steps, 40 evaluations"):
        assert told in repr(run)
        assert told in run._repr_html_()


def test_csv_holds_every_digit(tmp_path: Path) -> None:
    model, q, v = tumbling()
    run = simulate(dynamics(model), q, v, 0.003)
    run.to_csv(tmp_path / "run.csv")
    with (tmp_path / "run.csv").open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    assert header == ["t", *(f"q.{n}" for n in model.coordinate_names), *(f"v.{n}" for n in model.velocity_names)]
    assert np.array_equal(np.array(rows, dtype=float), np.column_stack([run.t, run.q, run.v]))
    both = simulate(dynamics(model), np.stack([q, q]), v, 0.003)
    both.to_csv(tmp_path / "both.csv")
    with (tmp_path / "both.csv").open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    assert header[:2] == ["trajectory", "t"]
    assert [row[0] for row in rows] == ["0"] * 4 + ["1"] * 4
    with pytest.raises(OutputError, match="cannot write"):
        run.to_csv(tmp_path / "missing" / "run.csv")


def test_progress_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    from mbkit.simulate import progress

    monkeypatch.setattr(progress, "LOOK_SECONDS", 0.0)
    dyn = dynamics(catalog.pendulum())
    for method, save in (("rk4", None), ("dop853", [0.0, 0.5])):
        told: list[float] = []
        simulate(dyn, [1.0], [0.0], 0.5, method, save=save, progress=told.append)
        assert len(told) > 3
        assert told == sorted(told)
        assert told[-1] == 1.0
    monkeypatch.setattr(progress, "_PATIENCE", 0.0)
    assert simulate(dyn, [1.0], [0.0], 0.05, progress=True).stats.finished


def test_a_start_beyond_a_joints_limits_is_warned_of(recwarn: pytest.WarningsRecorder) -> None:
    ur5 = mb.load("ur5")
    dyn, q = dynamics(ur5), ur5.neutral()
    simulate(dyn, q, np.zeros(6), 0.01)
    assert not recwarn.list
    q[2] = 90.0
    with pytest.warns(MbkitWarning, match=r"elbow_joint = 90 .*radians"):
        simulate(dyn, q, np.zeros(6), 0.01)
    batch = np.stack([np.zeros(6), q])
    with pytest.warns(MbkitWarning, match=r"trajectory 1: .*elbow_joint = 90"):
        simulate(dyn, batch, np.zeros(6), 0.01)


@pytest.mark.parametrize("call", [mb.simulate, mb.simulate.simulate])
def test_warnings_point_at_the_line_that_called(call):
    model = slider(lower=-1.0, upper=1.0).build()
    with pytest.warns(MbkitWarning) as heard:
        call(dynamics(model, "pinocchio"), [2.0], [1e155], 0.01, "rk4")
    assert len(heard) == 2
    assert {warning.filename for warning in heard} == {__file__}
