"""Coordinates, velocities, energies and the power balance over time."""

from __future__ import annotations

import csv
import io
import math
import textwrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import InputError, MbkitError
from mbkit.model import Model
from mbkit.simulate.plotting.style import PLAIN, drawing, new_figure
from mbkit.simulate.run_data import RunData

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

#: Trajectories of a batch that are drawn.
_DRAWN: Final = 10
#: Lines differ by colour, then by dashes; more than so many have no legend.
_DASHES: Final = ("-", (0, (4, 2)), (0, (1, 1.2)), (0, (6, 1.5, 1, 1.5)))
_NAMED: Final = len(_DASHES) * len(PLAIN.series)
_SIZES: Final[dict[str, Any]] = {"axes.grid": True, "font.size": 9.0, "lines.linewidth": 1.4, "legend.fontsize": 8.0}


def _panels(model: Model) -> list[tuple[tuple[str, str, str], list[int], list[int]]]:
    """Return (title, unit, unit of velocities), coordinates and velocities of each unit that there is."""
    # A system on paper does not say which of its coordinates are angles.
    plain = ("lengths", "m", "m/s") if model.has_bodies else ("coordinates", "SI", "SI")
    titles = plain, ("angles", "rad", "rad/s"), ("quaternions", "1", "rad/s")
    of_q: tuple[list[int], ...] = ([], [], [])
    of_v: tuple[list[int], ...] = ([], [], [])
    for joint in model.independent_joints:
        kind, q, v = joint.type, model.layout.q[joint.name].start, model.layout.v[joint.name].start
        turn = [] if kind.quaternion is None else [range(kind.quaternion, n) for n in (kind.nq, kind.nv)]
        for k, (a, b) in enumerate([(kind.lengths,) * 2, (kind.angular,) * 2, turn or ((), ())]):
            of_q[k].extend(q + i for i in a)
            of_v[k].extend(v + i for i in b)
    return [group for group in zip(titles, of_q, of_v, strict=True) if group[1]]


def plot(run: RunData, fig: Figure | SubFigure | None = None) -> Figure:
    """Draw a run; see `Trajectory.plot`."""
    panels = _panels(run.model)
    forces = _forces(run)
    rows = len(panels) + 1 + (len(forces) > 0)
    with drawing(more=_SIZES), np.errstate(over="ignore", invalid="ignore"):
        fig = fig or new_figure(11, 0.6 + 2.2 * rows)
        axes = fig.subplots(rows, 2, sharex=True, squeeze=False)
        names, speeds = run.model.coordinate_names, run.model.velocity_names
        for (left, right), ((title, unit, rate), q, v) in zip(axes, panels, strict=False):
            own, rates = [names[i] for i in q], [speeds[i] for i in v]
            # One legend at the right is for both.
            _lines(left, run.t, run.q[..., q], own, f"{title} ({unit})", legend=own != rates)
            _lines(right, run.t, run.v[..., v], rates, f"their velocities ({rate})")
        for axis, (label, own, values) in zip(axes[-2] if forces else (), forces, strict=False):
            _lines(axis, run.t, values, own, label)
        if len(forces) == 1:
            axes[-2][1].set_axis_off()
        left, right = axes[-1]
        _energies(left, right, run)
        if run.stats.ended == "diverged":
            for axis in axes.flat:
                _show_beginning(axis, len(run.t))
        for axis in axes[-1]:
            axis.set_xlabel("t (s)")
        _mark(axes, run)
        title = f"{run.model.name}: {run.method} on {run.engine}"
        if run.q.ndim == 3:
            title += f", {len(run.q)} trajectories" + (f", the first {_DRAWN}" if len(run.q) > _DRAWN else "")
        fig.suptitle(title, fontsize=11)
    return _whole(fig)


def _forces(run: RunData) -> list[tuple[str, list[str], Array]]:
    """Return label, names and values of the torques and forces that acted; a coordinate on paper has no unit."""
    if not run.driven or not np.nan_to_num(run.tau).any():
        return []
    names, tau = run.model.velocity_names, run.tau
    if not run.model.has_bodies:
        return [("generalized forces (SI)", list(names), tau)]
    linear = {names[k] for (_, _, rate), _, of_v in _panels(run.model) if rate == "m/s" for k in of_v}
    turning, straight = ([n for n in names if (n in linear) == moves] for moves in (False, True))
    parts = ("torques (N m)", turning), ("forces (N)", straight)
    return [(label, own, tau[..., [names.index(n) for n in own]]) for label, own in parts if own]


def plot_csv(text: str, title: str) -> Figure:
    """Draw a table that `Trajectory.to_csv` wrote: coordinates and velocities over time.

    Raises
    ------
    InputError
        The table is no such one.
    """
    rows: list[list[str]]
    head, *rows = [*csv.reader(io.StringIO(text)), []]
    batch = head[:1] == ["trajectory"]
    names = head[batch + 1 :]
    try:
        data = np.array([row for row in rows if row], dtype=float)
        if (
            head[batch : batch + 1] != ["t"]
            or {name[:2] for name in names if not name.startswith("tau.")} != {"q.", "v."}
            or not len(data)
        ):
            raise ValueError("its columns are " + ", ".join(head[:4]) + ", ...")
        data = data.reshape(len(np.unique(data[:, 0])) if batch else 1, -1, len(head))[:, :, int(batch) :]
    except ValueError as error:
        raise InputError(
            f"expected the table of a trajectory (t, q.NAME, ..., v.NAME, ...), which mbkit simulate writes; {error}"
        ) from None
    with drawing(more=_SIZES):
        fig = new_figure(11, 5.0)
        axes = fig.subplots(2, 1, sharex=True)
        for axis, kind, label in zip(axes, "qv", ("q (m or rad)", "v (m/s or rad/s)"), strict=True):
            which = [k for k, name in enumerate(names, 1) if name.startswith(f"{kind}.")]
            _lines(axis, data[0, :, 0], data[:, :, which], [names[k - 1][2:] for k in which], label)
        axes[-1].set_xlabel("t (s)")
        fig.suptitle(title, fontsize=11)
    return fig


