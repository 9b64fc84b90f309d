"""A description with links that are fixed together merged into one body, and comparison of its parts to a tolerance.

Two descriptions of one robot may merge links or keep them apart; the motion is the same. So they are compared merged,
and each body knows its links.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.load.shapes import NOTHING, MassProperties, together
from mbkit.model import Body, Frame, Joint, Mimic, Model
from mbkit.model.elements.forces import FrameForce, by_functions
from mbkit.model.elements.formula import NUMPY, Formula
from mbkit.model.elements.references import KINDS_OF_PARTS, hung_on, with_names
from mbkit.model.parts import OF_Q, OF_V, NumberRule, acting, rules_of
from mbkit.studies._targets import with_values

#: Kinds of parts that are compared by their fields alone.
OTHERS: Final = tuple(kind for kind in KINDS_OF_PARTS if kind not in ("bodies", "joints"))


#: A part's section and name, or "links", the body and the link, or "" for the description itself.
Where = tuple[str, ...]


@dataclass(frozen=True)
class Tolerances:
    """Comparison of parts of descriptions to a relative tolerance, field by field."""

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

    def same(self, a: Any, b: Any) -> bool:
        """Return whether two parts of one kind, or the matter of two bodies, are equal but for their names."""
        return not self.differing(a, b)

    def differing(self, a: Any, b: Any, *names: str) -> list[str]:
        """Return the fields in which two parts of one kind differ, of all but the name or of these, each by its rule.

        A force's formulas differ by their values, and a number that is not given by what acts in its place.
        """
        rules = rules_for(a)
        of = names or [f.name for f in fields(a) if f.name != "name"]
        if "formula" in of:
            of = [n for n in of if n not in ("symbols", "numbers")]
        return [n for n in of if not self._same(n, rules.get(n), a, b)]

    def _same(self, name: str, rule: NumberRule | None, a: Any, b: Any) -> bool:
        if getattr(a, name) is getattr(b, name) is None:
            return True
        x, y = (as_it_acts(name, part) for part in (a, b))
        if isinstance(x, Mimic) and isinstance(y, Mimic):
            return self.same(x, y)
        if rule is None and isinstance(x, np.ndarray) and x.shape == np.shape(y):
            return bool(np.allclose(x, y, self.relative, self.relative))
        if rule is None or np.shape(x) != np.shape(y):
            return bool(np.array_equal(x, y))
        if name == "inertia":
            return self.inertia(x, y, a.mass)
        if rule.place:
            return self.point(x, y) or (name == "com" and not (a.mass or b.mass))
        if rule.direction or rule.added:
            return self.vector(np.asarray(x), np.asarray(y))
        if isinstance(x, float) or rule.shape in (OF_Q, OF_V):
            return all(map(self.number, np.atleast_1d(x).tolist(), np.atleast_1d(y).tolist()))
        return self.vector(x, y, float(np.abs([x, y]).max(initial=0.0)))


def rules_for(part: Any) -> Mapping[str, NumberRule]:
    """Return the rules of a part's numbers, also of matter without a name."""
    return rules_of(Body if isinstance(part, MassProperties) else type(part))


def as_it_acts(name: str, part: Any) -> Any:
    """Return a field as it acts, of a formula its values."""
    given = acting(part, name)
    if not isinstance(given, Formula):
        return given
    # Random arguments of many sizes, which each name has for itself.
    rngs = {name: np.random.default_rng([*name.encode()]) for name in given.arguments}
    at = {name: rng.standard_normal(64) * 10 ** rng.uniform(-2, 2, 64) for name, rng in rngs.items()}
    with np.errstate(all="ignore"):
        values = given(at | dict(zip(part.symbols, part.numbers, strict=True)), NUMPY)
    known = np.nan_to_num([np.broadcast_to(x, 64) for x in values], posinf=0.0, neginf=0.0)
    return known if known.any() else given


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

    def put(self, where: Where, values: Mapping[str, Any]) -> MergedModel:
        """Return the description with other fields in one part.

        With a section alone `values` are whole parts by name, None for one that is taken away.
        """
        section, *names = where
        if not section:
            return replace(self, model=replace(self.model, **values))
        if section == BASE_FRAME:
            return self._with_base_frame(self.model.joint(names[0]).child, *values["frame"])
        if not names:
            kept = [p for p in getattr(self.model, section) if p.name not in values]
            return self.put(("",), {section: (*kept, *(p for p in values.values() if p is not None))})
        *body, name = names
        if body:
            old = self.links[body[0]]
            links = tuple(replace(x, matter=replace(x.matter, **values)) if x.name == name else x for x in old)
            changed = replace(self, links={**self.links, body[0]: links})
            return changed.put(("bodies", *body), vars(composite(links)))
        if "inertia" in values:
            values = {**values, "inertia": _symmetric(values["inertia"])}
        parts = (replace(p, **values) if p.name == name else p for p in getattr(self.model, section))
        return self.put(("",), {section: tuple(parts)})

    def _with_base_frame(self, body: str, R: Array, p: Array) -> MergedModel:
        """Return the description with the frame of a free body at R, p in the old one; q and v then differ."""
        places = {body: (body, R.T, -R.T @ p)}
        model = reattached(self.model, places)
        joints = tuple(hung_on(j, places, []) if j.parent == body else j for j in model.joints)
        links = tuple(replace(x, R=R.T @ x.R, p=R.T @ (x.p - p)) for x in self.links[body])
        own = Body(body, **vars(composite(links)))
        bodies = tuple(own if x.name == body else x for x in model.bodies)
        return MergedModel(replace(model, joints=joints, bodies=bodies), {**self.links, body: links})


