"""What people are shown of a result: sections of paragraphs, tables, lists, facts and figures.

A view makes one document of a result; `terminal` and `page` render it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

__all__ = [
    "Block",
    "Bullet",
    "Column",
    "Details",
    "Document",
    "Facts",
    "Figure",
    "Items",
    "Paragraph",
    "Section",
    "Span",
    "Style",
    "Table",
    "Text",
    "spans",
]

#: Where a part is shown. A terminal has room for the verdict and what leads to it, a page for everything.
On = Literal["both", "terminal", "page"]
Style = Literal["", "good", "bad", "allowed", "muted", "bold", "mono"]


@dataclass(frozen=True)
class Span:
    """A piece of text in one style; of a table on a page also its cell's own class."""

    text: str
    style: Style = ""
    cell: str = ""


Text = str | Span | Sequence[str | Span]


def spans(text: Text) -> list[Span]:
    """Return a text as pieces."""
    pieces = [text] if isinstance(text, (str, Span)) else text
    return [piece if isinstance(piece, Span) else Span(piece) for piece in pieces]


@dataclass(frozen=True)
class Paragraph:
    """Running text; a note is smaller."""

    text: Text
    on: On = "both"
    note: bool = False


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes
    ----------
    head : str
        A line feed breaks it.
    cell : callable
        Row -> Text.
    right : bool
        Whether it holds numbers.
    on : str
    width : int
        On a terminal, at least so many characters, which are never folded.
    most : int
        On a terminal, longer texts are cut.
    fill : bool
        On a terminal, takes what is left of the width, and what is too long is cut.
    group : bool
        Shown only where it differs from the row before, which begins a group.
    """

    head: str
    cell: Callable[[Any], Text]
    right: bool = False
    on: On = "both"
    width: int = 0
    most: int = 0
    fill: bool = False
    group: bool = False


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
    """An entry of a list.

    Attributes
    ----------
    head, text : str
    mark, style : str
        What stands before it.
    aside : str
        More, for a page.
    state : (str, str) or None
        For a page: what is folded away, and its title.
    """

    head: str
    text: str
    mark: str = "·"
    style: Style = "muted"
    aside: str = ""
    state: tuple[str, str] | None = None


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
    """A drawing of a page as an SVG element, with its caption; where `draw` returns nothing, there is none."""

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
    """Blocks under a title; one of level 3 stands below the one before it. Without blocks it is not shown."""

    title: str
    blocks: Sequence[Block]
    on: On = "both"
    level: int = 2

    def shown(self, where: On) -> list[Block]:
        """Return the blocks that are shown there."""
        return [b for b in self.blocks if b.on in ("both", where)] if self.on in ("both", where) else []


@dataclass(frozen=True)
class Document:
    """All that is shown of a result.

    Attributes
    ----------
    name : str
        Of the model or file, as a terminal has it before the verdict.
    heading, title : str
        Of the page, and in the browser's bar.
    verdict : str
        One sentence.
    good : bool
    marked : bool
        Whether the verdict is a judgement, with ✓ or ✗ before it.
    summary : str
        What a terminal shows below the verdict.
    opening : sequence of Block
        What stands before the first section.
    sections : sequence of Section
    result : object
        With `versions`, `processor` and `seconds`, for the foot of the page.
    basis : mapping
        What the numbers rest on, for the foot of the page.
    last : bool
        Whether a terminal has the verdict at the end.
    """

    name: str
    heading: str
    title: str
    verdict: str
    good: bool
    sections: Sequence[Section]
    result: Any
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
