"""Documents as self-contained HTML pages, light, dark and printed: nothing is loaded, one script sorts tables.

The script stands in the page. Its digest in the page's security policy keeps any other from running.
"""

from __future__ import annotations

import base64
import hashlib
from datetime import datetime
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from mbkit._escape import terminal
from mbkit.studies.document import Document, Span, spans
from mbkit.studies.formatting import count_text, error_text, time_text

if TYPE_CHECKING:
    from jinja2 import Environment


def render(shown: Document, *, data: str = "", table: str = "", when: datetime | None = None) -> str:
    """Return a document as a page; `data` and `table` are the JSON and CSV files beside it, `when` its date."""
    stamp = (when or datetime.now().astimezone()).strftime("%Y-%m-%d %H:%M:%S %Z").strip()
    template = _environment().get_template("document.html")
    names = {"data": data, "table_file": table, "script": _script(), "digest": _digest()}
    return template.render(shown=shown, result=shown.result, when=stamp, **names)


@cache
def _script() -> str:
    return (Path(__file__).parent / "templates" / "sort.js").read_text(encoding="utf-8")


def _digest() -> str:
    """Return the script's digest as a security policy writes it."""
    return f"sha256-{base64.b64encode(hashlib.sha256(_script().encode()).digest()).decode()}"


@lru_cache(maxsize=1)
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader("mbkit.report"),
        # Names come from files of strangers.
        autoescape=True,
        # Control characters too; our own markup is of another type.
        finalize=lambda value: terminal(value) if type(value) is str else value,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        error=error_text,
        time=time_text,
        count=count_text,
        spans=spans,
        kind=lambda block: type(block).__name__,
        cellsize=_cellsize,
        markup=Markup,
    )
    return environment


def _cellsize(cell: list[Span]) -> str:
    """Return the class of a cell that is not to be broken, or that needs room, by the length of its text."""
    size = sum(len(span.text) for span in cell)
    return "nowrap " if size <= 34 else "long " if size > 60 else ""
