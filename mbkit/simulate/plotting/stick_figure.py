"""A tree as sticks: from joint to joint, and at the ends to the farthest frame or the centre of mass.

Bodies that fixed joints hold together are one link. Places follow from the description alone, without an engine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit.errors import InputError
from mbkit.model import Joint, Model


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
        n = len(self.path)
        parts = (self.links, self.slides, self.joints, self.carts, self.anchors, self.boxes, self.path)
        return np.concatenate([part.reshape(-1, n, 3) for part in parts])


class _Pose:
    """R_WF and p_WF at every configuration."""

    def __init__(self, R: Array, p: Array) -> None:
        self.R, self.p = R, p

    def of(self, point: Array) -> Array:
        """Return a point of the frame in world axes, (n, 3)."""
        return np.asarray(self.p + self.R @ point)

    def then(self, R: Array, p: Array) -> _Pose:
        """Return a frame that stands in this one."""
        return _Pose(self.R @ R, self.p + np.einsum("nij,nj->ni", self.R, np.broadcast_to(p, self.p.shape)))


def skeleton(model: Model, q: Array) -> Skeleton:
    """Return the sticks at configurations (n, nq)."""
    n = len(q)
    full = model.layout.expand_q(q)
    poses = {"world": _Pose(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)))}
    bases: dict[str, _Pose] = {}
    for joint in model.tree:
        bases[joint.name] = poses[joint.parent].then(joint.rotation, joint.translation)
        poses[joint.child] = bases[joint.name].then(*_placement(joint, full[:, model.layout.full_q[joint.name]]))
    return _Drawn(model, poses, bases).whole(n)


def _placement(joint: Joint, q: Array) -> tuple[Array, Array]:
    # The formulas are for the components of all configurations at once.
    R, p = joint.type.placement(np, joint, list(q.T))
    n = len(q)
    rows = [[np.broadcast_to(x, n) for x in row] for row in R]
    return np.array(rows).transpose(2, 0, 1), np.array([np.broadcast_to(x, n) for x in p]).T


class _Drawn:
    """The parts of a drawn tree."""

    def __init__(self, model: Model, poses: dict[str, _Pose], bases: dict[str, _Pose]) -> None:
        self._model, self._poses, self._bases = model, poses, bases
        self._root = {"world": "world"}
        self._depth = {"world": 0}
        self._members: dict[str, list[str]] = {"world": []}
        for joint in model.tree:
            fixed = not joint.type.nv
            root = self._root[joint.parent] if fixed else joint.child
            self._root[joint.child] = root
            self._members.setdefault(root, []).append(joint.child)
            if not fixed:
                self._depth[root] = self._depth[self._root[joint.parent]] + 1
        self._moving = [j for j in model.tree if j.type.nv]

    def whole(self, n: int) -> Skeleton:
        links, slides, joints, carts, masses, anchors, boxes = ([] for _ in range(7))
        path, deepest = np.zeros((n, 3)), 0
        for joint in self._moving:
            root, base, place = self._root[joint.parent], self._bases[joint.name].p, self._poses[joint.child].p
            flies = joint.type.floating
            slides_along = bool(joint.type.lengths) and not flies
            if root == "world":
                foot = base if joint.parent == "world" else self._foot(joint)
                links += [] if foot is base else [[foot, base]]
                anchors += [] if flies or slides_along else [foot]
            elif not flies:
                links.append([self._poses[root].p, base])
            if slides_along and root == "world":
                carts.append(place)
            elif slides_along:
                slides.append([base, place])
            joints += [] if flies or slides_along else [place]
        carrying = {self._root[j.parent] for j in self._moving}
        for root, depth in self._depth.items():
            if root == "world":
                continue
            tip, weighs = (None, False) if root in carrying else self._tip(root)
            here = self._poses[root].p
            if tip is not None:
                links.append([here, tip])
                masses += [tip] if weighs else []
            elif root not in carrying and not self._slides(root):
                boxes.append(self._box(root))
            if depth > deepest and root not in carrying:
                path, deepest = here if tip is None else tip, depth
        first = self._moving[0] if self._moving else None
        if first is not None and first.type.floating:
            path = self._poses[first.child].of(self._model.body(first.child).com)

        def stacked(parts: Sequence[object], *shape: int) -> Array:
            return np.array(parts, dtype=np.float64).reshape(len(parts), *shape, n, 3)

        return Skeleton(
            links=stacked(links, 2),
            slides=stacked(slides, 2),
            joints=stacked(joints),
            carts=stacked(carts),
            masses=stacked(masses),
            anchors=stacked(anchors),
            boxes=stacked(boxes, 8),
            path=path,
        )

    def _foot(self, joint: Joint) -> Array:
        """Return the origin of the body on the ground that a joint stands on."""
        body = joint.parent
        above = {j.child: j.parent for j in self._model.tree}
        while above[body] != "world":
            body = above[body]
        return self._poses[body].p

    def _slides(self, root: str) -> bool:
        return any(j.child == root and j.type.lengths and not j.type.floating for j in self._moving)

    def _tip(self, root: str) -> tuple[Array | None, bool]:
        """Return the end of a last link, and whether it is a centre of mass."""
        here, members = self._poses[root].p, self._members[root]
        found = [self._poses[body].p for body in members]
        found += [self._poses[f.body].of(f.translation) for f in self._model.frames if f.body in members]
        masses = [self._poses[b].of(self._model.body(b).com) for b in members if self._model.body(b).mass]
        for points, weigh in ((found, False), (masses, True)):
            far = max(points, key=lambda p: float(np.linalg.norm(p[0] - here[0])), default=here)
            # Shorter lengths of robots are rounding.
            if np.linalg.norm(far[0] - here[0]) > 1e-6:
                same = any(np.allclose(far[0], m[0], rtol=0, atol=1e-9) for m in masses)
                return far, weigh or same
        return None, False

    def _box(self, root: str) -> Array:
        """Return the corners of the uniform box with a body's mass and inertia, (8, n, 3)."""
        body = self._model.body(root)
        moments, axes = np.linalg.eigh(body.inertia)
        # ∫ x² dm of each principal axis; of a box it is m/3 times the half length squared.
        squares = np.maximum(moments.sum() / 2 - moments, 0.0)
        half = np.sqrt(3 * squares / body.mass) if body.mass else np.zeros(3)
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return np.array([self._poses[root].of(body.com + axes @ (half * s)) for s in signs])


