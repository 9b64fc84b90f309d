"""A description as Newton's builder takes it."""

from __future__ import annotations

import newton
import numpy as np
import warp as wp

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

#: Numbers of a joint with one velocity, as Newton calls them.
NUMBERS = {"rotors": "armature", "damping": "damping", "stiffness": "stiffness", "rest": "rest_q"}


def built(data: dict[str, Any]) -> Any:
    """Return the builder of a description, the joints of each of its joints, and its bodies."""
    builder = newton.ModelBuilder(gravity=tuple(data["gravity"]))
    bodies: dict[str, int] = {"world": -1}
    numbers: dict[str, list[Any]] = {}
    for joint in data["joints"]:
        parent, steps = bodies[joint["parent"]], joint["steps"] or [{"type": "fixed", "axes": []}]
        if steps[0]["type"] == "free" and parent >= 0:
            raise NotImplementedError(f"free joint {joint['name']!r} on a body; here it takes those on the world alone")
        turn = wp.quat_from_matrix(wp.mat33(np.array(joint["rotation"])))
        numbers[joint["name"]], at = [], wp.transform(joint["translation"], turn)
        for k, step in enumerate(steps):
            if k < len(steps) - 1:
                child = builder.add_link()
            else:
                child = bodies[joint["child"]] = _link(builder, joint["child"], data["bodies"][joint["child"]])
            own = {name: joint[name][k] for name in NUMBERS if step["type"] in ("revolute", "prismatic")}
            numbers[joint["name"]].append(_joint(builder, step, parent, child, at, own))
            parent, at = child, wp.transform()
    builder.add_articulation([*range(builder.joint_count)])
    return builder, numbers, bodies


def _link(builder: Any, name: str, body: dict[str, Any]) -> Any:
    inertia = wp.mat33(np.array(body["inertia"]))
    return builder.add_link(mass=body["mass"], com=tuple(body["com"]), inertia=inertia, label=name)


def _joint(builder: Any, step: dict[str, Any], parent: int, child: int, at: Any, own: dict[str, Any]) -> Any:
    kind = step["type"]
    if kind in ("revolute", "prismatic"):
        # Versions before 1.8 have no springs of joints.
        own = {NUMBERS[name]: value for name, value in own.items() if value and (name != "rest" or own["stiffness"])}
        own["axis"] = wp.vec3(step["axes"][0])
    if kind == "free":
        return builder.add_joint_free(child, parent=parent, parent_xform=at)
    return getattr(builder, "add_joint_" + kind)(parent, child, parent_xform=at, **own)
