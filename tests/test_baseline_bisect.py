"""Where a failing baseline began: commits in the tests' own repositories, and versions altered on purpose."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path

import pytest
from click.testing import CliRunner

import mbkit as mb
from mbkit._child_process import end_all
from mbkit.cli import cli
from mbkit.engines.versions.engine_version import versions_of
from mbkit.errors import UnsupportedError
from mbkit.studies import results
from mbkit.studies.baseline import BisectResult, bisection, study
from mbkit.studies.baseline.history import Commit, History
from mbkit.studies.versions.result import AWAY, TOWARDS
from tests.scenes import mounted
from tests.test_baseline import ARM
from tests.test_engine_versions import script
from tests.test_versions import made, wrong

GRIPPER = 'mass value="0.4"'
NAMES = ["-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false", "-c", "tag.gpgsign=false"]


@pytest.fixture(autouse=True)
def environments(tmp_path, monkeypatch):
    monkeypatch.setenv("MBKIT_ENVIRONMENTS", str(tmp_path / "environments"))
    end_all()
    yield
    end_all()


def bisected(path: Path) -> BisectResult:
    recorded = mb.baseline.read(path)
    return mb.baseline.bisect(mb.load(path.parent / recorded.target, **recorded.options), path)


class Repository:
    """A repository with a robot's file and its baseline."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.clock = folder, 0
        folder.mkdir()
        self.git("init", "-q", "-b", "main")

    def git(self, *words: str) -> str:
        self.clock += 1
        date = f"2026-01-01T00:00:{self.clock % 60:02d}Z"
        env = {k: x for k, x in os.environ.items() if not k.startswith("GIT_")}
        env |= {"GIT_CONFIG_GLOBAL": os.devnull, "GIT_AUTHOR_DATE": date, "GIT_COMMITTER_DATE": date}
        return subprocess.run(
            ["git", *NAMES, *words], cwd=self.folder, env=env, check=True, capture_output=True, text=True
        ).stdout.strip()

    def write(self, text: str, name: str = "arm.urdf") -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def commit(self, subject: str, text: str, name: str = "arm.urdf") -> str:
        self.write(text, name)
        self.git("add", "-A")
        self.git("commit", "-q", "--allow-empty", "-m", subject)
        return self.git("rev-parse", "HEAD")

    def record(self, name: str = "arm.urdf", **options: object) -> Path:
        path = self.folder / "arm.toml"
        model = mb.load(self.folder / name, **options)
        mb.baseline.record(model, path, ["lagrangian"], target=f"./{name}", options=options)
        return path


@pytest.fixture
def repository(tmp_path) -> Repository:
    return Repository(tmp_path / "robot")


def heavier(mass: float, friction: float = 0.1) -> str:
    return ARM.replace(GRIPPER, f'mass value="{mass}"').replace('damping="0.1"', f'damping="{friction}"')


@pytest.mark.thorough("1-True", "4-False", "5-True")
@pytest.mark.parametrize(("bad", "committed"), [(1, True), (4, False), (5, True), (7, True)])
def test_the_commit_that_changed_a_mass_is_found(repository, committed, bad):
    repository.commit("A comment", ARM + "<!-- before -->")
    repository.write(ARM)
    path = repository.record()
    if not committed:
        repository.write("arm.toml\n", ".gitignore")
    hashes = [repository.commit("Recorded", ARM)]
    for k in range(1, 8):
        text = heavier(0.41) if k >= bad else ARM
        hashes.append(repository.commit(f"Change {k}", f"{text}<!-- {k} -->"))
        repository.commit("Something else", str(k), "notes.txt")
    result = bisected(path)
    (onset,) = result.onsets
    assert (onset.first_bad, onset.subject) == (hashes[bad], f"Change {bad}")
    assert onset.last_good == hashes[bad - 1]
    assert [c.text for c in onset.changes] == ["mass of link gripper: 0.4 → 0.41"]
    assert onset.date.startswith("2026-01-01T")
    assert not result.notes
    assert len(result.examined) <= 7


