"""Loops and prescribed motions of a model on the own derivation: one form, redundant rows, states, steps, runs."""

from __future__ import annotations

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import trapezoid

import mbkit as mb
from mbkit.errors import InputError, ModelError, UnsupportedError
from mbkit.model.loops import LOOP_KINDS
from tests.quantities import T0, closed
from tests.random_trees import random_tree
from tests.scenes import chain, hinge, linkage

EPS = float(np.finfo(float).eps)


def four_bar(**loop: object) -> mb.Model:
    return linkage(**loop).build()  # type: ignore[arg-type]  # by name


def closed_tree(seed: int, kind: str = "point", *, drive: bool = False) -> tuple[mb.Model, np.ndarray]:
    """Return a random tree with a loop between two of its bodies, and a configuration at which it is closed."""
    return closed(random_tree(seed, 6, springs=False), seed, kind, drive=drive)


@pytest.mark.thorough("point-0", "frame-2", "revolute-0", "cylindrical-0", "prismatic-2")
@pytest.mark.parametrize(("kind", "seed"), [(kind, (0, 2)[k % 2]) for k, kind in enumerate(LOOP_KINDS)])
def test_equation_of_motion_holds_under_every_kind_of_loop(kind: str, seed: int) -> None:
    model, q = closed_tree(seed, kind, drive=seed == 2)
    dyn, oracle = (mb.dynamics(model, name) for name in ("lagrangian", "oracle"))
    assert np.abs(dyn.constraint_residual(q)).max() < 1e-13
    rng = np.random.default_rng(seed)
    q, v = dyn.project(q, rng.standard_normal(model.nv))
    tau = rng.standard_normal(model.nv)
    a, J = dyn.forward_dynamics(q, v, tau), dyn.constraint_jacobian(q)
    force, pull = dyn.inverse_dynamics(q, v, a), dyn.generalized_constraint_force(q, v, tau)
    assert np.allclose(pull, J.T @ dyn.constraint_forces(q, v, tau), atol=0, rtol=1e-12)
    M = dyn.mass_matrix(q)
    root = np.sqrt(np.diag(M))
    K = np.block([[M / np.outer(root, root), (J / root).T], [J / root, np.zeros((len(J), len(J)))]])
    singular = np.linalg.svd(K, compute_uv=False)
    condition = singular[0] / singular[model.nv + len(dyn.constraint_names) - len(dyn.mobility().redundant) - 1]
    size = np.linalg.norm(force) + np.linalg.norm(pull) + np.linalg.norm(M @ a)
    assert np.linalg.norm(force - tau - pull) < 1e3 * EPS * size
    bias = dyn.constraint_bias(q, v)
    assert np.linalg.norm(J @ a + bias) < 1e2 * EPS * condition * (np.linalg.norm(np.abs(J) @ np.abs(a)) + 1)
    exact = oracle.forward_dynamics(q, v, tau)
    assert np.linalg.norm(root * (a - exact)) < 10 * EPS * condition * np.linalg.norm(root * exact)
    # What the loop's rows claim is what the poses of the bodies say.
    assert np.abs(oracle.constraint_residual(q) - dyn.constraint_residual(q)).max() < 1e-14


@pytest.mark.thorough("0", "2")
@pytest.mark.parametrize("seed", range(3))
def test_bias_and_rate_are_derivatives_along_a_motion(seed: int) -> None:
    model, q = closed_tree(seed, "frame" if seed else "revolute", drive=True)
    dyn = mb.dynamics(model, "oracle")
    rng = np.random.default_rng(seed)
    v, a, h = rng.standard_normal(model.nv), rng.standard_normal(model.nv), 1e-4

    def moved(s: float) -> tuple[np.ndarray, np.ndarray, mb.Dynamics]:
        return model.integrate(q, s * v + 0.5 * s * s * a), v + s * a, dyn.at(t=T0 + s)

    ends = [moved(s) for s in (-h, h)]
    rate = np.subtract(*[now.constraint_residual(x) for x, _, now in ends[::-1]]) / (2 * h)
    assert np.abs(rate - dyn.constraint_rate(q, v)).max() < 1e-6
    second = np.subtract(*[now.constraint_rate(x, w) for x, w, now in ends[::-1]]) / (2 * h)
    whole = dyn.constraint_jacobian(q) @ a + dyn.constraint_bias(q, v)
    # A free joint's v is no constant along the exponential of ½ s² a: of first order in s it is.
    assert np.abs(second - whole).max() < 1e-5 * (1 + np.abs(whole).max())


