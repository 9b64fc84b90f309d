"""The folder that pages and data are written to."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Final

from mbkit import _process as _interrupt
from mbkit.errors import OutputError, writing
from mbkit.studies.results import write_whole


def file_stem(name: str) -> str:
    """Return a model's name as the stem of a file in the folder, whatever the name holds."""
    return re.sub(r"[^\w.+-]+", "_", name).strip("._")[:100] or "model"


def check_writable(folder: Path) -> None:
    """Raise `OutputError`, before long work, if `folder` cannot be written to; nothing is created."""
    place = folder.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    why = "" if os.access(place, os.W_OK | os.X_OK) else f"no permission in {place}"
    why = why if place.is_dir() else f"{place} is not a folder"
    if why:
        raise OutputError(f"cannot write to {folder}: {why}; choose another with --out")


def check_replaceable(folder: Path, *names: str, force: bool = False) -> None:
    """Raise `OutputError`, before long work, for a file that mbkit did not write, unless `force` is set."""
    for path in (folder / name for name in names):
        if not force and os.path.lexists(path) and not _is_own(path):
            remedy = "choose another folder with --out, or replace it with --force"
            raise OutputError(f"{path} is there and mbkit did not write it; {remedy}")


#: At the beginning or the end of what mbkit writes.
_MARKS: Final = (
    b'content="mbkit"',
    b"Software\0mbkit",
    b"ritten by mbkit",
    b"engine,method,setting,value,",
    b"case,parameter,unit,value,engine,method,",
    b"t,q.",
)


def _is_own(path: Path) -> bool:
    """Return whether a file is one that a command of mbkit has written."""
    try:
        if path.suffix == ".json":
            data = json.loads(path.read_bytes())
            # Equations say at their head with which mbkit they were written; results among other versions.
            return isinstance(data, dict) and "mbkit" in (data | dict(data.get("versions") or {}))
        with path.open("rb") as file:
            head = file.read(4096)
            file.seek(max(0, os.path.getsize(path) - 64))
            head += file.read()
    except (OSError, ValueError, TypeError, RecursionError):
        return False
    return any(mark in head for mark in _MARKS)


def write(folder: Path, name: str, content: str | bytes, *, force: bool = False) -> Path:
    """Write a file as a whole or not at all, text as UTF-8, and return its path; see `check_replaceable`."""
    path = folder / name
    with _interrupt.uninterrupted:
        check_replaceable(folder, name, force=force)
        with writing(path, "choose another folder with --out"):
            folder.mkdir(parents=True, exist_ok=True)
            write_whole(path, content if isinstance(content, bytes) else content.encode("utf-8", "backslashreplace"))
    return path
