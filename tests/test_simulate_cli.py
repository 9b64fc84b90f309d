"""The commands `mbkit simulate` and `mbkit plot`, and the help of all commands."""

from __future__ import annotations

import csv
import json
import shlex
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner, Result

from mbkit import catalog, dynamics, simulate
from mbkit.cli import cli
from mbkit.studies import svg
from tests.descriptions import links, robot, urdf_joint
from tests.test_report import AGREEING, STUDY
from tests.test_stress_report import RESULT


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder of the test's own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def undrawn(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: ARG001
    """What a test does not look at is not drawn: that would be most of its time."""
    monkeypatch.setattr(svg, "image", lambda _: b"")


def call(*arguments: str) -> Result:
    return CliRunner().invoke(cli, arguments)


# mbkit simulate


def test_a_run_is_the_librarys_and_is_written_whole(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = call("simulate", "cart_pole", "--q0", "-0.5,1", "--v0", "0.1,0", "--duration", "0.2", "--dt", "2e-3")
    assert result.exit_code == 0, result.output
    run = simulate(dynamics(catalog.cart_pole()), [-0.5, 1.0], [0.1, 0.0], 0.2, dt=2e-3)
    folder = here / "mbkit-report"
    assert {p.name for p in folder.iterdir()} == {
        f"cart_pole-{name}" for name in ("trajectory.csv", "plot.png", "picture.png")
    }
    rows = list(csv.reader((folder / "cart_pole-trajectory.csv").read_text().splitlines()))
    assert rows[0] == ["t", "q.x", "q.theta", "v.x", "v.theta"]
    assert np.array_equal(np.array(rows[1:], dtype=float), np.column_stack([run.t, run.q, run.v]))
    assert (folder / "cart_pole-plot.png").read_bytes().startswith(b"\x89PNG")
    assert f"{run.q[-1, 1]:.6g}" in result.stdout
    assert "cart_pole-picture.png" in result.stdout
    monkeypatch.setattr(svg, "image", lambda _: b"")
    # What mbkit wrote, it replaces; what somebody else wrote, it does not.
    assert call("simulate", "cart_pole", "--duration", "0.01").exit_code == 0
    (folder / "cart_pole-trajectory.csv").write_text("mine")
    again = call("simulate", "cart_pole", "--duration", "0.01")
    assert again.exit_code == 2
    assert "--force" in again.stderr
    assert call("simulate", "cart_pole", "--duration", "0.01", "--force").exit_code == 0


@pytest.mark.usefixtures("undrawn")
def test_json_has_the_cost_and_the_final_state() -> None:
    start = "--q0", "random:3", "--v0", "random:3"
    result = call("simulate", "cart_pole", *start, "--method", "rk853", "--rtol", "1e-8", "--save", "10", "--json")
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    model = catalog.cart_pole()
    times = np.linspace(0.0, 1.0, 11)
    run = simulate(dynamics(model), *model.random_state(3), 1.0, "rk853", rtol=1e-8, save=times)
    assert data["final"]["t"] == 1.0
    assert list(data["final"]["q"].values()) == run.q[-1].tolist()
    assert data["final"]["v"]["theta"] == run.v[-1, 1]
    assert data["stats"]["steps"] == run.stats.steps
    assert data["finished"]
    assert data["doubts"] == []
    assert "cart_pole-trajectory.csv" in result.stderr


@pytest.mark.thorough("slider_crank-lagrangian", "pendulum-pinocchio")
@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("target", "engine"),
    [("mbkit.lagrangian.systems:kepler", "lagrangian"), ("slider_crank", "lagrangian"), ("pendulum", "pinocchio")],
)
def test_the_engine_is_one_that_holds_the_system(target: str, engine: str) -> None:
    start = ("--q0", "1,0", "--v0", "0,1") if "kepler" in target else ()
    result = call("simulate", target, *start, "--duration", "0.01", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["engine"] == engine


@pytest.mark.usefixtures("undrawn")
def test_a_torque_saturates_where_asked(here: Path) -> None:
    limit = '<limit lower="-2" upper="2" effort="5" velocity="3"/>'
    (here / "arm.urdf").write_text(robot(links("base", "arm"), urdf_joint("j", "base", "arm", limit)))
    push = "simulate", "arm.urdf", "--duration", "0.1", "--torque", "-8", "--force"
    result = call(*push, "--saturate")
    assert result.exit_code == 0, result.output
    assert "torque on j clipped in 100 % of the run, first at t = 0 s, by at most 3" in result.stdout
    rows = (here / "mbkit-report" / "arm-trajectory.csv").read_text().splitlines()
    assert (rows[0].split(",")[-1], float(rows[-1].split(",")[-1])) == ("tau.j", -5.0)
    data = json.loads(call(*push, "--saturate", "--json").stdout)
    assert data["stats"]["saturated"] == [["j", 1.0, 0.0, 3.0]]
    assert json.loads(call(*push, "--json").stdout)["stats"]["saturated"] == []


@pytest.mark.usefixtures("undrawn")
def test_a_run_that_diverges_or_is_doubtful_has_status_1() -> None:
    wild = ("simulate", "double_pendulum", "--q0", "1.5,1", "--v0", "30,3", "--duration", "20", "--dt", "0.05")
    result = call(*wild, "--method", "semi_implicit_euler", "--json")
    assert result.exit_code == 1
    data = json.loads(result.stdout)
    assert not data["finished"]
    assert data["stats"]["ended"] == "diverged"
    assert "diverged" in result.stderr
    drifting = call("simulate", "pendulum", "--q0", "3", "--method", "rk853", "--rtol", "1e-2", "--duration", "60")
    assert drifting.exit_code == 1
    assert "with doubts" in drifting.stdout
    assert "gained" in drifting.stderr


BAD = [
    (["simulate"], "TARGET"),
    (["simulate", "pendulum", "--engine", "bullet"], "unknown engine 'bullet'"),
    (["simulate", "pendulum", "--method", "rk5"], "unknown method 'rk5'"),
    (["simulate", "pendulum", "--q0", "random:x"], "--q0: expected neutral, random:SEED or 1 numbers"),
    (["simulate", "pendulum", "--v0", "a,b"], "--v0: expected neutral"),
    (["simulate", "pendulum", "--q0", "1,2"], "q0: expected shape (1,)"),
    (["simulate", "pendulum", "--torque", "a"], "--torque: expected neutral"),
    (["simulate", "pendulum", "--saturate"], "saturate: expected joints with effort_limit"),
    (["simulate", "pendulum", "--rtol", "1e-8"], "rtol"),
    (["simulate", "pendulum", "--save", "7"], "is not a step of dt"),
    (["simulate", "slider_crank", "--engine", "drake"], "constraints"),
    (["plot"], "FILE"),
    (["plot", "missing.json"], "cannot read missing.json"),
    (["plot", "regular"], "regular: expected the CSV of mbkit simulate, or the JSON of mbkit check"),
    (["plot", "other.csv"], "other.csv: expected the table of a trajectory"),
    (["plot", "list.json"], "list.json: expected the CSV of mbkit simulate"),
    (["plot", "half.json", "--case", "x"], "for --case"),
    (["plot", "other.csv", "below/other.csv", "--out", "figures"], "different names"),
]


@pytest.mark.parametrize(("arguments", "told"), BAD, ids=[" ".join(a) for a, _ in BAD])
def test_bad_input_is_one_message_and_exit_2(here: Path, arguments: list[str], told: str) -> None:
    texts = {"regular": "", "other.csv": "a,b\n1,2\n", "list.json": "[1]", "half.json": '{"curves": 3}'}
    for name, text in texts.items():
        (here / name).write_text(text)
    result = call(*arguments)
    assert result.exit_code == 2, result.output
    assert told in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert {p.name for p in here.iterdir()} == set(texts)


# mbkit plot


@pytest.mark.thorough
def test_every_result_becomes_a_figure(here: Path) -> None:
    for name, result in (("check", AGREEING), ("bench", STUDY), ("stress", RESULT)):
        result.to_json(here / f"{name}.json")
    simulate(dynamics(catalog.pendulum()), [1.0], [0.0], 0.1).to_csv(here / "run.csv")
    names = ["check.json", "bench.json", "stress.json", "run.csv"]
    drawn = call("plot", *names)
    assert drawn.exit_code == 0, drawn.output
    assert drawn.stdout.split() == ["check.png", "bench.png", "stress.png", "run.png"]
    assert all((here / name).read_bytes().startswith(b"\x89PNG") for name in drawn.stdout.split())
    for _ in range(2):
        # A figure of its own is replaced, and is the same.
        again = call("plot", *names, "--format", "svg", "--out", "figures")
        assert again.exit_code == 0, again.output
    pages = {p.name: p.read_text() for p in (here / "figures").iterdir()}
    assert len(pages) == 4
    assert all("<svg" in page for page in pages.values())
    assert "theta" in pages["run.svg"], "text that can be searched"
    one = call("plot", "stress.json", "--case", "joint_spring")
    assert one.stdout.split() == ["stress-joint_spring.png"]
    assert "did you mean 'joint_spring'" in call("plot", "stress.json", "--case", "joint_sprin").stderr


def test_a_picture_of_somebody_else_is_not_replaced(here: Path) -> None:
    AGREEING.to_json(here / "check.json")
    (here / "check.png").write_text("mine")
    result = call("plot", "check.json")
    assert result.exit_code == 2
    assert "--force" in result.stderr
    assert (here / "check.png").read_text() == "mine"
    assert call("plot", "check.json", "--force").exit_code == 0


# The help of all commands


def commands(group: click.Group, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    for name, command in group.commands.items():
        yield (*path, name), command
        if isinstance(command, click.Group):
            yield from commands(command, (*path, name))


ALL = dict(commands(cli))


@pytest.mark.parametrize("path", ALL, ids=" ".join)
def test_the_help_ends_in_examples_that_parse(path: tuple[str, ...]) -> None:
    shown = call(*path, "--help").output
    examples = ALL[path].examples  # type: ignore[attr-defined]
    assert examples
    assert shown.rstrip().endswith("\n  ".join(("Examples:", *examples)))
    for example in examples:
        program, *words = shlex.split(example)
        assert program == "mbkit"
        command: click.Command = cli
        while isinstance(command, click.Group):
            command = command.commands[words.pop(0)]
        group = isinstance(ALL[path], click.Group)
        assert command is ALL[path] or (group and command in ALL[path].commands.values())  # type: ignore[attr-defined]
        command.make_context("mbkit", words)
