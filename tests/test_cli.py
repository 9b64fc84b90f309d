"""The command: what it prints, what it writes, how it ends."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from mbkit._child_process import WorkerDiedError
from mbkit.cli import cli
from mbkit.errors import OutputError
from mbkit.load.loader import find
from mbkit.studies.compare import all_robots as sweeps
from mbkit.studies.compare import figure
from mbkit.studies.compare.all_robots import RobotOutcome, all_robots
from mbkit.studies.worker import run

QUICK = ("--no-rollouts", "--samples", "4")


@pytest.fixture(autouse=True)
def without_panels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the panels of a page, which take most of a small check's time and are tested with the figures."""
    monkeypatch.setattr(figure, "term_costs", lambda *_: "")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder of the test's own, and the import path as it was."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


def call(*arguments: str) -> Result:
    return CliRunner().invoke(cli, arguments)


def module(folder: Path, name: str, text: str) -> None:
    (folder / f"{name}.py").write_text(textwrap.dedent(text))


@pytest.mark.thorough
def test_a_reader_that_stops_early_does_not_change_the_verdict(tmp_path):
    check = f"{sys.executable} -m mbkit check pendulum --no-rollouts --samples 4 --out {tmp_path}"
    piped = f"{check} | head -n 1; exit ${{PIPESTATUS[0]}}"
    run = subprocess.run(["bash", "-c", piped], capture_output=True, text=True, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "agree" in run.stdout
    assert not run.stderr
    assert (tmp_path / "pendulum.html").exists()


def test_a_fault_of_the_library_has_a_status_of_its_own(monkeypatch, tmp_path):
    def broken(*_args, **_kwargs):
        raise ZeroDivisionError("planted")

    monkeypatch.setattr("mbkit.studies.compare", broken)
    result = CliRunner().invoke(cli, ["check", "pendulum", "--out", str(tmp_path)])
    assert result.exit_code == 70
    assert "planted" in result.stderr
    assert "please report" in result.stderr


def test_a_robot_agrees_and_is_written(here):
    result = call("check", "double_pendulum", *QUICK)
    assert result.exit_code == 0, result.output
    assert "agree to" in result.stdout.splitlines()[0]
    assert len(result.stdout.splitlines()) <= 24
    assert "limits: off here in every engine" in " ".join(result.stdout.split())
    assert "forward dynamics" not in result.stdout
    assert "forward dynamics" in call("check", "double_pendulum", "--full", *QUICK).stdout
    data = json.loads((here / "mbkit-report" / "double_pendulum.json").read_text())
    assert data["passed"]
    assert "<svg" in (here / "mbkit-report" / "double_pendulum.html").read_text()
    assert "mbkit-report/double_pendulum.html" in result.stdout


@pytest.mark.thorough
def test_everything_from_a_cold_start(tmp_path):
    made = subprocess.run(
        [sys.executable, "-m", "mbkit", "check", "pendulum", "--full", "--out", "out"],
        cwd=tmp_path,
        env=os.environ
        | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "PYTHONIOENCODING": "ascii", "MBKIT_COMPILE": "1"},
        capture_output=True,
        timeout=120,
    )
    text = made.stdout.decode("utf-8")
    assert made.returncode == 0, text + made.stderr.decode()
    for wanted in ("✓ pendulum", "Rollouts", "Error against run time", "What a call leaves out", "contacts"):
        assert wanted in text
    assert made.stderr == b""
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"pendulum.html", "pendulum.json"}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_import_of_the_command_is_light():
    heavy = "{'numpy', 'pinocchio', 'mujoco', 'casadi', 'scipy', 'matplotlib', 'rich', 'jinja2'}"
    code = f"import sys, mbkit.cli; print({heavy} & set(sys.modules))"
    env = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    assert subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True).stdout == "set()\n"


def test_files_have_the_robots_own_name_whatever_its_case_was(here):
    assert call("export", "UR5", "--quantity", "gravity", "--out", "o").exit_code == 0
    assert call("baseline", "record", "UR5", "Ur/UR5-gripper", "o", "--engines", "pinocchio").exit_code == 0
    assert {p.name for p in (here / "o").iterdir()} == {"ur5.c", "ur5.h", "ur5.toml", "ur_ur5_gripper.toml"}


