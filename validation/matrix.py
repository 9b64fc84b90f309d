"""Every kind of part on every path: right to an error, refused by name, or left out with a note.

The examples and their truth are `tests.kind_examples`, in NumPy alone; the paths are `tests.kind_paths`.
``python -m validation.matrix takes`` writes anew only the kinds that each gate takes, ``pairs`` only what became of
the models of several kinds (`tests.kind_pairs`), and ``mutations`` of the mutations of `tests.kind_mutations`.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

# SymPy forgets what it knows of expressions, which kinds share, after a thousand of them.
os.environ.setdefault("SYMPY_CACHE_SIZE", "None")

from mbkit.model.elements.kinds import PART_KINDS, joint_types, kind
from tests import kind_mutations, kind_pairs
from tests.kind_examples import TYPES
from tests.kind_paths import Cell
from tests.kind_studies import ABSENT, COLUMNS, ROWS, cell, registered
from validation.stamp import results, stamp

KINDS = ROWS
PATHS = tuple(COLUMNS)
PROCESSES = 2
#: Characters of a refusal that are kept.
MOST = 160
#: Of the models of several kinds one of so many.
EACH = 1
SMOKE = {
    "KINDS": ("gravity", "loop.point"),
    "PATHS": ("lagrangian: accelerations", "URDF and back"),
    "PROCESSES": 0,
    "EACH": 300,
}
#: Outcomes that are faults.
FAULTS = ("silent", "unnamed", "crash")


def row(name: str, paths: tuple[str, ...]) -> dict[str, Any]:
    """Return the cells of a kind, and the seconds that each took."""
    os.environ["MBKIT_COMPILE"] = "0"
    cells, seconds = {}, {}
    registered()
    with tempfile.TemporaryDirectory() as folder:
        for path in paths:
            begun = spent()
            out = cell(name, path, Path(folder))
            text = out.text.replace(f"{folder}/", "")
            seconds[path] = spent() - begun
            cells[path] = [out.outcome, None if out.error is None else float(f"{out.error:.1e}"), text[:MOST]]
    return {"kind": name, "cells": cells, "seconds": seconds}


def spent() -> float:
    """Return the processor's seconds of this process and of those that it has waited for."""
    return sum(os.times()[:4])


def takes() -> dict[str, list[str]]:
    """Return the kinds that each gate takes."""
    types = joint_types(*(x.removeprefix("joint_type.") for x in TYPES if not x.endswith("beam")))
    kinds = [*PART_KINDS.values(), *map(kind, sorted(types))]
    return {name: [k.name for k in kinds if gate.takes(k)] for name, gate in sorted(registered().items())}


def mutations() -> dict[str, Any]:
    """Return how many mutants each mutation of each path has, and the kinds whose mutants nothing notices."""
    registered()
    cells = json.loads(results("matrix.json").read_text(encoding="utf-8"))["rows"]
    right = {(r["kind"], path) for r in cells for path, c in r["cells"].items() if c[0] == "right"}
    out: dict[str, Any] = {}
    for mutation in ("dropped", "admitted", "removed"):
        paths = PATHS if mutation == "removed" else sorted(set(registered()) - {*kind_mutations.ELSEWHERE})[::EACH]
        found = out[mutation] = {"paths": len(paths), "left_out": [], "mutants": 0, "survive": {}}
        for path in paths:
            names = [name for name in KINDS if mutation != "removed" or (name, path) in right]
            with tempfile.TemporaryDirectory() as folder:
                got = [getattr(kind_mutations, mutation)(name, path, Path(folder)) for name in names]
            found["mutants"] += sum(x is not None for x in got)
            if kinds := [x.kind for x in got if x is not None and x.outcome == "survives"]:
                found["survive"][path] = kinds
    return out


@contextmanager
def shared() -> Iterator[Callable[..., Iterable[Any]]]:
    """Yield a function as `map`, whose calls processes share."""
    if not PROCESSES:
        yield map
        return
    with ProcessPoolExecutor(PROCESSES, mp_context=get_context("spawn")) as pool:
        yield pool.map


def model_of_pairs(name: str) -> list[tuple[str, str, Cell, float]]:
    """Return the cells of a model of several kinds, each with its path and the processor's seconds."""
    os.environ["MBKIT_COMPILE"] = "0"
    kind_pairs.names()
    out = []
    with tempfile.TemporaryDirectory() as folder:
        for path in kind_pairs.paths(name):
            begun = spent()
            got = kind_pairs.pair_cell(name, path, Path(folder))
            out.append((name, path, got, spent() - begun))
    return out


def pairs(found: Iterable[Any] | None = None) -> dict[str, Any]:
    """Return what became of the models that hold every pair of kinds, in what `model_of_pairs` found of each."""
    if found is None:
        with shared() as each:
            return pairs(each(model_of_pairs, kind_pairs.names()[::EACH]))
    cells, seconds = [x for part in found for x in part], Counter[str]()
    for _, path, _, taken in cells:
        seconds[path] += taken
    summary = kind_pairs.summary([x[:3] for x in cells])
    return summary | {"cpu_s": round(seconds.total()), "seconds": {path: round(x, 1) for path, x in seconds.items()}}


def told(data: dict[str, Any]) -> None:
    """Print counts and faults."""
    print(data["counts"], data["pairs"]["counts"], data["pairs"]["cpu_s"], "s for pairs")
    for r in data["rows"]:
        for path, (outcome, error, text) in r["cells"].items():
            if outcome in FAULTS:
                print(f"{r['kind']} on {path}: {outcome} {error} {text}")
    for kinds, path, outcome, text in data["pairs"]["faults"]:
        print(f"{', '.join(kinds)} on {path}: {outcome} {text}")


def main() -> int:
    begun = time.perf_counter()
    file = results("matrix.json")
    made = {"takes": takes, "pairs": pairs, "mutations": mutations}
    before = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    if asked := [x for x in sys.argv[1:] if x in made]:
        data = before | {x: made[x]() for x in asked}
    else:
        with shared() as each:
            # All calls are there at once, so that no process waits.
            made_rows, of_pairs = (
                each(row, KINDS, [PATHS] * len(KINDS)),
                each(model_of_pairs, kind_pairs.names()[::EACH]),
            )
            found, together = list(made_rows), pairs(of_pairs)
        counts = Counter(c[0] for r in found for c in r["cells"].values())
        times = [r.pop("seconds") for r in found]
        seconds = {path: round(sum(x[path] for x in times), 1) for path in PATHS}
        data = stamp(__file__) | {
            "counts": dict(counts),
            "cpu_s": round(sum(seconds.values())),
            "wall_s": round(time.perf_counter() - begun),
            "columns": [{"group": COLUMNS[p].group, "name": p, "close": COLUMNS[p].close} for p in PATHS],
            "seconds": seconds,
            "not_yet": [
                f"terms of {p}, whose gate alone is asked, as its environment is not here"
                for p in PATHS
                if any(r["cells"][p][2] == ABSENT for r in found)
            ],
            "without_column": sorted(set(registered()) - {g for c in COLUMNS.values() for g in c.gates}),
            "takes": takes(),
            "pairs": together,
            "mutations": before.get("mutations", {}),
            "rows": found,
        }
    told(data)
    file.write_text(json.dumps(data, ensure_ascii=False, separators=(",", ":")) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
