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
from mbkit.errors import UnknownNameError
from mbkit.simulate.plotting.style import (
    PLAIN,
    Palette,
    drawing,
    engine_index,
    engine_mark,
    figure_of,
    legend,
    log_ticks,
    name_points,
)
from mbkit.studies.measurement import Measurement, Outcome
from mbkit.studies.stress.measurements import CaseResult, Line, Overview, engines_of, fractional_index, name_of
from mbkit.studies.svg import PAGE, PAGE_WIDTH_INCHES, canvas, page_legend, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

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
    "warned": "gross",
    "silent": "gross",
    "diverged": "end",
    "refused": "end",
    "slow": "end",
    "nan": "mute",
    "died": "mute",
    "not run": "none",
    "unjudged": "none",
}
#: Outcome -> its word in a wide and in a narrow cell.
WORDS: Final[dict[Outcome, tuple[str, str]]] = {
    "diverged": ("diverged", "div"),
    "nan": ("NaN", "NaN"),
    "refused": ("refused", "ref"),
    "slow": ("slow", "slow"),
    "died": ("died", "died"),
    "not run": ("", ""),
}
_MARKS: Final[dict[Outcome, str]] = {"silent": "✗ ", "warned": "! ", "unjudged": "? "}
#: More columns than these have no room for words.
MAX_ROOMY_COLUMNS: Final = 14
_DASHED: Final = (0, (1.5, 1))


def shade(cell: Measurement, outcome: Outcome) -> str:
    """Return the name of a cell's shade, a key of `SHADES`."""
    if outcome in _SHADES:
        return _SHADES[outcome]
    digits = math.inf if cell.seen == 0 else -math.log10(cell.seen) if cell.seen > 0 else -math.inf
    return ("h" if outcome == "held" else "w") + str(sum(digits < d for d in _SHADE_DIGITS))


def cell_text(cell: Measurement, outcome: Outcome, short: bool = False) -> str:
    """Return what a cell says: its error, with a mark where it is grossly wrong, or how it ended."""
    if outcome in WORDS:
        return WORDS[outcome][short]
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
    if case is not None and case not in known:
        raise UnknownNameError("case", case, known)
    if case is None and len(known) == 1:
        case = next(iter(known))
    with drawing(palette):
        return _overview(cases, palette, ax) if case is None else _map(known[case], palette, ax)


def _axes(ax: Axes | None, rows: int, height: float) -> Axes:
    """Return axes with so many rows of a height, in; in a new figure where none is given."""
    # Figure without pyplot: no window system, nothing to close.
    from matplotlib.figure import Figure

    return ax or Figure(figsize=(PAGE_WIDTH_INCHES, 1.5 + height * max(rows, 1)), layout="constrained").add_subplot()


