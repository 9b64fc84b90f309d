"""Loops and couplers that an importer reads out of a file, against those of the file, end by end.

Bodies have other frames, names and fused parts in every importer. Ends are therefore compared by the joint that carries
them, and by their poses in the world where all coordinates are zero.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple, TypeVar

import numpy as np

from mbkit.load.xml_reader import Element
from mbkit.model import Coupler, Loop, Model
from mbkit.model.elements.references import hung_on
from mbkit.studies.explain.hypotheses import exchanged, follows, moved, paired
from mbkit.studies.explain.merged_model import Tolerances

#: Attributes that switch equalities off, by element.
_SWITCHES: Final = {**dict.fromkeys(("equality", "connect", "weld"), ("active",)), "flag": ("equality", "constraint")}
#: Parts by which a file, or an importer, holds joints.
Held = Loop | Coupler
Kind = TypeVar("Kind", Loop, Coupler)
#: By how much a part differs, its name, and what differs in words.
Difference = tuple[float, str, str]


class Written(NamedTuple):
    """The loops and couplers that importers are compared with."""

    active: Sequence[Held] = ()
    #: With those that the file has switched off.
    every: Sequence[Held] = ()
    #: Why they are unknown; empty where they are known.
    faults: str = ""


def between_joints(model: Model, parts: Sequence[Held], names: Mapping[str, str] | None = None) -> list[Loop | Coupler]:
    """Return loops of a description on the joints that carry their ends, and couplers of these joints.

    The ends' poses are those in the world, which is the joint "", where all coordinates are zero; `names` has other
    names for joints. What no joint moves against each other is no loop.
    """
    at = {"world": ("", np.eye(3), np.zeros(3))}
    other = dict(names or {j.name: j.name for j in model.joints})
    for joint in model.tree:
        placed = hung_on(joint, at, [])
        carrier = other.get(joint.name, joint.name) if joint.type.nv else placed.parent
        at[joint.child] = carrier, placed.rotation, placed.translation
    placed_loops = [hung_on(x, at, []) for x in parts if isinstance(x, Loop)]
    loops = [exchanged(x) if x.body_a > x.body_b else x for x in placed_loops if x.body_a != x.body_b]
    couplers = [x for x in parts if isinstance(x, Coupler)]
    leaders = [tuple(other.get(n, "") for n in x.leaders) for x in couplers]
    own = (replace(x, joint=other.get(x.joint, ""), leader=some) for x, some in zip(couplers, leaders, strict=True))
    return [*loops, *map(_ordered, own)]


def loop_differences(written: Written, read: Sequence[Held], near: Tolerances) -> list[Difference]:
    """Return what differs between the loops of a file and those that were read."""

    def apart(a: Loop, b: Loop) -> float:
        return sum(moved(a, b)) if (a.kind, a.body_a, a.body_b) == (b.kind, b.body_a, b.body_b) else np.inf

    def says(a: Loop, b: Loop) -> str:
        far, turn = moved(a, b)
        texts = [f"moved by {far:.3g} m"] * (far > near.relative * near.length)
        return " and ".join(texts + [f"turned by {turn:.3g} rad"] * (turn > near.relative))

    return _differences(Loop, written, read, apart, says)


def coupler_differences(written: Written, file: Model, read: Sequence[Held], tolerance: float) -> list[Difference]:
    """Return the same of couplers: an importer may hold the file's mimic joints by them, or leave these free."""

    def apart(a: Coupler, b: Coupler) -> float:
        numbers = zip(a._values()[3:], b._values()[3:], strict=True)
        same = (a.joint, a.leaders) == (b.joint, b.leaders)
        return sum(float(np.abs(x - y).sum()) for x, y in numbers) if same else np.inf

    def says(a: Coupler, b: Coupler) -> str:
        size = max(1.0, float(np.abs(a.ratio).sum()) + abs(a.offset))
        return f"{follows(b)}, not {follows(a)}" if apart(a, b) > tolerance * size else ""

    return _differences(Coupler, written, read, apart, says, lambda x: _is_mimicked(x, file, tolerance))


def _differences(
    of: type[Kind],
    written: Written,
    read: Sequence[Held],
    apart: Callable[[Kind, Kind], float],
    says: Callable[[Kind, Kind], str],
    implied: Callable[[Kind], bool] = lambda _: False,
) -> list[Difference]:
    active, inactive, left = ([x for x in some if isinstance(x, of)] for some in (*written[:2], read))
    pairs, lost = paired(active, left, apart)
    left = [x for x in left if not implied(x)]
    paired(active, inactive, apart)
    wrong, _ = paired(inactive, left, apart)
    out = [(apart(a, b), _called(a), text) for a, b in pairs if (text := says(a, b))]
    out += [(1.0, _called(a), "missing") for a in lost]
    out += [(1.0, _called(a), "inactive, read as active") for a, _ in wrong]
    return out + [(1.0, _called(b), "not in the file") for b in left]


def _is_mimicked(x: Coupler, file: Model, tolerance: float) -> bool:
    """Return whether a coupler says what mimic joints of the file do."""
    mimics = {j.name: j.mimic for j in file.joints if j.mimic}
    total, offset = dict[str, float](), -x.offset
    for name, factor in zip((x.joint, *x.leaders), (1.0, *-x.ratios), strict=True):
        while mimic := mimics.get(name):
            offset += factor * mimic.offset
            name, factor = mimic.joint, factor * mimic.ratio
        total[name] = total.get(name, 0.0) + factor
    far = [offset, *total.values(), *x.curve]
    return bool(np.abs(far).max() <= tolerance * (1.0 + abs(x.offset) + np.abs(x.ratios).sum()))


def _ordered(x: Coupler) -> Coupler:
    """Return a coupler with its joints in the order of their names, which its equation has either way without curve."""
    if x.curve.any() or not x.ratios.all():
        return x
    (joint, c), *others = sorted(zip((x.joint, *x.leaders), (1.0, *-x.ratios), strict=True))
    ratios = np.array([-d / c for _, d in others])
    return replace(x, joint=joint, leader=tuple(name for name, _ in others), ratio=ratios, offset=x.offset / c)


def _called(x: Held) -> str:
    """Return a part's name, or its kind where an importer gives none, and its joints."""
    if isinstance(x, Loop):
        joints = " and ".join(repr(name) if name else "the world" for name in (x.body_a, x.body_b))
        return f"{x.name or f'a loop of {x.kind}s'} (between {joints})"
    *first, last = map(repr, (x.joint, *x.leaders))
    return f"{repr(x.name) if x.name else 'a coupler'} (of {', '.join(first)} and {last})"


def activated(root: Element) -> Element:
    """Return an MJCF with all its equalities active."""
    attributes = {k: x for k, x in root.attributes.items() if k not in _SWITCHES.get(root.tag, ())}
    return replace(root, attributes=attributes, children=[activated(x) for x in root.children])
