"""How large the numbers of a state are, where a tolerance is relative to the largest of them."""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import Array

__all__ = ["size_of"]

#: rad, m, rad/s, m/s.
_COMMON: Final = 10.0


def size_of(*states: Array) -> float:
    """Return by what a tolerance relative to a state's largest number is too loose for the others.

    In whole decades, as Taylor series of each order are compiled once; below ten it is the slack that common motions
    have.

    Examples
    --------
    >>> size_of(np.array([0.1, -3.0])), size_of(np.array([0.1, 1.0]), np.array([-2e4]))
    (1.0, 100000.0)
    """
    largest = max(float(np.abs(y).max(initial=0.0)) for y in states)
    return float(10.0 ** np.ceil(np.log10(largest))) if largest > _COMMON else 1.0