def test_two_changes_are_found_each_at_its_own_commit_and_one_that_was_undone_is_not(repository):
    path = repository.record(name=repository.commit("First", ARM) and "arm.urdf")
    repository.commit("Recorded", ARM)
    mass = repository.commit("Heavier", heavier(0.41))
    repository.commit("A slip", heavier(0.41, 7.0))
    repository.commit("Heavier still", heavier(0.43))
    damped = repository.commit("Damped", heavier(0.43, 0.2))
    result = bisected(path)
    assert [(o.first_bad, [c.field for c in o.changes]) for o in result.onsets] == [
        (mass, ["mass"]),
        (damped, ["damping"]),
    ]


def test_a_change_that_came_with_a_merge_is_found_inside_of_it(repository):
    repository.commit("First", ARM)
    path = repository.record()
    repository.commit("Recorded", ARM)
    repository.git("checkout", "-q", "-b", "side")
    repository.commit("Only a comment", ARM + "<!-- side -->")
    bad = repository.commit("On the side", heavier(0.41) + "<!-- side -->")
    repository.commit("More of it", heavier(0.41) + "<!-- more -->")
    repository.git("checkout", "-q", "main")
    repository.commit("Elsewhere", "x", "notes.txt")
    repository.git("merge", "-q", "--no-ff", "-m", "Merged", "side")
    merge = repository.git("rev-parse", "HEAD")
    repository.commit("Later", heavier(0.41) + "<!-- later -->")
    (onset,) = bisected(path).onsets
    assert onset.first_bad == bad != merge
    # A merge that changes something by itself.
    repository.git("checkout", "-q", "side")
    repository.commit("Nothing", heavier(0.41) + "<!-- nothing -->")
    repository.git("checkout", "-q", "main")
    repository.git("merge", "-q", "--no-ff", "--no-commit", "-s", "ours", "side")
    evil = repository.commit("Merged badly", heavier(0.41, 0.3))
    assert [o.first_bad for o in bisected(path).onsets] == [bad, evil]


def test_a_branch_that_began_before_a_change_does_not_hide_it(repository):
    repository.commit("First", ARM)
    path = repository.record()
    repository.commit("Recorded", ARM)
    repository.git("checkout", "-q", "-b", "side")
    repository.commit("A comment", ARM + "<!-- side -->")
    repository.git("checkout", "-q", "main")
    bad = repository.commit("Heavier", heavier(0.41))
    repository.git("checkout", "-q", "side")
    repository.commit("Another comment", ARM + "<!-- more -->")
    repository.git("checkout", "-q", "main")
    repository.git("merge", "-q", "--no-ff", "-m", "Merged", "side")
    assert [o.first_bad for o in bisected(path).onsets] == [bad]


def test_rounding_is_not_where_an_edit_began(repository):
    repository.commit("First", ARM)
    path = repository.record()
    repository.commit("Recorded", ARM)
    repository.commit("Rounded", heavier(0.4 + 1e-16))
    bad = repository.commit("Heavier", heavier(0.41))
    repository.commit("A comment", heavier(0.41) + "<!-- x -->")
    assert [o.first_bad for o in bisected(path).onsets] == [bad]


def test_a_hook_of_another_repository_is_no_hindrance(repository, tmp_path, monkeypatch):
    repository.commit("First", ARM)
    path = repository.record()
    repository.commit("Recorded", ARM)
    bad = repository.commit("Heavier", heavier(0.41))
    monkeypatch.setenv("GIT_DIR", str(Repository(tmp_path / "other").folder / ".git"))
    assert [o.first_bad for o in bisected(path).onsets] == [bad]


def test_what_is_not_committed_and_what_is_not_in_the_file_are_told(repository):
    repository.commit("First", ARM)
    path = repository.record()
    last = repository.commit("Recorded", ARM)
    repository.write(heavier(0.41))
    (onset,) = bisected(path).onsets
    assert (onset.first_bad, onset.last_good) == ("", last)
    assert "not committed" in bisected(path).verdict
    repository.write(ARM)
    result = mb.baseline.bisect(mb.load(repository.folder / "arm.urdf").without("damping"), path)
    assert not result.onsets
    assert "changed in Python" in result.notes[0]


