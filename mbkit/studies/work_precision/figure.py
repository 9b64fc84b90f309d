"""The work-precision figure: error and energy drift against run time, and one panel for each method."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
    new_figure,
)
from mbkit.studies.measurement import Measurement
from mbkit.studies.svg import MIN_DRAWN_ERROR, PAGE_WIDTH_INCHES, PANELS_PER_ROW
from mbkit.studies.work_precision.sweep import Curve, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Run time, s, error or energy drift, and whose they are.
_Place = tuple[float, float, Curve]
_Measure = Callable[[Measurement], float]

#: MuJoCo's own integrators stand in the panel of the same formula.
_SAME_FORMULA: Final = {m.name: m.own for m in METHODS.values() if m.own}
#: A run with a larger error, rad or m, is not on the front; with ten times as much it is not drawn.
MAX_USEFUL_ERROR: Final = 0.1


def figure(
    curves: Sequence[Curve], duration: float, floor: float, palette: Palette = PLAIN, only: Axes | None = None
) -> Figure:
    """Draw all curves of error against run time, thin, the best of each engine, and the front.

    At the right stands the same for energy, below one panel for each method; of these there is none where the errors
    are drawn into the axes `only`. The floor says how well the reference is known, rad or m.
    """
    with drawing(palette):
        drawn = _Drawing(curves, duration, floor if math.isfinite(floor) and floor > 0 else 0.0, palette)
        if only is not None:
            drawn.errors(only, own=False)
            return figure_of(only)
        methods = drawn.methods()
        rows = math.ceil(len(methods) / PANELS_PER_ROW)
        # Inches of the first part, and of each row of panels.
        heights = [4.4, *([0.3 + 1.5 * rows] if rows else [])]
        fig = new_figure(PAGE_WIDTH_INCHES, sum(heights))
        parts = fig.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
        # With dampers the energy is not conserved, and there is no drift to show.
        conserved = bool(drawn.places(curves, lambda p: p.energy))
        axes = parts[0].subplots(1, 1 + conserved, squeeze=False, width_ratios=(1.55, 1.0)[: 1 + conserved])[0]
        drawn.errors(axes[0], own=True)
        if conserved:
            drawn.overview(axes[1], lambda p: p.energy, EPS)
            labels = {"ylabel": "energy drift, relative", "xlabel": axes[0].get_xlabel()}
            axes[1].set(**labels, title="energy over the same runs")
        if rows:
            caption = "Method by method, each engine in its colour, the front behind"
            if any(c.method in _SAME_FORMULA for some in methods.values() for c in some):
                caption += "; dashed: MuJoCo's own integrator of the same formulas"
            parts[1].suptitle(caption, x=0.01, ha="left", fontsize=10.0)
            grid = parts[1].subplots(rows, PANELS_PER_ROW, sharex=True, sharey=True, squeeze=False)
            drawn.by_method(list(grid.flat), methods)
    return fig


def _xy(places: Sequence[_Place]) -> tuple[list[float], list[float]]:
    return [x for x, _, _ in places], [y for _, y, _ in places]


def _text(place: _Place) -> str:
    seconds, error, curve = place
    return f"{curve.engine} {curve.method}: {error:.1e} in {seconds:.2g} s"


def _front(places: Sequence[_Place], floor: float) -> list[_Place]:
    return pareto_front(places, lambda place: place[:2], floor)


@dataclass(frozen=True)
class _Drawing:
    """The curves of a study; a floor of 0 is unknown."""

    curves: Sequence[Curve]
    duration: float
    floor: float
    palette: Palette

    @property
    def engines(self) -> list[str]:
        return list(dict.fromkeys(c.engine for c in self.curves))

    def error(self, p: Measurement) -> float:
        """Return an error as it is drawn: below the reference's floor nothing is known."""
        return max(p.error, self.floor / 10) if math.isfinite(p.error) else math.nan

    def places(self, curves: Sequence[Curve], measure: _Measure) -> list[_Place]:
        points = ((p.seconds, measure(p), c) for c in curves for p in c.points)
        known = (place for place in points if place[0] > 0 and math.isfinite(place[0]) and math.isfinite(place[1]))
        return [(x, max(y, MIN_DRAWN_ERROR), c) for x, y, c in known if y <= 10 * MAX_USEFUL_ERROR]

    def methods(self) -> dict[str, list[Curve]]:
        """Return the curves of each panel, methods on most engines first."""
        some = (curve for curve in self.curves if self.places([curve], self.error))
        panels = by_key((_SAME_FORMULA.get(curve.method, curve.method), curve) for curve in some)
        return dict(sorted(panels.items(), key=lambda item: -len({c.engine for c in item[1]})))

    def front(self, ax: Axes, places: Sequence[_Place], floor: float, width: float) -> list[_Place]:
        """Draw the front of all useful points as a band, and return it."""
        front = _front([place for place in places if place[1] <= MAX_USEFUL_ERROR], floor)
        ax.plot(*_xy(front), color=self.palette.ink, alpha=0.16, linewidth=width, solid_capstyle="round")
        return front

    def errors(self, ax: Axes, *, own: bool) -> None:
        """Draw errors, with a legend; `own` is whether the figure is ours."""
        from matplotlib.lines import Line2D

        self.overview(ax, self.error, self.floor)
        ax.set_title("error: lower left is better", loc="left")
        ax.set_ylabel("largest error of q, rad or m")
        ax.set_xlabel(f"run time of {self.duration:g} s of motion, s")
        ink, muted = self.palette.ink, self.palette.muted
        looks: dict[str, dict[str, Any]] = {
            f"best of {one_line(e, 20)}": {"color": self.palette.engine(e), "marker": engine_mark(e), "linewidth": 2.0}
            for e in self.engines
        }
        looks["the front"] = {"color": ink, "alpha": 0.16, "linewidth": 9.0}
        looks["every curve"] = {"color": muted, "linewidth": 0.7}
        if self.floor > 0:
            dashed: dict[str, Any] = {"color": muted, "linestyle": (0, (4, 3)), "linewidth": 1.0}
            ax.axhline(self.floor, **dashed)
            looks[f"reference known to {self.floor:.0e}"] = dashed
        handles = [Line2D([], [], label=label, **look) for label, look in looks.items()]
        legend(ax, handles, "upper" if own else "lower", own=own, columns=7 if own else 2)

    def overview(self, ax: Axes, measure: _Measure, floor: float) -> None:
        """Draw all curves thin, the best of each engine, and the front with its names."""
        places = self.places(self.curves, measure)
        for curve in self.curves:
            colour, thin = self.palette.engine(curve.engine), _xy(self.places([curve], measure))
            name_points(ax.plot(*thin, color=colour, linewidth=0.7, alpha=0.4), [f"{curve.engine} {curve.method}"])
        front = {id(curve): curve for _, _, curve in self.front(ax, places, floor, 11.0)}
        for engine in self.engines:
            best = _front([place for place in places if place[2].engine == engine], floor)
            look: dict[str, Any] = {"color": self.palette.engine(engine), "marker": engine_mark(engine)}
            name_points(ax.plot(*_xy(best), markersize=4.5, linewidth=2.0, **look), map(_text, best))
        # The front's names have room at the left, where nothing else can be.
        self.scale(ax, places, floor, 0.35 if front else 0.0)
        for k, curve in enumerate(reversed(front.values())):
            font: dict[str, Any] = {"color": self.palette.engine(curve.engine), "fontsize": 9.0, "fontweight": "bold"}
            ax.text(0.02, 0.03 + 0.06 * k, one_line(curve.method, 30), transform=ax.transAxes, **font)

    def scale(self, ax: Axes, places: Sequence[_Place], floor: float, left: float = 0.0, ticks: int = 9) -> None:
        """Set logarithmic axes that hold all places, with a part of the decades free at the left."""
        ax.set_xscale("log")
        ax.set_yscale("log")
        if places:
            xs, ys = _xy(places)
            low, high = math.log10(min(xs)) - 0.15, math.log10(max(xs)) + 0.15
            ax.set_xlim(10 ** (low - left * (high - low)), 10**high)
            lowest = min([*ys, floor] if floor > 0 else ys) / 5
            # Above, the half of a marker.
            ax.set_ylim(lowest, max(ys) * max(2.0, (max(ys) / lowest) ** 0.05))
        ax.grid(which="major")
        log_ticks(ax, ticks)

    def by_method(self, panels: Sequence[Axes], methods: dict[str, list[Curve]]) -> None:
        """Draw one method a panel, each engine in its colour, with the front as a band behind."""
        places = self.places(self.curves, self.error)
        for k, (ax, (method, some)) in enumerate(zip(panels, methods.items(), strict=False)):
            self.front(ax, places, self.floor, 6.0)
            for curve in some:
                own, of_curve = curve.method in _SAME_FORMULA, self.places([curve], self.error)
                mark, line = ("", (0, (2, 1))) if own else (engine_mark(curve.engine), "-")
                look: dict[str, Any] = {"color": self.palette.engine(curve.engine), "marker": mark, "markersize": 3.0}
                name_points(ax.plot(*_xy(of_curve), linestyle=line, linewidth=1.3, **look), map(_text, of_curve))
            ax.set_title(one_line(method, 30), loc="left", fontsize=9.5, pad=3)
            self.scale(ax, places, self.floor, ticks=5)
            # The last of a column, whose lower neighbours may be missing.
            ax.tick_params(labelsize=8.5, labelbottom=k + PANELS_PER_ROW >= len(methods))
        for ax in panels[len(methods) :]:
            ax.remove()
