"""What a description is in the coordinates of an engine of another version, and how it travels there.

A model travels as plain data: numbers in JSON keep every digit, and no parser of a version is between the description
and its dynamics. MuJoCo has no other constructor in all versions than its parser of MJCF, and gets the text of
`mbkit.convert`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit.engines.base import BESIDE, OF_ANY_ENGINE, OF_COUPLINGS, OF_TREES, ROTORS_OF_SEVERAL, SOLVED, STACKS
from mbkit.model import Body, Joint, Model
from mbkit.model.elements.kinds import joint_types
from mbkit.model.elements.paths import Path
from mbkit.model.validation import static_bodies

#: Joint type -> the joints that an engine has in its place, one after the other.
Steps = Mapping[str, Callable[[Joint], list[dict[str, Any]]]]


class Convention(NamedTuple):
    """Coordinates of joints that rotate freely, in an engine.

    Attributes
    ----------
    free_q, free_v, ball_q : tuple of int
        The engine's number k is the description's number so and so; an empty `ball_q` stands for roll, pitch and yaw.
    turned : mapping
        Joint type -> starts of the triples of its velocity that are in the axes of the joint's fixed frame.
    linear : int
        Where a free joint's linear velocity begins.
    """

    free_q: tuple[int, ...] = (0, 1, 2, 3, 4, 5, 6)
    free_v: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    ball_q: tuple[int, ...] = (0, 1, 2, 3)
    turned: Mapping[str, tuple[int, ...]] = {}
    linear: int = 0


def _one(joint: Joint) -> list[dict[str, Any]]:
    return [{"type": joint.kind, "axes": joint.axes.tolist(), "pitch": joint.pitch}]


def _stacked(joint: Joint) -> list[dict[str, Any]]:
    return [{"type": kind, "axes": [axis.tolist()], "pitch": 0.0} for kind, axis in STACKS[joint.kind](joint)]


_OF_ALL: Final[dict[str, Callable[[Joint], list[dict[str, Any]]]]] = {
    "fixed": lambda _: [],
    **dict.fromkeys(("revolute", "continuous", "prismatic", "planar"), _stacked),
    **dict.fromkeys(("helical", "ball", "free"), _one),
}
#: The same where joints of several rotations are one joint of the engine, or a stack of them.
ONE_BY_ONE: Final = _OF_ALL | dict.fromkeys(("universal", "spherical_zyx"), _one)
STACKED: Final = _OF_ALL | dict.fromkeys(("universal", "spherical_zyx"), _stacked)
SENT: Final = Path("sent", "", joint_types(*ONE_BY_ONE) | OF_TREES | OF_COUPLINGS, instead=SOLVED)
SENT_TO_DRAKE: Final = replace(SENT, name="sent to drake", carries=SENT.carries - {ROTORS_OF_SEVERAL})
NEWTON: Final = replace(SENT_TO_DRAKE, name="newton", carries=SENT_TO_DRAKE.carries - joint_types("helical"))
_RUN: Final = SENT.carries - BESIDE - {"mimic"}
_WHY: Final = {"mimic": "it would have to be reduced; load with mimic='free'"}
REMOTE_RUNS: Final = Path("remote runs", "", _RUN, _WHY, instead=OF_ANY_ENGINE)
#: Runs of engines that know no more than what acts on one joint.
REMOTE_RUNS_OF_JOINTS: Final = replace(
    REMOTE_RUNS, name="remote runs of joints", carries=_RUN - OF_COUPLINGS - {"point.spring", "point.damper"}
)


def travelling(steps: Steps | None, model: Model) -> tuple[dict[str, Any], dict[str, Sequence[str]]]:
    """Return a description as an engine's file in `remote` takes it, and the engine's joints of each joint.

    `steps` are the engine's joints in the place of each joint type; without them the description travels as MJCF,
    with its refusals.
    """
    if steps is None:
        return _mjcf(model)
    static = static_bodies(model.joints)
    numbers = ("rotation", "translation", "damping", "stiffness", "rest", "rotors")
    return {
        "gravity": model.gravity.tolist(),
        "bodies": {b.name: {**_plain(b, "mass", "com", "inertia"), "static": b.name in static} for b in model.bodies},
        "joints": [
            {
                **_plain(joint, "name", "parent", "child", *numbers),
                "steps": [{**step, "type": _plain_type(step["type"])} for step in steps[joint.kind](joint)],
            }
            for joint in model.tree
        ],
    }, {joint.name: (joint.name,) for joint in model.joints}


def _plain(part: Joint | Body, *fields: str) -> dict[str, Any]:
    values = ((name, getattr(part, name)) for name in fields)
    return {name: x.tolist() if isinstance(x, np.ndarray) else x for name, x in values}


def _plain_type(kind: str) -> str:
    return "revolute" if kind == "continuous" else kind


def _mjcf(model: Model) -> tuple[dict[str, Any], dict[str, Sequence[str]]]:
    # The import loads MuJoCo.
    from mbkit.engines.mujoco.mjcf_writer import mjcf_text
    from mbkit.engines.mujoco.model import specified

    # `Dynamics` adds these to an engine's own terms, also what holds the weight of rotors.
    model = model.smooth.without("forces")
    model = replace(model, forces=(), bindings=tuple(b for b in model.bindings if b.where != "forces"))
    text = mjcf_text(model, "for another version")
    return {"text": text}, {name: tuple(own) for name, own in specified(model)[1].joints.items()}


class Places(NamedTuple):
    """Where the engine's numbers are in the description's full coordinates."""

    #: Entry i is full coordinate q_index[i]; the angles of a ball joint with roll, pitch and yaw mean nothing.
    q_index: np.ndarray
    v_index: np.ndarray
    #: Joints with velocities in other axes: the joint, its places in the engine's q and v.
    turning: tuple[tuple[Joint, list[int], list[int]], ...]


def places(
    convention: Convention, model: Model, names: Mapping[str, Sequence[str]], joints: Mapping[str, Any]
) -> Places:
    """Return the places of an engine's coordinates, from those of its joints, by name."""
    layout, turning = model.layout, []
    of_q, of_v = dict[int, int](), dict[int, int]()
    for joint in (j for j in model.joints if j.type.nv):
        own = [joints[name] for name in names[joint.name]]
        at_q, at_v = ([k for one in own for k in one[i]] for i in (0, 1))
        order_q: Sequence[int] = range(joint.type.nq)
        order_v: Sequence[int] = range(joint.type.nv)
        if joint.type.quaternion is not None:
            free = joint.type.nv > 3
            order_q = convention.free_q if free else convention.ball_q or (0,) * 3
            order_v = convention.free_v if free else order_v
            if joint.kind in convention.turned:
                turning.append((joint, at_q, at_v))
        of_q |= zip(at_q, (layout.full_q[joint.name].start + k for k in order_q), strict=True)
        of_v |= zip(at_v, (layout.full_v[joint.name].start + k for k in order_v), strict=True)
    q_index, v_index = (np.array([of[k] for k in range(len(of))], int) for of in (of_q, of_v))
    return Places(q_index, v_index, tuple(turning))
