"""`mbkit bench`: which engine and method reaches which error in which time."""

from __future__ import annotations

from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import click

from mbkit import _interrupt
from mbkit.cli import _shared as shared
from mbkit.cli._shared import Report

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
    from mbkit.studies._checkpoint import InterruptedSweepError
    from mbkit.studies._targets import model_of
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
