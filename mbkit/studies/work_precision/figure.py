"""The work-precision figure: error and energy drift against run time, and one panel for each method."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Final

from mbkit._escape import one_line
from mbkit.methods.registry import METHODS
from mbkit.studies._figure_style import PLAIN, Palette, engine_mark, log_ticks, style
from mbkit.studies.work_precision.curve import Curve, PrecisionPoint

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_Place = tuple[float, float]
_Measure = Callable[[PrecisionPoint], float]

#: MuJoCo's own integrators stand in the panel of the same formula.
_SAME_FORMULA: Final = {m.name: m.own for m in METHODS.values() if m.own}
_COLUMNS: Final = 5
_WIDTH: Final = 10.4
_TOP: Final = 4.4
#: Right end of the axes; leaves room for half of the last tick's label.
_RIGHT: Final = 0.98
_MIN_LEGEND: Final = 5.0
_ROW: Final = 1.5
_NAME: Final = 9.0  # points, and the width of a bold letter, in
_LETTER: Final = 0.077
#: A run with a larger error, rad or m, is not on the front; with ten times as much it is not drawn.
USEFUL: Final = 0.1
_MAX_ERROR: Final = 1.0
_MIN_ERROR: Final = 1e-17
_EPS: Final = 2.0**-52


def figure(curves: Sequence[Curve], duration: float, floor: float, palette: Palette = PLAIN) -> Figure:
    """Draw all curves of error against run time, thin, the best of each engine, and the front.

    At the right stands the same for energy, below one panel for each method. The floor says how well the reference is
    known, rad or m.
    """
    # Figure without pyplot: no window system, nothing to close.
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    floor = floor if math.isfinite(floor) and floor > 0 else 0.0
    methods = _methods(curves)
    rows = math.ceil(len(methods) / _COLUMNS)

    def error(p: PrecisionPoint) -> float:
        # Below the reference's floor nothing is known; a logarithm has no zero.
        return max(p.error, floor / 10, _MIN_ERROR) if math.isfinite(p.error) else math.nan

    with rc_context(style(palette)):  # type: ignore[arg-type]
        height = _TOP + (0.75 + _ROW * rows if rows else 0.0)
        fig = Figure(figsize=(_WIDTH, height))
        above, below = 0.62 / height, 0.55 / height
        split = 1 - _TOP / height
        # With dampers the energy is not conserved, and there is no drift to show.
        conserved = any(_drawable(p.seconds, p.energy) for c in curves for p in c.points)
        margins = {"left": 0.07, "right": _RIGHT, "top": 1 - above, "bottom": split + below, "wspace": 0.2}
        ratios = (1.55, 1.0) if conserved else (1.0,)
        axes = fig.subplots(1, len(ratios), width_ratios=ratios, squeeze=False, gridspec_kw=margins)[0]
        _overview(axes[0], curves, error, floor, palette, show_floor=floor > 0)
        axes[0].set_title("error: lower left is better", loc="left")
        axes[0].set_ylabel("largest error of q, rad or m")
        if conserved:
            _overview(axes[1], curves, lambda p: p.energy, _EPS, palette)
            axes[1].set_title("energy over the same runs", loc="left")
            axes[1].set_ylabel("energy drift, relative")
        for ax in axes:
            ax.set_xlabel(f"run time of {duration:g} s of motion, s")
        _legend(fig, curves, floor, palette)
        if rows:
            caption = "Method by method, each engine in its colour, the front behind"
            if any(c.method in _SAME_FORMULA for some in methods.values() for c in some):
                caption += "; dashed: MuJoCo's own integrator of the same formulas"
            fig.text(0.025, split - 0.12 / height, caption, va="top")
            margins = {"left": 0.07, "right": _RIGHT, "top": split - 0.58 / height, "bottom": 0.42 / height}
            margins |= {"wspace": 0.08, "hspace": 0.3}
            grid = fig.subplots(rows, _COLUMNS, sharex=True, sharey=True, squeeze=False, gridspec_kw=margins)
            _by_method(list(grid.flat), methods, curves, error, floor, palette)
    return fig


def _methods(curves: Iterable[Curve]) -> dict[str, list[Curve]]:
    """Return the curves of each panel, methods on most engines first."""
    panels: dict[str, list[Curve]] = {}
    for curve in curves:
        if any(_drawable(p.seconds, p.error) for p in curve.points):
            panels.setdefault(_SAME_FORMULA.get(curve.method, curve.method), []).append(curve)
    return dict(sorted(panels.items(), key=lambda item: -len({c.engine for c in item[1]})))


def _drawable(seconds: float, y: float) -> bool:
    return math.isfinite(seconds) and seconds > 0 and math.isfinite(y)


def _places(points: Iterable[PrecisionPoint], measure: _Measure) -> list[_Place]:
    places = [(p.seconds, max(measure(p), _MIN_ERROR)) for p in points if _drawable(p.seconds, measure(p))]
    return [(x, y) for x, y in places if y <= _MAX_ERROR]


def _front(places: Iterable[tuple[Curve, _Place]], floor: float) -> list[tuple[Curve, _Place]]:
    """Return the points that none beats in both error and run time, fastest first; below the floor all are equal."""
    out: list[tuple[Curve, _Place]] = []
    for curve, (x, y) in sorted(places, key=lambda item: item[1]):
        if not out or max(y, floor) < max(out[-1][1][1], floor):
            out.append((curve, (x, y)))
    return out


def _useful(places: Iterable[tuple[Curve, _Place]]) -> list[tuple[Curve, _Place]]:
    return [(curve, (x, y)) for curve, (x, y) in places if y <= USEFUL]


def _overview(
    ax: Axes, curves: Sequence[Curve], measure: _Measure, floor: float, palette: Palette, *, show_floor: bool = False
) -> None:
    """Draw all curves thin, the best of each engine, and the front with its names."""
    known = [(c, place) for c in curves for place in _places(c.points, measure)]
    for curve in curves:
        ax.plot(*_columns(_places(curve.points, measure)), color=palette.engine(curve.engine), linewidth=0.7, alpha=0.4)
    front = _front(_useful(known), floor)
    ax.plot(*_columns([p for _, p in front]), color=palette.ink, alpha=0.16, linewidth=11.0, solid_capstyle="round")
    for engine in _engines(curves):
        best = _front([item for item in known if item[0].engine == engine], floor)
        ax.plot(
            *_columns([p for _, p in best]),
            color=palette.engine(engine),
            marker=engine_mark(engine),
            markersize=4.5,
            linewidth=2.0,
        )
    ax.set_xscale("log")
    ax.set_yscale("log")
    names = _names(front)
    if known:
        _limits(ax, [p for _, p in known], floor, names)
    if show_floor:
        ax.axhline(floor, color=palette.muted, linestyle=(0, (4, 3)), linewidth=1.0)
    ax.grid(which="major")
    log_ticks(ax)
    _name(ax, names, palette)


def _columns(places: Sequence[_Place]) -> tuple[list[float], list[float]]:
    return [x for x, _ in places], [y for _, y in places]


def _limits(ax: Axes, places: Sequence[_Place], floor: float, names: Sequence[tuple[Curve, _Place, bool]]) -> None:
    """Set the limits to hold all places, and at the left the names of the front: nothing else can be there."""
    xs, ys = _columns(places)
    low, high = math.log10(min(xs)) - 0.15, math.log10(max(xs)) + 0.15
    width = float(ax.get_window_extent().width) / ax.get_figure(root=True).dpi  # type: ignore[union-attr]
    for curve, (x, _), below in names:
        share = min(0.6, (_LETTER * len(_short(curve)) + (-0.2 if below else 0.2)) / width)
        low = min(low, (math.log10(x) - share * high) / (1 - share))
    ax.set_xlim(10**low, 10**high)
    room = 0.7 + 0.9 * sum(below for _, _, below in names)
    ax.set_ylim(min([*ys, floor] if floor > 0 else ys) / 10**room, max(ys) * 2)


def _names(front: Sequence[tuple[Curve, _Place]]) -> list[tuple[Curve, _Place, bool]]:
    """Return each of the front's curves with its first point, and whether its name stands below that."""
    out: list[tuple[Curve, _Place, bool]] = []
    for k, (curve, (x, y)) in enumerate(front):
        if all(curve is not c for c, _, _ in out):
            # Where the front has become flat, what is left of a point is the front.
            flat = k > 0 and math.log10(front[k - 1][1][1] / y) < 2 * math.log10(x / front[k - 1][1][0])
            out.append((curve, (x, y), flat))
    return out


