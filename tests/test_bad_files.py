"""Files that are wrong, broken or hostile: one clear error each, and nothing else happens."""

# ruff: noqa: E501 -- a description is easier to read on one line
from __future__ import annotations

import contextlib
import math
import os
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mbkit import errors
from mbkit.errors import LoadError, MbkitError, ModelError, NonPhysicalWarning
from mbkit.load import load, xml_reader
from mbkit.load.loader import find, read_loops
from mbkit.load.urdf_reader import Snapper, read_links
from tests.descriptions import INERTIAL, LIMIT, links, robot, written
from tests.descriptions import urdf_joint as joint

LINK = '<link name="a"/>' + links("b")
JOINT = joint("j", "a", "b")


def with_inertial(mass: str = "1", moments: str = "1 0 0 1 0 1", origin: str = "") -> str:
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    told = " ".join(f'{n}="{x}"' for n, x in zip(names, moments.split(), strict=True))
    inertial = f'<inertial>{origin}<mass value="{mass}"/><inertia {told}/></inertial>'
    return robot('<link name="a"/>', links("b", inertial=inertial), JOINT)


def with_joint(inside: str, kind: str = "revolute") -> str:
    return robot(LINK, joint("j", "a", "b", inside, kind))


def three(*joints: str) -> str:
    return robot(links("a", "b", "c"), *joints)


def raised(tmp_path: Path, text: str | bytes, name: str = "robot.urdf", **options: object) -> MbkitError:
    path = written(tmp_path, text, name)
    with pytest.raises(MbkitError) as caught:
        load(path, **options)
    assert str(path) in str(caught.value)
    return caught.value


# What is wrong with the text of the file as such.

TEXTS = {
    "empty": (b"", "the file is empty"),
    "not_xml": (b"mass: 3\n", "line 1, column 1: not well-formed XML"),
    "binary": (bytes(range(256)), "not well-formed XML"),
    "mismatched": (b'<robot name="r">\n<link name="a">\n</robot>', "line 3.*mismatched tag"),
    "attribute_without_value": (
        b'<robot name="r">\n<link name/></robot>',
        "line 2, column 11: not well-formed XML: .*'/' after '<link name'",
    ),
    "unknown_entity": (b'<robot name="&who;"/>', "undefined entity"),
    "wrong_encoding": (
        b'<?xml version="1.0" encoding="klingon"?><robot name="r"/>',
        "not readable as XML|unknown encoding",
    ),
    "ampersand": (b'<robot name="a & b"/>', "line 1, column 17: .*&amp;"),
    "broken_utf8": (b'<robot name="\xff\xfe"/>', "line 1, column 14: .*0xff.*UTF-8"),
    "sdf": (b'<sdf version="1.6"/>', r"this is SDF; give its file a name that ends in \.sdf"),
    "html": (b"<html><body/></html>", "root element is <html>"),
    "nested": (b"<robot>" + b"<link>" * 100_000, "nested more than 250 deep"),
}


@pytest.mark.parametrize("case", TEXTS)
def test_texts_that_are_no_description(case, tmp_path, capfd):
    text, expected = TEXTS[case]
    error = raised(tmp_path, text)
    assert isinstance(error, LoadError)
    assert re.search(expected, str(error)), str(error)
    assert str(error).count("not well-formed") <= 1
    assert capfd.readouterr() == ("", "")


def test_text_is_written_once_however_often_elements_interrupt_it(monkeypatch):
    written = []

    class Counted(xml_reader.Element):
        def __setattr__(self, name, value):
            if name == "text":
                written.append(len(value))
            super().__setattr__(name, value)

    monkeypatch.setattr(xml_reader, "Element", Counted)
    content = b"<robot>" + b"<a/>word" * 1000 + b"</robot>"
    assert xml_reader.parse(content, "x").text == "word" * 1000
    assert sum(written) < len(content)


@pytest.mark.parametrize("inside", [LIMIT, LIMIT + '<mimic joint="unknown_{i}"/>'])
def test_few_unknown_names_are_compared_with_all_known_ones(monkeypatch, tmp_path, inside):
    calls = []
    monkeypatch.setattr(errors.difflib, "get_close_matches", lambda *given, **_: calls.append(given) or [])
    text = robot(links("a"), *(joint(f"j{i}", "a", f"b{i}", inside.replace("{i}", str(i))) for i in range(50)))
    error = raised(tmp_path, text)
    assert sum("unknown" in fault for fault in error.faults) >= 50
    assert len(calls) <= 10


