"""What a baseline was recorded of, as text: a robot's name, a function, or a file by its place beside the baseline."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from mbkit.errors import InputError

__all__ = ["checked_target", "kept", "resolved"]


def checked_target(target: object, options: object = None) -> None:
    """Refuse what a baseline cannot keep as a target, or as the options that it is loaded with."""
    if not isinstance(target, str):
        raise InputError(f"target: expected a text such as 'panda' or './arm.urdf', got {type(target).__name__}")
    if options is None:
        return
    kept_kinds = (bool, int, float, str)
    if not isinstance(options, Mapping) or not all(
        isinstance(k, str)
        and (isinstance(x, kept_kinds) or (isinstance(x, (list, tuple)) and all(isinstance(y, kept_kinds) for y in x)))
        for k, x in options.items()
    ):
        raise InputError(f"options: expected keyword arguments of mbkit.load, of numbers and texts, got {options!r}")


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
