"""The tree of an MJCF: bodies with their inertias, joints and sites, with defaults and frames resolved.

Inertia by MuJoCo's rules: geoms with a group in ``inertiagrouprange`` and more than 1e-14 kg decide where
``inertiafromgeom`` is "true", or "auto" without an <inertial>; else the <inertial> does. Then ``boundmass`` and
``boundinertia`` raise smaller numbers, and ``balanceinertia`` replaces an impossible inertia by a sphere's.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import MappingProxyType
from typing import Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit._reproducible import product, turned
from mbkit.errors import LoadError
from mbkit.load import xml_reader
from mbkit.load.mjcf_attributes import (
    HERE,
    ORIENTATIONS,
    Compiler,
    Defaults,
    Pose,
    about,
    from_euler,
    has_length,
    matrix_of,
    mesh_name,
    pose,
)
from mbkit.load.shapes import NOTHING, MassProperties, counts, mass_properties_of, together
from mbkit.load.urdf_reader import BASE_JOINT
from mbkit.load.xml_reader import MAX_ELEMENTS, Element, Reader, reserved, unused
from mbkit.model.validation import listing

#: MuJoCo's types of joints, in the order of its `mjtJoint`, and the kinds of joints here.
KINDS: Final = {"free": "free", "ball": "ball", "slide": "prismatic", "hinge": "revolute"}
_JOINTS: Final = ("joint", "freejoint")
_NAMED: Final = {"body": "body", "joint": "joint", "freejoint": "joint", "site": "site"}
# MuJoCo 4.0.0 counts geoms above this mass, in kg.
_MIN_GEOM_MASS: Final = 1e-14


@dataclass
class MjcfJoint:
    """A joint as the file has it; anchor and axis are in the body's axes."""

    name: str
    element: Element  # with the defaults of its class
    kind: str  # hinge, slide, ball or free
    anchor: Array = field(default_factory=lambda: np.zeros(3))
    axis: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    ref: float = 0.0  # its coordinate in the pose of the file, rad or m
    rest: float = 0.0  # its coordinate where its spring rests, rad or m

    @property
    def scalar(self) -> bool:
        """Whether it has one coordinate."""
        return self.kind in ("hinge", "slide")

    def at_zero(self, R: Array, p: Array, axis: Array) -> tuple[Array, Array]:
        """Return its frame at q = 0, where R, p is the one at q = ``ref``, the pose of the file."""
        if not self.ref:
            return R, p
        return (product(R, about(axis, -self.ref)), p) if self.kind == "hinge" else (R, p - product(R, self.ref * axis))


@dataclass
class MjcfBody:
    """A body as the file has it."""

    name: str
    parent: str
    pose: Pose  # in the parent's axes, with the <frame> elements around it
    joints: list[MjcfJoint]
    mass_properties: MassProperties  # in its own axes; nothing while `Scene.inferred` has the body
    sites: list[tuple[str, Pose]] = field(default_factory=list)
    gravcomp: float = 0.0  # share of its weight that is held

    @property
    def anchor(self) -> Array:
        """Origin of the `Model`'s body in the file's body."""
        return self.joints[-1].anchor if self.joints else np.zeros(3)

    def chain(
        self, anchor: Array, unused: Callable[[str, str], str]
    ) -> Iterator[tuple[MjcfJoint | None, str, str, Array, Array]]:
        """Yield each joint with its parent, its child and its frame; None is a fixed joint.

        Massless bodies stand between joints. `anchor` is that of the parent.
        """
        R, p, parent, before = self.pose.R, self.pose.p - anchor, self.parent, np.zeros(3)
        if not self.joints:
            yield None, parent, self.name, R, p
        for joint in self.joints:
            child = self.name if joint is self.joints[-1] else unused("body", f"{self.name}_{joint.name}")
            # The coordinates of a free joint are the pose in the world.
            R, p = (np.eye(3), np.zeros(3)) if joint.kind == "free" else (R, p + product(R, joint.anchor - before))
            yield joint, parent, child, R, p
            R, p, parent, before = np.eye(3), np.zeros(3), child, joint.anchor


