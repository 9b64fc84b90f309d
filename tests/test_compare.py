"""The judgement: it passes what agrees, and names what does not."""

from __future__ import annotations

import itertools
import json
import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp
from click.testing import CliRunner

import mbkit as mb
from mbkit.cli import cli
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.engines.mujoco.engine import MujocoDynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.engines.pinocchio.engine import PinocchioDynamics
from mbkit.engines.registry import find_engine
from mbkit.errors import InputError, NumericalError
from mbkit.studies.compare import beyond_terms
from mbkit.studies.compare.all_robots import RobotOutcome, Sweep
from mbkit.studies.compare.beyond_terms import findings, rollouts
from mbkit.studies.compare.body_terms import BODY_TERMS
from mbkit.studies.compare.errors import (
    Scales,
    acceleration_errors,
    condition_under_constraints,
    force_errors,
    interleaved,
    matrix_errors,
)
from mbkit.studies.compare.terms import TERMS, RolloutRow
from mbkit.studies.compare.terms import states as study_states
from mbkit.testing import assert_engines_agree
from tests import kind_examples
from tests.random_trees import random_tree
from tests.scenes import chain, hinge

TERM_NAMES = {t.name for t in (*TERMS, *BODY_TERMS)} | {"power balance"}
#: Terms that MuJoCo does not have.
WITHOUT_MUJOCO = ("regressor", "∂ID/∂(q, v, a)")
HINGE = {"axis": (0, 1, 0)}
ROD = {"mass": 1.0, "com": (0.1, 0.2, -0.3), "inertia": (0.2, 0.3, 0.25), "translation": (0, 0, -0.5)}
SMALL = chain(*(ROD | {"axis": x} for x in np.eye(3)), name="small").build()


@pytest.fixture(autouse=True)
def untimed(monkeypatch):
    """Call each term once where its time is asked for: this file's other tests are not about times."""
    study = import_module("mbkit.studies.compare.study")
    monkeypatch.setattr(study, "interleaved", partial(interleaved, rounds=1, budget=0.0))


@pytest.fixture
def brief(monkeypatch):
    """Leave little time to error against run time, where a test asks for something else."""
    monkeypatch.setattr(import_module("mbkit.studies.compare.study"), "_MAX_SECONDS", 0.5)


@pytest.fixture
def of_motion(monkeypatch):
    """Leave out the terms of bodies, where a test is about one of the equation of motion or about none."""
    monkeypatch.setattr(import_module("mbkit.studies.compare.study"), "BODY_TERMS", ())


def terms(model, **kwargs):
    return mb.compare(model, samples=16, terms_only=True, **kwargs)


@pytest.mark.thorough("human", "tiago_no_hand")
@pytest.mark.parametrize("robot", ["double_pendulum", "human", "tiago_no_hand"])
def test_robots_agree(robot):
    result = terms(mb.load(robot))
    assert result.passed, result.verdict
    assert result.engines == ("pinocchio", "lagrangian", "mujoco")
    assert {r.term for r in result.rows} == TERM_NAMES
    # MuJoCo holds a body without mass as joints of the next one, and has no load between these.
    lacking = [*["joint loads"] * (robot == "human"), *WITHOUT_MUJOCO]
    assert [(r.engine, r.term) for r in result.refusals] == [("mujoco", term) for term in lacking]
    assert len(result.rows) == 3 * len(TERM_NAMES) - len(result.refusals)
    for row in result.rows:
        # What an engine's own formula cannot do better is said aloud, and only there.
        assert row.relative <= 1e-12 or (robot == "tiago_no_hand" and "own formula" in row.reason)
        assert row.samples > 16


@pytest.mark.usefixtures("of_motion")
def test_an_engine_that_gives_nan_fails(monkeypatch):
    term = "forward dynamics"
    planted(monkeypatch, MujocoDynamics, "_forward_dynamics", lambda x: np.full_like(x, np.nan))
    result = terms(SMALL)
    assert not result.passed
    broken = [r for r in result.rows if not r.passed and r.term == term]
    assert [r.engine for r in broken] == ["mujoco"]
    assert "not finite" in broken[0].reason
    # The others are still compared with each other.
    assert sum(r.term == term and r.passed for r in result.rows) == 2
    json.loads(result.to_json())


def test_a_half_wrong_acceleration_fails_however_badly_conditioned():
    heavy = {"mass": 1e6, "com": (0, 0, -1), "inertia": (1e6, 1e6, 1e6)}
    light = {"mass": 1e-7, "com": (0, 0, -1e-2), "inertia": (1e-9, 1e-9, 1e-9), "translation": (0, 0, -1)}
    model = chain(heavy | HINGE, light | HINGE, name="uneven").build()
    assert terms(model).passed
    q, v, a, tau = (np.ones((1, 2)) * x for x in (0.3, 0.2, 1.0, 1.0))
    M = mb.dynamics(model).mass_matrix(q)
    wrong = acceleration_errors(0.5 * a, a, Scales.of(M, v, tau))
    assert wrong.relative[0] > 0.01


