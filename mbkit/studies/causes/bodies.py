"""Usual mistakes with a body: lost, fused wrongly, weighed about the wrong point or in the wrong axes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import permutations, product
from typing import Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.load.solids import NOTHING, Lump
from mbkit.studies.causes.compact import Compact, Member, composite
from mbkit.studies.causes.hypothesis import Guess, angle_of, told
from mbkit.studies.causes.near import Near
from mbkit.studies.causes.turns import reordered

__all__ = ["blind", "by_link", "named", "paired"]

_UNITS: Final = ((1e3, "1000 times too large, as grams or millimetres"), (1e-3, "1000 times too small"))
#: kg/m³.
_WATER: Final = 1000.0
#: URDF's order of an inertia's six numbers, and MuJoCo's.
_URDF: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_MJCF: Final = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def blind(members: Sequence[Member], R_PJ: Array, *, base: bool = False) -> Iterator[Guess]:
    """Yield what a body could be after each mistake that needs no knowledge of the other side.

    Parameters
    ----------
    members : sequence of Member
        The body's links, its own first.
    R_PJ : (3, 3) array
        How the joint that carries it is turned.
    base : bool
        Whether it is a base that moves freely.
    """
    at = composite(members)
    yield Guess("base mass" if base else "lost body", "has no matter in it", NOTHING)
    yield from _fused(members)
    yield from _about(at)
    for R, whose in ((R_PJ, "the parent's axes"), (R_PJ.T, "axes turned against its own")):
        if not np.array_equal(R, np.eye(3)):
            yield Guess("inertia axes", f"has the inertia in {whose}", Lump(at.mass, at.com, R @ at.inertia @ R.T))
    yield from _products(at)
    for com, says in ((np.zeros(3), "at the origin"), (-at.com, "on the other side of the origin")):
        yield Guess("centre of mass", f"has the centre of mass {says}", Lump(at.mass, com, at.inertia))
    yield from _places(at, R_PJ)
    yield from _balls(at)
    for factor, says in _UNITS:
        yield Guess("unit of mass", f"has a mass {says}", Lump(factor * at.mass, at.com, at.inertia))
        yield Guess("unit of length", f"has the centre of mass {says}", Lump(at.mass, factor * at.com, at.inertia))
        yield Guess("unit of inertia", f"has an inertia {says}", Lump(at.mass, at.com, factor * at.inertia))
    for factor in (1e6, 1e-6):
        says = f"has an inertia {factor:g} times as large, as of millimetres"
        yield Guess("unit of inertia", says, Lump(at.mass, at.com, factor * at.inertia))


def _fused(members: Sequence[Member]) -> Iterator[Guess]:
    """Yield what goes wrong where links are fixed to each other."""
    own, *fixed = members
    heavy = [m for m in fixed if m.matter.mass or m.matter.inertia.any()]
    for m in heavy:
        rest = composite([x for x in members if x is not m])
        yield Guess("lost body", f"leaves out link {m.name!r}, which is fixed to it", rest)
    if len(heavy) > 1:
        yield Guess("lost body", "leaves out every link that is fixed to it", composite([own]))
    groups = [(f"link {m.name!r}", [m]) for m in heavy] + ([("its links", heavy)] if len(heavy) > 1 else [])
    for who, some in groups:
        turned = [m for m in some if not np.array_equal(m.R, np.eye(3))]
        if turned:
            for how, change in (
                ("without turning it", lambda m: replace(m, R=np.eye(3))),
                ("turned the wrong way", lambda m: replace(m, R=m.R.T)),
                ("without turning its inertia", _inertia_as_written),
            ):
                with_change = [change(m) if m in turned else m for m in members]
                yield Guess("fused with a rotated frame", f"fuses {who} {how}", composite(with_change))
        if any(m.p.any() for m in some):
            put = [replace(m, p=np.zeros(3)) if m in some else m for m in members]
            yield Guess("fused at the wrong place", f"fuses {who} at the origin", composite(put))
    if heavy:
        whole = composite(members)
        there = sum((m.lump.inertia for m in members), np.zeros((3, 3)))
        says = "adds the inertias of its links, each about its own centre of mass"
        yield Guess("inertia about the wrong point", says, Lump(whole.mass, whole.com, there))


def _inertia_as_written(m: Member) -> Member:
    # Turned back, so that it stands in the body's axes as it stands in its own.
    return replace(m, matter=Lump(m.matter.mass, m.matter.com, m.R.T @ m.matter.inertia @ m.R))


def _about(at: Lump) -> Iterator[Guess]:
    if not (at.mass and at.com.any()):
        return
    d = spatial.skew(at.com)
    steiner = -at.mass * d @ d
    for sign, says in (
        (1, "has the inertia about the body's origin for that about the centre of mass"),
        (-1, "takes the inertia to be about the body's origin, and moves it to the centre of mass"),
    ):
        yield Guess("inertia about the wrong point", says, Lump(at.mass, at.com, at.inertia + sign * steiner))


def _products(at: Lump) -> Iterator[Guess]:
    I = at.inertia
    diagonal = np.diag(np.diag(I))
    if np.array_equal(I, diagonal):
        return
    kind = "products of inertia"
    yield Guess(kind, "has the products of inertia with the other sign", Lump(at.mass, at.com, 2 * diagonal - I))
    yield Guess(kind, "has no products of inertia", Lump(at.mass, at.com, diagonal))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        flipped = I.copy()
        flipped[i, j] = flipped[j, i] = -I[i, j]
        yield Guess(kind, f"has I{'xyz'[i]}{'xyz'[j]} with the other sign", Lump(at.mass, at.com, flipped))
    for written, read, says in (
        (_URDF, _MJCF, "URDF's order read in MJCF's"),
        (_MJCF, _URDF, "MJCF's order read in URDF's"),
    ):
        other = np.zeros((3, 3))
        for (i, j), (k, l) in zip(written, read, strict=True):
            other[k, l] = other[l, k] = I[i, j]
        yield Guess(
            "order of the inertia's numbers", f"has the inertia's six numbers in {says}", Lump(at.mass, at.com, other)
        )


def _places(at: Lump, R_PJ: Array) -> Iterator[Guess]:
    if np.array_equal(R_PJ, np.eye(3)) or not at.com.any():
        return
    for R in (R_PJ, R_PJ.T):
        yield Guess("centre of mass", "has the centre of mass in other axes", Lump(at.mass, R @ at.com, at.inertia))


def _balls(at: Lump) -> Iterator[Guess]:
    """Yield what Drake puts in the place of matter that it finds impossible."""
    for mass, says in (
        (at.mass, "has the inertia of a ball of water of its mass"),
        (1.0, "has a ball of water of 1 kg in its place"),
    ):
        if mass > 0:
            radius = (mass / (4 / 3 * np.pi * _WATER)) ** (1 / 3)
            yield Guess("replaced inertia", says, Lump(mass, at.com, 0.4 * mass * radius**2 * np.eye(3)))


def named(members: Sequence[Member], R_PJ: Array, b: Lump, near: Near, *, base: bool = False) -> list[Guess]:
    """Return the mistakes that make a body's matter that of the other side, with names as exact as can be.

    One mistake for all of it is sought first, then one each for mass, centre of mass and inertia. The value of
    each has the fields of the matter that it concerns, as the other side has them, and no two share a field.
    """
    a = composite(members)
    everything = {"mass": b.mass, "com": b.com, "inertia": b.inertia}
    guesses = list(blind(members, R_PJ, base=base))
    for guess in guesses:
        if near.lump(guess.value, b):
            return [replace(guess, value=everything)]
    if _fits(_scaled(a, b), b, near):
        says = f"has {told(b.mass / a.mass)} times the mass, and the inertia with it"
        return [Guess("mass", says, everything)]
    if not a.mass and not a.inertia.any():
        return [Guess("added body", "has matter in it", everything)]
    out = []
    if not near.number(a.mass, b.mass):
        found = _first(guesses, Lump(b.mass, a.com, a.inertia), near)
        kind, says = (found.kind, found.says) if found else ("mass", _change("mass", a.mass, b.mass, "kg"))
        out.append(Guess(kind, says, {"mass": b.mass}))
    if not near.point(a.com, b.com):
        found = _first(guesses, Lump(a.mass, b.com, a.inertia), near)
        what = "centre of mass"
        kind, says = (found.kind, found.says) if found else (what, _change(what, a.com, b.com, "m"))
        out.append(Guess(kind, says, {"com": b.com}))
    if not near.inertia(a.inertia, b.inertia, a.mass):
        kind, says = _inertia(a, b, guesses, near)
        out.append(Guess(kind, says, {"inertia": b.inertia}))
    return out


def by_link(ours: Sequence[Member], theirs: Sequence[Member], near: Near) -> list[tuple[str, Guess]] | None:
    """Return (link, mistake) where both sides still know the links that a body was made of; else None.

    The members are those that `paired` returns.
    """
    there = {m.name: m for m in theirs}
    if len(ours) < 2 or there.keys() != {m.name for m in ours}:
        return None
    out = []
    for m in ours:
        wanted = there[m.name].matter
        if not near.lump(m.matter, wanted):
            alone = replace(m, R=np.eye(3), p=np.zeros(3))
            out += [(m.name, guess) for guess in named([alone], np.eye(3), wanted, near)]
    return out


def paired(one: Compact, other: Compact, near: Near) -> tuple[Compact, Compact]:
    """Return both descriptions with the links that they share in the same axes.

    A link whose frame stands elsewhere in the second description is given in its body's axes in both.
    """
    sides: tuple[dict[str, tuple[Member, ...]], ...] = (dict(one.members), dict(other.members))
    for name in sides[0].keys() & sides[1].keys():
        there = {m.name: m for m in sides[1][name]}
        apart = {
            m.name
            for m in sides[0][name]
            if m.name in there and not (near.vector(m.R, there[m.name].R) and near.point(m.p, there[m.name].p))
        }
        for side in sides:
            side[name] = tuple(_in_body_axes(m) if m.name in apart else m for m in side[name])
    return Compact(one.model, sides[0]), Compact(other.model, sides[1])


def _in_body_axes(m: Member) -> Member:
    return Member(m.name, np.eye(3), np.zeros(3), m.lump)


def _first(guesses: Sequence[Guess], value: Lump, near: Near) -> Guess | None:
    return next((g for g in guesses if near.lump(g.value, value)), None)


def _fits(a: Lump | None, b: Lump, near: Near) -> bool:
    return a is not None and near.lump(a, b)


def _scaled(a: Lump, b: Lump) -> Lump | None:
    return a.scaled(b.mass / a.mass) if a.mass and b.mass and b.mass != a.mass else None


def _change(what: str, a: object, b: object, unit: str) -> str:
    return f"has the {what} {told(b)} {unit} for {told(a)}"


def _inertia(a: Lump, b: Lump, guesses: Sequence[Guess], near: Near) -> tuple[str, str]:
    """Return the name of a changed inertia, whatever else of the body changed."""
    for guess in guesses:
        if near.inertia(guess.value.inertia, b.inertia, a.mass) and not near.inertia(
            guess.value.inertia, a.inertia, a.mass
        ):
            return guess.kind, guess.says
    moments = np.linalg.eigvalsh(a.inertia), np.linalg.eigvalsh(b.inertia)
    if near.inertia(np.diag(moments[0]), np.diag(moments[1]), a.mass):
        if _misread(a.inertia, b.inertia, a.mass, near):
            return "quaternion order", "has the inertia in axes whose quaternion was read in the wrong order"
        return "inertia axes", f"has the same principal moments in other axes: {told(b.inertia)} for {told(a.inertia)}"
    factor = np.trace(b.inertia) / np.trace(a.inertia) if np.trace(a.inertia) else 0.0
    if near.inertia(factor * a.inertia, b.inertia, a.mass):
        return "inertia", f"has {told(float(factor))} times the inertia"
    return "inertia", f"has the inertia {told(b.inertia)} kg m² for {told(a.inertia)}"


def _misread(a: Array, b: Array, mass: float, near: Near) -> bool:
    """Return whether b is a in principal axes whose quaternion was read in another order."""
    moments, axes = np.linalg.eigh(a)
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            Q = axes[:, order] * signs
            if np.linalg.det(Q) < 0:
                continue
            for R in reordered(Q):
                if angle_of(R.T @ Q) > near.tolerance and near.inertia(
                    R @ np.diag(moments[list(order)]) @ R.T, b, mass
                ):
                    return True
    return False
