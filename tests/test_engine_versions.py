"""Engines of other versions: environments, processes and the protocol; the present interpreter is an environment."""

from __future__ import annotations

import ast
import os
import pickle
import signal
import stat
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import entry_points
from importlib.metadata import version as installed
from pathlib import Path

import numpy as np
import pytest

import mbkit as mb
from mbkit._child_process import end_all
from mbkit.engines.registry import find_engine
from mbkit.engines.remote import environment, process
from mbkit.engines.remote.dynamics import VersionDynamics
from mbkit.engines.remote.packages import PACKAGES, EngineVersion
from mbkit.engines.remote.served import serve
from mbkit.errors import (
    EngineProcessError,
    InputError,
    KnownDefectWarning,
    MbkitError,
    UnknownNameError,
    UnsupportedError,
)
from mbkit.studies._targets import engine_names
from tests.random_trees import IN_MUJOCO, SOUND, random_tree
from validation import versions

#: Those that are installed here.
ENGINES = tuple(name for name, package in PACKAGES.items() if not package.tested)


def script(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def present(engine: str, version: str, before: str = "") -> EngineVersion:
    """Make an environment of the present interpreter, and return its engine."""
    python = environment.python_of(environment.place(PACKAGES[engine].distribution, version))
    # A real environment links to an interpreter, over which the script would be written.
    assert not python.is_symlink()
    script(python, f'{before}\nexec "{sys.executable}" "$@"')
    return mb.engine(f"{engine}=={version}")


@pytest.fixture(autouse=True)
def environments(tmp_path, monkeypatch):
    monkeypatch.setenv("MBKIT_ENVIRONMENTS", str(tmp_path / "environments"))
    end_all()
    yield tmp_path / "environments"
    end_all()


def chain() -> mb.Model:
    """Two joints with springs, dampers and rotors."""
    b = mb.ModelBuilder("chain")
    for name, kind, parent, body in (("j1", "revolute", "world", "one"), ("j2", "prismatic", "one", "two")):
        b.add_body(body, mass=2.0, com=(0.1, 0.2, 0.3), inertia=(0.3, 0.4, 0.5))
        numbers = {"damping": 0.3, "stiffness": 2.0, "rest": 0.1, "armature": 0.2, "axis": (0.6, 0.0, 0.8)}
        b.add_joint(name, kind, parent=parent, child=body, translation=(0.1, 0.0, 0.4), **numbers)
    return b.build()


def between() -> mb.Model:
    """Two branches with springs and a damper between points, and springs, dampers and rotors on sums of coordinates."""
    b = mb.ModelBuilder("between")
    for name, kind, parent, body in (
        ("swivel", "ball", "world", "trunk"),
        ("left", "revolute", "trunk", "a"),
        ("right", "prismatic", "trunk", "b"),
        ("tip", "helical", "a", "c"),
    ):
        b.add_body(body, mass=2.0, com=(0.1, 0.2, 0.3), inertia=(0.3, 0.4, 0.5))
        axis = {} if kind == "ball" else {"axis": (0.6, 0.0, 0.8)}
        more = {"pitch": 0.2} if kind == "helical" else {}
        b.add_joint(name, kind, parent=parent, child=body, translation=(0.1, 0.2, 0.4), **axis, **more)
    b.add_spring("coil", body_a="world", point_a=(1, 2, 0), body_b="c", point_b=(0, 0.1, 0.2), stiffness=30.0)
    b.add_spring("strut", body_a="a", body_b="b", point_b=(0, 0, 0.3), stiffness=20.0, rest_length=0.3, damping=4.0)
    b.add_coupling("belt", {"left": 1.0, "right": -2.0}, stiffness=5.0, rest_length=0.2, damping=0.7, armature=0.3)
    b.add_coupling("gear", {"left": 1.0, "tip": 3.0}, armature=0.4)
    return b.build()


TURNING = tuple(kind for kind in SOUND if kind in IN_MUJOCO)
STACKED = ("revolute", "universal", "spherical_zyx")
BARE = {"springs": False, "damping": False, "armature": False}
MODELS = {
    "turning": lambda: random_tree(1, 12, TURNING, **BARE),
    "universal": lambda: random_tree(2, 6, STACKED, **BARE),
    "springs": chain,
    "between": between,
}
TERMS = {
    "mass_matrix": 1,
    "gravity": 1,
    "potential_energy": 1,
    "coriolis_force": 2,
    "nle": 2,
    "passive": 2,
    "kinetic_energy": 2,
    "inverse_dynamics": 3,
    "forward_dynamics": 3,
}


@pytest.mark.thorough("springs")
@pytest.mark.parametrize("name", ["springs", "turning"])
def test_threads_that_share_a_version_get_the_poses_of_their_own_states(name):
    model = MODELS[name]()
    dyn, (q, v) = mb.dynamics(model, present("mujoco", "1.0")), model.random_state(0, 60)
    frame = model.bodies[-1].name
    whole = [(dyn.pose(x, frame), dyn.jacobian(x, frame), dyn.coriolis_force(x, y)) for x, y in zip(q, v, strict=True)]
    with ThreadPoolExecutor(4) as pool:
        found = list(
            pool.map(
                lambda k: (dyn.pose(q[k], frame), dyn.jacobian(q[k], frame), dyn.coriolis_force(q[k], v[k])), range(60)
            )
        )
    for mine, others in zip(whole, found, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(mine, others, strict=True))


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", MODELS)
def test_terms_are_those_of_the_oracle(engine, name):
    model = MODELS[name]()
    if engine == "drake":
        pytest.importorskip("pydrake")
    version = present(engine, installed(PACKAGES[engine].distribution))
    if name == "between" and engine == "mujoco":
        with pytest.raises(UnsupportedError, match="helical"):
            mb.dynamics(model, version)
        return
    dyn = mb.dynamics(model, version)
    oracle, rng = mb.dynamics(model, "oracle"), np.random.default_rng(0)
    q, v = model.random_state(rng, 3)
    states = q, v, rng.standard_normal(v.shape)
    # Pinocchio's matrix and energy are known to be wrong for these, which is told.
    wrong = {"universal": "coriolis_force", "springs": "kinetic_energy"}.get(name) if engine == "pinocchio" else None
    for term, arguments in TERMS.items():
        with warnings.catch_warnings(record=True, action="always", category=KnownDefectWarning) as told:
            value, truth = (getattr(d, term)(*states[:arguments]) for d in (dyn, oracle))
        right = np.abs(value - truth).max() <= 1e-12 * max(1.0, np.abs(truth).max())
        assert right == (term != wrong), term
        assert bool(told) == (term == wrong), term
    body = model.bodies[-1].name
    for quantity in (lambda d: d.jacobian(q, body), lambda d: d.pose(q, body)):
        assert np.abs(quantity(dyn) - quantity(oracle)).max() < 1e-12


def test_an_engine_says_what_it_is_and_what_it_cannot_give():
    model = mb.catalog.double_pendulum()
    dyn = mb.dynamics(model, present("mujoco", "4.0.0"))
    assert dyn.engine == "mujoco==4.0.0"
    assert mb.dynamics(model, "mujoco==4.0.0").engine == dyn.engine
    with pytest.raises(UnsupportedError, match="without the matrix"):
        dyn.coriolis_matrix([0.1, 0.2], [1.0, 2.0])
    with pytest.raises(InputError, match="q: expected shape"):
        dyn.gravity([0.1])
    with pytest.raises(InputError, match="has no options"):
        mb.dynamics(model, mb.engine("mujoco==4.0.0"), threads=2)
    again = pickle.loads(pickle.dumps(dyn))
    assert np.array_equal(again.mass_matrix([0.1, 0.2]), dyn.mass_matrix([0.1, 0.2]))
    run = mb.simulate(dyn, [0.1, 0.2], [0.0, 0.0], 0.01, dt=1e-3)
    other = mb.simulate(mb.dynamics(model, "lagrangian"), [0.1, 0.2], [0.0, 0.0], 0.01, dt=1e-3)
    assert run.q[-1] == pytest.approx(other.q[-1], abs=1e-12)


def test_what_a_library_prints_is_no_answer():
    dyn = mb.dynamics(mb.catalog.pendulum(), present("mujoco", "4.0.0", before='echo "hello"; echo "[1]" >&2'))
    assert dyn.mass_matrix([0.0]).shape == (1, 1)


def test_a_kinetic_energy_that_old_bindings_mistake_is_announced(monkeypatch):
    dyn = mb.dynamics(mb.catalog.pendulum(), present("mujoco", "3.1.0"))
    monkeypatch.setattr(dyn, "_kinetic_energy", lambda q, _: dyn._potential_energy(q))
    with pytest.warns(KnownDefectWarning, match="entry of the potential energy is read.*; half"):
        dyn.kinetic_energy([0.3], [0.2])


def test_a_process_that_dies_is_an_error_and_the_next_call_starts_another(monkeypatch):
    version = present("mujoco", "4.0.0")
    dyn = mb.dynamics(mb.catalog.pendulum(), version)
    before = dyn.mass_matrix([0.3])
    own = process.process_of(version)
    folder = own._folder
    pid, send = own._process.pid, own._send

    def sent(message):
        send(message)
        # Nothing in the process can catch it, such as a thread that prints where it is while another answers.
        os.kill(pid, signal.SIGKILL)

    # As a library may do it: in the middle of a call.
    os.kill(pid, signal.SIGSTOP)
    with monkeypatch.context() as m:
        m.setattr(own, "_send", sent)
        with pytest.raises(EngineProcessError, match="SIGKILL"):
            dyn.mass_matrix([0.3])
    assert not folder.exists()
    assert np.array_equal(dyn.mass_matrix([0.3]), before)


def test_a_process_that_hangs_is_ended_in_time():
    version = present("mujoco", "4.0.0")
    dyn = mb.dynamics(mb.catalog.pendulum(), mb.engine(version.name, seconds=0.5))
    os.kill(process.process_of(version)._process.pid, signal.SIGSTOP)
    with pytest.raises(EngineProcessError, match=r"ended after 0\.5 s"):
        dyn.gravity([0.3])
    assert dyn.gravity([0.0]) == pytest.approx([0.0], abs=1e-15)


def test_a_process_that_does_not_start_says_its_last_words():
    version = present("mujoco", "4.0.0", before='echo "libGL is missing" >&2; exit 3')
    with pytest.raises(EngineProcessError, match=r"status 3 \(libGL is missing\)"):
        mb.dynamics(mb.catalog.pendulum(), version)


def test_a_process_ends_with_its_parent_and_leaves_nothing():
    version = present("mujoco", "4.0.0")
    script_ = (
        "import os, mbkit as mb\n"
        "from mbkit.engines.remote import process\n"
        f"version = mb.engine({version.name!r})\n"
        "dyn = mb.dynamics(mb.catalog.pendulum(), version)\n"
        "own = process.process_of(version)\n"
        "print(own._process.pid, own._folder, flush=True)\n"
        "os._exit(0)\n"
    )
    done = subprocess.run([sys.executable, "-c", script_], capture_output=True, text=True, check=True)
    pid, folder = done.stdout.split()
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and (Path(folder).exists() or Path(f"/proc/{pid}").exists()):
        time.sleep(0.05)
    assert not Path(folder).exists()
    assert not Path(f"/proc/{pid}").exists()


@pytest.mark.parametrize("name", ["mujoco", "mujoco==", "mujoco==3.1 --pre", "mujoco==../x", "mujoco==3.x", 3, None])
def test_what_is_no_version_is_refused(name):
    with pytest.raises(InputError, match="expected an engine and its version"):
        mb.engine(name)


def test_an_engine_without_versions_is_refused():
    with pytest.raises(UnknownNameError, match="pinocchio"):
        mb.engine("pinochio==2.7.0")
    with pytest.raises(InputError, match="seconds"):
        mb.engine("mujoco==3.1.0", seconds=0)


# Environments, by an installer of the tests' own.

INSTALLER = """
if [ "$1" = venv ]; then
  for last; do :; done
  mkdir -p "$last/bin"
  printf '#!/bin/sh\\nexec "{python}" "$@"\\n' > "$last/bin/python"
  chmod +x "$last/bin/python"
  exit 0
fi
echo "$@" >> "{log}"
{install}
"""


@pytest.fixture
def installer(tmp_path, monkeypatch):
    """Put a ``uv`` of one's own before the path; return the function that says what it does, and its log."""
    log = tmp_path / "log"
    log.touch()
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")

    def does(install: str, python: Path | str = sys.executable) -> Path:
        script(tmp_path / "bin" / "uv", INSTALLER.format(python=python, log=log, install=install))
        return log

    return does


def test_an_environment_is_made_once_and_whole(installer, environments):
    log, lines = installer("exit 0"), []
    place = environment.place("mujoco", "9.9")
    # What a process left that was ended while it built.
    script(place.with_name(f".{place.name}.part") / "bin" / "python", "exit 1")
    for _ in range(2):
        python = environment.interpreter("mujoco", "9.9", "mujoco", lines.append)
    assert python.is_file()
    assert len(log.read_text().splitlines()) == 1
    assert "mujoco==9.9 numpy" in log.read_text()
    assert len(lines) == 2
    assert "making an environment of mujoco 9.9" in lines[0]
    assert [p.name for p in environments.iterdir() if p.is_dir()] == [place.name]
    assert mb.engine("mujoco==9.9").installed


def test_two_at_once_build_one(installer):
    log = installer("sleep 0.5; exit 0")
    made = []
    threads = [
        threading.Thread(target=lambda: made.append(environment.interpreter("mujoco", "9.9", "mujoco", len)))
        for _ in range(3)
    ]
    for step in (threading.Thread.start, threading.Thread.join):
        for thread in threads:
            step(thread)
    assert len(made) == 3
    assert len(log.read_text().splitlines()) == 1


def test_what_is_compiled_for_an_older_numpy_gets_it(installer):
    log = installer('case "$*" in *"numpy<2"*) exit 0;; esac; exit 0')
    with pytest.raises(UnsupportedError, match="no_such_module cannot be imported: ModuleNotFoundError"):
        environment.interpreter("mujoco", "9.9", "no_such_module", len)
    assert [line.split()[-1] for line in log.read_text().splitlines()] == ["numpy", "numpy<2"]


def test_a_dependency_that_is_too_new_is_bounded(installer, tmp_path):
    """The wanted library is there in another version: the package that brought it is taken a version older."""
    library = 'raise ImportError("libmine.so.4: cannot open shared object file: No such file or directory")'
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "needs_mine.py").write_text(library)
    log = installer(
        'for last; do :; done; root="$(dirname "$(dirname "$5")")"; info="$root/lib/mine-2.0.dist-info"\n'
        'mkdir -p "$info"; echo "mine.prefix/lib/libmine.so.5,sha,1" > "$info/RECORD"\n'
        'printf "Name: mine\\nVersion: 2.0\\n" > "$info/METADATA"\n'
        f'if [ "$last" = "mine<2.0" ]; then echo "" > {tmp_path}/broken/needs_mine.py; fi',
        script(tmp_path / "bin" / "mine", f'cd {tmp_path}/broken; exec "{sys.executable}" "$@"'),
    )
    environment.interpreter("mujoco", "9.9", "needs_mine", len)
    assert [line.split()[-1] for line in log.read_text().splitlines()] == ["numpy", "mine<2.0"]


