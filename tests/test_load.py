"""Loading: robots by name, URDF against Pinocchio's own model, MJCF against MuJoCo's compiler."""

# ruff: noqa: E501 -- a description is easier to read on one line
from __future__ import annotations

import importlib.metadata
import itertools
import os
import re
import subprocess
import sys
import textwrap
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

import mbkit as mb
from mbkit import spatial
from mbkit.errors import (
    InputError,
    KnownDefectWarning,
    LoadError,
    MbkitWarning,
    ModelError,
    NonPhysicalWarning,
    UnknownNameError,
)
from mbkit.load import load, robots, xml_reader
from mbkit.load.loader import _MAKERS, find
from mbkit.load.mjcf_attributes import rules as mjcf_rules
from mbkit.load.sanitized_text import strip
from mbkit.load.urdf_reader import Snapper, urdf_links
from mbkit.model import Mimic
from mbkit.model.validation import sample_mass_matrix
from mbkit.studies import compare
from tests.descriptions import INERTIAL, LIMIT, links, robot, urdf_joint, written
from tests.random_files import mujoco_terms, random_mjcf

EPS = np.finfo(float).eps
ROBOTS = {r.name: r for r in robots()}
# Files of example-robot-data that are no robot with joints, and why.
REFUSED = {
    "hector_description/quadrotor_base": "no joints",
    "iris_description/iris_simple": "all joints are fixed",
    "ur_description/ur3": "has no name",
}
SOUND = sorted(ROBOTS.keys() - REFUSED.keys())


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes its warnings into the working folder."""
    monkeypatch.chdir(tmp_path)


def quiet(source: object, **options: object):
    """Load; no robot is warned of for its sizes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NonPhysicalWarning)
        warnings.filterwarnings("error", "(?s).*digits", MbkitWarning)
        return load(source, **options)


def sample(model):
    """The state at which `sample_mass_matrix` is taken."""
    return model.random_state(np.random.default_rng(0))[0]


# An independent walk through the tree: where every body stands.


def placements(model, q):
    q = model.layout.expand_q(q)
    at = {"world": (np.eye(3), np.zeros(3))}
    for joint in model.tree:
        R_JC, p_JC = (
            np.array(x, dtype=float) for x in joint.type.placement(np, joint, q[model.layout.full_q[joint.name]])
        )
        R, p = at[joint.parent]
        R, p = R @ joint.rotation, p + R @ joint.translation
        at[joint.child] = R @ R_JC, p + R @ p_JC
    return at


def frame_placement(model, q, name):
    frame = model.frame(name)
    R, p = placements(model, q)[frame.body]
    return R @ frame.rotation, p + R @ frame.translation


def height_energy(model, q):
    at = placements(model, q)
    coms = {b.name: at[b.name][1] + at[b.name][0] @ b.com for b in model.bodies}
    return -sum(b.mass * model.gravity @ coms[b.name] for b in model.bodies)


# Pinocchio's own model of the same file, with its own coordinates.


def pinocchio_model(path, floating=False):
    text = Path(path).read_text()
    return pin.buildModelFromXML(text, pin.JointModelFreeFlyer()) if floating else pin.buildModelFromXML(text)


def pinocchio_q(raw, model, q):
    q = model.layout.expand_q(q)
    out = pin.neutral(raw)
    for joint in model.joints:
        if not joint.type.nv:
            continue
        theirs = raw.joints[raw.getJointId(joint.name)]
        x = q[model.layout.full_q[joint.name]]
        if joint.kind == "continuous":
            x = np.array([np.cos(x[0]), np.sin(x[0])])
        elif joint.kind == "planar":
            x = np.array([x[0], x[1], np.cos(x[2]), np.sin(x[2])])
        out[theirs.idx_q : theirs.idx_q + theirs.nq] = x
    return out


def pinocchio_mass_matrix(raw, model, q):
    """M in the model's velocities: a planar joint's are in the parent's axes here."""
    data = raw.createData()
    M = np.array(pin.crba(raw, data, pinocchio_q(raw, model, q)))
    M = np.triu(M) + np.triu(M, 1).T
    T = np.eye(raw.nv)
    full = model.layout.expand_q(q)
    for joint in model.joints:
        if joint.kind == "planar":
            v = raw.joints[raw.getJointId(joint.name)].idx_v
            theta = full[model.layout.full_q[joint.name]][2]
            T[v : v + 2, v : v + 2] = [[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]]
    return T.T @ M @ T


def assert_near(actual, expected, factor=200):
    scale = np.abs(expected).max()
    assert np.abs(actual - expected).max() <= factor * EPS * scale


# Names.


def test_every_urdf_of_the_package_has_a_record():
    listed = [f for f in importlib.metadata.files("example-robot-data") if f.suffix == ".urdf"]
    assert len(ROBOTS) == len(listed)
    assert len(SOUND) > 60
    assert all(r.path.is_file() for r in ROBOTS.values())
    names = [a for r in ROBOTS.values() for a in (r.name, *r.aliases)]
    assert len(names) == len(set(names))
    assert all(find(name).name == r.name for r in ROBOTS.values() for name in (r.name, *r.aliases))
    # Names that two files share are told apart by the folder.
    b, c = find("anymal_b").path, find("anymal_c").path
    assert b.name == c.name
    assert b != c
    assert find("anymal_c_simple_description/anymal").path == c


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("panda", "panda.urdf"),
        ("ur3", "ur3_robot.urdf"),
        ("ur5_limited", "ur5_joint_limited_robot.urdf"),
        ("talos", "talos_reduced.urdf"),
        ("b1_z1", "b1-z1.urdf"),
        ("panda/panda_collision", "panda_collision.urdf"),
    ],
)
def test_usual_names(name, file):
    assert find(name).path.name == file


@pytest.mark.parametrize(
    ("source", "options", "error", "words"),
    [
        ("pnada", {}, UnknownNameError, "unknown robot 'pnada'; did you mean 'panda'"),
        ("franka", {}, UnknownNameError, "unknown robot 'franka.*'; did you mean 'panda'. .a path"),
        ("PAL-Robotics", {}, UnknownNameError, "did you mean 'talos' or 'tiago'"),
        ("panda_description/pandas", {}, UnknownNameError, "panda_description/panda"),
        (Path("nowhere.urdf"), {}, LoadError, r"nowhere\.urdf: no such file"),
        ("panda", {"mimic": "keep"}, InputError, "mimic"),
        ("panda", {"nonphysical": "ignore"}, InputError, "nonphysical"),
        ("panda", {"gravity": (0, 0)}, ModelError, "gravity"),
        (3, {}, InputError, "source"),
    ],
)
def test_what_cannot_be_loaded_is_named(source, options, error, words):
    with pytest.raises(error, match=words):
        load(source, **options)


def test_suggested_names_of_makers_are_robots():
    for name in [x for names in _MAKERS.values() for x in names]:
        assert find(name)


def test_paths_may_be_texts_or_pathlike_of_any_suffix(tmp_path):
    text = Path(ROBOTS["double_pendulum_description/double_pendulum"].path).read_text()
    path = written(tmp_path, text, "pendulum.txt")
    assert load(path) == load(str(path)) == load("double_pendulum")


# All robots.


def test_records_tell_size_or_reason(capfd):
    assert {n: r.reason for n, r in ROBOTS.items() if r.reason}.keys() == REFUSED.keys()
    for name, why in REFUSED.items():
        assert why in ROBOTS[name].reason
        assert ROBOTS[name].nq is None
        assert ROBOTS[name].mass is None
    for name in SOUND:
        assert ROBOTS[name].nq >= ROBOTS[name].nv > 0
        assert ROBOTS[name].mass > 0
    told = capfd.readouterr()
    assert not told.out
    assert not told.err


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("name", SOUND)
def test_a_robot_is_pinocchios_and_its_numbers_are_the_files(name):
    path = ROBOTS[name].path
    raw, model = pinocchio_model(path), quiet(name, mimic="free")
    assert model.joint_names == tuple(raw.names)[1:]
    assert model.nq == model.nv == raw.nv
    q = sample(model)
    assert_near(sample_mass_matrix(model), pinocchio_mass_matrix(raw, model, q))
    other = model.random_state(np.random.default_rng(1))[0]
    data = raw.createData()
    theirs = [pin.computePotentialEnergy(raw, data, pinocchio_q(raw, model, x)) for x in (q, other)]
    mine = [height_energy(model, x) for x in (q, other)]
    assert mine[0] - mine[1] == pytest.approx(theirs[0] - theirs[1], abs=1e-12 * model.mass * 9.81)
    root = ET.parse(path).getroot()
    masses = [float(m.get("value")) for m in root.findall("link/inertial/mass")]
    assert model.mass == pytest.approx(sum(masses), rel=1e-14)
    tags = {j.get("name"): j for j in root.findall("joint")}
    assert set(model.joint_names) == {n for n, j in tags.items() if j.get("type") != "fixed"}
    for joint in model.joints:
        assert np.abs(joint.rotation @ joint.rotation.T - np.eye(3)).max() < 10 * EPS
    for joint in model.independent_joints:
        assert_joint_as_written(joint, tags[joint.name])


