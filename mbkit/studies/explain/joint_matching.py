"""Which joint of one description is which of the other: by structure, names being a hint.

Trees are laid over each other from the world outwards, and by names. Two joints cost what differs between
them that no choice of frames can change (kind, mass, principal moments, distance), a little
for what frames can change, and less for another name; siblings are assigned so that the whole
costs least (Kuhn's algorithm). The cheaper of the two counts. So equal robots with exchanged or other names
still fit, and so do robots that share names and not their whole shape.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.model import Body, Joint, JointCoupling, Mimic, Model
from mbkit.model.joint_types import FIXED
from mbkit.studies.explain.hypotheses import Hypothesis
from mbkit.studies.explain.merged_links import Compact, Member, compact
from mbkit.studies.explain.tolerance import Near

__all__ = ["Aligned", "Match", "Matching", "aligned", "match", "renamed", "settled"]


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
            cost += _FRAME if a.type.motion == b.type.motion else _KIND
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


# One description in the names, the order and the frames of another, its motion being the same.
#
# Where a body's frame is drawn is nobody's physics: a frame may turn freely about whatever its
# joint is, and slide along the joint's axis. Importers and converters make use of that. A frame
# is moved to where the other description has it, if nothing of its joint and body differs then, or at least
# two parts less. One part less is no evidence: of two different robots, a frame can always be slid to where the
# other's stands, and its centre of mass and the next joint then have numbers that are in neither file.


@dataclass(frozen=True)
class Aligned:
    """The other description in the first one's words, and which frames were moved for that."""

    compact: Compact
    reframed: tuple[str, ...]


def renamed(b: Compact, a: Model, matching: Matching) -> Compact:
    """Return `b` with the names and the order of `a` where joints match."""
    own = {j.name: j for j in b.model.joints}
    # Joints that were held still or taken away are told as alone, and are there no more.
    alone = [n for n in matching.only_b if n in own]
    order = {m.a: k for k, m in enumerate(matching.pairs)}
    joints = {m.b: m.a for m in matching.pairs}
    taken = {j.name for j in a.joints}
    theirs = {j.name: j.child for j in a.joints}
    bodies = {own[m.b].child: theirs[m.a] for m in matching.pairs}
    used = {x.name for x in a.bodies} | {"world"}
    for name in alone:
        joints[name] = _unused(name, taken)
        taken.add(joints[name])
        bodies[own[name].child] = _unused(own[name].child, used)
        used.add(bodies[own[name].child])
    bodies["world"] = "world"
    made = [
        replace(
            j,
            name=joints[j.name],
            parent=bodies[j.parent],
            child=bodies[j.child],
            mimic=None if j.mimic is None else Mimic(joints[j.mimic.joint], j.mimic.ratio, j.mimic.offset),
        )
        for j in b.model.joints
    ]
    made.sort(key=lambda j: order.get(j.name, len(order)))
    matter = {bodies[x.name]: x for x in b.model.bodies}
    model = replace(
        b.model,
        joints=tuple(made),
        bodies=tuple(replace(matter[j.child], name=j.child) for j in made),
        springs=tuple(replace(s, body_a=bodies[s.body_a], body_b=bodies[s.body_b]) for s in b.model.springs),
        couplings=tuple(replace(c, joints=tuple(joints.get(n, n) for n in c.joints)) for c in b.model.couplings),
        loops=tuple(replace(x, body_a=bodies[x.body_a], body_b=bodies[x.body_b]) for x in b.model.loops),
        prescribed=tuple(replace(p, joint=joints.get(p.joint, p.joint)) for p in b.model.prescribed),
    )
    return Compact(model, {bodies[name]: some for name, some in b.members.items()})


def _unused(name: str, taken: set[str]) -> str:
    while name in taken:
        name += "_"
    return name


