"""Options, output, messages and exit status of all commands."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn

import click

from mbkit import _process as _interrupt
from mbkit._escape import terminal
from mbkit.errors import InputError, MbkitError, MbkitWarning, OutputError, UnknownNameError

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from mbkit.studies.document import Document

# Exit status. "Differ" is a verdict, so a fault of mbkit's own has another.
AGREE: Final = 0
DONE: Final = 0
DIFFER: Final = 1
MISUSE: Final = 2
INTERNAL: Final = 70
INTERRUPTED: Final = _interrupt.INTERRUPTED

#: Keyword arguments of `mbkit.load` that messages name, as options of the command line.
_OPTIONS: Final = {
    'nonphysical="warn"': "--nonphysical warn",
    "mimic='free'": "--mimic free",
    "floating_base=True": "--floating-base",
    "actuators=True": "--actuators",
}

# Options that several commands have.

Command = Callable[..., None]
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON, and nothing else, on stdout.")
force_option = click.option("--force", is_flag=True, help="Replace files that mbkit did not write.")


def out_option(default: str) -> Callable[[Command], Command]:
    """Return the option for the folder of results."""
    kind = click.Path(path_type=Path)
    return click.option("--out", default=default, show_default=True, type=kind, help="Folder to fill.")


def report_options(command: Command) -> Command:
    """Add the options of commands that write a report; the command gets them as a `Report`."""

    @functools.wraps(command)
    def with_report(*args: Any, out: Path, as_json: bool, force: bool, **more: Any) -> None:
        command(*args, report=Report(out, as_json, force), **more)

    return json_option(out_option("mbkit-report")(force_option(with_report)))


def engines_option(default: str) -> Callable[[Command], Command]:
    """Return the option for names of engines."""
    return click.option("--engines", default=default, show_default=True, callback=split, metavar="A,B,...")


def methods_option(default: str) -> Callable[[Command], Command]:
    """Return the option for names of methods of integration; `default` is for the help."""
    text = f"Integrators.  [default: {default}]"
    return click.option("--methods", default="", callback=_methods, metavar="A,B,...", help=text)


def _methods(ctx: click.Context, parameter: click.Parameter, value: str) -> tuple[str, ...]:
    names = split(ctx, parameter, value)
    if names:
        from mbkit.methods.registry import method_of

        for name in names:
            method_of(name)
    return names


def states_options(samples: int) -> Callable[[Command], Command]:
    """Return the options for random states: how many, and their seed."""
    count = click.IntRange(min=1)
    number = click.option("--samples", default=samples, show_default=True, type=count, help="Random states.")
    return lambda command: number(seed_option()(command))


def seed_option(text: str | None = None) -> Callable[[Command], Command]:
    """Return the option for the seed of random states."""
    return click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help=text)


def split(_ctx: click.Context, _parameter: click.Parameter, value: str) -> tuple[str, ...]:
    """Return names that are separated by commas."""
    return tuple(name.strip() for name in value.split(",") if name.strip())


def load_options(command: Command) -> Command:
    """Add the options for reading a file or robot; the command gets those that were set as `options`."""

    @functools.wraps(command)
    def with_options(*args: Any, **more: Any) -> None:
        given = {name: more.pop(name) for name in ("floating_base", "mimic", "nonphysical", "loops", "actuators")}
        command(*args, options={k: v for k, v in given.items() if v not in (None, False)}, **more)

    bodies, mimics = click.Choice(["error", "warn"]), click.Choice(["reduce", "free"])
    base = click.option("--floating-base", is_flag=True, help="Let the base of a file or robot move freely.")
    mimic = click.option("--mimic", type=mimics, help="What mimic joints become.  [default: reduce]")
    nonphysical = click.option("--nonphysical", type=bodies, help="Refuse impossible bodies, or take them.")
    loops = click.option("--loops", metavar="FILE", help="TOML file of loops to add, a table [[loop]] for each.")
    servos = click.option("--actuators", is_flag=True, help="Let the servos of an MJCF act, at zero control.")
    return base(mimic(nonphysical(loops(servos(with_options)))))


def stem_of(target: str, name: str) -> str:
    """Return the stem of a target's files: the robot's name or the file's path, since several files hold one name."""
    from mbkit.load.loader import canonical
    from mbkit.report.output_folder import file_stem

    if (robot := canonical(target)) is None and Path(target).is_file():
        # The end of a path tells more than its beginning.
        name = os.path.relpath(Path(target).with_suffix(""))[-100:]
    return file_stem(robot or name)


def in_options(message: str) -> str:
    """Return a message of `mbkit.load` in the words of the command line."""
    for keyword, option in _OPTIONS.items():
        message = message.replace(keyword, option)
    return message


def check_engines(names: tuple[str, ...], least: int) -> None:
    """Raise for names that are no engine's, before anything is read, loaded or computed."""
    from mbkit.engines.registry import REFERENCE, compared, find_engine
    from mbkit.engines.remote.packages import names_version, remote_engines

    comparable = compared()
    for name in names:
        if name == REFERENCE:
            raise InputError("--engines: the oracle is what every engine is measured by; leave it out")
        if names_version(name):
            # Another version, or an engine that always has an environment.
            find_engine(name)
        elif name not in comparable:
            raise UnknownNameError("engine", name, (*comparable, *remote_engines()))
    if len(set(names)) < least:
        count = {1: "one", 2: "two"}[least]
        raise InputError(
            f"--engines: expected at least {count} of {', '.join(comparable)}, got {', '.join(names) or 'none'}"
        )


# Help and messages.


