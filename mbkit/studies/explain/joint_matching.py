"""Which joint of one description is which of the other: by structure, with names as a hint.

The trees are compared from the world outwards. A pair of joints costs what differs between them whatever the choice of
frames (type, mass, principal moments, distance), a little for differences of frames, and less for another name.
Siblings are assigned at the least total cost, and a match by names alone is used if it costs no more.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.model import Body, Joint, Mimic, Model
from mbkit.model.joint_types import FIXED
from mbkit.studies.explain.hypotheses import Hypothesis
from mbkit.studies.explain.merged_model import FrameChange, MergedModel, Tolerances, merge, reattached
from mbkit.studies.explain.terms import restricted, trimmed_couplings

#: Deeper chains are compared by name, because the assignment is recursive.
_MAX_DEPTH: Final = 150
_NAME, _FRAME, _NUMBER, _KIND, _ALONE = 0.1, 0.25, 1.0, 3.0, 2.0
_Pairs = list[tuple[Joint, Joint]]


@dataclass(frozen=True)
class Match:
    """One joint of each description, and ``how`` they were matched: by "name" or by "structure"."""

    a: str
    b: str
    how: str


@dataclass(frozen=True)
class Matching:
    """Matched joints, in the first description's order, and joints without a counterpart."""

    pairs: tuple[Match, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]

    @property
    def to_b(self) -> dict[str, str]:
        """Joint of the first -> joint of the second."""
        return {m.a: m.b for m in self.pairs}


def match(a: Model, b: Model, near: Tolerances) -> Matching:
    """Match the joints of two merged descriptions."""
    assignment = _Assignment(a, b, near)
    names = {j.name for j in b.joints}
    to_b = {j.name: j.name for j in a.joints if j.name in names}
    if max(_depth(a), _depth(b)) <= _MAX_DEPTH:
        by_structure = assignment.solve()
        for name in to_b:
            if name not in by_structure and name not in by_structure.values():
                by_structure[name] = name
        if assignment.cost(by_structure) < assignment.cost(to_b):
            to_b = by_structure
    matched = [j.name for j in a.joints if j.name in to_b]
    return Matching(
        tuple(Match(n, to_b[n], "name" if to_b[n] == n else "structure") for n in matched),
        tuple(j.name for j in a.joints if j.name not in to_b),
        tuple(j.name for j in b.joints if j.name not in set(to_b.values())),
    )


def _depth(model: Model) -> int:
    depth = {"world": 0}
    for joint in model.tree:
        depth[joint.child] = depth[joint.parent] + 1
    return max(depth.values())


class _Tree:
    """A description by name: joints, bodies, the joints on each body, and the size of each joint's subtree."""

    def __init__(self, model: Model) -> None:
        self.joints = {j.name: j for j in model.joints}
        self.bodies = {x.name: x for x in model.bodies}
        self.children: dict[str, list[Joint]] = {}
        for joint in model.joints:
            self.children.setdefault(joint.parent, []).append(joint)
        self.carrier = {j.child: j.name for j in model.joints}
        self.sizes: dict[str, int] = {}
        for joint in reversed(model.tree):
            self.sizes[joint.name] = 1 + sum(self.sizes[c.name] for c in self.children.get(joint.child, ()))