def test_a_message_of_many_or_long_faults_can_be_read(tmp_path):
    error = raised(tmp_path, robot("<link/>" * 5000 + f'<link name="a"/><link name="{"b" * 100_000}"/>'))
    assert len(error.faults) > 5000
    assert len(str(error)) < 300_000
    assert str(len(error.faults)) in str(error)


# URDF. Each names the culprit, and what to do where that is not plain.

URDFS = {
    "no_name": (f"<robot>{LINK}{JOINT}</robot>", ["<robot> has no name", 'name="..."']),
    "no_links": (robot(), ["no links"]),
    "no_joints": (robot('<link name="a"/>'), ["no joints", "nq = 0", "floating_base=True"]),
    "no_moving_joints": (with_joint("", "fixed"), ["all joints are fixed", "nq = 0"]),
    "cycle": (
        robot(links("a", "b", "c", "d"), joint("j", "b", "c"), joint("k", "c", "d"), joint("l", "d", "b")),
        ["joints 'j', 'k', 'l' form a cycle", "cut the loop"],
    ),
    "two_parents": (
        three(JOINT, joint("k", "a", "c"), joint("l", "c", "b")),
        ["link 'b': child of 2 joints ('j', 'l')"],
    ),
    "two_roots": (three(JOINT), ["2 links that no joint carries ('a', 'c')"]),
    "same_link_names": (robot(links("a", "b", "b"), JOINT), ["link 'b': declared 2 times"]),
    "unknown_link": (robot(LINK, joint("j", "a", "bb")), ["joint 'j': unknown link 'bb'; did you mean 'b'?"]),
    "nameless_link": (robot("<link/>", LINK, JOINT), ["<link> has no name"]),
    "no_parent": (robot(LINK, '<joint name="j" type="revolute"><child link="b"/></joint>'), ["'j': no <parent>"]),
    "unknown_type": (with_joint(LIMIT, "hinge"), ["joint 'j': type 'hinge'", "expected one of fixed, revolute"]),
    "no_limit": (with_joint(""), ["joint 'j': a revolute joint needs <limit", "continuous"]),
    "no_effort": (with_joint('<limit lower="0" upper="1" velocity="1"/>'), ["joint 'j': limit effort: missing"]),
    "negative_effort": (with_joint(LIMIT.replace('t="1"', 't="-1"')), ["joint 'j': limit effort is negative"]),
    "negative_damping": (
        with_joint(LIMIT + '<dynamics damping="-1"/>'),
        ["joint 'j': damping -1 is negative", "line 1"],
    ),
    "zero_axis": (with_joint('<axis xyz="0 0 0"/>' + LIMIT), ["joint 'j': axis is zero"]),
    "unknown_dynamics": (
        with_joint(LIMIT + '<dynamics spring_rate="2"/>'),
        ["unknown attribute 'spring_rate'", "spring_stiffness"],
    ),
    "damped_floating": (with_joint('<dynamics damping="1"/>', "floating"), ["joint 'j': damping or friction"]),
    "two_limits": (with_joint(LIMIT + LIMIT.replace('"1"', '"2"')), ["joint 'j': 2 <limit> elements"]),
    "mimic_unknown": (
        with_joint(LIMIT + '<mimic joint="k"/>'),
        ["joint 'j': mimics unknown joint 'k'", "mimic='free'"],
    ),
    "mimic_planar": (
        three(
            joint("j", "a", "b", '<axis xyz="0 0 1"/>', "planar"), joint("k", "b", "c", LIMIT + '<mimic joint="j"/>')
        ),
        ["joint 'k': mimics 'j', but both must have one velocity"],
    ),
    "xacro": (robot('<xacro:macro name="m"/>', LINK, JOINT), ["1 xacro elements, such as <xacro:macro>", "run xacro"]),
    "xacro_number": (with_inertial(mass="${m}"), ["link 'b': mass value: '${m}' is not a finite number; run xacro"]),
    "negative_mass": (with_inertial(mass="-2"), ["link 'b': mass -2 kg is negative"]),
    "no_mass_element": (
        robot('<link name="a"/>', links("b", inertial="<inertial/>"), JOINT),
        ["link 'b': <inertial> has no <mass>", "link 'b': <inertial> has no <inertia>"],
    ),
    "missing_moment": (with_inertial().replace(' iyz="0"', ""), ["link 'b': inertia iyz: missing"]),
    "zero_mass": (with_inertial(mass="0"), ["'b'", "no mass but inertia", 'nonphysical="warn"']),
    "nothing_at_all": (
        with_inertial(mass="0", moments="0 0 0 0 0 0"),
        ["'b'", "no mass moves with joint 'j'", "M is singular", 'nonphysical="warn"'],
    ),
    "triangle": (with_inertial(moments="1 0 0 1 0 3"), ["'b'", "violates A + B >= C", "1, 1, 3", 'nonphysical="warn"']),
    "not_positive": (with_inertial(moments="-1 0 0 1 0 1"), ["'b'", "not positive", "-1, 1, 1", 'nonphysical="warn"']),
    "root_joint_taken": (robot(LINK, joint("root_joint", "a", "b")), ["joint 'root_joint'"]),
    "huge": (with_inertial(mass="1e200"), ["link 'b': mass value: '1e200' is too large"]),
    "thousands_of_joints": (
        robot(links(*(f"l{i}" for i in range(2002))), *(joint(f"j{i}", f"l{i}", f"l{i + 1}") for i in range(2001))),
        ["2001 joints; up to 2000"],
    ),
}


