"""Forces of MJCF files beside weights and joints' linear springs, against bare MuJoCo: M, bias, passive forces."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import ModelError, UnsupportedError
from mbkit.load import mjcf_reader
from mbkit.load.mjcf_attributes import rules
from mbkit.show import shapes_of
from tests.random_files import errors, mujoco_terms, random_mjcf, terms_of, with_tendons
from tests.scenes import chain, hinge

ENGINES = ("lagrangian", "pinocchio", "mujoco", "oracle")


def written(text: str, folder: Path, name: str = "m.xml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def check(path: Path, engines: tuple[str, ...] = ENGINES, **options: Any) -> tuple[mb.Model, np.ndarray]:
    """Compare a file with bare MuJoCo; return the model, and the passive forces there."""
    model, at = mb.load(path, **options), terms_of(mujoco.MjModel.from_xml_path(str(path)), 4, 0)
    passive = at.actuated if options.get("actuators") else at.passive
    for engine in engines:
        dyn = mb.dynamics(model, engine)
        for name, x, exact in (
            ("M", dyn.mass_matrix(at.q), at.M),
            ("nle", dyn.nle(at.q, at.v), at.nle),
            ("passive", dyn.passive(at.q, at.v), passive),
        ):
            assert np.abs(x - exact).max() < 1e-12 * max(np.abs(exact).max(), 1.0), (engine, name)
    return model, passive


# Gravity compensation


def arm(held: str = 'gravcomp="0.7"', joint: str = "", more: str = "", option: str = "") -> str:
    """Return a free base with a body of two joints and a fixed tool, all of them held."""
    return f"""<mujoco model="arm"><option gravity="1 2 -9">{option}</option><worldbody>
      <body name="base" {held} pos="0 0 1"><freejoint name="f"/><geom type="box" size=".1 .2 .3" pos=".2 .1 .3"/>
        <body name="link" pos="0 0 .6" gravcomp="-0.3"><joint name="j" axis="1 0 0" damping="1" {joint}/>
          <joint name="k" axis="0 1 1" stiffness="3" {joint}/><geom size=".1" pos=".1 0 .2" euler="1 2 3"/>
          <body name="tool" pos="0 .3 0" gravcomp="1"><geom type="capsule" size=".1 .2" pos=".1 .1 0"/></body></body>
      </body></worldbody>{more}</mujoco>"""


@pytest.mark.thorough("", '<flag spring="disable"/>')
@pytest.mark.parametrize("option", ["", '<flag gravity="disable"/>', '<flag spring="disable"/>'])
def test_gravity_compensation_is_that_of_mujoco(option: str, tmp_path: Path) -> None:
    model, passive = check(written(arm(option=option), tmp_path))
    assert [f.fraction for f in model.forces] == [0.7, -0.3, 1.0]
    assert passive[:, :6].any() != ("gravity" in option)
    assert not any("gravity compensation" in note for note in model.notes)
    # With springs and dampers off MuJoCo holds no weight.
    model, passive = check(written(arm(option='<flag spring="disable" damper="disable"/>'), tmp_path), ("lagrangian",))
    assert not passive.any()
    assert not model.forces


@pytest.mark.thorough("1", "2", "6", "7")
@pytest.mark.parametrize("seed", range(8))
def test_gravity_compensation_of_random_files_is_that_of_mujoco(seed: int, tmp_path: Path) -> None:
    numbers = iter(np.random.default_rng(seed).uniform(-1, 2, 100))
    text = re.sub("<body ", lambda _: f'<body gravcomp="{float(next(numbers))!r}" ', random_mjcf(seed))
    model, at = mb.load(written(text, tmp_path)), mujoco_terms(text, 3, seed)
    passive = mb.dynamics(model.without("friction"), "lagrangian").passive(at.q, at.v)
    assert model.forces
    # Weights cancel in the sums that MuJoCo and mbkit form in another order.
    assert np.abs(passive - at.passive).max() < 1e-13 * max(np.abs(at.passive).max(), np.abs(at.nle).max(), 1.0)


def test_without_a_weight_held_upwards_mujoco_holds_none(tmp_path: Path) -> None:
    text = arm(held='gravcomp="-0.5"').replace('gravcomp="1"', "")
    model, passive = check(written(text, tmp_path), ("lagrangian",))
    assert not model.forces
    # The joints' damper and spring are left.
    assert not passive[:, :6].any()
    (read,) = mb.compare_parsers(written(text, tmp_path), ("mujoco",), samples=1).importers
    assert read.agrees
    b = hinge(mass=2.0, com=(0.5, 0, 0.1), axis=(0, -1, 0))
    b.add_gravity_compensation("a", -0.5)
    with pytest.raises(UnsupportedError, match="gravity compensation of 'a'"):
        mb.convert(b.build(), "mjcf")
    with pytest.raises(UnsupportedError, match="gravity compensation of 'a'"):
        mb.simulate(mb.dynamics(b.build(), "mujoco"), [0.1], [0.0], 0.1, "mujoco_rk4", 1e-2)


MOTOR = '<actuator><motor joint="k"/></actuator>'


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize(
    ("lifted", "more", "actuators"), [("jk", MOTOR, True), ("k", MOTOR, True), ("jk", MOTOR, False), ("k", "", True)]
)
def test_weight_that_actuators_hold(actuators: bool, more: str, lifted: str, tmp_path: Path) -> None:
    """MuJoCo counts it as actuation, wherever the actuators are; without any it does not act."""
    text = arm(more=more)
    for name in lifted:
        text = text.replace(f'name="{name}"', f'name="{name}" actuatorgravcomp="true"')
    model, _ = check(written(text, tmp_path), actuators=actuators)
    assert any(bool(f.without) for f in model.forces) != (actuators and bool(more))
    said = "act as passive" if actuators and more else "do not act" if actuators else "left out; with actuators=True"
    assert any(f"servos of gravity compensation by actuators {said}" in note for note in model.notes)
    assert "servos of gravity compensation" in repr(model)
    q, v = model.random_state(0)
    ours, theirs = (mb.simulate(mb.dynamics(model, "mujoco"), q, v, 0.05, x, 1e-3) for x in ("rk4", "mujoco_rk4"))
    np.testing.assert_allclose(ours.q[-1], theirs.q[-1], rtol=0, atol=1e-9)
    assert np.abs(ours.power_balance()).max() < 1e-5 * abs(ours.energy()[0])
    back = mb.load(written(mb.convert(model, "mjcf").text, tmp_path))
    assert mb.explain(model, back).agree
    (read,) = mb.compare_parsers(written(text, tmp_path), ("mujoco",), samples=1).importers
    assert read.agrees


def test_a_held_weight_is_a_parameter_and_has_an_energy() -> None:
    b = hinge(mass=2.0, com=(0.5, 0, 0.1), axis=(0, -1, 0))
    b.add_gravity_compensation("a", mb.Parameter("c", 0.75))
    model = b.build()
    bare = model.without("forces")
    for engine in ENGINES:
        dyn, other = mb.dynamics(model, engine), mb.dynamics(bare, engine)
        for c in (0.75, -0.2):
            at = dyn.at(c=c)
            np.testing.assert_allclose(at.passive([0.3], [1.0]), c * other.gravity([0.3]), rtol=1e-14)
            np.testing.assert_allclose(at.potential_energy([0.3]), (1 - c) * other.potential_energy([0.3]), rtol=1e-14)
    symbols = mb.lagrangian.from_model(model)
    (V, bare_V) = (x.V.subs({"c": 0.75, "j": 0.3, "g": 9.81}) for x in (symbols, mb.lagrangian.from_model(bare)))
    assert float(V) == pytest.approx(0.25 * float(bare_V), rel=1e-14)
    assert not mb.dynamics(model.without("gravity")).passive([0.3], [0.0]).any()


def test_a_held_weight_is_written_read_and_told(tmp_path: Path) -> None:
    model = mb.load(written(arm().replace("euler", "zaxis"), tmp_path))
    back = mb.load(written(mb.convert(model, "mjcf").text, tmp_path))
    assert {f.body: f.fraction for f in back.forces} == {"base": 0.7, "link": -0.3, "tool": 1.0}
    assert mb.explain(model, back).agree
    without = mb.explain(model, model.without("forces"))
    assert not without.agree
    assert without.explained
    assert {c.kind for c in without.acting} == {"gravity compensation"}
    with pytest.raises(UnsupportedError, match="gravity compensation of 'base'"):
        mb.convert(model, "urdf")
    elsewhere = [replace(f, without=("j",)) if f.body == "link" else f for f in model.forces]
    other = replace(model, forces=tuple(elsewhere))
    (cause,) = mb.explain(model, other).acting
    assert "at other joints" in cause.says
    with pytest.raises(UnsupportedError, match="one answer for each joint"):
        mb.dynamics(other, "mujoco")
    pinocchio, read = mb.compare_parsers(written(arm(), tmp_path), ("pinocchio", "mujoco"), samples=1).importers
    assert read.agrees
    assert pinocchio.explanation is not None
    assert {c.kind for c in pinocchio.explanation.acting} >= {"gravity compensation"}


def test_faults_of_gravity_compensation_are_named() -> None:
    b = hinge(body="link", joint="hinge")
    for body in ("lnik", "link", "link"):
        b.add_gravity_compensation(body, without=("hinge", "hnige"))
    with pytest.raises(ModelError) as caught:
        b.build()
    for told in ("unknown body 'lnik'; did you mean 'link'?", "declared 2 times", "unknown joint 'hnige'"):
        assert told in str(caught.value)


# Copies


REPLICATED = """<mujoco model="ring"><compiler eulerseq="XYz"/>
  <default><default class="light"><geom density="300"/></default></default>
  <worldbody><body name="hub" pos="0 0 1"><joint name="spin" axis="0 0 1"/>
    <geom type="box" size=".2 .3 .1"/><site name="o"/>
    <replicate count="3" offset=".1 .02 .0333333333333" euler="10 20 33.333333333" sep="_" childclass="light">
      <frame pos="1 .1 0"><body name="arm"><joint name="j" axis="1 2 0" damping=".1"/>
        <geom size=".1 .2" type="capsule"/><site name="s" pos=".1 .2 .3"/>
        <replicate count="2" euler="0 90 0"><body name="tip" pos=".3 0 0"><joint name="k" type="slide" axis="1 0 .1"/>
          <geom size=".05" pos=".1 0 0"/></body></replicate></body></frame></replicate>
    <body name="last"><joint name="z" axis="1 0 0"/><geom size=".1" pos="0 0 .3"/></body></body></worldbody>
  <tendon><fixed name="t" stiffness="2" damping=".3"><joint joint="j" coef="1.5"/>
    <joint joint="spin" coef="-.7"/></fixed>
    <fixed stiffness="1"><joint joint="k" coef="1"/></fixed></tendon>
  <actuator><position joint="k" kp="3" kv="1"/><damper tendon="t" kv="1" ctrlrange="0 1"/></actuator>
  <equality><joint joint1="j" joint2="spin" polycoef=".1 2 0 0 0"/><connect body1="arm" anchor="1 2 3"/></equality>
