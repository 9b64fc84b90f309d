"""One self-contained HTML page: no script, nothing loaded from anywhere, light and dark."""

from __future__ import annotations

from datetime import datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from mbkit.report import figures
from mbkit.report.numbers import count_text, error_text, plain, time_text
from mbkit.report.reading import allowances, by_term, curves, failures, headline, judged, notices, omission_state, told
from mbkit.studies.all_robots import Sweep
from mbkit.studies.costs import DURATION
from mbkit.studies.result import Comparison

if TYPE_CHECKING:
    from jinja2 import Environment

__all__ = ["check_page", "sweep_page"]


def check_page(result: Comparison, *, asked: str = "", data: str = "", when: datetime | None = None) -> str:
    """Return the page of one comparison.

    Parameters
    ----------
    result : Comparison
    asked : str
        What the model was asked for as, where that is another name.
    data : str
        Name of the JSON file beside the page.
    when : datetime, optional
        Stamped on the page; by default now.
    """
    from markupsafe import Markup

    return _render(
        "check.html",
        when,
        data,
        result,
        asked=asked if asked != result.model else "",
        headline=headline(result),
        failures=failures(result),
        allowances=allowances(result),
        terms=by_term(result),
        notices=notices(result.refusals),
        judged=judged(result),
        told=told(result),
        curves=curves(result),
        digits_figure=Markup(figures.digits(result)) if result.rows else None,
        costs_figure=Markup(figures.error_against_time(result, DURATION)) if curves(result) else None,
        horizon=DURATION,
    )


def sweep_page(result: Sweep, *, data: str = "", when: datetime | None = None) -> str:
    """Return the page of many robots."""
    from markupsafe import Markup

    compared = any(o.comparison and o.comparison.rows for o in result.outcomes)
    return _render("all.html", when, data, result, figure=Markup(figures.robots(result)) if compared else None)


def _render(template: str, when: datetime | None, data: str, result: Any, **more: Any) -> str:
    stamp = (when or datetime.now().astimezone()).strftime("%Y-%m-%d %H:%M:%S %Z").strip()
    return _environment().get_template(template).render(result=result, when=stamp, data=data, **more)


@lru_cache(maxsize=1)
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("mbkit.report"),
        # Names come from files of strangers.
        autoescape=True,
        finalize=_harmless,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters.update(error=error_text, time=time_text, count=count_text, unchanged=omission_state)
    return made


def _harmless(value: Any) -> Any:
    # Control characters too; markup made here is of another type.
    return plain(value) if type(value) is str else value
