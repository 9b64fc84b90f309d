"""A description with one body for every joint that moves; what is fixed together is one lump of matter.

Two descriptions of one robot may fuse links or keep them apart, and the motion is the same.
So they are compared fused, and each body remembers the links that it was made of.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mbkit._check import Array
from mbkit.load.shapes import NOTHING, Lump, together
from mbkit.model import Body, Joint, Model
from mbkit.studies._targets import with_values

__all__ = ["Compact", "Member", "compact", "composite", "with_link", "with_lump", "with_matter"]


@dataclass(frozen=True)
class Member:
    """A link inside a body.

    Attributes
    ----------
    name : str
    R, p : (3, 3) and (3,) arrays
        Where its frame stands in the body's.
    matter : Lump
        In its own axes.
    """

    name: str
    R: Array
    p: Array
    matter: Lump

    @property
    def lump(self) -> Lump:
        """Its matter in the body's axes."""
        return self.matter.moved(self.R, self.p)


@dataclass(frozen=True)
class Compact:
    """A fused description.

    Attributes
    ----------
    model : Model
        Without fixed joints, and without what stands still.
    members : mapping of str to tuple of Member
        Body -> the links in it, its own first; ``"world"`` has those that stand still.
    """

    model: Model
    members: Mapping[str, tuple[Member, ...]]

    @property
    def ground(self) -> Lump:
        """What stands still, in the world's axes."""
        return composite(self.members["world"])


def compact(model: Model) -> Compact:
    """Return the description with everything fused that is fixed together.

    Parameters without a value are refused, the others take theirs; frames are left out.
    """
    if model.parameters:
        model.require_values("explain")
        model = with_values(model)
    bodies = {b.name: b for b in model.bodies}
    at: dict[str, tuple[str, Array, Array]] = {"world": ("world", np.eye(3), np.zeros(3))}
    members: dict[str, list[Member]] = {"world": []}
    moved: dict[str, Joint] = {}
    for joint in model.tree:
        carrier, R, p = at[joint.parent]
        R, p = R @ joint.rotation, p + R @ joint.translation
        own = bodies[joint.child]
        if joint.type.nv:
            moved[joint.name] = replace(joint, parent=carrier, rotation=R, translation=p)
            carrier, R, p = joint.child, np.eye(3), np.zeros(3)
            members[carrier] = []
        at[joint.child] = carrier, R, p
        members[carrier].append(Member(own.name, R, p, Lump(own.mass, own.com, own.inertia)))
    moving = [j for j in model.joints if j.name in moved]
    fused = replace(
        model,
        bodies=tuple(_body(j.child, composite(members[j.child])) for j in moving),
        joints=tuple(moved[j.name] for j in moving),
        frames=(),
        springs=tuple(
            replace(s, body_a=a, point_a=p_a, body_b=b, point_b=p_b)
            for s in model.springs
            for (a, p_a), (b, p_b) in [(_point(at, s.body_a, s.point_a), _point(at, s.body_b, s.point_b))]
        ),
        loops=tuple(
            replace(
                x,
                body_a=at[x.body_a][0],
                rotation_a=at[x.body_a][1] @ x.rotation_a,
                translation_a=_point(at, x.body_a, x.translation_a)[1],
                body_b=at[x.body_b][0],
                rotation_b=at[x.body_b][1] @ x.rotation_b,
                translation_b=_point(at, x.body_b, x.translation_b)[1],
            )
            for x in model.loops
        ),
    )
    return Compact(fused, {name: tuple(some) for name, some in members.items()})


def composite(members: Iterable[Member]) -> Lump:
    """Return several links as one lump, in the body's axes."""
    # A link without matter is a mere frame, and adds no rounding.
    lumps = [m.lump for m in members if m.matter.mass or m.matter.inertia.any()]
    if not lumps:
        return NOTHING
    if len(lumps) > 1 and not any(x.mass for x in lumps):
        return Lump(0.0, np.zeros(3), np.asarray(sum(x.inertia for x in lumps)))
    return together(lumps)


def with_lump(model: Model, name: str, lump: Lump) -> Model:
    """Return the description with other matter in one body."""
    return replace(model, bodies=tuple(_body(name, lump) if b.name == name else b for b in model.bodies))


def with_matter(x: Compact, name: str, fields: Mapping[str, Any]) -> Compact:
    """Return the description with another mass, centre of mass or inertia in one body."""
    body = x.model.body(name)
    return replace(x, model=with_lump(x.model, name, replace(Lump(body.mass, body.com, body.inertia), **fields)))


def with_link(x: Compact, name: str, link: str, fields: Mapping[str, Any]) -> Compact:
    """Return the description with other matter in one link of a body, in the link's axes."""
    members = tuple(replace(m, matter=replace(m.matter, **fields)) if m.name == link else m for m in x.members[name])
    return Compact(with_lump(x.model, name, composite(members)), {**x.members, name: members})


def _body(name: str, lump: Lump) -> Body:
    # Turning an inertia leaves rounding on one side of the diagonal.
    return Body(name, lump.mass, lump.com, 0.5 * (lump.inertia + lump.inertia.T))


def _point(at: Mapping[str, tuple[str, Array, Array]], body: str, point: Array) -> tuple[str, Array]:
    carrier, R, p = at[body]
    return carrier, p + R @ point
