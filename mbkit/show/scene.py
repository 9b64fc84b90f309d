"""A scene: shapes on bodies and the bodies' places at several times, and the shapes of a model without any."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, Final, Literal

import numpy as np

from mbkit._check import Array, by_key, shown
from mbkit.errors import InputError, LoadError, MbkitWarning, warn
from mbkit.load.mjcf_attributes import has_length, z_to
from mbkit.model import Body, Model
from mbkit.model.description import body_poses, inertia_box
from mbkit.model.elements.paths import OF_BODIES, Path
from mbkit.model.validation import listing
from mbkit.show.meshes import Color, thinned
from mbkit.show.visuals import Shape, Visuals, read_visuals

PICTURE: Final = Path(
    "picture",
    "show cannot draw",
    OF_BODIES,
    instead="a run of it is shown by animate(model=...) with a description of the same coordinates",
)
#: Kinds of shapes that can be asked for.
Kind = Literal["visual", "collision", "sticks"]
SHAPES: Final[tuple[Kind, ...]] = ("visual", "collision", "sticks")
#: Colours of bodies without shapes, in turn, and of joints.
_BODIES: Final[tuple[Color, ...]] = (
    (0.16, 0.42, 0.66, 1.0),
    (0.82, 0.50, 0.16, 1.0),
    (0.20, 0.55, 0.42, 1.0),
    (0.62, 0.34, 0.52, 1.0),
    (0.52, 0.52, 0.22, 1.0),
)
_JOINT: Final[Color] = (0.30, 0.32, 0.35, 1.0)
#: The camera's half angle in degrees, and its elevation in rad.
HALF_ANGLE_DEGREES: Final = 17.5
_CAMERA_ELEVATION: Final = 0.3


def shapes_of(model: Model, kind: Kind = "visual") -> list[Shape]:
    """Return the shapes of a model, in its bodies' axes.

    Parameters
    ----------
    model : Model
    kind : {"visual", "collision", "sticks"}
        Of the file that the model came from; where it has none of them, the other ones if they are on half of the
        bodies. Without a file, and for a link whose mesh cannot be read, and for "sticks": capsules from joint to
        joint, and boxes with the mass and inertia of the bodies.

    Raises
    ------
    UnsupportedError
        A model written as energies.
    InputError
        Another kind, or a parameter of the model has no value.

    Warns
    -----
    MbkitWarning
        Once, of all meshes that cannot be read.
    """
    if kind not in SHAPES:
        raise InputError(f"shapes: expected one of {', '.join(SHAPES)}, got {shown(kind)}")
    PICTURE.admit(model)
    model.require_values("show")
    visuals = Visuals()
    try:
        for which in () if kind == "sticks" or not model.sources else (kind, *(s for s in SHAPES[:2] if s != kind)):
            visuals = read_visuals(model, which)
            # A few contact shapes are no picture of a robot.
            few = which != kind and 2 * len({s.body for s in visuals.shapes}) < len(model.bodies)
            if (visuals.shapes and not few) or visuals.missing:
                break
            visuals = Visuals()
    except LoadError as error:
        warn(f"{model.name}: its shapes are not read, and it is drawn as capsules and boxes: {error}", MbkitWarning)
    bodies = {model.frame(name).body for name in visuals.missing if name != "world"}
    if visuals.shapes and model.drawn_from:
        # Bodies that were added to the robot have no file.
        bodies |= {body.name for body in model.bodies if body.mass} - {s.body for s in visuals.shapes}
    if visuals.missing:
        several = listing([f"{name} ({why})" for name, why in visuals.missing.items()], 3)
        warn(f"{model.name}: meshes that cannot be read are drawn as capsules and boxes: {several}", MbkitWarning)
    if visuals.shapes or bodies:
        return visuals.shapes + stand_ins(model, bodies - {s.body for s in visuals.shapes})
    return stand_ins(model, {body.name for body in model.bodies})


def stand_ins(model: Model, bodies: set[str]) -> list[Shape]:
    """Return capsules from joint to joint and boxes with the inertia of some bodies."""
    if not bodies:
        return []
    points = [(joint.parent, joint.translation) for joint in model.joints]
    points += [x for y in model.loops for x in ((y.body_a, y.translation_a), (y.body_b, y.translation_b))]
    ends = by_key(points)
    for body in model.bodies:
        if body.name not in ends:
            places = [f.translation for f in model.frames if f.body == body.name] + [body.com]
            ends[body.name] = [max(places, key=lambda p: float(np.linalg.norm(p)))]
    boxes = {body.name: inertia_box(body) for body in model.bodies}
    lengths = [float(np.linalg.norm(p)) for places in ends.values() for p in places if has_length(p)]
    lengths = lengths or [2 * float(np.linalg.norm(half)) for _, half in boxes.values() if half.any()] or [1.0]
    radius, longest = 0.06 * float(np.mean(lengths)), 1.5 * max(lengths)
    out: list[Shape] = []
    moving = {joint.child: joint for joint in model.joints if joint.type.nv}
    for k, body in enumerate(model.bodies):
        if body.name not in bodies:
            continue
        color = _BODIES[k % len(_BODIES)]
        for i, p in ((i, p) for i, p in enumerate(ends[body.name]) if has_length(p)):
            size = (radius, float(np.linalg.norm(p)) / 2)
            out.append(Shape(f"{body.name}.stick{i}", body.name, z_to(p), p / 2, "capsule", size, (), color))
        box = _box(body, *boxes[body.name], radius, longest, color)
        slides = body.name in moving and bool(moving[body.name].type.lengths)
        out += [box] if box is not None and (boxes[body.name][1].any() or not slides) else []
        if slides and not boxes[body.name][1].any():
            out.append(Shape(f"{body.name}.box", body.name, np.eye(3), body.com, "box", (2 * radius,) * 3, (), color))
        if body.name in moving and not moving[body.name].type.floating and not slides:
            name = f"{body.name}.joint"
            out.append(Shape(name, body.name, np.eye(3), np.zeros(3), "sphere", (1.4 * radius,), (), _JOINT))
    return out


def _box(body: Body, axes: Array, half: Array, radius: float, longest: float, color: Color) -> Shape | None:
    """Return the box of a body's inertia, neither thinner than a stick nor larger than the model; None without mass."""
    if not body.mass:
        return None
    axes = axes * np.sign(np.linalg.det(axes))
    if not half.any():
        return Shape(f"{body.name}.mass", body.name, np.eye(3), body.com, "sphere", (2.2 * radius,), (), color)
    size = tuple(float(x) for x in np.clip(half, 0.5 * radius, longest))
    return Shape(f"{body.name}.inertia", body.name, axes, body.com, "box", size, (), (*color[:3], 0.4))


