"""Figures of pages, as SVG that takes its colours from the page, so that light and dark both read.

Matplotlib draws with stand-in colours; each is then replaced by a variable of the page's style sheet. Engines differ by
colour and by marker.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from mbkit._escape import html, one_line
from mbkit.report.formatting import error_text, time_text
from mbkit.simulate.plotting.style import (
    CROSS,
    POINTS,
    Palette,
    drawing,
    engine_index,
    engine_mark,
    log_ticks,
    name_points,
)
from mbkit.studies.compare.all_robots import Sweep
from mbkit.studies.compare.result import Comparison, figure
from mbkit.studies.stress.measurements import CaseResult, Line, name_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Stand-ins for the page's colours.
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
_DASHES: Final = (0, (2, 2))
_WIDTH: Final = 10.4
#: Pixels of the smallest letters of a figure, however narrow the window.
_SMALLEST: Final = 10.0
_DOTS_PER_INCH: Final = 160


@contextmanager
def page_style(salt: str) -> Iterator[None]:
    """Give the page's style, and the same names inside an SVG every time."""
    with drawing(PAGE, {"svg.hashsalt": f"mbkit {salt}"}):
        yield


@contextmanager
def _canvas(
    salt: str, width: float, height: float, rows: int = 1, columns: int = 1, **grid: Any
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Give a figure, sized in inches, and its axes, row by row."""
    # Figure without pyplot: no window system, nothing to close.
    from matplotlib.figure import Figure

    with page_style(salt):
        fig = Figure(figsize=(width, height))
        yield fig, list(fig.subplots(rows, columns, squeeze=False, **grid).flat)


def svg(fig: Figure, title: str) -> str:
    """Return a figure as an element of a page; `title` is what a screen reader says."""
    stream = io.StringIO()
    none: dict[str, None] = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    fig.savefig(stream, format="svg", transparent=True, bbox_inches="tight", pad_inches=0.05, metadata=none)
    text = stream.getvalue()
    text = _titled(text[text.index("<svg") :])
    for size in ("width", "height"):
        text = re.sub(rf'(<svg[^>]*?) {size}="[^"]*"', r"\1", text, count=1)
    width = float(re.findall(r'viewBox="\S+ \S+ (\S+)', text)[0])
    least = width * _SMALLEST / min(map(float, re.findall(r"font(?:-size)?: ([\d.]+)px", text)), default=_SMALLEST)
    text = text.replace("<svg", f'<svg role="img" aria-label="{html(title)}" style="--least: {math.ceil(least)}px"', 1)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for stand_in, variable in _VARIABLES.items():
        text = text.replace(stand_in, variable)
    return text


def _titled(text: str) -> str:
    """Return an SVG without names of its groups, which would stand twice on a page, and with titles of its points."""
    first, *groups = text.split('<g id="')
    return first + "".join("<g" + _with_titles(*group.split('"', 1)) for group in groups)


def _with_titles(name: str, rest: str) -> str:
    """Return a group of an SVG with the texts of its points as titles, which a browser shows on hover."""
    if not name.startswith(POINTS):
        return rest
    texts = [f"<title>{each}</title>" for each in name.removeprefix(POINTS).split("\n")]
    marks = re.findall(r"<use [^>]*/>", rest)
    if len(marks) != len(texts):
        # Without markers, or with some beyond the edge.
        return rest.replace(">", f">{texts[0]}", 1)
    head, *between = re.split(r"<use [^>]*/>", rest)
    pieces = (f"<g>{title}{mark}</g>{after}" for title, mark, after in zip(texts, marks, between, strict=True))
    return head + "".join(pieces)


def image(fig: Figure, ending: str = "png") -> bytes:
    """Return a figure as a file, PNG or SVG, on white, the same every time."""
    stream = io.BytesIO()
    marks: dict[str, Any] = {"png": {"Software": "mbkit"}, "svg": {"Creator": "written by mbkit", "Date": None}}
    with drawing(more={"svg.hashsalt": "mbkit"}):
        fig.savefig(stream, format=ending, dpi=_DOTS_PER_INCH, facecolor="white", metadata=marks[ending])
    content = stream.getvalue()
    return _titled(content.decode()).encode() if ending == "svg" else content


def _legend(
    fig: Figure, engines: Sequence[str], lines: Sequence[dict[str, Any]], left: float, size: float, **options: Any
) -> None:
    """Name the engines, by colour and marker, and further lines, above the figure."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=PAGE.engine(e), marker=engine_mark(e), ls="none", markersize=size, label=one_line(e, 30))
        for e in engines
    ]
    handles += [Line2D([], [], **line) for line in lines]
    fig.legend(handles=handles, loc="upper left", bbox_to_anchor=(left, 1.0), ncols=len(handles), **options)


# The digits of each term.


def digits(result: Comparison) -> str:
    """Draw the digits of agreement of each term and engine: worst sample, and median behind it."""
    with page_style("digits"):
        return svg(figure(result, PAGE), "Digits of agreement of each term and engine")


# Many robots.

_GROUP_MARKS: Final = "osD^vP"


