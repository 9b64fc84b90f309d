"""Loops that importers read out of an MJCF are those of the file, or the difference is named and measured."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import ModelError
from mbkit.model import Loop
from mbkit.studies.explain.hypotheses import moved
from mbkit.studies.explain.merged_model import Tolerances
from mbkit.studies.importers import study
from mbkit.studies.importers.result import ParserComparison, Stage
from mbkit.studies.importers.study import Written, between_joints, coupler_differences, loop_differences

BODY = '<inertial pos=".2 0 0" mass="1" diaginertia=".1 .1 .1"/>'
#: Two links in a chain; {0} is where the second one's joint stands in it, {1} its attitude, {2} the equalities.
CHAIN = (
    '<mujoco model="m"><compiler inertiafromgeom="false"/><worldbody><body name="a" pos="0 0 1">'
    f'<joint name="ja" axis="0 1 0"/>{BODY}<site name="g" pos=".2 .1 0" {{1}}/><body name="b" pos=".4 0 0" {{1}}>'
    f'<joint name="jb" axis="0 1 0" pos="{{0}}"/>{BODY}<site name="s" pos=".1 .2 .3"/>'
    f'<body name="tool" pos="0 0 .1">{BODY}</body></body></body></worldbody>'
    "<equality>{2}</equality></mujoco>"
)
CONNECT = '<connect name="x" body1="b" anchor=".3 0 .1"/>'
WELD = '<weld name="w" body1="b" relpose=".1 .2 .3 .8 .6 0 0"/>'
TURNED = 'quat=".8 .6 0 0"'


def compared(tmp_path: Path, at: str, attitude: str, equalities: str) -> ParserComparison:
    path = tmp_path / "m.xml"
    path.write_text(CHAIN.format(at, attitude, equalities))
    return mb.compare_parsers(path)


def loops(result: ParserComparison) -> dict[str, Stage]:
    return {p.engine: next(s for s in p.stages if s.name == "loops") for p in result.importers}


@pytest.mark.thorough(every=3)
@pytest.mark.parametrize(
    "equalities", [CONNECT, WELD, CONNECT + WELD, '<connect body1="b" body2="tool" anchor="0 0 0"/>']
)
@pytest.mark.parametrize("attitude", ["", TURNED])
def test_nothing_differs_where_the_joint_stands_in_the_body_s_origin(
    equalities: str, attitude: str, tmp_path: Path
) -> None:
    found = loops(compared(tmp_path, "0 0 0", attitude, equalities))
    for engine in ("pinocchio", "mujoco"):
        assert found[engine].same is True, found[engine]
        assert not found[engine].worst


@pytest.mark.parametrize("equality", [CONNECT, WELD])
def test_pinocchio_takes_poses_in_the_joint_s_axes(equality: str, tmp_path: Path) -> None:
    found = loops(compared(tmp_path, "0 .2 .1", "", equality))
    assert found["mujoco"].same is True
    assert found["pinocchio"].same is False
    # The joint is away from the body's origin by this much.
    assert found["pinocchio"].worst == pytest.approx(0.05**0.5, rel=1e-12)
    assert "moved by 0.224 m" in found["pinocchio"].says


def test_a_relative_pose_that_is_left_to_the_pose_of_the_file(tmp_path: Path) -> None:
    for relpose in ("", 'relpose="0 1 0 0 0 0 0"'):
        found = loops(compared(tmp_path, "0 0 0", TURNED, f'<weld body1="b" {relpose}/>'))
        assert found["mujoco"].same is True
        assert found["pinocchio"].same is True


@pytest.mark.parametrize("equality", [CONNECT, WELD])
def test_an_inactive_loop_that_is_read_as_active(equality: str, tmp_path: Path) -> None:
    result = compared(tmp_path, "0 0 0", "", equality.replace("/>", ' active="false"/>'))
    found = loops(result)
    assert found["mujoco"].same is True
    assert found["pinocchio"].same is False
    assert "inactive, read as active" in found["pinocchio"].says
    for text in (result.to_markdown(), result.to_csv(), result.to_json()):
        assert "inactive, read as active" in text
    rows = json.loads(result.to_json())["importers"][0]["stages"]
    assert [x["same"] for x in rows if x["name"] == "loops"] == [False]


@pytest.mark.thorough("connect")
@pytest.mark.parametrize("tag", ["connect", "weld"])
def test_mujoco_s_sites(tag: str, tmp_path: Path) -> None:
    found = loops(compared(tmp_path, "0 .2 .1", TURNED, f'<{tag} site1="g" site2="s"/>'))
    assert found["mujoco"].same is True


@pytest.mark.parametrize("flag", ["equality", "constraint"])
def test_a_flag_switches_loops_off(flag: str, tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    option = f'<option><flag {flag}="disable"/></option><worldbody>'
    path.write_text(CHAIN.format("0 0 0", "", CONNECT).replace("<worldbody>", option))
    found = loops(mb.compare_parsers(path))
    assert found["mujoco"].same is True
    assert "inactive, read as active" in found["pinocchio"].says


def test_what_mbkit_refuses_as_a_loop_is_not_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = study._written

    def written(*args: Any, loops: bool = False) -> mb.Model:
        if loops:
            raise ModelError("m", ["no such loop"])
        return read(*args)

    monkeypatch.setattr(study, "_written", written)
    result = compared(tmp_path, "0 0 0", "", CONNECT)
    assert all(x.same is None and "no such loop" in x.says for x in loops(result).values())
    assert all(p.agrees for p in result.importers)


def test_drake_loses_welds_and_does_not_give_its_points(tmp_path: Path) -> None:
    weld, connect = (loops(compared(tmp_path, "0 0 0", "", x))["drake"] for x in (WELD, CONNECT))
    assert weld.same is False
    assert "'jb'): missing" in weld.says
    assert connect.same is None
    assert connect.says


def test_pinocchio_refuses_a_loop_to_the_world_by_name_and_its_tree_is_compared(tmp_path: Path) -> None:
    result = compared(tmp_path, "0 0 0", "", CONNECT.replace("/>", ' body2="world"/>'))
    pinocchio, mujoco, _ = result.importers
    ours, theirs = (next(s for s in p.stages if s.name == "loops") for p in (pinocchio, mujoco))
    assert theirs.same is True
    assert ours.same is None
    assert "world" in ours.says
    assert pinocchio.agrees
    assert any("reader of constraints refuses" in note for note in pinocchio.notes)


def test_a_body_without_a_joint_of_its_own(tmp_path: Path) -> None:
    """Pinocchio fuses it, and takes a relative pose to it for one to the body that carries it."""
    text = CHAIN.replace('name="tool" pos', 'quat=".8 .6 0 0" name="tool" pos')
    path = tmp_path / "m.xml"
    path.write_text(text.format("0 0 0", "", '<weld body1="a" body2="tool" relpose=".4 0 0 1 0 0 0"/>'))
    found = loops(mb.compare_parsers(path))
    assert found["mujoco"].same is True
    assert found["pinocchio"].same is False
    # A quaternion (0.8, 0.6, 0, 0) turns by 2 arccos 0.8.
    assert "moved by 0.1 m and turned by 1.29 rad" in found["pinocchio"].says


def pose(angle: float, *point: float) -> np.ndarray:
    X = np.eye(4)
    X[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    X[:3, 3] = point
    return X


def closure(kind: str, a: np.ndarray, b: np.ndarray) -> Loop:
    return Loop("x", kind, "", a[:3, :3], a[:3, 3], "j", b[:3, :3], b[:3, 3])


def test_either_end_counts_and_the_frame_in_which_a_weld_is_written_does_not() -> None:
    a, b = pose(0.3, 1, 2, 3), pose(-0.2, 0, 1, 0)
    other = pose(1.1, 0.4, -0.7, 0.2)
    far, turn = moved(closure("frame", a, b), closure("frame", a @ other, b @ other))
    assert max(far, turn) < 1e-15 * 10
    assert moved(closure("frame", a, b), closure("frame", a @ pose(0.25, 0, 0, 0), b)) == pytest.approx(
        (0.0, 0.25), abs=1e-14
    )
    for ends in ((a @ pose(0, 0.5, 0, 0), b), (a, b @ pose(0, 0.5, 0, 0))):
        for kind in ("point", "frame"):
            assert moved(closure(kind, a, b), closure(kind, *ends)) == pytest.approx((0.5, 0.0), abs=1e-14)


def test_loops_are_paired_with_the_nearest_and_the_rest_is_named() -> None:
    near = Tolerances(1e-9, 1.0)
    one, two, off = (closure("point", pose(0, x, 0, 0), pose(0, x, 0, 0)) for x in (0.0, 1.0, 5.0))
    written = Written([one, two], [one, off, two])
    assert not loop_differences(written, [two, one], near)
    assert [says for *_, says in loop_differences(written, [two], near)] == ["missing"]
    assert [says for *_, says in loop_differences(written, [off, two, one], near)] == ["inactive, read as active"]
    assert [says for *_, says in loop_differences(written, [two, one, off, off], near)] == [
        "inactive, read as active",
        "not in the file",
    ]


COUPLED = '<joint name="c" joint1="jb" joint2="ja" polycoef="0.1 {0} 0 0 0" {1}/>'


def couplers(result: ParserComparison) -> dict[str, Stage]:
    return {p.engine: next(s for s in p.stages if s.name == "couplers") for p in result.importers}


def test_couplers_of_joints_are_compared(tmp_path: Path) -> None:
    """MuJoCo reads them, the other two lose them in silence."""
    result = compared(tmp_path, "0 0 0", "", COUPLED.format("-0.5", ""))
    found = couplers(result)
    assert found["mujoco"].same is True
    for engine in ("pinocchio", "drake"):
        assert found[engine].same is False
        assert "'c' (of 'ja' and 'jb'): missing" in found[engine].says
        assert "missing" in result.to_markdown()


@pytest.mark.parametrize("swapped", [False, True])
def test_a_coupler_s_numbers_are_those_of_either_of_its_joints(swapped: bool) -> None:
    written = mb.model.Coupler("c", "a", "b", -0.5, 0.1)
    read = mb.model.Coupler("", "y", "x", -2.0, 0.2) if swapped else mb.model.Coupler("", "x", "y", -0.5, 0.1)
    names, plain = {"x": "a", "y": "b"}, mb.catalog.double_pendulum()
    (own,) = between_joints(plain, [written], {x: x for x in "ab"})
    loops = Written([own], [own])

    def differences(loops: Written, *read: mb.model.Coupler) -> list[tuple[float, str, str]]:
        return coupler_differences(loops, plain, between_joints(plain, read, names), 1e-9)

    assert differences(loops, read) == []
    for change in ({"ratio": read.ratio * (1 + 1e-6)}, {"offset": read.offset + 1e-6}):
        ((size, where, says),) = differences(loops, replace(read, **change))
        assert 1e-7 < size < 1e-5
        assert where == "'c' (of 'a' and 'b')"
        assert says.startswith("a = ")
    ((_, _, says),) = differences(loops, read, read)
    assert says == "not in the file"
    ((_, _, says),) = differences(Written(every=[own]), read)
    assert says == "inactive, read as active"


def test_mujoco_s_polynomial_is_of_the_coordinates_less_those_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    path.write_text(CHAIN.format("0 0 0", "", COUPLED.format("2", "")).replace('name="ja"', 'name="ja" ref="30"'))
    assert couplers(mb.compare_parsers(path))["mujoco"].same is True


LINK = (
    '<link name="{0}"><inertial><origin xyz="0.1 0 0.2"/><mass value="1"/>'
    '<inertia ixx="1" iyy="1.2" izz="1.1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
HINGE = (
    '<joint name="j{0}" type="revolute"><parent link="{1}"/><child link="{0}"/><axis xyz="0 1 0"/>'
    '<limit lower="-3" upper="3" effort="1" velocity="1"/>{2}</joint>'
)
FOLLOWS = '<mimic joint="{0}" multiplier="{1}" offset="{2}"/>'


def test_mimic_joints_may_be_held_by_couplers_also_in_a_chain(tmp_path: Path) -> None:
    second, third = FOLLOWS.format("ja", 2, 0.1), FOLLOWS.format("jb", -0.5, 0.2)
    joints = HINGE.format("a", "base", "") + HINGE.format("b", "a", second) + HINGE.format("c", "b", third)
    path = tmp_path / "chain.urdf"
    path.write_text(f'<robot name="r"><link name="base"/>{"".join(map(LINK.format, "abc"))}{joints}</robot>')
    found = couplers(mb.compare_parsers(path))
    assert {engine: stage.same for engine, stage in found.items()} == dict.fromkeys(found, True)
    model, names = mb.load(path), {x: x for x in ("ja", "jb", "jc")}
    for ratio, offset, right in ((-0.5, 0.2, True), (0.5, 0.2, False), (-0.5, 0.3, False)):
        read = mb.model.Coupler("", "jc", "jb", ratio, offset)
        some = coupler_differences(Written(), model, between_joints(model, [read], names), 1e-9)
        assert [says for _, _, says in some] == ([] if right else ["not in the file"])
