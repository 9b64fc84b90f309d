"""MJCF to `Model`, element by element, by MuJoCo's rules (XML reference of 4.0).

Pinocchio's MJCF parser (4.1.0) loses bodies, masses and springs without a message. A body's frame is its last joint's;
a frame of the body's name keeps the body's origin. A body with several joints becomes a chain of massless bodies.
Coordinates are MuJoCo's: a hinge is at its ``ref`` in the pose of the file, a free joint's are its pose in the world.

MuJoCo's uncompiled ``MjSpec`` (4.0.0) holds every decimal, but resolves no defaults, copies and attached files here. Of
92 descriptions refused here by name and line it takes 40, three (such as 300³ copies) exhaust its memory, it
reads ``0x10`` and ``inf`` as numbers, and elements of included files have line 0.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit._reproducible import length
from mbkit.errors import ModelError
from mbkit.load.mjcf_attributes import Compiler, Defaults, check_names
from mbkit.load.mjcf_compiled import infer_inertias, infer_springs, name_list
from mbkit.load.mjcf_couplings import Transmissions
from mbkit.load.mjcf_equalities import Equalities
from mbkit.load.mjcf_reader import (
    KINDS,
    MjcfBody,
    MjcfJoint,
    Scene,
    add_free_base,
    read_tree,
    write_out_attached,
    write_out_copies,
)
from mbkit.load.shapes import NOTHING, together
from mbkit.load.urdf_reader import Snapper
from mbkit.load.xml_reader import Element, Reader
from mbkit.model import Body, Model, ModelBuilder, kind_of, quaternions
from mbkit.model.description import LEFT_OUT, SERVOS
from mbkit.model.validation import body_fault

_REFUSED: Final = {
    "composite": "write its bodies out; MuJoCo's save as XML does",
    "flexcomp": "deformable bodies are not rigid; remove it",
}
#: Numbers of a joint's velocities, and their attributes in MJCF, which MuJoCo's models have too.
_SPRING: Final = {"stiffness": "stiffness", "damping": "damping", "rest": "springref"}
JOINT_NUMBERS: Final = _SPRING | {"armature": "armature", "friction": "frictionloss"}
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
    loops: bool,
    actuators: bool,
) -> Model:
    """Return the model of a <mujoco> element; for the arguments see `mbkit.load.load`."""
    read = Reader()
    for element in mujoco.walk():
        if element.tag in _REFUSED:
            read.fault(f"<{element.tag}> is not read: {_REFUSED[element.tag]}", element)
    compiler = Compiler.of(mujoco, read)
    attached = write_out_attached(mujoco, path, compiler, read)
    copied = write_out_copies(mujoco, compiler, read)
    misspelt = check_names(mujoco, read)
    if floating_base:
        add_free_base(mujoco, read)
    scene = Scene(compiler, Defaults(mujoco, read), read)
    read_tree(mujoco, scene)
    flags: dict[str, str] = {}
    own_gravity: tuple[float, ...] = (0.0, 0.0, -9.81)
    for option in mujoco.all("option"):
        own_gravity = read.numbers(option, "gravity", "the file", count=3, default=own_gravity)
        for flag in option.all("flag"):
            flags |= flag.attributes
            for name, value in flag.attributes.items():
                if value not in ("enable", "disable"):
                    read.fault(f"option flag {name}: expected 'enable' or 'disable', got {value[:40]!r}", flag)
    off = {name for name, value in flags.items() if value == "disable"}
    if gravity is None:
        gravity = (0.0, 0.0, 0.0) if "gravity" in off else own_gravity
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
    total_mass, written_mass = scene.compiler.settotalmass, sum(b.mass_properties.mass for b in scene.bodies)
    scale = total_mass / written_mass if total_mass > 0 and written_mass > 0 else 1.0
    springs = infer_springs(mujoco, path, scene)
    b = ModelBuilder(mujoco.attributes.get("model") or path.stem, gravity=gravity)
    # A body may be below one of its name.
    joined = "" if read.faults else _join_welded(scene)
    snap = _Tree(b, scene, springs, off).add_bodies(scale)
    _hold_weights(b, mujoco, scene, off, actuators=actuators)
    transmissions = Transmissions(mujoco, scene, off, servos=actuators)
    equalities = Equalities(mujoco, scene, off, enabled=loops, tendons=transmissions.factors)
    if read.faults:
        raise ModelError(str(path), read.faults)
    sprung = f"stiffness and damping from MuJoCo's compiler (springdamper): {name_list(springs)}" if springs else ""
    for note in (
        *_notes(mujoco, path, scene, flags, scale),
        joined,
        attached,
        copied,
        inferred,
        sprung,
        misspelt,
        snap.note,
    ):
        if note:
            b.note(note)
    equalities.add_to(b, snap)
    try:
        if transmissions.functions:
            with warnings.catch_warnings():
                # The second build warns.
                warnings.simplefilter("ignore")
                transmissions.add_functions(b, b.build(nonphysical=nonphysical, point_masses=False))
        model = b.build(nonphysical=nonphysical, point_masses=False)
    except ModelError as error:
        raise ModelError(str(path), error.faults) from None
    features = {"spring": "springs", "damper": "damping"}
    return transmissions.applied(model.without(*(feature for flag, feature in features.items() if flag in off)))


def _join_welded(scene: Scene) -> str:
    """Give the masses of welded bodies that no body can have alone to the bodies that carry them; return a note.

    Such as mass without inertia: a URDF's links that are fixed to each other are one body too. The frames stay.
    """
    known, joined = {body.name: body for body in scene.bodies}, []
    for body in reversed(scene.bodies):
        at, carrier = body.mass_properties, known.get(body.parent)
        if body.joints or carrier is None or not at.mass or body.gravcomp != carrier.gravcomp:
            continue
        if not _moves(body, known):
            # Any matter may stand still.
            continue
        if body_fault(Body(body.name, at.mass, at.com, at.inertia), point_masses=False) is not None:
            parts = [carrier.mass_properties, at.moved(body.pose.R, body.pose.p)]
            carrier.mass_properties = together([x for x in parts if x.mass])
            body.mass_properties = NOTHING
            joined.append(f"{body.name} in {carrier.name}")
    if not joined:
        return ""
    return (
        f"welded bodies with masses that no body has alone count as parts of those that carry them: {name_list(joined)}"
    )


def _moves(body: MjcfBody, known: Mapping[str, MjcfBody]) -> bool:
    """Return whether a joint carries a body."""
    return bool(body.joints) or (body.parent in known and _moves(known[body.parent], known))


class _Tree:
    """Adds the bodies of a scene to a builder."""

    def __init__(
        self, b: ModelBuilder, scene: Scene, springs: Mapping[str, tuple[float, float]], off: set[str]
    ) -> None:
        self.b, self.scene, self.read, self.springs, self.snap = b, scene, scene.read, springs, Snapper()
        self.off = off

    def add_bodies(self, scale: float) -> Snapper:
        """Add the bodies, with `scale` times their masses, and return the record of rounded entries."""
        b, scene, snap = self.b, self.scene, self.snap
        anchors: dict[str, Array] = {"world": np.zeros(3)}
        for body in scene.bodies:
            anchors[body.name] = body.anchor
            at = body.mass_properties.scaled(scale) if scale != 1 else body.mass_properties
            for joint, parent, child, R, p in body.chain(anchors[body.parent], scene.unused):
                if joint is None:
                    name = scene.unused("joint", f"{body.name}_fixed")
                    b.add_joint(name, "fixed", parent=parent, child=child, translation=p, rotation=snap(R))
                    continue
                self._add_joint(joint, parent, child, R, p)
                if child != body.name:
                    b.add_body(child)
            b.add_body(body.name, mass=at.mass, com=at.com - body.anchor, inertia=at.inertia)
            if body.anchor.any():
                b.add_frame(body.name, body=body.name, translation=-body.anchor)
            for site, X in body.sites:
                # A frame hides a body of its name, and the body's origin goes first.
                name = scene.unused("site", f"{site}_site") if site in scene.names["body"] else site
                b.add_frame(name, body=body.name, translation=X.p - body.anchor, rotation=snap(X.R))
        return snap

    def _add_joint(self, joint: MjcfJoint, parent: str, child: str, R: Array, p: Array) -> None:
        item, element, read, scene = f"joint {joint.name!r}", joint.element, self.read, self.scene
        angle = scene.compiler.angle if joint.kind in ("hinge", "ball") else 1.0
        values: dict[str, Any] = {"armature": read.number(element, "armature", item, 0.0)}
        higher: dict[str, tuple[float, ...]] = {}
        for name in ("stiffness", "damping"):
            values[name], *rest_of = read.numbers(element, name, item, count=3, least=1, default=(0.0,))
            higher[name] = (*rest_of, 0.0, 0.0)[:2]
        if joint.name in self.springs:
            values["stiffness"], values["damping"] = self.springs[joint.name]
        if joint.scalar:
            axis = values["axis"] = self.snap(joint.axis / length(joint.axis))
            R, p = joint.at_zero(R, p, axis)
            if limits := _range(element, "range", "limited", item, scene):
                values["lower"], values["upper"] = (angle * x for x in limits)
            if force := _range(element, "actuatorfrcrange", "actuatorfrclimited", item, scene):
                values["effort_limit"] = max(abs(x) for x in force)
        else:
            if joint.kind == "ball" and _range(element, "range", "limited", item, scene, ordered=False):
                scene.left_out["limit of a ball joint"] += 1
            if joint.kind == "free" and (armature := values.pop("armature")):
                self._add_weightless(joint, child, armature)
        yields = read.number(element, "springyield", item, 0.0)
        if values["stiffness"] or any(higher["stiffness"]):
            values["rest"] = joint.rest
            scene.left_out["yield of a spring"] += bool(yields)
        kind, R = KINDS[joint.kind], self.snap(R)
        if not joint.scalar:
            values.pop("rest", None)
            self._add_spring(joint, (values.pop("stiffness"), *higher["stiffness"]), parent, child, R, p)
        elif any(higher["stiffness"]) and "spring" not in self.off:
            k1, k2 = higher["stiffness"]
            self.b.add_joint_force(
                f"spring of {joint.name}",
                joint.name,
                potential=lambda q: k1 / 3 * (q - joint.rest) ** 3 + k2 / 4 * (q - joint.rest) ** 4,
            )
        if any(higher["damping"]) and "damper" not in self.off:
            self.b.add_joint_force(f"damper of {joint.name}", joint.name, _damper(joint, *higher["damping"]))
        friction = read.number(element, JOINT_NUMBERS["friction"], item, 0.0)
        if friction and not kind_of(kind).coordinate_velocities:
            self.b.note(
                f"{LEFT_OUT}: dry friction {friction:g} of {joint.kind} joint {joint.name!r}, "
                "which acts along each velocity, whose axes move with the body"
            )
            friction = 0.0
        self.b.add_joint(
            joint.name, kind, parent=parent, child=child, translation=p, rotation=R, friction=friction, **values
        )

    def _add_weightless(self, joint: MjcfJoint, child: str, armature: float) -> None:
        """Add the armature of a free joint: matter about its origin that has inertia and no weight."""
        if armature < 0:
            self.read.fault(f"joint {joint.name!r}: armature {armature:g}; expected at least 0", joint.element)
            return
        name = self.scene.unused("body", f"armature of {joint.name}")
        self.b.add_body(name, mass=armature, inertia=armature * np.eye(3))
        self.b.add_joint(self.scene.unused("joint", name), "fixed", parent=child, child=name)
        self.b.add_gravity_compensation(name, 1.0)
        self.b.note(
            f"the armature of free joint {joint.name!r} is a body without weight, of {armature:g} kg and {armature:g} "
            "kg m²; it counts in M, and neither in the mass nor in the centre of mass"
        )

    def _add_spring(
        self, joint: MjcfJoint, stiffness: tuple[float, ...], parent: str, child: str, R: Array, p: Array
    ) -> None:
        """Add the spring of a ball or free joint, against the rotation vector and the way from the pose of the file."""
        k0, k1, k2 = stiffness
        if not any(stiffness) or "spring" in self.off:
            return
        name = f"spring of {joint.name}"
        if k1:
            # The cube of a rotation vector's length has no second derivative where it rests.
            why = f"stiffness that grows with the {joint.kind} joint's displacement; expected 0 for the second number"
            self.read.fault(f"joint {joint.name!r}: {why}", joint.element)
        free = joint.kind == "free"
        if free:
            pose = next(body.pose for body in self.scene.bodies if body.name == child)
            R, p = self.snap(pose.R), pose.p

        def potential(x: Any) -> Any:
            squares = [sum(x[i] ** 2 for i in part) for part in ((0, 1, 2), (3, 4, 5))[not free :]]
            return sum(k2 / 4 * square**2 for square in squares)

        self.b.add_bushing(
            name,
            body_a=parent,
            translation_a=p,
            rotation_a=R,
            body_b=child,
            stiffness=[*[k0 * free] * 3, k0, k0, k0],
            potential=potential if k2 else None,
        )


def _damper(joint: MjcfJoint, c1: float, c2: float) -> Any:
    """Return the force of a damper that grows with the speed, without its linear part; one for each velocity."""

    def resisted(v: Any) -> Any:
        return -(c1 * abs(v) + c2 * v**2) * v

    if joint.scalar:
        return lambda _t, _q, v: resisted(v)
    import casadi as ca

    free = joint.kind == "free"
    q, v = (ca.vertsplit(ca.SX.sym(name, n)) for name, n in (("q", 4 + 3 * free), ("v", 3 + 3 * free)))
    # MuJoCo's velocities of a free body's origin are in the axes of the world.
    linear = [resisted(x) for x in quaternions.rotate(q[3:], v[:3])] if free else []
    back = quaternions.rotate_back(q[3:], linear) if free else []
    return ca.vertcat(*back, *(resisted(x) for x in v[-3:]))


def _hold_weights(b: ModelBuilder, mujoco: Element, scene: Scene, off: set[str], *, actuators: bool) -> None:
    """Add the gravity compensation of bodies, as MuJoCo 4.0.0 applies it.

    None acts where springs and dampers are off, or where no body's is above zero. The part at a joint with
    ``actuatorgravcomp`` is actuation, with or without an actuator there, and none in a file without actuators or with
    all of them off.
    """
    if {"spring", "damper"} <= off or not any(body.gravcomp > 0 for body in scene.bodies):
        return
    acting = actuators and "actuation" not in off and any(section.children for section in mujoco.all("actuator"))
    moving: dict[str, list[MjcfJoint]] = {"world": []}
    lifted: dict[str, None] = {}
    for body in scene.bodies:
        joints = moving[body.name] = [*moving[body.parent], *body.joints]
        if not (joints and body.gravcomp and body.mass_properties.mass):
            continue
        by_actuators = [j.name for j in joints if j.element.attributes.get("actuatorgravcomp") == "true"]
        lifted |= dict.fromkeys(by_actuators)
        if acting or len(by_actuators) < len(joints):
            b.add_gravity_compensation(body.name, body.gravcomp, without=() if acting else by_actuators)
    if lifted:
        left_out = "do not act, as in MuJoCo" if actuators else "left out; with actuators=True MuJoCo's act"
        what = "act as passive forces" if acting else left_out
        b.note(f"{SERVOS} of gravity compensation by actuators {what}: joints {name_list(lifted)}")


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


def _notes(mujoco: Element, path: Path, scene: Scene, flags: Mapping[str, str], scale: float) -> Iterator[str]:
    """Yield the notes on decisions and on parts that were left out."""
    files = list(dict.fromkeys(e.file for e in mujoco.walk() if e.file))
    if files:
        yield f"included: {', '.join(files)}"
        outside = [f for f in files if not (path.parent / f).resolve().is_relative_to(path.parent.resolve())]
        if outside:
            yield f"included from outside the folder of {path.name}: {', '.join(outside)}"
    if sections := Counter(s.tag for s in mujoco.children for _ in s.children or [s] if s.tag not in _READ):
        counts = ", ".join(f"{n} {tag}" for tag, n in sorted(sections.items()))
        yield f"sections left out, with whatever they do to the motion: {counts}"
    if left_out := ", ".join(f"{what} ({n})" for what, n in sorted(scene.left_out.items()) if n):
        yield f"{LEFT_OUT}: {left_out}"
    medium = Element("option", {}, 0)
    for element in mujoco.all("option"):
        medium.attributes |= {k: v for k, v in element.attributes.items() if k in ("density", "viscosity", "wind")}
    if any(scene.read.number(medium, name, "the file", 0.0) for name in ("density", "viscosity")):
        numbers = ", ".join(f"{k} {v}" for k, v in sorted(medium.attributes.items()))
        yield f"{LEFT_OUT}: the forces of a fluid (option {numbers}), with fluidshape and fluidcoef of geoms"
    if others := ", ".join(f"{k}={v}" for k, v in sorted(flags.items()) if k not in _HONOURED):
        yield f"option flags are an engine's, and were left out: {others}"
    if unnamed := " and ".join(f"{n} {kind}" for kind, n in sorted(scene.unnamed.items())):
        yield f"names were generated for elements without one ({unnamed})"
    for setting, bodies in scene.bounded.items():
        yield f"compiler {setting} changed the {'mass' if setting == 'boundmass' else 'inertia'} of {name_list(bodies)}"
    if scale != 1:
        yield f"compiler settotalmass: all masses and inertias times {scale:.9g}"
    moved = [b for b in scene.bodies if np.any(b.pose.p) or not np.array_equal(b.pose.R, np.eye(3))]
    if free := [b.name for b in moved if b.joints and b.joints[0].kind == "free"]:
        yield f"q of a free body is its pose in the world; its pose in the file was left out: {name_list(free)}"
    if scene.aligned:
        yield f"the frame of free bodies is their inertial frame (align): {name_list(scene.aligned)}"
    if stacked := [b.name for b in scene.bodies if len(b.joints) > 1]:
        yield f"massless bodies stand between the joints of bodies with several: {name_list(stacked)}"
