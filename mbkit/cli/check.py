"""`mbkit check`: do the engines agree on a model."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from mbkit import _interrupt
from mbkit.cli._shared import (
    AGREE,
    DIFFER,
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

__all__ = ["check"]


@click.command()
@click.argument("target", required=False)
@click.option("--all", "everything", is_flag=True, help="Check every robot of example-robot-data.")
@click.option("--engines", default="pinocchio,lagrangian,mujoco", show_default=True, callback=split, metavar="A,B,...")
@click.option("--samples", default=64, show_default=True, type=click.IntRange(min=1), help="Random states.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@model_options
@click.option("--no-rollouts", is_flag=True, help="Terms only: no trajectories, run times or omissions.")
@click.option("--own-parsers", is_flag=True, help="Compare what each engine's own importer makes of the file.")
@click.option("--jobs", type=click.IntRange(min=1), help="With --all: processes.  [default: one per processor]")
@click.option("--json", "as_json", is_flag=True, help="Print JSON, and nothing else, on stdout.")
@click.option(
    "--out", default="mbkit-report", show_default=True, type=click.Path(path_type=Path), help="Folder to fill."
)
@force_option
def check(
    target: str | None,
    everything: bool,
    engines: tuple[str, ...],
    samples: int,
    seed: int,
    floating_base: bool,
    mimic: Literal["reduce", "free"] | None,
    nonphysical: Literal["error", "warn"] | None,
    no_rollouts: bool,
    own_parsers: bool,
    jobs: int | None,
    as_json: bool,
    out: Path,
    force: bool,
) -> None:
    """Compare engines on TARGET, and write a page and JSON.

    TARGET is a robot (mbkit robots lists them), a catalog system, a path to a URDF or
    MJCF file, or package.module:function for a function that returns a Model. With --own-parsers
    it is a robot or a file, which Pinocchio, MuJoCo and Drake read by themselves; --floating-base then lets
    its base go in all of them.
    """
    if own_parsers and (everything or target is None or mimic or nonphysical or no_rollouts):
        raise click.UsageError(
            "--own-parsers takes one TARGET as it is written, and --floating-base, --seed, --json and --out"
        )
    if everything and (target is not None or nonphysical is not None):
        raise click.UsageError("--all takes every robot as it is: without a TARGET and without --nonphysical")
    if not everything and jobs is not None:
        raise click.UsageError("--jobs goes with --all")
    from mbkit.report.output_folder import check_writable

    if own_parsers:
        check_writable(out)
        _check_parsers(str(target), floating_base, seed, as_json, out, force)
        return
    check_engines(engines, least=2)
    check_writable(out)
    if everything:
        _check_all(engines, samples, seed, floating_base, mimic or "reduce", jobs, as_json, out, force)
    elif target is not None:
        options = load_options(floating_base, mimic, nonphysical)
        _check_one(target, options, engines, samples, seed, no_rollouts, as_json, out, force)
    else:
        raise click.UsageError("give a TARGET, such as panda, or --all; mbkit robots lists what there is")


def _check_one(
    target: str,
    options: Mapping[str, Any],
    engines: tuple[str, ...],
    samples: int,
    seed: int,
    no_rollouts: bool,
    as_json: bool,
    out: Path,
    force: bool,
) -> None:
    from mbkit.load.robot_data import canonical
    from mbkit.report.output_folder import check_replaceable, file_stem
    from mbkit.report.progress import Bar
    from mbkit.studies import compare
    from mbkit.studies._targets import model_of

    model = model_of(target, options)
    # Several robots' files hold the same name.
    stem = file_stem(canonical(target) or model.name)
    check_replaceable(out, f"{stem}.json", f"{stem}.html", force=force)
    with Bar(f"check {model.name}") as bar:
        result = compare(model, engines, samples, seed, terms_only=no_rollouts, progress=bar)

    def table() -> RenderableType:
        from mbkit.report import compare_view, terminal

        return terminal.render(compare_view.view(result, target))

    def page() -> str:
        from mbkit.report import compare_view
        from mbkit.report.page import render

        return render(compare_view.view(result, target), data=f"{stem}.json")

    data = result.to_json()
    files = (File("data", f"{stem}.json", lambda: data + "\n"), File("page", f"{stem}.html", page))
    written = show(data, table, files, out, as_json=as_json, force=force)
    if not result.rows:
        say("error", f"{result.verdict}; two engines that hold the model are needed")
    elif result.nothing:
        say("error", result.verdict)
    leave(MISUSE if not written or result.nothing else AGREE if result.passed else DIFFER)


def _check_parsers(target: str, floating_base: bool, seed: int, as_json: bool, out: Path, force: bool) -> None:
    from mbkit.load.robot_data import canonical
    from mbkit.report.output_folder import check_replaceable, file_stem
    from mbkit.studies.importers import compare_parsers

    stem = f"{file_stem(canonical(target) or Path(target).stem)}.importers"
    check_replaceable(out, f"{stem}.json", f"{stem}.html", force=force)
    result = compare_parsers(target, floating_base=floating_base, seed=seed)

    def table() -> RenderableType:
        from mbkit.report import explain_view, terminal

        return terminal.render(explain_view.importers_view(result))

    def page() -> str:
        from mbkit.report import explain_view
        from mbkit.report.page import render

        return render(explain_view.importers_view(result), data=f"{stem}.json")

    data = result.to_json()
    files = (File("data", f"{stem}.json", lambda: data + "\n"), File("page", f"{stem}.html", page))
    written = show(data, table, files, out, as_json=as_json, force=force)
    read = any(not p.refused for p in result.importers)
    if not read:
        say("error", f"no importer reads {target}")
    leave(MISUSE if not written or not read else AGREE if result.agree else DIFFER)


def _check_all(
    engines: tuple[str, ...],
    samples: int,
    seed: int,
    floating_base: bool,
    mimic: Literal["reduce", "free"],
    jobs: int | None,
    as_json: bool,
    out: Path,
    force: bool,
) -> None:
    from mbkit.load import robots
    from mbkit.report.output_folder import check_replaceable
    from mbkit.report.progress import Bar
    from mbkit.studies.compare.all_robots import RobotOutcome, Sweep, all_robots

    check_replaceable(out, "all.json", "all.html", force=force)
    expected = len(robots())
    outcomes: list[RobotOutcome] = []
    begun = time.perf_counter()
    interrupted = False
    try:
        with _interrupt.keeping, Bar("check --all") as bar:
            for outcome in all_robots(
                engines=engines, samples=samples, seed=seed, floating_base=floating_base, mimic=mimic, jobs=jobs
            ):
                outcomes.append(outcome)
                bar(len(outcomes) / expected, f"{len(outcomes)}/{expected} {outcome.robot}: {outcome.status}")
    except KeyboardInterrupt:
        interrupted = True
    result = Sweep(
        outcomes=tuple(sorted(outcomes, key=lambda o: o.robot)),
        expected=expected,
        engines=engines,
        samples=samples,
        seed=seed,
        seconds=time.perf_counter() - begun,
    )

    def table() -> RenderableType:
        from mbkit.report import compare_view, terminal

        return terminal.render(compare_view.robots_view(result))

    def page() -> str:
        from mbkit.report import compare_view
        from mbkit.report.page import render

        return render(compare_view.robots_view(result), data="all.json")

    data = result.to_json()
    files = (File("data", "all.json", lambda: data + "\n"), File("page", "all.html", page))
    written = show(data, table, files, out, as_json=as_json, force=force)
    if interrupted:
        say("interrupted", f"{len(outcomes)} of {expected} robots were finished")
    leave(INTERRUPTED if interrupted else MISUSE if not written else AGREE if result.passed else DIFFER)
