"""Whatever an importer does, it does to a process of its own: its end is told, and the rest is compared."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import mbkit as mb
from mbkit.engines import imported
from mbkit.errors import InputError
from mbkit.studies.importers import study

ROBOT = (
    '<robot name="{0}"><link name="base"/><link name="arm"><inertial><origin xyz="0 0 0.1"/><mass value="2"/>'
    '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>'
    '<joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint></robot>'
)
# An importer of another kind for each robot's name.
PLANTED = """
import os, re, signal, sys, time

def read(text, format_, floating_base, files):
    name = re.search('robot name="(\\w+)"', text)[1]
    if name == "segfault":
        print("the last thing that it said", flush=True)
        os.kill(os.getpid(), signal.SIGSEGV)
    if name == "sleep":
        time.sleep(600)
    if name == "spin":
        while True:
            pass
    if name == "quit":
        os._exit(7)
    if name == "exit":
        sys.exit("a demand that fails")
    if name == "fault":
        raise IndexError("list index out of range")
    from mbkit.engines.pinocchio.importer import read as sound
    made = sound(text, format_, floating_base, files)
    if name == "later":
        return type(made)(made.model, lambda q, v, without: os.abort(), ("a note",))
    return type(made)(made.model, made.terms, (str(os.getpid()),))
"""


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Return what becomes of a robot whose planted importer stands in for Drake's."""
    (tmp_path / "planted_importer.py").write_text(PLANTED, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    key = imported.IMPORTERS["drake"]._replace(module="planted_importer", library="planted_importer")
    monkeypatch.setitem(imported.IMPORTERS, "drake", key)

    def run(
        name: str, importers: tuple[str, ...] = ("drake",), **options: float
    ) -> mb.studies.parsers.ParserComparison:
        path = tmp_path / f"{name}.urdf"
        path.write_text(ROBOT.format(name), encoding="utf-8")
        return mb.compare_parsers(path, importers, samples=1, **options)

    yield run
    worker = study._workers.pop(key, None)
    if worker is not None:
        worker.end()


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("segfault", "its importer ended the process with SIGSEGV (the last thing that it said)"),
        ("quit", "its importer: the process ended with status 7"),
        ("exit", "SystemExit: a demand that fails"),
        ("fault", "IndexError: list index out of range"),
        ("later", "its importer ended the process with SIGABRT"),
    ],
)
def test_an_importer_that_dies_is_a_told_refusal(told, name: str, why: str) -> None:
    others = ("pinocchio",) if name == "segfault" else ()
    *rest, drake = told(name, (*others, "drake")).importers
    assert drake.refused == why
    assert not drake.stages
    assert all(p.agrees for p in rest)


def test_one_that_hangs_is_stopped_and_the_next_file_read(told) -> None:
    assert told("spin", seconds=0.2).importers[0].refused.startswith("its importer was stopped after ")
    assert told("sleep", seconds=0.2).importers[0].refused.startswith("its importer was stopped after ")
    # One process for one file after the other.
    first, second = (told(name).importers[0] for name in ("sound", "sounder"))
    assert first.agrees
    assert first.notes == second.notes != (str(os.getpid()),)
    # One that was interrupted owes an answer that nobody wants.
    study._workers[imported.IMPORTERS["drake"]].begin(os.getpid)
    assert told("sound").importers[0].notes != first.notes
    with pytest.raises(InputError, match="seconds"):
        told("sound", seconds=-1.0)


@pytest.mark.thorough
def test_in_a_script_without_a_guard_in_its_forks_and_after_its_end(tmp_path: Path) -> None:
    (tmp_path / "r.urdf").write_text(ROBOT.format("r"), encoding="utf-8")
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent(
            """
            import os
            import mbkit as mb
            from mbkit.studies.importers import study

            def pid():
                assert mb.compare_parsers("r.urdf", ("mujoco",)).importers[0].agrees
                (worker,) = study._workers.values()
                return worker.call(os.getpid)

            first = pid()
            forked = os.fork()
            if not forked:
                # A fork has no part in its parent's processes.
                (worker,) = study._workers.values()
                own = worker.call(os.getpid)
                worker.end()
                raise SystemExit(own == first)
            assert os.waitpid(forked, 0)[1] == 0
            assert pid() == first
            print(first)
            """
        ),
        encoding="utf-8",
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-W", "error", str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    with pytest.raises(ProcessLookupError):
        os.kill(int(done.stdout), 0)
    assert not list(tmp_path.glob("mbkit-*"))
