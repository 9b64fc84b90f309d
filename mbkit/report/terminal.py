"""Documents on a terminal: the verdict first, then where it comes from.

The folder that pages and data are written to.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from mbkit import _process as _interrupt
from mbkit._escape import one_line, terminal
from mbkit.errors import OutputError, writing
from mbkit.studies import document
from mbkit.studies.document import Bullet, Column, Document, Items, Paragraph, Span, Style
from mbkit.studies.results import write_whole

_STYLES: Final[dict[Style, str]] = {
    "good": "green",
    "bad": "bold red",
    "allowed": "bold yellow",
    "muted": "dim",
    "bold": "bold",
}
#: Longer texts are cut; the page and the JSON have them whole.
_MAX_LETTERS: Final = 600


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
    text = one_line(bullet.text, _MAX_LETTERS)
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


def file_stem(name: str) -> str:
    """Return a model's name as the stem of a file in the folder, whatever the name holds."""
    return re.sub(r"[^\w.+-]+", "_", name).strip("._")[:100] or "model"


def check_writable(folder: Path) -> None:
    """Raise `OutputError`, before long work, if `folder` cannot be written to; nothing is created."""
    place = folder.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    why = "" if os.access(place, os.W_OK | os.X_OK) else f"no permission in {place}"
    why = why if place.is_dir() else f"{place} is not a folder"
    if why:
        raise OutputError(f"cannot write to {folder}: {why}; choose another with --out")


def check_replaceable(folder: Path, *names: str, force: bool = False) -> None:
    """Raise `OutputError`, before long work, for a file that mbkit did not write, unless `force` is set."""
    for path in (folder / name for name in names):
        if not force and os.path.lexists(path) and not _is_own(path):
            remedy = "choose another folder with --out, or replace it with --force"
            raise OutputError(f"{path} is there and mbkit did not write it; {remedy}")


#: At the beginning or the end of what mbkit writes.
_MARKS: Final = (
    b'content="mbkit"',
    b"Software\0mbkit",
    b"ritten by mbkit",
    b"engine,method,setting,value,",
    b"case,parameter,unit,value,engine,method,",
    b"t,q.",
)
_HEAD_BYTES: Final = 4096


def _is_own(path: Path) -> bool:
    """Return whether a file is one that a command of mbkit has written."""
    try:
        if path.suffix == ".json":
            data = json.loads(path.read_bytes())
            # Equations say at their head with which mbkit they were written; results among other versions.
            return isinstance(data, dict) and "mbkit" in (data | dict(data.get("versions") or {}))
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
            file.seek(max(0, os.path.getsize(path) - 64))
            head += file.read()
    except (OSError, ValueError, TypeError, RecursionError):
        return False
    return any(mark in head for mark in _MARKS)


def write(folder: Path, name: str, content: str | bytes, *, force: bool = False) -> Path:
    """Write a file as a whole or not at all, text as UTF-8, and return its path; see `check_replaceable`."""
    path = folder / name
    with _interrupt.uninterrupted:
        check_replaceable(folder, name, force=force)
        with writing(path, "choose another folder with --out"):
            folder.mkdir(parents=True, exist_ok=True)
            write_whole(path, content if isinstance(content, bytes) else content.encode("utf-8", "backslashreplace"))
    return path
