"""Visual and collision shapes in the URDF or MJCF that a model came from. Meshes are opened here and nowhere else."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.errors import LoadError, UnknownNameError
from mbkit.load import xml_reader
from mbkit.load.mjcf_attributes import (
    Compiler,
    asset_name,
    compiled_model,
    matrix_of,
    mesh_assets,
    mesh_name,
    read_mesh,
)
from mbkit.load.mjcf_reader import write_out_attached
from mbkit.load.shapes import SIZES
from mbkit.load.xml_reader import Element, Reader, element_text
from mbkit.model import Frame, Model
from mbkit.model.description import ShapeFile
from mbkit.show.meshes import Color, Surface, cleaned, file_of, read_surfaces, solid

GREY: Final[Color] = (0.70, 0.72, 0.75, 1.0)
#: Groups of MJCF's geoms that MuJoCo's viewer shows without being asked.
_SHOWN_GROUPS: Final = range(3)


@dataclass(frozen=True, eq=False)
class Shape:
    """Something to draw on a body.

    Attributes
    ----------
    name, body : str
        The body is one of the model, or ``"world"``.
    rotation, translation : (3, 3) and (3,) arrays
        R_BS and p_BS_B, m.
    kind : str
        ``"mesh"``, or a solid of `mbkit.load.shapes.SIZES`.
    size : tuple of float
        Half lengths and radii of a solid, m.
    meshes : tuple of Surface
        Of a mesh, by material.
    color : tuple of float
        Red, green, blue and opacity in 0 to 1, where a mesh has none of its own.
    """

    name: str
    body: str
    rotation: Array
    translation: Array
    kind: str
    size: tuple[float, ...] = ()
    meshes: tuple[Surface, ...] = ()
    color: Color = GREY

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """The triangles, in the shape's axes."""
        return self.meshes if self.kind == "mesh" else (solid(self.kind, self.size),)


@dataclass
class Visuals:
    """The shapes that a file draws."""

    shapes: list[Shape] = field(default_factory=list)
    #: Bodies whose mesh is missing or unreadable, with the first reason of each.
    missing: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Bodies:
    """The bodies of a model whose names begin with a prefix, such as those of one of several joined files."""

    model: Model
    file: ShapeFile

    def frame(self, name: str) -> Frame:
        """Return a frame by its name in the file."""
        if name != "world":
            return self.model.frame(self.file.prefix + name)
        return Frame(name, self.file.body, np.array(self.file.rotation), np.array(self.file.translation))


def read_visuals(model: Model, kind: str) -> Visuals:
    """Return the "visual" or "collision" shapes of the files of a model; `LoadError` if one is unreadable."""
    out = Visuals()
    for file in model.sources:
        bodies, path, prefix = _Bodies(model, file), Path(file.path), file.prefix
        root = xml_reader.read(path)
        if root.tag == "robot":
            own = _Urdf(bodies, path, root).visuals(kind)
        else:
            own = _mjcf(bodies, path, xml_reader.with_includes(root, path), kind)
        out.shapes += [replace(x, name=prefix + x.name) for x in own.shapes]
        out.missing |= {name if name == "world" else prefix + name: why for name, why in own.missing.items()}
    return out


def _place(model: _Bodies, name: str) -> tuple[str, Array, Array] | None:
    """Return body, R and p of the frame of a link or body, or None where the model has none of that name."""
    try:
        frame = model.frame(name)
    except UnknownNameError:
        return None
    return frame.body, frame.rotation, frame.translation