def test_what_no_engine_can_give_is_not_called_agreement():
    model = mb.catalog.double_pendulum()
    light = replace(model.bodies[1], mass=0.0)
    result = terms(replace(model, bodies=(model.bodies[0], light)))
    assert result.passed
    assert result.not_compared == ("forward dynamics", "M⁻¹", "forward dynamics, wrench", "power balance")
    assert "not compared: forward dynamics, M⁻¹, forward dynamics, wrench, power balance" in result.verdict


def massless() -> mb.Model:
    link = HINGE | {"translation": (0, 0, 0.3)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return chain(link, link, name="frames").build(nonphysical="warn")


def test_zeros_that_are_equal_are_no_agreement():
    model = massless()
    result = mb.compare(model, engines=("pinocchio", "lagrangian"), samples=2)
    assert not result.passed
    assert all(r.passed for r in result.rows)
    assert "mass matrix is zero" in result.nothing
    assert result.verdict.startswith("nothing compared")
    with pytest.raises(AssertionError, match="mass matrix is zero"):
        assert_engines_agree(model, engines=("pinocchio", "lagrangian"))
    found = mb.explain(model, model)
    assert found.massless
    assert not found.agree
    # A term that is zero is no digit of those that agree, and no other row is called zero.
    result = terms(mb.catalog.double_pendulum(), engines=("pinocchio", "lagrangian"))
    assert {r.term for r in result.rows if r.zero} == {"passive"}
    assert "| passive | pinocchio | – zero |" in result.to_markdown()


def test_a_sweep_in_which_every_robot_is_refused_is_no_agreement():
    refused = RobotOutcome("a", "refused", "no mass")
    agreed = RobotOutcome("b", "agree")
    assert not Sweep((refused,), 1, (), 1, 0, 0.0).passed
    assert Sweep((refused, agreed), 2, (), 1, 0, 0.0).passed


@pytest.mark.usefixtures("of_motion")
def test_every_engine_is_measured_by_the_oracle(monkeypatch):
    """An error that all engines share is seen."""
    model = SMALL
    result = terms(model)
    assert result.reference == "oracle"
    assert {r.reference for r in result.rows} == {"oracle"}
    assert all(0 < r.relative < 1e-14 for r in result.rows if r.term == "nle")
    for engine in (PinocchioDynamics, LagrangianDynamics, MujocoDynamics):
        planted(monkeypatch, engine, "_nle", lambda x: x * (1 + 1e-11))
    failed = {(r.term, r.engine) for r in terms(model).rows if not r.passed}
    assert failed >= {("nle", e) for e in ("pinocchio", "lagrangian", "mujoco")}


@pytest.mark.usefixtures("of_motion")
def test_where_the_oracle_has_no_value_an_engine_stands_in(monkeypatch):
    def fail(self, q, v):  # noqa: ARG001
        raise NumericalError("no value here")

    monkeypatch.setattr(OracleDynamics, "_passive", fail)
    result = terms(SMALL.without("gravity"))
    assert any(r.engine == "oracle" and r.term == "passive" for r in result.refusals)
    rows = [r for r in result.rows if r.term == "passive"]
    assert {r.reference for r in rows} == {"pinocchio"}
    assert {r.engine for r in rows} == {"pinocchio", "lagrangian", "mujoco"}


@pytest.mark.thorough
@pytest.mark.usefixtures("brief")
def test_a_failing_study_loses_no_terms():
    """A spring with a rest length whose ends meet has no direction there, and every engine says so."""
    b = chain({"kind": "free", "mass": 1.0, "inertia": (1, 1, 1)}, name="tether")
    b.add_spring("s", body_a="world", body_b="b0", stiffness=3.0, rest_length=0.1)
    result = mb.compare(b.build(), samples=4)
    assert {r.term for r in result.rows if r.passed} >= {"M", "g", "nle"}
    told = [r.reason for r in (*result.rows, *result.refusals)]
    assert any("point spring" in text and "'s'" in text for text in told)
    assert "not compared: passive" in result.verdict


@pytest.mark.thorough
@pytest.mark.usefixtures("brief")
def test_a_stiff_scene_ends_and_is_not_judged_by_what_it_cannot_show():
    rod = HINGE | {"mass": 1.0, "com": (0, 0, -0.5), "inertia": (0.1, 0.1, 0.1), "stiffness": 1e13}
    result = mb.compare(chain(rod, rod | {"translation": (0, 0, -1)}, name="stiff").build(), samples=4)
    unjudged = [r for r in result.rollouts if not r.judged]
    assert all("not judged" in r.note for r in unjudged if not r.informs)
    assert all(r.passed is None for r in unjudged)
    assert {x.kind for x in result.findings} == {"stiff joint"}
    assert unjudged or any(r.term == "rollouts" for r in result.refusals)
    if result.precision is None:
        assert any("no reference holds for even" in r.reason for r in result.refusals)
    else:
        assert any("horizon cut" in text for text in result.precision.shortened)
        assert "horizon cut" in repr(result)


def planted(monkeypatch, engine, method, change):
    original = getattr(engine, method)
    monkeypatch.setattr(engine, method, lambda self, *a: change(original(self, *a)))


@pytest.mark.usefixtures("of_motion")
def test_a_planted_error_in_one_joint_is_found_and_named(monkeypatch):
    model, k, term = SMALL, 1, "nle"
    # Relative to the whole vector, on one joint.
    planted(monkeypatch, MujocoDynamics, "_nle", lambda x: x + 1e-9 * (1 + np.abs(x).max()) * np.eye(3)[k])
    result = terms(model)
    failed = {(r.term, r.engine): r for r in result.rows if not r.passed}
    assert (term, "mujoco") in failed
    assert failed[term, "mujoco"].joint == model.joint_names[k]
    assert model.joint_names[k] in failed[term, "mujoco"].reason
    assert model.joint_names[0] not in failed[term, "mujoco"].reason
    assert "mujoco differs" in result.verdict
    assert result.worst is not None
    assert not result.worst.passed


@pytest.mark.parametrize(
    ("method", "term", "entry"),
    [("_regressor", WITHOUT_MUJOCO[0], (1, 25))]
    + [("_inverse_dynamics_derivatives", WITHOUT_MUJOCO[1], (k, 1, 2)) for k in range(3)],
)
def test_one_wrong_entry_of_a_derivative_is_found_at_its_joint(monkeypatch, method, term, entry):
    model = SMALL

    def spoil(x):
        x = np.array(x)
        x[(..., *entry)] *= 1 + 1e-9
        return x

    planted(monkeypatch, PinocchioDynamics, method, spoil)
    (failed,) = (r for r in terms(model, engines=("pinocchio", "lagrangian")).rows if not r.passed)
    assert (failed.term, failed.engine) == (term, "pinocchio")
    # Of the two that an entry of derivatives belongs to, the first is that of the force.
    assert failed.joint == model.joint_names[1]


@pytest.mark.usefixtures("of_motion")
@pytest.mark.parametrize(
    ("method", "term", "passed"), [("_gravity", "g", False), ("_nle", "nle", False), ("_mass_matrix", "M", True)]
)
def test_the_rounding_of_the_mass_matrix_excuses_no_other_term(monkeypatch, method, term, passed):
    planted(monkeypatch, MujocoDynamics, method, lambda x: x * (1 + 1e-9))
    monkeypatch.setattr(MujocoDynamics, "_mass_matrix_rounding", lambda self, q, quantity: 1e10)  # noqa: ARG005
    rows = {(r.term, r.engine): r for r in terms(SMALL, engines=("pinocchio", "mujoco")).rows}
    row = rows[term, "mujoco"]
    assert row.passed == passed
    assert (row.allowed > 1e-12) == passed


def test_a_planted_error_in_the_accelerations_breaks_the_power_balance(monkeypatch):
    planted(monkeypatch, PinocchioDynamics, "forward_dynamics", lambda a: a * (1 + 1e-8))
    failed = {(r.term, r.engine) for r in terms(SMALL).rows if not r.passed}
    assert failed == {(term, "pinocchio") for term in ("forward dynamics", "forward dynamics, wrench", "power balance")}


def test_a_wrong_mass_matrix_entry_is_found_however_small_the_link(monkeypatch):
    model = mb.load("panda")

    def spoil(M):
        return M * (1 + 1e-9 * np.diag(np.arange(M.shape[-1]) == 7))

    planted(monkeypatch, PinocchioDynamics, "_mass_matrix", spoil)
    failed = [r for r in terms(model).rows if not r.passed]
    # What is solved with M follows from it where joints are reduced.
    finger = ("M", "M⁻¹", "forward dynamics", "forward dynamics, wrench")
    assert {(r.term, r.engine, r.joint) for r in failed} == {
        *((term, "pinocchio", model.joint_names[7]) for term in finger),
        ("power balance", "pinocchio", ""),
    }


def test_a_wrong_integrator_is_found(monkeypatch):
    model = mb.load("double_pendulum")
    original = MujocoDynamics.rollout

    def late(self, integrator, q0, v0, dt, tau, steps, **more):
        return original(self, integrator, q0, v0, dt * (1 + 1e-9), tau, steps, **more)

    monkeypatch.setattr(MujocoDynamics, "rollout", late)
    made = {n: mb.dynamics(model, n) for n in ("pinocchio", "lagrangian", "mujoco")}
    rows = [r for r in rollouts(model, made, 0, "") if math.isfinite(r.tolerance)]
    assert rows
    assert all(r.passed is False for r in rows)


# The panda's wrist whirls when it falls limp: its rollouts are conditioned worst.
READY = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4, 0.02, 0.02])


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("engine", ["pinocchio", "lagrangian"])
@pytest.mark.parametrize(("method", "native"), [("rk4", "mujoco_rk4"), ("semi_implicit_euler", "mujoco_euler")])
@pytest.mark.parametrize("robot", ["double_pendulum", "panda", "anymal_b"])
def test_rollouts_equal_mujocos_own_to_1e_12(robot, method, native, engine):
    model = mb.load(robot, mimic="free", floating_base=robot == "anymal_b").without("damping")
    rng = np.random.default_rng(0)
    q0, v0 = model.random_state(rng)
    if robot == "panda":
        q0, v0 = READY, 0 * v0
    ours = mb.simulate(mb.dynamics(model, engine), q0, v0, 1.0, method, 1e-3)
    theirs = mb.simulate(mb.dynamics(model, "mujoco"), q0, v0, 1.0, native, 1e-3)
    assert len(ours.t) == len(theirs.t) == 1001
    assert np.abs(model.difference(theirs.q, ours.q)).max() <= 1e-12