def assert_joint_as_written(joint, tag):
    def number(path, attribute, absent):
        element = tag.find(path)
        return absent if element is None else float(element.get(attribute, absent))

    assert joint.kind == tag.get("type")
    assert joint.child == tag.find("child").get("link")
    bounded = joint.kind != "continuous"
    assert joint.lower == (number("limit", "lower", 0) if bounded else -np.inf)
    assert joint.upper == (number("limit", "upper", 0) if bounded else np.inf)
    assert joint.effort_limit == number("limit", "effort", np.inf)
    assert joint.velocity_limit == number("limit", "velocity", np.inf)
    assert joint.damping == number("dynamics", "damping", 0)
    assert joint.friction == number("dynamics", "friction", 0)
    assert joint.armature == joint.stiffness == 0
    axis = np.array([1.0, 0, 0] if tag.find("axis") is None else tag.find("axis").get("xyz").split(), dtype=float)
    np.testing.assert_allclose(joint.axes[0], axis / np.linalg.norm(axis), rtol=0, atol=2 * EPS)


@pytest.mark.parametrize("name", ["panda", "ur5", "anymal_c", "tiago_no_hand", "romeo", "z1"])
def test_frames_stand_where_pinocchio_has_them(name):
    raw, model = pinocchio_model(find(name).path), quiet(name, mimic="free")
    q = sample(model)
    data = raw.createData()
    pin.framesForwardKinematics(raw, data, pinocchio_q(raw, model, q))
    links = [f.name for f in raw.frames if f.type == pin.BODY and f.name != "world"]
    fixed = [f.name for f in raw.frames if f.type == pin.FIXED_JOINT and f.name != "universe"]
    mine = {b.name for b in model.bodies} | {f.name for f in model.frames}
    assert mine == {*links, *fixed}
    for link in links:
        R, p = frame_placement(model, q, link)
        theirs = data.oMf[raw.getFrameId(link, pin.BODY)]
        np.testing.assert_allclose(R, theirs.rotation, rtol=0, atol=100 * EPS)
        np.testing.assert_allclose(p, theirs.translation, rtol=0, atol=100 * EPS)


@pytest.mark.parametrize("name", ["anymal_b", "talos", "solo12", "ur5", "hector", "iris_simple"])
def test_floating_base(name):
    path = find(name).path
    raw, model = pinocchio_model(path, floating=True), load(name, floating_base=True)
    assert model.joints[0].name == "root_joint"
    assert model.joints[0].kind == "free"
    assert (model.nq, model.nv) == (raw.nq, raw.nv)
    assert model.mass == pytest.approx(pin.computeTotalMass(raw))
    assert_near(sample_mass_matrix(model), pinocchio_mass_matrix(raw, model, sample(model)))
    assert not np.isfinite(model.lower[:7]).any()


def test_typical_files_load_without_a_word():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ("panda", "ur5", "tiago", "pr2", "talos", "talos_full", "anymal_c", "allegro_left_hand", "hyq"):
            load(find(name).path)


# Mimic joints.


def test_mimic_is_reduced_or_free_and_told():
    reduced, free = load("panda"), load("panda", mimic="free")
    assert (reduced.nv, free.nv) == (8, 9)
    assert reduced.joint("panda_finger_joint2").mimic == Mimic("panda_finger_joint1", 1.0, 0.0)
    assert free.joint("panda_finger_joint2").mimic is None
    assert any("reduced" in n and "panda_finger_joint2" in n for n in reduced.notes)
    assert any("independent" in n and "panda_finger_joint2" in n for n in free.notes)
    assert reduced.needs.mimic
    assert not free.needs.mimic


@pytest.mark.parametrize("name", ["panda", "baxter", "pr2", "talos_full", "tiago_pro"])
def test_reduced_mass_matrix_is_that_of_the_free_one(name):
    raw, model = pinocchio_model(find(name).path), load(name)
    assert model.nv < raw.nv
    G = model.layout.G
    assert_near(sample_mass_matrix(model), G.T @ pinocchio_mass_matrix(raw, model, sample(model)) @ G)


def test_mimic_values_and_chains(tmp_path):
    joints = (
        urdf_joint("a", "l0", "l1")
        + urdf_joint("b", "l1", "l2", LIMIT + '<mimic joint="a" multiplier="-2" offset="0.5"/>')
        + urdf_joint("c", "l2", "l3", LIMIT + '<mimic joint="b" offset="0.25"/>')
        + urdf_joint("d", "l3", "l4", LIMIT + '<mimic joint="a"/>')
    )
    model = load(written(tmp_path, robot(links("l0", "l1", "l2", "l3", "l4"), joints)))
    assert model.nv == 1
    np.testing.assert_array_equal(model.layout.expand_q(np.array([0.1])), [0.1, 0.3, 0.55, 0.1])


def test_mimic_tags_that_lead_nowhere(tmp_path):
    joints = urdf_joint("left", "l0", "l1") + urdf_joint("b", "l1", "l2", LIMIT + '<mimic joint="lift"/>')
    path = written(tmp_path, robot(links("l0", "l1", "l2"), joints))
    with pytest.raises(ModelError, match=r"joint 'b': mimics unknown joint 'lift', near 'left'.*mimic='free'"):
        load(path)
    assert load(path, mimic="free").nv == 2
    # Robots of example-robot-data have such tags; they load, and say so.
    hands = load("alex_psyonic_hands")
    assert hands.nv == 39
    assert any("unknown joint 'index_q1'" in n for n in hands.notes)
    assert any("mimic tags on fixed joints" in n for n in load("talos_arm").notes)


# Bodies.


def test_nonphysical_bodies_by_name_and_by_path():
    path = find("romeo_small").path
    with pytest.warns(NonPhysicalWarning, match="RShoulderYawLink"):
        by_name = load("romeo_small")
    with pytest.raises(ModelError, match=r"A \+ B >= C.*RShoulderYawLink") as caught:
        load(path)
    for told in ('nonphysical="warn"', str(path), "RElbowYawLink"):
        assert told in str(caught.value)
    with pytest.warns(NonPhysicalWarning):
        assert load(path, nonphysical="warn") == by_name
    with pytest.raises(ModelError):
        load("romeo_small", nonphysical="error")
    assert {n for n, _ in by_name.nonphysical} == {"RShoulderYawLink", "RElbowYawLink"}
    # A link that is healed by what is fixed to it is noted.
    healed = load("allegro_left_hand", nonphysical="error")
    assert any("link_15.0" in n and "A + B >= C" in n for n in healed.notes)


