"""What every file of results begins with: day, versions of everything that computes, processor, SIMD, and code.

The code of a script is its own text and that of every module of `validation` and `tests` that it imports, without
comments and docstrings; that of mbkit is all of its files. Pages compare both with the code beside them.
"""

from __future__ import annotations

import ast
import datetime
import hashlib
import os
from functools import cache
from pathlib import Path
from typing import Any

import mbkit
from mbkit.codegen import jit
from mbkit.studies.results import processor, versions

HERE = Path(__file__).parent
#: Modules that compute nothing of what is kept.
_FRAME = {"stamp", "pages", "smoke", "__main__"}


def stamp(script: str) -> dict[str, Any]:
    """Return the stamp of a script, which gives its `__file__`."""
    name = Path(script).stem
    told = {"date": datetime.date.today().isoformat(), "versions": versions(), "processor": processor()}
    told["simd"] = {"doubles": jit.host().width, "chosen": os.environ.get("MBKIT_CPU", "")}
    return told | {"code": {"of": name, "script": script_code(name), "mbkit": package_code()}}


def results(name: str) -> Path:
    """Return the place of a file of results or a folder of figures: beside the scripts, but in a smoke run."""
    return Path(os.environ.get("MBKIT_RESULTS", HERE), name)


def changed(data: dict[str, Any]) -> str:
    """Return what of the code is no longer that which made a file of results, empty where all is."""
    code = data.get("code")
    if code is None:
        return "made before the code was kept with it"
    if code["script"] != script_code(code["of"]):
        return "made by other code than these scripts have now"
    return "" if code["mbkit"] == package_code() else "mbkit's code has changed since"


@cache
def script_code(name: str) -> str:
    """Return the digest of a script's code and of what it imports from here and from the tests."""
    files, found = [HERE / f"{name}.py"], dict[Path, str]()
    while files:
        file = files.pop()
        if file in found:
            continue
        tree = ast.parse(text := file.read_text(encoding="utf-8"))
        found[file] = _code(tree, text)
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                modules = [node.module, *(f"{node.module}.{x.name}" for x in node.names)]
            else:
                modules = [x.name for x in node.names] if isinstance(node, ast.Import) else []
            for module in modules:
                package, _, stem = module.partition(".")
                beside = HERE.parent / package / f"{stem}.py"
                if package in ("validation", "tests") and stem not in _FRAME and beside.is_file():
                    files.append(beside)
    return _digest("\n".join(found[file] for file in sorted(found)))


def _code(tree: ast.Module, text: str) -> str:
    """Return a module's lines without docstrings, comments that have a line of their own, and empty lines."""
    kept: list[str] = text.splitlines()
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) and ast.get_docstring(
            node, clean=False
        ):
            first = node.body[0]
            kept[first.lineno - 1 : first.end_lineno] = [""] * ((first.end_lineno or 0) - first.lineno + 1)
    return "\n".join(x.rstrip() for x in kept if x.strip() and not x.lstrip().startswith("#"))


@cache
def package_code() -> str:
    """Return the digest of all files of mbkit."""
    top = Path(mbkit.__file__).parent
    return _digest("\n".join(x.read_text(encoding="utf-8") for x in sorted(top.rglob("*.py"))))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