def test_a_commit_that_cannot_be_read_is_left_out_by_name(repository):
    repository.commit("First", ARM)
    path = repository.record()
    good = repository.commit("Recorded", ARM)
    broken = repository.commit("Broken", ARM.replace("</robot>", ""))
    bad = repository.commit("Mended", heavier(0.41))
    result = bisected(path)
    (onset,) = result.onsets
    assert (onset.last_good, onset.skipped, onset.first_bad) == (good, (broken,), bad)
    (unread,) = [x for x in result.examined if x.failed is None]
    assert broken.startswith(unread.name)
    assert str(repository.folder.parent) not in unread.outcome.replace(str(repository.folder), "")
    assert "mbkit-" not in unread.outcome


def test_files_that_an_mjcf_includes_and_files_of_loops_are_read_as_they_were(repository):
    main = """<mujoco model="arm"><worldbody><body name="upper"><include file="common/joint.xml"/>
      <inertial pos="0 0 .1" mass="2" diaginertia=".1 .1 .1"/>
      <body name="lower" pos="0 0 .3"><joint name="elbow" axis="0 1 0"/>
      <inertial pos="0 0 .1" mass="1" diaginertia=".1 .1 .1"/></body></body></worldbody></mujoco>"""
    joint = '<mujoco><joint name="shoulder" axis="0 1 0" damping="{}"/></mujoco>'
    repository.write(joint.format(0.1), "common/joint.xml")
    repository.commit("First", main, "arm.xml")
    path = repository.record("arm.xml")
    repository.commit("Recorded", main, "arm.xml")
    repository.commit("A comment", main + "<!-- x -->", "arm.xml")
    bad = repository.commit("Damped", joint.format(0.2), "common/joint.xml")
    repository.commit("A comment", main + "<!-- y -->", "arm.xml")
    (onset,) = bisected(path).onsets
    assert onset.first_bad == bad
    assert [c.field for c in onset.changes] == ["damping"]


def test_files_of_loops_are_read_as_they_were(repository):
    head = '[[loop]]\nname = "rod"\nkind = "distance"\nbody_a = "world"\nbody_b = "lower"\n'
    rod = head + "translation_a = [{}, 0, 0.1]\nlength = 0.35\n"
    loops = repository.write(rod.format(0.2), "loops.toml")
    repository.commit("First", ARM)
    path = repository.folder / "arm.toml"
    model = mb.load(repository.folder / "arm.urdf", loops=loops)
    mb.baseline.record(model, path, ["lagrangian"], target="./arm.urdf", options={"loops": "./loops.toml"})
    repository.commit("Recorded", ARM)
    repository.commit("A comment", ARM + "<!-- x -->")
    bad = repository.commit("Moved", rod.format(0.25), "loops.toml")
    repository.commit("A comment", ARM + "<!-- y -->")
    (onset,) = mb.baseline.bisect(mb.load(repository.folder / "arm.urdf", loops=loops), path).onsets
    assert onset.first_bad == bad
    assert {c.section for c in onset.changes} == {"loops"}


def test_without_a_history_the_reason_is_given(repository, tmp_path, monkeypatch):
    repository.commit("First", heavier(0.41))
    repository.write(ARM)
    path = repository.record()
    repository.commit("Only the baseline fits", heavier(0.41))
    result = bisected(path)
    assert not result.onsets
    assert "none of 1 examined commits of 1 is as recorded" in result.notes[0]
    clone = tmp_path / "clone"
    subprocess.run(["git", "clone", "-q", "--depth", "1", f"file://{repository.folder}", str(clone)], check=True)
    assert "shallow" in " ".join(bisected(clone / "arm.toml").notes)
    outside = tmp_path / "outside"
    outside.mkdir()
    for name in ("arm.toml", "arm.urdf"):
        (outside / name).write_bytes((repository.folder / name).read_bytes())
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path))
    assert "in no git repository" in bisected(outside / "arm.toml").notes[0]
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "git is not installed" in bisected(path).notes[0]


