"""The work-precision figure: error and energy drift against run time, and one panel for each method."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

from mbkit._check import EPS, by_key
from mbkit._escape import one_line
from mbkit.methods.registry import METHODS
from mbkit.simulate.plotting.style import (
    PLAIN,
    Palette,
    drawing,
    engine_mark,
    figure_of,
    legend,
    log_ticks,
    name_points,
)
from mbkit.studies.measurement import Measurement
from mbkit.studies.svg import PAGE_WIDTH_INCHES
from mbkit.studies.work_precision.curve import Curve, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

#: Run time, s, error or energy drift, and whose they are.
_Place = tuple[float, float, Curve]
_Measure = Callable[[Measurement], float]

#: MuJoCo's own integrators stand in the panel of the same formula.
_SAME_FORMULA: Final = {m.name: m.own for m in METHODS.values() if m.own}
_PANELS_PER_ROW: Final = 5
_TOP_HEIGHT_INCHES: Final = 4.4
#: Right end of the axes; leaves room for half of the last tick's label.
_RIGHT_EDGE: Final = 0.98
_PANEL_HEIGHT_INCHES: Final = 1.5
#: Size of the front's names, and the width of one of their bold letters.
_NAME_POINTS: Final = 9.0
_LETTER_WIDTH_INCHES: Final = 0.077
#: A run with a larger error, rad or m, is not on the front; with ten times as much it is not drawn.
MAX_USEFUL_ERROR: Final = 0.1
_MAX_DRAWN_ERROR: Final = 1.0
_MIN_DRAWN_ERROR: Final = 1e-17
_DASHED: Final = (0, (4, 3))


def figure(
    curves: Sequence[Curve], duration: float, floor: float, palette: Palette = PLAIN, only: Axes | None = None
) -> Figure:
    """Draw all curves of error against run time, thin, the best of each engine, and the front.

    At the right stands the same for energy, below one panel for each method; of these there is none where the errors
    are drawn into the axes `only`. The floor says how well the reference is known, rad or m.
    """
    floor = floor if math.isfinite(floor) and floor > 0 else 0.0
    methods = _methods(curves)
    rows = math.ceil(len(methods) / _PANELS_PER_ROW)

    def error(p: Measurement) -> float:
        # Below the reference's floor nothing is known; a logarithm has no zero.
        return max(p.error, floor / 10, _MIN_DRAWN_ERROR) if math.isfinite(p.error) else math.nan

    with drawing(palette):
        # Figure without pyplot: no window system, nothing to close.
        from matplotlib.figure import Figure

        if only is not None:
            _errors(only, curves, duration, floor, palette, error)
            legend(only, _handles(curves, floor, palette), "lower", own=False, columns=2)
            return figure_of(only)
        height = _TOP_HEIGHT_INCHES + (0.75 + _PANEL_HEIGHT_INCHES * rows if rows else 0.0)
        fig = Figure(figsize=(PAGE_WIDTH_INCHES, height))
        split = 1 - _TOP_HEIGHT_INCHES / height
        # With dampers the energy is not conserved, and there is no drift to show.
        conserved = any(_drawable(p.seconds, p.energy) for c in curves for p in c.points)
        margins = {"left": 0.07, "right": _RIGHT_EDGE, "top": 1 - 0.62 / height, "bottom": split + 0.55 / height}
        ratios = (1.55, 1.0) if conserved else (1.0,)
        gridspec = margins | {"wspace": 0.2}
        axes = fig.subplots(1, len(ratios), width_ratios=ratios, squeeze=False, gridspec_kw=gridspec)[0]
        _errors(axes[0], curves, duration, floor, palette, error)
        if conserved:
            _overview(axes[1], curves, lambda p: p.energy, EPS, palette)
            axes[1].set_title("energy over the same runs", loc="left")
            axes[1].set_ylabel("energy drift, relative")
            axes[1].set_xlabel(axes[0].get_xlabel())
        _legend(fig, curves, floor, palette)
        if rows:
            caption = "Method by method, each engine in its colour, the front behind"
            if any(c.method in _SAME_FORMULA for some in methods.values() for c in some):
                caption += "; dashed: MuJoCo's own integrator of the same formulas"
            fig.text(0.025, split - 0.12 / height, caption, va="top")
            margins |= {"top": split - 0.58 / height, "bottom": 0.42 / height, "wspace": 0.08, "hspace": 0.3}
            grid = fig.subplots(rows, _PANELS_PER_ROW, sharex=True, sharey=True, squeeze=False, gridspec_kw=margins)
            _by_method(list(grid.flat), methods, _places(curves, error), error, floor, palette)
    return fig


def _methods(curves: Sequence[Curve]) -> dict[str, list[Curve]]:
    """Return the curves of each panel, methods on most engines first."""
    drawn = (curve for curve in curves if any(_drawable(p.seconds, p.error) for p in curve.points))
    panels = by_key((_SAME_FORMULA.get(curve.method, curve.method), curve) for curve in drawn)
    return dict(sorted(panels.items(), key=lambda item: -len(_engines(item[1]))))


def _engines(curves: Sequence[Curve]) -> list[str]:
    return list(dict.fromkeys(c.engine for c in curves))


def _drawable(seconds: float, y: float) -> bool:
    return math.isfinite(seconds) and seconds > 0 and math.isfinite(y)


def _places(curves: Sequence[Curve], measure: _Measure) -> list[_Place]:
    points = ((p.seconds, measure(p), c) for c in curves for p in c.points)
    places = ((x, max(y, _MIN_DRAWN_ERROR), c) for x, y, c in points if _drawable(x, y))
    return [place for place in places if place[1] <= _MAX_DRAWN_ERROR]


def _xy(places: Sequence[_Place]) -> tuple[list[float], list[float]]:
    return [x for x, _, _ in places], [y for _, y, _ in places]


def _text(place: _Place) -> str:
    seconds, error, curve = place
    return f"{curve.engine} {curve.method}: {error:.1e} in {seconds:.2g} s"


def _front(places: Sequence[_Place], floor: float) -> list[_Place]:
    return pareto_front(places, lambda place: place[:2], floor)


def _draw_front(ax: Axes, places: Sequence[_Place], floor: float, palette: Palette, width: float) -> list[_Place]:
    """Draw the front of all useful points as a band, and return it."""
    front = _front([place for place in places if place[1] <= MAX_USEFUL_ERROR], floor)
    ax.plot(*_xy(front), color=palette.ink, alpha=0.16, linewidth=width, solid_capstyle="round")
    return front


def _overview(
    ax: Axes, curves: Sequence[Curve], measure: _Measure, floor: float, palette: Palette, *, show_floor: bool = False
) -> None:
    """Draw all curves thin, the best of each engine, and the front with its names."""
    places = _places(curves, measure)
    for curve in curves:
        thin = ax.plot(*_xy(_places([curve], measure)), color=palette.engine(curve.engine), linewidth=0.7, alpha=0.4)
        name_points(thin, [f"{curve.engine} {curve.method}"])
    front = _draw_front(ax, places, floor, palette, 11.0)
    for engine in _engines(curves):
        best = _front([place for place in places if place[2].engine == engine], floor)
        look: dict[str, Any] = {"color": palette.engine(engine), "marker": engine_mark(engine)}
        name_points(ax.plot(*_xy(best), markersize=4.5, linewidth=2.0, **look), map(_text, best))
    ax.set_xscale("log")
    ax.set_yscale("log")
    names = _names(front)
    _limits(ax, places, floor, names)
    if show_floor:
        ax.axhline(floor, color=palette.muted, linestyle=_DASHED, linewidth=1.0)
    ax.grid(which="major")
    log_ticks(ax)
    _write_names(ax, names, palette)


def _errors(
    ax: Axes, curves: Sequence[Curve], duration: float, floor: float, palette: Palette, error: _Measure
) -> None:
    _overview(ax, curves, error, floor, palette, show_floor=floor > 0)
    ax.set_title("error: lower left is better", loc="left")
    ax.set_ylabel("largest error of q, rad or m")
    ax.set_xlabel(f"run time of {duration:g} s of motion, s")


def _limits(ax: Axes, places: Sequence[_Place], floor: float, names: Sequence[tuple[_Place, bool]]) -> None:
    """Set the limits to hold all places, and at the left the names of the front: nothing else can be there."""
    if not places:
        return
    xs, ys = _xy(places)
    low, high = math.log10(min(xs)) - 0.15, math.log10(max(xs)) + 0.15
    width = float(ax.get_window_extent().width) / figure_of(ax).dpi
    for (x, _, curve), below in names:
        share = min(0.6, (_LETTER_WIDTH_INCHES * len(_short(curve)) + (-0.2 if below else 0.2)) / width)
        low = min(low, (math.log10(x) - share * high) / (1 - share))
    ax.set_xlim(10**low, 10**high)
    room = 0.7 + 0.9 * sum(below for _, below in names)
    lowest = min([*ys, floor] if floor > 0 else ys) / 10**room
    # Above, the half of a marker.
    ax.set_ylim(lowest, max(ys) * max(2.0, (max(ys) / lowest) ** 0.05))


def _names(front: Sequence[_Place]) -> list[tuple[_Place, bool]]:
    """Return the first point of each of the front's curves, and whether its name stands below that."""
    names: list[tuple[_Place, bool]] = []
    for k, (x, y, curve) in enumerate(front):
        if all(curve is not known for (_, _, known), _ in names):
            # Where the front has become flat, left of a point lies the front.
            flat = k > 0 and math.log10(front[k - 1][1] / y) < 2 * math.log10(x / front[k - 1][0])
            names.append(((x, y, curve), flat))
    return names