def _name(ax: Axes, names: Sequence[tuple[Curve, _Place, bool]], palette: Palette) -> None:
    """Write the names of the front's methods where all is empty: left of the front, or below it."""
    scale = ax.get_figure(root=True).dpi / 72  # type: ignore[union-attr]
    last = math.inf
    for curve, place, below in names:
        wanted = float(ax.transData.transform(place)[1]) / scale - (16.0 if below else 0.0)
        # Downwards, where the front is further right, so that no name meets another.
        placed = min(wanted, last - 12.0)
        shift = placed - wanted - (16.0 if below else 0.0)
        last = placed
        ax.annotate(
            _short(curve),
            place,
            (9.0 if below else -11.0, shift),
            textcoords="offset points",
            ha="right",
            va="center",
            fontsize=_NAME,
            fontweight="bold",
            color=palette.engine(curve.engine),
        )


def _short(curve: Curve) -> str:
    return one_line(curve.method, 30)


def _engines(curves: Sequence[Curve]) -> list[str]:
    return list(dict.fromkeys(c.engine for c in curves))


def _legend(fig: Figure, curves: Sequence[Curve], floor: float, palette: Palette) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D(
            [], [], color=palette.engine(e), marker=engine_mark(e), linewidth=2.0, label=f"best of {one_line(e, 20)}"
        )
        for e in _engines(curves)
    ]
    handles.append(Line2D([], [], color=palette.ink, alpha=0.16, linewidth=9.0, label="the front"))
    handles.append(Line2D([], [], color=palette.muted, linewidth=0.7, label="every curve"))
    if floor > 0:
        label = f"reference known to {floor:.0e}"
        handles.append(Line2D([], [], color=palette.muted, linestyle=(0, (4, 3)), linewidth=1.0, label=label))
    # On one line, in letters as small as long names need.
    for size in (10.0, 9.0, 8.0, 7.0, 6.0, _MIN_LEGEND):
        legend = fig.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(0.02, 1.0),
            ncols=len(handles),
            columnspacing=1.6,
            prop={"size": size},
        )
        if size == _MIN_LEGEND or legend.get_window_extent().x1 <= _RIGHT * fig.bbox.width:
            return
        legend.remove()


