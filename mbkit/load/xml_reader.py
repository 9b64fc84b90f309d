"""Parser for untrusted XML, with line numbers, and a strict reader of attributes.

It refuses document type declarations, because they can hold entity bombs, external entities and file URLs.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Final, NoReturn
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from mbkit._check import MAX_MAGNITUDE, shown
from mbkit.errors import InputError, LoadError
from mbkit.model.builder import MAX_NAME_LENGTH

#: Far above any robot, far below what would exhaust memory or the stack.
MAX_FILE_BYTES: Final = 64 * 2**20
MAX_ELEMENTS: Final = 500_000
MAX_DEPTH: Final = 250

_ENDINGS: Final = (".urdf", ".xml", ".mjcf")
_MAX_LISTED_FILES: Final = 10
# An XML declaration starts in the first so many bytes, and is no longer.
_MAX_DECLARATION_BYTES: Final = 4096
_COMMENT: Final = re.compile(rb"<!--.*?-->", re.DOTALL)
_ENCODING: Final = re.compile(rb"encoding\s*=\s*[\"']([A-Za-z0-9._-]+)[\"']")
_BLANK: Final = b" \t\r\n\xef\xbb\xbf"

#: expat's "syntax error" and "not well-formed (invalid token)" do not name the character.
_VAGUE_ERRORS: Final = (2, 4)
#: First elements of descriptions.
_ROOTS: Final = ("robot", "mujoco", "mujocoinclude", "sdf")
_FIRST: Final = re.compile(rb"<([A-Za-z]\w*)")


@dataclass(eq=False, slots=True)
class Element:
    """An element as it was written."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)
    text: str = ""
    file: str = ""  # the included file that holds it; empty in the main file
    notes: tuple[str, ...] = ()  # of the root element: ignored parts of the text
    included_at: int = 0  # the line of the <include> in the main file, else 0

    @property
    def place(self) -> str:
        """File and line, for messages."""
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
    """Return the root element of a file, or raise `LoadError`."""
    try:
        exists, is_file = path.exists(), path.is_file()
        size = path.stat().st_size if exists else 0
        content = path.read_bytes() if is_file and size <= MAX_FILE_BYTES else b""
    except (OSError, ValueError) as error:
        # ValueError: a null character in the name.
        raise LoadError(f"{path!s}: cannot be read ({error})") from None
    if not exists:
        raise LoadError(f"{path}: no such file")
    if not is_file:
        what = f"a folder{_descriptions(path)}" if path.is_dir() else "not a regular file"
        raise LoadError(f"{path}: expected a URDF or MJCF file, this is {what}")
    if size > MAX_FILE_BYTES:
        raise LoadError(f"{path}: expected a description of up to {MAX_FILE_BYTES} bytes, got {size} bytes")
    return parse(content, str(path))


def expanded(path: Path, arguments: Mapping[str, str]) -> Element:
    """Return the root element of what xacro makes of a file with arguments; `LoadError` in xacro's words."""
    if not isinstance(arguments, Mapping) or not all(isinstance(x, str) for pair in arguments.items() for x in pair):
        raise InputError(
            f"xacro: expected a mapping of names to text, as {{'prefix': 'left_'}}, got {shown(arguments)}"
        )
    # A file that is missing or too large is refused as every file is.
    read(path)
    try:
        # Only such a file needs it.
        import xacro
    except ImportError:
        raise LoadError(f"{path}: a xacro file is expanded by the package xacro; pip install 'mbkit[xacro]'") from None
    try:
        text = xacro.process_file(str(path), mappings=dict(arguments)).toxml()
    except Exception as error:
        # Any: its macros are Python's expressions.
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise LoadError(f"{path}: xacro cannot expand it: {why[:500]}") from None
    return parse(text.encode(), str(path))


