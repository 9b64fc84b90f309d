"""A body's mass and inertia in MJCF: written, or inferred from its geoms."""

from __future__ import annotations

import numpy as np

from mbkit.load.attributes import Reader
from mbkit.load.mjcf_values import ORIENTATIONS, Compiler, Pose, has_length, pose, z_to
from mbkit.load.solids import NOTHING, SIZES, Lump, solid, together
from mbkit.load.xml import Element

__all__ = ["body_lump"]


def body_lump(
    inertials: list[tuple[Element, Pose]],
    geoms: list[tuple[Element, Pose]],
    compiler: Compiler,
    read: Reader,
    who: str,
) -> Lump:
    """Return a body's mass, centre of mass and inertia in its own axes.

    Parameters
    ----------
    inertials, geoms : list of (Element, Pose)
        With the pose of the <frame> they stand in; defaults filled in.
    compiler, read, who
        Settings, where faults go, and whom they blame.
    """
    if len(inertials) > 1:
        read.fault(f"{who}: {len(inertials)} <inertial> elements; keep one", inertials[1][0])
    before = len(read.faults)
    if inertials and not (compiler.inertiafromgeom and geoms):
        lump = _written(*inertials[0], compiler, read, who)
    elif compiler.inertiafromgeom is False:
        lump = NOTHING
    else:
        first, last = compiler.groups
        lumps = [
            _geom(e, X, compiler, read, who) for e, X in geoms if first <= read.number(e, "group", who, 0.0) <= last
        ]
        lump = together([x for x in lumps if x.mass]) if any(x.mass for x in lumps) else NOTHING
    if len(read.faults) == before:
        _check_bounds(lump, compiler, read, who)
    return lump


def _written(element: Element, X: Pose, compiler: Compiler, read: Reader, who: str) -> Lump:
    mass = read.number(element, "mass", who)
    if mass < 0:
        read.fault(f"{who}: mass {mass:g} kg is negative; expected 0 or more", element)
    if "pos" not in element.attributes:
        read.fault(f"{who}: <inertial> has no pos; write the centre of mass", element)
    placed = X @ pose(element, compiler, read, who)
    if "fullinertia" in element.attributes:
        if "diaginertia" in element.attributes or ORIENTATIONS.keys() & element.attributes.keys():
            read.fault(f"{who}: <inertial> has fullinertia and diaginertia or an orientation; keep one", element)
        xx, yy, zz, xy, xz, yz = read.numbers(element, "fullinertia", who, count=6)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    else:
        inertia = np.diag(read.numbers(element, "diaginertia", who, count=3, default=(0, 0, 0)))
    return Lump(mass, np.zeros(3), inertia).moved(placed.R, placed.p)


def _geom(element: Element, X: Pose, compiler: Compiler, read: Reader, who: str) -> Lump:
    given = element.attributes
    density = read.number(element, "density", who, 1000.0)
    mass = read.number(element, "mass", who, -1.0)
    if density < 0 or ("mass" in given and mass < 0):
        read.fault(f"{who}: a geom's mass or density is negative; expected 0 or more", element)
        return NOTHING
    shape = given.get("type", "sphere")
    if mass == 0 or (density == 0 and "mass" not in given) or shape in ("plane", "hfield"):
        return NOTHING
    if shape in ("mesh", "sdf") or "mesh" in given:
        read.fault(f"{who}: its inertia would come from a mesh, and meshes are not opened; add <inertial>", element)
        return NOTHING
    if shape not in SIZES:
        read.fault(f"{who}: geom type {shape[:40]!r}; expected one of {', '.join(SIZES)}", element)
        return NOTHING
    if given.get("shellinertia", "false") != "false":
        read.fault(f"{who}: the inertia of a shell is not read; add <inertial>", element)
        return NOTHING
    before = len(read.faults)
    size, placed = _sized(element, shape, compiler, read, who)
    if len(read.faults) > before:
        return NOTHING
    lump = solid(shape, size)
    return lump.scaled(mass / lump.mass if "mass" in given else density).moved((X @ placed).R, (X @ placed).p)


def _sized(element: Element, shape: str, compiler: Compiler, read: Reader, who: str) -> tuple[tuple[float, ...], Pose]:
    """Return the sizes of a geom and its pose; two end points may give length and pose."""
    needed = SIZES[shape]
    if "fromto" not in element.attributes:
        size = read.numbers(element, "size", who, count=3, least=needed)[:needed]
        placed = pose(element, compiler, read, who)
    else:
        ends = np.array(read.numbers(element, "fromto", who, count=6))
        size = read.numbers(element, "size", who, count=3, least=1)
        if shape == "sphere":
            read.fault(f"{who}: a sphere has no fromto; use pos", element)
        if "pos" in element.attributes:
            read.fault(f"{who}: a geom has pos and fromto; keep one", element)
        along = ends[3:] - ends[:3]
        if not has_length(along):
            read.fault(f"{who}: a geom's fromto has no length", element)
            return size, Pose(np.eye(3), ends[:3])
        half = float(np.linalg.norm(along)) / 2
        size = (size[0], half) if needed == 2 else (size[0], size[0], half)
        placed = Pose(z_to(along), (ends[:3] + ends[3:]) / 2)
    if min(size) <= 0:
        told = " ".join(f"{x:g}" for x in size)
        read.fault(f"{who}: a {shape} of size {told}; expected sizes above 0", element)
    return size, placed


def _check_bounds(lump: Lump, compiler: Compiler, read: Reader, who: str) -> None:
    """Name the bodies that boundmass or boundinertia would change; nothing is changed here."""
    if lump.mass < compiler.boundmass:
        read.fault(f"{who}: compiler boundmass would raise its mass {lump.mass:g} kg; write the mass you mean")
    smallest = float(np.linalg.eigvalsh(lump.inertia)[0])
    if compiler.boundinertia > 0 and smallest < compiler.boundinertia:
        read.fault(f"{who}: compiler boundinertia would raise its inertia {smallest:g} kg m²; write what you mean")
