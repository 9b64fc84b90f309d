"""The document of a result: sections of paragraphs, tables, lists, facts and figures.

A result has one, `ResultTable.document`; a terminal, a page, Markdown and a notebook show it. A page has room for
everything, the others for the verdict and what leads to it: `on` says where a part is shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from mbkit._escape import html, markdown

On = Literal["both", "terminal", "page"]
Style = Literal["", "good", "bad", "allowed", "muted", "bold", "mono"]


@dataclass(frozen=True)
class Span:
    """A piece of text in one style; `cell` is a class of the style sheet for its cell of a table."""

    text: str
    style: Style = ""
    cell: str = ""


Text = str | Span | Sequence[str | Span]


def spans(text: Text) -> list[Span]:
    """Return a text as pieces."""
    pieces = [text] if isinstance(text, (str, Span)) else text
    return [piece if isinstance(piece, Span) else Span(piece) for piece in pieces]


def plain(text: Text) -> str:
    """Return a text without its styles, and without the spaces that align it."""
    return " ".join("".join(piece.text for piece in spans(text)).split())


@dataclass(frozen=True)
class Paragraph:
    """Running text; a note is smaller."""

    text: Text
    on: On = "both"
    note: bool = False


@dataclass(frozen=True)
class Column:
    """A column of a table: its head, in which a line feed breaks it, and the text of a row's cell.

    `group` is shown only where it differs from the row before, which begins a group. On a terminal, `width` is the
    least width and is never folded, texts longer than `most` are cut, and `fill` takes the rest of the line.
    """

    head: str
    cell: Callable[[Any], Text]
    right: bool = False
    on: On = "both"
    group: bool = False
    width: int = 0
    most: int = 0
    fill: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of any kind; `dense` has no space between columns on a terminal, `style` is a class of the style sheet."""

    columns: Sequence[Column]
    rows: Sequence[Any]
    on: On = "both"
    dense: bool = False
    style: str = ""

    def shown(self, where: On) -> list[Column]:
        """Return the columns that are shown there."""
        return [c for c in self.columns if c.on in ("both", where)]

    def groups(self, where: On) -> Iterator[list[list[list[Span]]]]:
        """Yield groups of rows of cells; without a column of groups there is one."""
        columns = self.shown(where)
        before: dict[int, list[Span]] = {}
        group: list[list[list[Span]]] = []
        for row in self.rows:
            cells = [spans(c.cell(row)) for c in columns]
            for k, column in enumerate(columns):
                if column.group and before.get(k) == cells[k]:
                    cells[k] = []
                elif column.group:
                    if group:
                        yield group
                    before[k], group = cells[k], []
            group.append(cells)
        if group:
            yield group


@dataclass(frozen=True)
class Bullet:
    """An entry of a list; on a page also `aside`, and the title and text of a folded part."""

    head: str
    text: str
    mark: str = "·"
    style: Style = "muted"
    aside: str = ""
    folded: tuple[str, str] | None = None

    @property
    def line(self) -> str:
        """Mark, head and text without styles; a plain entry has no mark."""
        mark = "" if self.mark in ("·", "i") else f"{self.mark} "
        return f"{mark}{self.head}{': ' if self.head else ''}{self.text}"


@dataclass(frozen=True)
class Items:
    """A list; a terminal shows at most `most` of its entries."""

    bullets: Sequence[Bullet]
    on: On = "both"
    most: int = 0


@dataclass(frozen=True)
class Facts:
    """Names with what there is to say of each, for a page."""

    facts: Sequence[tuple[str, Text]]
    on: On = "page"


@dataclass(frozen=True)
class Figure:
    """A drawing of a page as an SVG element with its caption; empty where `draw` returns None."""

    draw: Callable[[], str]
    caption: str
    wide: bool = False
    on: On = "page"


@dataclass(frozen=True)
class Details:
    """Blocks of a page that are folded away."""

    summary: str
    blocks: Sequence[Paragraph | Table | Facts]
    on: On = "page"


Block = Paragraph | Table | Items | Facts | Figure | Details


@dataclass(frozen=True)
class Section:
    """Blocks under a title; one of level 3 belongs to the one before it. Blocks without content are left out."""

    title: str
    blocks: Sequence[Block]
    on: On = "both"
    level: int = 2

    def shown(self, where: On) -> list[Block]:
        """Return the blocks that are shown there."""
        places = ("both", where)
        if self.on not in places:
            return []
        return [b for b in self.blocks if b.on in places and getattr(b, "rows", True) and getattr(b, "bullets", True)]


