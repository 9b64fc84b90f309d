"""Which joint of one description is which of the other: by structure, with names as a hint.

The trees are compared from the world outwards. A pair of joints costs what differs between them whatever the choice of
frames (type, mass, principal moments, distance), a little for differences of frames, and less for another name.
Siblings are assigned at the least total cost, and a match by names alone is used if it costs no more.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain, product
from typing import Any, Final

import numpy as np

from mbkit._check import Array, by_key
from mbkit.model import Body, Joint, Model
from mbkit.model.elements.references import _OF_BODIES, hung_on, names_in, renamed
from mbkit.model.joint_types import FIXED, PRISMATIC
from mbkit.studies.explain.hypotheses import Change, Hypothesis, differences, links_in_common_axes, turn_of
from mbkit.studies.explain.merged_model import (
    BASE_FRAME,
    OTHERS,
    MergedModel,
    Tolerances,
    at_itself,
    merge,
    number_text,
    reattached,
)
from mbkit.studies.explain.terms import fitting, restricted

#: Costs of another name, a frame or number that differs, another kind, and a joint that stays alone.
_NAME_COST, _FRAME_COST, _NUMBER_COST, _KIND_COST, _ALONE_COST = 0.1, 0.25, 1.0, 3.0, 2.0
_FRAMES: Final = ("rotation", "translation")


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
    by_name = {name: name for name in assignment.a.joints if name in assignment.b.joints}
    to_b = assignment.solve()
    to_b |= {name: name for name in by_name if name not in to_b and name not in to_b.values()}
    if not assignment.cost(to_b) < assignment.cost(by_name):
        to_b = by_name
    pairs = [(j.name, to_b[j.name]) for j in a.joints if j.name in to_b]
    return Matching(
        tuple(Match(x, y, "name" if x == y else "structure") for x, y in pairs),
        tuple(j.name for j in a.joints if j.name not in to_b),
        tuple(j.name for j in b.joints if j.name not in set(to_b.values())),
    )


class _Tree:
    """The bodies of a description by depth, what each joint carries, and the joints on each body."""

    def __init__(self, model: Model) -> None:
        self.joints = {j.name: j for j in model.joints}
        self.bodies = {x.name: x for x in model.bodies}
        self.moments = {x.name: np.asarray(np.linalg.eigvalsh(x.inertia), dtype=np.float64) for x in model.bodies}
        self.carrier = {j.child: j.name for j in model.joints}
        self.children = by_key((j.parent, j) for j in model.joints)
        #: Number of joints on a body and beyond, and the joint that carries it.
        self.sizes = {j.child: sum(j.name in above for above in model.chains.values()) for j in model.joints}
        self.levels = [["world"], *by_key((len(model.chains[j.name]), j.child) for j in model.tree).values()]

    def on(self, body: str) -> tuple[list[Joint], Array]:
        """Return the joints on a body, and what it costs to leave each alone with all that it carries."""
        some = self.children.get(body, [])
        return some, np.array([_ALONE_COST * self.sizes[j.child] for j in some])


class _Assignment:
    """The assignment of least cost between two trees."""

    def __init__(self, a: Model, b: Model, near: Tolerances) -> None:
        self.near, self.a, self.b = near, _Tree(a), _Tree(b)

    def solve(self) -> dict[str, str]:
        from scipy.optimize import linear_sum_assignment

        #: Two bodies -> the cost of all that they carry, and the pairs of joints on them.
        below: dict[tuple[str, str], tuple[float, list[tuple[Joint, Joint]]]] = {}
        for x, y in chain(*(product(*two) for two in [*zip(self.a.levels, self.b.levels, strict=False)][::-1])):
            (ours, alone), (theirs, others) = self.a.on(x), self.b.on(y)
            costs = [[self._own(i, k) + below[i.child, k.child][0] for k in theirs] for i in ours]
            # A pair that costs more than both alone is none.
            more = np.reshape(costs, (len(ours), len(theirs))) - alone[:, None] - others
            rows, columns = linear_sum_assignment(np.minimum(more, 0.0))
            pairs = [(i, k) for i, k in zip(rows, columns, strict=True) if more[i, k] < 0]
            cost = alone.sum() + others.sum() + sum(more[pair] for pair in pairs)
            below[x, y] = float(cost), [(ours[i], theirs[k]) for i, k in pairs]
        out: dict[str, str] = {}
        waiting = below["world", "world"][1]
        while waiting:
            joint, other = waiting.pop()
            out[joint.name] = other.name
            waiting += below[joint.child, other.child][1]
        return out

    def cost(self, to_b: Mapping[str, str]) -> float:
        """Return the cost of any assignment."""
        total = _ALONE_COST * (len(self.a.joints) + len(self.b.joints) - 2 * len(to_b))
        for name, other in to_b.items():
            a, b = self.a.joints[name], self.b.joints[other]
            above, below = self.a.carrier.get(a.parent, ""), self.b.carrier.get(b.parent)
            total += self._own(a, b) + (0.0 if to_b.get(above) == below else _NUMBER_COST)
        return total

    def _own(self, a: Joint, b: Joint) -> float:
        x, y, near = self.a.bodies[a.child], self.b.bodies[b.child], self.near
        far = np.array([[np.linalg.norm(a.translation)], [np.linalg.norm(b.translation)]])
        kind = _FRAME_COST if a.type.motion == b.type.motion else _KIND_COST
        frames = len(near.differing(a, b, "axes", *_FRAMES)) + (not near.point(x.com, y.com))
        numbers = (not near.point(*far)) + (not near.number(x.mass, y.mass))
        numbers += not near.inertia(self.a.moments[x.name], self.b.moments[y.name], x.mass)
        other = _NAME_COST * (a.name != b.name) + kind * (a.kind != b.kind)
        return other + _FRAME_COST * frames + _NUMBER_COST * numbers


# The second description with names, order and frames of the first.


def rename_joints(b: MergedModel, a: Model, matching: Matching) -> MergedModel:
    """Return `b` with the names and the order of `a` where joints match."""
    own = {j.name: j for j in b.model.joints}
    theirs = {j.name: j.child for j in a.joints}
    # Joints that were held still or removed are in the matching, and those that they carry may be in the description.
    alone = [j for n, j in own.items() if n not in matching.to_b.values()]
    joints = {j.name: f"{j.name} of the second" for j in alone} | {m.b: m.a for m in matching.pairs}
    bodies = {j.child: f"{j.child} of the second" for j in alone} | {
        own[m.b].child: theirs[m.a] for m in matching.pairs
    }
    bodies["world"] = "world"
    order = {m.a: k for k, m in enumerate(matching.pairs)}
    parts, _ = renamed(b.model, lambda name: bodies.get(name, name), lambda name: joints.get(name, name), str)
    parts["joints"].sort(key=lambda joint: order.get(joint.name, len(order)))
    matter = {x.name: x for x in parts["bodies"]}
    parts["bodies"] = [matter[joint.child] for joint in parts["joints"]]
    fields: dict[str, Any] = {kind: tuple(some) for kind, some in parts.items()}
    model = replace(b.model, **fields)
    return MergedModel(model, {bodies[name]: some for name, some in b.links.items()})


def align_frames(b: MergedModel, a: Model, near: Tolerances) -> tuple[MergedModel, tuple[str, ...]]:
    """Return `b`, in the names of `a`, with its frames where `a` has them, and the joints of moved frames.

    A frame may turn freely about its joint's axis and slide along it. It is moved if then nothing of its joint and
    body differs, or at least two parts less. One part less is no evidence: between different robots a frame can always
    slide to the other's place, and its centre of mass and the next joint then have numbers that are in neither file.
    """
    joints = {j.name: j for j in a.joints}
    places = {"world": at_itself("world")}
    out: dict[str, tuple[Joint, Body]] = {}
    moved = []
    for joint in b.model.tree:
        there, body, like = hung_on(joint, places, []), b.model.body(joint.child), joints.get(joint.name)
        places[joint.child] = at_itself(joint.child)
        out[joint.name] = there, body
        if like is None or not joint.type.axial or like.type.motion != joint.type.motion:
            continue
        turn, shift = there.rotation.T @ like.rotation, there.rotation.T @ (like.translation - there.translation)
        # Exact ones and zeros stay exact.
        turn = np.eye(3) if near.vector(turn, np.eye(3)) else turn
        shift = np.zeros(3) if near.point(shift, np.zeros(3)) else shift
        if joint.type.rotates:
            shift = joint.axes[0] * (joint.axes[0] @ shift)
        if not shift.any() and np.array_equal(turn, np.eye(3)):
            continue
        other, change = _moved(there, body, turn, shift), (joint.child, turn.T, -turn.T @ shift)
        carried = [c for c in b.model.joints if c.parent == joint.child and c.name in joints]
        own, beyond = [], []
        for (placed, matter), place in (((there, body), at_itself(joint.child)), (other, change)):
            unlike = near.differing(matter, a.body(like.child), "com", "inertia")
            own.append(len(near.differing(placed, like, *_FRAMES, "axes")) + len(unlike))
            hung = (hung_on(c, {joint.child: place}, []) for c in carried)
            beyond.append(sum(len(near.differing(c, joints[c.name], *_FRAMES)) for c in hung))
        gain = own[0] - own[1] + beyond[0] - beyond[1]
        if gain > 1 or (gain == 1 and not own[1]):
            out[joint.name] = other
            places[joint.child] = change
            moved.append(joint.name)
    model = replace(
        reattached(b.model, places),
        joints=tuple(out[j.name][0] for j in b.model.joints),
        bodies=tuple(out[j.name][1] for j in b.model.joints),
    )
    links = {}
    for name, some in b.links.items():
        _, R, p = places[name]
        links[name] = tuple(replace(x, R=R @ x.R, p=p + R @ x.p) for x in some)
    return MergedModel(model, links), tuple(moved)


def align_bases(one: MergedModel, b: MergedModel, near: Tolerances) -> tuple[MergedModel, list[Hypothesis]]:
    """Return `b` with the frames of its free bodies where `one` has them, and the differences that this takes away.

    A frame is moved as a joint on the body says, if then at least two parts less differ: the frame of a free body is
    no free choice, as its coordinates are the frame's pose.
    """
    moved = []
    for joint in (j for j in one.model.joints if j.type.floating and b.model.joint(j.name).kind == j.kind):
        carried = [c for c in one.model.joints if c.parent == joint.child]
        pairs = [(c, b.model.joint(c.name)) for c in carried if b.model.joint(c.name).parent == joint.child]
        before = _count_between(one, b, near)
        for here, there in pairs[:2]:
            # Where the first's frame is in the second's.
            R = there.rotation @ here.rotation.T
            p = there.translation - R @ here.translation
            if near.vector(R, np.eye(3)) and near.point(p, np.zeros(3)):
                continue
            other = b.put((BASE_FRAME, joint.name), {"frame": (R, p)})
            if _count_between(one, other, near) > before - 2:
                continue
            turn = float(np.linalg.norm(turn_of(R)))
            says = f"has the body's frame turned by {number_text(turn)} rad and moved by {number_text(-R.T @ p)} m"
            change = Change((BASE_FRAME, joint.name), {"frame": (R, p)}, {"frame": (R.T, -R.T @ p)})
            moved.append(Hypothesis("frame of the free joint", f"joint {joint.name!r}", says, (change,)))
            b = other
            break
    return b, moved


def _count_between(a: MergedModel, b: MergedModel, near: Tolerances) -> int:
    return len(differences(*links_in_common_axes(a, b, near), near))


def _moved(joint: Joint, body: Body, R: Array, p: Array) -> tuple[Joint, Body]:
    """Return a joint and its body with both frames moved by R, p."""
    placed = replace(
        joint, rotation=joint.rotation @ R, translation=joint.translation + joint.rotation @ p, axes=joint.axes @ R
    )
    com = R.T @ (body.com - p) if body.mass else body.com
    inertia = R.T @ body.inertia @ R
    return placed, Body(body.name, body.mass, com, 0.5 * (inertia + inertia.T))


# Joints that only one of the descriptions has.


def reconcile_joint_sets(
    a: Model, b: Model, near: Tolerances
) -> tuple[MergedModel, MergedModel, Matching, list[Hypothesis]]:
    """Return both descriptions with the same joints, their matching, and the differences that were removed for that.

    A joint without a counterpart is held still, or removed with everything it carries, on the side that has it,
    whichever leaves fewer differences. The matching names these joints as without counterpart.
    """
    causes: list[Hypothesis] = []
    # The order in q and v is told beside.
    b = _with_slides_in_order(a, b)
    alone: tuple[list[str], list[str]] = ([], [])
    sides = [a, b]
    while True:
        one, other = (merge(x) for x in sides)
        matching = match(one.model, other.model, near)
        if not matching.only_a and not matching.only_b:
            return one, other, Matching(matching.pairs, tuple(alone[0]), tuple(alone[1])), causes
        side = 0 if matching.only_a else 1
        model, names = sides[side], matching.only_a or matching.only_b
        name = next(j.name for j in model.tree if j.name in names)
        below = {n for n, above in model.chains.items() if name in above}
        options = {True: _held(model, name)}
        if len(below) < len(model.joints):
            options[False] = restricted(model, {j.name for j in model.joints} - below)
        costs = {
            still: _count_differences(*((x, sides[1]) if side == 0 else (sides[0], x)), near)
            for still, x in options.items()
        }
        still = min(options, key=costs.__getitem__)
        # A loader that merges links keeps a frame where each was.
        there = (b, a)[side]
        fixed = name in {*(j.name for j in there.joints if not j.type.nv), *(f.name for f in there.frames)}
        causes.append(_structural_cause(still, name, model, below, side, fixed=fixed))
        alone[side].append(name)
        sides[side] = options[still]


def _with_slides_in_order(a: Model, b: Model) -> Model:
    """Return `b` with slides that follow each other in the order of `a`: translations commute."""
    order = {j.name: k for k, j in enumerate(a.tree)}

    def exchanged(pair: tuple[Joint, Joint]) -> bool:
        below, joint = (order.get(x.name) for x in pair)
        return below is not None and joint is not None and joint < below

    while pair := next(filter(exchanged, _consecutive_slides(b)), None):
        joints = {j.name: j for j in b.joints}
        for joint, place in (pair, pair[::-1]):
            # Where a joint is on its parent belongs to the place.
            there = {n: getattr(place, n) for n in ("parent", "child", *_FRAMES)}
            joints[joint.name] = replace(joint, **there)
        b = replace(b, joints=tuple(joints[j.name] for j in b.joints))
    return b


def _consecutive_slides(model: Model) -> Iterator[tuple[Joint, Joint]]:
    """Yield pairs of slides of which one carries the other, without matter, turns or anything else between them."""
    on = by_key((joint.parent, joint) for joint in model.joints)
    used = {name for kind in OTHERS for part in getattr(model, kind) for name in names_in(part, _OF_BODIES)}
    slides = {j.child: j for j in model.joints if j.kind == PRISMATIC.name and j.mimic is None}
    for below, joint in ((slides[x.parent], x) for x in slides.values() if x.parent in slides):
        between = model.body(joint.parent)
        matter = between.mass or between.inertia.any() or between.name in used
        if not matter and len(on[between.name]) == 1 and np.array_equal(joint.rotation, np.eye(3)):
            yield below, joint


def _held(model: Model, name: str) -> Model:
    """Return the description with a joint fixed at zero, and those that follow it."""
    held = {name} | {j.name for j in model.joints if j.mimic is not None and j.mimic.joint == name}
    joints = tuple(
        Joint._of(j.name, FIXED.name, j.parent, j.child, j.rotation, j.translation) if j.name in held else j
        for j in model.joints
    )
    return fitting(model, joints=joints)


def _count_differences(a: Model, b: Model, near: Tolerances) -> float:
    one, other = merge(a), merge(b)
    matching = match(one.model, other.model, near)
    there, _ = align_frames(rename_joints(other, one.model, matching), one.model, near)
    alone = len(matching.only_a) + len(matching.only_b)
    ground = not near.number(one.ground.mass, there.ground.mass)
    return _count_between(one, there, near) + 2.0 * alone + ground


def _structural_cause(
    still: bool, name: str, model: Model, below: Collection[str], side: int, *, fixed: bool
) -> Hypothesis:
    """Return that one side has a joint alone; `fixed`: the other side has it, or its link, without motion."""
    if fixed:
        says = "lets it move, which stands still on the other side" if side else "holds it still"
        return Hypothesis("joint held still", f"joint {name!r}", says)
    count = 1 if still else sum(1 for j in model.joints if j.name in below and j.type.nv)
    more = f" and the {count - 1} joint{'s' * (count > 2)} below it" if count > 1 else ""
    kind, says = ("added joint", f"has it{more} besides") if side else ("lost joint", f"lacks it{more}")
    return Hypothesis(kind, f"joint {name!r}", says)
