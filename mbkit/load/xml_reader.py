"""Parser for untrusted XML, with line numbers, and a strict reader of attributes.

A document type declaration, which can hold entity bombs, external entities and file URLs, is refused. The rest of
XML cannot refer to anything outside the text.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Final, NoReturn
from xml.parsers import expat

from mbkit.errors import LoadError

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

#: What expat says of any character that it cannot take: "syntax error", "not well-formed (invalid token)".
_VAGUE: Final = (2, 4)
#: Characters of the line that a message repeats.
_SHOWN: Final = 30


@dataclass(eq=False, slots=True)
class Element:
    """An element as it was written: tag, attributes, line, children, and what text is in it, joined.

    `file` is the included file that it stands in, and empty in the file that was asked for; `included_at`
    is then the line of the <include> there, else 0.
    `notes`, of the root element, say what of the text was passed over.
    """

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)
    text: str = ""
    file: str = ""
    notes: tuple[str, ...] = ()
    included_at: int = 0

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
        why = _unexpected(content, parser.ErrorByteIndex)
        if error.code not in _VAGUE or not why:
            why = expat.errors.messages.get(error.code, str(error))
        raise LoadError(f"{name}: line {error.lineno}, column {error.offset + 1}: not well-formed XML: {why}") from None
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


def _unexpected(content: bytes, at: int) -> str:
    """Return the character that ends the reading of a text, with the text before it; empty at the text's end."""
    if not 0 <= at < len(content):
        return ""
    byte = content[at]
    try:
        found = content[at : at + 4].decode("utf-8", "ignore")[:1] if byte < 0x80 else content[at:].decode()[:1]
    except UnicodeDecodeError:
        return f"byte 0x{byte:02x} is not UTF-8; save the file as UTF-8"
    before = content[:at].splitlines()[-1:] if content[:at][-1:] not in (b"\n", b"\r") else []
    line = b"".join(before).decode("utf-8", "replace").replace("\0", "").lstrip()[-_SHOWN:]
    after = f" after {line!r}" if line else ""
    if not found.isprintable() and not found.isspace():
        return f"control character 0x{byte:02x}{after}; remove it"
    hint = ""
    if line.endswith("&"):
        hint = "; write &amp; for &"
    elif found == "<":
        hint = "; write &lt; for < in a value"
    elif not line:
        hint = "; expected <"
    return f"unexpected {found!r}{after}{hint}"


# Numbers and names in attributes, read strictly; every fault is kept, none is raised.

_NUMBER: Final = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
#: Larger than anything that moves, and the products of several still fit a double.
LARGEST: Final = 1e30
_LONGEST_NAME: Final = 1000


