"""Triangles of what is drawn: round shapes, boxes, and meshes from files.

OBJ and COLLADA are read with the colours of their materials, all else by Assimp in Pinocchio's coal.

coal makes one surface of a file and drops its materials, so the two formats that have any are read here. coal 3.0.3
also gives the triangles of a node's second mesh the vertices of the first one, and each material is a mesh there. Files
are those of strangers: whatever is wrong with one is a ValueError. That is why pycollada 0.9.3 and trimesh 5.2.0 do not
read them: a mesh without one of its materials gets lost (of 343 public meshes the foot of ANYmal, with all its 4,604
triangles), NaN becomes zero, a wrong index an empty mesh, and trimesh rounds colours to bytes.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array, by_key
from mbkit.errors import LoadError
from mbkit.load import xml_reader
from mbkit.load.mjcf_attributes import about, read_mesh
from mbkit.load.xml_reader import MAX_DEPTH, MAX_ELEMENTS, Element

Indices = NDArray[np.int64]
Color = tuple[float, float, float, float]
#: Sides of a round shape.
_ROUND_SIDES: Final = 32
#: A mesh of fewer triangles stays as it is, and one of more is at least so many cells long.
_MIN_CLUSTERED_TRIANGLES: Final = 150
_MIN_CELLS_ALONG: Final = 5


@dataclass(frozen=True, eq=False)
class Surface:
    """Vertices (n, 3) in m, triangles (m, 3) of their indices, and a colour in 0 to 1 where a file has one."""

    vertices: Array
    triangles: Indices
    color: Color | None = None

    def area(self) -> float:
        """Return the area in m²."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@lru_cache(maxsize=512)
