"""SDF beside the same robot as URDF, which Pinocchio reads, and beside closed forms; what is refused."""

import re
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mbkit as mb
from mbkit.errors import LoadError, MbkitError
from mbkit.studies.compare.beyond_terms import findings

CLOSE = 1e-12
drake = pytest.mark.skipif(find_spec("pydrake") is None, reason="Drake is not installed")


def text(*numbers):
    return " ".join(repr(float(x)) for x in np.ravel(numbers))


def pose_text(X):
    return text(X[:3, 3], Rotation.from_matrix(X[:3, :3]).as_euler("xyz"))


def inertial(rng, urdf):
    """Return the same <inertial> of both formats, in which the pose of the inertia is turned."""
    mass, place, moments = rng.uniform(0.5, 3), text(rng.uniform(-0.2, 0.2, 3)), rng.uniform(0.02, 0.03, 3)
    turn, names = text(rng.uniform(-1, 1, 3)), ("ixx", "iyy", "izz")
    if urdf:
        ends = " ".join(f'{n}="{x!r}"' for n, x in zip(names, map(float, moments), strict=True))
        origin = f'<origin xyz="{place}" rpy="{turn}"/><mass value="{mass!r}"/>'
        return f'<inertial>{origin}<inertia {ends} ixy="0" ixz="0" iyz="0"/></inertial>'
    ends = "".join(f"<{n}>{float(x)!r}</{n}>" for n, x in zip(names, moments, strict=True))
    return f"<inertial><pose>{place} {turn}</pose><mass>{mass!r}</mass><inertia>{ends}</inertia></inertial>"


def two_texts(seed, n=4):
    """Return a branching robot as URDF and as SDF, whose poses stand in frames of all kinds."""
    rng = np.random.default_rng(seed)
    matter = rng.integers(1_000_000, size=n + 1)
    links = [inertial(np.random.default_rng(x), urdf=True) for x in matter]
    urdf = [f'<link name="l{k}">{x}</link>' for k, x in enumerate(links)]
    links = [inertial(np.random.default_rng(x), urdf=False) for x in matter]
    sdf = [f'<link name="l0"><pose>0 0 0 0 0 0</pose>{links[0]}</link>']
    world = [np.eye(4)]
    for k in range(1, n + 1):
        parent, kind = int(rng.integers(k)), str(rng.choice(["revolute", "continuous", "prismatic"]))
        X = np.eye(4)
        X[:3, :3], X[:3, 3] = Rotation.from_euler("xyz", rng.uniform(-1.4, 1.4, 3)).as_matrix(), rng.uniform(-1, 1, 3)
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        world.append(world[parent] @ X)
        ends = f'<parent link="l{parent}"/><child link="l{k}"/><axis xyz="{text(axis)}"/>'
        rest = '<limit lower="-1" upper="1" effort="9" velocity="3"/><dynamics damping="0.3"/>'
        origin = f'<origin xyz="{text(X[:3, 3])}" rpy="{text(Rotation.from_matrix(X[:3, :3]).as_euler("xyz"))}"/>'
        urdf.append(f'<joint name="j{k}" type="{kind}">{origin}{ends}{rest}</joint>')
        # A frame of the model, one on the parent, or the joint's own.
        frame, place, joint_pose = "", f"<pose>{pose_text(world[k])}</pose>", ""
        if k % 3 == 1:
            frame = f'<frame name="f{k}" attached_to="l{parent}"><pose>{pose_text(X)}</pose></frame>'
            place = f'<pose relative_to="f{k}">0 0 0 0 0 0</pose>'
        elif k % 3 == 2:
            joint_pose = f'<pose relative_to="l{parent}">{pose_text(X)}</pose>'
            place = f'<pose relative_to="j{k}">0 0 0 0 0 0</pose>'
        about, R = [("__model__", world[k]), (f"l{parent}", X), (f"l{k}", np.eye(4))][k % 3]
        axis_text = f'<xyz expressed_in="{about}">{text(R[:3, :3] @ axis)}</xyz>'
        limit = "" if kind == "continuous" else "<lower>-1</lower><upper>1</upper>"
        numbers = f"<limit>{limit}<effort>9</effort><velocity>3</velocity></limit><dynamics><damping>0.3</damping>"
        sdf.append(
            f'{frame}<link name="l{k}">{place}{links[k]}</link><joint name="j{k}" type="{kind}">{joint_pose}'
            f"<parent>l{parent}</parent><child>l{k}</child><axis>{axis_text}{numbers}</dynamics></axis></joint>"
        )
    return (
        f'<robot name="r">{"".join(urdf)}</robot>',
        f'<sdf version="1.7"><model name="r">{"".join(sdf)}</model></sdf>',
    )


