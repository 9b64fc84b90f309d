"""Every robot of example-robot-data ends in agreement or in a named reason."""

from __future__ import annotations

import warnings

import pytest

import mbkit as mb
from mbkit.errors import MbkitWarning, ModelError

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


def test_all_69_are_known():
    names = {r.name for r in mb.robots()}
    assert len(names) == 69
    assert names >= TWO_ENGINES | set(REFUSED) | ABOVE


@pytest.mark.parametrize("robot", [r.name for r in mb.robots()])
def test_robot(robot):
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
    assert result.not_compared == (
        ("forward dynamics", "M⁻¹", "forward dynamics, wrench", "power balance")
        if robot in ("romeo_description/romeo", "romeo_description/romeo_laas_small")
        else ()
    )
