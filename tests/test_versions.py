"""Studies of an engine's versions, in environments whose versions are the installed engine, altered on purpose."""

from __future__ import annotations

import json
import os
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit._child_process import end_all
from mbkit.cli import cli
from mbkit.engines.versions import environment, process
from mbkit.errors import InputError, UnknownNameError
from mbkit.report.page import render
from mbkit.report.versions_view import versions_view
from mbkit.studies.versions import VersionsResult
from mbkit.studies.versions.result import ASIDE, AWAY, GIVEN, REFUSED, TOWARDS
from mbkit.studies.versions.study import _spread
from tests.test_engine_versions import script

ARM = """<robot name="arm"><link name="base"/><link name="upper"><inertial><origin xyz="0.1 0.2 0.3" rpy="0.3 0.2 0.1"/>
<mass value="2"/><inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
#: What a process runs in the place of `serve.py`: the same, with something altered before.
SERVE = """
import os, sys
sys.path.insert(0, {folder!r})
import on_mujoco as engine
import serve
E = engine.Engine
{alter}
serve.serve(int(sys.argv[2]), "mujoco", sys.argv[4])
"""
GRAVITY = "old = E.gravity; E.gravity = lambda self, q: {factor} * old(self, q)"


@pytest.fixture(autouse=True)
def environments(tmp_path, monkeypatch):
    monkeypatch.setenv("MBKIT_ENVIRONMENTS", str(tmp_path / "environments"))
    end_all()
    yield
    end_all()


def made(version: str, alter: str = "") -> str:
    """Make a version of MuJoCo that is the installed one but for what is altered."""
    place = environment.place("mujoco", version)
    program = place / "serve.py"
    script(environment.python_of(place), f'shift 2; exec "{sys.executable}" "{program}" "$@"')
    folder = str(Path(process.serve.__file__).parent)
    program.write_text(SERVE.format(folder=folder, alter=alter), encoding="utf-8")
    return version


def wrong(factor: float) -> str:
    return GRAVITY.format(factor=factor)


def pendulum() -> mb.Model:
    return mb.catalog.double_pendulum()


def found(result: VersionsResult) -> list[tuple[str, str, str]]:
    return [(c.term, c.version, c.direction) for c in result.changes]


def test_the_first_version_of_a_number_is_found_by_bisection():
    names = [made(f"1.{k}", wrong(1.001) if 5 <= k <= 13 else "") for k in range(20)]
    result = mb.versions(pendulum(), "mujoco", reversed(names), most=4, samples=2)
    assert found(result) == [("g", "1.5", AWAY), ("g", "1.14", TOWARDS)]
    assert all(c.next_to_it for c in result.changes)
    assert [c.before for c in result.changes] == ["1.4", "1.13"]
    assert 4 < len(result.measured) < 14
    good, bad = result.row("double_pendulum", "1.4", "g"), result.row("double_pendulum", "1.5", "g")
    assert good.digits > 14
    assert bad.digits == pytest.approx(3.0, abs=0.5)
    assert bad.changed
    assert bad.moved == pytest.approx(1e-3, rel=2)
    assert not result.same
    assert "2 changes, 1 of them away" in result.verdict


def test_what_moves_within_the_tolerance_is_no_change():
    names = [made("1.0"), made("1.1", wrong(1 + 1e-11))]
    result = mb.versions(pendulum(), "mujoco", names, samples=2)
    assert result.same
    assert found(mb.versions(pendulum(), "mujoco", names, samples=2, tolerance=1e-13)) == [("g", "1.1", AWAY)]


def test_a_version_that_dies_or_refuses_is_a_row_and_the_rest_is_measured():
    names = [
        made("1.0"),
        made("1.1", "E.nle = lambda *x: os.abort()"),
        made("1.2", "del E.potential_energy, E.matter"),
        made("1.3"),
    ]
    result = mb.versions(pendulum(), "mujoco", names, samples=2)
    assert [x for x in found(result) if x[0] in ("nle", "potential energy")] == [
        ("nle", "1.1", REFUSED),
        ("nle", "1.2", GIVEN),
        ("potential energy", "1.2", REFUSED),
        ("potential energy", "1.3", GIVEN),
    ]
    assert "SIGABRT" in result.row("double_pendulum", "1.1", "nle").reason
    assert result.row("double_pendulum", "1.1", "M").digits > 12
    assert result.measured == ("1.0", "1.1", "1.2", "1.3")


def test_a_version_that_does_not_start_has_reasons_and_one_that_does_not_install_is_missing(tmp_path, monkeypatch):
    script(tmp_path / "bin" / "uv", 'echo "ERROR: no wheel for this system" >&2; exit 1')
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    names = [made("1.0"), made("1.1", 'sys.exit("libGL is missing")'), "1.2", made("1.3")]
    result = mb.versions(pendulum(), "mujoco", names, samples=2)
    assert "libGL is missing" in result.row("double_pendulum", "1.1", "M").reason
    ((version, reason),) = result.missing
    assert version == "1.2"
    assert "no wheel for this system" in reason
    assert not result.same


def test_a_parser_that_reads_a_file_otherwise_is_seen(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    unturned = 'old = engine.parsed\nengine.parsed = lambda text, form: old(text.replace("0.3 0.2 0.1", "0 0 0"), form)'
    result = mb.versions(str(path), "mujoco", [made("1.0"), made("1.1", unturned), made("1.2")], samples=2)
    assert found(result) == [("file M", "1.1", AWAY), ("file M", "1.2", TOWARDS)]
    assert result.row(str(path), "1.1", "M").digits > 14


def test_its_own_run_is_measured():
    tree = mb.load("ur5", floating_base=True)
    wrong_order = (
        'old = E.rollout; E.rollout = lambda self, q, v, method, **more: old(self, q, v, method="euler", **more)'
    )
    result = mb.versions(tree, "mujoco", [made("1.0"), made("1.1", wrong_order)], samples=1)
    assert found(result) == [("own RK4", "1.1", AWAY)]
    assert result.row(tree.name, "1.0", "own RK4").digits > 6


def test_times_are_ratios_to_the_last_version():
    slow = "import time\nold = E.seconds; E.seconds = lambda self, *x, **y: 3.0 * old(self, *x, **y)"
    result = mb.versions(pendulum(), "mujoco", [made("1.0", slow), made("1.1")], samples=1)
    assert 1.5 < result.row("double_pendulum", "1.0", "M").time_ratio < 6.0
    assert result.row("double_pendulum", "1.1", "M").time_ratio == 1.0


@pytest.mark.thorough
def test_as_many_environments_stay_as_are_to_be_kept(tmp_path, monkeypatch, capsys):
    place = 'for last; do :; done; mkdir -p "$last/bin"'
    fake = f'{place}; cp "{tmp_path / "python"}" "$last/bin/python"'
    script(tmp_path / "python", f'exec "{sys.executable}" "$@"')
    script(tmp_path / "bin" / "uv", f'if [ "$1" = venv ]; then {fake}; fi; exit 0')
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    names = [made("1.0"), "1.1", "1.2", "1.3", "1.4"]
    result = mb.versions(pendulum(), "mujoco", names, samples=1, keep=2)
    assert result.same
    left = [v for v in names if environment.exists("mujoco", v)]
    assert left == ["1.0", "1.1", "1.4"]
    said = capsys.readouterr().err
    assert said.index("4 environments are made, some 44 s and 240 MB") < said.index(
        "making an environment of mujoco 1.1"
    )
    mb.versions(pendulum(), "mujoco", ["1.1", "1.6"], samples=1, keep=0)
    assert [v for v in (*names, "1.6") if environment.exists("mujoco", v)] == left


@pytest.mark.thorough
@pytest.mark.parametrize(
    "executor",
    [partial(ThreadPoolExecutor, 2), partial(ProcessPoolExecutor, 1, get_context("spawn"))],
    ids=["threads", "processes"],
)
def test_executors_find_the_same(executor):
    names = [made(f"1.{k}", wrong(1.001) if k == 2 else "") for k in range(4)]
    alone = mb.versions(pendulum(), "mujoco", names, samples=2)
    with executor() as pool:
        result = mb.versions(pendulum(), "mujoco", names, samples=2, executor=pool)
    assert found(result) == found(alone) == [("g", "1.2", AWAY), ("g", "1.3", TOWARDS)]
    assert [(r.term, r.version, r.digits) for r in result.rows] == [(r.term, r.version, r.digits) for r in alone.rows]


def test_a_result_is_plain_data_and_comes_back():
    result = mb.versions(pendulum(), "mujoco", [made("1.0"), made("1.1", wrong(1.001))], samples=1)
    back = VersionsResult.from_json(result.to_json())
    assert back.to_json() == result.to_json()
    assert "g of double_pendulum: away from the truth" in result.to_markdown()
    assert "<table>" in result._repr_html_()
    assert len(result.to_csv().splitlines()) == 1 + len(result.rows)
    page = render(versions_view(result))
    assert "away from the truth" in page
    with pytest.raises(LookupError):
        result.row("double_pendulum", "1.7", "g")


def test_the_command_says_what_moved_and_by_its_status(tmp_path):
    made("1.0"), made("1.1", wrong(1.001))
    out = str(tmp_path / "out")
    for versions, status in (("1.0,1.1", 1), ("1.0", 0)):
        run = CliRunner().invoke(cli, ["versions", "pendulum", "--versions", versions, "--out", out, "--samples", "1"])
        assert run.exit_code == status, run.output
    assert sorted(p.suffix for p in Path(out).iterdir()) == [".csv", ".html", ".json"]
    run = CliRunner().invoke(cli, ["versions", "pendulum", "--versions", "1.0,1.1", "--json", "--out", out])
    assert [c["version"] for c in json.loads(run.stdout)["changes"]] == ["1.1"]
    assert CliRunner().invoke(cli, ["versions", "pendulum", "--engine", "mujuco", "--out", out]).exit_code == 2


def test_versions_are_chosen_by_where_they_begin_and_end(monkeypatch):
    from mbkit.studies.versions import study

    monkeypatch.setattr(study, "versions_of", lambda _: ("2.9.1", "3.0.0", "3.1.0", "3.10.0", "3.11.2", "4.0.0"))
    chosen = [x.version for x in study._chosen("mujoco", None, "3.1", "3.11")]
    assert chosen == ["3.1.0", "3.10.0", "3.11.2"]
    assert [x.version for x in study._chosen("mujoco", None, "", "latest")][-1] == "4.0.0"
    with pytest.raises(UnknownNameError, match=r"there are: 2\.9\.1"):
        study._chosen("mujoco", None, "5", "latest")
    with pytest.raises(InputError, match="first"):
        study._chosen("mujoco", None, "new", "latest")


def test_a_number_that_is_as_wrong_as_before_goes_nowhere():
    names = [made("1.0", wrong(1.001)), made("1.1", wrong(0.999)), made("1.2", wrong(0.9))]
    result = mb.versions(pendulum(), "mujoco", names, samples=1)
    assert found(result) == [("g", "1.1", ASIDE), ("g", "1.2", AWAY)]


@pytest.mark.parametrize("n", [1, 2, 7, 40])
def test_a_spread_has_both_ends(n):
    some = _spread(n, 5)
    assert (some[0], some[-1]) == (0, n - 1)
    assert len(some) == min(n, 5)
    assert np.ptp(np.diff(some)) <= 1 if len(some) > 1 else True


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"engine": "casadi"}, "engine with versions"),
        ({"targets": []}, "targets: expected"),
        ({"targets": ["pendulum", "pendulum"]}, "expected each once"),
        ({"versions": "3.1.0"}, "versions: expected several names"),
        ({"versions": ["3.1 --pre"]}, "expected an engine and its version"),
        ({"keep": -1}, "keep: expected"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"most": 0}, "most"),
    ],
)
def test_bad_input_is_refused_before_anything_is_made(arguments, reason):
    with pytest.raises((InputError, UnknownNameError), match=reason):
        mb.versions(**{"targets": "pendulum", "engine": "mujoco", "versions": ["1.0"]} | arguments)
