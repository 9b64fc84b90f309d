"""A strip of stick figures: the motion at a glance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbkit._check import Array, count
from mbkit.errors import InputError
from mbkit.model import Model
from mbkit.simulate.along import moved
from mbkit.simulate.projection import plane_of
from mbkit.simulate.skeleton import skeleton
from mbkit.simulate.strip import Strip
from mbkit.simulate.style import BAD, drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mbkit.simulate.trajectory import Trajectory

__all__ = ["picture"]

#: Steps of the path between two figures.
_FINE: Final = 40
#: A run that diverged is drawn up to so many times the size of its first figures.
_FAR: Final = 6.0


def picture(run: Trajectory, model: Model, figures: int, view: str | ArrayLike | None, member: int) -> Figure:
    """Draw what `Trajectory.picture` says, of a model with numbers for its parameters."""
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


def _states(run: Trajectory, member: int) -> tuple[Array, Array, Array]:
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