@pytest.mark.usefixtures("brief")
def test_mujocos_implicit_damping_is_shown_for_what_it_is():
    result = mb.compare(mb.load("double_pendulum"), samples=4)
    shown = [r for r in result.rollouts if "implicit" in r.against]
    assert len(shown) == 1
    assert shown[0].error > 1e-4
    assert "(M + h D)" in shown[0].note
    assert result.passed


def gripper() -> mb.Model:
    """Return two fingers on a damped hinge with dry friction and limits; one finger mimics the other."""
    part = HINGE | {"mass": 1.0, "com": (0.1, 0, -0.3), "inertia": (0.1, 0.1, 0.05)}
    palm = part | {"damping": 0.2, "friction": 0.1, "lower": -2.0, "upper": 2.0}
    finger = part | {"kind": "prismatic", "parent": "b0"}
    return chain(palm, finger, finger | {"mimic": ("j1", -1.0, 0.0)}, name="gripper").build()


def test_a_whole_comparison_has_rollouts_run_times_and_omissions(monkeypatch):
    # As users have it; interpreted, thousands of steps take three times as long.
    monkeypatch.setenv("MBKIT_COMPILE", "1")
    result = mb.compare(gripper(), samples=4)
    assert result.passed, result.verdict
    assert all("mimic joints free" in r.note for r in result.rollouts if "explicit" not in r.method)
    needs = {"contacts", "geometry", "limits", "dry friction", "damping", "springs", "gravity", "loops"}
    assert {o.need for o in result.omissions} == needs | {"Coriolis matrix"}
    assert not any(o.fault for o in result.omissions)
    study = result.precision
    assert study.complete
    assert study.floor < 1e-12
    # Every curve is there, however slow the machine.
    wanted = {(e, m) for e in result.engines for m in find_engine(e).shown}
    assert {(c.engine, c.method) for c in study.curves} == wanted
    assert [text.partition(" (")[0] for text in result.shortened] == [
        "not compared: dry friction as mujoco holds it",
        "rollouts and error against run time are without dry friction",
    ]
    rk4 = next(c for c in study.curves if c.method == "mujoco_rk4")
    assert rk4.order == pytest.approx(4, abs=0.2)
    assert json.loads(result.to_json())["precision"]["front"]


