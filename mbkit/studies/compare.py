"""`compare`: the terms of the equation of motion from several engines, judged."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from mbkit._check import Array, real
from mbkit.engines import ENGINES, Dynamics, dynamics
from mbkit.errors import InputError, KnownDefectWarning, MbkitError, UnknownNameError
from mbkit.model import Model
from mbkit.studies import stamp
from mbkit.studies.costs import costs
from mbkit.studies.measure import Errors, Scales
from mbkit.studies.omissions import omissions
from mbkit.studies.power import power_rows
from mbkit.studies.result import Comparison, Refusal, Row, tupled
from mbkit.studies.rollouts import free_of_mimic, rollouts
from mbkit.studies.states import States, states
from mbkit.studies.terms import TERMS, Term
from mbkit.studies.timing import interleaved

__all__ = ["compare"]

# The own derivation first: it shares no algorithm with the other two.
_REFERENCES: Final = ("lagrangian", "pinocchio", "mujoco")
_EPS: Final = float(np.finfo(float).eps)
# Each of the largest terms went through about this many roundings on the way.
_ROUNDINGS: Final = 4.0
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
    names = _checked(model, engines, samples, tolerance)
    tell = progress or _silent
    made, refusals, setup = _made(model, names, tell)
    present = [n for n in _REFERENCES if n in made]
    reference = present[0] if present else ""
    rows: list[Row] = []
    study = None
    if len(made) > 1:
        study = _Terms(model, made, reference, states(model, samples, seed), tolerance)
        rows, refused = study.rows(lambda f, text: tell(0.05 + f * (0.85 if terms_only else 0.35), text))
        refusals += refused
    result: dict[str, Any] = {}
    if len(made) > 1 and not terms_only and model.nv:
        tell(0.42, "rollouts")
        moving, movers, note = model, made, ""
        if model.layout.reduced:
            moving, note = free_of_mimic(model), "mimic joints free"
            movers, _, _ = _made(moving, tuple(made), _silent)
        result["rollouts"] = rollouts(moving, movers, seed, note)
        tell(0.6, "error against run time")
        result["costs"], result["reference_floor"], refused = costs(moving, movers, seed)
        refusals += refused
        tell(0.9, "what was left out")
        result["omissions"] = omissions(model, made, seed)
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


def _silent(_fraction: float, _text: str) -> None:
    """Tell nobody."""


def _checked(model: Model, engines: Sequence[str], samples: int, tolerance: float) -> tuple[str, ...]:
    if not isinstance(model, Model):
        raise InputError(f"model: expected a Model, got {type(model).__name__}; mbkit.load(...) makes one")
    if not model.nv:
        raise InputError(f"model: nothing moves in {model.name} (nv = 0), so there is nothing to compare; add a joint")
    if isinstance(engines, str):
        raise InputError(f"engines: expected several names, got the string {engines!r}; write ({engines!r}, ...)")
    for name in engines:
        if name not in ENGINES:
            raise UnknownNameError("engine", str(name), ENGINES)
    unique = tuple(dict.fromkeys(engines))
    if len(unique) < 2:
        raise InputError(f"engines: expected at least two to compare, got {list(engines)}; there are {list(ENGINES)}")
    if not isinstance(samples, (int, np.integer)) or samples < 1:
        raise InputError(f"samples: expected a count of at least 1, got {samples!r}")
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
            refusals.append(Refusal(name, "", _unprefixed(str(error), name)))
        setup[name] = time.perf_counter() - start
    return made, refusals, setup


def _unprefixed(text: str, engine: str) -> str:
    return text.removeprefix(f"{engine}: ")


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


class _Terms:
    """Evaluates every term in every engine, and judges it against the reference."""

    def __init__(self, model: Model, made: dict[str, Dynamics], reference: str, at: States, tolerance: float) -> None:
        self.model, self.made, self.reference = model, made, reference
        self.at, self.tolerance = at, tolerance
        self.refusals: list[Refusal] = []
        dyn = made[reference]
        acting = np.abs(at.tau) + np.abs(dyn.nle(at.q, at.v)) + np.abs(dyn.passive(at.q, at.v))
        heavy = float(np.linalg.norm(model.gravity)) * np.sqrt(model.mass)
        self.scales = Scales.of(dyn.mass_matrix(at.q), at.v, acting, heavy)
        #: The joint of each velocity.
        self.joint_of = [j.name for j in model.independent_joints for _ in range(j.type.nv)]

    def rows(self, tell: Progress) -> tuple[list[Row], list[Refusal]]:
        """Return a row per term and engine."""
        rows: list[Row] = []
        for k, term in enumerate(TERMS):
            tell(k / (len(TERMS) + 1), term.name)
            rows += self._term(term)
        tell(len(TERMS) / (len(TERMS) + 1), "power balance")
        for name, errors in power_rows(self.made, self.at, self.scales):
            rows.append(self._row("power balance", name, errors, (np.nan, np.nan), ""))
        return rows, self.refusals

    def _term(self, term: Term) -> list[Row]:
        values: dict[str, Array] = {}
        defects: dict[str, str] = {}
        for name, dyn in self.made.items():
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                try:
                    values[name] = term.call(dyn, self.at)
                except MbkitError as error:
                    self.refusals.append(Refusal(name, term.name, _unprefixed(str(error), name)))
            defects[name] = "; ".join({str(w.message) for w in caught if issubclass(w.category, KnownDefectWarning)})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", KnownDefectWarning)
            times = interleaved({name: term.single(self.made[name], self.at) for name in values})
        if self.reference not in values:
            return []
        rows = []
        for name, value in values.items():
            if name != self.reference:
                errors = term.errors(value, values[self.reference], self.scales)
                allowed = self._allowed(term, name, errors)
                rows.append(self._row(term.name, name, errors, times[name], defects[name], allowed))
        own = Errors(*(np.zeros(len(self.at.q)),) * 2, np.zeros(self.model.nv))
        rows.append(self._row(term.name, self.reference, own, times[self.reference], defects[self.reference]))
        return rows

    def _allowed(self, term: Term, engine: str, errors: Errors) -> float:
        """Return the tolerance, or the engine's own bound where its formula cannot do better."""
        if term.quantity != "mass_matrix" or errors.relative.max() <= self.tolerance:
            return self.tolerance
        amplified = self.made[engine].mass_matrix_rounding(self.at.q[errors.worst])
        return self.tolerance if amplified is None else max(self.tolerance, _ROUNDINGS * _EPS * float(amplified))

    def _row(
        self,
        term: str,
        engine: str,
        errors: Errors,
        ns: tuple[float, float],
        defect: str,
        allowed: float | None = None,
    ) -> Row:
        allowed = self.tolerance if allowed is None else allowed
        worst = errors.worst
        relative = float(errors.relative[worst])
        per = errors.per_velocity
        joint = self.joint_of[int(np.argmax(per))] if per.size and per.max() > 0 else ""
        passed = relative <= allowed
        reason = ""
        if passed and relative > self.tolerance:
            reason = (
                f"{relative:.1e} at {joint} is above {self.tolerance:.0e}, and within the rounding of {engine}'s own "
                f"formula ({allowed:.0e}): its terms are {allowed / (_ROUNDINGS * _EPS):.0e} times the result"
            )
        if not passed:
            bad = [n for n, e in zip(self.joint_of, per, strict=False) if e > self.tolerance] if per.size else []
            named = ", ".join(dict.fromkeys(bad)) or "no single joint"
            reason = f"differs by {relative:.1e} at {named}" if per.size else f"differs by {relative:.1e}"
            if defect:
                reason += f"; {defect}"
        return Row(
            term=term,
            engine=engine,
            reference=self.reference,
            joint=joint,
            max_abs=float(errors.absolute.max()),
            relative=relative,
            per_joint=float(per.max()) if per.size else 0.0,
            median=float(np.median(errors.relative)),
            samples=len(errors.relative),
            worst_kind=self.at.kinds[worst],
            worst_q=tupled(self.at.q[worst]),
            worst_v=tupled(self.at.v[worst]),
            ns=ns[0],
            ns_spread=ns[1],
            passed=passed,
            reason=reason,
            allowed=allowed,
        )