def test_a_tree_cannot_write_outside_of_its_folder(repository, tmp_path, monkeypatch):
    """A tree object may hold any name; git refuses it on checkout alone."""
    repository.commit("First", ARM)
    history = History(repository.folder / "arm.urdf")
    blob = repository.git("hash-object", "-w", "arm.urdf")
    raw = b"100644 ..evil\0" + bytes.fromhex(blob) + b"40000 ..\0" + bytes.fromhex(repository.git("write-tree"))
    (repository.folder / "tree").write_bytes(raw)
    tree = repository.git("hash-object", "-w", "--literally", "-t", "tree", "tree")
    history._parts = []
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with history.files_at(Commit(tree, (), "", "")) as folder:
        assert sorted(p.name for p in folder.rglob("*")) == ["..evil"]
        assert not (folder.parent / "arm.urdf").exists()


# Versions of an engine.


@pytest.fixture
def numbers(tmp_path, monkeypatch):
    """Return a function that records in one version and finds another installed, whose gravity is wrong."""

    def recorded(old: str, new: str, known: list[str], factor: float = 1.001, then: float = 1.0) -> Path:
        monkeypatch.setattr(bisection, "versions_of", lambda _: tuple(known))
        path = tmp_path / "pendulum.toml"
        from mbkit.engines.mujoco.engine import MujocoDynamics

        true = MujocoDynamics._gravity

        def say(version: str, gravity: float) -> None:
            monkeypatch.setattr(results, "versions", lambda: now | {"mujoco": version})
            monkeypatch.setattr(MujocoDynamics, "_gravity", lambda self, q: gravity * true(self, q))

        now = results.versions()
        say(old, then)
        mb.baseline.record(mb.catalog.double_pendulum(), path, ["mujoco"], target="mbkit.catalog:double_pendulum")
        say(new, factor)
        return path

    return recorded


@pytest.mark.thorough("1-True", "4-False")
@pytest.mark.parametrize(("bad", "newer"), [(1, True), (4, False), (9, True)])
def test_the_first_version_that_fails_is_found_in_either_direction(numbers, bad, newer):
    known = [made(f"1.{k}", wrong(1.001) if (k >= bad) == newer else "") for k in range(10)]
    old, new = ("1.0", "1.9") if newer else ("1.9", "1.0")
    path = numbers(old, new, ["0.9", *known, "2.0"])
    result = mb.baseline.bisect(mb.catalog.double_pendulum(), path)
    (onset,) = result.onsets
    assert (onset.engine, onset.kind) == ("mujoco", "version")
    edge = [f"1.{bad - 1}", f"1.{bad}"]
    assert [onset.last_good, onset.first_bad] == (edge if newer else edge[::-1])
    assert onset.direction == AWAY
    assert onset.digits_before > 14
    assert onset.digits == pytest.approx(3.0, abs=0.5)
    assert onset.moved[0].term == "g"
    assert onset.moved[0].error == pytest.approx(1e-3, rel=2)
    assert not result.notes
    assert len(result.examined) <= 6


@pytest.mark.thorough
def test_a_number_that_is_right_since_went_towards_the_truth(numbers):
    known = [made("1.0", wrong(1.01)), made("1.1", wrong(1.01)), made("1.2")]
    path = numbers("1.0", "1.2", known, factor=1.0, then=1.01)
    (onset,) = mb.baseline.bisect(mb.catalog.double_pendulum(), path).onsets
    assert (onset.first_bad, onset.direction) == ("1.2", TOWARDS)


@pytest.mark.thorough
def test_versions_that_do_not_install_or_refuse_are_between(numbers, tmp_path, monkeypatch, capsys):
    script(tmp_path / "bin" / "uv", 'echo "ERROR: no wheel for this system" >&2; exit 1')
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    known = [made("1.0"), "1.1", made("1.2", "del E.gravity"), made("1.3", wrong(1.001)), made("1.4", wrong(1.001))]
    path = numbers("1.0", "1.4", known)
    result = mb.baseline.bisect(mb.catalog.double_pendulum(), path)
    (onset,) = result.onsets
    assert (onset.last_good, onset.skipped, onset.first_bad) == ("1.0", ("1.1", "1.2"), "1.3")
    reasons = {x.name: x.outcome for x in result.examined if x.failed is None}
    assert "no wheel for this system" in reasons["mujoco==1.1"]
    assert "g: " in reasons["mujoco==1.2"]
    said = capsys.readouterr().err
    assert "1 environments are made, some 11 s and 120 MB of disk" in said


