"""Warnings that point at the user's line."""

from __future__ import annotations

import sys
import warnings


def warn(message: str, category: type[Warning]) -> None:
    """Warn at the line that called the library, however deep in it this is."""
    level, frame = 1, sys._getframe(0)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] == "mbkit":
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


def called_within(*packages: str) -> bool:
    """Return whether a package of the library calls what called the caller's caller, in place of a user."""
    frame = sys._getframe(4)
    while frame.f_back is not None and (name := frame.f_globals.get("__name__", "")).partition(".")[0] == "mbkit":
        if name.startswith(packages):
            return True
        frame = frame.f_back
    return False
