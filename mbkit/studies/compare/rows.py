"""Rows of a comparison: terms, rollouts, findings and omissions, as plain data."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar, Final

from mbkit.engines.base import DOUBLE_BITS
from mbkit.studies.compare.errors import digits_of

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
