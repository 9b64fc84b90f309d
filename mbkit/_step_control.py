"""How far the steps of an embedded pair may shrink and grow, compiled or not."""

from __future__ import annotations

from typing import Final

__all__ = ["GROWTH", "LAST", "SAFETY", "SHRINK"]

SAFETY: Final = 0.8
SHRINK: Final = 0.2
GROWTH: Final = 10.0
#: The 32nd root of the smallest error that is remembered, 1e-4.
LAST: Final = 1e-4 ** (1 / 32)
