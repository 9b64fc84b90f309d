"""Joint stops: limits that act, as one-sided conditions on coordinates.

At its bound a coordinate q has an acceleration inwards of zero or more, and the stop pushes inwards or not at all
(Signorini's condition); a velocity outwards ends in an impact with Newton's restitution (Moreau 1988, Unilateral
contact and dry friction in finite freedom dynamics; Pfeiffer and Glocker 1996, Multibody Dynamics with Unilateral
Contacts, ch. 3 and 8). The bound of a joint that follows another by a ratio is one of its leader.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import EPS, Array
from mbkit.model.description import Description

#: Verbs of events.
HITS: Final = "hits"
RESTS: Final = "comes to rest on"
#: Distance from a bound, relative to it and in rad or m where it is smaller, that is rounding of a coordinate.
TOUCHING: Final = 64 * EPS


class StopLaw:
    """The stops of a description by its independent velocities.

    Attributes
    ----------
    bounds : (2, nv) array
        The lower and the upper bound of each velocity's coordinate, rad or m; infinite without a stop.
    restitution : (2, nv) array
    which : (nv,) array of bool
        The velocities with a stop.
    places : (nv,) array of int
        Those of the coordinates with stops in q.
    names : dict
        (0 or 1, velocity) -> the joint with this bound, and "lower" or "upper".
    room : (2, nv) array
        Distances that are rounding of a coordinate.
    """

    def __init__(self, model: Description) -> None:
        layout, nv = model.layout, model.layout.sizes[1]
        self.bounds = np.array([[-np.inf], [np.inf]]) + np.zeros(nv)
        self.restitution = np.zeros((2, nv))
        self.places = np.zeros(nv, dtype=np.intp)
        self.names: dict[tuple[int, int], tuple[str, str]] = {}
        for joint in model.joints:
            if (e := joint.restitution) is None:
                continue
            leader = joint.mimic.joint if joint.mimic else joint.name
            ratio, offset = (joint.mimic.ratio, joint.mimic.offset) if joint.mimic else (1.0, 0.0)
            for k in range(joint.type.nv if ratio else 0):
                i = layout.v[leader].start + k
                self.places[i] = layout.q[leader].start + k
                for side, bound in enumerate((joint.lower[k], joint.upper[k])):
                    # A negative ratio makes an upper bound of the leader of a lower one.
                    own = side if ratio > 0 else 1 - side
                    at = (bound - offset) / ratio
                    inner = at > self.bounds[0, i] if own == 0 else at < self.bounds[1, i]
                    if inner:
                        self.bounds[own, i], self.restitution[own, i] = at, e[k]
                        name = joint.name if joint.mimic else model.coordinate_names[self.places[i]]
                        self.names[own, i] = name, ("lower", "upper")[side]
        finite = np.isfinite(self.bounds)
        self.which: NDArray[np.bool_] = np.asarray(finite.any(axis=0))
        self.room = np.where(finite, TOUCHING * np.maximum(1.0, np.abs(self.bounds)), 0.0)
        self._any = bool(self.which.any())

    def __bool__(self) -> bool:
        return self._any

    def distance(self, q: Array) -> Array:
        """Return how far coordinates are inside of each stop, negative beyond: (..., 2, nv), infinite without one."""
        own = q[..., None, self.places]
        return np.asarray((own - self.bounds) * np.array([[1.0], [-1.0]]))

    def against(self, q: Array) -> Array:
        """Return 1 for velocities whose coordinate is at its lower stop, -1 at its upper one, else 0; (..., nv)."""
        if not self._any:
            return np.zeros((*q.shape[:-1], len(self.which)))
        low, high = np.moveaxis(self.distance(q) <= self.room, -2, 0)
        return np.asarray(low * 1.0 - high)

    def passed(self, q: Array) -> Array:
        """Return 1 for velocities whose coordinate is beyond its lower stop, -1 beyond its upper one; (..., nv)."""
        low, high = np.moveaxis(self.distance(q) < -self.room, -2, 0)
        return np.asarray(low * 1.0 - high)

    def clearance(self, q: Array, v: Array) -> Array:
        """Return the distance from the nearest stop, (..., nv): above zero by rounding where v leads inwards."""
        inwards = v[..., None, :] * np.array([[1.0], [-1.0]]) >= 0
        return np.asarray((self.distance(q) + np.where(inwards, 0.5 * self.room, 0.0)).min(axis=-2))

    def onto(self, q: Array, which: Any) -> Array:
        """Return configurations with `which` velocities' coordinates, (..., nv), at the nearest of their stops."""
        out, distance = q.copy(), np.abs(self.distance(q))
        nearest = np.where(distance[..., 0, :] <= distance[..., 1, :], self.bounds[0], self.bounds[1])
        for i in np.flatnonzero(self.which).tolist():
            out[..., self.places[i]] = np.where(which[..., i], nearest[..., i], q[..., self.places[i]])
        return out

    def restitution_at(self, against: Array) -> Array:
        """Return e of the stops that coordinates are at, (..., nv)."""
        return np.asarray(np.where(against > 0, self.restitution[0], self.restitution[1]))

    def event(self, i: int, side: float, does: str) -> str:
        """Return words such as "j1 hits its upper stop" for the stop that pushes a velocity to a side."""
        name, word = self.names[int(side < 0), i]
        return f"{name} {does} its {word} stop"

    def led_beyond(self, i: int, side: float) -> str:
        """Return why a run ends where rows alone move a velocity that its stop should hold."""
        return f"{self.event(i, side, 'is led beyond')} by constraints, which no impact can stop"

    def singular(self, i: int, side: float) -> str:
        """Return why a run ends at a stop where rows of constraints depend on each other."""
        return f"{self.event(i, side, 'reaches')} at a singular pose, where it is not known what the impact does"

    def beyond(self, q: Array) -> str:
        """Return which coordinates are beyond their stops, and by how much; empty where none is."""
        over = -self.distance(q.reshape(-1, q.shape[-1]))
        sentences = []
        for n, side, i in np.argwhere(over > self.room).tolist():
            name, word = self.names[side, i]
            of = f"trajectory {n}: " if q.ndim > 1 else ""
            amount, bound = float(over[n, side, i]), self.bounds[side, i]
            sentences.append(f"{of}{name} is {amount:.6g} beyond its {word} stop at {bound:.6g}")
        more = f", and {len(sentences) - 3} more" if len(sentences) > 3 else ""
        return "; ".join(sentences[:3]) + more


