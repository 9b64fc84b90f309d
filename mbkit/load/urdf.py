"""URDF to `Model`, by Pinocchio's parser.

Pinocchio merges links that are fixed to each other, so a model has one body for every
moving joint, named after the joint's child link; the links merged into it become
frames. Joints stand in Pinocchio's order: depth first, siblings by name.
"""

from __future__ import annotations

from typing import Any, Final, Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.errors import LoadError, ModelError
from mbkit.load.urdf_check import UrdfFile, UrdfJoint, unbounded
from mbkit.model import Body, Mimic, Model, ModelBuilder
from mbkit.model.validation import body_fault

# Zeros and ones that rounding has blurred, set right once, when a file is loaded.
#
# A rotation by exactly half a turn, written 3.141592653589793, becomes a matrix with
# 6e-17 where there should be 0. Such an entry stops a term from vanishing while the
# expressions are derived. Only entries within a few units in the last place of 0, 1 or
# -1 are touched: 1.5708 for a quarter turn gives -3.67e-6, and that stays as written.

# A rotation matrix made by way of a quaternion is off by up to about 5 eps.
_REACH: Final = 8 * float(np.finfo(float).eps)


class Snapper:
    """Snaps entries of rotations and axes, and counts what it did.

    Parameters
    ----------
    reach : float
        How near to 0, 1 or -1 an entry is set to it; by default what rounding does.

    Attributes
    ----------
    count : int
        Entries changed so far.
    largest : float
        The largest change.
    """

    def __init__(self, reach: float = _REACH) -> None:
        self._reach = reach
        self.count = 0
        self.largest = 0.0

    def __call__(self, entries: Array) -> Array:
        """Return the entries of a rotation matrix or a unit vector, snapped."""
        out = np.where(np.abs(entries) <= self._reach, 0.0, entries)
        # A one is set right only where it stands alone: beside an angle of 4e-8,
        # whose cosine is 1 - 8e-16, it would spoil the unit length.
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
        """What was done, in one sentence, or None."""
        if not self.count:
            return None
        return (
            f"{self.count} entries of rotations and axes within {self._reach:.1e} of 0, 1 or -1 were set to it; "
            f"the largest change was {self.largest:.1e}"
        )


_AXES: Final = dict(zip("XYZ", np.eye(3), strict=True))
_ALIGNED: Final = {"R": "revolute", "P": "prismatic", "RUB": "continuous"}
_UNALIGNED: Final = {
    "RevoluteUnaligned": "revolute",
    "RevoluteUnboundedUnaligned": "continuous",
    "PrismaticUnaligned": "prismatic",
}
_WHOLE: Final = {"FreeFlyer": "free", "Planar": "planar"}


def model_of(
    urdf: UrdfFile,
    source: str,
    *,
    floating_base: bool,
    mimic: Literal["reduce", "free"],
    nonphysical: Literal["error", "warn"],
    gravity: ArrayLike,
) -> Model:
    """Parse a checked URDF and describe what came out."""
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
        """Describe the parsed model, joint by joint."""
        b = ModelBuilder(self.urdf.name, gravity=gravity)
        X_base = self._add_base(b)
        for index in range(1, self.raw.njoints):
            self._add_joint(b, index, X_base)
        self._add_frames(b, X_base)
        self.odd = self._odd_links()
        for note in (*self.urdf.notes, *self._mimic_notes(), *self._odd_notes(), *self._rename_notes(), self.snap.note):
            if note:
                b.note(note)
        try:
            return b.build(nonphysical=nonphysical, point_masses=False, parts=self.odd)
        except ModelError as error:
            raise ModelError(source, error.faults) from None

    # The base: what Pinocchio has merged into its universe.

    def _add_base(self, b: ModelBuilder) -> Any:
        """Add the body that stands still, and return where it stands in the world, or None."""
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
        """Return the fixed joint whose child is the base, if the root link is but the ground."""
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

    # Joints.

    def _add_joint(self, b: ModelBuilder, index: int, X_base: Any) -> None:
        raw, name = self.raw, str(self.raw.names[index])
        joint = raw.joints[index]
        kind, axis = _kind(joint)
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
            mimic=self._mimic_of(name),
            **limits,
        )

    def _mimic_of(self, name: str) -> Mimic | None:
        return self.joints[name].mimic if self.mimic == "reduce" and name in self.joints else None

    # Frames: the links and fixed joints that were merged away.

    def _add_frames(self, b: ModelBuilder, X_base: Any) -> None:
        taken = {*self.bodies, "world"}
        for type_ in (pin.BODY, pin.FIXED_JOINT):
            for frame in list(self.raw.frames)[1:]:
                body = self.bodies[frame.parentJoint]
                if frame.type != type_ or frame.name in taken or body == "world":
                    continue
                taken.add(frame.name)
                X = frame.placement
                if frame.parentJoint == 0 and X_base is not None and not X_base.isIdentity(0.0):
                    X = X_base.actInv(X)
                b.add_frame(frame.name, body=body, translation=X.translation, rotation=self.snap(X.rotation))

    # What a reader should know.

    def _mimic_notes(self) -> list[str]:
        mimics = [(j.name, j.mimic) for j in self.urdf.joints if j.mimic]
        if not mimics:
            return []
        listing = ", ".join(f"{name} = {m.ratio:g} {m.joint} {m.offset:+g}" for name, m in mimics)
        if self.mimic == "free":
            return [f"mimic joints kept independent, as mimic='free' asks: {listing}"]
        return [f"mimic joints reduced, so that they have no coordinate of their own: {listing}"]

    def _odd_links(self) -> dict[str, list[tuple[str, str]]]:
        bodies: dict[str, list[tuple[str, str]]] = {}
        for link, why in self.urdf.odd_links.items():
            frame = self.raw.frames[self.raw.getFrameId(link, pin.BODY)]
            bodies.setdefault(self.bodies[frame.parentJoint], []).append((link, why))
        return bodies

    def _odd_notes(self) -> list[str]:
        odd = [(body, link, why) for body, links in self.odd.items() for link, why in links]
        healed = [f"{link} ({why})" for body, link, why in odd if body not in self.suspects]
        if not healed:
            return []
        listing = "; ".join(healed[:5]) + (f"; and {len(healed) - 5} more" if len(healed) > 5 else "")
        return [f"links that no matter is like, seen alone, but sound with what is fixed to them: {listing}"]

    def _rename_notes(self) -> list[str]:
        return [f"link 'world' is called {n!r} here, because 'world' is the ground" for n in self.renamed]


def _kind(joint: Any) -> tuple[str, Any]:
    """Return the kind and axis of one of Pinocchio's joints."""
    name = joint.shortname().removeprefix("JointModel")
    if name[:-1] in _ALIGNED:
        return _ALIGNED[name[:-1]], _AXES[name[-1]]
    if name in _UNALIGNED:
        # Not every unaligned joint shows its axis, but all show the motion they allow.
        data = joint.createData()
        motion = np.ravel(data.S)
        return _UNALIGNED[name], motion[:3] if name.startswith("P") else motion[3:]
    return _WHOLE[name], None
