"""`mbkit versions`: which version of an engine changed which number."""

from __future__ import annotations

from typing import Any

import click

from mbkit.cli import _shared as shared
from mbkit.cli._shared import Report


@shared.command(
    "mbkit versions panda ur5 --engine mujoco --from 3.3",
    "mbkit versions arm.urdf --engine pinocchio --versions 2.7.0,4.1.0",
)
@click.argument("targets", nargs=-1, required=True)
@click.option("--engine", default="", metavar="ENGINE", help="Whose versions.  [default: mujoco]")
@click.option("--from", "first", default="", metavar="VERSION", help="Oldest version.  [default: the first there is]")
@click.option("--to", "last", default="latest", show_default=True, metavar="VERSION", help="Newest version.")
@click.option("--versions", "named", default="", callback=shared.split, metavar="A,B,...", help="These versions alone.")
@click.option(
    "--most",
    default=12,
    show_default=True,
    type=click.IntRange(min=2),
    help="Versions measured at first; what lies between is bisected.",
)
@click.option("--keep", type=click.IntRange(min=0), help="New environments that stay on the disk.  [default: all]")
@click.option("--jobs", type=click.IntRange(min=1), help="Measure so many versions at once; times are less sure then.")
@click.option(
    "--tolerance", default=1e-9, show_default=True, type=click.FloatRange(min=0, min_open=True), help="What counts."
)
@shared.states_options(4)
@shared.report_options
def versions(
    targets: tuple[str, ...], engine: str, named: tuple[str, ...], jobs: int | None, report: Report, **settings: Any
) -> None:
    """Say which version of an engine changed which number of TARGETS.

    TARGETS are what `mbkit check` takes. Each version runs in an environment of its own, which is made with uv or pip
    and kept in the user's cache folder, or in MBKIT_ENVIRONMENTS. A page, JSON and CSV are written. Status 1 says that
    a number moved, or that a version could not be measured.
    """
    from contextlib import nullcontext

    from mbkit.engines.registry import MUJOCO
    from mbkit.report.versions_view import versions_view
    from mbkit.simulate.progress import Bar
    from mbkit.studies.versions import versions as study
    from mbkit.studies.worker import WorkerPool

    report.prepare()
    engine = engine or MUJOCO
    stem = f"{shared.stem_of(targets[0], targets[0])}-{shared.stem_of(engine, engine)}-versions"
    report.prepare(stem, "json", "csv", "html")
    with Bar(f"versions of {engine}") as bar, nullcontext() if jobs is None else WorkerPool(jobs) as executor:
        result = study(targets, engine, named or None, executor=executor, progress=bar, **settings)
    written = report.write(versions_view(result), stem, table=result.to_csv)
    shared.leave(shared.MISUSE if not written else shared.AGREE if result.same else shared.DIFFER)