@pytest.mark.usefixtures("brief")
def test_what_the_file_has_and_no_engine_uses_is_told_and_is_no_difference():
    """A wrist whose friction is ten times its weight, and whose damper stops it within 0.1 ms."""
    link = HINGE | {"mass": 1.0, "com": (0, 0, -0.1), "inertia": (0.01, 0.01, 0.01)}
    link |= {"lower": -2.0, "upper": 2.0, "effort_limit": 9.0}
    wrist = {"joint": "wrist", "friction": 10.0, "damping": 200.0, "translation": (0, 0, -0.2)}
    model = chain(link, link | wrist, name="arm").build()
    result = mb.compare(model, samples=4)
    assert result.passed, result.verdict
    friction, limits, stiff = result.findings
    assert [x.kind for x in result.findings] == ["dry friction", "limits", "stiff joint"]
    assert friction.joints == stiff.joints == ("wrist",)
    # With the shoulder free the wrist moves the inertia det M / M₁₁.
    q = np.zeros((1, 2))
    M = mb.dynamics(model).mass_matrix(q)
    moved = np.linalg.det(M[0]) / M[0, 0, 0]
    assert findings(model, np.ones((1, 2)), M)[2].size == pytest.approx(moved / 200.0)
    assert findings(model, np.full((3, 2), 4.0), M)[0].size == pytest.approx(2.5)
    assert "limits, limits of effort at 2 joints" in limits.says
    (changed,) = (o for o in result.omissions if o.need == "dry friction")
    assert changed.change > 0.1
    assert not changed.unchanged
    assert not changed.fault
    unjudged = [r for r in result.rollouts if not r.judged and not r.informs]
    assert unjudged
    assert all("wrist: damping over inertia" in r.note for r in unjudged)
    shown = " ".join(result.shortened)
    assert f"none of {len(unjudged)} rollouts judged" in shown
    assert "rollouts cut" not in shown