def unknown_root(path: Path, root: Element) -> LoadError:
    """Return the error for a file of neither format."""
    expected = "<robot> (URDF) or <mujoco> (MJCF)"
    if root.tag == "mujocoinclude":
        expected += "; this is a part that such a file includes"
    return LoadError(f"{path}: the root element is <{root.tag[:60]}>; expected {expected}")


def _descriptions(folder: Path) -> str:
    """List the descriptions in a folder and in those right below, for a message; a whole disk may be below it."""
    files = itertools.islice(itertools.chain(folder.glob("*"), folder.glob("*/*")), 10_000)
    names = sorted(str(p.relative_to(folder)) for p in files if p.suffix in _ENDINGS)
    if not names:
        return ", and no .urdf or .xml file is in it or right below"
    return f"; it holds {', '.join(names[:_MAX_LISTED_FILES])}{' and more' * (len(names) > _MAX_LISTED_FILES)}"


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
        if len(stack) > MAX_DEPTH:
            raise LoadError(f"{name}: line {element.line}: elements are nested more than {MAX_DEPTH} deep")
        if count > MAX_ELEMENTS:
            raise LoadError(f"{name}: line {element.line}: more than {MAX_ELEMENTS} elements; a robot has far fewer")

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
        # A file that is no description, which an <include> may name, is not quoted.
        first = _FIRST.search(_COMMENT.sub(b"", content))
        known = first is not None and first[1].decode() in _ROOTS
        why = _unexpected(content, parser.ErrorByteIndex) if known else "its first element is no <robot> or <mujoco>"
        if error.code not in _VAGUE_ERRORS or not why:
            why = expat.errors.messages.get(error.code, str(error))
        raise LoadError(f"{name}: line {error.lineno}, column {error.offset + 1}: not well-formed XML: {why}") from None
    except LoadError:
        raise
    except (LookupError, ValueError) as error:
        raise LoadError(f"{name}: not readable as XML: {error}; save it as UTF-8") from None
    roots[0].notes = notes
    return roots[0]


def _readable(content: bytes) -> tuple[bytes, str | None, tuple[str, ...]]:
    """Return a text without parts that robot parsers ignore and expat refuses, its encoding, and notes.

    These are text before the XML declaration, and null characters after the last element. Lines keep their numbers.
    """
    if content[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in content[:4]:
        # In UTF-16 a null is half of a character.
        return content, None, ()
    notes = []
    stripped = content.rstrip(b"\0" + _BLANK[:4])
    if b"\0" in content[len(stripped) :]:
        content = stripped
        notes.append("null characters after the last element were ignored")
    start = content.find(b"<?xml", 0, _MAX_DECLARATION_BYTES)
    stop = content.find(b"?>", start, start + _MAX_DECLARATION_BYTES) + 2
    before = content[: max(start, 0)]
    if not before.strip(b"\xef\xbb\xbf") or stop < 2 or b"<" in _COMMENT.sub(b"", before):
        return content, None, tuple(notes)
    encoding = _ENCODING.search(content, start, stop)
    content = b"\n" * content.count(b"\n", 0, stop) + content[stop:]
    notes.append("text before the XML declaration was ignored")
    return content, encoding.group(1).decode() if encoding else None, tuple(notes)


def _unexpected(content: bytes, at: int) -> str:
    """Return the character that ends the reading of a text, with the text before it; empty at the text's end."""
    if not 0 <= at < len(content):
        return ""
    byte = content[at]
    try:
        character = content[at : at + 4].decode("utf-8", "ignore")[:1] if byte < 0x80 else content[at:].decode()[:1]
    except UnicodeDecodeError:
        return f"byte 0x{byte:02x} is not UTF-8; save the file as UTF-8"
    before = re.split(rb"[\r\n]", content[:at])[-1]
    line = before.decode("utf-8", "replace").replace("\0", "").lstrip()[-30:]
    after = f" after {line!r}" if line else ""
    if not character.isprintable() and not character.isspace():
        return f"control character 0x{byte:02x}{after}; remove it"
    hint = "" if line else "; expected <"
    if line.endswith("&") or character == "<":
        hint = "; write &amp; for &" if line.endswith("&") else "; write &lt; for < in a value"
    return f"unexpected {character!r}{after}{hint}"


def element_text(tag: str, attributes: Mapping[str, str], inside: str = "") -> str:
    """Return an element as XML."""
    head = tag + "".join(f" {k}={quoteattr(v)}" for k, v in attributes.items())
    return f"<{head}>{inside}</{tag}>" if inside else f"<{head}/>"


# Numbers and names in attributes

_NUMBER: Final = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)


