"""One description in the names, the order and the frames of another, its motion being the same.

Where a body's frame is drawn is nobody's physics: a frame may turn freely about whatever its
joint is, and slide along the joint's axis. Importers and converters make use of that. A frame
is moved to where the other description has it, if nothing of its joint and body differs then, or at least
two parts less. One part less is no evidence: of two different robots, a frame can always be slid to where the
other's stands, and its centre of mass and the next joint then have numbers that are in neither file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.model import Body, Joint, Mimic, Model
from mbkit.studies.causes.compact import Compact, Member
from mbkit.studies.causes.joints import HINGES
from mbkit.studies.causes.matching import Matching
from mbkit.studies.causes.near import Near

__all__ = ["Aligned", "aligned", "renamed"]

#: Kinds whose frames mean nothing beyond their axis. The others' coordinates are measured in theirs.
_LOOSE: Final = ("revolute", "continuous", "helical", "prismatic")


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
        if like is None or joint.kind not in _LOOSE or (like.kind != joint.kind and {like.kind, joint.kind} != HINGES):
            continue
        turn, shift = there.rotation.T @ like.rotation, there.rotation.T @ (like.translation - there.translation)
        # Exact ones and zeros stay what they are.
        turn = np.eye(3) if near.vector(turn, np.eye(3)) else turn
        shift = np.zeros(3) if near.point(shift, np.zeros(3)) else shift
        axis = joint.axes[0]
        if joint.kind != "prismatic":
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
