"""Importers in environments of their own: what they read is described, and judged like any other's."""

from __future__ import annotations

from pathlib import Path

import pytest

import mbkit as mb
from mbkit._child_process import end_all
from mbkit.engines.remote import dynamics
from mbkit.engines.remote.packages import PACKAGES, EngineVersion, Package, register_remote_engine
from mbkit.errors import InputError, UnknownNameError
from mbkit.studies.explain.terms import TERMS
from mbkit.studies.importers.study import _SINGLE_TOLERANCE
from tests.test_engine_versions import present
from tests.test_parsers import LINK, MJCF, arm, causes, urdf, write

HINGE = '<joint name="hinge" type="{}"><parent link="base"/><child link="upper"/><axis xyz="1 0 0"/></joint>'
STILL = '<link name="base"/>'


def test_an_importer_that_is_not_judged_is_refused_by_name(tmp_path: Path) -> None:
    path = write(tmp_path, arm())
    with pytest.raises(UnknownNameError, match="newton"):
        mb.compare_parsers(path, ["drake==1.40.0"])
    with pytest.raises(UnknownNameError, match="newton"):
        mb.compare_parsers(path, ["newtn"])
    with pytest.raises(InputError, match="mujoco-warp"):
        mb.compare_parsers(path, mb.engine("newton"))  # type: ignore[arg-type]
    assert set(dynamics.importers()) == {"newton", "mujoco-warp", "mjx", "mjx-single"}


def needs(name: str) -> None:
    if not mb.engine(name).installed:
        pytest.skip(f"no environment of {name}")


def test_newton_corrects_inertias_and_says_which(tmp_path: Path) -> None:
    needs("newton")
    parts = STILL, LINK.format("upper", 1, 0.01, 0.01, 0.03, ""), HINGE.format("continuous")
    result = mb.compare_parsers(write(tmp_path, urdf(*parts)), ["newton"])
    (newton,) = result.importers
    assert "0.010001 kg m² more about every axis" in causes(result, newton.engine)["corrected inertia"][0]
    assert any("corrected the inertia of upper" in note for note in newton.notes)
    assert newton.explanation is not None
    assert newton.explanation.explained
    sound = mb.compare_parsers(write(tmp_path, arm()), ["newton"]).importers[0]
    assert sound.agrees
    assert 0 < max(s.worst for s in sound.stages if s.name in ("M", "g", "nle")) < _SINGLE_TOLERANCE


def test_newton_reads_joints_of_one_body_at_one_place(tmp_path: Path) -> None:
    needs("newton")
    text = MJCF.replace('<joint name="roll" axis="1 0 0"/>', '<joint name="roll" axis="0 0 1" pos="0 0.4 0"/>')
    result = mb.compare_parsers(write(tmp_path, text, "arm.xml"), ["mujoco", "newton"])
    mujoco, newton = result.importers
    assert mujoco.agrees
    assert "M" in {s.name for s in newton.stages if s.same is False}
    assert {"gravity", "joint origin"} <= causes(result, newton.engine).keys()


def test_put_model_holds_what_the_file_says(tmp_path: Path) -> None:
    needs(name := "mujoco-warp")
    servo = '<actuator><position name="servo" joint="elbow" kp="3" kv="0.2"/></actuator></mujoco>'
    path = write(tmp_path, MJCF.replace("</mujoco>", servo), "arm.xml")
    result = mb.compare_parsers(path, ["mujoco", name])
    mujoco, remote = result.importers
    assert remote.agrees
    assert [s.same for s in mujoco.stages] == [s.same for s in remote.stages]
    damp = path.read_text(encoding="utf-8").replace("<option ", '<option density="900" ')
    found = causes(mb.compare_parsers(write(tmp_path, damp, "damp.xml"), [name]), remote.engine)
    assert "density 900" in found["fluid"][0]


#: An engine whose `put_model` is a copy of MuJoCo's model, in the present interpreter.
HELD = """
import copy, mujoco, numpy as np, on_mujoco

def put(m):
    m = copy.copy(m)
    {put}
    return m

class Engine(on_mujoco.Engine):
    def __init__(self, m, acting=False):
        super().__init__(put(m))
        self._m.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)

    def passive(self, q, v):
        passive = super().passive(q, v)
        mujoco.mj_fwdActuation(self._m, self._d)
        return passive + self._d.qfrc_actuator
"""
HANGS = """
import time
class Engine: ...
def imported(*_, **__): time.sleep(60)
"""


@pytest.fixture
def one_of_ones_own(tmp_path, monkeypatch):
    """Register an engine by the text of its file, in an environment of the present interpreter."""
    monkeypatch.setenv("MBKIT_ENVIRONMENTS", str(tmp_path / "environments"))
    names = []

    def registered(name: str, text: str, importer: str) -> EngineVersion:
        (file := tmp_path / f"on_{name}.py").write_text(text, encoding="utf-8")
        where: dict[str, str] = {"file": str(file), "importer": importer}
        package = Package(name, "numpy", PACKAGES["mjx"].convention, tested=("1",), **where)
        register_remote_engine(name, package)
        names.append(name)
        present(name, "1")
        return mb.engine(name, seconds=2.0 if importer.startswith("on_") else 60.0)

    yield registered
    end_all()
    for name in names:
        del PACKAGES[name]


@pytest.mark.thorough
def test_an_importer_that_hangs_is_ended_after_its_time(tmp_path, one_of_ones_own) -> None:
    version = one_of_ones_own("hanging", HANGS, "on_hanging")
    (one,) = mb.compare_parsers(write(tmp_path, arm()), [version]).importers
    assert "ended after 2 s" in one.refused


@pytest.mark.thorough
def test_what_put_model_drops_is_named(tmp_path, one_of_ones_own) -> None:
    servo = '<actuator><position name="servo" joint="elbow" kp="3" kv="0.2"/></actuator></mujoco>'
    path = write(tmp_path, MJCF.replace("</mujoco>", servo), "arm.xml")
    whole = one_of_ones_own("whole", HELD.format(put="pass"), "mujoco_importer")
    mujoco, same = mb.compare_parsers(path, ["mujoco", whole]).importers
    assert same.agrees
    assert [(s.name, s.same) for s in mujoco.stages] == [(s.name, s.same) for s in same.stages]
    assert max(s.worst for s in same.stages if s.name in TERMS) < 1e-12
    dropping = one_of_ones_own("dropping", HELD.format(put="m.dof_armature[0] = 0"), "mujoco_importer")
    result = mb.compare_parsers(path, [dropping])
    assert causes(result, dropping.name).keys() == {"armature"}
    assert any("put_model: dof_armature of 'shoulder'" in note for note in result.importers[0].notes)


def test_a_file_that_the_importer_refuses_gives_its_reason(tmp_path, one_of_ones_own) -> None:
    version = one_of_ones_own("whole", HELD.format(put="pass"), "mujoco_importer")
    path = write(tmp_path, arm(tool=LINK.format("tool", 0.3, 1e-3, 1e-3, 9e-3, "")))
    assert "A + B >= C" in mb.compare_parsers(path, [version]).importers[0].refused


def test_a_floating_base_and_what_stands_beside(tmp_path, one_of_ones_own) -> None:
    version = one_of_ones_own("whole", HELD.format(put="pass"), "mujoco_importer")
    assert mb.compare_parsers(write(tmp_path, arm()), [version], floating_base=True).importers[0].agrees
    text = MJCF.replace("<option ", '<option density="900" ')
    found = mb.compare_parsers(write(tmp_path, text, "wet.xml"), [version])
    assert "density 900" in causes(found, version.name)["fluid"][0]
