"""The own derivation as an engine: eliminations and cost. The structure of its equations is in test_properties."""

from __future__ import annotations

import pickle

import casadi as ca
import numpy as np
import pytest

import mbkit as mb
from mbkit.derivation import Equations
from mbkit.errors import UnknownNameError, UnsupportedError
from tests.random_trees import off, random_tree, states

SEEDS = range(3)
# Sums of a few hundred rounded terms.
CLOSE = 1e-13


@pytest.fixture(scope="module", params=SEEDS)
def tree(request):
    model = random_tree(request.param, 14, mimic=request.param % 2 == 1)
    return model, mb.dynamics(model, "lagrangian"), states(model, 4, request.param)


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


@pytest.mark.thorough(every=4)
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
            ends = {"parent": f"b{i - 1}" if i else "world", "child": f"b{i}"}
            b.add_joint(f"j{i}", "revolute", **ends, axis=axes[i % 2], translation=(0, 0, -1))
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
