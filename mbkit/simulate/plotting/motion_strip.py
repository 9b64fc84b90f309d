"""A strip of stick figures."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbkit._check import Array, count
from mbkit.errors import InputError
from mbkit.model import Model
from mbkit.simulate.along_trajectory import moved
from mbkit.simulate.plotting.stick_figure import Plane, Skeleton, plane_of, skeleton
from mbkit.simulate.plotting.time_series import ACCENT, BAD, FAINT, GHOST, INK, MUTED, drawing
from mbkit.simulate.run_data import RunData

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Inches, at most.
_WIDTH: Final = 11.0
_HEIGHT: Final = 8.0
#: Width by height of the whole that reads best.
_SHAPE: Final = 3.0
#: Edges of a box whose corners are counted with x slowest, and its side at -x.
_EDGES: Final = [(i, i | b) for i in range(8) for b in (1, 2, 4) if not i & b]
_SIDE: Final = [0, 1, 3, 2]


class Strip:
    """Windows of one size, side by side, each of which holds the points `seen`, (P, 2); `size` is in inches."""

    def __init__(self, drawn: Skeleton, plane: Plane, seen: Array, figures: int) -> None:
        self._drawn, self._plane, self._figures = drawn, plane, figures
        low, high = seen.min(axis=0), seen.max(axis=0)
        largest = float((high - low).max()) or 1.0
        # Room around the figure, and never a window that is a line.
        room = np.maximum(0.06 * largest, (0.35 * largest - (high - low)) / 2)
        self._low, self._window = low - room, high - low + 2 * room
        self._gap = 0.12 * largest
        self._cell = self._window + np.array([0.3, 1.2]) * self._gap
        self._columns = self._best_columns()
        self._rows = -(-figures // self._columns)
        whole = self._cell * [self._columns, self._rows]
        scale = min(_WIDTH / whole[0], _HEIGHT / whole[1])
        self.size = (max(4.5, whole[0] * scale), whole[1] * scale + 0.6)

    def _best_columns(self) -> int:
        def waste(columns: int) -> float:
            rows = -(-self._figures // columns)
            shape = columns * self._cell[0] / (rows * self._cell[1])
            return abs(math.log(shape / _SHAPE)) + 2 * math.log(columns * rows / self._figures)

        return min(range(1, self._figures + 1), key=waste)

    def draw(self, axis: Axes, k: int, t: float, since: tuple[int, int]) -> None:
        """Draw figure k at t (s), the one before it and the path between; `since` are their indices of time."""
        from matplotlib.patches import Rectangle

        corner = self._cell * [k % self._columns, -(k // self._columns)]
        window = axis.add_patch(Rectangle(tuple(corner), *self._window, facecolor="none", edgecolor=FAINT, zorder=0))
        pen = _Pen(axis, window, lambda points: self._plane.of(points) - self._low + corner)
        before, now = since
        self._ground(pen, corner, first=k == 0)
        pen.line(self._drawn.path, color=GHOST, linewidth=0.8, zorder=1)
        if k:
            self._figure(pen, before, GHOST)
        pen.line(self._drawn.path[before : now + 1], color=ACCENT, linewidth=1.8, zorder=5)
        self._figure(pen, now, INK)
        pen.dots(self._drawn.path[now : now + 1], color=ACCENT, markersize=5, zorder=8)
        x, y = corner[0] + self._window[0] / 2, corner[1] - 0.15 * self._gap
        axis.text(x, y, f"t = {t:.3g} s", ha="center", va="top", fontsize=8.5)

    def _ground(self, pen: _Pen, corner: Array, *, first: bool) -> None:
        drawn = self._drawn
        # A rail is where a cart has been.
        for cart in drawn.carts:
            pen.line(cart, color=FAINT, linewidth=5, zorder=0.5, solid_capstyle="round")
        pen.dots(drawn.anchors[:, 0], marker=6, color=MUTED, markersize=9, zorder=2)
        level = -self._low[1]
        if (
            not len(drawn.anchors)
            and not len(drawn.carts)
            and self._plane.names[1] == "z"
            and 0 < level < self._window[1]
        ):
            ends = corner + np.array([[0, level], [self._window[0], level]])
            pen.axis.plot(*ends.T, color=MUTED, linewidth=0.8, linestyle=(0, (1, 2)), zorder=0.6)
            if first:
                pen.axis.text(ends[0, 0], ends[0, 1], " z = 0", color=MUTED, fontsize=7.5, va="bottom")

    def _figure(self, pen: _Pen, i: int, colour: str) -> None:
        drawn, z = self._drawn, 3.0 if colour == GHOST else 6.0
        for stick in drawn.slides[:, :, i]:
            pen.line(stick, color=colour, linewidth=1.0, zorder=z)
            if colour != GHOST:
                pen.dots(stick[1:], marker="s", color=colour, markersize=4, zorder=z + 0.1)
        for box in drawn.boxes[:, :, i]:
            pen.area(box[_SIDE], facecolor=colour, alpha=0.35, zorder=z)
            for edge in _EDGES:
                pen.line(box[list(edge)], color=colour, linewidth=1.2, zorder=z)
        for stick in drawn.links[:, :, i]:
            pen.line(stick, color=colour, linewidth=2.4, zorder=z, solid_capstyle="round")
        if colour == GHOST:
            return
        pen.dots(drawn.carts[:, i], marker="s", color=colour, markersize=9, zorder=z + 0.1)
        pen.dots(drawn.joints[:, i], color=colour, markerfacecolor="white", markersize=4, zorder=z + 0.2)
        pen.dots(drawn.masses[:, i], color=colour, markersize=8, zorder=z + 0.3)

    def frame(self, axis: Axes) -> None:
        """Set the axis's bounds; draw the scale and the directions."""
        x, y = self._plane.names
        bar = _round(0.3 * self._window[0])
        bottom = (1 - self._rows) * self._cell[1] - 0.95 * self._gap
        axis.plot([0, bar], [bottom, bottom], color=INK, linewidth=2, solid_capstyle="butt")
        axis.annotate(
            f"{bar:g} m; {x} to the right, {y} upwards",
            (bar, bottom),
            xytext=(5, 0),
            textcoords="offset points",
            va="center",
            fontsize=8.5,
        )
        axis.set_xlim(-0.02 * self._cell[0], self._columns * self._cell[0])
        axis.set_ylim(bottom - 0.3 * self._gap, self._window[1] + 0.1 * self._gap)
        axis.set_aspect("equal")
        axis.set_axis_off()