def test_two_files_of_one_name_have_reports_of_their_own(here):
    arm = find("double_pendulum_simple").path.read_text()
    for place in ("arm.urdf", "old/arm.urdf", "new/arm_2.urdf"):
        (here / place).parent.mkdir(exist_ok=True)
        (here / place).write_text(arm)
    for place in ("arm.urdf", "old/arm.urdf", str(here / "new" / "arm_2.urdf")):
        done = call("check", place, *QUICK, "--engines", "pinocchio,mujoco", "--out", "o")
        assert done.exit_code == 0, done.output
    stems = ("arm", "old_arm", "new_arm_2")
    assert {p.name for p in (here / "o").iterdir()} == {f"{stem}.{x}" for stem in stems for x in ("html", "json")}


@pytest.mark.parametrize("target", ["https://example.org/robot.urdf", "file:///tmp/robot.urdf", "package://a/b.urdf"])
def test_a_url_is_to_be_downloaded_first(target):
    result = call("check", target)
    assert result.exit_code == 2
    assert target in result.stderr
    assert "download" in result.stderr


def test_a_folder_is_told_with_the_descriptions_in_it(here):
    (here / "things" / "urdf").mkdir(parents=True)
    assert "no .urdf" in call("check", "things").stderr
    (here / "things" / "urdf" / "arm.urdf").write_text(IMPOSSIBLE)
    result = call("check", "things")
    assert result.exit_code == 2
    assert os.path.join("urdf", "arm.urdf") in result.stderr


def test_json_is_all_there_is_on_stdout(here):
    module(
        here,
        "talkative",
        "import mbkit\nprint('import')\ndef f():\n    print('call')\n    return mbkit.catalog.pendulum()",
    )
    result = call("check", "talkative:f", "--json", *QUICK)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["model"] == "pendulum"
    assert "call" in result.stderr
    assert "pendulum.html" in result.stderr


@pytest.mark.usefixtures("here")
def test_options_of_files_are_refused_for_what_is_no_file():
    result = call("check", "pendulum", "--floating-base")
    assert result.exit_code == 2
    assert "floating_base" in result.stderr


def test_a_known_defect_is_a_named_failure_and_exit_1(here):
    module(
        here,
        "armature",
        """
        import mbkit

        def arm():
            b = mbkit.ModelBuilder("arm")
            b.add_body("link", mass=1.0, com=(0.1, 0, -0.2), inertia=(0.1, 0.1, 0.1))
            b.add_joint("hinge", "revolute", parent="world", child="link", axis=(0, 0.6, 0.8), armature=0.5)
            return b.build()
        """,
    )
    result = call("check", "armature:arm", *QUICK)
    assert result.exit_code == 1, result.output
    assert result.stdout.startswith("✗ arm")
    assert "kinetic energy, pinocchio: differs" in result.stdout
    assert "armature" in result.stdout
    assert result.stderr == ""
    assert "crossed out" in (here / "mbkit-report" / "arm.html").read_text()


def test_warnings_are_one_line(here):
    (here / "arm.urdf").write_text(IMPOSSIBLE.replace('name="r"', 'name="arm"'))
    result = call("check", "arm.urdf", "--nonphysical", "warn", *QUICK)
    assert result.exit_code == 0
    lines = result.stderr.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("warning: arm")
    assert "mujoco left out" in " ".join(result.stdout.split())
    assert "'b'" in result.stdout


@pytest.mark.usefixtures("here")
def test_two_engines_must_hold_the_model():
    result = call("check", "romeo_small", "--engines", "pinocchio,mujoco", *QUICK)
    assert result.exit_code == 2
    assert "two engines" in result.stderr
    assert "RShoulderYawLink" in result.stdout


MODULES = {
    "gives_3": "def f(): return 3",
    "leaves": "import sys; sys.exit(0)",
    "faulty": "import mbkit\ndef f(): return mbkit.ModelBuilder('empty').build()",
}
BAD = [
    (["check"], "give a TARGET"),
    (["check", "pandaa"], "did you mean 'panda'"),
    (["check", "qqqqqqqq"], "mbkit robots"),
    (["check", "nothing.urdf"], "nothing.urdf: no such file"),
    (["check", "nowhere:f"], "No module named 'nowhere'"),
    (["check", "gives_3:g"], "unknown function 'g'"),
    (["check", "gives_3:f"], "expected a Model, got int"),
    (["check", "leaves:f"], "SystemExit"),
    (["check", "faulty:f"], "no bodies"),
    (["check", "panda", "--engines", "pinocchio,bullet"], "unknown engine 'bullet'"),
    (["check", "panda", "--engines", "pinocchio"], "at least two"),
    (["check", "panda", "--mimic", "maybe"], "--mimic"),
    (["check", "panda", "--jobs", "2"], "--all"),
    (["check", "panda", "--out", "regular/below"], "regular is not a folder"),
    (["check", "--all", "panda"], "without a TARGET"),
    (["chekc", "panda"], "No such command"),
]


