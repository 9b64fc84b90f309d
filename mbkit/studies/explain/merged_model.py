"""A description with links that are fixed together merged into one body, and comparison of its parts to a tolerance.

Two descriptions of one robot may merge links or keep them apart; the motion is the same. So they are compared merged,
and each body knows its links.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.load.shapes import NOTHING, MassProperties, together
from mbkit.model import Body, Frame, Joint, Model
from mbkit.model.elements.forces import FrameForce, by_functions
from mbkit.model.elements.references import KINDS_OF_PARTS, with_names
from mbkit.studies._targets import with_values

#: Kinds of parts that are compared by their fields alone.
OTHERS: Final = tuple(kind for kind in KINDS_OF_PARTS if kind not in ("bodies", "joints"))


@dataclass(frozen=True)
class Tolerances:
    """Comparison of parts of descriptions to a relative tolerance."""

    relative: float
    #: Size of the robot, m: the scale for coordinates that should be zero.
    length: float

    @classmethod
    def of(cls, model: Model, relative: float) -> Tolerances:
        """Take the size from the distances between joints and centres of mass."""
        points = (*(j.translation for j in model.joints), *(b.com for b in model.bodies))
        return cls(relative, max([1e-3, *(float(np.linalg.norm(x)) for x in points)]))

    def number(self, a: float, b: float) -> bool:
        """Return whether two numbers are equal; an infinite limit equals itself alone."""
        size = max(abs(a), abs(b))
        return a == b or (size < np.inf and abs(a - b) <= self.relative * size)

    def numbers(self, a: Array, b: Array) -> bool:
        """Return whether all numbers of two vectors are equal."""
        return a.shape == b.shape and all(map(self.number, a.tolist(), b.tolist()))

    def vector(self, a: Array, b: Array, scale: float = 1.0) -> bool:
        """Return whether two vectors or matrices are equal, as a whole."""
        return a.shape == b.shape and bool(np.abs(a - b).max(initial=0.0) <= self.relative * scale)

    def point(self, a: Array, b: Array) -> bool:
        """Return whether two points are equal."""
        return self.vector(a, b, self.length)

    def inertia(self, a: Array, b: Array, mass: float) -> bool:
        """Return whether two inertias of bodies of this mass are equal."""
        # A move of an inertia from one point to another rounds as m l².
        floor = 1e-3 * mass * self.length**2 * self.relative
        return bool(np.abs(a - b).max() <= self.relative * np.abs(a).max() + floor)

    def mass_properties(self, a: MassProperties, b: MassProperties) -> bool:
        """Return whether mass, centre of mass and inertia are equal."""
        com = self.point(a.com, b.com) or not (a.mass or b.mass)
        return self.number(a.mass, b.mass) and com and self.inertia(a.inertia, b.inertia, a.mass)


@dataclass(frozen=True)
class LinkInBody:
    """A link merged into a body: the pose of its frame in the body's, and its matter in its own axes."""

    name: str
    R: Array
    p: Array
    matter: MassProperties

    @property
    def mass_properties(self) -> MassProperties:
        """Its matter in the body's axes."""
        return self.matter.moved(self.R, self.p)

    @property
    def massive(self) -> bool:
        """Whether it has mass or inertia; otherwise it is a mere frame."""
        return bool(self.matter.mass or self.matter.inertia.any())


@dataclass(frozen=True)
class MergedModel:
    """A description without fixed joints and without links fixed to the world."""

    model: Model
    #: Body -> its links, its own first; ``"world"`` has those that stand still.
    links: Mapping[str, tuple[LinkInBody, ...]]

    @property
    def ground(self) -> MassProperties:
        """The matter that stands still, in the world's axes."""
        return composite(self.links["world"])

    def mass_properties(self, body: str) -> MassProperties:
        """Return the matter of a body."""
        x = self.model.body(body)
        return MassProperties(x.mass, x.com, x.inertia)

    def with_fields(self, **fields: Any) -> MergedModel:
        """Return the description with other fields of the model."""
        return replace(self, model=replace(self.model, **fields))

    def with_joint(self, fields: Mapping[str, Any], name: str) -> MergedModel:
        """Return the description with other fields in one joint."""
        return self.with_fields(joints=tuple(replace(j, **fields) if j.name == name else j for j in self.model.joints))

    def with_body(self, fields: Mapping[str, Any], name: str) -> MergedModel:
        """Return the description with another mass, centre of mass or inertia in one body."""
        return replace(
            self, model=with_mass_properties(self.model, name, replace(self.mass_properties(name), **fields))
        )

    def with_link(self, fields: Mapping[str, Any], body: str, link: str) -> MergedModel:
        """Return the description with other matter in one link of a body, in the link's axes."""
        links = tuple(replace(x, matter=replace(x.matter, **fields)) if x.name == link else x for x in self.links[body])
        return MergedModel(with_mass_properties(self.model, body, composite(links)), {**self.links, body: links})


