"""Figures of pages, as SVG that takes its colours from the page, so that light and dark both read.

Matplotlib draws with stand-in colours; each is then replaced by a variable of the page's style sheet. Engines differ by
colour and by marker.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from mbkit._check import EPS
from mbkit._escape import html
from mbkit.simulate.plotting.style import POINTS, Palette, drawing

if TYPE_CHECKING:
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
PAGE_WIDTH_INCHES: Final = 10.4
PANELS_PER_ROW: Final = 5
#: Smaller errors are drawn here, where double precision tells nothing, and a logarithm has no zero.
MIN_DRAWN_ERROR: Final = EPS / 64
#: Pixels of the smallest letters of a figure, however narrow the window.
_MIN_LETTER_PIXELS: Final = 10.0


@contextmanager
def page_style(salt: str) -> Iterator[None]:
    """Give the page's style, and the same names inside an SVG every time."""
    with drawing(PAGE, {"svg.hashsalt": f"mbkit {salt}"}):
        yield


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
    letters = map(float, re.findall(r"font(?:-size)?: ([\d.]+)px", text))
    least = width * _MIN_LETTER_PIXELS / min(letters, default=_MIN_LETTER_PIXELS)
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
        fig.savefig(stream, format=ending, dpi=160, facecolor="white", metadata=marks[ending])
    content = stream.getvalue()
    return _titled(content.decode()).encode() if ending == "svg" else content
