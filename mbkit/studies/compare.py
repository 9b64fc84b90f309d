"""`compare`: the terms of the equation of motion from several engines, judged."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Final

from mbkit._check import count, real
from mbkit.engines import ENGINES, Dynamics, dynamics
from mbkit.errors import InputError, MbkitError, UnknownNameError
from mbkit.model import Model
from mbkit.studies import stamp
from mbkit.studies.costs import costs
from mbkit.studies.judge import Judge
from mbkit.studies.omissions import omissions
from mbkit.studies.result import Comparison, Refusal, Row
from mbkit.studies.rollouts import free_of_mimic, rollouts
from mbkit.studies.states import states

__all__ = ["compare"]

# The own derivation first: it shares no algorithm with the other two.
_REFERENCES: Final = ("lagrangian", "pinocchio", "mujoco")
Progress = Callable[[float, str], None]


def compare(
    model: Model,
    engines: Sequence[str] = ("pinocchio", "lagrangian", "mujoco"),
    samples: int = 64,
    seed: int = 0,
    *,
    tolerance: float = 1e-12,
    terms_only: bool = False,
    progress: Progress | None = None,
) -> Comparison:
    """Compare engines on one description.

    Parameters
    ----------
    model : Model
    engines : sequence of str
        At least two; the reference is the own derivation where it is among them.
    samples : int
        Random states, beside which stand neutral, at-limit and near-singular ones.
    seed : int
    tolerance : float
        Largest error that passes, measured as `mbkit.studies.measure` says.
    terms_only : bool
        Whether to leave out rollouts, error against run time and omissions.
    progress : callable, optional
        Called as ``progress(fraction, text)``.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError, UnknownNameError
        For unusable arguments. What an engine cannot do is a row of `refusals`.
    """
    begun = time.perf_counter()
    names = _checked(model, engines, samples, seed, tolerance)
    tell = progress or _silent
    made, refusals, setup = _made(model, names, tell)
    present = [n for n in _REFERENCES if n in made]
    reference = present[0] if present else ""
    rows: list[Row] = []
    if len(made) > 1:
        study = Judge(model, made, reference, states(model, samples, seed), tolerance)
        rows, refused = study.rows(lambda f, text: tell(0.05 + f * (0.85 if terms_only else 0.35), text))
        refusals += refused
    result: dict[str, Any] = {}
    if len(made) > 1 and not terms_only:
        result, refused = _beyond_terms(model, made, seed, tell)
        refusals += refused
    tell(1.0, "done")
    return Comparison(
        model=model.name,
        facts=_facts(model),
        engines=tuple(made),
        reference=reference,
        samples=samples,
        seed=seed,
        tolerance=tolerance,
        rows=tuple(rows),
        refusals=tuple(refusals),
        setup=setup,
        versions=stamp.versions(),
        processor=stamp.processor(),
        seconds=time.perf_counter() - begun,
        **result,
    )


def _beyond_terms(
    model: Model, made: dict[str, Dynamics], seed: int, tell: Progress
) -> tuple[dict[str, Any], list[Refusal]]:
    """Return rollouts, costs and omissions; what fails is told, and loses nothing else."""
    result: dict[str, Any] = {}
    refusals: list[Refusal] = []
    moving, movers, note = model, made, ""
    if model.layout.reduced:
        moving, note = free_of_mimic(model), "mimic joints free"
        movers, _, _ = _made(moving, tuple(made), _silent)

    def study(fraction: float, name: str, call: Callable[[], None]) -> None:
        tell(fraction, name)
        try:
            call()
        except MbkitError as error:
            refusals.append(Refusal("", name, str(error)))

    def run_rollouts() -> None:
        result["rollouts"] = rollouts(moving, movers, seed, note)

    def run_costs() -> None:
        result["costs"], result["reference_floor"], refused = costs(moving, movers, seed)
        refusals.extend(refused)

    def run_omissions() -> None:
        result["omissions"] = omissions(model, made, seed)

    study(0.42, "rollouts", run_rollouts)
    study(0.6, "error against run time", run_costs)
    study(0.9, "what was left out", run_omissions)
    return result, refusals


def _silent(_fraction: float, _text: str) -> None:
    """Tell nobody."""


def _checked(model: Model, engines: Sequence[str], samples: int, seed: int, tolerance: float) -> tuple[str, ...]:
    if not isinstance(model, Model):
        raise InputError(f"model: expected a Model, got {type(model).__name__}; mbkit.load(...) makes one")
    if not model.nv:
        raise InputError(f"model: nothing moves in {model.name} (nv = 0), so there is nothing to compare; add a joint")
    if isinstance(engines, str):
        raise InputError(f"engines: expected several names, got the string {engines!r}; write ({engines!r}, ...)")
    for name in engines:
        if not isinstance(name, str) or name not in ENGINES:
            raise UnknownNameError("engine", str(name), ENGINES)
    unique = tuple(dict.fromkeys(engines))
    if len(unique) < 2:
        raise InputError(f"engines: expected at least two to compare, got {list(engines)}; there are {list(ENGINES)}")
    count("samples", samples, least=1)
    count("seed", seed)
    real("tolerance", tolerance, positive=True)
    return unique


def _made(
    model: Model, names: Sequence[str], tell: Progress
) -> tuple[dict[str, Dynamics], list[Refusal], dict[str, float]]:
    made, refusals, setup = {}, [], {}
    for k, name in enumerate(names):
        tell(0.05 * k / len(names), f"building {name}")
        start = time.perf_counter()
        try:
            made[name] = dynamics(model, name)
        except MbkitError as error:
            refusals.append(Refusal(name, "", str(error).removeprefix(f"{name}: ")))
        setup[name] = time.perf_counter() - start
    return made, refusals, setup


def _facts(model: Model) -> dict[str, Any]:
    return {
        "nq": model.nq,
        "nv": model.nv,
        "mass": model.mass,
        "digest": model.digest,
        "needs": model.needs.as_dict(),
        "joints": list(model.joint_names),
        "notes": list(model.notes),
        "nonphysical": [f"{name}: {why}" for name, why in model.nonphysical],
    }
