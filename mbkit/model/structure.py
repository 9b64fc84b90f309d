"""Faults in how the parts of a description hang together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence, Set
from typing import Final

import numpy as np

from mbkit.errors import Suggestions, nearest
from mbkit.model.parts import Body, Frame, Joint, JointCoupling, Loop, PointSpring, Prescribed

__all__ = ["structure_faults"]

# Up to so many names stand in a message.
_FEW: Final = 40
# M of so many velocities takes 200 MB.
_MOST_VELOCITIES: Final = 5000


def structure_faults(
    bodies: Sequence[Body],
    joints: Sequence[Joint],
    frames: Sequence[Frame],
    springs: Sequence[PointSpring],
    couplings: Sequence[JointCoupling],
    loops: Sequence[Loop],
    prescribed: Sequence[Prescribed],
) -> list[str]:
    """Return one sentence per fault: names, the tree, mimics, and what joints may carry."""
    known = {b.name for b in bodies} | {"world"}
    faults: list[str] = []
    if not bodies:
        faults.append("no bodies; add at least one")
    velocities = sum(j.type.nv for j in joints)
    if velocities > _MOST_VELOCITIES:
        faults.append(f"{velocities} velocities; up to {_MOST_VELOCITIES} are taken, because M takes their square")
    for what, names in (
        ("body", [b.name for b in bodies]),
        ("joint", [j.name for j in joints]),
        ("frame", [f.name for f in frames]),
        ("spring", [s.name for s in springs]),
        ("coupling", [c.name for c in couplings]),
        ("loop", [x.name for x in loops]),
    ):
        faults += [f"{what} {n!r}: declared {k} times; names must differ" for n, k in Counter(names).items() if k > 1]
    if any(f.name == "world" for f in frames):
        faults.append("frame 'world': that name is the ground's; choose another")
    if any(b.name == "world" for b in bodies):
        faults.append("body 'world': that name is the ground's; choose another")
    suggestions = Suggestions()
    bodily = known - {"world"}
    for joint in joints:
        faults += _unknown(f"joint {joint.name!r}", (joint.parent, joint.child), known, suggestions)
        faults += _joint_faults(joint)
    for frame in frames:
        faults += _unknown(f"frame {frame.name!r}", (frame.body,), bodily, suggestions)
    for spring in springs:
        faults += _unknown(f"spring {spring.name!r}", (spring.body_a, spring.body_b), known, suggestions)
        faults += [
            f"spring {spring.name!r}: {n} {getattr(spring, n):g} is negative"
            for n in ("stiffness", "rest_length", "damping")
            if getattr(spring, n) < 0
        ]
        if spring.body_a == spring.body_b:
            faults.append(f"spring {spring.name!r}: both ends on {spring.body_a!r}; it would never act")
    for coupling in couplings:
        faults += _coupling_faults(coupling, joints)
    for loop in loops:
        faults += _unknown(f"loop {loop.name!r}", (loop.body_a, loop.body_b), known, suggestions)
        if loop.body_a == loop.body_b:
            faults.append(f"loop {loop.name!r}: both ends on {loop.body_a!r}; it would close nothing")
    faults += _tree_faults(bodies, joints)
    faults += _mimic_faults(joints)
    one = {j.name for j in joints if j.type.nv == 1 and not j.mimic}
    there = ", ".join(sorted(one)) or "none"
    faults += [
        f"prescribed {p.joint!r}: expected a joint of one velocity that mimics none; there are: {there}"
        for p in prescribed
        if p.joint not in one
    ]
    moved = Counter(p.joint for p in prescribed)
    faults += [f"prescribed {n!r}: moved {k} times; give one motion" for n, k in moved.items() if k > 1]
    return faults


def _unknown(who: str, names: Iterable[str], known: Set[str], suggestions: Suggestions) -> list[str]:
    out = []
    for name in names:
        if name not in known:
            near = suggestions.near(name, known)
            few = f"; there are: {', '.join(sorted(known))}" if len(known) <= _FEW else "; declare it"
            out.append(f"{who}: unknown body {name!r}" + (f"; did you mean {near!r}?" if near else few))
    return out


def _joint_faults(joint: Joint) -> list[str]:
    who, out = f"joint {joint.name!r}", []
    if joint.child == "world":
        out.append(f"{who}: the world cannot be a child; swap parent and child")
    if np.any(joint.lower > joint.upper):
        out.append(f"{who}: lower limit {joint.lower} above upper limit {joint.upper}")
    signed = ("armature", "damping", "friction", "stiffness", "velocity_limit", "effort_limit")
    out += [f"{who}: {n} {getattr(joint, n)} is negative" for n in signed if np.any(getattr(joint, n) < 0)]
    if joint.type.quaternion is not None:
        turning = slice(joint.type.quaternion, None)
        if np.isfinite([joint.lower[turning], joint.upper[turning]]).any():
            out.append(f"{who}: limits on the quaternion of a {joint.kind} joint bound no angle; leave them infinite")
    if np.any(joint.armature) and joint.type.nv != 1:
        out.append(
            f"{who}: armature on a {joint.kind} joint; expected a joint of one velocity "
            "(engines leave out the gyroscopic term otherwise): add a rotor as a body"
        )
    if np.any(joint.stiffness) and not joint.type.coordinate_velocities:
        out.append(f"{who}: joint spring on a {joint.kind} joint, which has no angle to act on; use add_spring")
    if joint.pitch and joint.kind != "helical":
        out.append(f"{who}: pitch {joint.pitch} on a {joint.kind} joint; only helical joints have one")
    return out


def _coupling_faults(coupling: JointCoupling, joints: Sequence[Joint]) -> Iterator[str]:
    who, sizes = f"coupling {coupling.name!r}", {j.name: j.type.nv for j in joints}
    for name in coupling.joints:
        if name not in sizes:
            near = nearest(name, sizes)
            yield f"{who}: unknown joint {name!r}" + (f"; did you mean {near[0]!r}?" if near else "")
        elif sizes[name] != 1:
            yield f"{who}: expected joints of one velocity, joint {name!r} has {sizes[name]}"
    for n in ("stiffness", "damping", "armature"):
        if getattr(coupling, n) < 0:
            yield f"{who}: {n} {getattr(coupling, n):g} is negative"
    if not np.any(coupling.factors):
        yield f"{who}: no joint has a factor other than zero; it would never act"


def _tree_faults(bodies: Sequence[Body], joints: Sequence[Joint]) -> list[str]:
    out = []
    carriers: dict[str, list[Joint]] = {}
    carried: dict[str, list[Joint]] = {}
    for joint in joints:
        carriers.setdefault(joint.child, []).append(joint)
        carried.setdefault(joint.parent, []).append(joint)
    for name, several in carriers.items():
        if len(several) > 1 and name != "world":
            told = ", ".join(repr(j.name) for j in several)
            out.append(
                f"body {name!r}: carried by {len(several)} joints ({told}); keep one and close the loop with add_loop"
            )
    reached = {"world"}
    stack = ["world"]
    while stack:
        for joint in carried.get(stack.pop(), ()):
            if joint.child not in reached:
                reached.add(joint.child)
                stack.append(joint.child)
    for body in bodies:
        if body.name in reached:
            continue
        if body.name in carriers:
            out.append(f"body {body.name!r}: not connected to the world; its joints form a cycle or hang in the air")
        else:
            out.append(f"body {body.name!r}: no joint carries it; add a joint with child={body.name!r}")
    return out


def _mimic_faults(joints: Sequence[Joint]) -> list[str]:
    out = []
    by_name = {j.name: j for j in joints}
    suggestions = Suggestions()
    # Joints from which following the leaders ends.
    ends: set[str] = set()
    for joint in joints:
        if joint.mimic is None:
            continue
        who = f"joint {joint.name!r}"
        leader = by_name.get(joint.mimic.joint)
        if leader is None:
            near = suggestions.near(joint.mimic.joint, by_name)
            out.append(f"{who}: mimics unknown joint {joint.mimic.joint!r}" + (f"; near: {near!r}" if near else ""))
            continue
        if joint.type.nv != 1 or leader.type.nv != 1:
            out.append(f"{who}: mimics {leader.name!r}, but both must have one velocity")
        seen, at = {joint.name}, leader
        while at.name not in ends and at.mimic is not None and at.mimic.joint in by_name:
            if at.name in seen:
                out.append(f"{who}: mimics in a circle through {at.name!r}")
                break
            seen.add(at.name)
            at = by_name[at.mimic.joint]
        ends |= seen
    return out
