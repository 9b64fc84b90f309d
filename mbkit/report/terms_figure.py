"""The terms' errors against their run times: what a digit of each term costs on each engine."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from mbkit._escape import one_line
from mbkit.report.drawing import PAGE, page_style, svg
from mbkit.report.reading import by_term
from mbkit.studies.drawing import engine_mark, log_ticks
from mbkit.studies.result import Comparison, Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["term_costs"]

_EPS: Final = 2.0**-52
#: Where smaller errors stand, and none: below this, double precision tells nothing.
_LEAST: Final = _EPS / 64
_COLUMNS: Final = 5
_ROW: Final = 1.55


def term_costs(result: Comparison) -> str:
    """Draw each term's worst relative error over the time of a call, one small panel a term.

    Terms that were not timed are left out; empty where none was.
    """
    terms = {name: _timed(rows) for name, rows in by_term(result).items()}
    terms = {name: rows for name, rows in terms.items() if rows}
    if not terms:
        return ""
    count = math.ceil(len(terms) / _COLUMNS)
    with page_style("term costs"):
        from matplotlib.figure import Figure

        height = 1.0 + _ROW * count
        fig = Figure(figsize=(10.4, height))
        margins = {"left": 0.07, "right": 0.995, "top": 1 - 0.6 / height, "bottom": 0.5 / height}
        grid = fig.subplots(
            count,
            _COLUMNS,
            sharex=True,
            sharey=True,
            squeeze=False,
            gridspec_kw={**margins, "wspace": 0.15, "hspace": 0.3},
        )
        panels = list(grid.flat)
        for ax, (name, rows) in zip(panels, terms.items(), strict=False):
            _panel(ax, name, rows, result.tolerance)
        _limits(panels[0], [r for rows in terms.values() for r in rows], result.tolerance)
        for k, ax in enumerate(panels):
            if k >= len(terms):
                ax.remove()
                continue
            ax.grid(which="major")
            log_ticks(ax, 5)
            ax.tick_params(labelsize=8.5, labelbottom=k + _COLUMNS >= len(terms))
        fig.text(0.53, 0.0, "time of one call, ns", ha="center", va="bottom")
        fig.text(0.0, 0.5, "worst relative error", rotation=90, ha="left", va="center")
        _legend(fig, result)
        return svg(fig, "Error of each term against the time of a call")


def _timed(rows: dict[str, Row]) -> list[Row]:
    # An engine that stands in for the oracle has no error of its own.
    return [r for r in rows.values() if math.isfinite(r.ns) and r.ns > 0 and r.engine != r.reference]


def _shown(row: Row) -> float:
    return 1.0 if math.isnan(row.relative) else min(max(row.relative, _LEAST), 1.0)


def _panel(ax: Axes, name: str, rows: list[Row], tolerance: float) -> None:
    for y, line in ((_EPS, "-"), (tolerance, (0, (4, 3)))):
        ax.axhline(y, color=PAGE.muted, linestyle=line, linewidth=0.9)
    for row in rows:
        place = [row.ns], [_shown(row)]
        ax.plot(*place, engine_mark(row.engine), color=PAGE.engine(row.engine), markersize=7)
        if not row.passed:
            ax.plot(*place, "x", color=PAGE.bad, markersize=11, markeredgewidth=2.2)
    ax.set_title(one_line(name, 28), loc="left", fontsize=9.5, pad=3)


def _limits(ax: Axes, rows: list[Row], tolerance: float) -> None:
    ax.set_xscale("log")
    ax.set_yscale("log")
    times, errors = [r.ns for r in rows], [_shown(r) for r in rows]
    ax.set_xlim(min(times) / 1.6, max(times) * 1.6)
    ax.set_ylim(min(*errors, _EPS) / 3, max(*errors, tolerance) * 3)


def _legend(fig: Figure, result: Comparison) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=PAGE.engine(e), marker=engine_mark(e), linestyle="none", markersize=7, label=e)
        for e in result.engines
    ]
    handles.append(Line2D([], [], color=PAGE.muted, linewidth=0.9, label="eps of double precision"))
    told = f"tolerance {result.tolerance:g}"
    handles.append(Line2D([], [], color=PAGE.muted, linestyle=(0, (4, 3)), linewidth=0.9, label=told))
    fig.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.03, 1.0), ncols=len(handles), columnspacing=1.8)