</mujoco>"""


def test_copies_are_those_of_mujoco(tmp_path: Path) -> None:
    path = written(REPLICATED, tmp_path)
    model, _ = check(path, ("lagrangian", "mujoco"), actuators=True, loops=False)
    compiled = mujoco.MjModel.from_xml_string(REPLICATED)
    assert [b.name for b in model.bodies if not b.name.startswith("hub_")] == [
        compiled.body(i).name for i in range(1, compiled.nbody)
    ]
    assert list(model.joint_names) == [compiled.joint(i).name for i in range(compiled.njnt)]
    (note,) = (n for n in model.notes if "<replicate>" in n)
    assert all(x in note for x in ("3 copies (line 5)", "2 copies (line 8)", "left out, as by MuJoCo (joint, line 15)"))
    assert len(mb.load(path).loops) == compiled.neq == 3
    (read,) = mb.compare_parsers(path, ("mujoco",), samples=1).importers
    assert read.agrees


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('count="3"', 'count="1.5"'), "whole number"),
        (('count="3"', 'count="100000000"'), "whole number up to"),
        (('count="3"', ""), "count"),
        (('count="3"', 'count="-1"'), "whole number up to"),
        (('sep="_"', 'pos="1 0 0"'), "unknown attribute 'pos'"),
        (('<frame pos="1 .1 0">', '<frame pos="1 .1 0"/><joint/><frame>'), "<joint> is not copied"),
    ],
)
def test_faults_of_copies_are_named(change: tuple[str, str], said: str, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=said):
        mb.load(written(REPLICATED.replace(*change), tmp_path))
    none = mb.load(written(REPLICATED.replace('count="3"', 'count="0"').split("<tendon")[0] + "</mujoco>", tmp_path))
    assert list(none.joint_names) == ["spin", "z"]


def test_copies_that_are_too_many_are_refused_before_any_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = "<body><joint/><geom size='.1'/></body>"

    def refused(inside: str, said: str) -> None:
        path = written(f"<mujoco><worldbody>{inside}</worldbody></mujoco>", tmp_path)
        with pytest.raises(ModelError, match=said) as caught:
            mb.load(path)
        assert len(caught.value.faults) == 1

    # Those beside each other count together.
    each = '<replicate count="{}">' + body + "</replicate>"
    refused(each.format(10) + each.format(124_999), "'124999'; expected a whole number up to 124990")
    monkeypatch.setattr(mjcf_reader, "_suffixed", lambda *_: pytest.fail("copied"))
    copies = '<replicate count="300" offset="1 0 0">{}</replicate>'
    refused(copies.format(copies.format(copies.format(body))), "count '300'; expected a whole number up to ")


def test_a_body_in_one_of_its_name_is_a_fault(tmp_path: Path) -> None:
    inner = '<body name="b"><geom size=".1"/></body>'
    text = f'<mujoco><worldbody><body name="b"><joint/><geom size=".1"/>{inner}</body></worldbody></mujoco>'
    with pytest.raises(ModelError, match="body 'b': declared more than once"):
        mb.load(written(text, tmp_path))


# Springs whose rest MuJoCo measures, and of several coordinates

RESTING = """<mujoco model="tied"><worldbody><site name="o" pos=".1 .2 .3"/>
  <body name="base" pos="0 .3 1" euler="10 20 30"><freejoint name="f"/><geom type="box" size=".1 .2 .3" pos=".2 .1 .3"/>
    <site name="b" pos=".3 .1 0"/>
    <body name="link" pos="0 0 .6" euler="0 10 0"><joint name="j" axis="1 0 .2" pos="0 .1 0" ref="15" springref="40"/>
      <geom size=".1" pos=".1 0 .2"/><body name="end" pos=".1 .2 .3" euler="3 2 1">
      <joint name="k" type="slide" axis="1 1 0" ref=".1" springref="-.2"/><joint name="l" type="ball"/>
      <geom size=".1 .2" type="capsule" pos="0 0 .3"/><site name="e" pos=".2 .3 .4"/></body></body></body></worldbody>
  <tendon><spatial name="free" stiffness="3" damping=".1"><site site="o"/><site site="e"/></spatial>
    <spatial name="inner" stiffness="2" springlength="-1 -1"><site site="b"/><site site="e"/></spatial>
  </tendon></mujoco>"""


def test_a_tendon_rests_at_the_length_that_mujoco_measures(tmp_path: Path) -> None:
    model, _ = check(written(RESTING, tmp_path))
    assert [s.name for s in model.springs] == ["free", "inner"]
    compiled = mujoco.MjModel.from_xml_string(RESTING)
    lengths = [s.rest_length for s in model.springs]
    np.testing.assert_allclose(lengths, compiled.tendon_lengthspring[:, 0], rtol=1e-14)


def test_a_tendon_on_one_joint_acts_by_the_square_of_its_factor(tmp_path: Path) -> None:
    tendon = '<tendon><fixed name="t" stiffness="3" damping=".4"><joint joint="j" coef="-2"/></fixed></tendon>'
    model, passive = check(written(arm(held="", more=tendon).replace(' gravcomp="-0.3"', ""), tmp_path))
    assert model.joint("j").damping == 1.0 + 4 * 0.4
    assert passive[:, 6].any()


NONLINEAR = """<mujoco model="bent"><option>{option}</option><worldbody>
  <body name="base" pos="0 .3 1" euler="10 20 30"><joint type="free" name="f" stiffness="{free}" damping="2"/>
    <geom type="box" size=".1 .2 .3" pos=".2 .1 .3"/>
    <body name="link" pos="0 0 .6" euler="0 10 0"><joint name="j" axis="1 0 .2" pos="0 .1 0" ref="15" springref="40"
      stiffness="1 2 3" damping=".1 .2 .3"/><joint name="w" type="slide" stiffness="0 0 2" damping="0 1"/>
      <geom size=".1" pos=".1 0 .2"/><body name="end" pos=".1 .2 .3" euler="3 2 1">
      <joint name="l" type="ball" pos=".1 0 0" stiffness="{ball}" damping=".1" armature="{armature}"/>
      <geom size=".1 .2" type="capsule" pos="0 0 .3"/></body></body></body></worldbody></mujoco>"""


@pytest.mark.thorough("2 0 3-0 0 1-", '2-1-<flag spring="disable"/>', '2-1-<flag damper="disable"/>')
@pytest.mark.parametrize(
    ("free", "ball", "option"),
    [
        ("2", "3", ""),
        ("2 0 3", "0 0 1", ""),
        ("2", "1", '<flag spring="disable"/>'),
        ("2", "1", '<flag damper="disable"/>'),
    ],
)
def test_springs_of_all_joints_and_polynomials(free: str, ball: str, option: str, tmp_path: Path) -> None:
    path = written(NONLINEAR.format(free=free, ball=ball, option=option, armature="0"), tmp_path)
    model, passive = check(path, ENGINES if option == "" else ("lagrangian",))
    assert np.abs(passive).max() > 0.1
    (read,) = mb.compare_parsers(path, ("mujoco",), samples=1).importers
    assert read.agrees
    assert bool([f for f in model.forces if "spring" in f.name]) == ("spring" not in option)


def test_mujocos_own_steps_have_its_springs_of_ball_and_free_joints(tmp_path: Path) -> None:
    text = NONLINEAR.format(free="20", ball="3", option="", armature="0")
    for polynomial in ('stiffness="1 2 3" damping=".1 .2 .3"', 'stiffness="0 0 2" damping="0 1"'):
        text = text.replace(polynomial, "")
    model = mb.load(written(text, tmp_path))
    q, v = model.random_state(0)
    own = mb.simulate(mb.dynamics(model, "mujoco"), q, v, 0.3, "mujoco_rk4", 1e-3)
    ours = mb.simulate(mb.dynamics(model, "lagrangian", compile=False), q, v, 0.3, "rk4", 1e-3)
    np.testing.assert_allclose(own.q[-1], ours.q[-1], rtol=0, atol=1e-11)
    back = written(mb.convert(model, "mjcf").text, tmp_path)
    check(back, ("mujoco",))
    bare, same = (
        terms_of(mujoco.MjModel.from_xml_path(str(x)), 2, 0) for x in (written(text, tmp_path, "a.xml"), back)
    )
    np.testing.assert_allclose(same.passive, bare.passive, rtol=0, atol=1e-12 * np.abs(bare.passive).max())
    # A spring by a function is not MuJoCo's, nor one that is not alike about all axes.
    b = chain({"kind": "ball", "mass": 1.0, "inertia": (0.1, 0.1, 0.1), "parent": "world"})
    b.add_bushing("soft", body_a="world", body_b="b0", stiffness=[0, 0, 0, 1, 2, 1])
    with pytest.raises(UnsupportedError, match="soft"):
        mb.simulate(mb.dynamics(b.build(), "mujoco"), [0, 0, 0, 1], [1, 0, 0], 0.1, "mujoco_rk4", 1e-2)


@pytest.mark.thorough("3-True")
@pytest.mark.parametrize(("spring", "run"), [("3", True), ("3 0 2", False)])
def test_a_check_runs_springs_of_ball_joints_or_says_why_not_and_names_what_is_left_out(
    spring: str, run: bool, tmp_path: Path
) -> None:
    """MuJoCo has linear springs of ball joints; a fluid acts in none of mbkit's engines."""
    joint = '<joint type="ball" stiffness="3"/>' if run else f'<joint axis="0 1 0" stiffness="{spring}"/>'
    world = f'<body pos="0 0 1">{joint}<geom type="box" size=".1 .2 .3" pos="0 0 -.3"/></body>'
    text = f'<mujoco><option density="1.2"/><worldbody>{world}</worldbody></mujoco>'
    result = mb.compare(mb.load(written(text, tmp_path)), samples=2)
    assert [x.says for x in result.findings if x.kind == "left out of the motion"] == [
        "the forces of a fluid (option density 1.2), with fluidshape and fluidcoef of geoms"
    ]
    assert bool(result.rollouts) is run
    assert all(row.passed for row in result.rollouts)
    assert any(r.term == "rollouts" and "do not hold all" in r.reason for r in result.refusals) is not run


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("{ball}", "1 1"), "joint 'l': stiffness that grows"),
        (('damping="2"', 'damping="2" armature="-1"'), "joint 'f': armature -1"),
    ],
)
def test_springs_and_dampers_that_are_not_read_are_refused(change: tuple[str, str], said: str, tmp_path: Path) -> None:
    text = NONLINEAR.replace(*change).format(free="1", ball="1", option="", armature="0")
    with pytest.raises(ModelError, match=said):
        mb.load(written(text, tmp_path))