@pytest.mark.thorough(every=4)
@drake
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("floating", [False, True])
def test_poses_and_axes_in_any_frame_are_those_of_the_urdf(seed, floating):
    urdf, sdf = two_texts(seed)
    urdf, sdf = (mb.load(x, floating_base=floating) for x in (urdf, sdf))
    one, other = (mb.dynamics(x, "lagrangian") for x in (urdf, sdf))
    rng = np.random.default_rng(seed)
    q, v = urdf.random_state(rng)
    theirs_q, theirs_v, order = np.empty(sdf.nq), np.empty(sdf.nv), np.empty(sdf.nv, dtype=int)
    for name in urdf.joint_names:
        theirs_q[sdf.layout.q[name]], theirs_v[sdf.layout.v[name]] = q[urdf.layout.q[name]], v[urdf.layout.v[name]]
        order[sdf.layout.v[name]] = np.arange(urdf.nv)[urdf.layout.v[name]]
    M, h = one.mass_matrix(q), one.nle(q, v)
    assert np.abs(other.mass_matrix(theirs_q) - M[np.ix_(order, order)]).max() < CLOSE * np.abs(M).max()
    assert np.abs(other.nle(theirs_q, theirs_v) - h[order]).max() < CLOSE * np.abs(h).max()
    assert np.abs(other.passive(theirs_q, theirs_v) - one.passive(q, v)[order]).max() < CLOSE
    for k in range(5):
        assert np.abs(other.pose(theirs_q, f"l{k}") - one.pose(q, f"l{k}")).max() < CLOSE
    assert sdf.source == ""
    for j in (j for j in urdf.joints if j.name.startswith("j")):
        for field in ("lower", "upper", "velocity_limit", "effort_limit"):
            assert getattr(j, field) == getattr(sdf.joint(j.name), field)


PENDULUM = """<sdf version="1.9"><model name="pendulum"><pose>0 0 2 {turn} 0 0</pose>
<frame name="tip" attached_to="arm"><pose>0.5 0 0 0 0 0</pose></frame>
<model name="inside"><link name="base"/></model>
<link name="arm"><pose relative_to="hinge">0.1 0 0 0 0 0</pose>
<inertial><pose>0.2 0 0 0 0 1.5707963267948966</pose><mass>2</mass>
<inertia><ixx>0.01</ixx><iyy>0.04</iyy><izz>0.03</izz></inertia></inertial></link>
<joint name="hinge" type="revolute"><pose relative_to="__model__">0 0.3 0 0 0 0</pose>
<parent>inside::base</parent><child>arm</child><axis><xyz expressed_in="__model__">0 1 0</xyz>
<dynamics><damping>0.7</damping><spring_stiffness>5</spring_stiffness><spring_reference>0.2</spring_reference></dynamics>
</axis></joint></model></sdf>"""


@drake
def test_a_pendulum_is_its_closed_form(tmp_path):
    file = tmp_path / "pendulum.sdf"
    file.write_text(PENDULUM.format(turn=0.0))
    model = mb.load(file)
    q, v, m, l, g = 0.4, 0.3, 2.0, 0.3, 9.81
    for engine in ("lagrangian", "pinocchio"):
        dyn = mb.dynamics(model, engine)
        # The inertia's axes are a quarter turn off, so that ixx is about the hinge.
        assert abs(dyn.mass_matrix([q])[0, 0] - (0.01 + m * l * l)) < CLOSE
        # Positive turns about y let the arm sink.
        assert abs(dyn.gravity([q])[0] + m * g * l * np.cos(q)) < CLOSE
        assert abs(dyn.passive([q], [v])[0] + 0.7 * v + 5 * (q - 0.2)) < CLOSE
        away = 0.6 * np.array([np.cos(q), 0.0, -np.sin(q)])
        assert np.abs(dyn.pose([q], "tip")[:3, 3] - away - [0.0, 0.3, 2.0]).max() < CLOSE
    assert model.bodies[-1].name == "arm"
    assert "inside::base" in [b.name for b in model.bodies]
    assert "the base 'inside::base' floats in SDF" in model.notes[0]


@drake
def test_the_models_own_pose_turns_it_under_gravity():
    turned = mb.dynamics(mb.load(PENDULUM.format(turn=0.5)), "lagrangian")
    assert abs(turned.gravity([0.4])[0] + 2.0 * 9.81 * 0.3 * np.cos(0.4) * np.cos(0.5)) < CLOSE
    free = mb.load(PENDULUM.format(turn=0.5), floating_base=True, gravity=(0, 0, -1.6))
    assert free.joint_names == ("root_joint", "hinge")
    assert np.abs(mb.dynamics(free, "lagrangian").gravity(free.neutral())[:3] - [0, 0, 2 * 1.6 + 1.6]).max() < CLOSE


