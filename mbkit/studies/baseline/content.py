"""What a baseline holds, as plain data and arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

from mbkit._check import Array
from mbkit.studies.baseline.description import Description
from mbkit.studies.compare.terms import States
from mbkit.studies.results import Refusal

__all__ = ["ROLLOUT", "Baseline", "Rollout"]

#: The name of a rollout's end among the terms: q, then v, (nq + nv,).
ROLLOUT: Final = "rollout"


@dataclass(frozen=True)
class Rollout:
    """How far a rollout goes from the first state: `steps` of Runge-Kutta 4 of `dt` s, without forces."""

    dt: float
    steps: int


@dataclass(frozen=True, eq=False)
class Baseline:
    """What was recorded of one model, as `record` returns and `read` reads it.

    Attributes
    ----------
    model : str
        Name of the model.
    digest : str
        Its fingerprint, `Model.digest`.
    target, options
        What `mbkit baseline check` loads, and how; empty where a model itself was given.
    seed : int
    processor : str
    versions : dict
        Of what computes, by package.
    description : dict
        The model's parameters, as `mbkit.studies.baseline.description` has them.
    coordinates, velocities : tuple of str
    states : States
    rollout : Rollout
    terms : dict
        Term -> values at the states by the oracle, rounded to double. ``"rollout"`` is the end
        of a rollout.
    errors : dict
        Engine -> term -> worst error against these, as `mbkit.studies.compare.errors` defines it; zero for
        one of less than 8 eps, which any engine may have.
    own : dict
        Engine -> term -> the engine's own values, where it differed by more than rounding.
    left_out : tuple of Refusal
        What an engine could not do when this was recorded.
    """

    model: str
    digest: str
    target: str
    options: dict[str, Any]
    seed: int
    processor: str
    versions: dict[str, str]
    description: Description
    coordinates: tuple[str, ...]
    velocities: tuple[str, ...]
    states: States
    rollout: Rollout
    terms: dict[str, Array]
    errors: dict[str, dict[str, float]]
    own: dict[str, dict[str, Array]] = field(default_factory=dict)
    left_out: tuple[Refusal, ...] = ()

    @property
    def engines(self) -> tuple[str, ...]:
        """The engines that were recorded."""
        return tuple(self.errors)

    @property
    def disagreements(self) -> tuple[str, ...]:
        """Where an engine differed from the oracle by more than rounding when this was recorded."""
        return tuple(
            f"{engine}: {term} differs from the oracle by {self.errors[engine][term]:.1e}; recorded as it is"
            for engine, terms in self.own.items()
            for term in terms
        )

    def __repr__(self) -> str:
        told = f"{len(self.terms)} terms at {len(self.states.kinds)} states"
        return f"<Baseline of {self.model!r}: {', '.join(self.engines)}; {told}>"
