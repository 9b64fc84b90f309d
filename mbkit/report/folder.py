"""The folder that pages and data are written to."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

from mbkit import _interrupt
from mbkit.errors import OutputError

__all__ = ["check_writable", "file_stem", "write"]


def file_stem(name: str) -> str:
    """Return a model's name as the stem of a file in the folder, whatever the name holds."""
    return re.sub(r"[^\w.+-]+", "_", name).strip("._")[:100] or "model"


def check_writable(folder: Path) -> None:
    """Raise `OutputError` if `folder` cannot be written to; nothing is created.

    Asked before long work, so that its result need not look for a place.
    """
    place = folder.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise OutputError(f"cannot write to {folder}: {place} is not a folder; choose another with --out")
    if not os.access(place, os.W_OK | os.X_OK):
        raise OutputError(f"cannot write to {folder}: no permission in {place}; choose another with --out")


def write(folder: Path, name: str, content: str | bytes) -> Path:
    """Write a file as a whole or not at all, and return its path; text is UTF-8."""
    with _interrupt.held:
        return _write(folder, name, content)


def _write(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    temporary = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, suffix=".part", delete=False) as file:
            temporary = file.name
            file.write(content if isinstance(content, bytes) else content.encode("utf-8", "backslashreplace"))
        # A temporary file is for its owner only; a report is for whoever may read the folder.
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)
        why = error.strerror or error
        raise OutputError(f"cannot write {path}: {why}; choose another folder with --out") from error
    return path


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
