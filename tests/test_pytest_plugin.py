"""The plugin, in a project of somebody who has mbkit installed and configured nothing."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import unittest
from dataclasses import replace
from pathlib import Path

import pytest

import mbkit as mb
from mbkit.engines import ENGINES, EngineInfo
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.testing import STRICT, assert_baseline, assert_engines_agree, assert_same_dynamics

TOP = Path(__file__).parent.parent
ARM = """<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial><origin xyz="0 0 0.15"/><mass value="2.3"/>
      <inertia ixx="0.02" iyy="0.02" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="lower">
    <inertial><origin xyz="0 0 0.1"/><mass value="1.2"/>
      <inertia ixx="0.008" iyy="0.008" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="gripper">
    <inertial><mass value="0.4"/><inertia ixx="0.0004" iyy="0.0004" izz="0.0004" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.3"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="50" velocity="3"/><dynamics damping="0.1"/></joint>
  <joint name="wrist" type="fixed"><parent link="lower"/><child link="gripper"/><origin xyz="0 0 0.2"/></joint>
</robot>
"""
TESTS = """
import mbkit as mb
import pytest
from mbkit.testing import assert_engines_agree, assert_same_dynamics

pytestmark = pytest.mark.mbkit(robots=["robots/arm.urdf", "cart_pole"], engines=["pinocchio", "mujoco"])


def test_engines_agree(mbkit_model):
    assert_engines_agree(mbkit_model, engines=("pinocchio", "mujoco"))


def test_as_recorded(mbkit_model, mbkit_baseline):
    mbkit_baseline(mbkit_model, engines=("pinocchio", "mujoco"))


def test_gravity_pulls(mbkit_model, mbkit_dynamics):
    assert abs(mbkit_dynamics.gravity(mbkit_model.neutral() + 0.5)).max() > 0


@pytest.mark.mbkit(robots=["robots/arm.urdf"])
def test_my_conversion_is_still_my_robot(mbkit_model):
    assert_same_dynamics(mbkit_model, mbkit_model.without("damping"))
"""


MISTAKES = """
import pytest
import mbkit as mb
from mbkit.engines import ENGINES, EngineInfo
from mbkit.engines.lagrangian import LagrangianDynamics

ENGINES["drake"] = EngineInfo("drake", module="no_such_engine", class_name="Dynamics", package="mbkit[drake]")


@pytest.mark.mbkit(robots=["pandaa"])
def test_unknown(mbkit_model): ...


@pytest.mark.mbkit(robots=[mb.catalog.pendulum(), mb.catalog.cart_pole], engines=["drake"])
def test_missing(mbkit_dynamics): ...


def test_agree():
    from mbkit.testing import assert_engines_agree
    assert_engines_agree(mb.catalog.pendulum(), engines=("pinocchio", "drake"))
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Return the folder of a project, and let its pytest find the plugin as an installed one is found."""
    folder = tmp_path
    info = folder / "site" / "mbkit-0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mbkit\nVersion: 0\n")
    plugins = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]["entry-points"]["pytest11"]
    lines = [f"{name} = {where}" for name, where in plugins.items()]
    (info / "entry_points.txt").write_text("\n".join(["[pytest11]", *lines]) + "\n")
    (folder / "project" / "robots").mkdir(parents=True)
    (folder / "project" / "robots" / "arm.urdf").write_text(ARM)
    (folder / "project" / "test_robots.py").write_text(TESTS)
    (folder / "project" / "pytest.ini").write_text("[pytest]\naddopts = --strict-markers -W error\n")
    return folder / "project"


def run(project: Path, *arguments: str) -> tuple[int, str]:
    """Run pytest as a user would; return its status and what it printed."""
    paths = [str(project.parent / "site"), str(TOP), os.environ.get("PYTHONPATH", "")]
    env = {k: x for k, x in os.environ.items() if not k.startswith("PYTEST_")} | {"PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--color=no", *arguments]
    made = subprocess.run(command, cwd=project, env=env, capture_output=True, text=True, timeout=300)
    return made.returncode, made.stdout + made.stderr


def test_the_examples_of_the_documentation_record_and_check(project):
    robots = {"README.md": 2, "notebooks/start/robot_ci.md": 1}
    for page in robots:
        blocks = re.findall(r"^```python\n(.*?)^```$", (TOP / page).read_text(encoding="utf-8"), flags=re.M | re.S)
        (example,) = (code for code in blocks if "mbkit_baseline" in code)
        (project / f"test_{Path(page).stem}.py").write_text(example)
    (project / "test_robots.py").unlink()
    status, out = run(project, "--mbkit-regen")
    assert status == 0, out
    assert "8 passed" in out
    for page, count in robots.items():
        assert len(list((project / "baselines" / f"test_{Path(page).stem}").iterdir())) == count


@pytest.mark.thorough
def test_a_project_records_under_xdist_and_is_told_what_changed(project):
    status, out = run(project, "-n", "1", "--mbkit-regen", "-k", "recorded and arm")
    assert status == 0, out
    assert "1 passed" in out
    folder = project / "baselines" / "test_robots"
    assert [p.name for p in folder.iterdir()] == ["test_as_recorded_arm.toml"]
    assert "recorded baselines/test_robots/test_as_recorded_arm.toml (pinocchio, mujoco)" in out

    (project / "robots" / "arm.urdf").write_text(ARM.replace('value="0.4"', 'value="0.41"'))
    (project / "test_mistakes.py").write_text(MISTAKES)
    (project / "test_bare.py").write_text("def test_bare(mbkit_model): ...\n")
    status, out = run(project, "-rA", "--continue-on-collection-errors")
    assert status == 1
    assert "3 failed, 6 passed, 3 skipped, 2 errors" in out, out
    failure = out[out.index("_ test_as_recorded[arm] _") :]
    assert "mass of link gripper: 0.4 → 0.41" in failure
    assert "If this is meant: pytest --mbkit-regen 'test_robots.py::test_as_recorded[arm]'" in failure
    assert "cause: joint 'elbow': model_b has damping 0 for 0.1" in failure
    for name in ("test_gravity_pulls[arm-pinocchio]", "test_gravity_pulls[cart_pole-mujoco]"):
        assert f"PASSED test_robots.py::{name}" in out
    # Mistakes and missing engines are a line each, and where in mbkit they were found is of no use.
    assert "test_bare: mbkit_model wants @pytest.mark.mbkit(robots=[...])" in out
    assert "unknown robot or catalog system 'pandaa'; did you mean 'panda'" in out
    assert "drake: not installed; pip install mbkit[drake]" in out
    assert "To record it: pytest --mbkit-regen 'test_robots.py::test_as_recorded[cart_pole]'" in out
    assert str(TOP / "mbkit") not in out
    assert "Traceback" not in out


def test_the_plugin_loads_nothing_of_mbkit_but_itself():
    code = """
