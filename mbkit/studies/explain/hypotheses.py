"""Differences between two descriptions: a name, a sentence, and fields of parts with the values of either side.

Each field belongs to one difference alone, so that any of them can be added to the first description or removed from
the second without the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit._check import Array
from mbkit.load.shapes import MassProperties
from mbkit.model import Joint
from mbkit.model.description import CONSTRAINT_FEATURES
from mbkit.model.elements.formula import NUMPY
from mbkit.model.elements.motion_laws import MOTION_LAWS, Motion, interval, position
from mbkit.model.elements.references import called
from mbkit.model.parts import Coupler, Loop
from mbkit.studies.explain.loops import exchanged, follows, loop_differences, moved, paired
from mbkit.studies.explain.merged_model import OTHERS, LinkInBody, MergedModel, Tolerances, composite, number_text
from mbkit.studies.explain.mistakes import (
    MATTER,
    Mistake,
    body_mistakes,
    changed_text,
    fitted_body,
    fitted_joint,
    groups_of,
    joint_mistakes,
    named,
)

#: Kind of a difference, and noun, where they are not the description's word for a part.
_WORDS: Final = {
    "springs": ("point spring", "spring"),
    "couplings": ("joint coupling", "coupling"),
    "prescribed": ("prescribed motion", "motion of"),
    "no_slip": ("contact without slip", "no slip"),
}
#: Relative difference of numbers written with five digits.
_ROUNDED_DIFFERENCE: Final = 2e-5
#: Most differences that are never summarized as rounding.
_MAX_LISTED_ALONE: Final = 4


class Change(NamedTuple):
    """Fields of one part on both sides; `where` as `MergedModel.put` takes it."""

    where: tuple[str, ...]
    ours: Mapping[str, Any]
    theirs: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A difference between two descriptions, with a name; `a` and `b` are its numbers."""

    kind: str
    subject: str
    says: str
    changes: tuple[Change, ...] = ()
    a: Any = None
    b: Any = None

    def apply(self, x: MergedModel) -> MergedModel:
        """Put the difference into a description."""
        for change in self.changes:
            x = x.put(change.where, change.theirs)
        return x

    def revert(self, x: MergedModel) -> MergedModel:
        """Take the difference out of a description that has it."""
        for change in self.changes:
            x = x.put(change.where, change.ours)
        return x


def words(section: str) -> tuple[str, str]:
    """Return the kind of a difference in parts of this section, and the noun before a part's name."""
    return _WORDS.get(section, (called(section), called(section)))


#: Kinds of differences that act on the motion through no term, but through constraints.
CONSTRAINTS: Final = frozenset(words(section)[0] for section in CONSTRAINT_FEATURES)


def summarized_differences(one: MergedModel, other: MergedModel, near: Tolerances) -> list[Hypothesis]:
    """Return the differences between two descriptions; many small ones are one, called rounding."""
    fine = differences(one, other, near)
    if len(fine) <= _MAX_LISTED_ALONE:
        return fine
    coarse = differences(one, other, replace(near, relative=max(_ROUNDED_DIFFERENCE, near.relative)))
    if len(coarse) > len(fine) // 2:
        return fine
    large = {(change.where, name) for h in coarse for change in h.changes for name in change.ours}
    small = []
    for where, *sides in (change for h in fine for change in h.changes):
        ours, theirs = ({n: x for n, x in side.items() if (where, n) not in large} for side in sides)
        small += [Change(where, ours, theirs)] if ours else []
    says = f"has rounded numbers: {len(small)} of them differ, by less than {_ROUNDED_DIFFERENCE:.0e} of their size"
    return [*coarse, Hypothesis("rounding", "", says, tuple(small))]


