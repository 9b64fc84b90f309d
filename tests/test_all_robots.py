"""Every robot of example-robot-data ends in agreement or in a named reason.

Robots of every sort of joint and base are compared in all terms. Their siblings are compared in M, inverse dynamics
and the energies: every number of a description is in these, and the other terms are derived from the same formulas as
a sibling's. ``python -m validation.bodies`` compares all robots in all terms.
"""

from __future__ import annotations

import warnings
from functools import partial
from importlib import import_module

import pytest

import mbkit as mb
from mbkit.errors import MbkitWarning, ModelError, UnsupportedError
from mbkit.studies.compare.body_terms import BODY_TERMS
from mbkit.studies.compare.terms import TERMS

#: MuJoCo refuses a body of these.
TWO_ENGINES = {
    "icub_description/icub",
    "icub_description/icub_reduced",
    "romeo_description/romeo",
    "romeo_description/romeo_laas_small",
    "romeo_description/romeo_small",
}
REFUSED = {
    "hector_description/quadrotor_base": "no joints",
    "iris_description/iris_simple": "all joints are fixed",
    "ur_description/ur3": "has no name",
}
#: A light link half a metre from the tree's centre of mass: MuJoCo's own rounding.
ABOVE = {"tiago_description/tiago_no_hand"}
#: Compared in all terms. Every other robot has the arm or the legs of one of these, or no other kind of joint.
WHOLE = {
    "a1_description/a1",
    "anymal_b_simple_description/anymal-kinova",
    "asr_twodof_description/TwoDofs",
    "bolt_description/bolt",
    "borinot_description/borinot_flying_arm_2",
    "double_pendulum_description/double_pendulum",
    "double_pendulum_description/double_pendulum_continuous",
    "finger_edu_description/finger_edu",
    "hextilt_description/hextilt_flying_arm_5",
    "iris_description/iris",
    "kinova_description/kinova",
    "panda_description/panda",
    "quadruped_description/quadruped",
    "so_arm_description/so100",
    "solo_description/solo",
    "solo_description/solo12",
    "talos_data/talos_left_arm",
    "tiago_description/tiago_no_hand",
    "ur_description/ur5_robot",
    "z1_description/z1",
}


def test_all_69_are_known():
    names = {r.name for r in mb.robots()}
    assert len(names) == 69
    assert names >= TWO_ENGINES | set(REFUSED) | ABOVE | WHOLE


#: Gravity, C v and passive forces are in the inverse dynamics; forward dynamics and the power balance follow.
FEW = tuple(t for t in TERMS if t.name in ("M", "inverse dynamics", "kinetic energy", "potential energy"))


def without_accelerations(*_):
    raise UnsupportedError("siblings are not asked for accelerations")


@pytest.mark.thorough(every=14)
@pytest.mark.parametrize("robot", [r.name for r in mb.robots()])
def test_robot(monkeypatch, robot):
    study = import_module("mbkit.studies.compare.study")
    # Each call once; tests/test_compare.py has the times.
    monkeypatch.setattr(study, "interleaved", partial(study.interleaved, rounds=1, budget=0.0))
    if sibling := robot not in WHOLE:
        monkeypatch.setattr(study, "TERMS", FEW)
        monkeypatch.setattr(study, "BODY_TERMS", ())
        monkeypatch.setattr(study, "power_errors", without_accelerations)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        if robot in REFUSED:
            with pytest.raises(ModelError, match=REFUSED[robot]):
                mb.load(robot)
            return
        model = mb.load(robot)
    result = mb.compare(model, samples=8, terms_only=True)
    assert result.passed, result.verdict
    if robot in TWO_ENGINES:
        assert result.engines == ("pinocchio", "lagrangian")
        refusal = next(r for r in result.refusals if r.engine == "mujoco")
        assert "refuses body '" in refusal.reason
    else:
        assert result.engines == ("pinocchio", "lagrangian", "mujoco")
    if robot not in ABOVE:
        assert max(r.relative for r in result.rows) <= 1e-12
    terms = {t.name for t in (FEW if sibling else (*TERMS, *BODY_TERMS))}
    assert {r.term for r in result.rows} == terms | {"power balance"} - {*result.not_compared}
    # MuJoCo's own friction holds no followers.
    softly = ("dry friction as mujoco holds it",) * (model.needs.friction and model.layout.reduced)
    assert result.not_compared == (*softly, *("power balance",) * sibling)
