"""The terms of the equation of motion that are compared, and how each is called.

Rows of a comparison: terms, rollouts, findings and omissions, as plain data.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Final

import numpy as np

from mbkit._check import DOUBLE_BITS, Array
from mbkit.engines import Dynamics
from mbkit.engines.frames_and_momenta import LOCAL
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import UnsupportedError
from mbkit.model import Model
from mbkit.model.manifold import limits_box
from mbkit.model.quantities import QUANTITIES
from mbkit.model.stops import StopLaw
from mbkit.studies.compare.errors import (
    Errors,
    Scales,
    acceleration_errors,
    constraint_force_errors,
    digits_of,
    energy_errors,
    force_errors,
    matrix_errors,
    ratio,
    row_errors,
)

# An angle this far from gimbal lock loses four digits in anything that divides
# by its cosine; none of the terms should.
_NEAR_SINGULAR_RADIANS: float = 1e-4
_AT_REST: Final = "at rest"


@dataclass(frozen=True)
class States:
    """States with accelerations and torques, (N, n) arrays, and the kind of each."""

    q: Array
    v: Array
    a: Array
    tau: Array
    kinds: tuple[str, ...]


def states(model: Model, samples: int, seed: int) -> States:
    """Return `samples` random states; without constraints also neutral, at-limit and near-singular ones.

    Near singular: every angle 1e-4 from a multiple of a right angle, which is near gimbal lock and stretched arms. With
    forces that jump, also states in which every other velocity is at rest, or all are; with stops, at rest on these.
    """
    rng = np.random.default_rng(seed)
    q, v = model.random_state(rng, samples)
    parts, stops = [("random", q)], StopLaw(model)
    few = max(2, samples // 16)
    if not model.constrained:
        parts.append(("neutral", np.tile(model.neutral(), (2, 1))))
        parts.append(("at limits", _at_limits(model, rng, few)))
        parts.append(("near singular", _near_singular(model, rng, few)))
        if "jump" in model.effects:
            at = model.random_state(rng, 4 * few if stops else few)[0]
            parts.append((_AT_REST, stops.onto(at, np.ones((len(at), model.nv), dtype=bool))))
    q = np.concatenate([x for _, x in parts])
    v = np.concatenate([v, rng.standard_normal((len(q) - samples, model.nv))])
    a, tau = rng.standard_normal((2, len(q), model.nv))
    kinds = tuple(kind for kind, x in parts for _ in x)
    resting = [k for k, kind in enumerate(kinds) if kind == _AT_REST]
    v[resting[:1]], v[resting[1:], ::2], v[np.ix_(np.array(resting, dtype=int), stops.which)] = 0.0, 0.0, 0.0
    return States(q, v, a, tau, kinds)


def _at_limits(model: Model, rng: np.random.Generator, n: int) -> Array:
    q, _ = model.random_state(rng, n)
    lower, upper = limits_box(model)
    for i in range(model.nq):
        if np.isfinite(lower[i]):
            q[:, i] = np.where(rng.random(n) < 0.5, lower[i], upper[i])
    return q


def _near_singular(model: Model, rng: np.random.Generator, n: int) -> Array:
    q, _ = model.random_state(rng, n)
    for joint in model.independent_joints:
        start = model.layout.q[joint.name].start
        for i in joint.type.angular:
            turns = rng.integers(-1, 3, n)
            if i == joint.type.gimbal:
                turns = 2 * rng.integers(0, 2, n) - 1
            q[:, start + i] = turns * np.pi / 2 + rng.choice([-_NEAR_SINGULAR_RADIANS, _NEAR_SINGULAR_RADIANS], n)
    return q


@dataclass(frozen=True)
class Term:
    """One compared quantity, a method of `Dynamics`.

    `more` returns the arguments behind the arrays that it takes, such as a frame of the model.
    """

    name: str
    quantity: str
    errors: Callable[[Array, Array, Any], Errors]
    more: Callable[[Model], tuple[Any, ...]] = lambda _: ()

    def call(self, dyn: Dynamics, states: States) -> Array:
        """Return the values at all states."""
        value = getattr(dyn, self.quantity)(*self._given(dyn, states))
        # Derivatives come as a tuple of matrices.
        return np.stack(value, axis=-3) if isinstance(value, tuple) else np.asarray(value)

    def reference(self, oracle: OracleDynamics, states: States) -> tuple[Array, Array]:
        """Return the oracle's values at all states, high and low part."""
        return oracle.extended(self.quantity, *self._given(oracle, states))

    def _given(self, dyn: Dynamics, states: States) -> list[Any]:
        arrays = (x for x in QUANTITIES[self.quantity].arguments if x != "wrenches")
        return [*(getattr(states, x) for x in arrays), *self.more(dyn.model)]

    def single(self, dyn: Dynamics, states: States) -> Callable[[], Any]:
        """Return a call at one random state, for timing."""
        method = getattr(dyn, self.quantity)
        q, v, a, tau = (np.ascontiguousarray(x[0]) for x in (states.q, states.v, states.a, states.tau))
        arguments = self._given(dyn, States(q, v, a, tau, states.kinds))
        return lambda: method(*arguments)


