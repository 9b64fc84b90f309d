"""Properties of the own derivation, on random trees: each would fail if the physics were wrong."""

from __future__ import annotations

import pickle

import casadi as ca
import numpy as np
import pytest

import mbkit as mb
from mbkit.derivation import Equations
from mbkit.errors import UnknownNameError, UnsupportedError
from tests.random_trees import off, random_tree, states

SEEDS = range(6)
# Sums of a few hundred rounded terms.
CLOSE = 1e-13


@pytest.fixture(scope="module", params=SEEDS)
def tree(request):
    model = random_tree(request.param, 14, mimic=request.param % 2 == 1)
    return model, mb.dynamics(model, "lagrangian"), states(model, 4, request.param)


@pytest.mark.thorough("1", "3", "4", "5")
def test_mass_matrix_is_symmetric_positive_definite(tree):
    _, dyn, (q, _, _, _) = tree
    M = dyn.mass_matrix(q)
    assert off(M, M.swapaxes(1, 2)) < 1e-15
    assert np.linalg.eigvalsh(M).min() > 0


@pytest.mark.thorough("0", "1", "4", "5")
def test_mass_matrix_is_the_derivative_of_inverse_dynamics(tree):
    _, dyn, (q, v, a, _) = tree
    M, rest = dyn.mass_matrix(q), dyn.inverse_dynamics(q, v, 0 * a)
    assert off(dyn.inverse_dynamics(q, v, a) - rest, np.einsum("nij,nj->ni", M, a)) < CLOSE


@pytest.mark.thorough("1", "3", "4", "5")
def test_terms_add_up(tree):
    _, dyn, (q, v, a, _) = tree
    C = dyn.coriolis_matrix(q, v)
    assert off(np.einsum("nij,nj->ni", C, v) + dyn.gravity(q), dyn.nle(q, v)) < CLOSE
    total = np.einsum("nij,nj->ni", dyn.mass_matrix(q), a) + dyn.nle(q, v) - dyn.passive(q, v)
    assert off(dyn.inverse_dynamics(q, v, a), total) < CLOSE


@pytest.mark.thorough("4", "5")
def test_mass_matrix_rate_less_twice_coriolis_is_skew(tree):
    # Ṁ exactly: the directional derivative of the expressions of M along D v.
    model, dyn, (q, v, _, _) = tree
    eq = Equations(model)
    rate = ca.jtimes(ca.densify(eq.mass_matrix)[:], eq.q, eq.kin.qdot)
    f = ca.Function("rate", [eq.q, eq.v], [ca.reshape(rate, model.nv, model.nv)])
    for qi, vi, C in zip(q, v, dyn.coriolis_matrix(q, v), strict=True):
        S = np.array(f(qi, vi)) - 2 * C
        assert np.abs(S + S.T).max() < CLOSE * np.abs(C).max()


def test_gravity_and_springs_are_the_slope_of_the_potential(tree):
    model, dyn, (q, v, _, _) = tree
    slope = dyn.gravity(q) - dyn.passive(q, 0 * v)
    # dV/dt along v, exactly differentiated, against the forces' power.
    eq = Equations(model)
    rate = ca.Function("rate", [eq.q, eq.v], [ca.jtimes(eq.potential_energy, eq.q, eq.kin.qdot)])
    expected = [float(rate(qi, vi)) for qi, vi in zip(q, v, strict=True)]
    assert off(np.sum(slope * v, axis=1), np.array(expected)) < CLOSE
    # And once by finite differences on the manifold, which shares no derivative.
    h = 1e-5
    ends = [dyn.potential_energy(model.integrate(q, s * h * v)) for s in (-2, -1, 1, 2)]
    numeric = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
    assert np.allclose(numeric, np.sum(slope * v, axis=1), rtol=1e-7, atol=1e-7)


@pytest.mark.thorough("3", "4", "5")
def test_power_balances(tree):
    _, dyn, (q, v, _, tau) = tree
    a = dyn.forward_dynamics(q, v, tau)
    damping = dyn.passive(q, v) - dyn.passive(q, 0 * v)
    power = np.sum((tau + damping) * v, axis=1)
    assert off(dyn.energy_rate(q, v, a), power) < 1e-12


