"""URDF to `Model`, by Pinocchio's parser.

Pinocchio merges links that are fixed to each other: a body has the name of its moving joint's child link, and the
merged links become frames. Joints are in Pinocchio's order: depth first, siblings by name.

A description as URDF, where the format can say it; the ground is a link called world.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from textwrap import indent
from typing import Any, Final, Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from mbkit import spatial
from mbkit._check import Array, by_key
from mbkit._escape import xml_attribute, xml_comment
from mbkit.errors import LoadError, ModelError, UnsupportedError
from mbkit.load.urdf_reader import BASE_JOINT, DYNAMICS, Snapper, UrdfFile, unbounded
from mbkit.load.xml_reader import reserved, unused
from mbkit.model import Body, Joint, Model, ModelBuilder, kind_of
from mbkit.model.elements.kinds import AS_LIMITS, joint_types
from mbkit.model.elements.paths import Path
from mbkit.model.validation import body_fault, listing

_AXES: Final = dict(zip("XYZ", np.eye(3), strict=True))
_ALIGNED: Final = {"R": "revolute", "P": "prismatic", "RUB": "continuous", "H": "helical"}
_LIMITS: Final = ("velocity_limit", "effort_limit", "lower", "upper")
_UNALIGNED: Final = {
    "RevoluteUnaligned": "revolute",
    "RevoluteUnboundedUnaligned": "continuous",
    "PrismaticUnaligned": "prismatic",
    "HelicalUnaligned": "helical",
    "FreeFlyer": "free",
    "Spherical": "ball",
    "SphericalZYX": "spherical_zyx",
    "Planar": "planar",
}


#: Numbers of a joint's velocities, and Pinocchio's names for them.
OF_VELOCITIES: Final = {"armature": "armature", "damping": "damping", "friction": "upperDryFrictionLimit"}


def joint_kind(joint: Any) -> tuple[str, Array | None]:
    """Return the kind and axis of one of Pinocchio's joints."""
    name = joint.shortname().removeprefix("JointModel")
    if name[:-1] in _ALIGNED:
        return _ALIGNED[name[:-1]], _AXES[name[-1]]
    if name not in _UNALIGNED:
        raise UnsupportedError(f"pinocchio: a {name} joint has no counterpart here")
    kind = _UNALIGNED[name]
    if not kind_of(kind).n_axes:
        return kind, None
    # Not every unaligned joint has its axis as an attribute, but all have the motion that they allow.
    data = joint.createData()
    motion = np.ravel(data.S)
    return kind, motion[:3] if kind == "prismatic" else motion[3:]


def joint_numbers(raw: Any, joint: Any) -> dict[str, Any]:
    """Return the constants and limits of one of Pinocchio's joints, as `ModelBuilder.add_joint` takes them."""
    q, v = slice(joint.idx_q, joint.idx_q + joint.nq), slice(joint.idx_v, joint.idx_v + joint.nv)
    out = {name: getattr(raw, own)[v] for name, own in OF_VELOCITIES.items()}
    if joint.nv == 1:
        out |= {"velocity_limit": raw.upperVelocityLimit[v], "effort_limit": raw.upperEffortLimit[v]}
        if joint.nq == 1:
            out |= {"lower": raw.lowerPositionLimit[q], "upper": raw.upperPositionLimit[q]}
    return {name: np.array(unbounded(x) if name in _LIMITS else x) for name, x in out.items()}


def model_of(
    urdf: UrdfFile,
    source: str,
    floating_base: bool,
    mimic: Literal["reduce", "free"],
    nonphysical: Literal["error", "warn"],
    gravity: ArrayLike,
) -> Model:
    """Parse a checked URDF and return its model."""
    try:
        if floating_base:
            raw = pin.buildModelFromXML(urdf.text, pin.JointModelFreeFlyer(), BASE_JOINT)
        else:
            raw = pin.buildModelFromXML(urdf.text)
    except Exception as error:
        raise LoadError(f"{source}: Pinocchio's URDF parser refuses this file: {error}") from None
    try:
        b = ModelBuilder(urdf.name, gravity=gravity)
        return _Conversion(b, raw, urdf, floating_base, mimic).build(nonphysical)
    except ModelError as error:
        raise ModelError(source, error.faults) from None