class LoadsUnderForce(Term):
    """Loads in the joints of a mechanism, which follow from the force τ and its motion."""

    def _given(self, dyn: Dynamics, states: States) -> list[Any]:  # noqa: ARG002  # as for the others
        # No accelerations, wrenches, axes or joints are given.
        return [states.q, states.v, None, None, LOCAL, None, states.tau]


_HEAVY: Final = partial(force_errors, heavy=True)

TERMS: Final = (
    Term("M", "mass_matrix", matrix_errors),
    Term("g", "gravity", _HEAVY),
    Term("nle", "nle", _HEAVY),
    Term("C v", "coriolis_force", force_errors),
    Term("passive", "passive", force_errors),
    Term("inverse dynamics", "inverse_dynamics", _HEAVY),
    Term("forward dynamics", "forward_dynamics", acceleration_errors),
    Term("kinetic energy", "kinetic_energy", energy_errors),
    Term("potential energy", "potential_energy", energy_errors),
)

FORWARD_DYNAMICS: Final = "forward_dynamics"
JOINT_LOADS: Final = "joint_wrenches"
#: Quantities that depend on how an engine holds constraints.
OF_CONSTRAINED_MOTION: Final = (FORWARD_DYNAMICS, JOINT_LOADS, "generalized_constraint_force")
#: Terms of models with constraints. Jᵀ λ is unique where λ is not.
CONSTRAINT_TERMS: Final = (
    Term("f", "constraint_residual", row_errors),
    Term("J", "constraint_jacobian", row_errors),
    Term("J̇ v rows", "constraint_bias", partial(row_errors, moving=True)),
    Term("Jᵀ λ", "generalized_constraint_force", constraint_force_errors),
)


#: The name of the power balance, which is no quantity of an engine.
POWER: Final = "power balance"


def power_errors(dyn: Dynamics, oracle: OracleDynamics, at: States, scales: Scales) -> Errors:
    """Return the errors of the power balance, dE/dt = (τ + τ_damping + Jᵀ λ) · v, with the engine's own acceleration.

    The rate of energy is differentiated exactly from T and V by the oracle; acceleration and damping are the engine's.
    So it fails if either the engine's dynamics or the energies are wrong, whatever two engines agree on. Energies of
    which T + V is not what forces change, by parts without velocities or by the time, are refused.
    """
    model = dyn.model
    if not model.has_bodies:
        T, M = oracle.kinetic_energy(at.q, at.v), oracle.mass_matrix(at.q)
        rest = np.abs(T - 0.5 * np.einsum("ki,kij,kj->k", at.v, M, at.v))
        if model.needs.time or (rest > 1e-12 * (np.abs(T) + scales.inertial)).any():
            raise UnsupportedError(f"{model.name}: its energies depend on the time, or T has parts that are not of v²")
    a = dyn.forward_dynamics(at.q, at.v, at.tau)
    still = np.zeros_like(at.v)
    # Forces without a potential do work at rest too; springs written as energies are in V.
    damping = dyn.passive(at.q, at.v) - dyn.passive(at.q, still)
    damping = damping + (dyn._lost_force(at.q, still) if model.has_bodies else dyn.passive(at.q, still))
    damping = damping + dyn._jumps_beside_passive(at.q, at.v, at.tau)
    inertial, rate = oracle.inverse_dynamics(at.q, at.v, a), oracle.energy_rate(at.q, at.v, a)
    # Drives do work, and so do constraints that give way.
    held = dyn.generalized_constraint_force(at.q, at.v, at.tau) if model.constrained else np.zeros_like(at.v)
    e = np.abs(rate - np.sum((at.tau + damping + held) * at.v, axis=1))
    # M a is as large as M's norm lets it be, and that is where it is rounded.
    root = np.sqrt(scales.diagonal)
    speed, size = np.linalg.norm(root * at.v, axis=1), np.linalg.norm(root * a, axis=1)
    pushes = sum(np.linalg.norm(x, axis=1) for x in (inertial, at.tau, damping, held))
    scale = speed * size + np.linalg.norm(at.v, axis=1) * pushes + scales.inertial
    return Errors(e, ratio(e, scale), np.empty(0))


#: The reference of terms of an engine whose constraints are soft.
OWN_LAW: Final = "own law"
#: Kinds of findings.
ACTUATORS: Final = "actuators"
LIMITS: Final = "limits"
STIFF: Final = "stiff joint"


