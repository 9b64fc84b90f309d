"""Operational-space inertia, inverse and null space: identities that hold whatever the robot."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import NumericalError, SingularPoseWarning
from tests.random_trees import random_tree, states

EPS = np.finfo(float).eps


@pytest.mark.thorough("local-0", "local-2", "local-3")
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("axes", ["local", "world", "local_world_aligned"])
def test_identities_hold_at_regular_poses(seed, axes):
    model = random_tree(seed, 9, ("free", "revolute", "prismatic", "ball"), nearest=1)
    dyn = mb.dynamics(model, "lagrangian")
    q, *_ = states(model, 4, seed)
    space = mb.operational_space(dyn, q, "tip", axes)
    assert not space.damped.any()
    J, M, task = dyn.jacobian(q, "tip", axes), dyn.mass_matrix(q), np.eye(6)
    # What is solved for loses the conditions of M and of the task.
    allowed = 100 * EPS * np.linalg.cond(M).max() * np.linalg.cond(space.inertia).max()
    assert np.abs(J @ space.inverse - task).max() < allowed
    assert np.abs(space.inertia @ (J @ np.linalg.solve(M, J.swapaxes(1, 2))) - task).max() < allowed
    N = space.null_space
    assert np.abs(N @ N - N).max() < allowed
    assert np.abs(J @ N).max() < allowed
    # A force in the null space accelerates nothing of the task.
    assert np.abs(J @ np.linalg.solve(M, N.swapaxes(1, 2))).max() < allowed
    one = mb.operational_space(dyn, q[1], "tip", axes)
    assert np.abs(one.inertia - space.inertia[1]).max() <= allowed * np.abs(one.inertia).max()
    assert not one.damped


def test_the_inverse_has_the_least_kinetic_energy():
    dyn = mb.dynamics(mb.load("panda"), "lagrangian")
    rng = np.random.default_rng(0)
    q, _ = dyn.model.random_state(rng)
    space = mb.operational_space(dyn, q, "panda_hand")
    rate = rng.standard_normal(6)
    best = space.inverse @ rate
    for _ in range(5):
        other = best + space.null_space @ rng.standard_normal(dyn.model.nv)
        assert np.allclose(space.jacobian @ other, rate, atol=1e-9)
        assert dyn.kinetic_energy(q, best) <= dyn.kinetic_energy(q, other) * (1 + 1e-9)


def test_two_links_have_the_closed_form():
    """A double pendulum's tip: Λ⁻¹ of two point masses, stretched to its limit."""
    model = mb.catalog.double_pendulum()
    dyn = mb.dynamics(model, "lagrangian")
    tip = model.frames[-1].name
    plane = [0, 2]
    with warnings.catch_warnings():
        warnings.simplefilter("error", SingularPoseWarning)
        space = mb.operational_space(dyn, [0.3, 1.1], tip, rows=plane)
    J = dyn.jacobian([0.3, 1.1], tip)[plane]
    inverse = np.linalg.inv(J)
    assert np.allclose(space.inertia, inverse.T @ dyn.mass_matrix([0.3, 1.1]) @ inverse, rtol=1e-12)
    assert np.abs(space.null_space).max() < 1e-13


def test_singular_poses_are_damped_and_told():
    model = mb.catalog.double_pendulum()
    dyn, tip = mb.dynamics(model, "lagrangian"), model.frames[-1].name
    with pytest.warns(SingularPoseWarning, match="singular pose of sample 1"):
        space = mb.operational_space(dyn, [[0.3, 1.1], [0.3, 0.0]], tip, rows=[0, 2])
    assert space.damped.tolist() == [False, True]
    assert np.isfinite(space.inertia).all()
    with pytest.raises(NumericalError, match="singular pose"):
        mb.operational_space(dyn, [0.0, 0.0], tip, damping=0)
    # Two velocities cannot move six rows.
    with pytest.warns(SingularPoseWarning):
        wide = mb.operational_space(dyn, [0.3, 1.1], tip)
    assert wide.damped
    assert wide.inertia.shape == (6, 6)
    assert wide.reciprocal_condition == 0


def test_damping_grows_from_zero():
    """The damped inverse is continuous where damping begins."""
    model = mb.catalog.double_pendulum()
    dyn, tip = mb.dynamics(model, "lagrangian"), model.frames[-1].name
    at = np.array([0.3, 0.05])
    edge = mb.operational_space(dyn, at, tip, rows=[0, 2]).reciprocal_condition
    plain = mb.operational_space(dyn, at, tip, rows=[0, 2], damping=edge * (1 - 1e-9))
    with pytest.warns(SingularPoseWarning):
        damped = mb.operational_space(dyn, at, tip, rows=[0, 2], damping=edge * (1 + 1e-9))
    assert np.allclose(plain.inertia, damped.inertia, rtol=1e-8)


def test_the_damped_inertia_is_that_of_the_least_singular_value_allowed():
    model = mb.catalog.double_pendulum()
    dyn, tip = mb.dynamics(model, "lagrangian"), model.frames[-1].name
    with pytest.warns(SingularPoseWarning):
        largest = [
            np.linalg.eigvalsh(mb.operational_space(dyn, [0.3, 1e-4], tip, rows=[0, 2], damping=damping).inertia)[-1]
            for damping in (0.1, 0.2)
        ]
    assert largest[0] / largest[1] == pytest.approx(4.0, rel=1e-3)
