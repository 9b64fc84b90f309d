"""What a link's shapes say of its matter: their hull, their volume, and the inertia of the hull."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from mbkit._check import TYPED, Array
from mbkit.load.shapes import MassProperties
from mbkit.show.surfaces import Indices
from mbkit.show.visuals import Shape


@dataclass(frozen=True, eq=False)
class Geometry:
    """All shapes of a link, visual and collision, in the link's axes.

    `hull` is their convex hull with density 1 kg/m³; `vertices` (n, 3) are its corners, and `planes` (m, 4) its faces:
    n x + d is the distance outside. `least` is the smallest volume that one kind of the shapes takes, m³: enclosed
    where its surfaces are closed, else that of its hull.
    """

    hull: MassProperties
    vertices: Array
    planes: Array
    least: float

    @property
    def size(self) -> float:
        """The diagonal of the box around it, m."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    def outside(self, point: Array) -> float:
        """Return how far a point is outside of the hull, m, at least; zero inside."""
        return max(0.0, float((self.planes[:, :3] @ point + self.planes[:, 3]).max()))

    def farthest(self, point: Array) -> float:
        """Return the distance of the corner that is farthest from a point, m."""
        return float(np.linalg.norm(self.vertices - point, axis=1).max())


def geometry_of(kinds: Iterable[list[Shape]]) -> Geometry | None:
    """Return the geometry of shapes, kind by kind; None where they span no volume."""
    parts = [[_placed(shape) for shape in shapes] for shapes in kinds if shapes]
    if not parts or (whole := _hull(np.concatenate([V for part in parts for V, _ in part]))) is None:
        return None
    volumes = []
    for part in parts:
        hull = _hull(np.concatenate([V for V, _ in part]))
        closed = all(_closed(V, T) for V, T in part)
        enclosed = sum(abs(solid_of(V, T).mass) for V, T in part) if closed else np.inf
        volumes += [min(enclosed, float(hull.volume))] if hull is not None else []
    least = min(volumes, default=float(whole.volume))
    return Geometry(_outward(whole), whole.points[whole.vertices], whole.equations, least)


def _placed(shape: Shape) -> tuple[Array, Indices]:
    """Return the surface of a shape in the link's axes."""
    firsts = np.cumsum([0, *(len(s.vertices) for s in shape.surfaces)])
    T = np.concatenate([s.triangles + k for s, k in zip(shape.surfaces, firsts, strict=False)])
    V = np.concatenate([s.vertices for s in shape.surfaces])
    return V @ shape.rotation.T + shape.translation, T


def _hull(V: Array) -> ConvexHull | None:
    extent = float(np.ptp(V, axis=0).max())
    try:
        hull = ConvexHull(V)
    except (QhullError, ValueError):
        return None
    return hull if hull.volume > TYPED * extent**3 else None


def _outward(hull: ConvexHull) -> MassProperties:
    """Return the mass properties of a hull, whose triangles Qhull does not turn outwards."""
    T = hull.simplices.astype(np.int64)
    a, b, c = (hull.points[T[:, k]] for k in range(3))
    inward = np.einsum("ni,ni->n", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    T[inward] = T[inward][:, ::-1]
    return solid_of(hull.points, T)


def solid_of(V: Array, T: Indices) -> MassProperties:
    """Return the mass properties at 1 kg/m³ of what closed triangles enclose.

    A sum over the tetrahedra to one point, by sign (Blow and Binstock 2004, How to find the inertia tensor of a 3D
    solid body).
    """
    o = V[T[:, 0]].mean(axis=0)
    corners = [V[T[:, k]] - o for k in range(3)]
    volumes = np.einsum("ni,ni->n", corners[0], np.cross(corners[1], corners[2])) / 6
    total, mass = sum(corners, np.zeros(3)), float(volumes.sum())
    if not mass:
        return MassProperties(0.0, o, np.zeros((3, 3)))
    com = np.asarray(volumes @ total) / (4 * mass)
    second = sum(np.einsum("n,ni,nj->ij", volumes, x, x) for x in (*corners, total)) / 20 - mass * np.outer(com, com)
    return MassProperties(mass, o + com, np.trace(second) * np.eye(3) - second)


def _closed(V: Array, T: Indices) -> bool:
    """Return whether every edge has two triangles, which run along it in opposite directions."""
    # Files repeat a vertex for each of its triangles.
    _, same = np.unique(V, axis=0, return_inverse=True)
    T = same.reshape(-1)[T]
    edges = np.concatenate([T[:, [0, 1]], T[:, [1, 2]], T[:, [2, 0]]])
    there, back = (edges @ order for order in ([len(V), 1], [1, len(V)]))
    return bool(np.array_equal(np.sort(there), np.sort(back)))
