"""A URDF link by link, without an engine's parser: the measure of importers; and floating bases for parsers.

By the URDF specification a joint's frame is its child link's, an inertia is about the centre of mass in the axes of
its origin, rpy are turns about fixed x, y and z, and a missing axis is x.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from mbkit import spatial
from mbkit.load import xml_reader
from mbkit.load.urdf import Snapper
from mbkit.load.urdf_check import examine
from mbkit.load.xml_reader import Element, Reader, unused
from mbkit.model import Model, ModelBuilder, kind_of

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
    name = unused(_BASE_LINK, links)

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
    snap, b = Snapper(), ModelBuilder(urdf.name)
    for link in (x for x in urdf.links if x.name != "world"):
        if link.inertia is None:
            b.add_body(link.name)
            continue
        R, I = snap(spatial.matrix_from_rpy(*link.rpy)), link.inertia
        turned = I if np.array_equal(R, np.eye(3)) else R @ I @ R.T
        b.add_body(link.name, mass=link.mass, com=link.com, inertia=0.5 * (turned + turned.T))
    if floating_base:
        b.add_joint(BASE_JOINT, "free", parent="world", child=urdf.root)
    elif urdf.root != "world":
        name = unused(f"world_to_{urdf.root}", {j.name for j in urdf.joints})
        b.add_joint(name, "fixed", parent="world", child=urdf.root)
    for j in urdf.joints:
        numbers = {**j.numbers, "mimic": j.mimic} if kind_of(j.kind).nv == 1 else {}
        R = snap(spatial.matrix_from_rpy(*j.rpy))
        b.add_joint(j.name, j.kind, parent=j.parent, child=j.child, translation=j.translation, rotation=R, **numbers)
    for note in urdf.notes:
        b.note(note)
    return b.build(nonphysical="warn", point_masses=False)


def read_links(path: Path) -> Model:
    """Return `urdf_links` of a file."""
    return urdf_links(xml_reader.read(path), str(path))
