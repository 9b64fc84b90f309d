"""Figures as SVG that takes its colours from the page, so that light and dark both read.

Matplotlib draws with stand-in colours; each is then replaced by a variable of the
page's style sheet. Engines differ by colour and by marker, methods by line and marker.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from mbkit.report.numbers import error_text, inline
from mbkit.report.reading import by_term, curves
from mbkit.studies.all_robots import Sweep
from mbkit.studies.result import Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["digits", "error_against_time", "robots"]

#: Stand-in -> what the page says; six series, as many as engines can be told apart.
_INK: Final = "#010101"
_MUTED: Final = "#020202"
_GRID: Final = "#030303"
_BAD: Final = "#040404"
_SERIES: Final = ("#050501", "#050502", "#050503", "#050504", "#050505", "#050506")
_PAGE: Final = {
    _INK: "var(--ink)",
    _MUTED: "var(--muted)",
    _GRID: "var(--rule)",
    _BAD: "var(--bad)",
    **{colour: f"var(--series{k})" for k, colour in enumerate(_SERIES, 1)},
}
_ENGINE_MARKS: Final = "osD^vP"
_METHOD_MARKS: Final = "osD^vPX*"
_METHOD_LINES: Final = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))
_STYLE: Final[dict[str, Any]] = {
    "svg.fonttype": "none",
    # A dollar sign in a name does not begin a formula.
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.size": 10.0,
    "text.color": _INK,
    "axes.edgecolor": _MUTED,
    "axes.labelcolor": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.axisbelow": True,
    "xtick.color": _MUTED,
    "ytick.color": _MUTED,
    "xtick.labelcolor": _INK,
    "ytick.labelcolor": _INK,
    "grid.color": _GRID,
    "grid.linewidth": 0.8,
    "lines.linewidth": 1.6,
    "lines.markersize": 6.0,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
}
#: Where an error of exactly zero stands on an axis of digits.
_SAME: Final = 17.0


def digits(result: Comparison) -> str:
    """Draw the digits of agreement of each term and engine: worst sample, and median behind it."""
    terms = by_term(result)
    engines = result.engines
    with _figure(7.2, 0.9 + 0.36 * len(terms), "digits") as (fig, ax):
        for k, engine in enumerate(engines):
            colour, mark = _SERIES[result.engines.index(engine) % 6], _ENGINE_MARKS[result.engines.index(engine) % 6]
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
                    ax.plot([worst], [y], "x", color=_BAD, markersize=11, markeredgewidth=2.2)
        limit = -math.log10(result.tolerance)
        ax.axvline(limit, color=_MUTED, linestyle=(0, (2, 2)), linewidth=1.0)
        told = f"tolerance {result.tolerance:g} "
        ax.text(limit, -0.75, told, color=_MUTED, ha="right", va="center", fontsize=9)
        ax.set_yticks(range(len(terms)), [inline(t, 40) for t in terms])
        ax.set_ylim(len(terms) - 0.4, -1.1)
        _digit_axis(ax, min(_digits(r.relative) for rows in terms.values() for r in rows.values()))
        below = -0.06 - 0.55 / (0.9 + 0.36 * len(terms))
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, below), ncols=len(engines))
        return _svg(fig, "Digits of agreement of each term and engine")


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


def error_against_time(result: Comparison, horizon: float) -> str:
    """Draw the error of rollouts against their run time, one line per engine and method."""
    found = curves(result)
    methods = list(dict.fromkeys(method for _, method in found))
    floor = result.reference_floor
    with _figure(7.2, 4.6, "costs") as (fig, ax):
        for (engine, method), points in found.items():
            k, m = result.engines.index(engine) if engine in result.engines else 5, methods.index(method)
            seen = [p for p in points if p.error > 0]
            ax.plot(
                [p.seconds for p in seen],
                [p.error for p in seen],
                color=_SERIES[k % 6],
                marker=_METHOD_MARKS[m % 8],
                linestyle=_METHOD_LINES[m % 5],
                label=inline(method if method.startswith(engine) else f"{engine} {method}", 40),
            )
        ax.set_xscale("log")
        ax.set_yscale("log")
        if floor > 0 and math.isfinite(floor):
            told = f"reference known to {error_text(floor)}"
            ax.axhline(floor, color=_MUTED, linestyle=(0, (2, 2)), linewidth=1.0, label=told)
            ax.set_ylim(bottom=min(floor / 5, ax.get_ylim()[0]))
        ax.set_xlabel(f"run time of {horizon:g} s of motion, s")
        ax.set_ylabel("largest error of q, rad or m")
        ax.grid(which="major")
        _log_ticks(ax)
        ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), handlelength=3.2)
        return _svg(fig, "Error of rollouts against run time")


def robots(result: Sweep) -> str:
    """Draw the worst error of each robot against its size."""
    groups: dict[tuple[str, ...], list[tuple[int, float]]] = {}
    for o in result.outcomes:
        if o.comparison is not None and o.comparison.worst is not None:
            error = o.comparison.worst.relative
            shown = 1.0 if math.isnan(error) else min(max(error, 1e-17), 1.0)
            groups.setdefault(o.comparison.engines, []).append((int(o.comparison.facts["nv"]), shown))
    with _figure(7.2, 3.4, "robots") as (fig, ax):
        for k, (engines, points) in enumerate(groups.items()):
            ax.plot(*zip(*points, strict=True), _ENGINE_MARKS[k % 6], color=_SERIES[k % 6], label=", ".join(engines))
        ax.set_yscale("log")
        ax.set_xlabel("velocities, nv")
        ax.set_ylabel("worst relative error")
        ax.grid()
        tolerances = {o.comparison.tolerance for o in result.outcomes if o.comparison}
        for tolerance in tolerances:
            ax.axhline(tolerance, color=_MUTED, linestyle=(0, (2, 2)), linewidth=1.0)
        _log_ticks(ax)
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
        return _svg(fig, "Worst relative error of each robot against its size")


def _log_ticks(ax: Axes) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    def power(x: float, _: object) -> str:
        return f"10{str(round(math.log10(x))).translate(_SUPERSCRIPT)}" if x > 0 else ""

    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() == "log":
            low, high = (math.log10(x) for x in axis.get_view_interval())
            if math.floor(high) - math.ceil(low) < 1:
                # Whole decades, so that there are two labels at least.
                axis.set_view_interval(10.0 ** math.floor(low), 10.0 ** math.ceil(high), ignore=True)
            axis.set_major_locator(LogLocator(10, numticks=9))
            axis.set_major_formatter(FuncFormatter(power))
            axis.set_minor_formatter(NullFormatter())
            axis.set_tick_params(which="minor", length=0)


_SUPERSCRIPT: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@contextmanager
def _figure(width: float, height: float, salt: str) -> Iterator[tuple[Figure, Axes]]:
    # Figure without pyplot: no window system, nothing to close.
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: Any = {**_STYLE, "svg.hashsalt": f"mbkit {salt}"}
    with rc_context(style):
        fig = Figure(figsize=(width, height))
        yield fig, fig.subplots()


def _svg(fig: Figure, title: str) -> str:
    stream = io.StringIO()
    fig.savefig(stream, format="svg", transparent=True, bbox_inches="tight", pad_inches=0.05, metadata=_NO_METADATA)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = text.replace("<svg", f'<svg role="img" aria-label="{title}"', 1)
    # Names of parts would otherwise stand twice on a page with two figures.
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for stand_in, variable in _PAGE.items():
        text = text.replace(stand_in, variable)
    return text


_NO_METADATA: Final[dict[str, None]] = {"Date": None, "Creator": None, "Format": None, "Type": None}
