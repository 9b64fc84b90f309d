"""Join two models into one, and mount a model on a tilted base."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit import spatial
from mbkit._check import Array, shown
from mbkit.errors import InputError
from mbkit.model.builder import MAX_LENGTH, ModelBuilder, expect_model
from mbkit.model.elements.paths import OF_BODIES, Path
from mbkit.model.elements.references import KINDS_OF_PARTS, entries, hung_on
from mbkit.model.model import Model
from mbkit.model.validation import listing

JOIN: Final = Path("join", "join: not known of", OF_BODIES)
#: Kinds of parts that share one set of names each.
_NAMED: Final = (("bodies", "frames"), *((kind,) for kind in KINDS_OF_PARTS if kind not in ("bodies", "frames")))


def read_pose(name: str, pose: ArrayLike | None) -> tuple[Array, Array]:
    """Return R and p of a homogeneous matrix, (4, 4); the identity for None."""
    if pose is None:
        return np.eye(3), np.zeros(3)
    X = spatial.checked_pose(name, pose)
    if np.abs(X[:3, 3]).max() > MAX_LENGTH:
        raise InputError(f"{name}: expected lengths up to {MAX_LENGTH:g} m, got {np.abs(X[:3, 3]).max():g}")
    return X[:3, :3], X[:3, 3]


def mounted(model: Model, pose: ArrayLike) -> Model:
    """Return a model whose ground is turned and moved against the world, as on a ceiling or a tilted base.

    Gravity and the world stay; what hangs on the ground moves by the pose, (4, 4).

    Raises
    ------
    InputError
        Another matrix than a pose, and a free joint on the ground, which has no mount.
    """
    R, p = read_pose("mount", pose)
    if floating := [j.name for j in model.joints if j.parent == "world" and j.type.floating]:
        raise InputError(
            f"mount: {model.name} floats on joint {floating[0]!r}; a mount is for a fixed base, and q places a free one"
        )
    bindings = list(model.bindings)
    places = {"world": ("world", R, p)}
    parts: dict[str, Any] = {
        kind: tuple(hung_on(x, places, bindings) for x in getattr(model, kind)) for kind in KINDS_OF_PARTS
    }
    rpy = [round(float(x) + 0.0, 4) for x in np.degrees(spatial.rpy_from_matrix(R))]
    note = f"mounted at {np.round(p, 6).tolist()} m, roll, pitch, yaw {rpy} degrees"
    drawn_from = tuple(x.hung_on("world", R, p) for x in model.sources)
    notes = (*model.notes, note)
    return replace(model, **parts, bindings=tuple(bindings), notes=notes, source="", drawn_from=drawn_from)


def join(
    base: Model, arm: Model, *, at: str, pose: ArrayLike | None = None, prefix: str = "", name: str | None = None
) -> Model:
    """Put one model on a frame of another: an arm on a cart, a hand on an arm, two arms on one body.

    What hangs on the ground of `arm` hangs on the body of the frame instead. The world, gravity and the file of shapes
    are those of `base`, and forces in world axes stay in these. Coordinates of `base` come first.

    Parameters
    ----------
    base, arm : Model
        Neither is changed. Parameters of the same name become one.
    at : str
        A frame or body of `base`, or ``"world"``.
    pose : (4, 4) array_like, optional
        Where the ground of `arm` stands in that frame, as a homogeneous matrix; `mbkit.spatial.pose` makes one.
    prefix : str
        Before the names of all parts of `arm`, such as ``"left_"``.
    name : str, optional
        Of the whole; by default that of `base`.

    Returns
    -------
    Model

    Raises
    ------
    InputError
        Names that both have, an arm that floats, and another matrix than a pose.
    UnknownNameError
        No frame of this name.
    ModelError
        Parameters of the same name with two values, or a prefix that no name can have.

    Examples
    --------
    >>> import mbkit as mb
    >>> torso = mb.ModelBuilder("torso")
    >>> torso.add_body("torso", mass=20.0, inertia=(1.0, 1.0, 0.5))
    >>> torso.add_joint("float", "free", parent="world", child="torso")
    >>> robot = torso.build()
    >>> for side, y in (("left_", 0.2), ("right_", -0.2)):
    ...     place = mb.spatial.pose((0, y, 0.3), rpy=(0, 1.57, 0))
    ...     robot = mb.join(robot, mb.load("ur5"), at="torso", pose=place, prefix=side)
    >>> robot.nv, robot.joint_names[1], robot.joint_names[7]
    (18, 'left_shoulder_pan_joint', 'right_shoulder_pan_joint')
    """
    base, arm = expect_model(base, "base"), expect_model(arm, "arm")
    if not isinstance(prefix, str):
        raise InputError(f"prefix: expected text, got {shown(prefix)}")
    for model in (base, arm):
        JOIN.admit(model)
    frame = base.frame(at)
    R, p = read_pose("pose", pose)
    if at != "world" and (floating := [j.name for j in arm.joints if j.parent == "world" and j.type.floating]):
        raise InputError(
            f"arm: {arm.name} floats on joint {floating[0]!r}, so that nothing would hold it at {at!r}; load it with a "
            "fixed base, or lock that joint"
        )
    b, added = ModelBuilder.of(base), ModelBuilder.of(arm)
    if prefix:
        added.add_prefix(prefix)
    added._notes = [f"{prefix or arm.name}: {text}" for text in arm.notes]
    _require_other_names(base, added._parts, prefix)
    place = entries(frame, "translation", base.bindings) + frame.rotation @ p
    b._take(added, frame.body, frame.rotation @ R, place, frame.translation + frame.rotation @ p)
    b._name = base.name if name is None else b._read.name("name", name)
    b.note(f"joined: {arm.name} at {at!r}" + (f" with the prefix {prefix!r}" if prefix else ""))
    if not np.array_equal(base.gravity, arm.gravity, equal_nan=True):
        b.note(f"gravity is that of {base.name}, {base.gravity.tolist()}; {arm.name} had {arm.gravity.tolist()}")
    return b.build()


def _require_other_names(base: Model, parts: dict[str, list[Any]], prefix: str) -> None:
    for kinds in _NAMED:
        there = {x.name for kind in kinds for x in getattr(base, kind)}
        both = [x.name for kind in kinds for x in parts[kind] if x.name in there]
        if both:
            named = listing([repr(x) for x in both], 1)
            raise InputError(
                f"prefix: with {prefix!r} both models have {kinds[0]} of the name {named}; give another one"
            )
