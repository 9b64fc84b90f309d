"""`compare`: the terms of the equation of motion from several engines, judged.

What the precision of an engine's numbers costs each term: the tolerance for an engine that is not double.

A term can be no better than the numbers that it is made of. So its tolerance is a few times what happens to it when the
description and the state are rounded to the engine's precision, evaluated in double precision: eps times the term's own
condition (Higham 2002, Accuracy and Stability of Numerical Algorithms, ch. 1.6), measured. Lengths are rounded by the
distance from the world's origin, since engines hold places in the world, and rotations by eps.
"""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Final

import numpy as np

from mbkit import spatial
from mbkit._check import DOUBLE_BITS, EPS, Array, count, real
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.engines.registry import DERIVED, STANDARD, find_engine
from mbkit.errors import KnownDefectWarning, MbkitError, NumericalError, UnsupportedError
from mbkit.model import Model
from mbkit.model.elements.kinds import EFFECTS
from mbkit.studies import results
from mbkit.studies._targets import engine_names, with_values
from mbkit.studies.compare.beyond_terms import findings, omissions, reached_limits, rollouts
from mbkit.studies.compare.body_terms import BODY_TERMS, MECHANISM_TERMS, BodyScales
from mbkit.studies.compare.errors import (
    ROUNDINGS,
    Errors,
    Scales,
    condition_under_constraints,
    epsilon,
    interleaved,
)
from mbkit.studies.compare.result import Comparison
from mbkit.studies.compare.terms import (
    CONSTRAINT_TERMS,
    FORWARD_DYNAMICS,
    JOINT_LOADS,
    LIMITS,
    OF_CONSTRAINED_MOTION,
    OWN_LAW,
    POWER,
    TERMS,
    Row,
    States,
    Term,
    power_errors,
    states,
)
from mbkit.studies.results import Refusal, model_info
from mbkit.studies.study_runs import Progress, integrable, require_motion, silent
from mbkit.studies.work_precision.study import work_precision

_SEEDS: Final = (0, 1)
#: An engine rounds on the way too: its error was at most 5.4 times that of the rounded numbers, over the terms of 66
#: robots in Newton (validation/trained_engines.json).
_ERROR_PER_ROUNDING: Final = 8.0


class Precision:
    """Tolerances of terms in a precision lower than double.

    Parameters
    ----------
    model : Model
    at : States
    bits : int
        Of the significand.
    scales : Scales
    oracle : OracleDynamics
    """

    def __init__(self, model: Model, at: States, bits: int, scales: Scales, oracle: OracleDynamics) -> None:
        self._model, self._at, self._scales, self._oracle = model, at, scales, oracle
        self.bits, self._eps = bits, epsilon(bits)

    def allowed(self, term: Term | str) -> float:
        """Return the largest error that passes: of a term, or of the power balance by its name."""
        own = [self._error(term, *rounded) for rounded in self._rounded]
        return _ERROR_PER_ROUNDING * max(self._eps, *own)

    def _error(self, term: Term | str, dyn: Dynamics, at: States) -> float:
        try:
            if isinstance(term, str):
                errors = power_errors(dyn, self._oracle, self._at, self._scales)
            else:
                exact = term.call(self._exact, self._at)
                errors = term.errors(term.call(dyn, at) - exact, exact, self._scales)
        except MbkitError:
            # A term that has no value here has no condition either.
            return 0.0
        return float(errors.relative.max())

    @cached_property
    def _exact(self) -> Dynamics:
        return _derived(self._model)

    @cached_property
    def _rounded(self) -> list[tuple[Dynamics, States]]:
        """Return the description and the states with other last digits, several times."""
        model, at, eps = self._model, self._at, self._eps
        places = self._exact.body_poses(at.q)[..., :3, 3] if model.has_bodies else np.zeros((1, 3))
        reach = float(np.abs(places).max(initial=0.0))
        out = []
        for seed in _SEEDS:
            rng = np.random.default_rng(seed)

            def noise(shape: tuple[int, ...], rng: np.random.Generator = rng) -> Array:
                return eps * rng.uniform(-1.0, 1.0, shape)

            v, a, tau = (np.asarray(x) * (1.0 + noise(np.shape(x))) for x in (at.v, at.a, at.tau))
            q = model.integrate(at.q, noise(at.v.shape))
            states = States(q, v, a, tau, at.kinds)
            bodies = tuple(
                replace(
                    b,
                    mass=b.mass * (1.0 + float(noise(()))),
                    com=b.com + reach * noise((3,)),
                    inertia=b.inertia * (1.0 + float(noise(()))),
                )
                for b in model.bodies
            )
            joints = tuple(
                replace(
                    j,
                    translation=j.translation + reach * noise((3,)),
                    rotation=j.rotation @ spatial.matrix_from_quaternion(spatial.exp_quaternion(noise((3,)))),
                )
                for j in model.joints
            )
            out.append((_derived(replace(model, bodies=bodies, joints=joints)), states))
        return out


