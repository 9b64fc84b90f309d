"""Every robot of example-robot-data ends in agreement or in a named reason.

One robot of each maker is compared in all terms. Its siblings, and humanoids alike, are compared in M, inverse and
forward dynamics and the energies: every number of a description is in these, and the other terms are derived from the
same formulas as its sibling's. ``python -m validation.bodies`` compares all robots in all terms.
"""

from __future__ import annotations

import sys
import warnings
from functools import partial

import pytest

import mbkit as mb
from mbkit.errors import MbkitWarning, ModelError
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
#: Robots of which another one is compared in all terms, with the same arm, the same legs or no other kind of joint, or
#: which tests/test_compare.py compares in all terms: human, icub and romeo.
SIBLINGS = {
    "alex_description/alex_nub_hands",
    "alex_description/alex_psyonic_hands",
    "alex_description/alex_sake_hands",
    "allegro_hand_description/allegro_left_hand",
    "anymal_b_simple_description/anymal",
    "anymal_c_simple_description/anymal",
    "b1_description/b1",
    "centauro_description/centauro",
    "double_pendulum_description/double_pendulum_simple",
    "g1_description/g1_29dof_rev_1_0",
    "g1_description/g1_29dof_with_hand_rev_1_0",
    "human_description/human",
    "icub_description/icub",
    "icub_description/icub_reduced",
    "panda_description/panda_collision",
    "romeo_description/romeo",
    "romeo_description/romeo_laas_small",
    "romeo_description/romeo_small",
    "simple_humanoid_description/simple_humanoid_classical",
    "so_arm_description/so101",
    "talos_data/talos_full_v2",
    "talos_data/talos_full_v2_box",
    "talos_data/talos_reduced",
    "talos_data/talos_reduced_box",
    "talos_data/talos_reduced_corrected",
    "tiago_description/tiago",
    "tiago_description/tiago_dual",
    "tiago_pro_description/tiago_pro",
    "ur_description/ur10_joint_limited_robot",
    "ur_description/ur10_robot",
    "ur_description/ur3_gripper",
    "ur_description/ur3_joint_limited_robot",
    "ur_description/ur3_robot",
    "ur_description/ur5_gripper",
    "ur_description/ur5_joint_limited_robot",
}


def test_all_69_are_known():
    names = {r.name for r in mb.robots()}
    assert len(names) == 69
    assert names >= TWO_ENGINES | set(REFUSED) | ABOVE | SIBLINGS


#: Gravity is in V, inverse dynamics and the power balance, and C v and passive forces in the last two.
FEW = tuple(t for t in TERMS if t.name not in ("g", "nle", "C v", "passive"))


@pytest.mark.parametrize("robot", [r.name for r in mb.robots()])
def test_robot(monkeypatch, robot):
    study = sys.modules["mbkit.studies.compare.study"]
    # Each call once; tests/test_compare.py has the times.
    monkeypatch.setattr(study, "interleaved", partial(study.interleaved, rounds=1, budget=0.0))
    if robot in SIBLINGS:
        monkeypatch.setattr(study, "TERMS", FEW)
        monkeypatch.setattr(study, "BODY_TERMS", ())
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
    terms = FEW if robot in SIBLINGS else (*TERMS, *BODY_TERMS)
    singular = robot in ("romeo_description/romeo", "romeo_description/romeo_laas_small")
    missing = [t.name for t in terms if singular and t.quantity in ("forward_dynamics", "mass_matrix_inverse")]
    assert result.not_compared == (*missing, *["power balance"] * singular)
    assert {r.term for r in result.rows} == {*(t.name for t in terms), "power balance"} - {*result.not_compared}
