"""Tables and figures of the book's pages, made from the files of results beside this one."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from IPython.display import SVG, Markdown
from matplotlib.figure import Figure

from validation.stamp import changed

HERE = Path(__file__).parent
#: Parts with ratios of the own derivation's batches, which fill the processor's registers, to code that does not.
SIMD = {"bench_terms", "bench_bodies", "bench_rollouts", "operations", "mechanisms", "identification", "gpu"}
#: Doubles in a register -> what has such ones.
LEVELS = {8: "AVX-512", 4: "AVX2", 2: "SSE2 or NEON"}
#: Packages whose versions matter for what is measured.
NAMED = ("mbkit", "python", "pin", "mujoco", "drake", "casadi", "sympy", "llvmlite", "heyoka", "numpy", "scipy")


def load(name: str) -> Any:
    """Return a file of results, such as ``accuracy``."""
    return json.loads((HERE / f"{name}.json").read_text(encoding="utf-8"))


def origin(data: dict[str, Any], part: str) -> Markdown:
    """Return the line of when, on what, with what versions and code a file was measured, and how to do so again."""
    told = [f"Measured on {data['date']}" if "date" in data else "Measured (the file has no date)"]
    told += [f"processor {data['processor']}"] if "processor" in data else []
    found = data.get("versions", {})
    told += [", ".join(f"{name} {found[name]}" for name in NAMED if name in found and found[name] != "not installed")]
    told += [lanes(data)] if part in SIMD else []
    told += [changed(data)]
    return Markdown(f"*{'; '.join(x for x in told if x)}. Again: `python -m validation {part}`.*")


def lanes(data: dict[str, Any]) -> str:
    """Return how many doubles the registers had that a file was measured with: ratios to scalar code go with it."""
    # The part that measures the limit of the vector units has always had it.
    doubles = data.get("simd", {}).get("doubles", data.get("width"))
    return f"SIMD of {doubles} doubles ({LEVELS[doubles]})" if doubles else "the level of SIMD was not kept"


def command(*words: str, columns: int = 80) -> int:
    """Print what mbkit's command says in a terminal of so many columns, and return its exit status."""
    # A process of its own: in a kernel it writes for notebooks.
    told = subprocess.run(
        [sys.executable, "-m", "mbkit", *words],
        capture_output=True,
        text=True,
        env=os.environ | {"COLUMNS": str(columns)},
    )
    print((told.stdout + told.stderr).strip())
    return told.returncode


def table(head: Sequence[str], rows: Iterable[Sequence[Any]], align: str = "") -> Markdown:
    """Return a table; `align` has ``l`` or ``r`` for each column, and ``r`` for those beyond."""
    marks = ["---" if mark == "l" else "---:" for mark in (align or "l").ljust(len(head), "r")]
    lines = [head, marks, *([str(x).replace("|", "\\|") for x in row] for row in rows)]
    return Markdown("\n".join(f"| {' | '.join(line)} |" for line in lines))


def figure(name: str) -> SVG:
    """Return a stored figure, such as ``terms``."""
    return SVG(filename=str(HERE / "figures" / f"{name}.svg"))


def drawn(fig: Figure) -> SVG:
    """Return a figure as SVG on transparent paper."""
    text = io.StringIO()
    fig.savefig(text, format="svg", transparent=True, bbox_inches="tight", metadata={"Date": None})
    return SVG(data=text.getvalue())
