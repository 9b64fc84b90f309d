"""`mbkit baseline`: record what engines say of a robot, and hold them against it later."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mbkit._escape import one_line
from mbkit.cli._shared import (
    AGREE,
    DIFFER,
    DONE,
    MISUSE,
    check_engines,
    console,
    in_options,
    json_option,
    leave,
    load_options,
    samples_option,
    say,
    seed_option,
    split,
    tell,
)
from mbkit.errors import BaselineError, InputError, MbkitError

if TYPE_CHECKING:
    from mbkit.model import Model
    from mbkit.studies.baseline import Baseline, BaselineResult


@click.group()
def baseline() -> None:
    """Record what engines say of a robot, and check later whether they still do.

    A baseline is a text file to keep beside the robot's description, in version control.
    """


@baseline.command()
@click.argument("targets", metavar="TARGET...", nargs=-1, required=True)
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--engines", callback=split, default="", metavar="A,B,...", help="[default: all that are installed]")
@samples_option(2)
@seed_option()
@load_options
@click.option("--force", is_flag=True, help="Replace a file that is another robot's baseline, or none.")
def record(
    targets: tuple[str, ...],
    path: Path,
    engines: tuple[str, ...],
    samples: int,
    seed: int,
    options: dict[str, Any],
    force: bool,
) -> None:
    """Record each TARGET in PATH: a .toml file, or a folder that gets a file for each.

    TARGET is what `mbkit check` takes; `mbkit baseline check` loads a robot, a catalog system or a file again,
    the file by its place beside PATH, and runs a function only where --target names it. The baseline of the same
    robot is replaced. Exit status: 0 done, 2 misuse or bad input.
    """
    if path.suffix == ".toml" and len(targets) > 1:
        raise click.UsageError(f"{len(targets)} targets want a folder, and {path} is a file's name")
    if engines:
        check_engines(engines, least=1)
    files = {target: path if path.suffix == ".toml" else path / _name(target) for target in targets}
    for file in files.values():
        alike = [t for t, other in files.items() if other == file]
        if len(alike) > 1:
            raise click.UsageError(f"{' and '.join(alike)} would both be {file}; record them one by one")
    for target, file in files.items():
        _record_one(target, options, file, engines, samples, seed, force)


def _record_one(
    target: str, options: dict[str, Any], file: Path, engines: tuple[str, ...], samples: int, seed: int, force: bool
) -> None:
    from mbkit.report.progress import Bar
    from mbkit.studies import baseline as baselines
    from mbkit.studies._targets import kept, model_of

    model = model_of(target, options)
    with Bar(f"record {model.name}") as bar:
        recorded = baselines.record(
            model,
            file,
            engines or None,
            samples=samples,
            seed=seed,
            target=kept(target, file),
            options=options,
            force=force,
            progress=bar,
        )
    tell(f"{file}: {one_line(model.name)}, {', '.join(recorded.engines)}, {file.stat().st_size / 1000:.0f} kB")
    for refusal in recorded.left_out:
        say("note", f"{refusal.engine}{' ' * bool(refusal.term)}{refusal.term}: {refusal.reason}")
    for disagreement in recorded.disagreements:
        say("warning", disagreement)


@baseline.command()
@click.argument("paths", metavar="PATH...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--target", help="Check this instead of what was recorded, or the function that was recorded; with one file."
)
@click.option("--strict", is_flag=True, help="Fail where an engine that was recorded is not installed.")
@click.option("--rebaseline", is_flag=True, help="Show what differs, and record it again.")
@load_options
@json_option
def check(
    paths: tuple[Path, ...],
    target: str | None,
    strict: bool,
    rebaseline: bool,
    options: dict[str, Any],
    as_json: bool,
) -> None:
    """Hold robots and engines against what was recorded in each PATH, a file or a folder of them.

    A changed parameter of the description is named first; then a number that moved, with its
    term, joint and engine, and the version that did. New versions alone ask, on a terminal, whether to
    record anew. Exit status: 0 as recorded, 1 something differs (or with --strict an engine is
    missing), 2 misuse, a file that cannot be read, or nothing that could be checked; 0 too for
    what --rebaseline recorded.
    """
    files = _files(paths)
    if target is not None and len(files) != 1:
        raise click.UsageError(f"--target goes with one file, and there are {len(files)}")
    if options and target is None:
        raise click.UsageError("options of loading go with --target; what was recorded is loaded as it was then")
    statuses = []
    results: list[BaselineResult] = []
    for file in files:
        try:
            result, recorded = _check_one(file, target, options, strict, rebaseline, table=not as_json)
        except MbkitError as error:
            # One file's fault must not hide what the others say.
            say("error", in_options(str(error)))
            statuses.append(MISUSE)
            continue
        results.append(result)
        nothing = result.status == "skipped" and not strict
        statuses.append(MISUSE if nothing else AGREE if result.passed or recorded else DIFFER)
    if as_json:
        tell("[" + ",\n".join(r.to_json() for r in results) + "]")
    leave(max(statuses))


def _check_one(
    file: Path, target: str | None, options: dict[str, Any], strict: bool, rebaseline: bool, *, table: bool
) -> tuple[BaselineResult, bool]:
    """Return the result, and whether it was recorded again."""
    from mbkit.report.explain_view import baseline_view
    from mbkit.report.progress import Bar
    from mbkit.report.terminal import render
    from mbkit.studies import baseline as baselines
    from mbkit.studies._targets import kept, model_of

    recorded = baselines.read(file)
    # A target of other options is recorded with them.
    options = {**recorded.options, **options}
    model = _model(recorded, file) if target is None else model_of(target, options)
    new_target = None if target is None else kept(target, file)
    with Bar(f"check {file.name}") as bar:
        result = baselines.check(model, file, strict=strict, target=new_target, progress=bar)
    if table:
        console().print(render(baseline_view(result, _again(file, target))))
    differs = result.status not in ("same", "skipped")
    if not differs or not (rebaseline or (table and result.status == "versions" and _confirmed(file))):
        return result, False
    if result.skipped:
        names = ", ".join(r.engine for r in result.skipped)
        say("error", f"{file}: not recorded anew, because what it has of {names} would be lost; install that first")
        return result, False
    baselines.record(
        model,
        file,
        recorded.engines,
        samples=recorded.states.kinds.count("random"),
        seed=recorded.seed,
        target=recorded.target if new_target is None else new_target,
        options=options,
        # It was read above, so it is this robot's.
        force=True,
    )
    say("recorded", str(file))
    return result, True


def _confirmed(file: Path) -> bool:
    """Return whether a person at a terminal wants a baseline recorded again."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return False
    return click.confirm(f"Record {file} anew with these versions?", default=False)


