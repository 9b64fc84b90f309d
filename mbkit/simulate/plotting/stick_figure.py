"""A tree as sticks: from joint to joint, and at the ends to the farthest frame or the centre of mass.

Bodies that fixed joints hold together are one link. Places follow from the description alone, without an engine.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit.errors import InputError
from mbkit.model import Joint, Model
from mbkit.model.elements.beams import OnBeam
from mbkit.model.poses import body_poses, inertia_box


@dataclass(frozen=True)
class Skeleton:
    """Points in world axes at n configurations."""

    # (S, 2, n, 3): ends of each link's sticks; a sliding joint on another link from its zero to its place.
    links: Array
    slides: Array
    # (S, n, 3): joints; bodies that slide on the ground; tips that are centres of mass; feet on the ground.
    joints: Array
    carts: Array
    masses: Array
    anchors: Array
    # (S, 8, n, 3): corners, x changing slowest, of a box with the inertia of a body with nothing to draw.
    boxes: Array
    # (n, 3): the point whose path is drawn.
    path: Array

    def points(self) -> Array:
        """Return all points, (P, n, 3)."""
        parts = (self.links, self.slides, self.joints, self.carts, self.anchors, self.boxes, self.path)
        return np.concatenate([part.reshape(-1, *self.path.shape) for part in parts])


def skeleton(model: Model, q: Array) -> Skeleton:
    """Return the sticks at configurations (n, nq)."""
    n = len(q)
    tree = _Tree(model, q)
    parts: dict[str, list[Any]] = {name: [] for name in Skeleton.__dataclass_fields__ if name != "path"}
    for joint in tree.moving:
        if isinstance(joint.type, OnBeam):
            parts["links"] += tree.bend(joint)
            continue
        parent, base, place = tree.link[joint.parent], tree.bases[joint.name], tree.origin(joint.child)
        flies, slides = joint.type.floating, _slides(joint)
        if parent != "world":
            parts["links"] += [] if flies else [[tree.origin(parent), base]]
            parts["slides"] += [[base, place]] if slides else []
        else:
            foot = base if joint.parent == "world" else tree.origin(tree.ground[joint.parent])
            parts["links"] += [] if joint.parent == "world" else [[foot, base]]
            parts["anchors"] += [] if flies or slides else [foot]
            parts["carts"] += [place] if slides else []
        parts["joints"] += [] if flies or slides else [place]
    for link, point in tree.loop_ends:
        parts["anchors" if link == "world" else "joints"].append(point)
        parts["links"] += [] if link == "world" else [[tree.origin(link), point]]
    path, deepest = np.zeros((n, 3)), 0
    carrying = {tree.link[joint.parent] for joint in tree.moving}
    for joint in tree.moving:
        link = joint.child
        if link in carrying:
            continue
        here = tree.origin(link)
        tip, weighs = tree.tip(link)
        if tip is not None:
            parts["links"].append([here, tip])
            parts["masses"] += [tip] if weighs else []
        elif not _slides(joint):
            parts["boxes"].append(tree.box(link))
        if tree.depth[link] > deepest:
            path, deepest = here if tip is None else tip, tree.depth[link]
    if tree.moving and tree.moving[0].type.floating:
        base_body = tree.moving[0].child
        path = tree.at(base_body, model.body(base_body).com)
    ends = {"links": (2,), "slides": (2,), "boxes": (8,)}
    arrays = {k: np.array(x, dtype=np.float64).reshape(len(x), *ends.get(k, ()), n, 3) for k, x in parts.items()}
    return Skeleton(**arrays, path=path)


def _slides(joint: Joint) -> bool:
    return bool(joint.type.lengths) and not joint.type.floating


class _Tree:
    """The poses of all bodies, and what link each belongs to: it goes by the name of its first body."""

    def __init__(self, model: Model, q: Array) -> None:
        self._model = model
        self._poses = body_poses(model, q)
        #: Places of the joints on their parents.
        self.bases: dict[str, Array] = {}
        self.link, self.depth = {"world": "world"}, {"world": 0}
        #: The body on the world that carries each body.
        self.ground: dict[str, str] = {}
        self.moving = [joint for joint in model.tree if joint.type.nv]
        for joint in model.tree:
            parent, child = joint.parent, joint.child
            self.bases[joint.name] = self.at(parent, joint.translation)
            self.link[child] = child if joint.type.nv else self.link[parent]
            self.ground[child] = self.ground.get(parent, child)
            if joint.type.nv:
                self.depth[child] = self.depth[self.link[parent]] + 1
        ends = [(x.body_a, x.translation_a) for x in model.loops] + [(x.body_b, x.translation_b) for x in model.loops]
        #: The links that loops join, and the points where they do.
        self.loop_ends = [(self.link[body], self.at(body, point)) for body, point in ends]

    def bend(self, joint: Joint) -> list[list[Array]]:
        """Return the pieces of a beam's axis, of its end."""
        points = [j for j in self.moving if j.mimic and j.mimic.joint == joint.name]
        line = [self.bases[joint.name], *(self.origin(j.child) for j in points), self.origin(joint.child)]
        return [] if joint.mimic else [[a, b] for a, b in pairwise(line)]

    def at(self, body: str, point: Array) -> Array:
        """Return a point of a body in world axes, (n, 3)."""
        R, p = self._poses[body]
        return np.asarray(p + R @ point)

    def origin(self, body: str) -> Array:
        """Return the place of a body's frame, (n, 3)."""
        return self._poses[body][1]

    def tip(self, link: str) -> tuple[Array | None, bool]:
        """Return the end of a last link, and whether it is a centre of mass."""
        here, model = self.origin(link), self._model
        bodies = [model.body(name) for name, own in self.link.items() if own == link and name != "world"]
        names = [body.name for body in bodies]
        places = [self.origin(name) for name in names]
        places += [self.at(f.body, f.translation) for f in model.frames if f.body in names]
        places += [point for own, point in self.loop_ends if own == link]
        masses = [self.at(body.name, body.com) for body in bodies if body.mass]
        for points, weigh in ((places, False), (masses, True)):
            far = max(points, key=lambda p: float(np.linalg.norm(p[0] - here[0])), default=here)
            # Shorter lengths of robots are rounding.
            if np.linalg.norm(far[0] - here[0]) > 1e-6:
                return far, weigh or any(np.allclose(far[0], m[0], rtol=0, atol=1e-9) for m in masses)
        return None, False

    def box(self, name: str) -> Array:
        """Return the corners of the uniform box with a body's mass and inertia, (8, n, 3)."""
        body = self._model.body(name)
        axes, half = inertia_box(body)
        return np.array([self.at(name, body.com + axes @ (half * s)) for s in product((-1, 1), repeat=3)])


