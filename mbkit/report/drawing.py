"""Figures as SVG that takes its colours from the page, so that light and dark both read.

Matplotlib draws with stand-in colours; each is then replaced by a variable of the
page's style sheet.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from mbkit._escape import html
from mbkit.studies.drawing import Palette, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["PAGE", "canvas", "page_style", "svg"]

#: Stand-ins for what the page says.
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
_NO_METADATA: Final[dict[str, None]] = {"Date": None, "Creator": None, "Format": None, "Type": None}


@contextmanager
def page_style(salt: str) -> Iterator[None]:
    """Give the page's style, and the same names inside an SVG every time."""
    from matplotlib import rc_context

    settings: Any = {**style(PAGE), "svg.hashsalt": f"mbkit {salt}"}
    with rc_context(settings):
        yield


@contextmanager
def canvas(width: float, height: float, salt: str) -> Iterator[tuple[Figure, Axes]]:
    """Give a figure, sized in inches, and its one pair of axes."""
    # Figure without pyplot: no window system, nothing to close.
    from matplotlib.figure import Figure

    with page_style(salt):
        fig = Figure(figsize=(width, height))
        yield fig, fig.subplots()


def svg(fig: Figure, title: str) -> str:
    """Return a figure as an element of a page; `title` is what a screen reader says."""
    stream = io.StringIO()
    fig.savefig(stream, format="svg", transparent=True, bbox_inches="tight", pad_inches=0.05, metadata=_NO_METADATA)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = text.replace("<svg", f'<svg role="img" aria-label="{html(title)}"', 1)
    # Names of parts would otherwise stand twice on a page with two figures.
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for stand_in, variable in _VARIABLES.items():
        text = text.replace(stand_in, variable)
    return text