def test_bricard_is_redundant_and_moves() -> None:
    model = mb.catalog.bricard()
    dyn = mb.dynamics(model, "lagrangian")
    mobility = dyn.mobility()
    assert mobility.degrees_of_freedom == 1
    assert len(mobility.rows) == 6
    assert len(mobility.redundant) == 1
    assert "of 6 rows 1 is redundant" in str(mobility)
    q = model.neutral()
    assert np.abs(dyn.constraint_residual(q)).max() < 1e-15
    tau = np.zeros(model.nv)
    run = mb.simulate(dyn, q, tau, 3.0, "rk853", rtol=1e-11, atol=1e-11)
    assert run.stats.finished
    # The row that was left out holds all the same.
    assert np.abs(dyn.constraint_residual(run.q)).max() < 1e-9
    energy = dyn.kinetic_energy(run.q, run.v) + dyn.potential_energy(run.q)
    assert np.ptp(energy) < 1e-7
    q, v = run.q[-1], run.v[-1]
    J, forces = dyn.constraint_jacobian(q), dyn.constraint_forces(q, v, tau)
    # The least norm: nothing of λ lies where Jᵀ gives no force.
    U, s, _ = np.linalg.svd(J)
    assert s[-1] < 1e-8 * s[0]
    assert abs(U[:, -1] @ forces) < 1e-7 * np.linalg.norm(forces)


@pytest.mark.thorough("False")
@pytest.mark.parametrize("compiled", [True, False])
def test_a_prescribed_motion_is_followed_and_its_drive_pays_for_the_energy(compiled: bool) -> None:
    arm = {"mass": 1.0, "com": (0, 0, -0.5), "inertia": (0.1, 0.1, 0.01), "axis": (0, 1, 0)}
    bob = {"mass": 0.5, "com": (0, 0, -0.4), "inertia": (0.02, 0.02, 0.01), "axis": (0, 1, 0)}
    b = chain(arm, bob | {"translation": (0, 0, -1)})
    b.prescribe("j0", offset=0.2, rate=0.3, amplitude=0.4, frequency=3.0, phase=0.1)
    model = b.build()
    dyn = mb.dynamics(model, "lagrangian", compile=compiled)
    q, v = dyn.project([0.2, 0.3], [0.0, 0.5])
    run = mb.simulate(dyn, q, v, 2.0, "rk4", dt=1e-3)
    path = 0.2 + 0.3 * run.t + 0.4 * np.sin(3 * run.t + 0.1)
    assert np.abs(run.q[:, 0] - path).max() < 1e-14
    along = [dyn.at(t=t) for t in run.t[::20]]
    states = zip(along, run.q[::20], run.v[::20], strict=True)
    power = np.array([now.constraint_forces(x, w, np.zeros(2))[0] * w[0] for now, x, w in states])
    energy = dyn.kinetic_energy(run.q, run.v) + dyn.potential_energy(run.q)
    work = trapezoid(power, run.t[::20])
    assert abs(energy[-1] - energy[0] - work) < 2e-3 * np.abs(energy).max()
    exact = mb.simulate(dyn, q, v, 2.0, "rk853", rtol=1e-12, atol=1e-12, save=[2.0])
    assert np.abs(run.q[-1] - exact.q[-1]).max() < 1e-9


