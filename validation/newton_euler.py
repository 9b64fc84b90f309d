"""Newton and Euler's equations in 45 digits: a witness for the derivation from energies.

It takes a description as plain data (see `validation.plain_model`), uses nothing of
mbkit, and shares no formula with it: bodies are balanced one by one with forces
and moments (Luh, Walker and Paul 1980; Featherstone 2008, ch. 5.3), in spatial vectors
(angular, linear) in body axes. A joint is a product of screws with massless
bodies between them: a universal joint two hinges, a spherical one three, a planar one
two slides and a hinge; only ball and free joints have more than one velocity,
constant in body axes.

What is read: an axis by its direction, a quaternion by its rotation, and a rotation
matrix as the rotation nearest to it; so that screws and placements are true ones to
45 digits, which their doubles are not. `Reading` has these numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import mpmath

DIGITS: Final = 45
mp: Final = mpmath.MPContext()
mp.dps = DIGITS

#: Kind -> its screws, in turn: ("hinge" | "slide", axis given by the joint or fixed).
_SCREWS: Final = {
    "fixed": (),
    "revolute": (("hinge", 0),),
    "continuous": (("hinge", 0),),
    "prismatic": (("slide", 0),),
    "helical": (("screw", 0),),
    "universal": (("hinge", 0), ("hinge", 1)),
    "spherical_zyx": (("hinge", (0, 0, 1)), ("hinge", (0, 1, 0)), ("hinge", (1, 0, 0))),
    "planar": (("slide", (1, 0, 0)), ("slide", (0, 1, 0)), ("hinge", (0, 0, 1))),
}


def vector(x: Any) -> Any:
    return mp.matrix([mp.mpf(c) for c in x])


def hat(w: Any) -> Any:
    return mp.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def unit(x: Any) -> Any:
    return x / mp.sqrt((x.T * x)[0])


def nearest_rotation(rows: Any) -> Any:
    """The orthogonal factor of the polar decomposition, by Newton's iteration (Higham 1986)."""
    R = mp.matrix(rows)
    for _ in range(8):
        R = (R + (R**-1).T) / 2
    return R


def turn(axis: Any, angle: Any) -> Any:
    K = hat(axis)
    return mp.eye(3) + mp.sin(angle) * K + (1 - mp.cos(angle)) * K * K


def rotation_of(quaternion: Any) -> Any:
    """x, y, z, w; Euler and Rodrigues' form, of the unit quaternion along it."""
    e = unit(vector(quaternion))
    K = hat(e[:3])
    return mp.eye(3) + 2 * e[3] * K + 2 * K * K


def stacked(a: Any, b: Any) -> Any:
    return mp.matrix([*a, *b])


def blocks(A: Any, B: Any, C: Any, D: Any) -> Any:
    out = mp.zeros(6)
    for i in range(3):
        for j in range(3):
            out[i, j], out[i, j + 3], out[i + 3, j], out[i + 3, j + 3] = A[i, j], B[i, j], C[i, j], D[i, j]
    return out


def motion_transform(R: Any, p: Any) -> Any:
    """Motion vectors in the axes of a frame, from those of its parent, in which it is at (R, p)."""
    return blocks(R.T, mp.zeros(3), -R.T * hat(p), R.T)


def cross_motion(v: Any) -> Any:
    return blocks(hat(v[:3]), mp.zeros(3), hat(v[3:]), hat(v[:3]))


def spatial_inertia(mass: Any, com: Any, inertia: Any) -> Any:
    m, c, inner = mp.mpf(mass), hat(vector(com)), mp.matrix(inertia)
    return blocks((inner + inner.T) / 2 + m * c * c.T, m * c, m * c.T, m * mp.eye(3))


_OF_JOINT = ("armature", "damping", "stiffness", "rest", "friction")


@dataclass
class Link:
    """A body, or a massless one between the screws of a joint, and how it moves on its parent.

    `subspace` has the velocities' motions as columns, constant in the link's axes;
    `sources` say of each which entry of v it is and times what.
    """

    name: str
    parent: int
    rotation: Any
    translation: Any
    kind: str
    axis: Any
    pitch: Any
    coordinates: list[tuple[int, Any, Any]]
    sources: list[tuple[int, Any]]
    subspace: Any
    inertia: Any
    armature: list[Any] = field(default_factory=list)
    damping: list[Any] = field(default_factory=list)
    stiffness: list[Any] = field(default_factory=list)
    rest: list[Any] = field(default_factory=list)
    friction: list[Any] = field(default_factory=list)


