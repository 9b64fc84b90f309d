"""Coordinates, velocities, energies and the power balance over time."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import MbkitError
from mbkit.model import Model
from mbkit.simulate.run_data import RunData

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


INK: Final = "#22303c"
MUTED: Final = "#7b8794"
FAINT: Final = "#e3e7eb"
GHOST: Final = "#c4ccd4"
ACCENT: Final = "#e8590c"
BAD: Final = "#c92a2a"
_STYLE: Final[Any] = {
    # A dollar sign in a name does not begin a formula.
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.size": 9.0,
    "text.color": INK,
    "axes.titlesize": 10.0,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
}


@contextmanager
def drawing() -> Iterator[None]:
    """Draw in this style, and leave the user's own as it was."""
    import matplotlib as mpl

    with mpl.rc_context(_STYLE):
        yield


#: Trajectories of a batch that are drawn.
_DRAWN: Final = 10
#: Lines that a legend tells apart.
_NAMED: Final = 10
_MARKED: Final = 20


@dataclass(frozen=True)
class _Kind:
    """Coordinates of one unit, and the velocities that belong to them."""

    title: str
    unit: str
    rate: str
    q: list[int]
    v: list[int]


def _kinds(model: Model) -> list[_Kind]:
    lengths, angles = _Kind("lengths", "m", "m/s", [], []), _Kind("angles", "rad", "rad/s", [], [])
    turns = _Kind("quaternions", "1", "rad/s", [], [])
    for joint in model.independent_joints:
        q, v = model.layout.q[joint.name].start, model.layout.v[joint.name].start
        kind, start = joint.type, joint.type.quaternion
        for group, which in ((lengths, kind.lengths), (angles, kind.angular)):
            group.q.extend(q + i for i in which)
            group.v.extend(v + i for i in which)
        if start is not None:
            turns.q.extend(range(q + start, q + kind.nq))
            turns.v.extend(range(v + start, v + kind.nv))
    return [group for group in (lengths, angles, turns) if group.q]


def plot(run: RunData) -> Figure:
    """Draw a run; see `Trajectory.plot`."""
    from matplotlib.figure import Figure

    kinds = _kinds(run.model)
    rows = len(kinds) + 1
    with drawing(), np.errstate(over="ignore", invalid="ignore"):
        figure = Figure(figsize=(11, 0.6 + 2.2 * rows), layout="constrained")
        axes = figure.subplots(rows, 2, sharex=True, squeeze=False)
        names = run.model.coordinate_names, run.model.velocity_names
        for (left, right), kind in zip(axes, kinds, strict=False):
            _lines(left, run, run.q[..., kind.q], [names[0][i] for i in kind.q], f"{kind.title} ({kind.unit})")
            _lines(right, run, run.v[..., kind.v], [names[1][i] for i in kind.v], f"their velocities ({kind.rate})")
        left, right = axes[-1]
        _energies(left, right, run)
        for axis in axes[-1]:
            axis.set_xlabel("t (s)")
        _mark(axes, run)
        figure.suptitle(_title(run), fontsize=11)
    return figure


def _title(run: RunData) -> str:
    title = f"{run.model.name}: {run.method} on {run.engine}"
    if run.q.ndim == 3:
        title += f", {len(run.q)} trajectories" + (f", the first {_DRAWN}" if len(run.q) > _DRAWN else "")
    return title


def _lines(axis: Axes, run: RunData, values: Array, names: list[str], label: str) -> None:
    """Draw one line for each name and trajectory, coloured by name."""
    colours = _colours(len(names))
    members = values[:_DRAWN] if values.ndim == 3 else values[None]
    for i, member in enumerate(members):
        for x, name, colour in zip(member.T, names, colours, strict=True):
            axis.plot(
                run.t,
                x,
                color=colour,
                alpha=1.0 if len(members) == 1 else 0.6,
                marker="." if len(run.t) == 1 else None,
                label=name if not i and len(names) <= _NAMED else None,
            )
    axis.set_ylabel(label)
    _within(axis, run, members)
    if len(names) <= _NAMED and len(members):
        axis.legend(loc="center left", bbox_to_anchor=(1, 0.5), handlelength=1.2)


def _colours(n: int) -> list[Any]:
    from matplotlib import colormaps

    return list(colormaps["tab10"].colors[:n]) if n <= 10 else list(colormaps["turbo"](np.linspace(0.05, 0.95, n)))  # type: ignore[attr-defined]


def _within(axis: Axes, run: RunData, values: Array) -> None:
    # The last states of a run that diverged would flatten all the others; its growth has
    # no scale, so that of its beginning is taken.
    if run.stats.ended != "diverged" or not values.size:
        return
    early = values[:, : max(3, len(run.t) // 20)]
    low, high = np.nanmin(early), np.nanmax(early)
    room = 20 * max(high - low, 0.05 * abs(low), 0.05 * abs(high), np.finfo(float).tiny)
    axis.set_ylim(max(low - room, np.nanmin(values)), min(high + room, np.nanmax(values)))


def _energies(left: Axes, right: Axes, run: RunData) -> None:
    left.set_ylabel("energy (J)")
    right.set_ylabel("E − E(0) − work (J)")
    right.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3))
    try:
        kinetic, potential = run.kinetic_energy(), run.potential_energy()
    except MbkitError as error:
        _show_error(left, error)
        _show_error(right, error)
        return
    parts = {"total": kinetic + potential}
    if run.q.ndim == 2:
        parts = {"kinetic": kinetic, "potential": potential, **parts}
    _lines(left, run, np.stack(list(parts.values()), axis=-1), list(parts), "energy (J)")
    for line in left.lines[len(parts) - 1 :: len(parts)]:
        line.set_color(INK)
    if left.lines:
        left.legend(loc="center left", bbox_to_anchor=(1, 0.5), handlelength=1.2)
    try:
        balance = run.power_balance()
    except MbkitError as error:
        _show_error(right, error)
        return
    members = balance[:_DRAWN] if balance.ndim == 2 else balance[None]
    for member in members:
        right.plot(run.t, member, color=INK, alpha=1.0 if len(members) == 1 else 0.6)
    _within(right, run, members)


def _show_error(axis: Axes, error: MbkitError) -> None:
    text = textwrap.fill(str(error), 60, max_lines=5)
    axis.text(0.5, 0.5, text, transform=axis.transAxes, ha="center", va="center", color=MUTED)


def _mark(axes: Any, run: RunData) -> None:
    """Draw a line at each event and at an early end, with its name above the first row."""
    marks = [(hit.t, hit.name, MUTED) for hit in run.events if (hit.member or 0) < _DRAWN]
    if run.stats.ended not in ("finished", "event"):
        reached = run.stats.reached
        ends = reached[:_DRAWN] if isinstance(reached, tuple) else (reached,)
        last = max(reached) if isinstance(reached, tuple) else None
        ended = run.stats.ended.replace("_", " ")
        marks += [(end, ended, BAD) for end in sorted(set(ends)) if end != last or len(set(ends)) == 1]
    named: set[str] = set()
    for t, name, colour in marks[:_MARKED]:
        for axis in axes.flat:
            axis.axvline(t, color=colour, linewidth=0.9, linestyle=(0, (3, 2)))
        if name not in named:
            named.add(name)
            short = textwrap.shorten(name, 30)
            axes[0, 0].annotate(
                f"{short} ", (t, 1), xycoords=("data", "axes fraction"), color=colour, ha="right", va="bottom"
            )
