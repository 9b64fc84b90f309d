"""`mbkit robots` and `mbkit convert`: descriptions by name, and in another format."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from mbkit.cli import _shared as shared
from mbkit.errors import OutputError


@shared.command("mbkit robots", "mbkit robots --json")
@shared.json_option
def robots(as_json: bool) -> None:
    """List the robots and catalog systems that can be checked by name."""
    from mbkit import catalog
    from mbkit.load import robots as records

    if as_json:
        fields = ("name", "aliases", "nq", "nv", "mass", "reason")
        listed = [{f: getattr(r, f) for f in fields} | {"path": str(r.path)} for r in records()]
        shared.tell(json.dumps(listed, indent=1))
        return
    from mbkit.report import terminal

    shared.console().print(terminal.robots(records(), catalog.systems()))


@shared.command("mbkit convert panda --to mjcf", "mbkit convert arm.urdf --to mjcf --out arm.xml")
@click.argument("target")
@click.option("--to", "to", required=True, type=click.Choice(["mjcf", "urdf"]), help="The format.")
@click.option("--out", type=click.Path(path_type=Path), help="File to write.  [default: print]")
@click.option("--force", is_flag=True, help="Replace a file that is there.")
@shared.load_options
def convert(target: str, to: str, out: Path | None, force: bool, options: dict[str, Any]) -> None:
    """Write TARGET as MJCF or URDF: its motion alone, without geometry.

    TARGET is what `mbkit check` takes. The text is read back with MuJoCo's or Pinocchio's own parser before
    it is written, and what the format cannot say is an error that names it.
    """
    from mbkit.studies._targets import model_of
    from mbkit.studies.convert import convert as converted

    if out is not None and out.exists() and not force:
        raise OutputError(f"{out} is there already; choose another with --out, or replace it with --force")
    result = converted(model_of(target, options), to)
    if out is None:
        shared.tell(result.text.removesuffix("\n"))
    else:
        result.write(out)
    for note in result.notes:
        shared.say("note", note)
    where = "printed" if out is None else f"written to {out}"
    shared.say("checked", f"{result.model} as {to}, {where}: read back, every term agrees to {result.worst:.1e}")
