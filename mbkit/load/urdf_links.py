"""A URDF link by link, without an engine's parser: the measure of importers; and floating bases for parsers.

By the URDF specification a joint's frame is its child link's, an inertia is about the centre of mass in the axes of
its origin, rpy are turns about fixed x, y and z, and a missing axis is x.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.load import xml_reader
from mbkit.load.urdf import Snapper
from mbkit.load.urdf_check import examine, unbounded
from mbkit.load.xml_reader import Element, Reader
from mbkit.model import Mimic, Model, ModelBuilder

#: The joint on which a floating base moves.
BASE_JOINT: Final = "root_joint"
#: Replaces the name "world" of a base link: the ground has that name.
_BASE_LINK: Final = "world_link"
_JOINTS: Final = ("joint", "freejoint")


def floated(mujoco: Element, read: Reader) -> Element:
    """Return a <mujoco> element with a free joint for the world's only body, or keep a fault."""
    tops = [b for world in mujoco.all("worldbody") for b in _parts(world, ("body",))]
    if not tops:
        return mujoco
    joints = [sum(1 for _ in _parts(b, _JOINTS)) for b in tops]
    if len(tops) != 1 or joints[0]:
        listing = ", ".join(f"{_called(b)} ({n} joints)" for b, n in zip(tops, joints, strict=True))
        read.fault(f"floating_base=True needs one body of the world, without joints; there are: {listing}")
        return mujoco
    if any(e.tag in _JOINTS and e.attributes.get("name") == BASE_JOINT for e in mujoco.walk()):
        read.fault(f"joint {BASE_JOINT!r}: floating_base=True adds a joint of that name; rename yours")
        return mujoco
    joint = Element("freejoint", {"name": BASE_JOINT}, tops[0].line, file=tops[0].file)
    return _replaced(mujoco, tops[0], replace(tops[0], children=[joint, *tops[0].children]))


def with_base(robot: Element) -> tuple[Element, str]:
    """Return a <robot> whose base link is not called ``world``, the ground's name for parsers, and any new name."""
    joints = robot.all("joint")
    links = {e.attributes.get("name") for e in robot.all("link")}
    if "world" not in links or any(e.attributes.get("link") == "world" for j in joints for e in j.all("child")):
        return robot, ""
    name = _BASE_LINK
    while name in links:
        name += "_"

    def renamed(element: Element) -> Element:
        attribute = {"link": "name", "parent": "link"}.get(element.tag, "")
        if element.attributes.get(attribute) == "world":
            return replace(element, attributes={**element.attributes, attribute: name})
        if element.tag != "joint":
            return element
        return replace(element, children=[renamed(e) for e in element.children])

    return replace(robot, children=[renamed(e) for e in robot.children]), name


def _parts(owner: Element, tags: tuple[str, ...]) -> Iterator[Element]:
    """Yield the children of these tags, with those of <frame> elements."""
    for child in owner.children:
        if child.tag == "frame":
            yield from _parts(child, tags)
        elif child.tag in tags:
            yield child


def _called(body: Element) -> str:
    name = body.attributes.get("name", "")
    return repr(name) if name else f"one without a name, {body.place}"


def _replaced(owner: Element, old: Element, new: Element) -> Element:
    if owner is old:
        return new
    if owner.tag not in ("mujoco", "worldbody", "frame"):
        return owner
    return replace(owner, children=[_replaced(c, old, new) for c in owner.children])


def urdf_links(root: Element, source: str, *, floating_base: bool = False) -> Model:
    """Return the model of a <robot> element with one body for each link, or raise `ModelError`.

    The root link is fixed to the world or floats; a root link called ``world`` is the world.
    """
    urdf = examine(root, source, floating_base=floating_base, mimic_matters=False, lenient=True)
    # The checked text has known elements alone.
    robot = xml_reader.parse(urdf.text.encode(), source)
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
    name, kind = joint.attributes["name"], joint.attributes["type"].replace("floating", "free")
    R, p = _pose(joint, snap)
    parent, child = (e.attributes["link"] for tag in ("parent", "child") for e in joint.all(tag))
    values: dict[str, Any] = {}
    limit, dynamics = joint.first("limit"), joint.first("dynamics")
    if kind in ("revolute", "continuous", "prismatic"):
        values["axis"] = _numbers(joint.first("axis"), "xyz", "1 0 0")
        values["damping"] = _numbers(dynamics, "damping", "0")
        values["friction"] = _numbers(dynamics, "friction", "0")
        values["mimic"] = mimics[name]
        for ours, theirs in (("velocity_limit", "velocity"), ("effort_limit", "effort")):
            if limit is not None and theirs in limit.attributes:
                values[ours] = unbounded(float(limit.attributes[theirs]))
        if limit is not None and kind != "continuous":
            values |= {x: unbounded(float(limit.attributes.get(x, 0))) for x in ("lower", "upper")}
    b.add_joint(name, kind, parent=parent, child=child, translation=p, rotation=R, **values)


def read_links(path: Path) -> Model:
    """Return `urdf_links` of a file."""
    return urdf_links(xml_reader.read(path), str(path))
