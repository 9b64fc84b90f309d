"""A URDF or MJCF without its references to other files, as the engines' parsers read it.

Elements keep their lines. Meshes, textures and packages go, with the shapes that need them. Only the meshes
that give a body of an MJCF its inertia stay: their files are read and passed on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath
from typing import Final
from xml.sax.saxutils import escape

from mbkit.errors import LoadError, ModelError
from mbkit.load import xml_reader
from mbkit.load.mjcf_attributes import Compiler, Defaults, mesh_assets, mesh_name, read_mesh
from mbkit.load.mjcf_reader import add_free_base, class_inside
from mbkit.load.shapes import counts
from mbkit.load.xml_reader import MAX_FILE_BYTES, Element, Reader, element_text, unused, with_includes

_FORMATS: Final = {"robot": "urdf", "mujoco": "mjcf"}
#: Elements that name other files, or mean nothing without one that does.
_GONE: Final = {
    "urdf": frozenset({"texture", "gazebo", "sensor"}),
    "mjcf": frozenset(
        {"sensor", "contact", "keyframe", "visual", "statistic", "custom", "skin", "camera", "material", "texture"}
    ),
}
_FOREIGN: Final = frozenset({"include", "attach", "flexcomp"})
_OUTSIDE: Final = ("package://", "file://", "model://", "http://", "https://")
_FROM_FILES: Final = ("mesh", "sdf", "hfield")


@dataclass(frozen=True)
class Stripped:
    """A file without references to others."""

    path: Path
    format: str  # "urdf" or "mjcf"
    root: Element  # as read, with the files that an MJCF includes
    text: str  # elements keep their lines; those of an included file have the line of the <include>
    gone: tuple[tuple[str, int], ...]  # removed elements, and how many
    renamed: str  # the base link's new name, where it may not be "world"; else empty
    shapeless: tuple[str, ...]  # bodies whose inertia might have come from a removed mesh
    meshes: dict[str, bytes]  # name in the text -> content
    unread: tuple[str, ...]  # why other meshes could not be read, a sentence each


def strip(path: Path, *, floating_base: bool = False) -> Stripped:
    """Read a file and remove what would open another; for a floating base add an MJCF's joint.

    URDF has no such joint; its base link only gets a name that no parser takes for the ground's.
    """
    root = xml_reader.read(path)
    format_ = _FORMATS.get(root.tag)
    if format_ is None:
        raise xml_reader.unknown_root(path, root)
    if format_ == "mjcf":
        root = with_includes(root, path)
    foreign = [e for e in root.walk() if e.tag in _FOREIGN]
    if foreign:
        raise LoadError(
            f"{path}: {foreign[0].place}: <{foreign[0].tag}> names another file, which is not opened; "
            "write its content in its place"
        )
    renamed = ""
    if floating_base and format_ == "urdf":
        root, renamed = _with_base(root)
    elif floating_base:
        read = Reader()
        add_free_base(root, read)
        if read.faults:
            raise ModelError(str(path), read.faults)
    meshes = _Meshes(root, path) if format_ == "mjcf" else None
    writer = _Writer(format_, meshes)
    writer.write(root)
    text, removed = "".join(writer.parts) + "\n", tuple(sorted(writer.gone.items()))
    files, unread = (meshes.files, tuple(dict.fromkeys(meshes.unread))) if meshes else ({}, ())
    return Stripped(path, format_, root, text, removed, renamed, tuple(dict.fromkeys(writer.shapeless)), files, unread)


def _with_base(robot: Element) -> tuple[Element, str]:
    """Return a <robot> whose base link is not called ``world``, the ground's name for parsers, and any new name."""
    joints = robot.all("joint")
    links = {e.attributes.get("name") for e in robot.all("link")}
    if "world" not in links or any(e.attributes.get("link") == "world" for j in joints for e in j.all("child")):
        return robot, ""
    name = unused("world_link", links)

    def renamed(element: Element) -> Element:
        attribute = {"link": "name", "parent": "link"}.get(element.tag, "")
        if element.attributes.get(attribute) == "world":
            return replace(element, attributes={**element.attributes, attribute: name})
        if element.tag != "joint":
            return element
        return replace(element, children=[renamed(e) for e in element.children])

    return replace(robot, children=[renamed(e) for e in robot.children]), name