def _map(case: CaseResult, palette: Palette, given: Axes | None) -> Figure:
    """Draw one case."""
    from matplotlib.patches import Rectangle

    ranked, count = Overview(case).lines, len(case.values)
    names = [one_line(f"{name_of(x.row)}  {x.row.setting}".rstrip(), 44) for x in ranked]
    ax = _axes(given, len(ranked), 0.24)
    for y, line in enumerate(ranked):
        for x, (cell, how) in enumerate(zip(line.row.cells[:count], line.outcomes, strict=False)):
            face, weight = SHADES[shade(cell, how)], "bold" if how == "silent" else "normal"
            ax.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=face, edgecolor="white", linewidth=1.0))
            text = cell_text(cell, how, short=count > MAX_ROOMY_COLUMNS)
            # Cells are light on every paper.
            ax.text(x, y, text, ha="center", va="center", fontsize=7.5, weight=weight, color=PLAIN.ink)
        ends = [y - 0.5, y + 0.5]
        if line.broken.failed is not None:
            ax.plot([line.reach - 0.5] * 2, ends, color=palette.ink, linewidth=2.2, solid_capstyle="butt")
        # Before the first value beyond what linear theory allows.
        at = math.nan if line.row.theory is None else fractional_index(case.values, line.row.theory)
        if at < count - 1:
            ax.plot([math.floor(at) + 0.5] * 2, ends, color=palette.series[3], linewidth=2.0, linestyle=_DASHED)
    ax.set_xlim(-0.5, max(count, 1) - 0.5)
    ax.set_ylim(max(len(ranked), 1) - 0.5, -0.5)
    ax.set_xticks(range(count), [number_text(v) for v in case.values], fontsize=8.5)
    ax.set_yticks(range(len(ranked)), names, fontsize=8.5)
    ax.tick_params(length=0)
    ax.spines[["left", "bottom"]].set_visible(False)
    unit = f", {case.unit}" if case.unit else ""
    ax.set_xlabel(one_line(f"{case.parameter}{unit}", 90))
    if not ranked:
        ax.text(0.5, 0.5, "nothing was run", transform=ax.transAxes, ha="center", color=palette.muted)
    about = one_line(f"{case.name}: {case.about}", 125)
    if given is None:
        # A sentence is longer than the axes, so it begins at the figure's left edge.
        figure_of(ax).suptitle(about, x=0.01, ha="left", fontsize=10.0)
    else:
        ax.set_title(textwrap.fill(about, 45), loc="left")
    legend(ax, _kinds(case.bar, palette), "lower", own=given is None, columns=6 if given is None else 2)
    return figure_of(ax)


def _kinds(bar: float, palette: Palette) -> list[Patch | Line2D]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Patch(facecolor=SHADES["h2"], label=f"held: error ≤ {number_text(bar)}"),
        Patch(facecolor=SHADES["w2"], label="inaccurate"),
        Patch(facecolor=SHADES["gross"], label="wrong: ! with a warning, ✗ in silence"),
        Patch(facecolor=SHADES["end"], label="ended otherwise"),
        Line2D([], [], color=palette.ink, linewidth=2.2, label="breaks"),
        Line2D([], [], color=palette.series[3], linewidth=1.8, linestyle=_DASHED, label="linear theory"),
    ]


def _overview(cases: Sequence[CaseResult], palette: Palette, given: Axes | None) -> Figure:
    """Draw how much of each sweep every engine's furthest method held, and mbkit's own choice."""
    from matplotlib.lines import Line2D

    cases = [c for c in cases if c.values]
    ax = _axes(given, len(cases), 0.32)
    engines, chosen = engines_of(cases), False
    # Marks of a row stand one below the other, none on another.
    apart = 0.8 / max(len(engines), 3)
    for y, case in enumerate(cases):
        size, own = len(case.values), Overview(case)
        leaders, choice = own.best, own.choice
        for k, engine in enumerate(engines):
            if engine in leaders:
                shift = (k - (len(engines) - 1) / 2) * apart
                colour, mark = palette.engine(engine), engine_mark(engine)
                ax.plot([leaders[engine].reach / size], [y + shift], mark, color=colour, markersize=5.0)
        if choice is not None:
            chosen = True
            ax.plot([choice.reach / size], [y], "|", color=palette.ink, markersize=22, markeredgewidth=1.4, zorder=1)
        span = f"{case.parameter} {number_text(case.values[0])} … {number_text(case.values[-1])} {case.unit}".rstrip()
        ax.text(1.03, y, one_line(span, 44), va="center", fontsize=8.0, color=palette.muted)
    ax.set_yticks(range(len(cases)), [one_line(c.name, 34) for c in cases])
    ax.set_ylim(max(len(cases), 1) - 0.5, -0.5)
    ax.set_xlim(-0.02, 1.02)
    ax.set_xticks([0, 0.25, 0.5, 0.75, 1], ["nothing", "¼", "½", "¾", "all"])
    ax.set_xlabel("part of the sweep that held, mild to extreme")
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="x")
    handles = [
        Line2D([], [], color=palette.engine(e), marker=engine_mark(e), linestyle="none", label=f"{e}, its best")
        for e in engines
    ]
    if chosen:
        auto = Line2D([], [], color=palette.ink, marker="|", linestyle="none", markersize=12, label="method auto")
        handles.append(auto)
    if handles:
        legend(ax, handles, "upper", own=given is None, columns=4 if given is None else 2)
    return figure_of(ax)


