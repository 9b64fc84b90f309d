"""TOML as a baseline has it: sections, and below them one line for each number or row, which says by itself what it is.

Why TOML: the standard library reads it, a name stands beside each number, comments are allowed, there
are infinities, and no text is taken for a number or a truth value. JSON lines have no comments and no
infinities; YAML needs a library, and reads 1e5 as text and no as false.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

from mbkit._escape import json_text

__all__ = ["dumps", "value"]

_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")


def dumps(table: Mapping[str, Any]) -> str:
    """Return a table as text: first what is no table itself, then a section for each that is.

    Below a section every line is the whole path to a number, text or row. Floats are the
    shortest text that reads back to the same bits.
    """
    head = [f"{_key(k)} = {value(x)}" for k, x in table.items() if not isinstance(x, Mapping)]
    sections = ["\n".join(head)]
    for name, part in table.items():
        if isinstance(part, Mapping) and part:
            sections.append("\n".join([f"[{_key(name)}]", *_lines(part)]))
    return "\n\n".join(sections) + "\n"


def _lines(part: Mapping[str, Any], before: str = "") -> Iterator[str]:
    for name, x in part.items():
        path = before + _key(name)
        if isinstance(x, Mapping):
            yield from _lines(x, path + ".")
        else:
            yield f"{path} = {value(x)}"


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else _text(name)


def _text(x: str) -> str:
    # What JSON escapes, TOML reads alike, but for characters of two units, which TOML writes as one.
    return "".join(
        f"\\U{ord(c):08x}" if ord(c) > 0xFFFF and not c.isprintable() else json_text(c)
        for c in json.dumps(x, ensure_ascii=False)
    )


def value(x: Any) -> str:
    """Return a number, text or list as TOML."""
    if isinstance(x, bool):
        return "true" if x else "false"
    if isinstance(x, str):
        return _text(x)
    if isinstance(x, (list, tuple)):
        return f"[{', '.join(value(y) for y in x)}]"
    return repr(x)
