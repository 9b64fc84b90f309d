"""The largest stable step of each method, against linear theory, and the rule that follows for a step."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mbkit._escape import one_line
from mbkit.report.figures import PAGE, page_style, svg
from mbkit.report.stress_view import Overview
from mbkit.studies._figure_style import engine_index, engine_mark, log_ticks
from mbkit.studies.stress.figure import number_text
from mbkit.studies.stress.measurements import CaseResult, Line, name_of, place

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: What a fact's name begins with that a step is to be short against: "fastest frequency", "fastest rate".
_FASTEST: Final = "fastest"
#: Ends that say nothing about stability.
_OTHER: Final = ("slow", "refused", "died")


@dataclass(frozen=True)
class StepLine:
    """One engine and method on a case whose step is swept, and what was measured against linear theory, in words."""

    line: Line
    verdict: str


@dataclass(frozen=True)
class StepCase:
    """A case whose step is swept, where it stands on the page, and its rows, the largest stable step first."""

    case: CaseResult
    anchor: str
    lines: tuple[StepLine, ...]


@dataclass(frozen=True)
class Bound:
    """Steps times the fastest frequency or rate ω, over all cases that have one."""

    held: float  # up to here it held in every case; 0: nowhere
    failed: float  # NaN: all held
    theory: float  # the least limit; infinite: no limit, NaN: unknown

    @property
    def words(self) -> str:
        """The rule for a step."""
        if math.isnan(self.failed):
            return f"no limit found up to {_two(self.held)} / ω"
        return f"dt ≤ {_two(self.held)} / ω" if self.held else f"none tried held, the least {_two(self.failed)} / ω"


@dataclass(frozen=True)
class Rule:
    """A method's bounds, by what ω is."""

    method: str
    bounds: dict[str, Bound]

    @property
    def words(self) -> str:
        """The rule for a step, once where it is the same for every ω."""
        by_words: dict[str, list[str]] = {}
        for kind, bound in self.bounds.items():
            by_words.setdefault(bound.words, []).append(kind)
        if len(by_words) == 1:
            return next(iter(by_words))
        return "; ".join(f"{words} ({', '.join(which)})" for words, which in by_words.items())


def _two(x: float) -> str:
    return number_text(float(f"{x:.2g}"))


def steps(cases: Iterable[Overview]) -> list[StepCase]:
    """Return the cases whose step is swept."""
    out = []
    for each in cases:
        if each.case.family == "step":
            found = [StepLine(line, against_theory(line, each.case)) for line in each.lines if not line.left_out]
            out += [StepCase(each.case, each.anchor, tuple(found))] if found else []
    return out


def rules(cases: Iterable[StepCase]) -> list[Rule]:
    """Return each method's rule over all engines and cases that tell a frequency or rate, the largest step first."""
    found: dict[str, dict[str, list[Bound]]] = {}
    for each in cases:
        for step in each.lines:
            for kind, bound in _bounds(step.line, each.case):
                found.setdefault(step.line.row.method, {}).setdefault(kind, []).append(bound)
    out = [Rule(method, {kind: _least(group) for kind, group in of.items()}) for method, of in found.items()]
    return sorted(out, key=lambda rule: (-min(b.held for b in rule.bounds.values()), rule.method))


def kinds(found: Iterable[Rule]) -> list[str]:
    """Return what ω is in any rule."""
    return list(dict.fromkeys(kind for rule in found for kind in rule.bounds))


def _bounds(line: Line, case: CaseResult) -> list[tuple[str, Bound]]:
    held, failed, theory = line.broken.held, line.broken.failed, line.row.theory
    if line.rest is not None and (failed is None or line.rest in _OTHER):
        # What stopped it there has nothing to do with the step.
        return []
    at = case.facts[0] if case.facts else {}
    return [
        (
            kind.partition(",")[0],
            Bound(
                0.0 if held is None else held * rate,
                math.nan if failed is None else failed * rate,
                math.nan if theory is None else theory * rate,
            ),
        )
        for kind, rate in at.items()
        if kind.startswith(_FASTEST) and rate > 0
    ]


def _least(group: list[Bound]) -> Bound:
    """Return what is safe in all the cases measured."""
    failed = min((b.failed for b in group if not math.isnan(b.failed)), default=math.nan)
    theory = min((b.theory for b in group if not math.isnan(b.theory)), default=math.nan)
    # Steps are tried on a grid, another one in each case: what held in one may be beyond what did not in another.
    return Bound(min(b.held for b in group if math.isnan(failed) or not math.isnan(b.failed)), failed, theory)


def against_theory(line: Line, case: CaseResult) -> str:
    """Return how the measured breaking point compares with linear theory; empty where one is unknown."""
    limit = math.nan if line.row.theory is None else line.row.theory
    at = place(case.values, limit)
    if math.isnan(at):
        return ""
    if line.reach and at < line.reach - 1:
        return f"holds {_times(case.values[line.reach - 1], limit)}further"
    failed = line.broken.failed
    if line.rest is not None and (failed is None or line.rest in _OTHER):
        return ""
    if failed is not None and at > line.reach:
        return f"breaks {_times(failed, limit)}earlier" if math.isfinite(limit) else "breaks, theory has no limit"
    return "as theory says"


def _times(x: float, y: float) -> str:
    return f"{_two(max(abs(x / y), abs(y / x)))} × " if x and y else ""


# The largest stable steps as a figure: measured as a bar between held and not, linear theory as a mark.

_COLUMNS: Final = 3
_ROW: Final = 0.2
_WIDTH: Final = 10.4


def stable_steps(cases: Sequence[StepCase]) -> str:
    """Draw each case's steps, a panel a case: from the largest that held to the least that failed, or an arrow."""
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