def test_dampers_that_grow_with_the_speed_of_any_joint(tmp_path: Path) -> None:
    text = NONLINEAR.format(free="0", ball="0", option="", armature="0")
    text = text.replace('damping="2"', 'damping="2 1 .5"').replace('damping=".1"', 'damping=".1 2 .3"')
    model, passive = check(written(text, tmp_path), (*ENGINES, "drake"))
    assert np.abs(passive[:, :6]).max() > 1.0
    assert [f.name for f in model.forces if "damper" in f.name] == [f"damper of {j}" for j in "fjwl"]


def test_armature_of_a_free_joint_is_matter_without_weight(tmp_path: Path) -> None:
    text = arm().replace('<freejoint name="f"/>', '<joint name="f" type="free" armature="0.3"/>')
    model, at = mb.load(written(text, tmp_path)), mujoco_terms(text, 4, 0)
    assert "the armature of free joint 'f' is a body without weight, of 0.3 kg" in " ".join(model.notes)
    for engine in (*ENGINES, "drake"):
        dyn = mb.dynamics(model, engine)
        # The weight that is held stands on both sides.
        forces = dyn.nle(at.q, at.v) - dyn.passive(at.q, at.v)
        for x, exact in ((dyn.mass_matrix(at.q), at.M), (forces, at.nle - at.passive)):
            assert np.abs(x - exact).max() < 1e-12 * max(np.abs(exact).max(), 1.0), engine
    # It is no mass: MuJoCo's centre of mass and momentum do not know it.
    assert model.mass == pytest.approx(mujoco.MjModel.from_xml_string(text).body_subtreemass[0], rel=1e-14)
    bare = mb.load(written(text.replace(' armature="0.3"', ""), tmp_path, "bare.xml"))
    assert model.without("armature").mass == model.mass
    for engine in (*ENGINES, "drake"):
        dyn, without = mb.dynamics(model, engine), mb.dynamics(model.without("armature"), engine)
        other, q, v = mb.dynamics(bare, engine), at.q[0], at.v[0]
        for x in (dyn, without):
            assert np.abs(x.center_of_mass(q) - other.center_of_mass(q)).max() < 1e-14, engine
            assert np.abs(x.centroidal_momentum(q, v) - other.centroidal_momentum(q, v)).max() < 1e-13, engine
        assert np.abs(without.mass_matrix(q) - other.mass_matrix(q)).max() < 1e-13, engine
        # Without forces it still has no weight.
        loose = [mb.dynamics(x.without("forces", "springs", "damping"), engine) for x in (model, bare)]
        assert np.abs(np.subtract(*(x.nle(q, 0 * v) - x.passive(q, 0 * v) for x in loose))).max() < 1e-12, engine
    com = mb.dynamics(model, "lagrangian").function("center_of_mass")(at.q[0]).full().ravel()
    assert np.abs(com - mb.dynamics(bare).center_of_mass(at.q[0])).max() < 1e-14
    assert not any("armature" in name for name in mb.variants(model, {"*.mass": 0.1}, size=2).values)
    assert mb.lint(model).links == mb.lint(bare).links == 3
    # MuJoCo's own model has no such body to compare.
    (read,) = mb.compare_parsers(written(text, tmp_path), ("mujoco",), samples=1).importers
    assert read.refused.startswith("joint 'f' is free and has armature")


