"""A description whose base stands still, written so that parsers can let it go."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

from mbkit.load.attributes import Reader
from mbkit.load.xml import Element

__all__ = ["BASE_JOINT", "floated", "with_base"]

#: The joint on which a floating base moves.
BASE_JOINT: Final = "root_joint"
#: What a base link called "world" is called then: the ground has that name.
_BASE_LINK: Final = "world_link"
_JOINTS: Final = ("joint", "freejoint")


def floated(mujoco: Element, read: Reader) -> Element:
    """Return a <mujoco> element with a free joint for the one body that stands in the world.

    Where that cannot be, a fault is kept and the element is returned as it is.
    """
    tops = [b for world in mujoco.all("worldbody") for b in _parts(world, ("body",))]
    if not tops:
        return mujoco
    joints = [sum(1 for _ in _parts(b, _JOINTS)) for b in tops]
    if len(tops) != 1 or joints[0]:
        told = ", ".join(f"{_called(b)} ({n} joints)" for b, n in zip(tops, joints, strict=True))
        read.fault(f"floating_base=True needs one body of the world, without joints; there are: {told}")
        return mujoco
    if any(e.tag in _JOINTS and e.attributes.get("name") == BASE_JOINT for e in mujoco.walk()):
        read.fault(f"joint {BASE_JOINT!r}: floating_base=True adds a joint of that name; rename yours")
        return mujoco
    joint = Element("freejoint", {"name": BASE_JOINT}, tops[0].line, file=tops[0].file)
    return _replaced(mujoco, tops[0], replace(tops[0], children=[joint, *tops[0].children]))


def with_base(robot: Element) -> tuple[Element, str]:
    """Return a <robot> element whose base link is not called ``world``, and what that is called instead.

    Parsers take a link of that name for the ground. The name is empty where nothing had to be done.
    """
    joints = robot.all("joint")
    links = {e.attributes.get("name") for e in robot.all("link")}
    if "world" not in links or any(e.attributes.get("link") == "world" for j in joints for e in j.all("child")):
        return robot, ""
    name = _BASE_LINK
    while name in links:
        name += "_"

    def called(element: Element, attribute: str) -> Element:
        if element.attributes.get(attribute) != "world":
            return element
        return replace(element, attributes={**element.attributes, attribute: name})

    def child(element: Element) -> Element:
        if element.tag == "link":
            return called(element, "name")
        if element.tag != "joint":
            return element
        return replace(element, children=[called(e, "link") if e.tag == "parent" else e for e in element.children])

    return replace(robot, children=[child(e) for e in robot.children]), name


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
