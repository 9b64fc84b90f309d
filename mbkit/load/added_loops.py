"""Loops that a file does not hold: given beside it, as arguments of `ModelBuilder.add_loop` or in a TOML file."""

from __future__ import annotations

import inspect
import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from mbkit._check import shown
from mbkit._reproducible import product
from mbkit.errors import InputError, LoadError, ModelError, nearest
from mbkit.model import Frame, Model, ModelBuilder
from mbkit.model.builder import with_loops
from mbkit.model.loops import LOOP_KINDS
from mbkit.model.parts import Loop

#: Values of `load(..., loops=)` beside True and False.
Loops = str | os.PathLike[str] | Sequence[Loop | Mapping[str, Any]]
#: Name of a TOML file's tables, one for each loop.
_TABLE: Final = "loop"
#: Largest file that is read, bytes.
_MAX_TOML_BYTES: Final = 1_000_000
_PARAMETERS: Final = {
    name: parameter.default is inspect.Parameter.empty
    for name, parameter in inspect.signature(ModelBuilder.add_loop).parameters.items()
    if name != "self"
}


def add_loops(model: Model, loops: Loops) -> Model:
    """Return a model with more loops, whose ends may stand on frames, such as links that were merged.

    Raises
    ------
    InputError
        No loops, or an argument that `ModelBuilder.add_loop` does not have or misses.
    LoadError
        A file that is missing, or is no TOML file of loops.
    ModelError
        All faults of the loops in one list: unknown bodies, kinds and wrong numbers.
    """
    entries: Sequence[Any]
    if isinstance(loops, (str, os.PathLike)):
        entries, where = read_loops(loops), os.fspath(loops)
    elif isinstance(loops, Sequence):
        entries, where = loops, "loops"
    else:
        raise InputError(
            f"loops: expected True, False, a TOML file, or a sequence of Loop objects or dicts, got {shown(loops)}"
        )
    arguments = [_arguments(one, f"{where}[{k}]") for k, one in enumerate(entries)]
    try:
        added = with_loops(model, [_on_bodies(model, one) for one in arguments])
    except ModelError as error:
        raise ModelError(where if where != "loops" else model.name, error.faults) from None
    names = ", ".join(repr(str(one["name"])) for one in arguments)
    return replace(added, notes=(*added.notes, f"loops given beside the file: {names}")) if arguments else added


def read_loops(path: str | os.PathLike[str]) -> list[Mapping[str, Any]]:
    """Return the tables ``[[loop]]`` of a TOML file, whose keys are arguments of `ModelBuilder.add_loop`."""
    file = Path(os.fspath(path))
    try:
        if file.stat().st_size > _MAX_TOML_BYTES:
            raise LoadError(f"{file}: expected a TOML file of loops, got {file.stat().st_size} bytes")
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise LoadError(f"{file}: {error.strerror or error}; loops= takes a TOML file, True, False or a list") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise LoadError(f"{file}: not a TOML file: {error}") from None
    tables = content.get(_TABLE, [])
    if not isinstance(tables, list) or not all(isinstance(x, dict) for x in tables) or content.keys() - {_TABLE}:
        raise LoadError(f"{file}: expected tables [[{_TABLE}]] and nothing else, got {', '.join(content)}")
    if not tables:
        raise LoadError(f"{file}: no table [[{_TABLE}]]; write one for each loop")
    return tables


def _arguments(one: Any, what: str) -> dict[str, Any]:
    """Return the arguments of `add_loop` that a loop stands for."""
    if isinstance(one, Loop):
        return {f.name: getattr(one, f.name) for f in fields(one)}
    if not isinstance(one, Mapping):
        raise InputError(f"{what}: expected a Loop or a dict of add_loop's arguments, got {shown(one)}")
    for name in one:
        if name not in _PARAMETERS:
            near = nearest(name, _PARAMETERS) if isinstance(name, str) else []
            raise InputError(f"{what}: unknown argument {shown(name)}; add_loop takes {', '.join(near or _PARAMETERS)}")
    if missing := [name for name, needed in _PARAMETERS.items() if needed and name not in one]:
        kind, absent = one.get("kind"), f"{', '.join(missing)} missing"
        if "kind" in one and not (isinstance(kind, str) and kind in LOOP_KINDS):
            kinds = ", ".join(map(repr, LOOP_KINDS))
            raise InputError(f"{what}: unknown kind {shown(kind)}; there are {kinds}; and {absent}")
        raise InputError(f"{what}: {absent}")
    return dict(one)


def _on_bodies(model: Model, one: dict[str, Any]) -> dict[str, Any]:
    """Return a loop with ends on bodies where they are on frames, such as the links of a URDF that were merged."""
    bodies = {body.name for body in model.bodies}
    frames = {frame.name: frame for frame in model.frames if frame.name not in bodies}
    out = dict(one)
    for side in "ab":
        frame = frames.get(one[f"body_{side}"]) if isinstance(one[f"body_{side}"], str) else None
        if frame is not None:
            out |= _moved(frame, one, side)
    return out


def _moved(frame: Frame, one: dict[str, Any], side: str) -> dict[str, Any]:
    p, R = one.get(f"translation_{side}", np.zeros(3)), one.get(f"rotation_{side}")
    try:
        point = frame.translation + product(frame.rotation, np.array(p, dtype=np.float64))
        axes = frame.rotation if R is None else product(frame.rotation, np.array(R, dtype=np.float64))
    except (TypeError, ValueError):
        # The builder names their faults.
        return {f"body_{side}": frame.body}
    return {f"body_{side}": frame.body, f"translation_{side}": point, f"rotation_{side}": axes}
