"""The pieces that tables on a terminal are made of."""

from __future__ import annotations

from rich import box
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

__all__ = ["bullet", "columns", "right", "titled"]


def bullet(head: str, text: str, mark: str = "·", style: str = "dim") -> RenderableType:
    """Return a line with a mark before it, folded under its own beginning."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=3, justify="right")
    grid.add_column(overflow="fold")
    grid.add_row(Text(mark, style=style), Text.assemble((head, "bold"), text))
    return grid


def columns(*heads: str | tuple[str, str]) -> Table:
    """Return an empty table; a column is its head, or its head and how it is justified."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    for told in heads:
        head, justify = (told, "left") if isinstance(told, str) else told
        # A long name goes on in the next line; an ellipsis would make it another name.
        table.add_column(Text(head), justify=justify, no_wrap=justify == "right", overflow="fold")  # type: ignore[arg-type]
    return table


def right(*heads: str) -> list[tuple[str, str]]:
    """Return columns of numbers."""
    return [(head, "right") for head in heads]


def titled(title: str, *parts: RenderableType) -> list[RenderableType]:
    """Return parts under a title."""
    return [Text(), Text(title, style="bold"), *parts]
