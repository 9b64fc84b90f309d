"""The figures of a stress result: the map of one case, and how far each engine held in all of them.

A map has a row for each engine and method and a column for each value. Colour is the digits of error:
blue where it held, orange to red where it did not; what ended otherwise is grey and says how. Marks and
words say the same, so that it reads in grey.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from mbkit._escape import one_line
from mbkit.errors import require_known
from mbkit.simulate.plotting.style import PLAIN, Palette, drawing, engine_mark, figure_of, legend, new_figure
from mbkit.studies.measurement import Measurement, Outcome
from mbkit.studies.stress.measurements import CaseResult, engines_of
from mbkit.studies.svg import PAGE_WIDTH_INCHES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Where one shade ends and the next begins, in digits of error.
_SHADE_DIGITS: Final = (12.0, 9.0, 6.0, 3.0)
#: The shades on white paper: h held and w did not, by digits from many to few; grossly wrong;
#: ended otherwise and said so; ended without a word; not run.
SHADES: Final = {
    **dict(zip(("h0", "h1", "h2", "h3", "h4"), ("#edf5fb", "#d5e8f5", "#bcdaef", "#a0cae7", "#83b8dd"), strict=True)),
    **dict(zip(("w0", "w1", "w2", "w3", "w4"), ("#fdf1d8", "#fce4b8", "#fad592", "#f5bd70", "#eda65c"), strict=True)),
    "gross": "#dd6244",
    "end": "#d4d8dd",
    "mute": "#aab1ba",
    "none": "#ffffff",
}
_SHADES: Final[dict[Outcome, str]] = {
    **dict.fromkeys(("warned", "silent"), "gross"),
    **dict.fromkeys(("diverged", "refused", "slow"), "end"),
    **dict.fromkeys(("nan", "died"), "mute"),
    **dict.fromkeys(("not run", "unjudged"), "none"),
}
#: Outcomes whose words in a cell are others than their names.
WORDS: Final[dict[Outcome, str]] = {"nan": "NaN", "not run": ""}
_MARKS: Final[dict[Outcome, str]] = {"silent": "✗ ", "warned": "! ", "unjudged": "? "}
_DASHED: Final = (0, (1.5, 1))


def shade(cell: Measurement, outcome: Outcome) -> str:
    """Return the name of a cell's shade, a key of `SHADES`."""
    if outcome in _SHADES:
        return _SHADES[outcome]
    digits = math.inf if cell.seen == 0 else -math.log10(cell.seen) if cell.seen > 0 else -math.inf
    return ("h" if outcome == "held" else "w") + str(sum(digits < d for d in _SHADE_DIGITS))


def cell_text(cell: Measurement, outcome: Outcome, short: bool = False) -> str:
    """Return the text of a cell: its error, with a mark where it is grossly wrong, or how it ended."""
    if outcome in ("diverged", "nan", "refused", "slow", "died", "not run"):
        word = WORDS.get(outcome, outcome)
        return word[:3] if short and len(word) > 4 else word
    if outcome == "unjudged" and math.isnan(cell.error):
        return "?"
    return _MARKS.get(outcome, "") + error_short(cell.seen)


def error_short(x: float) -> str:
    """Return an error as short as a cell is: one digit."""
    if not math.isfinite(x):
        return "NaN" if math.isnan(x) else "∞"
    if 0.01 <= x < 999.5 or x == 0:
        return f"{x:.1g}" if x < 9.5 else f"{x:.0f}"
    return _exponent(f"{x:.0e}")


def number_text(x: float) -> str:
    """Return a swept number as short as it can be: 256, 0.01, 1e6, 2.5e-9."""
    if not math.isfinite(x) or x == 0 or 1e-3 <= abs(x) < 1e4:
        return f"{x:g}".replace("inf", "∞")
    return _exponent(f"{x:.2e}")


def _exponent(text: str) -> str:
    text = re.sub(r"\.?0+e", "e", text) if "." in text else text
    return re.sub(r"e([+-])0*(?=\d)", lambda m: "e" + m.group(1).strip("+"), text)


def figure(
    cases: Sequence[CaseResult], case: str | None = None, palette: Palette = PLAIN, ax: Axes | None = None
) -> Figure:
    """Draw the map of one case, by default of the only one, or how far each engine held in every case."""
    known = {c.name: c for c in cases}
    if case is not None:
        require_known("case", known, case)
    elif len(known) == 1:
        case = next(iter(known))
    with drawing(palette):
        return _overview(cases, palette, ax) if case is None else _map(known[case], palette, ax)


def _axes(ax: Axes | None, rows: int, height: float) -> Axes:
    """Return axes with so many rows of a height, in; in a new figure where none is given."""
    ax = ax or new_figure(PAGE_WIDTH_INCHES, 1.5 + height * max(rows, 1)).add_subplot()
    ax.set_ylim(max(rows, 1) - 0.5, -0.5)
    return ax


