"""URDF to `Model`, by Pinocchio's parser.

Pinocchio merges links that are fixed to each other: a body has the name of its moving joint's child link, and the
merged links become frames. Joints are in Pinocchio's order: depth first, siblings by name.
"""

from __future__ import annotations

from typing import Any, Final, Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.errors import LoadError, ModelError, UnsupportedError
from mbkit.load.urdf_check import UrdfFile, UrdfJoint, unbounded
from mbkit.model import Body, Model, ModelBuilder, kind_of
from mbkit.model.validation import body_fault

# A rotation matrix from a quaternion is off by up to about 5 eps.
_REACH: Final = 8 * float(np.finfo(float).eps)


class Snapper:
    """Rounds entries of rotations and axes that are within `reach` of 0, 1 or -1, and counts them.

    Half a turn, written 3.141592653589793, gives 6e-17 in place of 0, and terms would not vanish when expressions are
    derived. Entries farther off, such as -3.67e-6 of the angle 1.5708, stay as written.
    """

    def __init__(self, reach: float = _REACH) -> None:
        self._reach = reach
        self.count = 0
        self.largest = 0.0

    def __call__(self, entries: Array) -> Array:
        """Return the entries of a rotation matrix or a unit vector, rounded."""
        out = np.where(np.abs(entries) <= self._reach, 0.0, entries)
        # A one is set only where it is alone: beside an angle of 4e-8, whose cosine is
        # 1 - 8e-16, it would spoil the unit length.
        alone = np.ones(out.shape, dtype=bool)
        for axis in range(out.ndim):
            alone &= np.count_nonzero(out, axis=axis, keepdims=True) == 1
        near_one = alone & (np.abs(np.abs(out) - 1) <= self._reach)
        out = np.where(near_one, np.sign(out), out)
        change = np.abs(out - entries)
        self.count += int(np.count_nonzero(change))
        self.largest = max(self.largest, float(change.max()))
        return out

    @property
    def note(self) -> str | None:
        """A sentence on the changes, or None."""
        if not self.count:
            return None
        return (
            f"{self.count} entries of rotations and axes within {self._reach:.1e} of 0, 1 or -1 were set to it; "
            f"the largest change was {self.largest:.1e}"
        )


_AXES: Final = dict(zip("XYZ", np.eye(3), strict=True))
_ALIGNED: Final = {"R": "revolute", "P": "prismatic", "RUB": "continuous", "H": "helical"}
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


def model_of(
    urdf: UrdfFile,
    source: str,
    *,
    floating_base: bool,
    mimic: Literal["reduce", "free"],
    nonphysical: Literal["error", "warn"],
    gravity: ArrayLike,
) -> Model:
    """Parse a checked URDF and return its model."""
    try:
        if floating_base:
            raw = pin.buildModelFromXML(urdf.text, pin.JointModelFreeFlyer(), "root_joint")
        else:
            raw = pin.buildModelFromXML(urdf.text)
    except Exception as error:
        raise LoadError(f"{source}: Pinocchio's URDF parser refuses this file: {error}") from None
    return _Conversion(raw, urdf, floating_base, mimic).run(source, nonphysical, gravity)