class _Assignment:
    """The assignment of least cost between two trees."""

    def __init__(self, a: Model, b: Model, near: Tolerances) -> None:
        self.near, self.a, self.b = near, _Tree(a), _Tree(b)
        self._known: dict[tuple[str, str], tuple[float, _Pairs]] = {}

    def solve(self) -> dict[str, str]:
        out: dict[str, str] = {}
        waiting = self._children("world", "world")[1]
        while waiting:
            a, b = waiting.pop()
            out[a.name] = b.name
            waiting += self._pair(a, b)[1]
        return out

    def cost(self, to_b: Mapping[str, str]) -> float:
        """Return the cost of any assignment."""
        total = _ALONE * (len(self.a.joints) + len(self.b.joints) - 2 * len(to_b))
        for name, other in to_b.items():
            a, b = self.a.joints[name], self.b.joints[other]
            above, below = self.a.carrier.get(a.parent, ""), self.b.carrier.get(b.parent)
            total += self._own(a, b) + (0.0 if to_b.get(above) == below else _NUMBER)
        return total

    def _pair(self, a: Joint, b: Joint) -> tuple[float, _Pairs]:
        """Return the cost of a and its subtree as b and its subtree, and the pairs of their children."""
        key = a.name, b.name
        if key not in self._known:
            below, pairs = self._children(a.child, b.child)
            self._known[key] = self._own(a, b) + below, pairs
        return self._known[key]

    def _children(self, a: str, b: str) -> tuple[float, _Pairs]:
        from scipy.optimize import linear_sum_assignment

        ours, theirs = self.a.children.get(a, []), self.b.children.get(b, [])
        n, k = len(ours), len(theirs)
        alone = [self.a.sizes[j.name] for j in ours], [self.b.sizes[j.name] for j in theirs]
        if not n or not k:
            return _ALONE * (sum(alone[0]) + sum(alone[1])), []
        # Beside the pairs, each joint may stay alone.
        cost = np.full((n + k, n + k), 1e12)
        cost[n:, k:] = 0.0
        cost[range(n), range(k, n + k)] = _ALONE * np.array(alone[0])
        cost[range(n, n + k), range(k)] = _ALONE * np.array(alone[1])
        cost[:n, :k] = [[self._pair(x, y)[0] for y in theirs] for x in ours]
        rows, columns = linear_sum_assignment(cost)
        pairs = [(ours[i], theirs[j]) for i, j in zip(rows, columns, strict=True) if i < n and j < k]
        return float(cost[rows, columns].sum()), pairs

    def _own(self, a: Joint, b: Joint) -> float:
        x, y, near = self.a.bodies[a.child], self.b.bodies[b.child], self.near
        far = np.array([[np.linalg.norm(a.translation)], [np.linalg.norm(b.translation)]])
        same_motion = a.type.motion == b.type.motion
        differing = (
            (a.name != b.name, _NAME),
            (a.kind != b.kind, _FRAME if same_motion else _KIND),
            (not near.point(*far), _NUMBER),
            (not near.number(x.mass, y.mass), _NUMBER),
            (not near.inertia(_moments(x), _moments(y), x.mass), _NUMBER),
            (not near.vector(a.axes, b.axes), _FRAME),
            (not near.vector(a.rotation, b.rotation), _FRAME),
            (not near.point(a.translation, b.translation), _FRAME),
            (not near.point(x.com, y.com), _FRAME),
        )
        return sum(cost for differs, cost in differing if differs)


def _moments(body: Body) -> Array:
    return np.asarray(np.linalg.eigvalsh(body.inertia), dtype=np.float64)


# The second description with names, order and frames of the first.


def rename_joints(b: MergedModel, a: Model, matching: Matching) -> MergedModel:
    """Return `b` with the names and the order of `a` where joints match."""
    own = {j.name: j for j in b.model.joints}
    theirs = {j.name: j.child for j in a.joints}
    joints = {m.b: m.a for m in matching.pairs}
    bodies = {own[m.b].child: theirs[m.a] for m in matching.pairs}
    used = set(theirs), {x.name for x in a.bodies} | {"world"}
    # Joints that were held still or removed are in the matching, but not in the description.
    for name in (n for n in matching.only_b if n in own):
        joints[name] = _unused(name, used[0])
        bodies[own[name].child] = _unused(own[name].child, used[1])
    bodies["world"] = "world"
    order = {m.a: k for k, m in enumerate(matching.pairs)}
    renamed = [
        replace(
            j,
            name=joints[j.name],
            parent=bodies[j.parent],
            child=bodies[j.child],
            mimic=None if j.mimic is None else Mimic(joints[j.mimic.joint], j.mimic.ratio, j.mimic.offset),
        )
        for j in b.model.joints
    ]
    renamed.sort(key=lambda j: order.get(j.name, len(order)))
    matter = {bodies[x.name]: x for x in b.model.bodies}
    model = replace(
        b.model,
        joints=tuple(renamed),
        bodies=tuple(replace(matter[j.child], name=j.child) for j in renamed),
        springs=tuple(replace(s, body_a=bodies[s.body_a], body_b=bodies[s.body_b]) for s in b.model.springs),
        couplings=tuple(replace(c, joints=tuple(joints.get(n, n) for n in c.joints)) for c in b.model.couplings),
        loops=tuple(replace(x, body_a=bodies[x.body_a], body_b=bodies[x.body_b]) for x in b.model.loops),
        prescribed=tuple(replace(p, joint=joints.get(p.joint, p.joint)) for p in b.model.prescribed),
    )
    return MergedModel(model, {bodies[name]: some for name, some in b.links.items()})


