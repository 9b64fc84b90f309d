"""What a baseline was recorded of, as text: a robot's name, a function, or a file by its place beside the baseline."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["kept", "resolved"]


def kept(target: str, baseline: Path) -> str:
    """Return a target as it is kept: a file relative to the baseline, so that both can move together.

    It then begins with a dot, as no name does.
    """
    if not os.path.isfile(target):
        return target
    try:
        relative = Path(os.path.relpath(target, baseline.absolute().parent)).as_posix()
    except ValueError:
        # Another drive: there is no way from one to the other.
        return Path(target).absolute().as_posix()
    return relative if relative.startswith(".") else f"./{relative}"


def resolved(target: str, baseline: Path) -> str:
    """Return a kept target as it is loaded from the current folder."""
    return os.path.normpath(baseline.absolute().parent / target) if target.startswith(".") else target
