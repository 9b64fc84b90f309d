"""Joints that only one of two descriptions has: standing still in the other, or lost there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from mbkit.model import Body, Joint, JointCoupling, Model
from mbkit.studies.causes.alignment import aligned, renamed
from mbkit.studies.causes.compact import Compact, compact
from mbkit.studies.causes.hypothesis import Hypothesis
from mbkit.studies.causes.matching import Matching, match
from mbkit.studies.causes.near import Near

__all__ = ["settled"]


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
            (_differing(*((x, b) if side == 0 else (a, x)), near), k, how, x)
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
    return replace(joint, kind="fixed", axes=joint.axes[:0], pitch=0.0, mimic=None, **empty)


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


def _differing(a: Model, b: Model, near: Near) -> float:
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
