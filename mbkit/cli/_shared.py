"""How every command ends: its status, and one message on stderr."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from mbkit import _interrupt
from mbkit._escape import terminal
from mbkit.errors import InputError, MbkitError, MbkitWarning, OutputError, UnknownNameError

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

__all__ = [
    "AGREE",
    "DIFFER",
    "DONE",
    "INTERNAL",
    "INTERRUPTED",
    "MISUSE",
    "Door",
    "File",
    "check_engines",
    "console",
    "force_option",
    "in_options",
    "leave",
    "load_options",
    "model_options",
    "say",
    "show",
    "split",
    "tell",
]


# Options that several commands have.

# Keyword arguments of `mbkit.load` that messages name, as options of the command line.
_OPTIONS: Final = {
    'nonphysical="warn"': "--nonphysical warn",
    "mimic='free'": "--mimic free",
    "floating_base=True": "--floating-base",
}

#: Of commands that write results into a folder.
force_option = click.option("--force", is_flag=True, help="Replace files that mbkit did not write.")


def split(_ctx: click.Context, _parameter: click.Parameter, value: str) -> tuple[str, ...]:
    """Return names that a comma parts."""
    return tuple(name.strip() for name in value.split(",") if name.strip())


def model_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that say how a file or robot is read; `load_options` gathers them."""
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


def load_options(floating_base: bool, mimic: str | None, nonphysical: str | None) -> dict[str, Any]:
    """Return what was asked for as keyword arguments of `mbkit.load`."""
    asked = {"floating_base": floating_base or None, "mimic": mimic, "nonphysical": nonphysical}
    return {k: v for k, v in asked.items() if v is not None}


def in_options(message: str) -> str:
    """Return a message of `mbkit.load` in the words of the command line."""
    for keyword, option in _OPTIONS.items():
        message = message.replace(keyword, option)
    return message


def check_engines(names: tuple[str, ...], least: int) -> None:
    """Raise for names that are no engine's, before anything is read, loaded or computed."""
    from mbkit.engines.registry import REFERENCE, compared

    comparable = compared()
    for name in names:
        if name == REFERENCE:
            raise InputError("--engines: the oracle is what every engine is measured by; leave it out")
        if name not in comparable:
            raise UnknownNameError("engine", name, comparable)
    if len(set(names)) < least:
        told, count = ", ".join(comparable), {1: "one", 2: "two"}.get(least, str(least))
        raise InputError(f"--engines: expected at least {count} of {told}, got {', '.join(names) or 'none'}")


AGREE: Final = 0
DONE: Final = 0
DIFFER: Final = 1
MISUSE: Final = 2
INTERNAL: Final = 70
INTERRUPTED: Final = _interrupt.INTERRUPTED


class Door(click.Group):
    """Turns what the library raises into one message and an exit status."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command that was asked for."""
        try:
            return self._invoke(ctx)
        finally:
            # A library may have swallowed it, or taken it for a failure of its own.
            if _interrupt.received():
                ctx.exit(INTERRUPTED)

    def _invoke(self, ctx: click.Context) -> Any:
        try:
            with _one_line_warnings():
                return super().invoke(ctx)
        except MbkitError as error:
            say("error", in_options(str(error)))
            ctx.exit(MISUSE)
        except KeyboardInterrupt:
            # Where the entry point listens, it has said so by now, and nothing else is printed.
            say("interrupted", "the command did not finish")
            ctx.exit(INTERRUPTED)
        except click.ClickException as error:
            # A word of the command line may be a file of somebody else's, by a wildcard.
            vars(error)["message"] = terminal(error.message)
            raise
        except (click.exceptions.Exit, click.Abort):
            raise
        except Exception:
            # A status of its own: "differ" is a verdict, and this is none.
            traceback.print_exc()
            say("error", "this is a fault of mbkit's; please report it with the lines above")
            ctx.exit(INTERNAL)


def say(what: str, text: str) -> None:
    """Print a message on stderr, with what it is before it; a line feed in it begins no message of its own."""
    told = re.sub(r"\n(?! )", "\n  ", terminal(text))
    colour = {"error": "red", "warning": "yellow"}.get(what)
    click.echo(f"{click.style(what, fg=colour, bold=True)}: {told}", err=True)


def tell(text: str) -> None:
    """Print text on stdout, with what a terminal would obey spelled out."""
    click.echo(terminal(text))


def leave(status: int) -> None:
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


# What a command prints and writes.


@dataclass(frozen=True)
class File:
    """A file to write: what it is called on the terminal, its name, and how its content is made."""

    what: str
    name: str
    make: Callable[[], str | bytes]


def show(
    data: str, table: Callable[[], RenderableType], files: Sequence[File], out: Path, *, as_json: bool, force: bool
) -> bool:
    """Write a result and print it; return whether all could be written.

    Parameters
    ----------
    data : str
        The result as JSON, printed where that was asked for.
    table : callable
        Makes what is printed else.
    files : sequence of File
        Written in their order, so the dearest to lose first.
    out : Path
        The folder.
    as_json, force : bool
        Whether JSON is printed, and whether files are replaced that mbkit did not write.
    """
    from mbkit.report import output_folder

    paths: dict[str, Path] = {}
    failure = ""
    try:
        for file in files:
            paths[file.what] = output_folder.write(out, file.name, file.make(), force=force)
    except OutputError as error:
        failure = str(error)
    try:
        if as_json:
            tell(data)
        else:
            screen = console()
            screen.print(table())
            if not failure:
                told = "\n".join(f"{what} {path}" for what, path in reversed(paths.items()))
                screen.print(told, markup=False, highlight=False, soft_wrap=True)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever reads may stop early (head); the verdict stands all the same, and
        # what is still buffered must not complain at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if failure:
        say("error", f"{failure}; the result itself is printed on stdout")
    elif as_json:
        say("written", " ".join(map(str, paths.values())))
    return not failure


def console() -> Console:
    """Return where tables are printed."""
    from rich.console import Console, ConsoleOptions
    from rich.segment import Segment

    class Screen(Console):
        """Prints no character of a name that a terminal would obey; leaves a closed pipe to the caller."""

        def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
            for text, style, control in super().render(renderable, options):
                yield Segment(text if control else terminal(text), style, control)

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    made: Console = Screen(highlight=False)
    if not made.is_terminal and "COLUMNS" not in os.environ:
        # A file has no width; rich would fold at 80.
        made.width = 140
    return made
