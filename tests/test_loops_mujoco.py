"""Loops on MuJoCo: its soft law in formulas of our own, its own numbers for the rows, runs with their drift, MJCF."""

from __future__ import annotations

import pickle
import warnings
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

import mbkit as mb
from mbkit.engines.mujoco import engine
from mbkit.engines.mujoco.constraints import Softness, stiffest
from mbkit.engines.mujoco.engine import MujocoDynamics
from mbkit.errors import DoubtfulRunWarning, InputError, MbkitWarning, ModelError, UnsupportedError
from mbkit.model import Model
from mbkit.model.loops import LOOP_KINDS
from mbkit.model.parts import Loop, Prescribed
from tests.quantities import closed
from tests.random_trees import IN_MUJOCO, off, random_tree

#: Default, the stiffest for a step of 1 ms, and stiffness and damping with a spline that is no parabola.
SETTINGS = ({}, stiffest(1e-3), {"solref": (-300.0, -20.0), "solimp": (0.5, 0.9, 1.0, 0.3, 3.0)})


def closed_tree(seed: int, kind: str) -> tuple[Model, np.ndarray]:
    return closed(random_tree(seed, 8, IN_MUJOCO), seed, kind)


def four_bar() -> tuple[Model, np.ndarray, np.ndarray]:
    model = mb.catalog.four_bar()
    q, v = mb.dynamics(model, "lagrangian", compile=False).project(model.neutral(), [5.0, 0.0, 0.0])
    return model, q, v


@pytest.mark.thorough("0-frame", "1-point", "1-frame", "2-point", "3-frame", "2-frame")
@pytest.mark.parametrize("kind", ["point", "frame"])
@pytest.mark.parametrize("seed", range(4))
def test_accelerations_are_those_of_the_written_law(seed: int, kind: str) -> None:
    model, q = closed_tree(seed, kind)
    rng = np.random.default_rng([seed, 1])
    own = mb.dynamics(model, "lagrangian", compile=False)
    q, v = own.project(q, rng.standard_normal(model.nv))
    tau = rng.standard_normal(model.nv)
    for options in SETTINGS:
        dyn = mb.dynamics(model, "mujoco", **options)
        said = dyn.constraint_law(q, v, tau)
        assert off(dyn.forward_dynamics(q, v, tau), said.acceleration) < 1e-11
        assert off(said.rigid, own.forward_dynamics(q, v, tau)) < 1e-11
        assert np.abs(said.residual).max() < 1e-12
        # Open, and moving across the loop.
        far, fast = model.integrate(q, 0.1 * rng.standard_normal(model.nv)), rng.standard_normal(model.nv)
        said = dyn.constraint_law(far, fast, tau)
        assert off(dyn.forward_dynamics(far, fast, tau), said.acceleration) < 1e-11
        assert np.abs(said.residual).max() > 1e-4
        force = dyn.generalized_constraint_force(far, fast, tau)
        assert off(force, said.jacobian.T @ said.force) < 1e-10
        # M v̇ + C v + g = τ + τ_passive + Jᵀ f with the terms of the tree.
        assert off(dyn.inverse_dynamics(far, fast, said.acceleration), tau + force) < 1e-9


@pytest.mark.thorough
def test_terms_of_the_law_are_mujoco_s() -> None:
    model, q = closed_tree(1, "frame")
    rng = np.random.default_rng(0)
    q = model.integrate(q, 0.2 * rng.standard_normal(model.nv))
    for options in SETTINGS:
        dyn = mb.dynamics(model, "mujoco", **options)
        said = dyn.constraint_law(q, rng.standard_normal(model.nv), rng.standard_normal(model.nv))
        d = dyn._closed[1]
        stiffness, damping = dyn.softness.gains
        assert np.allclose(d.efc_KBIP.reshape(-1, 4)[:, :2], [stiffness, damping], rtol=1e-14, atol=0)
        assert np.allclose(d.efc_KBIP.reshape(-1, 4)[:, 2], said.impedance, rtol=1e-14, atol=0)
        assert np.allclose(d.efc_R, said.regularizer, rtol=1e-12, atol=0)
        assert off(said.reference, d.efc_aref) < 1e-14


def test_stiffer_settings_keep_more_digits_and_never_more_than_the_cap_allows() -> None:
    model, q, v = four_bar()
    digits = []
    for impedance in (0.5, 0.9, 0.99, 0.999, 0.9999):
        dyn = mb.dynamics(model, "mujoco", solimp=(impedance, impedance, 0.001, 0.5, 2.0))
        digits.append(dyn.constraint_law(q, v, np.zeros(3)).digits)
    # R falls by ten with each nine of the impedance, and so does what it costs.
    assert np.allclose(np.diff(digits[1:]), 1.0, atol=0.1)
    assert digits[0] < digits[1]
    assert 3 < digits[-1] < 6
    assert f"{digits[-1]:.1f} digits" in str(dyn.constraint_law(q, v, np.zeros(3)))


