"""Documents on a terminal: the verdict first, then where it comes from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final

from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from mbkit._escape import one_line, terminal
from mbkit.report import document
from mbkit.report.document import Bullet, Document, Items, Paragraph, Span, Style

_STYLES: Final[dict[Style, str]] = {
    "good": "green",
    "bad": "bold red",
    "allowed": "bold yellow",
    "muted": "dim",
    "bold": "bold",
}
#: Longer texts are cut; the page and the JSON have them whole.
_LONGEST: Final = 600


def render(shown: Document) -> RenderableType:
    """Return a document as rich prints it."""
    parts: list[RenderableType] = []
    for section, blocks in shown.shown("terminal"):
        if section.title:
            parts += [Text(), Text(one_line(section.title), style="bold")]
        parts += [part for block in blocks for part in _block(block)]
    head = _verdict(shown)
    return Group(*parts, Text(), *head, Text()) if shown.last else Group(*head, *parts, Text())


def _verdict(shown: Document) -> list[RenderableType]:
    style = ("bold green" if shown.good else "bold red") if shown.marked else ""
    mark = ("✓ " if shown.good else "✗ ") if shown.marked else ""
    name = f"{one_line(shown.name, 80)}: " if shown.name else ""
    out: list[RenderableType] = [Text.assemble((mark, style), (name, "bold"), (one_line(shown.verdict), style))]
    return [*out, Text(f"  {one_line(shown.summary)}", style="dim")] if shown.summary else out


def _block(block: document.Block) -> Iterator[RenderableType]:
    if isinstance(block, document.Table):
        yield _table(block)
    elif isinstance(block, Paragraph):
        yield Text("  ") + _text(document.spans(block.text))
    elif isinstance(block, Items):
        shown = block.bullets[: block.most or None]
        yield from map(_bullet, shown)
        if len(shown) < len(block.bullets):
            more = f"and {len(block.bullets) - len(shown)} more, in the page and the JSON"
            yield _bullet(Bullet("", more, " ", shown[-1].style))


def _text(spans: Iterable[Span], most: int = 0) -> Text:
    """Return pieces of text on one line, with the spaces that align them."""
    return Text.assemble(*((_aligned(s.text, most), _STYLES.get(s.style, "")) for s in spans))


def _aligned(text: str, most: int) -> str:
    return one_line(text, most) if most else terminal(text).replace("\n", " ")


def _bullet(bullet: Bullet) -> RenderableType:
    """Return a line with a mark before it, folded under its own beginning."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=3, justify="right")
    grid.add_column(overflow="fold")
    head = f"{one_line(bullet.head)}: " if bullet.head else ""
    text = one_line(bullet.text, _LONGEST)
    grid.add_row(Text(bullet.mark, style=_STYLES.get(bullet.style, "")), Text.assemble((head, "bold"), text))
    return grid


def columns(*heads: str) -> Table:
    """Return an empty table."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    for head in heads:
        # A long name goes on in the next line; an ellipsis would make it another name.
        table.add_column(Text(head), overflow="fold")
    return table


def _table(block: document.Table) -> Table:
    shown = block.shown("terminal")
    table = columns(*(c.head for c in shown))
    table.padding = 0 if block.dense else table.padding
    for k, (spec, column) in enumerate(zip(shown, table.columns, strict=True)):
        column.justify = "right" if spec.right else "left"
        column.no_wrap = spec.right or spec.fill or bool(spec.width)
        column.min_width = spec.width or None
        if spec.fill:
            table.expand, column.overflow = True, "ellipsis"
            column.ratio = 1 if k == len(shown) - 1 else None
    for group in block.groups("terminal"):
        for row in group:
            table.add_row(*(_text(cell, c.most) for c, cell in zip(shown, row, strict=True)))
    return table


def robots(records: Iterable[Any], systems: Iterable[str]) -> RenderableType:
    """Return the table of robots that there are, and the names of catalog systems."""
    table = columns("robot", "short names", "nq", "nv", "mass, kg", "")
    for column in table.columns[2:5]:
        column.justify, column.no_wrap = "right", True
    for r in records:
        numbers = ("–", "–", "–") if r.reason else (str(r.nq), str(r.nv), f"{r.mass:.4g}")
        names = Text(", ".join(r.aliases), style="bold")
        table.add_row(Text(r.name), names, *numbers, Text(one_line(r.reason or ""), style="yellow"))
    head = f"{len(table.rows)} robots of example-robot-data; mimic joints reduced."
    foot = f"{head} Catalog systems: {', '.join(systems)}"
    return Group(table, Padding(Text(foot, style="dim"), (0, 0, 1, 0)))