class _Urdf:
    """A URDF's <visual> and <collision> elements (ROS wiki, urdf/XML/link)."""

    def __init__(self, model: _Bodies, source: Path, robot: Element) -> None:
        self.model, self.source, self.robot = model, source, robot
        folders = os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)
        folders += [f"{p}/share" for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
        self.folders = [Path(f) for f in folders if f]
        self.colors = {e.attributes.get("name", ""): c for e in robot.all("material") if (c := _rgba(e))}
        self.files: dict[tuple[str, tuple[float, ...]], tuple[Surface, ...]] = {}

    def visuals(self, kind: str) -> Visuals:
        out = Visuals()
        # A link of the ground's name has another one in the model.
        links = {e.attributes.get("name", ""): e for e in self.robot.all("link")}
        for link, element in links.items():
            place = _place(self.model, "world_link" if link == "world" and "world_link" not in links else link)
            place = place or _place(self.model, link)
            if place is None:
                continue
            body, R_BL, p_BL = place
            for k, visual in enumerate(element.all(kind)):
                R, p = _origin(visual)
                placed = (f"{link}.{k}" if k else link, body, R_BL @ R, p_BL + R_BL @ p)
                try:
                    out.shapes += self._shape(placed, visual)
                except (ValueError, TypeError) as error:
                    out.missing.setdefault(link, " ".join(str(error).split())[:200])
        return out

    def _shape(self, placed: tuple[str, str, Array, Array], visual: Element) -> Iterator[Shape]:
        geometry, material = visual.first("geometry"), visual.first("material")
        color = GREY
        if material is not None:
            color = _rgba(material) or self.colors.get(material.attributes.get("name", ""), GREY)
        for element in geometry.children if geometry else ():
            if element.tag == "mesh":
                reference = element.attributes.get("filename", "")
                scale = _numbers(element, "scale", 3, (1.0, 1.0, 1.0))
                own = self._meshes(reference, scale)
                # A colour of the URDF is meant for meshes without one.
                yield Shape(*placed, "mesh", meshes=own, color=color)
            elif element.tag == "box":
                yield Shape(*placed, "box", tuple(x / 2 for x in _sizes(element, "size", 3)), color=color)
            elif element.tag == "sphere":
                yield Shape(*placed, "sphere", _sizes(element, "radius", 1), color=color)
            elif element.tag in ("cylinder", "capsule"):
                size = (*_sizes(element, "radius", 1), _sizes(element, "length", 1)[0] / 2)
                yield Shape(*placed, element.tag, size, color=color)

    def _meshes(self, reference: str, scale: tuple[float, ...]) -> tuple[Surface, ...]:
        key = (reference, scale)
        if key not in self.files:
            path = file_of(reference, self.source, self.folders)
            if path is None:
                raise ValueError(f"no such file: {reference}")
            surfaces = read_surfaces(path)
            if scale != (1.0, 1.0, 1.0):
                # A mirrored surface is turned inside out, and back.
                turn = slice(None, None, -1 if np.prod(scale) < 0 else 1)
                surfaces = tuple(Surface(s.vertices * scale, s.triangles[:, turn], s.color) for s in surfaces)
            self.files[key] = surfaces
        return self.files[key]


def _numbers(element: Element, name: str, count: int, default: tuple[float, ...] | None = None) -> tuple[float, ...]:
    read = Reader()
    out = read.numbers(element, name, element.tag, count=count, default=default)
    if read.faults:
        raise ValueError(read.faults[0])
    return out


def _sizes(element: Element, name: str, count: int) -> tuple[float, ...]:
    out = _numbers(element, name, count)
    if min(out) <= 0:
        raise ValueError(f"{element.tag} {name}: expected numbers above 0")
    return out


def _origin(element: Element) -> tuple[Array, Array]:
    origin = element.first("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    read, zero = Reader(), (0.0, 0.0, 0.0)
    p, rpy = (read.numbers(origin, name, "origin", count=3, default=zero) for name in ("xyz", "rpy"))
    return spatial.matrix_from_rpy(rpy[0], rpy[1], rpy[2]), np.array(p)


def _rgba(material: Element) -> Color | None:
    color = material.first("color")
    if color is None or "rgba" not in color.attributes:
        return None
    r, g, b, a = Reader().numbers(color, "rgba", "color", count=4, default=GREY)
    return (r, g, b, a)


# MJCF, by MuJoCo's compiler: defaults, frames, materials, inline meshes and sizes that are fitted to meshes


def _mjcf(model: _Bodies, source: Path, mujoco: Element, kind: str) -> Visuals:
    out, assets = Visuals(), dict[str, bytes]()
    settings = Compiler.of(mujoco, Reader())
    write_out_attached(mujoco, source, settings, Reader())
    missing: dict[str, str] = {}
    for name, mesh in mesh_assets(mujoco).items():
        file = mesh.attributes.get("file", "")
        path = source.parent / settings.mesh_path(file)
        if not file:
            continue
        content, why = read_mesh(path)
        if why:
            missing[name] = why
            continue
        own = asset_name(content, path)
        assets[own] = content
        mesh.attributes |= {"name": name, "file": own}
    text = "".join(_written(e, missing, out) for e in mujoco.children if e.tag in ("default", "asset", "worldbody"))
    names = {"angle", "eulerseq", "autolimits", "inertiafromgeom", "fitaabb", "boundmass", "boundinertia"}
    merged = {k: x for k, x in settings.attributes.items() if k in names}
    # A body without mass for want of its mesh compiles, too.
    merged |= {"boundmass": "1e-9", "boundinertia": "1e-9", "balanceinertia": "true"}
    try:
        compiled = compiled_model(merged, text, assets)
    except ValueError as error:
        raise LoadError(f"{source}: MuJoCo's compiler refuses its shapes: {error}") from None
    out.shapes += _geoms(model, compiled, kind)
    return out


def _written(element: Element, missing: dict[str, str], out: Visuals, body: str = "world") -> str:
    """Return an element without lost meshes, textures, and what says nothing about shapes."""
    if element.tag in ("texture", "hfield", "skin", "model", "plugin", "camera", "light", "flexcomp"):
        return ""
    if element.tag == "body":
        body = element.attributes.get("name", "")
    name = mesh_name(element) if element.tag == "mesh" else element.attributes.get("mesh", "")
    if element.tag in ("mesh", "geom") and (name in missing or element.attributes.get("type") == "hfield"):
        if element.tag == "geom" and name in missing:
            out.missing.setdefault(body, missing[name])
        return ""
    attributes = {k: x for k, x in element.attributes.items() if k != "texture"}
    return element_text(element.tag, attributes, "".join(_written(e, missing, out, body) for e in element.children))


def _geoms(model: _Bodies, compiled: Any, kind: str) -> Iterator[Shape]:
    meshes: dict[int, tuple[Surface, ...]] = {}
    for k in range(compiled.ngeom):
        geom = compiled.geom(k)
        collides = bool(geom.contype[0] or geom.conaffinity[0])
        if (int(geom.group[0]) not in _SHOWN_GROUPS) if kind == "visual" else not collides:
            continue
        number = int(geom.bodyid[0])
        # The loader numbers bodies without a name in MuJoCo's order.
        name = compiled.body(number).name or f"body{number}"
        place = _place(model, name)
        shape = _GEOMS[int(geom.type[0])] if int(geom.type[0]) < len(_GEOMS) else ""
        if place is None or shape not in ("mesh", *SIZES):
            continue
        body, R_BF, p_BF = place
        R = R_BF @ matrix_of(geom.quat)
        material = int(geom.matid[0])
        rgba = compiled.mat_rgba[material] if material >= 0 else geom.rgba
        placed = (geom.name or f"{name}.{k}", body, R, p_BF + R_BF @ geom.pos)
        color = (float(rgba[0]), float(rgba[1]), float(rgba[2]), float(rgba[3]))
        if shape == "mesh":
            mesh = int(geom.dataid[0])
            if mesh not in meshes:
                meshes[mesh] = (_mesh(compiled, mesh),)
            yield Shape(*placed, shape, meshes=meshes[mesh], color=color)
        else:
            yield Shape(*placed, shape, tuple(float(s) for s in geom.size[: SIZES[shape]]), color=color)


#: Kinds of geoms by their numbers in mjtGeom.
_GEOMS: Final = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")


def _mesh(compiled: Any, mesh: int) -> Surface:
    first, count = compiled.mesh_vertadr[mesh], compiled.mesh_vertnum[mesh]
    start, faces = compiled.mesh_faceadr[mesh], compiled.mesh_facenum[mesh]
    return cleaned(compiled.mesh_vert[first : first + count], compiled.mesh_face[start : start + faces])