@dataclass
class Scene:
    """The state of the walk over the tree."""

    compiler: Compiler
    defaults: Defaults
    read: Reader
    bodies: list[MjcfBody] = field(default_factory=list)
    names: dict[str, set[str]] = field(default_factory=lambda: {"body": {"world"}, "joint": set(), "site": set()})
    #: Names of bodies and joints, written or generated, by the element's id.
    names_of_elements: dict[int, str] = field(default_factory=dict)
    unnamed: Counter[str] = field(default_factory=Counter)
    #: Bodies whose inertia MuJoCo's compiler infers, and the geoms with their meshes that count for it.
    inferred: dict[str, list[tuple[Element, str]]] = field(default_factory=dict)
    #: Settings of the compiler that changed a mass or inertia, and the bodies.
    bounded: dict[str, list[str]] = field(default_factory=dict)
    #: Free bodies whose frame became their inertial frame.
    aligned: list[str] = field(default_factory=list)
    #: Sites of the world.
    sites: list[tuple[str, Pose]] = field(default_factory=list)
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
        self.names_of_elements[id(element)] = name
        return name

    def unused(self, kind: str, name: str) -> str:
        """Reserve and return this name, or a longer one that is free."""
        return reserved(name, self.names[kind])


# Copies

_REPLICATE_ATTRIBUTES: Final = frozenset({"name", "count", "sep", "offset", "euler", "class", "childclass"})
#: Sections whose elements are copied where they name something that is copied.
_SECTIONS_WITH_REFERENCES: Final = ("tendon", "actuator", "equality")
#: Kind of element that an attribute names; a final 1 or 2 is left out.
_REFERENCES: Final = {
    **{kind: kind for kind in ("body", "joint", "site", "geom", "tendon")},
    **dict.fromkeys(("refsite", "sidesite", "cranksite", "slidersite"), "site"),
    "jointinparent": "joint",
}


def write_out_copies(mujoco: Element, compiler: Compiler, read: Reader) -> str:
    """Write the copies of every <replicate> in its place, as MuJoCo 4.0.0 does, and return a note.

    Copy k stands in a <frame> turned by k times the angles, an offset in the axes of the copy before away from it, and
    has the number k behind its names. Tendons, actuators and equalities that name something in it are copied with it.
    """
    copier = _Copier(mujoco, compiler, read)
    for world in mujoco.all("worldbody"):
        copier.size(world)
        # Inner copies are written out first: their numbers stand before the outer ones.
        _replace_all(world, "replicate", copier.copies)
    return f"<replicate> written out: {listing(copier.notes)}" if copier.notes else ""


@dataclass
class _Copier:
    """Writes <replicate> elements out, up to a number of elements."""

    mujoco: Element
    compiler: Compiler
    read: Reader
    notes: list[str] = field(default_factory=list)
    left: int = MAX_ELEMENTS

    def size(self, element: Element) -> int:
        """Return the number of elements once all is written out; after a fault a <replicate> stands for one copy."""
        inside = 1 + sum(map(self.size, element.children))
        if element.tag != "replicate":
            return inside
        count, most = self.read.number(element, "count", "<replicate>", -1.0), self.left // inside
        if 0 <= count <= most and count == int(count):
            self.left -= int(count) * inside
            return int(count) * inside
        got = element.attributes.get("count", "")[:40]
        more = f"expected a whole number up to {most}, as all copies may have {MAX_ELEMENTS:,} elements"
        self.read.fault(f"<replicate>: count {got!r}; {more}", element)
        for one in (e for e in element.walk() if e.tag == "replicate"):
            one.tag, one.attributes = "frame", {}
        return inside

    def copies(self, element: Element) -> Iterable[Element]:
        """Return a <frame> for each copy, and copy what names something in it."""
        item, own, read = "<replicate>", element.attributes, self.read
        for name in own.keys() - _REPLICATE_ATTRIBUTES:
            read.fault(
                f"{item}: unknown attribute {name!r}; there are: {', '.join(sorted(_REPLICATE_ATTRIBUTES))}", element
            )
        for child in element.children:
            if child.tag in (*_JOINTS, "inertial"):
                read.fault(f"{item}: <{child.tag}> is not copied; put it into a <body>", child)
        count = read.number(element, "count", item)
        offset, angles = (
            np.array(read.numbers(element, name, item, count=3, default=(0, 0, 0))) for name in ("offset", "euler")
        )
        p, out = np.zeros(3), dict[str, Element]()
        for k in range(int(count)):
            # MuJoCo multiplies the angles, which is no power of one turn.
            R = from_euler(k * angles, self.compiler)
            suffix = f"{own.get('sep', '')}{k:0{len(str(int(count)))}d}"
            at = {"pos": " ".join(repr(float(x)) for x in p), "quat": _quat(R)}
            at |= {n: own[n] for n in ("class", "childclass") if n in own}
            out[suffix] = replace(_suffixed(element, suffix), tag="frame", attributes=at)
            p = p + product(R, offset)
        self.notes += [f"{len(out)} copies ({element.place})", *_copy_naming(self.mujoco, element, out)]
        return out.values()


