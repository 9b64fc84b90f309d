"""Coordinates, velocities, energies and the power balance over time."""

from __future__ import annotations

import textwrap
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


def style(ink: str, muted: str, grid: str, **more: Any) -> dict[str, Any]:
    """Return Matplotlib's settings for figures of this package, in these colours."""
    labels = dict.fromkeys(("text.color", "axes.labelcolor", "xtick.labelcolor", "ytick.labelcolor"), ink)
    return {
        # A dollar sign in a name does not begin a formula.
        "text.parse_math": False,
        "font.family": "sans-serif",
        **labels,
        **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), muted),
        **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
        **dict.fromkeys(("axes.linewidth", "grid.linewidth"), 0.8),
        "axes.titlesize": 10.0,
        "axes.axisbelow": True,
        "grid.color": grid,
        **more,
    }


def drawing() -> Any:
    """Return a context that draws in this style, and leaves the user's own as it was."""
    import matplotlib as mpl

    sizes = {"font.size": 9.0, "lines.linewidth": 1.4, "legend.fontsize": 8.0}
    settings: Any = style(INK, MUTED, FAINT, **{"axes.grid": True, **sizes})
    return mpl.rc_context(settings)


#: Trajectories of a batch that are drawn.
_DRAWN: Final = 10
#: Lines that a legend tells apart.
_NAMED: Final = 10
_MARKED: Final = 20


def _panels(model: Model) -> list[tuple[tuple[str, str, str], list[int], list[int]]]:
    """Return (title, unit, unit of velocities), coordinates and velocities of each unit that there is."""
    titles = ("lengths", "m", "m/s"), ("angles", "rad", "rad/s"), ("quaternions", "1", "rad/s")
    of_q: tuple[list[int], ...] = ([], [], [])
    of_v: tuple[list[int], ...] = ([], [], [])
    for joint in model.independent_joints:
        kind, q, v = joint.type, model.layout.q[joint.name].start, model.layout.v[joint.name].start
        turn = [] if kind.quaternion is None else [range(kind.quaternion, n) for n in (kind.nq, kind.nv)]
        for k, (a, b) in enumerate([(kind.lengths,) * 2, (kind.angular,) * 2, turn or ((), ())]):
            of_q[k].extend(q + i for i in a)
            of_v[k].extend(v + i for i in b)
    return [group for group in zip(titles, of_q, of_v, strict=True) if group[1]]


def plot(run: RunData) -> Figure:
    """Draw a run; see `Trajectory.plot`."""
    from matplotlib.figure import Figure

    panels = _panels(run.model)
    rows = len(panels) + 1
    with drawing(), np.errstate(over="ignore", invalid="ignore"):
        figure = Figure(figsize=(11, 0.6 + 2.2 * rows), layout="constrained")
        axes = figure.subplots(rows, 2, sharex=True, squeeze=False)
        names, speeds = run.model.coordinate_names, run.model.velocity_names
        for (left, right), ((title, unit, rate), q, v) in zip(axes, panels, strict=False):
            _lines(left, run, run.q[..., q], [names[i] for i in q], f"{title} ({unit})")
            _lines(right, run, run.v[..., v], [speeds[i] for i in v], f"their velocities ({rate})")
        left, right = axes[-1]
        _energies(left, right, run)
        for axis in axes[-1]:
            axis.set_xlabel("t (s)")
        _mark(axes, run)
        title = f"{run.model.name}: {run.method} on {run.engine}"
        if run.q.ndim == 3:
            title += f", {len(run.q)} trajectories" + (f", the first {_DRAWN}" if len(run.q) > _DRAWN else "")
        figure.suptitle(title, fontsize=11)
    return figure


def _lines(axis: Axes, run: RunData, values: Array, names: list[str], label: str, colours: Any = None) -> None:
    """Draw one line for each name and trajectory, coloured by name."""
    from matplotlib import colormaps

    n = len(names)
    if colours is None:
        tab: Any = colormaps["tab10"]
        colours = tab.colors[:n] if n <= _NAMED else colormaps["turbo"](np.linspace(0.05, 0.95, n))
    members = values[:_DRAWN] if values.ndim == 3 else values[None]
    style: dict[str, Any] = {"alpha": 1.0 if len(members) == 1 else 0.6, "marker": "." if len(run.t) == 1 else None}
    for i, member in enumerate(members):
        for x, name, colour in zip(member.T, names, colours, strict=True):
            axis.plot(run.t, x, color=colour, label=name if name and not i and n <= _NAMED else None, **style)
    axis.set_ylabel(label)
    # The last states of a run that diverged would flatten all the others; its growth has
    # no scale, so that of its beginning is taken.
    if run.stats.ended == "diverged" and members.size:
        early = members[:, : max(3, len(run.t) // 20)]
        low, high = np.nanmin(early), np.nanmax(early)
        room = 20 * max(high - low, 0.05 * abs(low), 0.05 * abs(high), np.finfo(float).tiny)
        axis.set_ylim(max(low - room, np.nanmin(members)), min(high + room, np.nanmax(members)))
    if n <= _NAMED and all(names) and len(members):
        axis.legend(loc="center left", bbox_to_anchor=(1, 0.5), handlelength=1.2)


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
        colours = [*("tab:blue", "tab:orange")[: len(parts) - 1], INK]
        _lines(left, run, np.stack(list(parts.values()), axis=-1), list(parts), titles[0], colours)
        _lines(right, run, run.power_balance()[..., None], [""], titles[1], [INK])
    except MbkitError as error:
        text = textwrap.fill(str(error), 60, max_lines=5)
        for axis in (left, right):
            if not axis.lines:
                axis.text(0.5, 0.5, text, transform=axis.transAxes, ha="center", va="center", color=MUTED)


def _mark(axes: Any, run: RunData) -> None:
    """Draw a line at each event and at an early end, with its name above the first row."""
    marks = [(hit.t, hit.name, MUTED) for hit in run.events if (hit.member or 0) < _DRAWN]
    if not run.stats.finished:
        reached = run.stats.reached
        ends = reached if isinstance(reached, tuple) else (reached,)
        shown = sorted(set(ends[:_DRAWN]))
        early = [end for end in shown if len(shown) == 1 or end != max(ends)]
        marks += [(end, run.stats.ended.replace("_", " "), BAD) for end in early]
    named: set[str] = set()
    for t, name, colour in marks[:_MARKED]:
        for axis in axes.flat:
            axis.axvline(t, color=colour, linewidth=0.9, linestyle=(0, (3, 2)))
        if name not in named:
            named.add(name)
            style: dict[str, Any] = {"color": colour, "ha": "right", "va": "bottom"}
            axes[0, 0].annotate(f"{textwrap.shorten(name, 30)} ", (t, 1), xycoords=("data", "axes fraction"), **style)
