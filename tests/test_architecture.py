"""The shape of the code: sizes of files and folders, and names of engines and joint types in one place each."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from functools import cache
from graphlib import TopologicalSorter
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import mbkit
from mbkit.engines.registry import ENGINES
from mbkit.model.joint_types import KINDS
from mbkit.simulate import METHODS

ROOT = Path(mbkit.__file__).parent
FILES = {path.relative_to(ROOT).as_posix(): path for path in sorted(ROOT.rglob("*.py"))}
#: Lines of a file, and modules of a folder, `__init__` not counted.
MAX_LINES, MAX_MODULES = 800, 15
#: What is larger today; these must not grow.
LARGE_FILES: dict[str, int] = {}
LARGE_FOLDERS: dict[str, int] = {}

#: Files and folders that may write the name of an engine.
ENGINE_NAMES = (
    "engines/",
    # Texts of examples, and words of formats: <mujoco> is a tag of MJCF.
    "load/",
    # The package of the same name, and the code that a compiled function depends on.
    "__init__.py",
    "derivation/fingerprint.py",
    # Which engine has a method of its own.
    "methods/",
    # The engine as the default of a signature.
    "lagrangian/system.py",
)
#: Files and folders that may write the name of a joint type. Models are described with the public builder, formats
#: have tables from their words to ours, and kinds of loops are named after joints.
JOINT_NAMES = ("model/joint_types.py", "model/loops.py", "engines/", "load/", "catalog/", "studies/stress/cases/")
#: Files and folders that may write the name of a method of integration.
METHOD_NAMES = (
    "methods/",
    # Which methods studies run on an engine, and an engine's own names of its integrators.
    "engines/",
    # The closed form of a method's error on a case, as for joint types.
    "studies/stress/cases/",
)
#: Files that may import what a text names.
IMPORTS_BY_NAME = (
    # Tables of what loads late.
    "__init__.py",
    "lagrangian/__init__.py",
    "simulate/solvers/__init__.py",
    # What users add: engines and importers.
    "engines/registry.py",
    "engines/imported.py",
    # An adapter in a process without mbkit, named on its command line.
    "engines/remote/served/serve.py",
    # A user's target, ``package.module:function``.
    "studies/_targets.py",
    # Packages that unpickle as themselves, and what the table of ``__init__`` names.
    "_imports.py",
    # A module of robot_descriptions, which runs without its function that fetches.
    "load/loader.py",
)
#: Names that are ordinary words too: a method with fixed steps, ``mimic="free"``, MJCF's ``autolimits="auto"``.
WORDS = ("fixed", "free", "ball", "auto")


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@cache
def literals(path: Path) -> list[tuple[int, str]]:
    """Return the strings of a module with their lines, without docstrings and f-strings."""
    skipped = {
        id(part)
        for node in nodes(path)
        if isinstance(node, (ast.Expr, ast.JoinedStr))
        for part in ([node.value] if isinstance(node, ast.Expr) else node.values)
    }
    return [
        (node.lineno, node.value)
        for node in nodes(path)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in skipped
    ]


def words_of(path: Path) -> Iterator[str]:
    """Yield the names and the words of strings of a module, without docstrings."""
    for node in nodes(path):
        for field in ("name", "id", "attr", "arg"):
            if isinstance(name := getattr(node, field, None), str):
                yield name
        if isinstance(node, ast.ImportFrom):
            yield (node.module or "").rpartition(".")[2]
    for _, text in literals(path):
        yield from re.findall(r"\w+", text)


def uses(names: Iterable[str], allowed: Iterable[str]) -> list[str]:
    """Return where a name stands as a string outside of files and folders (which end in a slash)."""
    names, allowed = frozenset(names), tuple(allowed)
    return [
        f"mbkit/{name}:{line}: {text!r}"
        for name, path in FILES.items()
        if not any(name == x or (x.endswith("/") and name.startswith(x)) for x in allowed)
        for line, text in literals(path)
        if text in names
    ]


def test_names_of_engines_stand_in_the_registry():
    assert uses((n for n, info in ENGINES.items() if info.built_in), ENGINE_NAMES) == []


def test_names_of_joint_types_stand_with_the_joint_types():
    names = (n for n, joint_type in KINDS.items() if joint_type.built_in and n not in WORDS)
    assert uses(names, JOINT_NAMES) == []


def test_names_of_methods_stand_with_the_methods():
    assert uses((n for n in METHODS if n not in WORDS), METHOD_NAMES) == []


def test_no_joint_is_asked_for_the_name_of_its_type():
    """``joint.kind == "free"`` leaves joint types of one's own behind; `JointType` has an attribute instead."""
    found = []
    for name, path in FILES.items():
        if name.startswith(("engines/", "load/")):
            continue
        for node in nodes(path):
            sides = [node.left, *node.comparators] if isinstance(node, ast.Compare) else []
            constants = {x.value for x in sides if isinstance(x, ast.Constant)}
            kinds = any(isinstance(x, ast.Attribute) and x.attr == "kind" for x in sides)
            if kinds and constants & {*KINDS} - {"fixed"}:
                found.append(f"mbkit/{name}:{node.lineno}")
    assert found == []