class _Conversion:
    """Adds what Pinocchio parsed to a builder, joint by joint."""

    def __init__(self, b: ModelBuilder, raw: Any, urdf: UrdfFile, floating_base: bool, mimic: str) -> None:
        self.b, self.raw, self.urdf, self.mimic = b, raw, urdf, mimic
        self.joints = {j.name: j for j in urdf.joints}
        self.snap = Snapper()
        self.links = {link.name for link in urdf.links}
        self.names: dict[str, str] = {}  # of links called otherwise here
        self.bodies = ["world"]  # by Pinocchio's joint
        self.suspects: set[str] = set()
        #: Pose of the base, the links that Pinocchio has merged into its universe, where it is a body here.
        self.X_base = None if floating_base else self._add_base()
        for index in range(1, raw.njoints):
            self._add_joint(index)
        self._add_frames()

    def build(self, nonphysical: Literal["error", "warn"]) -> Model:
        """Return the model, with notes on all decisions."""
        odd = by_key((self.bodies[self._frame(x[0]).parentJoint], x) for x in self.urdf.odd_links.items())
        healed = [f"{link} ({why})" for body, links in odd.items() for link, why in links if body not in self.suspects]
        mimics = [(j.name, j.mimic) for j in self.urdf.joints if j.mimic]
        notes = [*self.urdf.notes]
        if mimics:
            how = "reduced, so that they have no coordinate of their own"
            how = "kept independent, as mimic='free' asks" if self.mimic == "free" else how
            formulas = ", ".join(f"{name} = {m.ratio:g} {m.joint} {m.offset:+g}" for name, m in mimics)
            notes.append(f"mimic joints {how}: {formulas}")
        if healed:
            together = listing(healed)
            notes.append(f"links of inconsistent inertia, sound together with the links fixed to them: {together}")
        notes += [f"link {x!r} is called {n!r} here, because 'world' is the ground" for x, n in self.names.items()]
        for note in notes if self.snap.note is None else [*notes, self.snap.note]:
            self.b.note(note)
        return self.b.build(nonphysical=nonphysical, point_masses=self.urdf.point_masses, parts=odd)

    def _frame(self, link: str) -> Any:
        return self.raw.frames[self.raw.getFrameId(link, pin.BODY)]

    def _add_base(self) -> Any:
        """Add the body that does not move, and return its pose in the world; None where the world holds nothing."""
        root, X, joint = self.urdf.root, pin.SE3.Identity(), None
        if root == "world":
            joint = next((j for j in self.urdf.joints if j.parent == "world" and j.kind == "fixed"), None)
            if joint is not None:
                root, X = joint.child, self._frame(joint.child).placement
            elif not self.raw.inertias[0].mass:
                return None
        name = self._body_name(root)
        self._add_body(name, X.actInv(self.raw.inertias[0]))
        self.bodies[0] = name
        self.b.add_joint(
            unused(f"world_to_{name}", self.joints) if joint is None else joint.name,
            "fixed",
            parent="world",
            child=name,
            translation=X.translation,
            rotation=self.snap(X.rotation),
        )
        return None if X.isIdentity(0.0) else X

    def _add_body(self, name: str, inertia: Any) -> None:
        body = Body(name, inertia.mass, inertia.lever, inertia.inertia)
        if body_fault(body, point_masses=self.urdf.point_masses):
            self.suspects.add(name)
        self.b.add_body(name, mass=body.mass, com=body.com, inertia=body.inertia)

    def _body_name(self, link: str) -> str:
        """Return the link's name; "world" is the ground's in a `Model`."""
        if link == "world":
            self.names[link] = unused("world_link", self.links)
        return self.names.get(link, link)

    def _add_joint(self, index: int) -> None:
        raw, name = self.raw, str(self.raw.names[index])
        joint, X, above = raw.joints[index], raw.jointPlacements[index], raw.parents[index]
        kind, axis = joint_kind(joint)
        own = self.joints.get(name)
        body = self._body_name(own.child if own else self.urdf.root)
        self._add_body(body, raw.inertias[index])
        self.bodies.append(body)
        self.b.add_joint(
            name,
            kind,
            # Kept as written: a placement relative to the base would be rounded again.
            parent="world" if not above and self.X_base is not None else self.bodies[above],
            child=body,
            translation=X.translation,
            rotation=self.snap(X.rotation),
            axis=None if axis is None else self.snap(axis),
            mimic=own.mimic if own and self.mimic == "reduce" else None,
            **joint_numbers(raw, joint),
            # Pinocchio knows no springs.
            **{name: own.numbers[name] for name in ("stiffness", "rest") if own and name in own.numbers},
        )

    def _add_frames(self) -> None:
        """Add the links and fixed joints that were merged."""
        names = {*self.bodies, "world"}
        for type_ in (pin.BODY, pin.FIXED_JOINT):
            for frame in list(self.raw.frames)[1:]:
                body = self.bodies[frame.parentJoint]
                if frame.type != type_ or frame.name in names or body == "world":
                    continue
                names.add(frame.name)
                X = frame.placement
                if frame.parentJoint == 0 and self.X_base is not None:
                    X = self.X_base.actInv(X)
                self.b.add_frame(frame.name, body=body, translation=X.translation, rotation=self.snap(X.rotation))


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
    notes={"joint.stop": AS_LIMITS},
    beside=_notes,
)


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
            # The largest number that every reader reads stands for no limit.
            out.append(_element("limit", {k: np.clip(x, -1e308, 1e308) for k, x in limits.items()}))
        dynamics = {k: x for k in DYNAMICS if (x := getattr(joint, k)).any()}
        out += [_element("dynamics", dynamics)] if dynamics else []
    if joint.mimic is not None:
        m = joint.mimic
        out.append(_element("mimic", {"joint": m.joint, "multiplier": m.ratio, "offset": m.offset}))
    return _element("joint", {"name": joint.name, "type": type_}, *out)
