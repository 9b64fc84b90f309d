"""What two descriptions differ in, parameter by parameter, in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.studies.baseline.description import FLAT, SECTIONS, Description, Part, default

__all__ = ["Change", "changes"]

_EPS: Final = float(np.finfo(float).eps)
# Another release of a parser may add the same numbers in another order.
_ROUNDINGS: Final = 64
_XYZ: Final = ("x", "y", "z")
_ENTRIES: Final = {
    "com": _XYZ,
    "translation": _XYZ,
    "translation_a": _XYZ,
    "translation_b": _XYZ,
    "point_a": _XYZ,
    "point_b": _XYZ,
    "gravity": _XYZ,
    "inertia": ("xx", "xy", "xz", "yy", "yz", "zz"),
    "axes": (*_XYZ, "x of the second", "y of the second", "z of the second"),
}
# Of these, zero is no size: an origin moved by 1e-17 m has not moved.
_ABSOLUTE: Final = ("com", "translation", "rotation", "axes", "point", "lower", "upper")
# A turn this small cannot be told from the rounding of its sine.
_TURNED: Final = 1e-7


@dataclass(frozen=True)
class Change:
    """One parameter that differs.

    Attributes
    ----------
    section : str
        Such as ``"bodies"``.
    part : str
        Name of the body, joint or other part; empty where the section has but one.
    field : str
        Such as ``"mass"``; empty where the whole part is new or gone.
    old, new : number, text, list of numbers or None
    text : str
        In words: ``"mass of body link5: 2.3 → 2.31"``.
    rounding : bool
        Whether it is no more than rounding.
    """

    section: str
    part: str
    field: str
    old: Any
    new: Any
    text: str
    rounding: bool = False


def changes(old: Description, new: Description) -> tuple[Change, ...]:
    """Return what differs, causes before effects: a link's place before the body whose inertia it moves."""
    return tuple(c for section in SECTIONS for c in _section(section, old, new))


def _section(section: str, old: Description, new: Description) -> Iterator[Change]:
    before, after = old.get(section, {}), new.get(section, {})
    gone = [n for n in before if n not in after and n]
    added = [n for n in after if n not in before and n]
    noun = SECTIONS[section]
    for name in list(gone):
        same = [n for n in added if after[n] == before[name]]
        if same:
            gone.remove(name)
            added.remove(same[0])
            yield Change(section, name, "", name, same[0], f"{noun} {name} is called {same[0]} now")
    for name in gone:
        yield Change(section, name, "", before[name], None, f"{noun} {name} is gone")
    for name in added:
        yield Change(section, name, "", None, after[name], f"{noun} {name} is new")
    kept = [n for n in before if n in after] if section not in FLAT else [""]
    if section == "joints" and kept != (now := [n for n in after if n in before]):
        told = f"order of the joints: {', '.join(kept)} → {', '.join(now)}"
        yield Change(section, "", "order", kept, now, told)
    for name in kept:
        owner = f"{noun} {name}{_more(section, name, new)}"
        yield from _fields(section, name, owner, before.get(name, {}), after.get(name, {}))


def _more(section: str, name: str, description: Description) -> str:
    """Return the names of a file that stand for a part too: what a parser has merged into it."""
    frames = description.get("frames", {})
    if section == "frames":
        names = [n for n, frame in frames.items() if frame.get("same_as") == name]
        return f" ({', '.join(names)})" if names else ""
    names = [n for n, frame in frames.items() if section == "bodies" and frame.get("body") == name]
    return f" (with {', '.join(names)} fixed to it)" if names else ""


def _fields(section: str, name: str, owner: str, before: Part, after: Part) -> Iterator[Change]:
    for field in [*before, *(f for f in after if f not in before)]:
        if section in FLAT and section != "system":
            # What is left out of these does not exist, rather than being zero.
            old, new = before.get(field), after.get(field)
        else:
            old = before.get(field, default(field, after.get(field)))
            new = after.get(field, default(field, before.get(field)))
        if old == new:
            continue
        what = _what(section, field, owner)
        x, y = _numbers(old), _numbers(new)
        if x is None or y is None or x.shape != y.shape:
            yield Change(section, name, field, old, new, f"{what}: {_told(old)} → {_told(new)}")
            continue
        yield Change(section, name, field, old, new, f"{what}: {_difference(field, x, y)}", _only_rounding(field, x, y))


def _what(section: str, field: str, owner: str) -> str:
    if section == "parameters":
        return f"parameter {field}"
    words = field.replace("_", " ")
    return words if section in FLAT else f"{words} of {owner}"


def _numbers(x: Any) -> Array | None:
    return np.array(x, dtype=np.float64, ndmin=1) if isinstance(x, (int, float, list)) else None


def _told(x: Any) -> str:
    return "none" if x in (None, "") else str(x)


def _difference(field: str, old: Array, new: Array) -> str:
    if field.startswith("rotation"):
        turned = _turn(old, new)
        if turned:
            return turned
    names = _ENTRIES.get(field, [str(k) for k in range(len(old))] if len(old) > 1 else [""])
    # Equal infinities are no difference, though they have none.
    moved = [k for k in range(len(old)) if old[k] != new[k]]
    return ", ".join(f"{names[k]} {_pair(old[k], new[k])}".strip() for k in moved)


def _pair(old: float, new: float) -> str:
    for digits in (6, 9, 12):
        a, b = f"{old:.{digits}g}", f"{new:.{digits}g}"
        if a != b:
            return f"{a} → {b}"
    return f"{old:.17g} → {new:.17g}"


def _turn(old: Array, new: Array) -> str:
    """Return by how much and about which of the old axes a frame has turned; empty for less than can be told."""
    R = old.reshape(3, 3).T @ new.reshape(3, 3)
    twice = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    size = float(np.linalg.norm(twice))
    angle = float(np.arctan2(0.5 * size, 0.5 * (np.trace(R) - 1)))
    if angle < _TURNED:
        return ""
    if size < _TURNED:
        return f"turned by {angle:.6g} rad"
    axis = ", ".join(f"{x:g}" for x in np.round(twice / size, 4) + 0.0)
    return f"turned by {angle:.6g} rad about ({axis})"


def _only_rounding(field: str, old: Array, new: Array) -> bool:
    if not (np.isfinite(old).all() and np.isfinite(new).all()):
        return False
    size = max(float(np.linalg.norm(old)), 1.0 if field.startswith(_ABSOLUTE) else 0.0)
    return float(np.linalg.norm(new - old)) <= _ROUNDINGS * _EPS * size