def _unused(name: str, used: set[str]) -> str:
    while name in used:
        name += "_"
    used.add(name)
    return name


def align_frames(b: MergedModel, a: Model, near: Tolerances) -> tuple[MergedModel, tuple[str, ...]]:
    """Return `b`, in the names of `a`, with its frames where `a` has them, and the joints of moved frames.

    A frame may turn freely about its joint's axis and slide along it. It is moved if then nothing of its joint and
    body differs, or at least two parts less. One part less is no evidence: between different robots a frame can always
    slide to the other's place, and its centre of mass and the next joint then have numbers that are in neither file.
    """
    joints = {j.name: j for j in a.joints}
    matter = {x.name: x for x in a.bodies}
    own = {x.name: x for x in b.model.bodies}
    changes = {"world": FrameChange.none("world")}
    out: dict[str, tuple[Joint, Body]] = {}
    moved = []
    for joint in b.model.tree:
        there = changes[joint.parent].joint(joint)
        body = own[joint.child]
        changes[joint.child] = FrameChange.none(joint.child)
        out[joint.name] = there, body
        like = joints.get(joint.name)
        if like is None or not joint.type.axial or like.type.motion != joint.type.motion:
            continue
        turn, shift = there.rotation.T @ like.rotation, there.rotation.T @ (like.translation - there.translation)
        # Exact ones and zeros stay exact.
        turn = np.eye(3) if near.vector(turn, np.eye(3)) else turn
        shift = np.zeros(3) if near.point(shift, np.zeros(3)) else shift
        if joint.type.rotates:
            axis = joint.axes[0]
            shift = axis * (axis @ shift)
        if not shift.any() and np.array_equal(turn, np.eye(3)):
            continue
        change = FrameChange(joint.child, turn.T, shift, np.zeros(3))
        other = _moved(there, body, turn, shift)
        after = _differing(*other, like, matter[like.child], near)
        gain = _differing(there, body, like, matter[like.child], near) - after
        for child in b.model.joints:
            if child.parent == joint.child and child.name in joints:
                fixed = joints[child.name]
                gain += _misplaced(child, fixed, near) - _misplaced(change.joint(child), fixed, near)
        if gain > 0 and (gain > 1 or not after):
            out[joint.name] = other
            changes[joint.child] = change
            moved.append(joint.name)
    model = replace(
        reattached(b.model, changes),
        joints=tuple(out[j.name][0] for j in b.model.joints),
        bodies=tuple(out[j.name][1] for j in b.model.joints),
    )
    links = {
        name: tuple(replace(x, R=changes[name].A @ x.R, p=changes[name].point(x.p)) for x in some)
        for name, some in b.links.items()
    }
    return MergedModel(model, links), tuple(moved)


def _moved(joint: Joint, body: Body, R: Array, p: Array) -> tuple[Joint, Body]:
    """Return a joint and its body with both frames moved by R, p."""
    placed = replace(
        joint, rotation=joint.rotation @ R, translation=joint.translation + joint.rotation @ p, axes=joint.axes @ R
    )
    com = R.T @ (body.com - p) if body.mass else body.com
    inertia = R.T @ body.inertia @ R
    return placed, Body(body.name, body.mass, com, 0.5 * (inertia + inertia.T))


def _differing(joint: Joint, body: Body, like: Joint, matter: Body, near: Tolerances) -> int:
    return _misplaced(joint, like, near) + sum(
        (
            not near.vector(joint.axes, like.axes),
            not near.point(body.com, matter.com),
            not near.inertia(body.inertia, matter.inertia, matter.mass),
        )
    )