def test_armature_of_a_ball_joint(tmp_path: Path) -> None:
    text = NONLINEAR.format(free="0", ball="0", option="", armature="0.7")
    for polynomial in ('stiffness="1 2 3" damping=".1 .2 .3"', 'stiffness="0 0 2" damping="0 1"'):
        text = text.replace(polynomial, "")
    path = written(text, tmp_path)
    model, _ = check(path)
    q, v = model.random_state(0)
    a = np.random.default_rng(0).standard_normal(model.nv)
    exact = mb.dynamics(model, "oracle").inverse_dynamics(q, v, a)
    for elimination in ("links", "mass matrix", "least constraint"):
        dyn = mb.dynamics(model, "lagrangian", elimination=elimination)
        np.testing.assert_allclose(dyn.forward_dynamics(q, v, exact), a, rtol=0, atol=1e-12 * np.abs(a).max())
    back = mb.load(written(mb.convert(model, "mjcf").text, tmp_path))
    assert mb.explain(model, back).agree
    assert back.joint("l").armature.tolist() == [0.7] * 3


BANDS = """<tendon><spatial stiffness="3" damping=".1" springlength="0 1.2"><site site="o"/><site site="e"/></spatial>
  <spatial name="bent" stiffness="2 .5 .3" springlength=".4"><site site="b"/><site site="e"/></spatial>
  <fixed stiffness="2 .5 .3" springlength="-.2 .1"><joint joint="j" coef="-1.5"/></fixed>
  <fixed stiffness="2 0 .3"><joint joint="k" coef="2"/></fixed>"""
