"""A description with links that are fixed together merged into one body, and comparison of its parts to a tolerance.

Two descriptions of one robot may merge links or keep them apart; the motion is the same. So they are compared merged,
and each body knows its links.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mbkit._check import Array
from mbkit.load.shapes import NOTHING, MassProperties, together
from mbkit.model import Body, Joint, Model
from mbkit.studies._targets import with_values


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

    A parameter without a value is an error, the others take their values; frames are left out.
    """
    model = with_values(model, "explain")
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
    merged = replace(reattached(model, at), bodies=matter, joints=joints, frames=())
    return MergedModel(merged, {name: tuple(some) for name, some in links.items()})


def reattached(model: Model, changes: Mapping[str, FrameChange]) -> Model:
    """Return the description with the ends of springs, loops and contacts in other frames."""

    def moved(part: Any) -> Any:
        ends: dict[str, Any] = {}
        for side in "ab":
            change = changes[getattr(part, f"body_{side}")]
            ends[f"body_{side}"] = change.body
            for name in (f"point_{side}", f"translation_{side}"):
                if hasattr(part, name):
                    ends[name] = change.point(getattr(part, name))
            if hasattr(part, f"rotation_{side}"):
                ends[f"rotation_{side}"] = change.A @ getattr(part, f"rotation_{side}")
            if hasattr(part, f"axis_{side}"):
                ends[f"axis_{side}"] = change.A @ getattr(part, f"axis_{side}")
        return replace(part, **ends)

    parts: dict[str, Any] = {
        where: tuple(map(moved, getattr(model, where))) for where in ("springs", "loops", "no_slip")
    }
    return replace(model, **parts)


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
