"""`mbkit stress`: where each engine and method breaks."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import click

from mbkit import _interrupt
from mbkit.cli import _shared as shared
from mbkit.cli._shared import Report

if TYPE_CHECKING:
    from mbkit.studies.stress.case import Case


@shared.command(
    "mbkit stress --list", "mbkit stress --quick", "mbkit stress joint_spring heavy_tip --engines lagrangian,mujoco"
)
@click.argument("cases", nargs=-1, metavar="[CASE]...")
@click.option("--quick", is_flag=True, help="Fewer values and methods: under two minutes instead of thirty.")
@shared.engines_option("lagrangian,pinocchio,mujoco")
@shared.methods_option("all; quick: one of a kind")
@click.option("--bar", type=float, help="Relative error up to which a value is held.  [default: 1e-6]")
@click.option("--dt", type=float, help="Step of fixed-step methods, s.  [default: 1e-3]")
@click.option("--rtol", type=float, help="Tolerance of adaptive methods.  [default: 1e-8]")
@click.option("--seconds", type=float, help="What one run may take, s.  [default: 2; quick: 0.5]")
@click.option("--budget", type=float, help="What the study may take, s.  [default: 1700; quick: 100]")
@click.option("--jobs", type=click.IntRange(min=1), help="Processes side by side.  [default: one a processor]")
@click.option("--list", "listing", is_flag=True, help="List the cases, and end.")
@shared.report_options
def stress(
    cases: tuple[str, ...],
    quick: bool,
    engines: tuple[str, ...],
    methods: tuple[str, ...],
    listing: bool,
    jobs: int | None,
    report: Report,
    **numbers: float | None,
) -> None:
    """Sweep each CASE's number over decades: where does each engine and method break, and how.

    All cases where none is named; --list tells them. A page, JSON and CSV are written. Every run is in a process of its
    own with a bound of time and memory. Ctrl-C ends the study early and writes the finished part.
    """
    if listing:
        _list(as_json=report.as_json)
        return
    from mbkit.simulate.progress import Bar
    from mbkit.studies._checkpoint import InterruptedSweepError
    from mbkit.studies.stress.study import stress as study

    shared.check_engines(engines, least=1)
    # One case has files of its own; several share theirs.
    stem = f"{cases[0]}-stress" if len(cases) == 1 else "stress"
    report.prepare(stem, "json", "csv", "html")
    limits: dict[str, Any] = {name: x for name, x in numbers.items() if x is not None}
    try:
        with _interrupt.keeping, Bar("stress") as bar:
            result = study(cases or None, engines, methods or None, quick=quick, jobs=jobs, progress=bar, **limits)
    except InterruptedSweepError as stopped:
        result = stopped.result
    written = report.write(result.document(full=False), stem, table=result.to_csv)
    finished = sum(cell.end == "finished" for _, row in result.rows() for cell in row.cells)
    if not result.complete:
        shared.say("interrupted", f"{finished} runs were finished")
        shared.leave(shared.INTERRUPTED)
    if not finished:
        shared.say("error", "no run was finished; the reasons are in the data")
    shared.leave(shared.DONE if written and finished else shared.MISUSE)


def _list(*, as_json: bool) -> None:
    from mbkit.report.terminal import table
    from mbkit.studies.document import Column, Table
    from mbkit.studies.stress.cases import CASES

    if as_json:
        facts = [{**case.facts(), "values": case.values, "quick": case.quick} for case in CASES.values()]
        shared.tell(json.dumps(facts))
        return
    columns = [
        Column("case", lambda case: case.name),
        Column("family", lambda case: case.family),
        Column("swept", _swept),
        Column("about", lambda case: case.about),
    ]
    shared.console().print(table(Table(columns, [*CASES.values()])))


def _swept(case: Case) -> str:
    return f"{case.parameter} {case.values[0]:g} to {case.values[-1]:g} {case.unit}".rstrip()