OVER_SITES = """<fixed name="sum" stiffness="2 1" springlength="-.1 .2"><joint joint="j" coef="1"/>
    <joint joint="k" coef=".5"/></fixed>
  <spatial name="over" stiffness="2" damping=".3"><site site="o"/><site site="b"/><site site="e"/></spatial>
  <spatial name="drum" stiffness="1 1" damping=".3 .2"><site site="o"/><site site="b"/><pulley divisor="2"/>
    <site site="b"/><site site="e"/></spatial>
  <spatial name="push" stiffness="-1" damping="-.2"><site site="b"/><site site="e"/></spatial>"""


@pytest.mark.thorough("False")
@pytest.mark.parametrize("off", [False, True])
def test_springs_of_tendons_that_rest_between_two_lengths(off: bool, tmp_path: Path) -> None:
    text = RESTING.split("<tendon>")[0] + BANDS
    if off:
        text = text.replace("<worldbody>", '<option><flag spring="disable"/></option><worldbody>')
    path = written(f"{text}</tendon></mujoco>", tmp_path)
    model, _ = check(path)
    assert len(model.forces) == (0 if off else 4)
    (read,) = mb.compare_parsers(path, ("mujoco",), samples=1).importers
    assert read.agrees


def test_springs_and_dampers_over_several_sites_and_joints(tmp_path: Path) -> None:
    more = '<general tendon="drum" gear="-2" damping=".3 .4 .5"/><general joint="j" damping=".3 0 .5"/>'
    text = f"{RESTING.split('<tendon>')[0]}<tendon>{OVER_SITES}</tendon><actuator>{more}</actuator></mujoco>"
    path = written(text, tmp_path)
    model, _ = check(path, ("mujoco",))
    assert any("'drum': stiffness 1 1 0, rest length" in note for note in model.notes)
    dyn = mb.dynamics(model.without("damping"), "lagrangian", compile=False)
    (read,) = mb.compare_parsers(path, ("mujoco",), samples=1).importers
    assert read.agrees
    # The springs' forces are those of their energy.
    q = model.random_state(0)[0]
    at = mujoco_terms(re.sub(' damping="[^"]*"', "", text), 1, 0)
    h = 1e-6
    step = np.eye(model.nv) * h
    slope = [
        (dyn.potential_energy(model.integrate(q, x)) - dyn.potential_energy(model.integrate(q, -x))) / 2 for x in step
    ]
    still = np.zeros(model.nv)
    springs = mb.load(written(re.sub(' damping="[^"]*"', "", text), tmp_path))
    passive = mb.dynamics(springs, "lagrangian", compile=False)
    np.testing.assert_allclose(passive.passive(at.q, at.v), at.passive, rtol=0, atol=1e-12 * np.abs(at.passive).max())
    np.testing.assert_allclose(np.array(slope) / h, dyn.gravity(q) - passive.passive(q, still), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("tendon", "actuator", "said"),
    [
        ('armature=".1"', "", "tendon 't': armature of a path over sites"),
        ("", 'tendon="t" armature=".1"', "armature of a path over sites"),
        ("", 'joint="l" armature=".1"', "armature of what is no sum"),
        ("", 'joint="l" damping=".1"', "damping of what is no sum"),
        ('stiffness="2"', "", "tendon 't': stiffness of what is no sum"),
        ('damping="2"', "", "tendon 't': damping of what is no sum"),
    ],
)
def test_what_acts_on_a_path_and_has_no_description_is_refused(
    tendon: str, actuator: str, said: str, tmp_path: Path
) -> None:
    # A path around a geom acts where it has a stiffness or a damping alone.
    around = '<geom geom="g"/>' if "armature" not in tendon + actuator else '<site site="b"/>'
    path = f'<spatial name="t" {tendon}><site site="o"/>{around}<site site="e"/></spatial>'
    text = (
        RESTING.split("<tendon>")[0].replace("<geom ", '<geom name="g" ', 1).replace('type="box" size=".1', 'size=".1')
    )
    text += f"<tendon>{path}</tendon>{actuator and f'<actuator><general {actuator}/></actuator>'}</mujoco>"
    mujoco.MjModel.from_xml_string(text)
    with pytest.raises(ModelError, match=said):
        mb.load(written(text, tmp_path))


@pytest.mark.thorough(every=8)
@pytest.mark.parametrize("seed", range(24))
def test_random_tendons_are_those_of_mujoco(seed: int, tmp_path: Path) -> None:
    text = with_tendons(random_mjcf(seed), seed)
    at, model = mujoco_terms(text, 2, seed), mb.load(written(text, tmp_path))
    dyn = mb.dynamics(model.without("friction"), "lagrangian", compile=False)
    found = errors(at, dyn.mass_matrix(at.q), dyn.nle(at.q, at.v), dyn.passive(at.q, at.v))
    assert max(found.values()) < 1e3


VALUES = (".7", ".3 1 2", "true", ".1 1", "t", "u", "w", "s", "affine", ".2 .5 .3 .1", "1 2 3 4 5 6", "-1 .5")


def moved(name: str, given: dict[str, str]) -> str:
    """Return an MJCF with a tendon on joints, one over sites, and an actuator, one of which has attributes."""
    own = " ".join(f'{k}="{x}"' for k, x in given.items())
    at = {x: own if x == name else "" for x in ("fixed", "spatial")}
    actuator = "" if name in at else f"<actuator><{name} {own}/></actuator>"
    return f"""<mujoco><worldbody><site name="o" pos="1 1 1"/><body name="b">
      <joint name="j" axis="1 0 0" springref="20"/><geom size=".1" pos=".3 0 0"/>
      <site name="s" pos="1 0 0"/><body name="c" pos="0 0 1"><joint name="h"/>
      <geom size=".1" pos="0 .2 0"/><site name="r" pos="0 1 0"/></body></body>
      <body name="d"><joint name="w" type="ball"/><geom size=".1" pos=".1 0 0"/></body></worldbody><tendon>
      <fixed name="t" {at["fixed"]}><joint joint="j" coef="2"/><joint joint="h" coef="-.5"/></fixed>
      <spatial name="u" {at["spatial"]}><site site="o"/><site site="s"/><site site="r"/></spatial></tendon>
      {actuator}</mujoco>"""


