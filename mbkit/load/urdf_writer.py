"""A description as URDF, where the format can say it; the ground is a link called world."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from textwrap import indent
from typing import Any, Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit._escape import xml_attribute, xml_comment
from mbkit.load.urdf_reader import DYNAMICS
from mbkit.load.xml_reader import reserved
from mbkit.model import Body, Joint, Model
from mbkit.model.elements.kinds import joint_types
from mbkit.model.elements.paths import Path

_TYPES: Final = {k: k for k in ("fixed", "revolute", "continuous", "prismatic", "planar")} | {"free": "floating"}
_CARRIED: Final = "gravity mimic joint.limit joint.velocity_limit joint.effort_limit"


def _notes(model: Model) -> Iterator[str]:
    if not np.array_equal(model.gravity, [0.0, 0.0, -9.81]):
        yield f"URDF has no gravity: load it with gravity={tuple((model.gravity + 0.0).tolist())}"
    if hidden := {f.name for f in model.frames} & {b.name for b in model.bodies}:
        yield f"frames that have a body's name were left out: {', '.join(sorted(hidden))}"


URDF: Final = Path(
    "urdf",
    "URDF cannot say of",
    joint_types(*_TYPES) | {*_CARRIED.split(), *(f"joint.{x}" for x in DYNAMICS)},
    beside=_notes,
)
# Stands for no limit: the largest number that every reader reads.
_UNLIMITED: Final = 1e308


def urdf_text(model: Model, comment: str) -> str:
    """Return a description as URDF, or raise `UnsupportedError` with every part that URDF does not have."""
    URDF.admit(model)
    joints = {j.name for j in model.joints}
    parts = [_element("link", {"name": "world"}), *map(_link, model.bodies), *map(_joint, model.joints)]
    for frame in model.frames:
        # Here a body's own frame cannot be another one.
        if frame.name == "world" or any(frame.name == b.name for b in model.bodies):
            continue
        name = reserved(f"{frame.name}_fixed", joints)
        ends = _ends(frame.rotation, frame.translation, frame.body, frame.name)
        parts += [_element("link", {"name": frame.name}), _element("joint", {"name": name, "type": "fixed"}, *ends)]
    return _element("robot", {"name": model.name}, f"<!-- {xml_comment(comment)} -->", *parts) + "\n"


def _element(tag: str, attributes: Mapping[str, Any], *inside: str) -> str:
    """Return an element, with its content on lines of its own; values are texts or numbers."""
    texts = {k: v if isinstance(v, str) else _numbers(v) for k, v in attributes.items()}
    head = tag + "".join(f" {k}={xml_attribute(v)}" for k, v in texts.items())
    lines = "".join(indent(text, "  ") + "\n" for text in inside)
    return f"<{head}>\n{lines}</{tag}>" if inside else f"<{head}/>"


def _numbers(values: Any) -> str:
    return " ".join(repr(float(x) + 0.0) for x in np.ravel(values))


def _ends(R: Array, p: Array, parent: str, child: str) -> list[str]:
    origin = _element("origin", {"xyz": p, "rpy": spatial.rpy_from_matrix(R)})
    return [origin, _element("parent", {"link": parent}), _element("child", {"link": child})]


def _link(body: Body) -> str:
    if not body.mass and not body.inertia.any():
        return _element("link", {"name": body.name})
    moments = {f"i{'xyz'[i]}{'xyz'[j]}": body.inertia[i, j] for i in range(3) for j in range(i, 3)}
    parts = _element("origin", {"xyz": body.com}), _element("mass", {"value": body.mass}), _element("inertia", moments)
    return _element("link", {"name": body.name}, _element("inertial", {}, *parts))


def _joint(joint: Joint) -> str:
    turns, limited = joint.kind in ("revolute", "continuous"), np.isfinite([joint.lower, joint.upper]).any()
    bounded = joint.kind == "prismatic" or (turns and limited)
    # A continuous joint of URDF has no limits.
    type_ = ("revolute" if limited else "continuous") if turns else _TYPES[joint.kind]
    out = _ends(joint.rotation, joint.translation, joint.parent, joint.child)
    if joint.kind == "planar":
        out.append(_element("axis", {"xyz": "0 0 1"}))
    if joint.type.nv == 1:
        out.append(_element("axis", {"xyz": joint.axes[0]}))
        limits = {"effort": joint.effort_limit, "velocity": joint.velocity_limit}
        if bounded:
            limits = {"lower": joint.lower, "upper": joint.upper} | limits
        if bounded or np.isfinite(list(limits.values())).any():
            out.append(_element("limit", {k: np.clip(x, -_UNLIMITED, _UNLIMITED) for k, x in limits.items()}))
        dynamics = {k: x for k in DYNAMICS if (x := getattr(joint, k)).any()}
        out += [_element("dynamics", dynamics)] if dynamics else []
    if joint.mimic is not None:
        m = joint.mimic
        out.append(_element("mimic", {"joint": m.joint, "multiplier": m.ratio, "offset": m.offset}))
    return _element("joint", {"name": joint.name, "type": type_}, *out)