def _write_names(ax: Axes, names: Sequence[tuple[_Place, bool]], palette: Palette) -> None:
    """Write the names of the front's methods where all is empty: left of the front, or below it."""
    scale = figure_of(ax).dpi / 72
    last = math.inf
    for (x, y, curve), below in names:
        at = float(ax.transData.transform((x, y))[1]) / scale
        # Downwards, where the front is further right, so that no name meets another.
        last = min(at - (16.0 if below else 0.0), last - 12.0)
        offset, colour = (9.0 if below else -11.0, last - at), palette.engine(curve.engine)
        font: dict[str, Any] = {"fontsize": _NAME_POINTS, "fontweight": "bold", "color": colour}
        ax.annotate(_short(curve), (x, y), offset, textcoords="offset points", ha="right", va="center", **font)


def _short(curve: Curve) -> str:
    return one_line(curve.method, 30)


def _handles(curves: Sequence[Curve], floor: float, palette: Palette) -> list[Line2D]:
    from matplotlib.lines import Line2D

    handles = []
    for e in _engines(curves):
        look: dict[str, Any] = {"color": palette.engine(e), "marker": engine_mark(e), "linewidth": 2.0}
        handles.append(Line2D([], [], label=f"best of {one_line(e, 20)}", **look))
    handles.append(Line2D([], [], color=palette.ink, alpha=0.16, linewidth=9.0, label="the front"))
    handles.append(Line2D([], [], color=palette.muted, linewidth=0.7, label="every curve"))
    if floor > 0:
        label = f"reference known to {floor:.0e}"
        handles.append(Line2D([], [], color=palette.muted, linestyle=_DASHED, linewidth=1.0, label=label))
    return handles


