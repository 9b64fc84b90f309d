"""What every figure shares: colours, markers, style and logarithmic axes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from mbkit._check import needed
from mbkit._escape import one_line
from mbkit.engines import ENGINES

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

_MARKS: Final = "osD^vP"
_SUPERSCRIPT: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

#: A cross over what failed.
CROSS: Final[dict[str, Any]] = {"linestyle": "none", "markersize": 11.0, "markeredgewidth": 2.2}


@dataclass(frozen=True)
class Palette:
    """Colours by what they are for; six series, one an engine."""

    ink: str
    muted: str
    grid: str
    bad: str
    series: tuple[str, str, str, str, str, str]

    def engine(self, name: str) -> str:
        """Return the colour of an engine."""
        return self.series[engine_index(name)]


#: For white paper; the series are the page's own in its light form.
PLAIN: Final = Palette(
    "#1b1f24", "#5c6570", "#d9dde2", "#b3261e", ("#0072b2", "#b35900", "#00805e", "#a03c82", "#6b6b00", "#555555")
)


def engine_index(name: str) -> int:
    """Return which of the six series an engine is drawn with: the same in every figure, whichever others are there."""
    order = list(ENGINES)
    return min(order.index(name), len(_MARKS) - 1) if name in order else len(_MARKS) - 1


def engine_mark(name: str) -> str:
    """Return an engine's marker."""
    return _MARKS[engine_index(name)]


def style(palette: Palette) -> dict[str, Any]:
    """Return Matplotlib's settings for figures of this package."""
    return {
        # A dollar sign in a name does not begin a formula.
        "text.parse_math": False,
        "font.family": "sans-serif",
        "font.size": 10.0,
        "svg.fonttype": "none",
        **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.labelcolor", "ytick.labelcolor"), palette.ink),
        **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), palette.muted),
        **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
        **dict.fromkeys(("axes.linewidth", "grid.linewidth"), 0.8),
        "axes.titlesize": 10.0,
        "axes.axisbelow": True,
        "grid.color": palette.grid,
        "legend.fontsize": 9.5,
        "lines.linewidth": 1.6,
        "lines.markersize": 6.0,
    }


def drawing(palette: Palette = PLAIN, more: Mapping[str, Any] | None = None) -> Any:
    """Return a context that draws in this style, and leaves the user's own as it was; `more` are further settings."""
    with needed("matplotlib", "a figure"):
        from matplotlib import rc_context

    settings: Any = {**style(palette), **(more or {})}
    return rc_context(settings)


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure, sized in inches: without pyplot, so no window system, and nothing to close."""
    with needed("matplotlib", "a figure"):
        from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def figure_of(ax: Axes) -> Figure:
    """Return the whole figure of an axes, also of one in a subfigure."""
    from matplotlib.figure import Figure

    fig = ax.get_figure(root=True)
    assert isinstance(fig, Figure)
    return fig


def legend(ax: Axes, handles: Sequence[Artist], side: Literal["upper", "lower"], *, own: bool, columns: int) -> None:
    """Put a legend above or below an axes; in a figure of `own`, with constrained layout, from its left edge."""
    place: Any = {"loc": f"outside {side} left"}
    if not own:
        at = ("lower left", (0.0, 1.0)) if side == "upper" else ("upper left", (0.0, -0.2))
        place = {**dict(zip(("loc", "bbox_to_anchor"), at, strict=True)), "fontsize": 8.0}
    whose: Any = figure_of(ax) if own else ax
    whose.legend(handles=handles, ncols=columns, columnspacing=1.2, handlelength=1.4, **place)


#: Prefix of the name of a line whose points have texts; these follow, one a line.
POINTS: Final = "points:"


def name_points(lines: Iterable[Line2D], texts: Iterable[str]) -> None:
    """Give each point of a line a text, which a page shows when it is pointed at; a line without markers has one."""
    name = POINTS + "\n".join(one_line(text) for text in texts)
    for line in lines:
        line.set_gid(name)


def log_ticks(ax: Axes, most: int = 9) -> None:
    """Label powers of ten on the logarithmic axes, with at most so many ticks."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() == "log":
            if min(axis.get_view_interval()) <= 0:
                # The axis is empty, and a logarithm has no zero.
                axis.set_view_interval(1e-3, 1.0, ignore=True)
            low, high = (math.log10(x) for x in axis.get_view_interval())
            if math.floor(high) - math.ceil(low) < 1:
                # Whole decades, so that there are two labels at least.
                axis.set_view_interval(10.0 ** math.floor(low), 10.0 ** math.ceil(high), ignore=True)
            axis.set_major_locator(LogLocator(10, numticks=most))
            axis.set_major_formatter(FuncFormatter(_power))
            axis.set_minor_locator(NullLocator())


def _power(x: float, _: object) -> str:
    return f"10{str(round(math.log10(x))).translate(_SUPERSCRIPT)}" if x > 0 else ""
