"""Zeros and ones that rounding has blurred, set right once, when a file is loaded.

A rotation by exactly half a turn, written 3.141592653589793, becomes a matrix with
6e-17 where there should be 0. Such an entry stops a term from vanishing while the
expressions are derived. Only entries within a few units in the last place of 0, 1 or
-1 are touched: 1.5708 for a quarter turn gives -3.67e-6, and that stays as written.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import Array

__all__ = ["Snapper"]

# A rotation matrix made by way of a quaternion is off by up to about 5 eps.
_REACH: Final = 8 * float(np.finfo(float).eps)


class Snapper:
    """Snaps entries of rotations and axes, and counts what it did.

    Parameters
    ----------
    reach : float
        How near to 0, 1 or -1 an entry is set to it; by default what rounding does.

    Attributes
    ----------
    count : int
        Entries changed so far.
    largest : float
        The largest change.
    """

    def __init__(self, reach: float = _REACH) -> None:
        self._reach = reach
        self.count = 0
        self.largest = 0.0

    def __call__(self, entries: Array) -> Array:
        """Return the entries of a rotation matrix or a unit vector, snapped."""
        out = np.where(np.abs(entries) <= self._reach, 0.0, entries)
        # A one is set right only where it stands alone: beside an angle of 4e-8,
        # whose cosine is 1 - 8e-16, it would spoil the unit length.
        alone = np.ones(out.shape, dtype=bool)
        for axis in range(out.ndim):
            alone &= np.count_nonzero(out, axis=axis, keepdims=True) == 1
        near_one = alone & (np.abs(np.abs(out) - 1) <= self._reach)
        out = np.where(near_one, np.sign(out), out)
        change = np.abs(out - entries)
        self.count += int(np.count_nonzero(change))
        self.largest = max(self.largest, float(change.max()))
        return out

    @property
    def note(self) -> str | None:
        """What was done, in one sentence, or None."""
        if not self.count:
            return None
        return (
            f"{self.count} entries of rotations and axes within {self._reach:.1e} of 0, 1 or -1 were set to it; "
            f"the largest change was {self.largest:.1e}"
        )