def test_derivatives_of_forward_dynamics_are_those_of_differences() -> None:
    model, q = closed_tree(0, "point")
    dyn = mb.dynamics(model, "lagrangian")
    q, v = dyn.project(q, np.ones(model.nv))
    tau, h = np.ones(model.nv), 1e-6
    by = dyn.forward_dynamics_derivatives(q, v, tau)
    for k, e in enumerate(np.eye(model.nv)):
        pairs = ((model.integrate(q, s * h * e), v, tau) for s in (1, -1))
        slope = np.subtract(*(dyn.forward_dynamics(*state) for state in pairs)) / (2 * h)
        assert np.abs(by.q[:, k] - slope).max() < 1e-5 * (1 + np.abs(by.q).max())
        slope = (dyn.forward_dynamics(q, v, tau + h * e) - dyn.forward_dynamics(q, v, tau - h * e)) / (2 * h)
        assert np.abs(by.tau[:, k] - slope).max() < 1e-6 * (1 + np.abs(by.tau).max())


def test_links_without_mass_in_a_loop() -> None:
    model = four_bar()
    crank, coupler, rocker = model.bodies
    light = replace(coupler, mass=0.0, com=np.zeros(3), inertia=np.zeros((3, 3)))
    model = replace(model, bodies=(crank, light, rocker))
    dyn, oracle = (mb.dynamics(model, name) for name in ("lagrangian", "oracle"))
    q, v = model.random_state(2)
    tau = np.array([1.0, 0.0, 0.5])
    a, exact = (x.forward_dynamics(q, v, tau) for x in (dyn, oracle))
    assert np.allclose(a, exact, rtol=1e-10)


def test_pickle_time_and_names() -> None:
    model, q = closed_tree(2, "revolute", drive=True)
    dyn = mb.dynamics(model, "lagrangian").at(t=0.25)
    copy = pickle.loads(pickle.dumps(dyn))
    assert copy.model.time == 0.25
    assert copy.constraint_names == dyn.constraint_names
    assert np.array_equal(copy.constraint_residual(q), dyn.constraint_residual(q))
    assert model.time_parameter == "t"
    assert dict(dyn.model.parameters) == {"t": 0.25}
    assert isinstance(dyn.function("constraint_residual"), ca.Function)
    # The time is a parameter that stays.
    later = model.with_parameters(t=0.5)
    assert later.time == 0.5
    assert later.time_parameter == "t"
    assert np.array_equal(mb.dynamics(later, "lagrangian").constraint_residual(q), dyn.at(t=0.5).constraint_residual(q))


def test_without_constraints_there_are_no_such_quantities() -> None:
    dyn = mb.dynamics(mb.catalog.double_pendulum(), "lagrangian")
    assert not any(name.startswith("constraint") for name in dyn.supports)
    assert dyn.constraint_names == ()
    with pytest.raises(UnsupportedError, match="has no loops"):
        dyn.constraint_residual([0.0, 0.0])
    assert dyn.mobility().degrees_of_freedom == 2
    q, v = dyn.project([0.1, 0.2], [0.3, 0.4])
    assert q.tolist() == [0.1, 0.2]
    assert v.tolist() == [0.3, 0.4]


def test_loops_that_cannot_be_are_refused_with_the_reason() -> None:
    zero = np.zeros(3)
    shut = {"body_a": "crank", "translation_a": zero, "body_b": "world", "translation_b": zero}
    for loop, call, words in (
        ({"translation_b": (5.0, 0, 0)}, "project", r"no configuration satisfies them all.*loop 'pin'"),
        ({"translation_b": (0.7, 0.2, 0)}, "constraint_residual", r"the ends never meet.*0.2"),
        (shut, "constraint_residual", "closes nothing"),
    ):
        with pytest.raises(InputError, match=words):
            getattr(mb.dynamics(four_bar(**loop), "lagrangian"), call)(*[zero] * (1 + (call == "project")))
    for loop, words in (
        ({"body_a": "rocker"}, "both ends on 'rocker'"),
        ({"kind": "distance"}, "expected a rod with a length above 0"),
        ({"length": 1.0}, "only a rod has one"),
        ({"kind": "weld"}, "unknown kind 'weld'"),
    ):
        with pytest.raises(ModelError, match=words):
            four_bar(**loop)
    with pytest.raises(InputError, match=r"q0: four_bar is open there: loop 'pin' .* by .*; project\("):
        mb.simulate(mb.dynamics(four_bar(), "lagrangian"), zero, zero, 0.1, "rk4", dt=1e-3)
    # Loops that never close have no mobility.
    b = hinge(com=(0.5, 0, 0))
    b.add_loop("pin", "point", body_a="a", translation_a=(1, 0, 0), translation_b=(5, 0, 0), body_b="world")
    with pytest.raises(InputError, match="no configuration satisfies them all"):
        mb.dynamics(b.build(), "lagrangian", compile=False).mobility()


