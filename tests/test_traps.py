"""Where engines differ and fail: a user of mbkit meets none of it. One test a trap.

Known defects have a file of their own, test_defects.py.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin
import pytest

import mbkit as mb
from mbkit.errors import ModelError, UnsupportedError
from mbkit.spatial import matrix_from_quaternion
from tests.random_trees import off, random_tree, states
from tests.scenes import mounted

FREE_URDF = """<robot name="box"><link name="base"><inertial><origin xyz="0.1 0.2 0.3"/><mass value="2"/>
<inertia ixx="0.3" iyy="0.4" izz="0.5" ixy="0.01" ixz="0.02" iyz="0.03"/></inertial></link>
<link name="arm"><inertial><origin xyz="0 0 -0.3"/><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="5" velocity="5"/></joint></robot>"""


@pytest.fixture
def floating(tmp_path):
    path = tmp_path / "box.urdf"
    path.write_text(FREE_URDF)
    return mb.load(path, floating_base=True)


def test_mujocos_dense_jacobians_are_asked_for_and_its_solver_is_off():
    dyn = mb.dynamics(random_tree(0, 6, ("revolute", "ball")), "mujoco")
    assert dyn.mj_model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE
    for bit in ("CONSTRAINT", "CONTACT", "LIMIT", "FRICTIONLOSS", "EQUALITY", "EULERDAMP", "AUTORESET"):
        assert dyn.mj_model.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{bit}"), bit


def test_a_free_joints_numbers_are_converted_whole(floating):
    """Quaternion order, world against body axes, and ω × v in the accelerations."""
    q, v, _, tau = (x[0] for x in states(floating, 1))
    dyn = mb.dynamics(floating, "mujoco")
    m, d = dyn.mj_model, mujoco.MjData(dyn.mj_model)
    R = matrix_from_quaternion(q[3:7])
    d.qpos[:] = [*q[:3], q[6], *q[3:6], *q[7:]]
    d.qvel[:] = [*(R @ v[:3]), *v[3:]]
    d.qfrc_applied[:] = [*(R @ tau[:3]), *tau[3:]]
    mujoco.mj_forward(m, d)
    a = np.array(d.qacc)
    a[:3] = R.T @ a[:3] - np.cross(v[3:6], v[:3])
    assert off(dyn.forward_dynamics(q, v, tau), a) < 1e-14
    assert off(mb.dynamics(floating).forward_dynamics(q, v, tau), a) < 1e-13
    naive = np.array(d.qacc)
    naive[:3] = R.T @ naive[:3]
    assert off(naive, a) > 1e-2


def test_continuous_joints_are_one_plain_angle_everywhere():
    model = mb.load("kinova")
    assert model.nq == model.nv == 6
    q = np.full(6, 0.3)
    for engine in ("pinocchio", "lagrangian", "mujoco"):
        dyn = mb.dynamics(model, engine)
        assert off(dyn.gravity(q + 2 * np.pi), dyn.gravity(q)) < 1e-14
    turns = mb.simulate(mb.dynamics(model.without("gravity")), q, 20 * np.eye(6)[5], 1.0, dt=1e-2)
    assert turns.q[-1, 5] > 2 * np.pi


def test_planar_velocities_are_the_derivatives_of_the_coordinates():
    b = mounted("puck", "puck", "slide", "planar", mass=2.0, com=(0.3, 0, 0), inertia=(0.1, 0.1, 0.2))
    model = b.build()
    q, v = np.array([1.0, 2.0, 0.7]), np.array([0.1, -0.2, 0.3])
    # T by hand: the centre of mass moves with (ẋ, ẏ) + θ̇ ẑ × R c.
    c = 0.3 * np.array([np.cos(0.7), np.sin(0.7)])
    speed = v[:2] + v[2] * np.array([-c[1], c[0]])
    expected = 0.5 * 2 * speed @ speed + 0.5 * 0.2 * v[2] ** 2
    for engine in ("pinocchio", "lagrangian", "mujoco"):
        assert mb.dynamics(model, engine).kinetic_energy(q, v) == pytest.approx(expected, rel=1e-14)


def test_helical_pitch_is_metres_per_radian():
    b = mounted("screw", "nut", "thread", "helical", mass=2.0, inertia=(1, 1, 1), axis=(0, 0, 1), pitch=0.5)
    model = b.build()
    for engine in ("pinocchio", "lagrangian"):
        dyn = mb.dynamics(model, engine)
        assert dyn.mass_matrix([0.2])[0, 0] == pytest.approx(1 + 2 * 0.25)
        assert dyn.pose([2.0], "nut")[2, 3] == pytest.approx(1.0)
        assert dyn.gravity([0.2]) == pytest.approx([2 * 9.81 * 0.5])


def test_siblings_are_addressed_by_name_whatever_their_order(tmp_path):
    """Pinocchio's parser sorts siblings by the alphabet, MuJoCo keeps them as declared."""
    link = (
        '<link name="{0}"><inertial><mass value="{1}"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )
    joint = (
        '<joint name="{0}" type="continuous"><parent link="base"/><child link="{0}"/><origin xyz="{1} 0 0"/>'
        '<axis xyz="1 0 0"/></joint>'
    )
    path = tmp_path / "siblings.urdf"
    path.write_text(
        '<robot name="r"><link name="base"/>'
        + link.format("zebra", 1)
        + link.format("ant", 3)
        + joint.format("zebra", 1)
        + joint.format("ant", 2)
        + "</robot>"
    )
    model = mb.load(path)
    for engine in ("pinocchio", "lagrangian", "mujoco"):
        X = mb.dynamics(model, engine).pose(model.neutral(), "ant")
        assert X[0, 3] == pytest.approx(2.0)
    assert model.body("ant").mass == 3
    assert model.joint("ant").child == "ant"


def test_parallel_slides_of_one_body_are_coupled_in_every_engine():
    b = mb.ModelBuilder("slides")
    b.add_body("between")
    b.add_body("body", mass=2, inertia=np.eye(3))
    b.add_joint("a", "prismatic", parent="world", child="between", axis=(0, 0, 1), armature=0.1)
    b.add_joint("b", "prismatic", parent="between", child="body", axis=(0, 0, 1), armature=0.2)
    model = b.build()
    for engine in ("pinocchio", "lagrangian", "mujoco"):
        np.testing.assert_array_equal(mb.dynamics(model, engine).mass_matrix([0.1, 0.2]), [[2.1, 2], [2, 2.2]])
    # MuJoCo by itself takes M for diagonal: when this fails, the mend in the adapter can go.
    text = mb.convert(model, "mjcf").text
    for compiled, coupling in ((text, 2), (text.replace(' simple="false"', ""), 0)):
        m = mujoco.MjModel.from_xml_string(compiled)
        d = mujoco.MjData(m)
        mujoco.mj_forward(m, d)
        M = np.zeros((2, 2))
        mujoco.mj_fullM(m, d, M)
        assert M[0, 1] == coupling


def test_the_base_links_mass_is_not_dropped(tmp_path, floating):
    path = tmp_path / "box.urdf"
    assert floating.mass == pytest.approx(3.0)
    assert mb.load(path).mass == pytest.approx(3.0)
    # MuJoCo's own import of the same file does drop it.
    assert mujoco.MjModel.from_xml_path(str(path)).body_mass.sum() == pytest.approx(1.0)
    dyn = mb.dynamics(floating, "mujoco")
    assert dyn.mj_model.body_mass.sum() == pytest.approx(3.0)


def test_every_bodys_inertia_arrives_in_mujoco(monkeypatch):
    """The adapter checks this itself; here the check is checked."""
    from mbkit.engines.mujoco import model as mujoco_model

    model = mb.load("ur5")
    monkeypatch.setattr(mujoco_model, "_set_constants", lambda made, *_: made.body_inertia.__imul__(1 + 1e-9))
    with pytest.raises(mb.MbkitError, match="inertia of body"):
        mb.dynamics(model, "mujoco")


def test_bodies_without_mass_are_named_and_never_nan():
    b = mb.ModelBuilder("hollow")
    b.add_body("shell")
    b.add_joint("j", "revolute", parent="world", child="shell", axis=(0, 1, 0))
    with pytest.raises(ModelError, match="'shell': no mass moves with joint 'j'"):
        b.build()
    # Between two joints a body may be massless: a Cardan cross, which MuJoCo holds too.
    b = mb.ModelBuilder("cross")
    b.add_body("cross")
    b.add_joint("first", "revolute", parent="world", child="cross", axis=(1, 0, 0))
    b.add_body("arm", mass=1.0, com=(0.1, 0.2, -1), inertia=(0.1, 0.2, 0.25))
    place = {"translation": (0.1, 0, 0.2), "rpy": (0.3, 0, 1)}
    b.add_joint("second", "revolute", parent="cross", child="arm", axis=(0, 1, 0), **place)
    model = b.build()
    q, v, _, tau = states(model, 3)
    own = mb.dynamics(model, "lagrangian").forward_dynamics(q, v, tau)
    for engine in ("pinocchio", "mujoco"):
        assert off(mb.dynamics(model, engine).forward_dynamics(q, v, tau), own) < 1e-13
    with pytest.raises(UnsupportedError, match="rides on 'cross'"):
        mb.dynamics(model, "mujoco").pose(q[0], "cross")


def test_points_rods_and_plates_reach_mujoco_as_they_are():
    for inertia in (None, (0.1, 0.1, 0.0), (0.1, 0.2, 0.3), (0.1 + 0.2, 0.1, 0.2)):
        b = mb.ModelBuilder("thin")
        b.add_body("a", mass=1.0, com=(0, 0.1, -1), inertia=inertia)
        b.add_joint("j", "universal", parent="world", child="a", axis=(1, 0, 0), axis2=(0, 1, 0))
        model = b.build()
        q, v, _, tau = states(model, 3)
        dyn, own = mb.dynamics(model, "mujoco"), mb.dynamics(model, "lagrangian")
        condition = np.linalg.cond(own.mass_matrix(q)).max()
        assert off(dyn.mass_matrix(q), own.mass_matrix(q)) < 1e-14
        assert off(dyn.forward_dynamics(q, v, tau), own.forward_dynamics(q, v, tau)) < 1e-14 * condition


def test_native_rollouts_of_mimic_joints_are_refused_and_free_ones_run():
    model = mb.load("panda")
    dyn = mb.dynamics(model, "mujoco")
    with pytest.raises(UnsupportedError, match=r"panda_finger_joint2.*hold it softly.*mimic='free'"):
        dyn.rollout("rk4", model.neutral(), np.zeros(8), 1e-3, None, 10)
    free = mb.load("panda", mimic="free")
    q, _ = mb.dynamics(free, "mujoco").rollout("rk4", free.neutral(), np.zeros(9), 1e-3, None, 10)
    assert q.shape == (11, 9)


def test_forces_on_a_floating_base_are_refused_in_native_rollouts(floating):
    dyn = mb.dynamics(floating, "mujoco")
    tau = np.zeros((5, floating.nv))
    tau[:, 0] = 1.0
    with pytest.raises(UnsupportedError, match="world axes"):
        dyn.rollout("rk4", floating.neutral(), np.zeros(floating.nv), 1e-3, tau, 5)
    tau[:, 0], tau[:, 4] = 0.0, 1.0
    dyn.rollout("rk4", floating.neutral(), np.zeros(floating.nv), 1e-3, tau, 5)


def test_pinocchio_s_reader_of_equalities_takes_anchors_of_joints_and_inactive_ones(tmp_path):
    """mbkit reads these elements itself; a version of Pinocchio that reads them otherwise fails here."""
    inertial = '<inertial pos=".2 0 0" mass="1" diaginertia=".1 .1 .1"/>'
    text = (
        '<mujoco><compiler inertiafromgeom="false"/><worldbody><body name="a"><joint name="j" axis="1 0 0" '
        f'pos="0 0 .2"/>{inertial}</body></worldbody>'
        '<equality><connect name="x" body1="a" anchor=".3 .2 .1" active="{}"/></equality></mujoco>'
    )
    points = {}
    for active in ("true", "false"):
        path = tmp_path / f"{active}.xml"
        path.write_text(text.format(active))
        _, read, _ = pin.buildModelAndConstraintsFromMJCF(str(path))
        points[active] = [np.array(one.joint1_placement.translation) for one in read]
    # The anchor is in the body's axes, whose origin is 0.2 m below the joint.
    (loop,) = mb.load(tmp_path / "true.xml").loops
    assert np.abs(loop.translation_a - [0.3, 0.2, -0.1]).max() < 1e-15
    assert np.abs(points["true"][0] - [0.3, 0.2, 0.1]).max() < 1e-15
    assert len(points["false"]) == 1
    assert not mb.load(tmp_path / "false.xml").loops


def test_pinocchio_loses_the_place_of_a_body_fixed_to_the_world_and_equalities_of_joints(tmp_path):
    inertial = '<inertial pos=".2 0 0" mass="1" diaginertia=".1 .1 .1"/>'
    path = tmp_path / "m.xml"
    path.write_text(
        '<mujoco><compiler inertiafromgeom="false"/><worldbody><body name="root" pos=".5 0 .1" quat=".6 .8 0 0">'
        f'{inertial}<body name="a"><joint name="j" axis="0 1 0"/>{inertial}<body name="b">'
        f'<joint name="k" axis="0 1 0"/>{inertial}</body></body></body></worldbody>'
        '<equality><joint joint1="j" joint2="k" polycoef="0 2 0 0 0"/></equality></mujoco>'
    )
    read, *constraints = pin.buildModelAndConstraintsFromMJCF(str(path))
    assert not any(len(some) for some in constraints)
    assert np.abs(read.jointPlacements[1].homogeneous - np.eye(4)).max() == 0.0
    model = mb.load(path)
    (coupler,) = model.couplers
    assert (coupler.joint, coupler.leader, coupler.ratio) == ("j", "k", 2.0)
    theirs = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(theirs)
    mujoco.mj_forward(theirs, data)
    g = mb.dynamics(model.without("couplers"), "pinocchio").gravity(np.zeros(2))
    assert np.abs(g - data.qfrc_bias).max() < 1e-14
    assert np.abs(pin.computeGeneralizedGravity(read, read.createData(), np.zeros(2)) - g).max() > 1.0


def test_rk4_on_rotations_is_of_fourth_order_in_mujoco_and_here():
    """Second order up to MuJoCo 3.3; both sides are measured against a tight reference."""
    model = mb.catalog.free_body()
    q0, v0 = model.neutral(), np.array([0, 0, 0, 1.0, 2.0, 0.5])
    end = mb.simulate(mb.dynamics(model), q0, v0, 1.0, "dop853", rtol=1e-13, save=[0.0, 1.0]).q[-1]
    for engine, method in (("mujoco", "mujoco_rk4"), ("pinocchio", "rk4")):
        errors = []
        for dt in (0.05, 0.025):
            run = mb.simulate(mb.dynamics(model, engine), q0, v0, 1.0, method, dt)
            errors.append(np.linalg.norm(model.difference(end, run.q[-1])))
        assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.2)