import sys, pytest
before = set(sys.modules)
import mbkit.pytest_plugin
print(*sorted(m for m in set(sys.modules) - before))
"""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(TOP), os.environ.get("PYTHONPATH", "")])}
    made = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert made.stdout.split() == ["mbkit", "mbkit._imports", "mbkit._version", "mbkit.pytest_plugin"]


# The asserts, wherever they are called.


def test_asserts_say_what_differs():
    b = mb.ModelBuilder("arm")
    b.add_body("link", mass=1.0, com=(0.1, 0, -0.2), inertia=(0.1, 0.1, 0.1))
    b.add_joint("hinge", "revolute", parent="world", child="link", axis=(0, 0.6, 0.8), armature=0.5)
    model = b.build()
    with pytest.raises(AssertionError) as caught:
        assert_engines_agree(model, ("pinocchio", "mujoco"))
    told = str(caught.value)
    assert "kinetic energy, pinocchio: differs by" in told
    assert "armature" in told
    assert "worst state" in told
    assert "pin 4" in told
    assert assert_engines_agree(model, ("lagrangian", "mujoco"), samples=2).passed
    with pytest.raises(AssertionError, match=r"joint 'hinge': model_b has armature 0 for 0\.5"):
        assert_same_dynamics(model, model.without("armature"))
    assert assert_same_dynamics(model, model).agree


class Heavy(LagrangianDynamics):
    """A user's own engine, with 1 % too much gravity."""

    engine = "heavy"

    def _gravity(self, q):
        return 1.01 * super()._gravity(q)


def test_asserts_take_an_engine_of_ones_own(monkeypatch):
    monkeypatch.setitem(ENGINES, "heavy", EngineInfo("heavy", module=__name__, class_name="Heavy"))
    with pytest.raises(AssertionError, match=r"g, heavy: differs by(.|\n)*casadi .*, heavy"):
        assert_engines_agree(mb.catalog.pendulum(), ("lagrangian", "heavy"), samples=1)


def test_a_missing_engine_skips_or_fails(monkeypatch, tmp_path):
    model, path = mb.catalog.pendulum(), tmp_path / "a.toml"
    mb.baseline.record(model, path, ["mujoco"])
    monkeypatch.setitem(ENGINES, "mujoco", replace(ENGINES["mujoco"], module="no_such_engine"))
    with pytest.raises(unittest.SkipTest, match="mujoco: not installed"):
        assert_engines_agree(model, ("pinocchio", "mujoco"))
    with pytest.raises(unittest.SkipTest, match="nothing was checked: mujoco"):
        assert_baseline(model, path)
    assert assert_engines_agree(model, samples=2).engines == ("pinocchio", "lagrangian")
    monkeypatch.setenv(STRICT, "1")
    with pytest.raises(AssertionError, match="mujoco: not installed"):
        assert_engines_agree(model)
    with pytest.raises(AssertionError, match="nothing was checked"):
        assert_baseline(model, path)


def test_an_engine_that_refuses_a_model_fails():
    written = mb.lagrangian.systems.get("pendulum")().model
    with pytest.raises(AssertionError, match="mujoco: pendulum: pendulum was written as energies"):
        assert_engines_agree(written, ("lagrangian", "mujoco"), samples=1)