# The plane of a picture of a motion in space: two orthonormal rows, to the right and upwards, in world axes.

_AXES: Final = "xyz"
# A world axis that shows this much of the widest spread reads better than a slanted one.
_NEARLY: Final = 0.9
# A motion flatter than this, seen from the side, is a line: it is seen from above.
_FLAT: Final = 0.02


def direction_name(direction: Array) -> str:
    """Return a world axis's name, or the components."""
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) > 1 - 1e-9:
        return ("-" if direction[k] < 0 else "") + _AXES[k]
    return "(" + ", ".join(f"{x:.2g}" for x in direction + 0.0) + ")"


def plane_of(view: str | ArrayLike | None, points: Array, gravity: Array) -> Array:
    """Return the plane (2, 3) of the argument `view`, or the one that shows most of the points (P, 3)."""
    if view is None:
        return np.array(_widest(points - points.mean(axis=0), gravity))
    if isinstance(view, str):
        if len(view) != 2 or view[0] == view[1] or not set(view) <= set(_AXES):
            raise InputError(f"view: expected two of x, y and z such as 'xz', or two directions, got {view!r}")
        return np.eye(3)[[_AXES.index(a) for a in view]]
    right, up = finite_array("view", view, (2, 3))
    lengths = np.linalg.norm(right), np.linalg.norm(up)
    if not all(lengths) or np.linalg.norm(np.cross(right, up)) < 1e-9 * lengths[0] * lengths[1]:
        raise InputError("view: expected two directions that are not along one line")
    right = right / lengths[0]
    return np.array([right, _across(up, right)])


def _across(x: Array, direction: Array) -> Array:
    """Return the unit vector of the part of x that is normal to a direction."""
    x = x - (x @ direction) * direction
    return np.asarray(x / np.linalg.norm(x))


def _positive(x: Array) -> Array:
    return x if x[np.argmax(np.abs(x))] > 0 else -x


def _widest(points: Array, gravity: Array) -> tuple[Array, Array]:
    g = float(np.linalg.norm(gravity))
    if g:
        up = -gravity / g
        right = _spread(points, up)
        ahead = np.cross(up, right)
        tall, wide, deep = (float(np.ptp(points @ x)) for x in (up, right, ahead))
        return right, up if tall > _FLAT * max(wide, deep) or deep <= tall else ahead
    # Nothing says where up is: the plane that shows most, z or else y upwards in it.
    squares, axes = np.linalg.eigh(points.T @ points)
    normal = axes[:, 0]
    k = int(np.argmax(np.abs(normal)))
    if points[:, k] @ points[:, k] <= squares[0] / _NEARLY**2 + 1e-12 * squares[2]:
        normal = np.eye(3)[k]
    up = _across(np.eye(3)[1 if abs(normal[2]) > _NEARLY else 2], normal)
    return _positive(np.cross(up, normal)), up


def _spread(points: Array, up: Array) -> Array:
    """Return the direction across `up` in which the points are widest, a world axis if one nearly is."""
    across = points - np.outer(points @ up, up)
    squares, axes = np.linalg.eigh(across.T @ across)
    for axis in np.eye(3):
        if abs(axis @ up) < 1e-9 and np.sum((across @ axis) ** 2) >= _NEARLY**2 * squares[2]:
            return np.asarray(axis)
    if not squares[2]:
        # Only up and down: any level direction.
        return _positive(_across(np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))]), up))
    return _positive(_across(axes[:, 2], up))