def robots(result: Sweep) -> str:
    """Draw the worst error of each robot against its size."""
    groups: dict[tuple[str, ...], list[tuple[int, float, str]]] = {}
    compared = [(o.robot, o.comparison) for o in result.outcomes if o.comparison is not None]
    for robot, c in compared:
        if (worst := c.worst) is not None:
            text = f"{robot}: {error_text(worst.relative)}, {worst.term} of {worst.engine}"
            groups.setdefault(c.engines, []).append((int(c.facts["nv"]), _shown(worst.relative, 1e-17), text))
    with _canvas("robots", 7.2, 3.4) as (fig, (ax,)):
        for k, (engines, points) in enumerate(groups.items()):
            nv, errors, texts = zip(*points, strict=True)
            look: dict[str, Any] = {"color": PAGE.series[k % 6], "label": ", ".join(engines)}
            name_points(ax.plot(nv, errors, _GROUP_MARKS[k % 6], **look), texts)
        ax.set_yscale("log")
        ax.set_xlabel("velocities, nv")
        ax.set_ylabel("worst relative error")
        ax.grid()
        for tolerance in {c.tolerance for _, c in compared}:
            ax.axhline(tolerance, color=PAGE.muted, linestyle=_DASHES, linewidth=1.0)
        log_ticks(ax)
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
        return svg(fig, "Worst relative error of each robot against its size")


def _shown(error: float, least: float) -> float:
    return 1.0 if math.isnan(error) else min(max(error, least), 1.0)


# What a digit of each term costs on each engine: errors against run times.

_EPS: Final = 2.0**-52
#: Where smaller errors stand, and none: below this, double precision tells nothing.
_LEAST: Final = _EPS / 64
_COLUMNS: Final = 5


def term_costs(result: Comparison) -> str:
    """Draw each term's worst relative error over the time of a call, one small panel a term.

    Terms that were not timed are left out; empty where none was.
    """
    # An engine that stands in for the oracle has no error of its own.
    timed = [r for r in result.rows if math.isfinite(r.ns) and r.ns > 0 and r.engine != r.reference]
    terms = list(dict.fromkeys(r.term for r in timed))
    if not terms:
        return ""
    count = math.ceil(len(terms) / _COLUMNS)
    height = 1.0 + 1.55 * count
    margins = {"left": 0.07, "right": 0.995, "top": 1 - 0.6 / height, "bottom": 0.5 / height}
    grid = {**margins, "wspace": 0.15, "hspace": 0.3}
    shared = {"sharex": True, "sharey": True, "gridspec_kw": grid}
    with _canvas("term costs", _WIDTH, height, count, _COLUMNS, **shared) as (fig, panels):
        level: dict[str, Any] = {"color": PAGE.muted, "linewidth": 0.9}
        dashed = {**level, "linestyle": (0, (4, 3))}
        for ax, term in zip(panels, terms, strict=False):
            ax.axhline(_EPS, **level)
            ax.axhline(result.tolerance, **dashed)
            for row in timed:
                if row.term == term:
                    place = [row.ns], [_shown(row.relative, _LEAST)]
                    point = ax.plot(*place, engine_mark(row.engine), color=PAGE.engine(row.engine), markersize=7)
                    spent = time_text(row.ns * 1e-9)
                    name_points(point, [f"{term}, {row.engine}: worst error {error_text(row.relative)} in {spent}"])
                    if not row.passed:
                        ax.plot(*place, "x", color=PAGE.bad, **CROSS)
            ax.set_title(one_line(term, 28), loc="left", fontsize=9.5, pad=3)
        panels[0].set_xscale("log")
        panels[0].set_yscale("log")
        times, errors = [r.ns for r in timed], [_shown(r.relative, _LEAST) for r in timed]
        panels[0].set_xlim(min(times) / 1.6, max(times) * 1.6)
        panels[0].set_ylim(min(*errors, _EPS) / 3, max(*errors, result.tolerance) * 3)
        for k, ax in enumerate(panels):
            if k >= len(terms):
                ax.remove()
                continue
            ax.grid(which="major")
            log_ticks(ax, 5)
            ax.tick_params(labelsize=8.5, labelbottom=k + _COLUMNS >= len(terms))
        fig.text(0.53, 0.0, "time of one call, ns", ha="center", va="bottom")
        fig.text(0.0, 0.5, "worst relative error", rotation=90, ha="left", va="center")
        levels = [level | {"label": "eps of double precision"}, dashed | {"label": f"tolerance {result.tolerance:g}"}]
        _legend(fig, result.engines, levels, 0.03, 7.0, columnspacing=1.8)
        return svg(fig, "Error of each term against the time of a call")


# The largest stable steps: measured as a bar between held and not, linear theory as a mark.

_STEP_COLUMNS: Final = 3
_THEORY: Final[dict[str, Any]] = {"color": PAGE.ink, "linewidth": 1.6, "linestyle": (0, (1.2, 0.8))}


def stable_steps(cases: Sequence[tuple[CaseResult, Sequence[Line]]]) -> str:
    """Draw each case's steps, a panel a case: from the largest that held to the least that failed, or an arrow."""
    # The rows of all panels: methods together, engine by engine.
    rows = [line.row for _, lines in cases for line in lines]
    methods = list(dict.fromkeys(row.method for row in rows))
    rows.sort(key=lambda row: (methods.index(row.method), engine_index(row.engine)))
    names = list(dict.fromkeys(map(name_of, rows)))
    columns = min(_STEP_COLUMNS, len(cases))
    count = math.ceil(len(cases) / columns)
    panel = 0.2 * len(names)
    height = 0.4 + (panel + 0.75) * count
    margins = {"left": 0.2, "right": 0.99, "top": 1 - 0.75 / height, "bottom": 0.5 / height}
    grid = {**margins, "wspace": 0.06, "hspace": 0.75 / panel}
    with _canvas("stable steps", _WIDTH, height, count, columns, sharey=True, gridspec_kw=grid) as (fig, panels):
        for ax, (case, lines) in zip(panels, cases, strict=False):
            _step_panel(ax, case, lines, names)
        for ax in panels[len(cases) :]:
            ax.remove()
        engines = sorted({row.engine for row in rows}, key=engine_index)
        _legend(fig, engines, [{**_THEORY, "label": "linear theory"}], 0.0, 6.0)
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