def names_imports(node: ast.AST) -> bool:
    """Return whether a node may import what a text names."""
    names = [getattr(node, "id", ""), getattr(node, "attr", "")]
    names += [x.name for x in node.names] if isinstance(node, ast.ImportFrom) else []
    return not {"import_module", "__import__"}.isdisjoint(names)


def test_imports_by_name_stand_in_tables():
    """What a lower room uses of an upper one stands in the table of `mbkit.__init__`, and contracts see the rest."""
    found = {name for name, path in FILES.items() if any(map(names_imports, nodes(path)))}
    assert found == set(IMPORTS_BY_NAME)


def imported_by(name: str) -> set[str]:
    """Return the files that a file imports, anywhere in it and for types too, without tables of packages."""
    found = set()
    for node in nodes(FILES[name]):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mbkit"):
            module = node.module.replace(".", "/").removeprefix("mbkit").lstrip("/")
            found |= {f"{module}.py", *(f"{module}/{x.name}.py".lstrip("/") for x in node.names)}
    return found & FILES.keys()


def test_no_file_imports_one_that_imports_it():
    tuple(TopologicalSorter({name: imported_by(name) for name in FILES}).static_order())


def test_modules_are_handed_down_to_those_that_use_them():
    text = "".join(path.read_text(encoding="utf-8") for path in FILES.values())
    assert set(re.findall(r'from_above\("(\w+)"\)', text)) == mbkit._HANDED_DOWN.keys()


def test_files_are_no_longer_than_a_concept():
    lines = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in FILES.items()}
    assert {name: n for name, n in lines.items() if n > LARGE_FILES.get(name, MAX_LINES)} == {}


def test_folders_hold_few_modules():
    folders = {path.parent for path in FILES.values()}
    sizes = {f.relative_to(ROOT).as_posix(): sum(p.name != "__init__.py" for p in f.glob("*.py")) for f in folders}
    assert {n: k for n, k in sizes.items() if k > LARGE_FOLDERS.get(n, MAX_MODULES)} == {}


def test_the_price_of_a_change_is_that_of_the_book():
    """Of each row of the table: where the example's name stands in code, without docstrings and comments."""
    page = (ROOT.parent / "notebooks" / "carry_on" / "extend.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]+) \| `(\w+)` \| (`[^|]+`) \|$", page, flags=re.MULTILINE)
    words = {name: set(words_of(path)) for name, path in FILES.items()}
    found = {what: {name for name, of in words.items() if example in of} for what, example, _ in rows}
    assert found == {what: set(re.findall(r"`([^`]+)`", files)) for what, _, files in rows}
    assert len(rows) >= 9


def test_validation_scripts_import_names_that_exist():
    missing = []
    for path in sorted((ROOT.parent / "validation").glob("*.py")):
        for node in nodes(path):
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "mbkit":
                for name in (alias.name for alias in node.names):
                    module = node.module if find_spec(node.module) else ""
                    if not module or not (hasattr(import_module(module), name) or find_spec(f"{module}.{name}")):
                        missing.append(f"{path.name}: {node.module}.{name}")
    assert not missing


def test_the_result_of_a_run_is_made_in_one_place():
    calls = [
        name
        for name, path in FILES.items()
        for node in nodes(path)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "SolverResult"
    ]
    assert calls == ["simulate/solvers/trajectory_record.py"]