#: Section of a change of where the frame of a free body is drawn, which stands before the joint's name.
BASE_FRAME: Final = "base frame"
#: A body's frame on another body: that one's name, and R and p there.
Place = tuple[str, Array, Array]


def at_itself(body: str) -> Place:
    """Return the place of a body that stands where it does."""
    return body, np.eye(3), np.zeros(3)


def merge(model: Model) -> MergedModel:
    """Return the description with links merged that are fixed together.

    A parameter without a value is an error, the others take their values; frames on which no force acts are left out.
    """
    model = _with_own_frames(with_values(model, "explain"))
    bodies = {b.name: b for b in model.bodies}
    at = {"world": at_itself("world")}
    links: dict[str, list[LinkInBody]] = {"world": []}
    moving: dict[str, Joint] = {}
    for joint in model.tree:
        placed, own = hung_on(joint, at, []), bodies[joint.child]
        at[joint.child] = placed.parent, placed.rotation, placed.translation
        if joint.type.nv:
            moving[joint.name] = placed
            at[joint.child] = at_itself(joint.child)
            links[joint.child] = []
        body, R, p = at[joint.child]
        links[body].append(LinkInBody(own.name, R, p, MassProperties(own.mass, own.com, own.inertia)))
    joints = tuple(moving[j.name] for j in model.joints if j.name in moving)
    parts = ((j.child, composite(links[j.child])) for j in joints)
    matter = tuple(Body(name, x.mass, x.com, _symmetric(x.inertia)) for name, x in parts)
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


def reattached(model: Model, places: Mapping[str, Place]) -> Model:
    """Return the description with the places of parts beside bodies and joints in other frames."""
    parts: dict[str, Any] = {kind: tuple(hung_on(x, places, []) for x in getattr(model, kind)) for kind in OTHERS}
    return replace(model, **parts)


def with_common_frames(*sides: MergedModel) -> Iterator[MergedModel]:
    """Yield the descriptions with each other's frames, so that forces can be exchanged."""
    frames = {f.name: f for side in sides for f in side.model.frames}
    for x in sides:
        own = frames | {f.name: f for f in x.model.frames}
        yield x.put(("",), {"frames": tuple(own.values())})


def composite(links: Iterable[LinkInBody]) -> MassProperties:
    """Return several links as one rigid body, in the body's axes."""
    masses = [x.mass_properties for x in links if x.massive]
    if not masses:
        return NOTHING
    if len(masses) > 1 and not any(x.mass for x in masses):
        return MassProperties(0.0, np.zeros(3), np.asarray(sum(x.inertia for x in masses)))
    return together(masses)


def _symmetric(inertia: Array) -> Array:
    """Return an inertia without the rounding that a rotation leaves on one side of the diagonal."""
    return np.asarray(0.5 * (inertia + inertia.T))


def number_text(value: Any) -> str:
    """Return a number, vector or matrix of a description as text."""
    if not isinstance(value, np.ndarray) or value.size == 1:
        x = float(value.ravel()[0]) if isinstance(value, np.ndarray) else value
        # Below this it is rounding.
        return f"{0.0 if abs(x) < 1e-15 else x:.6g}"
    if value.shape != (3, 3):
        return f"({', '.join(map(number_text, value.ravel().tolist()))})"
    if np.array_equal(value, value.T):
        return f"[{', '.join(map(number_text, value[np.triu_indices(3)]))}]"
    return f"[{'; '.join(map(number_text, value))}]"
