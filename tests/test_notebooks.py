"""Every notebook runs from top to bottom, and its stored outputs are those of today, in substance.

After a wanted change ``python -m tests.test_notebooks [NAME ...]`` runs notebooks and stores their outputs.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import unescape
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbformat import NotebookNode

FOLDER = Path(__file__).parent.parent / "notebooks" / "examples"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 300_000
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?!\w)")
#: Below this a number is rounding, which no two processors share.
ROUNDING = 1e-10
Run = Callable[[NotebookNode], None]


@contextmanager
def kernel() -> Iterator[Run]:
    """Give a function that runs a notebook; one kernel, which imports once, has a name space and a folder for each."""
    client = NotebookClient(nbformat.v4.new_notebook(), timeout=120, kernel_name="python3")

    def run(notebook: NotebookNode) -> None:
        with tempfile.TemporaryDirectory() as folder:
            anew = nbformat.v4.new_code_cell(f"%reset_selective -f ^[^_]\n%cd -q {folder}")
            # The folder cannot be removed everywhere while it is the kernel's.
            left = nbformat.v4.new_code_cell("%cd -q ~")
            for cells in ([anew], notebook.cells, [left]):
                client.nb = nbformat.v4.new_notebook(cells=cells)
                client.reset_execution_trackers()
                for index, cell in enumerate(cells):
                    client.execute_cell(cell, index)

    with client.setup_kernel():
        yield run


@pytest.fixture(scope="module")
def run() -> Iterator[Run]:
    with kernel() as run:
        yield run


def shown(cell: NotebookNode) -> list[tuple[tuple[str, ...], str]]:
    """Return what a cell shows: the kinds of each output, and its text. Streams are one output, however they came."""
    streams: dict[str, str] = {}
    out = []
    for output in cell.get("outputs", []):
        if output.output_type == "stream":
            streams[output.name] = streams.get(output.name, "") + output.text
            continue
        data = output.get("data", {})
        text = ""
        # A figure's text is its size; of a page with a style the words count.
        if not any(kind.startswith("image/") for kind in data):
            plain = re.sub(r"<style.*?</style>|<[^>]+>", " ", data.get("text/html", ""), flags=re.DOTALL)
            text = unescape(plain) or data.get("text/plain", "")
        out.append(((output.output_type, *sorted(data)), text))
    return [*(((name,), text) for name, text in sorted(streams.items())), *out]


def last_digit(number: str) -> float:
    """Return a little more than what the last digit of a printed number is worth, and 0 for a count."""
    digits, _, power = number.lower().partition("e")
    return 1.01 * 10.0 ** (int(power or 0) - len(digits.partition(".")[2])) if "." in digits or power else 0.0


def same(ours: str, theirs: str) -> bool:
    """Return whether two texts are equal, numbers to three digits, and counts of right digits to one."""
    if [w.split() for w in NUMBER.split(ours)] != [w.split() for w in NUMBER.split(theirs)]:
        return False
    after = [text[:7] for text in NUMBER.split(ours)[1:]]
    for a, b, unit in zip(NUMBER.findall(ours), NUMBER.findall(theirs), after, strict=True):
        x, y = float(a), float(b)
        limit = 1.0 if unit == " digits" else max(5e-3 * max(abs(x), abs(y)), last_digit(a), ROUNDING)
        if not abs(x - y) <= limit:
            return False
    return True


@pytest.mark.thorough
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs_and_its_outputs_are_current(path: Path, run: Run) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    stored = [shown(cell) for cell in notebook.cells]
    run(notebook)
    for index, (before, cell) in enumerate(zip(stored, notebook.cells, strict=True)):
        now = shown(cell)
        place = f"{path.stem}, cell {index}; after a wanted change: python -m tests.test_notebooks {path.stem}"
        assert [kinds for kinds, _ in now] == [kinds for kinds, _ in before], place
        for (_, ours), (_, theirs) in zip(now, before, strict=True):
            assert same(ours, theirs), f"{place}\n{ours}\nstored:\n{theirs}"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_asks_shows_and_answers(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", [])]
    assert "**Question.**" in notebook.cells[0].source
    assert notebook.cells[-1].source.startswith("## Answer")
    assert any(kind.startswith("image/") for o in outputs for kind in o.get("data", {}))
    assert not any(o.output_type == "error" or o.get("name") == "stderr" for o in outputs)
    assert path.stat().st_size < LARGEST


def test_texts_are_compared_in_substance() -> None:
    assert same("off by 3.1e-16 at 12.001 s", "off by  8e-17 at 12.0 s")
    assert same("agree to 13.6 digits", "agree to 14.1 digits")
    assert not same("agree to 13.6 digits", "agree to 15.1 digits")
    assert same("12.1 s", "12.2 s")
    assert same("1.7e-07 rad", "1.8e-07 rad")
    assert not same("12.1 s", "12.3 s")
    assert not same("97 steps", "98 steps")
    assert not same("12.1 s", "12.1 m")
    assert not same("12.1 s", "12.1 s 3")
    assert not same("nan", "1.0")


def store(names: list[str]) -> None:
    """Run notebooks and write them with their outputs."""
    with kernel() as run:
        for path in (path for path in NOTEBOOKS if not names or path.stem in names):
            notebook = nbformat.read(path, as_version=4)
            run(notebook)
            for cell in notebook.cells:
                cell.metadata.pop("execution", None)
            nbformat.write(notebook, path)
            print(f"{path.stem}: {path.stat().st_size // 1000} kB")


if __name__ == "__main__":
    store(sys.argv[1:])