def differences(one: MergedModel, other: MergedModel, near: Tolerances) -> list[Hypothesis]:
    """Return the differences that turn `one` into `other`, part by part."""
    a, b = one.model, other.model
    gravity = f"has the gravity {number_text(b.gravity)} m/s² for {number_text(a.gravity)}"
    rows = (("has no gravity", 0 * a.gravity), ("has gravity with the other sign", -a.gravity), (gravity, b.gravity))
    signs = [Mistake("gravity", says, {"gravity": x}) for says, x in rows]
    out = [_hypothesis(("",), "", x, a, b) for x in named(a, b, [["gravity"]], signs, near)]
    out += chain(*(_other_parts(section, one, other, near) for section in OTHERS))
    theirs = {j.name: j for j in b.joints}
    for joint, there in ((j, theirs[j.name]) for j in a.joints if j.name in theirs):
        usual = chain(joint_mistakes(joint), fitted_joint(joint, there, near))
        mistakes = named(joint, there, groups_of(joint, there), usual, near)
        out += [_hypothesis(("joints", joint.name), f"joint {joint.name!r}", x, joint, there) for x in mistakes]
        out += _matter_differences(one, joint, other, near)
    return out


def _hypothesis(where: tuple[str, ...], subject: str, x: Mistake, a: Any, b: Any) -> Hypothesis:
    ours, theirs = ({name: getattr(side, name) for name in x.fields} for side in (a, b))
    numbers = [*ours.values(), *theirs.values()]
    if len(numbers) != 2 or not all(isinstance(v, (float, np.ndarray)) for v in numbers):
        numbers = [None, None]
    return Hypothesis(x.kind, subject, x.says, (Change(where, ours, theirs),), *numbers)


# Matter.


def _of_matter(
    links: Sequence[LinkInBody], R: Array, b: MassProperties, near: Tolerances, base: bool = False
) -> Iterator[Mistake]:
    """Yield the mistakes that turn the matter of a body into that of the other side."""
    a, usual = composite(links), body_mistakes(links, R, base=base)
    yield from named(a, b, [MATTER], chain(usual, fitted_body(a, b, usual, near)), near)


def _links_apart(
    one: MergedModel, other: MergedModel, body: str, near: Tolerances
) -> Iterator[tuple[LinkInBody, MassProperties, list[Mistake]]]:
    """Yield the links of a body that differ, where both sides know the same links of it, in common axes."""
    ours, theirs = one.links[body], {x.name: x.matter for x in other.links[body]}
    if len(ours) > 1 and theirs.keys() == {x.name for x in ours}:
        for x in ours:
            alone, b = replace(x, R=np.eye(3), p=np.zeros(3)), theirs[x.name]
            if not near.same(x.matter, b):
                yield x, b, [*_of_matter([alone], np.eye(3), b, near)]


def _matter_differences(one: MergedModel, joint: Joint, other: MergedModel, near: Tolerances) -> Iterator[Hypothesis]:
    body = joint.child
    a, b = one.mass_properties(body), other.mass_properties(body)
    if near.same(a, b):
        return
    apart = [*_links_apart(one, other, body, near)]
    for link, there, mistakes in apart:
        subject = f"link {link.name!r}" + (f", fixed to {body!r}" if link.name != body else "")
        yield from (_hypothesis(("links", body, link.name), subject, x, link.matter, there) for x in mistakes)
    if not apart:
        base = joint.type.floating and joint.parent == "world"
        for x in _of_matter(one.links[body], joint.rotation, b, near, base):
            yield _hypothesis(("bodies", body), f"body {body!r}", x, a, b)


def ground_differences(one: MergedModel, other: MergedModel, near: Tolerances, first: str) -> Iterator[Hypothesis]:
    """Yield the difference in the matter that stands still, which no term has."""
    a, b = one.ground, other.ground
    if near.same(a, b):
        return
    says = f"has {number_text(a.mass)} -> {number_text(b.mass)} kg standing still"
    if not b.mass and a.mass:
        says = f"has no mass in what stands still, where {first} has {number_text(a.mass)} kg"
    elif near.number(a.mass, b.mass):
        some = [f"link {link.name!r} {x.says}" for link, _, own in _links_apart(one, other, "world", near) for x in own]
        says = f"has other matter of the same mass standing still{': ' if some else ''}{', '.join(some)}"
    yield Hypothesis("base mass", "the base", says, a=a.mass, b=b.mass)