GRIPPER = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><inertial pos="0 0 0" mass="1"
diaginertia="1 1 1"/>
<body name="a"><joint name="a" axis="0 1 0" range="0 0.8" limited="true"/><inertial pos="0 0 .1" mass=".1"
diaginertia="1e-3 1e-3 1e-3"/></body>
<body name="b" pos=".1 0 0"><joint name="b" axis="0 1 0" range="0 0.8" limited="true"/><inertial pos="0 0 .1" mass=".1"
diaginertia="1e-3 1e-3 1e-3"/></body></body></worldbody>
<equality><connect body1="a" body2="b" anchor=".05 0 .2"/></equality></mujoco>"""


def test_a_limit_at_which_a_mechanism_stands_is_no_difference_of_engines(tmp_path):
    """A gripper that rests on its stops: MuJoCo's limits would act, and no engine has them on."""
    file = tmp_path / "gripper.xml"
    file.write_text(GRIPPER)
    model = mb.load(file)
    dyn = mb.dynamics(model, "mujoco")
    rows = beyond_terms._in_mujoco(model, dyn, np.array([-0.3, -0.3]), np.zeros(2))
    (limits,) = (o for o in rows if o.need == "limits")
    assert limits.change > 1e-3
    assert not limits.unchanged
    assert not limits.fault
    result = replace(mb.compare(model, ("lagrangian", "mujoco"), 2, terms_only=True), omissions=tuple(rows))
    assert result.passed, result.verdict
    assert "agree" in result.headline
    absent = replace(result, omissions=(replace(limits, present=False),))
    assert not absent.passed


def test_what_was_left_out_would_show_if_it_mattered():
    """Limits that act at the state, switched on, must change the accelerations."""
    from mbkit.engines.mujoco.engine import Variant

    model = hinge(lower=-0.1, upper=0.1, friction=2.0).build()
    dyn = mb.dynamics(model, "mujoco")
    q, v = np.array([0.5]), np.array([0.3])
    lean = Variant(dyn).accelerations(q, v)
    assert abs(Variant(dyn, ("LIMIT", "CONSTRAINT")).accelerations(q, v) - lean) > 1
    assert abs(Variant(dyn, ("FRICTIONLOSS", "CONSTRAINT")).accelerations(q, v) - lean) > 0.1
    smooth = mb.dynamics(model.without("friction"))
    assert lean == pytest.approx(smooth.forward_dynamics(q, v, [0.0]), rel=1e-14)


def test_energies_are_balanced_where_t_plus_v_is_what_forces_change():
    """A constant force without a potential does work; on a turning hoop T + V changes without a force."""
    x, v = sp.symbols("x xdot")
    pushed = mb.lagrangian.Lagrangian(v**2 / 2, x**2, [x], [v], forces={x: 2}).model
    result = mb.compare(pushed, ("lagrangian", "pinocchio"), 2, terms_only=True)
    assert result.passed
    assert {r.relative < 1e-12 for r in result.rows if r.term == "power balance"} == {True}
    hoop = mb.lagrangian.systems.bead_on_hoop()
    model = hoop.model.with_parameters(**{str(p): 1.0 for p in hoop.parameters})
    for system in (model, mb.lagrangian.from_model(kind_examples.example("force.of_time").model).model):
        result = mb.compare(system, ("lagrangian", "pinocchio"), 2, terms_only=True)
        assert result.passed
        assert [r.reason for r in result.refusals if r.term == "power balance"] == [
            f"{system.name}: its energies depend on the time, or T has parts that are not of v²"
        ]


def test_one_engine_alone_agrees_with_the_reference():
    model = mb.lagrangian.systems.driven_pendulum().model
    result = mb.compare(model, ("lagrangian", "mujoco"), 1, terms_only=True)
    assert result.passed
    assert f"lagrangian agrees with the {result.reference}" in result.verdict


@pytest.mark.usefixtures("of_motion")
def test_the_same_seed_gives_the_same_numbers_and_progress_grows():
    model, told = SMALL, []
    first, again, other = (terms(model, seed=s, progress=lambda *x: told.append(x)) for s in (1, 1, 2))

    def numbers(r):
        return [(x.term, x.engine, x.relative, x.worst_q) for x in r.rows]

    assert numbers(first) == numbers(again)
    assert numbers(first) != numbers(other)
    fractions = [f for f, _ in told[: len(told) // 3]]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert any("nle" in text for _, text in told)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"engines": ("pinocchio",)}, InputError, "at least 2"),
        ({"engines": ("pinocchio", "oracle")}, InputError, "leave it out"),
        ({"model": hinge("rock", kind="fixed", axis=None).build()}, InputError, "nothing moves in rock"),
    ],
)
def test_misuse_is_explained(kwargs, error, message):
    with pytest.raises(error, match=message):
        mb.compare(**({"model": mb.load("ur5")} | kwargs))


