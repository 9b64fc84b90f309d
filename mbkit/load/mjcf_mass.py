"""Mass and inertia of an MJCF's bodies by MuJoCo's rules: written, or inferred from geoms.

Geoms with a group in ``inertiagrouprange`` and more than 1e-14 kg decide where ``inertiafromgeom`` is "true", or
"auto" without an <inertial>; else the <inertial> does. Then ``boundmass`` and ``boundinertia`` raise smaller
numbers, and ``balanceinertia`` replaces an impossible inertia by a sphere's.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.load.mjcf_attributes import ORIENTATIONS, Compiler, Pose, has_length, pose, z_to
from mbkit.load.shapes import NOTHING, SIZES, Lump, solid, together
from mbkit.load.xml_reader import Element, Reader

# MuJoCo 4.0.0 counts geoms above this mass, in kg.
_LEAST_MASS: Final = 1e-14


def body_lump(
    inertials: list[tuple[Element, Pose]],
    geoms: list[tuple[Element, Pose]],
    place: Array,
    compiler: Compiler,
    read: Reader,
    item: str,
) -> tuple[Lump | None, list[str]]:
    """Return a body's inertia in its own axes, and the settings that changed it; None where it is a mesh's or shell's.

    Elements have their defaults and the pose of their <frame>; geoms are those for which `counts` is true. `place`
    is the body's written position.
    """
    if len(inertials) > 1:
        read.fault(f"{item}: {len(inertials)} <inertial> elements; keep one", inertials[1][0])
    infer = compiler.inertiafromgeom
    if infer or (infer is None and not inertials):
        lumps = [_geom(e, X, compiler, read, item) for e, X in geoms]
        if any(x is None for x in lumps):
            return None, []
        heavy = [x for x in lumps if x and x.mass > _LEAST_MASS]
        if heavy:
            # A flat body's A + B and C differ by rounding.
            return _bounded(together(heavy), compiler, slack=1e-14)
    if not inertials:
        lump, changed = _bounded(NOTHING, compiler)
        # MuJoCo takes that place for the centre of mass in the body.
        return replace(lump, com=place) if changed else lump, changed
    principal, X = _written(*inertials[0], compiler, read, item)
    lump, changed = _bounded(principal, compiler, slack=1e-14 if "fullinertia" in inertials[0][0].attributes else 0.0)
    return lump.moved(X.R, X.p), changed


def _bounded(lump: Lump, compiler: Compiler, slack: float = 0.0) -> tuple[Lump, list[str]]:
    """Return a lump after the compiler's bounds, and the settings that changed it; moments have a relative `slack`."""
    mass, inertia, changed = lump.mass, lump.inertia, list[str]()
    if mass < compiler.boundmass > 0:
        mass = compiler.boundmass
        changed.append("boundmass")
    moments, axes = np.linalg.eigh(inertia)
    if moments[0] < compiler.boundinertia > 0:
        moments = np.maximum(moments, compiler.boundinertia)
        inertia = axes @ np.diag(moments) @ axes.T
        changed.append("boundinertia")
    if compiler.balanceinertia and moments[0] + moments[1] < moments[2] * (1 - slack):
        inertia = float(np.mean(moments)) * np.eye(3)
        changed.append("balanceinertia")
    return (Lump(mass, lump.com, inertia) if changed else lump), changed


def _written(element: Element, X: Pose, compiler: Compiler, read: Reader, item: str) -> tuple[Lump, Pose]:
    """Return an <inertial> about its own centre, and its pose in the body."""
    mass = read.number(element, "mass", item)
    if mass < 0:
        read.fault(f"{item}: mass {mass:g} kg is negative; expected 0 or more", element)
    if "pos" not in element.attributes:
        read.fault(f"{item}: <inertial> has no pos; write the centre of mass", element)
    placed = X @ pose(element, compiler, read, item)
    if "fullinertia" in element.attributes:
        if "diaginertia" in element.attributes or ORIENTATIONS.keys() & element.attributes.keys():
            read.fault(f"{item}: <inertial> has fullinertia and diaginertia or an orientation; keep one", element)
        xx, yy, zz, xy, xz, yz = read.numbers(element, "fullinertia", item, count=6)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    else:
        inertia = np.diag(read.numbers(element, "diaginertia", item, count=3, default=(0, 0, 0)))
    return Lump(mass, np.zeros(3), inertia), placed


def counts(geom: Element, compiler: Compiler, read: Reader, item: str) -> bool:
    """Return whether a geom, with its defaults filled in, may give its body mass."""
    first, last = compiler.groups
    # A number that cannot be read is a fault where it is used.
    amount = Reader().number(geom, "mass" if "mass" in geom.attributes else "density", item, 1000.0)
    inside = first <= read.number(geom, "group", item, 0.0) <= last
    return inside and amount != 0 and geom.attributes.get("type", "sphere") not in ("plane", "hfield")


def _geom(element: Element, X: Pose, compiler: Compiler, read: Reader, item: str) -> Lump | None:
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
    lump, placed = solid(shape, size), X @ own_pose
    return lump.scaled(amount / lump.mass if "mass" in own else amount).moved(placed.R, placed.p)


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
        half = float(np.linalg.norm(along)) / 2
        size = (size[0], half) if needed == 2 else (size[0], size[0], half)
        placed = Pose(z_to(along), (ends[:3] + ends[3:]) / 2)
    if min(size) <= 0:
        listing = " ".join(f"{x:g}" for x in size)
        read.fault(f"{item}: a {shape} of size {listing}; expected sizes above 0", element)
    return size, placed