def test_an_unknown_version_is_answered_with_those_that_there_are(installer):
    installer('echo "ERROR: Could not find a version of mujoco==9.9 (from versions: 3.1.0, 4.0.0)" >&2; exit 1')
    with pytest.raises(UnknownNameError, match=r"version of mujoco '9\.9'.*4\.0\.0, 3\.1\.0"):
        mb.dynamics(mb.catalog.pendulum(), mb.engine("mujoco==9.9"))


def test_where_uv_does_not_say_which_versions_there_are_pip_is_asked(installer, monkeypatch):
    said = "No solution found\n  cause: Because there is no version\n  of mujoco==9.9, it cannot be installed"
    installer(f'echo "error: {said}" >&2; exit 1')
    monkeypatch.setattr(environment, "available", lambda _: ("3.1.0", "4.0.0"))
    with pytest.raises(UnknownNameError, match=r"version of mujoco '9\.9'.*4\.0\.0, 3\.1\.0"):
        mb.dynamics(mb.catalog.pendulum(), mb.engine("mujoco==9.9"))

    def unknown(_):
        raise UnsupportedError("no connection")

    monkeypatch.setattr(environment, "available", unknown)
    with pytest.raises(UnsupportedError, match=r"no environment.*there is no version"):
        mb.dynamics(mb.catalog.pendulum(), mb.engine("mujoco==9.9"))


