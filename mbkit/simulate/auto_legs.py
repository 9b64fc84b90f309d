"""The parts of a run by method auto, and how they are told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

__all__ = ["Leg", "kind", "told"]

#: Changes of the method that are told one by one.
_TOLD: Final = 3


@dataclass
class Leg:
    """A part of a run by one method: from when on and why, and what else there is to say."""

    method: str
    t: float
    why: str = ""
    note: str = ""


def kind(legs: Sequence[Leg]) -> str:
    """Return the methods in their order.

    Examples
    --------
    >>> kind([Leg("rk853", 0.0)]), kind([Leg("rk853", 0.0), Leg("rodas5", 0.1)])
    ('rk853 throughout', 'rk853, then rodas5')
    """
    methods = [leg.method for leg in legs]
    return f"{methods[0]} throughout" if len(methods) == 1 else ", then ".join(methods)


def told(legs: Sequence[Leg]) -> str:
    """Return what was chosen and why.

    Examples
    --------
    >>> told([Leg("rk853", 0.0), Leg("rodas5", 0.1, "where stability held its steps")])
    'rk853 to t = 0.1 s, where stability held its steps; rodas5 from there'
    """
    parts: list[str] = []
    skipped = len(legs) - 1 - 2 * _TOLD
    for i, leg in enumerate(legs):
        if skipped > 0 and _TOLD < i <= _TOLD + skipped:
            if i == _TOLD + 1:
                parts.append(f"{skipped} more changes")
            continue
        part = leg.method + (" from there" if i else "")
        # What a method was given on the way to being left is of no interest.
        until = f" to t = {legs[i + 1].t:.3g} s, {legs[i + 1].why}" if i + 1 < len(legs) else ""
        parts.append(part + (until or (leg.note and f", {leg.note}")))
    return kind(legs) if len(legs) == 1 and not legs[0].note else "; ".join(parts)