class Reader:
    """Reads attributes of one file and collects its faults.

    Attributes
    ----------
    faults : list of str
        One sentence per fault: the element, what was expected, what came.
    notes : list of str
        What was passed over without loss.
    """

    def __init__(self) -> None:
        self.faults: list[str] = []
        self.notes: list[str] = []

    def fault(self, text: str, element: Element | None = None) -> None:
        """Keep one fault; the element tells the line, and the file where that is an included one."""
        where = f" ({element.place})" if element else ""
        self.faults.append(text + where)

    def name(self, element: Element, attribute: str, item: str) -> str:
        """Return a name that must be there, not be empty, and be short enough for a message."""
        value = element.attributes.get(attribute, "")
        if not value.strip():
            self.fault(f"{item}: <{element.tag}> has no {attribute}; give it one", element)
        if len(value) > _LONGEST_NAME:
            self.fault(
                f"{item}: {element.tag} {attribute}: a name of {len(value)} characters; "
                f"expected up to {_LONGEST_NAME}, got {_short(value)}",
                element,
            )
            return value[:_LONGEST_NAME]
        return value

    def numbers(
        self,
        element: Element,
        attribute: str,
        item: str,
        *,
        count: int,
        least: int | None = None,
        default: tuple[float, ...] | None = None,
        bounded: bool = True,
    ) -> tuple[float, ...]:
        """Return the numbers of an attribute.

        Parameters
        ----------
        element, attribute, item
            Where to read, and the element that messages name.
        count, least : int
            How many numbers are expected: exactly `count`, or from `least` to `count`.
        default : tuple of float, optional
            What stands for an absent attribute, which is a fault without it.
        bounded : bool
            Whether sizes that would overflow are a fault; limits may be that large.
        """
        where = f"{item}: {element.tag} {attribute}"
        neutral = default if default is not None else (0.0,) * count
        raw = element.attributes.get(attribute)
        if raw is None:
            if default is None:
                self.fault(f"{where}: missing; expected {_amount(count, least)}", element)
            return neutral
        values = []
        for word in raw.split():
            value = float(word) if _NUMBER.fullmatch(word) else math.nan
            if not math.isfinite(value):
                self.fault(f"{where}: {_short(word)} is not a finite number{_hint(word)}", element)
                return neutral
            if bounded and abs(value) > LARGEST:
                self.fault(f"{where}: {_short(word)} is too large to compute with", element)
                return neutral
            values.append(value)
        if not (count if least is None else least) <= len(values) <= count:
            self.fault(f"{where}: expected {_amount(count, least)}, got {_short(raw)}", element)
            return neutral
        return tuple(values)

    def number(
        self, element: Element, attribute: str, item: str, default: float | None = None, *, bounded: bool = True
    ) -> float:
        """Return a single number; see `numbers`."""
        fallback = None if default is None else (default,)
        return self.numbers(element, attribute, item, count=1, default=fallback, bounded=bounded)[0]

    def choice(self, element: Element, attribute: str, choices: tuple[str, ...]) -> str:
        """Return one of the choices, the first where the attribute is absent."""
        value = element.attributes.get(attribute, choices[0])
        if value in choices:
            return value
        self.fault(f"{element.tag} {attribute}: expected one of {', '.join(choices)}, got {value[:40]!r}", element)
        return choices[0]

    def only(self, element: Element, tag: str, item: str) -> Element | None:
        """Return the child of this tag, of which there may be one, or several that are equal."""
        found = element.all(tag)
        if len(found) > 1 and all(_content(e) == _content(found[0]) for e in found):
            self.notes.append(f"{item}: {len(found)} equal <{tag}> elements were read as one ({found[1].place})")
        elif len(found) > 1:
            self.fault(f"{item}: {len(found)} <{tag}> elements; keep one", found[1])
        return found[0] if found else None


def _amount(count: int, least: int | None) -> str:
    if count == 1 and least in (None, 1):
        return "a number"
    return f"{count} numbers" if least in (None, count) else f"{least} to {count} numbers"


