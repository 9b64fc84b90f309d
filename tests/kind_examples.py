"""An example of every kind of part and of every joint type, with its motion in NumPy alone.

Each is an arm with one such part, which has the name "x", or moves joint "j0". The truth is `tests.plain_mechanics` on
coordinates of its own: a joint of several velocities is a stack of hinges and slides without mass, and a quaternion
three angles. `tests.test_matrix` and `tests.kind_paths` share the examples.
"""

# ruff: noqa: ARG001, ARG005  # all parts are called alike
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.polynomial import Polynomial
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import mbkit as mb
from mbkit.model import Model
from tests.plain_mechanics import GRAVITY, LOOPS, Case, Part, derivative, loop_part, norm, rotation

_STEP = 1e-30
_X, _Y, _Z = np.eye(3)
TIME = 0.37
#: Of each joint type, the kinds of its links, without masses but the last; their axes, if not the joint's own.
_STACKS: dict[str, tuple[tuple[str, Any], ...]] = {
    "fixed": (("fixed", 0 * _X),),
    "revolute": (("revolute", 0),),
    "continuous": (("revolute", 0),),
    "prismatic": (("prismatic", 0),),
    "helical": (("revolute", 0),),
    "universal": (("revolute", 0), ("revolute", 1)),
    "spherical_zyx": (("revolute", _Z), ("revolute", _Y), ("revolute", _X)),
    "ball": (("revolute", _Z), ("revolute", _Y), ("revolute", _X)),
    "planar": (("prismatic", _X), ("prismatic", _Y), ("revolute", _Z)),
    "free": (
        *(("prismatic", _X), ("prismatic", _Y), ("prismatic", _Z)),
        *(("revolute", _Z), ("revolute", _Y), ("revolute", _X)),
    ),
}
#: Axes of joint types with other ones than the first.
AXES: dict[str, tuple[Any, ...]] = {"": ((0, 0.6, 0.8),), "universal": ((0, 0.6, 0.8), (1, 0, 0))}


def _body_rates(q: np.ndarray) -> np.ndarray:
    """Return W with ω = W q̇ in the body's axes, for turns about z, y and x."""
    s1, c1, s2, c2 = np.sin(q[1]), np.cos(q[1]), np.sin(q[2]), np.cos(q[2])
    return np.array([[-s1, 0, 1], [c1 * s2, c2, 0], [c1 * c2, -s2, 0]])


def _zyx(q: np.ndarray) -> np.ndarray:
    return rotation(_Z, q[0]) @ rotation(_Y, q[1]) @ rotation(_X, q[2])


def _quaternion(q: np.ndarray) -> np.ndarray:
    out = np.array([0.0, 0, 0, 1])
    for axis, angle in zip((_Z, _Y, _X), q, strict=True):
        turn, w = np.sin(angle / 2) * axis, np.cos(angle / 2)
        u, s = out[:3], out[3]
        out = np.array([*(s * turn + w * u + np.cross(u, turn)), s * w - u @ turn])
    return out


