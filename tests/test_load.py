"""Loading: robots by name, URDF against Pinocchio's own model, MJCF against MuJoCo's compiler."""

# ruff: noqa: E501 -- a description is easier to read on one line
from __future__ import annotations

import importlib.metadata
import os
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
from mbkit.errors import InputError, LoadError, ModelError, NonPhysicalWarning, UnknownNameError
from mbkit.load import load, robots
from mbkit.load.names import find
from mbkit.load.snap import Snapper
from mbkit.load.solids import solid
from mbkit.model import Mimic
from mbkit.model.physical import sample_mass_matrix

EPS = np.finfo(float).eps
ROBOTS = {r.name: r for r in robots()}
# Files of example-robot-data that are no robot with joints, and why.
REFUSED = {
    "hector_description/quadrotor_base": "no joints",
    "iris_description/iris_simple": "all joints are fixed",
    "ur_description/ur3": "has no name",
}
SOUND = sorted(ROBOTS.keys() - REFUSED.keys())
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
LIMIT = '<limit lower="-1" upper="1" effort="2" velocity="3"/>'


def urdf_joint(name: str, parent: str, child: str, inside: str = LIMIT, kind: str = "revolute") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes its warnings into the working folder."""
    monkeypatch.chdir(tmp_path)


def write(folder: Path, text: str, name: str = "robot.urdf") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def quiet(source: object, **options: object):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NonPhysicalWarning)
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
    assert all(r.path.is_file() for r in ROBOTS.values())
    names = [a for r in ROBOTS.values() for a in (r.name, *r.aliases)]
    assert len(names) == len(set(names))
    assert all(find(name).name == r.name for r in ROBOTS.values() for name in (r.name, *r.aliases))


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("panda", "panda.urdf"),
        ("ur3", "ur3_robot.urdf"),
        ("ur5", "ur5_robot.urdf"),
        ("ur10", "ur10_robot.urdf"),
        ("ur5_limited", "ur5_joint_limited_robot.urdf"),
        ("talos", "talos_reduced.urdf"),
        ("talos_reduced", "talos_reduced.urdf"),
        ("talos_full", "talos_full_v2.urdf"),
        ("talos_arm", "talos_left_arm.urdf"),
        ("solo12", "solo12.urdf"),
        ("double_pendulum", "double_pendulum.urdf"),
        ("b1_z1", "b1-z1.urdf"),
        ("panda/panda_collision", "panda_collision.urdf"),
        ("talos/talos_full_v2", "talos_full_v2.urdf"),
    ],
)
def test_usual_names(name, file):
    assert find(name).path.name == file


def test_names_that_two_files_share_are_told_apart_by_folder():
    b, c = find("anymal_b").path, find("anymal_c").path
    assert b.name == c.name
    assert b != c
    assert find("anymal_c_simple_description/anymal").path == c


def test_unknown_name_suggests_near_ones():
    with pytest.raises(UnknownNameError, match=r"unknown robot 'pnada'; did you mean 'panda'"):
        load("pnada")
    with pytest.raises(UnknownNameError, match="panda_description/panda"):
        load("panda_description/pandas")


def test_missing_files_are_named(tmp_path):
    with pytest.raises(LoadError, match=r"nowhere\.urdf: no such file"):
        load(tmp_path / "nowhere.urdf")
    with pytest.raises(LoadError, match=r"nowhere\.xml: no such file"):
        load("nowhere.xml")


def test_paths_may_be_texts_or_pathlike_of_any_suffix(tmp_path):
    text = Path(ROBOTS["double_pendulum_description/double_pendulum"].path).read_text()
    path = write(tmp_path, text, "pendulum.txt")
    assert load(path) == load(str(path)) == load("double_pendulum")


def test_options_are_checked():
    with pytest.raises(InputError, match="mimic"):
        load("panda", mimic="keep")
    with pytest.raises(InputError, match="nonphysical"):
        load("panda", nonphysical="ignore")
    with pytest.raises(InputError, match="source"):
        load(3)
    with pytest.raises(InputError, match="source"):
        load("")
    with pytest.raises(ModelError, match="gravity"):
        load("panda", gravity=(0, 0))


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


@pytest.mark.parametrize("name", SOUND)
def test_mass_matrix_and_energy_are_pinocchios(name):
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


@pytest.mark.parametrize("name", SOUND)
def test_numbers_are_the_files(name):
    root = ET.parse(ROBOTS[name].path).getroot()
    model = quiet(name, mimic="free")
    masses = [float(m.get("value")) for m in root.findall("link/inertial/mass")]
    assert model.mass == pytest.approx(sum(masses), rel=1e-14)
    tags = {j.get("name"): j for j in root.findall("joint")}
    assert set(model.joint_names) == {n for n, j in tags.items() if j.get("type") != "fixed"}
    for joint in model.independent_joints:
        tag = tags[joint.name]

        def number(path, attribute, absent, tag=tag):
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
        assert joint.armature == 0
        assert joint.stiffness == 0
        axis = (
            np.array([float(x) for x in tag.find("axis").get("xyz").split()])
            if tag.find("axis") is not None
            else [1, 0, 0]
        )
        np.testing.assert_allclose(joint.axes[0], np.array(axis) / np.linalg.norm(axis), rtol=0, atol=2 * EPS)


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
    links = "".join(f'<link name="l{i}">{INERTIAL}</link>' for i in range(5))
    joints = (
        urdf_joint("a", "l0", "l1")
        + urdf_joint("b", "l1", "l2", LIMIT + '<mimic joint="a" multiplier="-2" offset="0.5"/>')
        + urdf_joint("c", "l2", "l3", LIMIT + '<mimic joint="b" offset="0.25"/>')
        + urdf_joint("d", "l3", "l4", LIMIT + '<mimic joint="a"/>')
    )
    model = load(write(tmp_path, f'<robot name="r">{links}{joints}</robot>'))
    assert model.nv == 1
    np.testing.assert_array_equal(model.layout.expand_q(np.array([0.1])), [0.1, 0.3, 0.55, 0.1])


def test_mimic_tags_that_lead_nowhere(tmp_path):
    links = "".join(f'<link name="l{i}">{INERTIAL}</link>' for i in range(3))
    joints = urdf_joint("left", "l0", "l1") + urdf_joint("b", "l1", "l2", LIMIT + '<mimic joint="lift"/>')
    path = write(tmp_path, f'<robot name="r">{links}{joints}</robot>')
    with pytest.raises(ModelError, match=r"joint 'b': mimics unknown joint 'lift', near 'left'.*mimic='free'"):
        load(path)
    assert load(path, mimic="free").nv == 2
    # A robot of example-robot-data has such tags; it loads, and says so.
    robot = load("alex_psyonic_hands")
    assert robot.nv == 39
    assert any("unknown joint 'index_q1'" in n for n in robot.notes)


def test_mimic_tags_on_fixed_joints_are_noted():
    assert any("mimic tags on fixed joints" in n for n in load("talos_arm").notes)


# Bodies.


def test_nonphysical_bodies_by_name_and_by_path():
    path = find("romeo_small").path
    with pytest.warns(NonPhysicalWarning, match="RShoulderYawLink"):
        by_name = load("romeo_small")
    with pytest.raises(ModelError, match=r"RShoulderYawLink.*A \+ B >= C") as caught:
        load(path)
    assert 'nonphysical="warn"' in str(caught.value)
    assert str(path) in str(caught.value)
    assert len(caught.value.faults) == 2
    with pytest.warns(NonPhysicalWarning):
        assert load(path, nonphysical="warn") == by_name
    with pytest.raises(ModelError):
        load("romeo_small", nonphysical="error")
    assert {n for n, _ in by_name.nonphysical} == {"RShoulderYawLink", "RElbowYawLink"}


def test_links_healed_by_what_is_fixed_to_them_are_noted():
    model = load("allegro_left_hand", nonphysical="error")
    assert any("link_15.0" in n and "A + B >= C" in n for n in model.notes)


def test_numbers_keep_their_last_digit(tmp_path):
    inertial = (
        '<inertial><origin xyz="0.1000000000000000055 -3e-1 .7"/><mass value=" 1.0000000000000002 "/>'
        '<inertia ixx="0.30000000000000004" ixy="1e-3" ixz="0" iyy="0.3" iyz="-0" izz="+.4"/></inertial>'
    )
    joint = urdf_joint("j", "a", "b", '<origin xyz="  0.1\n0.2  0.30000000000000004"/>' + LIMIT)
    model = load(write(tmp_path, f'<robot name="r"><link name="a"/><link name="b">{inertial}</link>{joint}</robot>'))
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
    links = f'<link name="base_link">{INERTIAL}</link><link name="tip">{INERTIAL}</link><link name="eye"/>'
    text = f'<robot name="r"><link name="world"/>{links}{joints}</robot>'
    path = write(tmp_path, text)
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


def test_a_lone_link_called_world(tmp_path):
    joint = urdf_joint("j", "world", "tip")
    text = f'<robot name="r"><link name="world"/><link name="tip">{INERTIAL}</link>{joint}</robot>'
    model = load(write(tmp_path, text))
    assert [b.name for b in model.bodies] == ["tip"]
    assert model.joint("j").parent == "world"


def test_planar_and_floating_joints_of_a_urdf(tmp_path):
    links = "".join(
        f'<link name="l{i}"><inertial><origin xyz=".1 .2 {i}"/><mass value="{i + 1}"/>'
        '<inertia ixx="1" ixy=".1" ixz="0" iyy="1.2" iyz="0" izz="1.3"/></inertial></link>'
        for i in range(5)
    )
    place = '<origin xyz=".3 -.2 .1" rpy=".5 .6 .7"/>'
    joints = (
        urdf_joint("a", "l0", "l1", place + '<axis xyz="0 0 2"/>', "planar")
        + urdf_joint("b", "l1", "l2", place, "floating")
        + urdf_joint("c", "l2", "l3", place + '<axis xyz="1 2 -3"/>', "continuous")
        + urdf_joint("d", "l3", "l4", place + '<axis xyz="-1 0 1"/>' + LIMIT, "prismatic")
    )
    path = write(tmp_path, f'<robot name="r">{links}{joints}</robot>')
    model, raw = load(path), pinocchio_model(path)
    assert [j.kind for j in model.joints] == ["fixed", "planar", "free", "continuous", "prismatic"]
    assert_near(sample_mass_matrix(model), pinocchio_mass_matrix(raw, model, sample(model)))


# Rounded zeros.


def test_only_rounding_is_snapped(tmp_path):
    places = {"exact": "1.5707963267948966 0 3.141592653589793", "rounded": "1.5708 0 0", "digits": "1.57079632679 0 0"}
    links = "".join(f'<link name="{n}">{INERTIAL}</link>' for n in ("base", *places))
    joints = "".join(urdf_joint("to_" + n, "base", n, f'<origin rpy="{rpy}"/>' + LIMIT) for n, rpy in places.items())
    path = write(tmp_path, f'<robot name="r">{links}{joints}</robot>')
    model, raw = load(path), pinocchio_model(path)
    exact = model.joint("to_exact").rotation
    assert np.isin(exact, (0.0, 1.0, -1.0)).all()
    assert not np.signbit(exact[exact == 0]).any()
    for name in ("rounded", "digits"):
        theirs = raw.jointPlacements[raw.getJointId("to_" + name)].rotation
        mine = model.joint("to_" + name).rotation
        tiny = (np.abs(theirs) < 1e-10) if name == "rounded" else (np.abs(theirs) < 1e-14)
        np.testing.assert_array_equal(mine[~tiny & (np.abs(theirs) < 0.5)], theirs[~tiny & (np.abs(theirs) < 0.5)])
    assert np.any(
        (np.abs(model.joint("to_rounded").rotation) > 3e-6) & (np.abs(model.joint("to_rounded").rotation) < 4e-6)
    )
    assert np.any(
        (np.abs(model.joint("to_digits").rotation) > 1e-12) & (np.abs(model.joint("to_digits").rotation) < 1e-11)
    )
    (note,) = [n for n in model.notes if "entries" in n]
    assert "largest change" in note


@pytest.mark.parametrize("name", ["panda", "romeo_laas_small", "tiago_dual", "go1"])
def test_snapped_rotations_are_rotations(name):
    for joint in quiet(name).joints:
        assert np.abs(joint.rotation @ joint.rotation.T - np.eye(3)).max() < 10 * EPS


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
    urdf = write(
        tmp_path,
        f'<robot name="r"><link name="a">{geometry}</link><link name="b">{geometry}{INERTIAL}</link>'
        f"{urdf_joint('j', 'a', 'b')}</robot>",
    )
    mjcf = write(
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
        load({str(urdf)!r})
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
        np.testing.assert_array_equal(joint.friction, compiled.dof_frictionloss[dof])
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
    "moon": f'<option gravity="0 .1 -1.62"/><worldbody><geom type="plane" size="1 1 1"/><body name="a"><joint name="j" '
    f'axis="1 0 0"/>{INERTIA}</body></worldbody>',
}


@pytest.mark.parametrize("name", MJCF)
def test_mjcf_is_what_mujoco_makes_of_it(name, tmp_path):
    text = f'<mujoco model="{name}">{MJCF[name]}</mujoco>'
    model = load(write(tmp_path, text, "robot.xml"))
    assert model.name == name
    check_against_mujoco(model, mujoco.MjModel.from_xml_string(text))


def random_mjcf(rng):
    """A random tree with every joint type, orientation and solid."""

    def numbers(n, scale=1.0):
        return " ".join(repr(float(x)) for x in scale * rng.normal(size=n))

    def placed():
        kind = rng.choice(["quat", "axisangle", "euler", "zaxis", "xyaxes", ""])
        sizes = {"quat": 4, "axisangle": 4, "euler": 3, "zaxis": 3, "xyaxes": 6}
        return f'pos="{numbers(3)}"' + (f' {kind}="{numbers(sizes[kind])}"' if kind else "")

    def matter():
        if rng.random() < 0.5:
            a, b, c = rng.uniform(0.5, 1, 3).tolist()
            return f'<inertial {placed()} mass="{float(rng.uniform(0.1, 3))!r}" diaginertia="{a + b!r} {b + c!r} {c + a!r}"/>'
        out = ""
        for _ in range(rng.integers(1, 3)):
            shape = rng.choice(["sphere", "capsule", "cylinder", "ellipsoid", "box"])
            sizes = " ".join(repr(float(x)) for x in rng.uniform(0.1, 0.5, 3))
            long = shape in ("capsule", "cylinder") and rng.random() < 0.5
            where = f'fromto="{numbers(6)}"' if long else placed()
            out += f'<geom type="{shape}" size="{sizes}" {where} density="{float(rng.uniform(10, 500))!r}"/>'
        return out

    count = 0

    def body(depth):
        nonlocal count
        count += 1
        name = f"b{count}"
        if depth == 0 and rng.random() < 0.3:
            joints = f'<freejoint name="{name}f"/>'
        else:
            kinds = list(rng.choice(["hinge", "slide"], rng.integers(0, 3)))
            if rng.random() < 0.2:
                kinds.append("ball")
            kinds = kinds if depth or kinds else ["hinge"]
            joints = "".join(
                f'<joint name="{name}{i}" type="{k}" pos="{numbers(3)}" '
                + (
                    f'axis="{numbers(3)}" ref="{float(rng.normal())!r}" armature="{float(rng.uniform(0, 0.1))!r}"'
                    if k != "ball"
                    else ""
                )
                + "/>"
                for i, k in enumerate(kinds)
            )
        children = "".join(body(depth + 1) for _ in range(rng.integers(0, 3))) if depth < 3 else ""
        return f'<body name="{name}" {placed()}>{joints}{matter()}{children}</body>'

    angle = rng.choice(["degree", "radian"])
    sequence = "".join(rng.choice(list("xyzXYZ"), 3))
    trees = "".join(body(0) for _ in range(rng.integers(1, 3)))
    return f'<mujoco><compiler angle="{angle}" eulerseq="{sequence}"/><worldbody>{trees}</worldbody></mujoco>'


@pytest.mark.parametrize("seed", range(40))
def test_random_mjcf_trees(seed, tmp_path):
    text = random_mjcf(np.random.default_rng(seed))
    check_against_mujoco(load(write(tmp_path, text, "robot.xml")), mujoco.MjModel.from_xml_string(text))


def test_geoms_without_mass_may_be_meshes(tmp_path):
    text = '<mujoco model="m"><worldbody><body><joint/><geom size=".1" pos="1 0 0"/>%s</body></worldbody></mujoco>'
    plain = load(write(tmp_path, text % "", "plain.xml"))
    for mesh in ('mesh="absent" mass="0"', 'mesh="absent" density="0"', 'mesh="absent" group="9"'):
        assert load(write(tmp_path, text % f'<geom type="mesh" {mesh}/>', "mesh.xml")) == plain


def test_mjcf_floating_base(tmp_path):
    body = f'<body name="a" pos="1 2 3">%s{INERTIA}<body name="b"><joint name="k"/>{INERTIA}</body></body>'
    model = load(write(tmp_path, f"<mujoco><worldbody>{body % ''}</worldbody></mujoco>", "r.xml"), floating_base=True)
    free = body % '<freejoint name="root_joint"/>'
    text = f"<mujoco><worldbody>{free}</worldbody></mujoco>"
    check_against_mujoco(model, mujoco.MjModel.from_xml_string(text))
    with pytest.raises(ModelError, match="floating_base=True needs one body of the world, without joints"):
        load(write(tmp_path, text, "r.xml"), floating_base=True)


def test_mjcf_says_what_it_left_out(tmp_path):
    text = (
        f'<mujoco><option density="1.2"/><worldbody><body gravcomp="1"><joint name="j"/><joint axis="1 0 0"/>{INERTIA}'
        f'<body><joint type="ball" range="0 90"/>{INERTIA}</body></body></worldbody>'
        '<actuator><motor joint="j"/></actuator><equality><joint joint1="j"/></equality>'
        '<tendon><fixed><joint joint="j" coef="1"/></fixed></tendon></mujoco>'
    )
    notes = "\n".join(load(write(tmp_path, text, "r.xml")).notes)
    for expected in ("actuators", "equality", "tendons", "gravity compensation", "ball joint", "fluid", "made up"):
        assert expected in notes


def test_mjcf_gravity_can_be_overruled(tmp_path):
    path = write(tmp_path, f"<mujoco>{MJCF['moon']}</mujoco>", "r.xml")
    np.testing.assert_array_equal(load(path, gravity=(0, 0, -1)).gravity, [0, 0, -1])
    flagged = MJCF["moon"].replace('.1 -1.62"/>', '.1 -1.62"><flag gravity="disable"/></option>')
    assert not load(write(tmp_path, f"<mujoco>{flagged}</mujoco>", "r.xml")).gravity.any()
    assert load("panda", gravity=(0, 0, 0)) == load("panda").without("gravity")


@pytest.mark.parametrize(
    ("shape", "size", "inside"),
    [
        ("box", (0.1, 0.2, 0.3), lambda x: np.all(np.abs(x) < (0.1, 0.2, 0.3), axis=-1)),
        ("ellipsoid", (0.1, 0.2, 0.3), lambda x: np.sum((x / (0.1, 0.2, 0.3)) ** 2, axis=-1) < 1),
        ("sphere", (0.3,), lambda x: np.sum(x**2, axis=-1) < 0.09),
        ("cylinder", (0.1, 0.3), lambda x: (np.hypot(x[:, 0], x[:, 1]) < 0.1) & (np.abs(x[:, 2]) < 0.3)),
        (
            "capsule",
            (0.1, 0.2),
            lambda x: np.hypot(np.hypot(x[:, 0], x[:, 1]), np.maximum(np.abs(x[:, 2]) - 0.2, 0)) < 0.1,
        ),
    ],
)
def test_solids_against_counting_points(shape, size, inside):
    edge = (np.arange(120) + 0.5) / 120 * 0.6 - 0.3
    points = np.stack(np.meshgrid(edge, edge, edge), axis=-1).reshape(-1, 3)
    matter = points[inside(points)]
    mass = len(matter) * (0.6 / 120) ** 3
    inertia = np.sum(matter**2) * np.eye(3) - matter.T @ matter
    lump = solid(shape, size)
    assert lump.mass == pytest.approx(mass, rel=0.02)
    np.testing.assert_allclose(np.diag(lump.inertia), np.diag(inertia) * (0.6 / 120) ** 3, rtol=0.03)


@pytest.mark.parametrize("flags", ['spring="disable"', 'damper="disable"', 'spring="disable" damper="disable"'])
def test_mjcf_flags_that_change_the_motion_are_honoured(tmp_path: Path, flags: str) -> None:
    text = f"""<mujoco><option><flag {flags}/></option><worldbody><body name="a"><joint name="j" axis="0 1 0"
    stiffness="7" damping="3"/><inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
    path = tmp_path / "flags.xml"
    path.write_text(text)
    model = mb.load(path)
    theirs = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(theirs)
    data.qpos[:], data.qvel[:] = 0.3, 0.7
    mujoco.mj_forward(theirs, data)
    for engine in ("pinocchio", "lagrangian", "mujoco"):
        assert mb.dynamics(model, engine).passive([0.3], [0.7]) == pytest.approx(data.qfrc_passive)
