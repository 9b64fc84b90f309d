"""An example of every kind of part and of every joint type, with its motion in NumPy alone.

Each is an arm with one such part, which has the name "x", or moves joint "j0". The truth is `tests.plain_mechanics` on
coordinates of its own: a joint of several velocities is a stack of hinges and slides without mass, and a quaternion
three angles. `tests.test_matrix` and `tests.kind_paths` share the examples.
"""

# ruff: noqa: ARG001, ARG005  # all parts are called alike
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
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
                out.append(x[k : k + _size(type_)])
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


def _size(type_: str) -> int:
    return len(_STACKS[type_]) if type_ != "fixed" else 0


class Arm:
    """Joints and bodies told twice: to a builder, and to the plain case."""

    def __init__(self, name: str, *, gravity: bool = False) -> None:
        weight = GRAVITY if gravity else 0 * GRAVITY
        self.builder = mb.ModelBuilder(name.replace(".", "_").replace(" ", "_"), gravity=weight)
        none: list[Any] = []
        empty = np.zeros((0, 3))
        self.case = Case(
            0, [], empty, [], empty, np.zeros(0), empty, [], none, np.zeros(0), np.zeros(0), np.zeros(0), TIME,
            np.zeros((0, 0)), np.zeros(0), [], {}, weight,
        )  # fmt: skip
        self.name, self.last = name, {"world": -1}
        self.joints: list[tuple[str, str, int]] = []

    def add(
        self, joint: str, type_: str, parent: str, body: str, *, axes: tuple[Any, ...] = (_Y,), place: Any = (0, 0, 0),
        R: np.ndarray | None = None, mass: float = 1.0, com: Any = (0.1, 0, -0.3), inertia: Any = (0.1, 0.12, 0.05),
        pitch: float = 0.0, mimic: tuple[str, float, float] | None = None, **numbers: Any,
    ) -> None:  # fmt: skip
        c, stack = self.case, _STACKS[type_]
        n, links, at = c.n, len(c.kinds), self.last[parent]
        where = {"rotation": np.eye(3) if R is None else R, "translation": place}
        one, two = (axes[0], axes[1]) if type_ == "universal" else (axes[0], None)
        named = type_ in ("revolute", "continuous", "prismatic", "helical", "universal")
        more = ({"axis": one} | ({"axis2": two} if two is not None else {})) if named else {}
        more |= {"pitch": pitch} if pitch else {}
        more |= {"mimic": mimic} if mimic else {}
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
        self.last[body] = at
        rows = np.zeros((len(stack), n))
        if mimic:
            rows[0, int(mimic[0][1:])] = mimic[1]
        free = 0 if mimic or type_ == "fixed" else len(stack)
        c.G = np.block([[c.G, np.zeros((links, free))], [rows, np.eye(len(stack), free)]])
        c.c = np.append(c.c, np.array([mimic[2]]) if mimic else np.zeros(len(stack)))
        k = np.arange(n, n + free)
        c.q, c.v = np.append(c.q, 0.25 - 0.1 * (k % 5)), np.append(c.v, np.where(k % 2, -0.4, 0.5) + 0.07 * k)
        if free:
            self.joints.append((joint, type_, n))

    def index(self, joint: str) -> int:
        return next(k for name, _, k in self.joints if name == joint)

    def with_part(self, part: Part) -> None:
        self.case.parts.append(part)

    def built(self, words: tuple[str, ...] = ()) -> Example:
        for part in self.case.parts:
            part.declare(self.builder)
        c = self.case
        c.v = c.allowed(c.t, c.q, c.v)
        model = self.builder.build()
        assert list(model.joint_names) == [j for j, *_ in self.joints]
        tau = 0.3 - 0.2 * (np.arange(c.n) % 4)
        return Example(self.name, model, c, self.joints, tau, {b: k for b, k in self.last.items() if k >= 0}, words)

    # Parts of the plain case

    def pose(self, body: str, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (np.eye(3), np.zeros(3)) if body == "world" else self.case.poses(x)[self.last[body]]

    def moving(self, body: str, at: Any, x: np.ndarray) -> np.ndarray:
        return self.case.moving(self.last[body], at, x)


def arm(name: str, hinges: int = 3, *, gravity: bool = False) -> Arm:
    out = Arm(name, gravity=gravity)
    for k in range(hinges):
        axis = (0.6, 0, 0.8) if k % 3 == 1 else (0, 1, 0)
        parent = f"b{k - 1}" if k else "world"
        out.add(f"j{k}", "revolute", parent, f"b{k}", axes=(axis,), place=(0, 0.1, -0.5), mass=1.0 + k)
    return out


# Parts of joints


def with_joint(type_: str = "revolute", **numbers: Any) -> Callable[[str], Example]:
    """Return the maker of an arm whose last joint, "x", has numbers."""

    def make(name: str) -> Example:
        a = arm(name)
        place = {"mass": 0.7, "com": (0.1, 0.2, -0.1), "inertia": (0.1, 0.2, 0.25), "axes": ((0, 0.6, 0.8),)}
        a.add("x", type_, "b2", "x", **place, **numbers)
        a.with_part(of_joint(a, type_, **numbers))
        return a.built()

    return make


def of_joint(a: Arm, type_: str, **numbers: Any) -> Part:
    """Return what numbers of joint "x" do, on its velocities E ẋ."""
    if type_ == "fixed" or "mimic" in numbers:
        return Part("x", ())
    k, m = a.index("x"), _size(type_)

    def E(c: Case, x: np.ndarray) -> np.ndarray:
        out = np.zeros((m, c.n), dtype=x.dtype)
        out[:, k : k + m] = _body_rates(x[k : k + 3]) if type_ == "ball" else np.eye(m)
        return out

    def number(field: str) -> np.ndarray:
        return np.broadcast_to(np.asarray(numbers.get(field, 0.0), dtype=float), (m,))

    stiffness, rest, damping, f = (number(x) for x in ("stiffness", "rest", "damping", "friction"))
    s = number("stiction") if "stiction" in numbers else f

    def force(c: Case, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        v = E(c, x) @ u
        dry = f + (s - f) * np.exp(-((v / numbers.get("stribeck_velocity", 1.0)) ** 2))
        return -E(c, x).T @ (damping * v + dry * np.sign(v))

    return Part(
        "x", (), force=force,
        inertia=lambda c, x: E(c, x).T @ np.diag(number("armature")) @ E(c, x),
        energy=lambda c, x: np.sum(stiffness * (x[k : k + m] - rest) ** 2) / 2,
    )  # fmt: skip


def _mimic(name: str) -> Example:
    a = arm(name)
    a.add("x", "revolute", "b2", "x", axes=((0, 0.6, 0.8),), mimic=("j0", 0.7, 0.2))
    return a.built()


def _rotor(name: str) -> Example:
    """A body whose weight is held: its mass adds to T alone."""
    a = arm(name, gravity=True)
    a.builder.add_body("x", mass=0.3, inertia=0.3 * np.eye(3))
    a.builder.add_joint("to_x", "fixed", parent="b2", child="x")

    def inertia(c: Case, x: np.ndarray) -> np.ndarray:
        J, W = a.moving("b2", (0, 0, 0), x), c.turning(2, x)
        return 0.3 * (J.T @ J + W.T @ W)

    a.with_part(Part("x", (), lambda b: b.add_gravity_compensation("x", 1.0), inertia=inertia))
    return a.built()


def _compensation(without: tuple[str, ...] = ()) -> Callable[[str], Example]:
    def make(name: str) -> Example:
        a = arm(name, gravity=True)

        def energy(c: Case, x: np.ndarray) -> Any:
            return 0.8 * c.mass[2] * c.weight @ c.point("b2", c.com[2], x)

        def force(c: Case, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
            return -derivative(lambda y: energy(c, y), x) * [f"j{k}" not in without for k in range(3)]

        acting = {"force": force} if without else {"energy": energy}
        a.with_part(Part("x", (), lambda b: b.add_gravity_compensation("b2", 0.8, without=without), **acting))
        return a.built()

    return make


# Parts between bodies


def _spring(stiffness: float = 0.0, damping: float = 0.0) -> Callable[[str], Example]:
    def make(name: str) -> Example:
        a, there = arm(name), np.array([1.0, 2.0, 3.0])

        def length(c: Case, x: np.ndarray) -> Any:
            return norm(c.point("b2", (0.1, 0, 0.2), x) - there)

        def force(c: Case, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
            J = derivative(lambda y: length(c, y), x)
            return -damping * (J @ u) * J

        ends = {"body_a": "world", "point_a": there, "body_b": "b2", "point_b": (0.1, 0, 0.2)}
        numbers = {"stiffness": stiffness, "rest_length": 0.5 if stiffness else 0.0, "damping": damping}
        a.with_part(
            Part(
                "x",
                (),
                lambda b: b.add_spring("x", **ends, **numbers),
                energy=lambda c, x: stiffness / 2 * (length(c, x) - 0.5) ** 2,
                force=force,
            )
        )
        return a.built()

    return make


def _coupling(**numbers: float) -> Callable[[str], Example]:
    def make(name: str) -> Example:
        a, row = arm(name), np.array([1.5, -0.5, 0.0])
        k, d, i = (numbers.get(x, 0.0) for x in ("stiffness", "damping", "armature"))
        a.with_part(
            Part(
                "x",
                (),
                lambda b: b.add_coupling("x", {"j0": 1.5, "j1": -0.5}, **numbers),
                energy=lambda c, x: k / 2 * (row @ x) ** 2,
                inertia=lambda c, x: i * np.outer(row, row),
                force=lambda c, t, x, u: -d * (row @ u) * row,
            )
        )
        return a.built()

    return make


def _bushing(name: str) -> Example:
    a = arm(name)
    k, d = np.arange(1.0, 7.0), 0.1 * np.arange(1.0, 7.0)
    R_0, p_0 = a.pose("b2", a.case.q)
    R_A, p_A = R_0 @ rotation(np.array([0.6, 0.0, 0.8]), 0.7), p_0 + np.array([0.1, -0.2, 0.1])

    def displaced(c: Case, x: np.ndarray) -> np.ndarray:
        R, p = c.poses(x)[2]
        B = R_A.T @ R
        angle = np.arccos((np.trace(B) - 1) / 2)
        turn = np.array([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]])
        return np.concatenate([R_A.T @ (p - p_A), turn * angle / (2 * np.sin(angle))])

    def force(c: Case, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        J = derivative(lambda y: displaced(c, y), x)
        return -J.T @ (d * (J @ u))

    ends = {"body_a": "world", "rotation_a": R_A, "translation_a": p_A, "body_b": "b2"}
    a.with_part(
        Part(
            "x",
            (),
            lambda b: b.add_bushing("x", **ends, stiffness=k, damping=d),
            energy=lambda c, x: np.sum(k * displaced(c, x) ** 2) / 2,
            force=force,
        )
    )
    return a.built()


def _frame_force(name: str) -> Example:
    a, F = arm(name), np.array([1.0, 2.0, 3.0])

    def force(c: Case, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        R, _ = c.poses(x)[2]
        return c.moving(2, (0, 0, 0), x).T @ R @ F

    a.with_part(Part("x", (), lambda b: b.add_force("x", "b2", force=F), force=force))
    return a.built()


def _joint_force(name: str) -> Example:
    a = arm(name)
    unit = np.eye(3)[0]
    a.with_part(
        Part(
            "x",
            (),
            lambda b: b.add_joint_force("x", "j0", lambda t, q, v: -(q**3) - v, potential=lambda q: q**4),
            energy=lambda c, x: x[0] ** 4,
            force=lambda c, t, x, u: (-(x[0] ** 3) - u[0]) * unit,
        )
    )
    return a.built()


def _force_of_time(name: str) -> Example:
    a = arm(name)
    a.with_part(
        Part(
            "x",
            (),
            lambda b: b.add_joint_force("x", "j0", lambda t, q, v: 2 * ca.cos(3 * t)),
            force=lambda c, t, x, u: 2 * np.cos(3 * t) * np.eye(3)[0],
        )
    )
    return a.built()


# Rows


def _loop(kind: str) -> Callable[[str], Example]:
    def make(name: str) -> Example:
        rng, n = np.random.default_rng(5), LOOPS[kind] + 1
        a = Arm(name)
        for k in range(n):
            axis = rng.standard_normal(3)
            type_ = ("revolute", "prismatic")[k % 2]
            numbers = {"place": rng.uniform(-0.5, 0.5, 3), "R": rotation(_X, rng.uniform(-1, 1)), "mass": 1.0 + 0.2 * k}
            axes = (axis / np.linalg.norm(axis),)
            a.add(f"j{k}", type_, f"b{k - 1}" if k else "world", f"b{k}", axes=axes, **numbers)
        a.with_part(loop_part(a.case, rng, kind, "x"))
        return a.built()

    return make


def _coupler(leaders: tuple[int, ...], ratio: Any, curve: float = 0.0) -> Callable[[str], Example]:
    def make(name: str) -> Example:
        a = arm(name)
        q, r = a.case.q, np.broadcast_to(ratio, len(leaders))
        free = [f"j{k}" for k in leaders]
        start = q[0] - r @ q[[*leaders]] - curve * q[leaders[0]] ** 2
        given = {"ratio": ratio, "offset": start, "curve": (curve, 0.0, 0.0)}
        a.with_part(
            Part(
                "x",
                (),
                lambda b: b.add_coupler("x", "j0", free if len(free) > 1 else free[0], **given),
                rows=lambda c, t, x: [x[0] - r @ x[[*leaders]] - curve * x[leaders[0]] ** 2 - start],
            )
        )
        return a.built()

    return make


def _moved(kind: str) -> Callable[[str], Example]:
    def make(name: str) -> Example:
        a = arm(name)
        start = a.case.q[0]
        table = CubicSpline([0.0, 1.0, 2.0], [start - 0.1, start + 0.4, start + 0.3], bc_type="natural")
        laws: dict[str, tuple[Callable[[Any], Any], Callable[[mb.ModelBuilder], None]]] = {
            "prescribed": (
                lambda t: start - 0.2 + t + 0.3 * np.sin(2 * t + 0.1),
                lambda b: b.prescribe("j0", offset=start - 0.2, rate=1.0, amplitude=0.3, frequency=2.0, phase=0.1),
            ),
            "formula": (lambda t: start - 0.05 + t**3, lambda b: b.prescribe("j0", lambda t: start - 0.05 + t**3)),
            "spline": (
                lambda t: table.c[:, 0] @ [t**3, t**2, t, 1.0],
                lambda b: b.prescribe("j0", ([0.0, 1.0, 2.0], table([0.0, 1.0, 2.0]))),
            ),
        }
        law, declare = laws[kind]
        a.case.q[0] = law(TIME)
        a.with_part(Part("x", (), declare, rows=lambda c, t, x: [x[0] - law(t)]))
        return a.built(("'j0'",))

    return make


def _no_slip(kind: str) -> Callable[[str], Example]:
    """A wheel, a ball or an edge at the end of an arm; the plane lies where its height is right."""

    def make(name: str) -> Example:
        a, radius, axis = arm(name, 3 if kind == "blade" else 5), 0.3, np.array([0.0, 0.6, 0.8])
        last = len(a.case.kinds) - 1
        body, n = f"b{last}", np.array([0.0, 0.0, 1.0])

        def contact(c: Case, x: np.ndarray) -> tuple[Any, np.ndarray]:
            """Return the height of the plane below the centre at contact, and the contact point from the centre."""
            wheel = c.poses(x)[last][0] @ axis
            lowest = n - (n @ wheel) * wheel
            if kind == "sphere":
                return radius, -radius * n
            return radius * norm(lowest), -radius * lowest / norm(lowest)

        centre = a.case.point(body, (0, 0, 0), a.case.q)
        floor = centre - contact(a.case, a.case.q)[0] * n

        def along(c: Case, x: np.ndarray) -> np.ndarray:
            J = c.moving(last, (0, 0, 0), x)
            if kind == "blade":
                return (c.poses(x)[last][0] @ axis)[None] @ J
            W, (_, r) = c.turning(last, x), contact(c, x)
            return (J + np.stack([np.cross(w, r) for w in W.T], axis=-1))[:2]

        def height(c: Case, t: Any, x: np.ndarray) -> list[Any]:
            return [n @ (c.point(body, (0, 0, 0), x) - floor) - contact(c, x)[0]]

        def declare(b: mb.ModelBuilder) -> None:
            if kind == "blade":
                b.add_blade("x", body_a=body, axis_a=axis, speed=0.1)
            else:
                more = {"axis_a": axis} if kind == "disc" else {}
                b.add_rolling("x", kind, body_a=body, radius=radius, translation_b=floor, **more)

        height_row = None if kind == "blade" else height
        speed = 0.1 if kind == "blade" else 0.0
        a.with_part(Part("x", (), declare, rows=height_row, speeds=along, speed=speed))
        return a.built()

    return make


# Joint types, and what no joint of one body is


def _of_type(type_: str) -> Callable[[str], Example]:
    """A joint of this type at the world, with a hinge behind it, under gravity."""

    def make(name: str) -> Example:
        a = Arm(name, gravity=True)
        axes = ((0, 0.6, 0.8), (1, 0, 0)) if type_ == "universal" else ((0, 0.6, 0.8),)
        more = {"pitch": 0.2} if type_ == "helical" else {}
        a.add("x", type_, "world", "b0", axes=axes, mass=1.3, place=(0.1, 0.2, 0.3), R=rotation(_X, 0.4), **more)
        a.add("j0", "revolute", "b0", "b1", axes=((0.8, 0, 0.6),), place=(0.2, -0.1, 0.3), mass=0.8)
        return a.built()

    return make


class _Beam(Case):
    """A hinge, and a beam of one shape √5 ξ² along y: closed form, with its shortening of second order."""

    EI, density, length = 3.0, 0.8, 1.0

    def places(self, q: np.ndarray, s: Any) -> np.ndarray:
        return np.array([s - 10 / 3 * s**3 * q[1] ** 2, np.sqrt(5) * s**2 * q[1], 0 * s * q[1]])

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        xi, w = np.polynomial.legendre.leggauss(12)
        M = np.zeros((2, 2), dtype=q.dtype)
        for s, weight in zip((xi + 1) / 2, w / 2, strict=True):
            x, y, _ = self.places(q, s)
            J = np.array([[-y, -20 / 3 * s**3 * q[1]], [x, np.sqrt(5) * s**2]])
            M = M + self.density * weight * J.T @ J
        # The hub, about its axis z, with its centre of mass at the axis.
        return M + np.diag([0.05, 0.0])

    def potential(self, q: np.ndarray) -> Any:
        xi, w = np.polynomial.legendre.leggauss(12)
        R, weight = rotation(_Z, q[0]), 0.0
        for s, part in zip((xi + 1) / 2, w / 2, strict=True):
            weight = weight - self.density * part * self.weight @ (R @ self.places(q, s))
        return weight + self.EI * 20 * q[1] ** 2 / 2


def _beam(name: str) -> Example:
    a = Arm(name, gravity=True)
    a.add("j0", "revolute", "world", "b0", axes=((0, 0, 1),), mass=0.5, com=(0, 0, 0))
    a.builder.add_beam(
        "x", parent="b0", length=1.0, stiffness=_Beam.EI, density=_Beam.density, shapes=[Polynomial([0.0, 0.0, 1.0])]
    )
    model = a.builder.build()
    c = _Beam(**{f: getattr(a.case, f) for f in a.case.__dataclass_fields__})
    c.q, c.v = np.array([0.4, 0.1]), np.array([0.7, -0.5])
    joints = [("j0", "revolute", 0), (model.joint_names[1], "revolute", 1)]
    return Example(name, model, c, joints, np.array([0.3, -0.2]), {}, ("beam", "'x'"))


class _Pendulum(Case):
    """The pendulum of `mbkit.lagrangian.systems`, with m = l = 1 and g = 9.81, from the downward vertical."""

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        return np.ones((1, 1), dtype=q.dtype)

    def potential(self, q: np.ndarray) -> Any:
        return -9.81 * np.cos(q[0])


def _energies(name: str) -> Example:
    a = arm(name, 1)
    c = _Pendulum(**{f: getattr(a.case, f) for f in a.case.__dataclass_fields__})
    return Example(
        name, mb.lagrangian.systems.pendulum().model, c, a.joints, np.array([0.3]), {}, ("bodies", "energies")
    )


def _written(part: str) -> Callable[[str], Example]:
    """Return the maker of an example's equations on paper, which have the same motion."""

    def make(name: str) -> Example:
        x = EXAMPLES[part](name)
        return replace(x, model=mb.lagrangian.from_model(x.model).model, words=("energies", "bodies"))

    return make


NUMBERS: dict[str, dict[str, float]] = {
    "armature": {"armature": 0.3},
    "spring": {"stiffness": 2.0, "rest": 0.3},
    "damping": {"damping": 0.4},
    "friction": {"friction": 0.2},
    "limit": {"lower": -3.0, "upper": 3.0},
    "velocity_limit": {"velocity_limit": 3.0},
    "effort_limit": {"effort_limit": 3.0},
}
EXAMPLES: dict[str, Callable[[str], Example]] = {
    "energies": _energies,
    "written.row": _written("loop.distance"),
    "written.speed": _written("no_slip.blade"),
    "written.t": _written("force.of_time"),
    "gravity": lambda name: arm(name, gravity=True).built(("gravity",)),
    "body.rotor": _rotor,
    "mimic": _mimic,
    **{f"joint.{name}": with_joint(**x) for name, x in NUMBERS.items()},
    **{f"joint.{n}.several": with_joint("planar", **{k: [y] * 3 for k, y in x.items()}) for n, x in NUMBERS.items()},
    "joint.armature.several": with_joint("ball", armature=0.3),
    "joint.damping.several": with_joint("ball", damping=0.4),
    "joint.stiction": with_joint(friction=0.2, stiction=0.4, stribeck_velocity=0.5),
    "point.spring": _spring(stiffness=3.0),
    "point.damper": _spring(damping=0.3),
    "coupling.spring": _coupling(stiffness=3.0),
    "coupling.damper": _coupling(damping=0.3),
    "coupling.armature": _coupling(armature=0.3),
    **{f"loop.{x}": _loop(x) for x in LOOPS},
    "coupler": _coupler((1,), 2.0),
    "coupler.curve": _coupler((1,), 1.0, 0.3),
    "coupler.several": _coupler((1, 2), (0.4, 0.7)),
    **{f"motion.{x}": _moved(x) for x in ("prescribed", "formula", "spline")},
    **{f"no_slip.{x}": _no_slip(x) for x in ("blade", "disc", "sphere")},
    "force.joint": _joint_force,
    "force.frame": _frame_force,
    "force.bushing": _bushing,
    "force.compensation": _compensation(),
    "force.compensation.partial": _compensation(("j0",)),
    "force.of_time": _force_of_time,
}
#: Joint types are kinds by themselves; those of beams have names of their numbers.
TYPES: dict[str, Callable[[str], Example]] = {
    **{f"joint_type.{x}": _of_type(x) for x in _STACKS},
    "joint_type.beam": _beam,
}


@cache
def example(name: str) -> Example:
    """Return the example of a kind of part or of a joint type."""
    return (EXAMPLES | TYPES)[name](name)
