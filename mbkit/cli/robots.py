"""`mbkit robots`: robots and systems by name."""

from __future__ import annotations

import click

from mbkit.cli._shared import console, tell


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print JSON on stdout.")
def robots(as_json: bool) -> None:
    """List the robots and catalog systems that can be checked by name."""
    from mbkit import catalog
    from mbkit.load import robots as records

    if as_json:
        import json

        fields = ("name", "aliases", "nq", "nv", "mass", "reason")
        listed = [{f: getattr(r, f) for f in fields} | {"path": str(r.path)} for r in records()]
        tell(json.dumps(listed, indent=1))
        return
    from mbkit.report import terminal

    console().print(terminal.robots(records(), catalog.systems()))
