"""`record`: what engines say of a model today, into a file."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mbkit._check import Array, count
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import UnsupportedError
from mbkit.model import Model
from mbkit.studies import stamp
from mbkit.studies.baseline import engines as engines_
from mbkit.studies.baseline.content import Baseline
from mbkit.studies.baseline.description import described
from mbkit.studies.baseline.evaluation import LONG, evaluated, states_of
from mbkit.studies.baseline.file import check_replaceable, path_of, store, text_of
from mbkit.studies.baseline.links import links_of
from mbkit.studies.baseline.target import checked_target
from mbkit.studies.baseline.versions import relevant
from mbkit.studies.baseline.yardstick import FINE, ROUNDING, Yardstick
from mbkit.studies.result import Refusal

__all__ = ["record"]

Progress = Callable[[float, str], object]


def record(
    model: Model,
    path: str | os.PathLike[str],
    engines: Sequence[str] | None = None,
    *,
    samples: int = 2,
    seed: int = 0,
    target: str = "",
    options: Mapping[str, Any] | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Baseline:
    """Record what engines say of a model, for `check` to hold them against later.

    The file has the model's parameters, every term at a few seeded states and the end of a
    short rollout, by the oracle; how far each engine was from these; and versions. The same
    model, versions and processor give the same bytes.

    Parameters
    ----------
    model : Model
        Whose named parameters have values.
    path : path
        A TOML file, of which folders are made. The baseline of the same model is replaced.
    engines : sequence of str, optional
        By default all that are installed and hold the model.
    samples : int
        Random states, beside which stands one near singular.
    seed : int
    target, options : str and mapping, optional
        What `mbkit baseline check` loads, as `mbkit check` takes it, and how: keyword arguments of
        `mbkit.load`. A function, ``package.module:function``, is loaded only where ``--target`` names it. A file's
        path is relative to the baseline's folder, and begins with a dot. Of a
        URDF, links that are fixed to each other are recorded each by itself then, beside the body
        that they make.
    force : bool
        Whether to replace whatever file is there.
    progress : callable, optional
        Called as ``progress(fraction, text)``.

    Returns
    -------
    Baseline
        Of which `disagreements` tells where an engine was not right even now.

    Raises
    ------
    InputError, UnknownNameError
        For unusable arguments.
    UnsupportedError
        An engine that was asked for is not installed, or none holds the model.
    OutputError
        The file cannot be written, or is not this model's to replace; it stays as it was.
    """
    model, where = engines_.checked_model(model), path_of(path)
    names = engines_.checked_names(engines)
    count("samples", samples, least=1)
    count("seed", seed)
    checked_target(target, options)
    if not force:
        check_replaceable(where, model.name)
    made = _recorded(model, names, engines is not None, samples, seed, progress or _silent)
    given = dict(options or {})
    description = made.description | links_of(model, target, given, where)
    made = replace(made, target=target, options=given, description=description)
    store(where, text_of(made), model.name, force=force)
    return made


def _silent(_fraction: float, _text: str) -> None:
    """Tell nobody."""


def _recorded(
    model: Model,
    names: Sequence[str],
    asked: bool,
    samples: int,
    seed: int,
    tell: Progress,
) -> Baseline:
    tell(0.0, "building")
    plain = engines_.with_values(model)
    made, refused, missing = engines_.made(plain, names)
    if asked and missing:
        raise UnsupportedError("; ".join(f"{m.engine}: {m.reason}" for m in missing))
    if not made:
        why = "; ".join(f"{r.engine}: {r.reason}" for r in refused)
        raise UnsupportedError(f"no engine holds {model.name}, so there is nothing to record: {why}")
    at = states_of(plain, samples, seed)
    tell(0.1, "34 digits")
    terms, untold = evaluated(OracleDynamics(plain), at, LONG)
    description = described(model)
    yardstick = Yardstick(terms, at, description, model.coordinate_names, model.velocity_names)
    errors: dict[str, dict[str, float]] = {}
    own: dict[str, dict[str, Array]] = {}
    left_out: list[Refusal] = [*refused, *untold]
    for k, (name, dyn) in enumerate(made.items()):
        tell(0.6 + 0.4 * k / len(made), name)
        values, without = evaluated(dyn, at, LONG)
        left_out += [r for r in without if r.term in terms]
        errors[name] = {t: _error(yardstick, t, x, terms[t]) for t, x in values.items() if t in terms}
        wrong = {t: values[t] for t, x in errors[name].items() if x > ROUNDING}
        if wrong:
            own[name] = wrong
    tell(1.0, "done")
    return Baseline(
        model=model.name,
        digest=model.digest,
        target="",
        options={},
        seed=seed,
        processor=stamp.processor(),
        versions=relevant(errors),
        description=description,
        coordinates=tuple(model.coordinate_names),
        velocities=tuple(model.velocity_names),
        states=at,
        rollout=LONG,
        terms=terms,
        errors=errors,
        own=own,
        left_out=tuple(left_out),
    )


def _error(yardstick: Yardstick, term: str, value: Array, reference: Array) -> float:
    error = float(np.max(yardstick.errors(term, value, reference).relative))
    return error if error > FINE else 0.0