@dataclass(frozen=True)
class Row:
    """One term of one engine against the reference, worst over all samples.

    `reference` is ``"oracle"``, an engine where the oracle has no value, or ``"own law"`` where an engine's constraints
    are soft. `max_abs` is the largest absolute difference of any entry, in the term's own unit; `relative` the worst
    normwise error of a sample, and `median` the median, see `mbkit.studies.compare.errors`; `per_joint` the worst error
    of a joint relative to its own scale, and `joint` that joint, empty for energies. `worst_kind` (random, neutral, at
    limits, near singular), `worst_q` and `worst_v` are the state of the worst sample. `ns` is the median of nanoseconds
    per evaluation of a single state, `ns_spread` half their interquartile range. `reason` says why the row failed,
    naming joints and a known defect where there is one; or why more than the comparison's tolerance was allowed.
    `allowed` is the error that passes: that tolerance, or more where the engine's own formula cannot do better.
    `defect` is the engine's known defect, where the row failed with one announced. `zero` says whether the reference is
    zero in every entry at every state, so that the row is no evidence. `bits` are those of the significand with which
    the engine computes: 53, or 24 in single precision, where `allowed` is what that precision costs the term.
    """

    term: str
    engine: str
    reference: str
    joint: str
    max_abs: float
    relative: float
    per_joint: float
    median: float
    samples: int
    worst_kind: str
    worst_q: tuple[float, ...]
    worst_v: tuple[float, ...]
    ns: float
    ns_spread: float
    passed: bool
    reason: str = ""
    allowed: float = math.nan
    defect: str = ""
    zero: bool = False
    bits: int = DOUBLE_BITS

    @property
    def digits(self) -> str:
        """Digits of a row of an engine in another precision than double, as in ``6.4 of 7.2 digits``."""
        return f"{-math.log10(max(self.relative, 1e-16)):.1f} of {digits_of(self.bits):.1f} digits"


@dataclass(frozen=True)
class RolloutRow:
    """A trajectory of mbkit's integrator on one engine against MuJoCo's own, by the same formula.

    `dt` is the step, `duration` the compared horizon and `asked` the wanted one, s. `error` is the largest difference
    of q over the horizon, on the manifold. `condition` says how far q moves per relative disturbance of the forces,
    see `mbkit.studies.compare.beyond_terms`; `tolerance` is 1e-12, or a multiple of eps times the condition if that
    is more, as where an engine's formula for M loses digits. `off` is MuJoCo where the other engines' runs all differ
    from its own and not from each other: then its own is the one that is off. `seconds` and `seconds_against` are the
    run times of the two. `judged` is False where too few steps are well conditioned to say anything, and of a row for
    information, whose tolerance is infinite; `passed` is None there.
    """

    method: str
    engine: str
    against: str
    dt: float
    duration: float
    error: float
    condition: float
    tolerance: float
    steps: int
    seconds: float
    seconds_against: float
    passed: bool | None
    note: str = ""
    judged: bool = True
    asked: float = math.nan
    off: str = ""

    @property
    def cut(self) -> bool:
        """Whether the compared horizon is shorter than the one wanted."""
        return self.duration < self.asked * (1 - 1e-9)

    @property
    def informs(self) -> bool:
        """Whether the row is for information, since it compares another formula and cannot fail."""
        return math.isinf(self.tolerance)


@dataclass(frozen=True)
class Finding:
    """What the description has that bears on runs: what no engine uses, forces that jump, joints for other methods.

    `kind` is ``"actuators"``, ``"left out of the motion"``, ``"dry friction"``, ``"limits"`` or ``"stiff joint"``;
    `says` tells it in words, and `joints` has its joints. `mbkit check` adds ``"the file itself"``, with the links and
    joints that `mbkit.lint` names.
    `size` of dry friction is its ratio to the other forces at that joint and the median state, the largest of all
    joints; of a stiff joint its time constant, s; of the file the number of findings; of limits NaN.
    """

    kind: str
    says: str
    joints: tuple[str, ...]
    size: float = math.nan


@dataclass(frozen=True)
class Omission:
    """One thing that was left out, need by need.

    `present` says whether the description has it, and `what` what was off. `saved_ns` are the nanoseconds saved per
    evaluation, the difference of two medians, NaN where nothing was timed; `saved_spread` is half the interquartile
    range of that difference; `saved_setup` are the seconds of set-up saved, NaN where none. `change` is the largest
    relative change of the accelerations with the thing on, and `unchanged` says whether it is within rounding. What
    the description has and no engine uses may change them; what it has not may not, so that is a `fault`.
    """

    need: str
    present: bool
    what: str
    saved_ns: float
    saved_spread: float
    saved_setup: float
    change: float
    unchanged: bool
    note: str = ""

    _derived: ClassVar = ("measurable", "fault")

    @property
    def fault(self) -> bool:
        """Whether leaving out what the description has not changes the accelerations."""
        return not self.unchanged and not self.present

    @property
    def measurable(self) -> bool:
        """Whether the time saved stands out from the spread of the timings, by twice that."""
        return abs(self.saved_ns) > 2 * self.saved_spread


def by_term(rows: Iterable[Row]) -> dict[str, dict[str, Row]]:
    """Return rows by term and engine, terms in their order."""
    out: dict[str, dict[str, Row]] = {}
    for row in rows:
        out.setdefault(row.term, {})[row.engine] = row
    return out
