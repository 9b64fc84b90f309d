"""A URDF or MJCF as it was written, less what would open another file.

Engines' parsers read this text. Its lines are those of the file: a removed element leaves empty lines.
Meshes, textures and packages are gone, and with them the shapes that were made of them. Boxes,
cylinders and spheres stay, because MuJoCo may take a body's inertia from them, and so does every other
element. Meshes stay where a body of an MJCF takes its inertia from them: those files are read and handed over.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Final
from xml.sax.saxutils import escape, quoteattr

from mbkit.errors import LoadError, ModelError
from mbkit.load import xml_reader
from mbkit.load.mjcf_attributes import Compiler, Defaults
from mbkit.load.urdf_links import floated, with_base
from mbkit.load.xml_reader import MOST_BYTES, Element, Reader, expanded

_FORMATS: Final = {"robot": "urdf", "mujoco": "mjcf"}
#: What names other files, or is nothing without what does.
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
    """A file without references to others.

    Attributes
    ----------
    path : pathlib.Path
    format : str
        ``"urdf"`` or ``"mjcf"``.
    root : Element
        As it was read, with the files that an MJCF includes.
    text : str
        What the parsers are given. An element stands in the line in which the file has it; one of an
        included file in the line of the <include>.
    gone : tuple of (str, int)
        Elements that were taken out, and how many.
    renamed : str
        What the base link is called, where it may not be ``world``; else empty.
    shapeless : tuple of str
        Bodies whose inertia might have come from a mesh that was taken out.
    meshes : dict
        The meshes that the text names, because a body takes its inertia from them: name -> content.
    unread : tuple of str
        Why others could not be read, a sentence each.
    """

    path: Path
    format: str
    root: Element
    text: str
    gone: tuple[tuple[str, int], ...]
    renamed: str
    shapeless: tuple[str, ...]
    meshes: dict[str, bytes]
    unread: tuple[str, ...]


def strip(path: Path, *, floating_base: bool = False) -> Stripped:
    """Read a file and take out what would open another.

    An MJCF whose base is to float is given the joint for it, which all parsers read. A URDF cannot say that:
    its base link is only given a name that no parser takes for the ground's.

    Raises
    ------
    ModelError
        No single body of an MJCF could float.
    LoadError
        It cannot be read, is neither URDF nor MJCF, or names a file that is not read.
    """
    root = xml_reader.read(path)
    format_ = _FORMATS.get(root.tag)
    if format_ is None:
        raise LoadError(f"{path}: the root element is <{root.tag[:60]}>; expected <robot> (URDF) or <mujoco> (MJCF)")
    if format_ == "mjcf":
        root = expanded(root, path)
    foreign = [e for e in root.walk() if e.tag in _FOREIGN]
    if foreign:
        raise LoadError(
            f"{path}: {foreign[0].place}: <{foreign[0].tag}> names another file, which is not opened; "
            "write its content in its place"
        )
    renamed = ""
    if floating_base and format_ == "urdf":
        root, renamed = with_base(root)
    elif floating_base:
        read = Reader()
        root = floated(root, read)
        if read.faults:
            raise ModelError(str(path), read.faults)
    meshes = _Meshes(root, path) if format_ == "mjcf" else None
    writer = _Writer(format_, meshes)
    writer.write(root)
    return Stripped(
        path=path,
        format=format_,
        root=root,
        text="".join(writer.parts) + "\n",
        gone=tuple(sorted(writer.gone.items())),
        renamed=renamed,
        shapeless=tuple(dict.fromkeys(writer.shapeless)),
        meshes=meshes.files if meshes else {},
        unread=tuple(dict.fromkeys(meshes.unread)) if meshes else (),
    )


class _Meshes:
    """The meshes that give bodies of an MJCF their inertia."""

    def __init__(self, mujoco: Element, path: Path) -> None:
        read = Reader()
        self._compiler, self._defaults = Compiler.of(mujoco, read), Defaults(mujoco, read)
        self._folder = path.parent
        settings = {k: v for e in mujoco.all("compiler") for k, v in e.attributes.items()}
        self._meshdir = settings.get("meshdir") or settings.get("assetdir", "")
        self._bare = settings.get("strippath") == "true"
        assets = [e for section in mujoco.all("asset") for e in section.all("mesh")]
        self._assets = {e.attributes.get("name") or _stem(e.attributes.get("file", "")): e for e in assets}
        self.files: dict[str, bytes] = {}
        self.unread: list[str] = []
        #: Asset's name -> file's name in `files`, empty where its vertices stand in the MJCF; None: not readable.
        self._given: dict[str, str | None] = {}
        #: Geoms that need a file and are left out, by identity; and whether their body has lost mass by that.
        self._lost: dict[int, bool] = {}
        for world in mujoco.all("worldbody"):
            self._body(world, None)

    def lost(self, geom: Element) -> bool:
        """Return whether a geom is taken out."""
        return id(geom) in self._lost

    def heavy(self, geom: Element) -> bool:
        """Return whether a geom that is taken out would have given its body mass."""
        return self._lost.get(id(geom), False)

    def written(self, asset: Element) -> dict[str, str] | None:
        """Return the attributes of a mesh that is handed over, else None."""
        own = asset.attributes
        name = own.get("name") or _stem(own.get("file", ""))
        given = self._given.get(name)
        if given is None or self._assets.get(name) is not asset:
            return None
        return {**own, "name": name, "file": given} if given else own

    def has(self, name: str) -> bool:
        """Return whether a mesh of this name is handed over."""
        return self._given.get(name) is not None

    def _body(self, owner: Element, childclass: str | None) -> None:
        childclass = owner.attributes.get("childclass", childclass)
        geoms = list(_parts(owner, childclass, "geom"))
        written = any(True for _ in _parts(owner, childclass, "inertial"))
        compiler = self._compiler
        inferred = compiler.inertiafromgeom is not False and (bool(compiler.inertiafromgeom) or not written)
        for geom, within in geoms:
            full = self._defaults.filled(geom, within).attributes
            if "mesh" in full or full.get("type") in _FROM_FILES:
                needed = owner.tag == "body" and inferred and self._heavy(full) and full.get("type") != "hfield"
                if not (needed and self._read(full.get("mesh", ""))):
                    self._lost[id(geom)] = needed
        for body, within in list(_parts(owner, childclass, "body")):
            self._body(body, within)

    def _heavy(self, full: dict[str, str]) -> bool:
        try:
            first, last = self._compiler.groups
            mass, density = float(full.get("mass", "nan")), float(full.get("density", "1000"))
            return first <= float(full.get("group", "0")) <= last and mass != 0 and (density != 0 or mass == mass)
        except ValueError:
            # The parsers report the fault.
            return True

    def _read(self, name: str) -> bool:
        """Read a mesh for the parsers; return whether they can have it."""
        asset = self._assets.get(name)
        if name not in self._given:
            # A mesh that is not declared is left to the parsers to name.
            self._given[name] = self._content(asset) if asset and "file" in asset.attributes else ""
        return self._given[name] is not None

    def _content(self, asset: Element) -> str | None:
        named = asset.attributes["file"].replace("\\", "/")
        own = PurePosixPath(named).name if self._bare else named
        relative = PurePosixPath(self._meshdir.replace("\\", "/")) / own
        if relative.is_absolute() or PureWindowsPath(str(relative)).drive:
            self.unread.append(f"mesh {named[:200]!r} ({asset.place}): an absolute path is not followed")
            return None
        try:
            path = self._folder / relative
            if not path.is_file():
                self.unread.append(f"mesh {named[:200]!r} ({asset.place}): no such file in {path.parent}")
                return None
            content = path.read_bytes() if path.stat().st_size <= MOST_BYTES else None
        except (OSError, ValueError) as error:
            self.unread.append(f"mesh {named[:200]!r} ({asset.place}): cannot be read ({error})")
            return None
        if content is None or sum(map(len, self.files.values())) + len(content) > MOST_BYTES:
            self.unread.append(f"mesh {named[:200]!r} ({asset.place}): up to {MOST_BYTES} bytes of meshes are read")
            return None
        name = relative.name
        while name in self.files:
            name = f"_{name}"
        self.files[name] = content
        return name


def _parts(owner: Element, childclass: str | None, tag: str) -> Iterator[tuple[Element, str | None]]:
    """Yield the children of a tag with their class, and those in <frame> and <replicate> elements."""
    for child in owner.children:
        if child.tag in ("frame", "replicate"):
            yield from _parts(child, child.attributes.get("childclass", childclass), tag)
        elif child.tag == tag:
            yield child, childclass


def _stem(file: str) -> str:
    return PurePosixPath(file.replace("\\", "/")).stem


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
        kept = list(self._kept(element))
        if self._shapeless(element, kept):
            self.shapeless.append(element.attributes.get("name", "?"))
        below = (element.included_at or element.line) - self._line
        if below > 0:
            self.parts.append("\n" * below)
            self._line += below
        listing = "".join(f" {k}={quoteattr(v)}" for k, v in self._attributes(element).items())
        inside = escape(" ".join(element.text.split()))
        if not inside and not kept:
            self.parts.append(f"<{element.tag}{listing}/>")
            return
        self.parts.append(f"<{element.tag}{listing}>{inside}")
        for child in kept:
            self.write(child)
        self.parts.append(f"</{element.tag}>")

    def _shapeless(self, element: Element, kept: list[Element]) -> bool:
        """Return whether a body has lost shapes from which MuJoCo would have taken its inertia."""
        if self._meshes is not None:
            return element.tag == "body" and any(self._meshes.heavy(e) for e in element.all("geom"))
        lost = any(e.tag in ("collision", "visual") and e not in kept for e in element.children)
        return element.tag == "link" and element.first("inertial") is None and lost

    def _attributes(self, element: Element) -> dict[str, str]:
        own = element.attributes
        if self._meshes is None:
            return own
        left_out = {"material"}
        if element.tag == "compiler":
            left_out |= {"meshdir", "assetdir", "texturedir"}
        elif element.tag == "mesh":
            own = self._meshes.written(element) or own
        elif element.tag == "geom" and not self._meshes.has(own.get("mesh", "")):
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
                return element.tag != "mesh" or self._meshes.written(element) is None
            return element.tag == "geom" and self._meshes.lost(element)
        if element.tag == "transmission":
            # Without a type it says nothing, and Drake 1.51 ends the process over it.
            type_ = element.first("type")
            return type_ is None or not type_.text.strip()
        if element.tag in ("visual", "collision"):
            return any(e.tag in ("mesh", "texture") for e in element.walk())
        return any(mark in value for value in element.attributes.values() for mark in _OUTSIDE)
