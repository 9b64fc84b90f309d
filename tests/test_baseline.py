"""Baselines: what changed is named, what did not is not, and no file is lost."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import re
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

import mbkit as mb
from mbkit.cli import cli
from mbkit.engines import ENGINES
from mbkit.engines.mujoco.engine import MujocoDynamics
from mbkit.engines.pinocchio.engine import PinocchioDynamics
from mbkit.errors import BaselineError, InputError, NonPhysicalWarning, OutputError, UnsupportedError
from mbkit.studies import results
from mbkit.studies.baseline.description import changes, described
from mbkit.studies.baseline.file import store, text_of
from tests.scenes import mounted

RECORDED = Path(__file__).parent / "baselines"
PAIR = ("pinocchio", "mujoco")
ARM = """<robot name="arm">
  <link name="base">
    <inertial><origin xyz="0 0 0.05"/><mass value="4.1"/>
      <inertia ixx="0.011" iyy="0.012" izz="0.013" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="upper">
    <inertial><origin xyz="0.01 0 0.15" rpy="0.1 0 0"/><mass value="2.3"/>
      <inertia ixx="0.021" iyy="0.022" izz="0.002" ixy="0.0001" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="lower">
    <inertial><origin xyz="0 0 0.1"/><mass value="1.2"/>
      <inertia ixx="0.008" iyy="0.009" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="gripper">
    <inertial><origin xyz="0 0.02 0"/><mass value="0.4"/>
      <inertia ixx="0.0004" iyy="0.0005" izz="0.0006" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="tool"/>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/>
    <axis xyz="0 1 0"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.3" rpy="0.2 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="50" velocity="3"/><dynamics damping="0.1"/></joint>
  <joint name="wrist" type="fixed"><parent link="lower"/><child link="gripper"/><origin xyz="0 0 0.2"/></joint>
  <joint name="tip" type="fixed"><parent link="gripper"/><child link="tool"/><origin xyz="0 0 0.07"/></joint>