def _replace_all(owner: Element, tag: str, parts: Callable[[Element], Iterable[Element]]) -> None:
    """Put its parts in the place of each element of a tag below another one, those inside first."""
    children: list[Element] = []
    for child in owner.children:
        _replace_all(child, tag, parts)
        children += parts(child) if child.tag == tag else [child]
    owner.children = children


def _quat(R: Array) -> str:
    x, y, z, w = spatial.quaternion_from_matrix(R)
    return " ".join(repr(float(c)) for c in (w, x, y, z))


def _suffixed(element: Element, suffix: str, names: Mapping[str, Container[str]] = MappingProxyType({})) -> Element:
    """Return a copy with a suffix behind all names, and behind the names of those to which it refers."""
    own = {
        key: x + suffix if key == "name" or x in names.get(_REFERENCES.get(key.rstrip("12"), ""), ()) else x
        for key, x in element.attributes.items()
    }
    return replace(element, attributes=own, children=[_suffixed(e, suffix, names) for e in element.children])


# Attached models

#: Settings of <compiler> that an attached file must share; orientations and angles are converted.
_SHARED_SETTINGS: Final = [
    "autolimits",
    "inertiafromgeom",
    "groups",
    "balanceinertia",
    "boundmass",
    "boundinertia",
    "alignfree",
]


def write_out_attached(mujoco: Element, path: Path, compiler: Compiler, read: Reader) -> str:
    """Write the parts of other files that <attach> names in its place, as MuJoCo 4.0.0 does, and return a note.

    All names get the prefix. Defaults become a class of their own; meshes, and the tendons, actuators and equalities
    that name attached elements only, are added. Options of the other file do not count.
    """
    attacher, worlds = _Attacher(mujoco, path, compiler, read), mujoco.all("worldbody")
    if any(e.tag == "attach" for world in worlds for e in world.walk()):
        _set_main_apart(mujoco)
    for world in worlds:
        _replace_all(world, "attach", attacher.attached)
    return f"<attach> written out: {listing(attacher.notes)}" if attacher.notes else ""


def _set_main_apart(mujoco: Element) -> None:
    """Move the main default class into one of its own, which reaches all of the file but attached elements."""
    tops = mujoco.all("default")
    inside = [e for top in tops for e in top.children]
    if not any(e.tag != "default" and e.attributes for e in inside):
        return
    name = unused("main_", {e.attributes.get("class") for top in tops for e in top.walk()})
    for section in (e for e in mujoco.children if e not in tops):
        for e in section.walk():
            e.attributes |= {k: name for k in ("class", "childclass") if e.attributes.get(k) == "main"}
        for e in section.children:
            if section.tag in _SECTIONS_WITH_REFERENCES or e.tag in ("mesh", "material"):
                e.attributes.setdefault("class", name)
        if section.tag == "worldbody":
            section.children = [Element("frame", {"childclass": name}, section.line, section.children)]
    tops[0].children = [Element("default", {"class": name}, tops[0].line, inside)]
    for top in tops[1:]:
        top.children = []