# Numbers of a three-link arm, each far from the others; what is printed of them is what double precision keeps.
def arm(mass=1.0, length=1.0, com=1.0, axis="0 0 1"):
    def link(name, m, c):
        moments = " ".join(f'{k}="{0.02 * m}"' for k in ("ixx", "iyy", "izz"))
        return (
            f'<link name="{name}"><inertial><origin xyz="{c} 0 0"/><mass value="{m}"/>'
            f'<inertia {moments} ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )

    def joint(name, parent, child, x, axis):
        return (
            f'<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{x} 0 0"/><axis xyz="{axis}"/></joint>'
        )

    return (
        f'<robot name="r">{link("a", 1, 0.1)}{link("b", 1, 0.1)}{link("c", mass, 0.1 * com)}'
        f"{joint('j', 'a', 'b', 1, '0 1 0')}{joint('k', 'b', 'c', length, axis)}</robot>"
    )


def swinging(kind: str, dynamics: str = "", moments: str | None = "1 1 1", com: float = 0.3) -> str:
    """Return a link of 2 kg whose centre stands off along x from a joint about or along z."""
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    numbers = " ".join(f'{n}="{x}"' for n, x in zip(names, f"{moments} 0 0 0".split(), strict=True)) if moments else ""
    inertia = f"<inertia {numbers}/>" if moments else ""
    link = links("b", inertial=f'<inertial><origin xyz="{com} 0 0"/><mass value="2"/>{inertia}</inertial>')
    inside = f'<axis xyz="0 0 1"/><limit lower="-9" upper="9" effort="1" velocity="1"/>{dynamics}'
    return robot(links("a"), link, urdf_joint("j", "a", "b", inside, kind))


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
def test_a_spring_in_the_dynamics_of_a_urdf_joint_acts(kind: str) -> None:
    model = mb.load(swinging(kind, '<dynamics spring_stiffness="3" spring_reference="0.2"/>'), gravity=(0, 0, 0))
    assert any("spring_stiffness 3 about 0.2" in note for note in model.notes)
    inertia = 2.0 if kind == "prismatic" else 1 + 2 * 0.3**2
    for engine in ("pinocchio", "lagrangian", "mujoco", "drake"):
        dyn = mb.dynamics(model, engine)
        assert dyn.passive([0.7], [0.0]) == pytest.approx([-3 * 0.5], rel=1e-14)
        assert dyn.forward_dynamics([0.7], [0.0], [0.0]) == pytest.approx([-3 * 0.5 / inertia], rel=1e-13)
    assert mb.dynamics(model).potential_energy([0.7]) == pytest.approx(3 * 0.5**2 / 2, rel=1e-14)
    # Link by link too, as importers and lint have it.
    linked = urdf_links(xml_reader.parse(swinging(kind, '<dynamics spring_stiffness="3"/>').encode(), ""), "")
    assert [*linked.joints[-1].stiffness] == [3.0]


def test_the_spring_of_a_fixed_joint_is_left_out_with_a_note() -> None:
    model = mb.load(swinging("fixed", '<dynamics spring_stiffness="3"/>'), floating_base=True)
    assert not model.needs.springs
    assert any("spring_stiffness 3" in note and "fixed joint leaves idle" in note for note in model.notes)


def test_mass_without_an_inertia_element_is_a_point() -> None:
    model = mb.load(swinging("revolute", "", None), nonphysical="warn", gravity=(0, 0, 0))
    assert any("read as point masses: b" in note for note in model.notes)
    for engine in ("pinocchio", "lagrangian", "mujoco", "drake"):
        assert mb.dynamics(model, engine).mass_matrix([0.4]) == pytest.approx(2 * 0.3**2, rel=1e-14)


def test_a_thin_rod_is_matter_in_files_and_by_hand() -> None:
    b = mb.ModelBuilder("rod", gravity=(0, 0, 0))
    b.add_body("b", mass=2.0, com=(0.3, 0, 0), inertia=(0.0, 0.2, 0.2))
    b.add_joint("j", "revolute", parent="world", child="b", axis=(0, 0, 1))
    inertial = '<inertial pos="0.3 0 0" mass="2" diaginertia="0 0.2 0.2"/>'
    mjcf = f'<mujoco><worldbody><body name="b">{inertial}<joint axis="0 0 1"/></body></worldbody></mujoco>'
    for model in (b.build(), mb.load(swinging("revolute", "", "0 0.2 0.2")), mb.load(mjcf)):
        assert not model.nonphysical
        for engine in ("pinocchio", "lagrangian", "mujoco", "drake"):
            assert mb.dynamics(model, engine).mass_matrix([0.4]) == pytest.approx(0.2 + 2 * 0.3**2, rel=1e-14)
    with pytest.raises(ModelError, match="no mass moves with joint 'j'"):
        mb.load(swinging("revolute", "", "0.2 0.2 0", com=0.0))


@pytest.mark.parametrize("numbers", [{"mass": 1e-14}, {"length": 1e8}, {"length": -1e6}])
def test_sizes_at_which_digits_vanish_come_with_a_warning(numbers, tmp_path):
    with pytest.warns(MbkitWarning, match="digits.*'k'"):
        model = load(written(tmp_path, arm(**numbers)))
    # What the warning says is so: engines that agree on the plain arm differ on this one.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KnownDefectWarning)
        assert not compare(model, ("pinocchio", "mujoco"), 4, 0, terms_only=True).passed


def test_numbers_keep_their_last_digit(tmp_path):
    inertial = (
        '<inertial><origin xyz="0.1000000000000000055 -3e-1 .7"/><mass value=" 1.0000000000000002 "/>'
        '<inertia ixx="0.30000000000000004" ixy="1e-3" ixz="0" iyy="0.3" iyz="-0" izz="+.4"/></inertial>'
    )
    joint = urdf_joint("j", "a", "b", '<origin xyz="  0.1\n0.2  0.30000000000000004"/>' + LIMIT)
    model = load(written(tmp_path, robot('<link name="a"/>', links("b", inertial=inertial), joint)))
    body = model.body("b")
    assert body.mass == 1.0000000000000002
    assert body.inertia[0, 0] == 0.30000000000000004
    assert body.inertia[0, 1] == 1e-3
    assert body.inertia[2, 2] == 0.4
    np.testing.assert_array_equal(body.com, [0.1, -0.3, 0.7])
    np.testing.assert_array_equal(model.joint("j").translation, [0.1, 0.2, 0.30000000000000004])


@pytest.mark.parametrize(
    ("placement", "parent"), [("", "base_link"), ('<origin xyz="1 2 3" rpy="0.3 0.4 0.5"/>', "world")]
)
def test_a_root_link_called_world_is_the_ground(tmp_path, placement, parent):
    joints = (
        urdf_joint("stand", "world", "base_link", placement, "fixed")
        + urdf_joint("look", "base_link", "eye", '<origin xyz="0 0 1"/>', "fixed")
        + urdf_joint("j", "base_link", "tip", '<origin xyz="0 1 0"/>' + LIMIT)
    )
    path = written(tmp_path, robot('<link name="world"/>', links("base_link", "tip"), '<link name="eye"/>', joints))
    model, raw = load(path), pinocchio_model(path)
    assert [b.name for b in model.bodies] == ["base_link", "tip"]
    assert model.joints[0].name == "stand"
    assert model.joint("j").parent == parent
    q = np.array([0.4])
    data = raw.createData()
    pin.framesForwardKinematics(raw, data, q)
    for name in ("base_link", "tip", "eye"):
        R, p = frame_placement(model, q, name)
        theirs = data.oMf[raw.getFrameId(name)]
        np.testing.assert_allclose(R, theirs.rotation, rtol=0, atol=10 * EPS)
        np.testing.assert_allclose(p, theirs.translation, rtol=0, atol=20 * EPS)
    floating = load(path, floating_base=True)
    assert floating.joint("root_joint").child == "world_link"
    assert any("world_link" in n for n in floating.notes)
    assert floating.mass == 2.0
    # The ground may carry a moving link alone.
    lone = load(written(tmp_path, robot('<link name="world"/>', links("tip"), urdf_joint("j", "world", "tip"))))
    assert [b.name for b in lone.bodies] == ["tip"]
    assert lone.joint("j").parent == "world"


def test_planar_and_floating_joints_of_a_urdf(tmp_path):
    inertial = (
        '<inertial><origin xyz=".1 .2 {0}"/><mass value="{0}"/>'
        '<inertia ixx="1" ixy=".1" ixz="0" iyy="1.2" iyz="0" izz="1.3"/></inertial>'
    )
    parts = [links(f"l{i}", inertial=inertial.format(i + 1)) for i in range(5)]
    place = '<origin xyz=".3 -.2 .1" rpy=".5 .6 .7"/>'
    joints = (
        urdf_joint("a", "l0", "l1", place + '<axis xyz="0 0 2"/>', "planar")
        + urdf_joint("b", "l1", "l2", place, "floating")
        + urdf_joint("c", "l2", "l3", place + '<axis xyz="1 2 -3"/>', "continuous")
        + urdf_joint("d", "l3", "l4", place + '<axis xyz="-1 0 1"/>' + LIMIT, "prismatic")
    )
    path = written(tmp_path, robot(*parts, joints))
    model, raw = load(path), pinocchio_model(path)
    assert [j.kind for j in model.joints] == ["fixed", "planar", "free", "continuous", "prismatic"]
    assert_near(sample_mass_matrix(model), pinocchio_mass_matrix(raw, model, sample(model)))


@pytest.mark.thorough('<axis xyz="0 1 0"/>', '<axis xyz="0 0 -2"/>', '<axis xyz="1 2 -3"/>')
@pytest.mark.parametrize("axis", ["", '<axis xyz="0 1 0"/>', '<axis xyz="0 0 -2"/>', '<axis xyz="1 2 -3"/>'])
def test_a_planar_joint_moves_across_its_normal_and_turns_about_it(axis, tmp_path):
    """URDF's default is x. The link moves as the specification says, whatever the coordinates along the plane."""
    inertial = (
        '<inertial><origin xyz=".1 .2 .3"/><mass value="2"/>'
        '<inertia ixx="1" ixy=".1" ixz="0" iyy="1.2" iyz="0" izz="1.3"/></inertial>'
    )
    place = '<origin xyz=".3 -.2 .1" rpy=".5 .6 .7"/>'
    joints = urdf_joint("slide", "base", "puck", place + axis, "planar")
    joints += urdf_joint("hinge", "puck", "arm", '<origin xyz="1 0 0"/><axis xyz="0 1 0"/>', "continuous")
    model = load(written(tmp_path, robot('<link name="base"/>', links("puck", "arm", inertial=inertial), joints)))
    n = np.array([float(x) for x in axis.split('"')[1].split()] if axis else (1.0, 0.0, 0.0))
    n /= np.linalg.norm(n)
    assert any("its normal" in note and "'puck_plane'" in note for note in model.notes)
    dyn = mb.dynamics(model)
    X0 = dyn.pose(model.neutral(), "puck")
    np.testing.assert_allclose(X0[:3, :3], spatial.matrix_from_rpy(0.5, 0.6, 0.7), atol=1e-15)
    q = np.array([0.4, -0.7, 0.9, 0.2])
    moved = np.linalg.inv(X0) @ dyn.pose(q, "puck")
    assert abs(n @ moved[:3, 3]) < 1e-15
    assert np.linalg.norm(moved[:3, 3]) == pytest.approx(np.hypot(0.4, 0.7), abs=1e-15)
    turn = spatial.matrix_from_quaternion(spatial.exp_quaternion(0.9 * n))
    np.testing.assert_allclose(moved[:3, :3], turn, atol=1e-15)
    # The matter moves with the links.
    com = [(dyn.pose(q, link) @ np.array([0.1, 0.2, 0.3, 1.0]))[:3] for link in ("puck", "arm")]
    np.testing.assert_allclose(dyn.center_of_mass(q), np.mean(com, axis=0), atol=1e-15)
    mb.testing.assert_engines_agree(model, ["pinocchio", "lagrangian"])


def test_welded_bodies_without_inertia_count_as_parts_of_their_carriers(tmp_path):
    """As MuJoCo has them, and as a URDF's fixed links are."""
    inner = '<body name="point" pos=".1 .2 .3" euler="10 20 30"><inertial pos=".1 0 0" mass="2" diaginertia="0 0 0"/>{}</body>'
    text = (
        '<mujoco><worldbody><body name="a"><joint name="j" axis="0 1 0" pos="0 0 .1"/><geom size=".1" pos=".3 0 0"/>'
        + inner.format('<body name="b" pos="0 .5 0"><joint name="k" axis="1 0 0"/><geom size=".1"/></body>')
        + '<body name="shell" pos="0 0 1"><geom size=".1"/></body></body></worldbody></mujoco>'
    )
    model = load(written(tmp_path, text, "r.xml"))
    assert any("'point in a'" in note for note in model.notes)
    assert model.body("point").mass == 0
    assert model.body("shell").mass > 0
    at, dyn = mujoco_terms(text, 3, 0), mb.dynamics(model)
    np.testing.assert_allclose(dyn.mass_matrix(at.q), at.M, rtol=1e-14)
    np.testing.assert_allclose(dyn.nle(at.q, at.v), at.nle, rtol=1e-13, atol=1e-13)
    assert model.mass == pytest.approx(mujoco.MjModel.from_xml_string(text).body_subtreemass[0], rel=1e-15)


# Rounded zeros.


def test_only_rounding_is_snapped(tmp_path):
    places = {"exact": "1.5707963267948966 0 3.141592653589793", "rounded": "1.5708 0 0", "digits": "1.57079632679 0 0"}
    joints = "".join(urdf_joint("to_" + n, "base", n, f'<origin rpy="{rpy}"/>' + LIMIT) for n, rpy in places.items())
    path = written(tmp_path, robot(links("base", *places), joints))
    model, raw = load(path), pinocchio_model(path)
    exact = model.joint("to_exact").rotation
    assert np.isin(exact, (0.0, 1.0, -1.0)).all()
    assert not np.signbit(exact[exact == 0]).any()
    for name, snapped, low, high in (("rounded", 1e-10, 3e-6, 4e-6), ("digits", 1e-14, 1e-12, 1e-11)):
        theirs = raw.jointPlacements[raw.getJointId("to_" + name)].rotation
        mine = model.joint("to_" + name).rotation
        kept = (np.abs(theirs) >= snapped) & (np.abs(theirs) < 0.5)
        np.testing.assert_array_equal(mine[kept], theirs[kept])
        assert np.any((np.abs(mine) > low) & (np.abs(mine) < high))
    (note,) = [n for n in model.notes if "entries" in n]
    assert "largest change" in note


def test_snapper_counts_and_keeps_unit_length():
    snap = Snapper()
    assert snap.note is None
    np.testing.assert_array_equal(snap(np.array([6e-17, -1 + 1e-16, 0])), [0, -1, 0])
    assert snap.count == 2
    assert snap.largest == pytest.approx(1.1e-16, rel=0.1)
    turn = spatial.matrix_from_rpy(4e-8, 0, 0)
    assert turn[1, 1] < 1
    np.testing.assert_array_equal(Snapper()(turn), turn)
    written = np.array([-1e-14, 1 - 1e-13, 3e-15])
    np.testing.assert_array_equal(Snapper()(written), written)


# Nothing outside the file.


def test_no_mesh_is_touched(tmp_path):
    """Opening a pipe that nobody writes to would wait for ever."""
    os.mkfifo(tmp_path / "mesh.stl")
    geometry = "".join(
        f'<{tag}><geometry><mesh filename="{uri}"/></geometry></{tag}>'
        for tag in ("visual", "collision")
        for uri in (
            f"file://{tmp_path}/mesh.stl",
            f"{tmp_path}/mesh.stl",
            "../../../../etc/passwd",
            "package://../mesh.stl",
        )
    )
    parts = links("a", inertial=geometry), links("b", inertial=geometry + INERTIAL), urdf_joint("j", "a", "b")
    urdf = written(tmp_path, robot(*parts))
    mjcf = written(
        tmp_path,
        f'<mujoco><asset><mesh name="m" file="{tmp_path}/mesh.stl"/><texture type="2d" file="../../mesh.stl"/></asset>'
        '<worldbody><geom type="mesh" mesh="m"/><body><joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>',
        "robot.xml",
    )
    code = textwrap.dedent(
        f"""
        import sys
        from mbkit.load import load
        opened = []
        load({str(urdf)!r}), load({str(mjcf)!r})
        sys.addaudithook(lambda event, args: opened.append(str(args[0])) if event == "open" else None)
        load({str(urdf)!r}), load({str(mjcf)!r})
        print(".stl" in "".join(opened), sum("robot" in o for o in opened))
        """
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False, env=environment
    )
    assert done.stdout.split() == ["False", "2"], done.stderr


# MJCF against MuJoCo's compiler.


def mujoco_state(compiled, model, q):
    out = np.array(compiled.qpos0)
    for joint in model.independent_joints:
        start = compiled.joint(joint.name).qposadr[0]
        x = q[model.layout.q[joint.name]]
        if joint.kind == "free":
            x = [*x[:3], x[6], *x[3:6]]
        elif joint.kind == "ball":
            x = [x[3], *x[:3]]
        out[start : start + len(x)] = x
    return out


def mujoco_data(compiled, model, q):
    data = mujoco.MjData(compiled)
    data.qpos[:] = mujoco_state(compiled, model, q)
    mujoco.mj_forward(compiled, data)
    return data


def mujoco_mass_matrix(compiled, model, q):
    """M in the model's velocities: a free joint's linear velocity is in world axes there."""
    M = np.zeros((compiled.nv, compiled.nv))
    mujoco.mj_fullM(compiled, mujoco_data(compiled, model, q), M)
    T = np.eye(compiled.nv)
    for joint in model.independent_joints:
        if joint.kind == "free":
            v = compiled.joint(joint.name).dofadr[0]
            quaternion = q[model.layout.q[joint.name]][3:]
            T[v : v + 3, v : v + 3] = spatial.matrix_from_quaternion(quaternion)
    return T.T @ M @ T


def check_against_mujoco(model, compiled):
    assert model.joint_names == tuple(compiled.joint(i).name for i in range(compiled.njnt))
    assert (model.nq, model.nv) == (compiled.nq, compiled.nv)
    assert model.mass == pytest.approx(compiled.body_mass.sum(), rel=1e-13)
    np.testing.assert_array_equal(model.gravity, compiled.opt.gravity)
    q = sample(model)
    # MuJoCo keeps principal moments, found to about 1e-12.
    assert_near(sample_mass_matrix(model), mujoco_mass_matrix(compiled, model, q), factor=1e5)
    for i in range(1, compiled.nbody):
        theirs, body = compiled.body(i), model.body(compiled.body(i).name)
        axes = spatial.matrix_from_quaternion(theirs.iquat[[1, 2, 3, 0]])
        anchor = compiled.jnt_pos[theirs.jntadr[0] + theirs.jntnum[0] - 1] if theirs.jntnum[0] else np.zeros(3)
        assert body.mass == pytest.approx(theirs.mass[0], rel=1e-12)
        if body.mass:
            np.testing.assert_allclose(
                body.com + anchor, theirs.ipos, rtol=0, atol=1e-12 * (1 + abs(theirs.ipos).max())
            )
        inertia = axes @ np.diag(theirs.inertia) @ axes.T
        np.testing.assert_allclose(body.inertia, inertia, rtol=0, atol=1e-11 * abs(inertia).max())
    data = mujoco_data(compiled, model, q)
    com = data.subtree_com[0]
    assert height_energy(model, q) == pytest.approx(-model.mass * model.gravity @ com, abs=1e-12 * model.mass)
    for i in range(1, compiled.nbody):
        R, p = frame_placement(model, q, compiled.body(i).name)
        np.testing.assert_allclose(p, data.xpos[i], rtol=0, atol=1e-13)
        np.testing.assert_allclose(R.ravel(), data.xmat[i], rtol=0, atol=1e-13)
    for i in range(compiled.nsite):
        R, p = frame_placement(model, q, compiled.site(i).name)
        np.testing.assert_allclose(p, data.site_xpos[i], rtol=0, atol=1e-13)
        np.testing.assert_allclose(R.ravel(), data.site_xmat[i], rtol=0, atol=1e-13)
    for i in range(compiled.njnt):
        theirs, joint = compiled.joint(i), model.joint(compiled.joint(i).name)
        dof = slice(theirs.dofadr[0], theirs.dofadr[0] + joint.type.nv)
        np.testing.assert_array_equal(joint.damping, compiled.dof_damping[dof])
        np.testing.assert_array_equal(joint.armature, compiled.dof_armature[dof])
        if joint.type.coordinate_velocities:
            np.testing.assert_array_equal(joint.friction, compiled.dof_frictionloss[dof])
        else:
            assert not joint.friction.any()
            lost = any("friction" in x and repr(joint.name) in x and "left out" in x for x in model.notes)
            assert lost == compiled.dof_frictionloss[dof].any()
        np.testing.assert_array_equal(joint.stiffness, np.full(joint.type.nv, theirs.stiffness[0]))
        if theirs.stiffness[0]:
            assert joint.rest == pytest.approx(compiled.qpos_spring[theirs.qposadr[0]], rel=1e-15)
        if joint.type.nq == 1:
            limits = theirs.range if theirs.limited[0] else (-np.inf, np.inf)
            np.testing.assert_allclose([joint.lower[0], joint.upper[0]], limits, rtol=1e-15)
            force = compiled.jnt_actfrcrange[i] if compiled.jnt_actfrclimited[i] else [np.inf]
            assert joint.effort_limit == np.abs(force).max()


INERTIA = '<inertial pos=".1 0 -.5" mass="2" diaginertia=".1 .2 .15"/>'
MJCF = {
    "hinge": f'<worldbody><body name="a" pos="0 0 1"><joint name="j" axis="0 1 0"/>{INERTIA}</body></worldbody>',
    "two_trees": f'<worldbody><body name="a"><joint name="j" pos="1 2 3"/>{INERTIA}</body>'
    f'<body name="b" pos="1 0 0"><joint name="k" type="slide" axis="1 1 0" range="-1 2"/>{INERTIA}</body></worldbody>',
    "full": '<worldbody><body name="a" quat="1 2 3 4"><joint name="j"/><inertial pos="1 2 3" mass="2" '
    'fullinertia="1 1.5 1.2 .1 -.2 .3"/><body name="b" pos="1 1 1"><inertial pos="0 0 0" mass="1" '
    'diaginertia="1 2 2.5" axisangle="1 1 0 40"/></body></body></worldbody>',
    "free": f'<worldbody><body name="a" pos="1 2 3" euler="10 20 30"><freejoint name="f"/>{INERTIA}'
    f'<body name="b" pos="0 0 1"><joint name="k" pos=".1 .2 .3" axis="1 2 3"/>{INERTIA}</body></body></worldbody>',
    "ball": f'<worldbody><body name="a" pos="1 2 3" zaxis="1 2 -3"><joint name="s" type="ball" pos=".3 .2 .1" damping="2"/>'
    f'{INERTIA}<body name="b" xyaxes="1 1 0 0 1 1"><joint name="k" type="slide" ref=".3" axis="0 0 -2"/>{INERTIA}</body>'
    "</body></worldbody>",
    "stack": f'<worldbody><body name="a"><joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" '
    f'axis="0 0 1" pos="1 1 1"/><joint name="z" pos=".2 .3 .4" ref="20"/><joint name="w" type="ball" pos="0 .1 .2"/>{INERTIA}'
    f'<body name="b" pos="0 .5 0"><joint name="k" axis="1 0 0" pos="0 0 .1"/>{INERTIA}</body></body></worldbody>',
    "details": '<compiler angle="radian"/><worldbody><body name="a"><joint name="j" axis="0 0 3" pos="0 .2 0" ref=".3" '
    'range="-1 2" springref=".2" stiffness="4" damping=".3" armature=".02" frictionloss=".1" actuatorfrcrange="-3 2"/>'
    f'{INERTIA}<site name="tip" pos="1 2 3" euler=".1 .2 .3"/></body></worldbody>',
    "degrees": f'<worldbody><body name="a"><joint name="j" ref="30" range="-90 60" springref="15" stiffness="4"/>{INERTIA}'
    f'<body name="b"><joint name="k" type="slide" range="-90 60" ref="1" springref="2" stiffness="3"/>{INERTIA}</body>'
    f'<body name="c"><joint name="l" range="-90 60" limited="false"/>{INERTIA}</body></body></worldbody>',
    "solids": '<worldbody><body name="a"><joint name="j"/><geom type="box" size=".1 .2 .3" pos="1 2 3" euler="10 20 30"/>'
    '<geom size=".2" density="300"/></body><body name="b"><joint name="k" axis="1 0 1"/><geom type="capsule" size=".1" '
    'fromto="0 0 0 1 1 1"/><geom type="cylinder" size=".1 .3" pos="0 1 0"/><geom type="ellipsoid" size=".1 .2 .3" mass="2"/>'
    '<geom type="box" size=".1" fromto="1 1 1 1 1 -2"/></body></worldbody>',
    "unseen_solids": '<worldbody><body name="a"><joint name="j"/><geom size=".1" pos="1 0 0" contype="0" conaffinity="0"/>'
    '<geom size=".1 .2" quat="1 1 0 0" type="capsule" mass="0"/><geom size=".3" group="4"/></body></worldbody>',
    "groups": '<compiler inertiagrouprange="1 2"/><worldbody><body name="a"><joint name="j"/><geom size=".1" pos="1 0 0" '
    'group="1"/><geom size=".3" group="3"/></body></worldbody>',
    "defaults": '<default><joint damping="1" axis="1 0 0"/><geom density="10" type="box" size=".1 .2 .3" euler="0 0 30"/>'
    '<default class="c"><joint armature=".1" type="slide"/><default class="d"><joint damping="0"/><geom quat="1 1 0 0"/>'
    '</default></default></default><worldbody><body name="a" childclass="c"><joint name="j"/><geom pos="1 0 0"/>'
    '<body name="b"><joint name="k" class="d"/><geom class="d"/><geom quat="1 0 0 1"/></body><body name="c" childclass="d">'
    '<joint name="l"/><geom/></body><body name="d"><joint name="m" class="main"/><geom mass="3"/></body></body></worldbody>',
    "frames": '<default><default class="c"><joint damping="3"/></default></default><worldbody><frame pos="1 0 0" '
    'euler="0 0 90"><frame childclass="c" axisangle="1 1 1 30"><body name="a" pos="0 1 0"><frame pos="0 0 2" euler="90 0 0">'
    f'<joint name="j" pos="1 0 0" axis="1 0 0"/>{INERTIA}<body name="b" pos="1 1 1"><joint name="k"/>{INERTIA}</body>'
    '<site name="s" pos="3 2 1"/></frame></body></frame></frame></worldbody>',
    "euler": f'<compiler eulerseq="xYz"/><worldbody><body name="a" euler="10 20 30"><joint name="j"/>{INERTIA}</body></worldbody>',
    "scaled": f'<compiler settotalmass="10"/><worldbody><body name="a"><joint name="j"/>{INERTIA}<body name="b" pos="0 1 0">'
    '<geom size=".1"/></body></body></worldbody>',
    "from_geom": f'<compiler inertiafromgeom="true"/><worldbody><body name="a"><joint name="j"/>{INERTIA}<geom size=".1"/>'
    f'<body name="b" pos="1 0 0">{INERTIA}</body></body></worldbody>',
    "bounds": f'<compiler boundmass="2.5" boundinertia=".14"/><worldbody><body name="a"><joint name="j"/>{INERTIA}<body '
    f'name="b" euler="10 20 30"><joint name="k"/>{INERTIA}<geom size=".3"/><frame pos="1 2 3" euler="0 40 0">'
    '<body name="c" pos="1 1 0" euler="0 0 9"/></frame></body></body></worldbody>',
    "balance": '<compiler balanceinertia="true" boundinertia=".15"/><worldbody><body name="a"><joint name="j"/><inertial '
    'pos="1 0 0" mass="1" diaginertia=".1 .2 .5"/><body name="b"><joint name="k"/><inertial pos="0 0 0" mass="1" fullinertia='
    '"1 .5 3 .1 .2 .3"/><body name="c" euler="10 20 30"><inertial pos="0 0 0" mass="1" euler="30 20 10" diaginertia="1 2 3"/>'
    "</body></body></body></worldbody>",
    "frame_class": '<default><default class="k"><geom density="3"/></default><default class="l"><geom density="5"/></default>'
    '</default><worldbody><frame class="k"><body name="a"><joint name="j"/><geom size=".1"/><frame class="k" childclass="l">'
    '<geom size=".2" pos="1 0 0"/></frame></body></frame></worldbody>',
    "inherited_ranges": '<default><joint limited="true" actuatorfrcrange="-2 1"/></default><worldbody>'
    f'<body name="a"><joint name="f" type="free"/>{INERTIA}<body name="b"><joint name="k" range="-30 60"/>{INERTIA}</body>'
    f'</body><body name="c"><joint name="s" type="ball" range="0 30"/>{INERTIA}</body></worldbody>',
    "no_autolimits": '<compiler autolimits="false"/><default><joint range="-30 60"/></default><worldbody><body name="a">'
    f'<joint name="f" type="free"/>{INERTIA}<body name="b"><joint name="k" range="0 0"/>{INERTIA}</body><body name="d">'
    f'<joint name="l" limited="true"/>{INERTIA}</body></body></worldbody>',
    "unordered_ranges": f'<worldbody><body name="a"><joint name="s" type="ball" limited="true"/>{INERTIA}<body name="b">'
    f'<joint name="k" range="2 1"/>{INERTIA}</body></body></worldbody>',
    "springdamper": '<compiler settotalmass="5"/><option><flag gravity="enable"/></option><worldbody><body name="a"><joint '
    f'name="j" springdamper=".5 .7" springref="10"/>{INERTIA}<body name="b" pos="1 0 0"><joint name="k" axis="0 1 0" '
    'armature=".1" stiffness="3" damping="2" springdamper="2 1"/><geom name="g" size=".1" pos="1 0 0"/><site name="s"/></body>'
    "</body></worldbody>",
    "shells": '<worldbody><body name="a"><joint name="j"/><geom type="box" size=".1 .2 .3" shellinertia="true"/></body>'
    '<body name="b"><joint name="k" axis="1 0 0"/><geom type="capsule" size=".1 .2" shellinertia="true" mass="2" pos="1 0 0"/>'
    "</body></worldbody>",
    "moon": f'<option gravity="0 .1 -1.62"/><worldbody><geom type="plane" size="1 1 1"/><body name="a"><joint name="j" '
    f'axis="1 0 0"/>{INERTIA}</body></worldbody>',
}


@pytest.mark.parametrize("name", MJCF)
def test_mjcf_is_what_mujoco_makes_of_it(name, tmp_path):
    text = f'<mujoco model="{name}">{MJCF[name]}</mujoco>'
    model = load(written(tmp_path, text, "robot.xml"))
    assert model.name == name
    # Free joints have no limits in MuJoCo, whatever they inherit.
    assert any("ball joint (1)" in note for note in model.notes) == (name in ("inherited_ranges", "unordered_ranges"))
    # What a setting or the compiler changed is said.
    for setting in ("boundmass", "boundinertia", "balanceinertia", "settotalmass", "springdamper"):
        assert any(setting in note for note in model.notes) == (f"{setting}=" in text)
    check_against_mujoco(model, mujoco.MjModel.from_xml_string(text))


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("seed", range(40))
def test_random_mjcf_trees(seed, tmp_path):
    root = ET.fromstring(random_mjcf(seed))
    for k, element in enumerate(root.iter()):
        if element.tag in ("body", "joint", "freejoint"):
            element.attrib.setdefault("name", f"{element.tag} {k}")
    for default in root.iter("default"):
        for joint in default.findall("joint"):
            del joint.attrib["name"]
    # What a flag switches off the model does without.
    for flag in root.findall("option/flag"):
        flag.attrib.clear()
    text = ET.tostring(root, encoding="unicode")
    check_against_mujoco(load(written(tmp_path, text, "robot.xml")), mujoco.MjModel.from_xml_string(text))


def test_geoms_without_mass_may_be_meshes(tmp_path):
    text = '<mujoco model="m"><worldbody><body><joint/><geom size=".1" pos="1 0 0"/>%s</body></worldbody></mujoco>'
    plain = load(written(tmp_path, text % "", "plain.xml"))
    for mesh in ('mesh="absent" mass="0"', 'mesh="absent" density="0"', 'mesh="absent" group="9"'):
        assert load(written(tmp_path, text % f'<geom type="mesh" {mesh}/>', "mesh.xml")) == plain


def test_springdamper_follows_from_all_that_is_in_the_mass_matrix(tmp_path):
    tendon = '<tendon><fixed name="t" armature=".2"><joint joint="k" coef="2"/></fixed></tendon>'
    text = f'<mujoco model="m">{MJCF["springdamper"]}{tendon}</mujoco>'
    model, compiled = load(written(tmp_path, text, "r.xml")), mujoco.MjModel.from_xml_string(text)
    for name in ("j", "k"):
        assert model.joint(name).stiffness[0] == pytest.approx(compiled.joint(name).stiffness[0], rel=1e-12)
        assert model.joint(name).damping[0] == pytest.approx(compiled.joint(name).damping[0], rel=1e-12)


def test_an_inertial_counts_where_no_geom_has_mass(tmp_path):
    """Which of <inertial> and geoms gives a body its mass, by every combination of rules."""
    inertials = ["", INERTIA, '<inertial pos="0 .1 0" mass="0"/>']
    geoms = [
        [],
        *([part] for part in ("mass='3'", "mass='0'", "density='0'", "group='4'", "mass='1e-14'", "mass='2e-14'")),
        *(["mass='3'", part] for part in ("mass='0'", "group='4'", "group='1'")),
        ["mass='0'", "group='4'"],
    ]
    bodies = ""
    for k, (inertial, parts) in enumerate(itertools.product(inertials, geoms)):
        shapes = "".join(f'<geom size=".1" pos="0 0 {i + 1}" {part}/>' for i, part in enumerate(parts))
        bodies += f'<body name="b{k}">{inertial}{shapes}</body>'
    for rule, groups in itertools.product(["true", "false", "auto"], ["0 5", "1 2", "4 5", "3 1"]):
        compiler = f'<compiler inertiafromgeom="{rule}" inertiagrouprange="{groups}"/>'
        moving = f'<body name="a"><joint name="j" axis="0 1 0"/>{INERTIA}{bodies}</body>'
        text = f"<mujoco>{compiler}<worldbody>{moving}</worldbody></mujoco>"
        check_against_mujoco(load(written(tmp_path, text, "r.xml")), mujoco.MjModel.from_xml_string(text))


# Meshes.

OBJ = "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
MESHED = (
    '<body name="a"><joint name="j" axis="1 1 0"/><geom type="mesh" mesh="part" density="50" pos="1 0 0" euler="0 20 0"/>'
    '<geom type="box" mesh="part" mass="2"/><geom type="mesh" mesh="seen" mass="0"/></body>'
    f'<body name="b"><joint name="k"/>{INERTIA}<geom type="mesh" mesh="seen"/></body>'
)


def meshed(folder, asset, compiler='meshdir="meshes"'):
    (folder / "meshes" / "more").mkdir(parents=True)
    for name in ("part", "seen", "more/part"):
        (folder / "meshes" / f"{name}.obj").write_text(OBJ)
    text = (
        f'<mujoco model="m"><compiler {compiler}/><asset>{asset}<mesh file="seen.obj"/></asset>'
        f"<worldbody>{MESHED}</worldbody></mujoco>"
    )
    return written(folder, text, "robot.xml")


@pytest.mark.parametrize("inertia", ["exact", "convex", "legacy", "shell"])
@pytest.mark.parametrize(
    ("asset", "compiler"),
    [
        ('<mesh file="part.obj" scale=".1 -.2 .3"/>', 'meshdir="meshes"'),
        ('<mesh name="part" file="more\\part.obj" refpos="1 2 3" refquat="1 2 3 4"/>', 'assetdir="meshes"'),
        ('<mesh file="none/part.obj"/>', 'meshdir="meshes" strippath="true" assetdir="none" fitaabb="true"'),
        ('<mesh name="part" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>', 'meshdir="meshes" discardvisual="true"'),
        ('<mesh name="part" builtin="sphere" params="2"/>', 'meshdir="meshes"'),
    ],
)
def test_inertia_of_meshes(tmp_path, inertia, asset, compiler):
    path = meshed(tmp_path, asset.replace("<mesh", f'<mesh inertia="{inertia}"'), compiler)
    model = load(path)
    check_against_mujoco(model, mujoco.MjModel.from_xml_path(str(path)))
    notes = " ".join(model.notes)
    assert "'a'" in notes
    assert ("part.obj" in notes) == ("file" in asset)
    assert "seen.obj" not in notes


@pytest.mark.parametrize(
    "settings",
    [
        ['assetdir="a"'],
        ['meshdir="" assetdir="a"'],
        ['meshdir="b" assetdir="a"'],
        ['meshdir="b"', 'assetdir="a"'],
        ['assetdir="a"', 'meshdir=""'],
        ['meshdir="b"', 'meshdir="" assetdir="a"'],
    ],
)
def test_mesh_folders_are_those_of_mujoco(tmp_path, settings):
    for folder, size in ((".", 1), ("a", 2), ("b", 3)):
        (tmp_path / folder).mkdir(exist_ok=True)
        scaled = "".join(
            f"v {x * size} {y * size} {z * size}\n" for x, y, z in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
        )
        (tmp_path / folder / "part.obj").write_text(scaled + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    text = (
        f'<mujoco model="m">{"".join(f"<compiler {s}/>" for s in settings)}<asset><mesh file="part.obj"/></asset>'
        '<worldbody><body name="a"><freejoint/><geom type="mesh" mesh="part"/></body></worldbody></mujoco>'
    )
    path = written(tmp_path, text, "robot.xml")
    expected = mujoco.MjModel.from_xml_path(str(path)).body_mass[1]
    assert load(path).mass == pytest.approx(expected, rel=1e-12)
    stripped = strip(path)
    assert mujoco.MjModel.from_xml_string(stripped.text, stripped.meshes).body_mass[1] == pytest.approx(
        expected, rel=1e-12
    )


def test_only_meshes_that_give_an_inertia_are_opened(tmp_path):
    path = meshed(tmp_path, '<mesh file="part.obj"/>')
    model = load(path)
    seen = tmp_path / "meshes" / "seen.obj"
    seen.unlink()
    # Opening a pipe that nobody writes to would wait for ever.
    os.mkfifo(seen)
    assert load(path) == model
    # The name of a mesh is that of a file, whose content may change.
    part = tmp_path / "meshes" / "part.obj"
    part.write_text(OBJ.replace("3", "4", 1))
    assert load(path) != model
    with pytest.raises(ModelError, match=r"'a'.*mesh"):
        load(path, meshes="never")
    for spoil in (lambda: part.write_text("v 0"), part.unlink, lambda: os.mkfifo(part)):
        spoil()
        with pytest.raises(ModelError, match="part"):
            load(path)
    with pytest.raises(InputError, match="meshes"):
        load(path, meshes="always")


# Names that MuJoCo does not know.

RICH = (
    '<mujoco model="m"><compiler angle="radian"/><option gravity="0 0 -9"><flag contact="disable"/></option>'
    '<default><joint damping=".1"/><geom density="900"/><default class="k"><joint armature=".1"/></default></default>'
    '<worldbody><frame pos="1 0 0"><body name="a" pos="0 0 1"><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>'
    '<joint name="j" class="k" stiffness="3"/><geom size=".1" mass="2"/><site name="s" pos="0 0 1"/></body></frame>'
    '<body name="b"><freejoint name="f"/><geom size=".1"/></body></worldbody>'
    '<tendon><fixed name="t"><joint joint="j" coef="2"/></fixed></tendon><actuator><motor joint="j" gear="3"/></actuator>'
    "</mujoco>"
)


def test_a_misspelt_name_is_never_lost(tmp_path):
    """Every element and attribute in turn has a name that MuJoCo's schema does not know."""
    load(written(tmp_path, RICH, "r.xml"))
    places = [(i, key) for i, e in enumerate(ET.fromstring(RICH).iter()) for key in (None, *e.attrib)]
    for i, key in places[1:]:
        tree = ET.fromstring(RICH)
        element = list(tree.iter())[i]
        right = key or element.tag
        wrong = [right.upper(), right[0] + right[2:], right + right[-1]][i % 3]
        if key is None:
            element.tag = wrong
        else:
            element.attrib = {wrong if k == key else k: v for k, v in element.attrib.items()}
        text = ET.tostring(tree, encoding="unicode")
        with pytest.raises(ModelError, match=re.escape(repr(wrong))):
            load(written(tmp_path, text, "r.xml"))
        # MuJoCo refuses it too, but for what stands in a <frame>, where it does not look.
        if "frame" not in text or element.tag not in ("frame", "body", "inertial", "joint", "geom", "site"):
            with pytest.raises(ValueError, match="XML Error"):
                mujoco.MjSpec.from_string(text)
    with pytest.raises(ModelError, match="did you mean 'damping'"):
        load(written(tmp_path, RICH.replace("stiffness", "dampnig"), "r.xml"))


def all_attributes(given):
    """An MJCF with one of each element that acts, and the attributes that are given."""

    def put(tag, **attributes):
        return f"<{tag} " + " ".join(f'{k}="{v}"' for k, v in (attributes | given.get(tag, {})).items())

    inner = (
        f'<body name="b" pos="1 0 0"><joint name="h" axis="0 1 0" stiffness="2" springref="30"/>'
        f"{put('inertial', pos='1 0 0', mass='2', diaginertia='1 1.2 1.5')}/>"
        '<geom size=".1" type="capsule" fromto="0 0 0 1 0 0"/><geom size=".1 .1 .2" type="box" euler="10 20 30"/>'
        f'<geom type="mesh" mesh="m"/>{put("site", name="s", size=".1")}/></body>'
    )
    return (
        f"<mujoco>{put('compiler')}/>{put('option')}>{put('flag')}/></option><default>"
        '<default class="k"><joint damping="5"/><geom density="7"/></default></default><asset>'
        f"{put('mesh', name='m', vertex='0 0 0 1 0 0 0 1 0 0 0 1')}/></asset><worldbody>{put('frame')}>"
        f"{put('body', name='a')}>{put('joint', name='j', axis='1 1 0')}/>"
        f"{put('geom', name='g', size='.1 .2 .3', type='box', pos='.1 .2 .3')}/>{inner}</body></frame></worldbody></mujoco>"
    )


def motion(compiled):
    """M, nle, passive forces and the site's place, at a state off the drawn one; only hinges and slides."""
    data = mujoco.MjData(compiled)
    rng = np.random.default_rng(0)
    data.qpos[:] = compiled.qpos0 + 0.3 * rng.random(compiled.nq)
    data.qvel[:] = rng.random(compiled.nv)
    mujoco.mj_forward(compiled, data)
    M = np.zeros((compiled.nv, compiled.nv))
    mujoco.mj_fullM(compiled, data, M)
    return data, np.concatenate([M.ravel(), data.qfrc_bias, data.qfrc_passive, data.site_xpos[0]])


VALUES = ".7|true|.1 1|.1 .2 .3|.1 .2 .3 .4|1 2 3 4 5 6|disable|radian|zyx|slide|m|k|1 5"


@pytest.mark.thorough
def test_no_attribute_changes_the_motion_in_silence(tmp_path):
    """What MuJoCo's motion feels is as in MuJoCo, refused, or noted, for every attribute of its schema."""
    plain = load(written(tmp_path, all_attributes({}), "r.xml"))
    _, before = motion(mujoco.MjModel.from_xml_string(all_attributes({})))
    body = mjcf_rules().children["worldbody"].children["body"]
    option = mjcf_rules().children["option"]
    rules = {tag: body.children[tag] for tag in ("joint", "geom", "inertial", "site", "frame")}
    rules |= {"body": body, "option": option, "flag": option.children["flag"]}
    rules |= {"compiler": mjcf_rules().children["compiler"], "mesh": mjcf_rules().children["asset"].children["mesh"]}
    names = {tag: sorted(rule.attributes) for tag, rule in rules.items()}
    # The schema does not show these.
    names["frame"] += ["massscale", "scale", "scaling"]
    felt = set()
    for tag, name in [(tag, name) for tag, all_of_it in names.items() for name in all_of_it]:
        for value in VALUES.split("|"):
            text = all_attributes({tag: {name: value}})
            try:
                data, after = motion(mujoco.MjModel.from_xml_string(text))
            except ValueError:
                continue
            if after.shape != before.shape or np.abs(after - before).max() > 1e-10:
                break
        else:
            continue
        felt.add((tag, name))
        try:
            model = load(written(tmp_path, text, "r.xml"))
        except ModelError:
            continue
        dyn = mb.dynamics(model, "pinocchio")
        q, v = data.qpos, data.qvel
        p = dyn.pose(q, model.frames[-1].name)[:3, 3]
        ours = np.concatenate([dyn.mass_matrix(q).ravel(), dyn.nle(q, v), dyn.passive(q, v), p])
        agrees = np.abs(ours - after).max() < 1e-9 * max(1, np.abs(after).max())
        assert agrees or set(model.notes) - set(plain.notes), (tag, name, value)
    assert len(felt) > 40


@pytest.mark.parametrize(("mass", "moments"), [("2", "1 1 3"), ("2", "0 0 0"), ("0", "0 0 2")])
def test_a_body_that_never_moves_may_have_any_inertia(tmp_path, mass, moments):
    def model(moments, joint=""):
        base = f'<inertial pos=".1 0 0" mass="{mass}" diaginertia="{moments}"/>'
        inner = f'<body name="b" euler="10 20 30">{base}<body name="c"><joint name="j" axis="1 0 0"/>{INERTIA}</body></body>'
        text = f'<mujoco model="m"><worldbody><body name="a">{joint}{base}{inner}</body></worldbody></mujoco>'
        return load(written(tmp_path, text, "r.xml"))

    odd = model(moments)
    (note,) = (note for note in odd.notes if "never move" in note)
    assert "'a'" in note
    assert "'b'" in note
    assert not odd.nonphysical
    for engine in ("pinocchio", "lagrangian", "mujoco", "drake"):
        if engine == "drake":
            pytest.importorskip("pydrake")
        ours, sound = (mb.dynamics(m, engine) for m in (odd, model("1 1 1") if mass != "0" else model("0 0 0")))
        np.testing.assert_array_equal(ours.mass_matrix([0.3]), sound.mass_matrix([0.3]))
        np.testing.assert_array_equal(ours.gravity([0.3]), sound.gravity([0.3]))
    if moments == "0 0 0":
        # Two points that are welded to each other are a thin rod.
        rod = model(moments, '<freejoint name="f"/>').body("a")
        assert rod.mass == 4
        assert np.linalg.eigvalsh(rod.inertia)[0] == pytest.approx(0.0, abs=1e-16)
    else:
        with pytest.raises(ModelError, match="'a'"):
            model(moments, '<freejoint name="f"/>')
    x, y, z = moments.split()
    inertia = f'<inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/>'
    base = links("a", inertial=f'<inertial><mass value="{mass}"/>{inertia}</inertial>')
    urdf = written(tmp_path, robot(base, links("b"), urdf_joint("j", "a", "b")))
    assert any("never moves" in note for note in load(urdf).notes)
    with pytest.raises(ModelError, match="'a'"):
        load(urdf, floating_base=True)


def test_mjcf_floating_base(tmp_path):
    body = f'<body name="a" pos="1 2 3">%s{INERTIA}<body name="b"><joint name="k"/>{INERTIA}</body></body>'
    model = load(written(tmp_path, f"<mujoco><worldbody>{body % ''}</worldbody></mujoco>", "r.xml"), floating_base=True)
    free = body % '<freejoint name="root_joint"/>'
    text = f"<mujoco><worldbody>{free}</worldbody></mujoco>"
    check_against_mujoco(model, mujoco.MjModel.from_xml_string(text))
    with pytest.raises(ModelError, match="floating_base=True needs one body of the world, without joints"):
        load(written(tmp_path, text, "r.xml"), floating_base=True)


def test_mjcf_says_what_it_left_out(tmp_path):
    text = (
        f'<mujoco><option density="1.2"/><worldbody><body><joint name="j"/><joint axis="1 0 0"/>{INERTIA}'
        f'<body><joint type="ball" range="0 90"/>{INERTIA}</body></body></worldbody>'
        '<actuator><motor joint="j"/></actuator><equality><joint joint1="j"/></equality>'
        '<tendon><fixed><joint joint="j" coef="1"/></fixed></tendon></mujoco>'
    )

    def notes(text):
        return " ".join(load(written(tmp_path, text, "r.xml")).notes)

    for expected in ("actuators", "equality", "tendons", "ball joint", "fluid", "generated"):
        assert expected in notes(text)
    for option, told in (('viscosity=".1" wind="1 0 0"', True), ('density="0" wind="1 0 0"', False)):
        assert ("fluid" in notes(RICH.replace("<option", f"<option {option}"))) == told
    # A name beside the motion that MuJoCo does not know.
    assert "'zneer'" in notes(RICH.replace("<compiler", '<visual><map zneer="1"/></visual><compiler'))


def test_mjcf_gravity_can_be_overruled(tmp_path):
    path = written(tmp_path, f"<mujoco>{MJCF['moon']}</mujoco>", "r.xml")
    np.testing.assert_array_equal(load(path, gravity=(0, 0, -1)).gravity, [0, 0, -1])
    flagged = MJCF["moon"].replace('.1 -1.62"/>', '.1 -1.62"><flag gravity="disable"/></option>')
    assert not load(written(tmp_path, f"<mujoco>{flagged}</mujoco>", "r.xml")).gravity.any()
    assert load("panda", gravity=(0, 0, 0)) == load("panda").without("gravity")


@pytest.mark.parametrize("flags", ['spring="disable"', 'damper="disable"', 'spring="disable" damper="disable"'])
def test_mjcf_flags_that_change_the_motion_are_honoured(tmp_path: Path, flags: str) -> None:
    text = f"""<mujoco><option><flag {flags}/></option><worldbody><body name="a"><joint name="j" axis="0 1 0"
    stiffness="7" damping="3"/><inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
    model, at = load(written(tmp_path, text, "flags.xml")), mujoco_terms(text, 1, 0)
    for engine in ("pinocchio", "lagrangian", "mujoco"):
        assert mb.dynamics(model, engine).passive(at.q, at.v) == pytest.approx(at.passive)


@pytest.mark.parametrize("mass", [5e-15, 5e-14])
def test_geoms_count_from_the_mass_from_which_mujoco_counts_them(mass: float, tmp_path: Path) -> None:
    text = f"""<mujoco><worldbody><body name="a"><joint name="j"/><geom size=".1" mass="1"/>
      <body name="b"><geom size=".1" mass="{mass}"/></body></body></worldbody></mujoco>"""
    (tmp_path / "a.xml").write_text(text)
    exact = mujoco.MjModel.from_xml_string(text).body("b").mass[0]
    assert mb.load(tmp_path / "a.xml", nonphysical="warn").body("b").mass == exact == (mass if mass > 1e-14 else 0)