def _whole(fig: Figure | SubFigure) -> Figure:
    from matplotlib.figure import Figure

    return fig if isinstance(fig, Figure) else _whole(fig.figure)


def _lines(
    axis: Axes,
    t: Array,
    values: Array,
    names: list[str],
    label: str,
    colours: tuple[str, ...] = PLAIN.series,
    *,
    legend: bool = True,
) -> None:
    """Draw one line for each name and trajectory, coloured by name."""
    members = values[:_DRAWN] if values.ndim == 3 else values[None]
    style: dict[str, Any] = {"alpha": 1.0 if len(members) == 1 else 0.6, "marker": "." if len(t) == 1 else None}
    for i, member in enumerate(members):
        for k, (x, name) in enumerate(zip(member.T, names, strict=True)):
            again, which = divmod(k, len(colours))
            style |= {"color": colours[which], "linestyle": _DASHES[again % len(_DASHES)]}
            axis.plot(t, x, label=None if i else name or None, **style)
    axis.set_ylabel(label)
    if legend and len(names) <= _NAMED and all(names) and len(members):
        # So many names have room below each other.
        columns = math.ceil(len(names) / 8)
        axis.legend(loc="center left", bbox_to_anchor=(1, 0.5), ncols=columns, handlelength=1.8)


def _show_beginning(axis: Axes, count: int) -> None:
    """Set the limits by the first of so many states: the last of a run that diverged would flatten all others."""
    lines = [np.asarray(line.get_ydata(), dtype=float) for line in axis.lines]
    values = np.array([y for y in lines if len(y) == count])
    if not np.isfinite(values).any():
        return
    # Its growth has no scale, so that of its beginning is taken.
    early = values[:, : max(3, count // 20)]
    low, high = np.nanmin(early), np.nanmax(early)
    room = 20 * max(high - low, 0.05 * abs(low), 0.05 * abs(high), np.finfo(float).tiny)
    axis.set_ylim(max(low - room, np.nanmin(values)), min(high + room, np.nanmax(values)))


def _energies(left: Axes, right: Axes, run: RunData) -> None:
    titles = "energy (J)", "E − E(0) − work (J)"
    right.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3))
    for axis, title in zip((left, right), titles, strict=True):
        axis.set_ylabel(title)
    try:
        kinetic, potential = run.kinetic_energy(), run.potential_energy()
        parts = {"total": kinetic + potential}
        if run.q.ndim == 2:
            parts = {"kinetic": kinetic, "potential": potential, **parts}
        colours = *PLAIN.series[: len(parts) - 1], PLAIN.ink
        _lines(left, run.t, np.stack(list(parts.values()), axis=-1), list(parts), titles[0], colours)
        _lines(right, run.t, run.power_balance()[..., None], [""], titles[1], (PLAIN.ink,))
    except MbkitError as error:
        text = textwrap.fill(str(error), 60, max_lines=5)
        for axis in (left, right):
            if not axis.lines:
                axis.text(0.5, 0.5, text, transform=axis.transAxes, ha="center", va="center", color=PLAIN.muted)


def _mark(axes: Any, run: RunData) -> None:
    """Draw a line at each event and at an early end, with its name above the first row."""
    marks = [(hit.t, hit.name, PLAIN.muted) for hit in run.events if (hit.member or 0) < _DRAWN]
    if not run.stats.finished:
        reached = run.stats.reached
        ends = reached if isinstance(reached, tuple) else (reached,)
        shown = sorted(set(ends[:_DRAWN]))
        early = [end for end in shown if len(shown) == 1 or end != max(ends)]
        marks += [(end, run.stats.ended.replace("_", " "), PLAIN.bad) for end in early]
    start, span = (run.t[0], run.t[-1] - run.t[0] or 1.0) if len(run.t) else (0.0, 1.0)
    # Names that would meet stand one above the other; (left, right) of each, row by row.
    taken: list[list[tuple[float, float]]] = []
    named: set[str] = set()
    # More lines would hide the curves.
    for t, name, colour in marks[:20]:
        for axis in axes.flat:
            axis.axvline(t, color=colour, linewidth=0.9, linestyle=(0, (3, 2)))
        if name in named:
            continue
        named.add(name)
        text = textwrap.shorten(name, 30)
        # A letter's width is a part of the panel's.
        at, width = (t - start) / span, 0.023 * (len(text) + 1)
        own = (at, at + width) if at < 0.5 else (at - width, at)
        free = (k for k, row in enumerate(taken) if all(own[1] <= x or y <= own[0] for x, y in row))
        row = next(free, len(taken))
        taken[row:] = taken[row:] or [[]]
        taken[row].append(own)
        style: dict[str, Any] = {"color": colour, "ha": "left" if at < 0.5 else "right", "va": "bottom"}
        place: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
        axes[0, 0].annotate(text, (t, 1), (0.0, 11.0 * row), **place, **style)