@dataclass
class _Other:
    """A file from which something is attached."""

    root: Element
    path: Path
    compiler: Compiler
    defaults: Defaults
    factor: float  # of its angles
    file: str


@dataclass
class _Attacher:
    """Writes <attach> elements out, up to a number of elements."""

    mujoco: Element
    path: Path
    compiler: Compiler
    read: Reader
    notes: list[str] = field(default_factory=list)
    others: dict[str, _Other | None] = field(default_factory=dict)
    added: set[tuple[str, str]] = field(default_factory=set)
    left: int = MAX_ELEMENTS

    def attached(self, element: Element) -> list[Element]:
        """Return the attached elements; none after a fault."""
        own, read = element.attributes, self.read
        model, prefix = (read.name(element, name, "<attach>") for name in ("model", "prefix"))
        if model not in self.others:
            self.others[model] = self._other(model, element)
        if (other := self.others[model]) is None:
            return []
        targets = [(tag, own[tag]) for tag in ("body", "frame") if own.get(tag)]
        worlds = other.root.all("worldbody")
        matches = [x for world in worlds for x in self._found(world, targets, None, other)] if targets else []
        if targets and not matches:
            read.fault(f"<attach>: {targets[0][0]} {targets[0][1]!r} is not in {other.file}", element)
            return []
        parts = matches[:1] or [(x, None) for world in worlds for x in world.children]
        self.left -= sum(1 for part, _ in parts for _ in part.walk())
        if self.left < 0:
            read.fault(f"<attach>: more than {MAX_ELEMENTS} elements; attach less", element)
            return []
        self.notes.append(f"{model!r} as {prefix!r} ({element.place})")
        if (model, prefix) not in self.added:
            self.added.add((model, prefix))
            self._add_shared(prefix, other, element)
        self._add_naming([part for part, _ in parts], prefix, other)
        out = []
        for part, childclass in parts:
            inside = _Prefixed(prefix, other).of(part, childclass)
            frame = {"childclass": prefix + (childclass or "main")}
            out.append(Element("frame", frame, element.line, [inside], file=element.file))
        return out

    def _other(self, model: str, element: Element) -> _Other | None:
        """Read the file of a <model>, or keep a fault."""
        assets = (e for asset in self.mujoco.all("asset") for e in asset.all("model"))
        asset = next((e for e in assets if e.attributes.get("name") == model), None)
        if asset is None:
            self.read.fault(f"<attach>: model {model!r} is no <model> of <asset> by name", element)
            return None
        file = asset.attributes.get("file", "").replace("\\", "/")
        if PurePosixPath(file).is_absolute() or PureWindowsPath(file).drive:
            self.read.fault(
                f"model {model!r}: an absolute path is not followed; write it as seen from this file", asset
            )
            return None
        path = self.path.parent / file
        try:
            root = xml_reader.with_includes(xml_reader.read(path), path)
        except LoadError as error:
            self.read.fault(f"model {model!r}: {error}", asset)
            return None
        if root.tag != "mujoco" or any(e.tag in ("attach", "replicate") for e in root.walk()):
            self.read.fault(f"model {model!r}: expected an MJCF without <attach> and <replicate> of its own", asset)
            return None
        compiler = Compiler.of(root, self.read)
        for name in _SHARED_SETTINGS:
            ours, theirs = getattr(self.compiler, name), getattr(compiler, name)
            if ours != theirs:
                self.read.fault(
                    f"model {model!r}: compiler {name} is {theirs}, and {ours} here; expected the same", asset
                )
        factor = compiler.angle / self.compiler.angle
        return _Other(root, path, compiler, Defaults(root, self.read), factor, file)

    def _found(
        self, owner: Element, targets: list[tuple[str, str]], childclass: str | None, other: _Other
    ) -> Iterator[tuple[Element, str | None]]:
        """Yield the element of this tag and name below another, with the class that reaches it."""
        for child in owner.children:
            if (child.tag, child.attributes.get("name")) in targets:
                yield child, childclass
            yield from self._found(child, targets, class_inside(child, childclass), other)

    def _add_shared(self, prefix: str, other: _Other, element: Element) -> None:
        """Add the defaults and meshes of a file, with a prefix."""
        prefixed = _Prefixed(prefix, other, of_classes=True)
        tops = self.mujoco.all("default") or [Element("default", {}, element.line)]
        if tops[0] not in self.mujoco.children:
            self.mujoco.children.append(tops[0])
        inside = [prefixed.of(e, None) for top in other.root.all("default") for e in top.children]
        tops[0].children.append(Element("default", {"class": f"{prefix}main"}, element.line, inside, file=other.file))
        meshes = []
        for mesh in (e for asset in other.root.all("asset") for e in asset.all("mesh")):
            own = mesh.attributes | {"name": prefix + mesh_name(mesh)}
            own["class"] = prefix + own.get("class", "main")
            if "file" in own:
                own["file"] = str((other.path.parent / other.compiler.mesh_path(own["file"])).absolute())
            meshes.append(replace(mesh, attributes=own, file=other.file))
        self.mujoco.children.append(Element("asset", {}, element.line, meshes, file=other.file))

    def _add_naming(self, parts: list[Element], prefix: str, other: _Other) -> None:
        """Add the tendons, actuators and equalities that name attached elements only."""
        names = _names(parts)
        for tag in _SECTIONS_WITH_REFERENCES:
            for section in other.root.all(tag):
                attached = []
                for e in section.children:
                    inside = _inside(e, names)
                    if inside and all(inside):
                        own = {"class": "main"} | e.attributes
                        attached.append(_Prefixed(prefix, other).of(replace(e, attributes=own), None))
                        if tag == "tendon" and "name" in e.attributes:
                            names.setdefault(tag, set()).add(e.attributes["name"])
                self.mujoco.children.append(Element(tag, {}, section.line, attached, file=other.file))


