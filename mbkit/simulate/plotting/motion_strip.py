"""A strip of stick figures.

A tree as sticks: from joint to joint, and at the ends to the farthest frame or the centre of mass.

Bodies that fixed joints hold together are one link. Places follow from the description alone, without an engine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise, product
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbkit._check import Array, count, finite_array
from mbkit.errors import InputError
from mbkit.model import Joint, Model
from mbkit.model.description import body_poses, inertia_box
from mbkit.model.elements.beams import OnBeam
from mbkit.simulate.plotting.style import PLAIN, drawing, figure_of, new_figure
from mbkit.simulate.run_data import RunData, integrate_finite

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Skeleton:
    """Points in world axes at n configurations."""

    # (S, 2, n, 3): ends of each link's sticks; a sliding joint on another link from its zero to its place.
    links: Array
    slides: Array
    # (S, n, 3): joints; bodies that slide on the ground; tips that are centres of mass; feet on the ground.
    joints: Array
    carts: Array
    masses: Array
    anchors: Array
    # (S, 8, n, 3): corners, x changing slowest, of a box with the inertia of a body with nothing to draw.
    boxes: Array
    # (n, 3): the point whose path is drawn.
    path: Array

    def points(self) -> Array:
        """Return all points, (P, n, 3)."""
        parts = (self.links, self.slides, self.joints, self.carts, self.anchors, self.boxes, self.path)
        return np.concatenate([part.reshape(-1, *self.path.shape) for part in parts])


def skeleton(model: Model, q: Array) -> Skeleton:
    """Return the sticks at configurations (n, nq)."""
    n = len(q)
    tree = _Tree(model, q)
    parts: dict[str, list[Any]] = {name: [] for name in Skeleton.__dataclass_fields__ if name != "path"}
    for joint in tree.moving:
        if isinstance(joint.type, OnBeam):
            parts["links"] += tree.bend(joint)
            continue
        parent, base, place = tree.link[joint.parent], tree.bases[joint.name], tree.origin(joint.child)
        flies, slides = joint.type.floating, _slides(joint)
        if parent != "world":
            parts["links"] += [] if flies else [[tree.origin(parent), base]]
            parts["slides"] += [[base, place]] if slides else []
        else:
            foot = base if joint.parent == "world" else tree.origin(tree.ground[joint.parent])
            parts["links"] += [] if joint.parent == "world" else [[foot, base]]
            parts["anchors"] += [] if flies or slides else [foot]
            parts["carts"] += [place] if slides else []
        parts["joints"] += [] if flies or slides else [place]
    for link, point in tree.loop_ends:
        parts["anchors" if link == "world" else "joints"].append(point)
        parts["links"] += [] if link == "world" else [[tree.origin(link), point]]
    path, deepest = np.zeros((n, 3)), 0
    carrying = {tree.link[joint.parent] for joint in tree.moving}
    for joint in tree.moving:
        link = joint.child
        if link in carrying:
            continue
        here = tree.origin(link)
        tip, weighs = tree.tip(link)
        if tip is not None:
            parts["links"].append([here, tip])
            parts["masses"] += [tip] if weighs else []
        elif not _slides(joint):
            parts["boxes"].append(tree.box(link))
        if tree.depth[link] > deepest:
            path, deepest = here if tip is None else tip, tree.depth[link]
    if tree.moving and tree.moving[0].type.floating:
        base_body = tree.moving[0].child
        path = tree.at(base_body, model.body(base_body).com)
    ends = {"links": (2,), "slides": (2,), "boxes": (8,)}
    arrays = {k: np.array(x, dtype=np.float64).reshape(len(x), *ends.get(k, ()), n, 3) for k, x in parts.items()}
    return Skeleton(**arrays, path=path)


def _slides(joint: Joint) -> bool:
    return bool(joint.type.lengths) and not joint.type.floating


class _Tree:
    """The poses of all bodies, and what link each belongs to: it goes by the name of its first body."""

    def __init__(self, model: Model, q: Array) -> None:
        self._model = model
        self._poses = body_poses(model, q)
        #: Places of the joints on their parents.
        self.bases: dict[str, Array] = {}
        self.link, self.depth = {"world": "world"}, {"world": 0}
        #: The body on the world that carries each body.
        self.ground: dict[str, str] = {}
        self.moving = [joint for joint in model.tree if joint.type.nv]
        for joint in model.tree:
            parent, child = joint.parent, joint.child
            self.bases[joint.name] = self.at(parent, joint.translation)
            self.link[child] = child if joint.type.nv else self.link[parent]
            self.ground[child] = self.ground.get(parent, child)
            if joint.type.nv:
                self.depth[child] = self.depth[self.link[parent]] + 1
        ends = [(x.body_a, x.translation_a) for x in model.loops] + [(x.body_b, x.translation_b) for x in model.loops]
        #: The links that loops join, and the points where they do.
        self.loop_ends = [(self.link[body], self.at(body, point)) for body, point in ends]

    def bend(self, joint: Joint) -> list[list[Array]]:
        """Return the pieces of a beam's axis, of its end."""
        points = [j for j in self.moving if j.mimic and j.mimic.joint == joint.name]
        line = [self.bases[joint.name], *(self.origin(j.child) for j in points), self.origin(joint.child)]
        return [] if joint.mimic else [[a, b] for a, b in pairwise(line)]

    def at(self, body: str, point: Array) -> Array:
        """Return a point of a body in world axes, (n, 3)."""
        R, p = self._poses[body]
        return np.asarray(p + R @ point)

    def origin(self, body: str) -> Array:
        """Return the place of a body's frame, (n, 3)."""
        return self._poses[body][1]

    def tip(self, link: str) -> tuple[Array | None, bool]:
        """Return the end of a last link, and whether it is a centre of mass."""
        here, model = self.origin(link), self._model
        bodies = [model.body(name) for name, own in self.link.items() if own == link and name != "world"]
        names = [body.name for body in bodies]
        places = [self.origin(name) for name in names]
        places += [self.at(f.body, f.translation) for f in model.frames if f.body in names]
        places += [point for own, point in self.loop_ends if own == link]
        masses = [self.at(body.name, body.com) for body in bodies if body.mass]
        for points, weigh in ((places, False), (masses, True)):
            far = max(points, key=lambda p: float(np.linalg.norm(p[0] - here[0])), default=here)
            # Shorter lengths of robots are rounding.
            if np.linalg.norm(far[0] - here[0]) > 1e-6:
                return far, weigh or any(np.allclose(far[0], m[0], rtol=0, atol=1e-9) for m in masses)
        return None, False

    def box(self, name: str) -> Array:
        """Return the corners of the uniform box with a body's mass and inertia, (8, n, 3)."""
        body = self._model.body(name)
        axes, half = inertia_box(body)
        return np.array([self.at(name, body.com + axes @ (half * s)) for s in product((-1, 1), repeat=3)])


