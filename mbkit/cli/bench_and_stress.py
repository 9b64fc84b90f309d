"""`mbkit bench`: which method reaches which error in which time; `mbkit stress`: where each one breaks."""

from __future__ import annotations

import json
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from mbkit import _process as _interrupt
from mbkit.cli import _shared as shared
from mbkit.cli._shared import Report

if TYPE_CHECKING:
    from mbkit.studies.stress.case import Case


#: Limits of evaluations in a run, of all methods and of a few.
_MAX_EVALUATIONS, _MAX_QUICK_EVALUATIONS = 3_000, 12_000


@shared.command("mbkit bench double_pendulum --quick", "mbkit bench ur5 --methods rk4,rk853 --duration 2 --out results")
@click.argument("target")
@shared.engines_option("pinocchio,lagrangian,mujoco")
@shared.methods_option("all there are")
@click.option("--duration", default=1.0, show_default=True, type=float, help="Horizon of the motion, s.")
@shared.seed_option("Of the start.")
@click.option("--repeats", type=click.IntRange(min=1), help="Timings of each setting.  [default: 3; full: 5]")
@click.option("--seconds", type=float, help="Of the processor, at the most, s.  [default: work is bounded, not time]")
@click.option("--jobs", type=click.IntRange(min=1), help="Measure in so many processes: sooner done, times less sure.")
@click.option("--quick", is_flag=True, help="Seven methods alone.")
@click.option("--full", is_flag=True, help="Finer settings, in runs of up to 200,000 evaluations: a minute or more.")
@shared.load_options
@shared.report_options
def bench(
    target: str,
    engines: tuple[str, ...],
    methods: tuple[str, ...],
    repeats: int | None,
    jobs: int | None,
    quick: bool,
    full: bool,
    options: dict[str, Any],
    report: Report,
    **settings: Any,
) -> None:
    """Measure error against run time on TARGET: every engine, every method.

    TARGET is what `mbkit check` takes. A page, its figure, JSON and CSV are written. Runs have up to 3,000 evaluations,
    one called from Python counting eight, so that a small system takes some seconds; with --full 200,000.
    Ctrl-C ends the study early and writes the finished part.
    """
    from mbkit.methods.registry import METHODS, QUICK_METHODS
    from mbkit.simulate.progress import Bar
    from mbkit.studies import work_precision
    from mbkit.studies._targets import model_of
    from mbkit.studies.study_runs import InterruptedSweepError
    from mbkit.studies.work_precision.result import picture
    from mbkit.studies.worker import WorkerPool

    if full and quick:
        raise click.UsageError("--full and --quick are opposites; give one")
    shared.check_engines(engines, least=1)
    report.prepare()
    model = model_of(target, options)
    stem = f"{shared.stem_of(target, model.name)}-bench"
    report.prepare(stem, "json", "csv", "png", "html")
    if quick and not methods:
        # A method that none of the engines has would be refused.
        methods = tuple(m for m in QUICK_METHODS if any(map(METHODS[m].on, engines)))
    settings["repeats"] = repeats or (5 if full else 3)
    settings["work"] = None if full else _MAX_QUICK_EVALUATIONS if quick else _MAX_EVALUATIONS
    workers: AbstractContextManager[Executor | None] = nullcontext() if jobs is None else WorkerPool(jobs)
    try:
        with _interrupt.keeping, Bar(f"bench {model.name}") as bar, workers as executor:
            result = work_precision(model, engines, methods or None, executor=executor, progress=bar, **settings)
    except InterruptedSweepError as stopped:
        result = stopped.result
    figure = partial(picture, result) if result.front else None
    written = report.write(result.document(target), stem, table=result.to_csv, figure=figure)
    if not result.complete:
        count, curves = sum(len(c.points) for c in result.curves), len(result.curves)
        shared.say("interrupted", f"{count} settings of {curves} curve{'s' * (curves != 1)} were finished")
        shared.leave(shared.INTERRUPTED)
    if not result.front:
        shared.say("error", "no run has an error that is known; the reasons are in the notes")
    shared.leave(shared.DONE if written and result.front else shared.MISUSE)


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
    from mbkit.studies.stress.study import stress as study
    from mbkit.studies.study_runs import InterruptedSweepError

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
