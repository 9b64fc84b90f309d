"""A URDF or MJCF as it was written, less what would open another file.

An engine's own parser is given this text. Meshes, textures and packages are gone, and with
them the shapes that were made of them; boxes, cylinders and spheres stay, because MuJoCo may
take a body's inertia from them, and so does every other element.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.sax.saxutils import escape, quoteattr

from mbkit.errors import LoadError, ModelError
from mbkit.load import xml
from mbkit.load.attributes import Reader
from mbkit.load.floating import floated, with_base
from mbkit.load.includes import expanded
from mbkit.load.xml import Element

__all__ = ["Stripped", "strip"]

_FORMATS: Final = {"robot": "urdf", "mujoco": "mjcf"}
#: What names other files, or is nothing without what does.
_GONE: Final = {
    "urdf": frozenset({"texture", "gazebo", "sensor"}),
    "mjcf": frozenset({"asset", "sensor", "contact", "keyframe", "visual", "statistic", "custom", "skin", "camera"}),
}
_FOREIGN: Final = frozenset({"include", "attach", "flexcomp"})
_OUTSIDE: Final = ("package://", "file://", "model://", "http://", "https://")


@dataclass(frozen=True)
class Stripped:
    """What is left of a file.

    Attributes
    ----------
    path : pathlib.Path
    format : str
        ``"urdf"`` or ``"mjcf"``.
    root : Element
        As it was read, with the files that an MJCF includes.
    text : str
        What the parsers are given.
    gone : tuple of (str, int)
        Elements that were taken out, and how many.
    renamed : str
        What the base link is called, where it may not be ``world``; else empty.
    shapeless : tuple of str
        Bodies whose inertia might have come from a mesh that was taken out.
    """

    path: Path
    format: str
    root: Element
    text: str
    gone: tuple[tuple[str, int], ...]
    renamed: str
    shapeless: tuple[str, ...]


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
    root = xml.read(path)
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
    gone: Counter[str] = Counter()
    shapeless: list[str] = []
    text = _written(root, format_, gone, shapeless)
    return Stripped(path, format_, root, text, tuple(sorted(gone.items())), renamed, tuple(dict.fromkeys(shapeless)))


def _written(element: Element, format_: str, gone: Counter[str], shapeless: list[str]) -> str:
    kept = list(_kept(element, format_, gone))
    if element.tag in ("link", "body") and element.first("inertial") is None and len(kept) < len(element.children):
        lost = [c for c in element.children if c not in kept and c.tag in ("geom", "collision", "visual")]
        shapeless += [element.attributes.get("name", "?")] if lost else []
    attributes = {k: v for k, v in element.attributes.items() if not (format_ == "mjcf" and k == "material")}
    told = "".join(f" {k}={quoteattr(v)}" for k, v in attributes.items())
    inside = escape(element.text.strip()) + "".join(_written(c, format_, gone, shapeless) for c in kept)
    return f"<{element.tag}{told}>{inside}</{element.tag}>\n" if inside else f"<{element.tag}{told}/>\n"


def _kept(element: Element, format_: str, gone: Counter[str]) -> Iterable[Element]:
    for child in element.children:
        if child.tag in _GONE[format_] or _must_go(child, format_):
            gone[child.tag] += 1
        else:
            yield child


def _must_go(element: Element, format_: str) -> bool:
    if format_ == "mjcf":
        if element.tag == "geom":
            return "mesh" in element.attributes or element.attributes.get("type") in ("mesh", "sdf", "hfield")
        return element.tag in ("mesh", "material", "hfield")
    if element.tag == "transmission":
        # Without a type it says nothing, and Drake 1.51 ends the process over it.
        type_ = element.first("type")
        return type_ is None or not type_.text.strip()
    if element.tag in ("visual", "collision"):
        return any(e.tag in ("mesh", "texture") for e in element.walk())
    return any(mark in value for value in element.attributes.values() for mark in _OUTSIDE)
