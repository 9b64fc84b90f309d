"""A fingerprint of the code that derives and compiles, so that a change of it makes another cache entry."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Final

#: Modules that decide the compiled code: packages with all their sub-packages, and single modules, below mbkit's
#: folder. Systems on paper bring equations of their own.
DECISIVE: Final = (
    "derivation",
    "codegen",
    "methods",
    "model",
    "lagrangian",
    "engines/derived.py",
    "engines/lagrangian.py",
    "engines/constraint_manifold.py",
    "spatial.py",
    "_check.py",
    "_reproducible.py",
    "errors.py",
)
_ROOT: Final = Path(__file__).parent.parent


def source_files(root: Path = _ROOT, listed: Iterable[str] = DECISIVE) -> tuple[Path, ...]:
    """Return the files of listed packages and modules, in order; `FileNotFoundError` where one holds no code."""
    out: list[Path] = []
    for name in listed:
        path = root / name
        found = sorted(path.rglob("*.py")) if path.is_dir() else [path]
        if not found or not found[0].is_file():
            raise FileNotFoundError(f"{path}: no source; correct the list in {__file__}")
        out += found
    return tuple(out)


def fingerprint(root: Path = _ROOT, listed: Iterable[str] = DECISIVE) -> str:
    """Return the SHA-256 of the files' places and contents, as hexadecimal digits."""
    total = hashlib.sha256()
    for path in source_files(root, listed):
        content = path.read_bytes()
        total.update(f"{path.relative_to(root).as_posix()}\0{len(content)}\0".encode() + content)
    return total.hexdigest()


#: Read when the derivation is imported: an edit that comes later is not the code that runs.
SOURCES: Final = fingerprint()
