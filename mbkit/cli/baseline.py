"""`mbkit baseline`: record what engines say of a robot, and hold them against it later."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mbkit._escape import one_line
from mbkit.cli import _shared as shared
from mbkit.cli._shared import AGREE, DIFFER, MISUSE
from mbkit.errors import BaselineError, InputError, MbkitError

if TYPE_CHECKING:
    from mbkit.model import Model
    from mbkit.studies.baseline import Baseline, BaselineResult

_FILE = click.Path(path_type=Path)


@click.group(cls=shared.Group, examples=("mbkit baseline record panda panda.toml", "mbkit baseline check panda.toml"))
def baseline() -> None:
    """Record what engines say of a robot, and check later whether they still do.

    A baseline is a text file to keep beside the robot's description, in version control.
    """


@shared.command("mbkit baseline record panda panda.toml", "mbkit baseline record ur5 arm.urdf baselines")
@click.argument("targets", metavar="TARGET...", nargs=-1, required=True)
@click.argument("path", type=_FILE)
@click.option(
    "--engines", callback=shared.split, default="", metavar="A,B,...", help="[default: all that are installed]"
)
@shared.states_options(2)
@shared.load_options
@click.option("--force", is_flag=True, help="Replace a file that is another robot's baseline, or none.")
def record(targets: tuple[str, ...], path: Path, engines: tuple[str, ...], **settings: Any) -> None:
    """Record each TARGET in PATH: a .toml file, or a folder that gets a file for each.

    TARGET is what `mbkit check` takes; `mbkit baseline check` loads a robot, a catalog system or a file again,
    the file by its place beside PATH, and runs a function only where --target names it. The baseline of the same
    robot is replaced. Exit status: 0 done, 2 misuse or bad input.
    """
    if path.suffix == ".toml" and len(targets) > 1:
        raise click.UsageError(f"{len(targets)} targets want a folder, and {path} is a file's name")
    if engines:
        shared.check_engines(engines, least=1)
    files = {target: path if path.suffix == ".toml" else path / _name(target) for target in targets}
    for file in files.values():
        alike = [t for t, other in files.items() if other == file]
        if len(alike) > 1:
            raise click.UsageError(f"{' and '.join(alike)} would both be {file}; record them one by one")
    for target, file in files.items():
        _record_one(target, file, engines, **settings)


def _record_one(target: str, file: Path, engines: tuple[str, ...], options: dict[str, Any], **settings: Any) -> None:
    from mbkit.simulate.progress import Bar
    from mbkit.studies import baseline as baselines
    from mbkit.studies._targets import kept, kept_options, model_of

    model = model_of(target, options)
    place, options = kept(target, file), kept_options(options, file)
    with Bar(f"record {model.name}") as bar:
        result = baselines.record(model, file, engines or None, target=place, options=options, progress=bar, **settings)
    size = file.stat().st_size / 1000
    shared.tell(f"{file}: {one_line(model.name)}, {', '.join(result.engines)}, {size:.0f} kB")
    for refusal in result.left_out:
        shared.say("note", f"{f'{refusal.engine} {refusal.term}'.rstrip()}: {refusal.reason}")
    for disagreement in result.disagreements:
        shared.say("warning", disagreement)


@shared.command(
    "mbkit baseline check panda.toml",
    "mbkit baseline check baselines --strict",
    "mbkit baseline check panda.toml --rebaseline",
)
@click.argument("paths", metavar="PATH...", nargs=-1, required=True, type=_FILE)
@click.option(
    "--target", help="Check this instead of what was recorded, or the function that was recorded; with one file."
)
@click.option("--strict", is_flag=True, help="Fail where an engine that was recorded is not installed.")
@click.option("--rebaseline", is_flag=True, help="Show what differs, and record it again.")
@shared.load_options
@shared.json_option
def check(
    paths: tuple[Path, ...], target: str | None, strict: bool, rebaseline: bool, options: dict[str, Any], as_json: bool
) -> None:
    """Hold robots and engines against what was recorded in each PATH, a file or a folder of them.

    A changed parameter of the description is named first; then a number that moved, with its term, joint and engine,
    and the version that did. New versions alone ask, on a terminal, whether to record again. Exit status: 0 as
    recorded, 1 something differs (or with --strict an engine is missing), 2 misuse, a file that cannot be read, or
    nothing that could be checked; 0 too for what --rebaseline recorded.
    """
    files = _files(paths)
    _check_target(files, target, options)
    statuses = []
    results: list[BaselineResult] = []
    for file in files:
        try:
            result, again = _check_one(file, target, options, strict, rebaseline, table=not as_json)
        except MbkitError as error:
            # One file's fault must not hide what the others say.
            shared.say("error", shared.in_options(str(error)))
            statuses.append(MISUSE)
            continue
        results.append(result)
        nothing = result.status == "skipped" and not strict
        statuses.append(MISUSE if nothing else AGREE if result.passed or again else DIFFER)
    if as_json:
        shared.tell("[" + ",\n".join(r.to_json() for r in results) + "]")
    shared.leave(max(statuses))


def _check_one(
    file: Path, target: str | None, options: dict[str, Any], strict: bool, rebaseline: bool, *, table: bool
) -> tuple[BaselineResult, bool]:
    """Return the result, and whether it was recorded again."""
    from mbkit.simulate.progress import Bar
    from mbkit.studies import baseline as baselines
    from mbkit.studies._targets import kept_options

    recorded = baselines.read(file)
    model, new_target, options = _loaded(recorded, file, target, options)
    with Bar(f"check {file.name}") as bar:
        result = baselines.check(model, file, strict=strict, target=new_target, progress=bar)
    if table:
        again = f"mbkit baseline check {file}{f' --target {target}' if target else ''} --rebaseline"
        shared.show(result.document(again, full=False), as_json=False)
    if result.status in ("same", "skipped"):
        return result, False
    if not rebaseline and not (table and result.status == "versions" and _confirmed(file)):
        return result, False
    if result.skipped:
        names = ", ".join(r.engine for r in result.skipped)
        why = f"what it has of {names} would be lost; install that first"
        shared.say("error", f"{file}: not recorded again, because {why}")
        return result, False
    baselines.record(
        model,
        file,
        recorded.engines,
        samples=recorded.states.kinds.count("random"),
        seed=recorded.seed,
        target=new_target or recorded.target,
        options=kept_options(options, file),
        # It was read above, so it is this robot's.
        force=True,
    )
    shared.say("recorded", str(file))
    return result, True


def _confirmed(file: Path) -> bool:
    """Return whether a person at a terminal wants a baseline recorded again."""
    interactive = sys.stdin.isatty() and sys.stdout.isatty()
    return interactive and click.confirm(f"Record {file} again with these versions?", default=False)


@shared.command("mbkit baseline diff old.toml new.toml")
@click.argument("path_a", type=_FILE)
@click.argument("path_b", type=_FILE)
@shared.json_option
def diff(path_a: Path, path_b: Path, as_json: bool) -> None:
    """Say what PATH_B has that PATH_A has not: parameters, numbers, versions. Nothing is computed.

    Exit status: 0 the same robot with the same numbers, 1 something differs, 2 misuse or a file
    that cannot be read.
    """
    from mbkit.studies import baseline as baselines

    result = baselines.diff(path_a, path_b)
    shared.show(result.document(full=False), as_json=as_json)
    shared.leave(AGREE if result.passed else DIFFER)


for _command in (record, check, diff):
    baseline.add_command(_command)


# Targets and files.


def _check_target(files: list[Path], target: str | None, options: dict[str, Any]) -> None:
    if target is not None and len(files) != 1:
        raise click.UsageError(f"--target goes with one file, and there are {len(files)}")
    if options and target is None:
        raise click.UsageError("options of loading go with --target; what was recorded is loaded as it was then")


def _name(target: str) -> str:
    """Return what a target's file is called in a folder: as the robot, the file or the function."""
    from mbkit.load.loader import canonical
    from mbkit.report.output_folder import file_stem

    robot = canonical(target)
    path = robot is None and (Path(target).is_file() or "/" in target)
    return f"{file_stem(Path(target).stem if path else robot or target.rpartition(':')[2])}.toml"


