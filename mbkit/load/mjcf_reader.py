"""The tree of an MJCF: bodies, joints and sites, with defaults and frames resolved."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.load.mjcf_attributes import HERE, Compiler, Defaults, Pose, has_length, pose
from mbkit.load.mjcf_mass import body_lump, counts
from mbkit.load.shapes import NOTHING, Lump
from mbkit.load.xml_reader import Element, Reader

KINDS: Final = {"hinge": "revolute", "slide": "prismatic", "ball": "ball", "free": "free"}
_NAMED: Final = {"body": "body", "joint": "joint", "freejoint": "joint", "site": "site"}


@dataclass
class MjcfJoint:
    """A joint as the file has it; anchor and axis are in the body's axes."""

    name: str
    element: Element  # with the defaults of its class
    kind: str  # hinge, slide, ball or free
    anchor: Array
    axis: Array
    ref: float  # its coordinate in the pose of the file, rad or m


@dataclass
class MjcfBody:
    """A body as the file has it."""

    name: str
    parent: str
    pose: Pose  # in the parent's axes, with the <frame> elements around it
    joints: list[MjcfJoint]
    lump: Lump  # in its own axes; nothing while `Scene.inferred` has the body
    sites: list[tuple[str, Pose]]

    @property
    def anchor(self) -> Array:
        """Origin of the `Model`'s body in the file's body."""
        return self.joints[-1].anchor if self.joints else np.zeros(3)


@dataclass
class Scene:
    """The state of the walk over the tree."""

    compiler: Compiler
    defaults: Defaults
    read: Reader
    bodies: list[MjcfBody] = field(default_factory=list)
    names: dict[str, set[str]] = field(default_factory=lambda: {"body": {"world"}, "joint": set(), "site": set()})
    #: Names of bodies and joints, written or generated, by the element's id.
    called: dict[int, str] = field(default_factory=dict)
    unnamed: Counter[str] = field(default_factory=Counter)
    #: Bodies whose inertia MuJoCo's compiler infers, and the geoms with their meshes that count for it.
    inferred: dict[str, list[tuple[Element, str]]] = field(default_factory=dict)
    #: Settings of the compiler that changed a mass or inertia, and the bodies.
    bounded: dict[str, list[str]] = field(default_factory=dict)
    #: Parts of the motion that a `Model` does not hold.
    left_out: Counter[str] = field(default_factory=Counter)

    def collect_names(self, world: Element) -> None:
        """Collect all names of the file, so that generated ones differ."""
        for element in world.walk():
            kind, name = _NAMED.get(element.tag), element.attributes.get("name", "")
            if kind and name in self.names[kind]:
                why = "that name is the ground's" if name == "world" else "declared more than once"
                self.read.fault(f"{kind} {name!r}: {why}; names must differ", element)
            if kind and name:
                self.names[kind].add(name)

    def name(self, element: Element, kind: str, fallback: str) -> str:
        """Return the element's name, or a generated one."""
        name = element.attributes.get("name", "")
        if not name:
            self.unnamed[kind] += 1
            name = self.unused(kind, fallback)
        self.called[id(element)] = name
        return name

    def unused(self, kind: str, name: str) -> str:
        """Reserve and return this name, or a longer one that is free."""
        while name in self.names[kind]:
            name += "_"
        self.names[kind].add(name)
        return name


def unfolded(
    owner: Element, X: Pose, childclass: str | None, scene: Scene, item: str
) -> Iterator[tuple[Element, Pose, str | None]]:
    """Yield the children of a body, with those of its <frame> elements, their pose and their class."""
    for child in owner.children:
        if child.tag != "frame":
            yield child, X, childclass
            continue
        # MuJoCo takes a frame's class for its childclass.
        own = child.attributes.get("childclass", child.attributes.get("class"))
        inner = scene.defaults.known(own, child) or childclass
        yield from unfolded(child, X @ pose(child, scene.compiler, scene.read, item), inner, scene, item)