def _derived(model: Model) -> Dynamics:
    return dynamics(model, DERIVED, **find_engine(DERIVED).brief)


#: Where a warning of a known defect goes on with the joints of this model.
_AS_IT_IS: Final = "; returned as it is"


@dataclass(eq=False)
class Judge:
    """Evaluates every term in every engine against the oracle, or the first engine where it has no value."""

    model: Model
    engines: Mapping[str, Dynamics]
    oracle: OracleDynamics
    at: States
    tolerance: float
    #: Defects that engines announced when they were built.
    defects: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        model, oracle, at = self.model, self.oracle, self.at
        self.refusals: list[Refusal] = []
        #: Digits of the exact acceleration that each engine with soft constraints keeps, at the median state.
        self.softness: dict[str, float] = {}
        #: Gravity, velocity and passive forces at all states, as sums of their sizes.
        self.forces = np.zeros_like(at.tau)
        for quantity in (oracle.nle, oracle.passive):
            # Where a term has no value, its own row says so.
            with contextlib.suppress(NumericalError):
                self.forces = self.forces + np.abs(quantity(at.q, at.v))
        acting = np.abs(at.tau) + self.forces
        # Its size is told beside the other forces.
        self.forces = self.forces - np.abs(oracle._jumps.law.force(at.v))
        gravity = float(np.linalg.norm(model.gravity))
        heavy = gravity * float(np.sqrt(model.mass)) if gravity else 0.0
        self.scales: Scales = Scales.of(oracle.mass_matrix(at.q), at.v, acting, heavy)
        J = oracle.constraint_jacobian(at.q) if model.constrained else None
        if J is not None:
            self.scales = replace(self.scales, constrained=condition_under_constraints(self.scales.M, J))
        self.findings = findings(model, self.forces, self.scales.M, J)
        self.terms: tuple[Term, ...] = TERMS + (CONSTRAINT_TERMS if model.constrained else ())
        if model.has_bodies and model.mass:
            self.terms += MECHANISM_TERMS if model.constrained else BODY_TERMS
            self.scales = BodyScales.around(self.scales, oracle, at)
        self.joint_of = model.velocity_joints
        #: Tolerances of engines that are not double, by their bits.
        self._lower = {
            dyn._significand_bits: Precision(model, at, dyn._significand_bits, self.scales, oracle)
            for dyn in self.engines.values()
            if dyn._significand_bits < DOUBLE_BITS
        }

    def rows(self, tell: Progress) -> tuple[list[Row], list[Refusal]]:
        """Return a row per term and engine."""
        rows: list[Row] = []
        for k, term in enumerate(self.terms):
            tell(k / (len(self.terms) + 1), term.name)
            rows += self._term(term)
        tell(len(self.terms) / (len(self.terms) + 1), POWER)

        for name, dyn in self.engines.items():
            try:
                errors = power_errors(dyn, self.oracle, self.at, self.scales)
            except MbkitError as error:
                self._refuse(name, POWER, error)
            else:
                lower = self._lower.get(self.engines[name]._significand_bits)
                allowed = lower.allowed(POWER) if lower else None
                rows.append(self._row(POWER, name, errors, self.defects.get(name, ""), allowed))
        return rows, self.refusals

    def _term(self, term: Term) -> list[Row]:
        values: dict[str, Array] = {}
        defects: dict[str, str] = {}
        broken: dict[str, str] = {}
        for name, dyn in self.engines.items():
            with warnings.catch_warnings(record=True, action="always") as caught:
                try:
                    values[name] = term.call(dyn, self.at)
                except NumericalError as error:
                    broken[name] = str(error).removeprefix(f"{name}: ")
                except MbkitError as error:
                    self._refuse(name, term.name, error)
            defects[name] = announced(caught) or self.defects.get(name, "")
        if not values and not broken:
            return []
        if broken and not values:
            # All alike: the model, not an engine. Named, and not counted as agreement.
            self.refusals += [Refusal(name, term.name, why) for name, why in broken.items()]
            return []
        with warnings.catch_warnings(action="ignore", category=KnownDefectWarning):
            times = interleaved({name: term.single(self.engines[name], self.at) for name in values})
        reference, high, low = self._reference(term, values)
        worst, nowhere, untimed = (np.inf,) * 4, ("", (), ()), (np.nan, np.nan)
        rows = [
            Row(term.name, name, reference, "", *worst, len(self.at.q), *nowhere, *untimed, False, why, self.tolerance)
            for name, why in broken.items()
        ]
        for name, value in values.items():
            against, exact, rest = reference, high, low
            dyn = self.engines[name]
            soft = dyn._soft_jumps or (self.model.constrained and dyn._soft_constraints)
            if soft and term.quantity in (OF_CONSTRAINED_MOTION if self.model.constrained else (FORWARD_DYNAMICS,)):
                against, exact, rest = OWN_LAW, self._own_law(term, name), np.zeros_like(value)
            errors = term.errors((value - exact) - rest, exact, self.scales)
            row = self._row(term.name, name, errors, defects[name], self._allowed(term, name, errors))
            ns, spread = times[name]
            rows.append(replace(row, reference=against, ns=ns, ns_spread=spread, zero=not exact.any()))
        return rows

    def _own_law(self, term: Term, name: str) -> Array:
        """Return what the written law of an engine with soft constraints says of a term at all states."""
        dyn: Any = self.engines[name]
        # Wrenches act as their generalized force.
        pushed = [dyn.generalized_force(self.at.q, *more)] if (more := term.more(self.model)) else []
        laws = [
            dyn.constraint_law(*state) for state in zip(self.at.q, self.at.v, sum(pushed, self.at.tau), strict=True)
        ]
        self.softness[name] = float(np.median([law.digits for law in laws]))
        accelerations = np.array([law.acceleration for law in laws])
        if term.quantity == FORWARD_DYNAMICS:
            return accelerations
        if term.quantity == JOINT_LOADS:
            return self.oracle.joint_wrenches(self.at.q, self.at.v, accelerations, tau=self.at.tau)
        return np.array([law.jacobian.T @ law.force for law in laws])

    def _reference(self, term: Term, values: dict[str, Array]) -> tuple[str, Array, Array]:
        """Return the engine of the reference values, and their high and low part."""
        try:
            return self.oracle.engine, *term.reference(self.oracle, self.at)
        except NumericalError as error:
            self._refuse(self.oracle.engine, term.name, error)
        name = next(iter(values))
        return name, values[name], np.zeros_like(values[name])

    def _refuse(self, engine: str, term: str, error: MbkitError) -> None:
        self.refusals.append(Refusal.of(engine, error, term))

    def _allowed(self, term: Term, engine: str, errors: Errors) -> float:
        """Return the tolerance, or the engine's own bound where its formula cannot do better."""
        dyn, allowed = self.engines[engine], self.tolerance
        if lower := self._lower.get(dyn._significand_bits):
            allowed = max(allowed, lower.allowed(term))
        # Accelerations are M's solution: they cannot be better than M.
        of_mass = term.quantity in ("mass_matrix", "mass_matrix_inverse", "forward_dynamics")
        if not of_mass or errors.relative.max() <= allowed:
            return allowed
        amplified = dyn._mass_matrix_rounding(self.at.q[errors.worst], term.quantity)
        return max(allowed, ROUNDINGS * epsilon(dyn._significand_bits) * amplified)

    def _row(self, term: str, engine: str, errors: Errors, defect: str, allowed: float | None = None) -> Row:
        """Return a row against the oracle, not timed."""
        allowed = self.tolerance if allowed is None else allowed
        worst, per = errors.worst, errors.per_velocity
        relative = float(errors.relative[worst])
        joint = self.joint_of[int(np.argmax(per))] if per.size and per.max() > 0 else ""
        passed = relative <= allowed
        reason = ""
        if not passed:
            bad = [n for n, e in zip(self.joint_of, per, strict=False) if e > self.tolerance]
            named = f" at {', '.join(dict.fromkeys(bad)) or 'no single joint'}" if per.size else ""
            reason = f"differs by {relative:.1e}{named}" + (f"; {defect}" if defect else "")
        elif relative > self.tolerance and self.engines[engine]._significand_bits == DOUBLE_BITS:
            reason = (
                f"{relative:.1e} at {joint} is above {self.tolerance:.0e}, and within the rounding of {engine}'s own "
                f"formula ({allowed:.0e}): its terms are {allowed / (ROUNDINGS * EPS):.0e} times the result"
            )
        return Row(
            term=term,
            engine=engine,
            reference=self.oracle.engine,
            joint=joint,
            max_abs=float(errors.absolute.max()),
            relative=relative,
            per_joint=float(per.max()) if per.size else 0.0,
            median=float(np.median(errors.relative)),
            samples=len(errors.relative),
            worst_kind=self.at.kinds[worst],
            worst_q=tuple(self.at.q[worst].tolist()),
            worst_v=tuple(self.at.v[worst].tolist()),
            ns=np.nan,
            ns_spread=np.nan,
            passed=passed,
            reason=reason,
            allowed=allowed,
            bits=self.engines[engine]._significand_bits,
            defect="" if passed else defect.split(_AS_IT_IS)[0],
        )