def test_other_terms_are_those_of_the_tree_after_forward_dynamics_too() -> None:
    model, q = closed_tree(3, "frame")
    rng = np.random.default_rng(4)
    v, a = rng.standard_normal((2, model.nv))
    dyn, tree = mb.dynamics(model, "mujoco"), mb.dynamics(model.without("loops"), "mujoco")
    bodies = [b.name for b in model.bodies]
    for _ in range(2):
        for name, state in (
            ("mass_matrix", (q,)),
            ("nle", (q, v)),
            ("passive", (q, v)),
            ("inverse_dynamics", (q, v, a)),
            ("centroidal_momentum_bias", (q, v)),
        ):
            mine, theirs = (getattr(x, name)(*state) for x in (dyn, tree))
            for x, y in zip(*((z.values() if isinstance(z, dict) else [z]) for z in (mine, theirs)), strict=True):
                assert np.array_equal(x, y), name
        dyn.forward_dynamics(q, v, a)
    wrench = {bodies[-1]: rng.standard_normal(6)}
    pushed = dyn.forward_dynamics(q, v, a, wrenches=wrench)
    assert off(pushed, dyn.forward_dynamics(q, v, a + dyn.generalized_force(q, wrench))) < 1e-10


def test_runs_keep_mujoco_s_drift() -> None:
    """Its own steps are those of `mj_step` to the bit, and mbkit's methods converge to the same motion."""
    model, q, v = four_bar()
    dyn = mb.dynamics(model, "mujoco", **stiffest(1e-3))
    assert not dyn._projects
    run = mb.simulate(dyn, q, v, 0.2, "mujoco_rk4", 1e-3)
    m = dyn.mj_model
    d = mujoco.MjData(m)
    m.opt.integrator, m.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, 1e-3
    d.qpos[:], d.qvel[:] = q, v
    for _ in range(200):
        mujoco.mj_step(m, d)
    assert np.array_equal(run.q[-1], d.qpos)
    gap = np.abs(dyn.constraint_residual(run.q)).max()
    assert 1e-10 < gap < 1e-5
    fine = mb.simulate(dyn, q, v, 0.05, "rk853", rtol=1e-11, atol=1e-12)
    coarse = mb.simulate(dyn, q, v, 0.05, "rk4", 1e-4)
    assert np.abs(fine.q[-1] - coarse.q[-1]).max() < 1e-7
    assert np.abs(dyn.constraint_residual(coarse.q)).max() > 1e-12
    stepped = dyn.step(q, v, np.zeros(3), 1e-3)
    assert np.abs(dyn.constraint_residual(stepped[0])).max() > 1e-12
    again = mb.simulate(dyn, q, v, 0.05, "dop853", rtol=1e-11, atol=1e-12)
    assert np.abs(again.q[-1] - fine.q[-1]).max() < 1e-7