# The plane of a picture of a motion in space: two orthonormal rows, to the right and upwards, in world axes.

_AXES: Final = "xyz"
# A world axis that shows this much of the widest spread reads better than a slanted one.
_NEARLY: Final = 0.9
# A motion flatter than this, seen from the side, is a line: it is seen from above.
_FLAT: Final = 0.02


def direction_name(direction: Array) -> str:
    """Return a world axis's name, or the components."""
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) > 1 - 1e-9:
        return ("-" if direction[k] < 0 else "") + _AXES[k]
    return "(" + ", ".join(f"{x:.2g}" for x in direction + 0.0) + ")"


def plane_of(view: str | ArrayLike | None, points: Array, gravity: Array) -> Array:
    """Return the plane (2, 3) of the argument `view`, or the one that shows most of the points (P, 3)."""
    if view is None:
        return np.array(_widest(points - points.mean(axis=0), gravity))
    if isinstance(view, str):
        if len(view) != 2 or view[0] == view[1] or not set(view) <= set(_AXES):
            raise InputError(f"view: expected two of x, y and z such as 'xz', or two directions, got {view!r}")
        return np.eye(3)[[_AXES.index(a) for a in view]]
    right, up = finite_array("view", view, (2, 3))
    lengths = np.linalg.norm(right), np.linalg.norm(up)
    if not all(lengths) or np.linalg.norm(np.cross(right, up)) < 1e-9 * lengths[0] * lengths[1]:
        raise InputError("view: expected two directions that are not along one line")
    right = right / lengths[0]
    return np.array([right, _across(up, right)])


