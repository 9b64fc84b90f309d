"""Stiction above friction: of joints at rest, some hold and some let go, by a pattern that is consistent."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines.elements.jumps import jump_forces
from mbkit.model import Model
from tests.random_trees import off

ENGINES = ("lagrangian", "pinocchio", "mujoco", "drake")
LENGTH, CENTRE = 0.8, 0.4


def chain(friction: np.ndarray, stiction: np.ndarray, masses: np.ndarray, **more: float) -> Model:
    """Return links in a plane without gravity, with 0.05 kg m² each."""
    b, parent = mb.ModelBuilder("chain", gravity=(0, 0, 0)), "world"
    for k, (f, s, m) in enumerate(zip(friction, stiction, masses, strict=True)):
        b.add_body(f"b{k}", mass=m, com=(CENTRE, 0, 0), inertia=(0.05, 0.05, 0.05))
        place = {"axis": (0, 0, 1), "translation": (LENGTH if k else 0.0, 0, 0)}
        b.add_joint(f"j{k}", "continuous", parent=parent, child=f"b{k}", friction=f, stiction=s, **place, **more)
        parent = f"b{k}"
    return b.build()


def mass_matrices(masses: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return M of `chain`, from the velocities of the links' centres of mass."""
    size, n = q.shape
    turned, M = np.cumsum(q, axis=1), np.zeros((size, n, n))
    for k, m in enumerate(masses):
        arms = np.where(np.arange(k + 1) == k, CENTRE, LENGTH)
        each = arms * np.exp(1j * turned[:, : k + 1])
        # Joint j turns every link from it on.
        J = np.zeros((size, n), dtype=complex)
        J[:, : k + 1] = 1j * np.cumsum(each[:, ::-1], axis=1)[:, ::-1]
        turns = (np.arange(n) <= k).astype(float)
        M += m * (J[:, :, None] * J[:, None, :].conj()).real + 0.05 * np.outer(turns, turns)
    return M


