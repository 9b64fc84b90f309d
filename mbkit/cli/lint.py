"""`mbkit lint`: is the file itself plausible."""

from __future__ import annotations

from typing import Any

import click

from mbkit.cli import _shared as shared


@shared.command("mbkit lint arm.urdf", "mbkit lint panda --control-period 0.004")
@click.argument("target")
@click.option(
    "--control-period",
    default=1e-3,
    show_default=True,
    type=click.FloatRange(min=0, min_open=True),
    help="Period of the controller or step, s.",
)
@click.option("--no-shapes", is_flag=True, help="Leave the shapes and meshes of the file unread.")
@shared.load_options
@shared.json_option
def lint(target: str, control_period: float, no_shapes: bool, options: dict[str, Any], as_json: bool) -> None:
    """Say what is not plausible in TARGET, by what it knows of itself: units, frames, signs, placeholders, limits.

    TARGET is what `mbkit check` takes. Links that no matter has are judged, not refused. Status 1 says that something
    is wrong for sure or likely; what to look at leaves it 0.
    """
    from mbkit.studies.lint import lint as study

    result = study(target, control_period=control_period, shapes=not no_shapes, **options)
    shared.show(result.document(full=False), as_json=as_json)
    shared.leave(shared.AGREE if result.passed else shared.DIFFER)
