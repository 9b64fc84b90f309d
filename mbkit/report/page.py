"""Documents as self-contained HTML pages: no script, nothing loaded from anywhere, light and dark."""

from __future__ import annotations

from datetime import datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from mbkit._escape import terminal
from mbkit.report.document import Document, spans
from mbkit.report.formatting import count_text, error_text, time_text
from mbkit.report.stress_view import FILTERS

if TYPE_CHECKING:
    from jinja2 import Environment


def render(shown: Document, *, data: str = "", table: str = "", when: datetime | None = None) -> str:
    """Return a document as a page; `data` and `table` are the JSON and CSV files beside it, `when` its date."""
    stamp = (when or datetime.now().astimezone()).strftime("%Y-%m-%d %H:%M:%S %Z").strip()
    template = _environment().get_template(shown.template)
    names = {"data": data, "table_file": table}
    return template.render(shown=shown, result=shown.result, when=stamp, **names, **shown.content())


@lru_cache(maxsize=1)
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader("mbkit.report"),
        # Names come from files of strangers.
        autoescape=True,
        finalize=_harmless,
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
        markup=Markup,
        **FILTERS,
    )
    return environment


def _harmless(value: Any) -> Any:
    # Control characters too; our own markup is of another type.
    return terminal(value) if type(value) is str else value
