"""Machine code on disk: found again, never trusted when it is not what was written."""

from __future__ import annotations

import os
import stat
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import mbkit as mb
from mbkit.codegen import compiled as module
from mbkit.codegen import disk_cache, python_call, step_loop
from mbkit.codegen.backend import LastUsed
from mbkit.derivation import fingerprint as sources
from mbkit.derivation.equations import Equations
from mbkit.engines.oracle import OracleDynamics
from tests.random_trees import random_tree, states


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache of this test's own, and a process that holds no functions but the one that Python calls."""
    python_call._definition()
    monkeypatch.setenv("MBKIT_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "_HELD", {})
    module._batch_object.cache_clear()
    yield tmp_path / "cache"
    module._batch_object.cache_clear()


MODEL = mb.catalog.double_pendulum()


def evaluated(*, derives: bool) -> np.ndarray:
    """Return inverse dynamics from a new engine, and see whether it derived anything."""
    module._HELD.clear()
    module._batch_object.cache_clear()
    dyn = mb.dynamics(MODEL, "lagrangian", compile=True)
    q, v, a, _ = states(MODEL, 4)
    out = dyn.inverse_dynamics(q, v, a)
    assert ("equations" in dyn.__dict__) == derives
    return out


def test_a_second_process_finds_what_the_first_compiled(folder):
    first = evaluated(derives=True)
    np.testing.assert_array_equal(evaluated(derives=False), first)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert all(stat.S_IMODE(p.stat().st_mode) == 0o600 for p in folder.iterdir())
    assert len(list(folder.iterdir())) == 2  # the function, and the loop that all share


def spoil_all(folder, change) -> None:
    for path in folder.iterdir():
        path.write_bytes(change(path.read_bytes()))


@pytest.mark.thorough("one more", "one short", "other version", "noise")
@pytest.mark.parametrize(
    "change",
    [
        lambda _: b"",
        lambda b: b[:50],
        lambda b: b[:-1],
        lambda b: b + b"\0",
        lambda b: b[:-20] + bytes([b[-20] ^ 1]) + b[-19:],
        lambda b: b"\xff" * len(b),
        lambda b: b.replace(b"machine code 1", b"machine code 0"),
    ],
    ids=["empty", "cut", "one short", "one more", "one bit", "noise", "other version"],
)
def test_a_spoiled_entry_is_made_again(folder, change):
    first = evaluated(derives=True)
    spoil_all(folder, change)
    np.testing.assert_array_equal(evaluated(derives=True), first)
    np.testing.assert_array_equal(evaluated(derives=False), first)


def test_an_entry_under_another_name_is_not_trusted(folder):
    first = evaluated(derives=True)
    a, b = sorted(folder.iterdir())
    content = a.read_bytes(), b.read_bytes()
    a.write_bytes(content[1])
    b.write_bytes(content[0])
    np.testing.assert_array_equal(evaluated(derives=True), first)


def test_whole_entries_of_another_form_are_made_again(folder):
    first = evaluated(derives=True)
    for path in folder.iterdir():
        found = disk_cache.read(path.name)
        assert found is not None
        if "inputs" in found[0]:
            disk_cache.write(path.name, {"inputs": "?"}, found[1])
    np.testing.assert_array_equal(evaluated(derives=True), first)


def test_a_link_and_another_users_file_are_not_followed(folder):
    evaluated(derives=True)
    for path in list(folder.iterdir()):
        moved = folder.parent / path.name
        path.rename(moved)
        path.symlink_to(moved)
    evaluated(derives=True)
    if os.getuid() == 0:
        for path in folder.iterdir():
            os.chown(path, 65534, 65534)
        evaluated(derives=True)
        os.chown(folder, 65534, 65534)
        assert disk_cache.folder() is None


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_in_the_place_of_an_entry_is_replaced_and_not_waited_for(folder):
    first = evaluated(derives=True)
    names = sorted(path.name for path in folder.iterdir())
    for name in names:
        (folder / name).unlink()
        os.mkfifo(folder / name, 0o600)
    with ThreadPoolExecutor(1) as pool:
        reading = pool.submit(evaluated, derives=True)
        try:
            np.testing.assert_array_equal(reading.result(60), first)
        finally:
            # A reader that waits gets the end of the file.
            for name in names:
                with suppress(OSError):
                    os.close(os.open(folder / name, os.O_WRONLY | os.O_NONBLOCK))
    assert sorted(path.name for path in folder.iterdir() if path.is_file()) == names


def test_a_folder_that_others_may_enter_is_closed(folder):
    folder.mkdir()
    folder.chmod(0o755)
    evaluated(derives=True)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_no_cache_where_none_can_be(folder, monkeypatch):
    for place in ("", str(folder / "file" / "below")):
        monkeypatch.setenv("MBKIT_CACHE_DIR", place)
        if place:
            folder.mkdir()
            (folder / "file").write_text("in the way")
        evaluated(derives=True)
        evaluated(derives=True)


@pytest.mark.usefixtures("folder")
def test_a_changed_number_is_another_entry():
    evaluated(derives=True)
    other = mb.dynamics(mb.catalog.double_pendulum(mass1=1.5), "lagrangian", compile=True)
    other.inverse_dynamics(*states(MODEL, 1)[:3])
    assert "equations" in other.__dict__


def test_the_oldest_entries_go_when_the_folder_is_full(folder, monkeypatch):
    monkeypatch.setattr(disk_cache, "_MAX_CACHE_BYTES", 3000)
    for k in range(6):
        disk_cache.write(f"{k:064x}", {"k": k}, b"x" * 900)
        os.utime(folder / f"{k:064x}", (k, k))
    assert disk_cache.read(f"{0:064x}") is None
    assert disk_cache.read(f"{5:064x}") == ({"k": 5, "key": f"{5:064x}"}, b"x" * 900)
    assert sum(p.stat().st_size for p in folder.iterdir()) <= 3000


def test_many_writers_of_one_entry_leave_a_whole_one(folder):
    def write(k: int) -> None:
        disk_cache.write("a" * 64, {"k": k}, bytes([k]) * 200_000)
        found = disk_cache.read("a" * 64)
        assert found is not None
        assert found[1] == bytes([found[0]["k"]]) * 200_000

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(64)))
    assert [p.name for p in folder.iterdir()] == ["a" * 64]