</robot>
"""


def call(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["baseline", *arguments])


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "arm.urdf").write_text(ARM)
    mb.baseline.record(mb.load(folder / "arm.urdf"), folder / "arm.toml", PAIR, target="./arm.urdf")
    return (folder / "arm.toml").read_bytes()


@pytest.fixture
def recorded(arm: Path, content: bytes) -> Path:
    path = arm.with_suffix(".toml")
    path.write_bytes(content)
    return path


def moved_version(monkeypatch, package: str = "pin", version: str = "99.0") -> None:
    now = results.versions()
    monkeypatch.setattr(results, "versions", lambda: now | {package: version})


def absent(monkeypatch, engine: str) -> None:
    """Make an engine one that is not installed."""
    known = replace(ENGINES[engine], module="no_such_engine", package=f"mbkit[{engine}]")
    monkeypatch.setitem(ENGINES, engine, known)


# The whole.


def test_ten_robots_are_as_they_were_recorded():
    files = sorted(RECORDED.glob("*.toml"))
    assert len(files) == 10
    assert sum(f.stat().st_size for f in files) <= 200_000
    result = call("check", str(RECORDED), "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert [r["path"] for r in found] == [str(f) for f in files]
    # Wherever an engine is missing, the others are checked.
    assert all(len(r["engines"]) + len(r["skipped"]) == 4 for r in found)
    assert all(r["worst"] < 1e-12 for r in found)


def test_the_same_is_recorded_as_the_same_bytes_and_read_back_to_the_bit(tmp_path, recorded, arm):
    again = tmp_path / "again.toml"
    made = mb.baseline.record(mb.load(arm), again, PAIR, target="./arm.urdf")
    assert again.read_bytes() == recorded.read_bytes()
    back = mb.baseline.read(again)
    assert text_of(back) == again.read_text()
    assert back.engines == PAIR
    assert all(np.array_equal(back.terms[t], x) for t, x in made.terms.items())
    assert all(np.array_equal(getattr(back.states, x), getattr(made.states, x)) for x in ("q", "v", "a", "tau"))
    assert mb.baseline.diff(recorded, again).status == "same"
    # A line says by itself what it is.
    lines = again.read_text().splitlines()
    assert "lower.mass = 1.6" in lines
    assert "gripper.mass = 0.4" in lines
    assert sum(line.startswith("nle.elbow = ") for line in lines) == 1


def _numbers(text: str) -> list[tuple[int, int, str]]:
    """Return every number of a mass, length or inertia that is not zero: where it is, and whose."""
    out = []
    owner = ""
    for tag in re.finditer(r"<(\w+)([^<>]*)>", text):
        if tag[1] in ("link", "joint") and "name=" in tag[2]:
            owner = re.search(r'name="(\w+)"', tag[2])[1]
        if tag[1] not in ("mass", "inertia", "origin"):
            continue
        for number in re.finditer(r"\d+\.\d*[1-9]", tag[2]):
            start = tag.start(2) + number.end() - 1
            out.append((start, start + 1, owner))
    return out


def test_one_digit_of_any_number_fails_by_the_name_of_its_link_or_joint(arm, tmp_path):
    path = tmp_path / "arm.toml"
    options = {"nonphysical": "warn"}
    mb.baseline.record(mb.load(arm), path, ["pinocchio"], samples=1, target="./arm.urdf", options=options)
    numbers = _numbers(ARM)
    assert len(numbers) == 28
    for start, end, owner in numbers[::2]:
        digit = ARM[start:end]
        arm.write_text(ARM[:start] + str(int(digit) % 9 + 1) + ARM[end:])
        with warnings.catch_warnings():
            # Some digits are of no matter.
            warnings.simplefilter("ignore", NonPhysicalWarning)
            result = mb.baseline.check(mb.load(arm, nonphysical="warn"), path)
        assert result.status == "description"
        # The one that was edited, and none that follows from it; where a pose turns, its inertia does too.
        assert {c.part for c in result.changes} == {owner}, result.text()
        assert not result.passed


def test_a_merged_link_is_named_beside_its_body_where_no_file_is_known(arm, tmp_path):
    path = tmp_path / "arm.toml"
    mb.baseline.record(mb.load(arm), path, ["pinocchio"])
    arm.write_text(ARM.replace('value="0.4"', 'value="0.5"'))
    changes = mb.baseline.check(mb.load(arm), path).changes
    assert changes[0].text == "mass of body lower (with gripper, tool fixed to it): 1.6 → 1.7"
    assert changes[0].old == 1.6
    arm.write_text(ARM.replace("0 0 0.07", "0 0 0.08"))
    (change,) = mb.baseline.check(mb.load(arm), path).changes
    assert change.text == "translation of frame tool (tip): z 0.27 → 0.28"


# What changed.


def scene(
    *,
    hinge: str = "hinge",
    order: tuple[str, str] = ("a", "b"),
    gravity: float = -9.81,
    turn: float = 0.0,
    **body: object,
) -> mb.Model:
    b = mb.ModelBuilder("scene", gravity=(0, 0, gravity))
    c, s = np.cos(turn), np.sin(turn)
    for name in order:
        b.add_body(name, **{"mass": 1.0, "com": (0.1, 0, 0), "inertia": (0.1, 0.1, 0.1), **body})
    for name in order:
        joint = {"a": hinge, "b": "other"}[name]
        rotation = [[1, 0, 0], [0, c, -s], [0, s, c]]
        b.add_joint(joint, "revolute", parent="world", child=name, axis=(0, 1, 0), rotation=rotation)
    return b.build()


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        (scene(gravity=-9.8), ["gravity: z -9.81 → -9.8"]),
        (
            scene(turn=0.01),
            ["rotation of joint hinge: turned by 0.01 rad about (1, 0, 0)", "rotation of joint other: "],
        ),
        (scene(hinge="pivot"), ["joint hinge is called pivot now"]),
        (scene(order=("b", "a")), ["order of the joints: hinge, other → other, hinge"]),
        (scene(inertia=(0.1, 0.1, 0.11)), ["inertia of body a: zz 0.1 → 0.11", "inertia of body b: "]),
        (scene(mass=1 + 2**-40), ["mass of body a: 1 → 1.0000000000009", "mass of body b: "]),
        (replace(scene(), name="other scene"), ["name: scene → other scene"]),
    ],
)
def test_a_changed_description_says_which_parameter(tmp_path, changed, told):
    path = tmp_path / "scene.toml"
    mb.baseline.record(scene(), path, ["pinocchio"], samples=1)
    result = mb.baseline.check(changed, path)
    assert result.status == "description"
    assert [c.text[: len(t)] for c, t in zip(result.changes, told, strict=True)] == told
    assert result.verdict in result.text()


def test_damping_limits_and_mimic_are_parameters_too():
    path = RECORDED / "panda.toml"
    told = [c.text for c in mb.baseline.check(mb.load("panda").without("damping", "limits"), path).changes]
    assert "damping of joint panda_joint1: 0.003 → 0" in told
    assert "upper of joint panda_joint1: 2.8973 → inf" in told
    freed = mb.baseline.check(mb.load("panda", mimic="free"), path)
    assert [c.text for c in freed.changes] == ["mimic of joint panda_finger_joint2: panda_finger_joint1 → none"]
    assert "other joints or another order than recorded" in freed.effect


def test_named_parameters_and_energies_are_told_by_name(tmp_path):
    path = tmp_path / "a.toml"
    mb.baseline.record(mb.catalog.pendulum(mass=mb.Parameter("m", 1.0)), path, ["lagrangian"])
    changes = mb.baseline.check(mb.catalog.pendulum(mass=mb.Parameter("m", 1.5)), path).changes
    assert changes[0].text == "parameter m: 1 → 1.5"
    from mbkit.lagrangian import systems

    written = systems.get("pendulum")().model
    made = mb.baseline.record(written, tmp_path / "b.toml")
    assert made.engines == ("lagrangian",)
    assert {r.engine for r in made.left_out} >= {"pinocchio", "mujoco"}
    assert mb.baseline.check(written, tmp_path / "b.toml").passed
    heavier = written.with_nominal({"m": 2.0})
    assert mb.baseline.check(heavier, tmp_path / "b.toml").changes[0].text == "parameter m: 1 → 2"


def test_rounding_of_another_parser_is_no_edit(monkeypatch, tmp_path):
    path = tmp_path / "scene.toml"
    mb.baseline.record(scene(), path, PAIR)
    rounded = scene(mass=1 + 2**-52)
    # With the same parser on the same processor, somebody wrote it.
    assert mb.baseline.check(rounded, path).status == "description"
    moved_version(monkeypatch)
    result = mb.baseline.check(rounded, path)
    assert result.status == "versions"
    assert any("only rounding: mass of body a" in note for note in result.notes)
    # Of a place zero is no size.
    first, *others = scene().joints
    placed = [
        described(replace(scene(), joints=(replace(first, translation=(x, 0, 0)), *others))) for x in (0, 1e-17, 1e-9)
    ]
    assert [changes(placed[0], x)[0].rounding for x in placed[1:]] == [True, False]


# Numbers and versions.


def test_a_moved_number_names_term_joint_and_the_version_that_moved(monkeypatch, recorded, arm):
    gravity = PinocchioDynamics._gravity

    def shifted(self, q):
        return gravity(self, q) * (1 + 1e-10 * np.array([0.0, 1.0]))

    monkeypatch.setattr(PinocchioDynamics, "_gravity", shifted)
    moved_version(monkeypatch)
    result = mb.baseline.check(mb.load(arm), recorded)
    assert result.status == "numbers"
    (row,) = result.moved
    assert (row.term, row.engine, row.joint) == ("g", "pinocchio", "elbow")
    assert row.cause == "pin 4.1.0 → 99.0" or row.cause.endswith("→ 99.0")
    assert row.now == pytest.approx(row.recorded * (1 + 1e-10), rel=1e-14)
    assert row.allowed < 1e-13 < row.error < 1e-9
    assert "pinocchio (pin" in result.text()
    assert "g at elbow" in result.text()


def test_an_engine_that_did_not_change_its_version_is_told_so(monkeypatch, recorded, arm):
    mass = MujocoDynamics._mass_matrix
    monkeypatch.setattr(MujocoDynamics, "_mass_matrix", lambda self, q: mass(self, q) + 1e-9 * np.eye(2))
    result = mb.baseline.check(mb.load(arm), recorded)
    assert {r.engine for r in result.moved} == {"mujoco"}
    assert "as recorded" in result.moved[0].cause
    assert result.moved[0].joint == "elbow"


def test_all_engines_alike_are_no_engines_fault(monkeypatch, recorded, arm):
    for engine in (PinocchioDynamics, MujocoDynamics):
        old = engine._potential_energy
        monkeypatch.setattr(engine, "_potential_energy", lambda self, q, old=old: old(self, q) + 1.0)
    (note,) = mb.baseline.check(mb.load(arm), recorded).notes
    assert "every engine moved" in note


def test_a_version_alone_asks_whether_to_rebaseline(monkeypatch, recorded, arm):
    moved_version(monkeypatch, "mujoco")
    result = mb.baseline.check(mb.load(arm), recorded)
    assert result.passed
    assert result.status == "versions"
    assert re.search(r"mujoco \S+ → 99.0; rebaseline\?", result.verdict)


def test_the_command_asks_once_and_records_anew_where_a_person_says_yes(monkeypatch, recorded):
    moved_version(monkeypatch, "mujoco")
    asked = call("check", str(recorded))
    assert asked.exit_code == 0
    assert "rebaseline?" in asked.stdout
    assert '"99.0"' not in recorded.read_text()
    check = inspect.unwrap(cli.commands["baseline"].commands["check"].callback)
    monkeypatch.setitem(check.__globals__, "_confirmed", lambda _: True)
    assert call("check", str(recorded)).exit_code == 0
    assert 'mujoco = "99.0"' in recorded.read_text()
    assert "rebaseline" not in call("check", str(recorded)).stdout


def test_a_missing_engine_is_skipped_with_the_reason_or_fails(monkeypatch, recorded, arm):
    absent(monkeypatch, "mujoco")
    result = mb.baseline.check(mb.load(arm), recorded)
    assert result.passed
    assert result.skipped[0].reason == "not installed; pip install mbkit[mujoco]"
    strict = mb.baseline.check(mb.load(arm), recorded, strict=True)
    assert not strict.passed
    assert "strict" in strict.verdict
    with pytest.raises(UnsupportedError, match="mujoco: not installed"):
        mb.baseline.record(mb.load(arm), recorded, PAIR)
    absent(monkeypatch, "pinocchio")
    nothing = mb.baseline.check(mb.load(arm), recorded)
    assert nothing.status == "skipped"
    assert not nothing.passed


def test_an_engine_that_refuses_what_it_took_has_moved(monkeypatch, recorded, arm):
    def refuse(*_: object) -> None:
        raise UnsupportedError("mujoco: no longer")

    monkeypatch.setattr(MujocoDynamics, "__init__", refuse)
    result = mb.baseline.check(mb.load(arm), recorded)
    assert result.status == "numbers"
    assert "everything: no longer: no longer" in result.text()


def test_a_known_defect_is_recorded_as_it_is_and_noticed_when_it_is_gone(monkeypatch, tmp_path):
    place = {"axis": (0, 0.6, 0.8), "armature": 0.5}
    b = mounted("arm", "link", "hinge", "revolute", mass=1.0, com=(0.1, 0, -0.2), inertia=(0.1, 0.1, 0.1), **place)
    model, path = b.build(), tmp_path / "arm.toml"
    made = mb.baseline.record(model, path, PAIR)
    assert [d.partition(" differs")[0] for d in made.disagreements] == ["pinocchio: kinetic energy"]
    assert mb.baseline.check(model, path).status == "same"
    monkeypatch.setattr(PinocchioDynamics, "_kinetic_energy", lambda self, q, v: 0.5 * v @ self._mass_matrix(q) @ v)
    (row,) = mb.baseline.check(model, path).moved
    assert row.term == "kinetic energy"
    assert "right now" in row.reason


# Files.


def faults(text: str) -> dict[str, tuple[bytes, str]]:
    lines = text.splitlines(keepends=True)
    return {
        "truncated": ("".join(lines[:-40]).encode(), "cut short"),
        "half a line": (text.encode()[:-100], "cut short"),
        "edited": (text.replace("lower.mass = 1.6", "lower.mass = 1.7").encode(), "edited or damaged"),
        "newer": (text.replace("format = 1", "format = 2").encode(), "newer mbkit"),
        "older": (text.replace("format = 1", "format = 0").encode(), "older mbkit"),
        "merged": (text.replace("[states]", "<<<<<<< ours\n[states]").encode(), "conflict marks"),
        "binary": (text.encode() + b"\xff\xfe", "no text"),
        "another": (b"[tool]\nname = 1\n", "no baseline of mbkit's"),
        "empty": (b"", "no baseline of mbkit's"),
    }


def test_a_file_that_is_not_as_it_was_written_is_told_apart(recorded, arm):
    text = recorded.read_text()
    model = mb.load(arm)
    for fault, (content, told) in faults(text).items():
        recorded.write_bytes(content)
        with pytest.raises(BaselineError, match=told):
            mb.baseline.check(model, recorded)
        if fault in ("newer", "another", "empty"):
            with pytest.raises(OutputError):
                mb.baseline.record(model, recorded, ["pinocchio"])
        assert recorded.read_bytes() == content
    # Ends of lines are version control's.
    recorded.write_bytes(text.replace("\n", "\r\n").encode())
    assert mb.baseline.check(model, recorded).passed
    recorded.unlink()
    with pytest.raises(BaselineError, match="no baseline"):
        mb.baseline.check(model, recorded)
    assert not [p for p in recorded.parent.iterdir() if p.name.startswith(".")]


def test_another_robots_baseline_is_neither_checked_nor_replaced(recorded, arm, monkeypatch):
    before = recorded.read_bytes()
    other = mb.catalog.pendulum()
    with pytest.raises(BaselineError, match=r"another robot: 'arm' with shoulder, elbow; this is 'pendulum'"):
        mb.baseline.check(other, recorded)
    with pytest.raises(OutputError, match="baseline of \"arm\", not of 'pendulum'"):
        mb.baseline.record(other, recorded)
    with pytest.raises(OutputError, match="no baseline"):
        mb.baseline.record(other, arm)
    assert recorded.read_bytes() == before
    # A full disk leaves what was there.
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OutputError, match="No space left"):
        mb.baseline.record(mb.load(arm), recorded, ["pinocchio"])
    assert recorded.read_bytes() == before
    monkeypatch.undo()
    mb.baseline.record(other, recorded, ["pinocchio"], force=True)
    assert mb.baseline.read(recorded).model == "pendulum"
    assert sorted(p.name for p in recorded.parent.iterdir()) == ["arm.toml", "arm.urdf"]


@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
def test_two_processes_at_once_leave_one_whole_file_and_no_other_robots(recorded, tmp_path):
    made = mb.baseline.read(recorded)
    texts = [text_of(replace(made, seed=k)) for k in (1, 2)]
    children = []
    for text in texts:
        child = os.fork()
        if not child:
            for _ in range(100):
                store(recorded, text, "arm", force=False)
            os._exit(0)
        children.append(child)
    seen = {mb.baseline.read(recorded).seed for _ in range(20)}
    assert all(os.waitpid(child, 0)[1] == 0 for child in children)
    assert seen <= {0, 1, 2}
    assert recorded.read_text() in texts
    # Two robots under one new name: one has it, the other is told.
    free = tmp_path / "free.toml"
    children = []
    for model in ("one", "two"):
        child = os.fork()
        if not child:
            try:
                store(free, text_of(replace(made, model=model)), model, force=False)
            except OutputError:
                os._exit(3)
            os._exit(0)
        children.append(child)
    assert sorted(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children) == [0, 3]
    assert not list(tmp_path.glob(".*"))


BAD = [
    ({"model": "panda"}, InputError, "expected a Model"),
    ({"model": mb.catalog.pendulum(mass=mb.Parameter("m"))}, InputError, "no value"),
    ({"path": "."}, InputError, "is a folder"),
    ({"path": "file/y.toml"}, OutputError, "cannot write"),
    ({"engines": "pinocchio"}, InputError, "several names"),
]


def test_bad_arguments_are_told(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    for bad, error, told in BAD:
        with pytest.raises(error, match=told):
            mb.baseline.record(**{"model": mb.catalog.pendulum(), "path": "a.toml", "engines": ["pinocchio"], **bad})
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


# Two files, and what is shown.


def test_diff_tells_parameters_numbers_and_versions_and_computes_nothing(monkeypatch, tmp_path, recorded, arm):
    arm.write_text(ARM.replace('value="2.3"', 'value="2.31"'))
    other = tmp_path / "other.toml"
    moved_version(monkeypatch)
    mb.baseline.record(mb.load(arm), other, PAIR[:1], target="./arm.urdf")
    monkeypatch.setattr("mbkit.engines.dynamics", None)
    result = mb.baseline.diff(recorded, other)
    assert result.status == "description"
    assert [c.text for c in result.changes] == ["mass of body upper: 2.3 → 2.31"]
    assert {r.term for r in result.moved} >= {"M", "g", "nle"}
    assert [str(v).split()[0] for v in result.versions] == ["pin"]
    assert result.skipped[0].engine == "mujoco"
    data = json.loads(result.to_json(tmp_path / "diff.json"))
    assert data["changes"][0]["new"] == 2.31
    for text in (result.to_markdown(), result._repr_html_(), result.text()):
        assert "2.3 → 2.31" in text
    arm.write_text(ARM)
    mb.baseline.record(mb.load(arm), other, PAIR[:1], seed=1, target="./arm.urdf")
    result = mb.baseline.diff(recorded, other)
    assert "the states are others" in result.notes[0]
    assert result.status == "numbers"
    mb.baseline.record(mb.catalog.pendulum(), other, PAIR[:1], force=True)
    with pytest.raises(BaselineError, match="no joint in common"):
        mb.baseline.diff(recorded, other)


def test_the_command_records_checks_and_ends_by_what_it_finds(monkeypatch, tmp_path, arm):
    monkeypatch.chdir(tmp_path)
    made = call("record", "arm.urdf", "mbkit.catalog:cart_pole", "base", "--engines", "pinocchio,mujoco")
    assert made.exit_code == 0, made.output
    assert 'target = "../arm.urdf"' in Path("base/arm.toml").read_text()
    # Wherever it is called from.
    monkeypatch.chdir(tmp_path / "base")
    agree = call("check", ".")
    assert agree.exit_code == 0, agree.output
    assert "✓ arm (arm.toml): as recorded" in agree.stdout
    monkeypatch.chdir(tmp_path)
    arm.write_text(ARM.replace("0 0 0.3", "0 0 0.31"))
    differ = call("check", "base")
    assert differ.exit_code == 1
    assert "translation of joint elbow: z 0.3 → 0.31" in differ.stdout
    assert "--rebaseline" in differ.stdout
    assert json.loads(call("check", "base/arm.toml", "--json").stdout)[0]["status"] == "description"
    Path("base/old.toml").write_text(Path("base/arm.toml").read_text())
    assert call("check", "base/arm.toml", "--rebaseline").exit_code == 0
    assert call("check", "base/arm.toml").exit_code == 0
    assert call("diff", "base/old.toml", "base/arm.toml").exit_code == 1
    assert call("diff", "base/arm.toml", "base/arm.toml").exit_code == 0
    assert call("check", "base/arm.toml", "--target", "mbkit.catalog:pendulum").exit_code == 2
    absent(monkeypatch, "mujoco")
    assert call("check", "base/arm.toml").exit_code == 0
    assert call("check", "base/arm.toml", "--strict").exit_code == 1
    absent(monkeypatch, "pinocchio")
    assert call("check", "base/arm.toml").exit_code == 2


@pytest.mark.usefixtures("recorded")
def test_one_files_fault_does_not_hide_the_others(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("cut.toml").write_text(Path("arm.toml").read_text()[:3000])
    result = call("check", "cut.toml", "arm.toml", "nothing.toml")
    assert result.exit_code == 2
    assert "✓ arm" in result.stdout
    assert "cut short" in result.stderr
    assert "nothing.toml: there is no baseline" in result.stderr
    for arguments, told in (
        (("record", "arm.urdf", "./arm.urdf", "base"), "would both be"),
        (("record", "arm.urdf", "mbkit.catalog:pendulum", "one.toml"), "want a folder"),
        (("record", "mbkit.catalog:pendulum", "arm.toml"), "baseline of"),
        (("check", "arm.toml", "cut.toml", "--target", "panda"), "--target goes with one file"),
        (("record", "arm.urdf", "x.toml", "--engines", "bullet"), "unknown engine"),
    ):
        result = call(*arguments)
        assert result.exit_code == 2, result.output
        assert told in result.stderr


# Baselines of strangers.


def forge(path: Path, key: str, value: str) -> None:
    """Put a value into a baseline's file, with a checksum that fits."""
    body = path.read_text().rpartition("# sha256 ")[0]
    body, count = re.subn(rf"^{re.escape(key)} = .*$", lambda _: f"{key} = {value}", body, count=1, flags=re.MULTILINE)
    assert count == 1, key
    path.write_text(f"{body}# sha256 {hashlib.sha256(body.encode()).hexdigest()}\n")