def walk(element: Element, parent: str, X: Pose, childclass: str | None, scene: Scene) -> None:
    """Read a body and everything below it into the scene."""
    name = scene.name(element, "body", f"body{len(scene.bodies) + 1}")
    item = f"body {name!r}"
    read, compiler = scene.read, scene.compiler
    childclass = scene.defaults.known(element.attributes.get("childclass"), element) or childclass
    own = pose(element, compiler, read, item)
    if read.number(element, "gravcomp", item, 0.0):
        scene.left_out["gravity compensation"] += 1
    if element.attributes.get("mocap") == "true":
        scene.left_out["motion capture"] += 1
    parts = list(unfolded(element, HERE, childclass, scene, item))
    joints = [_joint(e, name, Y, c, scene) for e, Y, c in parts if e.tag in ("joint", "freejoint")]
    _check_joints(joints, parent, item, read)
    inertials = [(e, Y) for e, Y, _ in parts if e.tag == "inertial"]
    geoms = [(e, scene.defaults.filled(e, c), Y) for e, Y, c in parts if e.tag == "geom"]
    geoms = [(e, full, Y) for e, full, Y in geoms if counts(full, compiler, read, item)]
    lump, changed = body_lump(inertials, [(full, Y) for _, full, Y in geoms], own.p, compiler, read, item)
    if lump is None:
        scene.inferred[name] = [(e, full.attributes.get("mesh", "")) for e, full, _ in geoms]
    for setting in changed:
        scene.bounded.setdefault(setting, []).append(name)
    body = MjcfBody(name, parent, X @ own, joints, lump or NOTHING, [])
    scene.bodies.append(body)
    for e, Y, c in parts:
        if e.tag == "site":
            site = scene.defaults.filled(e, c)
            if e.attributes.get("name") and "fromto" not in site.attributes:
                body.sites.append((e.attributes["name"], Y @ pose(site, compiler, read, f"site in {item}")))
        elif e.tag == "body":
            walk(e, name, Y, c, scene)
        elif e.tag == "plugin":
            scene.left_out["plugin"] += 1


def _joint(element: Element, body: str, X: Pose, childclass: str | None, scene: Scene) -> MjcfJoint:
    read = scene.read
    free = element.tag == "freejoint"
    full = element if free else scene.defaults.filled(element, childclass)
    name = scene.name(element, "joint", f"{body}_joint")
    item = f"joint {name!r}"
    type_ = "free" if free else full.attributes.get("type", "hinge")
    if type_ not in KINDS:
        read.fault(f"{item}: type {type_[:40]!r}; expected one of {', '.join(KINDS)}", element)
        type_ = "hinge"
    if free and element.attributes.get("align") == "true":
        read.fault(f"{item}: align moves the body's frame; set it to false", element)
    anchor, axis, ref = np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0
    if type_ != "free":
        anchor = X.p + X.R @ np.array(read.numbers(full, "pos", item, count=3, default=(0, 0, 0)))
    if type_ in ("hinge", "slide"):
        axis = np.array(read.numbers(full, "axis", item, count=3, default=(0, 0, 1)))
        if not has_length(axis):
            read.fault(f"{item}: axis is zero; expected a direction, such as 0 0 1", element)
            axis = np.array([0.0, 0.0, 1.0])
        axis = X.R @ axis
        ref = read.number(full, "ref", item, 0.0) * (scene.compiler.angle if type_ == "hinge" else 1.0)
    return MjcfJoint(name, full, type_, anchor, axis, ref)


def _check_joints(joints: list[MjcfJoint], parent: str, item: str, read: Reader) -> None:
    kinds = [j.kind for j in joints]
    if "free" in kinds and len(kinds) > 1:
        read.fault(f"{item}: a free joint and others; a free body has no other joint")
    if "free" in kinds and parent != "world":
        read.fault(f"{item}: a free joint below {parent!r}; only bodies of the world may be free")
