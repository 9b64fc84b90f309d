"""`mbkit check`: do the engines agree on a model."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mbkit import _interrupt
from mbkit.cli._shared import (
    AGREE,
    DIFFER,
    INTERRUPTED,
    MISUSE,
    check_engines,
    engines_option,
    json_option,
    leave,
    load_options,
    prepare,
    report_options,
    samples_option,
    say,
    seed_option,
    show,
    stem_of,
)

if TYPE_CHECKING:
    from mbkit.model import Model


@click.command()
@click.argument("target", required=False)
@click.option("--all", "everything", is_flag=True, help="Check every robot of example-robot-data.")
@engines_option("pinocchio,lagrangian,mujoco")
@samples_option(64)
@seed_option()
@load_options
@click.option("--no-rollouts", is_flag=True, help="Terms only: no trajectories, run times or omissions.")
@click.option("--own-parsers", is_flag=True, help="Compare what each engine's own importer makes of the file.")
@click.option("--jobs", type=click.IntRange(min=1), help="With --all: processes.  [default: one per processor]")
@json_option
@report_options
def check(
    target: str | None,
    everything: bool,
    engines: tuple[str, ...],
    samples: int,
    seed: int,
    options: dict[str, Any],
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
    if own_parsers and (everything or target is None or no_rollouts or options.keys() - {"floating_base"}):
        raise click.UsageError(
            "--own-parsers takes one TARGET as it is written, and --floating-base, --seed, --json and --out"
        )
    if everything and (target is not None or "nonphysical" in options):
        raise click.UsageError("--all takes every robot as it is: without a TARGET and without --nonphysical")
    if not everything and jobs is not None:
        raise click.UsageError("--jobs goes with --all")
    from mbkit.report.output_folder import check_writable

    if not own_parsers:
        check_engines(engines, least=2)
    check_writable(out)
    write = partial(show, out=out, as_json=as_json, force=force)
    if everything:
        prepare(out, "all", "json", "html", force=force)
        _check_all(write, jobs, {"engines": engines, "samples": samples, "seed": seed, **options})
    elif target is None:
        raise click.UsageError("give a TARGET, such as panda, or --all; mbkit robots lists what there is")
    elif own_parsers:
        stem = f"{stem_of(target, Path(target).stem)}.importers"
        prepare(out, stem, "json", "html", force=force)
        _check_parsers(write, target, stem, seed, **options)
    else:
        from mbkit.studies._targets import model_of

        model = model_of(target, options)
        stem = stem_of(target, model.name)
        prepare(out, stem, "json", "html", force=force)
        _check_one(write, target, model, stem, engines, samples=samples, seed=seed, terms_only=no_rollouts)


def _check_one(
    write: Callable[..., bool], target: str, model: Model, stem: str, engines: tuple[str, ...], **settings: Any
) -> None:
    from mbkit.report import compare_view
    from mbkit.report.progress import Bar
    from mbkit.studies import compare

    with Bar(f"check {model.name}") as bar:
        result = compare(model, engines, **settings, progress=bar)
    written = write(result, lambda: compare_view.view(result, target), stem)
    if not result.rows:
        say("error", f"{result.verdict}; two engines that hold the model are needed")
    elif result.nothing:
        say("error", result.verdict)
    leave(MISUSE if not written or result.nothing else AGREE if result.passed else DIFFER)


def _check_parsers(
    write: Callable[..., bool], target: str, stem: str, seed: int, *, floating_base: bool = False
) -> None:
    from mbkit.report import explain_view
    from mbkit.studies.importers import compare_parsers

    result = compare_parsers(target, floating_base=floating_base, seed=seed)
    written = write(result, lambda: explain_view.importers_view(result), stem)
    read = any(not p.refused for p in result.importers)
    if not read:
        say("error", f"no importer reads {target}")
    leave(MISUSE if not written or not read else AGREE if result.agree else DIFFER)


def _check_all(write: Callable[..., bool], jobs: int | None, settings: dict[str, Any]) -> None:
    from mbkit.load import robots
    from mbkit.report import compare_view
    from mbkit.report.progress import Bar
    from mbkit.studies.compare.all_robots import RobotOutcome, Sweep, all_robots

    expected = len(robots())
    outcomes: list[RobotOutcome] = []
    begun = time.perf_counter()
    interrupted = False
    try:
        with _interrupt.keeping, Bar("check --all") as bar:
            for outcome in all_robots(**settings, jobs=jobs):
                outcomes.append(outcome)
                bar(len(outcomes) / expected, f"{len(outcomes)}/{expected} {outcome.robot}: {outcome.status}")
    except KeyboardInterrupt:
        interrupted = True
    result = Sweep(
        outcomes=tuple(sorted(outcomes, key=lambda o: o.robot)),
        expected=expected,
        engines=settings["engines"],
        samples=settings["samples"],
        seed=settings["seed"],
        seconds=time.perf_counter() - begun,
    )
    written = write(result, lambda: compare_view.robots_view(result), "all")
    if interrupted:
        say("interrupted", f"{len(outcomes)} of {expected} robots were finished")
    leave(INTERRUPTED if interrupted else MISUSE if not written else AGREE if result.passed else DIFFER)