@pytest.mark.thorough("general", "position", "velocity", "pid", "cylinder", "damper")
@pytest.mark.parametrize("name", ["fixed", "spatial", "general", "position", "velocity", "pid", "damper", "cylinder"])
def test_no_attribute_of_tendons_and_actuators_changes_the_motion_in_silence(name: str, tmp_path: Path) -> None:
    """M, nle and passive forces are as in MuJoCo or refused; at zero control a note may say what is left out."""
    section = rules().children["tendon" if name in ("fixed", "spatial") else "actuator"]
    ways = [{}] if name in ("fixed", "spatial") else [{"joint": "j"}, {"tendon": "t"}, {"tendon": "u"}, {"joint": "w"}]
    ways = [x | ({"ctrlrange": "0 1"} if name == "damper" else {}) for x in ways]
    felt = 0
    for way, key in ((x, k) for x in ways for k in sorted(section.children[name].attributes)):
        before = mujoco_terms(moved(name, way), 1, 0)
        for value, acts in ((x, a) for x in VALUES for a in ("passive", "actuated")):
            terms, text = ("M", "nle", acts), moved(name, way | {key: value})
            try:
                at = mujoco_terms(text, 1, 0)
            except ValueError:
                continue
            if all(np.abs(getattr(at, x) - getattr(before, x)).max() < 1e-10 for x in terms):
                continue
            felt += 1
            try:
                model = mb.load(written(text, tmp_path), actuators=acts == "actuated")
            except ModelError:
                break
            dyn = mb.dynamics(model, "lagrangian", compile=False)
            own = dyn.mass_matrix(at.q), dyn.nle(at.q, at.v), dyn.passive(at.q, at.v)
            agrees = all(
                np.abs(x - getattr(at, n)).max() < 1e-9 * max(1.0, np.abs(getattr(at, n)).max())
                for n, x in zip(terms, own, strict=True)
            )
            said = acts == "actuated" and any(n.startswith("left out of the motion of actuators") for n in model.notes)
            assert agrees or said, (way, key, value, acts)
            break
    assert felt >= 3


# Curves

KNEE = """<mujoco model="knee"><worldbody><body name="thigh"><joint name="hip" axis="0 1 0"/>
  <geom size=".1 .2" type="capsule" pos="0 0 -.2"/><body name="shin" pos="0 0 -.4">
  <joint name="slip" type="slide" axis="1 0 .1" ref=".1"/><joint name="knee" axis="0 1 0" ref="20"/>
  <geom size=".1 .2" type="capsule" pos=".1 0 -.2"/></body></body></worldbody>
  <equality><joint name="roll" joint1="slip" joint2="knee" polycoef=".02 .3 -.4 .5 -.6"/></equality></mujoco>"""


def test_an_equality_of_higher_degree_is_a_curve(tmp_path: Path) -> None:
    path = written(KNEE, tmp_path)
    model = mb.load(path)
    compiled = mujoco.MjModel.from_xml_string(KNEE)
    data, q, v = mujoco.MjData(compiled), np.array([0.3, 0.25, 0.7]), np.array([1.0, 2.0, -3.0])
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(compiled, data)
    for engine in ("lagrangian", "pinocchio", "oracle"):
        dyn = mb.dynamics(model, engine)
        np.testing.assert_allclose(dyn.constraint_residual(q), data.efc_pos, rtol=0, atol=1e-14)
        J = data.efc_J.reshape(1, 3)
        np.testing.assert_allclose(dyn.constraint_jacobian(q), J, rtol=0, atol=1e-14)
        # MuJoCo knows no J̇ v: the Jacobian's central difference along v.
        h = 1e-5
        rate = (dyn.constraint_jacobian(q + h * v) - dyn.constraint_jacobian(q - h * v)) / (2 * h)
        np.testing.assert_allclose(dyn.constraint_bias(q, v), rate @ v, rtol=1e-8)
    at, rates = mb.dynamics(model).project(q, v)
    tau = np.array([1.0, -2.0, 3.0])
    exact = mb.dynamics(model, "oracle").forward_dynamics(at, rates, tau)
    for engine in ("lagrangian", "pinocchio"):
        a = mb.dynamics(model, engine).forward_dynamics(at, rates, tau)
        np.testing.assert_allclose(a, exact, rtol=0, atol=1e-12 * np.abs(exact).max())
    run = mb.simulate(mb.dynamics(model, "lagrangian"), at, rates, 1.0, dt=1e-3)
    assert np.abs(run.power_balance()).max() < 1e-8 * abs(run.energy()[0])
    with pytest.raises(UnsupportedError, match="'roll' is a curve"):
        mb.dynamics(model, "mujoco")
    (read,) = mb.compare_parsers(path, ("mujoco",), samples=1).importers
    assert all(stage.same for stage in read.stages if stage.name == "couplers")
    (row,) = mb.lagrangian.from_model(model).constraints
    values = dict(zip(("hip", "slip", "knee"), q, strict=True))
    assert float(row.subs({x: values[x.name] for x in row.free_symbols})) == pytest.approx(data.efc_pos[0], abs=1e-14)
    straight = replace(model.couplers[0], curve=np.zeros(3))
    (cause,) = mb.explain(model, replace(model, couplers=(straight,))).acting
    assert "curve" in cause.says


def test_numbers_of_a_curve_are_parameters_and_checked() -> None:
    wheel = {"mass": 1.0, "inertia": (0.1, 0.1, 0.1), "axis": (0, 1, 0), "parent": "world"}
    b = chain(wheel, wheel)
    b.add_coupler("cam", "j0", "j1", curve=(mb.Parameter("c", 0.5), 0.0, 0.0))
    dyn = mb.dynamics(b.build(), "lagrangian")
    for c in (0.5, 2.0):
        np.testing.assert_allclose(dyn.at(c=c).constraint_residual([0.0, 0.3]), -0.3 - c * 0.09, rtol=1e-14)
    b.add_coupler("bad", "j0", "j1", curve=(1.0, 2.0))
    with pytest.raises(ModelError, match="curve: expected shape"):
        b.build()


