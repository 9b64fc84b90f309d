"""Every importer's reading is compared with the file as written, and what differs has its cause."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit.cli import cli
from mbkit.engines import imported
from mbkit.engines.mujoco import importer
from mbkit.errors import InputError, LoadError, ModelError, UnknownNameError
from mbkit.load import xml_reader
from mbkit.load.loader import find
from mbkit.load.sanitized_text import strip
from mbkit.load.urdf_reader import urdf_links
from mbkit.load.xml_reader import Element
from mbkit.report.page import render
from mbkit.studies.explain.result import meaning
from mbkit.studies.explain.terms import TERMS
from mbkit.studies.importers.result import MISSING

LINK = (
    '<link name="{0}"><inertial><origin xyz="0 0.01 0.1" rpy="0.1 0 0"/><mass value="{1}"/>'
    '<inertia ixx="{2}" ixy="0" ixz="0" iyy="{3}" iyz="0" izz="{4}"/></inertial>{5}</link>'
)
JOINT = (
    '<joint name="{0}" type="{1}"><origin xyz="0 0 0.2" rpy="0 0.3 0"/><parent link="{2}"/><child link="{3}"/>'
    '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="5" velocity="2"/>{4}</joint>'
)


VALIDATION = Path(__file__).parents[1] / "validation"
DRAKE = imported.IMPORTERS["drake"]


def urdf(*parts: str) -> str:
    return f'<?xml version="1.0"?><robot name="r">{"".join(parts)}</robot>'


def arm(*beside: str, tool: str = LINK.format("tool", 0.3, 1e-3, 2e-3, 2e-3, ""), friction: float = 0.2) -> str:
    """Return an arm with dry friction, which Drake drops."""
    return urdf(
        LINK.format("base", 1, 0.01, 0.01, 0.01, ""),
        LINK.format("upper", 2, 0.01, 0.02, 0.015, ""),
        LINK.format("lower", 1, 0.004, 0.003, 0.002, ""),
        tool,
        JOINT.format("shoulder", "revolute", "base", "upper", f'<dynamics damping="0.5" friction="{friction}"/>'),
        JOINT.format("elbow", "continuous", "upper", "lower", ""),
        JOINT.format("mount", "fixed", "lower", "tool", ""),
        *beside,
    )


def write(folder: Path, text: str, name: str = "r.urdf") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def causes(result: object, engine: str) -> dict[str, list[str]]:
    out: dict[str, list[str]] = {}
    found = next(p for p in result.importers if p.engine == engine).explanation  # type: ignore[attr-defined]
    for c in found.causes:
        out.setdefault(c.kind, []).append(str(c))
    return out


def test_three_importers_of_one_sound_file(tmp_path: Path) -> None:
    result = mb.compare_parsers(write(tmp_path, arm(friction=0.0)))
    assert result.agree
    assert result.verdict == "pinocchio, mujoco and drake agree with the file as written, limits apart"
    assert [p.engine for p in result.importers] == ["pinocchio", "mujoco", "drake"]
    assert not causes(result, "pinocchio")
    # What is known of each: MuJoCo drops the base and velocity limits, Drake effort limits.
    assert causes(result, "mujoco").keys() == {"base mass", "limits"}
    assert "1 kg" in causes(result, "mujoco")["base mass"][0]
    assert causes(result, "drake").keys() == {"limits"}
    stages = {s.name: s for s in result.importers[1].stages}
    assert [*stages] == ["joints", "mimic", "loops", "couplers", "M", "g", "nle", "passive"]
    assert stages["M"].worst < 1e-14
    told = json.loads(result.to_json())
    assert told["agree"]
    assert any(line.startswith("| M |") and "✓ same" in line for line in result.to_markdown().splitlines())
    assert "base mass" in result._repr_html_()


def test_dry_friction_that_an_importer_drops_is_another_motion(tmp_path: Path) -> None:
    turning = '<dynamics damping="0.1" friction="5"/>'
    hinge = JOINT.format("hinge", "continuous", "base", "rod", turning)
    path = write(tmp_path, urdf('<link name="base"/>', LINK.format("rod", 2, 0.02, 0.03, 0.03, ""), hinge))
    result = mb.compare_parsers(path)
    read = {p.engine: p for p in result.importers}
    assert [p.agrees for p in read.values()] == [True, True, False]
    assert result.verdict == "pinocchio and mujoco agree with the file as written, limits apart; drake differs"
    assert {"friction", "limits"} == causes(result, "drake").keys()
    # The force that is lost, 5 N m, over the whole of 5 + 0.1 |v|, at the state of the least speed.
    v = mb.load(path).random_state(np.random.default_rng(0), 3)[1]
    (passive,) = (s for s in read["drake"].stages if s.name == "passive")
    assert (passive.same, passive.where) == (False, "hinge")
    assert passive.worst == pytest.approx(np.max(5 / (5 + 0.1 * np.abs(v))), rel=1e-12)
    for p in result.importers:
        assert p.explanation is not None
        assert p.agrees == p.explanation.agree
    told = json.loads(result.to_json())
    assert (told["agree"], told["verdict"]) == (False, result.verdict)
    page = result.document()
    assert (page.good, page.title) == (False, "r.urdf: importers differ")
    shown = CliRunner().invoke(cli, ["check", str(path), "--own-parsers", "--out", str(tmp_path)])
    assert shown.exit_code == 1
    assert shown.output.startswith("✗ r.urdf: pinocchio and mujoco agree")


def test_massless_inertia_and_impossible_inertia_as_each_importer_takes_them(tmp_path: Path) -> None:
    massless = mb.compare_parsers(write(tmp_path, arm(tool=LINK.format("tool", 0, 1e-3, 2e-3, 2e-3, ""))))
    assert not massless.agree
    assert "leaves out link 'tool'" in causes(massless, "mujoco")["lost body"][0]
    assert "a ball of water of 1 kg" in causes(massless, "drake")["replaced inertia"][0]
    assert all(p.explanation is not None and p.explanation.explained for p in massless.importers)
    impossible = mb.compare_parsers(write(tmp_path, arm(tool=LINK.format("tool", 0.3, 1e-3, 1e-3, 9e-3, ""))))
    assert "A + B >= C" in impossible.importers[1].refused
    assert "link 'tool'" in causes(impossible, "drake")["replaced inertia"][0]
    # By Drake itself, nothing of mbkit between.
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(arm(tool=LINK.format("tool", 0, 1e-3, 2e-3, 2e-3, "")), "urdf")
    M = plant.GetBodyByName("tool").default_spatial_inertia()
    assert M.get_mass() == pytest.approx(1.0, rel=1e-15)
    radius = (1 / (4 / 3 * np.pi * 1000)) ** (1 / 3)
    assert M.get_unit_inertia().get_moments()[0] - 0.01**2 - 0.1**2 == pytest.approx(0.4 * radius**2, rel=1e-12)


@pytest.mark.thorough
def test_real_robots_differ_as_the_table_says() -> None:
    table = json.loads((VALIDATION / "importers.json").read_text(encoding="utf-8"))["robots"]
    result = mb.compare_parsers("bolt", samples=1)
    # Who reads the result has the robot, and another machine.
    assert result.source == "bolt"
    assert str(find("bolt").path.parent) not in result.to_json()
    row = table["bolt_description/bolt"]
    for p in result.importers:
        assert row[p.engine]["status"] == ("agrees" if p.agrees else "differs")
        assert p.explanation is not None
        assert [c["says"] for c in row[p.engine]["causes"]] == [str(c) for c in p.explanation.acting]
    assert all(p["explained"] for r in table.values() for p in r.values() if p["status"] != "refuses")


MJCF = """<mujoco model="arm">
  <compiler angle="degree"/>
  <option gravity="0 0 -9.8"/>
  <default><joint damping="0.2" armature="0.01"/><geom density="500"/></default>
  <worldbody>
    <body name="upper" pos="0 0 0.1" euler="0 30 0">
      <joint name="shoulder" axis="0 1 0" range="-90 90"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
      <body name="lower" pos="0.3 0 0" quat="0.9 0.1 0.2 0.3">
        <joint name="elbow" axis="0 0 1" pos="0.01 0 0" ref="20" stiffness="3" springref="10"/>
        <geom type="box" size="0.1 0.02 0.03" pos="0.1 0 0"/>
        <body name="hand" pos="0.2 0 0">
          <joint name="slide" type="slide" axis="1 0 0"/>
          <joint name="roll" axis="1 0 0"/>
          <inertial pos="0.01 0.02 0.03" mass="0.4" fullinertia="0.002 0.003 0.0035 0.0001 0.0002 0.0003"/>
        </body>
      </body>
    </body>
    <body name="ball" pos="1 0 0"><freejoint name="fly"/><geom type="sphere" size="0.05"/></body>
  </worldbody>