def _legend(fig: Figure, curves: Sequence[Curve], floor: float, palette: Palette) -> None:
    handles = _handles(curves, floor, palette)
    place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (0.02, 1.0), "columnspacing": 1.6}
    # The legend stays on one line: its letters are as small as long names need.
    for size in (10.0, 9.0, 8.0, 7.0, 6.0, 5.0):
        drawn = fig.legend(handles=handles, ncols=len(handles), prop={"size": size}, **place)
        if size == 5.0 or drawn.get_window_extent().x1 <= _RIGHT_EDGE * fig.bbox.width:
            return
        drawn.remove()


def _by_method(
    panels: Sequence[Axes],
    methods: dict[str, list[Curve]],
    places: Sequence[_Place],
    measure: _Measure,
    floor: float,
    palette: Palette,
) -> None:
    """Draw one method a panel, each engine in its colour, with the front as a band behind."""
    for ax, (method, some) in zip(panels, methods.items(), strict=False):
        _draw_front(ax, places, floor, palette, 6.0)
        for curve in some:
            own = curve.method in _SAME_FORMULA
            mark, line = ("", (0, (2, 1))) if own else (engine_mark(curve.engine), "-")
            look: dict[str, Any] = {"color": palette.engine(curve.engine), "marker": mark, "markersize": 3.0}
            of_curve = _places([curve], measure)
            name_points(ax.plot(*_xy(of_curve), linestyle=line, linewidth=1.3, **look), map(_text, of_curve))
        ax.set_title(one_line(method, 30), loc="left", fontsize=9.5, pad=3)
    first = panels[0]
    first.set_xscale("log")
    first.set_yscale("log")
    _limits(first, places, floor, ())
    for k, ax in enumerate(panels):
        if k >= len(methods):
            ax.remove()
            continue
        ax.grid(which="major")
        log_ticks(ax, 5)
        ax.tick_params(labelsize=8.5)
        if k + _PANELS_PER_ROW >= len(methods):
            # The last of a column, whose lower neighbours may be missing.
            ax.tick_params(labelbottom=True)