@dataclass
class _Prefixed:
    """Copies elements of another file, with a prefix before all names, and angles in this file's unit."""

    prefix: str
    other: _Other
    of_classes: bool = False  # whether these are defaults

    def of(self, element: Element, childclass: str | None) -> Element:
        """Return a copy of an element that a class reaches."""
        own = dict(element.attributes)
        self._turn(element, own, childclass)
        for key, x in own.items():
            named = key in ("name", "class", "childclass", "mesh") or key.rstrip("12") in _REFERENCES
            if named and x not in ("", "world"):
                own[key] = self.prefix + x
        inner = class_inside(element, childclass)
        children = [self.of(e, inner) for e in element.children]
        return replace(element, attributes=own, children=children, file=self.other.file)

    def _turn(self, element: Element, own: dict[str, str], childclass: str | None) -> None:
        # Numbers that are none stay: whoever reads them says so.
        with contextlib.suppress(ValueError, KeyError):
            own["quat"] = _quat(from_euler(np.array([*map(float, own["euler"].split())]), self.other.compiler))
            del own["euler"]
        if self.other.factor == 1:
            return
        if words := own.get("axisangle", "").split():
            own["axisangle"] = " ".join([*words[:3], *map(self._angle, words[3:])])
        # In a default class its type may not be known: every joint says its own angles.
        if element.tag == "joint" and not self.of_classes and not {"joint", "joint1"} & own.keys():
            full = self.other.defaults.filled(element, childclass).attributes
            if full.get("type", "hinge") in ("hinge", "ball"):
                for key in ("range", "ref", "springref"):
                    if key in full:
                        own[key] = " ".join(map(self._angle, full[key].split()))

    def _angle(self, text: str) -> str:
        try:
            return repr(float(text) * self.other.factor)
        except ValueError:
            # Not a number: whoever reads it says so.
            return text


def class_inside(element: Element, childclass: str | None) -> str | None:
    """Return the class that reaches the children of an element; MuJoCo takes a frame's class for its childclass."""
    own, framed = element.attributes, element.tag in ("frame", "replicate")
    return own.get("childclass", own.get("class", childclass) if framed else childclass)