def _across(x: Array, direction: Array) -> Array:
    """Return the unit vector of the part of x that is normal to a direction."""
    x = x - (x @ direction) * direction
    return np.asarray(x / np.linalg.norm(x))


def _positive(x: Array) -> Array:
    return x if x[np.argmax(np.abs(x))] > 0 else -x


def _widest(points: Array, gravity: Array) -> tuple[Array, Array]:
    g = float(np.linalg.norm(gravity))
    if g:
        up = -gravity / g
        right = _spread(points, up)
        ahead = np.cross(up, right)
        tall, wide, deep = (float(np.ptp(points @ x)) for x in (up, right, ahead))
        return right, up if tall > _FLAT * max(wide, deep) or deep <= tall else ahead
    # Nothing says where up is: the plane that shows most, z or else y upwards in it.
    squares, axes = np.linalg.eigh(points.T @ points)
    normal = axes[:, 0]
    k = int(np.argmax(np.abs(normal)))
    if points[:, k] @ points[:, k] <= squares[0] / _NEARLY**2 + 1e-12 * squares[2]:
        normal = np.eye(3)[k]
    up = _across(np.eye(3)[1 if abs(normal[2]) > _NEARLY else 2], normal)
    return _positive(np.cross(up, normal)), up


def _spread(points: Array, up: Array) -> Array:
    """Return the direction across `up` in which the points are widest, a world axis if one nearly is."""
    across = points - np.outer(points @ up, up)
    squares, axes = np.linalg.eigh(across.T @ across)
    for axis in np.eye(3):
        if abs(axis @ up) < 1e-9 and np.sum((across @ axis) ** 2) >= _NEARLY**2 * squares[2]:
            return np.asarray(axis)
    if not squares[2]:
        # Only up and down: any level direction.
        return _positive(_across(np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))]), up))
    return _positive(_across(axes[:, 2], up))


INK: Final = PLAIN.ink
MUTED: Final = PLAIN.muted
FAINT: Final = PLAIN.grid
ACCENT: Final = PLAIN.series[1]
GHOST: Final = "#c4ccd4"
#: Inches, at most.
_SIZE: Final = (11.0, 8.0)
#: Inches that a time needs below its window, and from one to the next.
_LINE: Final = 0.3
_TIME: Final = 0.95
#: Edges of a box whose corners are counted with x slowest, and its side at -x.
_EDGES: Final = [(i, i | b) for i in range(8) for b in (1, 2, 4) if not i & b]
_SIDE: Final = [0, 1, 3, 2]
_DOTS: Final[Any] = {"marker": "o", "linestyle": "none"}
#: Steps of the path between two figures.
_FINE: Final = 40


