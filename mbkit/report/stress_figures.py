"""The largest stable steps as a figure: measured as a bar between held and not, linear theory as a mark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from mbkit._escape import one_line
from mbkit.report.drawing import PAGE, page_style, svg
from mbkit.report.stress_steps import StepCase, StepLine
from mbkit.studies.drawing import engine_index, engine_mark, log_ticks
from mbkit.studies.stress.reading import name_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["stable_steps"]

_COLUMNS: Final = 3
_ROW: Final = 0.2
_WIDTH: Final = 10.4


def stable_steps(cases: Sequence[StepCase]) -> str:
    """Draw each case's steps, a panel a case and a line an engine and method.

    A method's steps are from the largest that held to the least that did not; an arrow where none failed.
    """
    names = _names(cases)
    columns = min(_COLUMNS, len(cases))
    count = math.ceil(len(cases) / columns)
    with page_style("stable steps"):
        from matplotlib.figure import Figure

        panel = _ROW * len(names) + 0.75
        height = 0.4 + panel * count
        fig = Figure(figsize=(_WIDTH, height))
        margins = {"left": 0.2, "right": 0.99, "top": 1 - 0.75 / height, "bottom": 0.5 / height}
        gaps = {"wspace": 0.06, "hspace": 0.75 / (panel - 0.75)}
        grid = fig.subplots(count, columns, sharey=True, squeeze=False, gridspec_kw={**margins, **gaps})
        for k, ax in enumerate(grid.flat):
            if k >= len(cases):
                ax.remove()
                continue
            _panel(ax, cases[k], names)
        _legend(fig, cases)
        return svg(fig, "Largest stable step of each method")


def _names(cases: Sequence[StepCase]) -> list[str]:
    """Return the rows of all panels: methods together, engine by engine."""
    found = {(s.line.row.method, engine_index(s.line.row.engine)): s for c in cases for s in c.lines}
    first = {s.line.row.method: k for k, s in reversed([*enumerate(s for c in cases for s in c.lines)])}
    return [name_of(found[key].line.row) for key in sorted(found, key=lambda key: (first[key[0]], key[1]))]


def _panel(ax: Axes, case: StepCase, names: list[str]) -> None:
    steps = [s for s in case.case.values if s > 0]
    ax.set_xscale("log")
    ax.set_ylim(len(names) - 0.4, -0.6)
    if steps:
        ax.set_xlim(min(steps) / 2, max(steps) * 2)
    for step in case.lines:
        _bar(ax, names.index(name_of(step.line.row)), step)
    ax.set_yticks(range(len(names)), [one_line(n, 34) for n in names], fontsize=8.5)
    ax.set_title(one_line(case.case.name, 34), loc="left", fontsize=9.5, pad=3)
    ax.grid(axis="x", which="major")
    log_ticks(ax, 6)
    ax.tick_params(axis="y", length=0)
    ax.tick_params(axis="x", labelsize=8.5)
    ax.set_xlabel("step, s", fontsize=9)


def _bar(ax: Axes, y: int, step: StepLine) -> None:
    row, broken = step.line.row, step.line.broken
    colour, mark = PAGE.engine(row.engine), engine_mark(row.engine)
    if broken.held is not None and broken.failed is not None:
        ax.plot([broken.held, broken.failed], [y, y], color=colour, linewidth=1.4)
    if broken.failed is not None:
        ax.plot([broken.failed], [y], "|", color=colour, markersize=7, markeredgewidth=1.4)
    if broken.held is not None:
        ax.plot([broken.held], [y], mark if broken.failed is not None else ">", color=colour, markersize=5.5)
    if row.theory is not None and 0 < row.theory < math.inf:
        dashes = (0, (1.2, 0.8))
        ax.plot([row.theory] * 2, [y - 0.45, y + 0.45], color=PAGE.ink, linewidth=1.6, linestyle=dashes)


def _legend(fig: Figure, cases: Sequence[StepCase]) -> None:
    from matplotlib.lines import Line2D

    engines = sorted({s.line.row.engine for c in cases for s in c.lines}, key=engine_index)
    handles = [
        Line2D([], [], color=PAGE.engine(e), marker=engine_mark(e), linestyle="none", label=one_line(e, 30))
        for e in engines
    ]
    handles.append(Line2D([], [], color=PAGE.ink, linewidth=1.6, linestyle=(0, (1.2, 0.8)), label="linear theory"))
    fig.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.0, 1.0), ncols=len(handles))
