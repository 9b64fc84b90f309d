"""The command `mbkit bench`: what it prints, writes, and how it ends."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

import mbkit as mb
from mbkit.cli import cli
from mbkit.studies.study_runs import OUT_OF_TIME, InterruptedSweepError

SHORT = ("--engines", "pinocchio,mujoco", "--methods", "rk4,mujoco_rk4", "--quick", "--seconds", "30", "--repeats", "1")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder of the test's own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path, list[object]]:
    """A study in its shortest form, the folder that it wrote to, and the study itself."""
    from mbkit.studies import work_precision

    made: list[object] = []

    def keeping(*arguments: object, **more: object) -> object:
        made.append(work_precision(*arguments, **more))
        return made[0]

    out = tmp_path_factory.mktemp("bench")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mbkit.studies.work_precision", keeping)
        return call("bench", "pendulum", *SHORT, "--out", str(out)), out, made


@pytest.fixture
def pendulum(measured: tuple[Result, Path, list[object]]) -> tuple[Result, Path]:
    """What the study printed, and the folder that it wrote to."""
    return measured[:2]


@pytest.fixture
def at_hand(measured: tuple[Result, Path, list[object]], monkeypatch: pytest.MonkeyPatch) -> object:
    """The same study for every command that asks for one."""
    monkeypatch.setattr("mbkit.studies.work_precision", lambda *_, **__: measured[2][0])
    return measured[2][0]


def call(*arguments: str) -> Result:
    return CliRunner().invoke(cli, arguments)


def test_a_study_is_printed_and_written(pendulum):
    result, out = pendulum
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("pendulum: fastest of 3 curves")
    # Lines are broken by the width of the terminal.
    text = " ".join(result.stdout.split())
    for wanted in ("first run", "mujoco_rk4", "compile", "its own error is at most", str(out / "pendulum-bench.html")):
        assert wanted in text, wanted
    assert result.stderr == ""
    suffixes = {".html", ".json", ".csv", ".png"}
    assert {p.name for p in out.iterdir()} == {f"pendulum-bench{s}" for s in suffixes}
    assert (out / "pendulum-bench.png").read_bytes().startswith(b"\x89PNG")
    page = (out / "pendulum-bench.html").read_text(encoding="utf-8")
    assert "<svg" in page
    assert 'href="pendulum-bench.csv"' in page


def test_json_and_csv_hold_the_same_points(pendulum):
    _, out = pendulum
    data = json.loads((out / "pendulum-bench.json").read_text())
    assert data["complete"]
    assert data["settings"]["repeats"] == 1
    rows = list(csv.DictReader(io.StringIO((out / "pendulum-bench.csv").read_text())))
    told = [(c["engine"], c["method"], p["value"], p["error"]) for c in data["curves"] for p in c["points"]]
    assert len(told) > 5
    assert [(r["engine"], r["method"], float(r["value"]), float(r["error"])) for r in rows] == told
    assert {r["front"] for r in rows} == {"0", "1"}


def test_what_was_finished_is_written_when_interrupted(here, monkeypatch, at_hand):
    def interrupted(*_: object, **__: object) -> None:
        raise InterruptedSweepError(replace(at_hand, complete=False, curves=at_hand.curves[:1]))

    monkeypatch.setattr("mbkit.studies.work_precision", interrupted)
    result = call("bench", "pendulum", *SHORT, "--json")
    assert result.exit_code == 130
    assert "interrupted: " in result.stderr
    told = json.loads(result.stdout)
    assert not told["complete"]
    assert len(told["curves"]) == 1
    assert "interrupted" in (here / "mbkit-report" / "pendulum-bench.html").read_text(encoding="utf-8")
    assert (here / "mbkit-report" / "pendulum-bench.csv").exists()


def test_interrupted_before_anything_was_finished(here, monkeypatch):
    def at_once(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mbkit.studies.work_precision", at_once)
    result = call("bench", "pendulum", *SHORT)
    assert result.exit_code == 130
    assert "interrupted: " in result.stderr
    assert not list(here.iterdir())


BAD = [
    (["bench", "panda", "--methods", "rk5"], "unknown method 'rk5'"),
    (["bench", "pendulum", "--methods", "taylor", "--engines", "pinocchio"], "taylor is not on pinocchio"),
    (["bench", "pendulum", "--duration", "-1"], "duration"),
    (["bench", "panda", "--out", "regular/below"], "regular is not a folder"),
]


@pytest.mark.parametrize(("arguments", "told"), BAD, ids=[" ".join(a) for a, _ in BAD])
def test_bad_input_is_one_message_and_exit_2(here, arguments, told):
    (here / "regular").write_text("")
    result = call(*arguments)
    assert result.exit_code == 2, result.output
    assert told in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert [p.name for p in here.iterdir()] == ["regular"]


def test_a_bench_says_that_its_runs_are_short_and_full_ones_are_not():
    model = mb.catalog.pendulum()
    short, whole = (
        mb.work_precision(model, ["lagrangian"], ["rk4"], steps=[0.1], duration=0.1, repeats=1, work=work)
        for work in (6_000, None)
    )
    assert short.shortened == ("runs of up to 6,000 evaluations alone",)
    assert whole.shortened == ()
    assert call("bench", "pendulum", "--full", "--quick").exit_code == 2


def test_what_was_taken_out_of_the_model_comes_first(tmp_path):
    (tmp_path / "r.urdf").write_text(
        '<robot name="r"><link name="base"/><link name="rod"><inertial><origin xyz="0.2 0 0"/><mass value="1"/>'
        '<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="hinge" '
        'type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/><dynamics friction="0.1"/>'
        "</joint></robot>"
    )
    arguments = ["--engines", "lagrangian", "--methods", "rk4", "--duration", "0.1", "--repeats", "1"]
    done = call("bench", str(tmp_path / "r.urdf"), *arguments, "--out", str(tmp_path / "out"))
    assert "; without dry friction; " in " ".join(done.stdout.split("\n\n")[0].split())
    (page,) = (tmp_path / "out").glob("*.html")
    assert "without dry friction" in page.read_text()


def test_little_time_is_shared_by_all_engines_and_names_no_winner_without_them():
    """Each engine has its first curve before any has its second, whatever the clock says."""
    model, methods = mb.catalog.pendulum(), ["rk4", "rk853", "radau"]
    result = mb.work_precision(model, methods=methods, repeats=1, duration=0.2, seconds=1e-3, work=1000)
    assert {c.engine for c in result.curves} == {"pinocchio", "lagrangian", "mujoco"}
    assert {c.method for c in result.curves} == {"rk4"}
    assert result.untimed == ()
    lost = [r for r in result.refusals if r.reason == OUT_OF_TIME]
    less = replace(
        result,
        curves=tuple(c for c in result.curves if c.engine == "pinocchio"),
        refusals=(*lost, *(replace(lost[0], engine=e, term="rk4") for e in ("lagrangian", "mujoco"))),
    )
    assert less.untimed == ("lagrangian", "mujoco")
    assert less.headline.startswith("no time was left for lagrangian and mujoco, so none is")
    assert "fastest of" not in less.headline
