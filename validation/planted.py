"""Defects planted one by one into a copy: each has to be caught by the tests that are named for it.

Run ``python -m validation.planted [WORD ...]``, some fifteen minutes for all on two cores; with words only the
defects whose file or text has one of them, and then nothing is written. Each entry of ``planted.toml`` replaces one
text, which stands once in its file, and runs its tests, without the thorough cases, up to the first that fails.
``validation/planted.json`` gets the table: defect, caught by, seconds. Exit status 1 if a defect was not caught.

Whoever makes the suite smaller or quicker runs it before and after: nothing that was caught may get away.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from validation.stamp import results, stamp

TOP = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_suffix(".toml")
#: Copies side by side, and seconds that the tests of one defect may take.
WORKERS, LIMIT = 2, 300
#: Of the defects of the list, these alone.
SOME = slice(None)
PASSED, FAILED = 0, 1


@dataclass(frozen=True)
class Defect:
    """A text of a file in the package, what stands in its place, and the tests that have to notice."""

    file: str
    text: str
    wrong: str
    tests: tuple[str, ...]

    @property
    def path(self) -> str:
        """The file, below the project's root."""
        return f"mbkit/{self.file}"


def defects() -> list[Defect]:
    """Read the list."""
    with LIST.open("rb") as file:
        return [Defect(d["file"], d["text"], d["wrong"], tuple(d["tests"])) for d in tomllib.load(file)["defect"]]


def copied(folder: Path) -> Path:
    """Copy what a test needs, as it is now; a checkout may be an archive, without git.

    Bytecode goes with it, so that no defect has all of it compiled again; that of the file with the defect is older.
    """
    for name in ("mbkit", "tests", "validation", "notebooks"):
        shutil.copytree(TOP / name, folder / name, ignore=shutil.ignore_patterns(".ipynb_checkpoints"))
    for file in (*TOP.glob("*.toml"), *TOP.glob("*.md")):
        shutil.copy(file, folder)
    return folder


def planted(defect: Defect, copy: Path, tests: Sequence[str] = ()) -> tuple[str, float]:
    """Return the first test that fails with a defect, empty if none does, and the seconds that took.

    The tests are the defect's own files, or those that are given.
    """
    path = copy / defect.path
    sound = path.read_text(encoding="utf-8")
    if sound.count(defect.text) != 1:
        raise ValueError(f"{defect.path}: expected {defect.text!r} once, found it {sound.count(defect.text)} times")
    path.write_text(sound.replace(defect.text, defect.wrong), encoding="utf-8")
    tests = tests or [f"tests/{name}.py" for name in defect.tests]
    options = ["-x", "-q", "-n0", "-p", "no:cacheprovider"]
    begun = time.perf_counter()
    try:
        run = subprocess.run(
            [sys.executable, "-m", "pytest", *options, *tests],
            cwd=copy,
            env={**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            text=True,
            timeout=LIMIT,
        )
        code, out = run.returncode, run.stdout
    except subprocess.TimeoutExpired:
        return f"no end after {LIMIT} s", time.perf_counter() - begun
    finally:
        path.write_text(sound, encoding="utf-8")
    seconds = time.perf_counter() - begun
    if code == PASSED:
        return "", seconds
    found = re.search(r"^(?:FAILED|ERROR) (\S+)", out, re.MULTILINE)
    return found[1] if found else "the tests cannot be collected", seconds


#: See `validation.smoke`.
SMOKE = {"WORKERS": 1, "SOME": slice(3, 4)}


def main() -> int:
    """Plant the defects, print and write the table."""
    words = sys.argv[1:]
    chosen = [d for d in defects()[SOME] if not words or any(w in d.file or w in d.text for w in words)]
    rows: dict[int, tuple[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder, Progress(console=Console(stderr=True)) as bar:
        task, copies = bar.add_task("planting", total=len(chosen)), Queue[Path]()
        for i in range(WORKERS):
            copies.put(copied(Path(folder) / str(i)))

        def one(k: int) -> None:
            copy = copies.get()
            try:
                rows[k] = planted(chosen[k], copy)
            finally:
                copies.put(copy)
                bar.advance(task)

        with ThreadPoolExecutor(WORKERS) as pool:
            list(pool.map(one, range(len(chosen))))
    table = Table("file", "wrong", "caught by", "seconds")
    for k, (caught, seconds) in sorted(rows.items()):
        table.add_row(chosen[k].file, chosen[k].wrong.strip()[:60], caught or "[bold red]nothing", f"{seconds:.0f}")
    Console(width=160).print(table)
    lost = [chosen[k] for k, (caught, _) in rows.items() if not caught]
    print(f"{len(chosen) - len(lost)} of {len(chosen)} defects were caught")
    if not words:
        parts = [
            {"file": d.path, "text": d.text, "wrong": d.wrong, "caught_by": rows[k][0], "seconds": round(rows[k][1], 1)}
            for k, d in enumerate(chosen)
        ]
        results("planted.json").write_text(
            json.dumps({**stamp(__file__), "defects": parts}, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
        )
    return int(bool(lost))


if __name__ == "__main__":
    sys.exit(main())
