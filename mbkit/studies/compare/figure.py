"""Figures of a comparison: the digits of each term, and what they cost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from mbkit._check import EPS
from mbkit._escape import one_line
from mbkit.simulate.plotting.style import (
    CROSS,
    PLAIN,
    Palette,
    engine_mark,
    figure_of,
    legend,
    log_ticks,
    name_points,
    new_figure,
)
from mbkit.studies.compare.terms import Row, by_term
from mbkit.studies.formatting import error_text, time_text
from mbkit.studies.svg import MIN_DRAWN_ERROR, PAGE, PAGE_WIDTH_INCHES, PANELS_PER_ROW, page_style, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: The place of an error of exactly zero on an axis of digits.
_DIGITS_OF_SAME: Final = 17.0


def figure(
    rows: Sequence[Row],
    engines: Sequence[str],
    reference: str,
    tolerance: float,
    palette: Palette = PLAIN,
    ax: Axes | None = None,
) -> Figure:
    """Draw the digits of agreement of each term and engine, in the style that is set."""
    terms = by_term(rows)
    own = ax is None
    ax = ax or new_figure(7.2, 1.3 + 0.36 * len(terms)).add_subplot()
    step = 0.8 / max(len(engines), 3)
    for k, engine in enumerate(engines):
        colour, label = palette.engine(engine), f"{one_line(engine, 30)} against {reference}"
        ax.plot([], [], engine_mark(engine), color=colour, label=label)
        shown = [(place, by[engine]) for place, by in enumerate(terms.values()) if engine in by]
        if not shown:
            continue
        y = [place + (k - (len(engines) - 1) / 2) * step for place, _ in shown]
        errors = {"median": [r.median for _, r in shown], "worst": [r.relative for _, r in shown]}
        ends = {kind: [_shown_digits(x) for x in some] for kind, some in errors.items()}
        ax.hlines(y, ends["median"], ends["worst"], color=colour, linewidth=1.2)
        # One line for all terms: Matplotlib's time goes by the lines.
        for kind, look in (("median", {"marker": "|", "markersize": 8}), ("worst", {"marker": engine_mark(engine)})):
            texts = [
                f"{r.term}, {engine}: {kind} error {error_text(x)}"
                for (_, r), x in zip(shown, errors[kind], strict=True)
            ]
            name_points(ax.plot(ends[kind], y, ls="none", color=colour, **look), texts)
        if failed := [(x, h) for (_, r), x, h in zip(shown, ends["worst"], y, strict=True) if not r.passed]:
            ax.plot(*zip(*failed, strict=True), "x", color=palette.bad, **CROSS)
    ax.set_yticks(range(len(terms)), [one_line(t, 40) for t in terms])
    ax.set_ylim(len(terms) - 0.4, -1.1)
    # The digits that all have say nothing; the tolerance's stay in sight.
    least = min((_shown_digits(row.relative) for row in rows), default=0.0)
    begin = max(0, min(10, 2 * (math.floor(least) // 2) - 2))
    ticks = range(begin, 17, 2)
    limit = -math.log10(tolerance)
    ax.axvline(limit, color=palette.muted, linestyle=(0, (2, 2)), linewidth=1.0)
    side = "left" if limit < (begin + _DIGITS_OF_SAME) / 2 else "right"
    text = f" tolerance {tolerance:g} "
    ax.text(limit, -0.75, text, color=palette.muted, ha=side, va="center", fontsize=9)
    ax.set_xlim(begin - 0.1, _DIGITS_OF_SAME + 0.3)
    ax.set_xticks([*ticks, _DIGITS_OF_SAME], [*map(str, ticks), "same"])
    ax.set_xlabel("digits of agreement, −log₁₀ of the relative error")
    ax.grid(axis="x")
    ax.tick_params(axis="y", length=0)
    handles = ax.get_legend_handles_labels()[0]
    legend(ax, handles, "upper", own=own, columns=3 if own and len(max(engines, key=len, default="")) < 12 else 2)
    return figure_of(ax)


def _shown_digits(error: float) -> float:
    return 0.0 if math.isnan(error) else _DIGITS_OF_SAME if error == 0 else min(max(-math.log10(error), 0.0), 16.5)


def digits(rows: Sequence[Row], engines: Sequence[str], reference: str, tolerance: float) -> str:
    """Draw the digits of agreement of each term and engine for a page."""
    with page_style("digits"):
        return svg(figure(rows, engines, reference, tolerance, PAGE), "Digits of agreement of each term and engine")


def shown_error(error: float, least: float) -> float:
    """Return an error within the axes of a figure."""
    return 1.0 if math.isnan(error) else min(max(error, least), 1.0)


# Errors of each term against run times: the price of a digit on each engine.


def term_costs(rows: Sequence[Row], engines: Sequence[str], tolerance: float) -> str:
    """Draw each term's worst relative error over the time of a call, one small panel a term.

    Terms that were not timed are left out; empty where none was.
    """
    from matplotlib.lines import Line2D

    # An engine that stands in for the oracle has no error of its own.
    timed = [r for r in rows if math.isfinite(r.ns) and r.ns > 0 and r.engine != r.reference]
    terms = list(dict.fromkeys(r.term for r in timed))
    if not terms:
        return ""
    columns = min(PANELS_PER_ROW, len(terms))
    lines = math.ceil(len(terms) / columns)
    with page_style("term costs"):
        fig = new_figure(PAGE_WIDTH_INCHES, 1.0 + 1.55 * lines)
        panels = list(fig.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).flat)
        looks: dict[str, dict[str, Any]] = {
            one_line(e, 30): {"color": PAGE.engine(e), "marker": engine_mark(e), "markersize": 7, "linestyle": "none"}
            for e in engines
        }
        level: dict[str, Any] = {"color": PAGE.muted, "linewidth": 0.9}
        dashed = {**level, "linestyle": (0, (4, 3))}
        for ax, term in zip(panels, terms, strict=False):
            ax.axhline(EPS, **level)
            ax.axhline(tolerance, **dashed)
            for row in (r for r in timed if r.term == term):
                place = [row.ns], [shown_error(row.relative, MIN_DRAWN_ERROR)]
                spent = time_text(row.ns * 1e-9)
                text = f"{term}, {row.engine}: worst error {error_text(row.relative)} in {spent}"
                name_points(ax.plot(*place, **looks[one_line(row.engine, 30)]), [text])
                if not row.passed:
                    ax.plot(*place, "x", color=PAGE.bad, **CROSS)
            ax.set_title(one_line(term, 28), loc="left", fontsize=9.5, pad=3)
        panels[0].set_xscale("log")
        panels[0].set_yscale("log")
        times, errors = [r.ns for r in timed], [shown_error(r.relative, MIN_DRAWN_ERROR) for r in timed]
        panels[0].set_xlim(min(times) / 1.6, max(times) * 1.6)
        panels[0].set_ylim(min(*errors, EPS) / 3, max(*errors, tolerance) * 3)
        for k, ax in enumerate(panels):
            ax.grid(which="major")
            log_ticks(ax, 5)
            ax.tick_params(labelsize=8.5, labelbottom=k + columns >= len(terms))
        for ax in panels[len(terms) :]:
            ax.remove()
        fig.supxlabel("time of one call, ns", fontsize=10.0)
        fig.supylabel("worst relative error", fontsize=10.0)
        looks |= {"eps of double precision": level, f"tolerance {tolerance:g}": dashed}
        handles = [Line2D([], [], label=label, **look) for label, look in looks.items()]
        legend(panels[0], handles, "upper", own=True, columns=7)
        return svg(fig, "Error of each term against the time of a call")
