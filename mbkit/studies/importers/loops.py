"""Loops and couplers that an importer reads out of a file, against those of the file, end by end.

Bodies have other frames, names and fused parts in every importer. Ends are therefore compared by the joint that carries
them, and by their poses in the world where all coordinates are zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit._check import Array
from mbkit.load.xml_reader import Element
from mbkit.model import Coupler, Loop, Mimic, Model
from mbkit.model.elements.references import hung_on
from mbkit.studies.explain.loop_differences import exchanged, moved
from mbkit.studies.explain.merged_model import Tolerances

#: What switches equalities off, by element.
_SWITCHES: Final = {**dict.fromkeys(("equality", "connect", "weld"), ("active",)), "flag": ("equality", "constraint")}


class Written(NamedTuple):
    """The loops and couplers that importers are compared with."""

    active: Sequence[Loop | Coupler] = ()
    #: With those that the file has switched off.
    every: Sequence[Loop | Coupler] = ()
    #: Why they are unknown; empty where they are known.
    faults: str = ""


def between_joints(model: Model, parts: Sequence[Any], names: Mapping[str, str] | None = None) -> list[Any]:
    """Return loops of a description on the joints that carry their ends, and couplers as they are.

    The ends' poses are those in the world, which is the joint "", where all coordinates are zero; `names` has other
    names for joints. What no joint moves against each other is no loop.
    """
    at = {"world": ("", np.eye(3), np.zeros(3))}
    for joint in model.tree:
        placed = hung_on(joint, at, [])
        carrier = (names or {}).get(joint.name, joint.name) if joint.type.nv else placed.parent
        at[joint.child] = carrier, placed.rotation, placed.translation
    moved = [hung_on(x, at, []) if isinstance(x, Loop) else x for x in parts]
    loops = [x for x in moved if isinstance(x, Loop) and x.body_a != x.body_b]
    ordered = [exchanged(x) if x.body_a > x.body_b else x for x in loops]
    return [*ordered, *(x for x in moved if isinstance(x, Coupler))]


def loop_differences(written: Written, read: Sequence[Any], near: Tolerances) -> list[tuple[float, str, str]]:
    """Return by how much each loop differs, its name, and what differs in words; pairs are the nearest of a kind."""
    out: list[tuple[float, str, str]] = []
    active, inactive, left = ([x for x in some if isinstance(x, Loop)] for some in (*written[:2], read))
    pairs, lost = _paired(active, left)
    for a, b in pairs:
        far, turn = moved(a, b)
        texts = [] if far <= near.relative * near.length else [f"moved by {far:.3g} m"]
        texts += [] if turn <= near.relative else [f"turned by {turn:.3g} rad"]
        if texts:
            out.append((max(far, turn), _between(a), " and ".join(texts)))
    out += [(1.0, _between(a), "missing") for a in lost]
    _paired(active, inactive)
    wrong, _ = _paired(inactive, left)
    out += [(1.0, _between(a), "inactive, read as active") for a, _ in wrong]
    return out + [(1.0, _between(b), "not in the file") for b in left]


def coupler_differences(
    written: Written, file: Model, read: Sequence[Any], names: Mapping[str, str], tolerance: float
) -> list[tuple[float, str, str]]:
    """Return the same of couplers; `names` has the file's joint for each of the importer's.

    An importer may hold the file's mimic joints by couplers, or leave them free, which is not counted here.
    """
    out: list[tuple[float, str, str]] = []
    left = [
        _ordered(replace(x, joint=names.get(x.joint, ""), leader=tuple(names.get(n, "") for n in x.leaders)))
        for x in read
        if isinstance(x, Coupler)
    ]
    active, inactive = ([_ordered(x) for x in some if isinstance(x, Coupler)] for some in written[:2])
    for a in active:
        _taken(a, inactive)
        if (b := _taken(a, left)) is None:
            out.append((1.0, _says(a), "missing"))
        elif (far := _apart(a, b)) > tolerance * max(1.0, float(np.abs(a.ratio).sum()) + abs(a.offset)):
            says = f"ratio {_text(b.ratios)} and offset {b.offset:.6g} for {_text(a.ratios)} and {a.offset:.6g}"
            if (a.curve != b.curve).any():
                says += f", curve {_text(b.curve)} for {_text(a.curve)}"
            out.append((far, _says(a), says))
    mimics = {j.name: j.mimic for j in file.joints if j.mimic}
    for b in left:
        (root, r1, o1), *others = (_from_root(name, mimics) for name in (b.joint, *b.leaders))
        far = abs(r1 - sum(c * r for c, (_, r, _) in zip(b.ratios, others, strict=True)))
        far += abs(o1 - sum(c * o for c, (_, _, o) in zip(b.ratios, others, strict=True)) - b.offset)
        far += float(np.abs(b.curve).sum())
        mimicked = all(name == root for name, *_ in others)
        if mimicked and far <= tolerance * max(1.0, abs(r1) + abs(o1)):
            continue
        off = _taken(b, inactive) is not None
        unlike = "other numbers than the file's mimic joints" if mimicked else "not in the file"
        out.append((far if mimicked else 1.0, _says(b), "inactive, read as active" if off else unlike))
    return out


def _from_root(name: str, mimics: Mapping[str, Mimic]) -> tuple[str, float, float]:
    """Return the joint that leads in the end, with ratio and offset."""
    ratio, offset = 1.0, 0.0
    while mimic := mimics.get(name):
        name, ratio, offset = mimic.joint, ratio * mimic.ratio, offset + ratio * mimic.offset
    return name, ratio, offset


def _taken(a: Coupler, some: list[Coupler]) -> Coupler | None:
    """Take the nearest coupler of the same joints out of some."""
    near = [(_apart(a, b), k) for k, b in enumerate(some) if (a.joint, a.leaders) == (b.joint, b.leaders)]
    return some.pop(min(near)[1]) if near else None


def _apart(a: Coupler, b: Coupler) -> float:
    return sum(float(np.abs(x - y).sum()) for x, y in zip(a._values()[3:], b._values()[3:], strict=True))


def _ordered(x: Coupler) -> Coupler:
    """Return a coupler with its joints in the order of their names, which its equation has either way without curve."""
    if x.curve.any() or not x.ratios.all():
        return x
    (joint, c), *others = sorted(zip((x.joint, *x.leaders), (1.0, *-x.ratios), strict=True))
    ratios = np.array([-d / c for _, d in others])
    return replace(x, joint=joint, leader=tuple(name for name, _ in others), ratio=ratios, offset=x.offset / c)


def _says(x: Coupler) -> str:
    *first, last = map(repr, (x.joint, *x.leaders))
    return f"{repr(x.name) if x.name else 'a coupler'} (of {', '.join(first)} and {last})"


def _text(numbers: Array) -> str:
    return " ".join(f"{x:.6g}" for x in numbers)


def _between(x: Loop) -> str:
    """Return a loop's name, or its kind where an importer gives none, and its joints."""
    joints = " and ".join(repr(x) if x else "the world" for x in (x.body_a, x.body_b))
    return f"{x.name or f'a loop of {x.kind}s'} (between {joints})"


def _paired(some: Sequence[Loop], left: list[Loop]) -> tuple[list[tuple[Loop, Loop]], list[Loop]]:
    """Pair loops with the nearest of `left`, which are taken out of it, and return those without a partner."""
    waiting, pairs = list(some), list[tuple[Loop, Loop]]()
    while True:
        near = [
            (sum(moved(a, b)), i, k)
            for i, a in enumerate(waiting)
            for k, b in enumerate(left)
            if (a.kind, a.body_a, a.body_b) == (b.kind, b.body_a, b.body_b)
        ]
        if not near:
            return pairs, waiting
        _, i, k = min(near)
        pairs.append((waiting.pop(i), left.pop(k)))


def activated(root: Element) -> Element:
    """Return an MJCF with all its equalities active."""
    attributes = {k: x for k, x in root.attributes.items() if k not in _SWITCHES.get(root.tag, ())}
    return replace(root, attributes=attributes, children=[activated(x) for x in root.children])
