"""Pinocchio's own derivatives of inverse and forward dynamics, with all that mbkit adds to them."""

from __future__ import annotations

import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import UnsupportedError
from mbkit.model import kind_of
from tests.random_trees import ALL, random_tree, states

#: Joint types that Pinocchio 4.1.0 differentiates wrongly.
WRONG = ("universal", "spherical_zyx")
RIGHT = tuple(kind for kind in ALL if kind not in (*WRONG, "fixed"))
EPS = np.finfo(float).eps


def assert_as_the_oracle(model, n: int = 4) -> None:
    """Check both derivatives within 1000 eps of the sizes, times the condition of M for accelerations."""
    own, oracle = mb.dynamics(model, "pinocchio"), mb.dynamics(model, "oracle")
    q, v, a, tau = states(model, n)
    condition = float(np.linalg.cond(oracle.mass_matrix(q)).max())
    for name, last, factor in (("inverse", a, 1.0), ("forward", tau, condition)):
        quantity = f"{name}_dynamics_derivatives"
        found, exact = (getattr(dyn, quantity)(q, v, last) for dyn in (own, oracle))
        for x, y in zip(found, exact, strict=True):
            assert np.abs(x - y).max() < 1000 * factor * EPS * max(1.0, np.abs(y).max())


def test_joint_springs_dampers_armature_and_couplings():
    b = mb.ModelBuilder("arm", gravity=(0.0, -3.0, -9.0))
    parent = "world"
    for k, kind in enumerate(("revolute", "prismatic", "helical", "planar")):
        axis = {"axis": (0.6, 0.0, 0.8)} if kind_of(kind).n_axes else {}
        more = {"armature": 0.2} if kind_of(kind).nv == 1 else {}
        b.add_body(f"b{k}", mass=1.0 + k, com=(0.1, 0.2, -0.1), inertia=(0.3, 0.4, 0.5))
        pitch = 0.2 if kind == "helical" else 0.0
        b.add_joint(
            f"j{k}", kind, parent=parent, child=f"b{k}", translation=(0.3, 0.1, 0.0), stiffness=5.0, rest=0.2,
            damping=0.7, pitch=pitch, **axis, **more,
        )  # fmt: skip
        parent = f"b{k}"
    b.add_coupling("belt", {"j0": 1.0, "j2": -2.0}, stiffness=3.0, rest_length=0.1, damping=0.4, armature=0.3)
    model = b.build()
    assert_as_the_oracle(model)
    assert_as_the_oracle(model.without("armature"))


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_joint_types_are_refused_by_name(kind):
    dyn = mb.dynamics(random_tree(0, 2, (kind,), springs=False, damping=False), "pinocchio")
    q, v, a, tau = (x[0] for x in states(dyn.model, 1))
    with pytest.raises(UnsupportedError, match=rf"pinocchio cannot give inverse.*{kind.replace('_', '-')}.*lagrangian"):
        dyn.inverse_dynamics_derivatives(q, v, a)
    with pytest.raises(UnsupportedError, match=rf"pinocchio cannot give forward.*{kind.replace('_', '-')}.*lagrangian"):
        dyn.forward_dynamics_derivatives(q, v, tau)


def test_point_springs_are_refused():
    dyn = mb.dynamics(random_tree(0, 3, ("revolute",)), "pinocchio")
    with pytest.raises(UnsupportedError, match=r"spring '.*' between two points"):
        dyn.forward_dynamics_derivatives(*(x[0] for x in states(dyn.model, 1)[:3]))


def test_rodas5_on_pinocchio_needs_no_derivation(monkeypatch):
    model = random_tree(1, 4, RIGHT, springs=False, damping=False)
    q, v = model.random_state(np.random.default_rng(0))
    derived = mb.simulate(mb.dynamics(model, "lagrangian"), q, v, 0.1, method="rodas5", rtol=1e-10)
    dyn = mb.dynamics(model, "pinocchio")
    monkeypatch.setattr("mbkit.simulate.stiffness_measure.dynamics", None)
    run = mb.simulate(dyn, q, v, 0.1, method="rodas5", rtol=1e-10)
    assert np.abs(model.difference(derived.q[-1], run.q[-1])).max() < 1e-8
