"""Documents on a terminal: the verdict first, then where it comes from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from mbkit._escape import one_line, terminal
from mbkit.studies import document
from mbkit.studies.document import Bullet, Column, Document, Items, Paragraph, Span, Style

_STYLES: Final[dict[Style, str]] = {
    "good": "green",
    "bad": "bold red",
    "allowed": "bold yellow",
    "muted": "dim",
    "bold": "bold",
}


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
        yield table(block)
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
    return Text.assemble(
        *(
            (one_line(s.text, most) if most else terminal(s.text).replace("\n", " "), _STYLES.get(s.style, ""))
            for s in spans
        )
    )


def _bullet(bullet: Bullet) -> RenderableType:
    """Return a line with a mark before it, folded under its own beginning."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=3, justify="right")
    grid.add_column(overflow="fold")
    head = f"{one_line(bullet.head)}: " if bullet.head else ""
    # Longer texts are cut; the page and the JSON have them whole.
    text = one_line(bullet.text, 600)
    grid.add_row(Text(bullet.mark, style=_STYLES.get(bullet.style, "")), Text.assemble((head, "bold"), text))
    return grid


def table(block: document.Table) -> Table:
    """Return a table as rich prints it."""
    shown = block.shown("terminal")
    out = Table(box=box.SIMPLE_HEAD, padding=0 if block.dense else (0, 1, 0, 0), pad_edge=False, show_edge=False)
    for column in shown:
        # A long name goes on in the next line; an ellipsis would make it another name.
        out.add_column(
            Text(column.head),
            overflow="ellipsis" if column.fill else "fold",
            justify="right" if column.right else "left",
            no_wrap=column.right or column.fill or bool(column.width),
            min_width=column.width or None,
            ratio=1 if column.fill and column is shown[-1] else None,
        )
    out.expand = any(column.fill for column in shown)
    for group in block.groups("terminal"):
        for row in group:
            out.add_row(*(_text(cell, c.most) for c, cell in zip(shown, row, strict=True)))
    return out


def robots(records: Sequence[Any], systems: Iterable[str]) -> RenderableType:
    """Return the table of robots that there are, and the names of catalog systems."""
    columns = [Column("robot", lambda r: r.name), Column("short names", lambda r: Span(", ".join(r.aliases), "bold"))]
    columns += [
        Column("nq", lambda r: "–" if r.reason else str(r.nq), right=True),
        Column("nv", lambda r: "–" if r.reason else str(r.nv), right=True),
        Column("mass, kg", lambda r: "–" if r.reason else f"{r.mass:.4g}", right=True),
        Column("", lambda r: Span(one_line(r.reason or ""), "allowed")),
    ]
    head = f"{len(records)} robots of example-robot-data; mimic joints reduced."
    foot = f"{head} Catalog systems: {', '.join(systems)}"
    return Group(table(document.Table(columns, records)), Padding(Text(foot, style="dim"), (0, 0, 1, 0)))
