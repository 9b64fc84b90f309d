"""`record`: what engines say of a model today, into a file."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array, count
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.engines.registry import compared, find_engine
from mbkit.errors import KnownDefectWarning, MbkitError, NumericalError, UnsupportedError
from mbkit.methods.registry import DEFAULT_METHOD
from mbkit.model import Model
from mbkit.studies import results
from mbkit.studies._checkpoint import Progress, silent
from mbkit.studies._targets import checked_target, engine_names, with_values
from mbkit.studies.baseline.description import described, links_of
from mbkit.studies.baseline.file import ROLLOUT, Baseline, Rollout, check_replaceable, path_of, store, text_of
from mbkit.studies.baseline.tolerance import FINE, ROUNDING, Comparator, relevant
from mbkit.studies.compare.terms import TERMS, States, states
from mbkit.studies.results import Refusal
from mbkit.studies.study_runs import quiet_simulate, require_motion

# What is recorded, evaluated: the states, every term at them, and where a short rollout ends.

_METHOD: Final = DEFAULT_METHOD
#: Of the motion of a robot an excerpt, in which rounding does not grow.
_ROLLOUT: Final = Rollout(dt=2e-3, steps=25)
# States are written in a file for people: of these decimals every double is its own shortest text.
_DECIMALS: Final = 6


def _states(model: Model, samples: int, seed: int) -> States:
    """Return `samples` random states, and one that is near singular."""
    drawn = states(model, samples, seed)
    # Limits act on no term, and at zero axes are aligned as they are near singular: a file is read by people.
    which = [*range(samples), *[k for k, kind in enumerate(drawn.kinds) if kind == "near singular"][:1]]
    v, a, tau = (np.round(x[which], _DECIMALS // 2) + 0.0 for x in (drawn.v, drawn.a, drawn.tau))
    if model.constrained:
        # Rounded, a state would be off the constraints.
        v = drawn.v[which]
    return States(_rounded(model, drawn.q[which]), v, a, tau, tuple(drawn.kinds[k] for k in which))


def _rounded(model: Model, q: Array) -> Array:
    if model.constrained:
        return q
    out = np.round(q, _DECIMALS)
    for start, _ in model.quaternions:
        # Unit length needs every digit.
        out[..., start : start + 4] = q[..., start : start + 4]
    return np.asarray(out + 0.0)


def evaluate(dyn: Dynamics, at: States, rollout: Rollout) -> tuple[dict[str, Array], list[Refusal]]:
    """Return every term that an engine gives, and why it does not give the others."""
    values: dict[str, Array] = {}
    refusals = []
    with warnings.catch_warnings():
        # A defect that was there before is recorded, and no news.
        warnings.simplefilter("ignore", KnownDefectWarning)
        for term in TERMS:
            try:
                values[term.name] = term.call(dyn, at)
            except MbkitError as error:
                refusals.append(Refusal.of(dyn.engine, error, term.name))
        try:
            values[ROLLOUT] = _rolled(dyn, at, rollout)
        except MbkitError as error:
            refusals.append(Refusal.of(dyn.engine, error, ROLLOUT))
    return values, refusals


def _rolled(dyn: Dynamics, at: States, rollout: Rollout) -> Array:
    """Return q and v at the end of a rollout from the first state, one after the other."""
    # MuJoCo's own steps make a mimic joint a soft equality, which is another system.
    # The same formula everywhere, by an engine's own steps where it has them.
    method = _METHOD if dyn.model.layout.reduced else find_engine(dyn.engine).rk4
    run = quiet_simulate(dyn, at.q[0], at.v[0], rollout.dt * rollout.steps, method, rollout.dt)
    if run.stats.ended != "finished":
        raise NumericalError(f"{dyn.engine}: {method}: {run.stats.message}")
    return np.concatenate([run.q[-1], run.v[-1]])


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
    model, where = checked_model(model), path_of(path)
    names = compared() if engines is None else engine_names(engines)
    count("samples", samples, least=1)
    count("seed", seed)
    checked_target(target, options)
    if not force:
        check_replaceable(where, model.name)
    recorded = _recorded(model, names, engines is not None, samples, seed, progress or silent)
    kept = dict(options or {})
    description = recorded.description | links_of(model, target, kept, where)
    recorded = replace(recorded, target=target, options=kept, description=description)
    store(where, text_of(recorded), model.name, force=force)
    return recorded


def _recorded(
    model: Model,
    names: Sequence[str],
    required: bool,
    samples: int,
    seed: int,
    tell: Progress,
) -> Baseline:
    tell(0.0, "building")
    plain = with_values(model)
    built, refused, missing = build_engines(plain, names)
    if required and missing:
        raise UnsupportedError("; ".join(f"{m.engine}: {m.reason}" for m in missing))
    if not built:
        why = "; ".join(f"{r.engine}: {r.reason}" for r in refused)
        raise UnsupportedError(f"no engine holds {model.name}, so there is nothing to record: {why}")
    at = _states(plain, samples, seed)
    tell(0.1, "34 digits")
    terms, absent = evaluate(OracleDynamics(plain), at, _ROLLOUT)
    description = described(model)
    comparator = Comparator(terms, at, description, model.coordinate_names, model.velocity_names)
    errors: dict[str, dict[str, float]] = {}
    own: dict[str, dict[str, Array]] = {}
    left_out: list[Refusal] = [*refused, *absent]
    for k, (name, dyn) in enumerate(built.items()):
        tell(0.6 + 0.4 * k / len(built), name)
        values, without = evaluate(dyn, at, _ROLLOUT)
        left_out += [r for r in without if r.term in terms]
        errors[name] = {t: _error(comparator, t, x, terms[t]) for t, x in values.items() if t in terms}
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
        processor=results.processor(),
        versions=relevant(errors),
        description=description,
        coordinates=tuple(model.coordinate_names),
        velocities=tuple(model.velocity_names),
        states=at,
        rollout=_ROLLOUT,
        terms=terms,
        errors=errors,
        own=own,
        left_out=tuple(left_out),
    )


def _error(comparator: Comparator, term: str, value: Array, reference: Array) -> float:
    error = float(np.max(comparator.errors(term, value, reference).relative))
    return error if error > FINE else 0.0


# The engines of a baseline; one that is not installed is no refusal.


def checked_model(model: object) -> Model:
    """Return a model that has something to record."""
    checked = require_motion(model, "record")
    checked.require_values("a baseline")
    return checked


def build_engines(model: Model, names: Iterable[str]) -> tuple[dict[str, Dynamics], list[Refusal], list[Refusal]]:
    """Return the engines that hold a model, those that refuse it, and those that are not installed."""
    engines: dict[str, Dynamics] = {}
    refused: list[Refusal] = []
    missing: list[Refusal] = []
    for name in names:
        try:
            engines[name] = dynamics(model, name, **find_engine(name).brief)
        except UnsupportedError as error:
            if isinstance(error.__cause__, ModuleNotFoundError):
                missing.append(Refusal(name, "", f"not installed; pip install {find_engine(name).package}"))
            else:
                refused.append(Refusal.of(name, error))
        except MbkitError as error:
            refused.append(Refusal.of(name, error))
    return engines, refused, missing
