"""The smallest part of a robot that still differs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from mbkit.model import Joint, Model

__all__ = ["part", "smallest"]


def part(model: Model, joints: set[str]) -> Model:
    """Return some joints of a fused description, with what they carry; what is above them stands still.

    A joint whose parent is left out stands in the world as it stands on its parent. Mimic joints follow
    only what is there.
    """
    kept = [j for j in model.joints if j.name in joints]
    bodies = {j.child for j in kept}
    made = [_grounded(j, bodies, joints) for j in kept]
    springs = [s for s in model.springs if {s.body_a, s.body_b} <= bodies | {"world"}]
    return replace(
        model,
        joints=tuple(made),
        bodies=tuple(b for b in model.bodies if b.name in bodies),
        springs=tuple(springs),
        couplings=tuple(c for c in model.couplings if set(c.joints) <= joints),
        loops=(),
        prescribed=(),
        frames=(),
        nonphysical=tuple(x for x in model.nonphysical if x[0] in bodies),
    )


def _grounded(joint: Joint, bodies: set[str], joints: set[str]) -> Joint:
    if joint.parent not in bodies and joint.parent != "world":
        joint = replace(joint, parent="world")
    if joint.mimic is not None and joint.mimic.joint not in joints:
        joint = replace(joint, mimic=None)
    return joint


def smallest(model: Model, differs: Callable[[set[str]], bool]) -> tuple[str, ...]:
    """Return the joints of the smallest part that still differs, found by taking joints away.

    Parameters
    ----------
    model : Model
        Fused.
    differs : callable
        Whether the part with these joints differs between the two sides.

    Returns
    -------
    tuple of str
        In the model's order; no joint can be left out of it. Empty where only the whole differs.
    """
    below: dict[str, set[str]] = {}
    for joint in reversed(model.tree):
        own = {joint.name}
        for child in model.joints:
            if child.parent == joint.child:
                own |= below[child.name]
        below[joint.name] = own
    # The smallest subtree, and then its branches one by one.
    for joints in sorted(below.values(), key=len):
        if differs(joints):
            left = set(joints)
            break
    else:
        return ()
    for joint in reversed(model.tree):
        # A branch can go when it does not matter; what is above it stays.
        without = left - below[joint.name]
        if joint.name in left and without and differs(without):
            left = without
    return tuple(j.name for j in model.joints if j.name in left)
