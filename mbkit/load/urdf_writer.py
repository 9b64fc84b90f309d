"""A description as URDF, where the format can say it; the ground is a link called world."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit._escape import xml_attribute, xml_comment
from mbkit.errors import UnsupportedError
from mbkit.model import Body, Joint, Model

_TYPES: Final = {
    "fixed": "fixed",
    "revolute": "revolute",
    "continuous": "continuous",
    "prismatic": "prismatic",
    "planar": "planar",
    "free": "floating",
}
# Stands for no limit: the largest number that every reader reads.
_OPEN: Final = 1e308


def urdf_text(model: Model, comment: str) -> str:
    """Return a description as URDF, or raise `UnsupportedError` with every part that URDF does not have."""
    faults = list(_unsupported(model))
    if faults:
        raise UnsupportedError(f"URDF cannot say of {model.name}: {'; '.join(faults)}")
    lines = [
        f"<robot name={xml_attribute(model.name)}>",
        f"  <!-- {xml_comment(comment)} -->",
        '  <link name="world"/>',
    ]
    for body in model.bodies:
        lines += _link(body)
    for joint in model.joints:
        lines += _joint(joint)
    links = {b.name for b in model.bodies} | {"world"}
    joints = {j.name for j in model.joints}
    for frame in model.frames:
        # Here a body's own frame cannot be another one.
        if frame.name in links:
            continue
        name = f"{frame.name}_fixed"
        while name in joints:
            name += "_"
        joints.add(name)
        lines += [
            f"  <link name={xml_attribute(frame.name)}/>",
            f'  <joint name={xml_attribute(name)} type="fixed">',
            f"    {_origin(frame.rotation, frame.translation)}",
            f"    <parent link={xml_attribute(frame.body)}/>",
            f"    <child link={xml_attribute(frame.name)}/>",
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>"]) + "\n"


def _unsupported(model: Model) -> Iterator[str]:
    for joint in model.joints:
        item = f"joint {joint.name!r}"
        if joint.kind not in _TYPES:
            yield f"{item} is {'a ball joint' if joint.kind == 'ball' else joint.kind.replace('_', '-')}"
            continue
        if joint.armature.any():
            yield f"{item} has armature"
        if joint.stiffness.any():
            yield f"{item} has a spring"
        if joint.type.nv > 1 and (joint.damping.any() or joint.friction.any()):
            yield f"{item} is {joint.kind} and has damping or friction"
        if joint.type.nv > 1 and np.isfinite([joint.lower, joint.upper]).any():
            yield f"{item} is {joint.kind} and has limits"
    yield from (f"spring {s.name!r} between two points" for s in model.springs)
    yield from (f"coupling {c.name!r} between joints" for c in model.couplings)
    yield from (f"loop {x.name!r}" for x in model.loops)
    yield from (f"joint {p.joint!r} is moved in time" for p in model.prescribed)


def _numbers(*values: Any) -> str:
    return " ".join(repr(float(x) + 0.0) for x in np.ravel(values))


def _origin(R: Array, p: Array) -> str:
    rpy = spatial.rpy_from_matrix(R)
    return f'<origin xyz="{_numbers(p)}" rpy="{_numbers(rpy)}"/>'


def _link(body: Body) -> list[str]:
    head = f"  <link name={xml_attribute(body.name)}"
    if not body.mass and not body.inertia.any():
        return [f"{head}/>"]
    moments = {f"i{'xyz'[i]}{'xyz'[j]}": body.inertia[i, j] for i in range(3) for j in range(i, 3)}
    listing = " ".join(f'{k}="{_numbers(x)}"' for k, x in moments.items())
    return [
        f"{head}>",
        "    <inertial>",
        f'      <origin xyz="{_numbers(body.com)}"/>',
        f'      <mass value="{_numbers(body.mass)}"/>',
        f"      <inertia {listing}/>",
        "    </inertial>",
        "  </link>",
    ]


def _joint(joint: Joint) -> list[str]:
    bounded = joint.kind == "prismatic" or (joint.kind == "revolute" and np.isfinite([joint.lower, joint.upper]).any())
    type_ = _TYPES[joint.kind] if joint.kind != "revolute" or bounded else "continuous"
    out = [
        f'  <joint name={xml_attribute(joint.name)} type="{type_}">',
        f"    {_origin(joint.rotation, joint.translation)}",
        f"    <parent link={xml_attribute(joint.parent)}/>",
        f"    <child link={xml_attribute(joint.child)}/>",
    ]
    if joint.kind == "planar":
        out.append('    <axis xyz="0 0 1"/>')
    if joint.type.nv == 1:
        out.append(f'    <axis xyz="{_numbers(joint.axes[0])}"/>')
        limits = {"effort": joint.effort_limit[0], "velocity": joint.velocity_limit[0]}
        if bounded:
            limits = {"lower": joint.lower[0], "upper": joint.upper[0]} | limits
        if bounded or np.isfinite(list(limits.values())).any():
            listing = " ".join(f'{k}="{_numbers(np.clip(x, -_OPEN, _OPEN))}"' for k, x in limits.items())
            out.append(f"    <limit {listing}/>")
        dynamics = {k: float(getattr(joint, k)[0]) for k in ("damping", "friction") if getattr(joint, k).any()}
        if dynamics:
            listing = " ".join(f'{k}="{_numbers(x)}"' for k, x in dynamics.items())
            out.append(f"    <dynamics {listing}/>")
    if joint.mimic is not None:
        m = joint.mimic
        listing = f'multiplier="{_numbers(m.ratio)}" offset="{_numbers(m.offset)}"'
        out.append(f"    <mimic joint={xml_attribute(m.joint)} {listing}/>")
    return [*out, "  </joint>"]