def _names(elements: Iterable[Element]) -> dict[str, set[str]]:
    """Return all names below elements, by tag."""
    names: dict[str, set[str]] = {}
    for inner in (x for element in elements for x in element.walk()):
        if inner.tag in _REFERENCES and "name" in inner.attributes:
            names.setdefault(inner.tag, set()).add(inner.attributes["name"])
    return names


def _inside(element: Element, names: Mapping[str, Container[str]]) -> list[bool]:
    """Return True for each part that an element names if it is among some names."""
    ends = [(_REFERENCES.get(k.rstrip("12"), ""), x) for y in element.walk() for k, x in y.attributes.items()]
    return [x in names.get(kind, ()) for kind, x in ends if kind]


def _copy_naming(mujoco: Element, element: Element, suffixes: Iterable[str]) -> Iterator[str]:
    """Copy the elements that name something in a <replicate>, and yield those that MuJoCo leaves out."""
    names = _names(element.children)
    for tag in _SECTIONS_WITH_REFERENCES:
        for section in mujoco.all(tag):
            originals, copied = list[Element](), list[Element]()
            for e in section.children:
                inside = _inside(e, names)
                if not any(inside):
                    originals.append(e)
                elif tag == "equality" and not all(inside):
                    yield f"an equality with one end in them is left out, as by MuJoCo ({e.tag}, {e.place})"
                else:
                    copied += [_suffixed(e, suffix, names) for suffix in suffixes]
                    if tag == "tendon" and "name" in e.attributes:
                        names.setdefault(tag, set()).add(e.attributes["name"])
            section.children = [*originals, *copied]


def frame_contents(
    owner: Element, X: Pose, childclass: str | None, scene: Scene, item: str
) -> Iterator[tuple[Element, Pose, str | None]]:
    """Yield the children of a body, with those of its <frame> elements, their pose and their class."""
    for child in owner.children:
        if child.tag != "frame":
            yield child, X, childclass
            continue
        inner = scene.defaults.known(class_inside(child, None), child) or childclass
        yield from frame_contents(child, X @ pose(child, scene.compiler, scene.read, item), inner, scene, item)


def add_free_base(mujoco: Element, read: Reader) -> None:
    """Add a free joint to the world's only body, or keep a fault."""

    def parts(owner: Element, tags: tuple[str, ...]) -> Iterator[Element]:
        for child in owner.children:
            if child.tag == "frame":
                yield from parts(child, tags)
            elif child.tag in tags:
                yield child

    bases = [b for world in mujoco.all("worldbody") for b in parts(world, ("body",))]
    joints = [len(list(parts(b, _JOINTS))) for b in bases]
    if bases and (len(bases) > 1 or joints[0]):
        names = (repr(b.attributes.get("name", "")) if b.attributes.get("name") else f"({b.place})" for b in bases)
        bodies = ", ".join(f"{name} ({n} joint{'s' * (n != 1)})" for name, n in zip(names, joints, strict=True))
        read.fault(f"floating_base=True needs one body of the world, without joints; there are: {bodies}")
    elif any(e.tag in _JOINTS and e.attributes.get("name") == BASE_JOINT for e in mujoco.walk()):
        read.fault(f"joint {BASE_JOINT!r}: floating_base=True adds a joint of that name; rename yours")
    elif bases:
        joint = Element("freejoint", {"name": BASE_JOINT}, bases[0].line, file=bases[0].file)
        bases[0].children.insert(0, joint)


def read_tree(mujoco: Element, scene: Scene) -> None:
    """Read every body, and the sites of the world, into the scene."""
    for world in mujoco.all("worldbody"):
        scene.collect_names(world)
    for world in mujoco.all("worldbody"):
        _read_children(
            list(frame_contents(world, HERE, None, scene, "the world")), "world", "the world", scene.sites, scene
        )


def _read_children(
    parts: list[tuple[Element, Pose, str | None]], owner: str, item: str, sites: list[tuple[str, Pose]], scene: Scene
) -> None:
    for element, X, childclass in parts:
        name = element.attributes.get("name")
        if element.tag == "site" and name:
            site = scene.defaults.filled(element, childclass)
            if "fromto" not in site.attributes:
                sites.append((name, X @ pose(site, scene.compiler, scene.read, f"site in {item}")))
        elif element.tag == "body":
            _read_body(element, owner, X, childclass, scene)
        elif element.tag == "plugin" and owner != "world":
            scene.left_out["plugin"] += 1