def _by_method(
    panels: Sequence[Axes],
    methods: dict[str, list[Curve]],
    curves: Sequence[Curve],
    measure: _Measure,
    floor: float,
    palette: Palette,
) -> None:
    """Draw one method a panel, each engine in its colour, with the front as a band behind."""
    known = [(c, place) for c in curves for place in _places(c.points, measure)]
    front = _columns([p for _, p in _front(_useful(known), floor)])
    for ax, (method, some) in zip(panels, methods.items(), strict=False):
        ax.plot(*front, color=palette.ink, alpha=0.16, linewidth=6.0, solid_capstyle="round")
        for curve in some:
            own = curve.method in _SAME_FORMULA
            ax.plot(
                *_columns(_places(curve.points, measure)),
                color=palette.engine(curve.engine),
                marker="" if own else engine_mark(curve.engine),
                linestyle=(0, (2, 1)) if own else "-",
                markersize=3.0,
                linewidth=1.3,
            )
        ax.set_title(one_line(method, 30), loc="left", fontsize=9.5, pad=3)
    first = panels[0]
    first.set_xscale("log")
    first.set_yscale("log")
    if known:
        _limits(first, [p for _, p in known], floor, ())
    for k, ax in enumerate(panels):
        if k >= len(methods):
            ax.remove()
            continue
        ax.grid(which="major")
        log_ticks(ax, 5)
        ax.tick_params(labelsize=8.5)
        if k + _COLUMNS >= len(methods):
            # The last of a column, whose lower neighbours may be missing.
            ax.tick_params(labelbottom=True)
