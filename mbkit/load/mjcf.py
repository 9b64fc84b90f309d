"""MJCF to `Model`, element by element.

Pinocchio's own MJCF parser is not used. As of 4.1.0 it reads only the first body of
the world, loses unnamed bodies, leaves the mass of geoms without contacts out, takes
the ranges of slides for angles and knows no springs, all in silence. What follows
keeps MuJoCo's rules (XML reference, docs of 4.0) and is tested against its compiler.

A body's frame is its last joint's. Where that joint stands off the body's origin, a
frame of the body's name keeps the origin, so that poses are MuJoCo's. A body with
several joints becomes a chain of massless bodies. The coordinates are MuJoCo's: a
hinge stands at its ``ref`` in the pose that is drawn, a free joint's are its place
in the world.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.errors import ModelError
from mbkit.load.attributes import Reader
from mbkit.load.floating import floated
from mbkit.load.mjcf_couplings import Transmissions
from mbkit.load.mjcf_scene import KINDS, MjcfJoint, Scene, unfolded, walk
from mbkit.load.mjcf_values import HERE, Compiler, Defaults, about
from mbkit.load.snap import Snapper
from mbkit.load.xml import Element
from mbkit.model import Model, ModelBuilder

__all__ = ["model_of_mjcf"]

_REFUSED: Final = {
    "attach": "it names another model; save the compiled model as one XML",
    "replicate": "write the copies out; MuJoCo's save as XML does",
    "composite": "write its bodies out; MuJoCo's save as XML does",
    "flexcomp": "deformable bodies are not rigid; remove it",
}
# Sections that are read, or that say nothing about the motion.
_READ: Final = ("compiler", "default", "option", "worldbody", "size", "visual", "statistic", "asset")
# Sections with notes of their own.
_NOTED: Final = ("tendon", "actuator", "equality")


# Option flags that change the smooth equations; the others steer an engine.
_HONOURED: Final = frozenset({"gravity", "spring", "damper", "passive", "actuation"})


def model_of_mjcf(
    mujoco: Element,
    path: Path,
    *,
    floating_base: bool,
    nonphysical: Literal["error", "warn"],
    gravity: ArrayLike | None,
) -> Model:
    """Describe the bodies and joints of a <mujoco> element."""
    read = Reader()
    _refuse(mujoco, read)
    if floating_base:
        mujoco = floated(mujoco, read)
    scene = Scene(Compiler.of(mujoco, read), Defaults(mujoco, read), read)
    for world in mujoco.all("worldbody"):
        scene.collect_names(world)
    for world in mujoco.all("worldbody"):
        for element, X, childclass in unfolded(world, HERE, None, scene, "the world"):
            if element.tag == "body":
                walk(element, "world", X, childclass, scene)
    own_gravity = _gravity(mujoco, read)
    if not scene.bodies:
        read.fault("no bodies; expected <worldbody> with <body> elements")
    elif not any(b.joints for b in scene.bodies):
        read.fault("no joints, so nothing moves (nq = 0); add a joint, or load with floating_base=True")
    b = ModelBuilder(mujoco.attributes.get("model") or path.stem, gravity=own_gravity if gravity is None else gravity)
    scale, snap = _total_scale(scene), Snapper()
    _describe(b, scene, scale, snap)
    off = _disabled(mujoco)
    transmissions = Transmissions(mujoco, scene, off)
    if read.faults:
        raise ModelError(str(path), read.faults)
    for note in (*_notes(mujoco, scene, scale), snap.note):
        if note:
            b.note(note)
    try:
        model = b.build(nonphysical=nonphysical, point_masses=False)
    except ModelError as error:
        raise ModelError(str(path), error.faults) from None
    features = {"spring": ("springs",), "damper": ("damping",), "passive": ("springs", "damping")}
    model = model.without(*(f for flag, names in features.items() if flag in off for f in names))
    return transmissions.applied(model)


def _refuse(mujoco: Element, read: Reader) -> None:
    for element in mujoco.walk():
        if element.tag in _REFUSED:
            read.fault(f"<{element.tag}> is not read: {_REFUSED[element.tag]}", element)


def _disabled(mujoco: Element) -> set[str]:
    """Return the names of the flags that switch a part of the smooth motion off."""
    flags = [flag.attributes for option in mujoco.all("option") for flag in option.all("flag")]
    return {name for attributes in flags for name, value in attributes.items() if value == "disable"} & _HONOURED


def _gravity(mujoco: Element, read: Reader) -> tuple[float, ...]:
    out: tuple[float, ...] = (0.0, 0.0, -9.81)
    for option in mujoco.all("option"):
        out = read.numbers(option, "gravity", "the file", count=3, default=out)
    return (0.0, 0.0, 0.0) if "gravity" in _disabled(mujoco) else out


def _total_scale(scene: Scene) -> float:
    wanted, total = scene.compiler.settotalmass, sum(b.lump.mass for b in scene.bodies)
    return wanted / total if wanted > 0 and total > 0 else 1.0


# Describing it.


def _describe(b: ModelBuilder, scene: Scene, scale: float, snap: Snapper) -> None:
    anchors: dict[str, Array] = {"world": np.zeros(3)}
    for body in scene.bodies:
        anchors[body.name] = body.anchor
        at = body.lump.scaled(scale) if scale != 1 else body.lump
        R, p = body.pose.R, body.pose.p - anchors[body.parent]
        parent = body.parent
        if not body.joints:
            name = scene.unused("joint", f"{body.name}_fixed")
            b.add_joint(name, "fixed", parent=parent, child=body.name, translation=p, rotation=snap(R))
        before = np.zeros(3)
        for joint in body.joints:
            last = joint is body.joints[-1]
            child = body.name if last else scene.unused("body", f"{body.name}_{joint.name}")
            if joint.kind == "free":
                R, p = np.eye(3), np.zeros(3)
            else:
                p = p + R @ (joint.anchor - before)
            _add_joint(b, joint, parent, child, R, p, scene, snap)
            if not last:
                b.add_body(child)
            R, p, parent, before = np.eye(3), np.zeros(3), child, joint.anchor
        b.add_body(body.name, mass=at.mass, com=at.com - body.anchor, inertia=at.inertia)
        if body.anchor.any():
            b.add_frame(body.name, body=body.name, translation=-body.anchor)
        for site, X in body.sites:
            # A frame hides a body of its name, and the body's origin goes first.
            name = scene.unused("site", f"{site}_site") if site in scene.names["body"] else site
            b.add_frame(name, body=body.name, translation=X.p - body.anchor, rotation=snap(X.R))


def _add_joint(
    b: ModelBuilder, joint: MjcfJoint, parent: str, child: str, R: Array, p: Array, scene: Scene, snap: Snapper
) -> None:
    who, element, read = f"joint {joint.name!r}", joint.element, scene.read
    angle = scene.compiler.angle if joint.kind in ("hinge", "ball") else 1.0
    given: dict[str, Any] = {}
    if joint.kind in ("hinge", "slide"):
        axis = snap(joint.axis / np.linalg.norm(joint.axis))
        given["axis"] = axis
        if joint.ref and joint.kind == "hinge":
            R = R @ about(axis, -joint.ref)
        elif joint.ref:
            p = p - R @ (joint.ref * axis)
        given["rest"] = angle * read.number(element, "springref", who, 0.0)
        limits = _range(element, "range", "limited", who, scene)
        if limits:
            given["lower"], given["upper"] = (angle * x for x in limits)
        force = _range(element, "actuatorfrcrange", "actuatorfrclimited", who, scene)
        if force:
            given["effort_limit"] = max(abs(x) for x in force)
    elif _range(element, "range", "limited", who, scene):
        scene.left_out["limit of a ball joint"] += 1
    for name in ("stiffness", "damping"):
        given[name], *higher = read.numbers(element, name, who, count=3, least=1, default=(0.0,))
        if any(higher):
            read.fault(f"{who}: {name} that depends on the position or speed; only constants are read", element)
    if any(read.numbers(element, "springdamper", who, count=2, default=(0.0, 0.0))):
        read.fault(f"{who}: springdamper is not read; write stiffness and damping", element)
    if not given["stiffness"]:
        given.pop("rest", None)
    b.add_joint(
        joint.name,
        KINDS[joint.kind],
        parent=parent,
        child=child,
        translation=p,
        rotation=snap(R),
        armature=read.number(element, "armature", who, 0.0),
        friction=read.number(element, "frictionloss", who, 0.0),
        **given,
    )


def _range(element: Element, range_: str, limited: str, who: str, scene: Scene) -> tuple[float, float] | None:
    """Return a range that applies, or None."""
    low, high = scene.read.numbers(element, range_, who, count=2, default=(0.0, 0.0), bounded=False)
    said = element.attributes.get(limited, "auto")
    if said == "auto" and range_ in element.attributes and not scene.compiler.autolimits:
        scene.read.fault(f"{who}: {range_} without {limited}, and autolimits is off; write {limited}", element)
    if said == "false" or (said == "auto" and not low < high):
        return None
    if not low < high:
        scene.read.fault(f"{who}: {range_} {low:g} {high:g}; expected the lower limit first", element)
    return low, high


def _notes(mujoco: Element, scene: Scene, scale: float) -> list[str]:
    """Say what was decided and what was left out."""
    out = []
    files = list(dict.fromkeys(e.file for e in mujoco.walk() if e.file))
    if files:
        out.append(f"included: {', '.join(files)}")
    sections = Counter(s.tag for s in mujoco.children for _ in s.children or [s] if s.tag not in (*_READ, *_NOTED))
    if sections:
        told = ", ".join(f"{n} {tag}" for tag, n in sorted(sections.items()))
        out.append(f"sections left out, with whatever they do to the motion: {told}")
    if scene.left_out:
        told = ", ".join(f"{what} ({n})" for what, n in sorted(scene.left_out.items()))
        out.append(f"not represented here, and left out: {told}")
    for option in mujoco.all("option"):
        fluid = [a for a in ("density", "viscosity", "wind") if a in option.attributes]
        if fluid:
            out.append(f"the forces of a fluid (option {', '.join(fluid)}) were left out")
        for flag in option.all("flag"):
            told = ", ".join(f"{k}={v}" for k, v in sorted(flag.attributes.items()) if k not in _HONOURED)
            if told:
                out.append(f"option flags are an engine's, and were left out: {told}")
    if scene.unnamed:
        told = " and ".join(f"{n} {kind}" for kind, n in sorted(scene.unnamed.items()))
        out.append(f"names were made up for what has none ({told})")
    if scale != 1:
        out.append(f"compiler settotalmass: all masses and inertias times {scale:.9g}")
    for body in scene.bodies:
        drawn = np.any(body.pose.p) or not np.array_equal(body.pose.R, np.eye(3))
        if body.joints and body.joints[0].kind == "free" and drawn:
            out.append(f"free body {body.name!r}: q is its pose in the world; where the file draws it was left out")
        if len(body.joints) > 1:
            out.append(f"body {body.name!r} has {len(body.joints)} joints: massless bodies stand between them")
    return out
