"""Figures of a comparison and of a sweep over robots.

Engines differ by colour and by marker.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from mbkit._escape import html, one_line
from mbkit.studies._figure_style import Palette, engine_mark, log_ticks, style
from mbkit.studies.compare.all_robots import Sweep
from mbkit.studies.compare.result import Comparison, Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Figures as SVG that takes its colours from the page, so that light and dark both read.
#
# Matplotlib draws with stand-in colours; each is then replaced by a variable of the
# page's style sheet.

#: Stand-ins for what the page says.
PAGE: Final = Palette(
    "#010101", "#020202", "#030303", "#040404", ("#050501", "#050502", "#050503", "#050504", "#050505", "#050506")
)
_VARIABLES: Final = {
    PAGE.ink: "var(--ink)",
    PAGE.muted: "var(--muted)",
    PAGE.grid: "var(--rule)",
    PAGE.bad: "var(--bad)",
    **{colour: f"var(--series{k})" for k, colour in enumerate(PAGE.series, 1)},
}
_NO_METADATA: Final[dict[str, None]] = {"Date": None, "Creator": None, "Format": None, "Type": None}


@contextmanager
def page_style(salt: str) -> Iterator[None]:
    """Give the page's style, and the same names inside an SVG every time."""
    from matplotlib import rc_context

    settings: Any = {**style(PAGE), "svg.hashsalt": f"mbkit {salt}"}
    with rc_context(settings):
        yield


@contextmanager
def canvas(width: float, height: float, salt: str) -> Iterator[tuple[Figure, Axes]]:
    """Give a figure, sized in inches, and its one pair of axes."""
    # Figure without pyplot: no window system, nothing to close.
    from matplotlib.figure import Figure

    with page_style(salt):
        fig = Figure(figsize=(width, height))
        yield fig, fig.subplots()


def svg(fig: Figure, title: str) -> str:
    """Return a figure as an element of a page; `title` is what a screen reader says."""
    stream = io.StringIO()
    fig.savefig(stream, format="svg", transparent=True, bbox_inches="tight", pad_inches=0.05, metadata=_NO_METADATA)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = text.replace("<svg", f'<svg role="img" aria-label="{html(title)}"', 1)
    # Names of parts would otherwise stand twice on a page with two figures.
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for stand_in, variable in _VARIABLES.items():
        text = text.replace(stand_in, variable)
    return text


def by_term(result: Comparison) -> dict[str, dict[str, Row]]:
    """Return term -> engine -> row, terms in their order."""
    out: dict[str, dict[str, Row]] = {}
    for row in result.rows:
        out.setdefault(row.term, {})[row.engine] = row
    return out


_GROUP_MARKS: Final = "osD^vP"
#: Where an error of exactly zero stands on an axis of digits.
_SAME: Final = 17.0


def digits(result: Comparison) -> str:
    """Draw the digits of agreement of each term and engine: worst sample, and median behind it."""
    terms = by_term(result)
    engines = result.engines
    with canvas(7.2, 0.9 + 0.36 * len(terms), "digits") as (fig, ax):
        for k, engine in enumerate(engines):
            colour, mark = PAGE.engine(engine), engine_mark(engine)
            shift = (k - (len(engines) - 1) / 2) * 0.26
            first = True
            for row, name in enumerate(terms):
                found = terms[name].get(engine)
                if found is None:
                    continue
                worst, median, y = _digits(found.relative), _digits(found.median), row + shift
                ax.plot([worst, median], [y, y], color=colour, linewidth=1.2)
                ax.plot([median], [y], "|", color=colour, markersize=8)
                label = f"{engine} against {result.reference}" if first else None
                ax.plot([worst], [y], mark, color=colour, label=label, linestyle="none")
                first = False
                if not found.passed:
                    ax.plot([worst], [y], "x", color=PAGE.bad, markersize=11, markeredgewidth=2.2)
        limit = -math.log10(result.tolerance)
        ax.axvline(limit, color=PAGE.muted, linestyle=(0, (2, 2)), linewidth=1.0)
        ax.text(limit, -0.75, f"tolerance {result.tolerance:g} ", color=PAGE.muted, ha="right", va="center", fontsize=9)
        ax.set_yticks(range(len(terms)), [one_line(t, 40) for t in terms])
        ax.set_ylim(len(terms) - 0.4, -1.1)
        _digit_axis(ax, min(_digits(r.relative) for rows in terms.values() for r in rows.values()))
        below = -0.06 - 0.55 / (0.9 + 0.36 * len(terms))
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, below), ncols=len(engines))
        return svg(fig, "Digits of agreement of each term and engine")


def _digits(error: float) -> float:
    return 0.0 if math.isnan(error) else _SAME if error == 0 else min(max(-math.log10(error), 0.0), 16.5)


def _digit_axis(ax: Axes, least: float) -> None:
    # The digits that all have say nothing; the tolerance's stay in sight.
    begin = max(0, min(10, 2 * (math.floor(least) // 2) - 2))
    ticks = range(begin, 17, 2)
    ax.set_xlim(begin - 0.1, _SAME + 0.3)
    ax.set_xticks([*ticks, _SAME], [*map(str, ticks), "same"])
    ax.set_xlabel("digits of agreement, −log₁₀ of the relative error")
    ax.grid(axis="x")
    ax.tick_params(axis="y", length=0)


def robots(result: Sweep) -> str:
    """Draw the worst error of each robot against its size."""
    groups: dict[tuple[str, ...], list[tuple[int, float]]] = {}
    for o in result.outcomes:
        if o.comparison is not None and o.comparison.worst is not None:
            error = o.comparison.worst.relative
            shown = 1.0 if math.isnan(error) else min(max(error, 1e-17), 1.0)
            groups.setdefault(o.comparison.engines, []).append((int(o.comparison.facts["nv"]), shown))
    with canvas(7.2, 3.4, "robots") as (fig, ax):
        for k, (engines, points) in enumerate(groups.items()):
            ax.plot(*zip(*points, strict=True), _GROUP_MARKS[k % 6], color=PAGE.series[k % 6], label=", ".join(engines))
        ax.set_yscale("log")
        ax.set_xlabel("velocities, nv")
        ax.set_ylabel("worst relative error")
        ax.grid()
        tolerances = {o.comparison.tolerance for o in result.outcomes if o.comparison}
        for tolerance in tolerances:
            ax.axhline(tolerance, color=PAGE.muted, linestyle=(0, (2, 2)), linewidth=1.0)
        log_ticks(ax)
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
        return svg(fig, "Worst relative error of each robot against its size")


# The terms' errors against their run times: what a digit of each term costs on each engine.

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
    label = f"tolerance {result.tolerance:g}"
    handles.append(Line2D([], [], color=PAGE.muted, linestyle=(0, (4, 3)), linewidth=0.9, label=label))
    fig.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.03, 1.0), ncols=len(handles), columnspacing=1.8)