def _loaded(
    recorded: Baseline, file: Path, target: str | None, options: dict[str, Any]
) -> tuple[Model, str | None, dict[str, Any]]:
    """Return the model that a baseline is held against, its target where that is another, and options of loading."""
    from mbkit.studies._targets import kept, model_of, resolved_options

    # A target of other options is recorded with them.
    options = {**resolved_options(recorded.options, file), **options}
    if target is None:
        return _model(recorded, file), None, options
    return model_of(target, options), kept(target, file), options


def _model(recorded: Baseline, file: Path) -> Model:
    from mbkit.studies._targets import is_code, model_of, resolved, resolved_options

    if not recorded.target:
        raise BaselineError(f"{file}: it was recorded of a model in Python, so there is nothing to load; give --target")
    if is_code(recorded.target):
        # A baseline is data, perhaps of somebody else: no word in it decides what code is run.
        raise BaselineError(
            f"{file}: it was recorded of the function {recorded.target}, which is not run because a file names it; "
            f"to run it: mbkit baseline check {file} --target {recorded.target}"
        )
    return model_of(resolved(recorded.target, file), resolved_options(recorded.options, file))


def _files(paths: tuple[Path, ...]) -> list[Path]:
    """Return the files, and of a folder every baseline in it."""
    from mbkit.studies.baseline.file import is_baseline

    out: list[Path] = []
    for path in paths:
        files = sorted(p for p in path.glob("*.toml") if is_baseline(p)) if path.is_dir() else [path]
        if not files:
            raise InputError(f"{path}: no baseline in this folder; mbkit baseline record TARGET {path} makes one")
        out += files
    return out