def links_in_common_axes(one: MergedModel, other: MergedModel, near: Tolerances) -> tuple[MergedModel, MergedModel]:
    """Return both descriptions with their common links in the same axes.

    A link whose frame differs between the two has its body's axes in both.
    """
    sides = dict(one.links), dict(other.links)
    for name in sides[0].keys() & sides[1].keys():
        there = {x.name: x for x in sides[1][name]}
        pairs = [(x, there[x.name]) for x in sides[0][name] if x.name in there]
        apart = {x.name for x, y in pairs if not (near.vector(x.R, y.R) and near.point(x.p, y.p))}
        for side in sides:
            side[name] = tuple(
                LinkInBody(x.name, np.eye(3), np.zeros(3), x.mass_properties) if x.name in apart else x
                for x in side[name]
            )
    return MergedModel(one.model, sides[0]), MergedModel(other.model, sides[1])


# Parts of all other kinds.


def _other_parts(section: str, one: MergedModel, other: MergedModel, near: Tolerances) -> Iterator[Hypothesis]:
    ours, theirs = ({x.name: x for x in getattr(side.model, section)} for side in (one, other))
    kind, what = words(section)
    pairs: list[tuple[Any, Any]] = [(x, theirs[n]) for n, x in ours.items() if n in theirs]
    alone, left = ([x for n, x in side.items() if n not in there] for side, there in ((ours, theirs), (theirs, ours)))
    if section == "loops":
        # Loops of other names are known by their ends.
        same, alone = paired(alone, left, lambda a, b: _apart(a, b, near))
        pairs += same
        if same:
            others = ", ".join(f"{a.name!r} is {b.name!r}" for a, b in same)
            yield Hypothesis("renamed", "", f"calls loops otherwise: {others}")
    for a, b in (*pairs, *((x, None) for x in alone), *((None, x) for x in left)):
        says = "lacks it" if b is None else "has it besides" if a is None else _other_numbers(a, b, near)
        if says:
            both = {x.name: None for x in (a, b) if x is not None}
            one_side, other_side = (both if x is None else both | {x.name: x} for x in (a, b))
            name = (b if a is None else a).name
            yield Hypothesis(kind, f"{what} {name!r}", says, (Change((section,), one_side, other_side),))


def _apart(a: Loop, b: Loop, near: Tolerances) -> float:
    """Return how far two loops are from one another; infinite where they hold other things together."""
    same = [x for x in (b, exchanged(b)) if (x.kind, x.body_a, x.body_b) == (a.kind, a.body_a, a.body_b)]
    return min((sum(moved(a, x)) for x in same), default=np.inf if loop_differences(a, b, near) else 0.0)


def _other_numbers(a: Any, b: Any, near: Tolerances) -> str:
    """Return what differs between two parts; empty where nothing does."""
    if isinstance(a, Loop):
        return ", and ".join(loop_differences(a, b, near))
    if type(a) in MOTION_LAWS:
        return "" if _same_motion(a, b, near) else "moves it otherwise"
    if type(a) is not type(b):
        return f"has another kind of it: {b} for {a}"
    others = near.differing(a, b)
    if isinstance(a, Coupler) and others:
        return f"has {follows(b)} for {follows(a)}"
    return f"has {changed_text(a, b, others)}" if others else ""


def _same_motion(a: Motion, b: Motion, near: Tolerances) -> bool:
    """Return whether two laws have the same coordinate at every time, whatever their formulas."""
    first, last = interval(a)
    if interval(b) != (first, last):
        return False
    # Times without a common period.
    t = np.maximum(first, -50.0) + (np.minimum(last, 50.0) - np.maximum(first, -50.0)) * np.linspace(0, 1, 257) ** 1.37
    x, y = (np.broadcast_to(position(part, t, NUMPY), t.shape) for part in (a, b))
    return near.vector(x, y, max(1.0, float(np.abs(x).max())))
