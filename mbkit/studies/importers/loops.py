"""Loops and couplers that an importer reads out of a file, against those of the file, end by end.

Bodies have other frames, names and fused parts in every importer. Ends are therefore compared by the joint that carries
them, and by their poses in the world where all coordinates are zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from mbkit._check import Array
from mbkit.load.xml_reader import Element
from mbkit.model import Coupler, Loop, Mimic, Model
from mbkit.studies.explain.hypotheses import angle_of
from mbkit.studies.explain.merged_model import Tolerances

#: What switches equalities off, by element.
_SWITCHES: Final = {**dict.fromkeys(("equality", "connect", "weld"), ("active",)), "flag": ("equality", "constraint")}


@dataclass(frozen=True)
class Closure:
    """A loop between the joints that carry its ends; joint "" is the world.

    `ends` are their poses in the world where all coordinates are zero, (2, 4, 4).
    """

    name: str
    kind: str
    joints: tuple[str, str]
    ends: Array

    @property
    def key(self) -> tuple[str, ...]:
        """What two readings of one loop share."""
        return self.kind, *sorted(self.joints)

    def says(self) -> str:
        """Return its name, or its kind where an importer gives none, and its joints."""
        between = " and ".join(repr(x) if x else "the world" for x in self.joints)
        return f"{self.name or f'a loop of {self.kind}s'} (between {between})"


class WrittenLoops(NamedTuple):
    """The loops and couplers that importers are compared with."""

    active: Sequence[Closure] = ()
    #: With those that the file has switched off.
    every: Sequence[Closure] = ()
    #: Why they are unknown; empty where they are known.
    faults: str = ""
    couplers: Sequence[Coupler] = ()
    every_coupler: Sequence[Coupler] = ()


def closures(model: Model, loops: Sequence[Loop], names: Mapping[str, str] | None = None) -> list[Closure]:
    """Return loops on the bodies of a description; `names` has other names for its joints."""
    names = names or {}
    poses, carriers = {"world": np.eye(4)}, {"world": ""}
    for joint in model.tree:
        poses[joint.child] = poses[joint.parent] @ _pose(joint.rotation, joint.translation)
        still = joint.type.nv == 0
        carriers[joint.child] = carriers[joint.parent] if still else names.get(joint.name, joint.name)
    out = []
    for x in loops:
        joints = carriers[x.body_a], carriers[x.body_b]
        ends = [
            poses[x.body_a] @ _pose(x.rotation_a, x.translation_a),
            poses[x.body_b] @ _pose(x.rotation_b, x.translation_b),
        ]
        # What no joint moves against each other is no loop.
        if joints[0] != joints[1]:
            order = (1, 0) if joints[0] > joints[1] else (0, 1)
            out.append(Closure(x.name, x.kind, tuple(joints[k] for k in order), np.array([ends[k] for k in order])))  # type: ignore[arg-type]  # of two
    return out


def difference(a: Closure, b: Closure) -> tuple[float, float]:
    """Return by how much the ends of b are moved and turned against those of a, in m and rad.

    A weld binds two bodies in one relative pose. Which frame holds them there is free, so b's second frame is put on
    a's before.
    """
    if a.kind == "point":
        return float(np.linalg.norm((b.ends - a.ends)[:, :3, 3], axis=1).max()), 0.0
    there = b.ends[0] @ _inverse(b.ends[1]) @ a.ends[1]
    far = float(np.linalg.norm(there[:3, 3] - a.ends[0, :3, 3]))
    return far, angle_of(a.ends[0, :3, :3].T @ there[:3, :3])


def loop_differences(written: WrittenLoops, read: Sequence[Closure], near: Tolerances) -> list[tuple[float, str, str]]:
    """Return by how much each loop differs, its name, and what differs in words; pairs are the nearest of a kind."""
    out: list[tuple[float, str, str]] = []
    left = list(read)
    pairs, lost = _paired(written.active, left)
    for a, b in pairs:
        far, turn = difference(a, b)
        zero, moved, turned = np.zeros(3), np.array([far, 0.0, 0.0]), np.array([turn, 0.0, 0.0])
        texts = [] if near.point(zero, moved) else [f"moved by {far:.3g} m"]
        texts += [] if near.vector(zero, turned) else [f"turned by {turn:.3g} rad"]
        if texts:
            out.append((max(far, turn), a.says(), " and ".join(texts)))
    out += [(1.0, a.says(), "missing") for a in lost]
    inactive = list(written.every)
    _paired(written.active, inactive)
    wrong, _ = _paired(inactive, left)
    out += [(1.0, a.says(), "inactive, read as active") for a, _ in wrong]
    return out + [(1.0, b.says(), "not in the file") for b in left]


def coupler_differences(
    written: WrittenLoops, file: Model, read: Sequence[Coupler], names: Mapping[str, str], tolerance: float
) -> list[tuple[float, str, str]]:
    """Return the same of couplers; `names` has the file's joint for each of the importer's.

    An importer may hold the file's mimic joints by couplers, or leave them free, which is not counted here.
    """
    out: list[tuple[float, str, str]] = []
    left = [
        _ordered(replace(x, joint=names.get(x.joint, ""), leader=tuple(names.get(n, "") for n in x.leaders)))
        for x in read
    ]
    inactive = list(map(_ordered, written.every_coupler))
    for a in map(_ordered, written.couplers):
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


def _paired(some: Sequence[Closure], left: list[Closure]) -> tuple[list[tuple[Closure, Closure]], list[Closure]]:
    """Pair closures with the nearest of `left`, which are taken out of it, and return those without a partner."""
    waiting, pairs = list(some), list[tuple[Closure, Closure]]()
    while True:
        near = [
            (sum(difference(a, b)), i, k) for i, a in enumerate(waiting) for k, b in enumerate(left) if a.key == b.key
        ]
        if not near:
            return pairs, waiting
        _, i, k = min(near)
        pairs.append((waiting.pop(i), left.pop(k)))


def activated(root: Element) -> Element:
    """Return an MJCF with all its equalities active."""
    attributes = {k: x for k, x in root.attributes.items() if k not in _SWITCHES.get(root.tag, ())}
    return replace(root, attributes=attributes, children=[activated(x) for x in root.children])


def _inverse(X: Array) -> Array:
    return _pose(X[:3, :3].T, -X[:3, :3].T @ X[:3, 3])


def _pose(R: Array, p: Array) -> Array:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, p
    return X