def test_a_time_constant_below_two_steps_is_raised_aloud() -> None:
    model, q, v = four_bar()
    dyn = mb.dynamics(model, "mujoco", **stiffest(1e-4))
    with pytest.warns(DoubtfulRunWarning, match=r"raises the time constant .* from 0\.0002 s to two steps, 0\.002 s"):
        mb.simulate(dyn, q, v, 0.01, "mujoco_rk4", 1e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mb.simulate(dyn, q, v, 0.01, "mujoco_rk4", 1e-4)


def test_settings_are_checked_and_stay() -> None:
    model, q, v = four_bar()
    dyn = mb.dynamics(model, "mujoco", **stiffest(2e-3))
    assert isinstance(dyn, MujocoDynamics)
    assert dyn.softness == Softness((4e-3, 1.0), (0.9999, 0.9999, 0.001, 0.5, 2.0))
    a = dyn.forward_dynamics(q, v, np.zeros(3))
    assert np.array_equal(pickle.loads(pickle.dumps(dyn)).forward_dynamics(q, v, np.zeros(3)), a)
    assert np.array_equal(dyn.at().forward_dynamics(q, v, np.zeros(3)), a)
    for options, says in (
        ({"solref": (1.0, -1.0)}, "two positive or two negative"),
        ({"solref": (1.0,)}, r"shape \(2,\)"),
        ({"solimp": (0.9, 1.0, 0.001, 0.5, 2.0)}, "0.9999"),
        ({"solimp": (0.9, 0.95, 0.0, 0.5, 2.0)}, "width"),
    ):
        with pytest.raises(InputError, match=says):
            mb.dynamics(model, "mujoco", **options)
    with pytest.raises(InputError, match="dt"):
        stiffest(0.0)
    with pytest.raises(UnsupportedError, match="no loops"):
        mb.dynamics(mb.catalog.pendulum(), "mujoco").constraint_law([0.0], [0.0], [0.0])
    with pytest.raises(InputError, match="one state"):
        dyn.constraint_law([q, q], v, v)


def test_what_mujoco_does_not_hold_is_refused_by_name() -> None:
    model, _ = closed_tree(0, "point")
    (loop,) = model.loops
    for kind in set(LOOP_KINDS) - {"point", "frame"}:
        other = replace(model, loops=(replace(loop, kind=kind, length=0.5 * (kind == "distance")),))
        with pytest.raises(UnsupportedError, match=r"loop 'loop', .*MuJoCo.*'lagrangian'"):
            mb.dynamics(other, "mujoco")
    joint = next(j.name for j in model.joints if j.type.nv == 1)
    with pytest.raises(UnsupportedError, match=rf"joint '{joint}' is moved in time"):
        mb.dynamics(replace(model, prescribed=(Prescribed(joint, rate=1.0),)), "mujoco")
    reduced = random_tree(5, 10, ("revolute", "prismatic"), mimic=True)
    bodies = [b.name for b in reduced.bodies]
    ends = (bodies[0], np.eye(3), np.zeros(3), bodies[-1], np.eye(3), np.zeros(3))
    with pytest.raises(UnsupportedError, match="point loop 'x', while joint 'j1' follows 'j0'"):
        mb.dynamics(replace(reduced, loops=(Loop("x", "point", *ends),)), "mujoco")


# MJCF

BODY = '<inertial pos=".2 .01 0" mass="1" diaginertia=".1 .12 .1"/>'
SCENE = f"""<mujoco><compiler inertiafromgeom="false" angle="degree"/>
<default><equality solref="0.01 1"/></default><worldbody><site name="w" pos=".1 .2 .3"/>
<body name="a" pos="0 0 1" euler="0 20 10"><joint name="j1" pos=".1 0 0" ref="20"/>
<joint name="j2" axis="0 1 0" pos="0 .1 0"/>{BODY}
<body name="b" pos="1 0 0" euler="30 0 0"><joint name="j3" type="ball" pos="0 0 .2"/>{BODY}
<site name="s" pos="1 0.2 0" euler="10 20 30"/><body name="f" pos="0 .2 0">{BODY}</body></body></body>
<body name="c" pos="0 1 0"><freejoint name="j4"/>{BODY}<site name="r" pos="1 0 0"/></body>
<body name="m" mocap="true" pos="3 0 0"/></worldbody>
<equality>%s</equality></mujoco>"""


def loaded(tmp_path: Path, equality: str, **options: object) -> Model:
    path = tmp_path / "scene.xml"
    path.write_text(SCENE % equality)
    return mb.load(path, **options)  # type: ignore[arg-type]  # by name


@pytest.mark.parametrize(
    "equality",
    [
        '<connect body1="a" body2="c" anchor=".3 .2 .1"/>',
        '<connect body1="b" anchor=".3 .2 .1"/>',
        '<connect site1="s" site2="r"/>',
        '<connect site1="w" site2="s"/>',
        '<weld body1="a" body2="c"/>',
        '<weld body1="f" body2="c" anchor=".1 .2 .4"/>',
        '<weld body1="b"/>',
        # MuJoCo takes the position of relpose for the point on the first body, whatever the anchor on the second is.
        '<weld body1="b" body2="c" relpose=".1 .2 .3 1 .2 .3 .4" anchor=".1 .3 .3"/>',
        '<weld site1="s" site2="r"/>',
    ],
)
def test_equalities_are_read_as_mujoco_s_compiler_reads_them(tmp_path: Path, equality: str) -> None:
    model = loaded(tmp_path, equality)
    tree = loaded(tmp_path, equality, loops=False)
    (loop,) = model.loops
    assert not tree.loops
    assert any("loops=False" in note for note in tree.notes)
    assert any(note.startswith("loops, held exactly") and loop.name in note for note in model.notes)
    m = mujoco.MjModel.from_xml_string(SCENE % equality)
    d, dyn, rng = mujoco.MjData(m), mb.dynamics(model, "mujoco"), np.random.default_rng(0)
    for _ in range(4):
        q, v = tree.random_state(rng)
        for name in ("j1", "j2", "j3", "j4"):
            x, at = q[model.layout.q[name]], m.joint(name).qposadr[0]
            turned = x if len(x) == 1 else np.concatenate([x[:-4], np.roll(x[-4:], 1)])
            d.qpos[at : at + len(x)] = turned
        mujoco.mj_forward(m, d)
        residual = dyn.constraint_law(q, v, np.zeros(model.nv)).residual
        # MuJoCo's rows are in the same axes.
        assert np.allclose(np.abs(residual[:3]), np.abs(d.efc_pos[:3]), rtol=0, atol=1e-14)
        assert abs(np.linalg.norm(residual[3:]) - np.linalg.norm(d.efc_pos[3:])) < 1e-14


def test_equalities_without_a_loop_are_named(tmp_path: Path) -> None:
    for equality, why in (
        ('<weld name="x" site1="s" site2="r" active="false"/>', "inactive"),
        ('<weld name="x" body1="b" body2="f"/>', "no joint moves"),
        ('<weld name="x" body1="m" body2="c"/>', "motion capture"),
        ('<joint name="x" joint1="j1"/>', "it holds a single joint"),
    ):
        model = loaded(tmp_path, equality)
        assert not model.loops
        assert any(
            note.startswith("left out of the motion of equality constraints: 'x'") and why in note
            for note in model.notes
        )
    path = tmp_path / "off.xml"
    flag = '<option><flag equality="disable"/></option><worldbody>'
    path.write_text((SCENE % '<weld site1="s" site2="r"/>').replace("<worldbody>", flag, 1))
    assert any("option flag equality is off" in note for note in mb.load(path).notes)
    for equality, why in (
        ('<connect body1="nobody" anchor="0 0 0"/>', "'nobody' is no body"),
        ('<connect site1="s" site2="nowhere"/>', "'nowhere' is no site"),
        ('<connect site1="s" site2="r" body1="a"/>', "keep one of the two"),
        ('<connect body1="a"/>', "anchor: missing"),
        ('<tendon name="x" tendon1="t"/>', "'t' is no tendon"),
    ):
        with pytest.raises(ModelError, match=why):
            loaded(tmp_path, equality)


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        # The scene's default class.
        ('torquescale="1"', "solref 0.01 1"),
        ('solref="-300 -20" solimp="0.9 0.95 0.001"', "solref -300 -20, solimp 0.9 0.95 0.001"),
        ('torquescale="0.5"', "solref 0.01 1, torquescale 0.5"),
    ],
)
def test_softness_that_an_exact_loop_does_not_have_is_named(tmp_path: Path, attributes: str, said: str) -> None:
    model = loaded(tmp_path, f'<weld name="x" site1="s" site2="r" {attributes}/>')
    assert f"left out, since loops are exact: 'x' ({said})" in model.notes
    path = tmp_path / "plain.xml"
    path.write_text((SCENE % '<weld name="x" site1="s" site2="r"/>').replace('solref="0.01 1"', ""))
    assert not any("exact: " in note for note in mb.load(path).notes)
    assert mb.load(path).loops == model.loops


