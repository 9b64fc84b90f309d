"""Triangles of the shapes that are drawn: solids of revolution, boxes, and meshes with fewer triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array

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