class Reader:
    """Reads attributes strictly, and collects faults and notes instead of raising."""

    def __init__(self) -> None:
        self.faults: list[str] = []
        self.notes: list[str] = []

    def fault(self, text: str, element: Element | None = None) -> None:
        """Keep one fault, with the element's place."""
        self.faults.append(f"{text} ({element.place})" if element else text)

    def name(self, element: Element, attribute: str, item: str) -> str:
        """Return a required name that is short enough for a message."""
        value = element.attributes.get(attribute, "")
        if not value.strip():
            self.fault(f"{item}: <{element.tag}> has no {attribute}; give it one", element)
        if len(value) > MAX_NAME_LENGTH:
            expected = f"expected a name of up to {MAX_NAME_LENGTH} characters, got {len(value)}: {_short(value)}"
            self.fault(f"{item}: {element.tag} {attribute}: {expected}", element)
        return value[:MAX_NAME_LENGTH]

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
        """Return `count` numbers of an attribute, or from `least` to `count`.

        An absent attribute is a fault without a `default`, and sizes that would overflow are one where `bounded`.
        """
        raw = element.attributes.get(attribute)
        if raw is None and default is not None:
            return default
        least = count if least is None else least
        expected = f"expected {count} numbers" if least == count else f"expected {least} to {count} numbers"
        expected = "expected a number" if count == least == 1 else expected
        words = [] if raw is None else raw.split()
        values = tuple(float(word) if _NUMBER.fullmatch(word) else math.nan for word in words)
        why = f"missing; {expected}" if raw is None else ""
        if raw is not None and not least <= len(words) <= count:
            why = f"{expected}, got {_short(raw)}"
        for word, value in zip(words, values, strict=True):
            if not math.isfinite(value):
                why = f"{_short(word)} is not a finite number{_hint(word)}"
                break
            if bounded and abs(value) > MAX_MAGNITUDE:
                why = f"{_short(word)} is too large to compute with"
                break
        if not why:
            return values
        self.fault(f"{item}: {element.tag} {attribute}: {why}", element)
        return (0.0,) * count if default is None else default

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
        children = element.all(tag)
        if len(children) > 1 and all(_content(e) == _content(children[0]) for e in children):
            self.notes.append(f"{item}: {len(children)} equal <{tag}> elements were read as one ({children[1].place})")
        elif len(children) > 1:
            self.fault(f"{item}: {len(children)} <{tag}> elements; keep one", children[1])
        return children[0] if children else None