@pytest.mark.thorough("thousands_of_joints")
@pytest.mark.parametrize("case", URDFS)
def test_urdfs_with_a_fault(case, tmp_path, capfd):
    text, expected = URDFS[case]
    error = raised(tmp_path, text, floating_base=case == "root_joint_taken")
    assert isinstance(error, ModelError)
    for part in expected:
        assert part in str(error), str(error)
    # Nothing of what the parsers in C++ would have said reached the terminal.
    assert capfd.readouterr() == ("", "")


NUMBERS = {
    "link 'b': mass value": with_inertial(mass="%s"),
    "link 'b': inertia ixy": with_inertial(moments="1 %s 0 1 0 1"),
    "link 'b': origin xyz": with_inertial(origin='<origin xyz="0 %s 0"/>'),
    "link 'b': origin rpy": with_inertial(origin='<origin rpy="0 0 %s"/>'),
    "joint 'j': origin xyz": with_joint('<origin xyz="%s 0 0"/>' + LIMIT),
    "joint 'j': origin rpy": with_joint('<origin rpy="%s 0 0"/>' + LIMIT),
    "joint 'j': axis xyz": with_joint('<axis xyz="%s 0 0"/>' + LIMIT),
    "joint 'j': limit lower": with_joint('<limit lower="%s" upper="1" effort="1" velocity="1"/>'),
    "joint 'j': limit upper": with_joint('<limit lower="0" upper="%s" effort="1" velocity="1"/>'),
    "joint 'j': limit effort": with_joint('<limit lower="0" upper="1" effort="%s" velocity="1"/>'),
    "joint 'j': limit velocity": with_joint('<limit lower="0" upper="1" effort="1" velocity="%s"/>'),
    "joint 'j': dynamics damping": with_joint(LIMIT + '<dynamics damping="%s"/>'),
    "joint 'j': dynamics friction": with_joint(LIMIT + '<dynamics friction="%s"/>'),
    "joint 'j': mimic multiplier": with_joint(LIMIT + '<mimic joint="j" multiplier="%s"/>'),
    "joint 'j': mimic offset": with_joint(LIMIT + '<mimic joint="j" offset="%s"/>'),
}


@pytest.mark.parametrize(
    ("where", "value"),
    [(x, "nan") for x in NUMBERS]
    + [("joint 'j': axis xyz", x) for x in ("inf", "-Infinity", "1e999", "0x10", "1,5", "one", "1_0", "٣")],
)
def test_numbers_that_are_none(where, value, tmp_path):
    error = raised(tmp_path, NUMBERS[where].replace("%s", value))
    assert f"{where}: {value!r} is not a finite number" in str(error)
    assert "(line 1)" in str(error)


