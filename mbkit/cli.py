"""The command `mbkit`: checks arguments, calls the library, prints, and says how it ended.

Exit status: 0 done, and the engines agree, 1 they differ, 2 misuse or bad input, 70 a fault of
mbkit's own, 130 interrupted.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import click

from mbkit._version import __version__
from mbkit.errors import InputError, MbkitError, MbkitWarning, OutputError, UnknownNameError

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

__all__ = ["cli", "main"]

AGREE: Final = 0
DIFFER: Final = 1
MISUSE: Final = 2
INTERNAL: Final = 70
INTERRUPTED: Final = 130


class _Door(click.Group):
    """Turns what the library raises into one message and an exit status."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            with _one_line_warnings():
                return super().invoke(ctx)
        except MbkitError as error:
            _say("error", str(error))
            ctx.exit(MISUSE)
        except KeyboardInterrupt:
            _say("interrupted", "nothing was finished")
            ctx.exit(INTERRUPTED)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except Exception:
            # A status of its own: "differ" is a verdict, and this is none.
            traceback.print_exc()
            _say("error", "this is a fault of mbkit's; please report it with the lines above")
            ctx.exit(INTERNAL)


@click.group(cls=_Door, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="mbkit")
def cli() -> None:
    """Equations of motion that can be trusted: Pinocchio, MuJoCo and an own derivation, compared."""


def _split(_ctx: click.Context, _parameter: click.Parameter, value: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in value.split(",") if name.strip())