@pytest.fixture
def pendulum(tmp_path: Path) -> Path:
    path = tmp_path / "pendulum.toml"
    mb.baseline.record(mb.catalog.pendulum(), path, ["lagrangian"], samples=1, target="pendulum")
    return path


@pytest.mark.parametrize("target", ["evil:made", "os:abort", "evil:made.sub", "mbkit.catalog:get"])
def test_a_function_runs_only_where_the_caller_names_it(pendulum, target, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "evil", raising=False)
    Path("evil.py").write_text("import mbkit as mb, pathlib\npathlib.Path('ran').touch()\nmade = mb.catalog.pendulum\n")
    forge(pendulum, "target", f'"{target}"')
    for arguments in (("check", "pendulum.toml"), ("check", "."), ("check", "pendulum.toml", "--rebaseline")):
        done = call(*arguments)
        assert done.exit_code == 2
        assert f"--target {target}" in done.stderr
    assert mb.baseline.check(mb.catalog.pendulum(), pendulum).passed
    assert not Path("ran").exists()
    if target == "evil:made":
        assert call("check", "pendulum.toml", "--target", target).exit_code == 0
        assert Path("ran").exists()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("format", "9" * 5000),
        ("steps", "1000000000"),
        ("q.theta", "[nan, nan]"),
        ("nle.theta", "[inf, inf]"),
        ("gravity", '"x"'),
        ("bob.com", "[[[]]]"),
        ("bob.com", "[" * 3000),
    ],
)
def test_a_forged_baseline_is_refused_as_such(pendulum, key, value):
    forge(pendulum, key, value)
    with pytest.raises(BaselineError) as caught:
        mb.baseline.read(pendulum)
    assert len(str(caught.value)) < 1000
    assert call("check", str(pendulum)).exit_code == 2


