"""The MuJoCo model that mbkit builds, as MJCF with every digit, and read back by MuJoCo's own parser.

MuJoCo's writer keeps six digits. Here numbers are the shortest decimals that give the same doubles.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final

import mujoco
import numpy as np

from mbkit._check import Array
from mbkit._escape import xml_attribute, xml_comment
from mbkit.engines.base import Dynamics
from mbkit.engines.mujoco.engine import MujocoDynamics
from mbkit.engines.mujoco.model import JOINT_TYPES, MujocoModel, Placed, heard_warnings, mapped, specified
from mbkit.errors import UnsupportedError
from mbkit.model import Joint, Model

_TYPES: Final = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
}
# MuJoCo refuses principal moments below 1e-15 kg m².
_LEAST: Final = 2e-15


class ReadBack(MujocoDynamics):
    """MuJoCo on the model that its own parser compiled of a text."""

    def __init__(self, model: Model, compiled: MujocoModel) -> None:
        Dynamics.__init__(self, model)
        self._hold(compiled)


def mjcf_text(model: Model, comment: str) -> str:
    """Return a description as MJCF, or raise `UnsupportedError` with all that MJCF cannot hold of it."""
    faults = list(_unsupported(model))
    if faults:
        raise UnsupportedError(f"MJCF cannot say of {model.name}: {'; '.join(faults)}")
    spec, placed, _ = specified(model)
    lines = [
        f"<mujoco model={xml_attribute(model.name)}>",
        f"  <!-- {xml_comment(comment)} -->",
        '  <compiler angle="radian" autolimits="false" inertiafromgeom="false" balanceinertia="false"/>',
        f"  <option{_attributes(gravity=model.gravity)}/>",
        "  <worldbody>",
    ]
    owners = {name: joint for joint in model.joints for name in placed.joints[joint.name]}
    lines += _body(spec.worldbody, owners, placed, model, "    ")
    lines.append("  </worldbody>")
    lines += _tendons(spec, model)
    lines += _equalities(model)
    return "\n".join([*lines, "</mujoco>"]) + "\n"


def read_back(model: Model, text: str) -> ReadBack:
    """Return the model that MuJoCo's parser reads from a text of `mjcf_text`, in the description's coordinates."""
    _, placed, _ = specified(model)
    with heard_warnings():
        try:
            compiled = mujoco.MjModel.from_xml_string(text)
        except ValueError as error:
            reason = " ".join(str(error).split())
            raise UnsupportedError(f"mujoco: refuses what was written of {model.name}: {reason}") from None
    return ReadBack(model, mapped(compiled, model, placed, ()))


def _unsupported(model: Model) -> Iterator[str]:
    for joint in model.joints:
        name = f"joint {joint.name!r}"
        if joint.kind not in JOINT_TYPES:
            yield f"{name} is {joint.kind}"
        parts = [joint.damping] if joint.kind == "ball" else np.split(joint.damping, 2) if joint.kind == "free" else []
        if any(np.ptp(x) > 0 for x in parts):
            yield f"{name} is damped differently along its body axes"
        elif joint.kind == "free" and joint.parent == "world" and np.ptp(joint.damping) > 0:
            yield f"{name} is damped differently in turning and in moving"
    for coupling in model.couplings:
        if coupling.armature and model.branched(coupling):
            yield f"coupling {coupling.name!r} has armature between branches, which MuJoCo leaves out of M"
    yield from (f"loop {x.name!r} (MuJoCo's would be soft)" for x in model.loops)
    yield from (f"joint {p.joint!r} is moved in time" for p in model.prescribed)
    yield from (f"body {name!r}: {why}" for name, why in model.nonphysical)


def _attributes(**values: Any) -> str:
    out = []
    for name, value in values.items():
        if isinstance(value, str):
            out.append(f" {name}={xml_attribute(value)}")
        elif value is not None:
            out.append(f' {name}="{" ".join(repr(float(x)) for x in np.ravel(value))}"')
    return "".join(out)


def _body(body: Any, owners: dict[str, Joint], placed: Placed, model: Model, indent: str) -> Iterator[str]:
    name = body.name
    if name != "world":
        moments = placed.degenerate.get(name, np.array(body.inertia))
        if body.mass > 0 or moments.any():
            at = _attributes(pos=body.ipos, quat=body.iquat, mass=body.mass, diaginertia=_allowed(moments))
            yield f"{indent}<inertial{at}/>"
    for joint in body.joints:
        yield f"{indent}<joint{_joint(joint, owners[joint.name])}/>"
    for site in body.sites:
        yield f"{indent}<site{_attributes(name=site.name, pos=site.pos)}/>"
    for f in model.frames:
        if f.body == name:
            yield f"{indent}<site{_attributes(name=f.name, pos=f.translation, xyaxes=f.rotation.T[:2])}/>"
    for child in body.bodies:
        simple = None if child.simple else "false"
        yield f"{indent}<body{_attributes(name=child.name, pos=child.pos, quat=child.quat, simple=simple)}>"
        yield from _body(child, owners, placed, model, indent + "  ")
        yield f"{indent}</body>"


def _allowed(moments: Array) -> Array:
    """Return principal moments that MuJoCo takes: a point's are lifted off zero, a plate's last digit lowered."""
    out = np.maximum(moments, _LEAST)
    low, middle, high = np.argsort(out)
    if out[low] + out[middle] < out[high]:
        # Half of what is missing on each side; a thin plate misses a rounding.
        out[low] += out[high] - out[low] - out[middle]
    while out[low] + out[middle] < out[high]:
        out[low] = np.nextafter(out[low], np.inf)
    return out


def _joint(joint: Any, owner: Joint) -> str:
    kind = _TYPES[int(joint.type)]
    attributes: dict[str, Any] = {"name": joint.name, "type": kind}
    if kind in ("hinge", "slide"):
        attributes |= {"pos": joint.pos, "axis": joint.axis}
        for name in ("stiffness", "damping"):
            attributes[name] = np.ravel(getattr(joint, name))[0] or None
        attributes["springref"] = joint.springref if attributes["stiffness"] else None
        attributes["armature"], attributes["frictionloss"] = joint.armature or None, joint.frictionloss or None
        # 2 is MuJoCo's "as the range says".
        if int(joint.limited) == 1:
            attributes |= {"limited": "true", "range": joint.range}
        if owner.type.nv == 1 and np.isfinite(owner.effort_limit[0]) and owner.effort_limit[0] > 0:
            effort = owner.effort_limit[0]
            attributes |= {"actuatorfrclimited": "true", "actuatorfrcrange": np.array([-effort, effort])}
    else:
        attributes |= {"pos": joint.pos} if kind == "ball" else {}
        attributes["damping"] = owner.damping[-1] or None
    return _attributes(**attributes)


def _tendons(spec: Any, model: Model) -> Iterable[str]:
    if not spec.tendons:
        return []
    out = ["  <tendon>"]
    points, between = spec.tendons[: len(model.springs)], spec.tendons[len(model.springs) :]
    for tendon in points:
        attributes = {n: np.ravel(getattr(tendon, n))[0] or None for n in ("stiffness", "damping")}
        out.append(f"    <spatial{_attributes(name=tendon.name, springlength=tendon.springlength[0], **attributes)}>")
        out += [f"      <site{_attributes(site=wrap.target.name)}/>" for wrap in tendon.path]
        out.append("    </spatial>")
    for tendon in between:
        attributes = {n: np.ravel(getattr(tendon, n))[0] or None for n in ("stiffness", "damping", "armature")}
        rest = tendon.springlength[0] if attributes["stiffness"] else None
        out.append(f"    <fixed{_attributes(name=tendon.name, springlength=rest, **attributes)}>")
        out += [f"      <joint{_attributes(joint=wrap.target.name, coef=wrap.coef)}/>" for wrap in tendon.path]
        out.append("    </fixed>")
    return [*out, "  </tendon>"]


def _equalities(model: Model) -> Iterable[str]:
    mimics = [(j.name, j.mimic) for j in model.joints if j.mimic is not None]
    if not mimics:
        return []
    out = ["  <equality>"]
    for name, m in mimics:
        shape = np.array([m.offset, m.ratio, 0.0, 0.0, 0.0])
        out.append(f"    <joint{_attributes(joint1=name, joint2=m.joint, polycoef=shape)}/>")
    return [*out, "  </equality>"]
