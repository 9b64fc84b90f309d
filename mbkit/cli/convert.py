"""`mbkit convert`: a description in another format, checked by reading it back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from mbkit.cli._shared import load_options, say, tell
from mbkit.errors import OutputError


@click.command()
@click.argument("target")
@click.option("--to", "to", required=True, type=click.Choice(["mjcf", "urdf"]), help="The format.")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="File to write.  [default: print]")
@click.option("--force", is_flag=True, help="Replace a file that is there.")
@load_options
def convert(target: str, to: str, output: Path | None, force: bool, options: dict[str, Any]) -> None:
    """Write TARGET as MJCF or URDF: its motion alone, without geometry.

    TARGET is what `mbkit check` takes. The text is read back with MuJoCo's or Pinocchio's own parser before
    it is written, and what the format cannot say is an error that names it.
    """
    from mbkit.studies._targets import model_of
    from mbkit.studies.convert import convert as converted

    if output is not None and output.exists() and not force:
        raise OutputError(f"{output} is there already; choose another with -o, or replace it with --force")
    result = converted(model_of(target, options), to)
    if output is None:
        tell(result.text.removesuffix("\n"))
    else:
        result.write(output)
    for note in result.notes:
        say("note", note)
    where = "printed" if output is None else f"written to {output}"
    say("checked", f"{result.model} as {to}, {where}: read back, every term agrees to {result.worst:.1e}")
