"""XML from strangers: read without entities, links or deep nesting, and with line numbers.

A document type declaration is where entity bombs, external entities and file URLs
live, and neither URDF nor MJCF needs one: it ends the reading before anything of it
is looked at. What is left of XML then cannot refer to anything outside the text.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NoReturn
from xml.parsers import expat

from mbkit.errors import LoadError

__all__ = ["MOST_BYTES", "MOST_ELEMENTS", "MOST_LEVELS", "Element", "parse", "read"]

#: Far above any robot, far below what would exhaust memory or the stack.
MOST_BYTES: Final = 64 * 2**20
MOST_ELEMENTS: Final = 500_000
MOST_LEVELS: Final = 250

_ENDINGS: Final = (".urdf", ".xml", ".mjcf")
_MOST_TOLD: Final = 10
# How far into a file an XML declaration is looked for, and how long it may be.
_HEAD: Final = 4096
_COMMENT: Final = re.compile(rb"<!--.*?-->", re.DOTALL)
_ENCODING: Final = re.compile(rb"encoding\s*=\s*[\"']([A-Za-z0-9._-]+)[\"']")
_BLANK: Final = b" \t\r\n\xef\xbb\xbf"


@dataclass(eq=False, slots=True)
class Element:
    """An element as it was written: tag, attributes, line, children, and what text is in it, joined.

    `file` is the included file that it stands in, and empty in the file that was asked for.
    `notes`, of the root element, say what of the text was passed over.
    """

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)
    text: str = ""
    file: str = ""
    notes: tuple[str, ...] = ()

    @property
    def place(self) -> str:
        """Where it stands, for messages."""
        return f"{self.file}, line {self.line}" if self.file else f"line {self.line}"

    def all(self, tag: str) -> list[Element]:
        """Return the children of this tag."""
        return [c for c in self.children if c.tag == tag]

    def first(self, tag: str) -> Element | None:
        """Return the first child of this tag."""
        return next((c for c in self.children if c.tag == tag), None)

    def walk(self) -> Iterator[Element]:
        """Yield this element and everything below it."""
        stack = [self]
        while stack:
            element = stack.pop()
            yield element
            stack.extend(reversed(element.children))


def read(path: Path) -> Element:
    """Return the root element of a file.

    Raises
    ------
    LoadError
        The file is missing, unreadable, empty, not well formed, or holds a
        document type declaration.
    """
    try:
        if not path.exists():
            raise LoadError(f"{path}: no such file")
        if not path.is_file():
            what = f"a folder{_descriptions(path)}" if path.is_dir() else "not a regular file"
            raise LoadError(f"{path}: expected a URDF or MJCF file, this is {what}")
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise LoadError(f"{path}: {size} bytes; a description of up to {MOST_BYTES} bytes was expected")
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, LoadError):
            raise
        # ValueError: a null character in the name.
        raise LoadError(f"{path!s}: cannot be read ({error})") from None
    return parse(content, str(path))


def _descriptions(folder: Path) -> str:
    """Return which descriptions a folder and those below it hold, for a message."""
    found = sorted(
        str(p.relative_to(folder)) for p in itertools.islice(folder.rglob("*"), 10_000) if p.suffix in _ENDINGS
    )
    if not found:
        return ", and no .urdf or .xml file is in it"
    return f"; it holds {', '.join(found[:_MOST_TOLD])}{' and more' * (len(found) > _MOST_TOLD)}"


def parse(content: bytes, name: str) -> Element:
    """Return the root element of a text; `name` begins every message."""
    if not content.strip(_BLANK):
        raise LoadError(f"{name}: the file is empty; expected <robot> (URDF) or <mujoco> (MJCF)")
    content, encoding, notes = _readable(content)
    parser = expat.ParserCreate(encoding)
    stack: list[Element] = []
    # The pieces of text in each element of the stack, joined once at its end.
    texts: list[list[str]] = []
    roots: list[Element] = []
    count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        element = Element(tag, attributes, parser.CurrentLineNumber)
        (stack[-1].children if stack else roots).append(element)
        stack.append(element)
        texts.append([])
        if len(stack) > MOST_LEVELS:
            raise LoadError(f"{name}: line {element.line}: elements are nested more than {MOST_LEVELS} deep")
        if count > MOST_ELEMENTS:
            raise LoadError(f"{name}: line {element.line}: more than {MOST_ELEMENTS} elements; a robot has far fewer")

    def end(_: str) -> None:
        stack.pop().text = "".join(texts.pop())

    def data(text: str) -> None:
        if stack and not text.isspace():
            texts[-1].append(text)

    def doctype(*_: object) -> NoReturn:
        raise LoadError(
            f"{name}: line {parser.CurrentLineNumber}: a document type declaration (<!DOCTYPE ...>), which can hide "
            "entities and links to other files, is not read; remove it, neither URDF nor MJCF needs one"
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = data
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        why = expat.errors.messages.get(error.code, str(error))
        raise LoadError(
            f"{name}: line {error.lineno}, column {error.offset + 1}: not well-formed XML: {why}"
            f"{_excerpt(content, error.lineno, error.offset)}"
        ) from None
    except (LookupError, ValueError) as error:
        if isinstance(error, LoadError):
            raise
        raise LoadError(f"{name}: not readable as XML: {error}; save it as UTF-8") from None
    roots[0].notes = notes
    return roots[0]


def _readable(content: bytes) -> tuple[bytes, str | None, tuple[str, ...]]:
    """Return a text without what robot parsers pass over and expat does not, its encoding, and notes.

    That is text before the XML declaration, and null characters after the last element. Lines keep their numbers.
    """
    if content[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in content[:4]:
        # In UTF-16 a null is half of a character.
        return content, None, ()
    notes = []
    whole = content.rstrip(b"\0" + _BLANK[:4])
    if b"\0" in content[len(whole) :]:
        content = whole
        notes.append("null characters after the last element were passed over")
    start = content.find(b"<?xml", 0, _HEAD)
    stop = content.find(b"?>", start, start + _HEAD) + 2
    before = content[: max(start, 0)]
    if not before.strip(b"\xef\xbb\xbf") or stop < 2 or b"<" in _COMMENT.sub(b"", before):
        return content, None, tuple(notes)
    encoding = _ENCODING.search(content, start, stop)
    content = b"\n" * content.count(b"\n", 0, stop) + content[stop:]
    notes.append("text before the XML declaration was passed over")
    return content, encoding.group(1).decode() if encoding else None, tuple(notes)


def _excerpt(content: bytes, line: int, column: int) -> str:
    """Return what stands where the parser stopped, for its message."""
    lines = content.split(b"\n", line)
    if len(lines) < line:
        return ""
    found = lines[line - 1][column : column + 30].decode("utf-8", "backslashreplace").strip()
    return f", at {found!r}" if found else ""