@pytest.mark.parametrize(("arguments", "told"), BAD, ids=[" ".join(a) or "empty" for a, _ in BAD])
def test_bad_input_is_one_message_and_exit_2(here, arguments, told):
    for name, text in MODULES.items():
        module(here, name, text)
        sys.modules.pop(name, None)
    (here / "regular").write_text("")
    result = call(*arguments)
    assert result.exit_code == 2, result.output
    assert told in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert not (here / "mbkit-report").exists()


IMPOSSIBLE = """<robot name="r"><link name="a"/><link name="b"><inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="9"/></inertial></link>
<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint></robot>"""


@pytest.mark.parametrize(
    "command",
    [
        "check FILE",
        "diff FILE FILE --mimic reduce",
        "baseline record FILE r.toml",
        "baseline check b.toml --nonphysical error --target FILE",
        "derive FILE",
        "bench FILE",
        "convert FILE --to urdf",
        "export FILE",
    ],
)
def test_every_command_says_how_to_take_impossible_bodies_in_its_own_options(here, command):
    (here / "r.urdf").write_text(IMPOSSIBLE)
    if "b.toml" in command:
        assert call("baseline", "record", "pendulum", "b.toml").exit_code == 0
    result = call(*command.replace("FILE", "r.urdf").split())
    assert result.exit_code == 2, result.output
    assert "'b'" in result.stderr
    assert "--nonphysical warn" in result.stderr
    assert 'nonphysical="warn"' not in result.stderr
    assert "--nonphysical" in call(*command.split()[: 2 if "baseline" in command else 1], "--help").output


@pytest.mark.usefixtures("here")
def test_a_result_that_cannot_be_written_is_still_printed(monkeypatch):
    def full(*_: object, **__: object) -> Path:
        raise OutputError("cannot write there: No space left on device")

    monkeypatch.setattr("mbkit.report.output_folder.write", full)
    for more in ((), ("--json",)):
        result = call("check", "pendulum", *QUICK, *more)
        assert result.exit_code == 2
        assert "No space left" in result.stderr
        assert "forward dynamics" in result.stdout
    assert json.loads(result.stdout)["passed"]


def outcomes(*statuses: str, interrupt: bool = False):
    def made(**_: object):
        for k, status in enumerate(statuses):
            yield RobotOutcome(f"folder/robot{k}", status, "because" if status != "agree" else "")
        if interrupt:
            raise KeyboardInterrupt

    return made


@pytest.mark.parametrize(
    ("statuses", "status"), [(["agree", "refused"], 0), (["agree", "differ"], 1), (["refused", "failed"], 1)]
)
def test_all_ends_by_what_its_robots_end_in(here, monkeypatch, statuses, status):
    monkeypatch.setattr("mbkit.load.robots", lambda: ("a", "b"))
    monkeypatch.setattr(sweeps, "all_robots", outcomes(*statuses))
    result = call("check", "--all")
    assert result.exit_code == status, result.output
    assert "2 robots" in result.stdout
    assert {p.name for p in (here / "mbkit-report").iterdir()} == {"all.html", "all.json"}


def test_interrupting_all_shows_and_writes_what_is_finished(here, monkeypatch):
    monkeypatch.setattr(sweeps, "all_robots", outcomes("agree", "refused", interrupt=True))
    result = call("check", "--all", "--json")
    assert result.exit_code == 130
    assert "2 of 69" in result.stderr
    assert len(json.loads(result.stdout)["robots"]) == 2
    assert (here / "mbkit-report" / "all.html").exists()


# Many robots.


