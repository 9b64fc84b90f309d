"""`mbkit export`: the equations of motion as C."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mbkit.cli._shared import json_option, load_options, out_option, tell

if TYPE_CHECKING:
    from mbkit.codegen.c_source import CSource


@click.command()
@click.argument("target")
@click.option(
    "--quantity",
    "quantities",
    multiple=True,
    metavar="NAME",
    help="What to compute; may be repeated.  [default: inverse_dynamics, forward_dynamics]",
)
@load_options
@click.option("--name", help="Prefix of every name in C, and stem of the files.  [default: the target's name]")
@click.option("--force", is_flag=True, help="Replace files that mbkit did not write.")
@json_option
@out_option("mbkit-export")
def export(
    target: str,
    quantities: tuple[str, ...],
    options: dict[str, Any],
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
    from mbkit.codegen.c_source import DEFAULT, c_identifier, export_c
    from mbkit.load.loader import canonical
    from mbkit.studies._targets import model_of

    model = model_of(target, options)
    # Several robots' files hold the same name.
    robot = canonical(target)
    stem = name if name is not None else c_identifier(robot) if robot is not None else None
    source = export_c(model, quantities or DEFAULT, name=stem)
    paths = source.write(out, force=force)
    if as_json:
        import json
        from dataclasses import asdict

        data: dict[str, Any] = {"name": source.name, "model": model.name, "digest": source.digest}
        data |= {"versions": source.versions, "header": str(paths[0]), "source": str(paths[1])}
        data["functions"] = [
            asdict(f) | {"inputs": dict(f.inputs), "outputs": dict(f.outputs)} for f in source.functions
        ]
        tell(json.dumps(data, indent=1))
        return
    list_functions(source, paths)


def list_functions(source: CSource, paths: Sequence[Path]) -> None:
    """Print the signatures of C functions and the files that hold them."""
    for function in source.functions:
        tell(f"{function.signature}: {function.operations} operations")
    tell(f"header {paths[0]}\nsource {paths[1]}")