def solid(kind: str, size: tuple[float, ...]) -> Surface:
    """Return the surface of a shape with half lengths and radii as MuJoCo's; the long axis is z."""
    if kind == "box":
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
        quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
        return Surface(corners, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))
    turns = np.linspace(-np.pi / 2, np.pi / 2, _ROUND_SIDES // 2 + 1)
    r, z = np.cos(turns), np.sin(turns)
    if kind == "cylinder":
        return _revolved(np.array([0, size[0], size[0], 0]), np.array([-size[1], -size[1], size[1], size[1]]))
    if kind == "capsule":
        upper, half = z[_ROUND_SIDES // 4 :], _ROUND_SIDES // 4
        ends = np.concatenate([size[0] * z[: half + 1] - size[1], size[0] * upper + size[1]])
        return _revolved(size[0] * np.concatenate([r[: half + 1], r[half:]]), ends)
    ball = _revolved(r, z)
    return Surface(ball.vertices * (size * 3 if len(size) == 1 else size), ball.triangles)


def _revolved(r: Array, z: Array) -> Surface:
    """Return a profile turned about z, whose first and last radius are zero."""
    angles = np.arange(_ROUND_SIDES) * (2 * np.pi / _ROUND_SIDES)
    rings = np.stack([np.outer(r[1:-1], np.cos(angles)), np.outer(r[1:-1], np.sin(angles))], axis=-1)
    heights = np.broadcast_to(z[1:-1, None, None], (*rings.shape[:2], 1))
    ends = np.array([[0, 0, z[0]], [0, 0, z[-1]]])
    vertices = np.concatenate([np.concatenate([rings, heights], axis=-1).reshape(-1, 3), ends])
    own = np.arange(_ROUND_SIDES)
    after, count = (own + 1) % _ROUND_SIDES, len(r) - 2
    bottom, top = count * _ROUND_SIDES, count * _ROUND_SIDES + 1
    parts = [np.stack([np.full(_ROUND_SIDES, bottom), after, own], axis=1)]
    for k in range(count - 1):
        a, b = k * _ROUND_SIDES, (k + 1) * _ROUND_SIDES
        parts += [np.stack([a + own, a + after, b + after], axis=1), np.stack([a + own, b + after, b + own], axis=1)]
    last = (count - 1) * _ROUND_SIDES
    parts.append(np.stack([last + own, last + after, np.full(_ROUND_SIDES, top)], axis=1))
    return Surface(vertices, np.concatenate(parts).astype(np.int64))


def thinned(surfaces: Sequence[Surface], most: int) -> list[Surface]:
    """Return surfaces of about `most` triangles together, or fewer.

    Vertices in one cell of a grid, the same in all surfaces, become one (Rossignac and Borrel 1993, Multi-resolution
    3D approximations for rendering complex scenes).
    """
    total = sum(len(s.triangles) for s in surfaces)
    if total <= most:
        return list(surfaces)
    # Two triangles a cell, so that the first size is nearly the last.
    cell = float(np.sqrt(2 * sum(s.area() for s in surfaces) / most)) / 2
    largest = max(float(np.ptp(s.vertices, axis=0).max()) for s in surfaces)
    out = list(surfaces)
    while total > most and cell < largest:
        out = [s if len(s.triangles) < _MIN_CLUSTERED_TRIANGLES else _clustered(s, cell) for s in surfaces]
        total = sum(len(s.triangles) for s in out)
        cell *= 1.25
    return out


def _clustered(surface: Surface, cell: float) -> Surface:
    low, extent = surface.vertices.min(axis=0), np.ptp(surface.vertices, axis=0)
    # A small part stays a solid.
    cell = min(cell, float(extent.max()) / _MIN_CELLS_ALONG)
    cells = np.floor((surface.vertices - low) / cell).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    keys = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    _, which, counts = np.unique(keys, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(which, x) for x in surface.vertices.T], axis=1) / counts[:, None]
    # Means lie inside; without the whole extent links that touch would be drawn apart.
    own = np.ptp(mean, axis=0)
    mean = low + (mean - mean.min(axis=0)) * np.divide(extent, own, out=np.ones(3), where=own > 0)
    try:
        return cleaned(mean, which[surface.triangles], surface.color)
    except ValueError:
        # Thinner than a cell in two directions.
        return surface


def cleaned(vertices: Any, triangles: Any, color: Color | None = None) -> Surface:
    """Return a surface without degenerate or repeated triangles and unused vertices; `ValueError` if none is left."""
    V, T = np.asarray(vertices, dtype=np.float64).reshape(-1, 3), np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    if not len(T) or T.min() < 0 or T.max() >= len(V):
        raise ValueError("no triangles, or some with vertices that are not there")
    triangles_left = T[(T[:, 0] != T[:, 1]) & (T[:, 1] != T[:, 2]) & (T[:, 2] != T[:, 0])]
    if len(triangles_left):
        _, first = np.unique(np.sort(triangles_left, axis=1), axis=0, return_index=True)
        triangles_left = triangles_left[np.sort(first)]
    if not len(triangles_left):
        raise ValueError("all triangles are points or lines")
    used, own = np.unique(triangles_left, return_inverse=True)
    if not np.isfinite(V[used]).all():
        raise ValueError("vertices that are not finite numbers")
    return Surface(V[used], own.reshape(-1, 3), color)


_MAX_TRIANGLES: Final = 10_000_000
_MAX_MATERIALS: Final = 5000
#: Pixels of a texture, 8192 by 8192: decoded it has 256 MiB.
_MAX_TEXTURE_PIXELS: Final = 2**26

MeanColor = Callable[[Path], Color | None]


def read_surfaces(path: Path) -> tuple[Surface, ...]:
    """Return the surfaces in a mesh file, one a colour, in the file's units; ValueError where there is none."""
    content, why = read_mesh(path)
    if why:
        raise ValueError(why)
    suffix = path.suffix.lower()
    # A file can name one picture many times.
    mean_color = cache(_mean_color)
    try:
        if suffix == ".dae":
            # Numbers that are not finite are refused once all is read.
            with np.errstate(invalid="ignore"):
                surfaces = list(_Collada(content, path, mean_color).surfaces())
        elif suffix == ".obj":
            surfaces = _wavefront(content.decode("utf-8", "replace"), path.parent, mean_color)
        else:
            surfaces = [_by_coal(path)]
    except (LoadError, ArithmeticError, LookupError, TypeError) as error:
        raise ValueError(f"not readable: {error}") from None
    if not surfaces:
        raise ValueError("no triangles in it")
    return tuple(map(_joined, by_key((surface.color, surface) for surface in surfaces).values()))


def _joined(surfaces: list[Surface]) -> Surface:
    """Return surfaces of one colour as one."""
    firsts = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    triangles = [s.triangles + first for s, first in zip(surfaces, firsts, strict=False)]
    vertices = np.concatenate([s.vertices for s in surfaces])
    if not np.isfinite(vertices).all():
        raise ValueError("vertices that are not finite numbers")
    return Surface(vertices, np.concatenate(triangles), surfaces[0].color)


def _by_coal(path: Path) -> Surface:
    # Pinocchio brings it; only meshes need it.
    import coal

    try:
        mesh = coal.MeshLoader(coal.BV_AABB).load(str(path), np.ones(3))
    except Exception as error:
        raise ValueError(str(error).partition("message:")[2].strip() or str(error)) from None
    triangles = [[t[0], t[1], t[2]] for t in map(mesh.tri_indices, range(mesh.num_tris))]
    if len(np.unique(triangles)) < len(mesh.vertices()):
        raise ValueError("coal mixes up the meshes of a node; save it as OBJ or COLLADA")
    return cleaned(mesh.vertices(), triangles)


# Wavefront OBJ (Alias 1993, Object Files)


def _wavefront(text: str, folder: Path, mean_color: MeanColor) -> list[Surface]:
    points: list[list[float]] = []
    faces: dict[str, list[tuple[int, int, int]]] = {}
    libraries: list[str] = []
    own = faces.setdefault("", [])
    # A line goes on after a backslash.
    for line in text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        kind, _, rest = line.strip().partition(" ")
        if kind == "v":
            points.append([float(x) for x in rest.split()[:3]])
        elif kind == "f":
            corners = [int(word.partition("/")[0]) for word in rest.split()]
            corners = [c - 1 if c > 0 else len(points) + c for c in corners]
            own += [(corners[0], a, b) for a, b in pairwise(corners[1:])]
        elif kind == "usemtl":
            own = faces.setdefault(rest.strip(), [])
        elif kind == "mtllib":
            libraries.append(Path(rest.strip()).name)
    if any(len(p) != 3 for p in points):
        raise ValueError("a vertex without three coordinates")
    if max(len(faces), len(libraries)) > _MAX_MATERIALS:
        raise ValueError(f"more than {_MAX_MATERIALS} materials")
    colors: dict[str, Color | None] = {}
    for library in dict.fromkeys(libraries):
        colors |= _materials(folder / library, mean_color)
    V = np.array(points)
    return [cleaned(V, triangles, colors.get(name)) for name, triangles in faces.items() if triangles]


def _materials(path: Path, mean_color: MeanColor) -> dict[str, Color | None]:
    content, _ = read_mesh(path)
    out: dict[str, Color | None] = {}
    name = ""
    for line in content.decode("utf-8", "replace").splitlines():
        kind, *words = line.split() or [""]
        if kind == "newmtl":
            name = " ".join(words)
        elif kind == "Kd" and len(words) >= 3 and name not in out:
            out[name] = _rgb(words)
        elif kind == "map_Kd" and words and (mean := mean_color(path.parent / Path(words[-1]).name)):
            out[name] = mean
    return out


def _rgb(words: Sequence[str]) -> Color | None:
    """Return a colour, or None where its numbers are not finite."""
    r, g, b = (float(w) for w in words[:3])
    return (r, g, b, 1.0) if math.isfinite(r + g + b) else None


def _mean_color(image: Path) -> Color | None:
    """Return the mean colour of a picture, in place of a texture."""
    content, _ = read_mesh(image)
    try:
        from PIL import Image

        # A pipe is not opened, and a picture is decoded only if it fits.
        with Image.open(io.BytesIO(content)) as picture:
            if math.prod(picture.size) > _MAX_TEXTURE_PIXELS:
                return None
            r, g, b = np.asarray(picture.convert("RGB").resize((16, 16))).reshape(-1, 3).mean(axis=0) / 255
    except Exception:
        # Any: a texture is not worth an error.
        return None
    return (float(r), float(g), float(b), 1.0)


# COLLADA (Barnes and Finch 2008, COLLADA Digital Asset Schema 1.4.1)


class _Collada:
    """The triangles below the nodes of a file, in metres; like RViz and Assimp in coal, it ignores which way is up."""

    def __init__(self, content: bytes, path: Path, mean_color: MeanColor) -> None:
        self.folder, self.mean_color = path.parent, mean_color
        self.root = xml_reader.parse(content, path.name)
        self.by_id = {e.attributes["id"]: e for e in self.root.walk() if "id" in e.attributes}
        units = [u for asset in self.root.all("asset") for u in asset.all("unit")]
        self.unit = float(units[0].attributes.get("meter", 1)) if units else 1.0
        # A file can use one geometry and one effect many times.
        self.geometry, self.diffuse = cache(self._geometry), cache(self._diffuse)
        self.elements = self.count = 0

    def surfaces(self) -> Iterator[Surface]:
        for scene in (e for library in self.root.all("library_visual_scenes") for e in library.all("visual_scene")):
            for node in scene.all("node"):
                yield from self._below(node, self.unit * np.eye(4), 0)

    def _target(self, url: str) -> Element | None:
        return self.by_id.get(url.removeprefix("#"))

    def _below(self, node: Element, above: Array, depth: int) -> Iterator[Surface]:
        self.elements += sum(1 for _ in node.walk())
        # A short file can use a node in itself, or one node for ever.
        if depth > MAX_DEPTH or self.elements > MAX_ELEMENTS:
            raise ValueError(f"nodes nested more than {MAX_DEPTH} deep, or more than {MAX_ELEMENTS} elements in them")
        X = above
        for child in node.children:
            if child.tag in ("matrix", "translate", "rotate", "scale"):
                X = X @ _transform(child)
        for child in node.children:
            target = self._target(child.attributes.get("url", ""))
            if child.tag == "node":
                yield from self._below(child, X, depth + 1)
            elif child.tag == "instance_node" and target:
                yield from self._below(target, X, depth + 1)
            elif child.tag == "instance_geometry" and target:
                materials = (e.attributes for e in child.walk() if e.tag == "instance_material")
                bound = {m.get("symbol", ""): m.get("target", "") for m in materials}
                for symbol, s in self.geometry(target):
                    self.count += len(s.triangles)
                    if self.count > _MAX_TRIANGLES:
                        raise ValueError(f"more than {_MAX_TRIANGLES} triangles")
                    V = s.vertices @ X[:3, :3].T + X[:3, 3]
                    yield Surface(V, s.triangles, self._color(bound.get(symbol, symbol)))

    def _geometry(self, geometry: Element) -> list[tuple[str, Surface]]:
        """Return the surfaces of a geometry, in its own axes, with the names of their materials."""
        parts_of_mesh = (e for mesh in geometry.all("mesh") for e in mesh.children)
        parts = [(e, self._part(e)) for e in parts_of_mesh if e.tag in ("triangles", "polylist", "polygons")]
        return [(e.attributes.get("material", ""), s) for e, s in parts if s]

    def _part(self, part: Element) -> Surface | None:
        at, positions = self._positions(part)
        triangles = _triangles(part, at) if positions.size else ()
        return cleaned(positions, triangles) if len(triangles) else None

    def _positions(self, part: Element) -> tuple[int, Array]:
        for used in part.all("input"):
            vertices = self._target(used.attributes.get("source", ""))
            if used.attributes.get("semantic") != "VERTEX" or vertices is None:
                continue
            for own in vertices.all("input"):
                source = self._target(own.attributes.get("source", ""))
                if own.attributes.get("semantic") == "POSITION" and source and (array := source.first("float_array")):
                    return int(used.attributes.get("offset", 0)), _numbers(array.text, float).reshape(-1, 3)
        return 0, np.empty((0, 3))

    def _color(self, material: str) -> Color | None:
        element = self._target(material)
        instance = element.first("instance_effect") if element else None
        effect = self._target(instance.attributes.get("url", "")) if instance else None
        return self.diffuse(effect) if effect else None

    def _diffuse(self, effect: Element) -> Color | None:
        diffuse = next((e for e in effect.walk() if e.tag == "diffuse"), None)
        if diffuse is None:
            return None
        if color := diffuse.first("color"):
            return _rgb(color.text.split())
        # A texture names a sampler, which names a surface, which names an image.
        name = next((t.attributes.get("texture", "") for t in diffuse.all("texture")), "")
        parameters = {e.attributes.get("sid", ""): e for e in effect.walk() if e.tag == "newparam"}
        for tag in ("source", "init_from"):
            if name in parameters:
                name = next((e.text.strip() for e in parameters[name].walk() if e.tag == tag), "")
        image = self._target(name)
        file = next((e.text.strip() for e in image.walk() if e.tag == "init_from"), "") if image else ""
        return self.mean_color(self.folder / file) if file and ":" not in file and not file.startswith("/") else None


def _numbers(text: str, kind: type) -> np.ndarray:
    try:
        # A blank text would become a number.
        return np.fromstring(text.strip(), dtype=kind, sep=" ")
    except ValueError:
        # Slower, but its error names the word.
        return np.array(text.split(), dtype=kind)


def _transform(element: Element) -> Array:
    x, X = _numbers(element.text, float), np.eye(4)
    if element.tag == "matrix":
        return np.asarray(x.reshape(4, 4))
    if element.tag == "translate":
        X[:3, 3] = x
    elif element.tag == "rotate":
        X[:3, :3] = about(x[:3], np.deg2rad(x[3])) if x[:3].any() else np.eye(3)
    else:
        X[:3, :3] = np.diag(x)
    return X


def _triangles(part: Element, at: int) -> Indices:
    """Return the vertices of triangles, entry `at` of each corner in <p>; polygons become fans."""
    stride = 1 + max((int(i.attributes.get("offset", 0)) for i in part.all("input")), default=0)
    lists = [_numbers(p.text, int).reshape(-1, stride)[:, at] for p in part.all("p")]
    corners: Indices = np.concatenate([np.empty(0, int), *lists])
    if part.tag == "triangles":
        return corners.reshape(-1, 3)
    vcount = part.first("vcount")
    counts = np.array([len(x) for x in lists], int) if vcount is None else _numbers(vcount.text, int)
    if counts.min(initial=0) < 0 or max(counts.max(initial=0), counts.sum()) > len(corners):
        raise ValueError("more corners than there are in <p>")
    starts = np.cumsum(counts) - counts
    fans = np.maximum(counts - 2, 0)
    first = np.repeat(starts, fans)
    k = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans) + 1
    return np.stack([corners[first], corners[first + k], corners[first + k + 1]], axis=1)


def file_of(reference: str, description: Path, folders: list[Path]) -> Path | None:
    """Return the file that a URDF's ``package://``, ``file://`` or relative reference means, or None.

    A package is a folder of that name, above the description or in one of the folders.
    """
    scheme = re.match(r"([a-z]+)://", reference)
    rest = reference[scheme.end() :] if scheme else reference
    if scheme and scheme[1] not in ("package", "model", "file"):
        return None
    if not scheme or scheme[1] == "file":
        candidates = [description.parent / rest]
    else:
        rest = rest.lstrip("/")
        package, _, inside = rest.partition("/")
        above = list(description.resolve().parents)
        candidates = [folder / rest for folder in (*above, *folders)]
        candidates += [folder / inside for folder in above if folder.name == package]
    try:
        return next((c for c in candidates if c.is_file()), None)
    except (OSError, ValueError):
        return None
