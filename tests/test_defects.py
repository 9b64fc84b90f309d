"""Values that engines are known to get wrong: returned, announced, and failed by name."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines import known_defects
from mbkit.errors import KnownDefectWarning
from mbkit.model.joint_types import KINDS
from mbkit.report.page import render
from tests.random_trees import off, states
from tests.scenes import mounted

PINOCCHIO = version("pin")
in_this_version = pytest.mark.skipif(PINOCCHIO != "4.1.0", reason="reproduced in Pinocchio 4.1.0 only")


def one_joint(kind, armature=0.0, **axes):
    b = mounted(
        kind, "a", "odd", kind, mass=1.3, com=(0.1, 0.2, -0.4), inertia=(0.3, 0.4, 0.5), armature=armature, **axes
    )
    b.add_body("b", mass=0.7, com=(0.3, 0, 0.1), inertia=(0.2, 0.2, 0.3))
    b.add_joint("plain", "revolute", parent="a", child="b", axis=(1, 0, 0), translation=(0, 0, -1))
    return b.build()


#: Terms that are wrong where a joint's axes turn in its child.
TURNING_AXES = ("C v", "J̇ v", "Ȧ_G v")
CORIOLIS = {"spherical_zyx": {}, "universal": {"axis": (1, 0, 0), "axis2": (0, 1, 0)}}


@in_this_version
@pytest.mark.parametrize("kind", list(CORIOLIS))
def test_pinocchios_coriolis_matrix_is_returned_with_a_warning_that_names_the_joint(kind):
    model = one_joint(kind, **CORIOLIS[kind])
    q, v, _, _ = (x[0] for x in states(model, 1))
    dyn, own = mb.dynamics(model), mb.dynamics(model, "lagrangian")
    with pytest.warns(KnownDefectWarning, match="coriolis_matrix.*'odd'") as caught:
        C = dyn.coriolis_matrix(q, v)
    # The warning points here, at the caller.
    assert caught[0].filename == __file__
    right = dyn.nle(q, v) - dyn.gravity(q)
    assert off(C @ v, right) > 1e-3
    assert off(own.coriolis_matrix(q, v) @ v, right) < 1e-14


@in_this_version
@pytest.mark.parametrize("kind", list(CORIOLIS))
def test_pinocchios_rates_of_jacobians_are_returned_with_a_warning_that_names_the_joint(kind):
    model = one_joint(kind, **CORIOLIS[kind])
    q, v, _, _ = (x[0] for x in states(model, 1))
    dyn, own = mb.dynamics(model), mb.dynamics(model, "lagrangian")
    for quantity, more in (("jacobian_dot_v", ("a",)), ("centroidal_momentum_bias", ())):
        with pytest.warns(KnownDefectWarning, match=f"{quantity}.*'odd'"):
            wrong = getattr(dyn, quantity)(q, v, *more)
        assert off(wrong, getattr(own, quantity)(q, v, *more)) > 1e-3
    right = dyn.acceleration(q, v, np.zeros(model.nv), "a")
    assert off(right, own.jacobian_dot_v(q, v, "a")) < 1e-14


@in_this_version
@pytest.mark.parametrize("axis", [(0, 0, -1), (1, 1, 0)])
def test_pinocchios_kinetic_energy_without_armature_is_returned_with_a_warning(axis):
    model = one_joint("revolute", armature=0.8, axis=axis)
    q, v, _, _ = (x[0] for x in states(model, 1))
    dyn, own = mb.dynamics(model), mb.dynamics(model, "lagrangian")
    with pytest.warns(KnownDefectWarning, match="kinetic_energy.*armature.*'odd'"):
        wrong = dyn.kinetic_energy(q, v)
    right = 0.5 * v @ dyn.mass_matrix(q) @ v
    assert wrong == pytest.approx(right - 0.5 * 0.8 * v[0] ** 2)
    assert own.kinetic_energy(q, v) == pytest.approx(right, rel=1e-14)


@pytest.mark.parametrize("armature", [0.0, 1e-8, 0.8])
@pytest.mark.parametrize("kind", [name for name, kind in KINDS.items() if kind.nv == 1])
def test_a_wrong_kinetic_energy_never_comes_without_a_warning(kind, armature):
    pitch = {"pitch": 0.2} if kind == "helical" else {}
    for axis in [*np.eye(3), (0, 0, -1), (1, 2, 0)]:
        model = one_joint(kind, armature, axis=axis, **pitch)
        q, v, _, _ = (x[0] for x in states(model, 1))
        dyn = mb.dynamics(model)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            value = dyn.kinetic_energy(q, v)
        right = 0.5 * v @ dyn.mass_matrix(q) @ v
        assert [w.category for w in caught] == [KnownDefectWarning] * int(abs(value - right) > 1e-11), (axis, value)
        assert all("'odd'" in str(w.message) and "'plain'" not in str(w.message) for w in caught)


@pytest.mark.thorough
@in_this_version
@pytest.mark.parametrize(
    ("model", "terms", "word"),
    [
        (one_joint("revolute", 0.7, axis=(0.6, 0, 0.8)), ("kinetic energy",), "computeKineticEnergy"),
        (one_joint("spherical_zyx"), TURNING_AXES, "computeCoriolisMatrix"),
    ],
    ids=["kinetic_energy", "coriolis"],
)
def test_a_comparison_names_the_engine_and_its_defect_where_nothing_else_differs(model, terms, word):
    result = mb.compare(model, ("pinocchio", "lagrangian", "mujoco"), samples=4, terms_only=True)
    assert not result.passed
    assert result.only_known_defects
    failed = [r for r in result.rows if not r.passed]
    assert [(r.term, r.engine) for r in failed] == [(term, "pinocchio") for term in terms]
    assert all("known defect of pinocchio" in r.reason and "odd" in r.reason for r in failed)
    assert failed == [r for r in result.rows if r.defect]
    for text in (
        result.verdict,
        result.headline,
        result.to_markdown(),
        result._repr_html_(),
        render(result.document()),
    ):
        first = next(line for line in text.splitlines() if "differs in" in line)
        assert word in first
        assert "mujoco" not in first.split("differs in")[0].rpartition(">")[2]
    assert result.digits > 13
    # Something else that differs is told beside it.
    row = replace(result.rows[0], engine="mujoco", passed=False, relative=0.1)
    worse = replace(result, rows=(*result.rows, row))
    assert not worse.only_known_defects
    assert word in worse.verdict
    assert f"mujoco differs in {row.term}" in worse.verdict
    assert worse.headline.startswith("pinocchio, mujoco differ")


@in_this_version
def test_a_defect_of_the_whole_engine_is_in_its_rows():
    b = mb.ModelBuilder("tiny")
    for k, parent in enumerate(("world", "b0")):
        b.add_body(f"b{k}", mass=1e-17, com=(0.1, 0.2, 0.3), inertia=(1e-17, 1e-17, 1e-17))
        b.add_joint(f"j{k}", "revolute", parent=parent, child=f"b{k}", axis=(0, 1, 0), translation=(0, 0, 0.3))
    result = mb.compare(b.build(), ("pinocchio", "lagrangian"), samples=2, terms_only=True)
    failed = [r for r in result.rows if not r.passed]
    assert {r.term for r in failed} > {"M", "power balance"}
    assert all(r.engine == "pinocchio" and "sum of two inertias" in r.defect for r in failed)
    assert result.only_known_defects


@pytest.mark.parametrize(
    ("defect", "robot", "term"),
    [(known_defects.CORIOLIS, "spherical_zyx", "C v"), (known_defects.KINETIC_ENERGY, "rotors", "kinetic energy")],
)
def test_the_versions_of_a_defect_are_those_of_the_record(defect, robot, term):
    path = Path(__file__).parents[1] / "validation" / "versions.json"
    found = json.loads(path.read_text(encoding="utf-8"))["engines"]["pinocchio"]
    (since,) = [x["since"] for x in found["wrong"] if (x["robot"], x["term"]) == (robot, term)]
    assert f"pinocchio {since} to {found['measured'][-1]}, " in defect