def aligned(b: Compact, a: Model, near: Near) -> Aligned:
    """Return `b`, whose names are those of `a`, with its frames where `a` has them."""
    joints = {j.name: j for j in a.joints}
    matter = {x.name: x for x in a.bodies}
    own = {x.name: x for x in b.model.bodies}
    # R and p of each body's new frame in its old one.
    moved: dict[str, tuple[Array, Array]] = {"world": (np.eye(3), np.zeros(3))}
    made: dict[str, tuple[Joint, Body]] = {}
    reframed = []
    carried: dict[str, list[tuple[Joint, Joint]]] = {}
    for joint in b.model.joints:
        if joint.name in joints:
            carried.setdefault(joint.parent, []).append((joint, joints[joint.name]))
    for joint in b.model.tree:
        R, p = moved[joint.parent]
        there = _seen_joint(joint, R, p)
        body = own[joint.child]
        moved[joint.child] = np.eye(3), np.zeros(3)
        made[joint.name] = there, body
        like = joints.get(joint.name)
        if like is None or not joint.type.axial or like.type.motion != joint.type.motion:
            continue
        turn, shift = there.rotation.T @ like.rotation, there.rotation.T @ (like.translation - there.translation)
        # Exact ones and zeros stay what they are.
        turn = np.eye(3) if near.vector(turn, np.eye(3)) else turn
        shift = np.zeros(3) if near.point(shift, np.zeros(3)) else shift
        axis = joint.axes[0]
        if joint.type.rotates:
            shift = axis * (axis @ shift)
        if not shift.any() and np.array_equal(turn, np.eye(3)):
            continue
        other = _moved(there, body, turn, shift)
        own_before = _differing(there, body, like, matter[like.child], near)
        own_after = _differing(*other, like, matter[like.child], near)
        gain = own_before - own_after
        for child, like_child in carried.get(joint.child, ()):
            gain += _misplaced(child, like_child, near) - _misplaced(_seen_joint(child, turn, shift), like_child, near)
        if gain > 0 and (gain > 1 or not own_after):
            made[joint.name] = other
            moved[joint.child] = turn, shift
            reframed.append(joint.name)
    model = replace(
        b.model,
        joints=tuple(made[j.name][0] for j in b.model.joints),
        bodies=tuple(made[j.name][1] for j in b.model.joints),
        springs=tuple(
            replace(s, point_a=_seen(moved, s.body_a, s.point_a), point_b=_seen(moved, s.body_b, s.point_b))
            for s in b.model.springs
        ),
        loops=tuple(
            replace(
                x,
                rotation_a=moved[x.body_a][0].T @ x.rotation_a,
                translation_a=_seen(moved, x.body_a, x.translation_a),
                rotation_b=moved[x.body_b][0].T @ x.rotation_b,
                translation_b=_seen(moved, x.body_b, x.translation_b),
            )
            for x in b.model.loops
        ),
    )
    members = {name: tuple(_seen_member(moved, name, m) for m in some) for name, some in b.members.items()}
    return Aligned(Compact(model, members), tuple(reframed))


def _moved(joint: Joint, body: Body, R: Array, p: Array) -> tuple[Joint, Body]:
    """Return a joint and its body with both frames moved by R, p."""
    placed = replace(
        joint,
        rotation=joint.rotation @ R,
        translation=joint.translation + joint.rotation @ p,
        axes=joint.axes @ R,
    )
    # What has no mass has no centre of mass.
    com = R.T @ (body.com - p) if body.mass else body.com
    inertia = R.T @ body.inertia @ R
    return placed, Body(body.name, body.mass, com, 0.5 * (inertia + inertia.T))


def _differing(joint: Joint, body: Body, like: Joint, matter: Body, near: Near) -> int:
    return sum(
        (
            _misplaced(joint, like, near),
            not near.vector(joint.axes, like.axes),
            not near.point(body.com, matter.com),
            not near.inertia(body.inertia, matter.inertia, matter.mass),
        )
    )


def _misplaced(joint: Joint, like: Joint, near: Near) -> int:
    return (not near.vector(joint.rotation, like.rotation)) + (not near.point(joint.translation, like.translation))


def _seen_joint(joint: Joint, R: Array, p: Array) -> Joint:
    """Return a joint as it stands in its parent's frame after that was moved by R, p."""
    return replace(joint, rotation=R.T @ joint.rotation, translation=R.T @ (joint.translation - p))


def _seen(moved: dict[str, tuple[Array, Array]], body: str, point: Array) -> Array:
    R, p = moved[body]
    return np.asarray(R.T @ (point - p))


def _seen_member(moved: dict[str, tuple[Array, Array]], body: str, member: Member) -> Member:
    R, p = moved[body]
    return replace(member, R=R.T @ member.R, p=R.T @ (member.p - p))


# Joints that only one of two descriptions has: standing still in the other, or lost there.


def settled(a: Model, b: Model, near: Near) -> tuple[Compact, Compact, Matching, list[Hypothesis]]:
    """Return both descriptions with the same joints, who is who, and what was done for that.

    A joint without a counterpart is held still or taken away with all that it carries, on the
    side that has it, whichever leaves fewer differences. The `Matching` is that of what is left,
    with those joints told as alone.
    """
    done: list[Hypothesis] = []
    alone: tuple[list[str], list[str]] = ([], [])
    while True:
        one, other = compact(a), compact(b)
        matching = match(one.model, other.model, near)
        if not matching.only_a and not matching.only_b:
            return one, other, Matching(matching.pairs, tuple(alone[0]), tuple(alone[1])), done
        side = 0 if matching.only_a else 1
        model = (a, b)[side]
        name = _topmost(model, (matching.only_a, matching.only_b)[side])
        options = sorted(
            (_differing_structure(*((x, b) if side == 0 else (a, x)), near), k, how, x)
            for k, (how, x) in enumerate(_options(model, name))
        )
        _, _, how, chosen = options[0]
        done.append(_said(how, name, model, side))
        alone[side].append(name)
        a, b = (chosen, b) if side == 0 else (a, chosen)


