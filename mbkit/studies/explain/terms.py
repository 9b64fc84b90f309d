"""Differences between the terms of two descriptions or engines, and the smallest part that still differs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Final

import numpy as np

from mbkit._check import PRINTED, TINY, Array
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import (
    InputError,
    KnownDefectWarning,
    MbkitError,
    NonPhysicalWarning,
    NumericalError,
    UnsupportedError,
)
from mbkit.model import Model
from mbkit.model.changes.jumps import JumpLaw, JumpNumbers
from mbkit.model.description import CONSTRAINT_FEATURES
from mbkit.model.elements.forces import coordinate_arguments
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.elements.references import _OF_BODIES, _OF_JOINTS, names_in
from mbkit.model.model import unchecked
from mbkit.model.stops import StopLaw
from mbkit.studies.compare import terms
from mbkit.studies.compare.errors import Scales
from mbkit.studies.compare.terms import States
from mbkit.studies.explain.merged_model import OTHERS

#: Terms by name, each with its quantity and its measure of errors.
TERM: Final = {term.name: term for term in terms.TERMS}
#: Terms of each explanation.
TERMS: Final = ("M", "g", "nle", "passive")
#: The term of two whole systems, with their constraints and all forces.
WHOLE: Final = "accelerations"
Values = dict[str, Array]


@dataclass(frozen=True)
class Gap:
    """The largest difference of one term, scaled as in `mbkit.studies.compare.errors`, and the joint where it is.

    Infinite for NaN.
    """

    term: str
    relative: float
    joint: str


#: The gap of each term; empty where nothing can be compared, as the coordinates differ.
Gaps = tuple[Gap, ...]


def worst(gaps: Gaps) -> float:
    """Return the largest of all; infinite where nothing can be compared."""
    return max((g.relative for g in gaps), default=np.inf)


def effects(gaps: Gaps) -> dict[str, float]:
    """Return term -> difference; an infinite one of M where nothing can be compared."""
    return {g.term: g.relative for g in gaps} or {"M": np.inf}


def larger(*several: Gaps) -> Gaps:
    """Return every term once, with the largest of its gaps."""
    out: dict[str, Gap] = {}
    for gap in chain(*several):
        out[gap.term] = max(out.get(gap.term, gap), gap, key=lambda x: x.relative)
    return tuple(out.values())


def states_of(model: Model, samples: int, seed: int) -> States:
    """Return random states of a model."""
    # Terms are those of the tree.
    tree = _with_limits_that_can_be(model).without(*CONSTRAINT_FEATURES)
    q, v = tree.random_state(np.random.default_rng(seed), samples)
    return States(q, v, np.zeros_like(v), np.zeros_like(v), ("random",) * samples)


def _with_limits_that_can_be(model: Model) -> Model:
    """Return a description without its limits where an importer gave some with lower > upper."""
    fits = all(np.all(j.lower <= j.upper) for j in model.joints)
    return model if fits else model.without("limits")


def model_terms(model: Model, at: States) -> Values:
    """Return all terms of a description, by Pinocchio, or by the own derivation where that does not carry a part."""
    tree = model.without(*(f for f in CONSTRAINT_FEATURES if getattr(model, f)))
    with warnings.catch_warnings(action="ignore", category=NonPhysicalWarning):
        try:
            return evaluated(dynamics(tree), at)
        except UnsupportedError:
            return evaluated(LagrangianDynamics(tree, compile=False), at)


def evaluated(dyn: Dynamics, at: States) -> Values:
    """Return all terms that an engine can compute."""
    out: Values = {}
    with warnings.catch_warnings(action="ignore", category=KnownDefectWarning):
        for term in TERMS:
            with suppress(MbkitError):
                out[term] = TERM[term].call(dyn, at)
    return out


def gaps(a: Values, b: Values, at: States, model: Model) -> Gaps:
    """Return the differences of values at states of a model, scaled by those of `a`."""
    # An engine may refuse the state, or have another number of velocities.
    if "M" not in a or "M" not in b or a["M"].shape != b["M"].shape:
        return ()
    M, v = a["M"], at.v
    diagonal, nothing = np.einsum("nii->ni", M).copy(), np.zeros(len(M))
    inertial = np.linalg.norm(M, axis=(1, 2)) * np.sum(v * v, axis=1)
    scales = Scales(M, diagonal, inertial, nothing, np.zeros_like(diagonal), nothing, nothing)
    out = []
    for term in (t for t in a if t in b):
        measured = TERM[term].errors(b[term] - a[term], a[term], scales)
        per = measured.per_velocity
        joint = model.velocity_joints[int(np.argmax(per))] if per.size and per.max() > 0 else ""
        largest = float(measured.relative.max(initial=0.0))
        # A NaN would be lost in a maximum.
        out.append(Gap(term, np.inf if np.isnan(largest) else largest, joint))
    return tuple(out)


def jump_gap(a: Model, b: Model) -> Gaps:
    """Return the differences of stops, and of forces that jump at rest and about the Stribeck velocities.

    Random states miss both. Each velocity's force is relative to its own; a bound that one side alone has counts 1.
    """
    return (*_friction_gap(a, b), *_stop_gap(a, b))


def _stop_gap(a: Model, b: Model) -> Gaps:
    ours, theirs = map(StopLaw, (a, b))
    if not (ours or theirs):
        return ()
    with np.errstate(invalid="ignore"):
        apart = np.nan_to_num(np.minimum(np.abs(theirs.bounds - ours.bounds), 1.0))
    apart = np.maximum(apart, np.abs(theirs.restitution - ours.restitution)).max(axis=0)
    return (Gap(EFFECTS["stop"], float(apart.max()), a.velocity_joints[int(np.argmax(apart))]),)


def _friction_gap(a: Model, b: Model) -> Gaps:
    numbers = [JumpNumbers.of(x.joints) for x in (a, b)]
    if all((x.bound == x.sliding).all() for x in numbers):
        return ()
    speeds = np.unique(np.concatenate([x.stribeck for x in numbers]))[:, None] * np.ones(a.nv)
    ours, theirs = (np.vstack([law.bound, -law.force_at(speeds)]) for law in map(JumpLaw, (a, b)))
    size = np.maximum(ours, theirs).max(axis=0)
    apart = np.abs(ours - theirs).max(axis=0) / np.where(size > 0, size, 1.0)
    return (Gap(EFFECTS["jump"], float(apart.max()), a.velocity_joints[int(np.argmax(apart))]),)


def whole_gap(a: Model, b: Model, samples: int, seed: int) -> float:
    """Return the largest difference between the accelerations of two whole systems with the same coordinates.

    At random consistent states of either, under random forces, with constraints and all forces that the descriptions
    hold: M Δv̇ relative to the forces at play. Infinite where a state of one is none of the other, NaN where neither has
    a state in which it could move.
    """
    sides = [LagrangianDynamics(_with_limits_that_can_be(x), compile=False) for x in (a, b)]
    worst, rng = np.nan, np.random.default_rng(seed)
    for own, other in (sides, sides[::-1]):
        try:
            q, v = own.model.random_state(rng, samples)
        except (InputError, NumericalError):
            # It has no state in which it could move.
            continue
        try:
            for k in range(samples):
                tau = np.linalg.norm(own.gravity(q[k])) * rng.standard_normal(a.nv)
                M, first = own.mass_matrix(q[k]), own.forward_dynamics(q[k], v[k], tau)
                if other.model.constrained and not _consistent(other, q[k], v[k]):
                    return np.inf
                apart = M @ (other.forward_dynamics(q[k], v[k], tau) - first)
                size = np.abs(M) @ np.abs(first) + np.abs(own.nle(q[k], v[k])) + np.abs(tau)
                gap = float(np.abs(apart).max() / max(float(size.max()), TINY))
                worst = np.inf if np.isnan(gap) else float(np.fmax(worst, gap))
        except NumericalError:
            # A mass that moves nothing: the terms tell.
            continue
        except InputError:
            return np.inf
        if not (own.model.constrained or other.model.constrained):
            break
    return worst


def _consistent(dyn: Dynamics, q: Array, v: Array) -> bool:
    """Return whether a state keeps the constraints, to the digits that a description leaves of it."""
    J = np.maximum(np.abs(dyn.constraint_jacobian(q)).sum(axis=1), 1.0)
    for rows, x in ((dyn.constraint_residual(q), q), (dyn.constraint_rate(q, v), v)):
        if not (np.abs(rows) <= PRINTED * J[: len(rows)] * max(1.0, float(np.abs(x).max()))).all():
            return False
    return True


# Parts of a description.


def restricted(model: Model, joints: Collection[str]) -> Model:
    """Return the description with some joints alone and the bodies on them; mimic joints follow only these.

    A joint whose parent is left out is fixed in the world as it is on its parent.
    """
    kept = [j for j in model.joints if j.name in joints]
    kept = [j if j.mimic is None or j.mimic.joint in joints else replace(j, mimic=None) for j in kept]
    bodies = {j.child for j in kept}
    return fitting(
        model,
        joints=tuple(j if j.parent in bodies else replace(j, parent="world") for j in kept),
        bodies=tuple(b for b in model.bodies if b.name in bodies),
        nonphysical=tuple(x for x in model.nonphysical if x[0] in bodies),
    )


def fitting(model: Model, **fields: Any) -> Model:
    """Return a description with other joints and bodies, and with the parts alone whose bodies and motion it has.

    A coupling keeps the joints that move, the others standing at zero.
    """
    with unchecked():
        tree = replace(model, **fields)
    moving = {j.name for j in tree.joints if j.type.nv}
    here = {"world", *(b.name for b in tree.bodies)}
    here |= {f.name for f in tree.frames if f.body in here}
    lost = coordinate_arguments(model).keys() - coordinate_arguments(tree).keys()

    def fits(part: Any) -> bool:
        fits = names_in(part, _OF_BODIES) <= here and names_in(part, _OF_JOINTS) <= moving
        return fits and lost.isdisjoint(getattr(part, "arguments", ()))

    parts: dict[str, Any] = {kind: tuple(filter(fits, getattr(model, kind))) for kind in OTHERS}
    kept = ((c, [k for k, name in enumerate(c.joints) if name in moving]) for c in model.couplings)
    parts["couplings"] = tuple(
        replace(c, joints=tuple(c.joints[k] for k in some), factors=c.factors[some]) for c, some in kept if some
    )
    return replace(tree, **parts)


def minimal_differing_subtree(model: Model, differs: Callable[[set[str]], bool]) -> tuple[str, ...]:
    """Return the joints of the smallest part of a merged model that differs between the two sides.

    None of them can be left out. Empty where only the whole differs.
    """
    below = {j.name: {n for n, chain in model.chains.items() if j.name in chain} for j in reversed(model.tree)}
    left = next((joints for joints in sorted(below.values(), key=len) if differs(joints)), set[str]())
    for joint in reversed(model.tree):
        # A branch that does not matter goes; the joints above it stay.
        without = left - below[joint.name]
        if joint.name in left and without and differs(without):
            left = without
    return tuple(j.name for j in model.joints if j.name in left)
