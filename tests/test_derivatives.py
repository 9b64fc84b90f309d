"""Derivatives of inverse and forward dynamics against differences at 113 bits and Pinocchio's."""

from __future__ import annotations

import numpy as np
import pytest

import mbkit as mb
from mbkit.codegen.extended_precision import Extended, arithmetic
from mbkit.codegen.program import program
from mbkit.errors import InputError, NumericalError
from tests.random_trees import random_tree, states
from tests.scenes import mounted

EPS = np.finfo(float).eps
# A central difference is good to h² and to 2⁻¹¹³ / h: 22 digits.
H = 1e-12
# Roundings that a column of derivatives collects, on a scale of the whole matrix.
K = 50
TREES = {
    "shallow": {"seed": 1, "n": 12},
    "deep": {"seed": 2, "n": 6, "nearest": 1},
    "mimic": {"seed": 3, "n": 7, "mimic": True, "nearest": 2},
    "free and balls": {"seed": 5, "n": 4, "kinds": ("free", "ball"), "nearest": 1},
    "no passive forces": {"seed": 6, "n": 8, "springs": False, "damping": False, "armature": False},
    "no gravity": {"seed": 7, "n": 8, "gravity": False},
}


@pytest.fixture(scope="module", params=list(TREES))
def tree(request):
    model = random_tree(**TREES[request.param])
    return model, mb.dynamics(model, "lagrangian"), [x[0] for x in states(model, 1, 5)]


class Differences:
    """Central differences of one of a model's functions, in extended precision."""

    def __init__(self, dyn, name):
        self.model, self.own = dyn.model, arithmetic()
        self.run = Extended(program(dyn.function(name)), self.own)

    def moved(self, q, k, t):
        """Return q ⊕ t e_k, by the exponentials of one direction, coded here alone."""
        q, own = self.own.array(q), self.own
        joint = next(
            j
            for j in self.model.independent_joints
            if self.model.layout.v[j.name].start <= k < self.model.layout.v[j.name].stop
        )
        at, i = self.model.layout.q[joint.name].start, k - self.model.layout.v[joint.name].start
        t = own.array(np.array([t]))
        out = q.copy()
        turn = {"free": 3, "ball": 0}.get(joint.kind)
        if turn is None:
            out[at + i] = out[at + i] + t[0]
            return out
        unit = own.array(np.eye(4)[i % 3])
        quaternion = q[at + turn : at + turn + 4]
        if i < turn:
            out[at : at + 3] = q[at : at + 3] + t * times(times(quaternion, unit), conjugate(quaternion))[:3]
        else:
            step = own.functions["sin"](t / 2) * unit + own.functions["cos"](t / 2) * own.array(np.eye(4)[3])
            out[at + turn : at + turn + 4] = times(quaternion, step)
        return out

    def along(self, which, *state):
        """Return the derivative with respect to one argument, rounded to double."""
        nv, own = self.model.nv, self.own
        rows = [[own.array(x) for x in state] for _ in range(2 * nv)]
        for k in range(nv):
            for row, t in ((rows[k], H), (rows[nv + k], -H)):
                if which == 0:
                    row[0] = self.moved(state[0], k, t)
                else:
                    row[which] = row[which] + own.array(t * np.eye(nv)[k])
        out = self.run(*(np.array([row[i] for row in rows]) for i in range(len(state))))[0][..., 0]
        step = own.array(np.full((1, 1), H))
        return own.pair((out[:nv] - out[nv:]) / (step + step))[0].T


def times(a, b):
    x, y, z, w = a
    r, s, t, u = b
    return np.array(
        [w * r + x * u + y * t - z * s, w * s - x * t + y * u + z * r, w * t + x * s - y * r + z * u,
         w * u - x * r - y * s - z * t]
    )  # fmt: skip


def conjugate(a):
    return np.array([-a[0], -a[1], -a[2], a[3]])


def close(x, reference, k=K):
    error, scale = np.linalg.norm(x - reference), np.linalg.norm(reference)
    assert error <= k * EPS * scale, f"{error / scale / EPS:.3g} eps"


@pytest.mark.thorough("shallow", "deep", "mimic", "free and balls")
def test_inverse_dynamics_derivatives_are_differences_along_the_manifold(tree):
    _, dyn, (q, v, a, _) = tree
    differences = Differences(dyn, "inverse_dynamics")
    got = dyn.inverse_dynamics_derivatives(q, v, a)
    for which, x in enumerate((got.q, got.v, got.a)):
        close(x, differences.along(which, q, v, a))


@pytest.mark.thorough("deep", "mimic", "free and balls", "no passive forces", "no gravity")
def test_forward_dynamics_derivatives_are_differences_along_the_manifold(tree):
    _, dyn, (q, v, _, tau) = tree
    differences = Differences(dyn, "forward_dynamics")
    got = dyn.forward_dynamics_derivatives(q, v, tau)
    condition = np.linalg.cond(dyn.mass_matrix(q))
    for which, x in enumerate((got.q, got.v, got.tau)):
        close(x, differences.along(which, q, v, tau), k=condition)


def test_gravity_and_springs_are_the_slope_of_the_potential(tree):
    _, dyn, (q, v, _, _) = tree
    slope = Differences(dyn, "potential_energy").along(0, q)[0]
    close(dyn.gravity(q) - dyn.passive(q, 0 * v), slope)


def test_compiled_derivatives_are_those_interpreted():
    model = random_tree(9, 2, ("revolute", "ball"))
    q, v, a, tau = states(model, 5)
    fast, slow = (mb.dynamics(model, "lagrangian", compile=yes) for yes in (True, False))
    for x, y in zip(
        fast.inverse_dynamics_derivatives(q, v, a), slow.inverse_dynamics_derivatives(q, v, a), strict=True
    ):
        close(x, y)
    condition = np.linalg.cond(slow.mass_matrix(q)).max()
    ours, theirs = (d.forward_dynamics_derivatives(q, v, tau) for d in (fast, slow))
    for x, y in zip(ours, theirs, strict=True):
        close(x, y, k=condition)


def test_bad_input_and_singular_poses_are_named():
    dyn = mb.dynamics(mb.load("ur5"), "lagrangian")
    with pytest.raises(InputError, match="expected shape"):
        dyn.inverse_dynamics_derivatives(np.zeros(6), np.zeros(6), np.zeros(5))
    b = mounted("massless", "a", "spin", "revolute", mass=1.0, com=(0.0, 0.0, 0.0), axis=(0, 0, 1))
    with pytest.warns(UserWarning, match="no mass moves"):
        model = b.build(nonphysical="warn")
    with pytest.raises(NumericalError, match="forward_dynamics_derivatives"):
        mb.dynamics(model, "lagrangian").forward_dynamics_derivatives([0.0], [0.0], [0.0])
