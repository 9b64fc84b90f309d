"""The terms of the equation of motion that are compared, and how each is called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.studies.measure import Errors, Scales, force_errors, matrix_errors, scalar_errors
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
        (values, reference values, scales) -> Errors.
    """

    name: str
    quantity: str
    arguments: tuple[str, ...]
    errors: Callable[[Array, Array, Scales], Errors]

    def call(self, dyn: Dynamics, states: States) -> Array:
        """Evaluate at all states."""
        return np.asarray(getattr(dyn, self.quantity)(*(getattr(states, a) for a in self.arguments)))

    def single(self, dyn: Dynamics, states: States) -> Callable[[], Any]:
        """Return a call at one random state, for timing."""
        method = getattr(dyn, self.quantity)
        arguments = [np.ascontiguousarray(getattr(states, a)[0]) for a in self.arguments]
        return lambda: method(*arguments)


def _accelerations(x: Array, reference: Array, scales: Scales) -> Errors:
    return force_errors(x, reference, scales, by_condition=True)


def _energies(x: Array, reference: Array, scales: Scales) -> Errors:
    return scalar_errors(x, reference, scales.floor)


TERMS: Final = (
    Term("M", "mass_matrix", ("q",), matrix_errors),
    Term("g", "gravity", ("q",), force_errors),
    Term("nle", "nle", ("q", "v"), force_errors),
    Term("C v", "coriolis_force", ("q", "v"), force_errors),
    Term("passive", "passive", ("q", "v"), force_errors),
    Term("inverse dynamics", "inverse_dynamics", ("q", "v", "a"), force_errors),
    Term("forward dynamics", "forward_dynamics", ("q", "v", "tau"), _accelerations),
    Term("kinetic energy", "kinetic_energy", ("q", "v"), _energies),
    Term("potential energy", "potential_energy", ("q",), _energies),
)