@pytest.mark.parametrize(("word", "hint"), [("0.07,", "comma"), ("${x}", "xacro"), ("$(optenv", "xacro")])
def test_numbers_that_are_none_come_with_a_hint(word, hint, tmp_path):
    assert hint in str(raised(tmp_path, with_joint(f'<origin xyz="{word} 0 0"/>' + LIMIT)))


# Every element and attribute in which URDF writes dynamics, each once.
COMPLETE = robot(
    links("a", "b"),
    links("c").replace("<mass", '<origin xyz="0 0 1" rpy="0 0 1"/><mass'),
    joint("j", "a", "b"),
    joint(
        "k",
        "b",
        "c",
        LIMIT + '<origin xyz="0 0 1" rpy="0 0 1"/><axis xyz="0 0 1"/><dynamics damping="1" friction="1"/>'
        '<mimic joint="j" multiplier="2" offset="1"/>',
    ),
)
ELEMENTS = {element.tag for element in xml_reader.parse(COMPLETE.encode(), "").walk()} - {"robot"}
ATTRIBUTES = {name for element in xml_reader.parse(COMPLETE.encode(), "").walk() for name in element.attributes}


@pytest.mark.parametrize("name", sorted(ELEMENTS | ATTRIBUTES))
@pytest.mark.parametrize("how", ["swapped", "short", "capitals"])
def test_misspelt_names_are_no_dynamics_that_is_lost(name, how, tmp_path):
    wrong = {"swapped": name[:-2] + name[:-3:-1], "short": name[:-1], "capitals": name.upper()}[how]
    for pattern in (rf"(</?){name}\b", rf"( ){name}(?==)"):
        text = re.sub(pattern, rf"\g<1>{wrong}", COMPLETE)
        if text != COMPLETE:
            assert repr(wrong) in str(error := raised(tmp_path, text)) or f"<{wrong}>" in str(error)
            assert isinstance(error, ModelError)


@pytest.mark.parametrize(
    ("old", "new"),
    [('<origin xyz="0 0 1"', '<origin pos="0 0 1"'), ("<inertial>", "<inertial><com/>"), ("</link>", "<mass/></link>")],
)
def test_what_would_be_lost_of_the_dynamics_is_refused(old, new, tmp_path):
    assert isinstance(raised(tmp_path, COMPLETE.replace(old, new)), ModelError)


def test_extensions_are_left_out_with_a_note(tmp_path):
    path = written(tmp_path, COMPLETE)
    plain = load(path)
    path.write_text(
        COMPLETE.replace("<axis", '<safety_controller/><drake:rotor_inertia value="1"/><axis')
        .replace("<dynamics", '<dynamics mu_viscous="1"')
        .replace("<robot", '<robot xmlns:drake="x"')
        .replace("</robot>", "<gazebo/><joints_of_mine/></robot>")
    )
    extended = load(path)
    assert extended == plain
    for name in ("safety_controller", "drake:rotor_inertia", "mu_viscous", "gazebo", "joints_of_mine"):
        assert any(name in note for note in extended.notes)


HEADS = {"lines": b"\n\n", "words": b"robot of mine\n", "comment": b"<!-- <robot> -->\n"}


@pytest.mark.parametrize("head", HEADS)
def test_text_around_the_document_is_passed_over_with_a_note(head, tmp_path):
    path = written(tmp_path, COMPLETE.encode())
    plain = load(path)
    for text in (
        HEADS[head] + b'<?xml version="1.0" encoding="latin-1"?>\n<!-- \xe4 -->' + COMPLETE.encode(),
        COMPLETE.encode() + b"\n\0\0\n",
    ):
        path.write_bytes(text)
        assert load(path) == plain
        assert len(load(path).notes) == len(plain.notes) + 1
    path.write_bytes(HEADS[head] + b'<?xml version="1.0"?>\n<robot>\n</link>')
    with pytest.raises(LoadError, match=f"line {HEADS[head].count(10) + 3}"):
        load(path)


