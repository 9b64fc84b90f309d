"""`mbkit diff`: why two descriptions, or two engines on one, differ."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import click

from mbkit.cli import _shared as shared
from mbkit.errors import MbkitError

if TYPE_CHECKING:
    from mbkit.model import Model


@shared.command("mbkit diff arm.urdf arm_new.urdf", "mbkit diff panda --engines pinocchio,mujoco")
@click.argument("first")
@click.argument("second", required=False)
@click.option(
    "--engines",
    callback=shared.split,
    default="",
    metavar="A,B",
    help="Two engines, to be compared on FIRST (and SECOND).",
)
@shared.states_options(3)
@click.option(
    "--tolerance", default=1e-9, show_default=True, type=click.FloatRange(min=0, min_open=True), help="What counts."
)
@shared.load_options
@shared.json_option
def diff(
    first: str, second: str | None, engines: tuple[str, ...], options: dict[str, Any], as_json: bool, **settings: Any
) -> None:
    """Say why SECOND moves otherwise than FIRST, and name the causes.

    Both are what `mbkit check` takes. A file is read link by link, as it is written, so that links which are
    fused wrongly are named. With two engines they are compared on one description, or each on its own.
    """
    if engines:
        shared.check_engines(engines, least=2)
        if len(engines) > 2:
            raise click.UsageError("--engines takes two")
    elif second is None:
        raise click.UsageError("give two descriptions, or one and --engines A,B")
    from mbkit.engines import dynamics
    from mbkit.report.explain_view import explanation_view
    from mbkit.studies.explain import explain

    targets = [first] if second is None else [first, second]
    sides: list[Any] = [_model(target, options) for target in targets]
    names = None
    if engines:
        sides = [dynamics(sides[k % len(sides)], engine) for k, engine in enumerate(engines)]
    else:
        a, b = (os.path.basename(target) or target for target in targets)
        names = (a, b) if a != b else (targets[0], targets[1])
    result = explain(*sides, names=names, **settings)
    shared.show(explanation_view(result), as_json=as_json)
    shared.leave(shared.AGREE if result.agree else shared.DIFFER)


def _model(target: str, options: Mapping[str, Any]) -> Model:
    """Return a file as it is written if there are no options, and any other target as it loads."""
    from mbkit import catalog
    from mbkit.load.loader import find
    from mbkit.studies._targets import model_of
    from mbkit.studies.importers.study import written

    # `model_of` says which one it takes where a robot is also a catalog system.
    if not options and (os.path.isfile(target) or (find(target) is not None and target not in catalog.systems())):
        # The loader has the better message, or reads it after all.
        with suppress(MbkitError):
            return written(target)
    return model_of(target, options)