def _read_body(element: Element, parent: str, X: Pose, childclass: str | None, scene: Scene) -> None:
    name = scene.name(element, "body", f"body{len(scene.bodies) + 1}")
    item = f"body {name!r}"
    read, compiler = scene.read, scene.compiler
    childclass = scene.defaults.known(element.attributes.get("childclass"), element) or childclass
    own = pose(element, compiler, read, item)
    if element.attributes.get("mocap") == "true":
        scene.left_out["motion capture"] += 1
    parts = list(frame_contents(element, HERE, childclass, scene, item))
    joints = [_joint(e, name, Y, c, scene) for e, Y, c in parts if e.tag in _JOINTS]
    if any(j.kind == "free" for j in joints):
        if len(joints) > 1:
            read.fault(f"{item}: a free joint and others; a free body has no other joint")
        if parent != "world":
            read.fault(f"{item}: a free joint below {parent!r}; only bodies of the world may be free")
    inertials = [(e, Y) for e, Y, _ in parts if e.tag == "inertial"]
    geoms = [(e, scene.defaults.filled(e, c), Y) for e, Y, c in parts if e.tag == "geom"]
    geoms = [(e, full, Y) for e, full, Y in geoms if counts(full, compiler, read, item)]
    mass_properties, changed = _body_mass_properties(
        inertials, [(full, Y) for _, full, Y in geoms], own.p, compiler, read, item
    )
    if mass_properties is None:
        scene.inferred[name] = [(e, full.attributes.get("mesh", "")) for e, full, _ in geoms]
    for setting in changed:
        scene.bounded.setdefault(setting, []).append(name)
    if any(j.kind == "free" and _aligned(j, scene) for j in joints) and not any(e.tag == "body" for e, _, _ in parts):
        at = _inertial_frame(mass_properties, inertials, compiler, read, item)
        own, back = own @ at, Pose(at.R.T, -product(at.R.T, at.p))
        parts = [(e, back @ Y, c) for e, Y, c in parts]
        mass_properties = (mass_properties or NOTHING).moved(back.R, back.p)
        scene.aligned.append(name)
    gravcomp = read.number(element, "gravcomp", item, 0.0)
    body = MjcfBody(name, parent, X @ own, joints, mass_properties or NOTHING, gravcomp=gravcomp)
    scene.bodies.append(body)
    _read_children(parts, name, item, body.sites, scene)


def _aligned(joint: MjcfJoint, scene: Scene) -> bool:
    """Return whether the frame of a free body is to be its inertial frame; MuJoCo moves none with bodies below it."""
    choices = ("auto", "true", "false")
    align = scene.read.choice(joint.element, "align", choices) if joint.element.tag == "freejoint" else "auto"
    return align == "true" or (align == "auto" and scene.compiler.alignfree)


def _inertial_frame(
    matter: MassProperties | None, inertials: list[tuple[Element, Pose]], compiler: Compiler, read: Reader, item: str
) -> Pose:
    """Return the frame of principal axes at the centre of mass, with the axes in MuJoCo's order."""
    if matter is None:
        read.fault(f"{item}: align, with an inertia from a mesh or a shell; add <inertial>, or set align to false")
        return HERE
    infer = compiler.inertiafromgeom
    turned_by = np.eye(3)
    if inertials and not infer:
        element, X = inertials[0]
        turned_by = (X @ pose(element, compiler, read, item)).R
        if "fullinertia" not in element.attributes:
            return Pose(turned_by, matter.com)
    # Imported late: only the order and signs of the axes need it.
    import mujoco

    values, axes, quat = np.zeros(3), np.zeros(9), np.zeros(4)
    mujoco.mju_eig3(values, axes, quat, turned(turned_by.T, matter.inertia).ravel())
    return Pose(product(turned_by, matrix_of(quat)), matter.com)