def test_equal_elements_are_read_once(tmp_path):
    path = written(tmp_path, COMPLETE)
    plain = load(path)
    path.write_text(COMPLETE.replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/>' * 2))
    assert load(path) == plain
    assert any("axis" in note for note in load(path).notes)
    assert "2 <axis>" in str(raised(tmp_path, COMPLETE.replace("<axis", '<axis xyz="0 1 0"/><axis')))


@pytest.mark.parametrize("read", [load, read_links])
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_lower_limit_above_the_upper_is_no_limit(read, kind, tmp_path):
    path = written(tmp_path, with_joint('<limit lower="2" upper="1" effort="3" velocity="4"/>', kind))
    model = read(path)
    assert (model.lower[0], model.upper[0]) == (-math.inf, math.inf)
    assert (model.joint("j").effort_limit, model.joint("j").velocity_limit) == (3, 4)
    assert any("'j'" in note and "limit" in note for note in model.notes)


def test_all_faults_come_at_once(tmp_path):
    text = (
        "<robot>"
        + links("a", "a", "b")
        + links("c", inertial=INERTIAL.replace('value="1"', 'value="-1"').replace('ixx="1"', 'ixx="nan"'))
        + joint("j", "a", "b", "")
        + joint("j", "b", "nowhere", '<axis xyz="0 0 0"/>' + LIMIT)
        + joint("k", "b", "c", LIMIT, "screw")
        + "</robot>"
    )
    error = raised(tmp_path, text)
    assert isinstance(error, ModelError)
    expected = ["no name", "'a': declared 2", "-1 kg", "'nan'", "needs <limit", "'j': declared 2"]
    expected += ["'nowhere'", "axis is zero", "'screw'"]
    for part in expected:
        assert sum(part in fault for fault in error.faults) == 1, (part, error.faults)
    assert str(error).count("\n  - ") == len(error.faults) == len(expected)


def test_nonphysical_links_come_in_one_error_and_load_with_a_warning(tmp_path):
    empty = '<link name="a"/><link name="empty"/>'
    error = raised(tmp_path, robot(impossible("heavy"), empty, joint("j", "a", "heavy"), joint("k", "heavy", "empty")))
    assert isinstance(error, ModelError)
    assert len(error.faults) == 2
    assert "'heavy'" in error.faults[0]
    assert "'empty'" in error.faults[1]
    with pytest.warns(NonPhysicalWarning, match="heavy.*empty"):
        model = load(tmp_path / "robot.urdf", nonphysical="warn")
    assert [n for n, _ in model.nonphysical] == ["heavy", "empty"]


def impossible(name: str) -> str:
    return links(name, inertial=INERTIAL.replace('izz="1"', 'izz="3"'))


def test_bodies_with_the_same_fault_are_one_line_with_one_way_out(tmp_path):
    names = [f"bad{i}" for i in range(13)]
    error = raised(tmp_path, robot(links("a"), *(impossible(n) + joint(f"j{n}", "a", n) for n in names)))
    assert len(error.faults) == 1
    assert all(repr(n) in str(error) for n in names)
    assert str(error).count("nonphysical") == 1


@pytest.mark.parametrize("base", ["a", "world"])
def test_a_fault_names_the_link_of_the_file(base, tmp_path):
    parts = links(base), '<link name="moving"/>', joint("j", base, "moving"), impossible("odd")
    error = raised(tmp_path, robot(*parts, joint("k", "moving", "odd", "", "fixed")))
    assert "link 'odd'" in str(error)
    assert "world_link" not in str(error)
    with pytest.warns(NonPhysicalWarning, match="link 'odd'"):
        model = load(tmp_path / "robot.urdf", nonphysical="warn")
    assert [name for name, _ in model.nonphysical] == ["moving"]
    # The base never moves: a note, which names it as the file does.
    path = written(tmp_path, robot(impossible(base), links("moving"), joint("j", base, "moving")))
    assert any(f"link {base!r}" in note and "never moves" in note for note in load(path).notes)


def test_a_negative_mass_is_an_error_whatever_is_asked(tmp_path):
    assert "negative" in str(raised(tmp_path, with_inertial(mass="-1"), nonphysical="warn"))
    light = links("c", inertial=INERTIAL.replace('value="1"', 'value="-.1"'))
    fused = robot(links("a", "b"), light, JOINT, joint("k", "b", "c", "", "fixed"))
    assert "link 'c': mass -0.1 kg is negative" in str(raised(tmp_path, fused, nonphysical="warn"))


def test_massless_links_between_joints_are_no_fault(tmp_path):
    across = joint("j", "a", "cross", '<axis xyz="0 1 0"/>' + LIMIT)
    path = written(
        tmp_path, robot('<link name="a"/><link name="cross"/>', links("b"), across, joint("k", "cross", "b"))
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load(path).body("cross").mass == 0


# MJCF.


def mjcf(inside: str, before: str = "", after: str = "") -> str:
    return f"<mujoco>{before}<worldbody>{inside}</worldbody>{after}</mujoco>"


BODY = '<body name="b"><joint name="j"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'


def jointed(attributes: str, before: str = "") -> str:
    return mjcf(BODY.replace('name="j"', f'name="j" {attributes}'), before)


def placed(attributes: str) -> str:
    return mjcf(BODY.replace('"b"', f'"b" {attributes}'))


def shaped(parts: str, before: str = "") -> str:
    return mjcf(f'<body name="b"><joint/>{parts}</body>', before)


MJCFS = {
    "no_bodies": (mjcf(""), ["no bodies"]),
    "no_joints": (mjcf('<body><geom size="1"/></body>'), ["no joints", "floating_base=True"]),
    "attach": (mjcf(f'{BODY}<attach model="m" body="b" prefix="p"/>'), ["model 'm' is no <model> of <asset>"]),
    "mesh_inertia": (
        shaped('<geom type="mesh" mesh="m"/>', '<asset><mesh name="m" file="m.stl"/></asset>'),
        ["body 'b'", "'m'", "m.stl"],
    ),
    "mesh_inertia_by_default": (
        shaped('<geom mesh="m" class="v"/>', '<default><default class="v"><geom type="mesh"/></default></default>'),
        ["body 'b'", "'m'", "no such <mesh>"],
    ),
    "unknown_class": (mjcf('<body childclass="k"><joint/></body>'), ["unknown default class 'k'; there are: main"]),
    "renamed_main": (
        mjcf(BODY, '<default class="k"><joint damping="1"/></default>'),
        ["<default>", "'main'", "line 1"],
    ),
    "same_names": (mjcf(BODY + BODY.replace('"b"', '"c"')), ["joint 'j': declared more than once"]),
    "called_world": (mjcf(BODY.replace('"b"', '"world"')), ["body 'world': that name is the ground's"]),
    "unknown_type": (jointed('type="screw"'), ["joint 'j': type 'screw'"]),
    "zero_axis": (jointed('axis="0 0 0"'), ["joint 'j': axis is zero"]),
    "two_orientations": (placed('quat="1 0 0 0" euler="1 2 3"'), ["quat and euler; keep one"]),
    "negative_mass": (mjcf(BODY.replace('mass="1"', 'mass="-1"')), ["body 'b': mass -1 kg is negative"]),
    "zero_size": (shaped('<geom size="0"/>'), ["body 'b': a sphere of size 0"]),
    "compiler": (shaped('<geom size="1" shellinertia="maybe"/>'), ["'b'", "MuJoCo's compiler"]),
    "flag": (mjcf(BODY, '<option><flag gravity="off"/></option>'), ["gravity", "'off'"]),
    "springdamper": (jointed('springdamper="1 0"'), ["joint 'j'", "springdamper"]),
    "world_attribute": (mjcf(BODY).replace("body>", 'body childclass="main">', 1), ["worldbody", "'childclass'"]),
    "triangle": (mjcf(BODY.replace("1 1 1", "1 1 3")), ["'b'", "A + B >= C", 'nonphysical="warn"']),
    "no_mass": (mjcf('<body name="b"><joint name="j"/></body>'), ["'b'", "no mass moves with joint 'j'"]),
    "free_below": (
        mjcf(BODY.replace("</body>", '<body name="c"><freejoint/><geom size="1"/></body></body>')),
        ["body 'c': a free joint below 'b'"],
    ),
    "curved_spring_on_ball": (jointed('type="ball" stiffness="1 2"'), ["joint 'j': stiffness that grows", "line 1"]),
    "nan": (
        mjcf(BODY.replace('pos="0 0 0"', 'pos="0 nan 0"')),
        ["body 'b': inertial pos: 'nan' is not a finite number"],
    ),
    "old_coordinates": (mjcf(BODY, '<compiler coordinate="global"/>'), ["compiler coordinate"]),
    "range_without_limited": (
        jointed('range="0 1"', '<compiler autolimits="false"/>'),
        ["joint 'j': range without limited"],
    ),
    "two_inertials": (
        mjcf(BODY.replace("</body>", '<inertial pos="0 0 0" mass="1"/></body>')),
        ["body 'b': 2 <inertial>"],
    ),
}


@pytest.mark.parametrize("case", MJCFS)
def test_mjcfs_with_a_fault(case, tmp_path, capfd):
    text, expected = MJCFS[case]
    error = raised(tmp_path, text, "robot.xml")
    assert isinstance(error, ModelError)
    for part in expected:
        assert part in str(error), str(error)
    assert capfd.readouterr() == ("", "")


# Hostile files.

SECRET = "the content of another file"
BOMB = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10 if i else "ha" * 10}">' for i in range(12))
HOSTILE = {
    "entity_bomb": f'<!DOCTYPE robot [{BOMB}]><robot name="&e11;"/>',
    "file_url": '<!DOCTYPE robot [<!ENTITY e SYSTEM "file://{secret}">]><robot name="r">&e;</robot>',
    "external_dtd": '<!DOCTYPE robot SYSTEM "http://127.0.0.1:1/robot.dtd"><robot name="r"/>',
    "after_a_declaration": '<?xml version="1.0" standalone="no"?>\n<!-- x -->\n<!DOCTYPE robot SYSTEM "file://{secret}"><robot/>',
}


@pytest.mark.parametrize("case", HOSTILE)
@pytest.mark.parametrize(("root", "encoding"), [("robot", "utf-8"), ("mujoco", "utf-16")])
def test_hostile_declarations_do_nothing(case, root, encoding, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text(SECRET)
    text = HOSTILE[case].replace("{secret}", str(secret)).replace("robot", root)
    before = os.stat(secret).st_atime_ns
    error = raised(tmp_path, text.encode(encoding))
    assert isinstance(error, LoadError)
    assert "document type declaration" in str(error)
    assert "remove it" in str(error)
    assert SECRET not in str(error)
    assert len(str(error)) < 1000
    assert os.stat(secret).st_atime_ns == before


def test_inclusions_of_other_kinds_are_inert(tmp_path):
    text = (
        '<?xml-stylesheet href="file:///etc/passwd"?><robot name="r" xmlns:xi="http://www.w3.org/2001/XInclude">'
        f'<xi:include href="file:///etc/passwd" parse="text"/>{LINK}{joint("j", "a", "b")}</robot>'
    )
    path = written(tmp_path, text)
    model = load(path)
    assert model.nv == 1
    assert any("1 xi:include" in n for n in model.notes)


# What is no file.


def test_what_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.urdf")
    with (tmp_path / "large.urdf").open("wb") as file:
        file.truncate(2**30)
    for source, expected in (
        (tmp_path / "pipe.urdf", "not a regular file"),
        (tmp_path, "a folder"),
        (tmp_path / "nowhere.urdf", "no such file"),
        ("a\0b.urdf", None),
        (Path("/dev/zero"), "expected a URDF or MJCF file"),
        (tmp_path / ("x" * 5000 + ".urdf"), None),
        (tmp_path / "large.urdf", "1073741824 bytes"),
    ):
        with pytest.raises(LoadError, match=expected):
            load(source)


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="the superuser may read everything")
def test_what_may_not_be_read(tmp_path):
    path = written(tmp_path, with_inertial())
    path.chmod(0)
    with pytest.raises(LoadError, match="cannot be read"):
        load(path)


# Whatever is changed in a file, loading it succeeds or raises an error of mbkit's.

URDF = Path(find("double_pendulum_simple").path).read_bytes()
MJCF = mjcf(
    BODY
    + '<body name="c" euler="1 2 3"><joint type="slide" axis="1 0 0" range="0 1"/><geom type="box" size="1 1 1"/></body>'
).encode()
WORDS = [b"", b" ", b"1 2", *b'0 -1 nan 1e308 -1e-320 < > " / &amp; a \x00 \xff'.split(b" ")]
EDITS = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 30), st.sampled_from(WORDS)), min_size=1, max_size=4)
VALUES = [b"", b"0 0 0", b"-1e29 1e29 1", *b"0 -1 nan 1e29 1e-320 world link1 fixed planar free mesh".split()]


