"""What each kind of cause means, for who meets it the first time."""

from __future__ import annotations

from typing import Final

__all__ = ["meaning"]

_MEANINGS: Final = {
    "actuator": "A motor or servo: its armature adds to M, and at zero control its gain and damping still act.",
    "added body": "It has matter where the other side has none.",
    "added joint": "It has a joint that the other side has not.",
    "armature": "A motor's inertia, seen through its gear: it adds to the diagonal of M.",
    "axis": "The joint turns or slides about another direction.",
    "axis sign": "Positive q goes the other way.",
    "base mass": "Matter that never moves, fused into the world: no term holds it while the base stands.",
    "centre of mass": "The matter is as heavy, and elsewhere.",
    "damping": "Viscous friction in the joint. It is in no term of M and nle.",
    "fluid": "The drag and lift of the medium in which the bodies move.",
    "friction": "Dry friction in the joint. It is in no term of M and nle.",
    "fused at the wrong place": "Links that are fixed to each other were made one body, and one was put elsewhere.",
    "fused with a rotated frame": "Links that are fixed to each other were made one body, and one was turned wrongly.",
    "gravity": "Another acceleration of gravity.",
    "gravity compensation": "A force that holds some of a body's weight.",
    "inertia": "The matter is as heavy, and resists turning otherwise.",
    "inertia about the wrong point": "The moments are about another point than the centre of mass.",
    "inertia axes": "The same principal moments, about other axes.",
    "inverse placement": "A frame's place in another was taken for the other's place in it.",
    "joint held still": "What moves on one side is fixed on the other, so q and v are not the same there.",
    "joint kind": "The joint moves in another way.",
    "joint order": "q and v name the same joints in another order; read them by name.",
    "joint origin": "The joint stands elsewhere in its parent.",
    "joint rotation": "The joint stands turned in its parent.",
    "limits": "Bounds of position, speed or effort. They are in no term of M and nle.",
    "lost body": "Matter is gone: with no joint of its own and little mass, an importer may take a link for empty.",
    "lost joint": "A joint is gone, with all that it carries, so q and v are not the same there.",
    "mass": "Another mass.",
    "mimic": "A joint that follows another has a coordinate of its own, or follows otherwise.",
    "names exchanged": "Joints are called by each other's names.",
    "own terms": "The engine computes other terms than the bodies and joints that were read out of it have.",
    "parent": "The joint hangs on another body.",
    "passive forces": "Springs and dampers were put where they do not belong, or left out.",
    "pitch": "How far a screw goes in a turn.",
    "products of inertia": "The off-diagonal moments have another sign, or are gone.",
    "quaternion order": "w, x, y, z was read for x, y, z, w, or the other way round.",
    "renamed": "The same joints are called otherwise.",
    "replaced inertia": "An inertia that no body can have was taken out, and a ball of water put in its place.",
    "rounding": "The numbers were written with few digits on the way.",
    "spring": "A spring in the joint. It is in no term of M and nle.",
    "tendon": "It couples joints: its armature adds to M, its spring and damper pull at them.",
    "unit of inertia": "The numbers are of another unit of inertia.",
    "unit of length": "The numbers are of another unit of length.",
    "unit of mass": "The numbers are of another unit of mass.",
    "unit of pitch": "Metres a radian, or a turn.",
    "velocity frame": "Velocities of a free body are in other axes.",
    "zero position": "q counts from another pose.",
}


def meaning(kind: str) -> str:
    """Return a sentence on a kind of cause; empty where its name says it all."""
    return _MEANINGS.get(kind, "")
