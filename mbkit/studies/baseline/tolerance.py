"""How far numbers are from the recorded ones, and how far they may be.

Errors are those of `mbkit.studies.compare.errors`, on the recorded values' own scales, so nothing but the
file and an engine is needed. An engine's own error against 34 digits, found when it was recorded, says
what its rounding is: 16 times that is allowed, because the error is the worst of a handful of states
and another processor rounds elsewhere; and of an error below 8 eps (`FINE`) 16 times 8 eps, because a
handful of states can by chance show almost none. What differed by more than `ROUNDING` when it was
recorded is no rounding; it is held against the engine's own values, to `OWN`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines.registry import ENGINES
from mbkit.studies import results
from mbkit.studies.baseline.description import Description, moving_mass
from mbkit.studies.baseline.file import ROLLOUT, Baseline
from mbkit.studies.compare.errors import Errors, Scales
from mbkit.studies.compare.terms import TERMS, States

FINE: Final = 8.0 * float(np.finfo(float).eps)
ROUNDING: Final = 1e-9
OWN: Final = 1e-12
_FACTOR: Final = 16.0
_ERRORS: Final[dict[str, Callable[..., Errors]]] = {t.name: t.errors for t in TERMS}


@dataclass(frozen=True)
class Moved:
    """A term that is not what was recorded, at its worst state and joint.

    Attributes
    ----------
    term, engine : str
    joint : str
        Name of the velocity, or of the two of an entry of M; empty for energies.
    state : str
        Which of the recorded states.
    recorded, now : float
        The entry that differs most for that joint.
    error, allowed : float
        As `mbkit.studies.compare.errors` has them.
    cause : str
        Which version moved.
    reason : str
        What else there is to say; alone where the engine gave no number.
    """

    term: str
    engine: str
    joint: str
    state: str
    recorded: float
    now: float
    error: float
    allowed: float
    cause: str = ""
    reason: str = ""

    def __str__(self) -> str:
        if np.isnan(self.now):
            return f"{self.term}: {self.reason}"
        at = f" at {self.joint}" if self.joint else ""
        where = f" ({self.state})" if self.state else ""
        change = f"{self.term}{at}{where}: {self.recorded:.12g} → {self.now:.12g}"
        more = f"; {self.reason}" if self.reason else ""
        return f"{change}, off by {self.error:.1e} where {self.allowed:.1e} is rounding{more}"


def allowed(baseline: Baseline, engine: str, term: str) -> float:
    """Return the error that is still rounding."""
    if term in baseline.own.get(engine, {}):
        return OWN
    recorded = baseline.errors[engine][term]
    if term == ROLLOUT:
        # Rounding grows along a motion, by what only the motion tells: the worst of all engines.
        recorded = max(e[term] for e in baseline.errors.values() if e.get(term, np.inf) <= ROUNDING)
    return _FACTOR * max(recorded, FINE)


class Comparator:
    """Measures values of any term against others; `terms` are the values that set the scales."""

    def __init__(
        self,
        terms: Mapping[str, Array],
        at: States,
        description: Description,
        coordinates: Iterable[str],
        velocities: Iterable[str],
    ) -> None:
        mass, gravity = moving_mass(description)
        acting = np.abs(at.tau) + sum(np.abs(terms[name]) for name in ("nle", "passive") if name in terms)
        self.scales = Scales.of(terms["M"], at.v, acting, float(np.linalg.norm(gravity)) * float(np.sqrt(mass)))
        self.velocities = tuple(velocities)
        self._split = len(tuple(coordinates))
        self._ends = tuple(f"{kind} of {n}" for kind, names in (("q", coordinates), ("v", velocities)) for n in names)
        self.states = tuple(f"{kind} state {k + 1}" for k, kind in enumerate(at.kinds))

    @classmethod
    def of(cls, baseline: Baseline) -> Comparator:
        """Return the one of a baseline."""
        b = baseline
        return cls(b.terms, b.states, b.description, b.coordinates, b.velocities)

    def errors(self, term: str, value: Array, reference: Array) -> Errors:
        """Measure a term's values."""
        if term == ROLLOUT:
            return self._ends_apart(value, reference)
        return _ERRORS[term](value - reference, reference, self.scales)

    def _ends_apart(self, value: Array, reference: Array) -> Errors:
        """Measure the ends of two rollouts: q and v each relative to their size, rad, m and s or more."""
        e, k = np.abs(value - reference), self._split
        size = np.concatenate([np.full(len(x), max(1.0, float(np.abs(x).max()))) for x in np.split(reference, [k])])
        return Errors(e.max(keepdims=True), (e / size).max(keepdims=True), e / size)

    def moved(self, engine: str, term: str, value: Array, reference: Array, least: float) -> Moved | None:
        """Return where a term is off by more than `least`, or None."""
        errors = self.errors(term, value, reference)
        error = float(errors.relative[errors.worst])
        if error <= least:
            return None
        joint, state, index = self._worst(term, errors, np.abs(value - reference))
        return Moved(term, engine, joint, state, float(reference[index]), float(value[index]), error, least)

    def _worst(self, term: str, errors: Errors, apart: Array) -> tuple[str, str, Any]:
        """Return the joint and state that are off most, and the entry."""
        per = errors.per_velocity
        if not per.size:
            return "", self.states[errors.worst], errors.worst
        j = int(np.argmax(per))
        if term == ROLLOUT:
            return self._ends[j], "", j
        if apart.ndim == 2:
            n = int(np.argmax(apart[:, j]))
            return self.velocities[j], self.states[n], (n, j)
        n, i = (int(x) for x in np.unravel_index(np.argmax(apart[:, j]), apart[:, j].shape))
        pair = self.velocities[j] if i == j else f"{self.velocities[j]}, {self.velocities[i]}"
        return pair, self.states[n], (n, j, i)


# Which package computes for which engine, and which of them have moved.

# The description and the states come from these, whatever the engine.
_SHARED: Final = ("mbkit", "pin", "numpy")


@dataclass(frozen=True)
class VersionChange:
    """A package whose version differs."""

    package: str
    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.package} {self.old} → {self.new}"


_ABSENT: Final = "not installed"


def _package(engine: str) -> str:
    return (ENGINES[engine].distribution if engine in ENGINES else "") or "mbkit"


def relevant(engines: Iterable[str]) -> dict[str, str]:
    """Return the versions that can move numbers of these engines."""
    packages = dict.fromkeys([*_SHARED, *(_package(e) for e in engines)])
    now = results.versions()
    return {p: now[p] for p in packages}


def moved(old: Mapping[str, str], new: Mapping[str, str]) -> tuple[VersionChange, ...]:
    """Return what differs among the packages of both; what is not installed has no version."""
    return tuple(VersionChange(p, x, new[p]) for p, x in old.items() if new.get(p, _ABSENT) not in (x, _ABSENT))


def of_engine(engine: str, old: Mapping[str, str], changed: Iterable[VersionChange]) -> str:
    """Return which version of an engine moved, or that none did, for a failure."""
    changed = tuple(changed)
    package = _package(engine)
    own = [str(m) for m in changed if m.package == package]
    others = [str(m) for m in changed if m.package in _SHARED and m.package != package]
    names = own or [f"{package} {old.get(package, '?')}, as recorded"]
    return "; ".join([*names, *others])