@pytest.mark.parametrize("target", [["panda"], np.zeros(3), b"panda", 1, Path("a.urdf")])
def test_a_target_is_a_text_and_options_are_plain(pendulum, target):
    model = mb.catalog.pendulum()
    with pytest.raises(InputError, match="target"):
        mb.baseline.record(model, pendulum, ["lagrangian"], target=target)
    with pytest.raises(InputError, match="target"):
        mb.baseline.check(model, pendulum, target=target)
    for options in ({"gravity": np.zeros(3)}, {"mimic": None}, [1], {1: 2.0}):
        with pytest.raises(InputError, match="options"):
            mb.baseline.record(model, pendulum, ["lagrangian"], options=options)
    assert mb.baseline.check(model, pendulum).passed


def test_a_frame_that_moved_is_no_word_of_rest(tmp_path: Path) -> None:
    """Whoever uses the tool has another pose and another Jacobian, though no term of the tree moves."""
    model = mb.load("ur5")
    mb.baseline.record(model, tmp_path / "ur5.toml", engines=["pinocchio"])
    frames = tuple(
        replace(f, translation=f.translation + np.array([0, 0, 0.02])) if f.name == "tool0" else f for f in model.frames
    )
    result = mb.baseline.check(replace(model, frames=frames), tmp_path / "ur5.toml")
    assert not result.passed
    assert result.effect.startswith("moves the pose of 1 frame, tool0 most, by 0.02 m and 0 rad, with their Jacobians")
    texts = [c.text for c in result.changes]
    assert texts[0] == "translation of frame tool0: z 0 → 0.02"
    assert not any("same" in text for text in texts)


