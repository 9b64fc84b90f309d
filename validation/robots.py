"""The robots of example-robot-data that a part takes: all, or in a smoke run a few by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mbkit as mb

#: In a smoke run: seven joints with damping and dry friction, and a file without links.
FEW = ("z1_description/z1", "ur_description/ur3")


def chosen(names: Sequence[str] | None) -> list[Any]:
    """Return `mbkit.robots`, or those that are named."""
    return [r for r in mb.robots() if names is None or r.name in names]