class _Meshes:
    """The meshes that give bodies of an MJCF their inertia."""

    def __init__(self, mujoco: Element, path: Path) -> None:
        read = Reader()
        self._compiler, self._defaults = Compiler.of(mujoco, read), Defaults(mujoco, read)
        self._folder = path.parent
        self._assets = mesh_assets(mujoco)
        self.files: dict[str, bytes] = {}
        self.unread: list[str] = []
        #: Asset's name -> file's name in `files`, empty where its vertices stand in the MJCF; None: not readable.
        self.passed: dict[str, str | None] = {}
        #: Geoms that need a file and are removed, by identity; and whether their body loses mass by that.
        self.lost: dict[int, bool] = {}
        for world in mujoco.all("worldbody"):
            self._body(world, None)

    def attributes(self, asset: Element) -> dict[str, str] | None:
        """Return the attributes of a mesh that is passed on, else None."""
        name = mesh_name(asset)
        file = self.passed.get(name)
        if file is None or self._assets.get(name) is not asset:
            return None
        return {**asset.attributes, "name": name, "file": file} if file else asset.attributes

    def _body(self, owner: Element, childclass: str | None) -> None:
        childclass = owner.attributes.get("childclass", childclass)
        parts = list(_parts(owner, childclass))
        infer = self._compiler.inertiafromgeom
        inferred = infer or (infer is None and not any(e.tag == "inertial" for e, _ in parts))
        for geom, within in parts:
            full = self._defaults.filled(geom, within)
            type_ = full.attributes.get("type")
            if geom.tag == "geom" and ("mesh" in full.attributes or type_ in _FROM_FILES):
                # Faults are the parsers' to report.
                needed = bool(owner.tag == "body" and inferred and counts(full, self._compiler, Reader(), ""))
                if not (needed and self._read(full.attributes.get("mesh", ""))):
                    self.lost[id(geom)] = needed
        for body, within in parts:
            if body.tag == "body":
                self._body(body, within)

    def _read(self, name: str) -> bool:
        """Read a mesh for the parsers; return whether they can have it."""
        asset = self._assets.get(name)
        if name not in self.passed:
            # The parsers report a mesh that is not declared.
            self.passed[name] = self._content(asset) if asset and "file" in asset.attributes else ""
        return self.passed[name] is not None

    def _content(self, asset: Element) -> str | None:
        """Read a mesh into `files` and return its name there, or None and a sentence in `unread`."""
        relative = self._compiler.mesh_path(asset.attributes["file"])
        if relative.is_absolute() or PureWindowsPath(str(relative)).drive:
            content, why = b"", "an absolute path is not followed"
        else:
            content, why = read_mesh(self._folder / relative, MAX_FILE_BYTES - sum(map(len, self.files.values())))
        if why:
            file = asset.attributes["file"].replace("\\", "/")
            self.unread.append(f"mesh {file[:200]!r} ({asset.place}): {why}")
            return None
        name = relative.name
        while name in self.files:
            name = f"_{name}"
        self.files[name] = content
        return name


def _parts(owner: Element, childclass: str | None) -> Iterator[tuple[Element, str | None]]:
    """Yield the children with their class, and those in <frame> and <replicate> elements."""
    for child in owner.children:
        if child.tag in ("frame", "replicate"):
            yield from _parts(child, class_inside(child, childclass))
        else:
            yield child, childclass


class _Writer:
    """Writes elements, each in its own line of the file."""

    def __init__(self, format_: str, meshes: _Meshes | None) -> None:
        self._format, self._meshes = format_, meshes
        self._line = 1
        self.parts: list[str] = []
        self.gone: Counter[str] = Counter()
        self.shapeless: list[str] = []

    def write(self, element: Element) -> None:
        """Write an element and its kept children."""
        children = list(self._kept(element))
        if self._shapeless(element, children):
            self.shapeless.append(element.attributes.get("name", "?"))
        below = (element.included_at or element.line) - self._line
        if below > 0:
            self.parts.append("\n" * below)
            self._line += below
        head = element_text(element.tag, self._attributes(element))
        inside = escape(" ".join(element.text.split()))
        if not inside and not children:
            self.parts.append(head)
            return
        self.parts.append(f"{head.removesuffix('/>')}>{inside}")
        for child in children:
            self.write(child)
        self.parts.append(f"</{element.tag}>")

    def _shapeless(self, element: Element, children: list[Element]) -> bool:
        """Return whether a body has lost shapes from which MuJoCo would have inferred its inertia."""
        if self._meshes is not None:
            return element.tag == "body" and any(self._meshes.lost.get(id(e)) for e in element.all("geom"))
        lost_shape = any(e.tag in ("collision", "visual") and e not in children for e in element.children)
        return element.tag == "link" and element.first("inertial") is None and lost_shape

    def _attributes(self, element: Element) -> dict[str, str]:
        own = element.attributes
        if self._meshes is None:
            return own
        left_out = {"material"}
        if element.tag == "compiler":
            left_out |= {"meshdir", "assetdir", "texturedir"}
        elif element.tag == "mesh":
            own = self._meshes.attributes(element) or own
        elif element.tag == "geom" and self._meshes.passed.get(own.get("mesh", "")) is None:
            left_out |= {"mesh", "hfield"}
        return {k: v for k, v in own.items() if k not in left_out}

    def _kept(self, element: Element) -> Iterable[Element]:
        for child in element.children:
            if child.tag in _GONE[self._format] or self._must_go(child, element):
                self.gone[child.tag] += 1
            else:
                yield child

    def _must_go(self, element: Element, owner: Element) -> bool:
        if self._meshes is not None:
            if element.tag == "asset":
                return all(self._must_go(e, element) for e in element.children)
            if owner.tag == "asset":
                return element.tag != "mesh" or self._meshes.attributes(element) is None
            return element.tag == "geom" and id(element) in self._meshes.lost
        if element.tag == "transmission":
            # Drake 1.51 ends the process over one without a type.
            type_ = element.first("type")
            return type_ is None or not type_.text.strip()
        if element.tag in ("visual", "collision"):
            return any(e.tag in ("mesh", "texture") for e in element.walk())
        return any(mark in value for value in element.attributes.values() for mark in _OUTSIDE)