@baseline.command()
@click.argument("path_a", type=click.Path(path_type=Path))
@click.argument("path_b", type=click.Path(path_type=Path))
@json_option
def diff(path_a: Path, path_b: Path, as_json: bool) -> None:
    """Say what PATH_B has that PATH_A has not: parameters, numbers, versions. Nothing is computed.

    Exit status: 0 the same robot with the same numbers, 1 something differs, 2 misuse or a file
    that cannot be read.
    """
    from mbkit.report.explain_view import baseline_view
    from mbkit.report.terminal import render
    from mbkit.studies import baseline as baselines

    result = baselines.diff(path_a, path_b)
    if as_json:
        tell(result.to_json())
    else:
        console().print(render(baseline_view(result)))
    leave(DONE if result.passed else DIFFER)


# Targets and files.


def _name(target: str) -> str:
    """Return what a target's file is called in a folder: as the robot, the file or the function."""
    from mbkit.load.loader import canonical
    from mbkit.report.output_folder import file_stem

    robot = canonical(target)
    path = robot is None and (Path(target).is_file() or "/" in target)
    return f"{file_stem(Path(target).stem if path else robot or target.rpartition(':')[2])}.toml"


def _again(file: Path, target: str | None) -> str:
    """Return the command that records again."""
    return f"mbkit baseline check {file}{f' --target {target}' if target else ''} --rebaseline"


def _model(recorded: Baseline, file: Path) -> Model:
    from mbkit.studies._targets import is_code, model_of, resolved

    if not recorded.target:
        raise BaselineError(f"{file}: it was recorded of a model in Python, so there is nothing to load; give --target")
    if is_code(recorded.target):
        # A baseline is data, perhaps of somebody else: no word in it decides what code is run.
        raise BaselineError(
            f"{file}: it was recorded of the function {recorded.target}, which is not run because a file names it; "
            f"to run it: mbkit baseline check {file} --target {recorded.target}"
        )
    return model_of(resolved(recorded.target, file), recorded.options)


def _files(paths: tuple[Path, ...]) -> list[Path]:
    """Return the files, and of a folder every baseline in it."""
    from mbkit.studies.baseline.file import is_baseline

    out: list[Path] = []
    for path in paths:
        if not path.is_dir():
            out.append(path)
            continue
        baselines = sorted(p for p in path.glob("*.toml") if is_baseline(p))
        if not baselines:
            raise InputError(f"{path}: no baseline in this folder; mbkit baseline record TARGET {path} makes one")
        out += baselines
    return out
