"""`mbkit bench`: which engine and method reaches which error in which time."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from mbkit import _interrupt
from mbkit.cli._shared import (
    DONE,
    INTERRUPTED,
    MISUSE,
    File,
    check_engines,
    force_option,
    leave,
    load_options,
    model_options,
    say,
    show,
    split,
)

if TYPE_CHECKING:
    from rich.console import RenderableType

    from mbkit.studies.work_precision.result import WorkPrecision

__all__ = ["bench"]

#: One of each kind, and MuJoCo's own beside the same formulas.
_QUICK_METHODS: Final = (
    "rk4",
    "semi_implicit_euler",
    "rk853",
    "dop853",
    "mujoco_rk4",
    "mujoco_euler",
    "mujoco_implicitfast",
)
_QUICK: Final[dict[str, Any]] = {"repeats": 3, "work": 24_000}
_USUAL: Final[dict[str, Any]] = {"repeats": 5, "work": None}


@click.command()
@click.argument("target")
@click.option("--engines", default="pinocchio,lagrangian,mujoco", show_default=True, callback=split, metavar="A,B,...")
@click.option("--methods", default="", callback=split, metavar="A,B,...", help="Integrators.  [default: all there are]")
@click.option("--duration", default=1.0, show_default=True, type=float, help="Horizon of the motion, s.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Of the start.")
@click.option("--repeats", type=click.IntRange(min=1), help="Timings of each setting.  [default: 5; quick: 3]")
@click.option("--seconds", type=float, help="Of the processor, at the most, s.  [default: work is bounded, not time]")
@click.option("--jobs", type=click.IntRange(min=1), help="Measure in so many processes: sooner done, times less sure.")
@click.option("--quick", is_flag=True, help="Seven methods, fewer repetitions and shorter runs.")
@model_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON, and nothing else, on stdout.")
@click.option(
    "--out", default="mbkit-report", show_default=True, type=click.Path(path_type=Path), help="Folder to fill."
)
@force_option
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
    floating_base: bool,
    mimic: str | None,
    nonphysical: str | None,
    as_json: bool,
    out: Path,
    force: bool,
) -> None:
    """Measure error against run time on TARGET: every engine, every method.

    TARGET is what `mbkit check` takes. A page, its figure, JSON and CSV are written.
    Ctrl-C ends the study early, and what is finished is written.
    """
    from mbkit.load.robot_data import canonical
    from mbkit.methods.registry import METHODS, method_of
    from mbkit.report.output_folder import check_replaceable, check_writable, file_stem
    from mbkit.report.progress import Bar
    from mbkit.studies import work_precision
    from mbkit.studies._targets import model_of
    from mbkit.studies.work_precision.result import InterruptedSweepError

    check_engines(engines, least=1)
    for name in methods:
        method_of(name)
    check_writable(out)
    model = model_of(target, load_options(floating_base, mimic, nonphysical))
    # Several robots' files hold the same name.
    stem = f"{file_stem(canonical(target) or model.name)}-bench"
    check_replaceable(out, *(f"{stem}.{ending}" for ending in ("json", "csv", "png", "html")), force=force)
    if quick and not methods:
        # Those that none of the engines has would be refused as asked for in error.
        methods = tuple(m for m in _QUICK_METHODS if not METHODS[m].engines or set(engines) & set(METHODS[m].engines))
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
    written = _show(result, target, stem, out, as_json, force)
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


def _show(result: WorkPrecision, target: str, stem: str, out: Path, as_json: bool, force: bool) -> bool:
    def table() -> RenderableType:
        from mbkit.report import terminal, work_precision_view

        return terminal.render(work_precision_view.view(result, target))

    def page() -> str:
        from mbkit.report import work_precision_view
        from mbkit.report.page import render

        return render(work_precision_view.view(result, target), data=f"{stem}.json", table=f"{stem}.csv")

    def picture() -> bytes:
        from mbkit.report import work_precision_view

        return work_precision_view.picture(result)

    data = result.to_json()
    files = [File("data", f"{stem}.json", lambda: data + "\n"), File("table", f"{stem}.csv", result.to_csv)]
    if result.front:
        files.append(File("figure", f"{stem}.png", picture))
    files.append(File("page", f"{stem}.html", page))
    return show(data, table, files, out, as_json=as_json, force=force)
