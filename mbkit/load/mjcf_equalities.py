"""Equality constraints of an MJCF as loops (XML reference of MuJoCo 4.0, section "equality").

A <connect> becomes a loop of two points, a <weld> one of two frames, and a <joint> or <tendon> that holds joints a
coupler, all exact where MuJoCo's are soft. What an element with bodies does not say is measured in the reference
configuration, the pose of the file: the second anchor of a <connect>, and the relative pose of a <weld>.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.polynomial import Polynomial

from mbkit import spatial
from mbkit._reproducible import product
from mbkit.load.mjcf_attributes import HERE, Pose, has_length
from mbkit.load.mjcf_compiled import name_list
from mbkit.load.mjcf_couplings import bound_parts, element_label
from mbkit.load.mjcf_reader import Scene
from mbkit.load.urdf_reader import Snapper
from mbkit.load.xml_reader import Element, unused
from mbkit.model import ModelBuilder
from mbkit.model.description import LEFT_OUT
from mbkit.model.validation import listing

_KINDS: Final = {"connect": "point", "weld": "frame"}
#: Attributes by which MuJoCo softens an element; an exact loop has none of it.
_SOFT: Final = ("solref", "solimp", "torquescale")
_JOINT: Final = "joint"
_COUPLED: Final = (_JOINT, "tendon")
#: Joint, leaders, their ratios, offset and curve of a coupler.
_Curve = tuple[str, list[str], list[float], float, list[float]]


def coupled(sides: Sequence[Mapping[str, float]], shape: Sequence[float], refs: Mapping[str, float]) -> _Curve | str:
    """Return an equality l₁ = P(l₂) as a coupler, or why it is none.

    A side is a sum of coordinates, less those of the pose of the file, with factors by joint. `shape` has P's five
    coefficients; a single side is equal to the first.
    """
    a, b = (*sides, {})[:2]
    if len(a) == len(b) == 1 and a.keys() != b.keys():
        ((joint, c), (leader, d)) = (*a.items(), *b.items())
        curve = Polynomial(shape)(Polynomial([-d * refs[leader], d])) if d != 1 or refs[leader] else Polynomial(shape)
        constant, ratio, *higher = (float(x) / c for x in (*curve.coef, *[0.0] * 5)[:5])
        leaders, ratios = [leader], [ratio]
    elif b and any(shape[2:]):
        return "it is a polynomial of a sum of coordinates"
    else:
        row = {name: a.get(name, 0.0) - shape[1] * b.get(name, 0.0) for name in (*a, *b)}
        row = {name: x for name, x in row.items() if x}
        if len(row) < 2:
            return "it holds a single joint"
        (joint, c), *others = row.items()
        constant = sum((d * refs[leader] for leader, d in others), shape[0]) / c
        leaders, ratios, higher = [x for x, _ in others], [-d / c for _, d in others], [0.0] * 3
    return joint, leaders, ratios, refs[joint] + constant, higher


@dataclass(frozen=True)
class _End:
    """A frame on a body of the file, in its axes."""

    body: str
    pose: Pose


class Equalities:
    """The <equality> sections of a file; none becomes a loop unless `enabled`, or where a flag switches them off.

    `tendons` has dl/dq of each joint for the lengths that are sums of coordinates, and nothing for the others.
    """

    def __init__(
        self,
        mujoco: Element,
        scene: Scene,
        disabled: set[str],
        *,
        enabled: bool,
        tendons: Mapping[str, Mapping[str, float]],
    ) -> None:
        self._scene, self._read = scene, scene.read
        self._left_out: list[str] = []
        self._soft: list[str] = []
        self._loops: dict[str, tuple[str, _End, _End]] = {}
        self._tendons = tendons
        self._couplers: dict[str, _Curve] = {}
        elements = [(e, element_label(e, k)) for k, e in self._numbered(mujoco)]
        if not elements:
            return
        #: Pose of each body in the reference configuration, and the body that carries it there.
        self._poses, self._carriers, self._anchors = {"world": HERE}, {"world": "world"}, {"world": np.zeros(3)}
        for body in scene.bodies:
            self._poses[body.name] = self._poses[body.parent] @ body.pose
            self._carriers[body.name] = body.name if body.joints else self._carriers[body.parent]
            self._anchors[body.name] = body.anchor
        self._sites = {name: _End("world", X) for name, X in scene.sites}
        self._sites |= {name: _End(body.name, X) for body in scene.bodies for name, X in body.sites}
        mocap_bodies = {e.attributes.get("name") for e in mujoco.walk() if e.attributes.get("mocap") == "true"}
        for element, label in elements:
            full = replace(scene.defaults.filled(replace(element, tag="equality"), None), tag=element.tag)
            why = "" if element.tag in (*_KINDS, *_COUPLED) else "no loop"
            if off := disabled & {"equality", "constraint"}:
                why = f"option flag {sorted(off)[0]} is off"
            elif full.attributes.get("active") == "false":
                why = "it is inactive"
            elif not enabled and not why:
                why = "loops=False"
            if not why and element.tag in _COUPLED:
                why = self._couple(full, f"equality {label}")
                if not why:
                    continue
            ends = None if why else self._ends(full, f"equality {label}")
            if ends is not None:
                a, b = (end.body for end in ends)
                if self._carriers[a] == self._carriers[b]:
                    why = "no joint moves its ends against each other"
                elif mocap_bodies & {a, b}:
                    why = "a motion capture body moves it"
                else:
                    name = unused(element.attributes.get("name") or f"{element.tag}{len(self._loops) + 1}", self._loops)
                    self._loops[name] = (_KINDS[element.tag], *ends)
                    if numbers := self._softness(full, f"equality {label}"):
                        self._soft.append(f"{name!r} ({numbers})")
                    continue
            if why:
                self._left_out.append(f"{label} ({bound_parts(element)}){'' if why == 'no loop' else f': {why}'}")

    def _couple(self, element: Element, item: str) -> str:
        """Take an equality of joints or of tendons, or return why it is left out."""
        kind = element.tag
        joints = {j.name: {j.name: 1.0} for body in self._scene.bodies for j in body.joints if j.scalar}
        known, expected = (joints, "hinge or slide") if kind == _JOINT else (self._tendons, "tendon")
        sides: list[Mapping[str, float]] = []
        for key in (f"{kind}1", f"{kind}2"):
            name = element.attributes.get(key, "")
            if not name and sides:
                break
            if name not in known:
                self._read.fault(f"{item}: {key} {name!r} is no {expected} of the file", element)
                return f"a {kind} is missing"
            if not known[name]:
                return f"tendon {name!r} is no sum of coordinates"
            sides.append(known[name])
        standard = (0.0, 1.0, 0.0, 0.0, 0.0)
        shape = self._read.numbers(element, "polycoef", item, count=5, least=1, default=standard)
        shape = (*shape, *standard[len(shape) :])
        refs = {j.name: j.ref for body in self._scene.bodies for j in body.joints}
        coupler = coupled(sides, shape, refs)
        if isinstance(coupler, str):
            return coupler
        name = unused(element.attributes.get("name") or f"{kind}{len(self._couplers) + 1}", self._couplers)
        self._couplers[name] = coupler
        return ""

    @staticmethod
    def _numbered(mujoco: Element) -> Iterable[tuple[int, Element]]:
        return enumerate((e for section in mujoco.all("equality") for e in section.children), 1)

    def _softness(self, element: Element, item: str) -> str:
        """Return the numbers by which an element is softer or stiffer than MuJoCo's default, as text."""
        softness = {name: element.attributes[name] for name in _SOFT if name in element.attributes}
        if "torquescale" in softness and self._read.number(element, "torquescale", item, 1.0) == 1.0:
            del softness["torquescale"]
        return ", ".join(f"{name} {' '.join(text.split())[:40]}" for name, text in softness.items())

    def _ends(self, element: Element, item: str) -> tuple[_End, _End] | None:
        """Return the two frames that an element binds; None after a fault."""
        names = element.attributes
        if "site1" in names or "site2" in names:
            if any(x in names for x in ("body1", "body2", "anchor", "relpose")):
                self._read.fault(f"{item}: sites, and bodies or an anchor; keep one of the two", element)
                return None
            ends = [self._sites.get(names.get(key, "")) for key in ("site1", "site2")]
            for key, site in zip(("site1", "site2"), ends, strict=True):
                if site is None:
                    self._read.fault(f"{item}: {key} {names.get(key, '')!r} is no site of the file", element)
            a, b = ends
            return None if a is None or b is None else (a, b)
        body1, body2 = names.get("body1", ""), names.get("body2", "world")
        for key, body in (("body1", body1), ("body2", body2)):
            if body not in self._poses:
                self._read.fault(f"{item}: {key} {body!r} is no body of the file", element)
                return None
        # Pose of the second body in the first one's axes, in the reference configuration.
        between = _inverse(self._poses[body1]) @ self._poses[body2]
        if element.tag == "connect":
            point = np.array(self._read.numbers(element, "anchor", item, count=3))
            at = _inverse(between) @ Pose(between.R, point)
            return _End(body1, Pose(np.eye(3), point)), _End(body2, Pose(np.eye(3), at.p))
        point = np.array(self._read.numbers(element, "anchor", item, count=3, default=(0.0, 0.0, 0.0)))
        # A quaternion of zeros, MuJoCo's default, asks for the reference configuration.
        relpose = np.array(
            self._read.numbers(element, "relpose", item, count=7, default=(0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        )
        if has_length(relpose[3:]):
            R = spatial.matrix_from_quaternion(spatial.normalized(np.roll(relpose[3:], -1)))
            # MuJoCo takes its position for the first body's point, whatever the anchor on the second is.
            return _End(body1, Pose(R, relpose[:3])), _End(body2, Pose(np.eye(3), point))
        return _End(body1, between @ Pose(np.eye(3), point)), _End(body2, Pose(np.eye(3), point))

    def add_to(self, b: ModelBuilder, snap: Snapper) -> None:
        """Add the loops, with notes on them and on the equalities that are left out."""
        for name, (kind, *ends) in self._loops.items():
            sides: dict[str, Any] = {}
            for end, side in zip(ends, "ab", strict=True):
                sides[f"body_{side}"] = end.body
                sides[f"translation_{side}"] = end.pose.p - self._anchors[end.body]
                sides[f"rotation_{side}"] = snap(end.pose.R) if kind == "frame" else None
            b.add_loop(name, kind, **sides)  # type: ignore[arg-type]  # of the kinds
        for name, (joint, leaders, ratios, offset, curve) in self._couplers.items():
            b.add_coupler(name, joint, leaders, ratio=ratios, offset=offset, curve=curve)
        if self._couplers:
            b.note(f"equalities of joints, held exactly where MuJoCo's are soft: {name_list(self._couplers)}")
        if self._loops:
            b.note(f"loops, held exactly where MuJoCo's are soft: {name_list(self._loops)}")
        if self._soft:
            b.note(f"left out, since loops are exact: {listing(self._soft)}")
        if self._left_out:
            b.note(f"{LEFT_OUT} of equality constraints: {'; '.join(self._left_out)}")


def _inverse(X: Pose) -> Pose:
    return Pose(X.R.T, -product(X.R.T, X.p))