@pytest.mark.thorough("1-frame")
@pytest.mark.parametrize("kind", ["point", "frame"])
@pytest.mark.parametrize("seed", range(2))
def test_a_loop_survives_mjcf(tmp_path: Path, seed: int, kind: str) -> None:
    model, _ = closed_tree(seed, kind)
    # What MJCF cannot say of dampers is not this test's.
    model = model.without("damping")
    made = mb.convert(model, "mjcf")
    assert made.worst < 1e-11
    assert any("softly" in note for note in made.notes)
    back = mb.load(made.write(tmp_path / "loop.xml"))
    (mine,), (theirs,) = model.loops, back.loops
    assert (theirs.name, theirs.kind, theirs.body_a, theirs.body_b) == (mine.name, kind, mine.body_a, mine.body_b)
    # Stacks of joints are joints of their own in MJCF: the ends are where they were in the pose of the file.
    ends = [mb.dynamics(x, "mujoco").constraint_law(x.neutral(), *np.zeros((2, x.nv))) for x in (model, back)]
    assert np.allclose(ends[0].residual, ends[1].residual, rtol=0, atol=1e-13)


def test_soft_loops_are_told_once_for_each_model_with_what_they_cost(monkeypatch):
    monkeypatch.setattr(engine, "_TOLD", set())
    model = mb.catalog.slider_crank()
    q, v = mb.dynamics(model).project([0.5, -0.2, -0.1], [1.0, 0.0, 0.0])
    tau = np.zeros(3)
    soft = mb.dynamics(model, "mujoco")
    rigid = mb.dynamics(model).forward_dynamics(q, v, tau)
    with pytest.warns(MbkitWarning, match="MuJoCo holds loops by soft constraints") as told:
        a = soft.forward_dynamics(q, v, tau)
    off = 100 * np.linalg.norm(a - rigid) / np.linalg.norm(rigid)
    assert f"accelerations are {off:.2g} % off" in str(told[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        soft.forward_dynamics(q, v, tau)
        mb.dynamics(model, "mujoco").forward_dynamics(np.array([q, q]), v, tau)
        mb.dynamics(mb.catalog.pendulum(), "mujoco").forward_dynamics([0.1], [0.0], [0.0])
    with pytest.warns(MbkitWarning, match="soft constraints"):
        mb.dynamics(model, "mujoco", solref=(0.002, 1.0)).forward_dynamics(q, v, tau)
