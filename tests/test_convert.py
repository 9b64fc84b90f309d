"""What is written as MJCF or URDF says the same, and what a format cannot say is named."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit import spatial
from mbkit.cli import cli
from mbkit.engines.mujoco.mjcf_writer import mjcf_text, read_back
from mbkit.errors import InputError, MbkitError, OutputError, UnknownNameError, UnsupportedError
from mbkit.load import xml_reader
from tests.random_trees import IN_MUJOCO, random_tree
from tests.scenes import mounted


@pytest.mark.parametrize("name", [0, 1, 2, "tiago_no_hand", "talos"])
def test_what_is_written_is_to_the_bit_what_mbkit_builds_in_mujoco(name: int | str) -> None:
    """MuJoCo's rounding of M, 1e-12 of tiago's wrist, is no loss of the text."""
    model = random_tree(name, 9, kinds=IN_MUJOCO) if isinstance(name, int) else mb.load(name, mimic="free")
    read, built = read_back(model, mjcf_text(model, "")), mb.dynamics(model, "mujoco")
    q, v = model.random_state(1, 3)
    assert np.array_equal(read.mass_matrix(q), built.mass_matrix(q))
    assert np.array_equal(read.nle(q, v), built.nle(q, v))
    assert np.array_equal(read.passive(q, v), built.passive(q, v))


def test_a_robot_survives_mjcf_and_mbkit_s_own_reader(tmp_path: Path) -> None:
    model = mb.load("panda", mimic="free")
    made = mb.convert(model, "mjcf")
    back = mb.load(made.write(tmp_path / "panda.xml"))
    found = mb.explain(model, back, samples=1, tolerance=1e-12)
    assert found.agree
    # MJCF has no velocity limits, and the rest is there to the last digit.
    assert {c.kind for c in found.causes} == {"limits"}
    assert all("no velocity limit" in str(c) for c in found.causes)
    assert any("velocity limits" in note for note in made.notes)
    q = model.neutral()
    for frame in ("panda_hand", "panda_link8"):
        np.testing.assert_allclose(
            mb.dynamics(back).pose(q, frame), mb.dynamics(model).pose(q, frame), rtol=0, atol=1e-14
        )


def test_a_hand_built_model_survives_urdf(tmp_path: Path) -> None:
    model = random_tree(5, 7, kinds=("revolute", "continuous", "prismatic", "fixed", "free", "planar"), **_PLAIN)
    made = mb.convert(model, "urdf")
    assert made.worst < 1e-12
    back = mb.load(made.write(tmp_path / "tree.urdf"), gravity=model.gravity)
    assert mb.explain(model, back, samples=1, tolerance=1e-12).agree
    assert any("gravity" in note for note in made.notes)


_PLAIN = {"springs": False, "damping": False, "armature": False}


def test_all_that_a_format_cannot_say_is_named_at_once() -> None:
    model = random_tree(3, 10)
    with pytest.raises(UnsupportedError) as urdf:
        mb.convert(model, "urdf")
    for what in ("universal", "spherical-zyx", "helical", "ball joint", "armature", "spring 'to_ground'"):
        assert what in str(urdf.value)
    with pytest.raises(UnsupportedError, match="is a helical joint"):
        mb.convert(model, "mjcf")
    with pytest.raises(UnknownNameError, match="mjcf"):
        mb.convert(model, "sdf")
    with pytest.raises(InputError, match="expected a Model"):
        mb.convert("panda", "mjcf")  # type: ignore[arg-type]
    with pytest.raises(OutputError, match="kept"):
        mb.convert(mb.catalog.pendulum(), "mjcf").write("/nowhere/at/all.xml")


@pytest.mark.parametrize("to", ["urdf", "mjcf"])
def test_a_number_of_a_joint_is_read_back_or_named(to: str, tmp_path: Path) -> None:
    """Whatever is not in the file is in an error, or in a note where it moves nothing."""
    each = ("armature", "damping", "friction", "stiffness", "velocity_limit", "effort_limit")
    numbers = [{name: 2.0} for name in each] + [{"effort_limit": 0.0}, {"upper": 1.5, "lower": -1.0}]
    numbers += [{"friction": 1.0, "stiction": 2.0}, {"friction": 1.0, "stiction": 2.0, "stribeck_velocity": 0.1}]
    numbers += [{"friction": 1.0, "stiction": 1.0}]
    kinds = ("revolute", 1), ("prismatic", 1), ("planar", 3), ("free", 6)
    for (kind, n), given in itertools.product(kinds, numbers):
        b = mb.ModelBuilder("one")
        b.add_body("body", mass=1.0, com=(0.1, 0.2, 0.3), inertia=(0.1, 0.2, 0.25))
        how: dict[str, object] = {"axis": (0, 0, 1)} if n == 1 else {}
        try:
            b.add_joint("j", kind, parent="world", child="body", **how, **{k: [x] * n for k, x in given.items()})
            model = b.build()
        except MbkitError:
            # No such joint.
            continue
        if model.joint("j").sticks:
            with pytest.raises(UnsupportedError, match="joint 'j' has stiction above its friction"):
                mb.convert(model, to)
            continue
        try:
            made = mb.convert(model, to)
        except UnsupportedError as error:
            named = str(error)
        else:
            named = " ".join(made.notes)
            if to == "urdf" or n == 1:
                back = mb.load(made.write(tmp_path / f"one.{to.replace('mjcf', 'xml')}"), gravity=model.gravity)
                found = mb.explain(model, back)
                assert found.agree
                if not found.causes:
                    continue
        if to == "urdf" or given.keys() & {"velocity_limit", "effort_limit"}:
            lacks = {"velocity_limit": "limits", "effort_limit": "limits", "upper": "limits", "stiffness": "spring"}
            assert any(lacks.get(x, x) in named for x in given), (kind, given, named)


def test_roll_pitch_yaw_are_those_of_the_matrix_next_to_a_right_angle_too() -> None:
    rng = np.random.default_rng(0)
    for pitch in (0.3, np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, 1e-8 - np.pi / 2, np.pi / 2 - 1e-5):
        roll, yaw = rng.uniform(-3, 3, 2)
        R = spatial.matrix_from_rpy(roll, pitch, yaw)
        np.testing.assert_allclose(spatial.matrix_from_rpy(*spatial.rpy_from_matrix(R)), R, rtol=0, atol=2e-15)


def test_the_door(tmp_path: Path) -> None:
    run = CliRunner().invoke
    out = tmp_path / "acrobot.xml"
    done = run(cli, ["convert", "acrobot", "--to", "mjcf", "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "read back, every term agrees" in done.stderr
    assert out.read_text().startswith("<mujoco")
    assert "is there already" in run(cli, ["convert", "acrobot", "--to", "mjcf", "--out", str(out)]).stderr
    assert run(cli, ["convert", "heavy_top", "--to", "urdf"]).exit_code == 2
    printed = run(cli, ["convert", "acrobot", "--to", "urdf"])
    assert printed.stdout.startswith("<robot")
    same = run(cli, ["diff", str(out), "acrobot"])
    assert same.exit_code == 0, same.output


@pytest.mark.parametrize(
    ("character", "where"),
    [(x, ("model", "body", "joint")[k % 3]) for k, x in enumerate('\x00\x0b\x1b\uffff\n\t<&"é\x85')],
)
@pytest.mark.parametrize("to", ["mjcf", "urdf"])
def test_a_name_is_written_so_that_xml_reads_it_or_refused(character: str, where: str, to: str) -> None:
    names = {n: f"a{character * (n == where)}b" for n in ("model", "body", "joint")}
    place = {"axis": (0, 1, 0)}
    b = mounted(
        names["model"], names["body"], names["joint"], "continuous", mass=1.0, com=(0, 0, 1), inertia=(1, 1, 1), **place
    )
    model = b.build()
    if character.isprintable() or character in "\n\t\x85":
        root = xml_reader.parse(mb.convert(model, to).text.encode(), "text")
        assert any(names[where] in element.attributes.values() for element in root.walk())
    else:
        with pytest.raises(UnsupportedError) as caught:
            mb.convert(model, to)
        assert repr(names[where]) in str(caught.value)
