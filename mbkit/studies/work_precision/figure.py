"""The work-precision figure: who is fastest at which error, and every curve by its method.

Above, all curves faintly, the best of each engine in its colour, and the front, which
nothing beats in both error and run time, as a band with its methods named; the same
for energy at the right. Below, one small panel per method with the engines in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Final

from mbkit._escape import one_line
from mbkit.studies._figure_style import PLAIN, Palette, engine_mark, log_ticks, style
from mbkit.studies.work_precision.result import Curve, PrecisionPoint, WorkPrecision

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["USEFUL", "figure"]

_Place = tuple[float, float]
_Measure = Callable[[PrecisionPoint], float]

#: MuJoCo's own integrators with the same formulas as ours stand beside them.
_BESIDE: Final = {"mujoco_rk4": "rk4", "mujoco_euler": "semi_implicit_euler"}
_COLUMNS: Final = 5
_WIDTH: Final = 10.4
_TOP: Final = 4.4
#: Where axes end, so that half of a last tick's label has its place.
_RIGHT: Final = 0.98
_SMALLEST: Final = 5.0
_ROW: Final = 1.5
_NAME: Final = 9.0  # points, and the width of a letter in bold, in
_LETTER: Final = 0.077
#: An error above this, rad or m, is no answer, so it is on no front; ten times as much is not drawn.
USEFUL: Final = 0.1
_MOST: Final = 1.0
#: A double tells no less.
_LEAST: Final = 1e-17
_EPS: Final = 2.0**-52


def figure(result: WorkPrecision, palette: Palette = PLAIN) -> Figure:
    """Draw a result.

    Parameters
    ----------
    result : WorkPrecision
    palette : Palette
        By default for white paper.

    Returns
    -------
    matplotlib.figure.Figure
        Without a window; ``savefig`` writes it, and a notebook shows it.
    """
    # Figure without pyplot: no window system, nothing to close.
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    methods = _methods(result.curves)
    rows = math.ceil(len(methods) / _COLUMNS)
    with rc_context(style(palette)):  # type: ignore[arg-type]
        height = _TOP + (0.75 + _ROW * rows if rows else 0.0)
        fig = Figure(figsize=(_WIDTH, height))
        above, below = 0.62 / height, 0.55 / height
        split = 1 - _TOP / height
        floor = _floor(result)
        # With dampers the energy is not conserved, and there is no drift to show.
        conserved = any(_drawable(p.seconds, p.energy) for _, p in result.rows())
        margins = {"left": 0.07, "right": _RIGHT, "top": 1 - above, "bottom": split + below, "wspace": 0.2}
        ratios = (1.55, 1.0) if conserved else (1.0,)
        axes = fig.subplots(1, len(ratios), width_ratios=ratios, squeeze=False, gridspec_kw=margins)[0]
        _overview(axes[0], result, lambda p: _shown(p, floor), floor, palette, known_to=floor > 0)
        axes[0].set_title("error: lower left is better", loc="left")
        axes[0].set_ylabel("largest error of q, rad or m")
        if conserved:
            _overview(axes[1], result, lambda p: p.energy, _EPS, palette)
            axes[1].set_title("energy over the same runs", loc="left")
            axes[1].set_ylabel("energy drift, relative")
        for ax in axes:
            ax.set_xlabel(f"run time of {result.duration:g} s of motion, s")
        _legend(fig, result, palette)
        if rows:
            told = "Method by method, each engine in its colour, the front behind"
            if any(c.method in _BESIDE for curves in methods.values() for c in curves):
                told += "; dashed: MuJoCo's own integrator of the same formulas"
            fig.text(0.025, split - 0.12 / height, told, va="top")
            grid = fig.subplots(
                rows,
                _COLUMNS,
                sharex=True,
                sharey=True,
                squeeze=False,
                gridspec_kw={
                    "left": 0.07,
                    "right": _RIGHT,
                    "top": split - 0.58 / height,
                    "bottom": 0.42 / height,
                    "wspace": 0.08,
                    "hspace": 0.3,
                },
            )
            _by_method(list(grid.flat), methods, result, palette)
    return fig


def _methods(curves: Iterable[Curve]) -> dict[str, list[Curve]]:
    """Return the panels: a method's name and its curves, those on the most engines first."""
    found: dict[str, list[Curve]] = {}
    for curve in curves:
        if any(_drawable(p.seconds, p.error) for p in curve.points):
            found.setdefault(_BESIDE.get(curve.method, curve.method), []).append(curve)
    return dict(sorted(found.items(), key=lambda item: -len({c.engine for c in item[1]})))