class _Conversion:
    def __init__(self, raw: Any, urdf: UrdfFile, floating_base: bool, mimic: str) -> None:
        self.raw, self.urdf, self.floating_base, self.mimic = raw, urdf, floating_base, mimic
        self.joints = {j.name: j for j in urdf.joints}
        self.snap = Snapper()
        self.bodies: list[str] = []
        self.suspects: set[str] = set()
        self.renamed: list[str] = []
        # Links with inconsistent inertias, by the body that they were merged into.
        self.odd: dict[str, list[tuple[str, str]]] = {}

    def run(self, source: str, nonphysical: Literal["error", "warn"], gravity: ArrayLike) -> Model:
        """Return the model of the parsed one, joint by joint."""
        b = ModelBuilder(self.urdf.name, gravity=gravity)
        X_base = self._add_base(b)
        for index in range(1, self.raw.njoints):
            self._add_joint(b, index, X_base)
        self._add_frames(b, X_base)
        for link, why in self.urdf.odd_links.items():
            frame = self.raw.frames[self.raw.getFrameId(link, pin.BODY)]
            self.odd.setdefault(self.bodies[frame.parentJoint], []).append((link, why))
        renamed = (f"link 'world' is called {n!r} here, because 'world' is the ground" for n in self.renamed)
        for note in (*self.urdf.notes, self._mimic_note(), self._odd_note(), *renamed, self.snap.note):
            if note:
                b.note(note)
        try:
            return b.build(nonphysical=nonphysical, point_masses=False, parts=self.odd)
        except ModelError as error:
            raise ModelError(source, error.faults) from None

    # The base: the links that Pinocchio has merged into its universe

    def _add_base(self, b: ModelBuilder) -> Any:
        """Add the body that does not move, and return its pose in the world, or None."""
        if self.floating_base:
            self.bodies.append("world")
            return None
        joint, X = self._base_link()
        if joint is None and self.urdf.root == "world" and not self.raw.inertias[0].mass:
            self.bodies.append("world")
            return None
        link = self.urdf.root if joint is None else joint.child
        name = self._body_name(link)
        self._add_body(b, name, X.actInv(self.raw.inertias[0]))
        joint_name = self._unused("world_to_" + name) if joint is None else joint.name
        b.add_joint(
            joint_name, "fixed", parent="world", child=name, translation=X.translation, rotation=self.snap(X.rotation)
        )
        return X

    def _add_body(self, b: ModelBuilder, name: str, inertia: Any) -> None:
        self.bodies.append(name)
        body = Body(name, inertia.mass, inertia.lever, inertia.inertia)
        if body_fault(body, point_masses=False):
            self.suspects.add(name)
        b.add_body(name, mass=body.mass, com=body.com, inertia=body.inertia)

    def _base_link(self) -> tuple[UrdfJoint | None, Any]:
        """Return the fixed joint whose child is the base, where the root link is the ground, and the base's pose."""
        here = pin.SE3.Identity()
        if self.urdf.root != "world":
            return None, here
        for joint in self.urdf.joints:
            if joint.parent == "world" and joint.kind == "fixed":
                return joint, self.raw.frames[self.raw.getFrameId(joint.child, pin.BODY)].placement
        return None, here

    def _body_name(self, link: str) -> str:
        """Return the link's name; "world" is the ground's in a `Model`."""
        if link != "world":
            return link
        name = "world_link"
        while name in self.urdf.links:
            name += "_"
        self.renamed.append(name)
        return name

    def _unused(self, name: str) -> str:
        while name in self.joints:
            name += "_"
        return name

    def _add_joint(self, b: ModelBuilder, index: int, X_base: Any) -> None:
        raw, name = self.raw, str(self.raw.names[index])
        joint = raw.joints[index]
        kind, axis = joint_kind(joint)
        link = self.joints[name].child if name in self.joints else self.urdf.root
        body = self._body_name(link)
        X = raw.jointPlacements[index]
        parent = self.bodies[raw.parents[index]]
        if raw.parents[index] == 0 and X_base is not None and not X_base.isIdentity(0.0):
            # Kept as written: a placement relative to the base would be rounded again.
            parent = "world"
        self._add_body(b, body, raw.inertias[index])
        v = slice(joint.idx_v, joint.idx_v + joint.nv)
        limits: dict[str, Any] = {}
        if kind in ("revolute", "prismatic"):
            limits["lower"] = unbounded(raw.lowerPositionLimit[joint.idx_q])
            limits["upper"] = unbounded(raw.upperPositionLimit[joint.idx_q])
        if joint.nv == 1:
            limits["velocity_limit"] = unbounded(raw.upperVelocityLimit[joint.idx_v])
            limits["effort_limit"] = unbounded(raw.upperEffortLimit[joint.idx_v])
        b.add_joint(
            name,
            kind,
            parent=parent,
            child=body,
            translation=X.translation,
            rotation=self.snap(X.rotation),
            axis=None if axis is None else self.snap(axis),
            armature=raw.armature[v],
            damping=raw.damping[v],
            friction=raw.upperDryFrictionLimit[v],
            mimic=self.joints[name].mimic if self.mimic == "reduce" and name in self.joints else None,
            **limits,
        )

    def _add_frames(self, b: ModelBuilder, X_base: Any) -> None:
        """Add the links and fixed joints that were merged."""
        names = {*self.bodies, "world"}
        for type_ in (pin.BODY, pin.FIXED_JOINT):
            for frame in list(self.raw.frames)[1:]:
                body = self.bodies[frame.parentJoint]
                if frame.type != type_ or frame.name in names or body == "world":
                    continue
                names.add(frame.name)
                X = frame.placement
                if frame.parentJoint == 0 and X_base is not None and not X_base.isIdentity(0.0):
                    X = X_base.actInv(X)
                b.add_frame(frame.name, body=body, translation=X.translation, rotation=self.snap(X.rotation))

    def _mimic_note(self) -> str:
        mimics = [(j.name, j.mimic) for j in self.urdf.joints if j.mimic]
        listing = ", ".join(f"{name} = {m.ratio:g} {m.joint} {m.offset:+g}" for name, m in mimics)
        what = "reduced, so that they have no coordinate of their own"
        if self.mimic == "free":
            what = "kept independent, as mimic='free' asks"
        return f"mimic joints {what}: {listing}" if mimics else ""

    def _odd_note(self) -> str:
        odd = [(body, link, why) for body, links in self.odd.items() for link, why in links]
        healed = [f"{link} ({why})" for body, link, why in odd if body not in self.suspects]
        listing = "; ".join(healed[:5]) + (f"; and {len(healed) - 5} more" if len(healed) > 5 else "")
        return (
            f"links of inconsistent inertia, sound together with the links fixed to them: {listing}" if healed else ""
        )