def test_what_should_not_happen_to_one_robot_does_not_end_the_others(monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("a defect of ours")

    monkeypatch.setattr(sweeps, "compare", broken)
    with ThreadPoolExecutor(1) as executor:
        found = list(all_robots(["ur3", "ur5"], executor=executor))
    assert [o.status for o in found] == ["failed", "failed"]
    assert found[0].reason == "ZeroDivisionError: a defect of ours"


def test_a_dying_process_is_named_and_takes_no_other_down():
    calls = {"good": partial(abs, -3), "raises": partial(int, "x"), "dies": partial(os._exit, 1)}
    calls |= {f"good{k}": partial(abs, k) for k in range(4)}
    found = dict(run(calls, jobs=2))
    assert isinstance(found.pop("dies"), WorkerDiedError)
    assert isinstance(found.pop("raises"), ValueError)
    assert found == {"good": 3, "good0": 0, "good1": 1, "good2": 2, "good3": 3}


@pytest.mark.thorough
def test_leaving_the_loop_ends_the_processes(tmp_path):
    noted = tmp_path / "pid"
    slow = f"import os, time; open({str(noted)!r}, 'w').write(str(os.getpid()) + '.'); time.sleep(600)"
    pids = []
    for name, pid in run({"quick": os.getpid, "slow": partial(exec, slow)}, jobs=2):
        assert name == "quick"
        while not noted.exists() or not noted.read_text().endswith("."):
            pass
        pids = [pid, int(noted.read_text()[:-1])]
        break
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


# Files of others.

COMMANDS = {
    "check pendulum --samples 1 --no-rollouts": ("pendulum.json", "pendulum.html"),
    "check ur3 --own-parsers": ("ur3.importers.json", "ur3.importers.html"),
    "check --all": ("all.json", "all.html"),
    "bench pendulum --engines lagrangian --methods rk4 --duration 0.01 --repeats 1 --seconds 1": (
        "pendulum-bench.json",
        "pendulum-bench.csv",
        "pendulum-bench.png",
        "pendulum-bench.html",
    ),
    "stress joint_spring": ("joint_spring-stress.json", "joint_spring-stress.csv", "joint_spring-stress.html"),
    "derive pendulum": ("pendulum.txt",),
    "derive pendulum --python": ("pendulum.py",),
    "derive pendulum --latex": ("pendulum.tex",),
    "derive pendulum --json": ("pendulum.json",),
}


@pytest.mark.thorough("bench pendulum --engines lagrangian --methods rk4 --duration 0.01 --repeats 1 --seconds 1")
@pytest.mark.parametrize("command", COMMANDS)
def test_a_file_of_somebody_else_is_not_replaced(here, command):
    for k, name in enumerate(COMMANDS[command]):
        path = here / "out" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(('{"name": "mine"}', "engine,pages\n1,2\n", "[" * 10_000)[k % 3])
        before = path.read_bytes()
        result = call(*command.split(), "--out", "out")
        assert result.exit_code == 2
        assert name in result.stderr
        assert "--force" in result.stderr
        assert path.read_bytes() == before
        assert [p.name for p in path.parent.iterdir()] == [name]
        path.unlink()
    if command.startswith(("bench", "derive")):
        path.write_text("mine")
        for more in (["--force"], []):
            # What mbkit wrote itself, it replaces.
            result = call(*command.split(), "--out", "out", *more)
            assert result.exit_code == 0, result.output
        assert {p.name for p in path.parent.iterdir()} == set(COMMANDS[command])


# Ctrl-C.

#: A command whose interruption is swallowed, as libraries do that it meets in their imports.
_SWALLOWING = """
import os, sys, time
from mbkit import _process as _interrupt
import mbkit.cli
@mbkit.cli.cli.command("wait")
def wait():
    keeping = _interrupt.keeping if "keep" in os.environ else _interrupt.Section()
    with keeping:
        for _ in range(600):
            try:
                print("ready", flush=True)
                time.sleep(0.1)
            except BaseException:
                {then}
sys.argv = ["mbkit", "wait"]
from mbkit.__main__ import main
main()
"""


@pytest.mark.parametrize(
    ("then", "presses", "environment"),
    [
        ("pass", 1, {}),
        ("raise ImportError('initialization failed')", 1, {}),
        ("import traceback; traceback.print_exc(); os.write(2, b'noise')", 1, {}),
        ("raise", 1, {}),
        ("raise", 1, {"keep": "1"}),
        ("pass", 2, {"keep": "1"}),
        ("_interrupt.raise_again()", 1, {"keep": "1"}),
    ],
)
def test_an_interruption_is_one_line_and_its_status_whoever_swallows_it(then, presses, environment):
    code = _SWALLOWING.format(then=then)
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | environment,
        # A job in the background ignores the signal, and its children would too.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    for _ in range(presses):
        process.stdout.readline()
        process.send_signal(signal.SIGINT)
        if presses > 1:
            for _ in range(3):
                process.stdout.readline()
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert len(said.splitlines()) == 1
    assert said.startswith("interrupted: ")


def test_the_entry_point_listens_before_anything_heavy_is_imported():
    code = "import sys; from mbkit import __main__; print(*sorted(sys.modules))"
    run = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, check=True)
    assert not {"typing", "click", "numpy", "mbkit.cli", "mbkit.errors"} & set(run.stdout.split())


@pytest.mark.usefixtures("here")
def test_an_option_that_own_parsers_do_not_take_is_named():
    result = call("check", "ur3", "--own-parsers", "--no-rollouts", "--mimic", "free")
    assert result.exit_code == 2
    assert "not --no-rollouts, --mimic" in " ".join(result.stderr.split())
