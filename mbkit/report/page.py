"""One self-contained HTML page: no script, nothing loaded from anywhere, light and dark."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from mbkit._escape import terminal
from mbkit.report import figures, importers_view, stress_view, work_precision_view
from mbkit.report.compare_view import (
    allowances,
    by_term,
    failures,
    headline,
    judged,
    notices,
    omission_state,
    saving_text,
    told,
)
from mbkit.report.figures import term_costs
from mbkit.report.formatting import count_text, error_text, time_text
from mbkit.report.stress_case import section
from mbkit.report.stress_steps import kinds, rules, stable_steps, steps
from mbkit.report.stress_view import avoid, methods, silences
from mbkit.studies import _figure_style
from mbkit.studies.compare.all_robots import Sweep
from mbkit.studies.compare.result import Comparison
from mbkit.studies.importers.result import ParserComparison
from mbkit.studies.stress.figure import error_short, number_text
from mbkit.studies.stress.result import StressResult, engines_of, name_of
from mbkit.studies.work_precision.result import WorkPrecision

if TYPE_CHECKING:
    from jinja2 import Environment

__all__ = ["bench_page", "check_page", "importers_page", "stress_page", "sweep_page"]


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
        digits_figure=Markup(figures.digits(result)) if result.rows else None,
        terms_figure=Markup(term_costs(result)),
        study=_study(result.precision) if result.precision is not None else None,
    )


def bench_page(
    result: WorkPrecision, *, asked: str = "", data: str = "", table: str = "", when: datetime | None = None
) -> str:
    """Return the page of one work-precision study.

    Parameters
    ----------
    result : WorkPrecision
    asked : str
        What the model was asked for as, where that is another name.
    data, table : str
        Names of the JSON and CSV files beside the page.
    when : datetime, optional
        Stamped on the page; by default now.
    """
    return _render(
        "bench.html",
        when,
        data,
        result,
        asked=asked if asked != result.model else "",
        headline=work_precision_view.headline(result),
        table=table,
        study=_study(result),
    )


def _study(result: WorkPrecision) -> dict[str, Any]:
    """Return what the section of error against run time is made of."""
    from markupsafe import Markup

    return {
        "result": result,
        "figure": Markup(work_precision_view.error_against_time(result)) if result.front else None,
        "front": work_precision_view.front_names(result),
        "leads": work_precision_view.leads(result),
        "lines": work_precision_view.curve_lines(result),
        "order_tolerance": work_precision_view.ORDER_TOLERANCE,
        "notices": notices(result.refusals),
    }


def importers_page(result: ParserComparison, *, data: str = "", when: datetime | None = None) -> str:
    """Return the page of one file through several importers.

    Parameters
    ----------
    result : ParserComparison
    data : str
        Name of the JSON file beside the page.
    when : datetime, optional
        Stamped on the page; by default now.
    """
    return _render(
        "importers.html",
        when,
        data,
        result,
        title=importers_view.title(result),
        lines=importers_view.lines(result),
        reasons={p.engine: importers_view.reasons(p) for p in result.importers},
    )


def sweep_page(result: Sweep, *, data: str = "", when: datetime | None = None) -> str:
    """Return the page of many robots."""
    from markupsafe import Markup

    compared = any(o.comparison and o.comparison.rows for o in result.outcomes)
    return _render("all.html", when, data, result, figure=Markup(figures.robots(result)) if compared else None)


def stress_page(result: StressResult, *, data: str = "", table: str = "", when: datetime | None = None) -> str:
    """Return the page of where engines and methods break.

    Parameters
    ----------
    result : StressResult
    data, table : str
        Names of the JSON and CSV files beside the page.
    when : datetime, optional
        Stamped on the page; by default now.
    """
    from markupsafe import Markup

    told = stress_view.overview(result)
    step_cases = steps(told)
    step_rules = rules(step_cases)
    engines = engines_of(result.cases)
    return _render(
        "stress.html",
        when,
        data,
        result,
        table=table,
        headline=stress_view.headline(result),
        avoid=avoid(result),
        silences=silences(result),
        asked=[o for o in told if o.choice is not None],
        behind=[o for o in told if o.behind],
        methods=methods(result),
        run_families=stress_view.families([o for o in told if stress_view.ranks(o.case)]),
        families=stress_view.families(told),
        sections={o.anchor: section(o) for o in told},
        engines=engines,
        series={e: _figure_style.engine_index(e) + 1 for e in engines},
        steps=step_cases,
        rules=step_rules,
        kinds=kinds(step_rules),
        step_figure=Markup(stable_steps(step_cases)) if step_cases else None,
        bars=stress_view.bars(result),
    )


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
    made.filters.update(
        error=error_text,
        time=time_text,
        count=count_text,
        short=error_short,
        number=number_text,
        fact=_three_digits,
        limit=_limit,
        unchanged=omission_state,
        saving=saving_text,
        setting=work_precision_view.setting_text,
        value=stress_view.value_text,
        held=stress_view.held_text,
        how=lambda outcome: stress_view.HOW.get(outcome, ""),
        told=stress_view.told,
        rowname=name_of,
        choice=_choice,
    )
    return made


def _harmless(value: Any) -> Any:
    # Control characters too; markup made here is of another type.
    return terminal(value) if type(value) is str else value


def _choice(value: Any) -> str:
    """Return what somebody chose, a switch, a number, a text or several of them, as a person writes it."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.12g}"
    if isinstance(value, Mapping):
        return "; ".join(f"{k}: {_choice(x)}" for k, x in value.items())
    return ", ".join(map(_choice, value)) if isinstance(value, (list, tuple)) else str(value)


def _three_digits(x: float) -> str:
    return "" if math.isnan(x) else number_text(float(f"{x:.3g}"))


def _limit(x: float | None, unit: str = "") -> str:
    """Return where theory lets something break."""
    if x is None or math.isnan(x):
        return "–"
    return "no limit" if math.isinf(x) else f"{_three_digits(x)} {unit}".rstrip()
