"""How every command ends: its status, and one message on stderr."""

from __future__ import annotations

import contextlib
import traceback
import warnings
from collections.abc import Iterator
from typing import Any, Final

import click

from mbkit.cli.options import in_options
from mbkit.errors import MbkitError, MbkitWarning

__all__ = ["AGREE", "DIFFER", "DONE", "INTERNAL", "INTERRUPTED", "MISUSE", "Door", "leave", "say"]

AGREE: Final = 0
DONE: Final = 0
DIFFER: Final = 1
MISUSE: Final = 2
INTERNAL: Final = 70
INTERRUPTED: Final = 130


class Door(click.Group):
    """Turns what the library raises into one message and an exit status."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command that was asked for."""
        try:
            with _one_line_warnings():
                return super().invoke(ctx)
        except MbkitError as error:
            say("error", in_options(str(error)))
            ctx.exit(MISUSE)
        except KeyboardInterrupt:
            say("interrupted", "nothing was finished")
            ctx.exit(INTERRUPTED)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except Exception:
            # A status of its own: "differ" is a verdict, and this is none.
            traceback.print_exc()
            say("error", "this is a fault of mbkit's; please report it with the lines above")
            ctx.exit(INTERNAL)


def say(what: str, text: str) -> None:
    """Print one line on stderr, with what it is before it."""
    from mbkit.report.numbers import plain

    colour = {"error": "red", "warning": "yellow"}.get(what)
    click.echo(f"{click.style(what, fg=colour, bold=True)}: {plain(text)}", err=True)


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