def _model_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that say how a file or robot is read; `_options` gathers them."""
    for option in (
        click.option(
            "--nonphysical", type=click.Choice(["error", "warn"]), help="Refuse impossible bodies, or take them."
        ),
        click.option(
            "--mimic", type=click.Choice(["reduce", "free"]), help="What mimic joints become.  [default: reduce]"
        ),
        click.option("--floating-base", is_flag=True, help="Let the base of a file or robot move freely."),
    ):
        command = option(command)
    return command


def _options(floating_base: bool, mimic: str | None, nonphysical: str | None) -> dict[str, Any]:
    asked = {"floating_base": floating_base or None, "mimic": mimic, "nonphysical": nonphysical}
    return {k: v for k, v in asked.items() if v is not None}


@cli.command()
@click.argument("target", required=False)
@click.option("--all", "everything", is_flag=True, help="Check every robot of example-robot-data.")
@click.option("--engines", default="pinocchio,lagrangian,mujoco", show_default=True, callback=_split, metavar="A,B,...")
@click.option("--samples", default=64, show_default=True, type=click.IntRange(min=1), help="Random states.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@_model_options
@click.option("--no-rollouts", is_flag=True, help="Terms only: no trajectories, run times or omissions.")
@click.option("--jobs", type=click.IntRange(min=1), help="With --all: processes.  [default: one per processor]")
@click.option("--json", "as_json", is_flag=True, help="Print JSON, and nothing else, on stdout.")
@click.option(
    "--out", default="mbkit-report", show_default=True, type=click.Path(path_type=Path), help="Folder to fill."
)
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
    jobs: int | None,
    as_json: bool,
    out: Path,
) -> None:
    """Compare engines on TARGET, and write a page and JSON.

    TARGET is a robot (mbkit robots lists them), a catalog system, a path to a URDF or
    MJCF file, or package.module:function for a function that returns a Model.
    """
    if everything and (target is not None or nonphysical is not None):
        raise click.UsageError("--all takes every robot as it is: without a TARGET and without --nonphysical")
    if not everything and jobs is not None:
        raise click.UsageError("--jobs goes with --all")
    from mbkit.report.folder import check_writable

    _check_engines(engines)
    check_writable(out)
    if everything:
        _check_all(engines, samples, seed, floating_base, mimic or "reduce", jobs, as_json, out)
    elif target is not None:
        options = _options(floating_base, mimic, nonphysical)
        _check_one(target, options, engines, samples, seed, no_rollouts, as_json, out)
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
) -> None:
    from mbkit.load.names import find
    from mbkit.report.folder import file_stem
    from mbkit.report.progress import Bar
    from mbkit.studies import compare
    from mbkit.studies.target import model_of

    model = model_of(target, options)
    with Bar(f"check {model.name}") as bar:
        result = compare(model, engines, samples, seed, terms_only=no_rollouts, progress=bar)

    def table() -> RenderableType:
        from mbkit.report import tables

        return tables.comparison(result, target)

    def page(data: str) -> str:
        from mbkit.report.page import check_page

        return check_page(result, asked=target, data=data)

    # Several robots' files hold the same name.
    stem = file_stem(target if find(target) else model.name)
    written = _show(result.to_json(), table, page, out, stem, as_json)
    if not result.rows:
        _say("error", f"{result.verdict}; two engines that hold the model are needed")
    _leave(MISUSE if not written or not result.rows else AGREE if result.passed else DIFFER)


def _check_all(
    engines: tuple[str, ...],
    samples: int,
    seed: int,
    floating_base: bool,
    mimic: Literal["reduce", "free"],
    jobs: int | None,
    as_json: bool,
    out: Path,
) -> None:
    from mbkit.load import robots
    from mbkit.report.progress import Bar
    from mbkit.studies.all_robots import RobotOutcome, Sweep, all_robots

    expected = len(robots())
    outcomes: list[RobotOutcome] = []
    begun = time.perf_counter()
    interrupted = False
    try:
        with Bar("check --all") as bar:
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
        from mbkit.report import tables

        return tables.sweep(result)

    def page(data: str) -> str:
        from mbkit.report.page import sweep_page

        return sweep_page(result, data=data)

    written = _show(result.to_json(), table, page, out, "all", as_json)
    if interrupted:
        _say("interrupted", f"{len(outcomes)} of {expected} robots were finished")
    _leave(INTERRUPTED if interrupted else MISUSE if not written else AGREE if result.passed else DIFFER)


@cli.command()
@click.option("--json", "as_json", is_flag=True, help="Print JSON on stdout.")
def robots(as_json: bool) -> None:
    """List the robots and catalog systems that can be checked by name."""
    from mbkit import catalog
    from mbkit.load import robots as records

    if as_json:
        import json

        fields = ("name", "aliases", "nq", "nv", "mass", "reason")
        listed = [{f: getattr(r, f) for f in fields} | {"path": str(r.path)} for r in records()]
        click.echo(json.dumps(listed, indent=1))
        return
    from mbkit.report import tables

    _console().print(tables.robots(records(), catalog.systems()))


@cli.command()
@click.argument("target")
@click.option(
    "--quantity",
    "quantities",
    multiple=True,
    metavar="NAME",
    help="What to compute; may be repeated.  [default: inverse_dynamics, forward_dynamics]",
)
@_model_options
@click.option("--name", help="Prefix of every name in C, and stem of the files.  [default: the target's name]")
@click.option("--force", is_flag=True, help="Replace files that mbkit did not write.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON, and nothing else, on stdout.")
@click.option(
    "--out", default="mbkit-export", show_default=True, type=click.Path(path_type=Path), help="Folder to fill."
)
def export(
    target: str,
    quantities: tuple[str, ...],
    floating_base: bool,
    mimic: str | None,
    nonphysical: str | None,
    name: str | None,
    force: bool,
    as_json: bool,
    out: Path,
) -> None:
    """Write the equations of motion of TARGET as C99 that needs no library.

    TARGET is what `mbkit check` takes. The header tells how to compile and call it, the
    units, the conventions and the order of the joints. A file that mbkit wrote before is
    replaced; an unknown quantity lists those that there are.
    """
    from mbkit.lagrangian.export import DEFAULT, c_identifier, export_c
    from mbkit.load.names import find
    from mbkit.studies.target import model_of

    model = model_of(target, _options(floating_base, mimic, nonphysical))
    # Several robots' files hold the same name.
    stem = name if name is not None else c_identifier(target) if find(target) else None
    made = export_c(model, quantities or DEFAULT, name=stem)
    paths = made.write(out, force=force)
    if as_json:
        import json
        from dataclasses import asdict

        told: dict[str, Any] = {"name": made.name, "model": model.name, "digest": made.digest}
        told |= {"versions": made.versions, "header": str(paths[0]), "source": str(paths[1])}
        told["functions"] = [asdict(f) | {"inputs": dict(f.inputs), "outputs": dict(f.outputs)} for f in made.functions]
        click.echo(json.dumps(told, indent=1))
        return
    for function in made.functions:
        click.echo(f"{function.signature}: {function.operations} operations")
    click.echo(f"header {paths[0]}\nsource {paths[1]}")


def _check_engines(names: tuple[str, ...]) -> None:
    # Before anything is read, loaded or computed.
    from mbkit.engines import ENGINES

    comparable = [name for name in ENGINES if name != "oracle"]
    for name in names:
        if name == "oracle":
            raise InputError("--engines: the oracle is what every engine is measured by; leave it out")
        if name not in comparable:
            raise UnknownNameError("engine", name, comparable)
    if len(set(names)) < 2:
        told = ", ".join(comparable)
        raise InputError(f"--engines: expected at least two of {told}, got {', '.join(names) or 'none'}")


# What is printed and written.


def _show(
    data: str, table: Callable[[], RenderableType], page: Callable[[str], str], out: Path, stem: str, as_json: bool
) -> bool:
    """Write a result and print it; return whether it could be written."""
    from mbkit.report import folder

    paths: list[Path] = []
    failure = ""
    try:
        paths.append(folder.write(out, f"{stem}.json", data + "\n"))
        paths.append(folder.write(out, f"{stem}.html", page(f"{stem}.json")))
    except OutputError as error:
        failure = str(error)
    try:
        if as_json:
            click.echo(data)
        else:
            console = _console()
            console.print(table())
            if not failure:
                console.print(f"page {paths[1]}\ndata {paths[0]}", markup=False, highlight=False, soft_wrap=True)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever reads may stop early (head); the verdict stands all the same, and
        # what is still buffered must not complain at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if failure:
        _say("error", f"{failure}; the result itself is printed on stdout")
    elif as_json:
        _say("written", " ".join(map(str, paths)))
    return not failure


def _console() -> Console:
    from rich.console import Console

    class Patient(Console):
        """Leaves a closed pipe to the caller; rich itself would end with status 1."""

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    console: Console = Patient(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        # A file has no width; rich would fold at 80.
        console.width = 140
    return console


def _say(what: str, text: str) -> None:
    from mbkit.report.numbers import plain

    colour = {"error": "red", "warning": "yellow"}.get(what)
    click.echo(f"{click.style(what, fg=colour, bold=True)}: {plain(text)}", err=True)


@contextlib.contextmanager
def _one_line_warnings() -> Iterator[None]:
    """Show each warning of the library once, on one line."""
    seen: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
        text = " ".join(str(message).split())
        if text not in seen:
            seen.add(text)
            _say("warning", text if issubclass(category, MbkitWarning) else f"{category.__name__}: {text}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", MbkitWarning)
        warnings.showwarning = show
        yield


def _leave(status: int) -> None:
    click.get_current_context().exit(status)


def main() -> None:
    """Run the command."""
    for stream in (sys.stdout, sys.stderr):
        # Marks and units are not ASCII, whatever the locale says.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")
    cli()