def test_hard_states_are_hard():
    model = random_tree(0, 6, ("spherical_zyx", "revolute", "prismatic"))
    at = study_states(model, 16, 0)
    assert set(at.kinds) == {"random", "neutral", "at limits", "near singular"}
    part = model.layout.q[next(j.name for j in model.joints if j.kind == "spherical_zyx")]
    middle = at.q[[k == "near singular" for k in at.kinds], part.start + 1]
    assert np.allclose(np.abs(np.cos(middle)), 1e-4, rtol=1e-3)
    at = study_states(mb.load("ur5"), 16, 0)
    edge = at.q[[k == "at limits" for k in at.kinds]]
    assert np.allclose(np.abs(edge), np.pi)


# How errors are measured


def test_no_unit_changes_the_error_of_a_mass_matrix():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((5, 4, 4))
    M = A @ A.swapaxes(1, 2) + np.eye(4)
    E = 1e-9 * rng.standard_normal(M.shape)
    v = rng.standard_normal((5, 4))
    D = np.diag([1e3, 1e-3, 1.0, 7.0])
    plain = matrix_errors(E, M, Scales.of(M, v, v))
    scaled = matrix_errors(D @ E @ D, D @ M @ D, Scales.of(D @ M @ D, v, v))
    assert plain.relative == pytest.approx(scaled.relative)
    assert plain.relative == pytest.approx(
        [(abs(e) / np.sqrt(np.outer(np.diag(m), np.diag(m)))).max() for e, m in zip(E, M, strict=True)]
    )


def test_a_vanishing_term_is_measured_by_the_forces_at_play():
    M, v = np.eye(2)[None], np.array([[3.0, 4.0]])
    none, e = np.zeros((1, 2)), np.array([[1e-15, 0.0]])
    assert force_errors(e, none, Scales.of(M, v, none)).relative == pytest.approx([1e-15 / 25])
    assert force_errors(none, none, Scales.of(M, 0 * v, none)).relative == [0.0]
    # |g| √m = 30 on two joints of unit inertia.
    heavy = Scales.of(M, v, none, 30.0)
    assert force_errors(e, none, heavy, heavy=True).relative == pytest.approx([1e-15 / (30 * np.sqrt(2))])
    assert force_errors(e, none, heavy).relative == pytest.approx([1e-15 / 25])


@pytest.mark.parametrize("seed", range(1))
def test_gravity_exerts_no_more_than_its_scale(seed):
    model = random_tree(seed, 8, springs=False, damping=False, armature=False)
    dyn = mb.dynamics(model, "lagrangian")
    q, v = model.random_state(np.random.default_rng(0), 50)
    weight = np.linalg.norm(model.gravity) * np.sqrt(model.mass)
    scales = Scales.of(dyn.mass_matrix(q), v, v, weight)
    assert (np.abs(dyn.gravity(q)) <= weight * np.sqrt(scales.diagonal) * (1 + 1e-12)).all()


def test_forward_dynamics_is_allowed_its_condition_and_no_more():
    M, v = np.diag([1.0, 1.0])[None] + 0.999 * np.array([[[0, 1], [1, 0]]]), np.ones((1, 2))
    scales = Scales.of(M, v, 0 * v)
    assert scales.condition == pytest.approx([1999.0])
    a = np.array([[1.0, -1.0]])
    errors = acceleration_errors(1e-10 * a, a, scales)
    # This error lies along the light direction: M e is as small as the forward error.
    assert errors.relative == pytest.approx([1e-10 / 1999.0])
    # Along the heavy one it is a force, and no condition excuses that.
    heavy = acceleration_errors(np.full_like(a, 1e-10), a, scales)
    assert heavy.relative[0] > 1e-11
    # Forces a thousand times what is left of them round as what they are.
    cancelled = acceleration_errors(1e-10 * a, a, Scales.of(M, v, 1e3 * v))
    assert cancelled.relative == pytest.approx([1e-13 / 1999.0])


def test_timings_are_medians_per_call_by_one_clock(monkeypatch):
    """Calls of 10 µs, and of 1 ms in which every third takes 3 ms, on a clock that only they advance."""
    now, calls = [0.0], itertools.count()
    monkeypatch.setattr(
        import_module("mbkit.studies.compare.errors"), "time", SimpleNamespace(perf_counter=lambda: now[0])
    )

    def spend(seconds):
        now[0] += seconds

    times = interleaved(
        {"fast": lambda: spend(1e-5), "slow": lambda: spend(3e-3 if next(calls) % 3 == 0 else 1e-3)}, rounds=9
    )
    assert times["fast"] == pytest.approx((1e4, 0.0), abs=1e-3)
    assert times["slow"] == pytest.approx((1e6, 1e6), rel=1e-9)


