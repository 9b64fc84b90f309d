"""Figures of a comparison and of a sweep over robots.

Engines differ by colour and by marker.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from mbkit._escape import one_line
from mbkit.report.drawing import PAGE, canvas, svg
from mbkit.report.reading import by_term
from mbkit.studies.all_robots import Sweep
from mbkit.studies.drawing import engine_mark, log_ticks
from mbkit.studies.result import Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["digits", "robots"]

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
        told = f"tolerance {result.tolerance:g} "
        ax.text(limit, -0.75, told, color=PAGE.muted, ha="right", va="center", fontsize=9)
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