def _topmost(model: Model, names: tuple[str, ...]) -> str:
    return next(j.name for j in model.tree if j.name in names)


def _options(model: Model, name: str) -> Iterator[tuple[str, Model]]:
    yield "still", _held(model, name)
    below = _below(model, name)
    if len(below) < len(model.joints):
        yield "lost", _without(model, below)


def _held(model: Model, name: str) -> Model:
    """Return the description with a joint fixed at zero; what follows it stands still too."""
    held = {name} | {j.name for j in model.joints if j.mimic is not None and j.mimic.joint == name}
    joints = tuple(_fixed(j) if j.name in held else j for j in model.joints)
    return replace(model, joints=joints, couplings=tuple(_left(model, held)))


def _left(model: Model, lost: set[str]) -> Iterator[JointCoupling]:
    """Yield the couplings without some joints, which stay at zero."""
    for c in model.couplings:
        kept = [k for k, name in enumerate(c.joints) if name not in lost]
        if kept:
            yield replace(c, joints=tuple(c.joints[k] for k in kept), factors=c.factors[kept])


def _fixed(joint: Joint) -> Joint:
    none = joint.axes[:0].ravel()
    numbers = ("lower", "upper", "velocity_limit", "effort_limit", "armature", "damping", "friction", "stiffness")
    empty: dict[str, Any] = dict.fromkeys((*numbers, "rest"), none)
    return replace(joint, kind=FIXED.name, axes=joint.axes[:0], pitch=0.0, mimic=None, **empty)


def _below(model: Model, name: str) -> set[str]:
    joints, bodies = set(), set()
    for joint in model.tree:
        if joint.name == name or joint.parent in bodies:
            joints.add(joint.name)
            bodies.add(joint.child)
    return joints


def _without(model: Model, joints: set[str]) -> Model:
    kept = [j for j in model.joints if j.name not in joints]
    lost = {j.child for j in model.joints if j.name in joints}
    kept = [replace(j, mimic=None) if j.mimic is not None and j.mimic.joint in joints else j for j in kept]
    bodies: tuple[Body, ...] = tuple(b for b in model.bodies if b.name not in lost)
    return replace(
        model,
        joints=tuple(kept),
        bodies=bodies,
        frames=tuple(f for f in model.frames if f.body not in lost),
        springs=tuple(s for s in model.springs if not {s.body_a, s.body_b} & lost),
        couplings=tuple(_left(model, joints)),
        loops=tuple(x for x in model.loops if not {x.body_a, x.body_b} & lost),
        prescribed=tuple(p for p in model.prescribed if p.joint not in joints),
        nonphysical=tuple(x for x in model.nonphysical if x[0] not in lost),
    )


def _differing_structure(a: Model, b: Model, near: Near) -> float:
    """Return in how many numbers two descriptions differ."""
    one, other = compact(a), compact(b)
    matching = match(one.model, other.model, near)
    drawn = aligned(renamed(other, one.model, matching), one.model, near).compact
    there = drawn.model
    own = {j.name: j for j in there.joints}
    count = 2.0 * (len(matching.only_a) + len(matching.only_b)) + (not near.number(one.ground.mass, drawn.ground.mass))
    for joint in one.model.joints:
        if joint.name in own:
            x, y = one.model.body(joint.child), there.body(joint.child)
            count += not near.number(x.mass, y.mass)
            count += not near.point(x.com, y.com)
            count += not near.inertia(x.inertia, y.inertia, x.mass)
            count += not near.point(joint.translation, own[joint.name].translation)
            count += not near.vector(joint.rotation, own[joint.name].rotation)
    return count


def _said(how: str, name: str, model: Model, side: int) -> Hypothesis:
    subject = f"joint {name!r}"
    if how == "still":
        says = "holds it still" if side == 0 else "lets it move, which stands still on the other side"
        return Hypothesis("joint held still", subject, says)
    below = len([j for j in model.joints if j.name in _below(model, name) and j.type.nv])
    more = f" and the {below - 1} joints below it" if below > 1 else ""
    says = f"lacks it{more}" if side == 0 else f"has it{more} besides"
    return Hypothesis("lost joint" if side == 0 else "added joint", subject, says)