TWO_JOINTS = """<sdf version="1.9"><model name="m"><link name="base"/>
<link name="arm"><pose>0.1 0.2 0.3 0.4 -0.5 0.6</pose><inertial><pose>0.2 0 0.1 0 0 0</pose><mass>2</mass><inertia>
<ixx>0.01</ixx><iyy>0.04</iyy><izz>0.03</izz></inertia></inertial></link>{joints}</model></sdf>"""


@drake
def test_a_universal_joint_is_two_hinges_and_a_screw_a_hinge_that_advances():
    first, second = "<axis><xyz>1 0 0</xyz></axis>", "<{0}><xyz>0 0.6 0.8</xyz></{0}>"
    ends = "<parent>{}</parent><child>{}</child>"
    cross = f'<joint name="j" type="universal">{ends.format("base", "arm")}{first}{second.format("axis2")}</joint>'
    link = '<link name="cross"><pose relative_to="arm">0 0 0 0 0 0</pose><inertial><mass>1e-12</mass><inertia>'
    link += "<ixx>1e-14</ixx><iyy>1e-14</iyy><izz>1e-14</izz></inertia></inertial></link>"
    hinges = f'{link}<joint name="j" type="revolute">{ends.format("base", "cross")}{first}</joint>'
    hinges += f'<joint name="k" type="revolute">{ends.format("cross", "arm")}{second.format("axis")}</joint>'
    one, two = (mb.dynamics(mb.load(TWO_JOINTS.format(joints=x)), "lagrangian") for x in (cross, hinges))
    q, v = [0.4, -0.7], [0.3, 0.9]
    assert np.abs(one.mass_matrix(q) - two.mass_matrix(q)).max() < 1e-10
    assert np.abs(one.nle(q, v) - two.nle(q, v)).max() < 1e-10
    kinds = "<screw_thread_pitch>0.3</screw_thread_pitch>"
    screw = f'<joint name="j" type="screw">{ends.format("base", "arm")}{second.format("axis")}{kinds}</joint>'
    hinge = f'<joint name="j" type="revolute">{ends.format("base", "arm")}{second.format("axis")}</joint>'
    turning, moving = (mb.dynamics(mb.load(TWO_JOINTS.format(joints=x)), "lagrangian") for x in (hinge, screw))
    # The mass advances 0.3 m a turn, which adds m (pitch / 2π)², and m c × n along the axis has no part.
    h = 0.3 / (2 * np.pi)
    assert abs(moving.mass_matrix([0.4])[0, 0] - turning.mass_matrix([0.4])[0, 0] - 2 * h * h) < CLOSE
    R = Rotation.from_euler("xyz", [0.4, -0.5, 0.6]).as_matrix()
    climbs = 2 * 9.81 * h * (R @ [0, 0.6, 0.8])[2]
    assert abs(moving.gravity([0.4])[0] - turning.gravity([0.4])[0] - climbs) < CLOSE
    away = moving.pose([0.4], "arm")[:3, 3] - turning.pose([0.4], "arm")[:3, 3]
    assert np.abs(away - 0.4 * h * R @ [0, 0.6, 0.8]).max() < CLOSE


def changed(old, new):
    return PENDULUM.format(turn=0.0).replace(old, new)


@drake
@pytest.mark.parametrize(
    ("given", "words"),
    [
        ('<sdf version="1.7"><world name="w"/></sdf>', "one <model> and nothing beside it, got <world>"),
        (changed("</sdf>", '<model name="b"/></sdf>'), "got <model>, <model>"),
        (changed("<mass>2", "<mass>-2"), "invalid inertia"),
        (changed("<mass>2", "<mass>1 2"), r"mass text: expected a number, got '1 2' \(line 5\)"),
        (changed("<mass>2", "<mass>"), "mass text: expected a number, got ''"),
        (changed("0.1 0 0 0 0 0", "0.1 0 0"), "pose text: expected 6 numbers"),
        (changed("<spring_reference>0.2", "<spring_reference>nan"), "'nan' is not a finite number"),
        (changed("<ixx>0.01", "<ixx>9"), "invalid inertia"),
        (changed("<parent>inside::base", "<parent>bose"), "bose"),
        (changed('type="revolute"', 'type="revolute2"'), "revolute2"),
        (changed("<damping>0.7</damping>", '<mimic joint="hinge"/>'), r"<mimic> \(line 9\)"),
        (changed('<link name="arm">', '<link name="arm"><gravity>false</gravity>'), "<gravity>"),
        (
            changed('<link name="arm">', '<include><uri>model://no</uri></include><link name="arm">'),
            "<include>.*gz sdf -p",
        ),
        (changed('version="1.9"', 'version="two"'), "<sdf> has the version 'two'; expected one such as 1.9"),
        (
            changed(
                '<link name="arm">',
                '<link name="c"><inertial auto="true"/><collision name="c"><geometry><mesh><uri>c.obj</uri></mesh>'
                '</geometry></collision></link><link name="arm">',
            ),
            r"link 'c' \(line \d+\) takes its inertia from a mesh",
        ),
        (
            changed("</joint>", '</joint><joint name="k" type="ball"><parent>world</parent><child>arm</child></joint>'),
            "loops",
        ),
    ],
)
def test_what_is_no_tree_of_one_model_is_refused_by_name(given, words):
    with pytest.raises(MbkitError, match=words):
        mb.load(given)


