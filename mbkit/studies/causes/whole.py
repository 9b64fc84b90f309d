"""Usual mistakes with what belongs to no single body or joint: gravity, point springs, joint couplings, the ground."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.model import Model
from mbkit.studies.causes.compact import Compact
from mbkit.studies.causes.hypothesis import Guess, Hypothesis, told
from mbkit.studies.causes.near import Near

__all__ = ["CONSTRAINTS", "gravities", "named", "with_gravity"]

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


def named(a: Model, b: Model, near: Near) -> list[Hypothesis]:
    """Return what makes gravity, springs, couplings, loops and prescribed motions of `a` those of `b`."""
    out = []
    if not near.vector(a.gravity, b.gravity, max(1.0, float(np.abs(a.gravity).max()))):
        says = next((g.says for g in gravities(a.gravity) if near.vector(g.value, b.gravity)), None)
        says = says or f"has the gravity {told(b.gravity)} m/s² for {told(a.gravity)}"
        sides = {"gravity": a.gravity}, {"gravity": b.gravity}
        out.append(Hypothesis("gravity", "", says, _with_fields, *sides, a.gravity, b.gravity))
    for field, kind, what in (
        ("springs", "point spring", "spring"),
        ("couplings", "joint coupling", "coupling"),
        ("loops", "loop", "loop"),
        ("prescribed", "prescribed motion", "motion of"),
    ):
        out += _parts(a, b, field, kind, what, near)
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
