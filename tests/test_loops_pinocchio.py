"""Loops and prescribed motions on Pinocchio: against 34 digits, on random closed mechanisms of every kind."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import mbkit as mb
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import NumericalError, UnsupportedError
from mbkit.model.loops import LOOP_KINDS
from mbkit.model.parts import Prescribed
from tests.quantities import MODELS, condition
from tests.random_trees import off
from tests.scenes import chain, linkage

EPS = float(np.finfo(float).eps)


def consistent(dyn, q: np.ndarray, rng) -> np.ndarray:
    """Return a random velocity with ḟ = 0."""
    v = rng.standard_normal(dyn.model.nv)
    return v - np.linalg.lstsq(dyn.constraint_jacobian(q), dyn.constraint_rate(q, v), rcond=1e-10)[0]


def against_34_digits(model: mb.Model, q: np.ndarray, seed: int, solver: str) -> None:
    """Both ways to accelerations and forces, whichever is taken; of redundant rows the same ones are left out."""
    rng = np.random.default_rng(seed)
    dyn, exact = mb.dynamics(model, "pinocchio"), mb.dynamics(model, "oracle")
    v, tau = consistent(exact, q, rng), rng.standard_normal(model.nv)
    assert dyn.constraint_solver == solver
    assert dyn.constraint_names == exact.constraint_names
    close = max(1e-12, 20 * EPS * condition(exact, q))
    a, forces = dyn._solved(q, v, tau)
    assert off(a, exact.forward_dynamics(q, v, tau)) < close
    assert off(forces, exact.constraint_forces(q, v, tau)) < close
    assert off(dyn.forward_dynamics(q, v, tau), exact.forward_dynamics(q, v, tau)) < close
    assert (dyn._iterated(q, v, tau) is not None) is (solver == "constraintDynamics")


@pytest.mark.thorough("point", "frame", "universal", "revolute", "distance")
@pytest.mark.parametrize("kind", LOOP_KINDS)
def test_both_ways_to_accelerations(kind):
    model, q = MODELS[f"loop.{kind}"]()
    rigid = kind in ("point", "frame") and not model.prescribed
    against_34_digits(model, q, 1, "constraintDynamics" if rigid else "LAPACK")


def bricard() -> tuple[mb.Model, np.ndarray]:
    model = mb.catalog.bricard()
    for seed in range(20):
        q, _ = model.random_state(seed)
        if np.abs(mb.dynamics(model).constraint_residual(q)).max() < 1e-13:
            return model, q
    raise AssertionError


def test_rows_that_are_redundant_where_loops_are_closed():
    model, q = bricard()
    dyn = mb.dynamics(model)
    assert len(dyn.mobility(q).redundant) == 1
    against_34_digits(model, q, 0, "LAPACK")
    # A plane that is carried along: its third row is nothing where the loop is closed.
    governor = mb.catalog.flyball_governor()
    q, v = governor.random_state(1)
    exact = mb.dynamics(governor, "oracle")
    assert mb.dynamics(governor).constraint_solver == "LAPACK"
    assert off(*(x.forward_dynamics(q, v, 0 * v) for x in (mb.dynamics(governor), exact))) < 1e-13


@pytest.fixture(scope="module")
def four_bar():
    model = mb.catalog.four_bar()
    return model, mb.dynamics(model), *model.random_state(0)


def plain(dyn):
    """Return Pinocchio's model of the loops, and data: all that constraintDynamics takes but the state."""
    loops = pin.StdVec_RigidConstraintModel(list(dyn._held._rigid[0]))
    data = pin.StdVec_RigidConstraintData([x.createData() for x in loops])
    own = dyn.pin_model.createData()
    pin.initConstraintDynamics(dyn.pin_model, own, loops, data)
    return dyn.pin_model, own, loops, data


def test_without_regularization_a_loop_in_a_plane_is_nan_in_silence(four_bar):
    _, dyn, q, v = four_bar
    m, d, loops, data = plain(dyn)
    still = np.zeros(3)

    def a(mu):
        return pin.constraintDynamics(m, d, q, v, still, loops, data, pin.ProximalSettings(1e-14, 1e-14, mu, 20)).copy()

    assert not np.isfinite(a(0.0)).any()
    assert off(a(1e-10), dyn._force(dyn.forward_dynamics(q, v, still))) < 1e-13


def test_pinocchio_s_derivative_under_a_loop_is_not_that_of_its_acceleration(four_bar):
    _, dyn, q, v = four_bar
    m, d, loops, data = plain(dyn)
    tau, settings, h = np.zeros(3), pin.ProximalSettings(1e-14, 1e-14, 1e-10, 20), 1e-6

    def a(q):
        return pin.constraintDynamics(m, d, q, v, tau, loops, data, settings).copy()

    slopes = np.transpose([(a(q + h * e) - a(q - h * e)) / (2 * h) for e in np.eye(3)])
    own = LagrangianDynamics(dyn.model, compile=False).forward_dynamics_derivatives(q, v, tau)
    damping = np.diag([j.damping[0] for j in dyn.model.joints])
    a(q)
    by_q, *_ = pin.computeConstraintDynamicsDerivatives(m, d, loops, data, settings)
    assert not damping.any()
    assert off(slopes, own.q) < 1e-7
    assert off(by_q, own.q) > 1e-3
    with pytest.raises(UnsupportedError, match="computeConstraintDynamicsDerivatives"):
        dyn.forward_dynamics_derivatives(q, v, tau)
    with pytest.raises(UnsupportedError, match="computeConstraintDynamicsDerivatives"):
        dyn.linearize(q, v, tau)


