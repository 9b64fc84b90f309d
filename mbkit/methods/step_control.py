"""How far the steps of an embedded pair may shrink and grow, compiled or not."""

from __future__ import annotations

from typing import Final

__all__ = ["DEFECT", "GROWTH", "LAST", "SAFETY", "SHRINK"]

SAFETY: Final = 0.8
SHRINK: Final = 0.2
GROWTH: Final = 10.0
#: The 32nd root of the smallest error that is remembered, 1e-4.
LAST: Final = 1e-4 ** (1 / 32)
#: A Rosenbrock method sees a force only through the Jacobian at the step's start: what was stiff there and has gone by
#: its end leaves no error behind. So the rate at the end is compared with that of the step's polynomial; of the
#: smooth, however stiff, they differ by 20 times the tolerance at most, by a tenth of it as a rule.
DEFECT: Final = 100.0
