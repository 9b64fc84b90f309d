"""A URDF link by link, as it is written: no engine's parser, nothing fused, nothing left out.

What importers make of a file is measured by this reading. It knows the URDF specification alone:
a joint's frame is its child link's, an inertia is about the centre of mass in the axes of its
origin, rpy are turns about fixed x, y and z, and a missing axis is x.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.load import xml
from mbkit.load.floating import BASE_JOINT
from mbkit.load.snap import Snapper
from mbkit.load.urdf_file import examine, unbounded
from mbkit.load.xml import Element
from mbkit.model import Mimic, Model, ModelBuilder

__all__ = ["urdf_links"]

_KINDS: Final = {"floating": "free"}
_SINGLE: Final = ("revolute", "continuous", "prismatic")


def urdf_links(root: Element, source: str, *, floating_base: bool = False) -> Model:
    """Return the description that a <robot> element is, one body for each link.

    The root link stands in the world, or floats there; or it is called ``world``, and is the world then.

    Raises
    ------
    ModelError
        The file has faults; all of them are listed.
    """
    urdf = examine(root, source, floating_base=floating_base, mimic_matters=False, lenient=True)
    # What was examined is clean XML of known elements.
    robot = xml.parse(urdf.text.encode(), source)
    snap = Snapper()
    b = ModelBuilder(urdf.name)
    for link in robot.all("link"):
        if link.attributes["name"] != "world":
            _add_link(b, link, snap)
    base = urdf.root
    if floating_base:
        b.add_joint(BASE_JOINT, "free", parent="world", child=base)
    elif base != "world":
        names = {j.name for j in urdf.joints}
        name = f"world_to_{base}"
        while name in names:
            name += "_"
        b.add_joint(name, "fixed", parent="world", child=base)
    mimics = {j.name: j.mimic for j in urdf.joints}
    for joint in robot.all("joint"):
        _add_joint(b, joint, mimics, snap)
    for note in urdf.notes:
        b.note(note)
    return b.build(nonphysical="warn", point_masses=False)


def _numbers(element: Element | None, attribute: str, default: str) -> Array:
    text = default if element is None else element.attributes.get(attribute, default)
    return np.array([float(x) for x in text.split()])


def _pose(owner: Element, snap: Snapper) -> tuple[Array, Array]:
    origin = owner.first("origin")
    rpy = _numbers(origin, "rpy", "0 0 0")
    return snap(spatial.matrix_from_rpy(*rpy)), _numbers(origin, "xyz", "0 0 0")


def _add_link(b: ModelBuilder, link: Element, snap: Snapper) -> None:
    name = link.attributes["name"]
    inertial = link.first("inertial")
    if inertial is None:
        b.add_body(name)
        return
    R, p = _pose(inertial, snap)
    mass, moments = inertial.first("mass"), inertial.first("inertia")
    xx, xy, xz, yy, yz, zz = (float(_numbers(moments, f"i{k}", "0")[0]) for k in ("xx", "xy", "xz", "yy", "yz", "zz"))
    I = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    turned = I if np.array_equal(R, np.eye(3)) else R @ I @ R.T
    b.add_body(name, mass=float(_numbers(mass, "value", "0")[0]), com=p, inertia=0.5 * (turned + turned.T))


def _add_joint(b: ModelBuilder, joint: Element, mimics: Mapping[str, Mimic | None], snap: Snapper) -> None:
    name, kind = joint.attributes["name"], _KINDS.get(joint.attributes["type"], joint.attributes["type"])
    R, p = _pose(joint, snap)
    parent, child = (e.attributes["link"] for tag in ("parent", "child") for e in joint.all(tag))
    given: dict[str, Any] = {}
    limit, dynamics = joint.first("limit"), joint.first("dynamics")
    if kind in _SINGLE:
        given["axis"] = _numbers(joint.first("axis"), "xyz", "1 0 0")
        given["damping"] = float(_numbers(dynamics, "damping", "0")[0])
        given["friction"] = float(_numbers(dynamics, "friction", "0")[0])
        given["mimic"] = mimics[name]
        for ours, theirs in (("velocity_limit", "velocity"), ("effort_limit", "effort")):
            if limit is not None and theirs in limit.attributes:
                given[ours] = unbounded(float(_numbers(limit, theirs, "0")[0]))
        if limit is not None and kind != "continuous":
            given["lower"], given["upper"] = (unbounded(float(_numbers(limit, x, "0")[0])) for x in ("lower", "upper"))
    b.add_joint(name, kind, parent=parent, child=child, translation=p, rotation=R, **given)


def read_links(path: Path) -> Model:
    """Return `urdf_links` of a file."""
    return urdf_links(xml.read(path), str(path))