def test_without_a_network_the_reason_is_that_of_the_installer(installer, environments):
    installer(
        'echo "WARNING: Retrying: Failed to establish a new connection: Name or service not known" >&2\n'
        'echo "ERROR: Could not find a version that satisfies mujoco==9.9 (from versions: none)" >&2; exit 1'
    )
    with pytest.raises(UnsupportedError, match=r"mujoco 9\.9: no environment.*Failed to establish a new connection"):
        mb.dynamics(mb.catalog.pendulum(), mb.engine("mujoco==9.9"))
    assert [p for p in environments.iterdir() if p.is_dir()] == []


def test_the_files_of_the_other_side_stand_alone():
    """They run on another NumPy and beside no mbkit, and no number of a version is in them."""
    for path in Path(serve.__file__).parent.glob("*.py"):
        tree = ast.parse(path.read_text("utf-8"))
        names = {a.name for node in ast.walk(tree) if isinstance(node, ast.Import) for a in node.names}
        names |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        assert not [name for name in names if name.startswith("mbkit")], path.name
        compared = [x for node in ast.walk(tree) if isinstance(node, ast.Compare) for x in ast.walk(node)]
        assert not [x for x in compared if isinstance(x, ast.Name) and "version" in x.id.lower()], path.name


def test_messages_hold_arrays_of_any_shape_and_no_pickles():
    arrays = [np.float64(3.0), np.zeros((0, 3)), np.arange(12.0).reshape(3, 4).T]
    data = serve.packed({"call": "x"}, arrays)
    head, back = serve.unpacked(data)
    assert head == {"call": "x"}
    assert all(np.array_equal(a, b) and np.shape(a) == b.shape for a, b in zip(arrays, back, strict=True))
    with pytest.raises(TypeError):
        serve.packed({}, [np.array([object()])])


