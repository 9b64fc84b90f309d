"""`compare`: the terms of the equation of motion from several engines, judged."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Final

from mbkit._check import count, real
from mbkit.engines import ENGINES, Dynamics, dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import InputError, KnownDefectWarning, MbkitError, UnknownNameError
from mbkit.model import Model
from mbkit.model.expected import expect_model
from mbkit.studies import stamp
from mbkit.studies.facts import facts_of
from mbkit.studies.judge import Judge, announced
from mbkit.studies.omissions import omissions
from mbkit.studies.result import Comparison, Refusal, Row
from mbkit.studies.rollouts import free_of_mimic, rollouts
from mbkit.studies.states import states
from mbkit.studies.work_precision import work_precision

__all__ = ["COMPARABLE", "compare"]

#: Engines that can be compared: all but the one that they are measured by.
COMPARABLE: Final = tuple(name for name in ENGINES if name != OracleDynamics.engine)
Progress = Callable[[float, str], None]

#: What a comparison shows of `work_precision`: a few methods, runs of little work, and seconds at the most.
_METHODS: Final = {
    "pinocchio": ("rk4", "semi_implicit_euler", "dop853"),
    "lagrangian": ("rk853", "rk4"),
    "mujoco": ("mujoco_euler", "mujoco_implicitfast", "mujoco_rk4"),
}
_HORIZON: Final = 0.5
_REPEATS: Final = 3
_WORK: Final = 24_000
_SECONDS: Final = 60.0


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
        At least two. All are measured by the oracle, the own derivation at 34 digits.
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
    if model.parameters:
        model = model.with_parameters(**{k: x for k, x in model.parameters.items() if x is not None})
    tell = progress or _silent
    made, refusals, setup, defects = _made(model, names, tell, compile=not terms_only)
    reference = ""
    rows: list[Row] = []
    # What was written as energies has the derivation and its 34 digits, and no other engine.
    enough = len(made) > 1 or (bool(made) and model.written is not None)
    if enough:
        tell(0.05, "34 digits")
        reference = OracleDynamics.engine
        study = Judge(model, made, OracleDynamics(model), states(model, samples, seed), tolerance, defects)
        rows, refused = study.rows(lambda f, text: tell(0.05 + f * (0.85 if terms_only else 0.35), text))
        refusals += refused
    result: dict[str, Any] = {}
    # Without mass nothing can be simulated.
    massless = any(r.term == "M" and r.zero for r in rows)
    if enough and not terms_only and not massless:
        result, refused = _beyond_terms(model, made, seed, tell)
        refusals += refused
    tell(1.0, "done")
    return Comparison(
        model=model.name,
        facts=facts_of(model),
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
    """Return rollouts, run times and omissions; what fails is told, and loses nothing else."""
    result: dict[str, Any] = {}
    refusals: list[Refusal] = []
    moving, movers, note = model, made, ""
    if model.layout.reduced:
        moving, note = free_of_mimic(model), "mimic joints free"
        movers, _, _, _ = _made(moving, tuple(made), _silent, compile=True)

    def study(fraction: float, name: str, call: Callable[[], None]) -> None:
        tell(fraction, name)
        try:
            call()
        except MbkitError as error:
            refusals.append(Refusal("", name, str(error)))

    def run_rollouts() -> None:
        result["rollouts"] = rollouts(moving, movers, seed, note)

    def run_times() -> None:
        result["precision"] = work_precision(
            moving,
            tuple(movers),
            {engine: _METHODS[engine] for engine in movers if engine in _METHODS},
            duration=_HORIZON,
            seed=seed,
            repeats=_REPEATS,
            seconds=_SECONDS,
            work=_WORK,
            progress=lambda fraction, text: tell(0.6 + 0.3 * fraction, text),
        )

    def run_omissions() -> None:
        result["omissions"] = omissions(model, made, seed)

    study(0.42, "rollouts", run_rollouts)
    study(0.6, "error against run time", run_times)
    if model.written is None:
        study(0.9, "what was left out", run_omissions)
    return result, refusals


def _silent(_fraction: float, _text: str) -> None:
    """Tell nobody."""


def _checked(model: Model, engines: Sequence[str], samples: int, seed: int, tolerance: float) -> tuple[str, ...]:
    expect_model(model)
    if not model.nv:
        raise InputError(f"model: nothing moves in {model.name} (nv = 0), so there is nothing to compare; add a joint")
    if isinstance(engines, str):
        raise InputError(f"engines: expected several names, got the string {engines!r}; write ({engines!r}, ...)")
    for name in engines:
        if name == OracleDynamics.engine:
            raise InputError("engines: the oracle is what every engine is measured by; leave it out")
        if not isinstance(name, str) or name not in COMPARABLE:
            raise UnknownNameError("engine", str(name), COMPARABLE)
    unique = tuple(dict.fromkeys(engines))
    if len(unique) < 2:
        raise InputError(
            f"engines: expected at least two to compare, got {list(engines)}; there are {list(COMPARABLE)}"
        )
    count("samples", samples, least=1)
    count("seed", seed)
    real("tolerance", tolerance, positive=True)
    return unique


def _made(
    model: Model,
    names: Sequence[str],
    tell: Progress,
    *,
    compile: bool,  # noqa: A002  # the engine's own word
) -> tuple[dict[str, Dynamics], list[Refusal], dict[str, float], dict[str, str]]:
    """Return the engines, who refuses the model, the time each took, and the known defects announced."""
    made, refusals, setup, defects = {}, [], {}, {}
    for k, name in enumerate(names):
        tell(0.05 * k / len(names), f"building {name}")
        start = time.perf_counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", KnownDefectWarning)
            try:
                # A few dozen states are no reason to compile; run times are.
                options = {} if compile or name != "lagrangian" else {"compile": False}
                made[name] = dynamics(model, name, **options)
            except MbkitError as error:
                refusals.append(Refusal(name, "", str(error).removeprefix(f"{name}: ")))
        setup[name] = time.perf_counter() - start
        defects[name] = announced(caught)
        for w in caught:
            if not issubclass(w.category, KnownDefectWarning):
                warnings.warn_explicit(w.message, w.category, w.filename, w.lineno)
    return made, refusals, setup, defects