@pytest.mark.parametrize(
    ("equality", "why"),
    [
        ('<tendon name="e" tendon1="t" tendon2="u" polycoef=".1 .2 .3 .4 .5"/>', ""),
        ('<tendon name="e" tendon1="w" polycoef=".1 7 0 0 0"/>', ""),
        ('<tendon name="e" tendon1="u" tendon2="w" polycoef=".1 .4 0 0 0"/>', ""),
        ('<tendon name="e" tendon1="w" tendon2="t" polycoef=".1 1 0 0 0"/>', "it holds a single joint"),
        ('<tendon name="e" tendon1="v" tendon2="t"/>', ""),
        ('<tendon name="e" tendon1="t" tendon2="w" polycoef=".1 1 2 0 0"/>', "polynomial of a sum"),
        ('<tendon name="e" tendon1="line" tendon2="w"/>', "'line' is no sum of coordinates"),
    ],
)
def test_an_equality_of_tendons_is_a_coupler(equality: str, why: str, tmp_path: Path) -> None:
    lengths = {"t": {"hip": 2.0}, "u": {"knee": -3.0}, "w": {"hip": 2.0, "knee": 0.5}, "v": {"knee": 1.0, "slip": 1.0}}
    fixed = "".join(
        f'<fixed name="{name}">{"".join(f"""<joint joint="{j}" coef="{x}"/>""" for j, x in row.items())}</fixed>'
        for name, row in lengths.items()
    )
    line = '<spatial name="line"><site site="s"/><site site="r"/></spatial>'
    text = KNEE.split("<equality>")[0].replace("</body></body>", '<site name="s"/></body><site name="r"/></body>')
    text += f"<tendon>{fixed}{line}</tendon><equality>{equality}</equality></mujoco>"
    path = written(text, tmp_path)
    model = mb.load(path)
    if why:
        assert not model.couplers
        assert any(why in note for note in model.notes)
        return
    compiled = mujoco.MjModel.from_xml_string(text)
    data, q = mujoco.MjData(compiled), np.array([0.3, 0.25, 0.7])
    data.qpos[:] = q
    mujoco.mj_forward(compiled, data)
    dyn = mb.dynamics(model, "lagrangian")
    # MuJoCo's is of lengths: its Jacobian has the factor of the coupled joint.
    scale = data.efc_J[list(model.joint_names).index(model.couplers[0].joint)]
    np.testing.assert_allclose(scale * dyn.constraint_residual(q), data.efc_pos, rtol=0, atol=1e-14)
    np.testing.assert_allclose(scale * dyn.constraint_jacobian(q)[0], data.efc_J, rtol=0, atol=1e-14)
    (read,) = mb.compare_parsers(path, ("mujoco",), samples=1).importers
    assert all(stage.same for stage in read.stages if stage.name == "couplers")


@pytest.mark.parametrize("polycoef", [".5", ".5 2", ".1 .2 .3"])
def test_a_short_polynomial_is_filled_as_by_mujoco(polycoef: str, tmp_path: Path) -> None:
    text = KNEE.replace(".02 .3 -.4 .5 -.6", polycoef)
    compiled = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(compiled)
    data.qpos[:] = 0.3, 0.25, 0.7
    mujoco.mj_forward(compiled, data)
    dyn = mb.dynamics(mb.load(written(text, tmp_path)), "oracle")
    np.testing.assert_allclose(dyn.constraint_residual(data.qpos), data.efc_pos, rtol=0, atol=1e-14)


# Attached models

HAND = """<mujoco model="hand"><compiler angle="radian"/><option gravity="0 0 0"/>
  <default><joint damping=".3"/><default class="light"><geom density="300"/><joint range="-1 1" springref=".2"/>
  <position kp="3"/></default></default>
  <worldbody><frame pos="0 0 1" euler=".1 .2 .3" name="mount"><body name="palm" pos=".1 .2 .3333333333333"
    euler=".3 0 .1" childclass="light"><joint name="j" axis="1 0 0" stiffness="2"/><geom size=".1" pos="0 .1 0"/>
    <site name="s" pos=".1 .1 .1"/><body name="tip" pos="0 0 .1"><joint name="k" ref=".1" axis="0 1 0"/>
    <joint name="p" type="slide" ref=".1" springref=".3" stiffness="1"/><geom type="box" size=".2 .1 .1"/></body></body>
  </frame><body name="other"><joint name="o"/><geom size=".1" axisangle="0 1 0 .3"/></body></worldbody>
  <actuator><position class="light" joint="k"/><motor joint="o" gear="2" armature=".1"/></actuator>
  <tendon><fixed name="t" stiffness="2"><joint joint="k" coef="2"/></fixed>
    <fixed name="mixed" stiffness="2"><joint joint="k" coef="2"/><joint joint="o" coef="2"/></fixed></tendon>
  <equality><connect body1="tip" anchor="0 0 .1"/><joint joint1="j" joint2="o"/></equality></mujoco>"""
ARM = """<mujoco model="arm"><asset><model name="hand" file="sub/hand.xml"/></asset>
  <default><default class="heavy"><geom density="3000"/></default></default><worldbody>
  <body name="base" pos="0 0 1"><joint name="f" axis="0 1 0" range="-90 90" limited="true"/>
    <geom size=".1" pos="0 .2 .1" class="heavy"/>{attach}</body></worldbody></mujoco>"""


