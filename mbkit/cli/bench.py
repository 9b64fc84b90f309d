"""`mbkit bench`: which engine and method reaches which error in which time."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import click

from mbkit import _interrupt
from mbkit.cli._shared import (
    DONE,
    INTERRUPTED,
    MISUSE,
    check_engines,
    engines_option,
    json_option,
    leave,
    load_options,
    prepare,
    report_options,
    say,
    seed_option,
    show,
    split,
    stem_of,
)

_QUICK: Final[dict[str, Any]] = {"repeats": 3, "work": 24_000}
_USUAL: Final[dict[str, Any]] = {"repeats": 5, "work": None}


@click.command()
@click.argument("target")
@engines_option("pinocchio,lagrangian,mujoco")
@click.option("--methods", default="", callback=split, metavar="A,B,...", help="Integrators.  [default: all there are]")
@click.option("--duration", default=1.0, show_default=True, type=float, help="Horizon of the motion, s.")
@seed_option("Of the start.")
@click.option("--repeats", type=click.IntRange(min=1), help="Timings of each setting.  [default: 5; quick: 3]")
@click.option("--seconds", type=float, help="Of the processor, at the most, s.  [default: work is bounded, not time]")
@click.option("--jobs", type=click.IntRange(min=1), help="Measure in so many processes: sooner done, times less sure.")
@click.option("--quick", is_flag=True, help="Seven methods, fewer repetitions and shorter runs.")
@load_options
@json_option
@report_options
def bench(
    target: str,
    engines: tuple[str, ...],
    methods: tuple[str, ...],
    duration: float,
    seed: int,
    repeats: int | None,
    seconds: float | None,
    jobs: int | None,
    quick: bool,
    options: dict[str, Any],
    as_json: bool,
    out: Path,
    force: bool,
) -> None:
    """Measure error against run time on TARGET: every engine, every method.

    TARGET is what `mbkit check` takes. A page, its figure, JSON and CSV are written.
    Ctrl-C ends the study early, and what is finished is written.
    """
    from mbkit.methods.registry import METHODS, QUICK_METHODS, method_of
    from mbkit.report import work_precision_view
    from mbkit.report.output_folder import check_writable
    from mbkit.report.progress import Bar
    from mbkit.studies import work_precision
    from mbkit.studies._checkpoint import InterruptedSweepError
    from mbkit.studies._targets import model_of

    check_engines(engines, least=1)
    for name in methods:
        method_of(name)
    check_writable(out)
    model = model_of(target, options)
    stem = f"{stem_of(target, model.name)}-bench"
    prepare(out, stem, "json", "csv", "png", "html", force=force)
    if quick and not methods:
        # A method that none of the engines has would be refused.
        methods = tuple(m for m in QUICK_METHODS if not METHODS[m].engines or set(engines) & set(METHODS[m].engines))
    usual = _QUICK if quick else _USUAL
    try:
        with _interrupt.keeping, Bar(f"bench {model.name}") as bar, _workers(jobs) as executor:
            result = work_precision(
                model,
                engines,
                methods or None,
                duration=duration,
                seed=seed,
                repeats=repeats if repeats is not None else usual["repeats"],
                seconds=seconds,
                work=usual["work"],
                executor=executor,
                progress=bar,
            )
    except InterruptedSweepError as stopped:
        result = stopped.result
    written = show(
        result,
        lambda: work_precision_view.view(result, target),
        stem,
        out,
        as_json=as_json,
        force=force,
        table=result.to_csv,
        figure=(lambda: work_precision_view.picture(result)) if result.front else None,
    )
    if not result.complete:
        settings, curves = sum(len(c.points) for c in result.curves), len(result.curves)
        say("interrupted", f"{settings} settings of {curves} curve{'s' * (curves != 1)} were finished")
    elif not result.front:
        say("error", "no run has an error that is known; the reasons are in the notes")
    leave(INTERRUPTED if not result.complete else MISUSE if not written or not result.front else DONE)


@contextmanager
def _workers(jobs: int | None) -> Iterator[Executor | None]:
    from mbkit.studies.worker import WorkerPool

    if jobs is None:
        yield None
    else:
        with WorkerPool(jobs) as pool:
            yield pool
