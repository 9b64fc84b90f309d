"""The terms of the equation of motion that are compared, and how each is called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.oracle import OracleDynamics
from mbkit.studies.measure import (
    Errors,
    Scales,
    acceleration_errors,
    energy_errors,
    force_errors,
    matrix_errors,
)
from mbkit.studies.states import States

__all__ = ["TERMS", "Term"]


@dataclass(frozen=True)
class Term:
    """One compared quantity.

    Attributes
    ----------
    name : str
        As it stands in tables.
    quantity : str
        Method of `Dynamics`.
    arguments : tuple of str
        Fields of `States`.
    errors : callable
        (errors, reference values, scales) -> Errors.
    """

    name: str
    quantity: str
    arguments: tuple[str, ...]
    errors: Callable[[Array, Array, Scales], Errors]

    def call(self, dyn: Dynamics, states: States) -> Array:
        """Evaluate at all states."""
        return np.asarray(getattr(dyn, self.quantity)(*(getattr(states, a) for a in self.arguments)))

    def reference(self, oracle: OracleDynamics, states: States) -> tuple[Array, Array]:
        """Return the oracle's values at all states, high and low part."""
        return oracle.extended(self.quantity, *(getattr(states, a) for a in self.arguments))

    def single(self, dyn: Dynamics, states: States) -> Callable[[], Any]:
        """Return a call at one random state, for timing."""
        method = getattr(dyn, self.quantity)
        arguments = [np.ascontiguousarray(getattr(states, a)[0]) for a in self.arguments]
        return lambda: method(*arguments)


_HEAVY: Final = partial(force_errors, heavy=True)

TERMS: Final = (
    Term("M", "mass_matrix", ("q",), matrix_errors),
    Term("g", "gravity", ("q",), _HEAVY),
    Term("nle", "nle", ("q", "v"), _HEAVY),
    Term("C v", "coriolis_force", ("q", "v"), force_errors),
    Term("passive", "passive", ("q", "v"), force_errors),
    Term("inverse dynamics", "inverse_dynamics", ("q", "v", "a"), _HEAVY),
    Term("forward dynamics", "forward_dynamics", ("q", "v", "tau"), acceleration_errors),
    Term("kinetic energy", "kinetic_energy", ("q", "v"), energy_errors),
    Term("potential energy", "potential_energy", ("q",), energy_errors),
)