@dataclass(frozen=True)
class Document:
    """All that is shown of a result.

    A terminal has `name` before the verdict and `summary` below it, or the verdict at the end (`last`); a page has a
    heading and, in the browser's bar, a title, which are the name by default, and `sentence` for the verdict: it also
    says on how many states, and against what. `marked`: the verdict is a judgement, with ✓ or ✗. At the foot of the
    page stand `basis` and the result's `versions`, `processor` and `seconds`.
    """

    name: str
    verdict: str
    good: bool
    sections: Sequence[Section]
    result: Any
    heading: str = ""
    title: str = ""
    sentence: str = ""
    marked: bool = True
    summary: str = ""
    opening: Sequence[Block] = ()
    basis: Mapping[str, Text] = field(default_factory=dict)
    last: bool = False

    def shown(self, where: On) -> Iterator[tuple[Section, list[Block]]]:
        """Yield the sections that have something to show there."""
        for section in (Section("", self.opening), *self.sections):
            if blocks := section.shown(where):
                yield section, blocks


# A notebook shows what a terminal shows, Markdown what a page shows but for figures and what is folded away.


def to_markdown(shown: Document) -> str:
    """Return a document in Markdown."""
    parts = [f"**{markdown(shown.name)}**: {markdown(shown.verdict)}"]
    for section, blocks in shown.shown("page"):
        parts += [f"**{markdown(section.title)}**"] if section.title else []
        parts += filter(None, map(block_markdown, blocks))
    return "\n\n".join(parts) + "\n"


def to_html(shown: Document) -> str:
    """Return a document as a notebook shows it."""
    parts = [f"<p><b>{html(shown.name)}</b>: {html(shown.verdict)}</p>"]
    for section, blocks in shown.shown("terminal"):
        parts += [f"<p><b>{html(section.title)}</b></p>"] if section.title else []
        parts += map(block_html, blocks)
    return "".join(parts)


def to_text(shown: Document, most: int = 0) -> str:
    """Return what a document says everywhere, as lines; of a list or table at most so many."""
    lines = [f"{shown.name}: {shown.verdict}"]
    for block in (block for _, blocks in shown.shown("both") for block in blocks):
        texts: Sequence[Text] = [block.text] if isinstance(block, Paragraph) else []
        if isinstance(block, Items):
            texts = [bullet.line for bullet in block.bullets]
        elif isinstance(block, Table):
            heads, *rows = _texts(block, "both")
            heads = [" ".join(head.split()) for head in heads]
            named = ([f"{head} {x}".strip() for head, x in zip(heads, row, strict=True) if x] for row in rows)
            texts = [", ".join(row) for row in named]
        lines += [f"  {plain(text)}" for text in texts[: most or None]]
        lines += [f"  and {len(texts) - most} more"] if most and len(texts) > most else []
    return "\n".join(lines)


def block_markdown(block: Block) -> str:
    """Return a block in Markdown; empty for what Markdown does not show."""
    if isinstance(block, Paragraph):
        return markdown(plain(block.text))
    if isinstance(block, Items):
        return "\n".join(f"- {markdown(bullet.line)}" for bullet in block.bullets)
    if isinstance(block, Facts):
        return "\n".join(f"- {markdown(f'{name}: {plain(text)}')}" for name, text in block.facts)
    if not isinstance(block, Table):
        return ""
    rule = "".join("|---:" if c.right else "|---" for c in block.shown("page"))
    head, *rows = ("".join(f"| {markdown(x)} ".replace("  ", " ") for x in row) for row in _texts(block, "page"))
    return "\n".join(f"{line}|" for line in (head, rule, *rows))


def block_html(block: Block) -> str:
    """Return a block as a notebook shows it; empty for what it does not show."""
    if isinstance(block, Paragraph):
        return f"<p>{html(plain(block.text))}</p>"
    if isinstance(block, Items):
        return f"<ul>{''.join(f'<li>{html(bullet.line)}</li>' for bullet in block.bullets)}</ul>"
    if not isinstance(block, Table):
        return ""
    head, *rows = _texts(block, "terminal")
    lines = [[f"<th>{html(x)}</th>" for x in head], *([f"<td>{html(x)}</td>" for x in row] for row in rows)]
    return "".join(("<table>", *(f"<tr>{''.join(line)}</tr>" for line in lines), "</table>"))


def _texts(table: Table, where: On) -> Iterator[list[str]]:
    """Yield the heads and then the cells of each row, as plain text."""
    yield [plain(c.head) for c in table.shown(where)]
    for group in table.groups(where):
        yield from ([plain(cell) for cell in row] for row in group)
