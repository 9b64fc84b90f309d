"""Numeric constants of the package: file, name, value, how each is used, and the tests that name it.

``python -m validation.thresholds`` lists them; with words, those whose file or name has one of them. A **threshold**
decides: it stands in a comparison, in ``min``, ``max`` or a range, or is passed as a tolerance. Every other number is a
**constant**: of physics, of a format, of a formula. ``--try`` sets each listed constant to a tenth of its value and to
ten times, and runs the tests that name it: a threshold that no test misses is not needed or not tested.
"""

from __future__ import annotations

import argparse
import ast
import math
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

TOP = Path(__file__).resolve().parents[1]
#: Functions that decide by one of their arguments, and keywords that are tolerances or limits.
DECIDING = {"min", "max", "range", "minimum", "maximum", "clip", "islice", "isclose", "allclose", "lru_cache"}
KEYWORDS = re.compile(r"tol|rcond|cutoff|limit|most|least|max|min")
#: A plugin of pytest that changes one constant before the tests begin.
PLUGIN = "import importlib; setattr(importlib.import_module({module!r}), {name!r}, {value!r})\n"


class Constant(NamedTuple):
    """A number that a module of the package calls by a name."""

    file: str  # below mbkit/
    name: str
    value: float
    threshold: bool
    tests: tuple[str, ...]

    @property
    def module(self) -> str:
        """Name of the module, as it is imported."""
        return ".".join(("mbkit", *Path(self.file).with_suffix("").parts))


def assigned(tree: ast.Module) -> Iterator[tuple[str, ast.expr]]:
    """Yield the names of a module's assignments, and their expressions."""
    for statement in tree.body:
        targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
        if isinstance(statement, (ast.Assign, ast.AnnAssign)) and statement.value is not None:
            name, value = targets[0], statement.value
            if isinstance(name, ast.Name):
                yield name.id, value
            elif isinstance(name, ast.Tuple) and isinstance(value, ast.Tuple):
                yield from ((n.id, v) for n, v in zip(name.elts, value.elts, strict=False) if isinstance(n, ast.Name))


def numbers(trees: dict[str, ast.Module]) -> dict[tuple[str, str], float]:
    """Return the constants of modules by file and name; those of a module may be computed from others."""
    basic: dict[str, Any] = {"np": np, "math": math, "sys": sys, "pi": math.pi, "float": float, "int": int}
    shared: dict[str, Any] = {}
    out: dict[tuple[str, str], float] = {}
    # The second pass knows the constants that modules import from each other.
    for _ in range(2):
        for file, tree in trees.items():
            imported = {a.name for n in tree.body if isinstance(n, ast.ImportFrom) for a in n.names}
            known = basic | {name: shared[name] for name in imported & shared.keys()}
            for name, value in assigned(tree):
                try:
                    number = eval(compile(ast.Expression(value), file, "eval"), {"__builtins__": {}}, known)
                except Exception:
                    continue
                if isinstance(number, (int, float)) and not isinstance(number, bool):
                    known[name] = out[file, name] = number
                    shared[name] = number
    return out


def deciding(tree: ast.Module) -> set[str]:
    """Return the names that stand in a comparison, or are an argument by which a function decides."""
    out: set[str] = set()
    for node in ast.walk(tree):
        parts: list[ast.AST] = [node] if isinstance(node, (ast.Compare, ast.Slice)) else []
        if isinstance(node, ast.Call):
            function = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            parts += node.args if function in DECIDING else []
            parts += [k.value for k in node.keywords if function in DECIDING or (k.arg and KEYWORDS.search(k.arg))]
        for part in parts:
            inside = list(ast.walk(part))
            out |= {n.id for n in inside if isinstance(n, ast.Name)}
            out |= {n.attr for n in inside if isinstance(n, ast.Attribute)}
    return out


def words(line: str) -> set[str]:
    """Return the words of a line."""
    return set(re.findall(r"\w+", line))


def constants(package: Path = TOP / "mbkit", tests: Path = TOP / "tests") -> list[Constant]:
    """Return the numeric constants of a package, by file."""
    trees = {str(p.relative_to(package)): ast.parse(p.read_text()) for p in sorted(package.rglob("*.py"))}
    decides = {file: deciding(tree) for file, tree in trees.items()}
    anywhere = set().union(*decides.values())
    lines = {p.name: [*map(words, p.read_text().splitlines())] for p in sorted(tests.glob("*.py"))}
    known = numbers(trees)
    times = Counter(name for _, name in known)
    out = []
    for (file, name), value in known.items():
        # One of a private name decides in its own module.
        threshold = name in (decides[file] if name.startswith("_") else anywhere)
        # A name that several modules have is that of the module on its line.
        named = {name} | ({Path(file).stem} if times[name] > 1 else set())
        out.append(
            Constant(file, name, value, threshold, tuple(t for t, of in lines.items() if any(map(named.issubset, of))))
        )
    return out


def tried(constant: Constant, folder: Path) -> str:
    """Return which of a tenth and ten times a constant its tests notice."""
    noticed = []
    for factor in (0.1, 10.0):
        value = type(constant.value)(constant.value * factor)
        (folder / "changed_constant.py").write_text(
            PLUGIN.format(module=constant.module, name=constant.name, value=value)
        )
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "changed_constant"]
        command += [f"tests/{t}" for t in constant.tests if t.startswith("test_")]
        path = os.pathsep.join((str(folder), str(TOP)))
        run = subprocess.run(command, cwd=TOP, env=os.environ | {"PYTHONPATH": path}, capture_output=True, check=False)
        noticed.append(f"{factor:g} times: {'noticed' if run.returncode == 1 else 'not noticed'}")
    return ", ".join(noticed)


def main() -> None:
    """List the constants, and the sums."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("words", nargs="*", help="list those whose file or name has one of these words")
    parser.add_argument("--try", dest="tries", metavar="FOLDER", type=Path, help="change each, with a file in FOLDER")
    args = parser.parse_args()
    every = constants()
    listed = [c for c in every if not args.words or any(w in f"{c.file} {c.name}" for w in args.words)]
    for threshold in (True, False):
        print("Thresholds" if threshold else "Constants")
        for c in (c for c in listed if c.threshold is threshold):
            found = tried(c, args.tries) if args.tries and c.tests else ", ".join(c.tests) or "no test names it"
            print(f"  {c.file:45} {c.name:32} {c.value:<12.6g} {found}")
    of_thresholds = [c for c in every if c.threshold]
    named = sum(1 for c in of_thresholds if c.tests)
    print(f"{len(every)} numbers: {len(of_thresholds)} thresholds, of which tests name {named}, and others")


if __name__ == "__main__":
    main()