def test_poses_and_velocities_of_named_frames_are_numbers_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, path = mb.load("ur5"), tmp_path / "ur5.toml"
    made = mb.baseline.record(model, path, engines=["pinocchio"])
    assert "tool0" in made.frames
    k, dyn = made.frames.index("tool0"), mb.dynamics(model, "lagrangian")
    poses, speeds = made.terms["frames"][:, k, :12].reshape(-1, 3, 4), made.terms["frames"][:, k, 12:]
    assert np.abs(poses - dyn.pose(made.states.q, "tool0")[:, :3]).max() < 1e-14
    J = dyn.jacobian(made.states.q, "tool0")
    assert np.abs(speeds - np.einsum("nij,nj->ni", J, made.states.v)).max() < 1e-13
    assert np.array_equal(mb.baseline.read(path).terms["frames"], made.terms["frames"])
    # An engine that places the tool elsewhere, with everything else as it was.
    pose = PinocchioDynamics._pose
    monkeypatch.setattr(
        PinocchioDynamics, "_pose", lambda self, q, frames: pose(self, q, frames) + 1e-6 * np.eye(4, k=3)
    )
    result = mb.baseline.check(model, path)
    assert [r.term for r in result.moved] == ["frames"]
    assert result.moved[0].joint in made.frames
    assert result.moved[0].error > 1e-8


def test_a_renamed_link_moves_no_frame(tmp_path: Path) -> None:
    """The frame of a tool that is fixed to it has another host by name alone."""
    text = (
        '<robot name="r"><link name="base"/><link name="arm"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>'
        '<inertia ixx="0.02" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="tool"/>'
        '<joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/></joint>'
        '<joint name="mount" type="fixed"><origin xyz="0.3 0 0"/><parent link="arm"/><child link="tool"/></joint>'
        "</robot>"
    )
    path, file = tmp_path / "r.urdf", tmp_path / "r.toml"
    path.write_text(text, encoding="utf-8")
    mb.baseline.record(mb.load(path), file, ["pinocchio"], samples=1)
    path.write_text(text.replace('"arm"', '"upper"'), encoding="utf-8")
    result = mb.baseline.check(mb.load(path), file)
    assert result.effect == "no term moves (pinocchio)"
    path.write_text(text.replace("0.3 0 0", "0.4 0 0").replace('"arm"', '"upper"'), encoding="utf-8")
    assert "tool most, by 0.1 m and 0 rad" in mb.baseline.check(mb.load(path), file).effect
