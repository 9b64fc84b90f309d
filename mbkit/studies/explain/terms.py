"""How far the terms of two descriptions or engines are apart, joint by joint."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics, dynamics
from mbkit.errors import KnownDefectWarning, MbkitError, NonPhysicalWarning
from mbkit.model import Joint, Model
from mbkit.studies.compare.errors import Scales, force_errors, matrix_errors

__all__ = ["TERMS", "Gap", "Gaps", "States", "evaluated", "gaps", "model_terms", "part", "smallest", "states_of"]


#: What is compared: name in tables, quantity, arguments.
TERMS: Final = (
    ("M", "mass_matrix", "q"),
    ("g", "gravity", "q"),
    ("nle", "nle", "qv"),
    ("passive", "passive", "qv"),
)
Values = dict[str, Array]


@dataclass(frozen=True)
class States:
    """States at which terms are compared: (N, nq) and (N, nv)."""

    q: Array
    v: Array


@dataclass(frozen=True)
class Gap:
    """The largest difference of one term.

    Attributes
    ----------
    term : str
    relative : float
        Measured as `mbkit.studies.compare.errors` says; infinite where one side has no value.
    joint : str
        Where it is largest.
    """

    term: str
    relative: float
    joint: str


@dataclass(frozen=True)
class Gaps:
    """The largest difference of each term; `comparable` is False where the coordinates are not the same."""

    terms: tuple[Gap, ...]
    comparable: bool = True

    @property
    def worst(self) -> float:
        """The largest of all; infinite where nothing can be compared."""
        return max((g.relative for g in self.terms), default=0.0) if self.comparable else np.inf

    @property
    def joint(self) -> str:
        """Where the largest is."""
        return max(self.terms, key=lambda g: g.relative).joint if self.terms else ""


def states_of(model: Model, samples: int, seed: int) -> States:
    """Return random states of a model."""
    # An importer may hold limits in which nothing fits.
    fits = all(np.all(j.lower <= j.upper) for j in model.joints)
    return States(*(model if fits else model.without("limits")).random_state(np.random.default_rng(seed), samples))


def model_terms(model: Model, at: States) -> Values:
    """Return all terms of a description, by Pinocchio."""
    still = [f for f, has in (("loops", model.loops), ("prescribed", model.prescribed)) if has]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NonPhysicalWarning)
        return evaluated(dynamics(model.without(*still)), at)


def evaluated(dyn: Dynamics, at: States) -> Values:
    """Return all terms that an engine can give."""
    out: Values = {}
    for term, quantity, arguments in TERMS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", KnownDefectWarning)
            try:
                out[term] = getattr(dyn, quantity)(*(getattr(at, x) for x in arguments))
            except MbkitError:
                # A term that one side cannot give is none to compare.
                continue
    return out


def gaps(a: Values, b: Values, v: Array, joints: Sequence[str]) -> Gaps:
    """Return how far values are apart, by what `a` has.

    Parameters
    ----------
    a, b : dict
        Term -> values at the same states.
    v : (N, nv) array
        Velocities of the states.
    joints : sequence of str
        The joint of each velocity.
    """
    # An engine that refuses the state, or has another number of velocities.
    if "M" not in a or "M" not in b or a["M"].shape != b["M"].shape:
        return Gaps((), comparable=False)
    scales = _scales(a, v)
    out = []
    for term in a:
        if term not in b:
            continue
        errors: Any = matrix_errors if term == "M" else force_errors
        measured = errors(b[term] - a[term], a[term], scales)
        per = measured.per_velocity
        joint = joints[int(np.argmax(per))] if per.size and per.max() > 0 else ""
        largest = float(measured.relative.max(initial=0.0))
        # NaN passes no comparison, and would be lost in a maximum.
        out.append(Gap(term, np.inf if np.isnan(largest) else largest, joint))
    return Gaps(tuple(out))


def _scales(a: Values, v: Array) -> Scales:
    M = a["M"]
    diagonal = np.einsum("nii->ni", M).copy()
    inertial = np.linalg.norm(M, axis=(1, 2)) * np.sum(v * v, axis=1)
    nothing = np.zeros(len(M))
    return Scales(M, diagonal, inertial, nothing, np.zeros_like(diagonal), nothing, nothing)


# The smallest part of a robot that still differs.


def part(model: Model, joints: set[str]) -> Model:
    """Return some joints of a fused description, with what they carry; what is above them stands still.

    A joint whose parent is left out stands in the world as it stands on its parent. Mimic joints follow
    only what is there.
    """
    kept = [j for j in model.joints if j.name in joints]
    bodies = {j.child for j in kept}
    made = [_grounded(j, bodies, joints) for j in kept]
    springs = [s for s in model.springs if {s.body_a, s.body_b} <= bodies | {"world"}]
    return replace(
        model,
        joints=tuple(made),
        bodies=tuple(b for b in model.bodies if b.name in bodies),
        springs=tuple(springs),
        couplings=tuple(c for c in model.couplings if set(c.joints) <= joints),
        loops=(),
        prescribed=(),
        frames=(),
        nonphysical=tuple(x for x in model.nonphysical if x[0] in bodies),
    )


def _grounded(joint: Joint, bodies: set[str], joints: set[str]) -> Joint:
    if joint.parent not in bodies and joint.parent != "world":
        joint = replace(joint, parent="world")
    if joint.mimic is not None and joint.mimic.joint not in joints:
        joint = replace(joint, mimic=None)
    return joint


def smallest(model: Model, differs: Callable[[set[str]], bool]) -> tuple[str, ...]:
    """Return the joints of the smallest part that still differs, found by taking joints away.

    Parameters
    ----------
    model : Model
        Fused.
    differs : callable
        Whether the part with these joints differs between the two sides.

    Returns
    -------
    tuple of str
        In the model's order; no joint can be left out of it. Empty where only the whole differs.
    """
    below: dict[str, set[str]] = {}
    for joint in reversed(model.tree):
        own = {joint.name}
        for child in model.joints:
            if child.parent == joint.child:
                own |= below[child.name]
        below[joint.name] = own
    # The smallest subtree, and then its branches one by one.
    for joints in sorted(below.values(), key=len):
        if differs(joints):
            left = set(joints)
            break
    else:
        return ()
    for joint in reversed(model.tree):
        # A branch can go when it does not matter; what is above it stays.
        without = left - below[joint.name]
        if joint.name in left and without and differs(without):
            left = without
    return tuple(j.name for j in model.joints if j.name in left)
