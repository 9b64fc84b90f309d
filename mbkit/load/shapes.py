"""Mass and inertia of MuJoCo's solid shapes, and of several together."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit._reproducible import product, turned
from mbkit.spatial import skew

# Number of sizes of each shape: half lengths and radii.
SIZES: Final = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}


@dataclass(frozen=True)
class MassProperties:
    """Mass, centre of mass, and inertia about it, in some common axes."""

    mass: float
    com: Array
    inertia: Array

    def moved(self, R: Array, p: Array) -> MassProperties:
        """Return the same mass properties in another frame, in which this one has the pose R, p."""
        return MassProperties(self.mass, p + product(R, self.com), turned(R, self.inertia))

    def scaled(self, factor: float) -> MassProperties:
        """Return the same shape with `factor` times the density."""
        return MassProperties(factor * self.mass, self.com, factor * self.inertia)


NOTHING: Final = MassProperties(0.0, np.zeros(3), np.zeros((3, 3)))


def solid(shape: str, size: tuple[float, ...]) -> MassProperties:
    """Return a shape of density 1 kg/m³ about its centre; half lengths and radii as in MuJoCo, the long axis is z."""
    if shape in ("box", "ellipsoid"):
        a, b, c = size
        mass, n = (8 * a * b * c, 3) if shape == "box" else (4 / 3 * pi * a * b * c, 5)
        moments = [(b * b + c * c) / n, (a * a + c * c) / n, (a * a + b * b) / n]
    elif shape == "sphere":
        (r,) = size
        mass = 4 / 3 * pi * r**3
        moments = [2 / 5 * r * r] * 3
    elif shape == "cylinder":
        r, h = size
        mass = 2 * pi * r * r * h
        moments = [r * r / 4 + h * h / 3] * 2 + [r * r / 2]
    else:
        # A cylinder and two half spheres, whose own centres stand 3/8 r beyond its ends.
        r, h = size
        tube, ball = 2 * pi * r * r * h, 4 / 3 * pi * r**3
        along = tube * r * r / 2 + ball * 2 / 5 * r * r
        across = tube * (r * r / 4 + h * h / 3) + ball * (2 / 5 * r * r + h * h + 3 / 4 * r * h)
        return MassProperties(tube + ball, np.zeros(3), np.diag([across, across, along]))
    return MassProperties(mass, np.zeros(3), mass * np.diag(moments))


def together(masses: list[MassProperties]) -> MassProperties:
    """Return the mass properties of several of positive mass, in the same axes, as one."""
    if len(masses) == 1:
        return masses[0]
    mass = sum(x.mass for x in masses)
    com = sum((x.mass * x.com for x in masses), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for x in masses:
        d = skew(x.com - com)
        inertia += x.inertia - x.mass * product(d, d)
    return MassProperties(mass, com, inertia)