def _misplaced(joint: Joint, like: Joint, near: Tolerances) -> int:
    return (not near.vector(joint.rotation, like.rotation)) + (not near.point(joint.translation, like.translation))


# Joints that only one of the descriptions has.


def reconcile_joint_sets(
    a: Model, b: Model, near: Tolerances
) -> tuple[MergedModel, MergedModel, Matching, list[Hypothesis]]:
    """Return both descriptions with the same joints, their matching, and the differences that were removed for that.

    A joint without a counterpart is held still, or removed with everything it carries, on the side that has it,
    whichever leaves fewer differences. The matching names these joints as without counterpart.
    """
    causes: list[Hypothesis] = []
    alone: tuple[list[str], list[str]] = ([], [])
    while True:
        one, other = merge(a), merge(b)
        matching = match(one.model, other.model, near)
        if not matching.only_a and not matching.only_b:
            return one, other, Matching(matching.pairs, tuple(alone[0]), tuple(alone[1])), causes
        side = 0 if matching.only_a else 1
        model, names = ((a, matching.only_a), (b, matching.only_b))[side]
        name = next(j.name for j in model.tree if j.name in names)
        options = {"still": _held(model, name)}
        below = _subtree(model, name)
        if len(below) < len(model.joints):
            options["lost"] = restricted(model, {j.name for j in model.joints} - below)
        costs = {how: _count_differences(*((x, b) if side == 0 else (a, x)), near) for how, x in options.items()}
        how = min(options, key=costs.__getitem__)
        causes.append(_structural_cause(how, name, model, below, side))
        alone[side].append(name)
        a, b = (options[how], b) if side == 0 else (a, options[how])


def _held(model: Model, name: str) -> Model:
    """Return the description with a joint fixed at zero, and those that follow it."""
    held = {name} | {j.name for j in model.joints if j.mimic is not None and j.mimic.joint == name}
    kept = {j.name for j in model.joints} - held
    joints = tuple(_fixed(j) if j.name in held else j for j in model.joints)
    return replace(model, joints=joints, couplings=tuple(trimmed_couplings(model, kept)))


def _fixed(joint: Joint) -> Joint:
    none = joint.axes[:0].ravel()
    numbers = ("lower", "upper", "velocity_limit", "effort_limit", "armature", "damping", "friction", "stiffness")
    empty: dict[str, Any] = dict.fromkeys((*numbers, "rest"), none)
    return replace(joint, kind=FIXED.name, axes=joint.axes[:0], pitch=0.0, mimic=None, **empty)


def _subtree(model: Model, name: str) -> set[str]:
    joints, bodies = set(), set()
    for joint in model.tree:
        if joint.name == name or joint.parent in bodies:
            joints.add(joint.name)
            bodies.add(joint.child)
    return joints


def _count_differences(a: Model, b: Model, near: Tolerances) -> float:
    one, other = merge(a), merge(b)
    matching = match(one.model, other.model, near)
    there, _ = align_frames(rename_joints(other, one.model, matching), one.model, near)
    own = {j.name: j for j in there.model.joints}
    count = 2.0 * (len(matching.only_a) + len(matching.only_b)) + (not near.number(one.ground.mass, there.ground.mass))
    for joint in one.model.joints:
        if joint.name in own:
            x, y = one.model.body(joint.child), there.model.body(joint.child)
            count += not near.number(x.mass, y.mass)
            count += not near.point(x.com, y.com)
            count += not near.inertia(x.inertia, y.inertia, x.mass)
            count += _misplaced(joint, own[joint.name], near)
    return count


def _structural_cause(how: str, name: str, model: Model, below: Collection[str], side: int) -> Hypothesis:
    subject = f"joint {name!r}"
    if how == "still":
        says = "holds it still" if side == 0 else "lets it move, which stands still on the other side"
        return Hypothesis("joint held still", subject, says)
    count = sum(1 for j in model.joints if j.name in below and j.type.nv)
    more = f" and the {count - 1} joints below it" if count > 1 else ""
    if side == 0:
        return Hypothesis("lost joint", subject, f"lacks it{more}")
    return Hypothesis("added joint", subject, f"has it{more} besides")