</mujoco>"""


@pytest.mark.thorough
def test_an_mjcf_through_three_importers(tmp_path: Path) -> None:
    result = mb.compare_parsers(write(tmp_path, MJCF, "arm.xml"))
    pinocchio, mujoco, drake = result.importers
    assert mujoco.agrees
    assert not causes(result, "mujoco")
    assert causes(result, "drake").keys() == {"armature", "spring", "renamed"}
    assert len(causes(result, "drake")["armature"]) == 4
    # Pinocchio 4.1 reads the first body of the world alone.
    assert pinocchio.explanation is not None
    assert pinocchio.explanation.only_a == ("fly",)
    assert {"lost joint", "gravity", "spring"} <= causes(result, "pinocchio").keys()
    assert drake.explanation is not None
    assert drake.explanation.explained
    assert any("drawn elsewhere" in note for note in drake.notes)


#: What changes MuJoCo's smooth terms: flags, an attribute of a body, sections, options.
ACTING = {
    "nothing": ("", "", "", ""),
    "gravity off": ("<flag gravity='disable'/>", "", "", ""),
    "springs off": ("<flag spring='disable'/>", "", "", ""),
    "dampers off": ("<flag damper='disable'/>", "", "", ""),
    "asleep": ("<flag sleep='enable'/>", "", "", ""),
    "steps of its own": ("", "", "", "integrator='discrete'"),
    "fluid": ("", "", "", "density='1.2' viscosity='0.1' wind='1 0 0'"),
    "held": ("", "gravcomp='0.7'", "", ""),
    "tendon armature": ("", "", "<tendon><fixed armature='2'>{t}</fixed></tendon>", ""),
    "tendon spring": ("", "", "<tendon><fixed stiffness='5' damping='1'>{t}</fixed></tendon>", ""),
    "motor armature": ("", "", "<actuator><motor joint='j1' armature='0.5' gear='2'/></actuator>", ""),
    "motor": ("", "", "<actuator><motor name='m' joint='j1'/></actuator>", ""),
    "motor damping": ("", "", "<actuator><motor joint='j1' damping='0.5'/></actuator>", ""),
    "servo": ("", "", "<actuator><position joint='j1' kp='20' kv='1'/></actuator>", ""),
    "servo off": ("<flag actuation='disable'/>", "", "<actuator><position joint='j1' kp='20'/></actuator>", ""),
    "clamped": ("", "", "<actuator><motor joint='j1' ctrllimited='true' ctrlrange='0.5 1'/></actuator>", ""),
}


def acting(case: str) -> str:
    flags, body, section, options = ACTING[case]
    section = section.format(t="<joint joint='j1' coef='1'/><joint joint='j2' coef='-0.5'/>")
    return f"""<mujoco model="m"><option {options}>{flags}</option><worldbody>
      <body name="a" {body}><joint name="j1" axis="0 1 0" stiffness="3" springref="20" damping="0.4"/>
        <geom type="box" size="0.1 0.2 0.3" pos="0 0 0.2"/>
        <body name="b" pos="0 0 0.5"><joint name="j2" axis="1 1 0" damping="0.1"/><geom size="0.1" pos="0 0 0.2"/>
          <body name="c" pos="0.1 0 0.5"><joint name="j3" type="ball"/><geom size="0.1" pos="0.1 0 0.2"/></body>
      </body></body>
      <body name="d" pos="0 0 3"><freejoint name="f"/><geom type="capsule" size="0.1 0.2" pos="0.1 0.2 0.3"/></body>
      </worldbody>{section}</mujoco>"""


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("case", ACTING)
def test_the_verdict_on_mujoco_is_that_of_its_own_terms(case: str, tmp_path: Path) -> None:
    path = write(tmp_path, acting(case), "m.xml")
    made = mujoco.MjModel.from_xml_path(str(path))
    model = mb.load(path, actuators=True)
    pinocchio = mb.dynamics(model)
    data, M = mujoco.MjData(made), np.empty((made.nv, made.nv))
    worst = 0.0
    read = importer.read(path.read_text(encoding="utf-8"), "mjcf")
    for q, v in zip(*model.random_state(np.random.default_rng(1), 3), strict=True):
        # The free joint's turn is left out, so that its velocities are MuJoCo's.
        q[9:], v[8:] = (0, 0, 0, 1), 0
        data.qpos[:], data.qvel[:] = np.r_[q[:2], q[5], q[2:5], q[6:9], 1, 0, 0, 0], v
        mujoco.mj_forward(made, data)
        mujoco.mj_fullM(made, data, M)
        own = {"M": M, "nle": data.qfrc_bias, "passive": data.qfrc_passive + data.qfrc_actuator}
        ours = {"M": pinocchio.mass_matrix(q), "nle": pinocchio.nle(q, v), "passive": pinocchio.passive(q, v)}
        theirs = read.terms(q[None], v[None], ())
        for name, x in own.items():
            scale = np.abs(x).max() + 1
            assert np.abs(theirs[name][0] - x).max() < 1e-12 * scale, name
            worst = max(worst, np.abs(theirs[name][0] - ours[name]).max() / scale)
    result = mb.compare_parsers(path, ("mujoco",))
    told = result.importers[0]
    assert told.agrees == (worst < 1e-9) == ("agrees" in result.verdict)
    assert told.explanation is not None
    assert told.explanation.agree == told.agrees
    assert told.explanation.worst == max(s.worst for s in told.stages if s.name in TERMS)
    assert told.explanation.explained
    assert bool(told.explanation.acting) != told.agrees
    if case == "motor":
        assert any("'m'" in note for note in told.notes)


def test_meshes_that_give_inertia_are_handed_over(tmp_path: Path) -> None:
    corners = [(x, y, z) for x in (-0.1, 0.1) for y in (-0.2, 0.2) for z in (-0.3, 0.3)]
    faces = ["1 2 4", "1 4 3", "5 7 8", "5 8 6", "1 5 6", "1 6 2", "3 4 8", "3 8 7", "1 3 7", "1 7 5", "2 6 8", "2 8 4"]
    lines = [*("v {} {} {}".format(*c) for c in corners), *(f"f {f}" for f in faces)]
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "box.obj").write_text("\n".join(lines), encoding="utf-8")
    text = """<mujoco model="m"><compiler meshdir="meshes"/>
      <asset><mesh file="box.obj"/><mesh name="seen" file="nowhere.obj"/><texture file="none.png" type="2d"/></asset>
      <default><default class="look"><geom type="mesh" density="0" group="2"/></default></default>
      <worldbody><body name="a"><joint name="j" axis="0 1 0"/><geom type="mesh" mesh="box"/>
        <geom class="look" mesh="seen"/><geom class="look" type="box" size="1 1 1"/></body></worldbody></mujoco>"""
    path = write(tmp_path, text, "m.xml")
    stripped = strip(path)
    assert list(stripped.meshes) == ["box.obj"]
    assert "nowhere" not in stripped.text
    # The default class keeps its density, so that the massless box has none.
    made = mujoco.MjModel.from_xml_string(stripped.text, stripped.meshes)
    assert made.body_mass[1] == pytest.approx(48, rel=1e-6)
    assert made.ngeom == 2
    result = mb.compare_parsers(path, samples=1)
    assert not any(p.refused for p in result.importers)
    assert any("box.obj" in note for note in result.notes)
    # Pinocchio 4.1 gives a mesh the mass of 1 kg.
    assert not result.importers[0].agrees
    assert not stripped.shapeless
    missing = mb.compare_parsers(
        write(tmp_path, text.replace('file="box', 'name="box" file="gone'), "gone.xml"), samples=1
    )
    assert any("gone.obj" in note for note in missing.notes)
    assert any("whose meshes" in note for note in missing.notes)
    assert missing.importers[1].refused
    assert not missing.reference
    outside = strip(write(tmp_path, text.replace('file="box.obj"', 'name="box" file="/etc/hostname"'), "out.xml"))
    assert not outside.meshes
    assert "hostname" in outside.unread[0]


def test_lines_in_messages_are_those_of_the_file(tmp_path: Path) -> None:
    def lines(root: Element) -> list[tuple[str, str, int]]:
        return [(e.tag, e.attributes.get("name", ""), e.included_at or e.line) for e in root.walk()]

    (tmp_path / "part.xml").write_text("<mujocoinclude>\n\n\n<body name='p'/></mujocoinclude>", encoding="utf-8")
    bad = "<!-- one -->\n" + MJCF.replace(
        '<body name="ball"', '<include file="part.xml"/>\n<!-- two\n -->\n<geom\n type="ball"/><body name="ball"'
    ).replace("<worldbody>", "<asset>\n<texture file='t.png'/>\n</asset><worldbody>")
    tall = arm('<transmission name="t">\n<type> a\n b </type>\n<joint name="elbow"/></transmission>').replace(
        "><", ">\n<"
    )
    for name, text in (("bad.xml", bad), ("tall.urdf", tall)):
        stripped = strip(write(tmp_path, text, name))
        kept = lines(xml_reader.parse(stripped.text.encode(), name))
        assert set(kept) <= set(lines(stripped.root))
        assert len(kept) > 20
    line = bad[: bad.index("<geom\n")].count("\n") + 1
    refused = mb.compare_parsers(tmp_path / "bad.xml", ("mujoco",)).importers[0].refused
    assert f"line {line}" in refused or f"Line number={line}" in refused
    broken = tall.replace('<mass value="2"/>', '<mass value="two"/>')
    line = broken[: broken.index('"two"')].count("\n") + 1
    drake = mb.compare_parsers(write(tmp_path, broken, "broken.urdf"), ("drake",)).importers[0]
    assert f":{line}:" in " ".join((drake.refused, *drake.notes))


def test_refusals_are_told_and_the_rest_is_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # mbkit itself does not read it, and no importer's reading of a URDF is the standard: nothing is compared.
    loose = arm().replace("<axis", "<axs/><axis")
    result = mb.compare_parsers(write(tmp_path, loose))
    assert result.reference == ""
    assert "axs" in result.faults
    assert not result.agree
    assert not any(p.agrees or p.stages for p in result.importers)
    assert "agree" not in result.verdict
    assert "not compared" in result.verdict
    assert "Nothing is compared" in render(result.document())
    monkeypatch.setitem(imported.IMPORTERS, "drake", DRAKE._replace(library="nothing_of_this_name"))
    result = mb.compare_parsers(write(tmp_path, arm()))
    assert "pip install mbkit[drake]" in result.importers[2].refused
    assert result.importers[1].agrees
    assert not result.agree
    assert "drake refuses" in result.verdict
    nothing = mb.compare_parsers(write(tmp_path, urdf('<link name="a"/>')))
    assert all(p.refused for p in nothing.importers)
    assert json.loads(nothing.to_json())["agree"] is False


def test_no_other_file_is_opened_and_what_would_open_one_is_told(tmp_path: Path) -> None:
    shapes = (
        '<collision><geometry><mesh filename="package://nowhere/a.stl"/></geometry></collision>'
        '<collision><geometry><box size="1 1 1"/></geometry></collision>'
        '<visual><geometry><box size="1 1 1"/></geometry><material name="m"><texture filename="file:///etc/x"/></material></visual>'
    )
    text = arm(
        LINK.format("extra", 0.1, 1e-3, 1e-3, 1e-3, shapes),
        JOINT.format("last", "fixed", "tool", "extra", ""),
        # Drake 1.51 ends the process over a transmission without a type.
        '<transmission name="t"><type/><joint name="elbow"/><actuator name="m"/></transmission>',
        '<gazebo><plugin filename="lib.so"/></gazebo>',
        friction=0.0,
    )
    stripped = strip(write(tmp_path, text))
    assert not any(x in stripped.text for x in ("package", "filename", "mesh", "<type"))
    assert stripped.text.count("<box") == 1
    assert dict(stripped.gone) == {"collision": 1, "gazebo": 1, "transmission": 1, "visual": 1}
    result = mb.compare_parsers(stripped.path)
    assert result.agree
    assert "collision" in result.notes[0]
    for bad, told in (
        ('<mujoco><include file="/etc/passwd"/></mujoco>', "an absolute path is not followed"),
        ('<mujoco><worldbody><attach model="m"/></worldbody></mujoco>', "names another file"),
        ('<!DOCTYPE r [<!ENTITY e "x">]><robot name="r"/>', "DOCTYPE"),
        ("<sdf/>", "expected <robot>"),
    ):
        with pytest.raises(LoadError, match=told):
            mb.compare_parsers(write(tmp_path, bad, "bad.xml"))


@pytest.mark.thorough
def test_a_quadruped_and_a_humanoid_with_a_floating_base() -> None:
    # An inertia at the base that no body has: it moves nothing while the base stands, and does when it floats.
    anymal = mb.compare_parsers("anymal", floating_base=True, samples=1)
    pinocchio, mujoco, drake = anymal.importers
    assert anymal.floating_base
    assert pinocchio.agrees
    assert max(s.worst for s in pinocchio.stages if s.name in ("M", "g", "nle")) < 1e-12
    assert "positive eigenvalues" in mujoco.refused
    assert drake.explanation is not None
    assert drake.explanation.explained
    assert [c.kind for c in drake.explanation.acting] == ["replaced inertia"]
    still = mb.compare_parsers("anymal", ("drake",), samples=1).importers[0]
    assert still.agrees
    talos = mb.compare_parsers("talos", floating_base=True, samples=1)
    assert [p.agrees for p in talos.importers] == [True, True, False]
    assert "cannot mimic" in talos.importers[2].refused
    table = json.loads((VALIDATION / "importers_floating.json").read_text(encoding="utf-8"))["robots"]
    assert [p["status"] for p in table["talos_data/talos_reduced"].values()] == ["agrees", "agrees", "refuses"]
    assert all(p.get("explained", True) for r in table.values() for p in r.values())


def test_a_floating_base_is_the_one_of_load(tmp_path: Path) -> None:
    # A base link of the ground's name, and what hangs on it stands elsewhere and turned.
    mount = JOINT.format("mount_base", "fixed", "world", "base", "")
    path = write(tmp_path, arm('<link name="world"/>', mount, friction=0.0))
    result = mb.compare_parsers(path, floating_base=True, samples=1)
    assert result.agree
    assert any("'world' is called 'world_link'" in note for note in result.notes)
    for p in result.importers:
        assert "root_joint" in {m.b for m in p.explanation.matches}  # type: ignore[union-attr]
    links = urdf_links(strip(path, floating_base=True).root, "r", floating_base=True)
    assert mb.explain(mb.load(path, floating_base=True), links).agree
    # An MJCF gets the joint in the text that all of them read.
    body = '<body name="{0}" pos="0 0 1" euler="10 20 30"><geom type="box" size="0.1 0.2 0.3"/>{1}</body>'
    leg = '<body name="leg" pos="0 0 -0.3"><joint name="hip" axis="0 1 0"/><geom size="0.1"/></body>'
    mjcf = "<mujoco model='m'><worldbody>{}</worldbody></mujoco>"
    path = write(tmp_path, mjcf.format(body.format("base", leg)), "m.xml")
    assert mb.compare_parsers(path, floating_base=True, samples=1).agree
    # MuJoCo alone reads frames.
    path = write(tmp_path, mjcf.format(f"<frame pos='1 0 0'>{body.format('base', leg)}</frame>"), "frame.xml")
    assert mb.compare_parsers(path, ("mujoco",), floating_base=True, samples=1).importers[0].agrees
    two = write(tmp_path, mjcf.format(body.format("a", leg) + body.format("b", "")), "two.xml")
    with pytest.raises(ModelError, match="needs one body of the world, without joints"):
        mb.compare_parsers(two, floating_base=True)


def test_the_page_tells_it_all_and_obeys_nothing(tmp_path: Path) -> None:
    bad = '<script>alert("x")</script>'.replace("<", "&lt;").replace('"', "&quot;")
    text = arm(tool=LINK.format("tool", 0, 1e-3, 2e-3, 2e-3, "")).replace('"tool"', f'"{bad}"')
    result = mb.compare_parsers(write(tmp_path, text), floating_base=True, samples=1)
    page = render(result.document(), data="r.importers.json")
    assert page.index('class="verdict bad">✗ pinocchio agrees') < page.index("<table") < page.index("Why they differ")
    assert "alert" in page
    assert page.count("<script") == 1
    assert "<" not in result.to_markdown()
    for told in ("the base floats", "a ball of water put in its place", "✓ same", "✗ differs", "mujoco 4"):
        assert told in page
    # A refusal has its reason.
    result = mb.compare_parsers(write(tmp_path, arm(tool=LINK.format("tool", 0.3, 1e-3, 1e-3, 9e-3, ""))), samples=1)
    page = render(result.document())
    assert "Refused" in page
    assert "A + B &gt;= C" in page
    nobody = mb.compare_parsers(write(tmp_path, urdf('<link name="a"/>')))
    assert "and none reads it" in render(nobody.document())


def kinds_in(source: ast.AST) -> Iterator[str]:
    """Yield the kinds that a module gives to causes: in calls, and in rows of kind, sentence and changed fields."""
    for node in ast.walk(source):
        row: list[ast.expr] = []
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in {"Mistake", "_Trial", "_vector_mistakes"}:
            row = node.args
        elif isinstance(node, ast.Tuple) and len(node.elts) == 3 and not isinstance(node.elts[2], ast.Constant):
            sentence = node.elts[1]
            named = isinstance(sentence, ast.JoinedStr) or getattr(sentence, "id", "body") != "body"
            if named or " " in str(getattr(sentence, "value", "")):
                row = node.elts
        if row and isinstance(row[0], ast.Constant) and isinstance(row[0].value, str):
            yield row[0].value


def test_every_kind_of_cause_has_a_meaning() -> None:
    folder = Path(mb.__file__).parent / "studies" / "explain"
    kinds = {kind for path in folder.glob("*.py") for kind in kinds_in(ast.parse(path.read_text(encoding="utf-8")))}
    assert len(kinds) > 30
    assert not {k for k in kinds if not meaning(k)}


def test_arguments_and_doors(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="pinocchio"):
        mb.compare_parsers("panda", importers=("pinoccio",))
    with pytest.raises(InputError, match="importers"):
        mb.compare_parsers("panda", importers=())
    with pytest.raises(UnknownNameError, match="robot"):
        mb.compare_parsers("no_such_robot")
    run = CliRunner().invoke
    path = write(tmp_path, arm(tool=LINK.format("tool", 0, 1e-3, 2e-3, 2e-3, "")))
    out = ["--out", str(tmp_path / "out")]
    done = run(cli, ["check", str(path), "--own-parsers", *out])
    assert done.exit_code == 1, done.output
    assert "a ball of water of 1 kg" in " ".join(done.stdout.split())
    data = json.loads(next((tmp_path / "out").glob("*r.importers.json")).read_text(encoding="utf-8"))
    assert data["reference"] == "file"
    assert not data["floating_base"]
    assert "✗ pinocchio agrees" in next((tmp_path / "out").glob("*r.importers.html")).read_text(encoding="utf-8")
    done = run(cli, ["check", str(path), "--own-parsers", "--floating-base", "--json", *out])
    assert json.loads(done.stdout)["floating_base"]
    assert run(cli, ["check", "--own-parsers"]).exit_code == 2
    other = write(tmp_path, arm().replace('damping="0.5"', 'damping="0.6"'), "other.urdf")
    same = write(tmp_path, arm())
    done = run(cli, ["diff", str(same), str(other), "--json"])
    assert done.exit_code == 1
    assert [c["kind"] for c in json.loads(done.stdout)["causes"]] == ["damping"]
    done = run(cli, ["diff", str(same), str(other)])
    assert "other.urdf has damping 0.6 for 0.5" in " ".join(done.stdout.split())
    assert run(cli, ["diff", str(same), "--engines", "pinocchio,mujoco"]).exit_code == 0
    assert run(cli, ["diff", str(same)]).exit_code == 2


def test_what_is_not_installed_refuses_nothing(tmp_path: Path) -> None:
    result = mb.compare_parsers(write(tmp_path, arm()), ("pinocchio", "mujoco"), samples=1)
    gone = replace(result.importers[1], version=MISSING, refused="mujoco is not installed", stages=(), explanation=None)
    verdict = replace(result, importers=(result.importers[0], gone)).verdict
    assert "mujoco is not installed" in verdict
    assert "refuse" not in verdict


@pytest.mark.thorough
def test_mimic_joints_that_an_importer_holds_are_not_called_free(tmp_path):
    """Agreement leaves mimic joints out, and says so; no mark of a fault stands below a tick."""
    result = mb.compare_parsers("panda")
    assert result.agree
    assert result.verdict.endswith("with the file as written, mimic joints and limits apart")
    ways = {"pinocchio": "left free", "mujoco": "held by soft equality constraints", "drake": "held by constraints"}
    for read in result.importers:
        mimic = next(s for s in read.stages if s.name == "mimic")
        assert mimic.says == f"1 {ways[read.engine]}: panda_finger_joint2"
        (cause,) = (c for c in read.explanation.causes if c.kind == "mimic")
        assert ("leaves it free" in cause.says) == (read.engine == "pinocchio")
    shown = CliRunner().invoke(cli, ["check", "panda", "--own-parsers", "--out", str(tmp_path)])
    assert shown.exit_code == 0
    assert "✗" not in shown.output
    assert mb.compare_parsers("ur5").verdict.endswith("with the file as written, limits apart")


def test_links_that_are_fused_to_impossible_matter_are_compared_too() -> None:
    """With a floating base the fused base of this robot has a negative moment of inertia."""
    (read,) = mb.compare_parsers("romeo_laas_small", ("drake",), floating_base=True, samples=1).importers
    assert not read.refused
    assert not read.agrees
    assert read.explanation is not None
    assert read.explanation.acting
