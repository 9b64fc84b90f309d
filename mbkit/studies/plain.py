"""Results as plain data and back: null for NaN, numbers as CSV has them, and files."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path
from typing import Any

from mbkit.errors import OutputError

__all__ = ["cell", "plain", "remade", "write"]


def plain(value: Any) -> Any:
    """Return data as JSON can hold it: tuples as lists, and None for what is not finite."""
    if isinstance(value, dict):
        return {k: plain(x) for k, x in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(x) for x in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def remade(kind: type[Any], told: dict[str, Any]) -> Any:
    """Return a dataclass from plain data; null is NaN, and what it does not have is left out."""
    names = [f.name for f in fields(kind) if f.name in told]
    return kind(**{n: math.nan if told[n] is None else told[n] for n in names})


def cell(x: float) -> str:
    """Return a number with all its digits for CSV, empty for NaN."""
    return "" if math.isnan(x) else repr(x)


def write(path: str | Path, text: str) -> None:
    """Write a text that somebody asked for.

    Raises
    ------
    OutputError
        It cannot be written there.
    """
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}; choose a folder that exists") from error
