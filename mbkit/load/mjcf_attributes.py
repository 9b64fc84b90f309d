"""MJCF's elements: the schema of names, compiler settings, default classes, and the ways to write a pose.

`mujoco.mj_printSchema` prints the schema. It leaves out <frame>, whose names only mbkit checks.
"""

from __future__ import annotations

import hashlib
import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit._reproducible import length, product
from mbkit.errors import did_you_mean
from mbkit.load.xml_reader import MAX_FILE_BYTES, Element, Reader, element_text
from mbkit.model.validation import listing

ORIENTATIONS: Final = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}


@dataclass(frozen=True)
class Pose:
    """R and p of a frame in another."""

    R: Array
    p: Array

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(product(self.R, other.R), self.p + product(self.R, other.p))


HERE: Final = Pose(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Compiler:
    """The settings of <compiler> that change a model's numbers or name its files."""

    angle: float  # radians per unit of angle in the file
    eulerseq: str  # three of xyzXYZ; small letters turn with the body, capitals stay
    autolimits: bool
    inertiafromgeom: bool | None  # None: only where there is no <inertial>
    groups: tuple[float, float]  # the first and last geom group that has mass
    balanceinertia: bool
    boundmass: float
    boundinertia: float
    settotalmass: float
    meshdir: str
    strippath: bool
    alignfree: bool
    attributes: Mapping[str, str]  # all, as written

    @classmethod
    def of(cls, mujoco: Element, read: Reader) -> Compiler:
        """Read every <compiler> of the file; later ones win."""
        merged, meshdir = Element("compiler", {}, mujoco.line), ""
        for element in mujoco.all("compiler"):
            merged = replace(element, attributes={**merged.attributes, **element.attributes})
            # An element's meshdir overrides its assetdir, even where it is empty.
            meshdir = element.attributes.get("meshdir", element.attributes.get("assetdir", meshdir))
        attributes, item = merged.attributes, "the file"

        def flag(name: str, default: str = "false") -> bool:
            return read.choice(merged, name, (default, "true" if default == "false" else "false")) == "true"

        if attributes.get("coordinate", "local") != "local":
            read.fault("compiler coordinate: only 'local' is read; convert the file with MuJoCo 2.3.3", merged)
        seq = attributes.get("eulerseq", "xyz")
        if len(seq) != 3 or set(seq.lower()) - set("xyz"):
            read.fault(f"compiler eulerseq: expected three of xyzXYZ, got {seq[:20]!r}", merged)
            seq = "xyz"
        infer = read.choice(merged, "inertiafromgeom", ("auto", "true", "false"))
        low, high = read.numbers(merged, "inertiagrouprange", item, count=2, default=(0.0, 5.0))
        return cls(
            angle=np.pi / 180 if read.choice(merged, "angle", ("degree", "radian")) == "degree" else 1.0,
            eulerseq=seq,
            autolimits=flag("autolimits", "true"),
            inertiafromgeom={"auto": None, "true": True, "false": False}[infer],
            groups=(low, high),
            balanceinertia=flag("balanceinertia"),
            boundmass=read.number(merged, "boundmass", item, 0.0),
            boundinertia=read.number(merged, "boundinertia", item, 0.0),
            settotalmass=read.number(merged, "settotalmass", item, -1.0),
            meshdir=meshdir.replace("\\", "/"),
            strippath=attributes.get("strippath") == "true",
            alignfree=flag("alignfree"),
            attributes=attributes,
        )

    def mesh_path(self, file: str) -> PurePosixPath:
        """Return the path of a mesh, relative to the MJCF's folder unless the file writes an absolute one."""
        path = PurePosixPath(file.replace("\\", "/"))
        return PurePosixPath(self.meshdir) / (path.name if self.strippath else path)


def mesh_assets(mujoco: Element) -> dict[str, Element]:
    """Return the <mesh> elements by name; a mesh without one has the stem of its file."""
    meshes = [e for section in mujoco.all("asset") for e in section.all("mesh")]
    return {mesh_name(e): e for e in meshes}


def mesh_name(mesh: Element) -> str:
    """Return the name of a <mesh>."""
    stem = PurePosixPath(mesh.attributes.get("file", "").replace("\\", "/")).stem
    return mesh.attributes.get("name") or stem


def asset_name(content: bytes, path: Path) -> str:
    """Return a name for a file that is passed on: MuJoCo caches meshes by name, so it stands for the content."""
    return hashlib.sha256(content).hexdigest() + path.suffix


def compiled_model(compiler: Mapping[str, str], inside: str, assets: Mapping[str, bytes]) -> Any:
    """Return the `MjModel` of an MJCF; ValueError with MuJoCo's reason, without lines, which are those of this text."""
    # Imported late: few files need the compiler.
    import mujoco

    text, previous = f"<mujoco>{element_text('compiler', compiler)}{inside}</mujoco>", mujoco.get_mju_user_warning()
    # Its warnings would be printed, and kept in a file of the working folder.
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            return mujoco.MjModel.from_xml_string(text, assets=dict(assets))
    except ValueError as error:
        raise ValueError(re.sub(r",? line -?\d+", "", " ".join(str(error).split()))) from None
    finally:
        mujoco.set_mju_user_warning(previous)


def read_mesh(path: Path, most: int = MAX_FILE_BYTES) -> tuple[bytes, str]:
    """Return a file's content, and why it cannot be read, if so."""
    try:
        # A pipe or a device would be read for ever.
        if not path.is_file():
            return b"", f"no such file: {path}"
        if path.stat().st_size > most:
            return b"", f"up to {MAX_FILE_BYTES} bytes of meshes are read"
        return path.read_bytes(), ""
    except (OSError, ValueError) as error:
        return b"", f"cannot be read ({error})"


class Defaults:
    """The default classes: what an element has without saying so."""

    def __init__(self, mujoco: Element, read: Reader) -> None:
        self.read = read
        self.classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for element in mujoco.all("default"):
            if element.attributes.get("class", "main") != "main":
                read.fault("the outermost <default> has another class than 'main'; put a <default> around it", element)
            self._collect(element, "main")

    def _collect(self, element: Element, name: str) -> None:
        values = self.classes[name]
        for child in element.children:
            if child.tag != "default":
                values[child.tag] = _over(values.get(child.tag, {}), child.attributes)
        for child in element.all("default"):
            inner = self.read.name(child, "class", f"the class inside {name!r}")
            if inner in self.classes:
                self.read.fault(f"default class {inner!r}: declared twice; names must differ", child)
            self.classes[inner] = dict(values)
            self._collect(child, inner)

    def known(self, name: str | None, element: Element) -> str | None:
        """Return the class name, or None after a fault."""
        if name is None or name in self.classes:
            return name
        classes = ", ".join(sorted(self.classes)[:20])
        self.read.fault(f"<{element.tag}>: unknown default class {name!r}; there are: {classes}", element)
        return None

    def filled(self, element: Element, childclass: str | None) -> Element:
        """Return the element with its defaults: its own class, else the enclosing childclass."""
        name = self.known(element.attributes.get("class"), element) or childclass or "main"
        values = self.classes[name].get(element.tag, {})
        return replace(element, attributes=_over(values, element.attributes))


def _over(values: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """Return `values` overridden by `own`; any orientation of its own replaces every other."""
    inherited = {k: v for k, v in values.items() if k not in ORIENTATIONS or not ORIENTATIONS.keys() & own.keys()}
    return {**inherited, **own}


def pose(element: Element, compiler: Compiler, read: Reader, item: str) -> Pose:
    """Return the pose that an element's pos and orientation give."""
    p = np.array(read.numbers(element, "pos", item, count=3, default=(0, 0, 0)))
    names = [name for name in ORIENTATIONS if name in element.attributes]
    if not names:
        return Pose(np.eye(3), p)
    if len(names) > 1:
        read.fault(f"{item}: {element.tag} has {' and '.join(names)}; keep one orientation", element)
    before = len(read.faults)
    values = np.array(read.numbers(element, names[0], item, count=ORIENTATIONS[names[0]]))
    R = None if len(read.faults) > before else _rotation(names[0], values, compiler)
    if R is None and len(read.faults) == before:
        read.fault(f"{item}: {element.tag} {names[0]}: expected directions of some length, got zeros", element)
    return Pose(np.eye(3) if R is None else R, p)


def _rotation(name: str, x: Array, compiler: Compiler) -> Array | None:
    """Return the matrix of one of MuJoCo's orientations, or None for a zero vector."""
    if name == "quat":
        return spatial.matrix_from_quaternion(spatial.normalized(x[[1, 2, 3, 0]])) if has_length(x) else None
    if name == "axisangle":
        return about(x[:3], compiler.angle * x[3]) if has_length(x[:3]) else None
    if name == "euler":
        return from_euler(x, compiler)
    if name == "zaxis":
        return z_to(x) if has_length(x) else None
    if not has_length(x[:3]):
        return None
    first = spatial.normalized(x[:3])
    second = x[3:] - first * product(first[None], x[3:])
    if not length(second) > 1e-10:
        return None
    second = spatial.normalized(second)
    return np.column_stack([first, second, np.cross(first, second)])


def from_euler(angles: Array, compiler: Compiler) -> Array:
    """Return the rotation by three angles about the axes of ``eulerseq``, in the file's unit."""
    R = np.eye(3)
    for letter, angle in zip(compiler.eulerseq, compiler.angle * angles, strict=True):
        turn = about(np.eye(3)["xyz".index(letter.lower())], float(angle))
        R = product(R, turn) if letter.islower() else product(turn, R)
    return R


def has_length(x: Array) -> bool:
    """Return whether a direction can be normalized; the squares of numbers below 1e-162 vanish."""
    return length(x) > 0


def matrix_of(wxyz: Any) -> Array:
    """Return the rotation matrix of a quaternion in MuJoCo's order."""
    return spatial.matrix_from_quaternion(np.roll(np.asarray(wxyz, dtype=np.float64), -1))


def about(axis: Array, angle: float) -> Array:
    """Return the rotation about an axis of any length."""
    half = angle / 2
    quaternion = np.array([*(math.sin(half) * spatial.normalized(axis)), math.cos(half)])
    return spatial.matrix_from_quaternion(quaternion)


def z_to(direction: Array) -> Array:
    """Return the shortest rotation that takes z to a direction."""
    z = spatial.normalized(direction)
    axis = np.array([-z[1], z[0], 0.0])
    sine = length(axis)
    if sine < 1e-10:
        axis = np.array([1.0, 0.0, 0.0])
    return about(axis, math.atan2(sine, z[2]))


# Names that MuJoCo's schema does not have.

# These do not act on the smooth motion: an unknown name in them is a note.
_ASIDE: Final = (
    *("visual", "statistic", "size", "sensor", "custom", "keyframe", "extension", "contact"),
    *("texture", "material", "skin", "hfield", "camera", "light"),
)
# These are refused or not read.
_UNREAD: Final = frozenset({"attach", "composite", "flexcomp", "plugin"})


@dataclass(frozen=True)
class Rule:
    """Attributes and children of an element; its parent has one at most if `once`."""

    attributes: frozenset[str] = frozenset()
    children: dict[str, Rule] = field(default_factory=dict)
    once: bool = False


def check_names(mujoco: Element, read: Reader) -> str:
    """Keep a fault for each unknown name that could act on the motion, and return a note about the others."""
    aside: list[str] = []
    _check(mujoco, rules(), read, aside)
    return f"unknown to MuJoCo's schema, and ignored: {listing(aside)}" if aside else ""


def _check(element: Element, rule: Rule, read: Reader, aside: list[str], acts: bool = True) -> None:
    """Check an element and all inside; without effect on the motion (not `acts`), names go into `aside`."""

    def unknown(what: str, name: str, known: frozenset[str], where: Element) -> None:
        if acts and where.tag not in _ASIDE:
            read.fault(f"{_called(element)}: unknown {what} {name[:60]!r}{_hint(name, known)}", where)
        else:
            aside.append(f"{what} {name[:60]!r} of <{element.tag}> ({where.place})")

    for name in element.attributes:
        if name not in rule.attributes:
            unknown("attribute", name, rule.attributes, element)
    tags: set[str] = set()
    for child in element.children:
        inner = rule.children.get(child.tag)
        if child.tag in _UNREAD:
            continue
        if inner is None:
            unknown("element", child.tag, frozenset(rule.children), child)
        elif inner.once and child.tag in tags:
            read.fault(f"{_called(element)}: more than one <{child.tag}>; keep one", child)
        else:
            _check(child, inner, read, aside, acts and child.tag not in _ASIDE)
        tags.add(child.tag)


def _called(element: Element) -> str:
    return f"{element.tag} {name[:60]!r}" if (name := element.attributes.get("name")) else f"<{element.tag}>"


@lru_cache(maxsize=1000)
def _hint(name: str, known: frozenset[str]) -> str:
    return did_you_mean(name[:60], sorted(known)) or f"; there are: {', '.join(sorted(known)) or 'none'}"


@lru_cache(maxsize=1)
def rules() -> Rule:
    """Return the rule for <mujoco>, from MuJoCo's schema."""
    # Imported late: only an MJCF needs it.
    import mujoco

    # Lines are "name (how often)   attribute attribute", indented by level; longer ones go on below.
    root = Rule()
    open_rules: list[tuple[int, Rule]] = [(-1, root)]
    text = re.sub(r"\n *(?!.* \(.\))", " ", mujoco.mj_printSchema(False, False))
    for indent, tag, often, names in re.findall(r"( *)(?:\(world\))?(\S+) \((.)\)(.*)", text):
        rule = Rule(frozenset(names.split()), once=often in "!?")
        while open_rules[-1][0] >= len(indent):
            open_rules.pop()
        open_rules[-1][1].children[tag] = rule
        open_rules.append((len(indent), rule))
        if often == "R":
            rule.children[tag] = rule
    whole = root.children["mujoco"]
    body = whole.children.pop("body")
    frame_attributes = frozenset({"name", "class", "childclass", "pos", *ORIENTATIONS})
    world = {tag: rule for tag, rule in body.children.items() if tag not in ("inertial", "joint", "freejoint")}
    for children in (body.children, world):
        children["frame"] = Rule(frame_attributes, children)
    whole.children["worldbody"] = Rule(frozenset(), world)
    return whole
