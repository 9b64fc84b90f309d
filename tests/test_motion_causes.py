"""Causes by what they do to a motion: against bare `mj_step` on files, and on recorded motions."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit import spatial
from mbkit.cli import cli
from mbkit.engines.mujoco.simulation import OwnSimulation
from mbkit.errors import InputError, OutputError, UnsupportedError
from mbkit.methods.simulation_settings import WORDS
from mbkit.studies.explain import Explanation, Motion, Servo, Settings, file_settings, record_of, records, worlds
from mbkit.studies.explain.hypotheses import Hypothesis
from mbkit.studies.explain.worlds import setting_differences
from mbkit.studies.written_causes import write_causes
from tests import kind_examples
from tests.test_causes import robot, with_body, with_joint

ARM = """<mujoco model="arm">
<option timestep="0.004" integrator="implicitfast" iterations="50"/>
<worldbody><body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0" damping="0.1" range="-170 170"/>
<inertial pos="0 0 -.2" mass="2" diaginertia=".03 .03 .004"/>
<body name="lower" pos="0 0 -.4"><joint name="elbow" axis="0 1 0" damping="0.05" armature="0.01"/>
<inertial pos="0.02 0 -.2" mass="1" diaginertia=".01 .01 .002"/>
<body name="tip" pos="0 0 -.4"><joint name="wrist" axis="1 0 0" frictionloss="0.02"/>
<inertial pos="0 0.01 -.05" mass="0.3" diaginertia=".001 .001 .0005"/></body></body></body></worldbody>
<actuator><position name="s" joint="shoulder" kp="60" kv="3" forcerange="-9 9"/>
<position name="e" joint="elbow" kp="30" kv="1" ctrlrange="-1 1"/><motor name="w" joint="wrist" gear="2"/></actuator>
</mujoco>"""
START = np.array([0.4, -0.3, 0.2]), np.array([0.5, 0.1, -0.4])
CONTROL = np.array([0.9, 1.4, 0.15])
TIMES = (0.1, 0.4, 1.0)
EDITS = {
    "damping": ('damping="0.1"', 'damping="0.4"'),
    "armature": ('armature="0.01"', 'armature="0.03"'),
    "friction": ('frictionloss="0.02"', 'frictionloss="0.1"'),
    "time step": ('timestep="0.004"', 'timestep="0.002"'),
    "longer step": ('timestep="0.004"', 'timestep="0.01"'),
    "integrator": ("implicitfast", "RK4"),
    "servo kp": ('kp="30"', 'kp="36"'),
    "servo kv": ('kv="3"', 'kv="2"'),
    "force range": ("-9 9", "-4 4"),
    "control range": ("-1 1", "-2 2"),
    "servo gear": ('gear="2"', 'gear="1.5"'),
    "centre of mass": ('pos="0.02 0 -.2"', 'pos="0.05 0 -.2"'),
    "joint limits": ("-170 170", "-170 30"),
}


def bare(text: str, duration: float = TIMES[-1], control: np.ndarray = CONTROL) -> dict[str, np.ndarray]:
    """A run of MuJoCo alone, as it would be recorded."""
    m = mujoco.MjModel.from_xml_string(text)
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = START
    d.ctrl[:] = control[: m.nu]
    rows = []
    for _ in range(round(duration / m.opt.timestep) + 1):
        rows.append([d.time, *d.qpos, *d.qvel])
        mujoco.mj_step(m, d)
    table = np.array(rows)
    return {"t": table[:, 0], "qpos": table[:, 1 : m.nq + 1], "qvel": table[:, m.nq + 1 :]}


def at(run: dict[str, np.ndarray], t: float) -> np.ndarray:
    return run["qpos"][int(np.argmin(np.abs(run["t"] - t)))]


def edited(*kinds: str) -> str:
    text = ARM
    for kind in kinds:
        old, new = EDITS[kind]
        assert old in text
        text = text.replace(old, new)
    return text


def read(folder: Path, *texts: str) -> tuple[list[mb.Model], list[Settings]]:
    models, settings = [], []
    for k, text in enumerate(texts):
        path = folder / f"{'ab'[k]}.xml"
        path.write_text(text)
        models.append(mb.load(path))
        held, _ = file_settings(path, models[-1])
        assert held is not None
        settings.append(held)
    return models, settings


def moved(folder: Path, other: str, **more: Any) -> Explanation:
    models, settings = read(folder, ARM, other)
    asked = {"controller": lambda *_: CONTROL, "times": TIMES, "q": START[0], "v": START[1]} | more
    return mb.explain(*models, motion=Motion(settings=(settings[0], settings[1]), **asked))


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
def test_a_run_with_the_settings_of_a_file_is_that_of_mj_step(tmp_path: Path, integrator: str) -> None:
    text = ARM.replace("implicitfast", integrator)
    (model,), (settings,) = read(tmp_path, text)
    t, q, v = OwnSimulation(model, replace(settings, control_period=0.02)).run(*START, lambda *_: CONTROL, 1.0)
    own = bare(text)
    assert np.allclose(t, own["t"], rtol=0, atol=1e-12)
    assert np.abs(q - own["qpos"]).max() < 1e-12
    assert np.abs(v - own["qvel"]).max() < 1e-11


@pytest.mark.parametrize("kind", [x for x in EDITS if x != "longer step"])
def test_a_cause_alone_moves_as_two_bare_runs_say(tmp_path: Path, kind: str) -> None:
    found = moved(tmp_path, edited(kind))
    assert found.motion is not None
    one, other = bare(ARM), bare(edited(kind))
    truth = [np.abs(at(one, t) - at(other, t)).max() for t in TIMES]
    wanted = {"joint limits": "limits"}.get(kind, kind)
    assert [x.kind for x in found.motion.effects] == [wanted], found.to_markdown()
    assert np.allclose(found.motion.effects[0].alone, truth, rtol=1e-6, atol=1e-12)
    assert np.allclose(found.motion.whole, truth, rtol=1e-6, atol=1e-12)
    assert max(found.motion.unexplained) < 1e-12
    assert max(truth) < 1e-9 or not found.agree


def test_several_causes_are_sorted_by_what_they_do(tmp_path: Path) -> None:
    kinds = ("damping", "time step", "servo kp", "armature")
    found = moved(tmp_path, edited(*kinds)).motion
    assert found is not None
    assert sorted(x.kind for x in found.effects) == sorted(kinds)
    assert "has the terms of first" in moved(tmp_path, edited("time step")).verdict
    sizes = [x.largest for x in found.effects]
    assert sizes == sorted(sizes, reverse=True)
    one, other = bare(ARM), bare(edited(*kinds))
    for x in found.effects:
        without = bare(edited(*(k for k in kinds if k != x.kind)))
        alone, left = bare(edited(x.kind)), [np.abs(at(without, t) - at(other, t)).max() for t in TIMES]
        assert np.allclose(x.alone, [np.abs(at(alone, t) - at(one, t)).max() for t in TIMES], rtol=1e-6, atol=1e-12)
        assert np.allclose(x.without, left, rtol=1e-6, atol=1e-12)
        beyond = [t for t, size in zip(found.grid, x.over_time, strict=True) if size > found.bound]
        assert np.isnan(x.passes) if not beyond else x.passes == beyond[0]


def test_every_setting_is_compared() -> None:
    servo = Servo("j", "position", 1.0, 0.1, 1.0, (-1.0, 1.0), (-1.0, 1.0))
    softness = (("j", (0.01, 1.0), ()),)
    a = Settings("mujoco", "mujoco_euler", 1e-3, True, "newton", 100, 1e-8, False, (servo,), 1e-2, softness)
    other = {"engine": "drake", "integrator": "mujoco_rk4", "solver": "cg", "servos": (), "kind": "motor", "joint": "k"}
    for f in fields(Settings):
        value = other.get(f.name, getattr(a, f.name) * 2 if f.name != "implicit_damping" else False)
        value = True if f.name == "limits" else value
        if f.name == "engine":
            (found,) = setting_differences(a, replace(a, engine="drake", integrator="drake_sap"))
            assert found.kind == "engine"
            continue
        (found,) = setting_differences(a, replace(a, **{f.name: value}))
        assert f.name == "servos" or found.kind == WORDS[f.name][0]
    for f in fields(Servo):
        value = other.get(f.name, 2 * getattr(servo, f.name) if f.type == "float" else (-2.0, 2.0))
        found = [*setting_differences(a, replace(a, servos=(replace(servo, **{f.name: value}),)))]
        assert len(found) == 1 + (f.name == "joint")
        assert f.name in ("kind", "joint") or found[0].kind == WORDS[f.name][0]


def test_what_one_file_does_not_say_is_named_and_not_compared() -> None:
    a = mb.load("ur5")
    b = with_joint(a, a.joint_names[1], damping=np.array([2.0]))
    held = Settings("mujoco", "mujoco_euler", 2e-3, True, "newton", 100, 1e-8, False, ())
    found = mb.explain(a, b, motion=Motion(settings=(None, held), times=(0.1,))).motion
    assert found is not None
    assert found.not_compared == ("the simulation of first, of which nothing is said",)
    half = mb.explain(a, b, motion=Motion(settings=(Settings(time_step=2e-3), held), times=(0.1,))).motion
    assert half is not None
    assert "integrator" in half.not_compared
    assert "time step" not in half.not_compared
    assert [x.kind for x in found.effects] == ["damping"]
    assert "mujoco_euler" in found.settings[0]


def test_contacts_of_a_file_are_named_as_not_compared(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text(ARM.replace("<worldbody>", '<worldbody><geom type="plane" size="1 1 .1"/>'))
    _, left = file_settings(path, mb.load(path))
    assert left == ("contacts of 1 shape",)
    soft = ARM.replace('range="-170 170"', 'range="-170 170" solreflimit="0.01 1" margin="0.1"')
    path.write_text(soft.replace('frictionloss="0.02"', 'frictionloss="0.02" solreffriction="0.01 1"'))
    _, left = file_settings(path, mb.load(path))
    assert left[:2] == ("the softness of dry friction", "the margin of joint limits")


TENDON = '<tendon><fixed name="t"{}><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="1"/></fixed></tendon>'


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('iterations="50"/>', 'iterations="50" actuatorgroupdisable="0"/>'),
        ('iterations="50"/>', 'iterations="50"><flag clampctrl="disable"/></option>'),
        ('iterations="50"/>', 'iterations="50"><flag constraint="disable"/></option>'),
        ('iterations="50"/>', 'iterations="50"><flag frictionloss="disable"/></option>'),
        ('iterations="50"/>', 'iterations="50"><flag actuation="disable"/></option>'),
        ("</actuator>", "</actuator>" + TENDON.format(' limited="true" range="-.2 .2"')),
        ("</actuator>", "</actuator>" + TENDON.format(' frictionloss="1"')),
        ("</actuator>", '<velocity name="x" joint="elbow" kv="2"/></actuator>'),
        ("</actuator>", '</actuator><equality><joint joint1="wrist"/></equality>'),
        (
            'name="shoulder" axis="0 1 0"',
            'name="shoulder" axis="0 1 0" actuatorfrcrange="-1 3" actuatorfrclimited="true"',
        ),
    ],
)
def test_what_no_setting_holds_of_a_file_is_never_compared_in_silence(tmp_path: Path, old: str, new: str) -> None:
    """The run of the description is held against `mj_step` on the file itself."""
    assert old in ARM
    path = tmp_path / "a.xml"
    path.write_text(ARM.replace(old, new))
    _, left = file_settings(path, mb.load(path))
    assert left
    assert file_settings(write(tmp_path, ARM), mb.load(tmp_path / "b.xml"))[1] == ()


def test_an_actuator_of_a_site_names_no_joint(tmp_path: Path) -> None:
    """Its numbers are those of other objects, of which there may be more than joints."""
    sites = "".join(f'<site name="s{k}"/>' for k in range(9))
    text = ARM.replace('<body name="tip"', f'{sites}<body name="tip"')
    path = tmp_path / "a.xml"
    path.write_text(text.replace("</actuator>", '<motor name="m" site="s8" gear="0 0 1 0 0 0"/></actuator>'))
    held, left = file_settings(path, mb.load(path))
    assert [x.joint for x in held.servos] == ["shoulder", "elbow", "wrist"]
    assert left == ("actuator m, which is no motor or servo of one joint",)


@pytest.mark.parametrize(
    ("threshold", "below", "above"),
    [
        # Residuals of the second of two tries: a pair is named below, and not above.
        ((records, "PAIR_GAIN"), 0.05, 0.5),
        # How far a file's run is from its description's.
        ((worlds, "LIKE_THE_FILE"), 5e-8, 5e-7),
    ],
)
def test_thresholds_decide_between_two_sides(
    threshold: tuple[Any, str], below: float, above: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module, name = threshold
    one, other = Hypothesis("a", "", ""), Hypothesis("b", "", "")

    def far(x: float) -> bool:
        if module is records:
            tried = [((), np.array([99.0])), ((one,), np.array([1.0])), ((one, other), np.array([x]))]
            return len(records.nearest(tried)[0]) == 1
        monkeypatch.setattr(OwnSimulation, "off_the_file", lambda *_: x)
        path = tmp_path / "a.xml"
        path.write_text(ARM)
        return file_settings(path, mb.load(path))[1] != ()

    assert [far(below), far(above)] == [False, True]
    for factor in (0.1, 10.0):
        with monkeypatch.context() as there:
            there.setattr(module, name, factor * getattr(module, name))
            assert far(below) == far(above)


def test_every_part_that_fusing_links_loses_is_refused() -> None:
    for name in ("body.rotor", "force.compensation"):
        model = kind_examples.example(name).model
        with pytest.raises(UnsupportedError, match="lost where links are fused"):
            mb.explain(model, model, motion=True)
    with pytest.raises(UnsupportedError, match="fused"):
        mb.explain(model, model, rollouts=({}, {}))


def write(folder: Path, text: str) -> Path:
    path = folder / "b.xml"
    path.write_text(text)
    return path


def test_a_controller_with_a_memory_is_refused_or_reset(tmp_path: Path) -> None:
    class Integral:
        def __init__(self) -> None:
            self.sum = np.zeros(3)

        def __call__(self, _t: float, q: np.ndarray, _v: np.ndarray) -> np.ndarray:
            self.sum = self.sum - 1e-3 * q
            return self.sum

    with pytest.raises(InputError, match="reset"):
        moved(tmp_path, edited("damping"), controller=Integral())

    class Reset(Integral):
        def reset(self) -> None:
            self.sum = np.zeros(3)

    assert moved(tmp_path, ARM, controller=Reset()).agree


@pytest.mark.parametrize("step", ["0.0015", "0.006", "0.003"])
def test_steps_that_do_not_divide_the_end_come_to_it(tmp_path: Path, step: str) -> None:
    text = ARM.replace('timestep="0.004"', f'timestep="{step}"')
    found = moved(tmp_path, text, times=(0.003, 1.0)).motion
    assert not any("bounds" in x for x in found.notes)
    assert np.isfinite(found.whole).all()


def test_orders_base_frames_and_joints_of_one_side_alone_are_causes() -> None:
    a = robot("solo8").without("friction")
    a = replace(
        a, joints=tuple(replace(j, mimic=None, kind="revolute", pitch=0.0) if j.type.nv == 1 else j for j in a.joints)
    )
    base = a.body(a.joints[0].child)
    R, p = spatial.matrix_from_rpy(0, 0, 0.5), np.array([0.1, 0, 0.02])
    turned = with_body(a, base.name, com=R.T @ (base.com - p), inertia=R.T @ base.inertia @ R)
    joints = [
        replace(j, rotation=R.T @ j.rotation, translation=R.T @ (j.translation - p)) if j.parent == base.name else j
        for j in turned.joints
    ]
    names = [j.name for j in joints if j.type.nv == 1]
    i, k = (next(n for n, j in enumerate(joints) if j.name == x) for x in (names[0], names[2]))
    joints[i], joints[k] = joints[k], joints[i]
    b = replace(turned, joints=tuple(joints), frames=())
    motion = Motion(times=(0.1, 0.3))
    found = mb.explain(replace(a, frames=()), b, motion=motion)
    assert {x.kind for x in found.motion.effects} == {"joint order", "frame of the free joint"}
    assert min(x.largest for x in found.motion.effects) > 1e-3
    assert max(found.motion.unexplained) < 1e-10
    lost = mb.explain(mb.load("ur5"), mb.load("ur5").lock({"wrist_3_joint": 0.0}), motion=motion).motion
    assert [x.kind for x in lost.effects] == ["joint held still"]
    assert max(lost.unexplained) < 1e-10


def test_causes_are_taken_over_and_back(tmp_path: Path) -> None:
    found = moved(tmp_path, edited("damping", "armature", "time step"))
    models, settings = read(tmp_path, ARM, edited("damping", "armature", "time step"))
    model, held = models[0], settings[0]
    for x in found.motion.effects:
        if x.kind == "time step":
            held = x.apply(held)
            assert x.revert(settings[1]).time_step == settings[0].time_step
            with pytest.raises(InputError, match="Settings"):
                x.apply(model)
        else:
            model = x.apply(model)
    assert mb.explain(model, models[1]).agree
    assert held.time_step == settings[1].time_step
    for cause in found.causes:
        assert not mb.explain(models[0], cause.apply(models[0])).agree
        assert not mb.explain(models[1], cause.revert(models[1])).agree
    order = next(c for c in mb.explain(mb.load("ur5"), mb.load("ur5").lock({"elbow_joint": 0.0})).causes)
    with pytest.raises(UnsupportedError, match="alone"):
        order.apply(mb.load("ur5"))


def test_the_written_file_moves_as_the_second(tmp_path: Path) -> None:
    kinds = ("damping", "time step", "servo kp", "integrator", "force range")
    found = moved(tmp_path, edited(*kinds))
    path = tmp_path / "fixed.xml"
    write_causes(found, path)
    one, other = bare(path.read_text()), bare(edited(*kinds))
    assert np.abs(one["qpos"] - other["qpos"]).max() < 1e-11
    with pytest.raises(OutputError, match="there already"):
        write_causes(found, path)
    first = found.motion.effects[0].kind
    write_causes(found, tmp_path / "one.xml", [1])
    one, other = bare((tmp_path / "one.xml").read_text()), bare(edited(first))
    assert np.abs(one["qpos"] - other["qpos"]).max() < 1e-11
    with pytest.raises(InputError, match="from 1 to 5"):
        write_causes(found, tmp_path / "two.xml", [9])


@pytest.mark.parametrize(
    ("kinds", "named"),
    [
        (("time step",), ("time step",)),
        (("integrator",), ("integrator",)),
        (("integrator", "time step"), ("integrator", "time step")),
        (("integrator", "longer step"), ("integrator", "time step")),
        (("damping", "armature"), ("armature", "damping")),
        (("servo kv",), ("servo kv",)),
    ],
)
def test_two_records_of_mj_step_are_explained(tmp_path: Path, kinds: tuple[str, ...], named: tuple[str, ...]) -> None:
    described = {"damping", "armature", "servo kv"}
    models, settings = read(tmp_path, ARM, edited(*kinds) if described.intersection(kinds) else ARM)
    pairs = bare(ARM), bare(edited(*kinds))
    motion = Motion(controller=lambda *_: CONTROL, settings=(settings[0], settings[1]))
    found = mb.explain(*models, rollouts=pairs, motion=motion).records
    assert found is not None
    assert found.reproduced < 1e-11
    assert sorted(found.kinds) == sorted(named), found.tried
    assert found.residual < 1e-11 < found.apart
    assert found.joint in models[0].joint_names


def test_a_record_that_was_made_with_another_step_than_its_file_says(tmp_path: Path) -> None:
    models, settings = read(tmp_path, ARM, edited("damping"))
    pairs = bare(ARM), bare(edited("damping", "time step"))
    motion = Motion(controller=lambda *_: CONTROL, settings=(settings[0], settings[1]))
    found = mb.explain(*models, rollouts=pairs, motion=motion).records
    assert sorted(found.kinds) == ["damping", "time step"]
    assert found.residual < 1e-11


def test_records_by_the_names_of_joints(tmp_path: Path) -> None:
    (model,), _ = read(tmp_path, ARM)
    run = bare(ARM)
    columns = {"time": run["t"]}
    for k, name in reversed([*enumerate(model.joint_names)]):
        columns |= {name: run["qpos"][:, k], f"{name}_vel": run["qvel"][:, k]}
    path = tmp_path / "run.csv"
    np.savetxt(path, np.array([*columns.values()]).T, delimiter=",", header=",".join(columns), comments="", fmt="%.17g")
    for data in (columns, path, str(path), (run["t"], run["qpos"], run["qvel"])):
        held = record_of(data, model)
        assert np.array_equal(held.q, run["qpos"])
        assert np.array_equal(held.v, run["qvel"])
    (model, other), settings = read(tmp_path, ARM, edited("damping"))
    motion = Motion(controller=lambda *_: CONTROL, settings=(settings[0], settings[1]))
    slow = [(x["t"], x["qpos"]) for x in (run, bare(edited("damping")))]
    found = mb.explain(model, other, rollouts=(slow[0], slow[1]), motion=motion).records
    assert found.kinds == ("damping",)
    assert max(found.reproduced, found.residual) < 1e-8


def test_each_record_has_its_own_controls(tmp_path: Path) -> None:
    models, settings = read(tmp_path, ARM, edited("damping"))
    pair = []
    for text, control in ((ARM, CONTROL), (edited("damping"), 0.5 * CONTROL)):
        run = bare(text, control=control)
        columns = {"t": run["t"]} | {n: run["qpos"][:, k] for k, n in enumerate(models[0].joint_names)}
        columns |= {f"{n}.v": run["qvel"][:, k] for k, n in enumerate(models[0].joint_names)}
        pair.append(
            columns | {f"{n}.u": np.full(len(run["t"]), control[k]) for k, n in enumerate(models[0].joint_names)}
        )
    motion = Motion(settings=(settings[0], settings[1]))
    found = mb.explain(*models, rollouts=(pair[0], pair[1]), motion=motion).records
    assert found.kinds == ("damping",)
    assert max(found.residual, found.reproduced) < 1e-11
    uneven = pair[0] | {"t": pair[0]["t"] ** 1.01}
    with pytest.raises(InputError, match="equal"):
        mb.explain(*models, rollouts=(uneven, pair[1]), motion=motion)
    later = {n: x[10:] for n, x in pair[1].items()}
    assert "apart" in " ".join(mb.explain(*models, rollouts=(pair[0], later), motion=motion).records.notes)
    bad = tmp_path / "bad.npz"
    bad.write_bytes(b"PK\x03\x04hello")
    with pytest.raises(InputError, match=r"bad\.npz"):
        mb.explain(*models, rollouts=(bad, bad), motion=motion)


def test_records_that_cannot_be_compared_are_refused(tmp_path: Path) -> None:
    (model, *_), (settings, *_) = read(tmp_path, ARM, ARM)
    run = bare(ARM)
    held = Motion(settings=(settings, settings))
    for change, says in (
        ({"qpos": np.degrees(run["qpos"]), "qvel": np.degrees(run["qvel"])}, "degrees.*0.0174533"),
        ({"qpos": run["qpos"][:, :2]}, r"shape \(K, 3\)"),
        ({"t": run["t"][::-1]}, "increasing"),
        ({"qpos": run["qpos"] * np.nan}, "finite"),
    ):
        with pytest.raises(InputError, match=says):
            mb.explain(model, model, rollouts=(run, run | change), motion=held)
    lost = {"t": run["t"], "shoulder": run["qpos"][:, 0], "elbow": run["qpos"][:, 1]}
    with pytest.raises(InputError, match="no column of wrist"):
        mb.explain(model, model, rollouts=(run, lost), motion=held)
    with pytest.raises(InputError, match="expected two records"):
        mb.explain(model, model, rollouts=(run,), motion=held)
    for wrong in ({"times": (1.0, 0.5)}, {"bound": 0.0}, {"seed": -1}, {"q": [[0.0] * 3] * 2}, {"times": ()}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            Motion(**wrong)
    with pytest.raises(InputError, match="column t or time"):
        record_of({"x": run["t"]}, model)


@pytest.mark.parametrize(
    ("controller", "says"),
    [
        (lambda *_: 1 / 0, "ZeroDivisionError"),
        (lambda *_: np.zeros(2), "3 finite numbers at t = 0 s, got shape"),
        (lambda *_: np.full(3, np.nan), "3 finite numbers"),
        (np.zeros((5, 2)), r"shape \(K, 3\)"),
        ("hold", "'posture', 'passive'"),
    ],
)
def test_a_controller_that_cannot_be_used_is_named(tmp_path: Path, controller: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        moved(tmp_path, edited("damping"), controller=controller)


def test_a_motion_that_diverges_says_when(tmp_path: Path) -> None:
    law = lambda *state: np.array([0.0, 0.0, 1e9 * state[2][2]])  # noqa: E731
    found = moved(tmp_path, edited("damping"), controller=law).motion
    assert found is not None
    assert any("leaves all bounds at" in x for x in found.notes)
    assert not found.alike(1e-9)
    assert "unexplained: NaN" in found.verdict
    assert not moved(tmp_path, ARM, controller=law).agree


def test_a_table_is_held_row_by_row(tmp_path: Path) -> None:
    rows = np.array([CONTROL, 0.5 * CONTROL])
    models, settings = read(tmp_path, ARM, edited("damping"))
    held = tuple(replace(x, control_period=0.5) for x in settings)
    table, law = (
        mb.explain(*models, motion=Motion(controller=c, settings=held, q=START[0], v=START[1], times=TIMES)).motion
        for c in (rows, lambda t, *_: rows[int(t >= 0.5 - 1e-9)])
    )
    assert table.whole == law.whole


def test_the_result_is_data_and_a_picture(tmp_path: Path) -> None:
    found = moved(tmp_path, edited("damping", "servo kp"))
    again = Explanation.from_json(found.to_json())
    assert again.motion.whole == found.motion.whole
    assert [x.kind for x in again.motion.effects] == [x.kind for x in found.motion.effects]
    with pytest.raises(UnsupportedError):
        again.motion.effects[0].apply(mb.load(tmp_path / "a.xml"))
    assert len(found.motion.to_csv().splitlines()) == 1 + 2 * len(TIMES)
    assert len(found.motion.plot().axes) == 2
    assert "not compared" in moved(tmp_path, ARM).verdict or "unexplained: 0" in moved(tmp_path, ARM).verdict
    assert moved(tmp_path, ARM).agree


def test_the_command_measures_writes_and_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in (("a.xml", ARM), ("b.xml", edited("damping", "time step"))):
        Path(name).write_text(text)
    run = lambda *words: CliRunner().invoke(cli, ["diff", "a.xml", "b.xml", *words])  # noqa: E731
    out = run("--motion", "--json", "--write", "fixed.xml", "--take", "1")
    assert out.exit_code == 1, out.output
    data = json.loads(out.stdout)
    assert sorted(x["kind"] for x in data["motion"]["effects"]) == ["damping", "time step"]
    assert Path("fixed.xml").exists()
    for name, text in (("a.csv", ARM), ("b.csv", edited("damping", "time step"))):
        held = bare(text, control=np.zeros(3))
        columns = {"t": held["t"]} | {n: held["qpos"][:, k] for k, n in enumerate(("shoulder", "elbow", "wrist"))}
        columns |= {f"{n}.v": held["qvel"][:, k] for k, n in enumerate(("shoulder", "elbow", "wrist"))}
        table = np.array([*columns.values()]).T
        np.savetxt(name, table, delimiter=",", header=",".join(columns), comments="", fmt="%.17g")
    out = run("--rollouts", "a.csv", "b.csv", "--json")
    assert sorted(json.loads(out.stdout)["records"]["kinds"]) == ["damping", "time step"]
    Path("laws.py").write_text("def law(t, q, v):\n    return -v\n")
    assert run("--motion", "--controller", "laws:law").exit_code == 1
    assert run("--motion", "--controller", "lost.csv").exit_code == 2
    assert run("--controller", "passive").exit_code == 2


def test_engines_run_with_their_own_integrators() -> None:
    model = mb.load("ur5")
    found = mb.explain(*(mb.dynamics(model, x) for x in ("mujoco", "drake")), motion=Motion(times=(0.1, 0.2))).motion
    assert found is not None
    assert [x.kind for x in found.effects] == ["engine"]
    # Without damping both are the same formula.
    assert found.effects[0].largest < 1e-12
    assert "drake_sap" in found.settings[1]