def _joint(element: Element, body: str, X: Pose, childclass: str | None, scene: Scene) -> MjcfJoint:
    read = scene.read
    free = element.tag == "freejoint"
    full = element if free else scene.defaults.filled(element, childclass)
    name = scene.name(element, "joint", f"{body}_joint")
    item = f"joint {name!r}"
    type_ = "free" if free else full.attributes.get("type", "hinge")
    if type_ not in KINDS:
        read.fault(f"{item}: type {type_[:40]!r}; expected one of {', '.join(KINDS)}", element)
    joint = MjcfJoint(name, full, type_ if type_ in KINDS else "hinge")
    if joint.kind != "free":
        joint.anchor = X.p + product(X.R, np.array(read.numbers(full, "pos", item, count=3, default=(0, 0, 0))))
    if joint.scalar:
        axis = np.array(read.numbers(full, "axis", item, count=3, default=(0, 0, 1)))
        if not has_length(axis):
            read.fault(f"{item}: axis is zero; expected a direction, such as 0 0 1", element)
            axis = joint.axis
        joint.axis = product(X.R, axis)
        unit = scene.compiler.angle if joint.kind == "hinge" else 1.0
        joint.ref, joint.rest = (unit * read.number(full, name, item, 0.0) for name in ("ref", "springref"))
    return joint


# Mass and inertia


def _body_mass_properties(
    inertials: list[tuple[Element, Pose]],
    geoms: list[tuple[Element, Pose]],
    place: Array,
    compiler: Compiler,
    read: Reader,
    item: str,
) -> tuple[MassProperties | None, list[str]]:
    """Return a body's inertia in its own axes, and the settings that changed it; None where it is a mesh's or shell's.

    Elements have their defaults and the pose of their <frame>; geoms are those for which `counts` is true. `place`
    is the body's written position.
    """
    if len(inertials) > 1:
        read.fault(f"{item}: {len(inertials)} <inertial> elements; keep one", inertials[1][0])
    infer = compiler.inertiafromgeom
    if infer or (infer is None and not inertials):
        masses = [mass_properties_of(e, X, compiler, read, item) for e, X in geoms]
        if any(x is None for x in masses):
            return None, []
        heavy = [x for x in masses if x and x.mass > _MIN_GEOM_MASS]
        if heavy:
            # A flat body's A + B and C differ by rounding.
            return _bounded(together(heavy), compiler, slack=1e-14)
    if not inertials:
        mass_properties, changed = _bounded(NOTHING, compiler)
        # MuJoCo takes that place for the centre of mass in the body.
        return replace(mass_properties, com=place) if changed else mass_properties, changed
    principal, X = _written(*inertials[0], compiler, read, item)
    mass_properties, changed = _bounded(
        principal, compiler, slack=1e-14 if "fullinertia" in inertials[0][0].attributes else 0.0
    )
    return mass_properties.moved(X.R, X.p), changed


def _bounded(
    mass_properties: MassProperties, compiler: Compiler, slack: float = 0.0
) -> tuple[MassProperties, list[str]]:
    """Return the properties after the compiler's bounds, and the settings that changed them; `slack` is relative."""
    mass, inertia, changed = mass_properties.mass, mass_properties.inertia, list[str]()
    if mass < compiler.boundmass > 0:
        mass = compiler.boundmass
        changed.append("boundmass")
    moments, axes = np.linalg.eigh(inertia)
    if moments[0] < compiler.boundinertia > 0:
        moments = np.maximum(moments, compiler.boundinertia)
        inertia = turned(axes, np.diag(moments))
        changed.append("boundinertia")
    if compiler.balanceinertia and moments[0] + moments[1] < moments[2] * (1 - slack):
        inertia = float(np.mean(moments)) * np.eye(3)
        changed.append("balanceinertia")
    return (MassProperties(mass, mass_properties.com, inertia) if changed else mass_properties), changed


def _written(element: Element, X: Pose, compiler: Compiler, read: Reader, item: str) -> tuple[MassProperties, Pose]:
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
    return MassProperties(mass, np.zeros(3), inertia), placed