def _short(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _hint(word: str) -> str:
    if "${" in word or "$(" in word:
        return "; run xacro on the file first"
    if "," in word:
        return "; it has a comma: write numbers with a point, and spaces between them"
    return ""


def _content(element: Element) -> tuple[object, ...]:
    """Return an element's content without lines and spaces, to compare it with another."""
    return element.tag, element.attributes, element.text.split(), [_content(c) for c in element.children]


def misspelt(name: str, known: Iterable[str]) -> str:
    """Return the known name that was probably meant, or an empty text; case and separators do not matter.

    Lengths must be nearly the same, so that an extension such as ``gear_velocity`` does not match a word in it.
    """
    plain = {_plain(k): k for k in known if abs(len(k) - len(name)) <= 2}
    near = difflib.get_close_matches(_plain(name), plain, n=1, cutoff=0.75)
    return plain[near[0]] if near else ""


def _plain(name: str) -> str:
    return re.sub(r"[-_.\s]", "", name.lower())


def unused(name: str, names: Container[object]) -> str:
    """Return this name, or a longer one that is not among `names`."""
    while name in names:
        name += "_"
    return name


def reserved(name: str, names: set[str]) -> str:
    """Return this name, or a longer one that is not among `names`, and add it to them."""
    names.add(name := unused(name, names))
    return name


# MJCF in several files
#
# As in MuJoCo, the content of a file's root element replaces an <include>, a name is relative to the folder of the
# main file or else of the file with the <include>, and no file is included twice. Unlike in MuJoCo, absolute
# names are not followed, so that a description means the same wherever its folder is.

_INCLUDE: Final = "include"


def with_includes(mujoco: Element, path: Path) -> Element:
    """Return the <mujoco> element of a file with the files that it includes, or raise `LoadError`."""
    if all(e.tag != _INCLUDE for e in mujoco.walk()):
        return mujoco
    return replace(mujoco, children=_Includes(path).inside(mujoco, path.parent, 1))


class _Includes:
    """The files that a main file includes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.seen = {path.resolve()}
        self.bytes = 0

    def inside(self, element: Element, folder: Path, level: int) -> list[Element]:
        """Return the children of an element of a file in `folder`, `level` deep in the whole."""
        if level > MAX_DEPTH:
            self._refuse(element, f"elements are nested more than {MAX_DEPTH} deep, included files counted")
        out: list[Element] = []
        for child in element.children:
            if child.tag != _INCLUDE:
                out.append(replace(child, children=self.inside(child, folder, level + 1)))
                continue
            path = self._path(child, folder)
            # A file counts as a level, so that a chain of them ends too.
            out += self.inside(self._read(child, path), path.parent, level + 1)
        return out

    def _path(self, include: Element, folder: Path) -> Path:
        """Return the path of an included file."""
        name = include.attributes.get("file", "")
        if not name.strip():
            self._refuse(include, 'no file; write <include file="..."/>')
        if include.children:
            self._refuse(include, "has elements of its own; move them into the file, or beside the <include>")
        # MuJoCo reads Windows' separators everywhere.
        relative = PurePosixPath(name.replace("\\", "/"))
        main = self.path.parent
        if relative.is_absolute() or PureWindowsPath(name).drive:
            self._refuse(include, f"an absolute path is not followed; write it as seen from {main}, or move it there")
        folders = list(dict.fromkeys((main, folder)))
        try:
            path = next((x / relative for x in folders if (x / relative).exists()), None)
        except OSError as error:
            self._refuse(include, f"cannot be read ({error.strerror})")
        if path is None:
            self._refuse(include, f"no such file in {' or '.join(str(f) for f in folders)}")
        if path.resolve() in self.seen:
            self._refuse(include, "was included before, or includes itself; include a file once at most")
        self.seen.add(path.resolve())
        return path

    def _read(self, include: Element, path: Path) -> Element:
        try:
            root = read(path)
            self.bytes += path.stat().st_size
        except (LoadError, OSError) as error:
            self._refuse(include, str(error))
        if self.bytes > MAX_FILE_BYTES:
            self._refuse(include, f"expected up to {MAX_FILE_BYTES} bytes of included files")
        if not root.children:
            self._refuse(include, "its root element is empty; expected elements inside")
        folder = self.path.parent
        file = str(path.relative_to(folder) if path.is_relative_to(folder) else path)
        for element in root.walk():
            element.file = file
            element.included_at = include.included_at or include.line
        return root

    def _refuse(self, element: Element, why: str) -> NoReturn:
        named = f' file="{element.attributes["file"][:200]}"' if element.attributes.get("file") else ""
        raise LoadError(f"{self.path}: {element.place}: <{element.tag}{named}>: {why}")
