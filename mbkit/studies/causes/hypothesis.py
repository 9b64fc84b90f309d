"""A difference between two descriptions, as something that can be put into one and taken out of the other."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mbkit._check import Array
from mbkit.load.solids import Lump
from mbkit.model import Joint, Model
from mbkit.studies.causes.compact import Compact

__all__ = ["Guess", "Hypothesis", "angle_of", "told", "with_joint"]


@dataclass(frozen=True)
class Guess:
    """What a part would be after a mistake.

    Attributes
    ----------
    kind : str
        The mistake's name.
    says : str
        What whoever made it did, beginning with a verb.
    value : Any
        The part as it would then be: a `Lump`, or some fields of a `Joint` or of a `Lump`.
    """

    kind: str
    says: str
    value: Any


def _unchanged(x: Compact, _: Mapping[str, Any]) -> Compact:
    return x


@dataclass(frozen=True)
class Hypothesis:
    """A difference between two descriptions: fields of one part, and a name for it.

    Each hypothesis owns its fields alone, so that any of them can be put into the first description or
    taken out of the second without the others.

    Attributes
    ----------
    kind, subject, says : str
    put : callable
        (description, fields) -> the description with these fields in the part.
    ours, theirs : mapping
        The fields as the first and the second description have them.
    a, b : Any
        The numbers of the two sides, where they are numbers.
    """

    kind: str
    subject: str
    says: str
    put: Callable[[Compact, Mapping[str, Any]], Compact] = field(default=_unchanged, compare=False)
    ours: Mapping[str, Any] = field(default_factory=dict, compare=False)
    theirs: Mapping[str, Any] = field(default_factory=dict, compare=False)
    a: Any = None
    b: Any = None

    def apply(self, x: Compact) -> Compact:
        """Put the difference into a description."""
        return self.put(x, self.theirs)

    def revert(self, x: Compact) -> Compact:
        """Take the difference out of a description that has it."""
        return self.put(x, self.ours)

    def without(self, fields: Container[str]) -> Hypothesis:
        """Return the hypothesis with less fields."""
        ours, theirs = ({k: x for k, x in side.items() if k not in fields} for side in (self.ours, self.theirs))
        return replace(self, ours=ours, theirs=theirs)


def with_joint(model: Model, name: str, **changes: Any) -> Model:
    """Return the description with other fields in one joint."""
    return replace(model, joints=tuple(replace(j, **changes) if j.name == name else j for j in model.joints))


def angle_of(R: Array) -> float:
    """Return the angle of a rotation, rad."""
    off = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(np.linalg.norm(off), np.trace(R) - 1))


def told(value: Any) -> str:
    """Return a number, vector or matrix of a description as a person writes it."""
    if isinstance(value, Lump):
        return f"{told(value.mass)} kg at {told(value.com)} m, inertia {told(value.inertia)}"
    if isinstance(value, Joint):
        return value.kind
    if isinstance(value, np.ndarray):
        if value.shape == (3, 3):
            i, j = np.triu_indices(3)
            if np.array_equal(value, value.T):
                return f"[{', '.join(told(x) for x in value[i, j])}]"
            return f"[{'; '.join(told(row) for row in value)}]"
        if value.size == 1:
            return told(float(value.ravel()[0]))
        return f"({', '.join(told(x) for x in value.ravel().tolist())})"
    # Rounding that nobody wrote is not worth a dozen digits.
    return f"{0.0 if abs(value) < 1e-15 else value:.6g}" if isinstance(value, (int, float)) else str(value)