@pytest.mark.thorough
def test_a_real_old_version(monkeypatch, tmp_path_factory):
    """The smallest download: MuJoCo 3.1.6, which has no MjSpec and another mj_fullM."""
    kept = os.environ.get("MBKIT_TEST_ENVIRONMENTS", str(tmp_path_factory.mktemp("environments")))
    monkeypatch.setenv("MBKIT_ENVIRONMENTS", kept)
    version = mb.engine("mujoco==3.1.6")
    try:
        version.interpreter()
    except (UnsupportedError, UnknownNameError) as error:
        pytest.skip(f"no environment can be made here: {error}")
    model = mb.load("ur5", floating_base=True)
    dyn, oracle = mb.dynamics(model, version), mb.dynamics(model, "oracle")
    q, v = model.random_state(0)
    for value, truth in ((dyn.mass_matrix(q), oracle.mass_matrix(q)), (dyn.nle(q, v), oracle.nle(q, v))):
        assert np.abs(value - truth).max() < 1e-12 * np.abs(truth).max()
    assert "4.0.0" in environment.available("mujoco")


@pytest.mark.thorough
def test_versions_are_parameters_of_tests(tmp_path):
    present("mujoco", "4.0.0")
    (tmp_path / "test_mine.py").write_text(
        "import mbkit as mb, pytest\n\n"
        '@pytest.mark.mbkit(robots=["pendulum"], engines=["mujoco==4.0.0", "mujoco==9.9", "mujoco"])\n'
        "def test_mass(mbkit_dynamics):\n"
        '    truth = mb.dynamics(mbkit_dynamics.model, "oracle").mass_matrix([0.3])\n'
        "    assert abs(mbkit_dynamics.mass_matrix([0.3]) - truth).max() < 1e-12\n"
    )
    # An installer that has no network.
    script(tmp_path / "bin" / "uv", 'echo "ERROR: no connection" >&2; exit 1')
    env = os.environ | {"PATH": f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    env["PYTHONPATH"] = os.pathsep.join([str(Path(mb.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    plugin = [] if "mbkit" in {p.name for p in entry_points(group="pytest11")} else ["-p", "mbkit.pytest_plugin"]
    command = [sys.executable, "-m", "pytest", *plugin, "-p", "no:cacheprovider", "-p", "no:xdist", "-rs", "-v"]
    done = subprocess.run([*command, "test_mine.py"], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 passed, 1 skipped" in done.stdout
    assert "test_mass[pendulum-mujoco==4.0.0] PASSED" in done.stdout
    assert "no connection" in done.stdout


def test_studies_take_the_engines_that_dynamics_takes():
    """The names alone: an environment is made at the first evaluation."""
    assert engine_names(["pinocchio", mb.engine("mujoco==3.3.7")]) == ("pinocchio", "mujoco==3.3.7")
    assert engine_names(("drake==1.40.0",)) == ("drake==1.40.0",)
    for bad, words in (
        ("mujoco==x", "expected an engine and its version"),
        ("mujocco==3.3.7", "did you mean 'mujoco'"),
    ):
        with pytest.raises(MbkitError, match=words):
            engine_names([bad])
    assert find_engine("mujoco==3.3.7").load() is VersionDynamics


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


def altered(version: str, alter: str = "") -> str:
    """Make a version of MuJoCo that is the installed one but for what is altered."""
    place = environment.place("mujoco", version)
    program = place / "serve.py"
    script(environment.python_of(place), f'shift 2; exec "{sys.executable}" "{program}" "$@"')
    program.write_text(SERVE.format(folder=str(Path(serve.__file__).parent), alter=alter), encoding="utf-8")
    return version


def test_versions_side_by_side_show_which_changed_a_number_and_where_to(tmp_path, monkeypatch):
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="arm"><link name="base"/><link name="upper"><inertial><origin xyz="0.1 0.2 0.3" '
        'rpy="0.3 0.2 0.1"/><mass value="2"/><inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0" ixz="0" iyz="0"/>'
        '</inertial></link><joint name="j" type="continuous"><parent link="base"/><child link="upper"/>'
        '<axis xyz="0 1 0"/></joint></robot>'
    )
    unturned = (
        "import mujoco\nold = mujoco.MjModel.from_xml_string\n"
        'mujoco.MjModel.from_xml_string = lambda text: old(text.replace("0.3 0.2 0.1", "0 0 0"))'
    )
    alterations = {
        "1.0": "",
        "1.1": "old = E.gravity; E.gravity = lambda self, q: 1.001 * old(self, q)",
        "1.2": unturned,
        "1.3": "E.nle = lambda *x: os.abort()",
        "1.4": 'old = E.rollout; E.rollout = lambda self, q, v, method, **x: old(self, q, v, method="euler", **x)',
        "1.5": "",
    }
    monkeypatch.setitem(versions.VERSIONS, "mujoco", tuple(altered(*x) for x in alterations.items()))
    found = versions.study("mujoco", [str(path)])
    assert found["measured"] == list(alterations)
    moves = {(c["version"], t, c["direction"].split()[0]) for c in found["changes"] for t in c["terms"]}
    assert {
        *(("1.1", "g", "away"), ("1.2", "g", "towards"), ("1.2", "file M", "away"), ("1.3", "file M", "towards")),
        *(("1.3", "nle", "refused"), ("1.4", "nle", "given"), ("1.4", "own RK4", "away")),
    } <= moves
    assert not [x for x in moves if x[1] == "M"]
    assert any("SIGABRT" in x["reason"] for x in found["reasons"])
    assert not found["wrong"]
    assert found["robots"][str(path)]["digits"] > 13


def test_a_version_of_an_engine_is_explained_on_another_description():
    """What is put into one description, or left of a robot, is asked of the same version."""
    model = mb.catalog.double_pendulum()
    heavy = mb.catalog.double_pendulum(mass2=1.5)
    other = mb.dynamics(heavy, present("mujoco", "4.0.0"))
    found = mb.explain(mb.dynamics(model), other)
    assert [c.kind for c in found.causes] == ["mass"]
    assert found.explained
