"""MJCF to `Model`, element by element, by MuJoCo's rules (XML reference of 4.0).

Pinocchio's MJCF parser (4.1.0) loses bodies, masses and springs without a message. A body's frame is its last
joint's; a frame of the body's name keeps the body's origin. A body with several joints becomes a chain of massless
bodies. Coordinates are MuJoCo's: a hinge is at its ``ref`` in the pose of the file, a free joint's are its pose in
the world.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.errors import ModelError
from mbkit.load.mjcf_attributes import HERE, Compiler, Defaults, about, check_names
from mbkit.load.mjcf_compiled import infer_inertias, infer_springs, listed
from mbkit.load.mjcf_couplings import Transmissions
from mbkit.load.mjcf_reader import KINDS, MjcfJoint, Scene, unfolded, walk
from mbkit.load.urdf import Snapper
from mbkit.load.urdf_links import floated
from mbkit.load.xml_reader import Element, Reader
from mbkit.model import Model, ModelBuilder

_REFUSED: Final = {
    "attach": "it names another model; save the compiled model as one XML",
    "replicate": "write the copies out; MuJoCo's save as XML does",
    "composite": "write its bodies out; MuJoCo's save as XML does",
    "flexcomp": "deformable bodies are not rigid; remove it",
}
# Sections that are read, have notes of their own, or do not act on the motion.
_READ: Final = (
    *("compiler", "default", "option", "worldbody", "size", "visual", "statistic"),
    *("asset", "tendon", "actuator", "equality"),
)
# Option flags that change the smooth equations; the others steer an engine.
_HONOURED: Final = frozenset({"gravity", "spring", "damper", "actuation"})


def model_of_mjcf(
    mujoco: Element,
    path: Path,
    floating_base: bool,
    nonphysical: Literal["error", "warn"],
    gravity: ArrayLike | None,
    meshes: Literal["auto", "never"],
) -> Model:
    """Return the model of a <mujoco> element; for the arguments see `mbkit.load.load`."""
    read = Reader()
    for element in mujoco.walk():
        if element.tag in _REFUSED:
            read.fault(f"<{element.tag}> is not read: {_REFUSED[element.tag]}", element)
    misspelt = check_names(mujoco, read)
    if floating_base:
        mujoco = floated(mujoco, read)
    scene = Scene(Compiler.of(mujoco, read), Defaults(mujoco, read), read)
    for world in mujoco.all("worldbody"):
        scene.collect_names(world)
    for world in mujoco.all("worldbody"):
        for element, X, childclass in unfolded(world, HERE, None, scene, "the world"):
            if element.tag == "body":
                walk(element, "world", X, childclass, scene)
    flags = _flags(mujoco, read)
    own_gravity = _gravity(mujoco, flags, read)
    for body, geoms in scene.inferred.items() if meshes == "never" else ():
        read.fault(
            f"body {body!r}: its inertia would come from a mesh or a shell, and none is opened; "
            'add <inertial>, or load with meshes="auto"',
            geoms[0][0],
        )
    inferred = infer_inertias(mujoco, path, scene)
    if not scene.bodies:
        read.fault("no bodies; expected <worldbody> with <body> elements")
    elif not any(b.joints for b in scene.bodies):
        read.fault("no joints, so nothing moves (nq = 0); add a joint, or load with floating_base=True")
    b = ModelBuilder(mujoco.attributes.get("model") or path.stem, gravity=own_gravity if gravity is None else gravity)
    scale, snap = _total_scale(scene), Snapper()
    springs = infer_springs(mujoco, path, scene)
    _describe(b, scene, scale, snap, springs)
    off = {name for name, value in flags.items() if value == "disable"}
    transmissions = Transmissions(mujoco, scene, off)
    if read.faults:
        raise ModelError(str(path), read.faults)
    sprung = f"stiffness and damping of springdamper are from MuJoCo's compiler: {listed(springs)}" if springs else ""
    for note in (*_notes(mujoco, path, scene, flags, scale), inferred, sprung, misspelt, snap.note):
        if note:
            b.note(note)
    try:
        model = b.build(nonphysical=nonphysical, point_masses=False)
    except ModelError as error:
        raise ModelError(str(path), error.faults) from None
    features = {"spring": "springs", "damper": "damping"}
    model = model.without(*(feature for flag, feature in features.items() if flag in off))
    return transmissions.applied(model)


def _flags(mujoco: Element, read: Reader) -> dict[str, str]:
    """Return the option flags; later ones win."""
    out: dict[str, str] = {}
    for flag in (f for option in mujoco.all("option") for f in option.all("flag")):
        for name, value in flag.attributes.items():
            if value not in ("enable", "disable"):
                read.fault(f"option flag {name}: expected 'enable' or 'disable', got {value[:40]!r}", flag)
        out.update(flag.attributes)
    return out


def _gravity(mujoco: Element, flags: Mapping[str, str], read: Reader) -> tuple[float, ...]:
    out: tuple[float, ...] = (0.0, 0.0, -9.81)
    for option in mujoco.all("option"):
        out = read.numbers(option, "gravity", "the file", count=3, default=out)
    return (0.0, 0.0, 0.0) if flags.get("gravity") == "disable" else out


def _total_scale(scene: Scene) -> float:
    wanted, total = scene.compiler.settotalmass, sum(b.lump.mass for b in scene.bodies)
    return wanted / total if wanted > 0 and total > 0 else 1.0


def _describe(
    b: ModelBuilder, scene: Scene, scale: float, snap: Snapper, springs: Mapping[str, tuple[float, float]]
) -> None:
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
            _add_joint(b, joint, parent, child, R, p, scene, snap, springs)
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
    b: ModelBuilder,
    joint: MjcfJoint,
    parent: str,
    child: str,
    R: Array,
    p: Array,
    scene: Scene,
    snap: Snapper,
    springs: Mapping[str, tuple[float, float]],
) -> None:
    item, element, read = f"joint {joint.name!r}", joint.element, scene.read
    angle = scene.compiler.angle if joint.kind in ("hinge", "ball") else 1.0
    values: dict[str, Any] = {}
    if joint.kind in ("hinge", "slide"):
        axis = snap(joint.axis / np.linalg.norm(joint.axis))
        values["axis"] = axis
        if joint.ref and joint.kind == "hinge":
            R = R @ about(axis, -joint.ref)
        elif joint.ref:
            p = p - R @ (joint.ref * axis)
        values["rest"] = angle * read.number(element, "springref", item, 0.0)
        limits = _range(element, "range", "limited", item, scene)
        if limits:
            values["lower"], values["upper"] = (angle * x for x in limits)
        force = _range(element, "actuatorfrcrange", "actuatorfrclimited", item, scene)
        if force:
            values["effort_limit"] = max(abs(x) for x in force)
    elif joint.kind == "ball" and _range(element, "range", "limited", item, scene, ordered=False):
        scene.left_out["limit of a ball joint"] += 1
    for name in ("stiffness", "damping"):
        values[name], *higher = read.numbers(element, name, item, count=3, least=1, default=(0.0,))
        if any(higher):
            read.fault(f"{item}: {name} that depends on the position or speed; only constants are read", element)
    if joint.name in springs:
        values["stiffness"], values["damping"] = springs[joint.name]
    values["armature"] = read.number(element, "armature", item, 0.0)
    if joint.kind in ("ball", "free"):
        # They may come from a default class for hinges.
        for name, why in (("stiffness", "a joint of one coordinate"), ("armature", "a joint of one velocity")):
            value = values.pop(name)
            if value:
                read.fault(f"{item}: {name} {value:g} on a {joint.kind} joint; expected {why}; set it to 0", element)
    if read.number(element, "springyield", item, 0.0) and values.get("stiffness"):
        scene.left_out["yield of a spring"] += 1
    if not values.get("stiffness"):
        values.pop("rest", None)
    b.add_joint(
        joint.name,
        KINDS[joint.kind],
        parent=parent,
        child=child,
        translation=p,
        rotation=snap(R),
        friction=read.number(element, "frictionloss", item, 0.0),
        **values,
    )


def _range(
    element: Element, range_: str, limited: str, item: str, scene: Scene, *, ordered: bool = True
) -> tuple[float, float] | None:
    """Return a range that applies, or None."""
    low, high = scene.read.numbers(element, range_, item, count=2, default=(0.0, 0.0), bounded=False)
    applies = scene.read.choice(element, limited, ("auto", "true", "false"))
    if applies == "auto" and (low or high) and not scene.compiler.autolimits:
        scene.read.fault(f"{item}: {range_} without {limited}, and autolimits is off; write {limited}", element)
    if applies == "false" or (applies == "auto" and not low < high):
        return None
    if ordered and not low < high:
        scene.read.fault(f"{item}: {range_} {low:g} {high:g}; expected the lower limit first", element)
    return low, high


def _notes(mujoco: Element, path: Path, scene: Scene, flags: Mapping[str, str], scale: float) -> list[str]:
    """Return the notes on decisions and on parts that were left out."""
    out = []
    files = list(dict.fromkeys(e.file for e in mujoco.walk() if e.file))
    if files:
        out.append(f"included: {', '.join(files)}")
        outside = [f for f in files if not (path.parent / f).resolve().is_relative_to(path.parent.resolve())]
        if outside:
            out.append(f"included from outside the folder of {path.name}: {', '.join(outside)}")
    sections = Counter(s.tag for s in mujoco.children for _ in s.children or [s] if s.tag not in _READ)
    if sections:
        listing = ", ".join(f"{n} {tag}" for tag, n in sorted(sections.items()))
        out.append(f"sections left out, with whatever they do to the motion: {listing}")
    if scene.left_out:
        listing = ", ".join(f"{what} ({n})" for what, n in sorted(scene.left_out.items()))
        out.append(f"not represented here, and left out: {listing}")
    medium = Element("option", {}, 0)
    for element in mujoco.all("option"):
        medium.attributes |= {k: v for k, v in element.attributes.items() if k in ("density", "viscosity", "wind")}
    if any(scene.read.number(medium, name, "the file", 0.0) for name in ("density", "viscosity")):
        listing = ", ".join(f"{k} {v}" for k, v in sorted(medium.attributes.items()))
        out.append(f"the forces of a fluid were left out (option {listing}), with fluidshape and fluidcoef of geoms")
    listing = ", ".join(f"{k}={v}" for k, v in sorted(flags.items()) if k not in _HONOURED)
    if listing:
        out.append(f"option flags are an engine's, and were left out: {listing}")
    if scene.unnamed:
        listing = " and ".join(f"{n} {kind}" for kind, n in sorted(scene.unnamed.items()))
        out.append(f"names were generated for elements without one ({listing})")
    for setting, bodies in scene.bounded.items():
        what = "mass" if setting == "boundmass" else "inertia"
        out.append(f"compiler {setting} changed the {what} of {listed(bodies)}")
    if scale != 1:
        out.append(f"compiler settotalmass: all masses and inertias times {scale:.9g}")
    moved = [b for b in scene.bodies if np.any(b.pose.p) or not np.array_equal(b.pose.R, np.eye(3))]
    free = [b.name for b in moved if b.joints and b.joints[0].kind == "free"]
    if free:
        out.append(f"q of a free body is its pose in the world; its pose in the file was left out: {listed(free)}")
    stacked = [b.name for b in scene.bodies if len(b.joints) > 1]
    if stacked:
        out.append(f"massless bodies stand between the joints of bodies with several: {listed(stacked)}")
    return out
