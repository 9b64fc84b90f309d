"""How figures of trajectories look."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

__all__ = ["ACCENT", "BAD", "FAINT", "GHOST", "INK", "MUTED", "drawing"]

INK: Final = "#22303c"
MUTED: Final = "#7b8794"
FAINT: Final = "#e3e7eb"
GHOST: Final = "#c4ccd4"
ACCENT: Final = "#e8590c"
BAD: Final = "#c92a2a"
_STYLE: Final[Any] = {
    # A dollar sign in a name does not begin a formula.
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.size": 9.0,
    "text.color": INK,
    "axes.titlesize": 10.0,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
}


@contextmanager
def drawing() -> Iterator[None]:
    """Draw in this style, and leave the user's own as it was."""
    import matplotlib as mpl

    with mpl.rc_context(_STYLE):
        yield