@pytest.mark.usefixtures("folder")
def test_the_fingerprint_holds_all_code_that_decides_what_is_compiled(monkeypatch):
    """Whatever runs between the request for machine code and LLVM counts, wherever it stands."""
    root = Path(mb.__file__).parent
    ran = set()

    def note(frame, event, _argument):
        if event == "call":
            ran.add(Path(frame.f_code.co_filename))

    def traced(make):
        def made(*arguments):
            sys.setprofile(note)
            try:
                return make(*arguments)
            finally:
                sys.setprofile(None)

        return made

    for where in (module, step_loop):
        monkeypatch.setattr(where, "_compile", traced(where._compile))
    tree = random_tree(1, 2, ("ball", "helical"))
    q, v, _, tau = (x[0] for x in states(tree, 1))
    mb.dynamics(tree, "lagrangian", compile=True).forward_dynamics(q, v, tau)
    paper = mb.lagrangian.systems.get("pendulum")().dynamics(options={"compile": True})
    for method, options in (("rk4", {"dt": 0.01}), ("rk853", {})):
        q = np.full((2, 1), 0.3)
        mb.simulate(paper, q, np.zeros((2, 1)), 0.02, method=method, save=[0.0, 0.02], **options)
    ran = {path for path in ran if path.is_relative_to(root)}
    assert {path.relative_to(root).parts[0] for path in ran} >= {"derivation", "codegen", "model", "lagrangian"}
    assert ran <= set(sources.source_files())