class Reading:
    """A description as links, with its rotations and axes made exact.

    Attributes
    ----------
    rotations, axes : dict
        By joint: the rotation nearest to the one given, and the unit axes.
    """

    def __init__(self, description: dict[str, Any]) -> None:
        self.description = description
        self.gravity = vector(description["gravity"])
        self.rotations = {j["name"]: nearest_rotation(j["rotation"]) for j in description["joints"]}
        self.axes = {j["name"]: [unit(vector(a)) for a in j["axes"]] for j in description["joints"]}
        self.links: list[Link] = []
        self.of_body: dict[str, int] = {"world": -1}
        leaders = {j["name"]: j for j in description["joints"]}
        for joint in description["joints"]:
            self._add(joint, leaders)

    def _add(self, joint: dict[str, Any], leaders: dict[str, Any]) -> None:
        mimic, pitch = joint["mimic"], mp.mpf(joint["pitch"])
        ratio, offset = (mp.mpf(mimic["ratio"]), mp.mpf(mimic["offset"])) if mimic else (mp.mpf(1), mp.mpf(0))
        leader = leaders[mimic["joint"]] if mimic else joint
        body = self.description["bodies"][joint["child"]]
        inertia = spatial_inertia(body["mass"], body["com"], body["inertia"])
        parent = self.of_body[joint["parent"]]
        place = self.rotations[joint["name"]], vector(joint["translation"])
        if joint["kind"] in ("ball", "free"):
            n = 3 if joint["kind"] == "ball" else 6
            # v is angular of a ball joint, linear then angular of a free one.
            order = [0, 1, 2] if n == 3 else [3, 4, 5, 0, 1, 2]
            subspace = mp.zeros(6, n)
            for column, row in enumerate(order):
                subspace[row, column] = 1
            q = [(joint["q"] + i, mp.mpf(1), mp.mpf(0)) for i in range(4 if n == 3 else 7)]
            v = [(joint["v"] + i, mp.mpf(1)) for i in range(n)]
            own = {k: [mp.mpf(x) for x in joint[k]] for k in _OF_JOINT}
            link = Link(joint["name"], parent, *place, joint["kind"], None, pitch, q, v, subspace, inertia, **own)
            self.links.append(link)
        screws = _SCREWS.get(joint["kind"], ()) if joint["kind"] not in ("ball", "free") else None
        if screws == ():
            self.links.append(
                Link(joint["name"], parent, *place, "fixed", None, pitch, [], [], mp.zeros(6, 0), inertia)
            )
        for i, (kind, axis) in enumerate(screws or ()):
            a = self.axes[joint["name"]][axis] if isinstance(axis, int) else vector(axis)
            none = mp.zeros(3, 1)
            motion = {"hinge": stacked(a, none), "slide": stacked(none, a), "screw": stacked(a, pitch * a)}[kind]
            own = {k: [mp.mpf(joint[k][i])] for k in _OF_JOINT}
            q = [(leader["q"] + i, ratio, offset)]
            v = [(leader["v"] + i, ratio)]
            last = i == len(screws) - 1
            mass = inertia if last else mp.zeros(6)
            self.links.append(Link(joint["name"], parent, *place, kind, a, pitch, q, v, motion, mass, **own))
            parent, place = len(self.links) - 1, (mp.eye(3), none)
        self.of_body[joint["child"]] = len(self.links) - 1

    def placement(self, link: Link, q: Any) -> tuple[Any, Any]:
        """The link in its parent: R and p."""
        x = [ratio * mp.mpf(q[i]) + offset for i, ratio, offset in link.coordinates]
        none = mp.zeros(3, 1)
        R, p = {
            "fixed": lambda: (mp.eye(3), none),
            "hinge": lambda: (turn(link.axis, x[0]), none),
            "slide": lambda: (mp.eye(3), x[0] * link.axis),
            "screw": lambda: (turn(link.axis, x[0]), link.pitch * x[0] * link.axis),
            "ball": lambda: (rotation_of(x), none),
            "free": lambda: (rotation_of(x[3:]), vector(x[:3])),
        }[link.kind]()
        return link.rotation * R, link.translation + link.rotation * p


def inverse_dynamics(
    reading: Reading, q: Any, v: Any, a: Any, *, gravity: bool = True, passive: bool = True, inertial: bool = True
) -> Any:
    """M a + C v + g - τ_passive, or some of it: `inertial` is M a + C v."""
    links, n = reading.links, reading.description["nv"]
    transforms, _, _, forces, poses = _balance(reading, q, v, a, gravity=gravity, inertial=inertial)
    if passive:
        _pull(reading, q, v, poses, forces)
    tau = mp.zeros(n, 1)
    for k in reversed(range(len(links))):
        link = links[k]
        if link.sources:
            push = link.subspace.T * forces[k]
            for i, (entry, ratio) in enumerate(link.sources):
                own = link.armature[i] * ratio * mp.mpf(a[entry]) if inertial else mp.mpf(0)
                if passive:
                    rate = ratio * mp.mpf(v[entry])
                    own += link.damping[i] * rate + link.friction[i] * mp.sign(rate)
                    if link.stiffness[i]:
                        where, scale, offset = link.coordinates[i]
                        own += link.stiffness[i] * (scale * mp.mpf(q[where]) + offset - link.rest[i])
                tau[entry] += ratio * (push[i] + own)
        if link.parent >= 0:
            forces[link.parent] += transforms[k].T * forces[k]
    return tau


