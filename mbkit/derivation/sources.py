"""A fingerprint of the code that derives and compiles, so that its change is another cache entry."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final

__all__ = ["SOURCES"]


def _digest() -> str:
    here = Path(__file__).parent
    total = hashlib.sha256()
    # What is written on paper brings equations of its own.
    beside = (here, here.parent / "model", here.parent / "lagrangian")
    for path in sorted(path for folder in beside for path in folder.glob("*.py")):
        total.update(path.name.encode() + b"\0" + path.read_bytes())
    return total.hexdigest()


#: Read when the derivation is imported: an edit that comes later is not what runs.
SOURCES: Final = _digest()