@pytest.mark.parametrize("alike", [True, False])
@pytest.mark.parametrize(
    "attach",
    [
        '<attach model="hand" body="palm" prefix="l_"/>',
        '<attach model="hand" prefix="l_"/>',
        '<attach model="hand" frame="mount" prefix="l_"/><body pos="1 0 0"><joint/><geom size=".1"/></body>',
        '<attach model="hand" body="tip" prefix="l_"/>'
        '<frame pos="1 .2 .3" euler="10 20 30"><attach model="hand" body="palm" prefix="r_"/></frame>',
    ],
)
def test_what_is_attached_is_that_of_mujoco(attach: str, alike: bool, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    hand, text = HAND, ARM.format(attach=attach)
    if not alike:
        hand = HAND.replace('angle="radian"', 'angle="radian" eulerseq="ZyX"')
        # The main class of this file does not reach the other, whose geoms need MuJoCo's compiler.
        main = '<joint damping="3" armature=".1"/><geom density="500" shellinertia="true"/><position kp="7"/>'
        text = text.replace("<default>", f"<default>{main}<tendon damping='2'/>", 1).replace(
            "</worldbody>", '</worldbody><actuator><position joint="f"/></actuator>'
        )
    written(hand, tmp_path, "sub/hand.xml")
    path = written(text, tmp_path)
    model, _ = check(path, ("lagrangian",), actuators=True)
    compiled = mujoco.MjModel.from_xml_path(str(path))
    names = [compiled.joint(i).name for i in range(compiled.njnt)]
    assert [x for x in model.joint_names if x in names] == [x for x in names if x]
    for i in np.flatnonzero(compiled.jnt_limited):
        joint = model.joint(names[i])
        np.testing.assert_allclose([joint.lower[0], joint.upper[0]], compiled.jnt_range[i], rtol=1e-14)
    assert len(model.loops) + len(model.couplers) == compiled.neq
    assert any("<attach> written out: 'hand' as 'l_'" in note for note in model.notes)
    drawn = {shape.body for shape in shapes_of(model)}
    assert {x for x in drawn if x.startswith("l_")} == {b.name for b in model.bodies if b.mass and b.name[:2] == "l_"}


def test_meshes_of_what_is_attached_are_found(tmp_path: Path) -> None:
    corners = [(x, y, z) for x in (-0.1, 0.1) for y in (-0.2, 0.2) for z in (-0.3, 0.3)]
    faces = ["1 2 4", "1 4 3", "5 7 8", "5 8 6", "1 5 6", "1 6 2", "3 4 8", "3 8 7", "1 3 7", "1 7 5", "2 6 8", "2 8 4"]
    (tmp_path / "sub" / "shapes").mkdir(parents=True)
    lines = [*("v {} {} {}".format(*c) for c in corners), *(f"f {f}" for f in faces)]
    written("\n".join(lines), tmp_path, "sub/shapes/box.obj")
    text = HAND.replace('"radian"', '"radian" meshdir="shapes"').replace(
        "<default>", '<default><mesh scale="1 2 1"/>', 1
    )
    text = text.replace("<worldbody>", '<asset><mesh file="box.obj"/></asset><worldbody>')
    written(text.replace('<geom size=".1" pos', '<geom type="mesh" mesh="box" pos'), tmp_path, "sub/hand.xml")
    path = written(ARM.format(attach='<attach model="hand" body="palm" prefix="l_"/>'), tmp_path)
    check(path, ("lagrangian",), actuators=True)


@pytest.mark.parametrize(
    ("where", "change", "said"),
    [
        ("arm", ('prefix="l_"', ""), "prefix"),
        ("arm", ('model="hand" body', 'model="hnd" body'), "model 'hnd' is no <model>"),
        ("arm", ("sub/hand.xml", "sub/none.xml"), "no such file"),
        ("arm", ("sub/hand.xml", "/etc/hand.xml"), "absolute path"),
        ("arm", ('body="palm"', 'body="plam"'), "body 'plam' is not in sub/hand.xml"),
        ("hand", ('angle="radian"', 'angle="radian" boundmass="1"'), "compiler boundmass is 1.0, and 0.0 here"),
        (
            "hand",
            ("<option", '<asset><model name="x" file="y"/></asset><worldbody><attach/></worldbody><option'),
            "own",
        ),
    ],
)
def test_faults_of_what_is_attached_are_named(where: str, change: tuple[str, str], said: str, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    texts = {"arm": ARM.format(attach='<attach model="hand" body="palm" prefix="l_"/>'), "hand": HAND}
    assert change[0] in texts[where]
    texts[where] = texts[where].replace(*change)
    written(texts["hand"], tmp_path, "sub/hand.xml")
    with pytest.raises(ModelError, match=said):
        mb.load(written(texts["arm"], tmp_path))


# Aligned free bodies


@pytest.mark.parametrize(
    "matter",
    [
        '<inertial pos=".1 .2 .3" mass="2" diaginertia="1 2 1.5" euler="10 20 30"/>',
        '<inertial pos=".1 .2 .3" mass="2" fullinertia="1 2 1.5 .1 .2 .3"/>',
        '<geom type="box" size=".1 .2 .3" pos=".3 .1 0" euler="10 20 30"/><geom size=".1"/>',
    ],
)
@pytest.mark.parametrize("below", ["", '<body name="c" pos="1 0 0"><joint name="k"/><geom size=".1"/></body>'])
@pytest.mark.parametrize("by", ["compiler", "joint"])
def test_a_free_body_may_be_aligned(by: str, below: str, matter: str, tmp_path: Path) -> None:
    align, setting = ('align="true"', "") if by == "joint" else ("", '<compiler alignfree="true"/>')
    text = (
        f'<mujoco>{setting}<worldbody><site name="o"/><body name="b" pos="1 2 3" euler="5 6 7">'
        f'<freejoint name="f" {align}/>{matter}<site name="s" pos=".1 0 .2" euler="1 2 3"/>{below}</body></worldbody>'
        '<tendon><spatial stiffness="3"><site site="o"/><site site="s"/></spatial></tendon></mujoco>'
    )
    model, _ = check(written(text, tmp_path))
    (body,) = (b for b in model.bodies if b.name == "b")
    assert any("align" in note for note in model.notes) == (not below)
    assert bool(np.abs(body.com).max() > 1e-12) == bool(below)
    compiled = mujoco.MjModel.from_xml_string(text)
    site = model.frame("s").translation
    np.testing.assert_allclose(site, compiled.site_pos[compiled.site("s").id], rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "equality",
    [
        '<connect body1="b" body2="c" anchor=".1 .2 .3"/>',
        '<connect body1="c" body2="b" anchor=".1 .2 .3"/>',
        '<weld body1="b" body2="c" anchor=".3 .2 .1"/>',
        '<weld body1="c" body2="b" relpose="1 2 3 1 .1 .2 .3" anchor=".3 .2 .1"/>',
    ],
)
def test_equalities_of_aligned_bodies_are_those_of_mujoco(equality: str, tmp_path: Path) -> None:
    """The anchors stand in the frame that align has moved."""
    text = f"""<mujoco><worldbody><body name="b" pos="1 0 0" euler="10 20 30"><freejoint align="true"/>
      <inertial mass="1" diaginertia="1 1.2 1.3" pos=".1 .2 .3" euler="30 0 0"/></body>
      <body name="c"><joint/><geom size=".1"/></body></worldbody><equality>{equality}</equality></mujoco>"""
    (loop,) = mb.load(written(text, tmp_path)).loops
    m = mujoco.MjModel.from_xml_string(text)
    data = m.eq_data[0]
    if "connect" in equality:
        ends = [(np.eye(3), data[:3]), (np.eye(3), data[3:6])]
    else:
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, data[6:10])
        ends = [(R.reshape(3, 3), data[3:6]), (np.eye(3), data[:3])]
    for (R, p), own in zip(
        ends, ((loop.rotation_a, loop.translation_a), (loop.rotation_b, loop.translation_b)), strict=True
    ):
        np.testing.assert_allclose(own[1], p, rtol=0, atol=1e-14)
        np.testing.assert_allclose(own[0], R, rtol=0, atol=1e-14)


def test_the_inertia_of_a_mesh_that_a_plugin_makes_is_mujocos(tmp_path: Path) -> None:
    text = """<mujoco><extension><plugin plugin="mujoco.sdf.torus"><instance name="ring">
      <config key="radius1" value=".3"/><config key="radius2" value=".1"/></instance></plugin></extension>
      <asset><mesh name="ring"><plugin instance="ring"/></mesh></asset><worldbody><body><joint axis="1 0 0"/>
      <geom type="sdf" mesh="ring" mass="2" pos="0 .1 0"><plugin instance="ring"/></geom></body></worldbody></mujoco>"""
    check(written(text, tmp_path), ("lagrangian",))
