"""What a command prints and writes."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mbkit._escape import terminal
from mbkit.cli.door import say, tell
from mbkit.errors import OutputError

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

__all__ = ["File", "console", "show"]


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
    from mbkit.report import folder

    paths: dict[str, Path] = {}
    failure = ""
    try:
        for file in files:
            paths[file.what] = folder.write(out, file.name, file.make(), force=force)
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