@dataclass
class Example:
    """An arm with a part, a state that its constraints allow, and its truth on the coordinates x of `plain`."""

    name: str
    model: Model
    plain: Case
    #: Of each joint with coordinates its type, and where its coordinates begin among those of `plain`.
    joints: list[tuple[str, str, int]]
    tau: np.ndarray
    #: Link of each body.
    links: dict[str, int]
    #: What a refusal may call the part.
    words: tuple[str, ...] = ()

    @property
    def rows(self) -> bool:
        return any(p.rows or p.speeds for p in self.plain.parts)

    def rates(self, x: np.ndarray) -> np.ndarray:
        """Return E with v = E ẋ."""
        E = np.eye(len(x), dtype=x.dtype)
        for _, type_, k in self.joints:
            if type_ == "ball":
                E[k : k + 3, k : k + 3] = _body_rates(x[k : k + 3])
            if type_ == "free":
                E[k : k + 3, k : k + 3] = _zyx(x[k + 3 : k + 6]).T
                E[k + 3 : k + 6, k + 3 : k + 6] = _body_rates(x[k + 3 : k + 6])
        return E

    def position(self, x: np.ndarray) -> np.ndarray:
        """Return the model's q."""
        out = []
        for _, type_, k in self.joints:
            if type_ == "ball":
                out.append(_quaternion(x[k : k + 3]))
            elif type_ == "free":
                out += [x[k : k + 3], _quaternion(x[k + 3 : k + 6])]
            else:
                out.append(x[k : k + size_of(type_)])
        return np.concatenate(out)

    @property
    def t(self) -> float:
        return self.plain.t

    @property
    def q(self) -> np.ndarray:
        return self.position(self.plain.q)

    @property
    def v(self) -> np.ndarray:
        return self.rates(self.plain.q) @ self.plain.v

    def acceleration(self, t: float, x: np.ndarray, u: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return v̇ at x and ẋ = u, under the model's generalized force."""
        E = self.rates(x)
        turning = np.imag(self.rates(x + 1j * _STEP * u)) / _STEP
        return E @ self.plain.acceleration(t, x, u, E.T @ tau) + turning @ u

    def mass_matrix(self, x: np.ndarray) -> np.ndarray:
        inverse = np.linalg.inv(self.rates(x))
        return inverse.T @ self.plain.mass_matrix(x) @ inverse

    def accelerated(self) -> np.ndarray:
        """Return v̇ at the example's state."""
        return self.acceleration(self.t, self.plain.q, self.plain.v, self.tau)

    def moved(self, dx: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return v̇ beside the state: at q ⊕ dx, with the same v or another one."""
        x = self.plain.q + np.linalg.solve(self.rates(self.plain.q), dx)
        return self.acceleration(self.t, x, np.linalg.solve(self.rates(x), v), tau)

    def force(self, a: np.ndarray, bodies: bool = False) -> np.ndarray:
        """Return τ that gives v̇ = a where no row holds; of the bodies alone, without what else acts."""
        c = replace(self.plain, parts=[]) if bodies else self.plain
        x, u, E = c.q, c.v, self.rates(c.q)
        turning = np.imag(self.rates(x + 1j * _STEP * u)) / _STEP
        dM = derivative(c.mass_matrix, x)
        h = np.einsum("ijk,j,k->i", dM, u, u) - np.einsum("jki,j,k->i", dM, u, u) / 2
        f = c.mass_matrix(x) @ np.linalg.solve(E, a - turning @ u) + h + derivative(c.potential, x)
        return np.linalg.solve(E.T, f - c.loads(c.t, x, u))

    def held(self) -> np.ndarray:
        """Return J of all rows on the model's velocities, (m, n)."""
        return self.plain.held(self.t, self.plain.q) @ np.linalg.inv(self.rates(self.plain.q))

    def beside(self, direction: np.ndarray, bent: np.ndarray, s: float) -> Example:
        """Return the example at a state that the rows allow to first order, s along two random directions."""
        c = self.plain
        rows = [p for p in c.parts if p.rows]
        J = derivative(lambda x: c.rows(c.t, x), c.q) if rows else np.zeros((0, c.n))
        x = c.q + s * (direction - np.linalg.pinv(J) @ (J @ direction))
        return replace(self, plain=replace(c, q=x, v=c.allowed(c.t, x, c.v + s * bent)))

    def flow(self, times: np.ndarray, load: Callable[..., Any] | None = None) -> np.ndarray:
        """Return x and ẋ at times after the start, (k, 2n), by SciPy; the force is the model's, load(t, q, v)."""
        n = self.plain.n

        def rate(t: float, y: np.ndarray) -> np.ndarray:
            x, u = y[:n], y[n:]
            E = self.rates(x)
            tau = self.tau if load is None else load(t, self.position(x), E @ u)
            return np.concatenate([u, self.plain.acceleration(t, x, u, E.T @ tau)])

        y = np.concatenate([self.plain.q, self.plain.v])
        ends = (self.t, self.t + times[-1])
        return solve_ivp(rate, ends, y, "DOP853", self.t + np.asarray(times), rtol=1e-11, atol=1e-12).y.T

    def state(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the model's q and v."""
        x, u = np.split(y, 2)
        return self.position(x), self.rates(x) @ u

    def motion(self, times: np.ndarray, load: Callable[..., Any] | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the model's q and v at times after the start."""
        q, v = zip(*map(self.state, self.flow(times, load)), strict=True)
        return np.array(q), np.array(v)

    @property
    def tip(self) -> str:
        """The last body."""
        return list(self.links)[-1]

    def jacobian(self, x: np.ndarray, body: str = "") -> np.ndarray:
        """Return the Jacobian of a body's frame in world axes on the model's velocities, (6, n): linear, angular."""
        k = self.links[body or self.tip]
        J = np.vstack([self.plain.moving(k, (0, 0, 0), x), self.plain.turning(k, x)])
        return J @ np.linalg.inv(self.rates(x))


def size_of(type_: str) -> int:
    return {"fixed": 0, "beam": 1}[type_] if type_ in ("fixed", "beam") else len(_STACKS[type_])


class Arm:
    """Joints and bodies told twice: to a builder, and to the plain case."""

    #: The lower bound of a stop that its joint is at.
    HERE = "here"

    def __init__(self, name: str, *, gravity: bool = False, rng: np.random.Generator | None = None) -> None:
        weight = GRAVITY if gravity else 0 * GRAVITY
        self.builder = mb.ModelBuilder(name.replace(".", "_").replace(" ", "_"), gravity=weight)
        none: list[Any] = []
        empty = np.zeros((0, 3))
        self.case = Case(
            0, [], empty, [], empty, np.zeros(0), empty, [], none, np.zeros(0), np.zeros(0), np.zeros(0), TIME,
            np.zeros((0, 0)), np.zeros(0), [], {}, weight,
        )  # fmt: skip
        self.name, self.last, self.rng = name, {"world": -1}, rng
        self.joints: list[tuple[str, str, int]] = []
        #: First link and type of each joint.
        self.link: dict[str, int] = {}
        self.types: dict[str, str] = {}

    def add(
        self, joint: str, type_: str, parent: str, body: str, *, axes: tuple[Any, ...] = (_Y,), place: Any = (0, 0, 0),
        R: np.ndarray | None = None, mass: float = 1.0, com: Any = (0.1, 0, -0.3), inertia: Any = (0.1, 0.12, 0.05),
        mimic: tuple[str, float, float] | None = None, **numbers: Any,
    ) -> None:  # fmt: skip
        c, stack = self.case, _STACKS[type_]
        n, links, at = c.n, len(c.kinds), self.last[parent]
        where = {"rotation": np.eye(3) if R is None else R, "translation": place}
        one, two = (axes[0], axes[1]) if type_ == "universal" else (axes[0], None)
        pitch = 0.2 if type_ == "helical" else 0.0
        named = type_ in ("revolute", "continuous", "prismatic", "helical", "universal")
        more = ({"axis": one} | ({"axis2": two} if two is not None else {})) if named else {}
        more |= {"pitch": pitch} if pitch else {}
        more |= {"mimic": mimic} if mimic else {}
        free = 0 if mimic or type_ == "fixed" else len(stack)
        k = np.arange(n, n + free)
        q = 0.25 - 0.1 * (k % 5) if self.rng is None else self.rng.uniform(-0.8, 0.8, free)
        rests = numbers.get("lower") == self.HERE
        numbers |= {"lower": float(q[0])} if rests else {}
        self.builder.add_body(body, mass=mass, com=com, inertia=inertia)
        self.builder.add_joint(joint, type_, parent=parent, child=body, **where, **more, **numbers)
        for i, (kind, axis) in enumerate(stack):
            own = axes[axis] if isinstance(axis, int) else axis
            c.parents.append(at)
            at = links + i
            first, final = i == 0, i == len(stack) - 1
            c.kinds.append(kind)
            c.axes = np.vstack([c.axes, np.asarray(own, dtype=float)])
            c.R.append(where["rotation"] if first else np.eye(3))
            c.p = np.vstack([c.p, np.asarray(place if first else (0, 0, 0), dtype=float)])
            c.mass = np.append(c.mass, mass if final else 0.0)
            c.com = np.vstack([c.com, np.asarray(com if final else (0, 0, 0), dtype=float)])
            c.I.append(np.diag(inertia) if final else np.zeros((3, 3)))
            if pitch:
                c.pitch[at] = pitch
        self.last[body], self.link[joint], self.types[joint] = at, links, type_
        rows, start = np.zeros((len(stack), n)), np.zeros(len(stack))
        if mimic:
            leader, ratio, offset = self.link[mimic[0]], *mimic[1:]
            rows[0], start[0] = ratio * c.G[leader], ratio * c.c[leader] + offset
        c.G = np.block([[c.G, np.zeros((links, free))], [rows, np.eye(len(stack), free)]])
        c.c = np.append(c.c, start)
        c.q, c.v = np.append(c.q, q), np.append(c.v, np.where(k % 2, -0.4, 0.5) + 0.07 * k)
        if free:
            self.joints.append((joint, type_, n))
        if numbers:
            part = of_joint(joint, type_, links, numbers)
            part.stops = ((links, 1.0, numbers["lower"]),) if rests else ()
            self.with_part(part)

    def next(self, type_: str, parent: str, **numbers: Any) -> str:
        """Add the joint and the body with the next number, and return the body's name."""
        k = len(self.link)
        self.add(f"j{k}", type_, parent, f"b{k}", **numbers)
        return f"b{k}"

    def hinge(self, k: int, parent: str) -> str:
        """Add the k-th hinge of a limb, and return its body."""
        axis = (0.6, 0, 0.8) if k % 3 == 1 else (0, 1, 0)
        return self.next("revolute", parent, axes=(axis,), place=(0, 0.1, -0.5), mass=1.0 + k)

    def with_part(self, part: Part) -> None:
        self.case.parts.append(part)

    def built(self, words: tuple[str, ...] = ()) -> Example:
        for part in self.case.parts:
            part.declare(self.builder)
        c = self.case
        c.v = c.allowed(c.t, c.q, c.v)
        model = self.builder.build()
        assert list(model.joint_names) == [j for j, *_ in self.joints], (model.joint_names, self.joints)
        tau = 0.3 - 0.2 * (np.arange(c.n) % 4)
        return Example(self.name, model, c, self.joints, tau, {b: k for b, k in self.last.items() if k >= 0}, words)

    # Parts of the plain case

    def pose(self, body: str, x: np.ndarray, c: Case | None = None) -> tuple[np.ndarray, np.ndarray]:
        return (np.eye(3), np.zeros(3)) if body == "world" else (c or self.case).poses(x)[self.last[body]]

    def point(self, body: str, at: Any, x: np.ndarray, c: Case | None = None) -> np.ndarray:
        R, p = self.pose(body, x, c)
        return p + R @ np.asarray(at)

    def moving(self, body: str, at: Any, x: np.ndarray) -> np.ndarray:
        return self.case.moving(self.last[body], at, x)


def arm(name: str, hinges: int = 3, *, gravity: bool = False) -> Arm:
    out, body = Arm(name, gravity=gravity), "world"
    for k in range(hinges):
        body = out.hinge(k, body)
    return out


# Parts of joints


def with_joint(type_: str = "revolute", **numbers: Any) -> Callable[[str], Example]:
    """Return the maker of an arm whose last joint, "x", has numbers."""

    def make(name: str) -> Example:
        a = arm(name)
        place = {"mass": 0.7, "com": (0.1, 0.2, -0.1), "inertia": (0.1, 0.2, 0.25), "axes": ((0, 0.6, 0.8),)}
        a.add("x", type_, "b2", "x", **place, **numbers)
        return a.built()

    return make


def _on_a_stop(name: str) -> Example:
    """An arm whose last joint rests on its lower stop, into which its load and the other velocities push it."""
    a = arm(name)
    place = {"mass": 0.7, "com": (-0.3, -0.2, -0.1), "inertia": (0.1, 0.2, 0.25), "axes": ((0, 0.6, 0.8),)}
    a.add("x", "revolute", "b2", "x", **place, lower=Arm.HERE, stops=True, restitution=0.3)
    a.case.v = np.abs(a.case.v)
    return a.built(("joint stops",))


def along(c: Case, x: np.ndarray, type_: str, link: int) -> np.ndarray:
    """Return E with v = E ẋ of the joint whose links begin there: a ball's and a free body's are in its axes."""
    E = c.G[link : link + size_of(type_)]
    at = np.flatnonzero(E[0])[0] if size_of(type_) else 0
    if type_ == "ball":
        return _body_rates(x[at : at + 3]) @ E
    if type_ == "free":
        return np.vstack([_zyx(x[at + 3 : at + 6]).T @ E[:3], _body_rates(x[at + 3 : at + 6]) @ E[3:]])
    return E


def of_joint(joint: str, type_: str, link: int, numbers: dict[str, Any]) -> Part:
    """Return what numbers of a joint do, on its velocities."""
    m = size_of(type_)

    def number(field: str) -> np.ndarray:
        return np.broadcast_to(np.asarray(numbers.get(field, 0.0), dtype=float), (m,))

    stiffness, rest, damping, f = (number(x) for x in ("stiffness", "rest", "damping", "friction"))
    s = number("stiction") if "stiction" in numbers else f

    def force(c: Case, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        E = along(c, x, type_, link)
        v = E @ u
        dry = f + (s - f) * np.exp(-((v / numbers.get("stribeck_velocity", 1.0)) ** 2))
        return -E.T @ (damping * v + dry * np.sign(v))

    def inertia(c: Case, x: np.ndarray) -> np.ndarray:
        E = along(c, x, type_, link)
        return E.T @ np.diag(number("armature")) @ E

    def energy(c: Case, x: np.ndarray) -> Any:
        return np.sum(stiffness * (c.G[link : link + m] @ x + c.c[link : link + m] - rest) ** 2) / 2

    acting = {"force": force} if np.any([damping, f, s]) else {}
    acting |= {"inertia": inertia} if np.any(number("armature")) else {}
    return Part(joint, (), **acting, **({"energy": energy} if np.any(stiffness) else {}))


@dataclass(frozen=True)
class Site:
    """Where a part of an arm stands: its name, a joint and others, and a body."""

    name: str = "x"
    joint: str = "j0"
    others: tuple[str, ...] = ("j1", "j2")
    body: str = "b2"


def alone(
    part: Callable[[Arm, Site], None], hinges: int = 3, *, gravity: bool = False, words: tuple[str, ...] = ()
) -> Callable[[str], Example]:
    """Return the maker of an arm with one part; without hinges the part begins at the world."""

    def make(name: str) -> Example:
        a = arm(name, hinges, gravity=gravity)
        part(a, Site() if hinges else Site(body="world"))
        return a.built(words)

    return make


def _mimic(a: Arm, at: Site) -> None:
    a.add(at.name, "revolute", at.body, at.name, axes=((0, 0.6, 0.8),), mimic=(at.joint, 0.7, 0.2))


def _rotor(a: Arm, at: Site) -> None:
    """A body whose weight is held: its mass adds to T alone."""
    a.builder.add_body(at.name, mass=0.3, inertia=0.3 * np.eye(3))
    a.builder.add_joint(f"to_{at.name}", "fixed", parent=at.body, child=at.name)

    def inertia(c: Case, x: np.ndarray) -> np.ndarray:
        J, W = c.moving(a.last[at.body], (0, 0, 0), x), c.turning(a.last[at.body], x)
        return 0.3 * (J.T @ J + W.T @ W)

    a.with_part(Part(at.name, (), lambda b: b.add_gravity_compensation(at.name, 1.0), inertia=inertia))


def _compensation(*, partial: bool = False) -> Callable[[Arm, Site], None]:
    def part(a: Arm, at: Site) -> None:
        k, without = a.last[at.body], (at.joint,) if partial else ()

        def energy(c: Case, x: np.ndarray) -> Any:
            return 0.8 * c.mass[k] * c.weight @ a.point(at.body, c.com[k], x, c)

        def force(c: Case, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
            out = -derivative(lambda y: energy(c, y), x)
            for joint, type_, i in a.joints:
                out[i : i + size_of(type_)] *= joint not in without
            return out

        acting = {"force": force} if partial else {"energy": energy}
        a.with_part(Part(at.name, (), lambda b: b.add_gravity_compensation(at.body, 0.8, without=without), **acting))

    return part


# Parts between bodies


def _spring(stiffness: float = 0.0, damping: float = 0.0) -> Callable[[Arm, Site], None]:
    def part(a: Arm, at: Site) -> None:
        there = np.array([1.0, 2.0, 3.0])

        def length(c: Case, x: np.ndarray) -> Any:
            return norm(a.point(at.body, (0.1, 0, 0.2), x, c) - there)

        def force(c: Case, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
            J = derivative(lambda y: length(c, y), x)
            return -damping * (J @ u) * J

        ends = {"body_a": "world", "point_a": there, "body_b": at.body, "point_b": (0.1, 0, 0.2)}
        numbers = {"stiffness": stiffness, "rest_length": 0.5 if stiffness else 0.0, "damping": damping}
        a.with_part(
            Part(
                at.name,
                (),
                lambda b: b.add_spring(at.name, **ends, **numbers),
                energy=lambda c, x: stiffness / 2 * (length(c, x) - 0.5) ** 2,
                force=force,
            )
        )

    return part


def _coupling(**numbers: float) -> Callable[[Arm, Site], None]:
    def part(a: Arm, at: Site) -> None:
        i, j = a.link[at.joint], a.link[at.others[0]]
        k, d, m = (numbers.get(x, 0.0) for x in ("stiffness", "damping", "armature"))

        def row(c: Case) -> np.ndarray:
            return 1.5 * c.G[i] - 0.5 * c.G[j]

        a.with_part(
            Part(
                at.name,
                (),
                lambda b: b.add_coupling(at.name, {at.joint: 1.5, at.others[0]: -0.5}, **numbers),
                energy=lambda c, x: k / 2 * (row(c) @ x + 1.5 * c.c[i] - 0.5 * c.c[j]) ** 2,
                inertia=lambda c, x: m * np.outer(row(c), row(c)),
                force=lambda c, t, x, u: -d * (row(c) @ u) * row(c),
            )
        )

    return part


def _bushing(a: Arm, at: Site) -> None:
    k, d = np.arange(1.0, 7.0), 0.1 * np.arange(1.0, 7.0)
    R_0, p_0 = a.pose(at.body, a.case.q)
    R_A, p_A = R_0 @ rotation(np.array([0.6, 0.0, 0.8]), 0.7), p_0 + np.array([0.1, -0.2, 0.1])

    def displaced(c: Case, x: np.ndarray) -> np.ndarray:
        R, p = a.pose(at.body, x, c)
        B = R_A.T @ R
        angle = np.arccos((np.trace(B) - 1) / 2)
        turn = np.array([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]])
        return np.concatenate([R_A.T @ (p - p_A), turn * angle / (2 * np.sin(angle))])

    def force(c: Case, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        J = derivative(lambda y: displaced(c, y), x)
        return -J.T @ (d * (J @ u))

    ends = {"body_a": "world", "rotation_a": R_A, "translation_a": p_A, "body_b": at.body}
    a.with_part(
        Part(
            at.name,
            (),
            lambda b: b.add_bushing(at.name, **ends, stiffness=k, damping=d),
            energy=lambda c, x: np.sum(k * displaced(c, x) ** 2) / 2,
            force=force,
        )
    )


def _frame_force(a: Arm, at: Site) -> None:
    F = np.array([1.0, 2.0, 3.0])

    def force(c: Case, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return c.moving(a.last[at.body], (0, 0, 0), x).T @ a.pose(at.body, x, c)[0] @ F

    a.with_part(Part(at.name, (), lambda b: b.add_force(at.name, at.body, force=F), force=force))


def _joint_force(a: Arm, at: Site) -> None:
    """A force -q³ - v and the potential q⁴; of a quaternion's joint the force -v."""
    k, type_ = a.link[at.joint], a.types[at.joint]
    m, turns = size_of(type_), type_ in ("ball", "free")
    q, v = ca.SX.sym("q", m), ca.SX.sym("v", m)

    def declare(b: mb.ModelBuilder) -> None:
        if m == 1:
            b.add_joint_force(at.name, at.joint, lambda t, q, v: -(q**3) - v, potential=lambda q: q**4)
        else:
            potential = {} if turns else {"potential": ca.sum1(q**4)}
            b.add_joint_force(at.name, at.joint, -v if turns else -(q**3) - v, **potential)

    def position(c: Case, x: np.ndarray) -> np.ndarray:
        return 0.0 if turns else c.G[k : k + m] @ x + c.c[k : k + m]

    def force(c: Case, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        E = along(c, x, type_, k)
        return -E.T @ (position(c, x) ** 3 + E @ u)

    a.with_part(Part(at.name, (), declare, energy=lambda c, x: np.sum(position(c, x) ** 4), force=force))


def _force_of_time(a: Arm, at: Site) -> None:
    k, type_ = a.link[at.joint], a.types[at.joint]
    m = size_of(type_)
    a.with_part(
        Part(
            at.name,
            (),
            lambda b: b.add_joint_force(at.name, at.joint, ca.vertcat(*[2 * ca.cos(3 * ca.SX.sym("t"))] * m)),
            force=lambda c, t, x, u: 2 * np.cos(3 * t) * along(c, x, type_, k).sum(axis=0),
        )
    )


# Rows


def _loop(kind: str) -> Callable[[Arm, Site], None]:
    """A limb that is closed at its end: what it hangs on stays free, and at the world one of its joints."""

    def part(a: Arm, at: Site) -> None:
        rng, parent = np.random.default_rng(5), at.body
        for k in range(LOOPS[kind] + (parent == "world")):
            axis = rng.standard_normal(3)
            type_ = ("revolute", "prismatic")[k % 2]
            numbers = {"place": rng.uniform(-0.5, 0.5, 3), "R": rotation(_X, rng.uniform(-1, 1)), "mass": 1.0 + 0.2 * k}
            parent = a.next(type_, parent, axes=(axis / np.linalg.norm(axis),), **numbers)
        a.with_part(loop_part(a.case, rng, kind, at.name, parent, a.last[parent]))

    return part


def _coupler(leaders: int, ratio: Any, curve: float = 0.0) -> Callable[[Arm, Site], None]:
    def part(a: Arm, at: Site) -> None:
        free, r = at.others[:leaders], np.broadcast_to(ratio, leaders)
        follower, led = a.link[at.joint], [a.link[x] for x in free]

        def apart(c: Case, x: np.ndarray) -> Any:
            y = c.G @ x + c.c
            return y[follower] - r @ y[led] - curve * y[led[0]] ** 2

        start = apart(a.case, a.case.q)
        given = {"ratio": ratio, "offset": start, "curve": (curve, 0.0, 0.0)}
        a.with_part(
            Part(
                at.name,
                (),
                lambda b: b.add_coupler(at.name, at.joint, free if len(free) > 1 else free[0], **given),
                rows=lambda c, t, x: [apart(c, x) - start],
            )
        )

    return part


def _moved(kind: str) -> Callable[[Arm, Site], None]:
    def part(a: Arm, at: Site) -> None:
        k, c = a.link[at.joint], a.case
        start = c.G[k] @ c.q + c.c[k]
        table = CubicSpline([0.0, 1.0, 2.0], [start - 0.1, start + 0.4, start + 0.3], bc_type="natural")
        laws: dict[str, tuple[Callable[[Any], Any], Callable[[mb.ModelBuilder], None]]] = {
            "prescribed": (
                lambda t: start - 0.2 + t + 0.3 * np.sin(2 * t + 0.1),
                lambda b: b.prescribe(at.joint, offset=start - 0.2, rate=1.0, amplitude=0.3, frequency=2.0, phase=0.1),
            ),
            "formula": (
                lambda t: start - 0.05 + t**3,
                lambda b: b.prescribe(at.joint, lambda t: start - 0.05 + t**3),
            ),
            "spline": (
                lambda t: table.c[:, 0] @ [t**3, t**2, t, 1.0],
                lambda b: b.prescribe(at.joint, ([0.0, 1.0, 2.0], table([0.0, 1.0, 2.0]))),
            ),
        }
        law, declare = laws[kind]
        c.q[c.G[k] == 1] = law(TIME)
        a.with_part(Part(at.name, (), declare, rows=lambda c, t, x: [c.G[k] @ x + c.c[k] - law(t)]))

    return part


def _no_slip(kind: str) -> Callable[[Arm, Site], None]:
    """A wheel, a ball or an edge at the end of a limb; the plane lies where its height is right."""

    def part(a: Arm, at: Site) -> None:
        radius, axis, body = 0.3, np.array([0.0, 0.6, 0.8]), at.body
        for k in range((1 if kind == "blade" else 3) + 2 * (body == "world")):
            body = a.hinge(k, body)
        last, n = a.last[body], np.array([0.0, 0.0, 1.0])

        def contact(c: Case, x: np.ndarray) -> tuple[Any, np.ndarray]:
            """Return the height of the plane below the centre at contact, and the contact point from the centre."""
            wheel = c.poses(x)[last][0] @ axis
            lowest = n - (n @ wheel) * wheel
            if kind == "sphere":
                return radius, -radius * n
            return radius * norm(lowest), -radius * lowest / norm(lowest)

        centre = a.point(body, (0, 0, 0), a.case.q)
        floor = centre - contact(a.case, a.case.q)[0] * n

        def along(c: Case, x: np.ndarray) -> np.ndarray:
            J = c.moving(last, (0, 0, 0), x)
            if kind == "blade":
                return (c.poses(x)[last][0] @ axis)[None] @ J
            W, (_, r) = c.turning(last, x), contact(c, x)
            return (J + np.stack([np.cross(w, r) for w in W.T], axis=-1))[:2]

        def height(c: Case, t: Any, x: np.ndarray) -> list[Any]:
            return [n @ (a.point(body, (0, 0, 0), x, c) - floor) - contact(c, x)[0]]

        def declare(b: mb.ModelBuilder) -> None:
            if kind == "blade":
                b.add_blade(at.name, body_a=body, axis_a=axis, speed=0.1)
            else:
                more = {"axis_a": axis} if kind == "disc" else {}
                b.add_rolling(at.name, kind, body_a=body, radius=radius, translation_b=floor, **more)

        height_row = None if kind == "blade" else height
        speed = 0.1 if kind == "blade" else 0.0
        a.with_part(Part(at.name, (), declare, rows=height_row, speeds=along, speed=speed))

    return part


# Joint types, and what no joint of one body is


def _of_type(type_: str) -> Callable[[str], Example]:
    """A joint of this type at the world, with a hinge behind it, under gravity."""

    def make(name: str) -> Example:
        a = Arm(name, gravity=True)
        a.add(
            "x",
            type_,
            "world",
            "b0",
            axes=AXES.get(type_, AXES[""]),
            mass=1.3,
            place=(0.1, 0.2, 0.3),
            R=rotation(_X, 0.4),
        )
        a.add("j0", "revolute", "b0", "b1", axes=((0.8, 0, 0.6),), place=(0.2, -0.1, 0.3), mass=0.8)
        return a.built()

    return make


def beam(a: Arm, at: Site) -> None:
    """A beam of one shape √5 ξ² along y: closed form, with its shortening of second order."""
    EI, density, k, n = 3.0, 0.8, a.last[at.body], a.case.n
    xi, weights = np.polynomial.legendre.leggauss(12)
    points = [*zip((xi + 1) / 2, density * weights / 2, strict=True)]
    c = a.case
    c.G, c.q, c.v = np.hstack([c.G, np.zeros((len(c.G), 1))]), np.append(c.q, 0.1), np.append(c.v, -0.5)
    a.joints.append((at.name, "beam", n))

    def places(x: np.ndarray, s: Any) -> np.ndarray:
        return np.array([s - 10 / 3 * s**3 * x[n] ** 2, np.sqrt(5) * s**2 * x[n], 0 * s * x[n]])

    def inertia(c: Case, x: np.ndarray) -> Any:
        M, (R, _) = np.zeros((c.n, c.n), dtype=x.dtype), c.poses(x)[k]
        for s, mass in points:
            J = c.moving(k, places(x, s), x)
            J[:, n] += R @ np.array([-20 / 3 * s**3 * x[n], np.sqrt(5) * s**2, 0.0])
            M = M + mass * J.T @ J
        return M

    def energy(c: Case, x: np.ndarray) -> Any:
        return 10 * EI * x[n] ** 2 - sum(mass * c.weight @ a.point(at.body, places(x, s), x, c) for s, mass in points)

    def declare(b: mb.ModelBuilder) -> None:
        shapes = [Polynomial([0.0, 0.0, 1.0])]
        b.add_beam(at.name, parent=at.body, length=1.0, stiffness=EI, density=density, shapes=shapes)

    a.with_part(Part(at.name, (), declare, energy=energy, inertia=inertia))


class _Pendulum(Case):
    """The pendulum of `mbkit.lagrangian.systems`, with m = l = 1 and g = 9.81, from the downward vertical."""

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        return np.ones((1, 1), dtype=q.dtype)

    def potential(self, q: np.ndarray) -> Any:
        return -9.81 * np.cos(q[0])

    def slope(self, q: np.ndarray) -> np.ndarray:
        return 9.81 * np.sin(q)


def _energies(name: str) -> Example:
    a = arm(name, 1)
    c = _Pendulum(**{f.name: getattr(a.case, f.name) for f in fields(Case) if f.init})
    return Example(
        name, mb.lagrangian.systems.pendulum().model, c, a.joints, np.array([0.3]), {}, ("bodies", "energies")
    )


class _Resting(_Pendulum):
    """It rests on a stop, into which all forces push it."""

    def acceleration(self, *_: Any, **__: Any) -> np.ndarray:
        return np.zeros(1)


def _stopped(name: str) -> Example:
    x = _energies(name)
    c = _Resting(**{f.name: getattr(x.plain, f.name) for f in fields(Case) if f.init} | {"v": np.zeros(1)})
    stops = {"stops": {"theta": (float(c.q[0]), None)}, "restitution": 0}
    form = mb.lagrangian.Lagrangian(**x.model.form._arguments() | stops)
    return replace(x, model=form.model, plain=c, words=(*x.words, "stops"))


def _written(part: str) -> Callable[[str], Example]:
    """Return the maker of an example's equations on paper, which have the same motion."""

    def make(name: str) -> Example:
        return on_paper(EXAMPLES[part](name))

    return make


def on_paper(x: Example) -> Example:
    return replace(x, model=mb.lagrangian.from_model(x.model).model, words=("energies", "bodies"))


NUMBERS: dict[str, dict[str, float]] = {
    "armature": {"armature": 0.3},
    "spring": {"stiffness": 2.0, "rest": 0.3},
    "damping": {"damping": 0.4},
    "friction": {"friction": 0.2},
    "limit": {"lower": -3.0, "upper": 3.0},
    "velocity_limit": {"velocity_limit": 3.0},
    "effort_limit": {"effort_limit": 3.0},
}
SEVERAL: dict[str, tuple[str, dict[str, Any]]] = {
    **{n: ("planar", {k: [y] * 3 for k, y in x.items()}) for n, x in NUMBERS.items()},
    "armature": ("ball", NUMBERS["armature"]),
    "damping": ("ball", NUMBERS["damping"]),
}
STICTION = {"friction": 0.2, "stiction": 0.4, "stribeck_velocity": 0.5}
#: Parts that stand on an arm, alone or with others, by kind; those with gravity hold weights.
PARTS: dict[str, Callable[[Arm, Site], None]] = {
    "mimic": _mimic,
    "point.spring": _spring(stiffness=3.0),
    "point.damper": _spring(damping=0.3),
    "coupling.spring": _coupling(stiffness=3.0),
    "coupling.damper": _coupling(damping=0.3),
    "coupling.armature": _coupling(armature=0.3),
    "coupler": _coupler(1, 2.0),
    "coupler.curve": _coupler(1, 1.0, 0.3),
    "coupler.several": _coupler(2, (0.4, 0.7)),
    **{f"motion.{x}": _moved(x) for x in ("prescribed", "formula", "spline")},
    "force.joint": _joint_force,
    "force.frame": _frame_force,
    "force.bushing": _bushing,
    "force.of_time": _force_of_time,
}
WEIGHTS: dict[str, Callable[[Arm, Site], None]] = {
    "body.rotor": _rotor,
    "force.compensation": _compensation(),
    "force.compensation.partial": _compensation(partial=True),
}
#: Parts with a limb of their own.
LIMBS: dict[str, Callable[[Arm, Site], None]] = {
    **{f"loop.{x}": _loop(x) for x in LOOPS},
    **{f"no_slip.{x}": _no_slip(x) for x in ("blade", "disc", "sphere")},
}
EXAMPLES: dict[str, Callable[[str], Example]] = {
    "energies": _energies,
    "written.row": _written("loop.distance"),
    "written.speed": _written("no_slip.blade"),
    "written.t": _written("force.of_time"),
    "written.stop": _stopped,
    "gravity": lambda name: arm(name, gravity=True).built(("gravity",)),
    **{f"joint.{name}": with_joint(**x) for name, x in NUMBERS.items()},
    **{f"joint.{name}.several": with_joint(type_, **x) for name, (type_, x) in SEVERAL.items()},
    "joint.stiction": with_joint(**STICTION),
    "joint.stop": _on_a_stop,
    **{k: alone(part, words=("'j0'",) if "motion" in k else ()) for k, part in PARTS.items()},
    **{k: alone(part, gravity=True) for k, part in WEIGHTS.items()},
    **{k: alone(part, 0) for k, part in LIMBS.items()},
}
#: Joint types are kinds by themselves; those of beams have names of their numbers.
TYPES: dict[str, Callable[[str], Example]] = {
    **{f"joint_type.{x}": _of_type(x) for x in _STACKS},
    "joint_type.beam": alone(lambda a, at: beam(a, replace(at, body="b0")), 1, gravity=True, words=("beam", "'x'")),
}
#: Examples of several kinds by name, of `tests.kind_pairs`.
TOGETHER: dict[str, Callable[[str], Example]] = {}


@cache
def example(name: str) -> Example:
    """Return the example of a kind of part, of a joint type, or of several."""
    return (EXAMPLES | TYPES | TOGETHER)[name](name)