# The largest stable steps: measured as a bar between held and not, linear theory as a mark.

_PANELS_PER_ROW: Final = 3
_THEORY: Final[dict[str, Any]] = {"color": PAGE.ink, "linewidth": 1.6, "linestyle": (0, (1.2, 0.8))}


def stable_steps(cases: Sequence[tuple[CaseResult, Sequence[Line]]]) -> str:
    """Draw each case's steps, a panel a case: from the largest that held to the least that failed, or an arrow."""
    # The rows of all panels: methods together, engine by engine.
    rows = [line.row for _, lines in cases for line in lines]
    methods = list(dict.fromkeys(row.method for row in rows))
    rows.sort(key=lambda row: (methods.index(row.method), engine_index(row.engine)))
    names = list(dict.fromkeys(map(name_of, rows)))
    columns = min(_PANELS_PER_ROW, len(cases))
    panel = 0.2 * len(names)
    height = 0.4 + (panel + 0.75) * math.ceil(len(cases) / columns)
    margins = {"left": 0.2, "right": 0.99, "top": 1 - 0.75 / height, "bottom": 0.5 / height}
    grid = {**margins, "wspace": 0.06, "hspace": 0.75 / panel}
    shape: dict[str, Any] = {"panels": len(cases), "columns": columns, "sharey": True, "gridspec_kw": grid}
    with canvas("stable steps", height, **shape) as (fig, panels):
        for ax, (case, lines) in zip(panels, cases, strict=True):
            _step_panel(ax, case, lines, names)
        engines = sorted({row.engine for row in rows}, key=engine_index)
        page_legend(fig, engines, [{**_THEORY, "label": "linear theory"}], 0.0, 6.0)
        return svg(fig, "Largest stable step of each method")


def _step_panel(ax: Axes, case: CaseResult, lines: Sequence[Line], names: list[str]) -> None:
    ax.set_xscale("log")
    ax.set_ylim(len(names) - 0.4, -0.6)
    if steps := [s for s in case.values if s > 0]:
        ax.set_xlim(min(steps) / 2, max(steps) * 2)
    for line in lines:
        y, held, failed, theory = names.index(name_of(line.row)), line.broken.held, line.broken.failed, line.row.theory
        colour, mark = PAGE.engine(line.row.engine), engine_mark(line.row.engine)
        name = name_of(line.row)
        if held is not None and failed is not None:
            ax.plot([held, failed], [y, y], color=colour, linewidth=1.4)
        if failed is not None:
            end = ax.plot([failed], [y], "|", color=colour, markersize=7, markeredgewidth=1.4)
            name_points(end, [f"{name}: did not hold at {failed:g} s"])
        if held is not None:
            point = ax.plot([held], [y], mark if failed is not None else ">", color=colour, markersize=5.5)
            name_points(point, [f"{name}: held to {held:g} s"])
        if theory is not None and 0 < theory < math.inf:
            ax.plot([theory] * 2, [y - 0.45, y + 0.45], **_THEORY)
    ax.set_yticks(range(len(names)), [one_line(n, 34) for n in names], fontsize=8.5)
    ax.set_title(one_line(case.name, 34), loc="left", fontsize=9.5, pad=3)
    ax.grid(axis="x", which="major")
    log_ticks(ax, 6)
    ax.tick_params(axis="y", length=0)
    ax.tick_params(axis="x", labelsize=8.5)
    ax.set_xlabel("step, s", fontsize=9)