def test_a_singular_pose_is_refused():
    dyn = mb.dynamics(linkage((1.0, 2.0, 1.0), ground=2.0, density=1.0).build())
    assert dyn.constraint_solver == "constraintDynamics"
    zero = np.zeros(3)
    for v in ([0.0, 0, 0], [1.0, -1, 1]):
        with pytest.raises(NumericalError, match=r"singular pose, where rows depend on each other .*loop 'pin'"):
            dyn.forward_dynamics(zero, v, zero)
        with pytest.raises(NumericalError, match="singular pose"):
            dyn.constraint_forces(zero, v, zero)
    # Beside it one freedom is left.
    q = np.array([0.3, -0.3, 0.3])
    exact = mb.dynamics(dyn.model, "oracle")
    assert off(*(x.forward_dynamics(q, [1.0, -1, 1], [0.1, 0, 0]) for x in (dyn, exact))) < 1e-12


def of_masses(b: float, c: float) -> mb.Model:
    links = []
    for parent, x, m in (("world", 0.0, 1.0), ("b0", 0.3, b), ("world", 1.0, c)):
        body = {"mass": m, "com": (0.2, 0, 0), "inertia": (0, m / 50, m / 50), "axis": (0, 0, 1)}
        links.append(body | {"parent": parent, "translation": (x, 0, 0)})
    out = chain(*links, gravity=(0, -9.81, 0))
    out.add_loop("pin", "point", body_a="b1", translation_a=(0.9, 0, 0), body_b="b2", translation_b=(0.7, 0, 0))
    return out.build()


def test_masses_that_differ_by_decades():
    for mass in (1e-2, 1e2):
        model = of_masses(mass, 1 / mass)
        against_34_digits(model, model.random_state(0)[0], 0, "constraintDynamics")
    model = of_masses(1e4, 1e-4)
    q, v = model.random_state(0)
    v, tau = 0 * v, np.zeros(3)
    dyn, right = mb.dynamics(model), mb.dynamics(model, "oracle").forward_dynamics(q, v, tau)
    m, d, loops, data = plain(dyn)
    settings = pin.ProximalSettings(1e-14, 1e-14, dyn._held._mu, 20)
    # What constraintDynamics loses is seen in the ends' accelerations, and LAPACK takes over.
    bare = pin.constraintDynamics(m, d, q, v, tau, loops, data, settings).copy()
    assert dyn._iterated(q, v, tau) is None
    a = dyn.forward_dynamics(q, v, tau)
    left = [np.abs(dyn.constraint_jacobian(q) @ x + dyn.constraint_bias(q, v)).max() for x in (bare, a)]
    assert left[1] < 1e-13
    assert left[0] > 100 * left[1]
    # The condition is 6e7: of factors alone nine digits would be right.
    assert off(a, right) < 1e-12
    assert off(bare, right) > 1e-10


def test_bodies_without_mass():
    crank = mb.catalog.slider_crank(crank_mass=0.0, rod_mass=0.0, piston_mass=1.3)
    q, v = crank.random_state(0)
    dyn, tau = mb.dynamics(crank), np.array([0.1, 0, 0])
    a, J = dyn.forward_dynamics(q, v, tau), dyn.constraint_jacobian(q)
    assert np.abs(J @ a + dyn.constraint_bias(q, v)).max() < 1e-14
    # The equation along the one freedom.
    along = np.linalg.svd(J)[2][-1]
    assert abs(along @ (dyn.inverse_dynamics(q, v, a) - tau)) < 1e-14


def test_batches_copies_and_wrenches(four_bar):
    model, dyn, *_ = four_bar
    q, v = model.random_state(2, 3)
    tau = np.random.default_rng(0).standard_normal((3, 3))
    many, one = dyn.forward_dynamics(q, v, tau), [dyn.forward_dynamics(*x) for x in zip(q, v, tau, strict=True)]
    assert np.array_equal(many, one)
    assert dyn.constraint_jacobian(q).shape == (3, 2, 3)
    assert dyn.constraint_forces(q, v, tau).shape == (3, 2)
    assert dyn.constraint_forces(q[:0], v[:0], tau[:0]).shape == (0, 2)
    again = pickle.loads(pickle.dumps(dyn))
    assert np.array_equal(again.forward_dynamics(q, v, tau), many)
    body = model.bodies[0].name
    push = {body: np.array([1.0, 2, 0, 0, 0, 0.5])}
    exact = mb.dynamics(model, "oracle")
    assert off(*(x.forward_dynamics(q, v, tau, push) for x in (dyn, exact))) < 1e-12
    driven = replace(model, prescribed=(Prescribed(model.joint_names[0], rate=2.0),))
    dyn, exact = mb.dynamics(driven), mb.dynamics(driven, "oracle")
    for t in (0.0, 0.4):
        later = dyn.at(t=t)
        assert later.model.time == t
        for x in (later, pickle.loads(pickle.dumps(later))):
            assert off(x.constraint_residual(q), exact.at(t=t).constraint_residual(q)) < 1e-14
        assert off(*(x.forward_dynamics(q, v, tau) for x in (later, exact.at(t=t)))) < 1e-11
    assert dyn.model.time == 0.0