# The plane of a picture of a motion in space.

_AXES: Final = "xyz"
# A world axis that shows this much of the widest spread reads better than a slanted one.
_NEARLY: Final = 0.9
# A motion flatter than this, seen from the side, is a line: it is seen from above.
_FLAT: Final = 0.02


@dataclass(frozen=True)
class Plane:
    """Two orthonormal directions, to the right and upwards, in world axes."""

    right: Array
    up: Array

    def of(self, points: Array) -> Array:
        """Return points (..., 3) in the plane, (..., 2)."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)

    @property
    def names(self) -> tuple[str, str]:
        """Names of the directions."""
        return _name(self.right), _name(self.up)


def _name(direction: Array) -> str:
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) > 1 - 1e-9:
        return ("-" if direction[k] < 0 else "") + _AXES[k]
    return "(" + ", ".join(f"{x:.2g}" for x in direction + 0.0) + ")"


def plane_of(view: str | ArrayLike | None, points: Array, gravity: Array) -> Plane:
    """Return the plane of the argument `view`, or the one that shows most of the points (P, 3)."""
    if view is None:
        return _widest(points - points.mean(axis=0), gravity)
    if isinstance(view, str):
        if len(view) != 2 or view[0] == view[1] or not set(view) <= set(_AXES):
            raise InputError(f"view: expected two of x, y and z such as 'xz', or two directions, got {view!r}")
        right, up = np.eye(3)[[_AXES.index(a) for a in view]]
        return Plane(right, up)
    right, up = finite_array("view", view, (2, 3))
    lengths = np.linalg.norm(right), np.linalg.norm(up)
    if not all(lengths) or np.linalg.norm(np.cross(right, up)) < 1e-9 * lengths[0] * lengths[1]:
        raise InputError("view: expected two directions that are not along one line")
    right = right / lengths[0]
    up = up - (up @ right) * right
    return Plane(right, up / np.linalg.norm(up))


def _widest(points: Array, gravity: Array) -> Plane:
    g = float(np.linalg.norm(gravity))
    if g:
        up = -gravity / g
        right = _spread(points, up)
        ahead = np.cross(up, right)
        tall, wide, deep = (float(np.ptp(points @ x)) for x in (up, right, ahead))
        if tall > _FLAT * max(wide, deep) or deep <= tall:
            return Plane(right, up)
        return Plane(right, ahead)
    # Nothing says where up is: the plane that shows most, z or else y upwards in it.
    normal = np.linalg.eigh(points.T @ points)[1][:, 0]
    k = int(np.argmax(np.abs(normal)))
    spread = np.linalg.eigvalsh(points.T @ points)
    if points[:, k] @ points[:, k] <= spread[0] / _NEARLY**2 + 1e-12 * spread[2]:
        normal = np.eye(3)[k]
    up = np.eye(3)[1 if abs(normal[2]) > _NEARLY else 2]
    up = up - (up @ normal) * normal
    up /= np.linalg.norm(up)
    right = np.cross(up, normal)
    return Plane(right if right[np.argmax(np.abs(right))] > 0 else -right, up)


def _spread(points: Array, up: Array) -> Array:
    """Return the direction across `up` in which the points are widest, a world axis if one nearly is."""
    across = points - np.outer(points @ up, up)
    squares, axes = np.linalg.eigh(across.T @ across)
    best = axes[:, 2]
    for axis in np.eye(3):
        level = abs(axis @ up) < 1e-9
        if level and np.sum((across @ axis) ** 2) >= _NEARLY**2 * squares[2]:
            return np.asarray(axis)
    best = best - (best @ up) * up
    if not squares[2] or not best.any():
        # Only up and down: any level direction.
        best = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    best /= np.linalg.norm(best)
    return np.asarray(best if best[np.argmax(np.abs(best))] > 0 else -best)
