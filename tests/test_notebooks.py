"""Every notebook runs from top to bottom."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbformat import NotebookNode

FOLDER = Path(__file__).parent.parent / "notebooks" / "examples"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run cells in one kernel, which imports once, in a name space and a folder of their own."""
    setup = nbformat.v4.new_notebook()
    client = NotebookClient(setup, timeout=120, kernel_name="python3")
    with client.setup_kernel():

        def run(notebook: NotebookNode) -> None:
            anew = nbformat.v4.new_code_cell(f"%reset_selective -f ^[^_]\n%cd -q {tmp_path_factory.mktemp('notebook')}")
            for cells in ([anew], notebook.cells):
                client.nb = nbformat.v4.new_notebook(cells=cells)
                client.reset_execution_trackers()
                for index, cell in enumerate(cells):
                    client.execute_cell(cell, index)

        yield run


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda p: p.stem)
def test_notebook_runs(path, run):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    # Kept without outputs, so that a diff shows what somebody wrote.
    assert not any(cell.get("outputs") for cell in notebook.cells)
    run(notebook)
    shown = [o for cell in notebook.cells for o in cell.get("outputs", [])]
    assert any({"text/html", "text/latex"} & set(o.get("data", {})) for o in shown)
    assert any("image/png" in o.get("data", {}) for o in shown)