def _short(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _hint(word: str) -> str:
    if "${" in word or "$(" in word:
        return "; run xacro on the file first"
    if "," in word:
        return "; it has a comma: write numbers with a point, and spaces between them"
    return ""


def _content(element: Element) -> tuple[object, ...]:
    """Return what an element says, to compare it with another."""
    return element.tag, element.attributes, element.text.split(), [_content(c) for c in element.children]


def misspelt(name: str, known: Iterable[str]) -> str:
    """Return the known name that was probably meant, or an empty text.

    Names are compared without case and separators. They must have most letters in common and nearly the same length,
    so that an extension whose name holds a known word (``gear_velocity``) is not taken for it.
    """
    plain = {_plain(k): k for k in known if abs(len(k) - len(name)) <= 2}
    found = difflib.get_close_matches(_plain(name), plain, n=1, cutoff=0.75) if plain else ()
    return plain[found[0]] if found else ""


def _plain(name: str) -> str:
    return re.sub(r"[-_.\s]", "", name.lower())


# MJCF in several files: the content of a file replaces its <include>, as in MuJoCo.
#
# A name is looked for in the folder of the file that was asked for, then in that of the file which
# names it; what stands inside the root element there takes the <include>'s place; no file is taken
# twice. Unlike MuJoCo, only names relative to those folders are followed, so that a description
# means the same wherever its folder is.

_TAG: Final = "include"


def expanded(mujoco: Element, path: Path) -> Element:
    """Return a <mujoco> element with the files that it includes.

    Parameters
    ----------
    mujoco : Element
        Of the file that was asked for; left as it is.
    path : pathlib.Path
        That file.

    Raises
    ------
    LoadError
        A file is missing, is no XML, is named by an absolute path, or is included twice.
    """
    if all(e.tag != _TAG for e in mujoco.walk()):
        return mujoco
    main = _Main(path)
    return replace(mujoco, children=main.inside(mujoco, path.parent, 1))


class _Main:
    """The file that was asked for, and what was taken into it so far."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.taken = {_identity(path)}
        self.bytes = 0

    def inside(self, element: Element, folder: Path, level: int) -> list[Element]:
        """Return the children of an element of a file in `folder`, `level` deep in the whole."""
        if level > MOST_LEVELS:
            self._refuse(element, f"elements are nested more than {MOST_LEVELS} deep, included files counted")
        out: list[Element] = []
        for child in element.children:
            if child.tag == _TAG:
                out += self._included(child, folder, level)
            else:
                out.append(replace(child, children=self.inside(child, folder, level + 1)))
        return out

    def _included(self, include: Element, folder: Path, level: int) -> list[Element]:
        name = include.attributes.get("file", "")
        if not name.strip():
            self._refuse(include, 'no file; write <include file="..."/>')
        if include.children:
            self._refuse(include, "has elements of its own; move them into the file, or beside the <include>")
        found = self._found(include, name, folder)
        identity = _identity(found)
        if identity in self.taken:
            self._refuse(include, "was included before, or includes itself; a file is taken once at most")
        self.taken.add(identity)
        root = self._read(include, found)
        if not root.children:
            self._refuse(include, f"<{root.tag[:60]}> in it is empty; expected elements inside")
        # A file counts as a level, so that a chain of them ends too.
        return self.inside(root, found.parent, level + 1)

    def _found(self, include: Element, name: str, folder: Path) -> Path:
        """Return the file that a name means."""
        # Written on Windows, and read so by MuJoCo everywhere.
        relative = PurePosixPath(name.replace("\\", "/"))
        if relative.is_absolute() or PureWindowsPath(name).drive:
            self._refuse(
                include, f"an absolute path is not followed; write it as seen from {self.path.parent}, or move it there"
            )
        folders = list(dict.fromkeys((self.path.parent, folder)))
        for place in folders:
            try:
                if (place / relative).exists():
                    return place / relative
            except OSError as error:
                self._refuse(include, f"cannot be read ({error.strerror})")
        return self._refuse(include, f"no such file in {' or '.join(str(f) for f in folders)}")

    def _read(self, include: Element, path: Path) -> Element:
        try:
            root = read(path)
            self.bytes += path.stat().st_size
        except (LoadError, OSError) as error:
            self._refuse(include, str(error))
        if self.bytes > MOST_BYTES:
            self._refuse(include, f"up to {MOST_BYTES} bytes of included files were expected")
        file = _relative(path, self.path.parent)
        for element in root.walk():
            element.file = file
            element.included_at = include.included_at or include.line
        return root

    def _refuse(self, element: Element, why: str) -> NoReturn:
        named = f' file="{element.attributes["file"][:200]}"' if element.attributes.get("file") else ""
        raise LoadError(f"{self.path}: {element.place}: <{element.tag}{named}>: {why}")


def _identity(path: Path) -> Path:
    # However it is spelt, and through whatever links.
    return path.resolve()


def _relative(path: Path, folder: Path) -> str:
    try:
        return str(path.relative_to(folder))
    except ValueError:
        return str(path)