@pytest.mark.thorough("3", "5", "4")
def test_forward_dynamics_inverts_inverse_dynamics(tree):
    _, dyn, (q, v, a, _) = tree
    back = dyn.forward_dynamics(q, v, dyn.inverse_dynamics(q, v, a))
    assert off(back, a) < 1e-14 * np.linalg.cond(dyn.mass_matrix(q)).max()


@pytest.mark.thorough(every=7)
@pytest.mark.parametrize("elimination", ["links", "mass matrix", "least constraint"])
def test_every_elimination_equals_lapack(tree, elimination):
    model, dyn, (q, v, _, tau) = tree
    right = tau + dyn.passive(q, v) - dyn.nle(q, v)
    dense = np.linalg.solve(dyn.mass_matrix(q), right[..., None])[..., 0]
    one = mb.dynamics(model, "lagrangian", elimination=elimination)
    assert one.elimination == pickle.loads(pickle.dumps(one)).elimination == elimination
    assert off(one.forward_dynamics(q, v, tau), dense) < 1e-14 * np.linalg.cond(dyn.mass_matrix(q)).max()


def test_other_eliminations_are_refused_by_name():
    pendulum = mb.catalog.pendulum()
    with pytest.raises(UnknownNameError, match=r"elimination.*did you mean 'links'"):
        mb.dynamics(pendulum, "lagrangian", elimination="link")
    written = mb.lagrangian.from_model(pendulum).dynamics().model
    with pytest.raises(UnsupportedError, match="written as energies"):
        mb.dynamics(written, "lagrangian", elimination="links")
    with pytest.raises(UnsupportedError, match="no sum of squares"):
        mb.dynamics(mb.load("icub"), "lagrangian", elimination="least constraint")


def test_a_scene_pays_for_what_it_has():
    """Zeros vanish while the graph is built: a planar arm costs less than a spatial one."""

    def chain(axes, offset):
        b = mb.ModelBuilder("chain")
        for i in range(5):
            b.add_body(f"b{i}", mass=1.0, com=(0, offset, -0.5), inertia=(0.1, 0.1, 0.1))
            b.add_joint(
                f"j{i}",
                "revolute",
                parent=f"b{i - 1}" if i else "world",
                child=f"b{i}",
                axis=axes[i % 2],
                translation=(0, 0, -1),
            )
        return mb.dynamics(b.build(), "lagrangian").function("inverse_dynamics").n_instructions()

    spatial = chain(((1, 2, 3), (3, -2, 1)), 0.2)
    assert chain(((0, 1, 0),) * 2, 0.0) < 0.3 * spatial
    # Parallel axes are planar in the axes of the links, however the world's lie.
    assert chain(((1, 2, 3),) * 2, 0.0) < 0.5 * spatial


def test_gravity_free_models_have_no_gravity_in_the_graph():
    model = mb.load("ur5")
    full = mb.dynamics(model, "lagrangian").function("nle").n_instructions()
    free = mb.dynamics(model.without("gravity"), "lagrangian").function("nle").n_instructions()
    assert free < full


def test_unknown_quantities_are_named():
    with pytest.raises(UnknownNameError, match="mass_matrix"):
        mb.dynamics(mb.load("ur5"), "lagrangian").function("mass_matrx")


def test_kinetic_energy_is_half_v_m_v(tree):
    _, dyn, (q, v, _, _) = tree
    assert off(dyn.kinetic_energy(q, v), 0.5 * np.einsum("ni,nij,nj->n", v, dyn.mass_matrix(q), v)) < CLOSE


def test_quasi_velocities_give_eulers_equations():
    """A free body without forces: I ω̇ + ω × I ω = 0 and m (v̇ + ω × v) = 0."""
    b = mb.ModelBuilder("free", gravity=(0, 0, 0))
    inertia = np.array([[2.0, 0.1, 0.2], [0.1, 3.0, 0.3], [0.2, 0.3, 4.0]])
    b.add_body("a", mass=5.0, inertia=inertia)
    b.add_joint("j", "free", parent="world", child="a")
    model = b.build()
    q, v, _, _ = (x[0] for x in states(model, 1))
    linear, w = v[:3], v[3:]
    expected = np.concatenate([-np.cross(w, linear), -np.linalg.solve(inertia, np.cross(w, inertia @ w))])
    for engine in ("pinocchio", "lagrangian", "mujoco"):
        assert off(mb.dynamics(model, engine).forward_dynamics(q, v, 0 * v), expected) < 1e-14