def loaded_or_refused(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", NonPhysicalWarning)
        for policy in ("error", "warn"):
            for floating in (False, True):
                with contextlib.suppress(MbkitError):
                    load(path, nonphysical=policy, floating_base=floating)


@settings(max_examples=50, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(original=st.sampled_from([URDF, MJCF]), edits=EDITS)
def test_damaged_files_never_crash(tmp_path, original, edits):
    text = original
    for where, length, word in edits:
        start = int(where * len(text))
        text = text[:start] + word + text[start + length :]
    loaded_or_refused(written(tmp_path, text))


@settings(max_examples=50, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_values_never_crash(tmp_path, data):
    """As above, but the file stays XML, so that the checks behind the parser are reached."""
    original = data.draw(st.sampled_from([URDF, MJCF]))
    pieces = original.split(b'"')
    for _ in range(data.draw(st.integers(1, 4))):
        at = 2 * data.draw(st.integers(0, len(pieces) // 2 - 1)) + 1
        pieces[at] = data.draw(st.sampled_from([*VALUES, pieces[1], pieces[-2]]))
    loaded_or_refused(written(tmp_path, b'"'.join(pieces)))


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("~/no_such_file_here.urdf", str(Path.home() / "no_such_file_here.urdf")),
        (Path("scene.usda"), "this is OpenUSD"),
        ("arm.urdf.xacro", "no such file"),
        (" <robot name='x'/>", "the text given"),
        ("ur5_description", "did you mean 'ur_description/ur5_robot'"),
        ("panda_mj_description", "did you mean 'panda_description/panda'"),
    ],
)
def test_a_source_that_is_no_urdf_or_mjcf_is_named(source, words):
    with pytest.raises(MbkitError, match=re.escape(words)):
        load(source)


def test_a_folder_names_the_robots_near_its_top(tmp_path):
    (tmp_path / "below" / "deep").mkdir(parents=True)
    for name in ("a.urdf", "b.xml", "below/c.urdf", "below/deep/d.urdf"):
        (tmp_path / name).touch()
    with pytest.raises(LoadError, match=r"it holds a.urdf, b.xml, below.c.urdf$"):
        load(tmp_path)


def test_limits_of_files_stand_where_they_are_said_to(tmp_path: Path) -> None:
    """A tenth or ten times any of these limits fails here."""

    def refusal(call: Any, *arguments: Any) -> str:
        try:
            call(*arguments)
        except LoadError as error:
            return str(error)
        return ""

    def of_bytes(size: int) -> Path:
        with open(tmp_path / "big", "wb") as file:
            file.truncate(size)
        return tmp_path / "big"

    def parsed(text: bytes) -> str:
        return refusal(xml_reader.parse, text, "x")

    nested, many, late = (
        lambda n: b"<a>" * n + b"</a>" * n,
        lambda n: b"<r>" + b"<a/>" * (n - 1) + b"</r>",
        lambda n: b"<!--" + b"x" * (n - 7) + b'--><?xml version="1.0"?><r/>',
    )
    assert "nested more than 250 deep" in parsed(nested(251))
    assert not parsed(nested(250))
    assert "more than 500000 elements" in parsed(many(500_001))
    assert not parsed(many(500_000))
    assert "not well-formed" in parsed(late(4096))
    assert not parsed(late(4091))
    assert "bytes, got" in refusal(xml_reader.read, of_bytes(2**26 + 1))
    assert "bytes, got" not in refusal(xml_reader.read, of_bytes(2**26))
    assert "got 1000001 bytes" in refusal(read_loops, of_bytes(1_000_001))
    assert "not a TOML file" in refusal(read_loops, of_bytes(1_000_000))
    for attributes, faults in (({"name": "n" * 1000, "x": "9e29"}, 0), ({"name": "n" * 1001, "x": "1.1e30"}, 2)):
        read, element = xml_reader.Reader(), xml_reader.Element("a", attributes, 1)
        read.name(element, "name", "it")
        read.number(element, "x", "it")
        assert len(read.faults) == faults
    eps = 2.0**-52
    rounded = Snapper()(np.array([[1.0, 7 * eps], [9 * eps, 1.0]]))
    assert rounded[0, 1] == 0
    assert rounded[1, 0] == 9 * eps
