"""Mass and inertia of MuJoCo's solid shapes, of several together, and of the geoms of an MJCF."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit._reproducible import length, product, turned
from mbkit.load.mjcf_attributes import Compiler, Pose, has_length, pose, z_to
from mbkit.load.xml_reader import Element, Reader
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


# Geoms of an MJCF


def counts(geom: Element, compiler: Compiler, read: Reader, item: str) -> bool:
    """Return whether a geom, with its defaults filled in, may give its body mass."""
    first, last = compiler.groups
    # A number that cannot be read is a fault where it is used.
    amount = Reader().number(geom, "mass" if "mass" in geom.attributes else "density", item, 1000.0)
    inside = first <= read.number(geom, "group", item, 0.0) <= last
    return inside and amount != 0 and geom.attributes.get("type", "sphere") not in ("plane", "hfield")


def mass_properties_of(element: Element, X: Pose, compiler: Compiler, read: Reader, item: str) -> MassProperties | None:
    """Return what a geom adds to its body; None for a mesh or a shell."""
    own = element.attributes
    amount = read.number(element, "mass" if "mass" in own else "density", item, 1000.0)
    if amount < 0:
        read.fault(f"{item}: a geom's mass or density is negative; expected 0 or more", element)
        return NOTHING
    shape = own.get("type", "sphere")
    if shape in ("mesh", "sdf") or "mesh" in own or own.get("shellinertia", "false") != "false":
        return None
    if shape not in SIZES:
        read.fault(f"{item}: geom type {shape[:40]!r}; expected one of {', '.join((*SIZES, 'mesh'))}", element)
        return NOTHING
    before = len(read.faults)
    size, own_pose = _sized(element, shape, compiler, read, item)
    if len(read.faults) > before:
        return NOTHING
    mass_properties, placed = solid(shape, size), X @ own_pose
    return mass_properties.scaled(amount / mass_properties.mass if "mass" in own else amount).moved(placed.R, placed.p)


def _sized(element: Element, shape: str, compiler: Compiler, read: Reader, item: str) -> tuple[tuple[float, ...], Pose]:
    """Return the sizes of a geom and its pose; two end points may stand for length and pose."""
    needed = SIZES[shape]
    if "fromto" not in element.attributes:
        size = read.numbers(element, "size", item, count=3, least=needed)[:needed]
        placed = pose(element, compiler, read, item)
    else:
        ends = np.array(read.numbers(element, "fromto", item, count=6))
        size = read.numbers(element, "size", item, count=3, least=1)
        if shape == "sphere":
            read.fault(f"{item}: a sphere has no fromto; use pos", element)
        if "pos" in element.attributes:
            read.fault(f"{item}: a geom has pos and fromto; keep one", element)
        along = ends[3:] - ends[:3]
        if not has_length(along):
            read.fault(f"{item}: a geom's fromto has no length", element)
            return size, Pose(np.eye(3), ends[:3])
        half = length(along) / 2
        size = (size[0], half) if needed == 2 else (size[0], size[0], half)
        placed = Pose(z_to(along), (ends[:3] + ends[3:]) / 2)
    if min(size) <= 0:
        listing = " ".join(f"{x:g}" for x in size)
        read.fault(f"{item}: a {shape} of size {listing}; expected sizes above 0", element)
    return size, placed