@dataclass(frozen=True, eq=False)
class Scene:
    """Shapes and places of bodies over time, in axes in which z is against gravity.

    Attributes
    ----------
    name : str
    bodies : tuple of str
        ``"world"`` first.
    shapes : tuple of Shape
    t : (K,) array
        s.
    rotations, translations : (K, B, 3, 3) and (K, B, 3) arrays
        R_WB and p_WB of each body, m.
    """

    name: str
    bodies: tuple[str, ...]
    shapes: tuple[Shape, ...]
    t: Array
    rotations: Array
    translations: Array

    @classmethod
    def of(cls, model: Model, q: Array, t: Array, kind: Kind, triangles: int) -> Scene:
        """Return the scene at configurations (K, nq) with about that many triangles at most."""
        shapes = shapes_of(model, kind)
        poses = body_poses(model, q)
        rotations = np.stack([R for R, _ in poses.values()], axis=1)
        translations = np.stack([p for _, p in poses.values()], axis=1)
        up = z_to(-model.gravity).T if has_length(model.gravity) else np.eye(3)
        return cls(model.name, tuple(poses), _fewer(shapes, triangles), t, up @ rotations, translations @ up.T)

    def placements(self, frame: int) -> tuple[Array, Array]:
        """Return R_WS (S, 3, 3) and p_WS (S, 3) of every shape at a frame."""
        which = [self.bodies.index(s.body) for s in self.shapes]
        R_WB, p_WB = self.rotations[frame, which], self.translations[frame, which]
        R = np.array([s.rotation for s in self.shapes]).reshape(-1, 3, 3)
        p = np.array([s.translation for s in self.shapes]).reshape(-1, 3)
        return R_WB @ R, p_WB + np.einsum("nij,nj->ni", R_WB, p)

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of all shapes over all frames, (2, 3), m."""
        corners = []
        for shape in self.shapes:
            V = np.concatenate([s.vertices for s in shape.surfaces])
            corners.append(list(product(*zip(V.min(axis=0), V.max(axis=0), strict=True))))
        points = [self.translations[:, 0]] if not corners else []
        for frame in np.unique(np.linspace(0, len(self.t) - 1, 40).astype(int)) if corners else ():
            R, p = self.placements(frame)
            points.append((np.einsum("nij,ncj->nci", R, np.array(corners)) + p[:, None]).reshape(-1, 3))
        every = np.concatenate(points)
        return np.array([every.min(axis=0), every.max(axis=0)])

    @property
    def ground(self) -> float:
        """Height of the grid, that of the lowest point, or zero where this is nearly it."""
        low, high = self.bounds[:, 2]
        return 0.0 if abs(low) < 0.03 * (high - low) else float(low)

    @cached_property
    def camera(self) -> dict[str, Any]:
        """A camera of 35° that sees everything, as target and distance in m, azimuth and elevation in rad."""
        low, high = self.bounds
        wide, deep = (high - low)[:2]
        # A motion in a plane is seen from its side, and a robot that looks along x from the front.
        azimuth = -np.pi / 2 + 0.5 if wide >= deep else 0.5
        right, up, back = camera_axes(azimuth, _CAMERA_ELEVATION)
        corners = np.array(list(product(*zip(low, high, strict=True)))) - (low + high) / 2
        # A picture is somewhat wider than it is high.
        needed = np.maximum(np.abs(corners @ up), np.abs(corners @ right) / 1.2) / np.tan(
            np.deg2rad(HALF_ANGLE_DEGREES)
        )
        return {
            "target": ((low + high) / 2).tolist(),
            "distance": 1.12 * max(float((corners @ back + needed).max()), 1e-6),
            "azimuth": azimuth,
            "elevation": _CAMERA_ELEVATION,
            "reach": max(float(np.linalg.norm(high - low)) / 2, 1e-6),
        }


def camera_axes(azimuth: float, elevation: float) -> Array:
    """Return the directions to the right, upwards and towards the camera, (3, 3)."""
    (ca, ce), (sa, se) = np.cos([azimuth, elevation]), np.sin([azimuth, elevation])
    return np.array([[-sa, ca, 0], [-ca * se, -sa * se, ce], [ca * ce, sa * ce, se]])


def _fewer(shapes: list[Shape], triangles: int) -> tuple[Shape, ...]:
    """Return shapes whose meshes have fewer triangles, shared ones still shared."""
    meshes = {id(s.meshes): s.meshes for s in shapes if s.meshes}
    flat = [surface for group in meshes.values() for surface in group]
    uses = max(1.0, sum(len(s.meshes) for s in shapes) / max(1, len(flat)))
    fewer = iter(thinned(flat, int(triangles / uses)))
    own = {key: tuple(next(fewer) for _ in group) for key, group in meshes.items()}
    return tuple(replace(s, meshes=own.get(id(s.meshes), ())) for s in shapes)
