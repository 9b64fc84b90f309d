"""A difference between two descriptions, as something that can be put into one and taken out of the other."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import permutations, product
from typing import Any, Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.load.shapes import NOTHING, Lump
from mbkit.model import Joint, Mimic, Model
from mbkit.studies.explain.merged_links import Compact, Member, composite
from mbkit.studies.explain.tolerance import Near

__all__ = [
    "CONSTRAINTS",
    "Guess",
    "Hypothesis",
    "angle_of",
    "blind",
    "by_link",
    "gravities",
    "misread",
    "named",
    "paired",
    "reordered",
    "told",
    "with_gravity",
    "with_joint",
]


@dataclass(frozen=True)
class Guess:
    """What a part would be after a mistake.

    Attributes
    ----------
    kind : str
        The mistake's name.
    says : str
        What whoever made it did, beginning with a verb.
    value : Any
        The part as it would then be: a `Lump`, or some fields of a `Joint` or of a `Lump`.
    """

    kind: str
    says: str
    value: Any


def _unchanged(x: Compact, _: Mapping[str, Any]) -> Compact:
    return x


@dataclass(frozen=True)
class Hypothesis:
    """A difference between two descriptions: fields of one part, and a name for it.

    Each hypothesis owns its fields alone, so that any of them can be put into the first description or
    taken out of the second without the others.

    Attributes
    ----------
    kind, subject, says : str
    put : callable
        (description, fields) -> the description with these fields in the part.
    ours, theirs : mapping
        The fields as the first and the second description have them.
    a, b : Any
        The numbers of the two sides, where they are numbers.
    """

    kind: str
    subject: str
    says: str
    put: Callable[[Compact, Mapping[str, Any]], Compact] = field(default=_unchanged, compare=False)
    ours: Mapping[str, Any] = field(default_factory=dict, compare=False)
    theirs: Mapping[str, Any] = field(default_factory=dict, compare=False)
    a: Any = None
    b: Any = None

    def apply(self, x: Compact) -> Compact:
        """Put the difference into a description."""
        return self.put(x, self.theirs)

    def revert(self, x: Compact) -> Compact:
        """Take the difference out of a description that has it."""
        return self.put(x, self.ours)

    def without(self, fields: Container[str]) -> Hypothesis:
        """Return the hypothesis with less fields."""
        ours, theirs = ({k: x for k, x in side.items() if k not in fields} for side in (self.ours, self.theirs))
        return replace(self, ours=ours, theirs=theirs)


def with_joint(model: Model, name: str, **changes: Any) -> Model:
    """Return the description with other fields in one joint."""
    return replace(model, joints=tuple(replace(j, **changes) if j.name == name else j for j in model.joints))


def angle_of(R: Array) -> float:
    """Return the angle of a rotation, rad."""
    off = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(np.linalg.norm(off), np.trace(R) - 1))


def told(value: Any) -> str:
    """Return a number, vector or matrix of a description as a person writes it."""
    if isinstance(value, Lump):
        return f"{told(value.mass)} kg at {told(value.com)} m, inertia {told(value.inertia)}"
    if isinstance(value, Joint):
        return value.kind
    if isinstance(value, np.ndarray):
        if value.shape == (3, 3):
            i, j = np.triu_indices(3)
            if np.array_equal(value, value.T):
                return f"[{', '.join(told(x) for x in value[i, j])}]"
            return f"[{'; '.join(told(row) for row in value)}]"
        if value.size == 1:
            return told(float(value.ravel()[0]))
        return f"({', '.join(told(x) for x in value.ravel().tolist())})"
    # Rounding that nobody wrote is not worth a dozen digits.
    return f"{0.0 if abs(value) < 1e-15 else value:.6g}" if isinstance(value, (int, float)) else str(value)


# Ways to get a rotation wrong.


def reordered(R: Array) -> tuple[Array, Array]:
    """Return the rotation with its quaternion written w first and read w last, and the other way round."""
    x, y, z, w = spatial.quaternion_from_matrix(R)
    first = spatial.matrix_from_quaternion(np.array([w, x, y, z]))
    return first, spatial.matrix_from_quaternion(np.array([y, z, w, x]))


def misread(R: Array) -> Iterator[tuple[str, str, Array]]:
    """Yield kind of mistake, what was done, and the rotation that comes of it."""
    for other in reordered(R):
        yield "quaternion order", "reads the joint's quaternion in the wrong order", other
    if angle_of(R) < 1e-12:
        return
    yield "inverse rotation", "has the joint's rotation the wrong way round", R.T
    yield "rotation left out", "has no rotation at the joint", np.eye(3)
    roll, pitch, yaw = spatial.rpy_from_matrix(R)
    about = [spatial.matrix_from_rpy(*x) for x in ((roll, 0, 0), (0, pitch, 0), (0, 0, yaw))]
    yield "order of angles", "turns by roll, pitch, yaw in the other order", about[0] @ about[1] @ about[2]
    for factor, says in ((180 / np.pi, "degrees for radians"), (np.pi / 180, "radians for degrees")):
        angles = factor * np.array([roll, pitch, yaw])
        yield "unit of angle", f"takes {says} in the joint's rotation", spatial.matrix_from_rpy(*angles)


# Usual mistakes with a body: lost, fused wrongly, weighed about the wrong point or in the wrong axes.

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


# Usual mistakes with a joint: where it stands, what it turns about, what it carries along.

_TURN: Final = 2 * np.pi
_DEGREE: Final = np.pi / 180
#: Numbers per velocity, by the name of what they are; those without a say in the smooth motion below.
_NUMBERS: Final = {"armature": "armature", "damping": "damping", "friction": "friction", "stiffness": "spring"}
_LIMITS: Final = ("lower", "upper", "velocity_limit", "effort_limit")


def blind_joints(joint: Joint) -> Iterator[Guess]:
    """Yield what a joint could be after each mistake that needs no knowledge of the other side; fields of it."""
    for name, kind in _NUMBERS.items():
        if np.any(getattr(joint, name)):
            yield Guess(kind, f"has no {kind}", {name: np.zeros(joint.type.nv)})
    if joint.mimic is not None:
        yield Guess("mimic", f"leaves it free, which follows {joint.mimic.joint!r}", {"mimic": None})
        if joint.mimic.offset:
            mimic = Mimic(joint.mimic.joint, joint.mimic.ratio)
            yield Guess("mimic", "leaves out the offset at which it follows", {"mimic": mimic})
    if joint.type.pitched:
        yield from _pitches(joint)
    yield from _axes(joint)
    yield from _places_joints(joint)


def _pitches(joint: Joint) -> Iterator[Guess]:
    for factor, says in (
        (_TURN, "takes a pitch per radian for one per turn"),
        (1 / _TURN, "takes a pitch per turn for one per radian"),
    ):
        yield Guess("unit of pitch", says, {"pitch": factor * joint.pitch})
    yield Guess("pitch", "has the pitch with the other sign", {"pitch": -joint.pitch})
    yield Guess("pitch", "has no pitch", {"pitch": 0.0})


def _axes(joint: Joint) -> Iterator[Guess]:
    if not joint.axes.size:
        return
    yield Guess("axis sign", "has the axis the other way round", {"axes": -joint.axes})
    if not np.array_equal(joint.rotation, np.eye(3)):
        for R, whose in ((joint.rotation.T, "the parent's"), (joint.rotation, "other")):
            yield Guess("axis", f"has the axis in {whose} axes", {"axes": joint.axes @ R.T})


def _places_joints(joint: Joint) -> Iterator[Guess]:
    R, p = joint.rotation, joint.translation
    for kind, says, other in misread(R):
        yield Guess(kind, says, {"rotation": other})
    if p.any():
        for factor, kind, says in (
            (-1.0, "joint origin", "has the joint's origin on the other side"),
            (0.0, "joint origin", "has the joint at the parent's origin"),
            (1e3, "unit of length", "has the joint's origin 1000 times too far, as of millimetres"),
            (1e-3, "unit of length", "has the joint's origin 1000 times too near"),
        ):
            yield Guess(kind, says, {"translation": factor * p})
        if not np.array_equal(R, np.eye(3)):
            yield Guess("joint origin", "has the joint's origin in the joint's axes", {"translation": R @ p})
            yield Guess("joint origin", "has the joint's origin in other axes", {"translation": R.T @ p})
            inverse = {"rotation": R.T, "translation": -R.T @ p}
            yield Guess("inverse placement", "has the joint's placement the wrong way round", inverse)


def named_joints(a: Joint, b: Joint, near: Near) -> list[Guess]:
    """Return the mistakes that make joint `a` joint `b`, with names as exact as can be."""
    out: list[Guess] = []
    if a.parent != b.parent:
        out.append(Guess("parent", f"hangs it on {b.parent!r} and not on {a.parent!r}", {"parent": b.parent}))
    if a.type.motion != b.type.motion:
        # Nothing of one kind's numbers means anything to the other.
        whole = {f.name: getattr(b, f.name) for f in fields(b) if f.name not in ("name", "child", "parent")}
        return [*out, Guess("joint kind", f"has it as a {b.kind} joint, not a {a.kind} one", whole)]
    guesses = list(blind_joints(a))
    out += _placed(a, b, guesses, near)
    if not near.vector(a.axes, b.axes):
        out.append(_fitting(guesses, {"axes": b.axes}, near) or _turned_axis(a, b))
    if not near.number(a.pitch, b.pitch):
        says = f"has the pitch {told(b.pitch)} m/rad for {told(a.pitch)}"
        out.append(_fitting(guesses, {"pitch": b.pitch}, near) or Guess("pitch", says, {"pitch": b.pitch}))
    out += _mimics(a, b, near)
    for name, kind in _NUMBERS.items():
        ours, theirs = getattr(a, name), getattr(b, name)
        if not near.numbers(ours, theirs):
            rest = {"rest": b.rest} if name == "stiffness" else {}
            out.append(Guess(kind, _number(name, ours, theirs), {name: theirs} | rest))
    if a.stiffness.any() and near.numbers(a.stiffness, b.stiffness) and not near.vector(a.rest, b.rest):
        out.append(Guess("spring", f"has the spring at rest at {told(b.rest)}, not {told(a.rest)}", {"rest": b.rest}))
    limits = {n: getattr(b, n) for n in _LIMITS if not near.numbers(getattr(a, n), getattr(b, n))}
    if limits:
        out.append(Guess("limits", _limits(a, limits), limits))
    return out


def _placed(a: Joint, b: Joint, guesses: Sequence[Guess], near: Near) -> list[Guess]:
    fields_: dict[str, Any] = {}
    if not near.vector(a.rotation, b.rotation):
        fields_["rotation"] = b.rotation
    if not near.point(a.translation, b.translation):
        fields_["translation"] = b.translation
    if not fields_:
        return []
    # One mistake for both, else one for each.
    whole = _fitting(guesses, fields_, near)
    if whole:
        return [whole]
    out = []
    if "rotation" in fields_:
        only = {"rotation": b.rotation}
        out.append(_fitting(guesses, only, near) or _turned(a, b))
    if "translation" in fields_:
        only = {"translation": b.translation}
        out.append(_fitting(guesses, only, near) or _shifted(a, b, near))
    return out


def _fitting(guesses: Sequence[Guess], wanted: dict[str, Any], near: Near) -> Guess | None:
    """Return the first mistake that makes these fields so, and no others."""
    for guess in guesses:
        if guess.value.keys() == wanted.keys() and all(_same(near, n, guess.value[n], x) for n, x in wanted.items()):
            return replace(guess, value=wanted)
    return None


def _same(near: Near, name: str, a: Any, b: Any) -> bool:
    if name == "translation":
        return near.point(a, b)
    if name in ("rotation", "axes"):
        return near.vector(a, b)
    return near.number(float(a), float(b))


def _turned(a: Joint, b: Joint) -> Guess:
    R = a.rotation.T @ b.rotation
    value = {"rotation": b.rotation}
    angle = angle_of(R)
    about = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    if a.type.axial and a.type.rotates and np.allclose(R @ a.axes[0], a.axes[0], atol=1e-9):
        angle = float(np.copysign(angle, about @ a.axes[0]))
        return Guess("zero position", f"counts from {told(angle)} rad ({told(angle / _DEGREE)}°) further on", value)
    return Guess("joint rotation", f"has it turned by {told(angle)} rad ({told(angle / _DEGREE)}°)", value)


def _shifted(a: Joint, b: Joint, near: Near) -> Guess:
    value = {"translation": b.translation}
    d = a.rotation.T @ (b.translation - a.translation)
    if a.type.axial and not a.type.rotates and near.point(np.cross(d, a.axes[0]), np.zeros(3)):
        return Guess("zero position", f"counts from {told(float(d @ a.axes[0]))} m further on", value)
    return Guess("joint origin", f"has the joint at {told(b.translation)} m, not at {told(a.translation)}", value)


def _turned_axis(a: Joint, b: Joint) -> Guess:
    return Guess("axis", f"has the axis {told(b.axes)}, not {told(a.axes)}", {"axes": b.axes})


def _mimics(a: Joint, b: Joint, near: Near) -> list[Guess]:
    if a.mimic is None and b.mimic is None:
        return []
    if a.mimic is None:
        assert b.mimic is not None
        return [Guess("mimic", f"lets it follow {b.mimic.joint!r}, which is free", {"mimic": b.mimic})]
    if b.mimic is None:
        return [Guess("mimic", f"leaves it free, which follows {a.mimic.joint!r}", {"mimic": None})]
    same = a.mimic.joint == b.mimic.joint and near.number(a.mimic.ratio, b.mimic.ratio)
    if same and abs(a.mimic.offset - b.mimic.offset) <= near.tolerance:
        return []
    one, other = (f"{told(m.ratio)} {m.joint} + {told(m.offset)}" for m in (b.mimic, a.mimic))
    return [Guess("mimic", f"lets it follow {one}, not {other}", {"mimic": b.mimic})]


def _number(name: str, a: Array, b: Array) -> str:
    what = "spring of stiffness" if name == "stiffness" else name
    unit = ""
    for factor, says in ((_DEGREE, "per degree for per radian"), (1 / _DEGREE, "per radian for per degree")):
        if a.any() and np.allclose(b, factor * a, rtol=1e-9):
            unit = f" ({says})"
    return f"has {what} {told(b)} for {told(a)}{unit}"


def _limits(a: Joint, limits: dict[str, Array]) -> str:
    lost = [n for n, x in limits.items() if not np.isfinite(x).any()]
    kept = [n for n in limits if n not in lost]
    parts = [f"{_told_limit(n)} {told(limits[n])} for {told(getattr(a, n))}" for n in kept]
    parts += [f"no {_told_limit(n)} ({told(getattr(a, n))})" for n in lost]
    return f"has {', '.join(parts)}"


def _told_limit(name: str) -> str:
    return f"{name} limit" if name in ("lower", "upper") else name.replace("_", " ")


# Usual mistakes with what belongs to no single body or joint: gravity, point springs, joint couplings, the ground.

#: What acts on the motion through no term, but through constraints.
CONSTRAINTS: Final = frozenset({"loop", "prescribed motion"})


def with_gravity(model: Model, gravity: Array) -> Model:
    """Return the description under another gravity."""
    return replace(model, gravity=gravity)


def gravities(a: Array) -> Iterator[Guess]:
    """Yield what gravity could be after each mistake."""
    if a.any():
        yield Guess("gravity", "has no gravity", np.zeros(3))
        yield Guess("gravity", "has gravity with the other sign", -a)


def named_whole(a: Model, b: Model, near: Near) -> list[Hypothesis]:
    """Return what makes gravity, springs, couplings, loops and prescribed motions of `a` those of `b`."""
    out = []
    if not near.vector(a.gravity, b.gravity, max(1.0, float(np.abs(a.gravity).max()))):
        says = next((g.says for g in gravities(a.gravity) if near.vector(g.value, b.gravity)), None)
        says = says or f"has the gravity {told(b.gravity)} m/s² for {told(a.gravity)}"
        sides = {"gravity": a.gravity}, {"gravity": b.gravity}
        out.append(Hypothesis("gravity", "", says, _with_fields, *sides, a.gravity, b.gravity))
    for section, kind, what in (
        ("springs", "point spring", "spring"),
        ("couplings", "joint coupling", "coupling"),
        ("loops", "loop", "loop"),
        ("prescribed", "prescribed motion", "motion of"),
    ):
        out += _parts(a, b, section, kind, what, near)
    return out


def _parts(a: Model, b: Model, field: str, kind: str, what: str, near: Near) -> list[Hypothesis]:
    key = "joint" if field == "prescribed" else "name"
    ours, theirs = ({getattr(x, key): x for x in getattr(m, field)} for m in (a, b))
    out = []
    for name in dict.fromkeys([*ours, *theirs]):
        one, other = ours.get(name), theirs.get(name)
        if one is not None and other is not None and _alike(one, other, near):
            continue
        says = "lacks it" if other is None else "has it besides" if one is None else "has other numbers for it"
        put = _exchange(field, key)
        out.append(Hypothesis(kind, f"{what} {name!r}", says, put, {name: one}, {name: other}))
    return out


def _with_fields(x: Compact, fields: Mapping[str, Any]) -> Compact:
    return replace(x, model=replace(x.model, **fields))


def _exchange(field: str, key: str) -> Callable[[Compact, Mapping[str, Any]], Compact]:
    """Return what exchanges springs, loops or prescribed motions by name; None takes one away."""

    def put(x: Compact, parts: Mapping[str, Any]) -> Compact:
        kept = [p for p in getattr(x.model, field) if getattr(p, key) not in parts]
        return _with_fields(x, {field: (*kept, *(p for p in parts.values() if p is not None))})

    return put


def _alike(a: Any, b: Any, near: Near) -> bool:
    for x, y in zip(a._values(), b._values(), strict=True):
        if isinstance(x, np.ndarray):
            if not near.point(x, y):
                return False
        elif isinstance(x, float):
            if not near.number(x, y):
                return False
        elif x != y:
            return False
    return True