def _round(length: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten below a length."""
    power = 10.0 ** math.floor(math.log10(length))
    return next(k * power for k in (5, 2, 1) if k * power <= length)


class _Pen:
    """Draws points of space in a window."""

    def __init__(self, axis: Axes, window: Any, place: Any) -> None:
        self.axis, self._window, self._place = axis, window, place

    def line(self, points: Array, **style: Any) -> None:
        # Not as an argument of plot: the axis would put its own bounds in its place.
        for line in self.axis.plot(*self._place(points).T, **style):
            line.set_clip_path(self._window)

    def dots(self, points: Array, **style: Any) -> None:
        self.line(points, **{"marker": "o", "linestyle": "none", **style})

    def area(self, points: Array, **style: Any) -> None:
        from matplotlib.patches import Polygon

        patch = self.axis.add_patch(Polygon(self._place(points), **style))
        patch.set_clip_path(self._window)


#: Steps of the path between two figures.
_FINE: Final = 40
#: A run that diverged is drawn up to so many times the size of its first figures.
_FAR: Final = 6.0


def picture(run: RunData, model: Model, figures: int, view: str | ArrayLike | None, member: int) -> Figure:
    """Draw a run of a model with numbers for its parameters; see `Trajectory.picture`."""
    from matplotlib.figure import Figure

    figures = count("count", figures, least=1)
    t, q, v = _states(run, member)
    if len(t) < 2 or t[0] == t[-1]:
        figures = 1
    at = np.linspace(t[0], t[-1], (figures - 1) * _FINE + 1)
    with np.errstate(over="ignore", invalid="ignore"):
        drawn = skeleton(model, _between(model, t, q, v, at))
    # (P, n, 3): all that is drawn at all times
    points = drawn.points()
    seen = points.transpose(1, 0, 2)[_near(points, run.stats.ended == "diverged")].reshape(-1, 3)
    plane = plane_of(view, seen, model.gravity)
    strip = Strip(drawn, plane, plane.of(seen), figures)
    with drawing():
        figure = Figure(figsize=strip.size, layout="constrained")
        axis = figure.add_subplot()
        for k in range(figures):
            strip.draw(axis, k, float(at[k * _FINE]), (max(k - 1, 0) * _FINE, k * _FINE))
        strip.frame(axis)
        title = f"{model.name}: {run.method} on {run.engine}"
        axis.set_title(title + (f", trajectory {member}" if run.q.ndim == 3 else ""), loc="left")
        if run.stats.ended not in ("finished", "event"):
            axis.set_title(run.stats.ended.replace("_", " "), loc="right", color=BAD)
    return figure


def _states(run: RunData, member: int) -> tuple[Array, Array, Array]:
    """Return the good states of one trajectory."""
    q, v = (run.q[member], run.v[member]) if run.q.ndim == 3 else (run.q, run.v)
    good = np.isfinite(q).all(-1) & np.isfinite(v).all(-1)
    if not good.any():
        raise InputError("picture: the trajectory has no state")
    return run.t[good], q[good], v[good]


def _between(model: Model, t: Array, q: Array, v: Array, at: Array) -> Array:
    """Return configurations between the states: cubics that have their velocities."""
    if len(t) < 2:
        return np.repeat(q[:1], len(at), axis=0)
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    h = t[k + 1] - t[k]
    s = ((at - t[k]) / h)[:, None]
    d = model.difference(q[k], q[k + 1])
    u = d * (3 - 2 * s) * s**2 + h[:, None] * (v[k] * s * (1 - s) ** 2 - v[k + 1] * s**2 * (1 - s))
    return moved(model, q[k], u)


def _near(points: Array, diverged: bool) -> NDArray[np.bool_]:
    """Return at which times the figures are whole, and not beyond the picture's bounds."""
    good = np.asarray(np.isfinite(points).all(axis=(0, 2)))
    if not diverged or not good.any():
        return good
    centre = points[:, np.flatnonzero(good)[0]].mean(axis=0)
    away = np.abs(points - centre).max(axis=(0, 2))
    usual = float(away[good][: max(3, len(good) // 20)].max())
    return np.asarray(good & (away <= _FAR * usual))