class _Command(click.Command):
    """A command whose help ends in examples, and whose line in a list is its whole first sentence."""

    def __init__(self, *args: Any, examples: Sequence[str] = (), **more: Any) -> None:
        super().__init__(*args, **more)
        self.examples = tuple(examples)

    def get_short_help_str(self, limit: int = 0) -> str:  # noqa: ARG002, a sentence is never cut
        """Return the first sentence of the help."""
        return " ".join((self.help or "").split()).partition(". ")[0].rstrip(".")

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples."""
        if self.examples:
            with formatter.section("Examples"):
                formatter.write("".join(f"{'':{formatter.current_indent}}{line}\n" for line in self.examples))
        super().format_epilog(ctx, formatter)


class Group(_Command, click.Group):
    """A command of commands, with examples."""


def command(*examples: str) -> Callable[[Command], _Command]:
    """Return the decorator of a command, with examples for its help."""
    return lambda function: click.command(cls=_Command, examples=examples)(function)


class CommandGroup(Group):
    """Turns what the library raises into one message and an exit status."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        try:
            with _one_line_warnings():
                return super().invoke(ctx)
        except MbkitError as error:
            say("error", in_options(str(error)))
            ctx.exit(MISUSE)
        except KeyboardInterrupt:
            # An entry point that listens has said so by now, and nothing else is printed.
            say("interrupted", "the command did not finish")
            ctx.exit(INTERRUPTED)
        except click.ClickException as error:
            # A word of the command line may be a file of somebody else's, by a wildcard.
            vars(error)["message"] = terminal(error.message)
            raise
        except (click.exceptions.Exit, click.Abort):
            raise
        except Exception as error:
            missing = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
            if missing not in ("", "mbkit"):
                say("error", f"{missing} is not installed, and this command needs it; pip install {missing}")
                ctx.exit(MISUSE)
            traceback.print_exc()
            say("error", "this is a fault of mbkit's; please report it with the lines above")
            ctx.exit(INTERNAL)
        finally:
            # A library may have swallowed the interruption, or treated it as its own failure.
            if _interrupt.received():
                ctx.exit(INTERRUPTED)


def say(what: str, text: str) -> None:
    """Print a message on stderr after its kind; lines after the first are indented."""
    text = re.sub(r"\n(?! )", "\n  ", terminal(text))
    colour = {"error": "red", "warning": "yellow"}.get(what)
    click.echo(f"{click.style(what, fg=colour, bold=True)}: {text}", err=True)


def tell(text: str) -> None:
    """Print text on stdout, with control characters spelled out."""
    click.echo(terminal(text))


def leave(status: int) -> NoReturn:
    """End the command with a status."""
    click.get_current_context().exit(status)


@contextlib.contextmanager
def _one_line_warnings() -> Iterator[None]:
    """Show each warning of the library once, on one line."""
    seen: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
        text = " ".join(str(message).split())
        if text not in seen:
            seen.add(text)
            say("warning", text if issubclass(category, MbkitWarning) else f"{category.__name__}: {text}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", MbkitWarning)
        warnings.showwarning = show
        yield


# Output.


def show(view: Document, *, as_json: bool) -> None:
    """Print a view, or its result as JSON."""
    if as_json:
        tell(view.result.to_json())
    else:
        from mbkit.report.terminal import render

        console().print(render(view))


@dataclass(frozen=True)
class Report:
    """The folder of a result's files, whether its JSON is printed, and whether foreign files are replaced."""

    out: Path
    as_json: bool
    force: bool

    def prepare(self, stem: str = "", *endings: str) -> None:
        """Raise before anything is computed if a result could not be written."""
        from mbkit.report import output_folder

        output_folder.check_writable(self.out)
        output_folder.check_replaceable(self.out, *(f"{stem}.{ending}" for ending in endings), force=self.force)

    def write(
        self,
        view: Document,
        stem: str,
        table: Callable[[], str] | None = None,
        figure: Callable[[], bytes] | None = None,
    ) -> bool:
        """Write JSON, CSV (`table`), PNG (`figure`) and a page of a result, and print it; return whether all went."""
        from mbkit.report import output_folder
        from mbkit.report.page import render

        def page() -> str:
            return render(view, data=f"{stem}.json", table=f"{stem}.csv" if table else "")

        contents: dict[str, tuple[str, Callable[[], str | bytes] | None]] = {
            "data": ("json", lambda: view.result.to_json() + "\n"),
            "table": ("csv", table),
            "figure": ("png", figure),
            "page": ("html", page),
        }
        paths: dict[str, Path] = {}
        failure = ""
        try:
            for what, (ending, content) in contents.items():
                if content is not None:
                    paths[what] = output_folder.write(self.out, f"{stem}.{ending}", content(), force=self.force)
        except OutputError as error:
            failure = str(error)
        try:
            show(view, as_json=self.as_json)
            if not self.as_json and not failure:
                lines = "\n".join(f"{what} {path}" for what, path in reversed(paths.items()))
                console().print(lines, markup=False, highlight=False, soft_wrap=True)
            sys.stdout.flush()
        except BrokenPipeError:
            # The reader may stop early (head). The verdict stands, and the rest of the buffer must not fail at the end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if failure:
            say("error", f"{failure}; the result itself is printed on stdout")
        elif self.as_json:
            say("written", " ".join(map(str, paths.values())))
        return not failure


def console() -> Console:
    """Return where tables are printed."""
    from rich.console import Console, ConsoleOptions
    from rich.segment import Segment

    class Screen(Console):
        """Prints no control character of a name; leaves a closed pipe to the caller."""

        def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
            for text, style, control in super().render(renderable, options):
                yield Segment(text if control else terminal(text), style, control)

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    screen: Console = Screen(highlight=False)
    if not screen.is_terminal and "COLUMNS" not in os.environ:
        # A file has no width; rich would fold at 80.
        screen.width = 140
    return screen
