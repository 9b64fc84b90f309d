"""Random chains with parts of every kind, and their equations in NumPy alone.

Each part says how it is declared to mbkit, and apart from that its energy, force, dissipation or rows in NumPy.
Derivatives are complex steps, exact to rounding; mbkit computes nothing here.
"""

# ruff: noqa: ARG001  # all parts and all paths are called alike
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import chain, combinations
from typing import Any

import numpy as np

import mbkit as mb

_STEP = 1e-30
#: Distance, velocity and force at a stop that are rounding.
_TOUCHING = 1e-9
GRAVITY = np.array([0.7, -0.4, -9.81])
#: Place of the frame `tip` on the last body, m.
TIP = (0.1, 0.2, 0.3)


def derivative(f: Callable[[np.ndarray], Any], x: np.ndarray) -> np.ndarray:
    """Return ∂f/∂x, with the axis of x last."""
    return np.stack([np.imag(f(x + 1j * _STEP * e)) / _STEP for e in np.eye(len(x))], axis=-1)


def skew(a: np.ndarray) -> np.ndarray:
    x, y, z = a
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def rotation(axis: np.ndarray, angle: Any) -> np.ndarray:
    K = skew(axis)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a × b along the last axis, in a tenth of `numpy.cross`'s time."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


def norm(x: np.ndarray) -> Any:
    return np.sqrt(np.sum(x * x))


def _turn(rng: np.random.Generator) -> np.ndarray:
    axis = rng.standard_normal(3)
    return rotation(axis / np.linalg.norm(axis), rng.uniform(-2, 2))


@dataclass
class Part:
    """A part of a case: how mbkit is told of it, and what it does."""

    kind: str
    words: tuple[str, ...]
    declare: Callable[[mb.ModelBuilder], None] = lambda _: None
    joint: dict[int, dict[str, Any]] = field(default_factory=dict)
    energy: Callable[..., Any] = lambda *_: 0.0  # of (case, q)
    inertia: Callable[..., Any] = lambda *_: 0.0  # of (case, q), (n, n)
    force: Callable[..., Any] = lambda *_: 0.0  # of (case, t, q, v), (n,)
    rows: Callable[..., list[Any]] | None = None  # of (case, t, q)
    #: Rows A of velocities alone, with A v = b, of (case, q); and b.
    speeds: Callable[..., np.ndarray] | None = None
    speed: float = 0.0
    #: Stops: the link, the side that it pushes to, and the bound of its full coordinate.
    stops: tuple[tuple[int, float, float], ...] = ()


