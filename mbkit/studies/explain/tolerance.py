"""When two numbers of a description are the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbkit._check import Array
from mbkit.load.shapes import Lump
from mbkit.model import Model

__all__ = ["Near"]


@dataclass(frozen=True)
class Near:
    """Compares parts of descriptions, to a relative tolerance.

    Attributes
    ----------
    tolerance : float
    length : float
        Size of the robot, m: what a coordinate that should be zero is measured by.
    """

    tolerance: float
    length: float

    @classmethod
    def of(cls, model: Model, tolerance: float) -> Near:
        """Take the size from the distances between joints and centres of mass."""
        far = [
            float(np.linalg.norm(x)) for x in (*(j.translation for j in model.joints), *(b.com for b in model.bodies))
        ]
        return cls(tolerance, max([1e-3, *far]))

    def number(self, a: float, b: float) -> bool:
        """Return whether two numbers are the same."""
        # An infinite limit is equal to itself, and to no other.
        size = max(abs(a), abs(b))
        return a == b or (size < np.inf and abs(a - b) <= self.tolerance * size)

    def numbers(self, a: Array, b: Array) -> bool:
        """Return whether all numbers of two vectors are the same."""
        return a.shape == b.shape and all(map(self.number, a.tolist(), b.tolist()))

    def vector(self, a: Array, b: Array, scale: float = 1.0) -> bool:
        """Return whether two vectors or matrices are the same, as a whole."""
        return a.shape == b.shape and bool(np.abs(a - b).max(initial=0.0) <= self.tolerance * scale)

    def point(self, a: Array, b: Array) -> bool:
        """Return whether two points are the same."""
        return self.vector(a, b, self.length)

    def inertia(self, a: Array, b: Array, mass: float) -> bool:
        """Return whether two inertias of bodies of this mass are the same."""
        # Moving an inertia from one point to another rounds as m l².
        floor = 1e-3 * mass * self.length**2 * self.tolerance
        return bool(np.abs(a - b).max() <= self.tolerance * np.abs(a).max() + floor)

    def lump(self, a: Lump, b: Lump) -> bool:
        """Return whether mass, centre of mass and inertia are the same."""
        com = self.point(a.com, b.com) or not (a.mass or b.mass)
        return self.number(a.mass, b.mass) and com and self.inertia(a.inertia, b.inertia, a.mass)