def consistent(M: np.ndarray, tau: np.ndarray, f: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the accelerations of all 3^n patterns of holding and moving, and which are consistent; (3^n, N, ...)."""
    found, fits = [], []
    for signs in itertools.product((0, 1, -1), repeat=len(f)):
        side = np.array(signs)
        moves = side != 0
        a = np.zeros(tau.shape)
        if moves.any():
            push = (tau - side * f)[:, moves, None]
            a[:, moves] = np.linalg.solve(M[:, moves][:, :, moves], push)[..., 0]
        held = np.einsum("nij,nj->ni", M, a) - tau
        fits.append(np.where(moves, side * a > 0, np.abs(held) <= s).all(axis=1))
        found.append(a)
    return np.array(found), np.array(fits)


def states(rng: np.random.Generator, n: int, size: int) -> tuple[np.ndarray, ...]:
    return rng.uniform(-3, 3, (size, n)), 6 * rng.uniform(-1, 1, (size, n)) * rng.random((size, 1))


ARM = chain(np.ones(2), 1.5 * np.ones(2), np.ones(2))
PULL = np.array([-5.8, -3.0])


@pytest.mark.parametrize("engine", [*ENGINES, "oracle"])
def test_a_joint_that_the_other_holds_once_that_lets_go_rests(engine: str) -> None:
    """Both would move against s; the first needs 0.752 once the second slides against f."""
    dyn, still = mb.dynamics(ARM, engine), np.zeros(2)
    a = np.asarray(dyn.forward_dynamics(still, still, PULL), dtype=float)
    assert a[0] == 0.0
    assert a[1] == pytest.approx(-2 / 0.21, rel=1e-13)
    many = dyn.forward_dynamics(np.zeros((3, 2)), np.zeros((3, 2)), [PULL, -PULL, 0 * PULL])
    np.testing.assert_allclose(np.asarray(many, dtype=float), [a, -a, 0 * a], rtol=1e-13)


@pytest.mark.parametrize("method", ["rk4", "rk853", "moreau"])
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_runs_and_steps_begin_where_one_joint_holds_back(engine: str, method: str) -> None:
    dyn, still = mb.dynamics(ARM, engine), np.zeros(2)
    run = mb.simulate(dyn, still, still, 0.01, method, torque=PULL, **({} if method == "rk853" else {"dt": 1e-3}))
    assert run.v[-1] == pytest.approx([0, -0.02 / 0.21], rel=1e-12)
    if method == "rk4":
        for pull, side in (([PULL] * 2, [1, 1]), ([PULL, -PULL], [1, -1])):
            _, v = dyn.step([still] * 2, [still] * 2, pull, 0.01, method)
            np.testing.assert_allclose(v, np.outer(side, [0, -0.02 / 0.21]), rtol=1e-12)
        assert dyn.step(still, still, PULL, 0.01, method)[1] == pytest.approx([0, -0.02 / 0.21], rel=1e-12)


@pytest.mark.thorough("1", "2", "4", "5")
@pytest.mark.parametrize("seed", range(6))
def test_accelerations_at_rest_are_those_of_a_consistent_pattern(seed: int) -> None:
    """Each of 3,600 states is held against all 3^n patterns."""
    rng = np.random.default_rng([seed, 51])
    n = 2 + seed % 3
    masses, f = rng.uniform(0.3, 3, n), rng.uniform(0, 3, n)
    s = f * rng.uniform(1, 2.5, n)
    q, tau = states(rng, n, 600)
    dyn = mb.dynamics(chain(f, s, masses), "lagrangian")
    M = mass_matrices(masses, q)
    assert off(dyn.mass_matrix(q), M) < 1e-14
    a = dyn.forward_dynamics(q, np.zeros(q.shape), tau)
    every, fits = consistent(M, tau, f, s)
    assert fits.any(axis=0).all()
    same = ((every == 0) == (a == 0)).all(axis=-1) & (np.abs(every - a).max(axis=-1) <= 1e-11 * np.abs(every).max())
    assert (same & fits).any(axis=0).all()
    # There is more than one in many of them.
    assert (fits.sum(axis=0) > 1).sum() > 30
    some = slice(None, None, 20)
    for engine in ENGINES[1:]:
        other = mb.dynamics(chain(f, s, masses), engine).forward_dynamics(q[some], 0 * q[some], tau[some])
        assert off(other, a[some]) < 1e-10
        assert ((other == 0) == (a[some] == 0)).all()
    _, v = dyn.step(q[some], 0 * q[some], tau[some], 1e-6)
    assert off(1e6 * v, a[some]) < 1e-3


def test_one_joint_holds_wherever_it_can_and_then_has_the_friction_of_motion() -> None:
    """2 kg, f = 3, s = 5: 4 N are held; 6 N give (6 - 3) / 2, where Gauss's function with s has its least at 0.5."""
    b = mb.ModelBuilder("block", gravity=(0, 0, 0))
    b.add_body("m", mass=2.0)
    b.add_joint("x", "prismatic", parent="world", child="m", axis=(1, 0, 0), friction=3.0, stiction=5.0)
    a = mb.dynamics(b.build(), "lagrangian").forward_dynamics(
        np.zeros((3, 1)), np.zeros((3, 1)), [[4.0], [6.0], [-6.0]]
    )
    assert a[:, 0] == pytest.approx([0.0, 1.5, -1.5], rel=1e-15)


def test_of_a_batch_machine_code_decides_which_of_all_patterns_it_is() -> None:
    """The same exchanges as symbols; accelerations are those of all patterns that each state may have."""
    rng, n = np.random.default_rng(4), 3
    masses, f = rng.uniform(0.3, 3, n), rng.uniform(0.5, 3, n)
    s = f * rng.uniform(1, 2.5, n)
    q, tau = states(rng, n, 100)
    written, run = (mb.dynamics(chain(f, s, masses), "lagrangian", compile=compiled) for compiled in (False, True))
    a, other = (dyn.forward_dynamics(q, np.zeros(q.shape), tau) for dyn in (run, written))
    assert any("exchange_rounds" in key for key in run._machines)
    assert off(a, other) < 1e-13
    np.testing.assert_array_equal(a == 0, other == 0)
    every, fits = consistent(mass_matrices(masses, q), tau, f, s)
    same = ((every == 0) == (a == 0)).all(axis=-1) & (np.abs(every - a).max(axis=-1) <= 1e-11 * np.abs(every).max())
    assert (same & fits).any(axis=0).all()
    # The code of many joints takes longer to make than it saves.
    many = mb.dynamics(chain(*(np.ones(19) for _ in range(3))), "lagrangian", compile=True)
    assert many._jumps._rounds(many) is None


@pytest.mark.thorough("1")
@pytest.mark.parametrize("seed", range(2))
def test_of_several_patterns_it_is_that_of_a_stribeck_velocity_that_goes_to_zero(seed: int) -> None:
    """The curve is followed by implicit steps in v / v_s, with v_s of all joints alike; 1 in 100 may differ."""
    rng = np.random.default_rng([seed, 7])
    n = 2 + seed
    masses, f = rng.uniform(0.3, 3, n), rng.uniform(0.5, 3, n)
    s = f * rng.uniform(1.3, 2.5, n)
    q, tau = states(rng, n, 4000)
    M = mass_matrices(masses, q)
    several = np.flatnonzero(consistent(M, tau, f, s)[1].sum(axis=0) > 1)[:200]
    assert len(several) > 100
    q, tau, A = q[several], tau[several], np.linalg.inv(M[several])
    a0, w, t, h = np.einsum("nij,nj->ni", A, tau), np.zeros(q.shape), 0.0, 4e-3
    alike, none = np.ones(w.shape, dtype=bool), np.zeros(w.shape)
    while t < 400:
        now = f + (s - f) * np.exp(-np.square(w))
        # With the friction of motion alone, this is the problem of impulses that has one answer.
        force, holds = jump_forces(A, a0 + w / h, now, now, alike, none)
        w = np.where(holds, 0.0, w + h * (a0 + np.einsum("nij,nj->ni", A, force)))
        t, h = t + h, min(1.01 * h, 1.0)
    a = mb.dynamics(chain(f, s, masses), "lagrangian").forward_dynamics(q, 0 * q, tau)
    assert (np.sign(a) == np.sign(w)).all(axis=1).mean() > 0.99


def test_joints_that_are_alike_let_go_alike_whatever_the_rounding() -> None:
    """Each of two would hold the other back."""
    A, one = np.array([[1.0, 0.5], [0.5, 1.0]]), np.ones((1, 2))
    for tilt in (0.0, 1e-14, -1e-14):
        b = A @ np.array([2.5, 2.5 + tilt])
        forces, holds = jump_forces(A[None], b[None], 2 * one, one, one > 0, 0 * one)
        assert not holds.any()
        assert forces.tolist() == [[-1.0, -1.0]]


def test_a_loop_holds_up_to_the_stiction_of_all_its_joints_and_slides_against_their_friction() -> None:
    friction, stiction = np.array([0.5, 1.0, 2.0]), np.array([1.5, 1.2, 5.0])
    b = mb.ModelBuilder("four_bar", gravity=(0, -9.81, 0))
    rods = (("crank", "world", 0.0, 0.3), ("coupler", "crank", 0.3, 0.9), ("rocker", "world", 1.0, 0.7))
    for (name, parent, x, length), f, s in zip(rods, friction, stiction, strict=True):
        b.add_body(name, mass=2 * length, com=(length / 2, 0, 0), inertia=2 * length**3 / 12 * np.ones(3))
        place = {"axis": (0, 0, 1), "translation": (x, 0, 0)}
        b.add_joint(name, "continuous", parent=parent, child=name, friction=f, stiction=s, **place)
    ends = {"translation_a": (0.9, 0, 0), "translation_b": (0.7, 0, 0)}
    b.add_loop("pin", "point", body_a="coupler", body_b="rocker", **ends)
    model = b.build()
    bare = mb.dynamics(model.without("friction"), "lagrangian")
    still = np.zeros(3)
    q, _ = bare.project([1.2, -0.6, 1.5], still)
    n = np.linalg.svd(bare.constraint_jacobian(q))[2][-1]
    M, holds, slides = bare.mass_matrix(q), stiction @ np.abs(n), friction @ np.abs(n)
    for engine in ("lagrangian", "pinocchio"):
        dyn = mb.dynamics(model, engine)
        for pull in (0.0, 0.3, 0.9, 0.99, 1.01, -0.9, -1.5, 4.0):
            tau = bare.nle(q, still) + pull * holds * n
            rate = np.sign(pull) * (abs(pull) > 1) * (abs(pull) * holds - slides) / (n @ M @ n)
            assert off(dyn.forward_dynamics(q, still, tau), rate * n) < 1e-9


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_what_rests_on_a_driven_cart_slides_back_where_the_drive_is_too_fast(engine: str) -> None:
    """2 kg with f = 3 N and s = 5 N on x = A cos ωt, at t = 0: it is pulled by 2 A ω², N."""
    for pull in (2.0, 4.9, 5.1, 8.0):
        b = mb.ModelBuilder("cart", gravity=(0, 0, 0))
        for name, parent in (("cart", "world"), ("block", "cart")):
            b.add_body(name, mass=2.0)
            rubs = {"friction": 3.0, "stiction": 5.0} if name == "block" else {}
            b.add_joint(name, "prismatic", parent=parent, child=name, axis=(1, 0, 0), **rubs)
        b.prescribe("cart", amplitude=pull / 18, frequency=3.0, phase=np.pi / 2)
        dyn = mb.dynamics(b.build(), engine)
        q, v = dyn.project([pull / 18, 0.3], [0.0, 0.0])
        a = dyn.forward_dynamics(q, v * [1, 0], [0.0, 0.0])
        assert a == pytest.approx([-pull / 2, (pull - 3) / 2 if pull > 5 else 0.0], rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_moreau_s_step_begins_in_the_same_pattern(engine: str) -> None:
    rng = np.random.default_rng(3)
    f = rng.uniform(0, 3, 3)
    dyn = mb.dynamics(chain(f, 2 * f, rng.uniform(0.3, 3, 3)), engine)
    q, tau = states(rng, 3, 40)
    run = mb.simulate(dyn, q, 0 * q, 1e-6, "moreau", dt=1e-6, torque=tau[:, None])
    a = dyn.forward_dynamics(q, 0 * q, tau)
    assert ((run.v[:, -1] == 0) == (a == 0)).all()
    assert off(1e6 * run.v[:, -1], a) < 1e-3
