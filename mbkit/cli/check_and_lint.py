"""`mbkit check`: do the engines agree on a model; `mbkit lint`: is the file itself plausible."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from mbkit import _process as _interrupt
from mbkit.cli import _shared as shared
from mbkit.cli._shared import AGREE, DIFFER, INTERRUPTED, MISUSE, Report
from mbkit.errors import MbkitError

if TYPE_CHECKING:
    from mbkit.model import Model
    from mbkit.studies import Comparison, Finding


@shared.command(
    "mbkit check panda",
    "mbkit check arm.urdf --floating-base --engines pinocchio,mujoco",
    "mbkit check panda --own-parsers",
    "mbkit check panda --own-parsers --engines mujoco,newton",
    "mbkit check --all --no-rollouts",
)
@click.argument("target", required=False)
@click.option("--all", "everything", is_flag=True, help="Check every robot of example-robot-data.")
@shared.engines_option("pinocchio,lagrangian,mujoco")
@shared.states_options(64)
@shared.load_options
@click.option("--no-rollouts", is_flag=True, help="Terms only: no trajectories, run times or omissions.")
@click.option("--full", is_flag=True, help="Print all tables, not only the verdict and the worst rows.")
@click.option("--own-parsers", is_flag=True, help="Compare what each engine's own importer makes of the file.")
@click.option("--jobs", type=click.IntRange(min=1), help="With --all: processes.  [default: one per processor]")
@shared.report_options
def check(
    target: str | None,
    everything: bool,
    options: dict[str, Any],
    no_rollouts: bool,
    full: bool,
    own_parsers: bool,
    jobs: int | None,
    report: Report,
    **settings: Any,
) -> None:
    """Compare engines on TARGET, and write a page and JSON.

    TARGET is a robot (mbkit robots lists them), a catalog system, a path to a URDF or
    MJCF file, or package.module:function for a function that returns a Model. Printed are the verdict, what the
    file has that bears on runs, faults, and each engine's worst row; --full and the page have the rest. With
    --own-parsers it is a robot or a file, which Pinocchio, MuJoCo and Drake read by themselves, or those of --engines:
    newton, mujoco-warp and mjx too, in environments of their own; with --floating-base its base moves freely in all of
    them.
    """
    others = {"--all": everything, "--no-rollouts": no_rollouts} | dict.fromkeys(
        options.keys() - {"floating_base"}, True
    )
    if own_parsers and (target is None or any(others.values())):
        flags = [f"--{name.strip('-').replace('_', '-')}" for name, on in others.items() if on]
        raise click.UsageError(
            "--own-parsers takes one TARGET as it is written, and --engines, --floating-base, --seed, --json and --out"
            + (f"; not {', '.join(flags)}" if flags else "")
        )
    if everything and (target is not None or "nonphysical" in options):
        raise click.UsageError("--all takes every robot as it is: without a TARGET and without --nonphysical")
    if full and (everything or own_parsers):
        raise click.UsageError("--full goes with one TARGET; --all and --own-parsers print everything")
    if not everything and jobs is not None:
        raise click.UsageError("--jobs goes with --all")
    if own_parsers:
        # Not those that the comparison of terms takes by default.
        named = click.get_current_context().get_parameter_source("engines") is not ParameterSource.DEFAULT
        options |= {"importers": settings["engines"]} if named else {}
    else:
        shared.check_engines(settings["engines"], least=2)
    report.prepare()
    if everything:
        _check_all(report, jobs, {**settings, **options})
    elif target is None:
        raise click.UsageError("give a TARGET, such as panda, or --all; mbkit robots lists what there is")
    elif own_parsers:
        _check_parsers(report, target, seed=settings["seed"], **options)
    else:
        _check_one(report, target, options, full=full, terms_only=no_rollouts, **settings)


def _check_one(report: Report, target: str, options: dict[str, Any], *, full: bool, **settings: Any) -> None:
    from mbkit.simulate.progress import Bar
    from mbkit.studies import compare
    from mbkit.studies._targets import model_of

    model = model_of(target, options)
    stem = shared.stem_of(target, model.name)
    report.prepare(stem, "json", "html")
    with Bar(f"check {model.name}") as bar:
        result = compare(model, **settings, progress=bar, checkpoint=_tell_terms)
    result = replace(result, findings=(*result.findings, *_of_file(model, target)))
    written = report.write(result.document(target, full=full), stem)
    if result.nothing:
        needed = "" if result.rows else "; two engines that hold the model are needed"
        shared.say("error", f"{result.verdict}{needed}")
    shared.leave(MISUSE if not written or result.nothing else AGREE if result.passed else DIFFER)


def _tell_terms(result: Comparison) -> None:
    """Print the verdict on terms at once; what follows takes longer."""
    shared.say("terms", f"{'✓' if result.passed else '✗'} {result.headline}; rollouts and run times follow")


def _of_file(model: Model, target: str) -> Iterator[Finding]:
    """Yield what `lint` says of a model with a file, which engines do not judge."""
    from mbkit.studies import Finding
    from mbkit.studies.lint import lint

    if not model.sources:
        return
    try:
        findings = lint(model)
    except MbkitError as error:
        yield Finding("the file itself", f"not judged: {error}", (), 0)
        return
    parts = tuple(dict.fromkeys(row.part for row in findings.rows))
    says = f"no engine judges it: {findings.verdict}" + (f"; mbkit lint {target}" if parts else "")
    yield Finding("the file itself", says, parts, len(findings.rows))


def _check_parsers(report: Report, target: str, **settings: Any) -> None:
    from mbkit.studies.importers import compare_parsers

    stem = f"{shared.stem_of(target, Path(target).stem)}.importers"
    report.prepare(stem, "json", "html")
    result = compare_parsers(target, **settings)
    written = report.write(result.document(), stem)
    read = any(not p.refused for p in result.importers)
    if not read:
        shared.say("error", f"no importer reads {target}")
    shared.leave(MISUSE if not written or not read else AGREE if result.agree else DIFFER)


def _check_all(report: Report, jobs: int | None, settings: dict[str, Any]) -> None:
    from mbkit.load import robots
    from mbkit.simulate.progress import Bar
    from mbkit.studies.compare.all_robots import RobotOutcome, Sweep, all_robots

    report.prepare("all", "json", "html")
    expected = len(robots())
    outcomes: list[RobotOutcome] = []
    start = time.perf_counter()
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
        **{name: settings[name] for name in ("engines", "samples", "seed")},
        seconds=time.perf_counter() - start,
    )
    written = report.write(result.document(), "all")
    if interrupted:
        shared.say("interrupted", f"{len(outcomes)} of {expected} robots were finished")
    shared.leave(INTERRUPTED if interrupted else MISUSE if not written else AGREE if result.passed else DIFFER)


@shared.command("mbkit lint arm.urdf", "mbkit lint panda --control-period 0.004")
@click.argument("target")
@click.option(
    "--control-period",
    default=1e-3,
    show_default=True,
    type=click.FloatRange(min=0, min_open=True),
    help="Period of the controller or step, s.",
)
@click.option("--no-shapes", is_flag=True, help="Leave the shapes and meshes of the file unread.")
@shared.load_options
@shared.json_option
def lint(target: str, control_period: float, no_shapes: bool, options: dict[str, Any], as_json: bool) -> None:
    """Say what is not plausible in TARGET, by what it knows of itself: units, frames, signs, placeholders, limits.

    TARGET is what `mbkit check` takes. Links that no matter has are judged, not refused. Status 1 says that something
    is wrong for sure or likely; what to look at leaves it 0.
    """
    from mbkit.studies.lint import lint as study

    result = study(target, control_period=control_period, shapes=not no_shapes, **options)
    shared.show(result.document(full=False), as_json=as_json)
    shared.leave(shared.AGREE if result.passed else shared.DIFFER)
