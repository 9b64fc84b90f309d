"""Which joint of one description is which of the other: by structure, names being a hint.

Trees are laid over each other from the world outwards, and by names. Two joints cost what differs between
them that no choice of frames can change (kind, mass, principal moments, distance), a little
for what frames can change, and less for another name; siblings are assigned so that the whole
costs least (Kuhn's algorithm). The cheaper of the two counts. So equal robots with exchanged or other names
still fit, and so do robots that share names and not their whole shape.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from mbkit.model import Body, Joint, Model
from mbkit.studies.causes.joints import HINGES
from mbkit.studies.causes.near import Near

__all__ = ["Match", "Matching", "match"]

# Beyond this depth the recursion would end; such chains are compared by name.
_DEEPEST: Final = 150
_NAME, _FRAME, _NUMBER, _KIND, _ALONE = 0.1, 0.25, 1.0, 3.0, 2.0


@dataclass(frozen=True)
class Match:
    """One joint of each description, and whether their names or their places say that they are the same."""

    a: str
    b: str
    how: str


@dataclass(frozen=True)
class Matching:
    """What fits what, and what fits nothing.

    Attributes
    ----------
    pairs : tuple of Match
        In the first description's order.
    only_a, only_b : tuple of str
        Joints without a counterpart.
    """

    pairs: tuple[Match, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]

    @property
    def to_b(self) -> dict[str, str]:
        """Joint of the first -> joint of the second."""
        return {m.a: m.b for m in self.pairs}


def match(a: Model, b: Model, near: Near) -> Matching:
    """Lay two fused descriptions over each other."""
    overlay = _Overlay(a, b, near)
    names = {j.name for j in b.joints}
    found = {j.name: j.name for j in a.joints if j.name in names}
    if max(_depth(a), _depth(b)) <= _DEEPEST:
        by_place = overlay.run()
        for name in found:
            if name not in by_place and name not in by_place.values():
                by_place[name] = name
        if overlay.cost(by_place) < overlay.cost(found):
            found = by_place
    taken = set(found.values())
    pairs = [
        Match(j.name, found[j.name], "name" if found[j.name] == j.name else "structure")
        for j in a.joints
        if j.name in found
    ]
    alone = [j.name for j in a.joints if j.name not in found], [j.name for j in b.joints if j.name not in taken]
    return Matching(tuple(pairs), *map(tuple, alone))


def _depth(model: Model) -> int:
    depth = {"world": 0}
    for joint in model.tree:
        depth[joint.child] = depth[joint.parent] + 1
    return max(depth.values())


class _Overlay:
    def __init__(self, a: Model, b: Model, near: Near) -> None:
        self.near = near
        self.joints = {j.name: j for j in a.joints}, {j.name: j for j in b.joints}
        self.children = _children(a), _children(b)
        self.bodies = {x.name: x for x in a.bodies}, {x.name: x for x in b.bodies}
        self.sizes = _sizes(a), _sizes(b)
        self.costs: dict[tuple[str, str], tuple[float, list[tuple[Joint, Joint]]]] = {}

    def run(self) -> dict[str, str]:
        found: dict[str, str] = {}
        waiting = self._assigned("world", "world")[1]
        while waiting:
            a, b = waiting.pop()
            found[a.name] = b.name
            waiting += self._pair(a, b)[1]
        return found

    def cost(self, found: Mapping[str, str]) -> float:
        """Return what it costs that joints of a are joints of b, however they were found."""
        total = _ALONE * (len(self.joints[0]) + len(self.joints[1]) - 2 * len(found))
        carrier = [{j.child: j.name for j in joints.values()} for joints in self.joints]
        for name, other in found.items():
            a, b = self.joints[0][name], self.joints[1][other]
            above, below = carrier[0].get(a.parent), carrier[1].get(b.parent)
            total += self._own(a, b) + (0.0 if found.get(above or "") == below else _NUMBER)
        return total

    def _pair(self, a: Joint, b: Joint) -> tuple[float, list[tuple[Joint, Joint]]]:
        """Return what it costs that a and all below it are b and all below it, and who is who there."""
        key = a.name, b.name
        if key not in self.costs:
            below, pairs = self._assigned(a.child, b.child)
            self.costs[key] = self._own(a, b) + below, pairs
        return self.costs[key]

    def _assigned(self, a: str, b: str) -> tuple[float, list[tuple[Joint, Joint]]]:
        from scipy.optimize import linear_sum_assignment

        ours, theirs = self.children[0].get(a, []), self.children[1].get(b, [])
        if not ours or not theirs:
            return _ALONE * (sum(self.sizes[0][j.name] for j in ours) + sum(self.sizes[1][j.name] for j in theirs)), []
        n, k = len(ours), len(theirs)
        # Everybody may stay alone.
        cost = np.zeros((n + k, n + k))
        cost[:n, k:] = cost[n:, :k] = np.inf
        for i, x in enumerate(ours):
            cost[i, k + i] = _ALONE * self.sizes[0][x.name]
            for j, y in enumerate(theirs):
                cost[i, j] = self._pair(x, y)[0]
                cost[n + j, j] = _ALONE * self.sizes[1][y.name]
        cost[np.isinf(cost)] = 1e12
        rows, columns = linear_sum_assignment(cost)
        pairs = [(ours[i], theirs[j]) for i, j in zip(rows, columns, strict=True) if i < n and j < k]
        return float(cost[rows, columns].sum()), pairs

    def _own(self, a: Joint, b: Joint) -> float:
        body_a, body_b, near = self.bodies[0][a.child], self.bodies[1][b.child], self.near
        cost = 0.0 if a.name == b.name else _NAME
        if a.kind != b.kind:
            cost += _FRAME if {a.kind, b.kind} == HINGES else _KIND
        far = np.linalg.norm(a.translation), np.linalg.norm(b.translation)
        cost += 0.0 if near.point(np.array([far[0]]), np.array([far[1]])) else _NUMBER
        cost += 0.0 if near.number(body_a.mass, body_b.mass) else _NUMBER
        cost += 0.0 if near.inertia(_moments(body_a), _moments(body_b), body_a.mass) else _NUMBER
        cost += 0.0 if near.vector(a.axes, b.axes) else _FRAME
        cost += 0.0 if near.vector(a.rotation, b.rotation) else _FRAME
        cost += 0.0 if near.point(a.translation, b.translation) else _FRAME
        return cost + (0.0 if near.point(body_a.com, body_b.com) else _FRAME)


def _moments(body: Body) -> np.ndarray:
    return np.asarray(np.linalg.eigvalsh(body.inertia))


def _children(model: Model) -> Mapping[str, list[Joint]]:
    out: dict[str, list[Joint]] = {}
    for joint in model.joints:
        out.setdefault(joint.parent, []).append(joint)
    return out


def _sizes(model: Model) -> dict[str, int]:
    """Return the number of joints in each joint's subtree, itself among them."""
    below = {j.child: 1 for j in model.joints}
    for joint in reversed(model.tree):
        if joint.parent != "world":
            below[joint.parent] += below[joint.child]
    return {j.name: below[j.child] for j in model.joints}