@dataclass
class Case:
    """A chain or tree of joints of one velocity, its parts, and a state that its constraints allow."""

    seed: int
    kinds: list[str]
    axes: np.ndarray
    R: list[np.ndarray]
    p: np.ndarray
    mass: np.ndarray
    com: np.ndarray
    I: list[np.ndarray]
    parts: list[Part]
    q: np.ndarray
    v: np.ndarray
    tau: np.ndarray
    t: float
    #: Full coordinates are G q + c; a joint that mimics another has none.
    G: np.ndarray
    c: np.ndarray
    #: Link that each link hangs on, -1 for the world; empty for a chain.
    parents: list[int] = field(default_factory=list)
    #: Advance of each link that is a screw, m/rad.
    pitch: dict[int, float] = field(default_factory=dict)
    weight: np.ndarray = field(default_factory=lambda: GRAVITY)
    _at: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    #: What no coordinate changes, by the number of links.
    _fixed: dict[int, tuple[np.ndarray, ...]] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def n(self) -> int:
        return len(self.q)

    @property
    def words(self) -> tuple[str, ...]:
        return tuple(w for part in self.parts for w in part.words)

    def model(self, parts: list[Part] | None = None, kept: Callable[[Part], bool] = lambda _: True) -> mb.Model:
        parts = [x for x in (self.parts if parts is None else parts) if kept(x)]
        b = mb.ModelBuilder(f"case{self.seed}", gravity=GRAVITY)
        for k, kind in enumerate(self.kinds):
            b.add_body(f"b{k}", mass=self.mass[k], com=self.com[k], inertia=self.I[k])
            more: dict[str, Any] = {}
            for part in parts:
                more |= part.joint.get(k, {})
            parent = f"b{k - 1}" if k else "world"
            place = {"rotation": self.R[k], "translation": self.p[k], "axis": self.axes[k]}
            b.add_joint(f"j{k}", kind, parent=parent, child=f"b{k}", **place, **more)
        b.add_frame("tip", body=f"b{len(self.kinds) - 1}", translation=TIP)
        for part in parts:
            part.declare(b)
        return b.build()

    # Kinematics

    def poses(self, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return R and p of each link; those of the last hundred q are kept, as terms are derived along the same."""
        key = q.tobytes(), len(self.kinds)
        if key in self._at:
            return self._at[key]
        x, (own, once, twice, along, _, _) = self.G @ q + self.c, self._joints()
        turned = own + np.sin(x)[:, None, None] * once + (1 - np.cos(x))[:, None, None] * twice
        places = self.p + along * x[:, None]
        out: list[tuple[np.ndarray, np.ndarray]] = []
        for k in range(len(self.kinds)):
            i = self.parents[k] if self.parents else k - 1
            R, p = out[i] if i >= 0 else (np.eye(3), np.zeros(3))
            out.append((R @ turned[k], p + R @ places[k]))
        if len(self._at) > 100:
            self._at.clear()
        self._at[key] = out
        return out

    def _joints(self) -> tuple[np.ndarray, ...]:
        """Return each joint's rotation, what sin and 1 - cos of its angle add, and the way of its body by coordinate.

        And the axes about which links turn and along which they move.
        """
        if len(self.kinds) not in self._fixed:
            turns = np.array([[float(kind == "revolute")] for kind in self.kinds])
            advance = 1 - turns
            for k, pitch in self.pitch.items():
                advance[k] = pitch
            own, K = np.array(self.R), np.array([skew(a) for a in turns * self.axes])
            along = (own @ (advance * self.axes)[..., None])[..., 0]
            self._fixed = {len(self.kinds): (own, own @ K, own @ K @ K, along, turns, advance)}
        return self._fixed[len(self.kinds)]

    def way(self, k: int) -> list[int]:
        """Return the links from the world to link k, and it."""
        if not self.parents:
            return [*range(k + 1)]
        return ([*self.way(self.parents[k])] if self.parents[k] >= 0 else []) + [k]

    def pose(self, body: str, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (np.eye(3), np.zeros(3)) if body == "world" else self.poses(q)[int(body[1:])]

    def point(self, body: str, at: Any, q: np.ndarray) -> np.ndarray:
        R, p = self.pose(body, q)
        return p + R @ np.asarray(at)

    def lines(self, q: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the links' axes and origins in the world, (L, 3); and (L, L) which of them are on the way to each."""
        key = "lines", q.tobytes(), len(self.kinds)
        if key not in self._at:
            poses, links = self.poses(q), len(self.kinds)
            axes, way = np.array([R @ a for (R, _), a in zip(poses, self.axes, strict=True)]), np.zeros((links, links))
            for k in range(links):
                way[k, self.way(k)] = 1.0
            *_, turns, advance = self._joints()
            self._at[key] = axes, np.array([p for _, p in poses]), way, turns * axes, advance * axes
        return self._at[key]

    def turning(self, k: int, q: np.ndarray) -> np.ndarray:
        """Return the angular Jacobian of body k, (3, n); it stays exact for complex q."""
        _, _, way, turns, _ = self.lines(q)
        return (way[k, :, None] * turns).T @ self.G

    def moving(self, k: int, at: Any, q: np.ndarray) -> np.ndarray:
        """Return the linear Jacobian of a point of body k, (3, n)."""
        R, p = self.poses(q)[k]
        _, origins, way, turns, advance = self.lines(q)
        return (way[k, :, None] * (cross(turns, p + R @ np.asarray(at) - origins) + advance)).T @ self.G

    def bodies(self, q: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return masses, Jacobians of centres of mass and of turns, and inertias in the world, of all that weigh."""
        key = "bodies", q.tobytes(), len(self.kinds)
        if key not in self._at:
            heavy, R = [k for k, m in enumerate(self.mass) if m], [x for x, _ in self.poses(q)]
            J = [self.moving(k, self.com[k], q) for k in heavy]
            W = [self.turning(k, q) for k in heavy]
            world = [R[k] @ self.I[k] @ R[k].T for k in heavy]
            self._at[key] = self.mass[heavy, None, None], *map(np.array, (J, W, world))
        return self._at[key]

    # Equations

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        if not self.mass.any():
            return np.zeros((self.n, self.n)) + sum(part.inertia(self, q) for part in self.parts)
        m, J, W, I = self.bodies(q)
        M = (m * J.swapaxes(1, 2) @ J + W.swapaxes(1, 2) @ I @ W).sum(axis=0)
        return M + sum(part.inertia(self, q) for part in self.parts)

    def of_velocities(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return C v: the bodies' forces at q̈ = 0, whose accelerations are complex steps along v."""
        out = np.zeros(self.n)
        if inert := [part for part in self.parts if part.inertia is not Part.inertia]:
            M = derivative(lambda x: sum(part.inertia(self, x) for part in inert), q)
            out = np.einsum("ijk,j,k->i", M, v, v) - np.einsum("jki,j,k->i", M, v, v) / 2
        if not self.mass.any():
            return out
        m, J, W, I = self.bodies(q)
        a, turned = (np.imag(x @ v)[..., None] / _STEP for x in self.bodies(q + 1j * _STEP * v)[1:3])
        w = W @ v
        moment = I @ turned + cross(w, (I @ w[..., None])[..., 0])[..., None]
        return out + (m * J.swapaxes(1, 2) @ a + W.swapaxes(1, 2) @ moment).sum(axis=0)[:, 0]

    def slope(self, q: np.ndarray) -> np.ndarray:
        """Return the derivative of the potential."""
        out = np.zeros(self.n)
        if self.mass.any():
            m, J, *_ = self.bodies(q)
            out = -(m * J.swapaxes(1, 2) @ self.weight[:, None]).sum(axis=0)[:, 0]
        if elastic := [part for part in self.parts if part.energy is not Part.energy]:
            out = out + derivative(lambda x: sum(part.energy(self, x) for part in elastic), q)
        return out

    def potential(self, q: np.ndarray) -> Any:
        weight = sum(-m * self.weight @ self.point(f"b{k}", self.com[k], q) for k, m in enumerate(self.mass))
        return weight + sum(part.energy(self, q) for part in self.parts)

    def energy(self, q: np.ndarray, v: np.ndarray) -> float:
        return float(v @ self.mass_matrix(q) @ v / 2 + self.potential(q))

    def loads(self, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the forces without a potential."""
        return np.zeros(self.n) + sum(part.force(self, t, q, v) for part in self.parts)

    def rows(self, t: Any, q: np.ndarray) -> np.ndarray:
        return np.array([x for part in self.parts if part.rows for x in part.rows(self, t, q)])

    def acceleration(
        self, t: float, q: np.ndarray, v: np.ndarray, tau: np.ndarray, hold: tuple[int, ...] = ()
    ) -> np.ndarray:
        """Return v̇ by the multipliers of all rows; velocities in `hold` stay zero."""
        h = self.of_velocities(q, v)
        f = tau + self.loads(t, q, v) - h - self.slope(q)
        J, bias = np.zeros((0, self.n)), np.zeros(0)
        if any(part.rows for part in self.parts):
            J = derivative(lambda x: self.rows(t, x), q)

            def rate(s: float) -> np.ndarray:
                step = s + 1j * _STEP
                return np.imag(self.rows(t + step, q + step * v)) / _STEP

            d = 1e-4
            bias = (8 * (rate(d) - rate(-d)) - (rate(2 * d) - rate(-2 * d))) / (12 * d)
        for part in self.parts:
            if part.speeds is not None:
                J = np.vstack([J, part.speeds(self, q)])
                bias = np.append(bias, np.imag(part.speeds(self, q + 1j * _STEP * v) @ v) / _STEP)
        for k in hold:
            J, bias = np.vstack([J, np.eye(self.n)[k]]), np.append(bias, 0.0)
        touched = self.touched(q, v)
        # Of all that could push, those that do, while the others let go: the motion is one.
        for pushing in chain(*(combinations(range(len(touched)), k) for k in range(len(touched) + 1))):
            rows = np.vstack([J, touched[[*pushing]]])
            m = len(rows)
            kkt = np.block([[self.mass_matrix(q), rows.T], [rows, np.zeros((m, m))]])
            found = np.linalg.solve(kkt, np.concatenate([f, -bias, np.zeros(len(pushing))]))
            if (touched @ found[: self.n] > -_TOUCHING).all() and (found[self.n + len(J) :] < _TOUCHING).all():
                return found[: self.n]
        raise AssertionError("no stops that push and let go")

    def touched(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the rows of the stops that links rest on, inwards, (k, n)."""
        y, u = self.G @ q + self.c, self.G @ v
        at = [x for part in self.parts for x in part.stops]
        on = [side * self.G[k] for k, side, bound in at if max(side * (y[k] - bound), side * u[k]) < _TOUCHING]
        return np.reshape(on, (-1, self.n))

    def held(self, t: float, q: np.ndarray) -> np.ndarray:
        """Return J of all rows, (m, n)."""
        J = derivative(lambda x: self.rows(t, x), q) if any(p.rows for p in self.parts) else np.zeros((0, self.n))
        return np.vstack([J, *(p.speeds(self, q) for p in self.parts if p.speeds is not None)])

    def allowed(self, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the velocities nearest to these that all rows allow, zero at stops."""
        J, at = self.held(t, q), self.touched(q, 0 * v)
        drift = [] if not any(p.rows for p in self.parts) else np.imag(self.rows(t + 1j * _STEP, q.astype(complex)))
        speeds = [p.speed for p in self.parts if p.speeds is not None for _ in p.speeds(self, q)]
        J, b = np.vstack([J, at]), np.concatenate([-np.asarray(drift) / _STEP, speeds, np.zeros(len(at))])
        # What rests does so to the last bit.
        return np.where(at.any(axis=0), 0.0, v - np.linalg.pinv(J) @ (J @ v - b)) if len(J) else v


# Parts


def loop_part(
    case: Case, rng: np.random.Generator, kind: str, name: str = "lp", body: str = "", link: int = -1
) -> Part:
    """Return a closure between the ground and a body, by default the last, that is closed where the case stands."""
    last = body or f"b{len(case.kinds) - 1}"
    R_0, p_0 = case.poses(case.q)[link]
    R_B, p_B = _turn(rng), rng.uniform(-0.3, 0.3, 3)
    R_A, p_A, length = R_0 @ R_B, p_0 + R_0 @ p_B, 0.0
    if kind == "distance":
        length = 0.8
        p_A = p_A + length * R_A[:, 0]
    if kind in ("cylindrical", "prismatic"):
        p_A = p_A + 0.3 * R_A[:, 2]
    if kind in ("revolute", "cylindrical"):
        R_A = R_A @ rotation(np.array([0.0, 0.0, 1.0]), 0.4)
    if kind == "universal":
        R_A = R_A @ rotation(np.array([1.0, 0.0, 0.0]), np.pi / 2)

    def rows(c: Case, t: Any, q: np.ndarray) -> list[Any]:
        R, p = c.poses(q)[link]
        A, B, gap = R_A, R @ R_B, p + R @ p_B - p_A
        across, sideways = [A[:, 0] @ B[:, 2], A[:, 1] @ B[:, 2]], [A[:, 0] @ gap, A[:, 1] @ gap]
        welded = [A[:, 0] @ B[:, 1], A[:, 1] @ B[:, 2], A[:, 2] @ B[:, 0]]
        return {
            "point": lambda: [*gap],
            "distance": lambda: [norm(gap) - length],
            "revolute": lambda: [*gap, *across],
            "universal": lambda: [*gap, A[:, 2] @ B[:, 2]],
            "cylindrical": lambda: [*sideways, *across],
            "prismatic": lambda: [*sideways, *welded],
            "frame": lambda: [*gap, *welded],
        }[kind]()

    def declare(b: mb.ModelBuilder) -> None:
        ends = {"rotation_a": R_A, "translation_a": p_A, "rotation_b": R_B, "translation_b": p_B}
        b.add_loop(name, kind, body_a="world", body_b=last, **ends, length=length)

    return Part(f"loop.{kind}", (name, "loop", "close"), declare, rows=rows)


LOOPS = {"point": 3, "distance": 1, "revolute": 5, "universal": 4, "cylindrical": 4, "prismatic": 5, "frame": 6}