def announced(caught: Iterable[warnings.WarningMessage]) -> str:
    """Return the known defects among recorded warnings, in words."""
    return "; ".join(dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, KnownDefectWarning)))


#: Limits of the `work_precision` in a comparison: a short horizon, few timings, runs of little work.
_MAX_EVALUATIONS: Final = 6_000
_MAX_SECONDS: Final = 60.0


def compare(
    model: Model,
    engines: Sequence[str] = STANDARD,
    samples: int = 64,
    seed: int = 0,
    *,
    tolerance: float = 1e-12,
    terms_only: bool = False,
    progress: Progress | None = None,
    checkpoint: Callable[[Comparison], object] | None = None,
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
        Largest error that passes, measured as `mbkit.studies.compare.errors` says.
    terms_only : bool
        Whether to leave out rollouts, error against run time and omissions.
    progress : callable, optional
        Called as ``progress(fraction, text)``.
    checkpoint : callable, optional
        Receives the comparison of the terms, before what follows them.

    Raises
    ------
    InputError, UnknownNameError
        For unusable arguments. What an engine cannot do is a row of `refusals`.
    """
    begun = time.perf_counter()
    model = require_motion(model, "compare")
    names = engine_names(engines, least=2)
    count("samples", samples, least=1)
    count("seed", seed)
    real("tolerance", tolerance, positive=True)
    model = with_values(model)
    tell = progress or silent
    built, refusals, setup, defects = _build(model, names, tell, compile=not terms_only)
    reference = ""
    rows: list[Row] = []
    result: dict[str, Any] = {}
    # A system written as energies has the derivation and its 34 digits, and no other engine.
    enough = len(built) > 1 or (bool(built) and not model.has_bodies)
    if enough:
        tell(0.05, "34 digits")
        reference = OracleDynamics.engine
        study = Judge(model, built, OracleDynamics(model), states(model, samples, seed), tolerance, defects)
        rows, refused = study.rows(lambda f, text: tell(0.05 + f * (0.85 if terms_only else 0.35), text))
        refusals += refused
        result |= {"softness": study.softness, "findings": study.findings}
    out = Comparison(
        model=model.name,
        facts=model_info(model),
        engines=tuple(built),
        reference=reference,
        samples=samples,
        seed=seed,
        tolerance=tolerance,
        rows=tuple(rows),
        refusals=tuple(refusals),
        setup=setup,
        **results.provenance(begun),
        **result,
    )
    # Without mass nothing can be simulated.
    massless = any(r.term == "M" and r.zero for r in rows)
    if enough and not terms_only and not massless:
        if checkpoint is not None:
            checkpoint(out)
        beyond, refused = _beyond_terms(model, built, seed, tell)
        seconds = time.perf_counter() - begun
        reached = beyond.pop("limits", "")
        told = tuple(replace(x, says=x.says + reached) if x.kind == LIMITS else x for x in out.findings)
        out = replace(out, refusals=(*out.refusals, *refused), seconds=seconds, findings=told, **beyond)
    tell(1.0, "done")
    return out


def _beyond_terms(
    model: Model, engines: dict[str, Dynamics], seed: int, tell: Progress
) -> tuple[dict[str, Any], list[Refusal]]:
    """Return rollouts, run times and omissions; what fails is a refusal, and loses nothing else."""
    (moving, notes), movers = integrable(model), engines
    if notes:
        movers, _, _, _ = _build(moving, tuple(engines), silent, compile=True)
    methods = {engine: shown for engine in movers if (shown := find_engine(engine).shown)}
    settings: dict[str, Any] = {
        "duration": 0.5,
        "repeats": 3,
        "seconds": _MAX_SECONDS,
        "work": _MAX_EVALUATIONS,
    }
    settings["progress"] = lambda fraction, text: tell(0.6 + 0.3 * fraction, text)
    by_time = partial(work_precision, moving, tuple(movers), methods, seed=seed, **settings)
    studies: list[tuple[float, str, str, Callable[[], Any]]] = [
        (0.42, "rollouts", "rollouts", partial(rollouts, moving, movers, seed, "; ".join(notes))),
        (0.6, "precision", "error against run time", by_time),
    ]
    if "joint.limit" in moving.acts:
        studies.append((0.5, "limits", "motions to limits", partial(reached_limits, moving, movers, seed)))
    if model.has_bodies:
        studies.append((0.9, "omissions", "what was left out", partial(omissions, model, engines, seed)))
    result: dict[str, Any] = {}
    refusals: list[Refusal] = []
    for fraction, part, name, call in studies:
        tell(fraction, name)
        try:
            result[part] = call()
        except MbkitError as error:
            refusals.append(Refusal("", name, str(error)))
    return result, refusals


def _build(
    model: Model,
    names: Sequence[str],
    tell: Progress,
    *,
    compile: bool,  # noqa: A002  # the engine's own word
) -> tuple[dict[str, Dynamics], list[Refusal], dict[str, float], dict[str, str]]:
    """Return the engines, refusals of the model, build times, and the known defects announced."""
    engines, refusals, setup, defects = {}, [], {}, {}
    for k, name in enumerate(names):
        tell(0.05 * k / len(names), f"building {name}")
        start = time.perf_counter()
        with warnings.catch_warnings(record=True, action="always", category=KnownDefectWarning) as caught:
            try:
                # A few dozen states are no reason to compile; run times are.
                options = {} if compile else find_engine(name).brief
                own = find_engine(name).load()._soft_jump_options if model.needs.friction else {}
                try:
                    engines[name] = dynamics(model, name, **options, **own)
                except UnsupportedError as error:
                    if not own:
                        raise
                    # The exact law stands in.
                    engines[name] = dynamics(model, name, **options)
                    refusals.append(Refusal.of(name, error, f"{EFFECTS['jump']} as {name} holds it"))
            except MbkitError as error:
                refusals.append(Refusal.of(name, error))
        setup[name] = time.perf_counter() - start
        defects[name] = announced(caught)
        for w in caught:
            if not issubclass(w.category, KnownDefectWarning):
                warnings.warn_explicit(w.message, w.category, w.filename, w.lineno)
    return engines, refusals, setup, defects