def _map(case: CaseResult, palette: Palette, given: Axes | None) -> Figure:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch, Rectangle

    count, ax = len(case.values), _axes(given, len(case.rows), 0.24)
    breaks: dict[str, Any] = {"color": palette.ink, "linewidth": 2.2}
    theory: dict[str, Any] = {"color": palette.series[3], "linewidth": 2.0, "linestyle": _DASHED}
    for y, line in enumerate(case._lines):
        for x, (cell, how) in enumerate(zip(line.row.cells[:count], line.outcomes, strict=False)):
            face, weight = SHADES[shade(cell, how)], "bold" if how == "silent" else "normal"
            ax.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=face, edgecolor="white", linewidth=1.0))
            # More columns have no room for words.
            text = cell_text(cell, how, short=count > 14)
            # Cells are light on every paper.
            ax.text(x, y, text, ha="center", va="center", fontsize=7.5, weight=weight, color=PLAIN.ink)
        if line.broken.failed is not None:
            ax.vlines(line.reach - 0.5, y - 0.5, y + 0.5, **breaks)
        if 0 < (beyond := sum(v <= (line.row.theory or 0.0) for v in case.values)) < count:
            ax.vlines(beyond - 0.5, y - 0.5, y + 0.5, **theory)
    ax.set_xlim(-0.5, max(count, 1) - 0.5)
    ax.set_xticks(range(count), [number_text(v) for v in case.values], fontsize=8.5)
    names = [one_line(f"{x.row._name}  {x.row.setting}".rstrip(), 44) for x in case._lines]
    ax.set_yticks(range(len(names)), names, fontsize=8.5)
    ax.tick_params(length=0)
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.set_xlabel(one_line(", ".join(filter(None, (case.parameter, case.unit))), 90))
    if not names:
        ax.text(0.5, 0.5, "nothing was run", transform=ax.transAxes, ha="center", color=palette.muted)
    about = one_line(f"{case.name}: {case.about}", 125)
    if given is None:
        # A sentence is longer than the axes, so it begins at the figure's left edge.
        figure_of(ax).suptitle(about, x=0.01, ha="left", fontsize=10.0)
    else:
        ax.set_title(textwrap.fill(about, 45), loc="left")
    kinds = {
        "h2": f"held: error ≤ {number_text(case.bar)}",
        "w2": "inaccurate",
        "gross": "wrong: ! with a warning, ✗ in silence",
        "end": "ended otherwise",
    }
    handles = [Patch(facecolor=SHADES[name], label=label) for name, label in kinds.items()]
    lines = [Line2D([], [], label="breaks", **breaks), Line2D([], [], label="linear theory", **theory)]
    legend(ax, [*handles, *lines], "lower", own=given is None, columns=6 if given is None else 2)
    return figure_of(ax)


def _overview(cases: Sequence[CaseResult], palette: Palette, given: Axes | None) -> Figure:
    """Draw how much of each sweep every engine's furthest method held, and mbkit's own choice."""
    from matplotlib.lines import Line2D

    cases = [c for c in cases if c.values]
    ax, engines = _axes(given, len(cases), 0.32), engines_of(cases)
    # Marks of a row stand one below the other, none on another.
    apart = 0.8 / max(len(engines), 3)
    auto: dict[str, Any] = {"color": palette.ink, "marker": "|", "linestyle": "none"}
    for y, case in enumerate(cases):
        for k, engine in enumerate(engines):
            if engine in case._best:
                place = [case._best[engine].reach / len(case.values)], [y + (k - (len(engines) - 1) / 2) * apart]
                ax.plot(*place, engine_mark(engine), color=palette.engine(engine), markersize=5.0)
        if case._choice is not None:
            place = [case._choice.reach / len(case.values)], [y]
            ax.plot(*place, markersize=22, markeredgewidth=1.4, zorder=1, **auto)
        span = f"{case.parameter} {number_text(case.values[0])} … {number_text(case.values[-1])} {case.unit}".rstrip()
        ax.text(1.03, y, one_line(span, 44), va="center", fontsize=8.0, color=palette.muted)
    ax.set_yticks(range(len(cases)), [one_line(c.name, 34) for c in cases])
    ax.set_xlim(-0.02, 1.02)
    ax.set_xticks([0, 0.25, 0.5, 0.75, 1], ["nothing", "¼", "½", "¾", "all"])
    ax.set_xlabel("part of the sweep that held, mild to extreme")
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="x")
    handles = [
        Line2D(
            [],
            [],
            color=palette.engine(e),
            marker=engine_mark(e),
            linestyle="none",
            label=f"{one_line(e, 30)}, its best",
        )
        for e in engines
    ]
    if any(case._choice for case in cases):
        handles.append(Line2D([], [], markersize=12, label="method auto", **auto))
    if handles:
        legend(ax, handles, "upper", own=given is None, columns=4 if given is None else 2)
    return figure_of(ax)
