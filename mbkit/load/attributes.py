"""Numbers and names in attributes, read strictly; every fault is kept, none is raised."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable
from typing import Final

from mbkit.load.xml import Element

__all__ = ["LARGEST", "Reader", "misspelt"]

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

    def name(self, element: Element, attribute: str, who: str) -> str:
        """Return a name that must be there, not be empty, and be short enough for a message."""
        value = element.attributes.get(attribute, "")
        if not value.strip():
            self.fault(f"{who}: <{element.tag}> has no {attribute}; give it one", element)
        if len(value) > _LONGEST_NAME:
            self.fault(
                f"{who}: {element.tag} {attribute}: a name of {len(value)} characters; "
                f"expected up to {_LONGEST_NAME}, got {_short(value)}",
                element,
            )
            return value[:_LONGEST_NAME]
        return value

    def numbers(
        self,
        element: Element,
        attribute: str,
        who: str,
        *,
        count: int,
        least: int | None = None,
        default: tuple[float, ...] | None = None,
        bounded: bool = True,
    ) -> tuple[float, ...]:
        """Return the numbers of an attribute.

        Parameters
        ----------
        element, attribute, who
            Where to read, and whom the message blames.
        count, least : int
            How many numbers are expected: exactly `count`, or from `least` to `count`.
        default : tuple of float, optional
            What stands for an absent attribute, which is a fault without it.
        bounded : bool
            Whether sizes that would overflow are a fault; limits may be that large.
        """
        where = f"{who}: {element.tag} {attribute}"
        neutral = default if default is not None else (0.0,) * count
        raw = element.attributes.get(attribute)
        if raw is None:
            if default is None:
                self.fault(f"{where}: missing; expected {_told(count, least)}", element)
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
            self.fault(f"{where}: expected {_told(count, least)}, got {_short(raw)}", element)
            return neutral
        return tuple(values)

    def number(
        self, element: Element, attribute: str, who: str, default: float | None = None, *, bounded: bool = True
    ) -> float:
        """Return a single number; see `numbers`."""
        fallback = None if default is None else (default,)
        return self.numbers(element, attribute, who, count=1, default=fallback, bounded=bounded)[0]

    def choice(self, element: Element, attribute: str, choices: tuple[str, ...]) -> str:
        """Return one of the choices, the first where the attribute is absent."""
        value = element.attributes.get(attribute, choices[0])
        if value in choices:
            return value
        self.fault(f"{element.tag} {attribute}: expected one of {', '.join(choices)}, got {value[:40]!r}", element)
        return choices[0]

    def only(self, element: Element, tag: str, who: str) -> Element | None:
        """Return the child of this tag, of which there may be one, or several that are equal."""
        found = element.all(tag)
        if len(found) > 1 and all(_content(e) == _content(found[0]) for e in found):
            self.notes.append(f"{who}: {len(found)} equal <{tag}> elements were read as one ({found[1].place})")
        elif len(found) > 1:
            self.fault(f"{who}: {len(found)} <{tag}> elements; keep one", found[1])
        return found[0] if found else None


def _told(count: int, least: int | None) -> str:
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
    so that an extension whose name holds a known word (``gear_velocity``) is none.
    """
    plain = {_plain(k): k for k in known if abs(len(k) - len(name)) <= 2}
    found = difflib.get_close_matches(_plain(name), plain, n=1, cutoff=0.75) if plain else ()
    return plain[found[0]] if found else ""


def _plain(name: str) -> str:
    return re.sub(r"[-_.\s]", "", name.lower())