@pytest.mark.thorough("0")
@pytest.mark.parametrize("seed", range(2))
def test_all_rows_are_closed_and_no_frame_is_half_a_turn_off(seed: int) -> None:
    model, _ = closed_tree(seed, "frame")
    dyn = mb.dynamics(model, "lagrangian")
    (loop,) = model.loops
    q, _ = model.random_state(seed, 4)
    assert np.abs(dyn.constraint_residual(q)).max() < 1e-12
    poses = dyn.body_poses(q)
    names = [b.name for b in model.bodies]
    A, B = (poses[:, names.index(x), :3, :3] for x in (loop.body_a, loop.body_b))
    turn = np.swapaxes(A @ loop.rotation_a, 1, 2) @ (B @ loop.rotation_b)
    assert np.abs(turn - np.eye(3)).max() < 1e-11


def test_a_start_half_a_turn_off_is_refused() -> None:
    first = {"mass": 1.0, "com": (0.1, 0, 0), "inertia": (0.1, 0.1, 0.1), "axis": (0, 0, 1)}
    b = chain(first, *[first | {"translation": (0.5, 0, 0)}] * 3)
    b.add_loop("weld", "frame", body_a="b3", body_b="world", translation_b=(0.5, 0, 0))
    dyn = mb.dynamics(b.build(), "lagrangian")
    closed, _ = dyn.project([1.0, 1.0, 2.0, 2.0], np.zeros(4))
    turned = np.array([*closed[:3], closed[3] + np.pi])
    assert np.abs(dyn.constraint_residual(turned)).max() < 1e-12
    mb.simulate(dyn, closed, np.zeros(4), 0.01, "rk4", dt=1e-3)
    with pytest.raises(InputError, match="loop 'weld' half a turn off"):
        mb.simulate(dyn, turned, np.zeros(4), 0.01, "rk4", dt=1e-3)


@pytest.mark.thorough("bricard", "andrews_squeezer", "flyball_governor")
@pytest.mark.parametrize("name", ["four_bar", "bricard", "andrews_squeezer", "flyball_governor"])
def test_engines_agree_on_mechanisms_mujoco_by_its_own_law(name: str) -> None:
    result = mb.compare(mb.catalog.get(name)(), samples=4, terms_only=True)
    assert result.passed, result.verdict
    assert set(result.engines) == {"pinocchio", "lagrangian", "mujoco"}
    of_motion = {
        r.term: r.reference for r in result.rows if r.engine == "mujoco" and r.term in ("forward dynamics", "Jᵀ λ", "M")
    }
    assert of_motion == {"forward dynamics": "own law", "Jᵀ λ": "own law", "M": "oracle"}
    assert result.softness["mujoco"] < 4
    assert "mujoco holds loops softly" in result.verdict


def test_what_would_be_the_trees_alone_is_refused() -> None:
    dyn = mb.dynamics(mb.catalog.four_bar(), "lagrangian")
    q = np.zeros(3)
    with pytest.raises(UnsupportedError, match=r"operational_space: .*four_bar: point loop 'pin'"):
        mb.operational_space(dyn, q, "coupler")
    with pytest.raises(InputError, match="tau: expected the force under which four_bar moves"):
        dyn.joint_wrenches(q, q, q)
