"""`mbkit diff`: why two descriptions, or two engines on one, differ."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

from mbkit.cli._shared import (
    AGREE,
    DIFFER,
    check_engines,
    console,
    json_option,
    leave,
    load_options,
    samples_option,
    seed_option,
    split,
    tell,
)
from mbkit.errors import MbkitError

if TYPE_CHECKING:
    from mbkit.model import Model


@click.command()
@click.argument("first")
@click.argument("second", required=False)
@click.option(
    "--engines", callback=split, default="", metavar="A,B", help="Two engines, to be compared on FIRST (and SECOND)."
)
@samples_option(3)
@seed_option()
@click.option(
    "--tolerance", default=1e-9, show_default=True, type=click.FloatRange(min=0, min_open=True), help="What counts."
)
@load_options
@json_option
def diff(
    first: str,
    second: str | None,
    engines: tuple[str, ...],
    samples: int,
    seed: int,
    tolerance: float,
    options: dict[str, Any],
    as_json: bool,
) -> None:
    """Say why SECOND moves otherwise than FIRST, and name the causes.

    Both are what `mbkit check` takes. A file is read link by link, as it is written, so that links which are
    fused wrongly are named. With two engines they are compared on one description, or each on its own.
    """
    if engines:
        check_engines(engines, least=2)
        if len(engines) > 2:
            raise click.UsageError("--engines takes two")
    elif second is None:
        raise click.UsageError("give two descriptions, or one and --engines A,B")
    from mbkit.engines import dynamics
    from mbkit.studies.explain import explain

    models = [_model(target, options) for target in ([first] if second is None else [first, second])]
    sides: list[Any] = list(models)
    if engines:
        sides = [dynamics(models[k % len(models)], engine) for k, engine in enumerate(engines)]
    names = None if engines else (_short(first), _short(second or ""))
    if names is not None and names[0] == names[1]:
        names = first, second or ""
    result = explain(*sides, samples=samples, seed=seed, tolerance=tolerance, names=names)
    if as_json:
        tell(result.to_json())
    else:
        from mbkit.report.explain_view import explanation_view
        from mbkit.report.terminal import render

        console().print(render(explanation_view(result)))
    leave(AGREE if result.agree else DIFFER)


def _short(target: str) -> str:
    return os.path.basename(target) or target


def _model(target: str, options: Mapping[str, Any]) -> Model:
    """Return a file as it is written if there are no options, and any other target as it loads."""
    from mbkit import catalog
    from mbkit.load.loader import find
    from mbkit.studies._targets import model_of
    from mbkit.studies.importers.study import written

    # `model_of` says which one it takes where a robot is also a catalog system.
    plain = not options and (os.path.isfile(target) or (find(target) is not None and target not in catalog.systems()))
    if plain:
        try:
            return written(target)
        except MbkitError:
            # The loader has the better message, or reads it after all.
            pass
    return model_of(target, options)