@dataclass(frozen=True)
class FrameChange:
    """Coordinates in another frame: x becomes A (x - o) + t on `body`."""

    body: str
    A: Array = field(default_factory=lambda: np.eye(3))
    o: Array = field(default_factory=lambda: np.zeros(3))
    t: Array = field(default_factory=lambda: np.zeros(3))

    def point(self, x: Array) -> Array:
        """Return a point in the other frame."""
        return np.asarray(self.A @ (x - self.o) + self.t)

    def joint(self, joint: Joint) -> Joint:
        """Return a joint on this body as it stands in the other frame."""
        rotation, translation = self.A @ joint.rotation, self.point(joint.translation)
        return replace(joint, parent=self.body, rotation=rotation, translation=translation)


def merge(model: Model) -> MergedModel:
    """Return the description with links merged that are fixed together.

    A parameter without a value is an error, the others take their values; frames on which no force acts are left out.
    """
    model = _with_own_frames(with_values(model, "explain"))
    bodies = {b.name: b for b in model.bodies}
    at = {"world": FrameChange("world")}
    links: dict[str, list[LinkInBody]] = {"world": []}
    moving: dict[str, Joint] = {}
    for joint in model.tree:
        placed, own = at[joint.parent].joint(joint), bodies[joint.child]
        if joint.type.nv:
            moving[joint.name] = placed
            at[joint.child] = FrameChange(joint.child)
            links[joint.child] = []
        else:
            at[joint.child] = FrameChange(placed.parent, placed.rotation, t=placed.translation)
        here = at[joint.child]
        links[here.body].append(LinkInBody(own.name, here.A, here.t, MassProperties(own.mass, own.com, own.inertia)))
    joints = tuple(moving[j.name] for j in model.joints if j.name in moving)
    matter = tuple(_body(j.child, composite(links[j.child])) for j in joints)
    merged = replace(reattached(model, at), bodies=matter, joints=joints)
    return MergedModel(merged, {name: tuple(some) for name, some in links.items()})


def _with_own_frames(model: Model) -> Model:
    """Return the description with the forces by functions alone, and with the frames alone on which they act.

    What holds weights acts on single links. The frame of a body becomes one that can stand elsewhere than the body's.
    """
    frames = {b.name: Frame(f"frame of {b.name}", b.name, np.eye(3), np.zeros(3)) for b in model.bodies}
    frames |= {f.name: f for f in model.frames}
    own = {f.name: frames[f.frame] for f in model.forces if isinstance(f, FrameForce)}
    forces = (
        with_names(model, f, lambda name: frames[name].name, str, {}) if f.name in own else f
        for f in by_functions(model)
    )
    return replace(model, forces=tuple(forces), frames=tuple({x.name: x for x in own.values()}.values()))


def attached(part: Any, changes: Mapping[str, FrameChange]) -> Any:
    """Return a part with its places on bodies in other frames."""
    names = {f.name for f in fields(part)}
    for end in {"", "_a", "_b"} & {n.removeprefix("body") for n in names if n.startswith("body")}:
        change = changes[getattr(part, f"body{end}")]
        places = {n: getattr(part, n) for n in names & {f"{x}{end}" for x in ("translation", "point")}}
        axes = {n: getattr(part, n) for n in names & {f"{x}{end}" for x in ("rotation", "axis")}}
        new = {n: change.point(x) for n, x in places.items()} | {n: change.A @ x for n, x in axes.items()}
        part = replace(part, **new, **{f"body{end}": change.body})
    return part


def reattached(model: Model, changes: Mapping[str, FrameChange]) -> Model:
    """Return the description with the places of parts beside bodies and joints in other frames."""
    parts: dict[str, Any] = {kind: tuple(attached(x, changes) for x in getattr(model, kind)) for kind in OTHERS}
    return replace(model, **parts)


def with_common_frames(*sides: MergedModel) -> Iterator[MergedModel]:
    """Yield the descriptions with each other's frames, so that forces can be exchanged."""
    frames = {f.name: f for side in sides for f in side.model.frames}
    yield from (x.with_fields(frames=tuple((frames | {f.name: f for f in x.model.frames}).values())) for x in sides)


def composite(links: Iterable[LinkInBody]) -> MassProperties:
    """Return several links as one rigid body, in the body's axes."""
    masses = [x.mass_properties for x in links if x.massive]
    if not masses:
        return NOTHING
    if len(masses) > 1 and not any(x.mass for x in masses):
        return MassProperties(0.0, np.zeros(3), np.asarray(sum(x.inertia for x in masses)))
    return together(masses)


def with_mass_properties(model: Model, name: str, mass_properties: MassProperties) -> Model:
    """Return the description with other matter in one body."""
    return replace(model, bodies=tuple(_body(name, mass_properties) if b.name == name else b for b in model.bodies))


def _body(name: str, mass_properties: MassProperties) -> Body:
    # A rotation of an inertia leaves rounding on one side of the diagonal.
    return Body(
        name, mass_properties.mass, mass_properties.com, 0.5 * (mass_properties.inertia + mass_properties.inertia.T)
    )