def test_the_fingerprint_changes_with_every_listed_file(tmp_path):
    (tmp_path / "pack" / "inner").mkdir(parents=True)
    files = [tmp_path / "pack" / "a.py", tmp_path / "pack" / "inner" / "b.py", tmp_path / "alone.py"]
    for path in files:
        path.write_text("x = 1")
    found = {sources.fingerprint(tmp_path, ("pack", "alone.py"))}
    for path in files:
        path.write_text("x = 2")
        found.add(sources.fingerprint(tmp_path, ("pack", "alone.py")))
    files[1].rename(tmp_path / "pack" / "b.py")
    found.add(sources.fingerprint(tmp_path, ("pack", "alone.py")))
    assert len(found) == 5
    for missing in ("gone", "gone.py"):
        with pytest.raises(FileNotFoundError, match=missing):
            sources.fingerprint(tmp_path, ("pack", missing))
    assert sources.fingerprint() == sources.SOURCES


# Derived functions in memory


def test_the_last_used_stay_up_to_a_number_of_operations():
    made: list[str] = []

    def derived(kept: LastUsed[str], name: str) -> str:
        def make() -> str:
            made.append(name)
            return name

        return kept.get((name, "f"), make)

    kept: LastUsed[str] = LastUsed(5, len)
    assert [derived(kept, name) for name in ("aa", "bb", "aa", "cc", "aa", "bb")] == [
        "aa",
        "bb",
        "aa",
        "cc",
        "aa",
        "bb",
    ]
    # Of the three with two operations each only the two that were used last.
    assert made == ["aa", "bb", "cc", "bb"]
    with disk_cache.force_recompile():
        derived(kept, "aa")
        derived(kept, "aa")
    derived(kept, "aa")
    assert made[4:] == ["aa"]
    derived(kept, "too large")
    derived(kept, "too large")
    # Nothing else gives way to what does not fit.
    derived(kept, "aa")
    assert made[5:] == ["too large", "too large"]


def test_a_second_dynamics_of_the_same_description_derives_nothing(monkeypatch):
    model = mb.catalog.double_pendulum(mass1=1.2345)
    again = mb.catalog.double_pendulum(mass1=1.2345)
    q, v, a = np.array([0.3, 0.4]), np.array([0.5, 0.6]), np.array([0.7, 0.8])
    first = [
        (dyn.nle(q, v), dyn.center_of_mass(q), dyn.mass_matrix_inverse(q), dyn.inverse_dynamics(q, v, a))
        for dyn in (mb.dynamics(model, "lagrangian", compile=False), mb.dynamics(model, "oracle"))
    ]

    def refuse(*_):
        raise AssertionError("derived again")

    for owner, name in ((Equations, "function"), (Equations, "body_quantity"), (OracleDynamics, "_function_of")):
        monkeypatch.setattr(owner, name, refuse)
    for values, dyn in zip(
        first, (mb.dynamics(again, "lagrangian", compile=False), mb.dynamics(again, "oracle")), strict=True
    ):
        second = (dyn.nle(q, v), dyn.center_of_mass(q), dyn.mass_matrix_inverse(q), dyn.inverse_dynamics(q, v, a))
        assert all(np.array_equal(x, y) for x, y in zip(values, second, strict=True))
    other = mb.catalog.double_pendulum(mass1=1.2346)
    for engine in ("lagrangian", "oracle"):
        with pytest.raises(AssertionError, match="derived again"):
            mb.dynamics(other, engine).nle(q, v)


def test_a_folder_with_room_is_not_looked_through_at_each_entry(folder, monkeypatch):
    looked = []
    monkeypatch.setattr(disk_cache, "_left", {})
    monkeypatch.setattr(disk_cache.os, "scandir", lambda at, scan=os.scandir: looked.append(at) or scan(at))
    for k in range(20):
        disk_cache.write(f"{k:064x}", {"k": k}, b"x")
    assert looked == [folder]
