"""Warnings that point at the user's line."""

from __future__ import annotations

import sys
import warnings


def warn(message: str, category: type[Warning], unless: tuple[str, ...] = ()) -> None:
    """Warn at the line that called the library, however deep in it this is, unless some of its modules are between."""
    level, frame = 1, sys._getframe(0)
    while frame.f_back is not None and (name := frame.f_globals.get("__name__", "")).split(".")[0] == "mbkit":
        if name.startswith(unless):
            return
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