def test_the_friction_of_a_mimic_joint_goes_by_the_size_of_its_ratio() -> None:
    rod = HINGE | {"mass": 1.0, "com": (0, 0, -0.5), "inertia": (0.1, 0.1, 0.01), "parent": "world", "friction": 1.0}
    model = chain(rod, rod | {"mimic": ("j0", -3.0, 0.0), "friction": 2.0}).build()
    (friction, *_) = findings(model, np.ones((1, 1)), np.ones((1, 1, 1)))
    # |q̇₀| + 2 |3 q̇₀| is the power that friction takes.
    assert friction.size == pytest.approx(1.0 + 2.0 * 3.0)


def far_from_its_joint(far: float) -> mb.Model:
    """Return an arm whose link of 8 kg has its centre of mass so many metres from its joint: a crane, a blade."""
    links = (
        {"mass": 4.0, "com": (0, 0, 0.1), "inertia": np.eye(3) * 0.02, "axis": (0, 0, 1)},
        {"mass": 8.0, "com": (far, 0, 0), "inertia": np.eye(3) * 0.05, "axis": (0, 1, 0)},
        {"mass": 1.0, "com": (0, 0.05, 0.1), "inertia": np.eye(3) * 0.002, "axis": (1, 0, 0)},
    )
    return chain(*(link | {"translation": (0, 0, 0.3)} for link in links), name="blade").build()


@pytest.mark.thorough
@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("far", [8.0, 40.0])
def test_what_the_formulas_of_far_masses_must_lose_is_no_disagreement(far):
    """One rule for all engines, and it reaches their rollouts."""
    result = mb.compare(far_from_its_joint(far), samples=16)
    assert result.passed, result.verdict
    assert all(r.error < 1e-9 for r in result.rollouts)
    excused = {r.engine for r in result.rows if r.relative > 1e-12}
    assert far < 40 or excused >= {"mujoco", "lagrangian"}


def test_what_an_engine_may_lose_is_small_on_a_robot_and_grows_with_the_distance():
    robot = mb.load("ur5")
    q = robot.neutral()
    for name in ("pinocchio", "lagrangian", "mujoco"):
        assert 1 <= mb.dynamics(robot, name)._mass_matrix_rounding(q) < 1e3
    # Where the link stands along the first axis, M_11 is small, and the inertia about it grows with the distance.
    q = [0.0, np.pi / 2, 0.0]
    near, far = (mb.dynamics(far_from_its_joint(x))._mass_matrix_rounding(q) for x in (4.0, 40.0))
    assert 50 < far / near < 200


@pytest.mark.thorough
@pytest.mark.usefixtures("brief")
def test_mujoco_is_named_where_its_own_run_is_off(monkeypatch):
    """The others differ from it and not from each other."""
    rollout = MujocoDynamics.rollout

    def spoilt(self, *args, **kwargs):
        q, v = rollout(self, *args, **kwargs)
        return q + 1e-6 * np.arange(len(q))[:, None], v

    monkeypatch.setattr(MujocoDynamics, "rollout", spoilt)
    result = mb.compare(mb.load("ur5"), samples=4)
    assert {r.off for r in result.rollouts if r.passed is False} == {"mujoco"}
    assert "rollout mujoco_rk4 on mujoco differs" in result.verdict
    assert "pinocchio" not in result.headline.split(":")[0]


@pytest.mark.usefixtures("brief")
def test_terms_are_told_before_anything_is_integrated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[mb.studies.Comparison] = []
    whole = mb.compare(mb.catalog.pendulum(), samples=2, checkpoint=told.append)
    (terms,) = told
    assert terms.rows == whole.rows
    assert terms.passed
    assert (terms.rollouts, terms.precision, terms.omissions) == ((), None, ())
    assert whole.rollouts
    # Timings are counted: the page names how many there are of a setting.
    assert whole.precision is not None
    counts = [p.repeats for _, p in whole.precision.rows()]
    assert 1 <= min(counts) <= max(counts) <= 3

    def at_hand(*_: object, checkpoint: Callable[[object], None] | None = None, **__: object) -> mb.studies.Comparison:
        if checkpoint is not None:
            checkpoint(terms)
        return whole

    monkeypatch.setattr("mbkit.studies.compare", at_hand)
    out = CliRunner().invoke(cli, ["check", "pendulum", "--samples", "2", "--out", str(tmp_path)])
    assert out.stderr.startswith("terms: ✓ pinocchio, lagrangian, mujoco agree to ")
    page = (tmp_path / "pendulum.html").read_text(encoding="utf-8")
    assert "medians of " in page
    assert " timings, interleaved in one process, the longest runs timed least" in page


def test_a_momentum_s_moment_about_a_moving_center_of_mass_may_round() -> None:
    """Slides turn nothing: m v x v is zero as far as the rotations of joints are orthogonal, and v is not small."""
    b = mb.ModelBuilder("slides", gravity=(0, 0, 0))
    axes = np.random.default_rng(3).normal(size=(4, 3))
    for i, axis in enumerate(axes):
        b.add_body(f"b{i}", mass=2.0, com=(0.1, 0.2, 0.3), inertia=(0.1, 0.1, 0.1))
        parent = f"b{i - 1}" if i else "world"
        b.add_joint(f"j{i}", "prismatic", parent=parent, child=f"b{i}", rpy=axis, axis=axis)
    result = mb.compare(b.build(), terms_only=True)
    assert result.passed, result.verdict


