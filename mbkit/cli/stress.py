"""`mbkit stress`: where each engine and method breaks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from mbkit import _interrupt
from mbkit.cli._shared import (
    DONE,
    INTERRUPTED,
    MISUSE,
    check_engines,
    console,
    engines_option,
    json_option,
    leave,
    prepare,
    report_options,
    say,
    show,
    split,
    tell,
)


@click.command()
@click.argument("cases", nargs=-1, metavar="[CASE]...")
@click.option("--quick", is_flag=True, help="Fewer values and methods: under two minutes instead of thirty.")
@engines_option("lagrangian,pinocchio,mujoco")
@click.option(
    "--methods",
    default="",
    callback=split,
    metavar="A,B,...",
    help="Integrators.  [default: all; quick: one of a kind]",
)
@click.option("--bar", type=float, help="Relative error up to which a value is held.  [default: 1e-6]")
@click.option("--dt", type=float, help="Step of fixed-step methods, s.  [default: 1e-3]")
@click.option("--rtol", type=float, help="Tolerance of adaptive methods.  [default: 1e-8]")
@click.option("--seconds", type=float, help="What one run may take, s.  [default: 2; quick: 0.5]")
@click.option("--budget", type=float, help="What the study may take, s.  [default: 1700; quick: 100]")
@click.option("--jobs", type=click.IntRange(min=1), help="Processes side by side.  [default: one a processor]")
@click.option("--list", "listing", is_flag=True, help="List the cases, and end.")
@json_option
@report_options
def stress(
    cases: tuple[str, ...],
    quick: bool,
    engines: tuple[str, ...],
    methods: tuple[str, ...],
    listing: bool,
    jobs: int | None,
    as_json: bool,
    out: Path,
    force: bool,
    **numbers: float | None,
) -> None:
    """Sweep each CASE's number over decades: where does each engine and method break, and how.

    All cases where none is named; --list tells them. A page, JSON and CSV are written.
    Every run is in a process of its own with a bound of time and memory. Ctrl-C ends the
    study early, and what is finished is written.
    """
    if listing:
        _list(as_json=as_json)
        leave(DONE)
    from mbkit.methods.registry import method_of
    from mbkit.report.progress import Bar
    from mbkit.report.stress_page import view
    from mbkit.studies._checkpoint import InterruptedSweepError
    from mbkit.studies.stress.study import stress as study

    check_engines(engines, least=1)
    for name in methods:
        method_of(name)
    # One case has files of its own; several share theirs.
    stem = f"{cases[0]}-stress" if len(cases) == 1 else "stress"
    prepare(out, stem, "json", "csv", "html", force=force)
    limits: dict[str, Any] = {name: x for name, x in numbers.items() if x is not None}
    try:
        with _interrupt.keeping, Bar("stress") as bar:
            result = study(cases or None, engines, methods or None, quick=quick, jobs=jobs, progress=bar, **limits)
    except InterruptedSweepError as stopped:
        result = stopped.result
    written = show(result, lambda: view(result), stem, out, as_json=as_json, force=force, table=result.to_csv)
    finished = sum(cell.end == "finished" for _, row in result.rows() for cell in row.cells)
    if not result.complete:
        say("interrupted", f"{finished} runs were finished")
    elif not finished:
        say("error", "no run was finished; the reasons are in the data")
    leave(INTERRUPTED if not result.complete else MISUSE if not written or not finished else DONE)


def _list(*, as_json: bool) -> None:
    import json

    from rich.text import Text

    from mbkit.report.terminal import columns
    from mbkit.studies.stress.cases import CASES

    if as_json:
        tell(json.dumps([{**case.facts(), "values": case.values, "quick": case.quick} for case in CASES.values()]))
        return
    table = columns("case", "family", "swept", "about")
    for case in CASES.values():
        unit = f" {case.unit}" if case.unit else ""
        swept = f"{case.parameter} {case.values[0]:g} to {case.values[-1]:g}{unit}"
        table.add_row(Text(case.name), Text(case.family), Text(swept), Text(case.about))
    console().print(table)
