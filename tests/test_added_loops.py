"""Loops added to a file that has none: `mbkit.load(..., loops=)`, a TOML file, the command line, baselines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit.cli import cli
from mbkit.errors import InputError, LoadError, ModelError
from mbkit.model.parts import Loop
from validation import four_bar as bare

PIN: dict[str, Any] = {
    "name": "pin",
    "kind": "point",
    "body_a": "coupler",
    "translation_a": [bare.COUPLER, 0, 0],
    "body_b": "rocker",
    "translation_b": [bare.ROCKER, 0, 0],
}
TABLE = "[[loop]]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in PIN.items())


def urdf(tip: bool = False) -> str:
    """Return the four-bar of `validation.four_bar` cut open; with `tip` the coupler ends in a link of its own."""
    links, joints = ['<link name="base"/>'], []
    for name, parent, x, length in bare.RODS:
        mass = bare.LINE * length
        turn = mass * length**2 / 12
        # A thin rod, with what a URDF's reader takes for one.
        moments = f'ixx="{1e-9}" iyy="{turn}" izz="{turn}" ixy="0" ixz="0" iyz="0"'
        inertial = f'<origin xyz="{length / 2} 0 0"/><mass value="{mass}"/><inertia {moments}/>'
        links.append(f'<link name="{name}"><inertial>{inertial}</inertial></link>')
        joints.append(
            f'<joint name="{name}" type="continuous"><parent link="{parent or "base"}"/><child link="{name}"/>'
            f'<origin xyz="{x} 0 0"/><axis xyz="0 0 1"/></joint>'
        )
    if tip:
        links.append('<link name="tip"/>')
        joints.append(
            '<joint name="tip" type="fixed"><parent link="coupler"/><child link="tip"/>'
            f'<origin xyz="{bare.COUPLER} 0 0" rpy="0.3 -0.2 0.9"/></joint>'
        )
    return f'<robot name="four_bar">{"".join(links + joints)}</robot>'


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "four_bar.urdf"
    path.write_text(urdf())
    return path


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "loops.toml"
    path.write_text(TABLE)
    return path


def load(path: Path, loops: Any) -> mb.Model:
    return mb.load(path, loops=loops, gravity=(0, -bare.GRAVITY, 0))


def test_a_urdf_with_a_loop_moves_as_the_closed_form(file: Path) -> None:
    """Accelerations of `validation.four_bar`, which knows nothing of URDF, joints or multipliers."""
    dyn = mb.dynamics(load(file, [PIN]), "lagrangian", compile=False)
    q, v = dyn.project(*bare.start())
    exact, _ = bare.acceleration(np.longdouble(bare.START), np.longdouble(bare.SPEED))
    assert dyn.forward_dynamics(q, v, np.zeros(3))[0] == pytest.approx(float(exact), rel=1e-11)
    assert mb.dynamics(load(file, [PIN]), "pinocchio").forward_dynamics(q, v, np.zeros(3))[0] == pytest.approx(
        float(exact), rel=1e-11
    )


def test_dicts_loop_objects_and_a_file_say_the_same(file: Path, table: Path) -> None:
    given = load(file, [PIN])
    ends = PIN["body_a"], np.eye(3), PIN["translation_a"], PIN["body_b"], np.eye(3), PIN["translation_b"]
    assert load(file, [Loop("pin", "point", *ends)]).loops == given.loops
    assert load(file, str(table)).digest == load(file, table).digest == given.digest
    assert any("loops given beside the file: 'pin'" in note for note in given.notes)
    assert load(file, []).loops == load(file, True).loops == load(file, False).loops == ()


def test_ends_may_be_on_links_that_were_merged(tmp_path: Path) -> None:
    path = tmp_path / "four_bar.urdf"
    path.write_text(urdf(tip=True))
    # The tip's axes are turned, so that a wrong order of turns shows.
    at_tip = {"body_a": "tip", "translation_a": [0.1, -0.2, 0.3], "rotation_a": np.eye(3)[[1, 2, 0]]}
    (loop,) = load(path, [PIN | at_tip]).loops
    assert loop.body_a == "coupler"
    dyn = mb.dynamics(load(path, []), "pinocchio")
    X = np.linalg.inv(dyn.pose(bare.start()[0], "coupler")) @ dyn.pose(bare.start()[0], "tip")
    assert np.abs(loop.translation_a - (X @ [0.1, -0.2, 0.3, 1.0])[:3]).max() < 1e-14
    assert np.abs(loop.rotation_a - X[:3, :3] @ np.eye(3)[[1, 2, 0]]).max() < 1e-14


def test_loops_of_an_mjcf_stay_beside_those_that_are_added(tmp_path: Path) -> None:
    rods = dict.fromkeys("acr", "<joint axis='0 0 1'/><inertial pos='0.2 0 0' mass='1' diaginertia='.1 .1 .1'/>")
    path = tmp_path / "four_bar.xml"
    path.write_text(
        f"<mujoco><worldbody><body name='crank'>{rods['a']}<body name='coupler' pos='.3 0 0'>{rods['c']}</body></body>"
        f"<body name='rocker' pos='1 0 0'>{rods['r']}</body></worldbody>"
        "<equality><connect name='own' body1='coupler' body2='rocker' anchor='.9 0 0'/></equality></mujoco>"
    )
    assert [loop.name for loop in mb.load(path, loops=[PIN]).loops] == ["own", "pin"]
    with pytest.raises(ModelError, match="loop 'own': declared 2 times"):
        mb.load(path, loops=[PIN | {"name": "own"}])


@pytest.mark.parametrize(
    ("loops", "error", "text"),
    [
        ([PIN | {"body_b": "rockr"}], ModelError, "loop 'pin': unknown body 'rockr'.*'rocker'"),
        ([PIN | {"kind": "hinge"}], ModelError, "loop 'pin': unknown kind 'hinge'"),
        ([PIN | {"body_c": "x"}], InputError, r"loops\[0\]: unknown argument 'body_c'"),
        ([{"name": "pin", "kind": "pointt"}], InputError, r"unknown kind 'pointt'.*'frame'.*body_a, body_b missing"),
        ([3], InputError, r"loops\[0\]: expected a Loop or a dict"),
        ("no.toml", LoadError, r"no\.toml: No such file"),
    ],
)
def test_what_is_wrong_with_a_loop_is_named(file: Path, loops: Any, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        load(file, loops)


@pytest.mark.parametrize(
    ("content", "text"),
    [("loop = 3", r"expected tables \[\[loop\]\]"), ("", r"no table \[\[loop\]\]"), ("[[loop", "not a TOML file")],
)
def test_faults_of_a_file_of_loops_are_named(file: Path, table: Path, content: str, text: str) -> None:
    table.write_text(content)
    with pytest.raises((LoadError, InputError), match=text):
        load(file, table)


def test_a_baseline_keeps_the_file_of_loops_by_its_place(
    file: Path, table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    baseline = tmp_path / "kept.toml"
    record = ["baseline", "record", str(file), str(baseline), "--loops", str(table), "--samples", "1"]
    done = CliRunner().invoke(cli, record)
    assert done.exit_code == 0, done.output
    assert 'loops = "./loops.toml"' in baseline.read_text()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    done = CliRunner().invoke(cli, ["baseline", "check", str(baseline)])
    assert done.exit_code == 0, done.output
    table.write_text(TABLE.replace(f"[{bare.ROCKER}, 0, 0]", "[0.71, 0, 0]"))
    done = CliRunner().invoke(cli, ["baseline", "check", str(baseline)])
    assert done.exit_code == 1
    assert "pin" in done.output
