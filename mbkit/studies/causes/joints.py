"""Usual mistakes with a joint: where it stands, what it turns about, what it carries along."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.model import Joint, Mimic
from mbkit.studies.causes.hypothesis import Guess, angle_of, told
from mbkit.studies.causes.near import Near
from mbkit.studies.causes.turns import misread

__all__ = ["HINGES", "blind", "named"]

_TURN: Final = 2 * np.pi
_DEGREE: Final = np.pi / 180
#: Numbers per velocity, by the name of what they are; those without a say in the smooth motion below.
_NUMBERS: Final = {"armature": "armature", "damping": "damping", "friction": "friction", "stiffness": "spring"}
_LIMITS: Final = ("lower", "upper", "velocity_limit", "effort_limit")
#: What differs in its limits alone.
HINGES: Final = frozenset({"revolute", "continuous"})


def blind(joint: Joint) -> Iterator[Guess]:
    """Yield what a joint could be after each mistake that needs no knowledge of the other side; fields of it."""
    for name, kind in _NUMBERS.items():
        if np.any(getattr(joint, name)):
            yield Guess(kind, f"has no {kind}", {name: np.zeros(joint.type.nv)})
    if joint.mimic is not None:
        yield Guess("mimic", f"leaves it free, which follows {joint.mimic.joint!r}", {"mimic": None})
        if joint.mimic.offset:
            mimic = Mimic(joint.mimic.joint, joint.mimic.ratio)
            yield Guess("mimic", "leaves out the offset at which it follows", {"mimic": mimic})
    if joint.kind == "helical":
        yield from _pitches(joint)
    yield from _axes(joint)
    yield from _places(joint)


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


def _places(joint: Joint) -> Iterator[Guess]:
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


def named(a: Joint, b: Joint, near: Near) -> list[Guess]:
    """Return the mistakes that make joint `a` joint `b`, with names as exact as can be."""
    out: list[Guess] = []
    if a.parent != b.parent:
        out.append(Guess("parent", f"hangs it on {b.parent!r} and not on {a.parent!r}", {"parent": b.parent}))
    if a.kind != b.kind and {a.kind, b.kind} != HINGES:
        # Nothing of one kind's numbers means anything to the other.
        whole = {f.name: getattr(b, f.name) for f in fields(b) if f.name not in ("name", "child", "parent")}
        return [*out, Guess("joint kind", f"has it as a {b.kind} joint, not a {a.kind} one", whole)]
    guesses = list(blind(a))
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
    if a.kind in ("revolute", "continuous", "helical") and np.allclose(R @ a.axes[0], a.axes[0], atol=1e-9):
        angle = float(np.copysign(angle, about @ a.axes[0]))
        return Guess("zero position", f"counts from {told(angle)} rad ({told(angle / _DEGREE)}°) further on", value)
    return Guess("joint rotation", f"has it turned by {told(angle)} rad ({told(angle / _DEGREE)}°)", value)


def _shifted(a: Joint, b: Joint, near: Near) -> Guess:
    value = {"translation": b.translation}
    d = a.rotation.T @ (b.translation - a.translation)
    if a.kind == "prismatic" and near.point(np.cross(d, a.axes[0]), np.zeros(3)):
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