def _floor(result: WorkPrecision) -> float:
    return result.floor if math.isfinite(result.floor) and result.floor > 0 else 0.0


def _shown(point: PrecisionPoint, floor: float) -> float:
    # What is below the reference's own floor is not known any better; a logarithm has no zero.
    return max(point.error, floor / 10, _LEAST) if math.isfinite(point.error) else math.nan


def _drawable(seconds: float, y: float) -> bool:
    return math.isfinite(seconds) and seconds > 0 and math.isfinite(y)


def _places(points: Iterable[PrecisionPoint], measure: _Measure) -> list[_Place]:
    found = [(p.seconds, max(measure(p), _LEAST)) for p in points if _drawable(p.seconds, measure(p))]
    return [(x, y) for x, y in found if y <= _MOST]


def _unbeaten(places: Iterable[tuple[Curve, _Place]], floor: float) -> list[tuple[Curve, _Place]]:
    """Return what nothing beats in both, fastest first; below the floor nothing is better."""
    out: list[tuple[Curve, _Place]] = []
    for curve, (x, y) in sorted(places, key=lambda item: item[1]):
        if not out or max(y, floor) < max(out[-1][1][1], floor):
            out.append((curve, (x, y)))
    return out


def _useful(places: Iterable[tuple[Curve, _Place]]) -> list[tuple[Curve, _Place]]:
    return [(curve, (x, y)) for curve, (x, y) in places if y <= USEFUL]


def _overview(
    ax: Axes, result: WorkPrecision, measure: _Measure, floor: float, palette: Palette, *, known_to: bool = False
) -> None:
    """Draw all curves faintly, the best of each engine, and the front with its names.

    Below `floor` nothing is better; `known_to` says whether that is the reference's own.
    """
    known = [(c, place) for c in result.curves for place in _places(c.points, measure)]
    for curve in result.curves:
        places = _places(curve.points, measure)
        ax.plot(*_columns(places), color=palette.engine(curve.engine), linewidth=0.7, alpha=0.4)
    front = _unbeaten(_useful(known), floor)
    ax.plot(*_columns([p for _, p in front]), color=palette.ink, alpha=0.16, linewidth=11.0, solid_capstyle="round")
    for engine in _engines(result):
        best = _unbeaten([item for item in known if item[0].engine == engine], floor)
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
    if known_to:
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


def _engines(result: WorkPrecision) -> list[str]:
    return list(dict.fromkeys(c.engine for c in result.curves))


def _legend(fig: Figure, result: WorkPrecision, palette: Palette) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D(
            [], [], color=palette.engine(e), marker=engine_mark(e), linewidth=2.0, label=f"best of {one_line(e, 20)}"
        )
        for e in _engines(result)
    ]
    handles.append(Line2D([], [], color=palette.ink, alpha=0.16, linewidth=9.0, label="the front"))
    handles.append(Line2D([], [], color=palette.muted, linewidth=0.7, label="every curve"))
    if _floor(result) > 0:
        told = f"reference known to {result.floor:.0e}"
        handles.append(Line2D([], [], color=palette.muted, linestyle=(0, (4, 3)), linewidth=1.0, label=told))
    # On one line, in letters as small as long names need.
    for size in (10.0, 9.0, 8.0, 7.0, 6.0, _SMALLEST):
        legend = fig.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(0.02, 1.0),
            ncols=len(handles),
            columnspacing=1.6,
            prop={"size": size},
        )
        if size == _SMALLEST or legend.get_window_extent().x1 <= _RIGHT * fig.bbox.width:
            return
        legend.remove()


def _by_method(
    panels: Sequence[Axes], methods: dict[str, list[Curve]], result: WorkPrecision, palette: Palette
) -> None:
    """Draw one method a panel, each engine in its colour, with the front as a band behind."""
    floor = _floor(result)

    def measure(p: PrecisionPoint) -> float:
        return _shown(p, floor)

    known = [(c, place) for c in result.curves for place in _places(c.points, measure)]
    front = _columns([p for _, p in _unbeaten(_useful(known), floor)])
    for ax, (method, curves) in zip(panels, methods.items(), strict=False):
        ax.plot(*front, color=palette.ink, alpha=0.16, linewidth=6.0, solid_capstyle="round")
        for curve in curves:
            beside = curve.method in _BESIDE
            ax.plot(
                *_columns(_places(curve.points, measure)),
                color=palette.engine(curve.engine),
                marker="" if beside else engine_mark(curve.engine),
                linestyle=(0, (2, 1)) if beside else "-",
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
