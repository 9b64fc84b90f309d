"""Numbers as text, the same on a terminal and on a page."""

from __future__ import annotations

import math
from typing import Final

__all__ = ["count_text", "error_text", "time_text"]

_UNITS: Final = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))


def error_text(x: float) -> str:
    """Return an error with two digits; no one needs a third."""
    if math.isnan(x):
        return "NaN"
    if math.isinf(x):
        return "∞" if x > 0 else "−∞"
    return "0" if x == 0 else f"{x:.1e}"


def time_text(seconds: float) -> str:
    """Return a time with three digits and its unit; empty where it was not measured."""
    if math.isnan(seconds):
        return ""
    if math.isinf(seconds):
        return "∞"
    size = abs(seconds)
    if size >= 99.95:
        return f"{seconds:.0f} s"
    for scale, unit in _UNITS:
        # Half of the last digit shown, so that 999.6 ns is not "1000 ns".
        if size >= 0.9995 * scale:
            return f"{_three(seconds / scale)} {unit}"
    return "0 ns" if size < 5e-12 else f"{seconds * 1e9:.2f} ns"


def _three(x: float) -> str:
    size = abs(x)
    return f"{x:.0f}" if size >= 99.95 else f"{x:.1f}" if size >= 9.995 else f"{x:.2f}"


def count_text(x: float) -> str:
    """Return a factor without decimals where it has three digits."""
    return "" if math.isnan(x) else "∞" if math.isinf(x) else f"{x:.3g}" if abs(x) < 1000 else f"{x:.1e}"