@pytest.mark.thorough
def test_what_is_not_the_engines_version_is_not_blamed_on_it(numbers):
    path = numbers("1.0", "1.1", [made("1.0"), made("1.1")])
    model = mb.catalog.double_pendulum()
    result = mb.baseline.bisect(model, path)
    assert not result.onsets
    assert any("as recorded in mujoco==1.1 in an environment of its own" in note for note in result.notes)
    made("1.0", wrong(1.001)), made("1.1", wrong(1.001))
    assert any("not as recorded in mujoco==1.0 either" in note for note in mb.baseline.bisect(model, path).notes)
    path = numbers("1.1", "1.1", ["1.0", "1.1"])
    assert "its version did not do it" in mb.baseline.bisect(model, path).notes[0]


@pytest.mark.thorough
def test_without_pip_the_versions_with_an_environment_are_examined(numbers, monkeypatch):
    for k in range(4):
        made(f"1.{k}", wrong(1.001) if k >= 2 else "")
    path = numbers("1.0", "1.3", [])

    def unknown(_):
        raise UnsupportedError("the versions of mujoco are not known; no connection")

    monkeypatch.setattr(bisection, "versions_of", unknown)
    result = mb.baseline.bisect(mb.catalog.double_pendulum(), path)
    assert [o.first_bad for o in result.onsets] == ["1.2"]
    assert "no connection" in result.notes[0]


def test_the_command_says_where_and_by_its_status(repository, numbers, tmp_path):
    def call(*words: str):
        return CliRunner().invoke(cli, ["baseline", "bisect", *map(str, words)])

    repository.commit("First", ARM)
    path = repository.record()
    repository.commit("Recorded", ARM)
    run = call(path)
    assert run.exit_code == 0, run.output
    assert "nothing to look for" in run.output
    bad = repository.commit("A heavier gripper", heavier(0.41))
    run = call(path)
    assert run.exit_code == 1, run.output
    assert bad[:10] in run.output
    assert "A heavier gripper" in run.output
    run = call(path, "--json")
    (data,) = json.loads(run.stdout)
    assert data["onsets"][0]["first_bad"] == bad
    back = BisectResult.from_json(json.dumps(data))
    assert back.onsets[0].subject == "A heavier gripper"
    assert "A heavier gripper" in back.to_markdown()
    assert len(back.to_csv().splitlines()) == 2
    pendulum = numbers("1.0", "1.1", [made("1.0"), made("1.1", wrong(1.001))])
    assert call(path, pendulum).exit_code == 1
    assert call(tmp_path / "none.toml").exit_code == 2
    assert call(path, pendulum, "--target", "pendulum").exit_code == 2
    (repository.folder / ".git").rename(tmp_path / "gone")
    run = call(path)
    assert run.exit_code == 2
    assert "in no git repository" in " ".join(run.output.split())


def test_a_real_version_is_found(monkeypatch, tmp_path):
    """MuJoCo's own Runge-Kutta steps of quaternions, which are of fourth order since 4.0."""
    kept = os.environ.get("MBKIT_TEST_ENVIRONMENTS")
    if not kept:
        pytest.skip("set MBKIT_TEST_ENVIRONMENTS to a folder for environments")
    monkeypatch.setenv("MBKIT_ENVIRONMENTS", kept)
    b = mounted("top", "rotor", "ball", "ball", mass=1.0, com=(0.0, 0.0, 0.1), inertia=(0.3, 0.4, 0.5))
    model, path, now, old = b.build(), tmp_path / "top.toml", results.versions(), "3.3.7"
    with monkeypatch.context() as m:
        m.setattr(results, "versions", lambda: now | {"mujoco": old})
        m.setattr(study, "dynamics", lambda model, name, **_: mb.dynamics(model, f"{name}=={old}"))
        mb.baseline.record(model, path, ["mujoco"])
    (onset,) = mb.baseline.bisect(model, path).onsets
    assert [r.term for r in onset.moved] == ["rollout"]
    assert onset.direction == TOWARDS
    known = versions_of("mujoco")
    assert known.index(onset.first_bad) == known.index(onset.last_good) + 1
