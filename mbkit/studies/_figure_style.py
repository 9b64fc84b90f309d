"""What every figure shares: colours, markers, style and logarithmic axes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from mbkit.engines import ENGINES
from mbkit.simulate.plotting import time_series

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARKS: Final = "osD^vP"
_SUPERSCRIPT: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


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
    sizes = {"font.size": 10.0, "lines.linewidth": 1.6, "lines.markersize": 6.0, "legend.fontsize": 9.5}
    return time_series.style(palette.ink, palette.muted, palette.grid, **{"svg.fonttype": "none", **sizes})


def log_ticks(ax: Axes, most: int = 9) -> None:
    """Label powers of ten on the logarithmic axes, with at most so many ticks."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() == "log":
            if min(axis.get_view_interval()) <= 0:
                # Of an empty axis; a logarithm has no zero.
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