@drake
def test_a_pose_may_be_empty_or_a_quaternion():
    quaternion = changed(
        "<pose>0.2 0 0 0 0 1.5707963267948966</pose>", '<pose rotation_format="quat_xyzw">0.2 0 0 0 0 {0} {0}</pose>'
    )
    turned = mb.load(quaternion.format(0.5**0.5))
    assert np.abs(turned.body("arm").inertia - np.diag([0.04, 0.01, 0.03])).max() < CLOSE
    place = '<pose relative_to="__model__">0 0.3 0 0 0 0</pose>'
    assert not mb.load(changed(place, '<pose relative_to="__model__"/>')).joint("hinge").translation.any()


@drake
def test_what_drake_ignores_is_noted():
    model = mb.load(changed("<frame", '<plugin name="p" filename="p.so"/><frame'))
    assert any("plugin" in note for note in model.notes)
    model = mb.load(changed("<damping>", "<friction>1</friction><damping>"))
    lost = "dry friction, which Drake does not read from SDF: hinge (1 N m or N)"
    assert f"left out of the motion: {lost}" in model.notes
    # A check says it on its first screen.
    assert [(x.kind, x.says) for x in findings(model, np.ones((1, model.nv)), np.eye(model.nv)[None])][:1] == [
        ("left out of the motion", lost)
    ]


@drake
def test_a_base_that_the_file_holds_does_not_float():
    held = changed(
        "</joint>", '</joint><joint name="k" type="fixed"><parent>world</parent><child>inside::base</child></joint>'
    )
    assert mb.load(held).nv == 1
    with pytest.raises(LoadError, match="there are: none"):
        mb.load(held, floating_base=True)


@drake
def test_several_bases_are_held_at_their_poses_or_all_float():
    other = '<link name="other"><pose>0 3 0 0 0 0.5</pose><inertial><mass>4</mass></inertial></link>'
    ends = "<parent>other</parent><child>wing</child><axis><xyz>0 0 1</xyz></axis>"
    hinge = f'<joint name="turn" type="revolute">{ends}</joint>'
    wing = '<link name="wing"><pose relative_to="other">1 0 0 0 0 0</pose><inertial><mass>2</mass></inertial></link>'
    both, alone = changed('<link name="arm">', f'{other}{wing}{hinge}<link name="arm">'), mb.load(changed("", ""))
    held = mb.load(both)
    assert any("bases 'other', 'inside::base' float in SDF, and are held" in note for note in held.notes)
    dyn, q = mb.dynamics(held), np.array([0.7, 0.4])[[held.joint_names.index(x) for x in ("hinge", "turn")]]
    # The arms do not know each other; sdformat's inertia is 1 kg m² where none stands.
    M, first = dyn.mass_matrix(q), held.joint_names.index("hinge")
    assert M[first, first] == pytest.approx(mb.dynamics(alone).mass_matrix([0.7])[0, 0], rel=1e-14)
    assert M[1 - first, 1 - first] == pytest.approx(1.0, rel=1e-14)
    assert M[0, 1] == 0
    c, s = np.cos(0.5), np.sin(0.5)
    assert np.abs(dyn.pose(q, "wing")[:3, 3] - [c, 3 + s, 2]).max() < CLOSE
    free = mb.load(both, floating_base=True)
    assert {x for x in free.joint_names if "root" in x} == {"root_joint_other", "root_joint_inside::base"}
    assert free.nv == 14


def test_without_drake_the_extra_is_named(monkeypatch, tmp_path):
    file = tmp_path / "arm.sdf"
    file.write_text(PENDULUM.format(turn=0.0))
    monkeypatch.setitem(sys.modules, "pydrake", None)
    with pytest.raises(LoadError, match=re.escape("mbkit[drake]")) as told:
        mb.load(file)
    assert str(file) in str(told.value)


def test_an_sdf_under_another_name_is_told(tmp_path):
    file = tmp_path / "arm.xml"
    file.write_text(PENDULUM.format(turn=0.0))
    with pytest.raises(MbkitError, match=r"ends in \.sdf"):
        mb.load(file)