def stop_faults(model: Description) -> Iterator[str]:
    """Yield one sentence per fault of a description's stops."""
    bound = {b.part for b in model.bindings if b.where == "joints" and b.field in ("ratio", "offset")}
    faulty = False
    for joint in model.joints:
        if (e := joint.restitution) is None:
            continue
        item = f"joint {joint.name!r}"
        own = list(_faults(item, joint))
        if np.any((e < 0) | (e > 1)):
            own.append(f"{item}: restitution: expected numbers from 0 to 1, got {e}")
        if joint.mimic and joint.name in bound:
            own.append(f"{item}: stops, while it follows {joint.mimic.joint!r} by a parameter; give a number")
        faulty = faulty or bool(own)
        yield from own
    if faulty:
        return
    law = StopLaw(model)
    # Between stops that are touched at once nothing moves either.
    for i in np.flatnonzero(law.bounds[1] - law.bounds[0] <= law.room.sum(axis=0)).tolist():
        names = " and ".join(law.names[side, i][0] for side in (0, 1))
        yield f"stops of {names} leave {model.velocity_names[i]} no room; lock(...) holds a joint that nothing moves"


def _faults(item: str, joint: Any) -> Iterator[str]:
    if not (joint.type.nv and joint.type.coordinate_velocities):
        yield f"{item}: stops on a {joint.kind} joint, which has no coordinate with such a rate; leave stops out"
    elif not np.isfinite([joint.lower, joint.upper]).any():
        yield f"{item}: stops without limits; give lower, upper or both"
    elif np.any(joint.lower == joint.upper):
        yield f"{item}: stops of zero width at {joint.lower}; lock(...) holds a joint that nothing moves"