class _Strip:
    """Windows of one size, side by side, each of which holds the points `seen`, (P, 2); sizes are in inches."""

    def __init__(self, drawn: Skeleton, plane: Array, seen: Array, figures: int, most: tuple[float, float]) -> None:
        self._drawn, self._plane = drawn, plane
        low, high = seen.min(axis=0), seen.max(axis=0)
        largest = float((high - low).max()) or 1.0
        # Room around the figure, and never a window that is a line.
        room = np.maximum(0.06 * largest, (0.35 * largest - (high - low)) / 2)
        self._low, self._window = low - room, high - low + 2 * room
        scale, self._gap, self._columns = math.inf, 0.12 * largest, 1
        widest = max(1, min(figures, int(most[0] / _TIME)))
        # Texts keep their size, so that their room depends on the scale, and the scale on their room.
        for _ in range(4):
            self._gap = max(0.12 * largest, _LINE / scale)
            self._cell = np.maximum(self._window + np.array([0.3, 1.2]) * self._gap, [_TIME / scale, 0])
            self._columns = min(range(1, widest + 1), key=lambda columns: self._waste(figures, columns))
            self._rows = -(-figures // self._columns)
            whole = self._cell * [self._columns, self._rows]
            scale = min(most[0] / whole[0], most[1] / whole[1])
        self.size = (max(4.5, whole[0] * scale), whole[1] * scale + 0.6)

    def _waste(self, figures: int, columns: int) -> float:
        rows = -(-figures // columns)
        shape = columns * self._cell[0] / (rows * self._cell[1])
        # Three times as wide as high reads best.
        return float(abs(math.log(shape / 3.0)) + 2 * math.log(columns * rows / figures))

    def draw(self, axis: Axes, k: int, t: float, before: int, now: int) -> None:
        """Draw figure k at t (s), the one before it and the path between, by their indices of time."""
        from matplotlib.patches import Rectangle

        drawn = self._drawn
        corner = self._cell * [k % self._columns, -(k // self._columns)]
        window = axis.add_patch(Rectangle(tuple(corner), *self._window, facecolor="none", edgecolor=FAINT, zorder=0))

        def line(points: Array, how: str = "plot", **style: Any) -> None:
            # Not as an argument of plot: the axis would put its own bounds in its place.
            for artist in getattr(axis, how)(*(points @ self._plane.T - self._low + corner).T, **style):
                artist.set_clip_path(window)

        # A rail is where a cart has been.
        for cart in drawn.carts:
            line(cart, color=FAINT, linewidth=5, zorder=0.5, solid_capstyle="round")
        line(drawn.anchors[:, 0], **{**_DOTS, "marker": 6}, color=MUTED, markersize=9, zorder=2)
        level = -self._low[1]
        grounded = len(drawn.anchors) or len(drawn.carts)
        if not grounded and direction_name(self._plane[1]) == "z" and 0 < level < self._window[1]:
            ends = corner + np.array([[0, level], [self._window[0], level]])
            axis.plot(*ends.T, color=MUTED, linewidth=0.8, linestyle=(0, (1, 2)), zorder=0.6)
            if not k:
                axis.text(ends[0, 0], ends[0, 1], " z = 0", color=MUTED, fontsize=7.5, va="bottom")
        line(drawn.path, color=GHOST, linewidth=0.8, zorder=1)
        if k:
            self._figure(line, before, GHOST, 3.0)
        line(drawn.path[before : now + 1], color=ACCENT, linewidth=1.8, zorder=5)
        self._figure(line, now, INK, 6.0)
        line(drawn.path[now : now + 1], **_DOTS, color=ACCENT, markersize=5, zorder=8)
        x, y = corner[0] + self._window[0] / 2, corner[1] - 0.15 * self._gap
        axis.text(x, y, f"t = {t:.3g} s", ha="center", va="top", fontsize=8.5)

    def _figure(self, line: Any, i: int, colour: str, z: float) -> None:
        drawn = self._drawn
        for stick in drawn.slides[:, :, i]:
            line(stick, color=colour, linewidth=1.0, zorder=z)
        for box in drawn.boxes[:, :, i]:
            line(box[_SIDE], "fill", facecolor=colour, alpha=0.35, zorder=z)
            for edge in _EDGES:
                line(box[list(edge)], color=colour, linewidth=1.2, zorder=z)
        for stick in drawn.links[:, :, i]:
            line(stick, color=colour, linewidth=2.4, zorder=z, solid_capstyle="round")
        if colour == GHOST:
            return
        square = {**_DOTS, "marker": "s", "color": colour, "zorder": z + 0.1}
        line(drawn.slides[:, 1, i], markersize=4, **square)
        line(drawn.carts[:, i], markersize=9, **square)
        line(drawn.joints[:, i], **_DOTS, color=colour, markerfacecolor="white", markersize=4, zorder=z + 0.2)
        line(drawn.masses[:, i], **_DOTS, color=colour, markersize=8, zorder=z + 0.3)

    def frame(self, axis: Axes) -> None:
        """Set the axis's bounds; draw the scale and the directions."""
        right, up = (direction_name(x) for x in self._plane)
        room = 0.3 * self._window[0]
        power = 10.0 ** math.floor(math.log10(room))
        bar = next(k * power for k in (5, 2, 1) if k * power <= room)
        bottom = (1 - self._rows) * self._cell[1] - 0.95 * self._gap
        axis.plot([0, bar], [bottom, bottom], color=INK, linewidth=2, solid_capstyle="butt")
        text = f"{bar:g} m; {right} to the right, {up} upwards"
        style: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": 8.5}
        axis.annotate(text, (bar, bottom), xytext=(5, 0), **style)
        axis.set_xlim(-0.02 * self._cell[0], self._columns * self._cell[0])
        axis.set_ylim(bottom - 0.3 * self._gap, self._window[1] + 0.1 * self._gap)
        axis.set_aspect("equal")
        axis.set_axis_off()


def picture(
    run: RunData, model: Model, figures: int, view: str | ArrayLike | None, member: int, axis: Axes | None = None
) -> Figure:
    """Draw a run of a model with numbers for its parameters; see `Trajectory.picture`."""
    figures = count("count", figures, least=1)
    q, v = (run.q[member], run.v[member]) if run.q.ndim == 3 else (run.q, run.v)
    good = np.isfinite(q).all(-1) & np.isfinite(v).all(-1)
    if not good.any():
        raise InputError("picture: the trajectory has no state")
    t, q, v = run.t[good], q[good], v[good]
    if t[0] == t[-1]:
        figures = 1
    at = np.linspace(t[0], t[-1], (figures - 1) * _FINE + 1)
    with np.errstate(over="ignore", invalid="ignore"):
        drawn = skeleton(model, _between(model, t, q, v, at))
    # (P, n, 3): all that is drawn at all times
    points = drawn.points()
    seen = points.transpose(1, 0, 2)[_near(points, run.stats.ended == "diverged")].reshape(-1, 3)
    plane = plane_of(view, seen, model.gravity)
    most = _SIZE
    if axis is not None:
        most = tuple(np.array(axis.get_window_extent().size) / figure_of(axis).dpi)
    strip = _Strip(drawn, plane, seen @ plane.T, figures, most)
    with drawing(more={"font.size": 9.0}):
        axis = axis or new_figure(*strip.size).add_subplot()
        for k in range(figures):
            strip.draw(axis, k, float(at[k * _FINE]), max(k - 1, 0) * _FINE, k * _FINE)
        strip.frame(axis)
        title = f"{model.name}: {run.method} on {run.engine}"
        axis.set_title(title + (f", trajectory {member}" if run.q.ndim == 3 else ""), loc="left")
        if not run.stats.finished:
            axis.set_title(run.stats.ended.replace("_", " "), loc="right", color=PLAIN.bad)
    return figure_of(axis)


def _between(model: Model, t: Array, q: Array, v: Array, at: Array) -> Array:
    """Return configurations between the states: cubics that have their velocities."""
    if len(t) < 2:
        return np.repeat(q[:1], len(at), axis=0)
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    h = t[k + 1] - t[k]
    s = ((at - t[k]) / h)[:, None]
    d = model.difference(q[k], q[k + 1])
    u = d * (3 - 2 * s) * s**2 + h[:, None] * (v[k] * s * (1 - s) ** 2 - v[k + 1] * s**2 * (1 - s))
    return integrate_finite(model, q[k], u)


def _near(points: Array, diverged: bool) -> NDArray[np.bool_]:
    """Return at which times the figures are whole, and not beyond the picture's bounds."""
    good = np.asarray(np.isfinite(points).all(axis=(0, 2)))
    if not diverged or not good.any():
        return good
    centre = points[:, np.flatnonzero(good)[0]].mean(axis=0)
    away = np.abs(points - centre).max(axis=(0, 2))
    usual = float(away[good][: max(3, len(good) // 20)].max())
    # A run that diverged is drawn up to some times the size of its first figures.
    return np.asarray(good & (away <= 6.0 * usual))