def bodies(reading: Reading, q: Any, v: Any, a: Any, wrenches: Any = None) -> dict[str, Any]:
    """Motion and load of each body: R and p in the world, and six-vectors (linear, angular) in its axes at its origin.

    They are twist, spatial acceleration, and the load of the joint that carries it (force, moment). `wrenches` act on
    bodies, in their axes at their origins.
    """
    transforms, velocities, _, forces, poses = _balance(reading, q, v, a)
    _, _, moved, _, _ = _balance(reading, q, v, a, gravity=False)
    _pull(reading, q, v, poses, forces)
    for body, wrench in (wrenches or {}).items():
        forces[reading.of_body[body]] -= stacked(vector(wrench[3:]), vector(wrench[:3]))
    for k in reversed(range(len(forces))):
        if reading.links[k].parent >= 0:
            forces[reading.links[k].parent] += transforms[k].T * forces[k]
    out = {}
    for body, k in reading.of_body.items():
        if k >= 0:
            turned = [stacked(x[3:], x[:3]) for x in (velocities[k], moved[k], forces[k])]
            out[body] = (*poses[k], *turned)
    return out


def _balance(
    reading: Reading, q: Any, v: Any, a: Any, *, gravity: bool = True, inertial: bool = True
) -> tuple[list[Any], list[Any], list[Any], list[Any], list[Any]]:
    """Transforms, velocities, accelerations, the force that each link needs, and poses."""
    transforms, velocities, accelerations, forces, poses = [], [], [], [], []
    base = stacked(mp.zeros(3, 1), -reading.gravity if gravity else mp.zeros(3, 1))
    for link in reading.links:
        R, p = reading.placement(link, q)
        X = motion_transform(R, p)
        rates = mp.matrix([ratio * mp.mpf(v[i]) for i, ratio in link.sources] or [0])
        second = mp.matrix([ratio * mp.mpf(a[i]) for i, ratio in link.sources] or [0])
        moves = bool(link.sources) and inertial
        own = link.subspace * rates if moves else mp.zeros(6, 1)
        above = velocities[link.parent] if link.parent >= 0 else mp.zeros(6, 1)
        pushed = accelerations[link.parent] if link.parent >= 0 else base
        velocity = X * above + own
        acceleration = X * pushed + cross_motion(velocity) * own
        if moves:
            acceleration += link.subspace * second
        momentum = link.inertia * velocity
        R0, p0 = poses[link.parent] if link.parent >= 0 else (mp.eye(3), mp.zeros(3, 1))
        poses.append((R0 * R, p0 + R0 * p))
        transforms.append(X)
        velocities.append(velocity)
        accelerations.append(acceleration)
        forces.append(link.inertia * acceleration - cross_motion(velocity).T * momentum)
    return transforms, velocities, accelerations, forces, poses


def _pull(reading: Reading, q: Any, v: Any, poses: Any, forces: Any) -> None:
    """Take the pull of point springs and dampers off the bodies' forces."""
    springs = reading.description["springs"]
    if not springs:
        return
    velocities = _velocities(reading, q, v)
    for spring in springs:
        ends = []
        for side in ("a", "b"):
            k, point = reading.of_body[spring[f"body_{side}"]], vector(spring[f"point_{side}"])
            if k < 0:
                ends.append((k, point, point, mp.zeros(3, 1)))
                continue
            R, p = poses[k]
            speed = R * (velocities[k][3:] + hat(velocities[k][:3]) * point)
            ends.append((k, point, p + R * point, speed))
        gap, closing = ends[1][2] - ends[0][2], ends[1][3] - ends[0][3]
        length = mp.sqrt((gap.T * gap)[0])
        k, rest, c = (mp.mpf(spring[n]) for n in ("stiffness", "rest_length", "damping"))
        pull = (k * (length - rest) + c * (gap.T * closing)[0] / length) / length * gap
        for (body, point, _, _), sign in zip(ends, (1, -1), strict=True):
            if body >= 0:
                local = poses[body][0].T * (sign * pull)
                forces[body] -= stacked(hat(point) * local, local)


def _velocities(reading: Reading, q: Any, v: Any) -> list[Any]:
    out: list[Any] = []
    for link in reading.links:
        X = motion_transform(*reading.placement(link, q))
        velocity = X * (out[link.parent] if link.parent >= 0 else mp.zeros(6, 1))
        if link.sources:
            velocity += link.subspace * mp.matrix([ratio * mp.mpf(v[i]) for i, ratio in link.sources])
        out.append(velocity)
    return out


def nle(reading: Reading, q: Any, v: Any) -> Any:
    """C v + g."""
    return inverse_dynamics(reading, q, v, [0] * len(v), passive=False)


def mass_matrix(reading: Reading, q: Any) -> Any:
    """M, a column per unit acceleration from rest."""
    n = reading.description["nv"]
    M = mp.zeros(n)
    for j in range(n):
        column = inverse_dynamics(reading, q, [0] * n, [int(i == j) for i in range(n)], gravity=False, passive=False)
        for i in range(n):
            M[i, j] = column[i]
    return M