def test_a_disc_that_lies_nearly_flat_rolls_with_all_digits() -> None:
    """n - (n·a) a lost 1e-8 of J̇ v at 7e-5 rad from flat, where the 64 random states of this comparison have one."""
    model = mb.catalog.rolling_disc()
    q = [0.14882154, -0.71399583, -0.49996473, -0.41537369, math.pi / 2 - 7e-5, 0.71727131]
    v = [-1.22337476, 0.53966813, 1.51765521, -1.71343941, -3.03531042, -0.96079879]
    exact = mb.dynamics(model, "oracle").constraint_bias(q, v)
    for engine in ("lagrangian", "pinocchio"):
        # The directions of the contact have the rounding of an axis over its way from upright.
        close = 100 * np.finfo(float).eps / 7e-5
        assert mb.dynamics(model, engine).constraint_bias(q, v) == pytest.approx(exact, rel=0, abs=close)
    # The condition of such a state belongs to its verdict; a wrong sign of J̇ v in one row would not pass.
    result = mb.compare(model, ("lagrangian", "pinocchio"), terms_only=True)
    assert result.passed, result.verdict
    worst = next(row for row in result.rows if row.term == "J̇ v rows")
    assert worst.max_abs < 1e-10
    assert worst.relative < 1e-15


@pytest.mark.parametrize(("ratio", "counts"), [(3e-11, True), (3e-12, False)])
def test_rows_that_follow_from_others_have_no_condition(ratio, counts):
    """Two rows at an angle d on two unit masses: the least eigenvalue of [[M, Jᵀ], [J, 0]] is d²/2, the largest 2."""
    d = 2 * math.sqrt(ratio)
    J = np.array([[[1.0, 0.0], [math.cos(d), math.sin(d)]]])
    (condition,) = condition_under_constraints(np.eye(2)[None], J)
    assert condition == pytest.approx(1 / ratio, rel=1e-3) if counts else condition < 10


def rollout_row(steps: int, error: float, condition: float) -> RolloutRow:
    """A run that is off by so much from MuJoCo's after so many well-conditioned steps."""
    dyn, q = mb.dynamics(hinge().build()), np.zeros((steps + 1, 1))
    stats = SimpleNamespace(message="", seconds=0.1)
    theirs = SimpleNamespace(q=q, method="mujoco_rk4", stats=stats)
    ours = SimpleNamespace(q=q + error, t=1e-3 * np.arange(steps + 1), method="rk4", engine="pinocchio", stats=stats)
    return beyond_terms._row(dyn, ours, theirs, np.full(steps + 1, condition), True, 1.0, "")


@pytest.mark.parametrize(("part", "passed"), [(0.5, True), (2.0, False)])
def test_a_rollout_may_differ_by_256_roundings_times_its_condition(part, passed):
    row = rollout_row(60, part * 256 * 2.0**-52 * 1e3, 1e3)
    assert (row.judged, row.passed) == (True, passed)
    assert (rollout_row(40, 1.0, 1e3).judged, rollout_row(40, 1.0, 1e3).passed) == (False, None)


def test_a_rollout_ends_where_its_condition_hides_an_error_of_1e_9(monkeypatch):
    limit = 1e-9 / (256 * 2.0**-52)
    grows = np.where(np.arange(1001) <= 300, limit / 2, 2 * limit)
    monkeypatch.setattr(beyond_terms, "_condition", lambda *_: grows)
    model = hinge().build()
    rows = rollouts(model, {e: mb.dynamics(model, e) for e in ("pinocchio", "mujoco")}, 0, "")
    assert {round(row.duration, 9) for row in rows} == {0.3}
    assert all(row.cut and row.judged for row in rows)


@pytest.mark.parametrize(("change", "unchanged"), [(3e-10, True), (3e-9, False)])
def test_a_change_of_accelerations_beyond_1e_9_is_a_change(monkeypatch, change, unchanged):
    from mbkit.engines.mujoco.engine import Variant

    made, accelerations = Variant.__init__, Variant.accelerations

    def make(self, dyn, bits=(), **more):
        made(self, dyn, bits, **more)
        self.factor = 1 + change * bool(bits)

    monkeypatch.setattr(Variant, "__init__", make)
    monkeypatch.setattr(Variant, "accelerations", lambda self, q, v: self.factor * accelerations(self, q, v))
    model = hinge().build()
    rows = beyond_terms.omissions(model, {"mujoco": mb.dynamics(model, "mujoco")}, 0)
    assert {o.unchanged for o in rows if o.need in ("contacts", "limits")} == {unchanged}
